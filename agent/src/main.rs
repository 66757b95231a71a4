//! Command line of `agent`.

fn main() {}
