//! What is known of each process of a run while it goes: does it run, is it ready, does it still say anything.
//!
//! Every process tells twice a second how its books stand ([`protocol::Stats`]). From the first time on it is ready; one
//! that falls silent for longer than the scenario allows hangs, and is replaced.

use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::operate::supervise::{ProcessEvent, ProcessEventKind};

/// Without news for so long, a process is shown as silent.
const SILENT: Duration = Duration::from_millis(1500);
/// An own pause of this length says that this program, or the whole machine, was stopped, and nothing of the others.
const OWN_PAUSE: Duration = Duration::from_secs(1);

/// How a process is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// It runs and has not said anything yet.
    Starting,
    /// It has joined the run and goes on telling about itself.
    Ready,
    /// It goes on telling about itself, but has failed in what it was to do.
    Failing,
    /// It runs but has said nothing for a while.
    Silent,
    /// It has fallen and will be started again.
    Fallen,
    /// It has ended as it should.
    Ended,
    /// It has fallen and stays down.
    Down,
}

/// A process as it is now.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProcessStatus {
    /// Name in messages, and of its log.
    pub name: String,
    /// How it is.
    pub state: State,
    /// Process id, while it runs.
    pub pid: Option<u32>,
    /// Since it was started last, seconds.
    pub up_s: f64,
    /// Times that it was started again.
    pub restarts: u32,
    /// How it fell last, in words.
    pub last_fall: Option<String>,
    /// What it has failed in, in words.
    #[serde(default)]
    pub failure: Option<String>,
    /// Since it said something, seconds.
    pub silent_s: Option<f64>,
    /// Resident memory, MiB.
    pub resident_mib: Option<f64>,
    /// Threads.
    pub threads: Option<u64>,
    /// Open descriptors.
    pub descriptors: Option<u64>,
}

/// What is noted of a process.
#[derive(Debug)]
struct Noted {
    state: State,
    pid: Option<u32>,
    started: Instant,
    /// Since this start.
    heard: Option<Instant>,
    restarts: u32,
    last_fall: Option<String>,
    failure: Option<String>,
}

/// Keeps watch over the processes of a run.
#[derive(Debug)]
pub struct Health {
    processes: BTreeMap<String, Noted>,
    /// Longest silence of a process that is ready.
    hang: Duration,
    /// Longest silence after a start.
    start: Duration,
    looked: Instant,
}

impl Health {
    /// Nothing runs yet. A process that is silent for `hang`, or for `start` after it was started, is to be replaced.
    #[must_use]
    pub fn new(hang: Duration, start: Duration) -> Self {
        Self { processes: BTreeMap::new(), hang, start, looked: Instant::now() }
    }

    /// Takes note of what happened to a process.
    pub fn note(&mut self, event: &ProcessEvent, now: Instant) {
        let noted = self.processes.entry(event.name.clone()).or_insert_with(|| Noted {
            state: State::Starting,
            pid: None,
            started: now,
            heard: None,
            restarts: 0,
            last_fall: None,
            failure: None,
        });
        match &event.what {
            ProcessEventKind::Started { pid } => {
                *noted = Noted {
                    state: State::Starting,
                    pid: Some(*pid),
                    started: now,
                    heard: None,
                    restarts: noted.restarts,
                    last_fall: noted.last_fall.take(),
                    failure: noted.failure.take(),
                };
            }
            ProcessEventKind::Fell { how, restart, .. } => {
                (noted.state, noted.pid, noted.restarts) = (State::Fallen, None, *restart);
                noted.last_fall = Some(how.clone());
            }
            ProcessEventKind::Said { .. } => {}
            ProcessEventKind::GaveUp { how, .. } | ProcessEventKind::Failed { how } => {
                (noted.state, noted.pid) = (State::Down, None);
                noted.last_fall = Some(how.clone());
            }
            ProcessEventKind::Done { .. } => (noted.state, noted.pid) = (State::Ended, None),
        }
    }

    /// Takes note of what a process has failed in.
    pub fn fails(&mut self, name: &str, words: &str) {
        if let Some(noted) = self.processes.get_mut(name) {
            noted.failure = Some(words.to_owned());
        }
    }

    /// Looks who has been heard when, and returns those that hang, with what is wrong in words.
    pub fn look(&mut self, heard: &BTreeMap<String, Instant>, now: Instant) -> Vec<(String, String)> {
        let was_away = now.saturating_duration_since(self.looked) > OWN_PAUSE;
        self.looked = now;
        // This program hears itself too: where it hears nobody at all, the network is away, and nobody hangs.
        let hears = heard.is_empty() || heard.values().any(|at| now.saturating_duration_since(*at) <= SILENT);
        let mut hanging = Vec::new();
        for (name, noted) in &mut self.processes {
            if noted.pid.is_none() {
                continue;
            }
            // The last words of an earlier life may come after its end.
            let last = heard.get(name).copied().filter(|at| *at > noted.started + SILENT / 3);
            noted.heard = noted.heard.max(last);
            if was_away {
                // What would have been heard meanwhile was not listened to.
                noted.started = noted.started.max(now.checked_sub(SILENT).unwrap_or(now));
                noted.heard = noted.heard.map(|_| now);
            }
            let (since, patience) = match noted.heard {
                Some(heard) => (now.saturating_duration_since(heard), self.hang),
                None => (now.saturating_duration_since(noted.started), self.start),
            };
            noted.state = match noted.heard {
                None => State::Starting,
                Some(_) if since > SILENT => State::Silent,
                Some(_) if noted.failure.is_some() => State::Failing,
                Some(_) => State::Ready,
            };
            if since > patience && hears {
                hanging.push((name.clone(), format!("has said nothing for {:.1} s", since.as_secs_f64())));
            }
        }
        hanging
    }

