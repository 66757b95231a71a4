//! The watch over a run while it goes: shows what happens, replaces who hangs, tells `v2vloc status`.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use bus::Endpoint;
use bus::shutdown::Stop;
use protocol::RunId;

use crate::experiment::progress::Display;
use crate::experiment::score::{Progress, ScorerNode};
use crate::operate::failures::Failures;
use crate::operate::fleet::{Fleet, REPLAY};
use crate::operate::health::Health;
use crate::operate::run_folder::RunFolder;
use crate::operate::status::{Phase, StatusWriter};
use crate::operate::supervise::{ProcessEvent, ProcessEventKind, Supervisor};

/// How often the display is brought up to date, and conditions are looked at.
const BEAT: Duration = Duration::from_millis(100);

/// How the watch over a run ended.
pub(crate) enum Ending {
    /// The scene is over.
    Over,
    /// Someone asked to end.
    Asked,
    /// A process stays down.
    Failed { process: String, how: String },
}

/// The watch over a run while it goes.
pub(crate) struct StatusReporter {
    health: Health,
    failures: Failures,
    status: StatusWriter,
}

impl StatusReporter {
    pub(crate) fn new(fleet: &Fleet, run: &RunId, endpoint: &Endpoint, folder: &RunFolder) -> Self {
        let timeouts = &fleet.scenario.timeouts;
        let [hang, start] = [timeouts.hang_s, timeouts.ready_s.max(timeouts.hang_s)].map(Duration::from_secs_f64);
        Self {
            health: Health::new(hang, start),
            failures: Failures::default(),
            status: StatusWriter::new(folder.path(), run.as_str(), endpoint.as_str()),
        }
    }

    /// Takes note of what happened; what is wrong with the process from now on, in words.
    pub(crate) fn note(&mut self, event: &ProcessEvent) -> Option<String> {
        self.health.note(event, Instant::now());
        let words = self.failures.note(event)?;
        self.health.fails(&event.name, words);
        Some(words.to_owned())
    }

    /// What the run had to go on without, in words.
    pub(crate) fn failures(&self) -> Vec<String> {
        self.failures.in_words()
    }

    /// Who has fallen, at least once.
    pub(crate) fn fallen(&self) -> Vec<String> {
        let statuses = self.health.statuses(Instant::now()).into_iter();
        statuses.filter(|process| process.last_fall.is_some()).map(|process| process.name).collect()
    }

    /// Writes down where the run stands.
    pub(crate) fn tell(&mut self, phase: Phase, progress: &Progress) {
        let health = &self.health;
        self.status.write(phase, progress, |now| health.statuses(now));
    }

    /// Shows what happens, and replaces who hangs, until the scene is over, someone asks to end, or a process stays down.
    pub(crate) fn follow(
        &mut self,
        supervisor: &Supervisor,
        happened: &Receiver<ProcessEvent>,
        scorer: &ScorerNode,
        stop: &Stop,
        display: &mut Display,
    ) -> Ending {
        loop {
            if stop.requested() {
                display.say("ending");
                return Ending::Asked;
            }
            let progress = scorer.progress();
            display.update(&progress);
            for (name, why) in self.health.look(&progress.told, Instant::now()) {
                supervisor.replace(&name, &why);
            }
            self.tell(Phase::Running, &progress);
            let event = match happened.recv_timeout(BEAT) {
                Ok(event) => event,
                Err(RecvTimeoutError::Timeout) => continue,
                // Not before the supervisor is gone, which outlives this.
                Err(RecvTimeoutError::Disconnected) => return Ending::Asked,
            };
            if let Some(words) = self.note(&event) {
                display.say(&format!("{}: {words}", event.name));
            }
            if let Some(ending) = show(event, display) {
                return ending;
            }
        }
    }
}

/// Shows what happened to a process; how the run ends where that ends it.
fn show(ProcessEvent { name, what }: ProcessEvent, display: &Display) -> Option<Ending> {
    match what {
        ProcessEventKind::Started { pid } => display.say(&format!("{name} runs (pid {pid})")),
        ProcessEventKind::Fell { how, again_after, restart } => display
            .say(&format!("{name} {how}; starting it again in {:.1} s (restart {restart})", again_after.as_secs_f64())),
        ProcessEventKind::GaveUp { how, is_optional: false } => return Some(Ending::Failed { process: name, how }),
        // The replay is the clock of the run; the others follow it.
        ProcessEventKind::Done { .. } if name == REPLAY => return Some(Ending::Over),
        // Told as failures, where they are some.
        ProcessEventKind::Said { .. }
        | ProcessEventKind::GaveUp { .. }
        | ProcessEventKind::Failed { .. }
        | ProcessEventKind::Done { .. } => {}
    }
    None
}
