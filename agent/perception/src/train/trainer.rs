//! Gradient descent as every training here does it: steps along one cycle of the learning rate, checkpoints that it goes
//! on from, and weights in the end.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use tch::Tensor;
use tch::nn::VarStore;

use super::adamw::{AdamW, Step};
use super::checkpoint;
use super::curve::Curve;
use super::data_listing::DataListing;
use super::error::TrainingError;
use super::run_config::RunConfig;
use super::schedule::OneCycle;
use crate::weights;

/// Gradients that are not finite in a row before a training gives up.
const MAX_SKIPPED: u32 = 20;

/// What a checkpoint remembers beside parameters and moments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Progress {
    step: u64,
    seconds: f64,
    seed: u64,
    batch: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    method: Option<String>,
}

impl Progress {
    /// Refuses what was stored by a training with another seed, batch or method.
    fn check(&self, asked: &Self) -> Result<(), TrainingError> {
        let text = |method: &Option<String>| method.clone().unwrap_or_default();
        let fields = [
            ("seed", self.seed.to_string(), asked.seed.to_string()),
            ("batch", self.batch.to_string(), asked.batch.to_string()),
            ("method", text(&self.method), text(&asked.method)),
        ];
        match fields.into_iter().find(|(_, found, asked)| found != asked) {
            Some((field, found, asked)) => Err(TrainingError::OtherTraining { field, found, asked }),
            None => Ok(()),
        }
    }
}

/// The weights that a training has written.
#[derive(Debug, Clone)]
pub struct Trained {
    /// Steps done.
    pub steps: u64,
    /// Seconds spent, in all runs together.
    pub seconds: f64,
    /// What it learnt from.
    pub data: DataListing,
    /// The weights, in half precision.
    pub weights: PathBuf,
    /// Their SHA-256.
    pub sha256: String,
    /// Number of parameters.
    pub parameters: usize,
}

/// A training in progress.
#[derive(Debug)]
pub struct Trainer {
    run: RunConfig,
    optimizer: AdamW,
    progress: Progress,
    skipped: u32,
    started: Instant,
    seconds_before: f64,
}

impl Trainer {
    /// Begins with `variables` as they are or, where `run` resumes, goes on from its checkpoint. Time counts from `started`;
    /// `method` is what a checkpoint has to be of where the same network is trained in several ways.
    ///
    /// # Errors
    /// [`TrainingError`] when the checkpoint is missing, cut off or of another training.
    pub fn begin(
        run: &RunConfig,
        variables: &VarStore,
        method: Option<&str>,
        started: Instant,
    ) -> Result<Self, TrainingError> {
        let mut optimizer = AdamW::new(variables, run.optimizer);
        let mut progress =
            Progress { step: 0, seconds: 0.0, seed: run.seed, batch: run.batch, method: method.map(str::to_owned) };
        if run.resume {
            let stored: Progress = checkpoint::restore(&checkpoint_path(run), variables, &mut optimizer)?;
            stored.check(&progress)?;
            progress = stored;
        }
        let seconds_before = progress.seconds;
        Ok(Self { run: run.clone(), optimizer, progress, skipped: 0, started, seconds_before })
    }

    /// The course so far, in `curve.csv` of the folder of the results.
    ///
    /// # Errors
    /// [`TrainingError::Io`] when the file cannot be written.
    pub fn curve(&self, header: &str) -> Result<Curve, TrainingError> {
        let checkpoint = self.run.resume.then_some(self.progress.step);
        Curve::open(&self.run.out.join("curve.csv"), header, checkpoint)
    }

    /// Steps done.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.progress.step
    }

    /// Seconds spent, in all runs together.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// The share that is done after `epoch` passes over the data, 0 at the start, 1 or more at the end.
    #[must_use]
    pub fn share_done(&self, epoch: f64) -> f64 {
        self.run.length.share_done(self.steps(), epoch, self.seconds())
    }

    /// The learning rate when a share is done.
    #[must_use]
    pub fn learning_rate(&self, share_done: f64) -> f64 {
        OneCycle { peak: self.run.learning_rate }.at(share_done)
    }

    /// Descends along the gradient of `loss`, or skips the step where that is not finite. Whether it was taken.
    ///
    /// # Errors
    /// [`TrainingError::Diverged`] after too many gradients that were not finite, and the tensor library's.
    pub fn step(&mut self, loss: &Tensor, share_done: f64) -> Result<bool, TrainingError> {
        self.optimizer.zero_grad();
        loss.f_backward()?;
        let taken = self.optimizer.step(self.learning_rate(share_done))? != Step::Skipped;
        self.skipped = if taken { 0 } else { self.skipped + 1 };
        if self.skipped >= MAX_SKIPPED {
            return Err(TrainingError::Diverged(self.skipped));
        }
        self.progress.step += 1;
        Ok(taken)
    }

    /// Writes a checkpoint of `variables` and all that is needed to go on from it.
    ///
    /// # Errors
    /// [`TrainingError::Checkpoint`] when the file cannot be written.
    pub fn checkpoint(&mut self, variables: &VarStore) -> Result<(), TrainingError> {
        self.progress.seconds = self.seconds();
        Ok(checkpoint::save(&checkpoint_path(&self.run), variables, &self.optimizer, &self.progress)?)
    }

    /// Writes the weights; their header says `about` what they are, and how they were trained.
    ///
    /// # Errors
    /// [`TrainingError::Weights`] when a parameter is not finite or the file cannot be written.
    pub fn save_weights(
        &self,
        variables: &VarStore,
        mut about: BTreeMap<String, String>,
        data: DataListing,
    ) -> Result<Trained, TrainingError> {
        about.insert("seed".to_owned(), self.run.seed.to_string());
        about.insert("steps".to_owned(), self.steps().to_string());
        about.insert("data_sha256".to_owned(), data.sha256.clone());
        let path = self.run.out.join("weights.safetensors");
        let sha256 = weights::save(&path, variables, &about, weights::Precision::Half)?;
        Ok(Trained {
            steps: self.steps(),
            seconds: self.seconds(),
            data,
            weights: path,
            sha256,
            parameters: variables.variables().values().map(Tensor::numel).sum(),
        })
    }
}

fn checkpoint_path(run: &RunConfig) -> PathBuf {
    run.out.join("checkpoint.safetensors")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_of_localizers_and_detectors_is_read_and_another_training_refused() {
        let localizer: Progress = serde_json::from_str(r#"{"step":7,"seconds":1.5,"seed":3,"batch":4}"#).unwrap();
        let detector: Progress =
            serde_json::from_str(r#"{"step":7,"seconds":1.5,"seed":3,"batch":4,"method":"max"}"#).unwrap();
        assert!(localizer.check(&Progress { step: 0, seconds: 0.0, ..localizer.clone() }).is_ok());
        for (asked, said) in [
            (Progress { seed: 4, ..detector.clone() }, "seed 3, not 4"),
            (Progress { batch: 8, ..detector.clone() }, "batch 4, not 8"),
            (Progress { method: Some("attention".into()), ..detector.clone() }, "method max, not attention"),
        ] {
            let message = detector.check(&asked).unwrap_err().to_string();
            assert!(message.contains(said), "{message}");
        }
    }
}
