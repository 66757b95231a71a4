//! Shared memory: the bytes of a fleet's large messages do not cross the loopback.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use tests::fleet::{programs, results, write_scenario};
use tests::hosts::Hosts;
use tests::locks::exclusive_lock;

/// Frames of a run.
const FRAMES: usize = 30;

/// Runs two vehicles at 10 Hz alone on a host, and returns the bytes on its loopback.
fn loopback_bytes(folder: &Path, network: &str) -> u64 {
    fs::create_dir(folder).unwrap();
    let hosts = Hosts::lay(&[]).expect("a network namespace");
    let scenario = write_scenario(folder, FRAMES, "rate: 1", network);
    let mut up = hosts.command("router", &programs().join("v2vloc"));
    up.arg("up")
        .arg(&scenario)
        .arg("--runs")
        .arg(folder.join("runs"))
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let code = up.status().unwrap().code();
    assert!(matches!(code, Some(0 | 3)), "{code:?}");
    assert!(results(&folder.join("runs/test")).len() > FRAMES / 2);
    let devices = hosts
        .command("router", Path::new("cat"))
        .arg("/proc/net/dev")
        .output()
        .unwrap();
    let devices = String::from_utf8_lossy(&devices.stdout).into_owned();
    let line = devices
        .lines()
        .find_map(|line| line.trim().strip_prefix("lo:"))
        .expect("a loopback");
    line.split_whitespace()
        .next()
        .and_then(|bytes| bytes.parse().ok())
        .expect("a count")
}

#[test]
#[ignore = "needs a network namespace"]
fn large_messages_do_not_cross_the_loopback() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let by_socket = loopback_bytes(&folder.path().join("socket"), "");
    let shared = loopback_bytes(
        &folder.path().join("shared"),
        "network: {shared_memory_mib: 32}",
    );
    eprintln!("{by_socket} bytes on the loopback, {shared} with shared memory");
    assert!(shared * 20 < by_socket, "{shared} of {by_socket} bytes");
}
