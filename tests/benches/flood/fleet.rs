//! Processes of the flood: each a call of this program with `part NAME ENDPOINT KEYS SHM_MIB SECONDS`.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use bus::bounded_queue::Pop;
use bus::{
    AccessControl, Bus, BusOptions, Credentials, Endpoint, Event, Identity, InboxLimits,
    PublisherOptions, SharedMemory, open, unix_nanos,
};
use protocol::message::Bev;
use protocol::{
    Account, BevFeatures, BevGrid, CodecConfig, DropReason, Limits, Pose, PoseEstimate, Principal,
    RunId, RunScope, Stamp, Topic, encode_features, wire,
};
use serde::{Deserialize, Serialize};
use support::statistics;
use tests::bus::free_port;
use tests::machine;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;

const HONEST: [&str; 3] = ["1", "2", "3"];
pub(crate) const FLOODING: [&str; 4] = ["4", "5", "6", "7"];
const PERIOD: Duration = Duration::from_millis(100);
const FLOOD_PERIOD: Duration = Duration::from_millis(1);
/// Warm-up before the measurement.
const WARM_UP: Duration = Duration::from_secs(3);
/// Longest time until a process ends.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Setting of a measurement.
pub(crate) struct Setting {
    /// Folder of the keys, with QUIC.
    pub(crate) keys: Option<PathBuf>,
    /// Number of flooding senders, of [`FLOODING`].
    pub(crate) floods: usize,
    /// Shared memory of each process, MiB; 0: none.
    pub(crate) shm_mib: usize,
    pub(crate) duration: Duration,
}

/// Result of a measurement.
#[derive(Serialize, Deserialize, Default)]
pub(crate) struct Measured {
    /// Latencies of the honest vehicles' feature maps.
    pub(crate) latencies_ms: Vec<f64>,
    /// Processor time of router, ego and honest vehicles together.
    pub(crate) cpu_ms: f64,
    pub(crate) ego_mib: f64,
    pub(crate) router_mib: f64,
    /// Messages of the flood: sent, rejected by the ego before decoding, decoded by the ego.
    pub(crate) sent: u64,
    pub(crate) refused: u64,
    pub(crate) decoded: u64,
}

pub(crate) fn quantile(values: &[f64], quantile: f64) -> f64 {
    statistics::quantile(&statistics::sorted(values), quantile).unwrap_or(f64::NAN)
}

/// Runs the fleet once.
pub(crate) fn measure(setting: &Setting) -> Result<Measured> {
    let endpoint = Endpoint::loopback(free_port());
    let seconds = (setting.duration + WARM_UP).as_secs_f64();
    let part = |name: &str, seconds: f64| -> Result<Part> {
        let keys = setting.keys.as_deref().unwrap_or(Path::new(""));
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["part", name, endpoint.as_str()]).arg(keys);
        command.args([setting.shm_mib.to_string(), seconds.to_string()]);
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let mut lines = BufReader::new(child.stdout.take().context("a pipe")?);
        let mut ready = String::new();
        lines.read_line(&mut ready)?;
        if ready.trim() != "ready" {
            bail!("{name} did not start");
        }
        Ok(Part { child, lines })
    };
    let router = part("router", 0.0)?;
    let ego = part("ego", seconds)?;
    let honest = part("honest", seconds + 1.0)?;
    let flooding = FLOODING[..setting.floods]
        .iter()
        .map(|cav| part(&format!("flood-{cav}"), seconds));
    let flooding = flooding.collect::<Result<Vec<_>>>()?;
    let (ego_id, pids) = (
        ego.child.id(),
        [router.child.id(), ego.child.id(), honest.child.id()],
    );
    thread::sleep(WARM_UP);
    let before = cpu_ms(&pids)?;
    let (mut peaks, until) = ([0.0_f64; 2], Instant::now() + setting.duration);
    while Instant::now() < until {
        for (peak, pid) in peaks.iter_mut().zip([ego_id, pids[0]]) {
            *peak = peak.max(resident_mib(pid));
        }
        thread::sleep(Duration::from_millis(200));
    }
    let cpu_ms = cpu_ms(&pids)? - before;
    let mut measured: Measured = serde_json::from_str(&ego.last_line()?)?;
    for flooding in flooding {
        measured.sent += flooding.last_line()?.trim().parse::<u64>()?;
    }
    [measured.ego_mib, measured.router_mib] = peaks;
    measured.cpu_ms = cpu_ms;
    drop((honest, router));
    // The last process to end removes the segments that the others still held.
    zenoh::shm::cleanup_orphaned_shm_segments();
    Ok(measured)
}

