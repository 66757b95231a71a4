//! Receivers that take nothing: the messages of the others go on, and what a receiver misses is counted.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use serde_json::Value;
use tests::bus::wait_for;
use tests::faults::{Fault, FaultyFleet, Kind, Results, Target, VEHICLES, write_scenario};
use tests::fleet::{Up, programs, signal};
use tests::hosts::{Hosts, router_address};
use tests::locks::exclusive_lock;

/// Longest gap between two results, milliseconds, at a frame period of 100 ms. The requirement is 300 ms on an idle machine;
/// a router that waits for such a receiver makes gaps of seconds.
const LONGEST_GAP_MS: u64 = 1000;

/// A recorder beside a run. Ended when dropped.
struct Recorder {
    child: Child,
    file: PathBuf,
}

impl Recorder {
    /// Starts one that records the run `test` of `router`, and waits until it has recorded something.
    fn start(router: &str, file: PathBuf) -> Self {
        let child = Command::new(programs().join("sim-replay"))
            .args(["record", "--json", "--keep-running", "--run=test"])
            .arg(format!("--connect={router}"))
            .arg(format!("--out={}", file.display()))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("sim-replay runs");
        wait_for("a recorded message", || {
            fs::metadata(&file).is_ok_and(|file| file.len() > 10_000)
        });
        Self { child, file }
    }

    fn stopped(router: &str, file: PathBuf) -> Self {
        let recorder = Self::start(router, file);
        signal(recorder.child.id(), "STOP");
        recorder
    }

    /// Goes on, ends, and returns its report and exit code.
    fn end(mut self) -> (Value, Option<i32>) {
        signal(self.child.id(), "CONT");
        let size = fs::metadata(&self.file).expect("its file").len();
        wait_for("a message after the stop", || {
            fs::metadata(&self.file).is_ok_and(|file| file.len() > size + 10_000)
        });
        thread::sleep(Duration::from_secs(2));
        signal(self.child.id(), "INT");
        let stdout = self.child.stdout.take().expect("a pipe");
        let report = std::io::read_to_string(stdout).expect("its report");
        let code = self.child.wait().expect("a child").code();
        (serde_json::from_str(report.trim()).expect("JSON"), code)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A fleet of [`VEHICLES`] at 10 Hz whose results are complete, and the endpoint of its router.
fn fleet(folder: &Path) -> (Up, String) {
    let scenario = write_scenario(folder, "");
    let mut up = Up::start(folder, &scenario);
    let line = up.wait_for_line("run test at ");
    let router = line
        .split_whitespace()
        .nth(3)
        .expect("an endpoint")
        .trim_end_matches(':')
        .to_owned();
    wait_until_complete(&mut up);
    (up, router)
}

fn wait_until_complete(up: &mut Up) {
    up.wait_for_results("fused results", |results| {
        results
            .last()
            .is_some_and(|result| tests::fleet::fused(result) == VEHICLES.len() - 1)
    });
}

/// Results published during `period`: their number and the longest gap, milliseconds.
fn results_during(up: &Up, period: impl FnOnce()) -> (usize, u64) {
    let mut results = Results::of(&up.folder);
    let before = results.update().len();
    period();
    let published: Vec<u64> = results.update()[before..]
        .iter()
        .map(|result| result.published_ms)
        .collect();
    let longest = published
        .windows(2)
        .map(|pair| pair[1].saturating_sub(pair[0]))
        .max()
        .unwrap_or(u64::MAX);
    (published.len(), longest)
}

fn ends_balanced(mut up: Up) {
    signal(up.pid(), "INT");
    assert!(matches!(up.wait().code(), Some(0 | 3)));
    let ledger: Value =
        serde_json::from_str(&fs::read_to_string(up.folder.join("ledger.json")).unwrap()).unwrap();
    assert_eq!(ledger["balances"], true, "{}", ledger["balance"]);
}

#[test]
fn stopped_receivers_stop_nobody_and_know_what_they_missed() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let (up, router) = fleet(folder.path());
    let file = |name: &str| folder.path().join(name);
    let mut stopped = Vec::new();
    // zenoh closes the connection of a silent receiver after 10 s: the time in which that happens is part of it.
    let (number, longest_ms) = results_during(&up, || {
        for name in ["a.mcap", "b.mcap", "c.mcap"] {
            stopped.push(Recorder::stopped(&router, file(name)));
            thread::sleep(Duration::from_secs(2));
        }
        thread::sleep(Duration::from_secs(12));
    });
    eprintln!("{longest_ms} ms between two of {number} results");
    assert!(longest_ms <= LONGEST_GAP_MS);
    drop(stopped);

    let recorder = Recorder::stopped(&router, file("d.mcap"));
    thread::sleep(Duration::from_secs(8));
    let (report, code) = recorder.end();
    assert!(
        report["undelivered"]
            .as_u64()
            .is_some_and(|messages| messages > 0),
        "{report}"
    );
    assert_eq!(code, Some(3), "a recording with gaps: {report}");
    ends_balanced(up);
}

#[test]
fn a_vehicle_that_is_cut_off_or_stopped_stops_no_other() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let fault = |kind| Fault {
        kind,
        target: Target::Process(format!("agent-{}", VEHICLES[3])),
        lasts: Duration::from_secs(6),
        after: Duration::from_millis(500),
    };
    let report = FaultyFleet::start(folder.path()).suffer(
        &[fault(Kind::Silence), fault(Kind::Stop)],
        |_, fault, ms| eprintln!("{fault}, as before after {ms} ms"),
    );
    eprintln!("{} ms between two results", report.findings.longest_gap_ms);
    assert!(
        report.findings.longest_gap_ms <= LONGEST_GAP_MS,
        "{report:?}"
    );
    assert!(report.balances, "{}", report.discrepancies);
}

#[test]
#[ignore = "needs network namespaces"]
fn a_cut_cable_to_a_vehicle_stops_no_other() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let hosts = Hosts::lay(&["vehicle"]).expect("network namespaces");
    let far = VEHICLES[3];
    let network = format!("network: {{listen: 'tcp/0.0.0.0:7447'}}\nremote_agents: ['{far}']");
    let scenario = write_scenario(folder.path(), &network);
    let mut up = Up::by(
        hosts.command("router", &programs().join("v2vloc")),
        folder.path(),
        &scenario,
    );
    up.wait_for_line("run test at ");
    let mut agent = hosts
        .command("vehicle", &programs().join("agent"))
        .args([
            "run",
            "--run=test",
            "--keep-running",
            "--connect-timeout-s=60",
        ])
        .arg(format!("--cav={far}"))
        .arg(format!("--connect=tcp/{}:7447", router_address(0)))
        .arg(format!(
            "--weights={}",
            folder.path().join("weights.safetensors").display()
        ))
        .spawn()
        .expect("ip runs");
    wait_until_complete(&mut up);
    let (number, longest_ms) = results_during(&up, || {
        hosts.cut(0).unwrap();
        thread::sleep(Duration::from_secs(16));
    });
    let _ = agent.kill();
    let _ = agent.wait();
    eprintln!("{longest_ms} ms between two of {number} results");
    assert!(longest_ms <= LONGEST_GAP_MS);
    // Nobody knows what the vehicle sent last: its cable is still cut.
    signal(up.pid(), "INT");
    assert!(matches!(up.wait().code(), Some(0 | 3)));
}
