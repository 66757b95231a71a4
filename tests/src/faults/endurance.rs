//! Repeated starts and ends of a fleet, and long runs.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use deploy::operate::health::{State, Usage};
use deploy::operate::status::RunStatus;

use super::{Results, VEHICLES, unix_ms};
use crate::fleet::{Up, signal, write_weights};

/// Interval between two readings of memory.
const READING_PERIOD: Duration = Duration::from_secs(5);
/// Fraction of a run that is warm-up.
const WARM_UP: f64 = 0.2;

/// Writes a scene of [`VEHICLES`], weights and a scenario into `folder`; `rest` are further lines of the scenario.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn write_scenario(folder: &Path, rest: &str) -> PathBuf {
    crate::scene::write(folder, &VEHICLES, 10);
    write_weights(&folder.join("weights.safetensors"));
    let text = format!(
        "run: test\nscene: {{dir: scene, loop: true}}\nmodels: {{weights: weights.safetensors}}\nmethod: max\n\
         ego: {{deadline_ms: 50, max_age_ms: 500}}\n{rest}\n"
    );
    let path = folder.join("scenario.yaml");
    fs::write(&path, text).expect("a writable folder");
    path
}

/// One start and its end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColdStart {
    /// From the start of `v2vloc up` to the first result with data of all neighbours, milliseconds.
    pub first_fused_ms: u64,
    /// Number of frames of the ego's agent before that one that were never decided.
    pub lost_before: u64,
    /// From Ctrl-C to the end of `v2vloc up`.
    pub stop: Duration,
    /// Number of processes that had to be killed, or that remained.
    pub left: usize,
}

/// Starts a fleet of [`VEHICLES`] with nothing running, waits until all are fused for a moment, and ends it. A secured
/// fleet makes its keys first, and speaks QUIC.
///
/// # Panics
/// When it does not reach that state.
#[must_use]
pub fn cold_start(folder: &Path, is_secured: bool) -> ColdStart {
    let scenario = write_scenario(folder, if is_secured { "security: {}" } else { "" });
    // Built before the clock runs: the check for changes takes seconds.
    crate::fleet::programs();
    let began_ms = unix_ms();
    let mut up = Up::start(folder, &scenario);
    let is_fused = |result: &serde_json::Value| crate::fleet::fused(result) == VEHICLES.len() - 1;
    up.wait_for_results("a result of all", |results| results.iter().any(is_fused));
    let results = crate::fleet::results(&up.folder);
    let first = results.iter().position(is_fused).expect("there is one");
    let published_ms = results[first]["publish_nanos"].as_u64().expect("a number") / 1_000_000;
    let index = results[first]["agent_frame"].as_u64().expect("a number");
    let pids = up.pids();
    let asked = Instant::now();
    signal(up.pid(), "INT");
    up.wait();
    let stop = asked.elapsed();
    let left = pids
        .values()
        .filter(|pid| crate::fleet::is_running(**pid))
        .count();
    ColdStart {
        first_fused_ms: published_ms - began_ms,
        lost_before: index - first as u64,
        stop,
        left,
    }
}

/// Measurements of a long run.
#[derive(Debug, Clone, PartialEq)]
pub struct Soak {
    /// Number of results.
    pub frames: usize,
    /// Resident memory of each process: MiB after the warm-up, MiB at the end, MiB a minute in between.
    pub memory: Vec<(String, [f64; 3])>,
    /// 99th percentile of the latency, milliseconds, in the first sixth after the warm-up and in the last sixth.
    pub p99_ms: [f64; 2],
    /// Descriptors and threads of each process, after the warm-up and at the end.
    pub handles: Vec<(String, [u64; 4])>,
    /// True if the ledger balances.
    pub balances: bool,
}

