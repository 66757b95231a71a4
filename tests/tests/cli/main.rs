//! Command line: messages and exit codes of wrong input, closed outputs, options in service files, poses of single clouds.

mod closed_output;
mod locate;
mod scenario_errors;
mod services;
