//! Settings that a process can only be started with, as its environment.

use std::env;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// A variable of the environment and its value.
pub type Setting = (&'static str, &'static str);

/// Memory that was given back is kept by the process for what comes next. Maps are megabytes each and come and go with every
/// frame: fetched anew from the system, page by page, they cost as much time as what is computed on them. Two heaps are
/// enough for few busy threads; with one for each, a process went on growing by a page here and there for hours.
pub const KEPT_MEMORY: [Setting; 4] = [
    ("MALLOC_MMAP_MAX_", "0"),
    ("MALLOC_TRIM_THRESHOLD_", "17179869184"),
    ("MALLOC_TOP_PAD_", "67108864"),
    ("MALLOC_ARENA_MAX", "2"),
];

/// Few compiled products. libtorch and the library it computes with in bfloat16 compile one for every shape of its
/// matrices and keep 1024 of them, megabytes each. No two batches of sparse sweeps have the same shape: a training would
/// grow by gigabytes of what it never meets again. A head's steps, of equal shapes all, take no longer with it either.
pub const FEW_PRODUCTS: [Setting; 2] = [("LRU_CACHE_CAPACITY", "16"), ("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16")];

/// Goes on as the same process with these settings, unless somebody has made them already. To be called first of all.
///
/// # Errors
/// What the system says when the program cannot be started again.
pub fn ensure(settings: &[Setting]) -> io::Result<()> {
    let missing: Vec<Setting> = missing(settings, |name| env::var_os(name).is_some());
    if missing.is_empty() {
        return Ok(());
    }
    let mut again = Command::new(env::current_exe()?);
    // Model cards tell the command as it was given.
    env::args_os().next().map(|name| again.arg0(name));
    Err(again.args(env::args_os().skip(1)).envs(missing).exec())
}

fn missing(settings: &[Setting], is_set: impl Fn(&str) -> bool) -> Vec<Setting> {
    settings.iter().filter(|(name, _)| !is_set(name)).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_somebody_has_set_stays() {
        let settings = [("A", "1"), ("B", "2")];
        assert_eq!(missing(&settings, |name| name == "A"), [("B", "2")]);
        assert!(missing(&settings, |_| true).is_empty());
    }
}
