//! Messages on their way in: decoded, counted, laid where they wait.

use std::time::{Duration, Instant};

use bus::{Arrival, unix_nanos};
use protocol::message::{Bev, Boxes, Descriptor, Points};
use protocol::{CavId, DropReason, HEADER_LEN, PoseEstimate, Stamp, Stream, wire};

use super::{Node, OwnFrame, Received};
use crate::ego::{Content, View};
use crate::neighbourhood::sender_of;

/// A neighbour's map may be of so much later a time than the newest of the ego's own, nanoseconds: its computer is faster.
const MAX_AHEAD_NANOS: u64 = 2_000_000_000;

impl Node<'_> {
    /// Takes a message in: the own agent's begins a frame, a neighbour's waits for one.
    pub(super) fn admit(&mut self, arrival: &Arrival) {
        let Some((cav, stream)) = sender_of(&arrival.topic) else { return };
        if stream == Stream::Descriptor {
            return self.hear_of(cav, arrival);
        }
        if *cav != self.cav && self.models.is_other(cav) {
            return self.bus.books().dropped(&arrival.topic, DropReason::Shape);
        }
        if let Some(reason) = self.out_of_time(arrival).filter(|_| *cav != self.cav) {
            return self.bus.books().dropped(&arrival.topic, reason);
        }
        let began = Instant::now();
        let Some((pose, content)) = self.decode(arrival) else { return };
        self.bus.books().timed("decode", began.elapsed());
        let transport = Duration::from_nanos(unix_nanos().saturating_sub(arrival.header.stamp.publish_nanos));
        // Decoding, which lies between arrival and now, is part of the wait.
        let transport = transport.saturating_sub(arrival.at.elapsed());
        self.bus.books().timed(&format!("{} transport", self.stream), transport);
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let view = View { cav: cav.clone(), pose, capture_nanos, content };
        if *cav == self.cav {
            self.keep_time(capture_nanos);
            let agent_frame = arrival.header.stamp.sequence;
            self.frames.push_back(OwnFrame { agent_frame, capture_nanos, transport, begun: arrival.at, view });
            return;
        }
        if let Some(neighbourhood) = &mut self.neighbourhood {
            neighbourhood.spoke(cav);
        }
        let payload_bytes = u64::from(arrival.header.metadata_len) + arrival.header.body_len;
        let wire_bytes = payload_bytes + HEADER_LEN as u64 + pose_message_bytes(&arrival.header.stamp, pose);
        if let Some(lost) = self.pairing.insert(cav, capture_nanos, Received { view, payload_bytes, wire_bytes }) {
            self.bus.books().dropped(&arrival.topic, lost.reason);
        }
    }

    /// Whether a message tells of a time that has not come, later than the ego's own sweeps by more than its own agent may
    /// lag behind; or of one that no frame of the ego asks for any more.
    fn out_of_time(&self, arrival: &Arrival) -> Option<DropReason> {
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let newest = self.own_nanos?;
        let oldest = self.frames.front().map_or(newest, |frame| frame.capture_nanos);
        if capture_nanos > newest.saturating_add(MAX_AHEAD_NANOS) {
            Some(DropReason::Future)
        } else if capture_nanos.saturating_add(self.options.pairing.max_age_nanos) < oldest {
            Some(DropReason::Stale)
        } else {
            None
        }
    }

    /// The ego's own sweeps say what time it is. Where they begin anew, so does everything.
    fn keep_time(&mut self, capture_nanos: u64) {
        let max_age_nanos = self.options.pairing.max_age_nanos;
        if self.own_nanos.is_some_and(|own| capture_nanos.saturating_add(max_age_nanos) < own) {
            tracing::info!(capture_nanos, "the scene has begun anew");
            for cav in self.pairing.cavs() {
                for _ in 0..self.pairing.turn_back(&cav, capture_nanos, MAX_AHEAD_NANOS) {
                    self.bus.books().dropped(&self.topic(&cav), DropReason::Stale);
                }
            }
            self.ego.forget();
        }
        self.own_nanos = Some(capture_nanos);
    }

    /// Takes in what an agent says of itself. The maps of another network are left out from then on.
    fn hear_of(&mut self, cav: &CavId, arrival: &Arrival) {
        let Some(descriptor) = self.inbox.decode::<Descriptor>(arrival, &self.options.limits) else { return };
        let Some(other) = self.models.hear(cav, &descriptor) else { return };
        if *cav == self.cav {
            tracing::error!(%cav, "the ego's own agent runs another network than the ego: {other}");
            return;
        }
        tracing::warn!(%cav, "its maps are of another network and are left out: {other}");
        for _ in 0..self.pairing.forget(cav) {
            self.bus.books().dropped(&self.topic(cav), DropReason::Shape);
        }
    }

    /// Pose and content of a message; an unsound one is counted under its sender and reason.
    fn decode(&self, arrival: &Arrival) -> Option<(PoseEstimate, Content)> {
        let limits = &self.options.limits;
        match self.stream {
            Stream::Boxes => {
                let Boxes { pose, detections } = self.inbox.decode(arrival, limits)?;
                Some((pose, Content::Boxes(detections)))
            }
            Stream::Points => {
                let Points { pose, points } = self.inbox.decode(arrival, limits)?;
                Some((pose, Content::Points(points)))
            }
            _ => {
                let Bev { pose, features } = self.inbox.decode(arrival, limits)?;
                let fits = self.models.check(&features);
                let decoded = features.decode(limits).and_then(|map| fits.map(|()| map));
                match decoded {
                    Ok(features) => Some((pose, Content::Features(features))),
                    Err(error) => {
                        self.bus.books().rejected(&arrival.topic, &error);
                        None
                    }
                }
            }
        }
    }
}

/// What the neighbour's `pose` message for the same frame took: it says the same as the pose inside this one.
fn pose_message_bytes(stamp: &Stamp, pose: PoseEstimate) -> u64 {
    wire::encode(stamp, pose).map_or(0, |encoded| encoded.wire_bytes() as u64)
}
