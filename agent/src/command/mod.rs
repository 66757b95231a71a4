//! One file per sub-command: its arguments and its `run`.

pub(crate) mod eval;
pub(crate) mod localize;
pub(crate) mod run;
pub(crate) mod train;
