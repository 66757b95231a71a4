//! Shared files: weights and scenarios that come with the programs, wherever those are installed.

use std::env;
use std::path::{Path, PathBuf};

/// Their folders from the folder of the programs: `bin` of an installation, `target/release` of a checkout.
const FROM_PROGRAMS: [&str; 2] = ["../share/v2vloc", "../../deploy"];

/// Every existing place of a file or folder, for example `weights` or `scenarios/demo.yaml`; that of an installation
/// first.
pub fn shared(name: &str) -> Vec<PathBuf> {
    let programs = env::current_exe()
        .ok()
        .and_then(|own| own.parent().map(Path::to_owned));
    let places = programs
        .iter()
        .flat_map(|folder| FROM_PROGRAMS.map(|place| folder.join(place).join(name)));
    places.filter(|place| place.exists()).collect()
}
