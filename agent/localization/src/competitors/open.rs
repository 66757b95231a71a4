//! Networks trained end to end, opened by the kind in their file.

use std::path::Path;

use perception::weights::{KIND_KEY, Weights};
use tch::Device;

use super::{EndToEndLocalizer, HypLiLocLocalizer};
use crate::pgc::pose_solver::PoseSolver;
use crate::pgc::{Localize, LocalizerError};

/// Reads a network that was trained end to end, of any kind; `solver` is of those that regress coordinates.
///
/// # Errors
/// [`LocalizerError`] names the file and what is wrong with it.
pub fn open_end_to_end(path: &Path, device: Device, solver: PoseSolver) -> Result<Box<dyn Localize>, LocalizerError> {
    match Weights::load(path)?.metadata(KIND_KEY) {
        Some(HypLiLocLocalizer::KIND) => Ok(Box::new(HypLiLocLocalizer::load(path, device)?)),
        _ => {
            let mut localizer = EndToEndLocalizer::load(path, device)?;
            localizer.set_solver(solver);
            Ok(Box::new(localizer))
        }
    }
}
