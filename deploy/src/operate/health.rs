//! State of each process during a run: running, ready, silent or hung.
//!
//! Every process publishes its message counters twice a second ([`protocol::Stats`]). After the first report it is
//! ready; one that is silent for longer than the scenario allows is hung, and is replaced.

use std::collections::BTreeMap;
use std::fs;
use std::mem;
use std::time::{Duration, Instant};

use bus::ROUTER;
use serde::{Deserialize, Serialize};

use crate::operate::router_watch::TimeSum;
use crate::operate::supervise::{ProcessEvent, ProcessEventKind};
use crate::score::{Progress, SCORER};

/// Time without a report after which a process is shown as silent.
const SILENT: Duration = Duration::from_millis(1500);
/// A gap of this length in the own loop means that this program, or the whole machine, was stopped; it is no evidence
/// about the other processes.
const OWN_PAUSE: Duration = Duration::from_secs(1);

/// State of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Running, no report yet.
    #[default]
    Starting,
    /// Has joined the run and reports regularly.
    Ready,
    /// Reports regularly, but has failed in its task.
    Failing,
    /// Running, but without a report for a while.
    Silent,
    /// Crashed, about to be restarted.
    Crashed,
    /// Ended as expected.
    Ended,
    /// Crashed and not restarted.
    Down,
}

/// Status of a process.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ProcessStatus {
    /// Name in messages, and of its log.
    pub name: String,
    /// State.
    pub state: State,
    /// Process id, while it runs.
    pub pid: Option<u32>,
    /// Time since the last start, seconds.
    pub up_s: f64,
    /// Number of restarts.
    pub restarts: u32,
    /// Description of its last crash.
    pub last_exit: Option<String>,
    /// Description of its failure, for a process that has failed in its task.
    pub failure: Option<String>,
    /// Problems that it reports while it runs.
    #[serde(default)]
    pub problems: Vec<String>,
    /// Time since its last report, seconds.
    pub silent_s: Option<f64>,
    /// Resources, while it runs.
    #[serde(flatten)]
    pub usage: Usage,
}

/// Record of one process.
#[derive(Debug)]
struct Noted {
    /// State, restarts and failure from its events; usage and times are added when a status is reported.
    status: ProcessStatus,
    started: Instant,
    /// Last report since this start.
    last_report: Option<Instant>,
    /// Silence so far of a process that is or was suspended, until its next report.
    silence: Option<Duration>,
    /// Those that are over.
    silences: TimeSum,
}

impl Noted {
    /// Takes the time since the last report. One that computes a frame for long is silent too, so only the silence of a
    /// suspended process counts.
    fn note_silence(&mut self, since: Duration) {
        let usage = || self.status.pid.and_then(Usage::of);
        if self.status.state != State::Silent {
            self.silences.add(self.silence.take());
        } else if self.silence.is_some() || usage().is_some_and(|usage| usage.is_stopped) {
            self.silence = Some(since);
        }
    }
}

/// Monitors the processes of a run.
#[derive(Debug)]
pub(crate) struct Health {
    processes: BTreeMap<String, Noted>,
    /// Longest silence of a ready process.
    hang: Duration,
    /// Longest silence after a start.
    start: Duration,
    looked: Instant,
    router_was_gone: bool,
}

impl Health {
    /// No process yet. One that is silent for `hang`, or for `start` after it was started, is to be replaced.
    pub(crate) fn new(hang: Duration, start: Duration) -> Self {
        Self {
            processes: BTreeMap::new(),
            hang,
            start,
            looked: Instant::now(),
            router_was_gone: false,
        }
    }

