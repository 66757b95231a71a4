//! Baseline in a weights file: the localizer of its kind.

use std::path::Path;

use perception::weights::{KIND_KEY, Weights};
use tch::Device;

use super::diffloc::DiffLocLocalizer;
use super::hypliloc::HypLiLocLocalizer;
use super::polar_retrieval::DescribePolar;
use super::sgloc::SgLocLocalizer;
use crate::pgc::pose_solver::PoseSolver;
use crate::pgc::{Localize, Result};

/// Reads the weights of a baseline; `solver` is for those that regress coordinates.
///
/// # Errors
/// [`LocalizerError`](crate::pgc::LocalizerError) when the file is missing, truncated or of no baseline, or its tensors are not those of its
/// configuration.
pub fn load_baseline(path: &Path, device: Device, solver: PoseSolver) -> Result<Box<dyn Localize>> {
    match Weights::load(path)?.metadata(KIND_KEY) {
        Some(DiffLocLocalizer::KIND) => Ok(Box::new(DiffLocLocalizer::load(path, device)?)),
        Some(HypLiLocLocalizer::KIND) => Ok(Box::new(HypLiLocLocalizer::load(path, device)?)),
        _ => Ok(Box::new(SgLocLocalizer::load(path, device, solver)?)),
    }
}

/// Reads the weights of a baseline that regresses poses, whose tokens describe a sweep.
///
/// # Errors
/// As [`load_baseline`], and for other baselines.
pub fn load_descriptor(path: &Path, device: Device) -> Result<Box<dyn DescribePolar>> {
    match Weights::load(path)?.metadata(KIND_KEY) {
        Some(DiffLocLocalizer::KIND) => Ok(Box::new(DiffLocLocalizer::load(path, device)?)),
        _ => Ok(Box::new(HypLiLocLocalizer::load(path, device)?)),
    }
}
