//! Fleet on three hosts over QUIC: a router, a vehicle and an ego, each in a network namespace with a virtual link to
//! the router. The commands are those of `deploy/docs/how-to/several-hosts.md`.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tests::fleet::{programs, signal, write_weights};
use tests::hosts::{Hosts, router_address};
use tests::locks::exclusive_lock;

const TICKS: usize = 8;
const PORT: u16 = 7447;
/// Longer than any step takes, under any load.
const TIMEOUT: Duration = Duration::from_secs(120);

/// A process on one of the hosts; killed when dropped.
struct Running(Child);

impl Running {
    fn end(mut self) -> Output {
        let deadline = Instant::now() + TIMEOUT;
        while self.0.try_wait().expect("a child").is_none() {
            assert!(Instant::now() < deadline, "a process does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut output = Output {
            status: self.0.wait().expect("a child"),
            stdout: Vec::new(),
            stderr: Vec::new(),
        };
        use std::io::Read;
        self.0
            .stdout
            .take()
            .expect("a pipe")
            .read_to_end(&mut output.stdout)
            .expect("its output");
        output
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start(command: &mut Command, log: &Path) -> Running {
    let log = fs::File::create(log).expect("a writable folder");
    Running(
        command
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .expect("ip runs"),
    )
}

#[test]
#[ignore = "needs network namespaces"]
fn a_fleet_spans_three_hosts_over_quic() {
    let _exclusive = exclusive_lock();
    let hosts = Hosts::lay(&["vehicle", "ego"]).expect("network namespaces");
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    tests::scene::write(folder.path(), &["4279", "4288"], TICKS);
    write_weights(&path("weights.safetensors"));
    let addresses = [0, 1]
        .map(|index| router_address(index).to_string())
        .join(",");
    let keys = path("keys");
    let made = Command::new(programs().join("v2vloc"))
        .args(["keys", "--agents=4279,4288", "--egos=4279", "--days=1"])
        .arg(format!("--hosts={addresses}"))
        .arg(format!("--out={}", keys.display()))
        .output()
        .unwrap();
    assert!(
        made.status.success(),
        "{}",
        String::from_utf8_lossy(&made.stderr)
    );

    let run = |host: &str, program: &str, arguments: &[&str], holder: &str| {
        let mut command = hosts.command(host, &programs().join(program));
        command
            .args(arguments)
            .arg(format!("--keys={}", keys.join(holder).display()));
        if program != "v2vloc" {
            let index = usize::from(host == "ego");
            command.args([
                "--run=test".to_owned(),
                format!("--connect=quic/{}:{PORT}", router_address(index)),
            ]);
            command.arg("--connect-timeout-s=60");
        }
        start(&mut command, &path(&format!("{holder}.log")))
    };
    let weights = format!("--weights={}", path("weights.safetensors").display());
    let router = run(
        "router",
        "v2vloc",
        &["router", &format!("--listen=quic/0.0.0.0:{PORT}")],
        "router",
    );
    let far = run(
        "vehicle",
        "agent",
        &["run", "--cav=4288", &weights],
        "agent-4288",
    );
    let near = run(
        "ego",
        "agent",
        &["run", "--cav=4279", &weights],
        "agent-4279",
    );
    let arguments = [
        "run",
        "--ego=4279",
        "--method=max",
        "--deadline-ms=60000",
        "--json",
        &weights,
    ];
    let ego = run("ego", "ego-fuser", &arguments, "ego-4279");
    let scene = path("scene");
    let arguments = [
        "stream",
        scene.to_str().unwrap(),
        "--lockstep",
        "--egos=4279",
        "--expect=4288/bev>ego-4279",
        "--expect=4279/bev>ego-4279",
        "--json",
    ];
    // The scene is on the router's host; there the endpoint is 10.78.1.1.
    let replay = run("router", "sim-replay", &arguments, "replay");

    // A client on the vehicle's host without keys, on the router's port.
    let mut unknown = hosts.command("vehicle", &programs().join("sim-replay"));
    unknown
        .args(["record", "--run=test", "--connect-timeout-s=2", "--out"])
        .arg(path("stolen.mcap"));
    unknown.arg(format!("--connect=tcp/{}:{PORT}", router_address(0)));
    let unknown = start(&mut unknown, &path("unknown.log")).end();
    assert!(!unknown.status.success(), "plain TCP is not taken");

    let log = |holder: &str| fs::read_to_string(path(&format!("{holder}.log"))).unwrap_or_default();
    let played = replay.end();
    assert!(
        played.status.success(),
        "{}{}",
        log("replay"),
        log("router")
    );
    let report: Value = serde_json::from_slice(&ego.end().stdout).unwrap();
    assert_eq!(
        (&report["frames"], &report["failed"]),
        (&TICKS.into(), &0.into()),
        "{}",
        log("ego-4279")
    );
    assert_eq!(
        report["fused"], TICKS,
        "every map of the other host was fused: {report}"
    );
    for agent in [far, near] {
        assert!(agent.end().status.success());
    }
    signal(router.0.id(), "TERM");
    assert!(router.end().status.success());
    // On a busy machine a client abandons a handshake, and begins another.
    let refused = log("router")
        .lines()
        .any(|line| line.contains("refused peer=") && !line.contains("unauthorised"));
    assert!(!refused, "{}", log("router"));
}