    /// Records an event of a process.
    pub(crate) fn note(&mut self, event: &ProcessEvent, now: Instant) {
        let noted = self.processes.entry(event.name.clone());
        let noted = noted.or_insert_with(|| Noted {
            status: ProcessStatus {
                name: event.name.clone(),
                ..ProcessStatus::default()
            },
            started: now,
            last_report: None,
            silence: None,
            silences: TimeSum::default(),
        });
        let status = &mut noted.status;
        match &event.what {
            ProcessEventKind::Started { pid } => {
                (status.state, status.pid) = (State::Starting, Some(*pid));
                (noted.started, noted.last_report, noted.silence) = (now, None, None);
            }
            ProcessEventKind::Crashed { how, restart, .. } => {
                (status.state, status.pid, status.restarts) = (State::Crashed, None, *restart);
                status.last_exit = Some(how.clone());
            }
            ProcessEventKind::Logged { .. } => {}
            ProcessEventKind::GaveUp { how, .. } | ProcessEventKind::Failed { how } => {
                (status.state, status.pid) = (State::Down, None);
                status.last_exit = Some(how.clone());
            }
            ProcessEventKind::Done { .. } => (status.state, status.pid) = (State::Ended, None),
        }
    }

    /// Records the failure of a process.
    pub(crate) fn fails(&mut self, name: &str, text: &str) {
        if let Some(noted) = self.processes.get_mut(name) {
            noted.status.failure = Some(text.to_owned());
        }
    }

    /// Updates the states from the times of the last reports, which do not arrive while the router is gone; returns the
    /// hung processes, each with a description.
    pub(crate) fn look(
        &mut self,
        last_reports: &BTreeMap<String, Instant>,
        router_is_gone: bool,
        now: Instant,
    ) -> Vec<(String, String)> {
        let is_back = mem::replace(&mut self.router_was_gone, router_is_gone) && !router_is_gone;
        let was_stopped = is_back || now.saturating_duration_since(self.looked) > OWN_PAUSE;
        self.looked = now;
        // Without a report of any other process the network is down, and no process counts as hung. Its own reports this
        // program receives without a router too.
        let mut others = last_reports.iter().filter(|(name, _)| *name != SCORER);
        let network_is_up = !router_is_gone
            && (others.clone().next().is_none()
                || others.any(|(_, at)| now.saturating_duration_since(*at) <= SILENT));
        let mut hanging = Vec::new();
        for (name, noted) in &mut self.processes {
            if noted.status.pid.is_none() {
                continue;
            }
            // The last reports of the previous process instance may arrive after its end.
            let last = last_reports.get(name).copied();
            let last = last.filter(|at| *at > noted.started + SILENT / 3);
            noted.last_report = noted.last_report.max(last);
            if was_stopped {
                // Reports of that time were not received.
                noted.started = noted.started.max(now.checked_sub(SILENT).unwrap_or(now));
                noted.last_report = noted.last_report.map(|_| now);
            }
            // The router reports nothing: what passes it shows its state (`RouterWatch`).
            if name == ROUTER {
                noted.status.state = State::Ready;
                continue;
            }
            let (since, timeout) = match noted.last_report {
                Some(last_report) => (now.saturating_duration_since(last_report), self.hang),
                None => (now.saturating_duration_since(noted.started), self.start),
            };
            noted.status.state = match noted.last_report {
                None => State::Starting,
                Some(_) if since > SILENT => State::Silent,
                Some(_) if noted.status.failure.is_some() => State::Failing,
                Some(_) => State::Ready,
            };
            noted.note_silence(since);
            if since > timeout && network_is_up {
                let why = format!("has not reported for {:.1} s", since.as_secs_f64());
                hanging.push((name.clone(), why));
            }
        }
        hanging
    }

    /// Processes that crashed at least once.
    pub(crate) fn crashed(&self) -> Vec<String> {
        let statuses = self.processes.values().map(|noted| &noted.status);
        let crashed = statuses.filter(|status| status.last_exit.is_some());
        crashed.map(|status| status.name.clone()).collect()
    }

    /// Ends of processes that were unexpected, as text: `agent-4288 was ended by signal 9`.
    pub(crate) fn ends(&self) -> Vec<String> {
        let ends = self.processes.iter().filter_map(|(name, noted)| {
            let how = noted.status.last_exit.as_ref()?;
            let times = match noted.status.restarts {
                0 | 1 => String::new(),
                restarts => format!(", restarted {restarts} times"),
            };
            Some(format!("{name} {how}{times}"))
        });
        ends.collect()
    }

