//! Writing a recording: messages in, whole chunks out.

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

/// A chunk is closed when it holds this much: what a crash costs, beside the last second.
const CHUNK_BYTES: usize = 4 << 20;
/// What is recorded is told to ROS 2 tools as it is: sweeps in coordinates of a map (UTM, for example) reach further than
/// a receiver takes.
const ANY_SIZE: Limits =
    Limits { max_abs_value: f32::MAX, max_points: u64::MAX, max_body_bytes: u64::MAX, ..Limits::DEFAULT };

/// How to write a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordingOptions {
    /// zstd level, 1 to 22; `None`: chunks are not packed. Clouds and maps hardly shrink, and packing costs a core.
    pub zstd_level: Option<u32>,
    /// Whether to write the channels for ROS 2 tools too.
    pub with_ros: bool,
}

impl Default for RecordingOptions {
    fn default() -> Self {
        Self { zstd_level: None, with_ros: true }
    }
}

/// A recording that is being written.
///
/// After an error nothing more is written: what is there is cut down to the last whole chunk, and every further message
/// is refused with [`RecordingError::Ended`].
pub struct RecordingWriter<S: Store> {
    path: PathBuf,
    options: RecordingOptions,
    mcap: mcap::Writer<NoSeek<WholeChunks<S>>>,
    /// By topic.
    channels: BTreeMap<String, u16>,
    /// Messages and bytes of the chunk that is open.
    open: (u64, usize),
    whole_messages: u64,
    /// Topics with messages that ROS 2 tools are not told of.
    untold: BTreeSet<Topic>,
    /// Why nothing more is written.
    ended: Option<String>,
}

impl RecordingWriter<File> {
    /// Begins a recording in a new file.
    ///
    /// # Errors
    /// [`RecordingError::Io`], also where the file is there already.
    pub fn create(path: &Path, options: RecordingOptions) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| RecordingError::io(path, source))?;
        Self::over(file, path, options)
    }
}

impl<S: Store> RecordingWriter<S> {
    /// Begins a recording in `store`; `path` names it in errors.
    ///
    /// # Errors
    /// [`RecordingError::Io`] when not even the header can be written.
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
            untold: BTreeSet::new(),
            ended: None,
        };
        writer.flush()?;
        Ok(writer)
    }

    /// Writes a message that came on `key` at `arrived_nanos` (Unix clock), as it is and, where ROS 2 has a word for it,
    /// once more for ROS 2 tools. A payload that is no sound message of ours is written as it is.
    ///
    /// # Errors
    /// [`RecordingError`] when the message, and with it the chunk that it would have gone into, is not written.
    pub fn write(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> Result<(), RecordingError> {
        self.check_open()?;
        let added = self.add(key, arrived_nanos, payload);
        self.checked(added)?;
        if self.open.1 > CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

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

    /// Ends the chunk that is open: everything written so far will be there whatever becomes of this process.
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

    /// Messages in whole chunks: those that can be read back. What is told to ROS 2 tools is not counted again.
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

    /// The channel of a topic, declared when it is first needed.
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

    /// A message for ROS 2 tools; none where ROS has no word for it. One that is not sound is named, once for its topic.
    fn translated(&mut self, key: &Key, payload: &[u8]) -> Vec<RosMessage> {
        if !ros::has_word_for(&key.topic) {
            return Vec::new();
        }
        match wire::decode_any([payload], &ANY_SIZE) {
            Ok((header, message)) => ros::translate(&key.topic, header.stamp.capture_nanos, &message),
            Err(error) => {
                if self.untold.insert(key.topic.clone()) {
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

/// How the messages of a topic are encoded. The topic alone decides: a first message that is none must not spoil those
/// after it.
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
