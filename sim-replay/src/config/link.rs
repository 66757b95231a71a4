//! Configuration of `sim-replay link`: link emulation between the agents of a run and an ego.

use protocol::config::FieldError;
use protocol::{CavId, RunId, Stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use bus::{BusConfig, InboxConfig, ProcessConfig};
use link::PRESETS;

/// Configuration of `sim-replay link`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct LinkProcessConfig {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long, required_unless_present = "config")]
    pub run: RunId,
    /// The vehicle that receives.
    #[arg(long, required_unless_present = "config", allow_hyphen_values = true)]
    pub ego: CavId,
    /// Link model.
    #[command(flatten)]
    #[serde(default)]
    pub link: LinkSelection,
    /// Streams that cross the link.
    #[arg(long, value_name = "STREAMS", value_delimiter = ',')]
    #[serde(default = "feature_streams")]
    pub streams: Vec<Stream>,
    /// Continue when all agents have ended, for the next ones; always so with `supervised`.
    #[arg(long)]
    #[serde(default)]
    pub keep_running: bool,
    /// Limits of messages from other vehicles.
    #[command(flatten)]
    #[serde(default)]
    pub inbox: InboxConfig,
    /// Connection to the router.
    #[command(flatten)]
    #[serde(default)]
    pub bus: BusConfig,
}

/// Streams of a method that exchanges feature maps.
fn feature_streams() -> Vec<Stream> {
    vec![Stream::Pose, Stream::Bev, Stream::Descriptor]
}

/// A link model and its seed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct LinkSelection {
    /// A YAML file with the stages of the link, or a preset.
    #[arg(long, value_name = "PRESET|FILE", long_help = link_help())]
    pub model: String,
    /// Same seed, same losses and delays.
    #[arg(long)]
    pub seed: u64,
}

impl Default for LinkSelection {
    fn default() -> Self {
        Self {
            model: "ideal".into(),
            seed: 0,
        }
    }
}

fn link_help() -> String {
    let presets = PRESETS
        .map(|(name, about)| format!("\n  {name}: {about}"))
        .concat();
    format!("A YAML file with the stages of the link, or a preset:{presets}\n")
}

impl ProcessConfig for LinkProcessConfig {
    const REQUIRED: &'static [&'static str] = &["run", "ego"];

    fn validate(&self) -> Result<(), FieldError> {
        self.inbox.validate()?;
        self.bus.validate()
    }
}
