//! Command line of `ego-fuser`.

fn main() {}
