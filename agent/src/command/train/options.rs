//! Options that all trainings share.

use std::path::{Path, PathBuf};
use std::time::Duration;

use agent::training::{ComputePrecision, Length};
use anyhow::Context;
use clap::ValueEnum;
use tch::{Cuda, Device};

use crate::cli::BadInput;

/// How long, where, and in which numbers.
#[derive(Debug, clap::Args)]
pub(crate) struct Options {
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
    pub(crate) seed: u64,
    /// Where to compute.
    #[arg(long, value_enum, default_value_t = DeviceName::Cpu)]
    device: DeviceName,
    /// Threads of the network on the CPU.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Threads that prepare batches.
    #[arg(long, default_value_t = 1)]
    pub(crate) loader_threads: usize,
    /// Numbers that products are computed in.
    #[arg(long, value_enum, default_value_t = PrecisionName::F32)]
    precision: PrecisionName,
    /// Folder of the results.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Go on from the checkpoint in --out.
    #[arg(long)]
    pub(crate) resume: bool,
    /// Print the summary as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DeviceName {
    /// The processor.
    Cpu,
    /// The first CUDA device.
    Cuda,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum PrecisionName {
    /// Single precision.
    F32,
    /// bfloat16: several times faster where the processor has it.
    Bf16,
}

impl Options {
    /// The length; sets the number of threads on the way.
    pub(crate) fn start(&self) -> anyhow::Result<(Length, Device)> {
        tch::set_num_threads(i32::from(self.threads));
        Ok((self.length()?, self.device()?))
    }

    pub(crate) fn precision(&self) -> ComputePrecision {
        match self.precision {
            PrecisionName::F32 => ComputePrecision::F32,
            PrecisionName::Bf16 => ComputePrecision::Bf16,
        }
    }

    fn length(&self) -> anyhow::Result<Length> {
        match (self.steps, self.epochs, self.minutes) {
            (Some(steps), _, _) if steps > 0 => Ok(Length::Steps(steps)),
            (_, Some(epochs), _) if epochs > 0.0 => Ok(Length::Epochs(epochs)),
            (_, _, Some(minutes)) if minutes > 0.0 => Ok(Length::Time(Duration::from_secs_f64(60.0 * minutes))),
            _ => Err(bad("one of --steps, --epochs and --minutes is needed, above zero")),
        }
    }

    fn device(&self) -> anyhow::Result<Device> {
        match self.device {
            DeviceName::Cpu => Ok(Device::Cpu),
            DeviceName::Cuda if Cuda::is_available() => Ok(Device::Cuda(0)),
            DeviceName::Cuda => Err(bad("no CUDA device, or a libtorch without CUDA")),
        }
    }
}

/// An error for which the exit code is 2.
pub(crate) fn bad(reason: &str) -> anyhow::Error {
    BadInput(anyhow::anyhow!(reason.to_owned())).into()
}

/// Refuses folders that are not there before anything is computed.
pub(crate) fn check_folders<'a>(folders: impl IntoIterator<Item = &'a PathBuf>) -> anyhow::Result<()> {
    for folder in folders {
        std::fs::read_dir(folder).with_context(|| folder.display().to_string()).map_err(BadInput)?;
    }
    Ok(())
}

/// Writes a model card beside weights.
pub(crate) fn write_card(out: &Path, card: &str) -> anyhow::Result<()> {
    let path = out.join("model-card.md");
    std::fs::write(&path, card).with_context(|| path.display().to_string())
}

/// The command as the user gave it.
pub(crate) fn command_line() -> String {
    std::env::args().collect::<Vec<_>>().join(" ")
}
