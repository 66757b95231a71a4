//! One file per sub-command: its arguments and its `run`.

pub(crate) mod convert;
pub(crate) mod export;
pub(crate) mod inspect;
pub(crate) mod link;
pub(crate) mod record;
pub(crate) mod recover;
pub(crate) mod stream;
pub(crate) mod synth;
