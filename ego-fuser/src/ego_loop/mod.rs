//! Ego loop: what an ego does with each input, at a time that is given. It has no network, clock or thread.
//!
//! A frame begins with the message of the ego's own agent. It is decided when every neighbour's message of the same
//! capture time has arrived, or when the deadline has passed; later messages serve the next frame, if they are still
//! young enough.
//!
//! The live process, simulation time and the replay of recorded inputs are adapters: they bring inputs in order of time
//! and carry out the outputs. The same inputs give the same outputs.

mod admit;
mod decide;
mod input;
pub mod recorded;
mod waits;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use protocol::{CavId, Stream};
use serde::Serialize;

use crate::capture_clock::CaptureClocks;
use crate::config::EgoSettings;
use crate::ego::Ego;
use crate::pace_control::PaceControl;
use crate::pairing::{Pairing, PairingConfig};
use crate::peer_models::PeerModels;
use crate::silence::Silence;
use crate::view::View;
use tracking::{Tracker, TrackerConfig};
use waits::Waits;

pub(crate) use admit::Refusal;
pub use input::{Input, Message, Output, Reception, Source};

/// Time that an ego whose own agent has ended waits for the last messages of its neighbours, nanoseconds.
const LAST_WAIT_NANOS: u64 = 2_000_000_000;

/// Options of an ego's loop.
#[derive(Debug, Clone, Copy)]
pub struct LoopOptions {
    /// Longest wait of a frame for its neighbours, from the arrival of the own agent's message, nanoseconds.
    pub deadline_nanos: u64,
    /// Pairing of messages with a frame.
    pub pairing: PairingConfig,
    /// True to slow the fleet down where this machine cannot keep up; false to ask for every sweep.
    pub sets_pace: bool,
    /// True where arrivals of sweeps are exact, as in simulation time.
    pub has_exact_arrivals: bool,
    /// True to track the detected objects.
    pub tracks: bool,
}

impl LoopOptions {
    /// Options in simulation time, with these limits.
    pub fn stepped(settings: &EgoSettings) -> Self {
        let max_age_nanos = settings.max_age_ms.saturating_mul(1_000_000);
        Self {
            deadline_nanos: settings.deadline_ms.saturating_mul(1_000_000),
            pairing: PairingConfig::with_max_age_nanos(max_age_nanos),
            sets_pace: false,
            has_exact_arrivals: true,
            tracks: settings.tracks,
        }
    }
}

/// Summary of an ego's run.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct LoopReport {
    /// Frames decided.
    pub frames: u64,
    /// Neighbours' messages that were fused, over all frames.
    pub fused: u64,
    /// Of these, messages of boxes, in place of a feature map or beside it.
    pub fused_boxes: u64,
    /// Boxes of neighbours beyond the limit, which were not read.
    pub refused_boxes: usize,
    /// Messages of boxes whose velocities were not taken, as successive boxes contradict them.
    pub refused_velocities: usize,
    /// Frames that were decided at the deadline.
    pub at_deadline: u64,
    /// Frames that could not be fused.
    pub failed: u64,
    /// Reason of the first of these.
    pub failure: Option<String>,
    /// The first agent whose maps were not fused as they are of another network, and what differs.
    pub other_network: Option<String>,
}

/// A frame that has begun.
struct OwnFrame {
    /// Sequence of the own agent's message.
    agent_frame: u64,
    /// From its publication to its arrival; `None` if its agent has another clock.
    transport: Option<Duration>,
    begun_nanos: u64,
    view: View,
}

/// The state of an ego between two inputs.
pub struct EgoLoop {
    cav: CavId,
    stream: Stream,
    /// True if neighbours may send boxes in place of that stream, or beside it.
    reads_boxes: bool,
    /// Streams of perception that vehicles send: that stream, and boxes in place of it or beside it.
    published: BTreeSet<Source>,
    /// Frames that were decided before the feature map of their time, by neighbour.
    late_maps: Silence,
    /// Capture time of the newest message of its stream that was fused, by neighbour, nanoseconds.
    fused_nanos: BTreeMap<CavId, u64>,
    options: LoopOptions,
    members: BTreeSet<CavId>,
    silence: Silence,
    models: PeerModels,
    pairing: Pairing<Source, Message>,
    clocks: CaptureClocks,
    /// System clock of a neighbour minus the ego's, seconds, as of its last message.
    clock_offsets_s: BTreeMap<CavId, f64>,
    frames: VecDeque<OwnFrame>,
    pace: PaceControl,
    tracker: Option<Tracker>,
    /// Capture time of the ego's newest sweep, nanoseconds.
    own_nanos: Option<u64>,
    /// Arrival of its message, nanoseconds.
    own_arrived_nanos: u64,
    ended: BTreeSet<CavId>,
    pub(crate) waits: Waits,
    /// Time at which the loop ends at the latest, after the own agent's end.
    ends_nanos: Option<u64>,
    is_finished: bool,
    report: LoopReport,
    outputs: Vec<Output>,
}

