//! Panics of a router's threads: noted by a hook, so that a router that routes nothing any more ends.
//!
//! A thread of zenoh that panics leaves a lock poisoned: the router lives on, refuses newcomers and passes no message.

use std::panic;
use std::sync::{Once, OnceLock};
use std::thread;

use bus::shutdown::Stop;

/// Text of the first panic.
static FIRST: OnceLock<String> = OnceLock::new();

/// Beginnings of the names of zenoh's threads.
const THREADS: [&str; 5] = ["acc-", "app-", "net-", "rx-", "tx-"];

/// Notes the first panic of a thread of the router from now on, and requests `stop` then.
pub(crate) fn watch(stop: &Stop) {
    static ONCE: Once = Once::new();
    let stop = stop.clone();
    ONCE.call_once(|| {
        let usual = panic::take_hook();
        panic::set_hook(Box::new(move |about| {
            if is_of_router(thread::current().name()) {
                // Only the first one has no other as its cause.
                let text = about.payload_as_str().unwrap_or("a panic");
                // Without the place in the code of the library.
                let text = text.split(" at /").next().unwrap_or_default();
                let _ = FIRST.set(text.replace('\n', " "));
                stop.request();
            }
            usual(about);
        }));
    });
}

/// The first panic of a thread of the router, if there was one.
pub(crate) fn first() -> Option<&'static str> {
    FIRST.get().map(String::as_str)
}

fn is_of_router(thread: Option<&str>) -> bool {
    thread.is_some_and(|name| THREADS.iter().any(|begin| name.starts_with(begin)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panic_in_thread(name: &str) {
        let thread = thread::Builder::new().name(name.into());
        assert!(thread.spawn(|| panic!("poisoned")).unwrap().join().is_err());
    }

    #[test]
    fn a_panic_of_a_thread_of_the_router_is_noted_and_one_of_another_is_not() {
        let stop = Stop::new();
        watch(&stop);
        panic_in_thread("scorer");
        assert!(first().is_none() && !stop.requested());
        panic_in_thread("rx-0");
        assert!(first().unwrap().contains("poisoned"), "{:?}", first());
        assert!(stop.requested());
    }
}
