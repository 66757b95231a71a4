//! Settings of the allocator, of libtorch and of zenoh that are environment variables and have to be set before a process starts.

use std::env;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Environment variable and its value.
pub type Setting = (&'static str, &'static str);

/// Keeps freed memory in the process. Feature maps have megabytes each and are allocated and freed with every frame:
/// fetching their pages from the system costs as much time as the computation on them. Two arenas are enough for few
/// busy threads; with one arena per thread, a process kept growing slowly for hours.
pub const KEPT_MEMORY: [Setting; 4] = [
    ("MALLOC_MMAP_MAX_", "0"),
    ("MALLOC_TRIM_THRESHOLD_", "17179869184"),
    ("MALLOC_TOP_PAD_", "67108864"),
    ("MALLOC_ARENA_MAX", "2"),
];

/// Limits the caches of compiled matrix products. libtorch and its bfloat16 library compile one for every shape of
/// matrices and keep 1024 of them, megabytes each. No two batches of sparse sweeps have the same shape: a training
/// would grow by gigabytes of products that are never used again. The steps of a head, which all have the same shape,
/// are not slower with it.
pub const FEW_PRODUCTS: [Setting; 2] = [
    ("LRU_CACHE_CAPACITY", "16"),
    ("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16"),
];

/// Threads of a router. zenoh's two threads for incoming messages are not enough: one that closes the connection of a
/// receiver that took nothing waits up to 10 s in the system (`SO_LINGER` on a socket with unsent data), and with two
/// such receivers nobody's messages would move.
pub const ROUTER_THREADS: Setting = (
    "ZENOH_RUNTIME",
    "(rx: (worker_threads: 16), tx: (worker_threads: 4), net: (worker_threads: 4), acc: (worker_threads: 4))",
);

/// Executes the process again with these settings, unless they are set already. To be called first of all.
///
/// # Errors
/// The error of the system when the program cannot be executed again.
pub fn ensure(settings: &[Setting]) -> io::Result<()> {
    let missing: Vec<Setting> = missing(settings, |name| env::var_os(name).is_some());
    // Also ends the second start: without it the process would replace itself for ever.
    if missing.is_empty() {
        return Ok(());
    }
    let mut again = Command::new(env::current_exe()?);
    // Model cards state the command as it was given.
    env::args_os().next().map(|name| again.arg0(name));
    Err(again.args(env::args_os().skip(1)).envs(missing).exec())
}

fn missing(settings: &[Setting], is_set: impl Fn(&str) -> bool) -> Vec<Setting> {
    let unset = settings.iter().filter(|(name, _)| !is_set(name));
    unset.copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_that_are_set_are_kept() {
        let settings = [("A", "1"), ("B", "2")];
        assert_eq!(missing(&settings, |name| name == "A"), [("B", "2")]);
        assert!(missing(&settings, |_| true).is_empty());
    }

    #[test]
    fn tests_have_the_threads_of_a_router() {
        let (name, threads) = ROUTER_THREADS;
        assert_eq!(env::var(name).as_deref(), Ok(threads));
    }
}
