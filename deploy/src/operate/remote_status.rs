//! Remote status: the processes of a run as its router shows them, without the folder of the run.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusError, present};
use protocol::{CavId, Detections, KeyExpr, Limits, Stamp, Stats, Stream, Topic, Verb, wire};
use serde::Serialize;
use terminal::text_table::number;

use crate::operate::status::{name_of, table_with_note};
use crate::score::ms_between;

/// Queued messages of a topic.
const PLACES: usize = 64;

/// State of one process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RemoteState {
    /// It is connected and reports.
    Alive,
    /// It is connected, and no report of it has arrived.
    Silent,
    /// It has left since its last report.
    Gone,
    /// The same after the end of the scene.
    Ended,
}

/// A process of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RemoteProcess {
    /// Name in messages.
    pub name: String,
    /// State.
    pub state: RemoteState,
    /// Cores in use, between its reports; `None` with fewer than two.
    pub cores: Option<f64>,
    /// Resident memory, MiB.
    pub resident_mib: Option<f64>,
    /// Number of messages that it has sent.
    pub sent: Option<u64>,
    /// Number of messages in its ledger that were dropped.
    pub dropped: Option<u64>,
    /// Problems that it reports.
    pub problems: Vec<String>,
}

/// Results of one ego while it was observed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RemoteEgo {
    /// The ego.
    pub ego: CavId,
    /// Results per second.
    pub rate_hz: f64,
    /// From the publication of a tick to that of its result, milliseconds, of the last result; `None` without a replay.
    pub latency_ms: Option<f64>,
    /// Number of neighbours in the last result.
    pub fused: usize,
}

/// Status of a run, observed for a short time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RemoteStatus {
    /// Name of the run.
    pub run: String,
    /// Time of observation, seconds.
    pub observed_s: f64,
    /// Processes, by name.
    pub processes: Vec<RemoteProcess>,
    /// Egos with results.
    pub egos: Vec<RemoteEgo>,
}

impl RemoteStatus {
    /// Observes the run of `bus` for some time; longer than a second, or processes seem silent.
    ///
    /// # Errors
    /// [`BusError`] when the session is closed.
    pub fn observe(bus: &Bus, time: Duration) -> Result<Self, BusError> {
        let run = &bus.identity().run;
        let selectors = [
            KeyExpr::stats(run),
            KeyExpr::stream(run, Stream::Detections),
            KeyExpr::truth(run),
            KeyExpr::one(&bus.key(Topic::Control(Verb::End))),
        ];
        let subscriber = bus.tap(&selectors, PLACES)?;
        let mut seen = Seen::default();
        let end = Instant::now() + time;
        while let Pop::Item(topic, message) = subscriber.take(Some(end)) {
            seen.add(&topic, &message.pieces());
        }
        // This observer reports, too.
        let own = &bus.identity().process;
        seen.reports.remove(own.as_str());
        // Asked for last, so that a process that has left meanwhile shows as gone.
        let alive = present(bus.session(), KeyExpr::everyone_alive(run).as_str())?;
        let others = alive.iter().filter(|process| *process != own);
        let alive = others.map(ToString::to_string).collect();
        Ok(seen.status(run.to_string(), time, &alive))
    }

    /// Problems as text.
    pub fn troubles(&self) -> Vec<String> {
        if self.processes.is_empty() {
            return vec!["no process of it is connected to this router".to_owned()];
        }
        let troubles = self.processes.iter().flat_map(|process| {
            let (name, problems) = (&process.name, process.problems.iter());
            match process.state {
                RemoteState::Alive => problems.map(|of| format!("{name}: {of}")).collect(),
                RemoteState::Silent => vec![format!("{name} is silent")],
                RemoteState::Gone => vec![format!("{name} has left")],
                RemoteState::Ended => vec![],
            }
        });
        troubles.collect()
    }

    /// The status as text for a terminal.
    pub fn table(&self) -> String {
        let numbers = ["cores", "MiB", "sent", "dropped"];
        let mut table = table_with_note(&["process", "state"], &numbers, "problem");
        for process in &self.processes {
            let [sent, dropped] = [process.sent, process.dropped]
                .map(|count| number(count.map(|count| count as f64), 0));
            table.row([
                process.name.clone(),
                name_of(&process.state),
                number(process.cores, 2),
                number(process.resident_mib, 0),
                sent,
                dropped,
                process.problems.join("; "),
            ]);
        }
        let results: String = self.egos.iter().map(result_line).collect();
        let (run, observed_s) = (&self.run, self.observed_s);
        format!("{run}, observed for {observed_s:.1} s\n{results}{table}")
    }
}

