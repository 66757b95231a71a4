//! Command line: messages and exit codes of wrong input, requirements between options, forms of values, closed outputs,
//! sibling programs, options in service files, poses of single clouds, fusion methods from files, shipped experiments,
//! trainings that are stopped and resumed.

mod closed_output;
mod evaluation;
mod experiments;
mod interruption;
mod locate;
mod mistakes;
mod programs;
mod requirements;
mod scenario_errors;
mod services;
