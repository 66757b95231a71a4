//! Command-line options that all trainings share.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use support::output;
use tch::Device;

use super::checkpoint::CHECKPOINT_FILE;
use super::interruption::Interruption;
use super::run_config::{Length, RunConfig};
use super::trainer::Trained;
use crate::compute_device::{ComputeDevice, NoCuda};
use crate::compute_precision::ComputePrecision;

/// Options that are invalid for any training.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OptionsError {
    /// No length, or zero.
    #[error("one of --steps, --epochs and --minutes is needed, above zero")]
    Length,
    /// Batches without samples.
    #[error("--batch must be above zero")]
    Batch,
    /// The folder of the results already holds a training.
    #[error("{}: it already holds a training; --resume continues it, --force overwrites it", .0.display())]
    Trained(PathBuf),
    /// The folder of the results holds no checkpoint.
    #[error("--resume: {} is missing: a training writes it now and then, and at Ctrl-C after its first step", .0.display())]
    NoCheckpoint(PathBuf),
    /// There is no CUDA device.
    #[error("--device cuda: {0}")]
    NoCuda(#[from] NoCuda),
    /// The signal handlers cannot be installed.
    #[error("cannot catch Ctrl-C: {0}")]
    Signals(String),
}

/// Options of length, device, precision and results.
#[derive(Debug, clap::Args)]
pub struct TrainingOptions {
    /// Length in steps.
    #[arg(long, group = "length")]
    steps: Option<u64>,
    /// Length in passes over the data.
    #[arg(long, group = "length")]
    epochs: Option<f64>,
    /// Length in minutes; the learning rate follows the clock, so the result is not bit-reproducible.
    #[arg(long, group = "length")]
    minutes: Option<f64>,
    /// Seed of parameters, order and augmentation.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Device to compute on.
    #[arg(long, value_enum, default_value_t)]
    device: ComputeDevice,
    /// Threads of the network on the CPU.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Threads that prepare batches.
    #[arg(long, default_value_t = 1)]
    loader_threads: usize,
    /// Number format of products; on a CPU without native bfloat16, bf16 is f32.
    #[arg(long, value_enum, default_value_t = ComputePrecision::F32)]
    precision: ComputePrecision,
    /// Folder of the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Resume from the checkpoint in --out.
    #[arg(long)]
    resume: bool,
    /// Restart if --out already holds a training; its files are overwritten.
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

impl TrainingOptions {
    /// The configuration of a training; also sets the tensor library's number of threads, and makes Ctrl-C end the
    /// training with a checkpoint. Prints a line to standard error if the CPU does not support the requested precision.
    ///
    /// # Errors
    /// [`OptionsError`] names the option that is invalid.
    pub fn run_config(&self, batch: usize, learning_rate: f64) -> Result<RunConfig, OptionsError> {
        if batch == 0 {
            return Err(OptionsError::Batch);
        }
        check_out(&self.out, self.resume, self.force)?;
        tch::set_num_threads(i32::from(self.threads));
        let device = self.device.open()?;
        Ok(RunConfig {
            batch,
            learning_rate,
            seed: self.seed,
            device,
            precision: self.precision_on(device, has_bfloat16()),
            loader_threads: self.loader_threads,
            resume: self.resume,
            interruption: Interruption::by_signals()
                .map_err(|error| OptionsError::Signals(error.to_string()))?,
            command: std::env::args().collect::<Vec<_>>().join(" "),
            ..RunConfig::new(self.length()?, &self.out)
        })
    }

    /// Prints the result of a training; `more` is an object of further JSON fields beside steps, time and weights.
    ///
    /// # Errors
    /// As [`output::line`].
    pub fn print(&self, trained: &Trained, more: &serde_json::Value) -> io::Result<()> {
        let (steps, seconds, weights) = (trained.steps, trained.seconds, &trained.weights);
        if self.json {
            let mut report = serde_json::json!({"steps": steps, "seconds": seconds, "weights": weights, "sha256": trained.sha256});
            if let (Some(report), Some(more)) = (report.as_object_mut(), more.as_object()) {
                report.extend(more.clone());
            }
            return output::line(report);
        }
        let weights = weights.display();
        output::line(format_args!("{steps} steps in {seconds:.0} s: {weights}"))
    }

    /// The number format of a device: bfloat16 without support in the CPU would take many times longer.
    fn precision_on(&self, device: Device, has_bfloat16: bool) -> ComputePrecision {
        if self.precision == ComputePrecision::Bf16 && device == Device::Cpu && !has_bfloat16 {
            output::note(
                "--precision bf16: this CPU has no native bfloat16, so f32 is used, which is faster here",
            );
            return ComputePrecision::F32;
        }
        self.precision
    }

