//! Command line of `sim-replay`.

fn main() {}