    /// Times without a report of processes that were suspended, as text: `replay was silent for 4.1 s`.
    pub(crate) fn silences(&self) -> Vec<String> {
        let silences = self.processes.iter().filter_map(|(name, noted)| {
            let mut silences = noted.silences;
            silences.add(noted.silence);
            silences.sentence(&format!("{name} was silent"))
        });
        silences.collect()
    }

    /// Status of every process; `progress` has what they reported.
    pub(crate) fn statuses(&self, progress: &Progress, now: Instant) -> Vec<ProcessStatus> {
        let elapsed_s = |since: Instant| now.saturating_duration_since(since).as_secs_f64();
        let statuses = self.processes.iter().map(|(name, noted)| {
            let Some(pid) = noted.status.pid else {
                return noted.status.clone();
            };
            ProcessStatus {
                up_s: elapsed_s(noted.started),
                problems: progress.problems.get(name).cloned().unwrap_or_default(),
                silent_s: noted.last_report.map(elapsed_s),
                usage: Usage::of(pid).unwrap_or_default(),
                ..noted.status.clone()
            }
        });
        statuses.collect()
    }
}

/// Resources of a process, from `/proc`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Usage {
    /// Resident memory, MiB.
    pub resident_mib: Option<f64>,
    /// Number of threads.
    pub threads: Option<u64>,
    /// Number of open descriptors.
    pub descriptors: Option<u64>,
    /// True if a signal has stopped it (Ctrl-Z).
    #[serde(skip)]
    pub is_stopped: bool,
}

impl Usage {
    /// Of the process `pid`; empty when it has ended.
    pub fn of(pid: u32) -> Option<Self> {
        let text = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let descriptors = fs::read_dir(format!("/proc/{pid}/fd")).ok();
        Some(Self {
            // VmRSS counts units of 1024 bytes.
            resident_mib: number_after("VmRSS:", &text).map(|kib| kib as f64 / 1024.0),
            threads: number_after("Threads:", &text),
            descriptors: descriptors.map(|entries| entries.count() as u64),
            is_stopped: text.contains("\nState:\tT"),
        })
    }
}

