//! Resource usage of this process: CPU time by the system's clock, memory by `/proc`.

use std::fs;

use protocol::ProcessUsage;
use rustix::time::{ClockId, clock_gettime};

/// CPU time and memory of this process so far; 0 where the system does not tell.
pub fn process_usage() -> ProcessUsage {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    ProcessUsage {
        cpu_s: process_cpu_s(),
        resident_bytes: memory_bytes(&status, "VmRSS:").unwrap_or(0),
        peak_resident_bytes: memory_bytes(&status, "VmHWM:").unwrap_or(0),
    }
}

/// User and system time of all threads of this process so far, seconds.
pub fn process_cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
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
