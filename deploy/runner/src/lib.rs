//! Runner of `v2vloc`: runs and experiments that compute networks.
//!
//! - [`scenario`]: the file that describes a run; weights and hashes of its inputs.
//! - [`fleet`]: its vehicles and processes, and the configuration of each.
//! - [`run`]: one run, live or in simulation time, and its metrics.
//! - [`experiment`]: offline evaluation, tables, sweeps and reports.
//! - [`schema`]: JSON schemas of the files.
//!
//! Each uses those before it in this list only. What operates and shows a fleet without networks is in `deploy`, whose
//! program `v2vloc` calls `v2vloc-runner` for the subcommands of this crate.
//!
//! ```
//! use runner::scenario::Scenario;
//!
//! # fn main() -> Result<(), support::file_error::FileError> {
//! let scenario = Scenario::read("../scenarios/demo.yaml".as_ref())?;
//! assert_eq!(scenario.method.name(), "max");
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub(crate) mod cached_poses;
pub(crate) mod evaluated_frame;
pub mod experiment;
pub mod fleet;
pub(crate) mod frame_lines;
pub mod run;
pub mod scenario;
pub mod schema;
