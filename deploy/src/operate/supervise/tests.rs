//! Tests of the supervisor with shells as processes.

use std::sync::mpsc::{Receiver, channel};

use rustix::process::{Pid, Signal, kill_process};

use super::watcher::FIRST_PAUSE;
use super::*;

const TIMEOUT: Duration = Duration::from_secs(20);

fn shell(name: &str, life: RestartPolicy, script: &str) -> ProcessSpec {
    let args = vec!["-c".into(), script.into()];
    ProcessSpec {
        name: name.into(),
        program: "/bin/sh".into(),
        args,
        life,
        metrics: None,
    }
}

fn start(
    spec: ProcessSpec,
    restarts: u32,
) -> (Supervisor, Receiver<ProcessEvent>, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let (events, received) = channel();
    (
        Supervisor::start(vec![spec], folder.path(), restarts, &events).unwrap(),
        received,
        folder,
    )
}

fn next(events: &Receiver<ProcessEvent>) -> ProcessEventKind {
    events.recv_timeout(TIMEOUT).unwrap().what
}

#[test]
fn who_ends_well_is_done() {
    let (supervisor, events, folder) =
        start(shell("job", RestartPolicy::Task, "echo hello; exit 3"), 3);
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert_eq!(
        next(&events),
        ProcessEventKind::Logged {
            line: "hello".into()
        }
    );
    assert_eq!(next(&events), ProcessEventKind::Done { data_lost: true });
    assert_eq!(
        std::fs::read_to_string(folder.path().join("job.log")).unwrap(),
        "hello\n"
    );
    assert!(supervisor.stop(TIMEOUT).is_empty());
}

#[test]
fn a_killed_service_is_started_again() {
    let (supervisor, events, _folder) =
        start(shell("car", RestartPolicy::Service, "exec sleep 600"), 3);
    let ProcessEventKind::Started { pid: first } = next(&events) else {
        panic!("not started")
    };
    kill_process(Pid::from_raw(first as i32).unwrap(), Signal::KILL).unwrap();
    let ProcessEventKind::Crashed {
        how,
        again_after,
        restart,
    } = next(&events)
    else {
        panic!("not crashed")
    };
    assert_eq!(
        (how.as_str(), again_after, restart),
        ("was ended by signal 9", FIRST_PAUSE, 1)
    );
    let ProcessEventKind::Started { pid: second } = next(&events) else {
        panic!("not restarted")
    };
    assert_ne!(first, second);
    assert!(supervisor.stop(TIMEOUT).is_empty(), "sleep ends on SIGTERM");
    assert_eq!(next(&events), ProcessEventKind::Done { data_lost: false });
}

#[test]
fn a_requested_end_is_reported_with_the_last_line() {
    for (code, ended) in [
        (0, ProcessEventKind::Done { data_lost: false }),
        (3, ProcessEventKind::Done { data_lost: true }),
        (
            1,
            ProcessEventKind::Failed {
                how: "ended with code 1".into(),
            },
        ),
    ] {
        let script = format!(
            "trap 'echo 7 missing; exit {code}' TERM; echo up; while :; do sleep 0.05; done"
        );
        let (supervisor, events, _folder) =
            start(shell("recorder", RestartPolicy::Optional, &script), 3);
        assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
        assert_eq!(
            next(&events),
            ProcessEventKind::Logged { line: "up".into() }
        );
        assert!(supervisor.stop(TIMEOUT).is_empty());
        assert_eq!(
            next(&events),
            ProcessEventKind::Logged {
                line: "7 missing".into()
            }
        );
        assert_eq!(next(&events), ended);
    }
}

#[test]
fn a_service_that_keeps_crashing_is_given_up_with_its_last_line() {
    let (_supervisor, events, _folder) = start(
        shell("car", RestartPolicy::Service, "echo no engine >&2; exit 1"),
        1,
    );
    let happenings: Vec<_> = (0..4).map(|_| next(&events)).collect();
    assert!(
        matches!(&happenings[1], ProcessEventKind::Crashed { again_after, .. } if *again_after == FIRST_PAUSE)
    );
    assert_eq!(
        happenings[3],
        ProcessEventKind::GaveUp {
            how: "ended with code 1: no engine".into(),
            is_optional: false
        }
    );
}

#[test]
fn the_parent_death_pipe_is_open_as_long_as_the_supervisor_runs() {
    let (supervisor, events, folder) = start(
        shell("car", RestartPolicy::Service, "echo up; cat; echo cut off"),
        3,
    );
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    let log = folder.path().join("car.log");
    let began = Instant::now();
    while std::fs::read_to_string(&log).unwrap().is_empty() && began.elapsed() < TIMEOUT {
        std::thread::yield_now();
    }
    assert_eq!(
        next(&events),
        ProcessEventKind::Logged { line: "up".into() }
    );
    // Its input does not end, so it does not end either.
    assert!(events.recv_timeout(Duration::from_millis(200)).is_err());
    drop(supervisor.stop(TIMEOUT));
    assert_eq!(std::fs::read_to_string(&log).unwrap(), "up\n");
}

