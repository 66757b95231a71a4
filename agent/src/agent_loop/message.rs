//! Messages of an agent on their way to the wire. The size of a feature map depends on when its turn to be sent comes.

use std::sync::{Mutex, PoisonError};

use protocol::message::Bev;
use protocol::{
    BevFeatures, CodecConfig, Encoded, Message, PoseEstimate, RateChoice, Stamp, Stream, WireError,
    wire,
};

use super::LoopOptions;
use crate::rate::{RateControl, Turn};

/// A message that is not encoded yet.
#[derive(Debug)]
pub struct Unsent {
    /// Stream on which it is published.
    pub stream: Stream,
    /// Number of messages of its stream before it, those included that are never sent.
    pub number: u64,
    /// Capture time of its sweep, nanoseconds.
    pub capture_nanos: u64,
    /// Its content.
    pub content: Content,
}

/// Content of a message.
#[derive(Debug)]
pub enum Content {
    /// Feature map of a sweep.
    Map {
        /// Pose of the sweep.
        pose: PoseEstimate,
        /// The map.
        features: BevFeatures,
        /// `[H, W]`, 0..1: probability of a vehicle per cell. Empty without head.
        confidence: Vec<f32>,
    },
    /// Message that does not depend on its turn.
    Fixed(Message),
}

/// Encoder of an agent's messages. Feature maps are encoded in the order of sending, within the limits of the rate.
#[derive(Debug)]
pub struct MessageEncoder {
    codec: CodecConfig,
    /// Of feature maps only: no pose waits while one is encoded.
    rate: Mutex<RateControl>,
}

impl MessageEncoder {
    /// State before the first message.
    pub fn new(options: &LoopOptions) -> Self {
        Self {
            codec: options.codec,
            rate: Mutex::new(RateControl::new(options.rate)),
        }
    }

    /// Encodes a message at its turn, `None` without a queue. Returns also the decision of the rate control, if a map had
    /// to keep within a limit.
    ///
    /// # Errors
    /// As [`wire::encode`] and [`encode_within`](protocol::codec::encode_within).
    pub fn encode(
        &self,
        message: Box<Unsent>,
        stamp: &Stamp,
        turn: Option<&Turn>,
    ) -> Result<(Encoded, Option<RateChoice>), WireError> {
        let capture_nanos = message.capture_nanos;
        match message.content {
            Content::Map {
                pose,
                features,
                confidence,
            } => {
                // Held while the map is encoded: the next limit depends on the size of this map.
                let mut rate = self.rate.lock().unwrap_or_else(PoisonError::into_inner);
                let features =
                    rate.encode(features, &self.codec, &confidence, capture_nanos, turn)?;
                let choice = features.rate;
                Ok((wire::encode(stamp, Bev { pose, features })?, choice))
            }
            Content::Fixed(message) => Ok((wire::encode_any(stamp, message)?, None)),
        }
    }
}
