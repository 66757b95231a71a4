//! Topics: the part of a key below its run.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::key::{MAX_KEY_BYTES, shown};
use crate::stream::StreamTable as _;
use crate::string_enum::{named, written_as_text};
use crate::{CavId, IdError, Key, KeyError, Kind, ProcessId, RunId, Stream};

named! {
    /// Role of a process in a run, part of its liveliness token.
    pub enum Role {
        /// Publishes one vehicle's poses and features.
        Agent = "agent",
        /// Fuses and detects for one vehicle.
        Ego = "ego",
        /// Streams a scene.
        Replay = "replay",
        /// Emulates the V2V link.
        Link = "link",
        /// Compares detections with the ground truth.
        Scorer = "scorer",
        /// Records all messages.
        Recorder = "recorder",
        /// Shows the run to people.
        Viewer = "viewer",
        /// Connects the run to a ROS 2 network.
        Ros2 = "ros2",
    }
}

named! {
    /// Verb of a control message: one key each, so that a process receives only messages that concern it.
    pub enum Verb {
        /// Start the scene's clock.
        Start = "start",
        /// Halt the clock.
        Pause = "pause",
        /// Start the clock again after a halt.
        Resume = "resume",
        /// Advance by a number of ticks and halt.
        Step = "step",
        /// Go to a tick.
        Seek = "seek",
        /// The scene is over.
        End = "end",
        /// A process has finished a tick (stepped runs).
        Done = "done",
    }
}

/// A key below its run: `4279/bev`, `truth`.
#[derive(
    Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, strum::Display,
)]
#[serde(try_from = "String", into = "String")]
pub enum Topic {
    /// `<cav>/<stream>`: a stream of a vehicle, published by it or by the replay on its behalf.
    #[strum(to_string = "{cav}/{stream}")]
    Stream {
        /// The vehicle.
        cav: CavId,
        /// Stream of the vehicle.
        stream: Stream,
    },
    /// `rx/<ego>/<cav>/<stream>`: the same as it reaches an ego over the emulated link.
    #[strum(to_string = "rx/{ego}/{cav}/{stream}")]
    Received {
        /// Receiving vehicle.
        ego: CavId,
        /// Sending vehicle.
        cav: CavId,
        /// Stream of the sending vehicle.
        stream: Stream,
    },
    /// `truth`.
    #[strum(to_string = "truth")]
    Truth,
    /// `control/<verb>`.
    #[strum(to_string = "control/{0}")]
    Control(Verb),
    /// `ready/<process>`: routes that the process has confirmed.
    #[strum(to_string = "ready/{0}")]
    Ready(ProcessId),
    /// `stats/<process>`.
    #[strum(to_string = "stats/{0}")]
    Stats(ProcessId),
    /// `alive/<role>/<cav>`: a liveliness token.
    #[strum(to_string = "alive/{role}/{cav}")]
    Alive {
        /// Role of the process.
        role: Role,
        /// Vehicle of the process; a process without one uses a name of its own.
        cav: CavId,
    },
}

impl Topic {
    /// Topic of a vehicle's stream.
    pub fn stream(cav: &CavId, stream: Stream) -> Self {
        let cav = cav.clone();
        Self::Stream { cav, stream }
    }

    /// The key of this topic in `run`.
    pub fn in_run(self, run: &RunId) -> Key {
        let run = run.clone();
        Key { run, topic: self }
    }

    /// Kind of its messages; `None` if they do not have this wire format.
    pub fn kind(&self) -> Option<Kind> {
        match self {
            Self::Stream { stream, .. } | Self::Received { stream, .. } => stream.kind(),
            Self::Truth => Some(Kind::Truth),
            Self::Control(_) | Self::Ready(_) => Some(Kind::Control),
            Self::Stats(_) => Some(Kind::Stats),
            Self::Alive { .. } => None,
        }
    }

    /// True if the ledger covers it: data, but not control messages, not messages that are repeated for late joiners
    /// (their number of receptions is undefined), and not previews.
    pub fn is_counted(&self) -> bool {
        match self {
            Self::Stream { stream, .. } | Self::Received { stream, .. } => stream.row().is_counted,
            Self::Truth => true,
            Self::Control(_) | Self::Ready(_) | Self::Stats(_) | Self::Alive { .. } => false,
        }
    }

    /// True if its messages are JSON, without a header.
    pub fn is_json(&self) -> bool {
        let is_stream = matches!(self, Self::Stream { .. } | Self::Received { .. });
        is_stream && self.kind().is_none()
    }

    fn from_chunks(chunks: &[&str]) -> Option<Result<Self, IdError>> {
        Some(match chunks {
            ["truth"] => Ok(Self::Truth),
            ["control", verb] => Ok(Self::Control(verb.parse().ok()?)),
            ["ready", process] => ProcessId::new(process).map(Self::Ready),
            ["stats", process] => ProcessId::new(process).map(Self::Stats),
            ["alive", role, cav] => {
                let role: Role = role.parse().ok()?;
                CavId::new(cav).map(|cav| Self::Alive { role, cav })
            }
            ["rx", ego, cav, stream @ ..] => {
                let stream = Stream::from_chunks(stream)?;
                let ids = CavId::new(ego).and_then(|ego| Ok((ego, CavId::new(cav)?)));
                ids.map(|(ego, cav)| Self::Received { ego, cav, stream })
            }
            // Last: the words above are reserved, so that no vehicle has one as its id.
            [cav, stream @ ..] => {
                let stream = Stream::from_chunks(stream)?;
                CavId::new(cav).map(|cav| Self::Stream { cav, stream })
            }
            [] => return None,
        })
    }
}

impl FromStr for Topic {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        if text.len() > MAX_KEY_BYTES {
            return Err(KeyError::unknown(text));
        }
        // `$` and `#` mean something to zenoh too.
        if text.contains(['*', '$', '#', '?']) {
            // They name many keys, a message has one.
            return Err(KeyError(format!("{:?} holds a wildcard", shown(text))));
        }
        let chunks: Vec<&str> = text.split('/').collect();
        Self::from_chunks(&chunks)
            .ok_or_else(|| KeyError::unknown(text))?
            .map_err(|error| KeyError::id(text, &error))
    }
}

written_as_text!(Topic);
