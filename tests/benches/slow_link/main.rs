//! Benchmark of feature maps over slow links: age of the newest one, losses and their reasons, blocking time of the
//! publisher.
//!
//! An agent offers a feature map at 10 Hz. Three connections to the ego take turns for every rate and size:
//!
//! - `link`: the bus, with the emulated link of `sim-replay link` between (KEEP_LAST(1) queue);
//! - `veth`: the bus over a real slow link, two network namespaces whose virtual link is shaped by a token bucket (`tc
//! qdisc add .. tbf`);
//! - `plain`: zenoh over the same virtual link with its default settings.
//!
//! ```text
//! cargo bench -p tests --bench slow_link -- --out deploy/results/link             # everything, 20 minutes
//! cargo bench -p tests --bench slow_link -- --out /tmp/link --ways link,plain --rates 27 --sizes 1048576
//! cargo bench -p tests --bench slow_link -- --out /tmp/rate --rates 27 --sizes 1048576 --seconds 60
//! ```
//!
//! The namespaces need root and iproute2; without them only `link` can run. A run lasts ten seconds, or two and a half
//! times the transmission time of a message where that is longer, so that the age of the newest feature map goes
//! through its whole saw tooth. Writes `slow_link.csv` and `slow_link.md`. Fails when a run of `link` misses a target:
//! no message lost without a reason, no call of the publisher longer than 5 ms, 95th percentile of the age of the
//! newest feature map, at every millisecond from the first arrival on, below twice the transmission time and 100 ms.

mod ends;
mod table;
mod virtual_link;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use table::Row;

const RATES_MBPS: [f64; 5] = [1.0, 6.0, 27.0, 100.0, 1000.0];
const SIZES: [usize; 3] = [64 << 10, 1 << 20, 8 << 20];
/// Time between two feature maps.
const PERIOD: Duration = Duration::from_millis(100);

/// Connection from the agent to the ego.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    Link,
    VirtualLink,
    Plain,
}

impl Way {
    const ALL: [Self; 3] = [Self::Link, Self::VirtualLink, Self::Plain];

    fn name(self) -> &'static str {
        match self {
            Self::Link => "link",
            Self::VirtualLink => "veth",
            Self::Plain => "plain",
        }
    }
}

/// One run.
#[derive(Debug, Clone, Copy)]
struct Cell {
    rate_mbps: f64,
    bytes: usize,
    duration: Duration,
}

impl Cell {
    fn new(rate_mbps: f64, bytes: usize, seconds: Option<f64>) -> Self {
        let mut cell = Self {
            rate_mbps,
            bytes,
            duration: Duration::ZERO,
        };
        let seconds = seconds.unwrap_or_else(|| (2.5 * cell.on_the_wire_ms() / 1e3).max(10.0));
        cell.duration = Duration::from_secs_f64(seconds);
        cell
    }

    /// Transmission time of a message, milliseconds.
    fn on_the_wire_ms(&self) -> f64 {
        self.bytes as f64 * 8.0 / (self.rate_mbps * 1e3)
    }

    /// Largest age of the newest feature map, milliseconds.
    fn age_target_ms(&self) -> f64 {
        2.0 * self.on_the_wire_ms() + PERIOD.as_secs_f64() * 1e3
    }
}

/// Options of the benchmark.
struct Wanted {
    out: PathBuf,
    ways: Vec<Way>,
    rates_mbps: Vec<f64>,
    sizes: Vec<usize>,
    seconds: Option<f64>,
}

fn wanted(arguments: &[String]) -> Result<Wanted> {
    let mut wanted = Wanted {
        out: PathBuf::new(),
        ways: Way::ALL.to_vec(),
        rates_mbps: RATES_MBPS.to_vec(),
        sizes: SIZES.to_vec(),
        seconds: None,
    };
    let mut arguments = arguments.iter().filter(|argument| *argument != "--bench");
    while let Some(name) = arguments.next() {
        let value = arguments
            .next()
            .with_context(|| format!("{name} needs a value"))?;
        let parts = || value.split(',');
        match name.as_str() {
            // cargo runs benches in the folder of their package.
            "--out" => {
                wanted.out = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
                    .join("..")
                    .join(value)
            }
            "--ways" => {
                wanted.ways = Way::ALL
                    .into_iter()
                    .filter(|way| parts().any(|part| part == way.name()))
                    .collect()
            }
            "--rates" => wanted.rates_mbps = parts().map(str::parse).collect::<Result<_, _>>()?,
            "--sizes" => wanted.sizes = parts().map(str::parse).collect::<Result<_, _>>()?,
            "--seconds" => wanted.seconds = Some(value.parse()?),
            _ => bail!("{name} is none of --out, --ways, --rates, --sizes, --seconds"),
        }
    }
    if wanted.out == PathBuf::new() {
        bail!("--out DIR is required: the folder of the table");
    }
    Ok(wanted)
}

fn measure(wanted: &Wanted) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for &rate_mbps in &wanted.rates_mbps {
        for &bytes in &wanted.sizes {
            let cell = Cell::new(rate_mbps, bytes, wanted.seconds);
            for &way in &wanted.ways {
                let seen = match way {
                    Way::Link => ends::over_link(&cell)?,
                    Way::VirtualLink | Way::Plain => virtual_link::over_virtual_link(&cell, way)?,
                };
                let row = Row::of(&cell, way, &seen);
                eprintln!("{}", row.markdown());
                rows.push(row);
            }
        }
    }
    Ok(rows)
}

fn main() -> Result<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // One end of the virtual link, in a namespace of its own.
    if arguments.first().is_some_and(|argument| argument == "end") {
        virtual_link::run_end(&arguments[1..])?;
        return Ok(ExitCode::SUCCESS);
    }
    if let [role, endpoint] = arguments.as_slice()
        && role == "router"
    {
        ends::route(endpoint)?;
        return Ok(ExitCode::SUCCESS);
    }
    let wanted = wanted(&arguments)?;
    let rows = measure(&wanted)?;
    table::write(&wanted.out, &arguments.join(" "), &rows)?;
    let missed = rows
        .iter()
        .filter(|row| row.way == Way::Link.name() && !row.is_on_target())
        .count();
    Ok(if missed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