/// Runs a fleet of [`VEHICLES`] at 10 Hz for so long; `on_reading` is called with every reading.
///
/// # Panics
/// When a process crashes.
#[must_use]
pub fn soak(
    folder: &Path,
    lasts: Duration,
    mut on_reading: impl FnMut(Duration, &[(String, Usage)]),
) -> Soak {
    let scenario = write_scenario(folder, "link: {model: ideal}");
    let mut up = Up::start(folder, &scenario);
    let mut results = Results::of(&up.folder);
    up.wait_for_results("a result", |results| !results.is_empty());
    let (began, began_ms) = (Instant::now(), unix_ms());
    let mut readings: Vec<(f64, Vec<(String, Usage)>)> = Vec::new();
    while began.elapsed() < lasts {
        std::thread::sleep(READING_PERIOD.min(lasts / 20));
        let own = [("v2vloc".to_owned(), up.pid())];
        let usage_of = |(name, pid)| Usage::of(pid).map(|usage| (name, usage));
        let usage: Vec<(String, Usage)> = up
            .pids()
            .into_iter()
            .chain(own)
            .filter_map(usage_of)
            .collect();
        let status = RunStatus::read(&up.folder).expect("a run writes its status");
        let crashed = status
            .processes
            .iter()
            .find(|process| process.state == State::Down || process.restarts > 0);
        assert!(crashed.is_none(), "{crashed:?}");
        on_reading(began.elapsed(), &usage);
        readings.push((began.elapsed().as_secs_f64() / 60.0, usage));
    }
    signal(up.pid(), "INT");
    up.wait();
    let frames = results.update().len();
    let table = fs::read_to_string(up.folder.join("frames.csv")).expect("a table");
    let ended_ms = began_ms + lasts.as_millis() as u64;
    let published: Vec<u64> = results
        .update()
        .iter()
        .map(|result| result.published_ms)
        .collect();
    let latencies = latencies(&table, &published);
    let sixth = (ended_ms - began_ms) / 6;
    let p99_within = |from: u64, to: u64| {
        let within = latencies
            .iter()
            .filter(|(at, _)| (from..to).contains(at))
            .map(|(_, ms)| *ms);
        p99(within.collect())
    };
    let warm_ms = began_ms + (WARM_UP * (ended_ms - began_ms) as f64) as u64;
    let ledger = fs::read_to_string(up.folder.join("ledger.json")).expect("a ledger");
    let ledger: serde_json::Value = serde_json::from_str(&ledger).expect("JSON");
    let warm: Vec<_> = readings
        .into_iter()
        .filter(|(minutes, _)| *minutes * 60.0 > WARM_UP * lasts.as_secs_f64())
        .collect();
    Soak {
        frames,
        memory: each(&warm, |usage| usage.resident_mib)
            .into_iter()
            .map(|(name, points)| {
                let (first, last) = (points[0].1, points[points.len() - 1].1);
                (name, [first, last, slope(&points)])
            })
            .collect(),
        p99_ms: [
            p99_within(warm_ms, warm_ms + sixth),
            p99_within(ended_ms - sixth, ended_ms),
        ],
        handles: each(&warm, |usage| usage.descriptors.map(|count| count as f64))
            .into_iter()
            .zip(each(&warm, |usage| usage.threads.map(|count| count as f64)))
            .map(|((name, descriptors), (_, threads))| {
                let ends =
                    |points: &[(f64, f64)]| [points[0].1 as u64, points[points.len() - 1].1 as u64];
                let ([d0, d1], [t0, t1]) = (ends(&descriptors), ends(&threads));
                (name, [d0, d1, t0, t1])
            })
            .collect(),
        balances: ledger["balances"] == true,
    }
}

/// A value of each process over time, minutes.
fn each(
    readings: &[(f64, Vec<(String, Usage)>)],
    value: impl Fn(&Usage) -> Option<f64>,
) -> Vec<(String, Vec<(f64, f64)>)> {
    let names = readings
        .first()
        .into_iter()
        .flat_map(|(_, usage)| usage.iter().map(|(name, _)| name.clone()));
    names
        .map(|name| {
            let at = |(minutes, usage): &(f64, Vec<(String, Usage)>)| {
                let (_, usage) = usage.iter().find(|(known, _)| *known == name)?;
                Some((*minutes, value(usage)?))
            };
            let points = readings.iter().filter_map(at).collect();
            (name, points)
        })
        .filter(|(_, points): &(String, Vec<_>)| !points.is_empty())
        .collect()
}

/// Latency and time of each result, from `frames.csv`; its lines are those of the results.
fn latencies(table: &str, published_ms: &[u64]) -> Vec<(u64, f64)> {
    let latency = |line: &str| line.split(',').nth(3)?.parse().ok();
    published_ms
        .iter()
        .copied()
        .zip(table.lines().skip(1).filter_map(latency))
        .collect()
}

fn p99(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values
        .get((values.len() * 99).div_ceil(100).saturating_sub(1))
        .copied()
        .unwrap_or(0.0)
}

/// Slope of the straight line through points, by least squares.
fn slope(points: &[(f64, f64)]) -> f64 {
    let count = points.len() as f64;
    let (mean_x, mean_y) = (
        points.iter().map(|(x, _)| x).sum::<f64>() / count,
        points.iter().map(|(_, y)| y).sum::<f64>() / count,
    );
    let spread: f64 = points.iter().map(|(x, _)| (x - mean_x).powi(2)).sum();
    let together: f64 = points
        .iter()
        .map(|(x, y)| (x - mean_x) * (y - mean_y))
        .sum();
    if spread > 0.0 { together / spread } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_and_percentiles_are_those_of_the_textbook() {
        assert!((slope(&[(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)]) - 2.0).abs() < 1e-12);
        assert_eq!(slope(&[(1.0, 4.0)]), 0.0);
        assert_eq!(p99((1..=200).map(f64::from).collect()), 198.0);
        let table =
            "tick,agent_frame,capture_nanos,latency_ms\n0,0,0,12.5\n1,1,100,\n2,2,200,14.0\n";
        assert_eq!(latencies(table, &[10, 20]), [(10, 12.5), (20, 14.0)]);
    }
}
