//! Subcommands: one file each, with its arguments and its `run`.

pub(crate) mod cover;
pub(crate) mod eval;
pub(crate) mod localize;
pub(crate) mod locate;
pub(crate) mod map;
pub(crate) mod quantise;
mod retrieval;
mod scene_heads;
pub(crate) mod train;
