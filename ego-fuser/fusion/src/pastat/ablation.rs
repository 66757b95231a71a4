//! Ablation of PASTAT: settings without some of its parts.

use perception::model_config::ConfigError;
use protocol::config::FieldError;

use super::config::PastatConfig;
use crate::FusionConfig;

/// A part that can be left out, for the ablation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Part {
    /// Confidence Embedding.
    Ce,
    /// Feature Spatial Alignment.
    Fsa,
    /// Temporal Encoding.
    Te,
    /// Temporal feature memory.
    TemporalMemory,
}

/// Settings without some parts, or with another number of time steps; other methods have no such parts.
///
/// # Errors
/// [`ConfigError`] where there is nothing to leave out.
pub fn ablated(
    fusion: &FusionConfig,
    without: &[Part],
    frames: Option<usize>,
) -> Result<FusionConfig, ConfigError> {
    let Some(config) = fusion.settings::<PastatConfig>() else {
        if without.is_empty() && frames.is_none() {
            return Ok(fusion.clone());
        }
        let value = format!("without {without:?}, {frames:?} frames");
        let rule = "must be unchanged for methods other than pastat";
        return Err(FieldError::new("fusion", value, rule).into());
    };
    let mut config = config.clone();
    for part in without {
        match part {
            Part::Ce => config.ce = false,
            Part::Fsa => config.fsa = None,
            Part::Te => config.te = None,
            Part::TemporalMemory => config.temporal_memory = None,
        }
    }
    config.frames = frames.unwrap_or(config.frames);
    // With one time step there is nothing to remember.
    if config.frames == 1 {
        config.temporal_memory = None;
    }
    Ok(FusionConfig::new(config))
}