    /// Every process as it is now.
    #[must_use]
    pub fn statuses(&self, now: Instant) -> Vec<ProcessStatus> {
        let seconds = |at: Instant| now.saturating_duration_since(at).as_secs_f64();
        let status = |(name, noted): (&String, &Noted)| {
            let usage = noted.pid.and_then(Usage::of).unwrap_or_default();
            ProcessStatus {
                name: name.clone(),
                state: noted.state,
                pid: noted.pid,
                up_s: if noted.pid.is_some() { seconds(noted.started) } else { 0.0 },
                restarts: noted.restarts,
                last_fall: noted.last_fall.clone(),
                failure: noted.failure.clone(),
                silent_s: noted.heard.filter(|_| noted.pid.is_some()).map(seconds),
                resident_mib: usage.resident_mib,
                threads: usage.threads,
                descriptors: usage.descriptors,
            }
        };
        self.processes.iter().map(status).collect()
    }
}

/// What a process uses, as the system says.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Usage {
    /// Resident memory, MiB.
    pub resident_mib: Option<f64>,
    /// Threads.
    pub threads: Option<u64>,
    /// Open descriptors.
    pub descriptors: Option<u64>,
}

impl Usage {
    /// Of the process `pid`; none when it is gone.
    #[must_use]
    pub fn of(pid: u32) -> Option<Self> {
        let text = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let field = |name: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(name))?;
            line.split_whitespace().next()?.parse::<u64>().ok()
        };
        Some(Self {
            resident_mib: field("VmRSS:").map(|kib| kib as f64 / 1024.0),
            threads: field("Threads:"),
            descriptors: fs::read_dir(format!("/proc/{pid}/fd")).ok().map(|entries| entries.count() as u64),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(name: &str, what: ProcessEventKind) -> ProcessEvent {
        ProcessEvent { name: name.into(), what }
    }

    /// A watch over one process that was started at the returned moment.
    fn watch() -> (Health, Instant) {
        let mut health = Health::new(Duration::from_secs(5), Duration::from_secs(60));
        let began = Instant::now();
        health.note(&event("ego", ProcessEventKind::Started { pid: std::process::id() }), began);
        (health, began)
    }

    /// Looks every 100 ms from `from_ms` to `to_ms` at a process that was last heard at `heard_ms`.
    fn look(health: &mut Health, began: Instant, [from_ms, to_ms, heard_ms]: [u64; 3]) -> Vec<(String, String)> {
        let at = |ms| began + Duration::from_millis(ms);
        let look = |ms| {
            let heard = BTreeMap::from([("ego".to_owned(), at(heard_ms)), ("scorer".to_owned(), at(ms))]);
            health.look(&heard, at(ms))
        };
        (from_ms..=to_ms).step_by(100).flat_map(look).collect()
    }

    #[test]
    fn who_falls_silent_is_shown_and_then_replaced() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 900, 0]).is_empty());
        let state = |health: &Health| health.statuses(began)[0].state;
        assert_eq!(state(&health), State::Starting);
        assert!(look(&mut health, began, [1000, 1500, 1000]).is_empty());
        assert_eq!(state(&health), State::Ready);
        assert!(look(&mut health, began, [1600, 5900, 1000]).is_empty());
        assert_eq!(state(&health), State::Silent);
        let hanging = look(&mut health, began, [6000, 6100, 1000]);
        assert_eq!(hanging, [("ego".to_owned(), "has said nothing for 5.1 s".to_owned())]);
        health
            .note(&event("ego", ProcessEventKind::Fell { how: "hung".into(), again_after: SILENT, restart: 1 }), began);
        let status = health.statuses(began).remove(0);
        assert_eq!((status.state, status.restarts, status.last_fall.as_deref()), (State::Fallen, 1, Some("hung")));
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
        // An hour later, before anyone has spoken.
        assert!(look(&mut health, began, [3_600_000, 3_604_000, 1900]).is_empty());
        assert_eq!(look(&mut health, began, [3_605_000, 3_605_100, 1900]).len(), 1, "and then silent all the same");
    }

    #[test]
    fn nobody_hangs_where_the_network_is_away() {
        let (mut health, began) = watch();
        assert!(look(&mut health, began, [0, 2000, 1900]).is_empty());
        let at = |ms| began + Duration::from_millis(ms);
        let heard = BTreeMap::from([("ego".to_owned(), at(1900)), ("scorer".to_owned(), at(2000))]);
        assert!((2100..30_000).step_by(100).all(|ms| health.look(&heard, at(ms)).is_empty()));
        assert_eq!(health.statuses(at(30_000))[0].state, State::Silent);
    }

    #[test]
    fn the_system_tells_what_a_process_uses() {
        let usage = Usage::of(std::process::id()).unwrap();
        assert!(usage.resident_mib.unwrap() > 1.0 && usage.threads.unwrap() >= 1 && usage.descriptors.unwrap() >= 3);
        assert_eq!(Usage::of(u32::MAX), None);
    }
}
