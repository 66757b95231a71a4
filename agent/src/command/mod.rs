//! One file per sub-command: its arguments and its `run`.

pub(crate) mod run;
