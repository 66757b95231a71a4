//! Traffic of each link over a recorded run: rate, time on the link and backlog, from one scene frame to the next.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{CavId, HEADER_LEN, Stream, Topic};
use recording::Entry;
use serde::Serialize;

use crate::score::ms_between;

/// Traffic of the link from one vehicle to an ego, for one scene frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct LinkTraffic {
    /// The sender.
    pub from: CavId,
    /// Bytes of its messages for this frame.
    pub sent_bytes: u64,
    /// From publication to arrival of the last of these, milliseconds; `None`: a message of perception did not arrive.
    pub transit_ms: Option<f64>,
    /// Bytes that were on their way when the tick was published: of earlier messages, those that arrived later.
    /// Messages that were lost do not count.
    pub waiting_bytes: Option<u64>,
}

/// Messages of all links to one ego.
#[derive(Debug, Default)]
pub(super) struct LinkSeries(BTreeMap<CavId, LinkMessages>);

#[derive(Debug, Default)]
struct LinkMessages {
    /// Streams but the pose, and bytes, by capture time.
    sent: BTreeMap<u64, (BTreeSet<Stream>, u64)>,
    /// The same streams as far as they arrived, and the longest time to arrival, milliseconds, by capture time.
    transits: BTreeMap<u64, (BTreeSet<Stream>, f64)>,
    /// Bytes of those that arrived, by time of publication.
    published: Vec<(u64, u64)>,
    /// The same by time of arrival.
    arrived: Vec<(u64, u64)>,
}

impl LinkSeries {
    /// Collects the messages to `ego`. Where there is no link emulation, they arrive when the recorder has them.
    pub(super) fn new(entries: &[Entry], ego: &CavId) -> Self {
        let mut topics = entries.iter().map(|entry| &entry.key.topic);
        let is_emulated =
            topics.any(|topic| matches!(topic, Topic::Received { ego: to, .. } if to == ego));
        let mut series = Self::default();
        for entry in entries {
            let (cav, stream, is_sent, is_arrived) = match &entry.key.topic {
                Topic::Stream { cav, stream } if cav != ego => (cav, *stream, true, !is_emulated),
                Topic::Received {
                    cav,
                    stream,
                    ego: to,
                } if to == ego => (cav, *stream, false, true),
                _ => continue,
            };
            if ![Stream::Pose, Stream::Bev, Stream::Boxes, Stream::Points].contains(&stream) {
                continue;
            }
            let link = series.0.entry(cav.clone()).or_default();
            let (stamp, bytes) = (&entry.header.stamp, bytes(entry));
            // A message of perception has its pose too.
            let perception = Some(stream).filter(|stream| *stream != Stream::Pose);
            if is_sent {
                let (streams, sum) = link.sent.entry(stamp.capture_nanos).or_default();
                streams.extend(perception);
                *sum += bytes;
            }
            if is_arrived {
                let transit_ms = ms_between(stamp.publish_nanos, entry.arrived_nanos);
                let transit = link.transits.entry(stamp.capture_nanos);
                let (streams, longest_ms) = transit.or_insert((BTreeSet::new(), transit_ms));
                streams.extend(perception);
                *longest_ms = longest_ms.max(transit_ms);
                link.published.push((stamp.publish_nanos, bytes));
                link.arrived.push((entry.arrived_nanos, bytes));
            }
        }
        // Poses alone, where the rest is not recorded, are not the traffic of a link.
        series.0.retain(|_, link| {
            let sent = link.sent.values().map(|(streams, _)| streams);
            let arrived = link.transits.values().map(|(streams, _)| streams);
            sent.chain(arrived).any(|streams| !streams.is_empty())
        });
        for link in series.0.values_mut() {
            accumulate(&mut link.published);
            accumulate(&mut link.arrived);
        }
        series
    }

    /// Traffic of every link for the frame of a capture time, whose tick was published at `began_nanos`.
    pub(super) fn at(&self, capture_nanos: u64, began_nanos: Option<u64>) -> Vec<LinkTraffic> {
        let traffic = self.0.iter().map(|(from, link)| {
            let sent = link.sent.get(&capture_nanos);
            let transit = link.transits.get(&capture_nanos);
            let has_all = |arrived| sent.is_none_or(|(sent, _)| sent.is_subset(arrived));
            LinkTraffic {
                from: from.clone(),
                sent_bytes: sent.map_or(0, |(_, bytes)| *bytes),
                transit_ms: transit.and_then(|(arrived, ms)| has_all(arrived).then_some(*ms)),
                // What was published less what has arrived is on its way. With two clocks a message can arrive
                // before it is published, and the difference stays at 0.
                waiting_bytes: began_nanos.map(|now| {
                    until(&link.published, now).saturating_sub(until(&link.arrived, now))
                }),
            }
        });
        traffic.collect()
    }
}

fn bytes(entry: &Entry) -> u64 {
    HEADER_LEN as u64 + u64::from(entry.header.metadata_len) + entry.header.body_len
}

/// Sorts by time and replaces bytes by the sum of all bytes so far.
fn accumulate(messages: &mut [(u64, u64)]) {
    messages.sort_unstable();
    let mut sum = 0_u64;
    for (_, bytes) in messages {
        sum = sum.saturating_add(*bytes);
        *bytes = sum;
    }
}

/// Sum of the bytes until a time, which counts.
fn until(accumulated: &[(u64, u64)], nanos: u64) -> u64 {
    let count = accumulated.partition_point(|(at, _)| *at <= nanos);
    accumulated[..count].last().map_or(0, |(_, sum)| *sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_transit_of_a_sweep_is_not_that_of_its_pose_where_its_map_is_lost() {
        let map = BTreeSet::from([Stream::Bev]);
        let link = LinkMessages {
            sent: [1, 2].map(|tick| (tick, (map.clone(), 900))).into(),
            transits: [(1, (map, 300.0)), (2, (BTreeSet::new(), 2.0))].into(),
            ..LinkMessages::default()
        };
        let series = LinkSeries([(CavId::new("2").unwrap(), link)].into());
        let at = |tick| series.at(tick, None).remove(0);
        assert_eq!((at(1).sent_bytes, at(1).transit_ms), (900, Some(300.0)));
        assert_eq!((at(2).sent_bytes, at(2).transit_ms), (900, None));
    }

    #[test]
    fn the_backlog_is_what_was_published_and_has_not_arrived() {
        // 100 bytes at 10, 200 at 20 and 300 at 30; they arrive in another order.
        let mut published = [(20, 200), (10, 100), (30, 300)];
        let mut arrived = [(25, 100), (60, 200), (40, 300)];
        accumulate(&mut published);
        accumulate(&mut arrived);
        assert_eq!(
            [0, 10, 24, 25, 30, 40, 60].map(|now| until(&published, now) - until(&arrived, now)),
            [0, 100, 300, 200, 500, 200, 0]
        );
    }
}
