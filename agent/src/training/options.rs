//! The part of the command line that all trainings share.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use clap::ValueEnum;
use sim_replay::output;
use tch::{Cuda, Device};

use super::run_config::{ComputePrecision, Length, RunConfig};
use super::trainer::Trained;

/// Options that no training can run with.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OptionsError {
    /// No length, or none at all.
    #[error("one of --steps, --epochs and --minutes is needed, above zero")]
    Length,
    /// Steps without samples.
    #[error("--batch is above zero")]
    Batch,
    /// There is no such device.
    #[error("no CUDA device, or a libtorch without CUDA")]
    NoCuda,
}

/// How long, where, and in which numbers.
#[derive(Debug, clap::Args)]
pub struct TrainingOptions {
    /// Length in steps.
    #[arg(long, group = "length")]
    steps: Option<u64>,
    /// Length in passes over the data.
    #[arg(long, group = "length")]
    epochs: Option<f64>,
    /// Length in minutes; the learning rate follows the clock, so the result is not repeatable to the bit.
    #[arg(long, group = "length")]
    minutes: Option<f64>,
    /// Seed of parameters, order and augmentation.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where to compute.
    #[arg(long, value_enum, default_value_t = DeviceName::Cpu)]
    device: DeviceName,
    /// Threads of the network on the CPU.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Threads that prepare batches.
    #[arg(long, default_value_t = 1)]
    loader_threads: usize,
    /// Numbers that products are computed in.
    #[arg(long, value_enum, default_value_t = ComputePrecision::F32)]
    precision: ComputePrecision,
    /// Folder of the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Go on from the checkpoint in --out.
    #[arg(long)]
    resume: bool,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DeviceName {
    /// The processor.
    Cpu,
    /// The first CUDA device.
    Cuda,
}

impl TrainingOptions {
    /// What a training is told; sets the tensor library's number of threads on the way.
    ///
    /// # Errors
    /// [`OptionsError`] says which option is at fault.
    pub fn run_config(&self, batch: usize, learning_rate: f64) -> Result<RunConfig, OptionsError> {
        if batch == 0 {
            return Err(OptionsError::Batch);
        }
        tch::set_num_threads(i32::from(self.threads));
        Ok(RunConfig {
            batch,
            learning_rate,
            seed: self.seed,
            device: self.device()?,
            precision: self.precision,
            loader_threads: self.loader_threads,
            resume: self.resume,
            command: std::env::args().collect::<Vec<_>>().join(" "),
            ..RunConfig::new(self.length()?, &self.out)
        })
    }

    /// Prints how a training ended; `more` is an object of what JSON has beside steps, time and weights.
    ///
    /// # Errors
    /// As [`output::line`].
    pub fn print(&self, trained: &Trained, more: &serde_json::Value) -> io::Result<()> {
        let Trained { steps, seconds, weights, sha256, .. } = trained;
        if self.json {
            let mut report =
                serde_json::json!({"steps": steps, "seconds": seconds, "weights": weights, "sha256": sha256});
            if let (Some(report), Some(more)) = (report.as_object_mut(), more.as_object()) {
                report.extend(more.clone());
            }
            output::line(report)
        } else {
            output::line(format_args!("{steps} steps in {seconds:.0} s: {}", weights.display()))
        }
    }

    fn length(&self) -> Result<Length, OptionsError> {
        match (self.steps, self.epochs, self.minutes) {
            (Some(steps), _, _) if steps > 0 => Ok(Length::Steps(steps)),
            (_, Some(epochs), _) if epochs > 0.0 => Ok(Length::Epochs(epochs)),
            (_, _, Some(minutes)) => match Duration::try_from_secs_f64(60.0 * minutes) {
                Ok(time) if !time.is_zero() => Ok(Length::Time(time)),
                _ => Err(OptionsError::Length),
            },
            _ => Err(OptionsError::Length),
        }
    }

    fn device(&self) -> Result<Device, OptionsError> {
        match self.device {
            DeviceName::Cpu => Ok(Device::Cpu),
            DeviceName::Cuda => cuda_device(),
        }
    }
}

/// The first CUDA device; without this question the tensor library panics where there is none.
///
/// # Errors
/// [`OptionsError::NoCuda`] when there is none, or the tensor library is one without CUDA.
pub fn cuda_device() -> Result<Device, OptionsError> {
    if Cuda::is_available() { Ok(Device::Cuda(0)) } else { Err(OptionsError::NoCuda) }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        options: TrainingOptions,
    }

    fn run_config(arguments: &str, batch: usize) -> Result<RunConfig, OptionsError> {
        let line = Line::try_parse_from(arguments.split_whitespace()).unwrap();
        line.options.run_config(batch, 1e-3)
    }

    #[test]
    fn a_length_above_zero_is_needed() {
        let run = run_config("train --minutes 1.5 --precision bf16 --out runs/x", 4).unwrap();
        assert_eq!(run.length, Length::Time(Duration::from_secs(90)));
        assert_eq!((run.precision, run.batch, run.seed, run.resume), (ComputePrecision::Bf16, 4, 0, false));
        for length in ["", "--steps 0", "--epochs=-1", "--minutes=-1", "--minutes 1e30", "--minutes nan"] {
            let line = format!("train --out x {length}");
            assert_eq!(run_config(&line, 4).unwrap_err(), OptionsError::Length, "{line}");
        }
        assert_eq!(run_config("train --out x --steps 3", 0).unwrap_err(), OptionsError::Batch);
        assert!(Line::try_parse_from(["train", "--out", "x", "--steps", "3", "--minutes", "3"]).is_err());
    }
}
