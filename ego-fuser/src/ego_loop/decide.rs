//! Frames of an ego's loop: end of the wait, selection of messages, fusion and report.

use std::time::Duration;

use protocol::message::{FusedNeighbour, NeighbourState, SkippedNeighbour, StageTiming};
use protocol::text::{MAX_MESSAGE_BYTES, printable};
use protocol::{Detections, DropReason, HEADER_LEN, Stream};

use super::{EgoLoop, Output, OwnFrame, Source};
use crate::ego::{Ego, EgoError, View};
use crate::misbehaviour::Assessment;

/// The neighbours' messages for a frame, and the neighbours without one.
#[derive(Default)]
struct Choice {
    views: Vec<View>,
    /// One for each view.
    messages: Vec<MessageInfo>,
    skipped: Vec<SkippedNeighbour>,
}

/// Fields of a message for accounting and report.
struct MessageInfo {
    stream: Stream,
    is_first_use: bool,
    payload_bytes: u64,
    wire_bytes: u64,
}

impl EgoLoop {
    /// Decides the oldest frame if it waits for nothing more, and ends the loop after the last.
    pub(super) fn wake(&mut self, ego: &mut Ego, now_nanos: u64) {
        if let Some(pace) = self.pace.repeat(now_nanos) {
            self.outputs.push(Output::Pace(pace));
        }
        let is_over = self.ends_nanos.is_some_and(|ends| now_nanos >= ends);
        if let Some(frame) = self.frames.front() {
            let is_complete = self.is_complete(frame.view.capture_nanos);
            if is_over || now_nanos >= self.due_nanos(frame) {
                self.report.at_deadline += u64::from(!is_complete);
                if let Some(frame) = self.frames.pop_front() {
                    self.fuse(ego, frame, now_nanos);
                }
            }
        }
        let has_ended =
            self.ends_nanos.is_some() && (is_over || self.members.is_subset(&self.ended));
        if has_ended && self.frames.is_empty() {
            // Messages that wait for a frame that will not come are counted: at the end of time every message is too
            // old, so that all that were not used are returned.
            let (_, dropped) = self.pairing.pair(u64::MAX);
            for lost in dropped {
                self.drop_lost(lost);
            }
            self.is_finished = true;
        }
    }

    /// Time at which the oldest frame waits for nothing more; 0: it does not wait.
    pub(super) fn due_nanos(&self, frame: &OwnFrame) -> u64 {
        // A frame followed by a newer one has waited too long already.
        if self.frames.len() > 1 || self.is_complete(frame.view.capture_nanos) {
            return 0;
        }
        let deadline_nanos = self.options.deadline_nanos;
        frame.begun_nanos.saturating_add(deadline_nanos)
    }

    fn is_complete(&self, capture_nanos: u64) -> bool {
        self.members.iter().all(|cav| {
            let [maps, boxes] = [self.stream, Stream::Boxes].map(|stream| (cav.clone(), stream));
            let is_other = self.models.other(cav).is_some();
            // Its feature maps came before the ego's next sweep lately.
            let is_in_time = self.published.contains(&maps) && self.late_maps.is_awaited(cav);
            // Boxes end the wait for maps that are of another network, or not in time.
            let boxes_do =
                self.reads_boxes && self.published.contains(&boxes) && (is_other || !is_in_time);
            !self.silence.is_awaited(cav)
                || self.ended.contains(cav)
                || self.pairing.has_reached(&maps, capture_nanos)
                || if boxes_do {
                    self.pairing.has_reached(&boxes, capture_nanos)
                } else {
                    is_other
                }
        })
    }

    fn fuse(&mut self, ego: &mut Ego, frame: OwnFrame, now_nanos: u64) {
        let own = frame.view;
        let waited = Duration::from_nanos(now_nanos.saturating_sub(frame.begun_nanos));
        let mut choice = self.choose(own.capture_nanos);
        // A map of another network on the same grid gives boxes, but not those that are there.
        let other = self.models.other(&self.cav);
        let other = other.map(|other| format!("own agent of another network: {other}"));
        let error = other.map(EgoError::OwnView);
        match error.map_or_else(|| ego.detect(&own, &choice.views), Err) {
            Ok(output) => {
                self.report.refused_boxes += output.refused_boxes;
                self.report.refused_velocities += output.refused_velocities;
                let neighbours = self.states(&output.beliefs, &choice.views);
                let own_source = self.own_source();
                self.outputs.push(Output::Counted(own_source, None));
                self.leave_out(&output.skipped, &output.fused, &mut choice);
                let fused = self.mark_used(&own, &output.fused, &choice);
                let transport = frame
                    .transport
                    .map(|transport| StageTiming::new("transport", transport));
                let (wait, stages) = (StageTiming::new("wait", waited), output.stages);
                let result = Detections {
                    ego: self.cav.clone(),
                    agent_frame: frame.agent_frame,
                    method: printable(ego.method().name(), MAX_MESSAGE_BYTES),
                    pose: own.pose,
                    detections: output.detections,
                    fused,
                    skipped: choice.skipped,
                    neighbours,
                    stages: transport.into_iter().chain([wait]).chain(stages).collect(),
                };
                self.report.frames += 1;
                let tracker = self.tracker.as_mut();
                let tracks = tracker.map(|tracker| tracker.follow(own.capture_nanos, &result));
                self.outputs.push(Output::Publish {
                    capture_nanos: own.capture_nanos,
                    result: Box::new(result),
                    tracks,
                });
            }
            Err(error) => {
                self.report.failed += 1;
                self.report.failure.get_or_insert_with(|| error.to_string());
                let reason = match error.is_of_frame() {
                    true => DropReason::NotFinite,
                    false => DropReason::Shape,
                };
                self.drop_message(self.own_source(), reason);
                // The neighbours' messages are valid.
                let all: Vec<usize> = (0..choice.views.len()).collect();
                self.mark_used(&own, &all, &choice);
                self.outputs.push(Output::Failed {
                    capture_nanos: own.capture_nanos,
                    error,
                });
            }
        }
    }

