//! Router that a client's invalid key poisons: it ends with a word, and its run goes on with a new one.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use tests::bus::free_port;
use tests::fleet::{Up, programs};
use tests::locks::exclusive_lock;
use zenoh::Wait;

use crate::silent_router::assert_replaced;

/// Part of a key, and what it becomes on the way: invalid, of the same length.
const REPLACED: [&[u8]; 2] = [b"AAAA", b"*\"QQ"];

/// Copies a connection one way; to the router the key is replaced.
fn copy(mut from: TcpStream, mut to: TcpStream, replaces: bool) {
    let mut buffer = [0; 1 << 16];
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        let bytes = &mut buffer[..length];
        let places = bytes
            .windows(4)
            .enumerate()
            .filter(|(_, part)| replaces && *part == REPLACED[0]);
        for place in places.map(|(place, _)| place).collect::<Vec<_>>() {
            bytes[place..place + 4].copy_from_slice(REPLACED[1]);
        }
        if to.write_all(bytes).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Both);
}

/// Address of a proxy in front of a router.
fn proxy(router: SocketAddr) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        let (client, _) = listener.accept().unwrap();
        let server = TcpStream::connect(router).unwrap();
        let (from, to) = (server.try_clone().unwrap(), client.try_clone().unwrap());
        thread::spawn(move || copy(from, to, false));
        copy(client, server, true);
    });
    address
}

/// Declares an invalid key, and a subscription that it is matched with.
fn poison(router: SocketAddr) {
    let mut config = zenoh::Config::default();
    let endpoint = format!("[\"tcp/{}\"]", proxy(router));
    for (field, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", &endpoint),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(field, value).unwrap();
    }
    let session = zenoh::open(config).wait().unwrap();
    for key in ["v2v/AAAA", "v2v/**"] {
        let subscriber = session.declare_subscriber(key).callback(|_| ()).wait();
        std::mem::forget(subscriber.unwrap());
        thread::sleep(Duration::from_millis(300));
    }
    // Nobody is left who would answer its end.
    std::mem::forget(session);
}

/// Address of the router of a run.
fn router_of(up: &mut Up) -> SocketAddr {
    let line = up.wait_for_line("run test at tcp/");
    let (_, address) = line.split_once("tcp/").unwrap();
    let (address, _) = address.split_once(": ").unwrap();
    address.parse().unwrap()
}

#[test]
fn a_run_replaces_a_router_that_is_poisoned() {
    assert_replaced("router ended with code 1", |up| poison(router_of(up)));
}

#[test]
fn a_router_that_is_poisoned_ends_for_its_supervisor() {
    let _exclusive = exclusive_lock();
    let address: SocketAddr = ([127, 0, 0, 1], free_port()).into();
    let mut router = Command::new(programs().join("v2vloc"))
        .args(["router", "--listen", &format!("tcp/{address}")])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let deadline = Instant::now() + Duration::from_secs(20);
    while TcpStream::connect(address).is_err() {
        assert!(Instant::now() < deadline, "the router does not listen");
        thread::sleep(Duration::from_millis(50));
    }
    poison(address);
    let status = loop {
        if let Some(status) = router.try_wait().unwrap() {
            break status;
        }
        if Instant::now() > deadline {
            router.kill().unwrap();
            panic!("the router goes on without routing");
        }
        thread::sleep(Duration::from_millis(50));
    };
    let mut text = String::new();
    router.stderr.unwrap().read_to_string(&mut text).unwrap();
    assert_eq!(status.code(), Some(1), "{text}");
    assert!(text.contains("the router failed and ends"), "{text}");
}
