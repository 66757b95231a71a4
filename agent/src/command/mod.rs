//! One file per sub-command: its arguments and its `run`.

pub(crate) mod replay_inputs;
pub(crate) mod run;
