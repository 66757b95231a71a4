//! Configuration of any training run: length, learning rate, device and precision.

use std::path::{Path, PathBuf};
use std::time::Duration;

use support::atomic_file;
use support::file_error::{AtFile, FileError};
use tch::Device;

use crate::compute_precision::ComputePrecision;

use super::adamw::AdamWConfig;
use super::checkpoint::CHECKPOINT_FILE;
use super::interruption::Interruption;
use super::schedule::RateSchedule;

/// Configuration of a training run, for any network.
#[derive(Debug, Clone)]
pub struct RunConfig {
    /// Length of the training.
    pub length: Length,
    /// Number of samples, pairs, sweeps or cells per step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Course of the learning rate.
    pub schedule: RateSchedule,
    /// Constants of the optimizer.
    pub optimizer: AdamWConfig,
    /// Seed of parameters, order and augmentation.
    pub seed: u64,
    /// Device of the network.
    pub device: Device,
    /// Number format of products.
    pub precision: ComputePrecision,
    /// Threads that prepare batches.
    pub loader_threads: usize,
    /// Folder of checkpoint, curve, weights and model card.
    pub out: PathBuf,
    /// True to resume from the checkpoint in `out`.
    pub resume: bool,
    /// Request to end early, with a checkpoint.
    pub interruption: Interruption,
    /// The user's command line, for the model card.
    pub command: String,
}

impl RunConfig {
    /// One sample at a time on the CPU, in single precision, into `out`.
    pub fn new(length: Length, out: &Path) -> Self {
        Self {
            length,
            batch: 1,
            learning_rate: 1e-3,
            schedule: RateSchedule::default(),
            optimizer: AdamWConfig::default(),
            seed: 0,
            device: Device::Cpu,
            precision: ComputePrecision::F32,
            loader_threads: 1,
            out: out.to_owned(),
            resume: false,
            interruption: Interruption::default(),
            command: String::new(),
        }
    }

    /// Creates the folder of the results and seeds the tensor library; must precede the first draw of a parameter. Removes
    /// the checkpoint of an earlier training there, unless it is resumed.
    ///
    /// # Errors
    /// [`FileError`] when the folder cannot be created, or the checkpoint not removed.
    pub fn start(&self) -> Result<(), FileError> {
        tch::manual_seed(self.seed as i64);
        atomic_file::create_folder(&self.out).at(&self.out)?;
        if self.resume {
            return Ok(());
        }
        // Of a training that is overwritten: --resume would go on with it if this one ended before its first checkpoint.
        let path = self.out.join(CHECKPOINT_FILE);
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error).at(&path),
            _ => Ok(()),
        }
    }
}

/// Length of a training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Length {
    /// Number of steps.
    Steps(u64),
    /// Number of passes over the data.
    Epochs(f64),
    /// As many steps as fit into a time; the learning rate follows the clock. Not bit-reproducible.
    Time(Duration),
}

impl Length {
    /// Share of the training that is done, 0 at the start, 1 or more at the end.
    pub fn share_done(self, step: u64, epoch: f64, seconds: f64) -> f64 {
        match self {
            Self::Steps(steps) => step as f64 / steps.max(1) as f64,
            Self::Epochs(epochs) => epoch / epochs.max(f64::MIN_POSITIVE),
            Self::Time(limit) => seconds / limit.as_secs_f64().max(f64::MIN_POSITIVE),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_training_that_starts_anew_leaves_no_older_checkpoint_to_resume() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoint = folder.path().join(CHECKPOINT_FILE);
        let run = RunConfig {
            resume: true,
            ..RunConfig::new(Length::Steps(1), folder.path())
        };
        std::fs::write(&checkpoint, b"").unwrap();
        run.start().unwrap();
        assert!(checkpoint.exists());
        RunConfig {
            resume: false,
            ..run
        }
        .start()
        .unwrap();
        assert!(!checkpoint.exists());
    }
}
