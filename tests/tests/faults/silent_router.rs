//! Routers that pass no message without a panic: one that hangs, one that is stopped, one that is killed for a while,
//! and a run that is suspended. The gap ends, and terminal, status, report and ledger name the cause.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use tests::bus::free_port;
use tests::fleet::{Up, programs, results, signal, write_scenario};
use tests::locks::exclusive_lock;

/// A process that is killed when this is dropped.
struct Helper(Child);

impl Drop for Helper {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Holds the threads of zenoh in a process, and no others, until it is dropped: to the rest of the process and to its
/// peers that is a router whose threads wait for each other.
fn hang_router_threads(pid: u32) -> Helper {
    const HOLD: &str = "
import ctypes, os, sys, time
ptrace = ctypes.CDLL(None, use_errno=True).ptrace
tasks = f'/proc/{sys.argv[1]}/task'
held = 0
for task in os.listdir(tasks):
    name = open(f'{tasks}/{task}/comm').read()
    if name.startswith(('acc-', 'app-', 'net-', 'rx-', 'tx-')):
        for request in 0x4206, 0x4207:  # PTRACE_SEIZE, PTRACE_INTERRUPT
            if ptrace(request, int(task), None, None) != 0:
                sys.exit(os.strerror(ctypes.get_errno()))
        held += 1
assert held >= 5, held
time.sleep(600)
";
    let mut python = Command::new("python3");
    let child = python.args(["-c", HOLD, &pid.to_string()]).spawn().unwrap();
    Helper(child)
}

fn router(port: u16) -> Helper {
    let mut router = Command::new(programs().join("v2vloc"));
    let listen = format!("tcp/127.0.0.1:{port}");
    let child = router.args(["router", "--listen", &listen]).spawn();
    let child = Helper(child.unwrap());
    let deadline = Instant::now() + Duration::from_secs(20);
    while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
        assert!(Instant::now() < deadline, "the router does not listen");
        thread::sleep(Duration::from_millis(50));
    }
    child
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// Output of `v2vloc` on a run.
fn v2vloc(command: &str, run: &Path) -> String {
    let mut v2vloc = Command::new(programs().join("v2vloc"));
    let output = v2vloc.arg(command).arg(run).output().unwrap();
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Seconds in `... for 4.0 s`.
fn seconds(cause: &str) -> f64 {
    let (_, rest) = cause.split_once(" for ").unwrap();
    rest.split(' ').next().unwrap().parse().unwrap()
}

/// The cause in all files of a run that has ended.
fn written_cause(run: &Path) -> String {
    assert!(run.join("metrics.json").is_file() && run.join("scenario.yaml").is_file());
    let of = |file: &str| json(&run.join(file))["causes"][0].clone();
    let cause = of("ledger.json");
    assert_eq!(
        [of("report.json"), of("status.json")],
        [cause.clone(), cause.clone()]
    );
    let cause = cause.as_str().unwrap().to_owned();
    assert!(v2vloc("report", run).contains(&format!("observed  {cause}\n")));
    cause
}

/// Spoils the router of a run, which has to replace it and to go on; `why` is in the line about its end.
pub(super) fn assert_replaced(why: &str, spoil: impl FnOnce(&mut Up)) {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 3, "loop: true", "");
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("some results", |results| results.len() > 5);
    let began = Instant::now();
    spoil(&mut up);
    let line = up.wait_for_line("; starting it again");
    assert!(line.contains(why), "{line}");
    let line = up.wait_for_line("the router is back after");
    assert!(began.elapsed() < Duration::from_secs(7), "{line}");
    let before = results(&up.folder).len();
    up.wait_for_results("results after it", |results| results.len() > before + 5);
    signal(up.pid(), "INT");
    let line = up.wait_for_line("exit 3: ");
    assert!(
        line.contains("router gone for") && !line.contains("answer more"),
        "{line}"
    );
    assert_eq!(up.wait().code(), Some(3));
    let ledger = json(&up.folder.join("ledger.json"));
    assert!(ledger["balances"] == true, "{}", ledger["balance"]);
    written_cause(&up.folder);
    let status = json(&up.folder.join("status.json"));
    let router = status["processes"]
        .as_array()
        .unwrap()
        .iter()
        .find(|process| process["name"] == "router")
        .unwrap();
    assert!(
        router["restarts"] == 1 && router["state"] == "ended",
        "{router}"
    );
    let report = json(&up.folder.join("report.json"));
    let processes = report["processes"].as_array().unwrap();
    let router = processes.iter().find(|one| one["process"] == "router");
    assert!(router.unwrap()["cpu_s"].as_f64() > Some(0.0), "{report}");
}

#[test]
fn a_run_replaces_a_router_that_hangs() {
    assert_replaced("router ", |up| {
        let hung = hang_router_threads(up.pids()["router"]);
        up.wait_for_line("the router is gone");
        thread::sleep(Duration::from_secs(1));
        // The kernel keeps the process until the threads that are held can end.
        drop(hung);
    });
}

#[test]
fn a_run_replaces_a_router_that_is_stopped_or_killed() {
    assert_replaced("router nothing came through it for 2.", |up| {
        signal(up.pids()["router"], "STOP");
    });
    assert_replaced("router was ended by signal 9", |up| {
        signal(up.pids()["router"], "KILL");
    });
}

#[test]
fn a_router_that_hangs_ends_for_its_supervisor() {
    let _exclusive = exclusive_lock();
    let (port, began) = (free_port(), Instant::now());
    let mut router = Command::new(programs().join("v2vloc"));
    let listen = format!("tcp/127.0.0.1:{port}");
    router
        .args(["router", "--listen", &listen])
        .stderr(Stdio::piped());
    let mut router = Helper(router.spawn().unwrap());
    // It goes on for as long as it routes.
    thread::sleep(Duration::from_secs(4));
    assert!(router.0.try_wait().unwrap().is_none());
    let hung = hang_router_threads(router.0.id());
    thread::sleep(Duration::from_secs(4));
    drop(hung);
    let mut text = String::new();
    std::io::Read::read_to_string(&mut router.0.stderr.take().unwrap(), &mut text).unwrap();
    assert_eq!(router.0.wait().unwrap().code(), Some(1), "{text}");
    assert!(
        text.contains("the router failed and ends: nothing came through it"),
        "{text}"
    );
    assert!(began.elapsed() < Duration::from_secs(20));
}

#[test]
fn an_outage_of_a_router_elsewhere_is_the_cause_of_the_gap() {
    let _exclusive = exclusive_lock();
    for is_killed in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let port = free_port();
        let connect = format!("network: {{connect: tcp/127.0.0.1:{port}}}\nrecord: {{}}");
        let mut first = router(port);
        let scenario = write_scenario(folder.path(), 3, "loop: true, rate: 0.5", &connect);
        let mut up = Up::start(folder.path(), &scenario);
        up.wait_for_results("some results", |results| results.len() > 5);
        let second = if is_killed {
            first.0.kill().unwrap();
            first.0.wait().unwrap();
            up.wait_for_line("the router is gone");
            thread::sleep(Duration::from_secs(4));
            Some(router(port))
        } else {
            signal(first.0.id(), "STOP");
            up.wait_for_line("the router is gone");
            // The status is written twice a second.
            thread::sleep(Duration::from_secs(1));
            let status = v2vloc("status", &up.folder);
            assert!(status.contains("is not well: router gone for "), "{status}");
            thread::sleep(Duration::from_secs(1));
            signal(first.0.id(), "CONT");
            None
        };
        let line = up.wait_for_line("the router is back after");
        let before = results(&up.folder).len();
        up.wait_for_results("the run going on", |results| results.len() > before + 3);
        let status = v2vloc("status", &up.folder);
        assert!(
            status.contains("\nobserved: router gone for "),
            "{line}: {status}"
        );
        signal(up.pid(), "INT");
        let exit = up.wait_for_line("exit 3: ");
        assert!(
            exit.contains("router gone for ") && !exit.contains("answer more"),
            "{exit}"
        );
        assert!(!exit.contains("too slow"), "{exit}");
        assert_eq!(up.wait().code(), Some(3));
        let cause = written_cause(&up.folder);
        assert!(
            cause.starts_with("router gone for ") && (3.5..7.0).contains(&seconds(&cause)),
            "{cause}"
        );
        let ledger = json(&up.folder.join("ledger.json"));
        assert!(ledger["balances"] == true, "{}", ledger["balance"]);
        drop(second);
    }
}

#[test]
fn a_suspended_run_reports_the_pause_and_scores_what_was_sent_meanwhile() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 3, "loop: true, rate: 0.5", "");
    let mut up = Up::start(folder.path(), &scenario);
    up.wait_for_results("some results", |results| results.len() > 5);
    signal(up.pid(), "STOP");
    thread::sleep(Duration::from_secs(6));
    let status = v2vloc("status", &up.folder);
    assert!(
        status.contains("is not well: the run is suspended for "),
        "{status}"
    );
    signal(up.pid(), "CONT");
    up.wait_for_line("the run was suspended for ");
    // Five results a second, which the scorer reads afterwards.
    up.wait_for_results("those of the pause", |results| results.len() > 5 + 25);
    signal(up.pid(), "INT");
    let code = up.wait().code();
    assert!(matches!(code, Some(0 | 3)), "{code:?}");
    let cause = written_cause(&up.folder);
    assert!((5.0..9.0).contains(&seconds(&cause)), "{cause}");
    let ledger = json(&up.folder.join("ledger.json"));
    assert!(ledger["balances"] == true, "{}", ledger["balance"]);
}
