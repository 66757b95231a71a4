//! What one vehicle of a deployment does.

use agent::attack::Lie;
use agent::rate::RateConfig;
use fusion::Exchange;
use fusion::Method;
use protocol::{CodecConfig, Stream};
use serde::{Deserialize, Serialize};

/// What a vehicle puts on the air beside its pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Publish {
    /// Feature maps.
    Bev,
    /// Its own detections.
    Boxes,
    /// Its points (only for the early-fusion baseline).
    Points,
}

impl Publish {
    /// What vehicles have to publish for a method; the ego's own agent sends its map even where nobody else's counts.
    #[must_use]
    pub fn for_method(method: Method) -> Self {
        match method.exchange() {
            Exchange::Nothing | Exchange::Features => Self::Bev,
            Exchange::Boxes => Self::Boxes,
            Exchange::Points => Self::Points,
        }
    }

    /// The name used in keys and on command lines.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Bev => "bev",
            Self::Boxes => "boxes",
            Self::Points => "points",
        }
    }

    /// The stream it goes to.
    #[must_use]
    pub fn stream(self) -> Stream {
        match self {
            Self::Bev => Stream::Bev,
            Self::Boxes => Stream::Boxes,
            Self::Points => Stream::Points,
        }
    }
}

/// Where a vehicle takes its pose from.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PoseSource {
    /// The pose of the recording.
    #[default]
    Recorded,
    /// The pose of the recording plus noise.
    Noisy(PoseNoise),
    /// From the vehicle's own LiDAR sweep, by the networks of `models.localizer`.
    Pgc,
    /// The same by the network of `models.end_to_end`, to compare with.
    EndToEnd,
}

impl PoseSource {
    /// The name used in files and on command lines.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Recorded => "recorded",
            Self::Noisy(_) => "noisy",
            Self::Pgc => "pgc",
            Self::EndToEnd => "end_to_end",
        }
    }
}

/// Noise on a recorded pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseNoise {
    /// How the errors of successive frames hang together.
    pub mode: NoiseMode,
    /// Standard deviation of x and y, metres.
    pub std_m: f64,
    /// Standard deviation of the heading, degrees.
    pub std_deg: f64,
    /// Seed of the errors.
    pub seed: u64,
}

impl Default for PoseNoise {
    fn default() -> Self {
        Self { mode: NoiseMode::default(), std_m: 0.2, std_deg: 0.2, seed: 0 }
    }
}

/// How the errors of successive frames hang together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseMode {
    /// One offset for the whole run, as the reference code does.
    Fixed,
    /// A new error every frame.
    #[default]
    Independent,
    /// Errors that drift: first-order autoregressive.
    Autoregressive,
}

/// What a vehicle computes and sends.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AgentSettings {
    /// Where the pose comes from.
    pub pose: PoseSource,
    /// How feature maps are written: number format, byte budget, packing.
    pub codec: CodecConfig,
    /// How they are fitted to what the air takes: a size, a byte rate, the vehicle's own queue.
    pub rate: RateConfig,
    /// Who starts the process.
    pub launch: Launch,
    /// What the vehicle lies about, to see what that does to the ego; absent: nothing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lie: Option<Lie>,
}

/// Who starts a vehicle's process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Launch {
    /// This run does, here.
    #[default]
    Here,
    /// Someone else does, on another host; the run waits for it.
    Elsewhere,
}

/// Settings of one vehicle that differ from `agents`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AgentOverrides {
    /// See [`AgentSettings::pose`].
    pub pose: Option<PoseSource>,
    /// See [`AgentSettings::codec`]; replaces it as a whole.
    pub codec: Option<CodecConfig>,
    /// See [`AgentSettings::rate`]; replaces it as a whole.
    pub rate: Option<RateConfig>,
    /// See [`AgentSettings::launch`].
    pub launch: Option<Launch>,
    /// See [`AgentSettings::lie`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lie: Option<Lie>,
}
