//! How many compiled products libtorch keeps.

use std::env;
use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::Context;

/// Where libtorch and the library it computes with in bfloat16 look up how many they keep; both keep 1024 where this is not set.
const CAPACITIES: [&str; 2] = ["LRU_CACHE_CAPACITY", "ONEDNN_PRIMITIVE_CACHE_CAPACITY"];
/// Enough where no shape comes again; a head's steps, of equal shapes all, take no longer with it either.
const FEW: &str = "16";

/// Goes on as the same process with few compiled products, unless somebody has said how many.
///
/// A product is compiled for every shape of its matrices and kept, megabytes each. No two batches of sparse sweeps have the
/// same shape: a training would grow by gigabytes of what it never meets again. Only the environment of a starting process
/// is asked for the number.
pub(crate) fn keep_few() -> anyhow::Result<()> {
    if CAPACITIES.iter().any(|name| env::var_os(name).is_some()) {
        return Ok(());
    }
    let program = env::current_exe().context("the program's own file")?;
    let mut again = Command::new(&program);
    // Model cards tell the command as it was given.
    env::args_os().next().map(|name| again.arg0(name));
    let error = again.args(env::args_os().skip(1)).envs(CAPACITIES.map(|name| (name, FEW))).exec();
    Err(error).with_context(|| program.display().to_string())
}
