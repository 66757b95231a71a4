//! Specification of a pose source: what the program asks of its settings.

use std::path::{Path, PathBuf};

use perception::inference::Inference;
use protocol::EgoMotion;
use protocol::config::FieldError;

use super::{PoseSource, PoseSourceError};

/// Input from which a source makes its poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PoseBasis {
    /// The measured pose of the sweep.
    MeasuredPose,
    /// Points of the sweep.
    Sweep,
    /// Files only.
    Files,
}

/// Settings of a pose source. Its file implements this, and its row is in `table.rs`.
pub(crate) trait PoseSettings {
    /// Input from which the poses are made: the sweep, unless a source states another one.
    fn basis(&self) -> PoseBasis {
        PoseBasis::Sweep
    }

    /// Sets the source up with checked settings and reads its files.
    fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError>;

    /// Checks the values; files are not opened.
    fn validate(&self) -> Result<(), FieldError> {
        Ok(())
    }

    /// Encoder, scene-specific head and surfel map of PGC: they may be given by name, and by the options `--encoder`,
    /// `--head` and `--surfel-map`. Beside them the least confidence of a pose, by the option `--min-confidence`.
    fn networks(&mut self) -> Option<([&mut PathBuf; 3], &mut f64)> {
        None
    }

    /// Files that the source reads.
    fn files(&mut self) -> Vec<&mut PathBuf> {
        let networks = self.networks().into_iter().flat_map(|(files, _)| files);
        // A surfel map is optional.
        (networks.filter(|file| !file.as_os_str().is_empty())).collect()
    }

    /// Prefix of the identifiers of its options, before the name of the field.
    fn option_prefix() -> &'static str
    where
        Self: Sized,
    {
        ""
    }

    /// False for an option of the source that has no effect beside its other settings.
    fn has_use_for(&self, _option: &str) -> bool {
        true
    }

    /// Name of the mode in which the source runs, for errors about its options.
    fn mode(&self) -> Option<String> {
        None
    }

    /// Chooses one scenario of many, once: a seed is derived from the one before.
    fn set_scenario(&mut self, _name: &str) {}

    /// Lets several vehicles on one machine measure in turn.
    fn set_turn(&mut self, _turn: u32) {}

    /// Has every sweep measured.
    fn measure_every_sweep(&mut self) {}

    /// Sweeps from one that is measured after its pose was published to the next.
    fn measuring_interval(&self, _motion: &EgoMotion) -> u32 {
        1
    }

    /// True if the ego of a fleet has the recorded pose instead.
    fn spares_ego(&self) -> bool {
        false
    }
}

/// Refuses an empty file name; `option` names the file on a command line.
pub(super) fn require_file(field: &str, option: &str, file: &Path) -> Result<(), FieldError> {
    if !file.as_os_str().is_empty() {
        return Ok(());
    }
    let rule = format!("must name a file ({option})");
    Err(FieldError::new(field, "empty", rule))
}
