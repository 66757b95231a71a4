//! Encode and decode, by size and codec.

fn main() {}
