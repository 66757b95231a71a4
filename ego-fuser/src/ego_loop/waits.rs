//! Waits of an ego: missing messages and streams, and messages that all cannot be used, for its status.

use std::collections::BTreeMap;

use protocol::message::Descriptor;
use protocol::{CavId, DropReason, Stream};

/// Time after which a wait is a problem, nanoseconds.
const AFTER_NANOS: u64 = 3_000_000_000;
/// The same for the own agent's next message while its period is not known or is long, nanoseconds.
const LONGEST_NANOS: u64 = 30_000_000_000;
/// Time after which messages that all cannot be used are a problem, and after which they are forgotten, nanoseconds.
const UNUSABLE_NANOS: u64 = 5_000_000_000;
/// Largest number of vehicles of a kind.
const MAX_VEHICLES: usize = 64;

/// Messages, streams and vehicles that an ego waits for, each with the time of the beginning, nanoseconds.
pub(crate) struct Waits {
    ego: CavId,
    /// Method and the stream that it needs.
    method: String,
    stream: Stream,
    /// True if boxes of a neighbour do in place of that stream.
    reads_boxes: bool,
    /// Last message of its own agent, or the first report of a sweep that it has.
    own_nanos: Option<u64>,
    /// Last message of its own agent.
    own_message_nanos: Option<u64>,
    /// Time after which the wait for the next one is a problem, nanoseconds.
    own_after_nanos: u64,
    /// Vehicles whose messages are all dropped for their time or their network: time of the first and of the last of these,
    /// and reason.
    unusable: BTreeMap<CavId, (u64, u64, DropReason)>,
    /// Vehicles that do not publish the stream, with those that they publish.
    without: BTreeMap<CavId, (String, u64)>,
    /// Vehicles that left without announcing their end.
    gone: BTreeMap<CavId, u64>,
}

impl Waits {
    pub(super) fn new(ego: &CavId, method: &str, stream: Stream, reads_boxes: bool) -> Self {
        Self {
            ego: ego.clone(),
            method: method.to_owned(),
            stream,
            reads_boxes,
            own_nanos: None,
            own_message_nanos: None,
            own_after_nanos: AFTER_NANOS,
            unusable: BTreeMap::new(),
            without: BTreeMap::new(),
            gone: BTreeMap::new(),
        }
    }

    /// Records a message of a vehicle.
    pub(super) fn received(&mut self, cav: &CavId, now_nanos: u64) {
        self.gone.remove(cav);
        self.without.remove(cav);
        if *cav == self.ego {
            self.own_nanos = Some(now_nanos);
            // A slow scene has a long period.
            let last = self.own_message_nanos.replace(now_nanos);
            let period = last.map_or(LONGEST_NANOS, |last| now_nanos.saturating_sub(last));
            self.own_after_nanos = period.saturating_mul(3).clamp(AFTER_NANOS, LONGEST_NANOS);
        }
    }

    /// Records that a vehicle's message was used, or why not, for [`Self::problems`].
    pub(crate) fn note(&mut self, cav: &CavId, reason: Option<DropReason>, now_nanos: u64) {
        use DropReason::{Clock, Future, Shape, Stale};
        let has_room = self.unusable.len() < MAX_VEHICLES;
        let reason = reason.filter(|why| has_room && matches!(why, Clock | Future | Shape | Stale));
        let known = self.unusable.remove(cav);
        if let Some(reason) = reason {
            let known = known.filter(|(_, last, _)| is_recent(*last, now_nanos));
            let first_nanos = known.map_or(now_nanos, |(first, ..)| first);
            let unusable = (first_nanos, now_nanos, reason);
            self.unusable.insert(cav.clone(), unusable);
        }
    }

