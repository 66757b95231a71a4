//! One file per sub-command: its arguments and its `run`.

pub(crate) mod eval;
pub(crate) mod localize;
pub(crate) mod run;
mod town_heads;
pub(crate) mod train;
