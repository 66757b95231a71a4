//! What can go wrong when scenes are generated.

use std::path::PathBuf;

use crate::town::TownError;

/// Why scenes could not be generated.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// The town could not be built.
    #[error(transparent)]
    Town(#[from] TownError),
    /// There is something in the output folder already.
    #[error("{} is not empty; --force writes into it all the same", .0.display())]
    NotEmpty(PathBuf),
    /// A file or folder could not be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// What was written.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
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
