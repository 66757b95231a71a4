//! Resource usage of this process: CPU time by the system's clock, memory by `/proc`.

use std::collections::BTreeMap;
use std::fs;
use std::time::Duration;

use protocol::text::{MAX_MESSAGE_BYTES, printable};
use protocol::{ProcessUsage, ThreadUsage};
use rustix::time::{ClockId, clock_gettime};

/// CPU time and memory of this process so far; 0 where the system does not tell.
pub fn process_usage() -> ProcessUsage {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    ProcessUsage {
        cpu_s: process_cpu_s(),
        resident_bytes: memory_bytes(&status, "VmRSS:").unwrap_or(0),
        peak_resident_bytes: memory_bytes(&status, "VmHWM:").unwrap_or(0),
        threads: threads(),
    }
}

/// User and system time of all threads of this process so far, seconds.
pub fn process_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// CPU time of the running threads by name; none where the kernel keeps no statistics of its scheduler.
fn threads() -> Vec<ThreadUsage> {
    let tasks = fs::read_dir("/proc/self/task").into_iter().flatten();
    let mut by_name = BTreeMap::<String, f64>::new();
    for task in tasks.flatten() {
        let read = |file: &str| fs::read_to_string(task.path().join(file)).ok();
        // A thread may end between the two.
        if let (Some(name), Some(times)) = (read("comm"), read("schedstat"))
            && let Some(nanos) = times.split(' ').next().and_then(|nanos| nanos.parse().ok())
        {
            let name = plain_name(&name);
            *by_name.entry(name).or_default() += Duration::from_nanos(nanos).as_secs_f64();
        }
    }
    let threads = by_name.into_iter();
    threads
        .map(|(name, cpu_s)| ThreadUsage { name, cpu_s })
        .collect()
}

/// Name without a number at its end: `rx-3` is one of several threads.
fn plain_name(name: &str) -> String {
    let name = name
        .trim_end()
        .trim_end_matches(|letter: char| letter.is_ascii_digit());
    printable(name.trim_end_matches('-'), MAX_MESSAGE_BYTES)
}

/// A field of `/proc/PID/status` in kB, in bytes.
fn memory_bytes(status: &str, field: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix(field))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    kib.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_cpu_time_and_memory() {
        let before = process_usage();
        let block = vec![1_u8; 32 << 20];
        let mut sum = 0_u64;
        while process_cpu_s() < before.cpu_s + 0.01 {
            sum = block.iter().fold(sum, |sum, byte| {
                sum.wrapping_mul(31).wrapping_add(u64::from(*byte))
            });
        }
        let after = process_usage();
        assert!(after.cpu_s > before.cpu_s, "{sum}");
        let of_threads: f64 = after.threads.iter().map(|thread| thread.cpu_s).sum();
        // Threads of other tests may have ended.
        assert!((0.01..=process_cpu_s()).contains(&of_threads), "{after:?}");
        assert!(
            after.resident_bytes > 16 << 20 && after.peak_resident_bytes >= 32 << 20,
            "{after:?}"
        );
    }

    #[test]
    fn fields_of_the_system_are_in_kilobytes() {
        let status = "Name:\tagent\nVmHWM:\t    2048 kB\nVmRSS:\t    1024 kB\n";
        assert_eq!(memory_bytes(status, "VmRSS:"), Some(1 << 20));
        assert_eq!(memory_bytes(status, "VmHWM:"), Some(2 << 20));
        assert_eq!(
            (
                memory_bytes(status, "VmSwap:"),
                memory_bytes("VmRSS: much", "VmRSS:")
            ),
            (None, None)
        );
    }
}
