//! Batch scheduling: runs helper threads under `SCHED_BATCH` so that waking one does not preempt the waker.

use rustix::process::{getpriority_process, setpriority_process};
use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Sets the batch policy for the calling thread: a woken thread waits for its turn; its share of the processor is
/// unchanged.
///
/// Linux may give the processor of the waking thread to the woken thread at once, if the latter has slept long enough.
/// On a fully loaded machine the clock thread, after handing a feature map to its sending thread, continued 8 to 13 ms
/// later, when the map was written. Threads of the policy `SCHED_BATCH` never preempt.
pub(super) fn use_batch_scheduling() {
    let Ok(niceness) = getpriority_process(None) else {
        return;
    };
    // The call also sets a niceness, which only root may set. In either case the old niceness is restored.
    let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch);
    let _ = set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Max, policy);
    let _ = setpriority_process(None, niceness);
}

#[cfg(test)]
mod tests {
    use thread_priority::thread_schedule_policy;

    use super::*;

    #[test]
    fn the_policy_is_changed_and_the_niceness_is_not() {
        let thread = std::thread::spawn(|| {
            let before = getpriority_process(None).unwrap();
            use_batch_scheduling();
            (
                before,
                getpriority_process(None).unwrap(),
                thread_schedule_policy().unwrap(),
            )
        });
        let (before, after, policy) = thread.join().unwrap();
        assert_eq!(before, after);
        assert_eq!(
            policy,
            ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch)
        );
    }
}
