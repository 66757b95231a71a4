//! Machine and commit, for the reports of benchmarks.

use std::fs;
use std::io;
use std::process::Command;

/// Commit that is measured, number and name of the cores.
#[must_use]
pub fn describe() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let names: Vec<&str> = text
        .lines()
        .filter_map(|line| line.strip_prefix("model name")?.split(": ").nth(1))
        .collect();
    let output = Command::new("git")
        .args(["describe", "--always", "--dirty", "--exclude=*"])
        .output();
    let commit = output
        .map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
        .unwrap_or_default();
    format!(
        "commit {commit}, {} cores of {}",
        names.len(),
        names.first().unwrap_or(&"an unknown processor")
    )
}

/// Processor time of all threads of a process, milliseconds; in steps of ten.
///
/// # Errors
/// When there is no such process.
pub fn cpu_ms(pid: u32) -> io::Result<f64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // The name in the second field may contain blanks; after it, user and system time are the 12th and 13th field.
    let rest = stat.rsplit(')').next().unwrap_or_default();
    let ticks: u64 = rest
        .split_whitespace()
        .skip(11)
        .take(2)
        .filter_map(|field| field.parse::<u64>().ok())
        .sum();
    // Linux counts at 100 Hz outside the kernel.
    Ok(ticks as f64 * 10.0)
}
