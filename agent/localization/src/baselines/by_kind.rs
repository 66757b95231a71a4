//! Baseline in a weights file: the localizer of its kind.

use std::path::Path;

use perception::weights::{KIND_KEY, Weights};
use tch::Device;

use super::diffloc::DiffLocLocalizer;
use super::hypliloc::HypLiLocLocalizer;
use super::sgloc::SgLocLocalizer;
use crate::pgc::pose_solver::PoseSolver;
use crate::pgc::{Localize, LocalizerError};

/// Reads the weights of a baseline; `solver` is for those that regress coordinates.
///
/// # Errors
/// [`LocalizerError`] when the file is missing, truncated or of no baseline, or its tensors are not those of its
/// configuration.
pub fn load_baseline(
    path: &Path,
    device: Device,
    solver: PoseSolver,
) -> Result<Box<dyn Localize>, LocalizerError> {
    match Weights::load(path)?.metadata(KIND_KEY) {
        Some(DiffLocLocalizer::KIND) => Ok(Box::new(DiffLocLocalizer::load(path, device)?)),
        Some(HypLiLocLocalizer::KIND) => Ok(Box::new(HypLiLocLocalizer::load(path, device)?)),
        _ => Ok(Box::new(SgLocLocalizer::load(path, device, solver)?)),
    }
}
