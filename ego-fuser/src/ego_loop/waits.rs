//! Waits of an ego: missing messages and streams, for its status.

use std::collections::BTreeMap;

use protocol::message::Descriptor;
use protocol::{CavId, Stream};

/// Time after which a wait is a problem, nanoseconds.
const AFTER_NANOS: u64 = 3_000_000_000;
/// Largest number of vehicles of a kind.
const MAX_VEHICLES: usize = 64;

/// Messages, streams and vehicles that an ego waits for, each with the time of the beginning, nanoseconds.
pub(super) struct Waits {
    ego: CavId,
    /// Method and the stream that it needs.
    method: String,
    stream: Stream,
    /// True if boxes of a neighbour do in place of that stream.
    reads_boxes: bool,
    /// Last message of its own agent, or the first report of a sweep that it has.
    own_nanos: Option<u64>,
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
        }
    }

    /// Records a vehicle's descriptor: the streams that it publishes, and that it has sweeps.
    pub(super) fn described(&mut self, cav: &CavId, descriptor: &Descriptor, now_nanos: u64) {
        let streams = &descriptor.streams;
        self.gone.remove(cav);
        // From the first sweep on: an agent without sweeps has nothing to send yet.
        if *cav == self.ego && !descriptor.sweeps.is_empty() {
            self.own_nanos.get_or_insert(now_nanos);
        }
        let sends_boxes = streams.contains(&Stream::Boxes) && *cav != self.ego;
        if streams.contains(&self.stream) || (self.reads_boxes && sends_boxes) {
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
        if !has_ended && self.gone.len() < MAX_VEHICLES {
            self.gone.insert(cav.clone(), now_nanos);
        }
    }

    /// Waits of three seconds and more, and streams that are missing.
    pub(super) fn problems(&self, now_nanos: u64) -> Vec<(String, u64)> {
        let Self { ego, stream, .. } = self;
        let late_before = now_nanos.saturating_sub(AFTER_NANOS);
        // An agent that publishes other streams is named for that instead.
        let own_nanos = self.own_nanos.filter(|_| !self.without.contains_key(ego));
        let no_own = own_nanos.filter(|since| *since < late_before);
        let no_own = no_own.map(|since| (format!("no {stream} of agent {ego}"), since));
        let without = self.without.iter().map(|(cav, (published, since))| {
            let method = &self.method;
            let problem = format!("{method} needs {stream}, agent {cav} publishes {published}");
            (problem, *since)
        });
        let gone = self.gone.iter().filter(|(_, since)| **since < late_before);
        let gone = gone.map(|(cav, since)| (format!("vehicle {cav} is gone"), *since));
        no_own.into_iter().chain(without).chain(gone).collect()
    }
}

#[cfg(test)]
mod tests {
    use protocol::message::ModelHash;
    use protocol::{BevGrid, Dtype};

    use super::*;

    const SECOND: u64 = 1_000_000_000;

    #[test]
    fn a_missing_stream_a_silent_agent_and_a_vehicle_that_is_gone_are_named() {
        let [own, other] = ["1", "2"].map(|name| CavId::new(name).unwrap());
        let mut waits = Waits::new(&own, "late", Stream::Boxes, false);
        let mut descriptor = Descriptor {
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
            streams: vec![Stream::Pose, Stream::Bev],
            sweeps: vec![],
        };
        waits.described(&other, &descriptor, SECOND);
        let needs = "late needs boxes, agent 2 publishes pose, bev".to_owned();
        assert_eq!(waits.problems(SECOND), [(needs, SECOND)]);
        descriptor.streams = vec![Stream::Boxes];
        waits.described(&other, &descriptor, 2 * SECOND);
        assert_eq!(waits.problems(2 * SECOND), []);

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