/// A process that is ended when dropped, and killed after a timeout. A killed one leaves its shared memory behind.
struct Part {
    child: Child,
    lines: BufReader<std::process::ChildStdout>,
}

impl Part {
    fn last_line(mut self) -> Result<String> {
        let mut line = String::new();
        self.lines.read_line(&mut line)?;
        Ok(line)
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        let until = Instant::now() + TIMEOUT;
        while Instant::now() < until && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(20));
        }
        if matches!(self.child.try_wait(), Ok(None)) {
            eprintln!("process {} does not end, it is killed", self.child.id());
            let _ = self.child.kill();
        }
        let _ = self.child.wait();
    }
}

fn cpu_ms(pids: &[u32]) -> Result<f64> {
    pids.iter()
        .try_fold(0.0, |sum, pid| Ok(sum + machine::cpu_ms(*pid)?))
}

/// Without shared memory: that is the size of the pools, which every process maps.
fn resident_mib(pid: u32) -> f64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let kib = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    (kib("RssAnon:") + kib("RssFile:")) / 1024.0
}

/// Runs one process.
pub(crate) fn run_part(arguments: &[String]) -> Result<()> {
    let [name, endpoint, keys, shm_mib, seconds] = arguments else {
        bail!("part NAME ENDPOINT KEYS SHM_MIB SECONDS")
    };
    let place = Place {
        endpoint: endpoint.parse()?,
        keys: (!keys.is_empty()).then(|| PathBuf::from(keys)),
        shm: match shm_mib.parse::<usize>()? {
            0 => SharedMemory::Off,
            mib => SharedMemory::Pool(mib << 20),
        },
    };
    let duration = Duration::from_secs_f64(seconds.parse()?);
    match name.as_str() {
        "router" => place.route(),
        "ego" => place.listen(duration),
        "honest" => place.send_maps(duration),
        _ => place.flood(name.trim_start_matches("flood-"), duration),
    }
}

struct Place {
    endpoint: Endpoint,
    keys: Option<PathBuf>,
    shm: SharedMemory,
}

impl Place {
    fn with_memory(&self, options: BusOptions) -> BusOptions {
        BusOptions {
            shared_memory: self.shm,
            ..options
        }
    }

    fn join(&self, principal: &str) -> Result<Bus> {
        let known: Principal = principal.parse()?;
        let identity = Identity {
            run: RunId::new("flood")?,
            process: known.name(),
            cav: known.cav,
        };
        let options = self.with_memory(BusOptions::client(self.endpoint.clone()));
        let options = match &self.keys {
            Some(keys) => options.with_credentials(Credentials::read(&keys.join(principal))?),
            None => options,
        };
        Ok(Bus::join(&options, identity)?)
    }

    fn route(&self) -> Result<()> {
        let mut options = self.with_memory(BusOptions::router(self.endpoint.clone()));
        if let Some(keys) = &self.keys {
            let credentials = Credentials::read(&keys.join("router"))?;
            let guard = AccessControl {
                members: credentials.members()?,
                runs: RunScope::Any,
            };
            options = options.with_credentials(credentials);
            options.guard = Some(guard);
        }
        let session = open(&options)?;
        print("ready")?;
        let _ = std::io::stdin().lines().next();
        session.close().wait().map_err(anyhow::Error::from_boxed)
    }

    fn listen(&self, duration: Duration) -> Result<()> {
        let ego = self.join("ego-9")?;
        let inbox = ego.limited_inbox(4, 16, InboxLimits::PEERS);
        let flooding = FLOODING.map(bev);
        let subscriptions = HONEST
            .iter()
            .chain(&FLOODING)
            .map(|cav| ego.subscribe(bev(cav), &inbox));
        let subscriptions = subscriptions.collect::<Result<Vec<_>, _>>()?;
        print("ready")?;
        let (began, mut measured) = (Instant::now(), Measured::default());
        let until = began + duration;
        while Instant::now() < until {
            let Pop::Item(topic, Event::Message(arrival)) = inbox.take(Some(until)) else {
                continue;
            };
            let Some(map) = inbox.decode::<Bev>(&arrival, &Limits::DEFAULT) else {
                continue;
            };
            map.features.decode(&Limits::DEFAULT)?;
            let took_ms =
                unix_nanos().saturating_sub(arrival.header.stamp.publish_nanos) as f64 / 1e6;
            ego.stats().received(&topic);
            if flooding.contains(&topic) {
                measured.decoded += 1;
            } else if began.elapsed() > WARM_UP {
                measured.latencies_ms.push(took_ms);
            }
        }
        let ledger = ego.stats().ledger();
        for topic in flooding {
            let here = Account::towards(topic, &ego.identity().process);
            let refused = ledger
                .get(&here)
                .and_then(|counts| counts.dropped.get(&DropReason::RateLimit));
            measured.refused += refused.copied().unwrap_or(0);
        }
        print(&serde_json::to_string(&measured)?)?;
        drop(subscriptions);
        Ok(ego.leave(TIMEOUT)?)
    }

