//! Command line of `ego-fuser`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ego_fuser::command_line::main()
}
