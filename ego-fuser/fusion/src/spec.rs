//! Method specification: name, exchange and fusion of one collaboration method.

use perception::model_config::DetectorConfig;
use protocol::{ConfidenceGate, Stream};
use serde::{Deserialize, Serialize};

use super::settings::{FusionConfig, FusionSettings};

/// Content of the messages that a method needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exchange {
    /// Nothing at all.
    Nothing,
    /// Boxes with scores.
    Boxes,
    /// Raw points.
    Points,
    /// BEV feature maps.
    Features,
}

impl Exchange {
    /// Stream of these messages; a method without any reads the ego's own map.
    pub fn stream(self) -> Stream {
        match self {
            Self::Boxes => Stream::Boxes,
            Self::Points => Stream::Points,
            Self::Features | Self::Nothing => Stream::Bev,
        }
    }
}

/// A collaboration method. A `static` of this type and its line in the table of [`crate::method`] are all that the rest
/// of the program needs of a method.
#[derive(Debug)]
pub struct MethodSpec {
    /// Name on the command line, in scenarios, weights files and results.
    pub name: &'static str,
    /// One line for `--help` and tables.
    pub summary: &'static str,
    /// Content of its messages.
    pub exchange: Exchange,
    /// Selection of the cells that agents send unless configured otherwise; absent: all cells.
    pub gate: Option<ConfidenceGate>,
    /// Names of the methods whose weights it runs with, best first; empty: only its own.
    pub runs_with_weights_of: &'static [&'static str],
    /// Its fusion.
    pub fusion: FusionSpec,
}

impl MethodSpec {
    /// A method that fuses all cells of feature maps, with its own weights, and has the name of its settings' kind.
    pub const fn of_features<S: FusionSettings>(summary: &'static str) -> Self {
        Self {
            name: S::KIND,
            summary,
            exchange: Exchange::Features,
            gate: None,
            runs_with_weights_of: &[],
            fusion: FusionSpec::of::<S>(),
        }
    }
}

/// The fusion of a method as functions of its settings' type.
#[derive(Debug, Clone, Copy)]
pub struct FusionSpec {
    /// Tag of its settings in weights files.
    pub kind: &'static str,
    /// Default settings behind a detector.
    pub default_config: fn(&MethodSpec, &DetectorConfig) -> FusionConfig,
    /// Reads the settings of a weights file, without their tag.
    pub parse: fn(serde_json::Value) -> Result<FusionConfig, serde_json::Error>,
}

impl FusionSpec {
    /// The functions of a type of settings.
    pub const fn of<S: FusionSettings>() -> Self {
        Self {
            kind: S::KIND,
            default_config: |_, detector| FusionConfig::new(S::for_detector(detector)),
            parse: |fields| serde_json::from_value::<S>(fields).map(FusionConfig::new),
        }
    }
}