impl EgoLoop {
    /// Loop of the vehicle `cav`, whose frames `ego` fuses, before its first input.
    pub fn new(cav: &CavId, ego: &Ego, options: LoopOptions) -> Self {
        let stream = ego.method().own_content().stream();
        // The objects in the area in which the ego detects are tracked.
        let [x_low, y_low, _, x_high, y_high, _] = ego.detector().config().lidar_range_m;
        let tracker_config = TrackerConfig {
            area_m: [x_low, y_low, x_high, y_high],
            ..TrackerConfig::default()
        };
        Self {
            cav: cav.clone(),
            stream,
            reads_boxes: ego.reads_boxes(),
            published: BTreeSet::new(),
            late_maps: Silence::default(),
            fused_nanos: BTreeMap::new(),
            waits: Waits::new(cav, ego.method().name(), stream, ego.reads_boxes()),
            options,
            members: BTreeSet::new(),
            silence: Silence::default(),
            models: PeerModels::new(ego.detector()),
            pairing: Pairing::new(options.pairing),
            clocks: CaptureClocks::new(options.has_exact_arrivals),
            clock_offsets_s: BTreeMap::new(),
            frames: VecDeque::new(),
            pace: PaceControl::new(),
            tracker: options.tracks.then(|| Tracker::new(tracker_config)),
            own_nanos: None,
            own_arrived_nanos: 0,
            ended: BTreeSet::new(),
            ends_nanos: None,
            is_finished: false,
            report: LoopReport::default(),
            outputs: Vec::new(),
        }
    }

    /// Takes an input in at `now_nanos`, which does not decrease from one message or wake to the next. Only
    /// [`Input::Wake`] decides a frame, and one at most: fusing takes time, in which more may arrive.
    pub fn handle(&mut self, ego: &mut Ego, input: Input, now_nanos: u64) -> Vec<Output> {
        match input {
            Input::Message(message) => self.take_in(ego, *message, now_nanos),
            Input::Model(cav, descriptor) => {
                self.waits.described(&cav, &descriptor, now_nanos);
                // After its scene an agent names no stream; what is known of its maps holds for the last of them.
                if !descriptor.streams.is_empty() {
                    self.compare_models(&cav, &descriptor);
                }
            }
            Input::Sweeps(cav, sweeps) => self.compare_clocks(&cav, &sweeps),
            Input::Joined(cav) => {
                self.members.insert(cav);
            }
            Input::Left(cav) => {
                // Before the vehicle is forgotten, and with it whether it announced its end.
                self.waits.left(&cav, self.ended.contains(&cav), now_nanos);
                self.forget(&cav);
            }
            Input::Ended(cav) if cav == self.cav => {
                // The last frames wait no less than others, even with a long deadline.
                let wait_nanos = LAST_WAIT_NANOS.max(self.options.deadline_nanos);
                self.ends_nanos = Some(now_nanos.saturating_add(wait_nanos));
            }
            Input::Ended(cav) => {
                self.ended.insert(cav);
            }
            Input::Wake => self.wake(ego, now_nanos),
        }
        std::mem::take(&mut self.outputs)
    }

    /// Time by which the loop has to be woken, 0 if at once; `None`: nothing waits.
    pub fn wakes_nanos(&self) -> Option<u64> {
        let front = self.frames.front().map(|frame| self.due_nanos(frame));
        front.into_iter().chain(self.ends_nanos).min()
    }

    /// True after the own agent's end, when everything is decided.
    pub fn is_finished(&self) -> bool {
        self.is_finished
    }

    /// Stream of the vehicles' perception that the method fuses.
    pub fn stream(&self) -> Stream {
        self.stream
    }

    /// Streams of which a neighbour may publish either or both.
    pub fn neighbour_streams(&self) -> impl Iterator<Item = Stream> + use<> {
        std::iter::once(self.stream).chain(self.reads_boxes.then_some(Stream::Boxes))
    }

    /// Summary so far.
    pub fn report(&self) -> &LoopReport {
        &self.report
    }

    /// Messages of a neighbour's stream that wait and were never used.
    pub fn unused(&self, source: &Source) -> usize {
        self.pairing.unused(source)
    }
}

#[cfg(test)]
mod tests;
