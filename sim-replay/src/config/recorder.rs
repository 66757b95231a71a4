//! Configuration of `sim-replay record`.

use std::path::PathBuf;

use protocol::config::{FieldError, within};
use protocol::{RunId, Stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use bus::{BusConfig, ProcessConfig};
use recording::{Contents, RecordingOptions};

/// Configuration of `sim-replay record`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct RecorderConfig {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long, required_unless_present = "config")]
    pub run: RunId,
    /// The new file.
    #[arg(long, value_name = "FILE.mcap", required_unless_present = "config")]
    pub out: PathBuf,
    /// Contents of the recording.
    #[command(flatten)]
    #[serde(default)]
    pub record: RecordingConfig,
    /// Continue when the replay ends, for the next one; always so with `supervised`.
    #[arg(long)]
    #[serde(default)]
    pub keep_running: bool,
    /// Connection to the router.
    #[command(flatten)]
    #[serde(default)]
    pub bus: BusConfig,
}

/// Contents of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingConfig {
    /// Streams to leave out, for example bev, which is most of the bytes.
    #[arg(long, value_delimiter = ',', value_name = "STREAM")]
    pub without: Vec<Stream>,
    /// Leave out the channels for ROS 2 tools: half the size, and still exactly the published messages.
    #[arg(long)]
    pub plain: bool,
    /// Record what enters the decisions of the ego and the agents too, in the run folder, for `replay-inputs` of
    /// `ego-fuser` and `agent`.
    #[arg(skip)]
    pub inputs: bool,
    /// zstd level, 1 to 22. Absent: not compressed; clouds and feature maps hardly shrink.
    #[arg(long, value_name = "LEVEL")]
    #[schemars(range(min = 1, max = 22))]
    pub zstd_level: Option<u32>,
}

impl RecordingConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] for the first invalid value.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("record.zstd_level", self.zstd_level.unwrap_or(1), 1, 22)
    }

    /// The options of the file.
    pub fn options(&self) -> RecordingOptions {
        RecordingOptions {
            zstd_level: self.zstd_level,
            contents: match self.plain {
                true => Contents::Messages,
                false => Contents::All,
            },
        }
    }
}

impl ProcessConfig for RecorderConfig {
    const REQUIRED: &'static [&'static str] = &["run", "out"];

    fn validate(&self) -> Result<(), FieldError> {
        self.record.validate()?;
        self.bus.validate()
    }
}
