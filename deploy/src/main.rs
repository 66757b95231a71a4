//! Command line of `deploy`.

fn main() {}
