//! Messages of an ego's loop: decoded, dated and queued.

use protocol::message::{Bev, Boxes, Descriptor, Points};
use protocol::{CavId, DropReason, HEADER_LEN, Header, Kind, Limits, Stream, WireError, wire};

use super::{EgoLoop, Message, Output, OwnFrame, Reception, Source};
use crate::capture_clock::SweepTime;
use crate::ego::{Content, Ego, View};
use crate::pairing::Dropped;

/// Largest lead of a neighbour's message over the newest of the ego's own, nanoseconds, beside the time since that arrived:
/// its computer may be faster.
const MAX_AHEAD_NANOS: u64 = 2_000_000_000;

/// Reason why a message is not decoded.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Refusal {
    /// No frame will use it.
    #[error("{0}")]
    Unneeded(DropReason),
    /// It is malformed.
    #[error(transparent)]
    Malformed(#[from] WireError),
}

impl EgoLoop {
    /// Decodes a vehicle's perception from its pieces on the wire.
    ///
    /// # Errors
    /// [`Refusal`] if no frame will use it, which is found out before the map is decoded, or if it is malformed.
    pub(crate) fn decode<'a>(
        &self,
        reception: &Reception,
        header: &Header,
        pieces: impl IntoIterator<Item = &'a [u8]>,
        limits: &Limits,
    ) -> Result<Message, Refusal> {
        let cav = &reception.cav;
        let is_boxes = header.kind == Kind::Boxes && self.reads_boxes && *cav != self.cav;
        let stream = if is_boxes { Stream::Boxes } else { self.stream };
        if *cav != self.cav {
            let times = [header.stamp.capture_nanos, reception.arrived_nanos];
            self.dated(cav, stream, times).map_err(Refusal::Unneeded)?;
        }
        let (pose, content) = match stream {
            Stream::Boxes => {
                let boxes: Boxes = wire::decode(pieces, limits)?.1;
                (boxes.pose, Content::Boxes(boxes.into_objects()))
            }
            Stream::Points => {
                let Points { pose, points } = wire::decode(pieces, limits)?.1;
                (pose, Content::Points(points))
            }
            _ => {
                let Bev { pose, features } = wire::decode(pieces, limits)?.1;
                // `decode` consumes the map, and a map that is malformed is reported as that first.
                let fits = self.models.check(&features);
                let map = features.decode(limits)?;
                fits?;
                (pose, Content::Features(map))
            }
        };
        let payload_bytes = u64::from(header.metadata_len) + header.body_len;
        // With the neighbour's `pose` message for the same frame: its content equals the pose inside this one.
        let pose_bytes =
            wire::encode(&header.stamp, pose).map_or(0, |encoded| encoded.wire_bytes());
        let view = View {
            cav: cav.clone(),
            pose,
            capture_nanos: header.stamp.capture_nanos,
            content,
        };
        Ok(Message {
            reception: reception.clone(),
            view,
            sequence: header.stamp.sequence,
            payload_bytes,
            wire_bytes: payload_bytes + (HEADER_LEN + pose_bytes) as u64,
        })
    }

    /// Takes a message in: the own agent's begins a frame, a neighbour's is queued for one.
    pub(super) fn take_in(&mut self, ego: &mut Ego, mut message: Message, now_nanos: u64) {
        let cav = message.view.cav.clone();
        let times = [message.view.capture_nanos, message.reception.arrived_nanos];
        self.waits.received(&cav, now_nanos);
        if cav == self.cav {
            return self.begin(ego, message, now_nanos);
        }
        let source = (cav.clone(), message.view.content.exchange().stream());
        self.published.insert(source.clone());
        // From here on the capture time is on the clock of the ego.
        match self.dated(&cav, source.1, times) {
            Ok(capture_nanos) => message.view.capture_nanos = capture_nanos,
            Err(reason) => return self.drop_message(source, reason),
        }
        // A map that comes after the ego's next sweep is no reason to wait for the next one.
        let capture_nanos = message.view.capture_nanos;
        let latest_nanos = capture_nanos.saturating_add(self.pairing.lead_nanos);
        if source.1 == self.stream && self.own_nanos.is_none_or(|own| own <= latest_nanos) {
            self.late_maps.reset(&cav);
        }
        if let Some(offset_s) = message.reception.clock_offset_s {
            self.clock_offsets_s.insert(cav.clone(), offset_s);
        }
        self.silence.reset(&cav);
        if let Some(lost) = self.pairing.insert(&source, capture_nanos, message) {
            self.drop_lost(lost);
        }
    }

    /// Begins a frame with the own agent's message.
    fn begin(&mut self, ego: &mut Ego, message: Message, now_nanos: u64) {
        let capture_nanos = message.view.capture_nanos;
        if let Some(own_nanos) = self.own_nanos {
            self.pairing
                .limit_lead(capture_nanos.saturating_sub(own_nanos));
        }
        self.keep_time(ego, capture_nanos);
        self.own_arrived_nanos = message.reception.arrived_nanos;
        // In the inbox, while another frame was fused, or behind one that waits for its neighbours.
        let waited_nanos = match self.frames.is_empty() {
            true => now_nanos.saturating_sub(message.reception.arrived_nanos),
            false => u64::MAX,
        };
        if self.options.sets_pace {
            let pace = self.pace.judge(capture_nanos, waited_nanos, now_nanos);
            self.outputs.extend(pace.map(Output::Pace));
        }
        self.frames.push_back(OwnFrame {
            agent_frame: message.sequence,
            transport: message.reception.transport,
            begun_nanos: message.reception.arrived_nanos,
            view: message.view,
        });
    }

    /// Capture time of a neighbour's message on the ego's clock, nanoseconds, of the stated one and the arrival.
    ///
    /// # Errors
    /// Reason to drop it: it is of another network; its clock is unsteady; it is in the future, later than the ego's own
    /// sweeps by more than its own agent may lag behind and the time since the newest of them; or it is so old that no frame
    /// of the ego will use it.
    fn dated(&self, cav: &CavId, stream: Stream, times: [u64; 2]) -> Result<u64, DropReason> {
        let [stated_nanos, arrived_nanos] = times;
        if stream == self.stream && self.models.other(cav).is_some() {
            return Err(DropReason::Shape);
        }
        let corrected = self.clocks.corrected(cav, stated_nanos);
        let capture_nanos = corrected.ok_or(DropReason::Clock)?;
        let Some(newest) = self.own_nanos else {
            return Ok(capture_nanos);
        };
        // A frame that still waits may use what is too old for the newest.
        let front = self.frames.front();
        let oldest = front.map_or(newest, |frame| frame.view.capture_nanos);
        // After a gap in a recording, which takes its time, the neighbour's map may be the first.
        let passed_nanos = arrived_nanos.saturating_sub(self.own_arrived_nanos);
        let ahead_nanos = passed_nanos.saturating_add(MAX_AHEAD_NANOS);
        if capture_nanos > newest.saturating_add(ahead_nanos) {
            Err(DropReason::Future)
        } else if capture_nanos.saturating_add(self.options.pairing.max_age_nanos) < oldest {
            Err(DropReason::Stale)
        } else {
            Ok(capture_nanos)
        }
    }

    /// Sets the clock by the ego's own sweeps. Where the scene restarts, all state is reset.
    fn keep_time(&mut self, ego: &mut Ego, capture_nanos: u64) {
        let max_age_nanos = self.options.pairing.max_age_nanos;
        let latest_nanos = capture_nanos.saturating_add(max_age_nanos);
        // An own sweep that is older by less than the largest age is no restart.
        if self.own_nanos.is_some_and(|own| latest_nanos < own) {
            tracing::info!(capture_nanos, "the scene has restarted");
            // A neighbour may restart before the ego: its first messages after that stay.
            for (source, gone) in self.pairing.turn_back(capture_nanos, MAX_AHEAD_NANOS) {
                self.drop_messages(&source, gone, DropReason::Stale);
            }
            self.fused_nanos.clear();
            ego.forget();
        }
        self.own_nanos = Some(capture_nanos);
    }

    /// Compares an agent's network with the ego's. Maps of another network are left out from then on, and frames of an own
    /// agent with another one fail.
    pub(super) fn compare_models(&mut self, cav: &CavId, descriptor: &Descriptor) {
        // Boxes and points belong to no network.
        let sends_maps = descriptor.streams.contains(&Stream::Bev);
        let perception = [Stream::Boxes, self.stream].into_iter();
        let sent = perception.filter(|stream| descriptor.streams.contains(stream));
        let sent = sent.map(|stream| (cav.clone(), stream));
        self.published.extend(sent);
        if self.stream != Stream::Bev || (self.reads_boxes && !sends_maps) {
            self.models.forget(cav);
            return;
        }
        let Some(other) = self.models.update(cav, descriptor) else {
            return;
        };
        // Of a neighbour that sends boxes beside its maps, these are read.
        let sends_boxes = descriptor.streams.contains(&Stream::Boxes);
        if sends_maps && (*cav == self.cav || !(self.reads_boxes && sends_boxes)) {
            let first = &mut self.report.other_network;
            first.get_or_insert_with(|| format!("agent {cav}: {other}"));
        }
        tracing::warn!(%cav, "its maps are of another network and are left out: {other}");
        self.empty(&(cav.clone(), Stream::Bev), DropReason::Shape);
    }

    /// Compares the capture clocks of two vehicles by the arrivals of their sweeps. Messages that wait under a capture
    /// time that is corrected otherwise now are dropped.
    pub(super) fn compare_clocks(&mut self, cav: &CavId, sweeps: &[SweepTime]) {
        for &sweep in sweeps {
            if *cav == self.cav {
                self.clocks.note_own(sweep);
            } else {
                self.clocks.note(cav, sweep);
            }
        }
        for cav in self.clocks.update() {
            self.empty_all(&cav, DropReason::Clock);
        }
    }

    /// Forgets a neighbour that has left.
    pub(super) fn forget(&mut self, cav: &CavId) {
        self.members.remove(cav);
        self.silence.reset(cav);
        self.models.forget(cav);
        self.published.retain(|(sender, _)| sender != cav);
        self.late_maps.reset(cav);
        self.clocks.forget(cav);
        self.clock_offsets_s.remove(cav);
        self.ended.remove(cav);
        self.empty_all(cav, DropReason::Stale);
        self.fused_nanos.remove(cav);
    }

    /// Drops the messages of a neighbour that wait.
    fn empty_all(&mut self, cav: &CavId, reason: DropReason) {
        for stream in self.neighbour_streams() {
            self.empty(&(cav.clone(), stream), reason);
        }
    }

    fn empty(&mut self, source: &Source, reason: DropReason) {
        let newest_nanos = self.pairing.capture_times(source).last();
        let reason = self.reason_of(source, newest_nanos.unwrap_or(0), reason);
        let unused = self.pairing.forget(source);
        self.drop_messages(source, unused, reason);
    }

    /// Drops a message that was not used.
    pub(super) fn drop_lost(&mut self, lost: Dropped<Source>) {
        let reason = self.reason_of(&lost.sender, lost.capture_nanos, lost.reason);
        self.drop_message(lost.sender, reason);
    }

    /// Reason why a message was not used. Boxes that came after the map of their sweep was fused are not missing.
    fn reason_of(&self, (cav, stream): &Source, capture_nanos: u64, why: DropReason) -> DropReason {
        // `None` is less than any time: nothing of this neighbour was fused.
        let is_fused = self.fused_nanos.get(cav) >= Some(&capture_nanos);
        match is_fused && *stream != self.stream {
            true => DropReason::Unneeded,
            false => why,
        }
    }

    pub(super) fn drop_message(&mut self, source: Source, reason: DropReason) {
        self.outputs.push(Output::Counted(source, Some(reason)));
    }

    fn drop_messages(&mut self, source: &Source, count: usize, reason: DropReason) {
        let dropped = (0..count).map(|_| Output::Counted(source.clone(), Some(reason)));
        self.outputs.extend(dropped);
    }
}
