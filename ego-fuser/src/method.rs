//! The registry of collaboration methods: what the agents of one frame exchange, by name.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// How the views of several CAVs become one set of boxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The ego alone: the baseline that every exchange must beat.
    None,
    /// Boxes are exchanged and merged by NMS.
    Late,
    /// Points are exchanged and encoded together in the ego frame.
    Early,
    /// Feature maps, element-wise maximum (F-Cooper).
    Max,
    /// Feature maps, self-attention over the agents at each cell (AttFuse, OPV2V).
    Attention,
    /// Feature maps, attention over agents and within windows of several sizes (V2X-ViT).
    #[serde(rename = "v2xvit")]
    V2xVit,
    /// Feature maps, attention over agents within windows and grids (CoBEVT).
    Cobevt,
    /// Feature maps of several frames, aligned by pose confidence and content, transformer (PASTAT).
    Pastat,
}

/// What has to cross the air for a method.
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

impl Method {
    /// Every method, in the order of tables.
    pub const ALL: [Self; 8] = [
        Self::None,
        Self::Late,
        Self::Early,
        Self::Max,
        Self::Attention,
        Self::V2xVit,
        Self::Cobevt,
        Self::Pastat,
    ];

    /// The name on the command line and in result files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Late => "late",
            Self::Early => "early",
            Self::Max => "max",
            Self::Attention => "attention",
            Self::V2xVit => "v2xvit",
            Self::Cobevt => "cobevt",
            Self::Pastat => "pastat",
        }
    }

    /// One line for `--help` and tables.
    #[must_use]
    pub fn summary(self) -> &'static str {
        match self {
            Self::None => "the ego alone",
            Self::Late => "boxes, merged by rotated NMS",
            Self::Early => "points, encoded together in the ego frame",
            Self::Max => "feature maps, element-wise maximum (F-Cooper)",
            Self::Attention => "feature maps, self-attention over agents at each cell (AttFuse)",
            Self::V2xVit => "feature maps, attention over agents and windows of several sizes (V2X-ViT)",
            Self::Cobevt => "feature maps, attention over agents within windows and grids (CoBEVT)",
            Self::Pastat => "feature maps with history, aligned by confidence and content, transformer (PASTAT)",
        }
    }

    /// What the agents send for it.
    #[must_use]
    pub fn exchange(self) -> Exchange {
        match self {
            Self::None => Exchange::Nothing,
            Self::Late => Exchange::Boxes,
            Self::Early => Exchange::Points,
            Self::Max | Self::Attention | Self::V2xVit | Self::Cobevt | Self::Pastat => Exchange::Features,
        }
    }
}

/// A name that no method has.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no method is called {0:?}; there are {names}", names = Method::ALL.map(Method::name).join(", "))]
pub struct UnknownMethod(String);

impl FromStr for Method {
    type Err = UnknownMethod;

    fn from_str(text: &str) -> Result<Self, UnknownMethod> {
        Self::ALL.into_iter().find(|method| method.name() == text).ok_or_else(|| UnknownMethod(text.to_owned()))
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for method in Method::ALL {
            assert_eq!(method.to_string().parse(), Ok(method));
            assert_eq!(serde_json::to_value(method).unwrap(), method.name());
        }
    }

    #[test]
    fn the_message_lists_every_method() {
        let message = "pastat2".parse::<Method>().unwrap_err().to_string();
        assert!(Method::ALL.iter().all(|method| message.contains(method.name())), "{message}");
    }
}
