//! What can go wrong when scenes are generated.

use std::path::PathBuf;

use crate::map::TownError;

/// Why scenes could not be generated.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// The town could not be built.
    #[error(transparent)]
    Town(#[from] TownError),
    /// There is something in the output folder already.
    #[error("{} is not empty; --force writes into it all the same", .0.display())]
    NotEmpty(PathBuf),
    /// Scenes that are kept are not those that are asked for.
    #[error("{} holds scenes made with {setting} {found}, not {wanted}; take another folder, or remove it", folder.display())]
    Kept {
        /// Where they lie.
        folder: PathBuf,
        /// The first setting that differs.
        setting: &'static str,
        /// What they were made with.
        found: String,
        /// What is asked for.
        wanted: String,
    },
    /// What lies in a folder does not say how it was made.
    #[error("{}: {problem}; scenes that were generated say there how", path.display())]
    Read {
        /// The file that should.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// A file or folder could not be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// What was written.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// A layout cannot hold a scene.
    #[error("layout {layout}: {reason}")]
    Layout {
        /// The layout's name.
        layout: &'static str,
        /// What it cannot hold.
        reason: String,
    },
    /// A number of the options makes no sense.
    #[error("{option} is {value}; {expected}")]
    Option {
        /// Its name on the command line.
        option: &'static str,
        /// What was given.
        value: String,
        /// What would do.
        expected: &'static str,
    },
    /// The road network has no place for a vehicle.
    #[error("town {0} has no lane long enough to start from")]
    NoRoad(String),
    /// No group of vehicles stays together.
    #[error(
        "scene {scenario}: {found} vehicles stay within {range_m} m of the ego, {wanted} are wanted; fewer --agents or --frames help"
    )]
    Alone {
        /// The scenario.
        scenario: String,
        /// How many companions there are.
        found: usize,
        /// How many are needed.
        wanted: usize,
        /// Within this distance, metres.
        range_m: f64,
    },
}