#[test]
fn bad_input_is_not_tried_again() {
    let (_supervisor, events, _folder) = start(
        shell(
            "car",
            RestartPolicy::Service,
            "echo error: bad map >&2; exit 2",
        ),
        5,
    );
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert_eq!(
        next(&events),
        ProcessEventKind::GaveUp {
            how: "ended with code 2: bad map".into(),
            is_optional: false
        }
    );
}

#[test]
fn a_process_that_ignores_the_request_is_killed_at_the_deadline() {
    let (supervisor, events, folder) = start(
        shell(
            "stubborn",
            RestartPolicy::Service,
            "trap '' TERM; echo up; while :; do sleep 0.05; done",
        ),
        3,
    );
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    let log = folder.path().join("stubborn.log");
    let began = Instant::now();
    while std::fs::read_to_string(&log).unwrap().is_empty() && began.elapsed() < TIMEOUT {
        std::thread::yield_now();
    }
    let asked = Instant::now();
    assert_eq!(supervisor.stop(Duration::from_millis(300)), ["stubborn"]);
    assert!(
        asked.elapsed() < Duration::from_secs(4),
        "{:?}",
        asked.elapsed()
    );
}

#[test]
fn a_missing_program_is_named() {
    let (events, _received) = channel();
    let spec = ProcessSpec {
        program: "/nowhere/agent".into(),
        ..shell("agent", RestartPolicy::Service, "")
    };
    let folder = tempfile::tempdir().unwrap();
    let error = Supervisor::start(vec![spec], folder.path(), 0, &events)
        .err()
        .unwrap();
    assert!(
        error.to_string().starts_with("/nowhere/agent is missing"),
        "{error}"
    );
}

#[test]
fn a_hung_process_is_killed_and_restarted_even_if_stopped() {
    let (supervisor, events, _folder) =
        start(shell("car", RestartPolicy::Service, "exec sleep 600"), 3);
    let ProcessEventKind::Started { pid: first } = next(&events) else {
        panic!("not started")
    };
    kill_process(Pid::from_raw(first as i32).unwrap(), Signal::STOP).unwrap();
    supervisor.replace("unknown", "does not exist");
    supervisor.replace("car", "has not reported for 5 s");
    let ProcessEventKind::Crashed { how, .. } = next(&events) else {
        panic!("not crashed")
    };
    assert_eq!(how, "has not reported for 5 s");
    let ProcessEventKind::Started { pid: second } = next(&events) else {
        panic!("not restarted")
    };
    assert_ne!(first, second);
    kill_process(Pid::from_raw(second as i32).unwrap(), Signal::STOP).unwrap();
    assert!(
        supervisor.stop(TIMEOUT).is_empty(),
        "a stopped process is continued to end"
    );
}

#[test]
fn a_service_that_ends_well_but_too_early_is_started_again() {
    let (_supervisor, events, _folder) = start(shell("car", RestartPolicy::Service, "exit 0"), 1);
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert!(
        matches!(next(&events), ProcessEventKind::Crashed { how, .. } if how.contains("without a request"))
    );
}

#[test]
fn a_task_that_is_struck_down_takes_up_its_job_and_one_that_cannot_do_it_stays_down() {
    let (supervisor, events, _folder) =
        start(shell("replay", RestartPolicy::Task, "exec sleep 600"), 3);
    let ProcessEventKind::Started { pid } = next(&events) else {
        panic!("not started")
    };
    kill_process(Pid::from_raw(pid as i32).unwrap(), Signal::KILL).unwrap();
    assert!(matches!(
        next(&events),
        ProcessEventKind::Crashed { restart: 1, .. }
    ));
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert!(supervisor.stop(TIMEOUT).is_empty());

    let (_supervisor, events, _folder) = start(
        shell("replay", RestartPolicy::Task, "echo no scene >&2; exit 1"),
        3,
    );
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert_eq!(
        next(&events),
        ProcessEventKind::GaveUp {
            how: "ended with code 1: no scene".into(),
            is_optional: false
        }
    );
}

#[test]
fn who_cannot_take_up_its_job_stays_down() {
    let (_supervisor, events, _folder) = start(
        shell("recorder", RestartPolicy::Optional, "kill -KILL $$"),
        3,
    );
    assert!(matches!(next(&events), ProcessEventKind::Started { .. }));
    assert!(matches!(
        next(&events),
        ProcessEventKind::GaveUp {
            is_optional: true,
            ..
        }
    ));
}
