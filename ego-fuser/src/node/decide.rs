//! Outgoing frames: end of the wait, selection of messages, fusion and report.

use std::time::Duration;

use bus::unix_nanos;
use protocol::message::{
    DetectionsReport, FusedNeighbour, NeighbourState, SkippedNeighbour, StageTiming,
};
use protocol::{Body, CavId, Detections, DropReason, Encoded, wire};

use super::{Node, OwnFrame};
use crate::ego::{EgoOutput, Skipped, View};
use crate::misbehaviour::{self, Assessment};
use crate::neighbourhood::Neighbourhood;
use crate::pairing::Paired;

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
    is_first_use: bool,
    payload_bytes: u64,
    wire_bytes: u64,
}

impl Node<'_> {
    /// Decides the frames that wait for nothing more; all of them where `must`.
    pub(super) fn decide(&mut self, must: bool) {
        while let Some(frame) = self.frames.front() {
            let is_complete = self.is_complete(frame.capture_nanos);
            // A frame followed by a newer one has waited too long already.
            let is_due =
                frame.begun.elapsed() >= self.options.deadline || self.frames.len() > 1 || must;
            if !is_complete && !is_due {
                return;
            }
            self.report.at_deadline += u64::from(!is_complete);
            if let Some(frame) = self.frames.pop_front() {
                self.fuse(frame);
            }
        }
    }

    fn is_complete(&self, capture_nanos: u64) -> bool {
        self.neighbourhood
            .iter()
            .flat_map(Neighbourhood::awaited)
            .all(|cav| {
                self.ended.contains(cav)
                    || self.models.is_other(cav)
                    || self.pairing.has_reached(cav, capture_nanos)
            })
    }

    fn fuse(&mut self, frame: OwnFrame) {
        let OwnFrame {
            agent_frame,
            capture_nanos,
            transport,
            begun,
            view: own,
        } = frame;
        let waited = begun.elapsed();
        let mut choice = self.choose(capture_nanos);
        let own_topic = self.topic(&self.cav);
        match self.ego.detect(&own, &choice.views) {
            Ok(EgoOutput {
                detections,
                fused,
                skipped,
                beliefs,
                stages,
            }) => {
                let neighbours = self.neighbour_reports(&beliefs, &choice.views);
                self.bus.stats().received(&own_topic);
                self.leave_out(&skipped, &mut choice);
                let fused = self.take_in(&own, &fused, &choice);
                let transport = transport.map(|transport| StageTiming::new("transport", transport));
                let wait = StageTiming::new("wait", waited);
                let stages = transport.into_iter().chain([wait]).chain(stages).collect();
                let result = Detections {
                    ego: self.cav.clone(),
                    agent_frame,
                    method: self.ego.method().name().to_owned(),
                    pose: own.pose,
                    detections,
                    fused,
                    skipped: choice.skipped,
                    neighbours,
                    stages,
                };
                self.publish(capture_nanos, result);
            }
            Err(error) => {
                tracing::error!(capture_nanos, "a frame could not be fused: {error}");
                self.report.failed += 1;
                let first = &mut self.report.failure;
                first.get_or_insert_with(|| error.to_string());
                let reason = match error.is_of_frame() {
                    true => DropReason::NotFinite,
                    false => DropReason::Shape,
                };
                self.bus.stats().dropped(&own_topic, reason);
                // The neighbours' messages are valid.
                self.take_in(&own, &(0..choice.views.len()).collect::<Vec<_>>(), &choice);
            }
        }
    }

    /// Report of the neighbours received for a frame.
    fn neighbour_reports(
        &self,
        assessments: &[(usize, Assessment)],
        views: &[View],
    ) -> Vec<NeighbourState> {
        let stats = self.bus.stats();
        for (index, assessment) in assessments {
            stats.trusted(&views[*index].cav, assessment.trust);
        }
        let clocks = stats.peers();
        let clock = |cav: &CavId| clocks.iter().find(|peer| peer.cav == *cav)?.clock_offset_s;
        let reports = misbehaviour::neighbour_states(assessments, views).into_iter();
        let mut reports: Vec<NeighbourState> = reports
            .map(|neighbour| NeighbourState {
                clock_offset_s: clock(&neighbour.cav),
                ..neighbour
            })
            .collect();
        self.clocks.describe(&mut reports);
        reports
    }

    /// The neighbours' messages for a frame, and the neighbours without one.
    fn choose(&mut self, capture_nanos: u64) -> Choice {
        let (paired, dropped) = self.pairing.pair(capture_nanos);
        let mut choice = Choice::default();
        for Paired {
            is_first_use,
            message,
            ..
        } in paired
        {
            // A copy, as the message may serve the next frame too.
            choice.views.push(message.view.clone());
            let (payload_bytes, wire_bytes) = (message.payload_bytes, message.wire_bytes);
            choice.messages.push(MessageInfo {
                is_first_use,
                payload_bytes,
                wire_bytes,
            });
        }
        for lost in &dropped {
            self.bus
                .stats()
                .dropped(&self.topic(&lost.cav), lost.reason);
        }
        let Some(neighbourhood) = &mut self.neighbourhood else {
            return choice;
        };
        let has_sent = |cav: &&CavId| choice.views.iter().any(|view| view.cav == **cav);
        let silent: Vec<CavId> = neighbourhood
            .members()
            .filter(|cav| !has_sent(cav))
            .cloned()
            .collect();
        for cav in silent {
            neighbourhood.missed(&cav);
            let lost = dropped
                .iter()
                .rev()
                .find(|lost| lost.cav == cav)
                .map(|lost| lost.reason);
            let reason = if self.models.is_other(&cav) {
                Some(DropReason::Shape)
            } else {
                lost
            };
            choice.skipped.push(SkippedNeighbour { cav, reason });
        }
        choice
    }

    /// Counts the views that are in the result as received, and describes them.
    fn take_in(&mut self, own: &View, fused: &[usize], choice: &Choice) -> Vec<FusedNeighbour> {
        self.report.fused += fused.len() as u64;
        let describe = |&index: &usize| {
            let view = &choice.views[index];
            let View { cav, pose, .. } = view;
            let MessageInfo {
                is_first_use,
                payload_bytes,
                wire_bytes,
            } = choice.messages[index];
            self.settle(cav, is_first_use, None);
            let (cav, age_nanos, confidence) =
                (cav.clone(), view.age_nanos(own), pose.confidence());
            FusedNeighbour {
                cav,
                age_nanos,
                confidence,
                payload_bytes,
                wire_bytes,
            }
        };
        fused.iter().map(describe).collect()
    }

    /// Counts the views that are not in the result, and names those that should have been.
    fn leave_out(&self, left_out: &[(usize, Skipped)], choice: &mut Choice) {
        for &(index, why) in left_out {
            let cav = choice.views[index].cav.clone();
            let reason = match why {
                Skipped::Unusable(reason) => Some(reason),
                // It was evaluated, and rightly left out.
                Skipped::NotNeeded => None,
            };
            self.settle(&cav, choice.messages[index].is_first_use, reason);
            if reason.is_some() {
                choice.skipped.push(SkippedNeighbour { cav, reason });
            }
        }
    }

    /// Counts a message at its first use.
    fn settle(&self, cav: &CavId, is_first_use: bool, reason: Option<DropReason>) {
        let topic = self.topic(cav);
        match reason {
            _ if !is_first_use => {}
            Some(reason) => self.bus.stats().dropped(&topic, reason),
            None => self.bus.stats().received(&topic),
        }
    }

    fn publish(&mut self, capture_nanos: u64, result: Detections) {
        // The own message's transport is counted already.
        for stage in result
            .stages
            .iter()
            .filter(|stage| stage.stage != "transport")
        {
            self.bus
                .stats()
                .timed(&stage.stage, Duration::from_nanos(stage.nanos));
        }
        self.report.frames += 1;
        // The ego does not know when the sensors of its vehicle measured.
        self.bus.stats().answered(None, result.fused.len());
        let (fused, binary) = (unix_nanos(), result.clone());
        self.detections.submit_encoded(capture_nanos, move |stamp| {
            let mut result = binary;
            let sending = Duration::from_nanos(stamp.publish_nanos.saturating_sub(fused));
            result.stages.push(StageTiming::new("send", sending));
            wire::encode(stamp, result)
        });
        self.json.submit_encoded(capture_nanos, move |stamp| {
            let head = DetectionsReport::new(stamp, None, result)
                .to_json()
                .into_bytes();
            Ok(Encoded {
                head,
                body: Body::Empty,
            })
        });
    }
}
