//! Trainer: gradient descent along one cycle of the learning rate, with checkpoints to resume from, and weights at the
//! end.

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use support::cli::Interrupted;
use support::file_error::{AtFile, FileError};
use tch::Tensor;
use tch::nn::VarStore;

use super::adamw::AdamW;
use super::checkpoint::{self, CHECKPOINT_FILE};
use super::curve::Curve;
use super::data_listing::DataListing;
use super::error::TrainingError;
use super::interruption::Steps;
use super::run_config::RunConfig;
use crate::weights::{self, CONFIG_KEY, KIND_KEY};

/// Number of gradients in a row that are not finite after which a training fails.
const MAX_SKIPPED: u32 = 20;

/// State of a training beside parameters and moments, in its checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "Progress")]
struct CheckpointState {
    step: u64,
    seconds: f64,
    /// Of these, seconds before the first step of each run.
    #[serde(default)]
    preparing_seconds: f64,
    seed: u64,
    batch: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    method: Option<String>,
    /// Identity of the data; absent where it was not stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    data_sha256: Option<String>,
}

impl CheckpointState {
    /// Rejects the state of a training with another seed, batch or method.
    fn check(&self, requested: &Self) -> Result<(), TrainingError> {
        let [found, wanted] =
            [self, requested].map(|progress| progress.method.clone().unwrap_or_default());
        let fields = [
            ("seed", self.seed.to_string(), requested.seed.to_string()),
            ("batch", self.batch.to_string(), requested.batch.to_string()),
            ("method", found, wanted),
        ];
        match fields.into_iter().find(|(_, found, asked)| found != asked) {
            None => Ok(()),
            Some((field, found, asked)) => Err(TrainingError::OtherTraining(field, found, asked)),
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
    /// Identity of the training data.
    pub data: DataListing,
    /// Path of the weights, in half precision.
    pub weights: PathBuf,
    /// SHA-256 of the weights.
    pub sha256: String,
    /// Number of parameters.
    pub parameters: usize,
}

/// A training in progress.
#[derive(Debug)]
pub struct Trainer {
    run: RunConfig,
    /// All that a checkpoint holds, trained or not.
    variables: HashMap<String, Tensor>,
    optimizer: AdamW,
    progress: CheckpointState,
    skipped: u32,
    started: Instant,
    seconds_before: f64,
    steps: Steps,
}

impl Trainer {
    /// Starts with `variables` as they are or, if `run` resumes, continues from its checkpoint. Time counts from
    /// `started`; `method` has to be that of the checkpoint if the same network is trained in several ways.
    ///
    /// # Errors
    /// [`TrainingError`] when the checkpoint is missing, truncated or of another training.
    pub fn begin(
        run: &RunConfig,
        variables: &VarStore,
        method: Option<&str>,
        started: Instant,
    ) -> Result<Self, TrainingError> {
        let mut optimizer = AdamW::new(variables, run.optimizer);
        let mut progress = CheckpointState {
            step: 0,
            seconds: 0.0,
            preparing_seconds: 0.0,
            seed: run.seed,
            batch: run.batch,
            method: method.map(str::to_owned),
            data_sha256: None,
        };
        if run.resume {
            let stored: CheckpointState =
                checkpoint::restore(&run.out.join(CHECKPOINT_FILE), variables, &mut optimizer)?;
            stored.check(&progress)?;
            progress = stored;
        }
        let seconds_before = progress.seconds;
        progress.preparing_seconds += started.elapsed().as_secs_f64();
        // Last: until here a signal ends the process at once.
        let steps = run.interruption.steps();
        Ok(Self {
            run: run.clone(),
            variables: variables.variables(),
            optimizer,
            progress,
            skipped: 0,
            started,
            seconds_before,
            steps,
        })
    }

    /// The same training on data with this identity ([`DataListing::sha256`]), which checkpoints state.
    ///
    /// # Errors
    /// [`TrainingError::OtherTraining`] when the checkpoint that is resumed states other data.
    pub fn on_data(mut self, sha256: &str) -> Result<Self, TrainingError> {
        match self.progress.data_sha256.replace(sha256.to_owned()) {
            Some(found) if found != sha256 => {
                let (field, asked) = ("data of SHA-256", sha256.to_owned());
                Err(TrainingError::OtherTraining(field, found, asked))
            }
            _ => Ok(self),
        }
    }

    /// Training curve, in `curve.csv` of the folder of the results.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be written.
    pub fn curve(&self, header: &str) -> Result<Curve, FileError> {
        let checkpoint = self.run.resume.then_some(self.progress.step);
        Curve::open(&self.run.out.join("curve.csv"), header, checkpoint)
    }

    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.progress.step
    }

    /// True after the first step, so that a user soon sees what a step costs, and after every `period` steps.
    pub fn is_report_due(&self, period: u64) -> bool {
        self.progress.step == 1 || self.progress.step.is_multiple_of(period)
    }

    /// Seconds spent, in all runs together.
    pub fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    /// Seconds spent on steps, in all runs together: without what came before the first step of each.
    pub fn seconds_of_steps(&self) -> f64 {
        self.seconds() - self.progress.preparing_seconds
    }

    /// Share of the training that is done after `epoch` passes over the data, 0 at the start, 1 or more at the end.
    pub fn share_done(&self, epoch: f64) -> f64 {
        let (steps, seconds) = (self.steps(), self.seconds());
        self.run.length.share_done(steps, epoch, seconds)
    }

    /// The learning rate when a share is done.
    pub fn learning_rate(&self, share_done: f64) -> f64 {
        self.run.schedule.rate(self.run.learning_rate, share_done)
    }

    /// Descends along the gradient of `loss`, or skips the step if that is not finite. True if the step was taken.
    ///
    /// # Errors
    /// [`TrainingError::Diverged`] after too many gradients that were not finite, and those of the tensor library.
    pub fn step(&mut self, loss: &Tensor, share_done: f64) -> Result<bool, TrainingError> {
        self.optimizer.zero_grad();
        loss.f_backward()?;
        let taken = self.optimizer.step(self.learning_rate(share_done))?;
        self.skipped = if taken { 0 } else { self.skipped + 1 };
        if self.skipped >= MAX_SKIPPED {
            return Err(TrainingError::Diverged(self.skipped));
        }
        // A skipped step counts, too: length and learning rate go on.
        self.progress.step += 1;
        Ok(taken)
    }

    /// Writes a checkpoint of all variables with the state that is needed to resume.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be written.
    pub fn checkpoint(&mut self) -> Result<(), FileError> {
        self.progress.seconds = self.seconds();
        let path = self.run.out.join(CHECKPOINT_FILE);
        checkpoint::save(&path, &self.variables, &self.optimizer, &self.progress)
    }

    /// Ends the training if that was requested; writes a checkpoint before. To be called after each step.
    ///
    /// # Errors
    /// [`TrainingError::Interrupted`], or [`FileError`].
    pub fn check_interruption(&mut self) -> Result<(), TrainingError> {
        if !self.steps.is_interrupted() {
            return Ok(());
        }
        self.checkpoint()?;
        Err(TrainingError::Interrupted(self.steps(), Interrupted))
    }

    /// Writes the weights of a network; their header contains `kind` and `config`.
    ///
    /// # Errors
    /// [`FileError`] when a parameter is not finite or the file cannot be written.
    pub fn save_network(
        &self,
        variables: &VarStore,
        kind: &str,
        config: &impl Serialize,
        data: DataListing,
    ) -> Result<Trained, FileError> {
        let config = serde_json::to_string(config).at(&self.run.out)?;
        let about = [(CONFIG_KEY, config), (KIND_KEY, kind.to_owned())];
        let about = about.map(|(key, text)| (key.to_owned(), text)).into();
        self.save_weights(variables, about, data)
    }

    /// Writes the weights; their header contains `about`, their kind and training.
    ///
    /// # Errors
    /// [`FileError`] when a parameter is not finite or the file cannot be written.
    pub fn save_weights(
        &self,
        variables: &VarStore,
        mut about: BTreeMap<String, String>,
        data: DataListing,
    ) -> Result<Trained, FileError> {
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

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::train::Length;

    #[test]
    fn progress_of_localizers_and_detectors_is_read_and_another_training_rejected() {
        let localizer: CheckpointState =
            serde_json::from_str(r#"{"step":7,"seconds":1.5,"seed":3,"batch":4}"#).unwrap();
        let detector: CheckpointState =
            serde_json::from_str(r#"{"step":7,"seconds":1.5,"seed":3,"batch":4,"method":"max"}"#)
                .unwrap();
        assert!(
            localizer
                .check(&CheckpointState {
                    step: 0,
                    seconds: 0.0,
                    ..localizer.clone()
                })
                .is_ok()
        );
        for (requested, expected) in [
            (
                CheckpointState {
                    seed: 4,
                    ..detector.clone()
                },
                "seed 3, not 4",
            ),
            (
                CheckpointState {
                    batch: 8,
                    ..detector.clone()
                },
                "batch 4, not 8",
            ),
            (
                CheckpointState {
                    method: Some("attention".into()),
                    ..detector.clone()
                },
                "method max, not attention",
            ),
        ] {
            let message = detector.check(&requested).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_checkpoint_is_not_resumed_on_other_data() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunConfig::new(Length::Steps(1), folder.path());
        let variables = VarStore::new(Device::Cpu);
        let _ = variables.root().ones("a", &[3]);
        let begin = |run: &RunConfig| Trainer::begin(run, &variables, None, Instant::now());
        // A checkpoint of before, without data, goes on with any.
        begin(&run).unwrap().checkpoint().unwrap();
        let run = RunConfig {
            resume: true,
            ..run
        };
        let mut trainer = begin(&run).unwrap().on_data("12ab").unwrap();
        trainer.checkpoint().unwrap();
        begin(&run).unwrap().on_data("12ab").unwrap();
        let refused = begin(&run).unwrap().on_data("34cd").unwrap_err();
        let message = refused.to_string();
        assert!(
            message.contains("data of SHA-256 12ab, not 34cd"),
            "{message}"
        );
    }
}
