//! Command line of `agent`.

use std::process::ExitCode;

fn main() -> ExitCode {
    agent::command_line::main()
}