fn result_line(ego: &RemoteEgo) -> String {
    format!(
        "ego {}: {:.1} results a second, latency {} ms, {} fused\n",
        ego.ego,
        ego.rate_hz,
        number(ego.latency_ms, 0),
        ego.fused
    )
}

/// Messages seen so far.
#[derive(Debug, Default)]
struct Seen {
    /// First and last report of each process instance, the newest of its name, with their stamps.
    reports: BTreeMap<String, [(Stamp, Stats); 2]>,
    /// Last result of each ego, and the number of results.
    results: BTreeMap<CavId, (u64, RemoteEgo)>,
    /// Time of publication of each tick, by capture time, nanoseconds.
    ticks: BTreeMap<u64, u64>,
    /// True after the end of the scene.
    has_ended: bool,
}

impl Seen {
    /// Adds a message. `None` for one that cannot be decoded, which is ignored: its sender then counts as silent.
    fn add(&mut self, topic: &Topic, pieces: &[&[u8]]) -> Option<()> {
        let (pieces, limits) = (pieces.iter().copied(), &Limits::DEFAULT);
        match topic {
            Topic::Stats(process) => {
                let (header, stats) = wire::decode::<Stats>(pieces, limits).ok()?;
                let report = (header.stamp, stats);
                // The CPU time of a restarted process begins anew.
                let known = self.reports.remove(process.as_str());
                let known = known.filter(|[(first, _), _]| first.epoch == report.0.epoch);
                let first = known.map_or_else(|| report.clone(), |[first, _]| first);
                self.reports.insert(process.to_string(), [first, report]);
            }
            Topic::Stream { cav, stream } if *stream == Stream::Detections => {
                let (header, result) = wire::decode::<Detections>(pieces, limits).ok()?;
                let count = self.results.get(cav).map_or(0, |(count, _)| *count) + 1;
                let (stamp, began) = (&header.stamp, self.ticks.get(&header.stamp.capture_nanos));
                // Signed: the stamps may be of two clocks.
                let latency_ms = began.map(|began| ms_between(*began, stamp.publish_nanos));
                let ego = RemoteEgo {
                    ego: cav.clone(),
                    rate_hz: 0.0,
                    latency_ms,
                    fused: result.fused.len(),
                };
                self.results.insert(cav.clone(), (count, ego));
            }
            Topic::Truth => {
                let stamp = wire::decode_header(pieces).ok()?.stamp;
                self.ticks.insert(stamp.capture_nanos, stamp.publish_nanos);
            }
            Topic::Control(Verb::End) => self.has_ended = true,
            _ => {}
        }
        Some(())
    }

    fn status(self, run: String, time: Duration, alive: &BTreeSet<String>) -> RemoteStatus {
        let observed_s = time.as_secs_f64();
        let names: BTreeSet<&String> = self.reports.keys().chain(alive).collect();
        let processes = names.iter().map(|name| {
            let reports = self.reports.get(*name);
            let last = reports.map(|[_, (_, last)]| last);
            RemoteProcess {
                name: (*name).clone(),
                state: match (alive.contains(*name), last) {
                    (true, Some(_)) => RemoteState::Alive,
                    (true, None) => RemoteState::Silent,
                    (false, _) if self.has_ended => RemoteState::Ended,
                    (false, _) => RemoteState::Gone,
                },
                cores: reports.and_then(cores),
                resident_mib: last
                    .map(|stats| stats.usage.resident_bytes as f64 / f64::from(1 << 20)),
                sent: last.map(|stats| stats.ledger.total().sent),
                dropped: last.map(|stats| stats.ledger.total().dropped_total()),
                problems: last.map_or(Vec::new(), |stats| stats.problems.clone()),
            }
        });
        let egos = self.results.into_values().map(|(count, ego)| RemoteEgo {
            rate_hz: count as f64 / observed_s,
            ..ego
        });
        RemoteStatus {
            run,
            observed_s,
            processes: processes.collect(),
            egos: egos.collect(),
        }
    }
}

/// Cores in use: the CPU time between the first and the last report.
fn cores([(began, first), (ended, last)]: &[(Stamp, Stats); 2]) -> Option<f64> {
    let seconds = ended.publish_nanos.saturating_sub(began.publish_nanos) as f64 * 1e-9;
    (seconds > 0.0).then(|| (last.usage.cpu_s - first.usage.cpu_s) / seconds)
}