    /// Records a vehicle's descriptor: the streams that it publishes, none after its scene, and that it has sweeps.
    pub(super) fn described(&mut self, cav: &CavId, descriptor: &Descriptor, now_nanos: u64) {
        let streams = &descriptor.streams;
        self.gone.remove(cav);
        let is_own = *cav == self.ego;
        if is_own && streams.is_empty() {
            (self.own_nanos, self.own_message_nanos) = (None, None);
        } else if is_own && !descriptor.sweeps.is_empty() {
            // From the first sweep on: an agent without sweeps has nothing to send yet.
            self.own_nanos.get_or_insert(now_nanos);
        }
        let sends_boxes = streams.contains(&Stream::Boxes) && !is_own;
        if streams.is_empty() || streams.contains(&self.stream) || self.reads_boxes && sends_boxes {
            self.without.remove(cav);
        } else if self.without.len() < MAX_VEHICLES {
            let names: Vec<String> = streams.iter().map(ToString::to_string).collect();
            let published = (names.join(", "), now_nanos);
            self.without.entry(cav.clone()).or_insert(published);
        }
    }

    /// Records that a vehicle has left, and whether it announced its end.
    pub(super) fn left(&mut self, cav: &CavId, has_ended: bool, now_nanos: u64) {
        self.without.remove(cav);
        self.unusable.remove(cav);
        if !has_ended && self.gone.len() < MAX_VEHICLES {
            self.gone.insert(cav.clone(), now_nanos);
        }
    }

    /// Waits of three seconds and more, streams that are missing, and vehicles of which no message can be used, each
    /// with the time of its beginning, nanoseconds.
    pub(crate) fn problems(&self, now_nanos: u64) -> Vec<(String, u64)> {
        let Self { ego, stream, .. } = self;
        let late_before = now_nanos.saturating_sub(AFTER_NANOS);
        // An agent that publishes other streams is named for that instead.
        let own_nanos = self.own_nanos.filter(|_| !self.without.contains_key(ego));
        let own_before = now_nanos.saturating_sub(self.own_after_nanos);
        let no_own = own_nanos.filter(|since| *since < own_before);
        let unusable = self.unusable.iter().filter(|(_, (first, last, _))| {
            is_recent(*last, now_nanos) && !is_recent(*first, *last)
        });
        let unusable = unusable.map(|(cav, (first, _, reason))| {
            let problem = format!("fuses no {stream} of agent {cav}, drop reason {reason}");
            (problem, *first)
        });
        let no_own = no_own.map(|since| (format!("no {stream} of agent {ego}"), since));
        let without = self.without.iter().map(|(cav, (published, since))| {
            let method = &self.method;
            let problem = format!("{method} needs {stream}, agent {cav} publishes {published}");
            (problem, *since)
        });
        let gone = self.gone.iter().filter(|(_, since)| **since < late_before);
        let gone = gone.map(|(cav, since)| (format!("vehicle {cav} is gone"), *since));
        let missing = no_own.into_iter().chain(without).chain(gone);
        missing.chain(unusable).collect()
    }
}

/// True if a message was dropped lately: successive ones are of one problem.
fn is_recent(dropped_nanos: u64, now_nanos: u64) -> bool {
    now_nanos.saturating_sub(dropped_nanos) < UNUSABLE_NANOS
}

#[cfg(test)]
mod tests {
    use protocol::message::{ModelHash, SweepArrival};
    use protocol::{BevGrid, Dtype};

    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn descriptor(streams: Vec<Stream>) -> Descriptor {
        Descriptor {
            model_hash: ModelHash([7; 32]),
            grid: BevGrid {
                x_min_m: -51.2,
                y_min_m: -38.4,
                cell_m: 0.8,
                width: 128,
                height: 96,
            },
            channels: 64,
            dtype: Dtype::I8,
            streams,
            sweeps: vec![],
        }
    }

    #[test]
    fn a_vehicle_whose_messages_are_all_unusable_is_named() {
        let [own, other] = ["1", "2"].map(|name| CavId::new(name).unwrap());
        let mut waits = Waits::new(&own, "max", Stream::Bev, true);
        let stale = Some(DropReason::Stale);
        for second in 1..=5 {
            waits.note(&other, stale, second * SECOND);
            assert_eq!(waits.problems(second * SECOND), []);
        }
        waits.note(&other, Some(DropReason::Clock), 6 * SECOND);
        let named = "fuses no bev of agent 2, drop reason clock".to_owned();
        assert_eq!(waits.problems(6 * SECOND), [(named, SECOND)]);
        assert_eq!(waits.problems(11 * SECOND), [], "it sends no more");

        // A message that was used, one that is left out rightly, and a pause: each is a new beginning.
        for (second, reason) in [(6, None), (11, Some(DropReason::OutOfRange)), (20, stale)] {
            waits.note(&other, reason, second * SECOND);
            for later in second + 1..second + 5 {
                waits.note(&other, stale, later * SECOND);
                assert_eq!(waits.problems(later * SECOND), [], "{reason:?}");
            }
        }
        waits.note(&other, stale, 25 * SECOND);
        assert_eq!(waits.problems(25 * SECOND).len(), 1);
        waits.left(&other, true, 25 * SECOND);
        assert_eq!(waits.problems(25 * SECOND), []);

        for second in 30..=35 {
            waits.note(&other, Some(DropReason::Shape), second * SECOND);
        }
        let named = "fuses no bev of agent 2, drop reason shape".to_owned();
        assert_eq!(waits.problems(35 * SECOND), [(named, 30 * SECOND)]);
    }

