//! Threads that may be woken without taking the place of who wakes them.

use rustix::process::{getpriority_process, setpriority_process};
use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};

/// Lets the calling thread wait for its turn when it is woken; it computes as much as before.
///
/// Linux gives the processor of whoever wakes a thread to that thread at once, when it has slept long enough. On a machine
/// with nothing to spare a clock that hands a map to its sending thread came back from that 8 to 13 ms later, when the
/// map was written. Threads of the policy `SCHED_BATCH` never do that.
pub(super) fn use_batch_scheduling() {
    let Ok(niceness) = getpriority_process(None) else { return };
    // The call sets a niceness too: one that only root may have. Whether it got it or not, it is put back.
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
            (before, getpriority_process(None).unwrap(), thread_schedule_policy().unwrap())
        });
        let (before, after, policy) = thread.join().unwrap();
        assert_eq!(before, after);
        assert_eq!(policy, ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Batch));
    }
}
