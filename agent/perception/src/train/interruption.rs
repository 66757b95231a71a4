//! Interruption of a training by Ctrl-C or SIGTERM: ends it after the current step, with a checkpoint.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use support::cli::Interrupted;

/// Request to end a training after its current step. Clones share it.
///
/// Before the first step and after the last there is no step to end and nothing that a checkpoint would keep: a signal
/// ends the process at once, as does a second one. Exit code 130 in any case.
#[derive(Debug, Clone, Default)]
pub struct Interruption {
    /// True if the next signal ends the process: outside of steps, and from the first signal on.
    ends_process: Arc<AtomicBool>,
}

impl Interruption {
    /// The request that Ctrl-C and SIGTERM make. [`Self::default`] is one that nothing makes.
    ///
    /// # Errors
    /// When the signal handlers cannot be installed.
    pub fn by_signals() -> io::Result<Self> {
        let ends_process = Arc::new(AtomicBool::new(true));
        for signal in [SIGINT, SIGTERM] {
            // In this order: the first signal is the one after which the flag is set.
            let (status, ends) = (Interrupted::EXIT_CODE.into(), Arc::clone(&ends_process));
            flag::register_conditional_shutdown(signal, status, ends)?;
            flag::register(signal, Arc::clone(&ends_process))?;
        }
        Ok(Self { ends_process })
    }

    /// Begins the steps; they end with the result.
    pub(super) fn steps(&self) -> Steps {
        self.ends_process.store(false, Ordering::Relaxed);
        Steps(self.clone())
    }
}

/// Steps of a training, during which a signal is a request.
#[derive(Debug)]
pub(super) struct Steps(Interruption);

impl Steps {
    /// True if the end of the training is requested.
    pub(super) fn is_interrupted(&self) -> bool {
        self.0.ends_process.load(Ordering::Relaxed)
    }
}

impl Drop for Steps {
    fn drop(&mut self) {
        self.0.ends_process.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use signal_hook::low_level::raise;

    use super::*;

    fn ends_process(interruption: &Interruption) -> bool {
        interruption.ends_process.load(Ordering::Relaxed)
    }

    #[test]
    fn a_signal_during_the_steps_is_a_request_and_ends_the_process_otherwise() {
        let interruption = Interruption::by_signals().unwrap();
        assert!(ends_process(&interruption), "before the steps");
        for signal in [SIGINT, SIGTERM] {
            let steps = interruption.steps();
            assert!(!steps.is_interrupted());
            raise(signal).unwrap();
            assert!(steps.is_interrupted());
            assert!(ends_process(&interruption), "a second one");
        }
        drop(interruption.steps());
        assert!(ends_process(&interruption), "after the steps");
    }
}
