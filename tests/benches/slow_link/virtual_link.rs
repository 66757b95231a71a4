//! Real slow link: two network namespaces, a virtual link between them, a token bucket at the agent's end.
//!
//! The ego's host runs the router and the ego, the agent's host only the agent; each is a process of this program.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use bus::{BusOptions, open};
use zenoh::{Config, Session, Wait};

use super::ends::{self, Measurement};
use super::{Cell, Way};

const AGENT: &str = "v2v-slow-agent";
const EGO: &str = "v2v-slow-ego";
const ROUTER: &str = "tcp/10.77.1.1:7447";

/// One run over the virtual link.
pub(crate) fn over_virtual_link(cell: &Cell, way: Way) -> Result<Measurement> {
    let _link = VirtualLink::lay(cell.rate_mbps)?;
    let mut ego = start(EGO, way, cell)?;
    let mut from_ego = BufReader::new(ego.stdout.take().context("a pipe")?);
    let mut ready = String::new();
    from_ego.read_line(&mut ready)?;
    let agent = start(AGENT, way, cell)?.wait_with_output()?;
    // The end of its input signals the end of the agent.
    drop(ego.stdin.take());
    let mut text = String::new();
    from_ego.read_to_string(&mut text)?;
    if !ego.wait()?.success() || !agent.status.success() {
        bail!("an end of the virtual link failed: see above");
    }
    let ego: Measurement = serde_json::from_str(&text)?;
    let mut seen: Measurement = serde_json::from_slice(&agent.stdout)?;
    seen.arrivals = ego.arrivals;
    seen.ledger.merge(&ego.ledger);
    Ok(seen)
}

fn start(host: &str, way: Way, cell: &Cell) -> Result<Child> {
    let numbers = [
        cell.rate_mbps.to_string(),
        cell.bytes.to_string(),
        cell.duration.as_secs_f64().to_string(),
    ];
    let mut command = Command::new("ip");
    command
        .args(["netns", "exec", host])
        .arg(std::env::current_exe()?)
        .args(["end", host, way.name()])
        .args(numbers);
    Ok(command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?)
}

/// Runs the process of one end: prints its observations.
pub(crate) fn run_end(arguments: &[String]) -> Result<()> {
    let [host, way, rate_mbps, bytes, seconds] = arguments else {
        bail!("end HOST WAY RATE BYTES SECONDS")
    };
    let cell = Cell::new(rate_mbps.parse()?, bytes.parse()?, Some(seconds.parse()?));
    let seen = match (host == EGO, way == Way::Plain.name()) {
        (true, true) => plain_ego()?,
        (true, false) => ego()?,
        (false, true) => {
            let session = plain_session("client")?;
            let submissions = ends::send_plain(&session, &cell)?;
            // Time for the messages in buffers.
            thread::sleep(Duration::from_secs_f64(
                (cell.on_the_wire_ms() / 1e3).min(20.0),
            ));
            session.close().wait().map_err(anyhow::Error::from_boxed)?;
            Measurement {
                submissions,
                ..Measurement::default()
            }
        }
        (false, false) => {
            let agent = ends::join(&ROUTER.parse()?, "agent-7", "7")?;
            let submissions = ends::send(&agent, &cell, &[(ends::sent_topic(), "ego-9")])?;
            let ledger = agent.stats().ledger();
            agent.leave(Duration::from_secs(20))?;
            Measurement {
                submissions,
                ledger,
                ..Measurement::default()
            }
        }
    };
    println!("{}", serde_json::to_string(&seen)?);
    Ok(())
}

fn ego() -> Result<Measurement> {
    let _router = open(&BusOptions::router(ROUTER.parse()?))?;
    let ego = ends::join(&ROUTER.parse()?, "ego-9", "9")?;
    print_ready()?;
    let arrivals = ends::receive(&ego, &ends::sent_topic())?;
    Ok(Measurement {
        arrivals,
        ledger: ego.stats().ledger(),
        ..Measurement::default()
    })
}

fn plain_ego() -> Result<Measurement> {
    let _router = plain_session("router")?;
    let session = plain_session("client")?;
    print_ready()?;
    let is_over = Arc::new(AtomicBool::new(false));
    let over = Arc::clone(&is_over);
    thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        over.store(true, Ordering::Relaxed);
    });
    Ok(Measurement {
        arrivals: ends::receive_plain(&session, || is_over.load(Ordering::Relaxed))?,
        ..Measurement::default()
    })
}

fn print_ready() -> Result<()> {
    let mut out = std::io::stdout();
    writeln!(out, "ready")?;
    Ok(out.flush()?)
}

/// zenoh with its default settings, except for endpoints and the restriction to TCP.
fn plain_session(mode: &str) -> Result<Session> {
    let (listen, connect) = if mode == "router" {
        (vec![ROUTER], vec![])
    } else {
        (vec![], vec![ROUTER])
    };
    let mut config = Config::default();
    for (key, value) in [
        ("mode", serde_json::json!(mode)),
        ("listen/endpoints", serde_json::json!(listen)),
        ("connect/endpoints", serde_json::json!(connect)),
        ("scouting/multicast/enabled", serde_json::json!(false)),
        ("transport/shared_memory/enabled", serde_json::json!(false)),
    ] {
        config
            .insert_json5(key, &value.to_string())
            .map_err(anyhow::Error::from_boxed)?;
    }
    zenoh::open(config)
        .wait()
        .map_err(anyhow::Error::from_boxed)
}

/// Two hosts and their virtual link; removed when dropped.
struct VirtualLink;

impl VirtualLink {
    fn lay(rate_mbps: f64) -> Result<Self> {
        // Left behind by a run that was killed.
        drop(Self);
        let link = Self;
        for host in [AGENT, EGO] {
            ip(&format!("netns add {host}"))?;
            ip(&format!("-n {host} link set lo up"))?;
        }
        ip(&format!(
            "link add slow0 netns {EGO} type veth peer name slow1 netns {AGENT}"
        ))?;
        for (host, end, address) in [
            (EGO, "slow0", "10.77.1.1/24"),
            (AGENT, "slow1", "10.77.1.2/24"),
        ] {
            ip(&format!("-n {host} address add {address} dev {end}"))?;
            ip(&format!("-n {host} link set {end} up"))?;
        }
        // A queue of 50 ms, as in routers; the burst is the size that a token bucket needs at 1 Gbit/s.
        let shape = format!(
            "netns exec {AGENT} tc qdisc add dev slow1 root tbf rate {rate_mbps}mbit burst 64kb latency 50ms"
        );
        ip(&shape)?;
        Ok(link)
    }
}

impl Drop for VirtualLink {
    fn drop(&mut self) {
        for host in [AGENT, EGO] {
            let _ = Command::new("ip")
                .args(["netns", "del", host])
                .stderr(Stdio::null())
                .status();
        }
    }
}

fn ip(arguments: &str) -> Result<()> {
    let output = Command::new("ip")
        .args(arguments.split(' '))
        .output()
        .context("iproute2 is needed")?;
    if !output.status.success() {
        bail!(
            "ip {arguments}: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(())
}
