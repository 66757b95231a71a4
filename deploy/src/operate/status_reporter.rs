//! Supervision of a run: displays events, replaces hung processes, writes the status for `v2vloc status`.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{Endpoint, ROUTER, RouterProbe};
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::RunId;

use crate::operate::REPLAY;
use crate::operate::failures::Failures;
use crate::operate::health::Health;
use crate::operate::progress::Display;
use crate::operate::router_watch::{RouterFinding, RouterWatch};
use crate::operate::run_folder::RunFolder;
use crate::operate::status::{Phase, StatusWriter};
use crate::operate::supervise::{ProcessEvent, ProcessEventKind, Supervisor};
use crate::operate::timeouts::Timeouts;
use crate::score::{Progress, SCORER, ScorerNode};

/// Update interval of the display and of the checks.
const BEAT: Duration = Duration::from_millis(100);

/// Reason for the end of a run.
pub enum Ending {
    /// The scene is over.
    Over,
    /// The user ended the run.
    Asked,
    /// A process crashed and is not restarted.
    Failed {
        /// Name of the process.
        process: String,
        /// Description of its end.
        how: String,
    },
}

/// Supervision of a run.
pub struct StatusReporter {
    health: Health,
    failures: Failures,
    router: RouterWatch,
    status: StatusWriter,
}

impl StatusReporter {
    /// For a run with these timeouts and its router at `endpoint`, a process of the run or not, that `probe` reaches;
    /// judged by `protocol`.
    pub fn new(
        timeouts: &Timeouts,
        run: &RunId,
        (endpoint, is_own, probe): (&Endpoint, bool, Option<RouterProbe>),
        folder: &RunFolder,
        protocol: EvaluationProtocol,
    ) -> Self {
        // A process that still loads its models gets no less time than one that computes.
        let [hang, start] =
            [timeouts.hang_s, timeouts.ready_s.max(timeouts.hang_s)].map(Duration::from_secs_f64);
        let (run, endpoint) = (run.as_str(), endpoint.as_str());
        Self {
            health: Health::new(hang, start),
            failures: Failures::default(),
            router: RouterWatch::new(probe, is_own),
            status: StatusWriter::new(folder.path(), run, endpoint, Some(protocol)),
        }
    }

    /// Records an event; returns the failure of the process from now on, as text.
    pub fn note(&mut self, event: &ProcessEvent) -> Option<String> {
        let now = Instant::now();
        self.health.note(event, now);
        if event.name == ROUTER && matches!(event.what, ProcessEventKind::Crashed { .. }) {
            self.router.note_restart(now);
        }
        let failure = self.failures.note(event)?;
        self.health.fails(&event.name, failure);
        Some(failure.to_owned())
    }

    /// Failures that the run continued without, as text.
    pub fn failures(&self) -> Vec<String> {
        self.failures.in_words()
    }

    /// Processes that crashed at least once.
    pub fn crashed(&self) -> Vec<String> {
        self.health.crashed()
    }

    /// Observed causes of lost messages, as text: outages of the router, pauses of the run and of processes, ends of
    /// processes.
    pub fn causes(&self) -> Vec<String> {
        let (silences, ends) = (self.health.silences(), self.health.ends());
        [self.router.causes(), silences, ends].concat()
    }

    /// True if messages of any process may have been lost while the router was gone or the run suspended.
    pub fn had_outages(&self) -> bool {
        self.router.had_outages() || self.crashed().iter().any(|name| name == ROUTER)
    }

    /// Ends the watch of the router.
    pub fn end(&mut self) {
        self.router.end();
    }

    /// Writes the status of the run.
    pub fn write_status(&mut self, phase: Phase, progress: &Progress) {
        let (health, causes) = (&self.health, (self.causes(), self.router.gone_s()));
        let status = &mut self.status;
        status.write(phase, progress, causes, |at| health.statuses(progress, at));
    }

    /// Displays events and replaces hung processes, `router` among them, until the scene is over, the user ends the run,
    /// or a process stays down.
    pub fn follow(
        &mut self,
        (supervisor, router): (&Supervisor, Option<&Supervisor>),
        events: &Receiver<ProcessEvent>,
        scorer: &ScorerNode,
        stop: &Stop,
        display: &mut Display,
    ) -> Ending {
        loop {
            if stop.requested() {
                display.print_line("ending");
                return Ending::Asked;
            }
            let progress = scorer.progress();
            display.update(&progress);
            // The scorer is in this process, so its own reports prove nothing.
            let reports = &progress.last_reports;
            let others = reports.iter().filter(|(name, _)| *name != SCORER);
            match self.router.look(scorer, others.map(|(_, at)| *at).max()) {
                Some(RouterFinding::Hung(why)) => {
                    if let Some(router) = router {
                        router.replace(ROUTER, &why);
                    }
                }
                Some(RouterFinding::Line(line)) => display.print_line(&line),
                None => {}
            }
            let is_gone = self.router.gone_s().is_some();
            for (name, why) in self.health.look(reports, is_gone, Instant::now()) {
                supervisor.replace(&name, &why);
            }
            self.write_status(Phase::Running, &progress);
            let event = match events.recv_timeout(BEAT) {
                Ok(event) => event,
                Err(RecvTimeoutError::Timeout) => continue,
                // Not before the supervisor has ended, which outlives this.
                Err(RecvTimeoutError::Disconnected) => return Ending::Asked,
            };
            if let Some(failure) = self.note(&event) {
                display.print_line(&format!("{}: {failure}", event.name));
            }
            if let Some(ending) = show(event, display) {
                return ending;
            }
        }
    }
}

/// Displays an event of a process; returns the end of the run where the event ends it.
fn show(ProcessEvent { name, what }: ProcessEvent, display: &Display) -> Option<Ending> {
    match what {
        ProcessEventKind::Started { pid } => {
            display.print_line(&format!("{name} runs (pid {pid})"))
        }
        ProcessEventKind::Crashed {
            how,
            again_after,
            restart,
        } => display.print_line(&format!(
            "{name} {how}; starting it again in {:.1} s (restart {restart})",
            again_after.as_secs_f64()
        )),
        ProcessEventKind::GaveUp {
            how,
            is_optional: false,
        } => return Some(Ending::Failed { process: name, how }),
        // The replay is the clock of the run; the others follow it.
        ProcessEventKind::Done { .. } if name == REPLAY => return Some(Ending::Over),
        // Reported as failures, where they are some.
        ProcessEventKind::Logged { .. }
        | ProcessEventKind::GaveUp { .. }
        | ProcessEventKind::Failed { .. }
        | ProcessEventKind::Done { .. } => {}
    }
    None
}
