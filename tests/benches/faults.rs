//! Benchmark of a fleet under faults: gaps between results, recovery, start and end, and long runs.
//!
//! Four vehicles at 10 Hz with recorded poses and a small network, so that two cores are enough; every process is the
//! real program, and they connect over virtual links that can be cut.
//!
//! ```text
//! cargo build --release --workspace --bins
//! cargo bench -p tests --bench faults -- --faults 500 --seed 1     # about 25 minutes
//! cargo bench -p tests --bench faults -- --starts 100              # about 10 minutes
//! cargo bench -p tests --bench faults -- --secured-starts 100      # the same with keys, over QUIC
//! cargo bench -p tests --bench faults -- --soak 3600               # an hour
//! ```
//!
//! Prints a line per fault to standard error and the summary, in Markdown, to standard output. Fails when a target is
//! missed.

use std::time::Duration;

use anyhow::{Context, Result, bail};
use support::statistics;
use tests::faults::{FaultyFleet, Report, cold_start, plan, soak};
use tests::machine;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench")
        .collect();
    let pairs = arguments.chunks(2).map(pair).collect::<Result<Vec<_>>>()?;
    // At any position among them.
    let seed = pairs
        .iter()
        .rfind(|(name, _)| *name == "--seed")
        .map_or(1, |(_, seed)| *seed);
    let mut misses = Vec::new();
    println!("{}\n", machine::describe());
    for (name, value) in pairs {
        match name {
            "--seed" => {}
            "--faults" => misses.extend(under_faults(seed, value as usize)),
            "--starts" => misses.extend(starts(value as usize, false)),
            "--secured-starts" => misses.extend(starts(value as usize, true)),
            "--soak" => misses.extend(for_long(Duration::from_secs(value))),
            _ => bail!("{name} is none of --seed, --faults, --starts, --secured-starts, --soak"),
        }
    }
    if !misses.is_empty() {
        bail!("missed: {}", misses.join("; "));
    }
    Ok(())
}

/// An option and its value.
fn pair(arguments: &[String]) -> Result<(&str, u64)> {
    let [name, value] = arguments else {
        bail!("{} needs a value", arguments[0])
    };
    Ok((
        name,
        value.parse().with_context(|| format!("{name} {value}"))?,
    ))
}

/// Names of the targets that were missed.
fn missed(targets: &[(bool, String)]) -> Vec<String> {
    for (holds, target) in targets {
        println!("- {target}: {}", if *holds { "yes" } else { "**no**" });
    }
    targets
        .iter()
        .filter(|(holds, _)| !holds)
        .map(|(_, target)| target.clone())
        .collect()
}

fn under_faults(seed: u64, count: usize) -> Vec<String> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let faults = plan(seed, count);
    let report = FaultyFleet::start(folder.path()).suffer(&faults, |number, fault, ms| {
        eprintln!("{number}: {fault}, as before after {ms} ms")
    });
    let Report {
        findings,
        slowest,
        balances,
        discrepancies,
        exempted,
        stop,
        left_over,
        growth,
        restarts,
    } = report;
    let returns = findings.fused_again_ms.len();
    let ms: Vec<f64> = findings
        .fused_again_ms
        .iter()
        .map(|&ms| ms as f64)
        .collect();
    let ms = statistics::sorted(&ms);
    let quantile = |q: f64| statistics::quantile(&ms, q).unwrap_or(0.0) as u64;
    let worst = quantile(1.0);
    println!("## {count} faults, seed {seed}\n");
    println!(
        "{restarts} restarts; slowest to be as before: {} ms ({})",
        slowest.0, slowest.1
    );
    println!(
        "first message of a new instance to first result with it: median {} ms, 95th percentile {} ms",
        quantile(0.5),
        quantile(0.95)
    );
    println!(
        "{exempted} messages exempt, as a process that they concern was offline; {discrepancies}"
    );
    let [descriptors, threads] = growth;
    missed(&[
        (
            findings.gaps.is_empty(),
            format!(
                "no gap over two periods (longest {} ms, above: {:?})",
                findings.longest_gap_ms, findings.gaps
            ),
        ),
        (
            worst <= 1000,
            format!(
                "fused again within 1 s of the first message ({returns} times, longest {worst} ms)"
            ),
        ),
        (balances, "the ledger balances".into()),
        (
            left_over.is_empty(),
            format!("nothing left in shared memory {left_over:?}"),
        ),
        (
            descriptors.0 <= 8,
            format!(
                "descriptors flat (at most {:+} in an instance, {})",
                descriptors.0, descriptors.1
            ),
        ),
        (
            threads.0 <= 4,
            format!(
                "threads flat (at most {:+} in an instance, {})",
                threads.0, threads.1
            ),
        ),
        (
            stop < Duration::from_secs(5),
            format!("ended within 5 s ({:.1} s)", stop.as_secs_f64()),
        ),
    ])
}

fn starts(count: usize, is_secured: bool) -> Vec<String> {
    let all: Vec<_> = (0..count)
        .map(|number| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let start = cold_start(folder.path(), is_secured);
            eprintln!("{number}: {start:?}");
            start
        })
        .collect();
    let mut first: Vec<u64> = all.iter().map(|start| start.first_fused_ms).collect();
    first.sort_unstable();
    let slowest = first.last().copied().unwrap_or(0);
    let stop = all.iter().map(|start| start.stop).max().unwrap_or_default();
    println!(
        "## {count} cold starts{}\n",
        if is_secured { ", with keys" } else { "" }
    );
    println!(
        "first fused result: median {} ms, longest {slowest} ms",
        first[first.len() / 2]
    );
    missed(&[
        (
            slowest < 3000,
            format!("first fused frame under 3 s after the start (longest {slowest} ms)"),
        ),
        (
            all.iter().all(|start| start.lost_before == 0),
            "no frame lost before it".into(),
        ),
        (
            stop < Duration::from_secs(5),
            format!("every stop under 5 s (longest {:.2} s)", stop.as_secs_f64()),
        ),
        (
            all.iter().all(|start| start.left == 0),
            "no process left behind".into(),
        ),
    ])
}

fn for_long(lasts: Duration) -> Vec<String> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let soak = soak(folder.path(), lasts, |since, usage| {
        let line = usage
            .iter()
            .map(|(name, usage)| format!("{name} {:.0}", usage.resident_mib.unwrap_or(0.0)));
        eprintln!(
            "{:.0} s, MiB: {}",
            since.as_secs_f64(),
            line.collect::<Vec<_>>().join(", ")
        );
    });
    println!("## {} minutes\n", lasts.as_secs() / 60);
    println!("{} results\n", soak.frames);
    println!("| process | MiB after warm-up | at the end | MiB a minute | descriptors | threads |");
    println!("|---|---|---|---|---|---|");
    for ((name, [first, last, slope]), (_, [d0, d1, t0, t1])) in
        soak.memory.iter().zip(&soak.handles)
    {
        println!("| {name} | {first:.1} | {last:.1} | {slope:+.3} | {d0}, {d1} | {t0}, {t1} |");
    }
    println!();
    let steepest = soak
        .memory
        .iter()
        .map(|(_, [.., slope])| *slope)
        .fold(f64::MIN, f64::max);
    let [first, last] = soak.p99_ms;
    missed(&[
        (
            steepest < 1.0,
            format!("memory grows by less than 1 MiB a minute (steepest {steepest:+.3})"),
        ),
        (
            last <= 1.1 * first,
            format!(
                "p99 at the end within 10 % of that after warm-up ({first:.1} and {last:.1} ms)"
            ),
        ),
        (soak.balances, "the ledger balances".into()),
    ])
}
