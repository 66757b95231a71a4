//! Command line: messages and exit codes of wrong input, closed outputs, options in service files.

mod closed_output;
mod scenario_errors;
mod services;