fn number_after(name: &str, text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::process::{self, Command};

    use super::*;

    fn event(name: &str, what: ProcessEventKind) -> ProcessEvent {
        ProcessEvent {
            name: name.into(),
            what,
        }
    }

    /// Monitor of one process that was started at the returned time.
    fn watch() -> (Health, Instant) {
        watch_process(process::id())
    }

    fn watch_process(pid: u32) -> (Health, Instant) {
        let mut health = Health::new(Duration::from_secs(5), Duration::from_secs(60));
        let began = Instant::now();
        health.note(&event("ego", ProcessEventKind::Started { pid }), began);
        (health, began)
    }

    /// Updates every 100 ms from `from_ms` to `to_ms`, for a process with its last report at `report_ms`.
    fn look(
        health: &mut Health,
        began: Instant,
        [from_ms, to_ms, report_ms]: [u64; 3],
    ) -> Vec<(String, String)> {
        let last_report = began + Duration::from_millis(report_ms);
        (from_ms..=to_ms)
            .step_by(100)
            .flat_map(|ms| {
                let now = began + Duration::from_millis(ms);
                let last_reports =
                    BTreeMap::from([("ego".to_owned(), last_report), ("replay".to_owned(), now)]);
                health.look(&last_reports, false, now)
            })
            .collect()
    }

    /// State of the first process.
    fn state(health: &Health, now: Instant) -> State {
        health.statuses(&Progress::default(), now)[0].state
    }

    #[test]
    fn a_silent_process_is_shown_and_then_replaced() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 900, 0]).is_empty());
        assert_eq!(state(&health, began), State::Starting);
        assert!(look(&mut health, began, [1000, 1500, 1000]).is_empty());
        assert_eq!(state(&health, began), State::Ready);
        assert!(look(&mut health, began, [1600, 5900, 1000]).is_empty());
        assert_eq!(state(&health, began), State::Silent);
        let hanging = look(&mut health, began, [6000, 6100, 1000]);
        assert_eq!(
            hanging,
            [("ego".to_owned(), "has not reported for 5.1 s".to_owned())]
        );
        health.note(
            &event(
                "ego",
                ProcessEventKind::Crashed {
                    how: "hung".into(),
                    again_after: SILENT,
                    restart: 1,
                },
            ),
            began,
        );
        let status = health.statuses(&Progress::default(), began).remove(0);
        assert_eq!(
            (status.state, status.restarts, status.last_exit.as_deref()),
            (State::Crashed, 1, Some("hung"))
        );
    }

    #[test]
    fn the_silence_of_a_suspended_process_is_a_cause_and_that_of_a_slow_one_is_none() {
        let mut suspended = Command::new("sh")
            .args(["-c", "kill -STOP $$"])
            .spawn()
            .unwrap();
        while !Usage::of(suspended.id()).unwrap().is_stopped {
            std::thread::sleep(Duration::from_millis(1));
        }
        for (pid, causes) in [
            (suspended.id(), ["ego was silent for 4.1 s"].as_slice()),
            (process::id(), &[]),
        ] {
            let (mut health, began) = watch_process(pid);
            look(&mut health, began, [0, 900, 0]);
            look(&mut health, began, [1000, 2500, 1000]);
            assert!(health.silences().is_empty(), "not yet");
            look(&mut health, began, [2600, 5100, 1000]);
            assert_eq!(health.silences(), causes, "so far");
            look(&mut health, began, [5200, 5200, 5200]);
            assert_eq!(health.silences(), causes);
        }
        suspended.kill().unwrap();
        suspended.wait().unwrap();
    }

    #[test]
    fn a_start_takes_its_time_but_not_for_ever() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 60_000, 0]).is_empty());
        assert_eq!(look(&mut health, began, [60_100, 60_100, 0]).len(), 1);
    }

    #[test]
    fn a_stopped_machine_is_no_reason_to_replace_everyone() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 2000, 1900]).is_empty());
        // An hour later, before any report.
        assert!(look(&mut health, began, [3_600_000, 3_604_000, 1900]).is_empty());
        assert_eq!(
            look(&mut health, began, [3_605_000, 3_605_100, 1900]).len(),
            1,
            "and then silent all the same"
        );
    }

    #[test]
    fn no_process_counts_as_hung_without_a_network() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 2000, 1900]).is_empty());
        let last_report = began + Duration::from_millis(1900);
        for ms in (2100..30_000).step_by(100) {
            let now = began + Duration::from_millis(ms);
            // The scorer receives its own reports without a network.
            let reports =
                BTreeMap::from([("ego".to_owned(), last_report), ("scorer".to_owned(), now)]);
            assert!(health.look(&reports, false, now).is_empty());
        }
        let end = began + Duration::from_secs(30);
        assert_eq!(state(&health, end), State::Silent);
    }

    #[test]
    fn processes_have_their_time_again_when_the_router_is_back() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 2000, 1900]).is_empty());
        for ms in (2100..30_000).step_by(100) {
            let now = began + Duration::from_millis(ms);
            assert!(health.look(&BTreeMap::new(), true, now).is_empty());
        }
        assert!(look(&mut health, began, [30_000, 35_000, 1900]).is_empty());
        assert_eq!(look(&mut health, began, [35_100, 35_100, 1900]).len(), 1);
    }

    #[test]
    fn resources_of_a_process_are_read() {
        let usage = Usage::of(process::id()).unwrap();
        assert!(
            usage.resident_mib.unwrap() > 1.0
                && usage.threads.unwrap() >= 1
                && usage.descriptors.unwrap() >= 3
        );
        assert_eq!(Usage::of(u32::MAX), None);
    }
}
