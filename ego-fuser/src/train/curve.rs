//! The course of a training as CSV: one row per report, with AP where a validation was made.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::validation::Accuracy;
use super::{StepReport, TrainError};

const HEADER: &str =
    "step,epoch,seconds,learning_rate,loss,score_loss,box_loss,samples_per_second,waiting,ap_30,ap_50,ap_70";

/// Appends rows to the curve; every row is on disk when the call returns.
#[derive(Debug)]
pub(super) struct Curve {
    path: PathBuf,
    file: File,
}

impl Curve {
    pub(super) fn open(path: &Path, resume: bool) -> Result<Self, TrainError> {
        let io = |source| TrainError::Io { path: path.to_owned(), source };
        let is_new = !(resume && path.exists());
        let file =
            OpenOptions::new().create(true).write(true).append(!is_new).truncate(is_new).open(path).map_err(io)?;
        let mut curve = Self { path: path.to_owned(), file };
        if is_new {
            curve.row(HEADER)?;
        }
        Ok(curve)
    }

    pub(super) fn step(&mut self, report: &StepReport) -> Result<(), TrainError> {
        let StepReport {
            step, epoch, seconds, learning_rate, score_loss, box_loss, samples_per_second, waiting, ..
        } = *report;
        let loss = score_loss + box_loss;
        self.row(&format!(
            "{step},{epoch:.3},{seconds:.1},{learning_rate:.3e},{loss:.5},{score_loss:.5},{box_loss:.5},{samples_per_second:.2},{waiting:.3},,,"
        ))
    }

    pub(super) fn validation(&mut self, step: u64, seconds: f64, accuracy: &Accuracy) -> Result<(), TrainError> {
        let [ap_30, ap_50, ap_70] = accuracy.ap_global;
        self.row(&format!("{step},,{seconds:.1},,,,,,,{ap_30:.4},{ap_50:.4},{ap_70:.4}"))
    }

    fn row(&mut self, row: &str) -> Result<(), TrainError> {
        writeln!(self.file, "{row}").map_err(|source| TrainError::Io { path: self.path.clone(), source })
    }
}
