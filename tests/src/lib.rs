//! What the end-to-end and golden tests share.

pub mod fixtures;
