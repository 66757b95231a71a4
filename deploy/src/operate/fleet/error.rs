//! Why a scenario makes no fleet.

use std::path::PathBuf;

use dataset::ReadError;
use link::LinkError;
use localization::pgc::LocalizerError;
use perception::weights::WeightsError;
use protocol::CavId;

use crate::experiment::weights_choice::WeightsChoiceError;

/// Why a scenario makes no fleet.
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
        /// The data set.
        dir: PathBuf,
        /// The name asked for.
        asked: String,
        /// The names there are.
        found: Vec<String>,
    },
    /// The scenario has no moment that all its vehicles have.
    #[error("scene {}: scenario {name} has no frame that all of {agents:?} have", dir.display())]
    NoFrames {
        /// The data set.
        dir: PathBuf,
        /// The scenario.
        name: String,
        /// Its vehicles.
        agents: Vec<String>,
    },
    /// The first tick to play is behind the last.
    #[error("scene.seek is {seek}, but scenario {name} has {ticks} ticks")]
    Seek {
        /// The tick asked for.
        seek: usize,
        /// The scenario.
        name: String,
        /// Its ticks.
        ticks: usize,
    },
    /// A vehicle is named that the scene does not have.
    #[error("{field} names vehicle {cav}, but scenario {name} has {found:?}")]
    NoVehicle {
        /// Where it is named.
        field: &'static str,
        /// The vehicle.
        cav: CavId,
        /// The scenario.
        name: String,
        /// The vehicles there are.
        found: Vec<String>,
    },
    /// A vehicle is to take its pose from a recording that has none.
    #[error(
        "vehicle {cav}: pose is {source_name}, but scenario {name} has no poses of it (no lidar_pose); choose pose: pgc, \
         which finds them"
    )]
    NoPoses {
        /// The vehicle.
        cav: CavId,
        /// Where its pose was to come from.
        source_name: &'static str,
        /// The scenario.
        name: String,
    },
    /// The weights cannot be used.
    #[error("weights: {0}")]
    Weights(#[from] WeightsError),
    /// There are no weights for the method.
    #[error(transparent)]
    NoWeights(#[from] WeightsChoiceError),
    /// The emulated air cannot be made.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The networks that find poses cannot be used, or not together.
    #[error("localizer: {0}")]
    Localizer(#[from] LocalizerError),
}
