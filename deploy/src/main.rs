//! Command line of `v2vloc`.

use std::process::ExitCode;

fn main() -> ExitCode {
    deploy::command_line::main()
}
