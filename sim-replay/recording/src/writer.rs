//! Writer of recordings: messages in, whole chunks out.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, McapResult, WriteOptions};
use protocol::{Key, Limits, Topic, wire};

use super::ros::{self, RosMessage};
use super::ros_schema::RosType;
use super::sink::{Store, WholeChunks};
use super::{OWN_ENCODING, RecordingError};

/// Size at which a chunk is closed: the largest loss of a crash, besides the last second.
const CHUNK_BYTES: usize = 4 << 20;
/// Recorded data are passed to ROS 2 tools unchanged: sweeps in map coordinates (UTM, for example) exceed the limits of
/// a receiver.
const ANY_SIZE: Limits =
    Limits { max_abs_value: f32::MAX, max_points: u64::MAX, max_body_bytes: u64::MAX, ..Limits::DEFAULT };

/// Options of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordingOptions {
    /// zstd level, 1 to 22; `None`: chunks are not compressed. Clouds and feature maps hardly shrink, and compression
    /// occupies a core.
    pub zstd_level: Option<u32>,
    /// True to write the channels for ROS 2 tools too.
    pub with_ros: bool,
}

impl Default for RecordingOptions {
    fn default() -> Self {
        Self { zstd_level: None, with_ros: true }
    }
}

/// A recording that is being written.
///
/// After an error nothing more is written: the file is truncated to the last whole chunk, and every further message is
/// refused with [`RecordingError::Ended`].
pub struct RecordingWriter<S: Store> {
    path: PathBuf,
    options: RecordingOptions,
    mcap: mcap::Writer<NoSeek<WholeChunks<S>>>,
    /// Channel id by topic.
    channels: BTreeMap<String, u16>,
    /// Messages and bytes of the open chunk.
    open: (u64, usize),
    whole_messages: u64,
    /// Topics with messages that could not be converted to ROS 2.
    unconverted: BTreeSet<Topic>,
    /// Reason why nothing more is written.
    ended: Option<String>,
}

impl RecordingWriter<File> {
    /// Begins a recording in a new file.
    ///
    /// # Errors
    /// [`RecordingError::Io`], also if the file exists already.
    pub fn create(path: &Path, options: RecordingOptions) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| RecordingError::io(path, source))?;
        Self::over(file, path, options)
    }
}

impl<S: Store> RecordingWriter<S> {
    /// Begins a recording in `store`; `path` is its name in errors.
    ///
    /// # Errors
    /// [`RecordingError::Io`] if the header cannot be written.
    pub fn over(store: S, path: &Path, options: RecordingOptions) -> Result<Self, RecordingError> {
        let format = WriteOptions::new()
            .profile("ros2")
            .library(concat!("v2vloc ", env!("CARGO_PKG_VERSION")))
            .compression(options.zstd_level.map(|_| Compression::Zstd))
            .compression_level(options.zstd_level.unwrap_or_default())
            .compression_threads(0)
            .chunk_size(None)
            .disable_seeking(true)
            // Each chunk has its own checksum.
            .calculate_data_section_crc(false);
        let begun = format.create(NoSeek::new(WholeChunks::new(store)));
        let mut writer = Self {
            path: path.into(),
            options,
            mcap: begun.map_err(|error| failure(path, error))?,
            channels: BTreeMap::new(),
            open: (0, 0),
            whole_messages: 0,
            unconverted: BTreeSet::new(),
            ended: None,
        };
        writer.flush()?;
        Ok(writer)
    }

