//! Command lines of a fleet's processes.

use std::ffi::{OsStr, OsString};
use std::path::Path;

use agent::rate::RateConfig;
use protocol::{Dtype, RunId, Smoothing};

use crate::operate::run_folder::RunFolder;
use crate::operate::security::RunKeys;
use crate::operate::supervise::{Life, ProcessSpec};
use crate::scenario::NoiseMode;

/// Where the processes of a run meet, where their programs lie, and where they write.
#[derive(Debug, Clone, Copy)]
pub struct Meeting<'a> {
    /// The run that they join.
    pub run: &'a RunId,
    /// Of the router.
    pub endpoint: &'a str,
    /// Where the processes find their keys, where they have some.
    pub keys: Option<&'a RunKeys>,
    /// Folder of the programs.
    pub programs: &'a Path,
    /// Folder of the run.
    pub folder: &'a RunFolder,
}

impl Meeting<'_> {
    pub(super) fn process(&self, name: String, program: &str, mut args: Arguments, life: Life) -> ProcessSpec {
        if let Some(keys) = self.keys {
            args.option("--keys", &keys.of_process(&name));
        }
        ProcessSpec { name, program: self.programs.join(program), args: args.0, life }
    }
}

/// The command line of a process.
pub(super) struct Arguments(pub(super) Vec<OsString>);

impl Arguments {
    /// What every process of a fleet is told.
    pub(super) fn of(command: &str, meeting: &Meeting<'_>) -> Self {
        let mut args = Self(vec![command.into()]);
        args.option("--connect", meeting.endpoint);
        args.option("--run", meeting.run.as_str());
        args.flag("--supervised");
        args
    }

    /// One argument, so that a value that begins with `-` (a roadside unit's id) is not taken for a flag.
    pub(super) fn option<V: AsRef<OsStr> + ?Sized>(&mut self, name: &str, value: &V) {
        let mut argument = OsString::from(name);
        argument.push("=");
        argument.push(value);
        self.0.push(argument);
    }

    pub(super) fn flag(&mut self, name: &str) {
        self.0.push(name.into());
    }
}

pub(super) fn dtype(dtype: Dtype) -> &'static str {
    match dtype {
        Dtype::F32 => "f32",
        Dtype::F16 => "f16",
        Dtype::I8 => "i8",
    }
}

pub(super) fn rate_options(args: &mut Arguments, rate: &RateConfig) {
    let RateConfig { message_bytes, bytes_per_second, watch_queue } = rate;
    if let Some(bytes) = message_bytes {
        args.option("--message-bytes", &bytes.to_string());
    }
    if let Some(bytes) = bytes_per_second {
        args.option("--bytes-per-second", &bytes.to_string());
    }
    if *watch_queue {
        args.flag("--watch-queue");
    }
}

pub(super) fn smoothing(smoothing: Option<Smoothing>) -> String {
    smoothing.map_or_else(|| "none".to_owned(), |Smoothing { kernel, sigma }| format!("{kernel},{sigma}"))
}

pub(super) fn noise_mode(mode: NoiseMode) -> &'static str {
    match mode {
        NoiseMode::Fixed => "fixed",
        NoiseMode::Independent => "independent",
        NoiseMode::Autoregressive => "autoregressive",
    }
}
