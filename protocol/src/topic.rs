//! What a key is about, below its run.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::CavId;
use crate::IdError;
use crate::Key;
use crate::KeyError;
use crate::ProcessId;
use crate::RunId;
use crate::Stream;
use crate::key::{MAX_KEY_BYTES, shown};
use crate::string_enum::{named, written_as_text};

named! {
    /// What a process does in a run: the part of a liveliness token that says whom one can expect what from.
    pub enum Role {
        /// Publishes one vehicle's poses and features.
        Agent = "agent",
        /// Fuses and detects for one vehicle.
        Ego = "ego",
        /// Streams a scene.
        Replay = "replay",
        /// Emulates the air.
        Link = "link",
        /// Compares detections with the truth.
        Scorer = "scorer",
        /// Writes down everything that is said.
        Recorder = "recorder",
        /// Shows the run to people.
        Viewer = "viewer",
    }
}

named! {
    /// What a control message asks for or says: one key each, so that a process hears only what concerns it.
    pub enum Verb {
        /// Start the scene's clock.
        Start = "start",
        /// Halt it.
        Pause = "pause",
        /// Let it run on.
        Resume = "resume",
        /// Move on by some ticks and halt.
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
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Topic {
    /// `<cav>/<stream>`: what a vehicle, or the replay on its behalf, publishes.
    Stream {
        /// The vehicle.
        cav: CavId,
        /// What of it.
        stream: Stream,
    },
    /// `rx/<ego>/<cav>/<stream>`: the same as it reaches an ego over the emulated air.
    Received {
        /// Who receives.
        ego: CavId,
        /// Who sent.
        cav: CavId,
        /// What of it.
        stream: Stream,
    },
    /// `truth`.
    Truth,
    /// `control/<verb>`.
    Control(Verb),
    /// `ready/<process>`: which routes it has heard of.
    Ready(ProcessId),
    /// `stats/<process>`.
    Stats(ProcessId),
    /// `alive/<role>/<cav>`: a liveliness token.
    Alive {
        /// What the process does.
        role: Role,
        /// For which vehicle; a process without one uses a name of its own.
        cav: CavId,
    },
}

impl Topic {
    /// The key of this topic in `run`.
    #[must_use]
    pub fn in_run(self, run: &RunId) -> Key {
        Key { run: run.clone(), topic: self }
    }

    /// Whether the ledger covers it: data, but neither the talk about the run itself nor what is said again and again
    /// for those who come later, of whom nobody knows how much of it they should have heard, nor what is only looked at.
    #[must_use]
    pub fn is_booked(&self) -> bool {
        match self {
            Self::Stream { stream, .. } | Self::Received { stream, .. } => {
                !matches!(stream, Stream::Descriptor | Stream::Preview)
            }
            Self::Truth => true,
            Self::Control(_) | Self::Ready(_) | Self::Stats(_) | Self::Alive { .. } => false,
        }
    }

    fn from_chunks(chunks: &[&str]) -> Result<Option<Self>, IdError> {
        Ok(match chunks {
            ["truth"] => Some(Self::Truth),
            ["control", verb] => Verb::ALL.into_iter().find(|known| known.as_str() == *verb).map(Self::Control),
            ["ready", process] => Some(Self::Ready(ProcessId::new(process)?)),
            ["stats", process] => Some(Self::Stats(ProcessId::new(process)?)),
            ["alive", role, cav] => match Role::ALL.into_iter().find(|known| known.as_str() == *role) {
                Some(role) => Some(Self::Alive { role, cav: CavId::new(cav)? }),
                None => None,
            },
            ["rx", ego, cav, stream @ ..] => match Stream::from_chunks(stream) {
                Some(stream) => Some(Self::Received { ego: CavId::new(ego)?, cav: CavId::new(cav)?, stream }),
                None => None,
            },
            [cav, stream @ ..] => match Stream::from_chunks(stream) {
                Some(stream) => Some(Self::Stream { cav: CavId::new(cav)?, stream }),
                None => None,
            },
            [] => None,
        })
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stream { cav, stream } => write!(f, "{cav}/{stream}"),
            Self::Received { ego, cav, stream } => write!(f, "rx/{ego}/{cav}/{stream}"),
            Self::Truth => f.write_str("truth"),
            Self::Control(verb) => write!(f, "control/{verb}"),
            Self::Ready(process) => write!(f, "ready/{process}"),
            Self::Stats(process) => write!(f, "stats/{process}"),
            Self::Alive { role, cav } => write!(f, "alive/{role}/{cav}"),
        }
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
            return Err(KeyError::Wildcard { text: shown(text) });
        }
        let chunks: Vec<&str> = text.split('/').collect();
        Self::from_chunks(&chunks)
            .map_err(|source| KeyError::Id { text: shown(text), source })?
            .ok_or_else(|| KeyError::unknown(text))
    }
}

written_as_text!(Topic);
