//! Locks between tests: for resources that the machine or the process has only once.

use std::fs::File;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Holds the machine for one test, across all test programs of this checkout, until the file is dropped: on two cores
/// several fleets would time each other out, and a measurement of memory counts the whole process.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn exclusive_lock() -> File {
    let path = crate::fleet::programs_dir().join("exclusive-test.lock");
    let file = File::create(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    file.lock()
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    file
}

/// Holds libtorch's random number generator, of which a process has one, until dropped. Tensors are computed on one
/// thread.
pub fn random_generator_lock() -> MutexGuard<'static, ()> {
    static GENERATOR: Mutex<()> = Mutex::new(());
    tch::set_num_threads(1);
    GENERATOR.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exclusive_lock_excludes_within_a_process_too() {
        let held = exclusive_lock();
        let path = crate::fleet::programs_dir().join("exclusive-test.lock");
        let other = File::create(path).unwrap();
        assert!(other.try_lock().is_err());
        drop(held);
        other.lock().unwrap();
    }
}
