//! How a run is steered, and how its processes agree to begin.

use serde::{Deserialize, Serialize};

use super::{check_count, check_within, metadata_only};
use crate::Limits;
use crate::ProcessId;
use crate::Topic;
use crate::Verb;
use crate::WireError;

/// One request or notice; [`Control::verb`] names the key it goes to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Control {
    /// Operator to replay: let the scene's clock run from here.
    Start {
        /// Seconds of the scene per second; 0: as fast as the fleet can.
        rate: f64,
    },
    /// Operator to replay: halt after the current tick.
    Pause,
    /// Operator to replay: run on.
    Resume,
    /// Operator to replay: publish so many ticks, then halt.
    Step {
        /// How many.
        ticks: u64,
    },
    /// Operator to replay: go on from this tick.
    Seek {
        /// Which, counted from 0.
        tick: u64,
    },
    /// Replay to all: nothing more will come.
    End {
        /// Ticks published, over all loops.
        ticks: u64,
        /// What was published, so that each receiver can tell what it lacks.
        sent: Vec<TopicCount>,
    },
    /// Any process, on a key of its own: models are loaded, subscriptions stand.
    Ready {
        /// Who.
        process: ProcessId,
        /// Routes over which a [`Control::Probe`] has come.
        heard: Vec<Topic>,
    },
    /// On a data key before the first message: proves the route. Answered by [`Control::Ready`] that names the topic.
    Probe,
    /// Any process to replay, stepped runs: everything of this tick is done.
    Done {
        /// Who.
        process: ProcessId,
        /// Which tick, counted from 0.
        tick: u64,
    },
}

/// How many messages went out on a topic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicCount {
    /// Where.
    pub topic: Topic,
    /// How many.
    pub messages: u64,
}

impl Control {
    /// The control key this goes to; a probe goes to the data key it proves, its answer to `ready/<process>`.
    #[must_use]
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
            Self::Ready { heard, .. } => check_count("topics", heard.len(), limits.max_entries),
            Self::Pause | Self::Resume | Self::Step { .. } | Self::Seek { .. } | Self::Probe | Self::Done { .. } => {
                Ok(())
            }
        }
    }
}

metadata_only!(Control, Control);
