//! Task: one kind of training, whose steps the trainer takes; and its progress.

use std::time::{Duration, Instant};

use tch::Tensor;

use super::data_listing::DataListing;
use super::error::TrainingError;
use super::trainer::Trainer;

/// Event in the course of a training.
#[derive(Debug, Clone, PartialEq)]
pub enum TrainingEvent {
    /// Sweeps are being encoded: number done and number of all.
    Encoding(usize, usize),
    /// The data to learn from or to validate on have been read.
    Read(DataListing),
    /// Something else is done, in words.
    Note(String),
    /// Some steps are done.
    Stepped(StepReport),
    /// A validation is done: its result in words.
    Validated(String),
}

/// Report over some steps.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// Number of steps done.
    pub step: u64,
    /// Share of the training that is done, 0..1.
    pub share_done: f64,
    /// Seconds spent so far, in all runs together.
    pub seconds: f64,
    /// Means since the last report, as the training defines them; the first is its loss or error.
    pub means: Vec<f64>,
    /// Step and means in words.
    pub text: String,
}

/// Receiver of the progress of a training.
pub type Observe<'a> = dyn FnMut(&TrainingEvent) + 'a;

/// Interval between two validations and checkpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SaveEvery {
    /// Number of steps.
    Steps(u64),
    /// Time.
    Time(Duration),
}

/// One kind of training: its network, its loss, and what it reports.
pub trait Task {
    /// Error that ends it early.
    type Error: From<TrainingError>;
    /// Steps between two reports.
    const REPORT_EVERY: u64;

    /// Number of passes over the data after so many steps.
    fn epoch(&self, steps: u64) -> f64;

    /// Share of the training that is done, 0 at the start, 1 or more at the end.
    fn share_done(&self, trainer: &Trainer) -> f64 {
        trainer.share_done(self.epoch(trainer.steps()))
    }

    /// Loss of the next step.
    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor, Self::Error>;

    /// Called after each step; `is_taken` is false if the gradient was not finite.
    fn stepped(&mut self, _trainer: &Trainer, _is_taken: bool) -> Result<(), Self::Error> {
        Ok(())
    }

    /// True if the steps since the last report are to be reported now.
    fn is_report_due(&self, trainer: &Trainer) -> bool {
        trainer.is_report_due(Self::REPORT_EVERY)
    }

    /// Reports the steps since the last report.
    fn report(&mut self, trainer: &Trainer) -> Result<(), Self::Error>;

    /// Validates, before a checkpoint.
    fn validate(&mut self, _trainer: &Trainer) -> Result<(), Self::Error> {
        Ok(())
    }
}

impl Trainer {
    /// Takes all steps of a training; writes checkpoints now and then and at the end.
    ///
    /// # Errors
    /// Those of the task, [`TrainingError::Diverged`] and [`TrainingError::Interrupted`]; the last checkpoint stays.
    pub fn run<T: Task>(&mut self, task: &mut T, save_every: SaveEvery) -> Result<(), T::Error> {
        let (mut saved_step, mut saved_at) = (None, Instant::now());
        while task.share_done(self) < 1.0 {
            let loss = task.loss(self)?;
            let is_taken = self.step(&loss, task.share_done(self))?;
            // Right after the step, before a report or a validation that may take long.
            self.check_interruption()?;
            task.stepped(self, is_taken)?;
            if task.is_report_due(self) {
                task.report(self)?;
            }
            let is_save_due = match save_every {
                SaveEvery::Steps(steps) => self.steps().is_multiple_of(steps),
                SaveEvery::Time(time) => saved_at.elapsed() >= time,
            };
            if is_save_due {
                self.save(task)?;
                (saved_step, saved_at) = (Some(self.steps()), Instant::now());
            }
        }
        match saved_step == Some(self.steps()) {
            true => Ok(()),
            false => self.save(task),
        }
    }

    fn save<T: Task>(&mut self, task: &mut T) -> Result<(), T::Error> {
        task.validate(self)?;
        Ok(self.checkpoint().map_err(TrainingError::from)?)
    }

    /// Report of the steps done, with the means since the last report.
    pub fn step_report(&self, share_done: f64, means: Vec<f64>, text: &str) -> TrainingEvent {
        let step = self.steps();
        TrainingEvent::Stepped(StepReport {
            step,
            share_done: share_done.min(1.0),
            seconds: self.seconds(),
            means,
            text: format!("step {step} {text}"),
        })
    }
}

/// Means of some numbers over the steps since the last report.
#[derive(Debug, Clone, PartialEq)]
pub struct Means<const N: usize> {
    sums: [f64; N],
    steps: u32,
}

impl<const N: usize> Default for Means<N> {
    fn default() -> Self {
        let (sums, steps) = ([0.0; N], 0);
        Self { sums, steps }
    }
}

impl<const N: usize> Means<N> {
    /// Adds the numbers of a step.
    pub fn add(&mut self, values: [f64; N]) {
        for (sum, value) in self.sums.iter_mut().zip(values) {
            *sum += value;
        }
        self.steps += 1;
    }

    /// True before the first step.
    pub fn is_empty(&self) -> bool {
        self.steps == 0
    }

    /// The means; 0 before the first step.
    pub fn get(&self) -> [f64; N] {
        self.sums.map(|sum| sum / f64::from(self.steps.max(1)))
    }

    /// The means, and a new start.
    pub fn take(&mut self) -> [f64; N] {
        std::mem::take(self).get()
    }
}