#[cfg(test)]
mod tests {
    use protocol::{Ledger, ProcessId, ProcessUsage};

    use super::*;

    fn stamp(epoch: u64, publish_nanos: u64) -> Stamp {
        Stamp {
            cav: CavId::new("1000").unwrap(),
            epoch,
            sequence: 0,
            capture_nanos: 0,
            publish_nanos,
        }
    }

    fn report(seen: &mut Seen, name: &str, at_s: f64, cpu_s: f64) {
        report_of_instance(seen, (name, 1), at_s, cpu_s);
    }

    fn report_of_instance(seen: &mut Seen, (name, epoch): (&str, u64), at_s: f64, cpu_s: f64) {
        let process: ProcessId = name.parse().unwrap();
        let usage = ProcessUsage {
            cpu_s,
            resident_bytes: 3 << 20,
            peak_resident_bytes: 3 << 20,
            threads: vec![],
        };
        let stats = Stats {
            process: process.clone(),
            ledger: Ledger::default(),
            stages: vec![],
            usage,
            traffic: vec![],
            problems: match name {
                "agent-1002" => vec!["no pose (for 12 s)".into()],
                _ => vec![],
            },
        };
        let bytes = wire::encode(&stamp(epoch, (at_s * 1e9) as u64), stats)
            .unwrap()
            .to_vec();
        seen.add(&Topic::Stats(process), &[&bytes]);
    }

    #[test]
    fn processes_are_alive_silent_or_gone() {
        let mut seen = Seen::default();
        report(&mut seen, "agent-1000", 1.0, 10.0);
        report(&mut seen, "agent-1000", 3.0, 11.0);
        report(&mut seen, "agent-1001", 1.0, 4.0);
        report(&mut seen, "agent-1002", 1.0, 4.0);
        let alive = ["agent-1000", "agent-1002", "ego-1000"];
        let alive = BTreeSet::from(alive.map(str::to_owned));
        let status = seen.status("test".into(), Duration::from_secs(2), &alive);
        let states: Vec<_> = status
            .processes
            .iter()
            .map(|process| (process.name.as_str(), process.state))
            .collect();
        let expected = [
            ("agent-1000", RemoteState::Alive),
            ("agent-1001", RemoteState::Gone),
            ("agent-1002", RemoteState::Alive),
            ("ego-1000", RemoteState::Silent),
        ];
        assert_eq!(states, expected);
        assert_eq!(status.processes[0].cores, Some(0.5));
        assert_eq!(
            (status.processes[1].cores, status.processes[1].resident_mib),
            (None, Some(3.0))
        );
        assert_eq!(
            status.troubles(),
            [
                "agent-1001 has left",
                "agent-1002: no pose (for 12 s)",
                "ego-1000 is silent"
            ]
        );
        insta::assert_snapshot!(status.table());
    }

    #[test]
    fn a_process_that_leaves_after_the_end_of_the_scene_has_ended() {
        for is_over in [false, true] {
            let mut seen = Seen::default();
            report(&mut seen, "agent-1000", 1.0, 10.0);
            if is_over {
                seen.add(&Topic::Control(Verb::End), &[]);
            }
            let status = seen.status("test".into(), Duration::from_secs(2), &BTreeSet::new());
            assert_eq!(status.troubles().is_empty(), is_over);
            let ended = status.processes[0].state == RemoteState::Ended;
            assert_eq!(ended, is_over);
        }
    }

    #[test]
    fn cores_of_a_restarted_process_are_those_of_its_new_instance() {
        let mut seen = Seen::default();
        let found = |seen: &Seen| seen.reports.get("replay").and_then(cores);
        for (epoch, at_s, cpu_s, expected) in [
            (1, 1.0, 10.0, None),
            (1, 2.0, 10.5, Some(0.5)),
            (2, 3.0, 0.25, None),
            (2, 5.0, 0.75, Some(0.25)),
        ] {
            report_of_instance(&mut seen, ("replay", epoch), at_s, cpu_s);
            assert_eq!(found(&seen), expected, "at {at_s} s");
        }
    }

    #[test]
    fn nobody_is_a_problem_and_junk_is_none() {
        let mut seen = Seen::default();
        seen.add(&Topic::Truth, &[b"junk"]);
        seen.add(&Topic::Stats("agent-1".parse().unwrap()), &[b"junk"]);
        let status = seen.status("test".into(), Duration::from_secs(1), &BTreeSet::new());
        assert_eq!(status.troubles().len(), 1);
    }
}