    fn send_maps(&self, duration: Duration) -> Result<()> {
        let buses = HONEST
            .iter()
            .map(|cav| self.join(&format!("agent-{cav}")))
            .collect::<Result<Vec<_>>>()?;
        let publishers = buses
            .iter()
            .zip(HONEST)
            .map(|(bus, cav)| bus.publisher(bev(cav), PublisherOptions::FEATURES));
        let publishers = publishers.collect::<Result<Vec<_>, _>>()?;
        print("ready")?;
        let (began, pose) = (Instant::now(), PoseEstimate::new(Pose::IDENTITY, 1.0));
        let maps: Vec<BevFeatures> = (0..HONEST.len()).map(|_| map_of(64)).collect();
        for turn in 0.. {
            let due = PERIOD / HONEST.len() as u32 * turn;
            if due > duration {
                break;
            }
            thread::sleep(due.saturating_sub(began.elapsed()));
            let index = turn as usize % HONEST.len();
            let map = maps[index].clone();
            publishers[index].submit_encoded(u64::from(turn), move |stamp| {
                wire::encode(
                    stamp,
                    Bev {
                        pose,
                        features: encode_features(map, &CodecConfig::default(), None)?,
                    },
                )
            });
        }
        drop(publishers);
        buses
            .into_iter()
            .try_for_each(|bus| Ok(bus.leave(TIMEOUT)?))
    }

    /// Valid messages of its own vehicle, as many as the network takes.
    fn flood(&self, cav: &str, duration: Duration) -> Result<()> {
        let bus = self.join(&format!("agent-{cav}"))?;
        let key = bus.key(bev(cav)).to_string();
        let pose = PoseEstimate::new(Pose::IDENTITY, 1.0);
        let features = encode_features(map_of(0), &CodecConfig::default(), None)?;
        print("ready")?;
        let began = Instant::now();
        let mut sent = 0_u64;
        while began.elapsed() < duration {
            let stamp = Stamp {
                cav: cav.parse()?,
                epoch: 1,
                sequence: sent,
                capture_nanos: sent,
                publish_nanos: unix_nanos(),
            };
            let encoded = wire::encode(
                &stamp,
                Bev {
                    pose,
                    features: features.clone(),
                },
            )?;
            let mut bytes = ZBytes::writer();
            bytes.append(encoded.head.into());
            bytes.append(encoded.body.as_bytes().to_vec().into());
            let put = bus
                .session()
                .put(&key, bytes.finish())
                .congestion_control(CongestionControl::Block);
            put.wait().map_err(anyhow::Error::from_boxed)?;
            sent += 1;
            let due = FLOOD_PERIOD * u32::try_from(sent)?;
            thread::sleep(due.saturating_sub(began.elapsed()));
        }
        print(&sent.to_string())?;
        Ok(bus.leave(TIMEOUT)?)
    }
}

fn bev(cav: &str) -> Topic {
    format!("{cav}/bev").parse().expect("a topic")
}

/// A feature map of 1.6 MB (`rows` 64: 100 x 64 cells of 64 channels), or one of 1 MiB (`rows` 0).
fn map_of(rows: u32) -> BevFeatures {
    let (channels, width, height) = if rows == 0 {
        (64, 64, 64)
    } else {
        (64, 100, rows)
    };
    let grid = BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width,
        height,
    };
    let values = (0..channels * width * height)
        .map(|index| (index % 1009) as f32 * 0.01)
        .collect();
    BevFeatures {
        grid,
        channels,
        code_of: None,
        values,
    }
}

fn print(line: &str) -> Result<()> {
    let mut out = std::io::stdout();
    writeln!(out, "{line}")?;
    Ok(out.flush()?)
}
