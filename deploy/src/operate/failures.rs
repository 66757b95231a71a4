//! Failures of single processes in a run that continues without them: the run ends with exit code 3.

use std::collections::BTreeMap;

use sim_replay::recorder::RecordReport;

use crate::operate::RECORDER;
use crate::operate::supervise::{ProcessEvent, ProcessEventKind};

/// Failures of a run, by process.
#[derive(Debug, Default)]
pub(crate) struct Failures {
    /// Description of the failure, by process.
    failed: BTreeMap<String, String>,
    /// The last line of each process's report.
    last_line: BTreeMap<String, String>,
}

impl Failures {
    /// Records an event; returns the failure of the process from now on, as text.
    pub(crate) fn note(&mut self, event: &ProcessEvent) -> Option<&str> {
        let ProcessEvent { name, what } = event;
        let text = match what {
            ProcessEventKind::Logged { line } if name == RECORDER => {
                let report: RecordReport = serde_json::from_str(line).ok()?;
                report.loss_in_words()?
            }
            ProcessEventKind::Logged { line } => {
                self.last_line.insert(name.clone(), line.clone());
                return None;
            }
            // Its report gives the reason.
            ProcessEventKind::Done { data_lost: true } if self.failed.contains_key(name) => {
                return None;
            }
            ProcessEventKind::Done { data_lost: true } => match self.last_line.get(name) {
                Some(line) => format!("data were lost: {line}"),
                None => "data were lost; see its log".into(),
            },
            ProcessEventKind::GaveUp {
                how,
                is_optional: true,
            } => format!("{how}; the run went on without it"),
            ProcessEventKind::Failed { how } => format!("{how} when it was asked to end"),
            // Either the run ends with it, or it is no failure.
            _ => return None,
        };
        self.failed.insert(name.clone(), text);
        self.failed.get(name).map(String::as_str)
    }

    /// Description of each failure, after the name of its process.
    pub(crate) fn in_words(&self) -> Vec<String> {
        let failed = self.failed.iter();
        let lines = failed.map(|(name, text)| format!("{name}: {text}"));
        lines.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noted(events: &[(&str, ProcessEventKind)]) -> Vec<String> {
        let mut failures = Failures::default();
        for (name, what) in events {
            failures.note(&ProcessEvent {
                name: (*name).into(),
                what: what.clone(),
            });
        }
        failures.in_words()
    }

    fn logged(line: &str) -> ProcessEventKind {
        ProcessEventKind::Logged { line: line.into() }
    }

    fn report(failure: Option<&str>, not_written: u64) -> ProcessEventKind {
        let report = RecordReport {
            file: "runs/a/recording.mcap".into(),
            messages: 40,
            bytes: 1000,
            seconds: 0.93,
            overwritten: 0,
            undelivered: 0,
            router_gone_s: 0.0,
            not_written,
            failure: failure.map(str::to_owned),
        };
        logged(&serde_json::to_string(&report).unwrap())
    }

    #[test]
    fn a_cut_recording_is_reported_with_the_remedy() {
        let events = [
            ("recorder", report(Some("disk full"), 0)),
            ("recorder", report(Some("disk full"), 344)),
            ("recorder", ProcessEventKind::Done { data_lost: true }),
        ];
        let text = "recorder: recording cut at 0.9 s: disk full, 344 messages missing; \
                     sim-replay recover runs/a/recording.mcap --out runs/a/recording.whole.mcap";
        assert_eq!(noted(&events), [text]);
        assert!(
            noted(&[
                ("recorder", report(None, 0)),
                ("recorder", ProcessEventKind::Done { data_lost: false })
            ])
            .is_empty()
        );
    }

    #[test]
    fn every_process_counts() {
        let events = [
            ("replay", logged("7 ticks were not answered")),
            ("replay", ProcessEventKind::Done { data_lost: true }),
            (
                "link-1",
                ProcessEventKind::Failed {
                    how: "ended with code 1".into(),
                },
            ),
            ("agent-1", ProcessEventKind::Started { pid: 1 }),
            ("agent-1", logged("40 sweeps")),
            ("agent-1", ProcessEventKind::Done { data_lost: false }),
            (
                "recorder",
                ProcessEventKind::GaveUp {
                    how: "was ended by signal 9".into(),
                    is_optional: true,
                },
            ),
        ];
        assert_eq!(
            noted(&events),
            [
                "link-1: ended with code 1 when it was asked to end",
                "recorder: was ended by signal 9; the run went on without it",
                "replay: data were lost: 7 ticks were not answered",
            ]
        );
    }
}
