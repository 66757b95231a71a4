//! Errors of scenarios from which no fleet can be built.

use std::path::PathBuf;

use dataset::ReadError;
use ego_fuser::ego::EgoError;
use link::LinkError;
use localization::pgc::LocalizerError;
use perception::weights::FileError;
use protocol::CavId;

use crate::scenario::weights_choice::WeightsChoiceError;

/// Reason why no fleet can be built from a scenario.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// The scene cannot be read.
    #[error("scene: {0}")]
    Scene(#[from] ReadError),
    /// The evaluation protocol is not known or contradicts itself.
    #[error("protocol: {0}")]
    Protocol(String),
    /// The data set has no scenario at all.
    #[error("scene {}: there is no scenario in it", .0.display())]
    Empty(PathBuf),
    /// The data set has no scenario of that name.
    #[error("scene {}: there is no scenario {asked:?}; it has {found:?}", dir.display())]
    NoScenario {
        /// Folder of the data set.
        dir: PathBuf,
        /// Requested name.
        asked: String,
        /// Names in the data set.
        found: Vec<String>,
    },
    /// The scenario has no capture time that all its vehicles have.
    #[error("scene {}: scenario {name} has no frame that all of {agents:?} have", dir.display())]
    NoFrames {
        /// Folder of the data set.
        dir: PathBuf,
        /// Name of the scenario.
        name: String,
        /// Ids of its vehicles.
        agents: Vec<String>,
    },
    /// The first tick to play is behind the last.
    #[error("scene.seek is {seek}, but scenario {name} has {ticks} ticks")]
    Seek {
        /// Requested tick, from 0.
        seek: usize,
        /// Name of the scenario.
        name: String,
        /// Number of its ticks.
        ticks: usize,
    },
    /// A vehicle is named that the scene does not have.
    #[error("{field} names vehicle {cav}, but scenario {name} has {found:?}")]
    NoVehicle {
        /// Field with the id.
        field: &'static str,
        /// Id of the vehicle.
        cav: CavId,
        /// Name of the scenario.
        name: String,
        /// Ids of the vehicles in the scene.
        found: Vec<String>,
    },
    /// A vehicle is to take its pose from a recording that has none.
    #[error(
        "vehicle {cav}: pose is {source_name}, but scenario {name} has no poses of it (no lidar_pose); choose pose: pgc, \
         which finds them"
    )]
    NoPoses {
        /// Id of the vehicle.
        cav: CavId,
        /// Name of its pose source.
        source_name: &'static str,
        /// Name of the scenario.
        name: String,
    },
    /// The weights cannot be used.
    #[error("weights: {0}")]
    Weights(#[from] FileError),
    /// The ego cannot fuse with the weights.
    #[error("weights: {0}")]
    Ego(#[from] EgoError),
    /// There are no weights for the method.
    #[error(transparent)]
    NoWeights(#[from] WeightsChoiceError),
    /// The link emulation cannot be built.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The pose networks cannot be used, or not together.
    #[error("localizer: {0}")]
    Localizer(#[from] LocalizerError),
}
