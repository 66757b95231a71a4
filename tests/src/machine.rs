//! What benches report beside their numbers.

use std::fs;
use std::io;
use std::process::Command;

/// The commit that is measured, and the cores and their name.
#[must_use]
pub fn describe() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let names: Vec<&str> =
        text.lines().filter_map(|line| line.strip_prefix("model name")?.split(": ").nth(1)).collect();
    let output = Command::new("git").args(["describe", "--always", "--dirty", "--exclude=*"]).output();
    let commit = output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned()).unwrap_or_default();
    format!("commit {commit}, {} cores of {}", names.len(), names.first().unwrap_or(&"an unknown processor"))
}

/// What all threads of a process have computed so far, milliseconds; in steps of ten.
///
/// # Errors
/// When there is no such process.
pub fn cpu_ms(pid: u32) -> io::Result<f64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // The name in the second field may hold blanks; behind it, user and system time are the 12th and 13th.
    let rest = stat.rsplit(')').next().unwrap_or_default();
    let ticks: u64 = rest.split_whitespace().skip(11).take(2).filter_map(|field| field.parse::<u64>().ok()).sum();
    // Linux counts at 100 Hz for everyone outside the kernel.
    Ok(ticks as f64 * 10.0)
}