    fn own_source(&self) -> Source {
        (self.cav.clone(), self.stream)
    }

    /// States of the neighbours whose messages were received for a frame, one for each view.
    fn states(&self, beliefs: &[(usize, Assessment)], views: &[View]) -> Vec<NeighbourState> {
        let mut states = Vec::with_capacity(views.len());
        for (index, view) in views.iter().enumerate() {
            let mut state = NeighbourState::new(view.cav.clone());
            state.clock_offset_s = self.clock_offsets_s.get(&view.cav).copied();
            if let Some((_, assessment)) = beliefs.iter().find(|(of, _)| *of == index) {
                state.trust = Some(assessment.trust);
                state.misbehaviour = assessment.misbehaviour;
            }
            states.push(state);
        }
        self.clocks.describe(&mut states);
        states
    }

    /// The neighbours' messages for a frame, and the neighbours without one.
    fn choose(&mut self, capture_nanos: u64) -> Choice {
        let (paired, dropped) = self.pairing.pair(capture_nanos);
        let mut choice = Choice::default();
        for paired in paired {
            // A copy, as the message may serve the next frame too.
            choice.views.push(paired.message.view.clone());
            choice.messages.push(MessageInfo {
                stream: paired.sender.1,
                is_first_use: paired.is_first_use,
                payload_bytes: paired.message.payload_bytes,
                wire_bytes: paired.message.wire_bytes,
            });
        }
        for lost in dropped.iter().cloned() {
            self.drop_lost(lost);
        }
        for cav in &self.members {
            let source = (cav.clone(), self.stream);
            if self.published.contains(&source) && !self.pairing.has_reached(&source, capture_nanos)
            {
                self.late_maps.missed(cav);
            }
            // One message of any stream is enough: the neighbour is neither silent nor left out.
            if choice.views.iter().any(|view| view.cav == *cav) {
                continue;
            }
            self.silence.missed(cav);
            let lost = dropped.iter().rev().find(|lost| lost.sender.0 == *cav);
            let reason = match self.models.other(cav) {
                Some(_) => Some(DropReason::Shape),
                None => lost.map(|lost| lost.reason),
            };
            let cav = cav.clone();
            choice.skipped.push(SkippedNeighbour { cav, reason });
        }
        choice
    }

    /// Counts the messages of the views at `fused` as received, and describes their neighbours.
    fn mark_used(&mut self, own: &View, fused: &[usize], choice: &Choice) -> Vec<FusedNeighbour> {
        self.report.fused += fused.len() as u64;
        let mut described: Vec<FusedNeighbour> = Vec::with_capacity(fused.len());
        for &index in fused {
            let (view, message) = (&choice.views[index], &choice.messages[index]);
            if message.stream == self.stream {
                let cav = view.cav.clone();
                self.fused_nanos.insert(cav, view.capture_nanos);
            } else {
                self.report.fused_boxes += 1;
            }
            self.count(view, message, None);
            let age_nanos = view.age_nanos(own);
            // A neighbour is one, also by two messages: its boxes are read beside its map.
            match described.iter_mut().find(|known| known.cav == view.cav) {
                Some(known) => {
                    // Two messages of one sweep share its pose message, which counts once.
                    known.wire_bytes += match known.age_nanos == age_nanos {
                        true => message.payload_bytes + HEADER_LEN as u64,
                        false => message.wire_bytes,
                    };
                    known.age_nanos = known.age_nanos.max(age_nanos);
                    known.payload_bytes += message.payload_bytes;
                }
                None => described.push(FusedNeighbour {
                    cav: view.cav.clone(),
                    age_nanos,
                    confidence: view.pose.confidence(),
                    payload_bytes: message.payload_bytes,
                    wire_bytes: message.wire_bytes,
                }),
            }
        }
        described
    }

    /// Counts the views that are not in the result, and names those that should have been.
    fn leave_out(
        &mut self,
        left_out: &[(usize, Option<DropReason>)],
        fused: &[usize],
        choice: &mut Choice,
    ) {
        // Without a reason a view was evaluated, and rightly left out.
        for &(index, reason) in left_out {
            let view = &choice.views[index];
            self.count(view, &choice.messages[index], reason);
            // A neighbour that is in the result by another message is not left out.
            if reason.is_some() && !fused.iter().any(|&one| choice.views[one].cav == view.cav) {
                let cav = view.cav.clone();
                choice.skipped.push(SkippedNeighbour { cav, reason });
            }
        }
    }

    /// Counts a message at its first use.
    fn count(&mut self, view: &View, message: &MessageInfo, reason: Option<DropReason>) {
        if message.is_first_use {
            let source = (view.cav.clone(), message.stream);
            self.outputs.push(Output::Counted(source, reason));
        }
    }
}
