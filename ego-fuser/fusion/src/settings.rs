//! Fusion settings: the trait that a method implements for its own, and [`FusionConfig`], which holds those of any
//! method.

use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

use perception::model_config::{ConfigError, DetectorConfig};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tch::nn;

use super::interface::Fusion;
use crate::pose_graph::PoseGraphConfig;

/// Metadata key of the fusion's settings in a weights file.
pub const FUSION_KEY: &str = "fusion";

/// Feature maps with more channels are fused by modules of full size.
const LEAN_CHANNELS: i64 = 128;

/// The settings that a method's fusion is built from.
pub trait FusionSettings:
    Debug + Clone + Serialize + DeserializeOwned + Send + Sync + 'static
{
    /// Tag in weights files.
    const KIND: &'static str;

    /// Default settings behind a detector.
    fn for_detector(detector: &DetectorConfig) -> Self;

    /// Builds the fusion with its variables below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError>;

    /// Inputs beyond the newest map of every agent.
    fn requirements(&self) -> Requirements {
        Requirements::default()
    }
}

/// Inputs that a fusion needs beyond the newest map of every agent as it was sent.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Requirements {
    /// Maps of earlier time steps.
    pub history: HistorySpec,
    /// Correction of the poses by boxes before maps are warped; absent: poses are used as received.
    pub pose_graph: Option<PoseGraphConfig>,
    /// True if training hides cells of the maps at random, as agents select at run time which to send.
    pub partial_maps_in_training: bool,
}

/// The earlier maps of every agent that a fusion needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HistorySpec {
    /// Time steps of every agent, the newest included.
    pub frames: usize,
    /// Edge of the squares of cells that are pooled in an earlier map, cells; absent: earlier maps are not pooled and
    /// are listed among the newest.
    pub earlier_cells: Option<i64>,
    /// True if earlier maps are needed at full resolution too.
    pub full_resolution: bool,
}

impl Default for HistorySpec {
    /// No earlier maps.
    fn default() -> Self {
        Self {
            frames: 1,
            earlier_cells: None,
            full_resolution: false,
        }
    }
}

/// Settings of the size that fits maps of a detector: `lean` up to 128 channels, else `full`.
pub(super) fn of_size<S>(detector: &DetectorConfig, lean: fn(i64) -> S, full: fn(i64) -> S) -> S {
    let channels = detector.feature_channels();
    if channels <= LEAN_CHANNELS {
        lean(channels)
    } else {
        full(channels)
    }
}

/// The settings of any method's fusion, stored as JSON beside its weights.
#[derive(Debug, Clone)]
pub struct FusionConfig(Arc<dyn AnySettings>);

impl FusionConfig {
    /// Settings of one method.
    pub fn new(settings: impl FusionSettings) -> Self {
        Self(Arc::new(settings))
    }

    /// Tag in weights files.
    pub fn kind(&self) -> &'static str {
        self.0.kind()
    }

    /// The settings, if they are of this type.
    pub fn settings<S: FusionSettings>(&self) -> Option<&S> {
        (&*self.0 as &dyn Any).downcast_ref()
    }

    /// See [`FusionSettings::requirements`].
    pub fn requirements(&self) -> Requirements {
        self.0.requirements()
    }

    /// See [`FusionSettings::build`].
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        self.0.build(path)
    }

    /// JSON with the tag first, as weights files hold it.
    pub fn to_json(&self) -> String {
        self.0.to_json(false)
    }

    /// The same over several lines, for readers.
    pub fn to_json_pretty(&self) -> String {
        self.0.to_json(true)
    }
}

impl PartialEq for FusionConfig {
    /// True if weights files hold the same text for both.
    fn eq(&self, other: &Self) -> bool {
        self.to_json() == other.to_json()
    }
}

/// [`FusionSettings`] with the type erased.
trait AnySettings: Any + Debug + Send + Sync {
    fn kind(&self) -> &'static str;
    fn requirements(&self) -> Requirements;
    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError>;
    /// `is_pretty`: over several lines.
    fn to_json(&self, is_pretty: bool) -> String;
}

#[derive(Serialize)]
struct Tagged<'a, S> {
    kind: &'static str,
    #[serde(flatten)]
    settings: &'a S,
}

impl<S: FusionSettings> AnySettings for S {
    fn kind(&self) -> &'static str {
        S::KIND
    }

    fn requirements(&self) -> Requirements {
        FusionSettings::requirements(self)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        FusionSettings::build(self, path)
    }

    fn to_json(&self, is_pretty: bool) -> String {
        let tagged = Tagged {
            kind: S::KIND,
            settings: self,
        };
        let text = match is_pretty {
            false => serde_json::to_string(&tagged),
            true => serde_json::to_string_pretty(&tagged),
        };
        text.expect("settings are JSON")
    }
}

/// Declares the settings `$config` of the fusion `$fusion`, which has none; `$kind` is their tag in weights files.
macro_rules! without_settings {
    ($config:ident, $kind:literal, $fusion:ident) => {
        #[doc = concat!("Settings of [`", stringify!($fusion), "`]: none.")]
        #[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        pub(crate) struct $config {}

        impl $crate::FusionSettings for $config {
            const KIND: &'static str = $kind;

            fn for_detector(_: &perception::model_config::DetectorConfig) -> Self {
                Self {}
            }

            fn build(
                &self,
                _: &tch::nn::Path<'_>,
            ) -> Result<Box<dyn $crate::Fusion>, perception::model_config::ConfigError> {
                Ok(Box::new($fusion))
            }
        }
    };
}
pub(crate) use without_settings;
