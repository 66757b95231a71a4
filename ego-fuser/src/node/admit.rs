//! Incoming messages: decoded, counted and queued.

use std::time::{Duration, Instant};

use bus::Arrival;
use protocol::message::{Bev, Boxes, Descriptor, Points};
use protocol::{CavId, DropReason, HEADER_LEN, PoseEstimate, Stamp, Stream, wire};

use super::{Node, OwnFrame, Received};
use crate::ego::{Content, View};
use crate::neighbourhood::sender_of;

/// Largest lead of a neighbour's message over the newest of the ego's own, nanoseconds: its computer may be faster.
const MAX_AHEAD_NANOS: u64 = 2_000_000_000;

impl Node<'_> {
    /// Admits a message: the own agent's begins a frame, a neighbour's is queued for one.
    pub(super) fn admit(&mut self, arrival: &Arrival) {
        let Some((cav, stream)) = sender_of(&arrival.topic) else {
            return;
        };
        if stream == Stream::Descriptor {
            return self.admit_descriptor(cav, arrival);
        }
        if *cav != self.cav && self.models.is_other(cav) {
            return self.bus.stats().dropped(&arrival.topic, DropReason::Shape);
        }
        if let Some(reason) = self.out_of_time(arrival).filter(|_| *cav != self.cav) {
            return self.bus.stats().dropped(&arrival.topic, reason);
        }
        let began = Instant::now();
        let Some((pose, content)) = self.decode(arrival) else {
            return;
        };
        self.bus.stats().timed("decode", began.elapsed());
        let transport = arrival.transport();
        self.bus
            .stats()
            .timed(&format!("{} transport", self.stream), transport);
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let view = View {
            cav: cav.clone(),
            pose,
            capture_nanos,
            content,
        };
        if *cav == self.cav {
            self.keep_time(capture_nanos);
            let agent_frame = arrival.header.stamp.sequence;
            // In the inbox, while another frame was fused, or behind one that waits for its neighbours.
            let waited = if self.frames.is_empty() {
                arrival.at.elapsed()
            } else {
                Duration::MAX
            };
            self.pace.judge(capture_nanos, waited);
            self.frames.push_back(OwnFrame {
                agent_frame,
                capture_nanos,
                transport,
                begun: arrival.at,
                view,
            });
            return;
        }
        if let Some(neighbourhood) = &mut self.neighbourhood {
            neighbourhood.received(cav);
        }
        let payload_bytes = u64::from(arrival.header.metadata_len) + arrival.header.body_len;
        let wire_bytes =
            payload_bytes + HEADER_LEN as u64 + pose_message_bytes(&arrival.header.stamp, pose);
        if let Some(lost) = self.pairing.insert(
            cav,
            capture_nanos,
            Received {
                view,
                payload_bytes,
                wire_bytes,
            },
        ) {
            self.bus.stats().dropped(&arrival.topic, lost.reason);
        }
    }

    /// Reason to drop a message by its time: it is in the future, later than the ego's own sweeps by more than its own
    /// agent may lag behind; or so old that no frame of the ego will use it.
    fn out_of_time(&self, arrival: &Arrival) -> Option<DropReason> {
        let capture_nanos = arrival.header.stamp.capture_nanos;
        let newest = self.own_nanos?;
        let oldest = self
            .frames
            .front()
            .map_or(newest, |frame| frame.capture_nanos);
        if capture_nanos > newest.saturating_add(MAX_AHEAD_NANOS) {
            Some(DropReason::Future)
        } else if capture_nanos.saturating_add(self.options.pairing.max_age_nanos) < oldest {
            Some(DropReason::Stale)
        } else {
            None
        }
    }

    /// Sets the clock by the ego's own sweeps. Where the scene restarts, all state is reset.
    fn keep_time(&mut self, capture_nanos: u64) {
        let max_age_nanos = self.options.pairing.max_age_nanos;
        if self
            .own_nanos
            .is_some_and(|own| capture_nanos.saturating_add(max_age_nanos) < own)
        {
            tracing::info!(capture_nanos, "the scene has restarted");
            for cav in self.pairing.cavs() {
                for _ in 0..self.pairing.turn_back(&cav, capture_nanos, MAX_AHEAD_NANOS) {
                    self.bus
                        .stats()
                        .dropped(&self.topic(&cav), DropReason::Stale);
                }
            }
            self.ego.forget();
        }
        self.own_nanos = Some(capture_nanos);
    }

    /// Processes an agent's descriptor. Maps of another network are left out from then on.
    fn admit_descriptor(&mut self, cav: &CavId, arrival: &Arrival) {
        let Some(descriptor) = self
            .inbox
            .decode::<Descriptor>(arrival, &self.options.limits)
        else {
            return;
        };
        let Some(other) = self.models.update(cav, &descriptor) else {
            return;
        };
        if *cav == self.cav {
            tracing::error!(%cav, "the ego's own agent runs another network than the ego: {other}");
            return;
        }
        tracing::warn!(%cav, "its maps are of another network and are left out: {other}");
        for _ in 0..self.pairing.forget(cav) {
            self.bus
                .stats()
                .dropped(&self.topic(cav), DropReason::Shape);
        }
    }

    /// Pose and content of a message; an invalid one is counted under its sender and reason.
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
                        self.bus.stats().rejected(&arrival.topic, &error);
                        None
                    }
                }
            }
        }
    }
}

/// Wire size of the neighbour's `pose` message for the same frame, bytes: its content equals the pose inside this one.
fn pose_message_bytes(stamp: &Stamp, pose: PoseEstimate) -> u64 {
    wire::encode(stamp, pose).map_or(0, |encoded| encoded.wire_bytes() as u64)
}