    #[test]
    fn the_own_agent_of_a_slow_scene_is_late_after_three_of_its_periods() {
        let own = CavId::new("1").unwrap();
        let mut waits = Waits::new(&own, "max", Stream::Bev, true);
        let is_late = |waits: &Waits, second: u64| !waits.problems(second * SECOND).is_empty();
        waits.received(&own, SECOND);
        assert!(!is_late(&waits, 30), "its period is not known");
        assert!(is_late(&waits, 32));
        waits.received(&own, 5 * SECOND);
        assert!(!is_late(&waits, 16) && is_late(&waits, 18));
        waits.received(&own, 5 * SECOND + SECOND / 10);
        assert!(!is_late(&waits, 8) && is_late(&waits, 9));
    }

    #[test]
    fn an_own_agent_whose_scene_has_ended_is_not_awaited() {
        let own = CavId::new("1").unwrap();
        let mut waits = Waits::new(&own, "max", Stream::Bev, true);
        let mut descriptor = descriptor(vec![]);
        descriptor.sweeps = vec![SweepArrival {
            before_nanos: 0,
            arrived_nanos: 5,
        }];
        waits.received(&own, SECOND);
        waits.received(&own, 2 * SECOND);
        waits.described(&own, &descriptor, 3 * SECOND);
        assert_eq!(waits.problems(90 * SECOND), []);
        // The next scene, of which no map comes.
        descriptor.streams = vec![Stream::Bev];
        waits.described(&own, &descriptor, 90 * SECOND);
        assert_eq!(waits.problems(94 * SECOND).len(), 1);
    }

    #[test]
    fn a_missing_stream_a_silent_agent_and_a_vehicle_that_is_gone_are_named() {
        let [own, other] = ["1", "2"].map(|name| CavId::new(name).unwrap());
        let mut waits = Waits::new(&own, "late", Stream::Boxes, false);
        let mut descriptor = descriptor(vec![Stream::Pose, Stream::Bev]);
        waits.described(&other, &descriptor, SECOND);
        let needs = "late needs boxes, agent 2 publishes pose, bev".to_owned();
        assert_eq!(waits.problems(SECOND), [(needs, SECOND)]);
        descriptor.streams = vec![Stream::Boxes];
        waits.described(&other, &descriptor, 2 * SECOND);
        assert_eq!(waits.problems(2 * SECOND), []);

        waits.received(&own, SECOND);
        waits.received(&own, 2 * SECOND);
        waits.left(&other, false, 4 * SECOND);
        assert_eq!(waits.problems(5 * SECOND), []);
        let named = [("no boxes of agent 1", 2), ("vehicle 2 is gone", 4)];
        let named = named.map(|(problem, since)| (problem.to_owned(), since * SECOND));
        assert_eq!(waits.problems(8 * SECOND), named);
        waits.received(&own, 8 * SECOND);
        waits.received(&other, 8 * SECOND);
        assert_eq!(waits.problems(8 * SECOND), []);

        let mut waits = Waits::new(&own, "max", Stream::Bev, true);
        for cav in [&own, &other] {
            waits.described(cav, &descriptor, SECOND);
        }
        let needs = "max needs bev, agent 1 publishes boxes".to_owned();
        assert_eq!(
            waits.problems(SECOND),
            [(needs, SECOND)],
            "a neighbour's boxes do"
        );
    }
}
