//! Fleet with keys among unknown clients and an attacker: each is refused, counted and named, and the boxes are those
//! of a run without them, box for box. The rows of the table in deploy/results/security.md about access control.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bus::{self, Bus, BusOptions, Credentials, Endpoint, Identity};
use deploy::operate::keys::{KeyPlan, make};
use serde_json::Value;
use tests::bus::free_port;
use tests::fleet::{Up, programs, results, write_scenario, write_sighted_weights};
use tests::keys::{TRIED_FOR, keys_for, unauthorised_peer};
use tests::locks::exclusive_lock;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

const TICKS: usize = 6;
/// Topics that an attacker with a certificate of the fleet tries; the certificate's own vehicle is 666.
const FORGED: [&str; 8] = [
    "4288/bev",
    "4279/bev",
    "*/bev",
    "**",
    "4279/detections",
    "rx/4279/4288/bev",
    "truth",
    "ready/ego-4279",
];

fn scenario(folder: &Path, rest: &str) -> PathBuf {
    fs::create_dir_all(folder).unwrap();
    let path = write_scenario(
        folder,
        TICKS,
        "lockstep: true, agents: [\"4279\", \"4288\"]",
        rest,
    );
    write_sighted_weights(&folder.join("weights.safetensors"));
    path
}

/// Results of a run that must not depend on other peers.
fn boxes(run: &Path) -> Vec<Value> {
    let of_interest = |result: &Value| {
        let fused: Vec<&Value> = result["fused"]
            .as_array()
            .unwrap()
            .iter()
            .map(|neighbour| &neighbour["cav"])
            .collect();
        serde_json::json!([result["capture_nanos"], result["detections"], fused])
    };
    results(run).iter().map(of_interest).collect()
}

