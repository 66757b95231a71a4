//! Control messages: clock of a run, and the start barrier of its processes.

use serde::{Deserialize, Serialize};

use super::{check_count, check_within, metadata_only};
use crate::{Limits, ProcessId, Topic, Verb, WireError};

/// One request or notification; [`Control::verb`] gives its key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// Operator to replay: start the scene's clock from here.
    Start {
        /// Seconds of the scene per second; 0: as fast as possible.
        rate: f64,
    },
    /// Operator to replay: halt after the current tick.
    Pause,
    /// Operator to replay: continue.
    Resume,
    /// Operator to replay: publish a number of ticks, then halt.
    Step {
        /// Number of ticks.
        ticks: u64,
    },
    /// Operator to replay: continue from this tick.
    Seek {
        /// Index of the tick, from 0.
        tick: u64,
    },
    /// Replay to all: no more messages follow.
    End {
        /// Ticks published, over all loops.
        ticks: u64,
        /// Messages published by topic, so that each receiver can compute its losses.
        sent: Vec<TopicCount>,
    },
    /// Any process, on a key of its own: models are loaded, subscriptions are declared.
    Ready {
        /// Process that is ready.
        process: ProcessId,
        /// Routes over which a [`Control::Probe`] has arrived.
        subscribed: Vec<Topic>,
    },
    /// On a data key before the first message: confirms the route. Answered by [`Control::Ready`] with the topic.
    Probe,
    /// Any process to replay, stepped runs: all work of this tick is done.
    Done {
        /// Process that is done.
        process: ProcessId,
        /// Index of the tick, from 0.
        tick: u64,
    },
}

/// Number of messages published on a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicCount {
    /// Topic of the messages.
    pub topic: Topic,
    /// Number of messages.
    pub messages: u64,
}

impl Control {
    /// The control key of this message; a probe is published on the data key that it confirms, its answer on
    /// `ready/<process>`.
    pub fn verb(&self) -> Option<Verb> {
        Some(match self {
            Self::Start { .. } => Verb::Start,
            Self::Pause => Verb::Pause,
            Self::Resume => Verb::Resume,
            Self::Step { .. } => Verb::Step,
            Self::Seek { .. } => Verb::Seek,
            Self::End { .. } => Verb::End,
            Self::Done { .. } => Verb::Done,
            Self::Ready { .. } | Self::Probe => return None,
        })
    }

    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        match self {
            Self::Start { rate } => check_within("rate", *rate, 0.0, 1e6),
            Self::End { sent, .. } => check_count("topics", sent.len(), limits.max_entries),
            Self::Ready { subscribed, .. } => {
                check_count("topics", subscribed.len(), limits.max_entries)
            }
            Self::Pause
            | Self::Resume
            | Self::Step { .. }
            | Self::Seek { .. }
            | Self::Probe
            | Self::Done { .. } => Ok(()),
        }
    }
}

metadata_only!(Control, Control);
