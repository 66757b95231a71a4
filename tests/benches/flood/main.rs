//! Benchmark of a flood: its cost for other processes, and the cost of QUIC for all.
//!
//! Three vehicles send feature maps of 1.6 MB ten times a second to an ego; a fourth (`--floods`: as many as four
//! more), with a certificate of the same fleet, sends 1 MiB as often as it can, up to 1000 times a second. Router, ego,
//! the three vehicles and each flooding one are processes of this program.
//!
//! ```text
//! cargo bench -p tests --bench flood [-- --seconds 20 --shm-mib 256 --floods 1 --out deploy/results/security-flood.md]
//! ```
//!
//! With `--shm-mib` large messages go through shared memory, of that size for each process: a flood then costs its
//! sender a copy and the network little, so that the flood has the requested rate and not the throughput of the
//! sockets.
//!
//! Latency: from the encoding of a feature map to its decoding at the ego. Processor time is for each feature map of
//! the three. Memory: largest resident size of the ego and the router.

mod fleet;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use deploy::operate::keys::{KeyPlan, make};
use tests::machine;

use fleet::{FLOODING, Measured, Setting};

/// Largest ratio of the others' 99th percentile with and without the flood.
const AT_MOST: f64 = 2.0;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let done = match arguments.first().map(String::as_str) {
        Some("part") => fleet::run_part(&arguments[1..]).map(|()| true),
        _ => bench(&arguments),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn bench(arguments: &[String]) -> Result<bool> {
    let (mut seconds, mut shm_mib, mut floods, mut out) = (20.0, 0, 1, None);
    let mut arguments = arguments.iter().filter(|argument| *argument != "--bench");
    while let Some(name) = arguments.next() {
        let value = arguments
            .next()
            .with_context(|| format!("{name} needs a value"))?;
        match name.as_str() {
            "--seconds" => seconds = value.parse()?,
            "--shm-mib" => shm_mib = value.parse()?,
            "--floods" => floods = value.parse::<usize>()?.clamp(1, FLOODING.len()),
            // cargo runs benches in the folder of their package.
            "--out" => out = Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(value)),
            _ => bail!("{name} is none of --seconds, --shm-mib, --floods, --out"),
        }
    }
    let folder = tempfile::tempdir()?;
    let agents = (1..=7).map(|cav| format!("agent-{cav}"));
    let principals = agents
        .chain(["ego-9".into(), "replay".into()])
        .map(|principal| principal.parse());
    let principals = principals.collect::<Result<_, _>>()?;
    make(&KeyPlan::new(folder.path(), principals, 1))?;
    let mut rows = Vec::new();
    // The settings alternate, so that a change in the load of the machine does not favour one.
    for _ in 0..2 {
        for (secured, flood) in [(false, false), (true, false), (false, true), (true, true)] {
            let keys = secured.then(|| folder.path().to_path_buf());
            let floods = if flood { floods } else { 0 };
            let setting = Setting {
                keys,
                floods,
                shm_mib,
                duration: Duration::from_secs_f64(seconds),
            };
            rows.push((secured, flood, fleet::measure(&setting)?));
        }
    }
    let memory = if shm_mib == 0 {
        "no shared memory".into()
    } else {
        format!("{shm_mib} MiB of shared memory each")
    };
    report(
        &rows,
        &format!("{seconds} s for each line, {memory}, {floods} flooding"),
        out.as_ref(),
    )
}

fn report(rows: &[(bool, bool, Measured)], how: &str, out: Option<&PathBuf>) -> Result<bool> {
    let mut text = format!("{}; {how}\n\n", machine::describe());
    text += "| link | flood | maps | p50 ms | p99 ms | CPU a map, ms | ego MiB | router MiB | flood: sent | refused | decoded |\n";
    text += "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n";
    for (secured, flood, measured) in rows {
        let Measured {
            latencies_ms,
            cpu_ms,
            ego_mib,
            router_mib,
            sent,
            refused,
            decoded,
        } = measured;
        let [p50, p99] = [0.50, 0.99].map(|quantile| fleet::quantile(latencies_ms, quantile));
        let (link, maps) = (if *secured { "QUIC" } else { "TCP" }, latencies_ms.len());
        writeln!(
            text,
            "| {link} | {} | {maps} | {p50:.1} | {p99:.1} | {:.1} | {ego_mib:.0} | {router_mib:.0} | {sent} | {refused} | {decoded} |",
            if *flood { "yes" } else { "no" },
            cpu_ms / maps.max(1) as f64,
        )?;
    }
    let p99 = |secured: bool, flood: bool| {
        let all = rows.iter().filter(|row| (row.0, row.1) == (secured, flood));
        let all: Vec<f64> = all
            .flat_map(|row| row.2.latencies_ms.iter().copied())
            .collect();
        fleet::quantile(&all, 0.99)
    };
    let ratios = [false, true].map(|secured| p99(secured, true) / p99(secured, false));
    writeln!(
        text,
        "\np99 under the flood over p99 without: TCP {:.2}, QUIC {:.2}",
        ratios[0], ratios[1]
    )?;
    print!("{text}");
    if let Some(path) = out {
        std::fs::write(path, &text).with_context(|| path.display().to_string())?;
    }
    Ok(ratios.iter().all(|ratio| *ratio <= AT_MOST))
}
