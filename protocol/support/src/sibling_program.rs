//! Sibling programs: a subcommand that another program of the same folder executes.
//!
//! A vehicle carries the program of its process only. Training and evaluation are in a program of their own, with the
//! readers of data sets, and are called by the same name, as Git and Cargo do it.

use std::env;
use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

use crate::output::{Verbosity, verbosity};

/// Arguments of a subcommand that a sibling program executes, `--help` included.
#[derive(Debug, clap::Args)]
#[command(disable_help_flag = true)]
pub struct Forwarded {
    /// Arguments as they were given.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    arguments: Vec<OsString>,
}

impl Forwarded {
    /// Replaces this process by `program`, from the same folder or else from `PATH`. Returns only on failure.
    #[must_use]
    pub fn exec(&self, program: &str, subcommand: &str) -> io::Error {
        let beside = env::current_exe().ok().map(|own| own.with_file_name(program)).filter(|path| path.exists());
        let path = beside.unwrap_or_else(|| program.into());
        let verbosity: &[&str] = match verbosity() {
            Verbosity::Quiet => &["--quiet"],
            Verbosity::Usual => &[],
            Verbosity::Debug => &["-v"],
            Verbosity::Trace => &["-vv"],
        };
        let error = Command::new(&path).args(verbosity).arg(subcommand).args(&self.arguments).exec();
        io::Error::new(error.kind(), format!("{subcommand} is part of the program {}: {error}", path.display()))
    }
}
