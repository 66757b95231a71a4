//! Frames of a live run: messages are collected by capture time and handed over when no more follow.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use bus::RawMessage;
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::{Topic, WireError, wire};

use crate::frame_parts::FrameParts;

/// Largest number of frames that wait for messages.
const MOST_PENDING: usize = 32;

/// Frames by capture time. A frame is handed over a while after its last message, in the order of capture times.
pub(crate) struct LiveFrames {
    pub(crate) run: String,
    protocol: EvaluationProtocol,
    /// Time without a message after which a frame is complete.
    pub(crate) settle: Duration,
    pending: BTreeMap<u64, Pending>,
    /// Frames that are complete, in order.
    pub(crate) ready: VecDeque<FrameParts>,
    handed_over: Option<u64>,
    replay_epoch: Option<u64>,
    /// Messages whose frame has been handed over.
    pub(crate) late: u64,
}

struct Pending {
    parts: FrameParts,
    last_message: Instant,
}

impl LiveFrames {
    pub(crate) fn new(run: &str, settle: Duration, protocol: EvaluationProtocol) -> Self {
        Self {
            run: run.to_owned(),
            protocol,
            settle,
            pending: BTreeMap::new(),
            ready: VecDeque::new(),
            handed_over: None,
            replay_epoch: None,
            late: 0,
        }
    }

    /// Adds a message of a topic that frames hold.
    pub(crate) fn add(&mut self, message: &RawMessage) -> Result<(), WireError> {
        let header = wire::decode_header(message.pieces())?;
        let at = header.stamp.capture_nanos;
        // The replay publishes the truth, so a new epoch there is a new replay. Agents restart on their own.
        if message.key.topic == Topic::Truth {
            let epoch = header.stamp.epoch;
            let known = self.replay_epoch.replace(epoch);
            // A replay that is started anew begins at its own first tick.
            if known.is_some_and(|known| known != epoch) {
                self.finish();
                self.handed_over = None;
            }
        }
        // Frames are handed over by capture time: an older one would come out of order.
        if self.handed_over.is_some_and(|newest| at <= newest) {
            self.late += 1;
            return Ok(());
        }
        let pending = self.pending.entry(at).or_insert_with(|| Pending {
            parts: FrameParts::empty(&self.run, at, &self.protocol),
            last_message: Instant::now(),
        });
        pending.last_message = Instant::now();
        let added = pending.parts.add(&message.key.topic, message.pieces());
        if self.pending.len() > MOST_PENDING {
            self.hand_over_oldest();
        }
        added
    }

    /// True if the oldest frame has had no message for a while.
    pub(crate) fn is_settled(&self) -> bool {
        let oldest = self.pending.first_key_value();
        oldest.is_some_and(|(_, pending)| pending.last_message.elapsed() >= self.settle)
    }

    /// No message follows: all frames are complete.
    pub(crate) fn finish(&mut self) {
        while !self.pending.is_empty() {
            self.hand_over_oldest();
        }
    }

    /// The oldest frame is complete.
    pub(crate) fn hand_over_oldest(&mut self) {
        if let Some((at, pending)) = self.pending.pop_first() {
            self.handed_over = Some(at);
            self.ready.push_back(pending.parts);
        }
    }
}