    fn length(&self) -> Result<Length, OptionsError> {
        let seconds = self.minutes.map(|minutes| 60.0 * minutes);
        // The conversion refuses NaN, infinity and negative numbers.
        let time = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
        match (self.steps, self.epochs, time) {
            (Some(steps), _, _) if steps > 0 => Ok(Length::Steps(steps)),
            (_, Some(epochs), _) if epochs > 0.0 => Ok(Length::Epochs(epochs)),
            (_, _, Some(time)) if !time.is_zero() => Ok(Length::Time(time)),
            _ => Err(OptionsError::Length),
        }
    }
}

/// Rejects a folder of results with a training that is neither resumed nor overwritten, and one with nothing to resume.
///
/// # Errors
/// [`OptionsError::Trained`] and [`OptionsError::NoCheckpoint`].
pub fn check_out(out: &Path, resume: bool, force: bool) -> Result<(), OptionsError> {
    let [weights, checkpoint] = ["weights.safetensors", CHECKPOINT_FILE].map(|name| out.join(name));
    if resume && !checkpoint.exists() {
        return Err(OptionsError::NoCheckpoint(checkpoint));
    }
    match [weights, checkpoint].into_iter().find(|file| file.exists()) {
        Some(file) if !resume && !force => Err(OptionsError::Trained(file)),
        _ => Ok(()),
    }
}

impl ComputePrecision {
    /// The fastest number format of a device.
    pub fn fastest_on(device: Device) -> Self {
        match device != Device::Cpu || has_bfloat16() {
            true => Self::Bf16,
            false => Self::F32,
        }
    }
}

/// True if the CPU multiplies in bfloat16 natively (AVX512-BF16, which every CPU with AMX has too).
fn has_bfloat16() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx512bf16");
    #[cfg(target_arch = "aarch64")]
    return std::arch::is_aarch64_feature_detected!("bf16");
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    false
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
        let run = run_config("train --minutes 1.5 --out runs/x", 4).unwrap();
        assert_eq!(run.length, Length::Time(Duration::from_secs(90)));
        assert_eq!(
            (run.precision, run.batch, run.seed, run.resume),
            (ComputePrecision::F32, 4, 0, false)
        );
        for length in [
            "",
            "--steps 0",
            "--epochs=-1",
            "--minutes=-1",
            "--minutes 1e30",
            "--minutes nan",
        ] {
            let line = format!("train --out x {length}");
            assert_eq!(
                run_config(&line, 4).unwrap_err(),
                OptionsError::Length,
                "{line}"
            );
        }
        assert_eq!(
            run_config("train --out x --steps 3", 0).unwrap_err(),
            OptionsError::Batch
        );
        assert!(
            Line::try_parse_from(["train", "--out", "x", "--steps", "3", "--minutes", "3"])
                .is_err()
        );
    }

    fn run_config_in(out: &Path, more: &str) -> Result<RunConfig, OptionsError> {
        let line = format!("train --steps 3 --out {} {more}", out.display());
        run_config(&line, 4)
    }

    #[test]
    fn a_training_is_overwritten_only_on_request() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        assert!(run_config_in(out, "").is_ok());
        let checkpoint = out.join("checkpoint.safetensors");
        assert_eq!(
            run_config_in(out, "--resume").unwrap_err(),
            OptionsError::NoCheckpoint(checkpoint)
        );
        for name in ["checkpoint.safetensors", "weights.safetensors"] {
            let file = out.join(name);
            std::fs::write(&file, b"").unwrap();
            let error = run_config_in(out, "").unwrap_err();
            assert_eq!(error, OptionsError::Trained(file), "{name}");
        }
        let message = run_config_in(out, "").unwrap_err().to_string();
        assert!(
            message.contains("weights.safetensors")
                && message.contains("--resume")
                && message.contains("--force")
        );
        assert!(run_config_in(out, "--resume").unwrap().resume);
        assert!(!run_config_in(out, "--force").unwrap().resume);
        assert!(
            Line::try_parse_from(["train", "--steps", "3", "--out", "x", "--resume", "--force"])
                .is_err()
        );
    }

    #[test]
    fn bfloat16_is_used_where_the_device_has_it() {
        for (name, device, has_bfloat16, expected) in [
            ("bf16", Device::Cpu, true, ComputePrecision::Bf16),
            ("bf16", Device::Cpu, false, ComputePrecision::F32),
            ("bf16", Device::Cuda(0), false, ComputePrecision::Bf16),
            ("f32", Device::Cpu, true, ComputePrecision::F32),
        ] {
            let line =
                Line::try_parse_from(["train", "--out", "x", "--steps", "3", "--precision", name])
                    .unwrap();
            assert_eq!(line.options.precision_on(device, has_bfloat16), expected);
        }
    }
}
