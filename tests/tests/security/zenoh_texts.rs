//! Contract with the pinned zenoh version: the texts of its log and metrics from which a router's refusals are counted.
//!
//! Each failure is provoked exactly once and counted exactly once. When an update of zenoh, quinn or rustls changes one
//! of the texts, a count here is missing: see `handshakes.rs` and `refusals.rs` of the bus.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::Duration;

use bus::Bus;
use bus::BusOptions;
use bus::Credentials;
use bus::Endpoint;
use bus::Identity;
use deploy::operate::keys::KeyPlan;
use deploy::operate::keys::make;
use tests::bus::{free_port, wait_for};
use tests::fleet::{programs, signal};
use tests::keys::{keys_for, unauthorised_peer};
use tests::locks::exclusive_lock;
use zenoh::Wait;

/// Largest size of a datagram of QUIC, bytes.
const DATAGRAM_BYTES: usize = 65_536;

/// `v2vloc router` as a process: zenoh's log is counted per process.
struct RouterProcess {
    child: Child,
    endpoint: Endpoint,
    log: PathBuf,
}

impl RouterProcess {
    fn start(folder: &Path, keys: &Path) -> Self {
        let port = free_port();
        let endpoint = Endpoint::loopback(port).secured();
        let log = folder.join("router.log");
        let child = Command::new(programs().join("v2vloc"))
            .args([
                "router",
                "--run=test",
                &format!("--listen=quic/0.0.0.0:{port}"),
            ])
            .arg(format!("--keys={}", keys.join("router").display()))
            .stderr(File::create(&log).unwrap())
            .spawn()
            .unwrap();
        let router = Self {
            child,
            endpoint,
            log,
        };
        wait_for("a router", || router.log().contains("routing at"));
        router
    }

    fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    /// Last count of each refusal, by peer, reason and message.
    fn counts(&self) -> BTreeMap<String, u64> {
        let log = self.log();
        let count = |line: &str| {
            let (refusal, count) = line.split_once("peer=")?.1.rsplit_once(" count=")?;
            Some((
                refusal
                    .replace(" reason=", " ")
                    .replace(" what=", " ")
                    .replace('"', ""),
                count.parse().ok()?,
            ))
        };
        log.lines().filter_map(count).collect()
    }

    /// Ends the router, which reads its refusals once more; returns the counts.
    fn end(mut self) -> BTreeMap<String, u64> {
        signal(self.child.id(), "TERM");
        assert!(self.child.wait().unwrap().success(), "{}", self.log());
        self.counts()
    }
}

impl Drop for RouterProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Forwards the first datagram of a client to the router, and nothing back.
fn first_datagram_only(router: &Endpoint) -> Endpoint {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let relay = Endpoint::loopback(socket.local_addr().unwrap().port()).secured();
    let router = router.as_str().trim_start_matches("quic/").to_owned();
    std::thread::spawn(move || {
        let mut datagram = vec![0; DATAGRAM_BYTES];
        let (length, _) = socket.recv_from(&mut datagram).unwrap();
        socket.send_to(&datagram[..length], router).unwrap();
        std::thread::sleep(Duration::from_secs(60));
    });
    relay
}

#[test]
fn each_failed_handshake_is_counted_once_under_its_cause() {
    // A client without processor time abandons a handshake and counts under another cause.
    let _exclusive = exclusive_lock();
    programs();
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(&folder.path().join("ours"), &["agent-1"]);
    let theirs = keys_for(&folder.path().join("theirs"), &["agent-1"]).join("agent-1");
    let plan = KeyPlan::new(&keys, vec!["agent-3".parse().unwrap()], 1);
    make(&KeyPlan {
        lifetime: Duration::from_secs(1),
        ..plan
    })
    .unwrap();
    let (ours, expired) = (keys.join("agent-1"), keys.join("agent-3"));
    let router = RouterProcess::start(folder.path(), &keys);
    // Certificates count in whole seconds.
    std::thread::sleep(Duration::from_millis(2100));
    let relay = first_datagram_only(&router.endpoint);
    let elsewhere: Endpoint = router
        .endpoint
        .as_str()
        .replace("127.0.0.1", "127.0.0.2")
        .parse()
        .unwrap();
    for (endpoint, authority, own) in [
        (&router.endpoint, &ours, Some(expired.as_path())),
        (&router.endpoint, &ours, Some(theirs.as_path())),
        (&router.endpoint, &ours, None),
        // The client refuses the router, whose certificate is for other addresses.
        (&elsewhere, &ours, Some(ours.as_path())),
        // Last: zenoh takes one handshake after the other, and the incomplete one keeps it half a minute.
        (&relay, &ours, Some(ours.as_path())),
    ] {
        assert!(
            unauthorised_peer(endpoint, authority, own).is_err(),
            "{own:?} is admitted at {endpoint}"
        );
    }
    let causes = [
        "begun and not finished",
        "broken off by the other side",
        "certificate of another authority",
        "expired certificate",
        "no certificate",
    ];
    wait_for("five causes", || router.counts().len() >= causes.len());
    let expected = causes.map(|cause| (format!("unauthorised handshake {cause}"), 1));
    assert_eq!(router.end(), BTreeMap::from(expected));
}

#[test]
fn each_refused_message_is_counted_once_under_its_peer_and_reason() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(&folder.path().join("keys"), &["agent-1"]);
    let router = RouterProcess::start(folder.path(), &keys);
    let credentials = Credentials::read(&keys.join("agent-1")).unwrap();
    let options = BusOptions::client(router.endpoint.clone()).with_credentials(credentials);
    let identity = Identity {
        run: "test".parse().unwrap(),
        process: "agent-1".parse().unwrap(),
        cav: "1".parse().unwrap(),
    };
    let bus = Bus::join(&options, identity).unwrap();
    let session = bus.session();
    // Of another vehicle, and on its own key more than a pose ever has.
    session
        .put("v2v/test/2/pose", vec![7_u8; 64])
        .wait()
        .unwrap();
    session
        .put("v2v/test/1/pose", vec![7_u8; 1 << 20])
        .wait()
        .unwrap();
    session.delete("v2v/test/2/pose").wait().unwrap();
    let _queryable = session
        .declare_queryable("v2v/test/undeclared")
        .callback(|_| ())
        .wait()
        .unwrap();
    wait_for("four refusals", || router.counts().len() >= 4);
    let expected = [
        "access-control declare",
        "access-control delete",
        "access-control put",
        "low-pass put",
    ];
    assert_eq!(
        router.end(),
        BTreeMap::from(expected.map(|refusal| (format!("agent-1 {refusal}"), 1)))
    );
}
