//! Incoming messages: decoded, counted and queued.

use std::time::{Duration, Instant};

use bus::{Arrival, LINK_TRANSIT_S, NETWORK_TRANSIT_S};
use protocol::message::{Bev, Boxes, Descriptor, Points, SweepArrival};
use protocol::{CavId, DropReason, HEADER_LEN, PoseEstimate, Stamp, Stream, wire};

use super::{Node, OwnFrame, Received};
use crate::capture_clock::SweepTime;
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
        let stated_nanos = arrival.header.stamp.capture_nanos;
        let timed = if *cav == self.cav {
            Ok(stated_nanos)
        } else {
            self.in_time(cav, stated_nanos)
        };
        let capture_nanos = match timed {
            Ok(capture_nanos) => capture_nanos,
            Err(reason) => return self.bus.stats().dropped(&arrival.topic, reason),
        };
        let began = Instant::now();
        let Some((pose, content)) = self.decode(arrival) else {
            return;
        };
        self.bus.stats().timed("decode", began.elapsed());
        let transport = self
            .bus
            .stats()
            .transport(arrival, self.longest_transit_s());
        if let Some(transport) = transport {
            let stage = format!("{} transport", self.stream);
            self.bus.stats().timed(&stage, transport);
        }
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

    /// Capture time of a neighbour's message on the ego's clock, nanoseconds.
    ///
    /// # Errors
    /// Reason to drop it: its clock is unsteady; it is in the future, later than the ego's own sweeps by more than its
    /// own agent may lag behind; or it is so old that no frame of the ego will use it.
    fn in_time(&self, cav: &CavId, stated_nanos: u64) -> Result<u64, DropReason> {
        let corrected = self.clocks.corrected(cav, stated_nanos);
        let capture_nanos = corrected.ok_or(DropReason::Clock)?;
        let Some(newest) = self.own_nanos else {
            return Ok(capture_nanos);
        };
        let oldest = self
            .frames
            .front()
            .map_or(newest, |frame| frame.capture_nanos);
        if capture_nanos > newest.saturating_add(MAX_AHEAD_NANOS) {
            Err(DropReason::Future)
        } else if capture_nanos.saturating_add(self.options.pairing.max_age_nanos) < oldest {
            Err(DropReason::Stale)
        } else {
            Ok(capture_nanos)
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
        self.compare_clocks(cav, arrival.header.stamp.capture_nanos, &descriptor.sweeps);
        // Boxes and points belong to no network.
        if self.stream != Stream::Bev {
            return;
        }
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

    /// Longest transit time of a message, seconds; the own agent's, which takes no link, has one clock with the ego.
    fn longest_transit_s(&self) -> f64 {
        if self.options.over_link {
            LINK_TRANSIT_S
        } else {
            NETWORK_TRANSIT_S
        }
    }

    /// Compares the capture clocks of two vehicles by the arrivals of their sweeps. Messages that wait under a capture
    /// time that is corrected otherwise now are dropped.
    fn compare_clocks(&mut self, cav: &CavId, newest_nanos: u64, sweeps: &[SweepArrival]) {
        let offset_s = self
            .bus
            .stats()
            .system_clock_offset_s(cav, self.longest_transit_s());
        let offset_nanos = (offset_s * 1e9) as i64;
        for sweep in sweeps {
            let time = SweepTime {
                capture_nanos: newest_nanos.saturating_sub(sweep.before_nanos),
                arrived_nanos: sweep.arrived_nanos.saturating_sub_signed(offset_nanos),
            };
            if *cav == self.cav {
                self.clocks.note_own(time);
            } else {
                self.clocks.note(cav, time);
            }
        }
        for cav in self.clocks.update() {
            for _ in 0..self.pairing.forget(&cav) {
                self.bus
                    .stats()
                    .dropped(&self.topic(&cav), DropReason::Clock);
            }
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
