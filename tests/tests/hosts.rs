//! A fleet on three hosts over QUIC: a router, a vehicle and an ego, each in a network namespace with a cable to the router.
//! What `deploy/hosts.md` tells to type is what runs here.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tests::fleet::{alone, programs, signal, write_weights};
use tests::hosts::{Hosts, router_address};

const TICKS: usize = 8;
const PORT: u16 = 7447;
/// Longer than anything takes here, under whatever load.
const PATIENCE: Duration = Duration::from_secs(120);

/// A process on one of the hosts; killed where it is left behind.
struct Running(Child);

impl Running {
    fn end(mut self) -> Output {
        let deadline = Instant::now() + PATIENCE;
        while self.0.try_wait().expect("a child").is_none() {
            assert!(Instant::now() < deadline, "a process does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut output = Output { status: self.0.wait().expect("a child"), stdout: Vec::new(), stderr: Vec::new() };
        use std::io::Read;
        self.0.stdout.take().expect("a pipe").read_to_end(&mut output.stdout).expect("its output");
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
    Running(command.stdout(Stdio::piped()).stderr(log).spawn().expect("ip runs"))
}

#[test]
fn a_fleet_spans_three_hosts_over_quic() {
    let _alone = alone();
    let hosts = match Hosts::lay(&["vehicle", "ego"]) {
        Ok(hosts) => hosts,
        Err(error) => return eprintln!("SKIPPED: no network namespaces here: {error}"),
    };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    tests::scene::write(folder.path(), &["4279", "4288"], TICKS);
    write_weights(&path("weights.safetensors"));
    let addresses = [0, 1].map(|index| router_address(index).to_string()).join(",");
    let keys = path("keys");
    let made = Command::new(programs().join("v2vloc"))
        .args(["keys", "--agents=4279,4288", "--egos=4279", "--days=1"])
        .arg(format!("--hosts={addresses}"))
        .arg(format!("--out={}", keys.display()))
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));

    let run = |host: &str, program: &str, words: &[&str], holder: &str| {
        let mut command = hosts.command(host, &programs().join(program));
        command.args(words).arg(format!("--keys={}", keys.join(holder).display()));
        if program != "v2vloc" {
            let index = usize::from(host == "ego");
            command.args(["--run=test".to_owned(), format!("--connect=quic/{}:{PORT}", router_address(index))]);
            command.arg("--connect-timeout=60");
        }
        start(&mut command, &path(&format!("{holder}.log")))
    };
    let weights = format!("--weights={}", path("weights.safetensors").display());
    let router = run("router", "v2vloc", &["router", &format!("--listen=quic/0.0.0.0:{PORT}")], "router");
    let far = run("vehicle", "agent", &["run", "--cav=4288", &weights], "agent-4288");
    let near = run("ego", "agent", &["run", "--cav=4279", &weights], "agent-4279");
    let words = ["run", "--ego=4279", "--method=max", "--deadline-ms=60000", "--json", &weights];
    let ego = run("ego", "ego-fuser", &words, "ego-4279");
    let scene = path("scene");
    let words = [
        "stream",
        scene.to_str().unwrap(),
        "--lockstep=4279",
        "--expect=4288/bev>ego-4279",
        "--expect=4279/bev>ego-4279",
        "--json",
    ];
    // The scene lies with the router; from there it is 10.78.1.1 that it goes to.
    let replay = run("router", "sim-replay", &words, "replay");

    // Somebody on the vehicle's host without keys, on the router's port.
    let mut stranger = hosts.command("vehicle", &programs().join("sim-replay"));
    stranger.args(["record", "--run=test", "--connect-timeout=2", "--out"]).arg(path("stolen.mcap"));
    stranger.arg(format!("--connect=tcp/{}:{PORT}", router_address(0)));
    let stranger = start(&mut stranger, &path("stranger.log")).end();
    assert!(!stranger.status.success(), "plain TCP is not taken");

    let log = |holder: &str| fs::read_to_string(path(&format!("{holder}.log"))).unwrap_or_default();
    let played = replay.end();
    assert!(played.status.success(), "{}{}", log("replay"), log("router"));
    let report: Value = serde_json::from_slice(&ego.end().stdout).unwrap();
    assert_eq!((&report["frames"], &report["failed"]), (&TICKS.into(), &0.into()), "{}", log("ego-4279"));
    assert_eq!(report["fused"], TICKS, "every map of the other host was fused: {report}");
    for agent in [far, near] {
        assert!(agent.end().status.success());
    }
    signal(router.0.id(), "TERM");
    assert!(router.end().status.success());
    // On a busy machine a client gives up a handshake, and begins another.
    let refused = log("router").lines().any(|line| line.contains("refused peer=") && !line.contains("stranger"));
    assert!(!refused, "{}", log("router"));
}

/// The words of every command line in the files that start processes, program and subcommand first.
fn commands(folder: &Path) -> Vec<(String, Vec<String>)> {
    let mut commands = Vec::new();
    for entry in fs::read_dir(folder.join("systemd")).unwrap() {
        let text = fs::read_to_string(entry.unwrap().path()).unwrap();
        for line in text.lines().filter_map(|line| line.strip_prefix("ExecStart=/opt/v2vloc/bin/")) {
            let words: Vec<String> = line.split(' ').map(str::to_owned).collect();
            commands.push((words[0].clone(), words[1..].to_vec()));
        }
    }
    let compose = fs::read_to_string(folder.join("compose/compose.yaml")).unwrap();
    let programs = ["v2vloc", "agent", "ego-fuser", "sim-replay"];
    for line in compose.lines().map(|line| line.trim().trim_start_matches("- ").trim_matches('"')) {
        if let Some(list) = line.strip_prefix("command: [") {
            let words: Vec<String> =
                list.trim_end_matches(']').split(", ").map(|word| word.trim_matches('"').into()).collect();
            commands.push((words[0].clone(), words[1..].to_vec()));
        } else if programs.contains(&line) {
            commands.push((line.to_owned(), Vec::new()));
        } else if let Some((_, words)) = commands.last_mut()
            && (line.starts_with("--") || (words.is_empty() && !line.contains(':')))
        {
            words.push(line.to_owned());
        }
    }
    commands
}

#[test]
fn keys_that_are_not_there_are_named_and_not_tried_again() {
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new(programs().join("sim-replay"))
        .args(["record", "--run=test", "--connect=quic/127.0.0.1:1"])
        .arg(format!("--keys={}", folder.path().display()))
        .arg(format!("--out={}", folder.path().join("recording.mcap").display()))
        .output()
        .unwrap();
    // The code with which the units do not start a process again.
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("ca.pem"), "{output:?}");
}

#[test]
fn units_and_containers_start_what_there_is() {
    let commands = commands(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy"));
    assert_eq!(commands.len(), 8, "{commands:?}");
    for (program, words) in commands {
        let output = Command::new(programs().join(&program)).args([&words[0], "--help"]).output().unwrap();
        let help = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{program} {}", words[0]);
        for name in words.iter().filter_map(|word| word.strip_prefix("--")).map(|word| word.split('=').next().unwrap())
        {
            assert!(
                help.contains(&format!("--{name} ")) || help.contains(&format!("--{name}\n")),
                "{program} {}: --{name}",
                words[0]
            );
        }
    }
}
