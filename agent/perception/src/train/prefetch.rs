//! Prefetching: threads that prepare batches ahead of a training.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{self, JoinHandle};

use super::error::TrainingError;

/// Number of batches that one thread may be ahead.
const AHEAD: usize = 3;

/// An endless sequence of batches, each a function of its number alone, so the same for any number of threads.
///
/// Thread k of T prepares batches k, k + T, k + 2T and so on into a queue of its own, and the queues are read in turn:
/// that keeps the order without synchronisation between threads. Dropping this ends them after the batch that they are
/// preparing: none computes while the program exits.
#[derive(Debug)]
pub struct Prefetch<T> {
    queues: Vec<Receiver<T>>,
    threads: Vec<JoinHandle<()>>,
    next: usize,
}

impl<T: Send + 'static> Prefetch<T> {
    /// Starts `threads` threads; `prepare` gets the numbers of batches from `first` on.
    pub fn start(
        threads: usize,
        first: u64,
        prepare: impl FnMut(u64) -> T + Clone + Send + 'static,
    ) -> Self {
        let count = threads.max(1);
        let started = (0..count).map(|thread| {
            let (sender, receiver) = sync_channel(AHEAD);
            let (mut prepare, first) = (prepare.clone(), first + thread as u64);
            let thread = thread::spawn(move || {
                for number in (first..).step_by(count) {
                    // The receiver is dropped when the training has ended.
                    if sender.send(prepare(number)).is_err() {
                        return;
                    }
                }
            });
            (receiver, thread)
        });
        let (queues, threads) = started.unzip();
        Self {
            queues,
            threads,
            next: 0,
        }
    }

    /// The next batch.
    ///
    /// # Errors
    /// [`TrainingError::LoaderGone`] when the thread that should have prepared it has ended.
    pub fn next_batch(&mut self) -> Result<T, TrainingError> {
        let queue = self.next;
        self.next = (queue + 1) % self.queues.len();
        let batch = self.queues[queue].recv();
        batch.map_err(|_| TrainingError::LoaderGone)
    }
}

impl<T> Drop for Prefetch<T> {
    fn drop(&mut self) {
        // A thread ends when nobody takes its batch.
        self.queues.clear();
        for thread in self.threads.drain(..) {
            // A panic has been reported, and `next_batch` has returned an error.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_come_in_order_from_any_number_of_threads() {
        for threads in 1..4 {
            let mut batches = Prefetch::start(threads, 5, |number| number * number);
            let got: Vec<u64> = (0..10).map(|_| batches.next_batch().unwrap()).collect();
            assert_eq!(
                got,
                (5..15).map(|number| number * number).collect::<Vec<u64>>()
            );
        }
    }
}