/// Publishes on topics of others, repeatedly; messages that the network does not take at once are dropped.
fn forge(session: &Session, is_over: &AtomicBool) {
    let _other = session
        .liveliness()
        .declare_token("v2v/test/alive/agent/4288")
        .wait();
    let _answers = session
        .declare_queryable("v2v/test/undeclared")
        .callback(|_| ())
        .wait();
    while !is_over.load(Ordering::Relaxed) {
        for text in FORGED {
            let put = session.put(format!("v2v/test/{text}"), vec![7_u8; 4096]);
            let _ = put.congestion_control(CongestionControl::Drop).wait();
        }
        // Its own key, and far more than any message has.
        let large = session.put("v2v/test/666/pose", vec![0_u8; 1 << 20]);
        let _ = large.congestion_control(CongestionControl::Drop).wait();
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn attacker(endpoint: &Endpoint, keys: &Path) -> Bus {
    let credentials = Credentials::read(&keys.join("agent-666")).unwrap();
    let options = BusOptions::client(endpoint.clone()).with_credentials(credentials);
    let identity = Identity {
        run: "test".parse().unwrap(),
        process: "agent-4288".parse().unwrap(),
        cav: "4288".parse().unwrap(),
    };
    Bus::join(&options, identity).expect("it has a certificate")
}

/// Expired keys of the same authority.
fn expired_keys(keys: &Path) -> PathBuf {
    let plan = KeyPlan::new(keys, vec!["agent-667".parse().unwrap()], 1);
    make(&KeyPlan {
        lifetime: Duration::from_secs(1),
        ..plan
    })
    .unwrap();
    // Certificates count in whole seconds.
    std::thread::sleep(Duration::from_millis(2100));
    keys.join("agent-667")
}

/// Clients without a certificate that the fleet accepts: none is admitted.
fn unknown_clients(endpoint: &Endpoint, keys: &Path, expired: &Path, theirs: &Path) {
    let authority = keys.join("agent-4288");
    let ways = [
        ("another authority", Some(theirs)),
        ("expired", Some(expired)),
        ("no certificate", None),
    ];
    std::thread::scope(|scope| {
        for (what, own) in ways {
            let authority = &authority;
            scope.spawn(move || {
                assert!(
                    unauthorised_peer(endpoint, authority, own).is_err(),
                    "{what}"
                )
            });
        }
        let plain = endpoint.as_str().replace("quic/", "tcp/").parse().unwrap();
        let options = BusOptions {
            connect_timeout: TRIED_FOR,
            ..BusOptions::client(plain)
        };
        assert!(bus::open(&options).is_err(), "plain TCP");
    });
}

#[test]
fn unknown_clients_and_an_attacker_change_nothing() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    // With keys of its own, which are deleted afterwards.
    let calm = folder.path().join("calm");
    let mut up = Up::start(&calm, &scenario(&calm, "security: {}"));
    assert_eq!(up.wait().code(), Some(0));
    let expected = boxes(&up.folder);
    assert_eq!(expected.len(), TICKS);
    assert!(
        expected
            .iter()
            .all(|result| result[2] == serde_json::json!(["4288"])),
        "{expected:?}"
    );
    assert!(!up.folder.join("keys").exists());

    let keys = keys_for(
        &folder.path().join("keys"),
        &[
            "agent-4279",
            "agent-4288",
            "agent-666",
            "ego-4279",
            "replay",
            "scorer",
            "recorder",
            "viewer",
        ],
    );
    let expired = expired_keys(&keys);
    let theirs = keys_for(&folder.path().join("theirs"), &["agent-4288"]).join("agent-4288");
    let stormy = folder.path().join("stormy");
    let endpoint = Endpoint::loopback(free_port()).secured();
    let rest = format!(
        "security: {{keys: {}}}\nnetwork: {{listen: {}}}\nremote_agents: [\"4288\"]",
        keys.display(),
        endpoint.as_str()
    );
    let scenario = scenario(&stormy, &rest);
    let mut up = Up::start(&stormy, &scenario);
    let line = up.wait_for_line("run test at");
    assert!(
        line.contains(endpoint.as_str()),
        "with keys a router uses QUIC for any configured protocol: {line}"
    );

    let is_over = Arc::new(AtomicBool::new(false));
    let attacker = attacker(&endpoint, &keys);
    let forging = std::thread::spawn({
        let (session, is_over) = (attacker.session().clone(), Arc::clone(&is_over));
        move || forge(&session, &is_over)
    });
    unknown_clients(&endpoint, &keys, &expired, &theirs);
    // And once more while the fleet drives.
    let trying = std::thread::spawn({
        let (endpoint, keys) = (endpoint.clone(), keys.clone());
        move || unknown_clients(&endpoint, &keys, &expired, &theirs)
    });
    // The fleet has waited for its second vehicle, which is started elsewhere.
    let mut agent = Command::new(programs().join("agent"))
        .args(["run", "--cav=4288", "--run=test", "--pose-source=recorded"])
        .arg(format!("--connect={endpoint}"))
        .arg(format!("--keys={}", keys.join("agent-4288").display()))
        .arg(format!(
            "--weights={}",
            stormy.join("weights.safetensors").display()
        ))
        .spawn()
        .unwrap();
    let status = up.wait();
    is_over.store(true, Ordering::Relaxed);
    forging.join().unwrap();
    trying.join().unwrap();
    let came = agent.wait().unwrap();
    if !came.success() || status.code() != Some(0) {
        for process in ["replay", "agent-4279", "ego-4279"] {
            eprintln!(
                "{process}: {}",
                fs::read_to_string(up.folder.join(format!("log/{process}.log")))
                    .unwrap_or_default()
            );
        }
    }
    assert!(came.success());

    assert_eq!(boxes(&up.folder), expected, "box for box");
    let ledger: Value =
        serde_json::from_str(&fs::read_to_string(up.folder.join("ledger.json")).unwrap()).unwrap();
    assert_eq!(
        (status.code(), &ledger["balances"]),
        (Some(0), &true.into()),
        "{}",
        ledger["balance"]
    );
    let refused = ledger["refused"].as_array().unwrap();
    let count = |message: &str, reason: &str| -> u64 {
        let is_it = |line: &&Value| {
            line["peer"] == "agent-666" && line["message"] == message && line["reason"] == reason
        };
        refused
            .iter()
            .filter(is_it)
            .map(|line| line["count"].as_u64().unwrap())
            .sum()
    };
    assert!(
        count("put", "access-control") >= FORGED.len() as u64,
        "{refused:?}"
    );
    assert!(count("put", "low-pass") >= 1, "{refused:?}");
    assert!(count("declare", "access-control") >= 2, "{refused:?}");
    for cause in [
        "expired certificate",
        "certificate of another authority",
        "no certificate",
        "plain TCP",
    ] {
        let is_it = |line: &Value| {
            line["peer"] == "unauthorised"
                && line["reason"] == "handshake"
                && line["message"] == cause
        };
        assert!(refused.iter().any(is_it), "{cause}: {refused:?}");
    }
    let known = ["agent-666", "unauthorised"];
    assert!(
        refused
            .iter()
            .all(|line| known.contains(&line["peer"].as_str().unwrap())),
        "{refused:?}"
    );
    let modes = fs::read_to_string(up.folder.join("scenario.yaml")).unwrap();
    assert!(
        modes.contains("security"),
        "the run reports that it had keys"
    );
}