    /// Writes a message that arrived on `key` at `arrived_nanos` (Unix clock), unchanged and, if ROS 2 has a type for
    /// it, once more for ROS 2 tools. A payload that is no valid message is written unchanged.
    ///
    /// # Errors
    /// [`RecordingError`] if the message, and with it its chunk, is not written.
    pub fn write(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> Result<(), RecordingError> {
        self.check_open()?;
        let added = self.add(key, arrived_nanos, payload);
        self.checked(added)?;
        if self.open.1 > CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

    #[expect(clippy::cast_possible_truncation, reason = "MCAP has 32 bits for the sequence number, which may wrap")]
    fn add(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> McapResult<()> {
        let header = wire::decode_header([payload]).ok();
        let head = MessageHeader {
            channel_id: self.channel(&key.to_string(), encoding_of(&key.topic), None)?,
            sequence: header.as_ref().map_or(0, |header| header.stamp.sequence as u32),
            log_time: arrived_nanos,
            publish_time: header.as_ref().map_or(arrived_nanos, |header| header.stamp.publish_nanos),
        };
        self.mcap.write_to_known_channel(&head, payload)?;
        self.open = (self.open.0 + 1, self.open.1 + payload.len());
        if self.options.with_ros {
            for RosMessage { topic, ros_type, cdr } in self.translated(key, payload) {
                let channel_id = self.channel(&topic, "cdr", Some(ros_type))?;
                self.mcap.write_to_known_channel(&MessageHeader { channel_id, ..head }, &cdr)?;
                self.open.1 += cdr.len();
            }
        }
        Ok(())
    }

    /// Ends the open chunk: everything written so far survives a crash of this process.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.check_open()?;
        let flushed = self.mcap.flush();
        self.checked(flushed)?;
        self.whole_messages += std::mem::take(&mut self.open).0;
        Ok(())
    }

    /// Messages in whole chunks: those that can be read back. Their copies for ROS 2 are not counted again.
    #[must_use]
    pub fn whole_messages(&self) -> u64 {
        self.whole_messages
    }

    /// Writes the index and ends the recording.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn finish(&mut self) -> Result<(), RecordingError> {
        self.flush()?;
        let finished = self.mcap.finish();
        self.checked(finished)?;
        self.ended = Some("it is complete".into());
        Ok(())
    }

    /// The channel of a topic, declared on first use.
    fn channel(&mut self, topic: &str, encoding: &str, ros: Option<RosType>) -> McapResult<u16> {
        if let Some(id) = self.channels.get(topic) {
            return Ok(*id);
        }
        let schema_id = match ros {
            Some(ros) => self.mcap.add_schema(ros.name(), "ros2msg", ros.definition().as_bytes())?,
            None => 0,
        };
        let id = self.mcap.add_channel(schema_id, topic, encoding, &BTreeMap::new())?;
        self.channels.insert(topic.to_owned(), id);
        Ok(id)
    }

    /// The ROS 2 messages of a message; none if ROS has no type for it. An invalid message is reported, once for its
    /// topic.
    fn translated(&mut self, key: &Key, payload: &[u8]) -> Vec<RosMessage> {
        if !ros::has_type_for(&key.topic) {
            return Vec::new();
        }
        match wire::decode_any([payload], &ANY_SIZE) {
            Ok((header, message)) => ros::translate(&key.topic, header.stamp.capture_nanos, &message),
            Err(error) => {
                if self.unconverted.insert(key.topic.clone()) {
                    tracing::warn!("{key}: recorded as it came, but not for ROS 2 tools: {error}");
                }
                Vec::new()
            }
        }
    }

    fn check_open(&self) -> Result<(), RecordingError> {
        match &self.ended {
            None => Ok(()),
            Some(reason) => Err(RecordingError::Ended { path: self.path.clone(), reason: reason.clone() }),
        }
    }

    fn checked<T>(&mut self, written: McapResult<T>) -> Result<T, RecordingError> {
        written.map_err(|error| {
            let error = failure(&self.path, error);
            self.ended = Some(error.to_string());
            error
        })
    }
}

/// Encoding of the messages of a topic. The topic alone decides: an invalid first message must not affect those after
/// it.
fn encoding_of(topic: &Topic) -> &'static str {
    match topic {
        Topic::Stream { stream, .. } | Topic::Received { stream, .. } if stream.kind().is_none() => "json",
        _ => OWN_ENCODING,
    }
}

fn failure(path: &Path, error: McapError) -> RecordingError {
    let source = match error {
        McapError::Io(source) => source,
        other => std::io::Error::other(other),
    };
    RecordingError::io(path, source)
}
