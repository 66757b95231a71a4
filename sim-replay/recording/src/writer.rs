//! Writer of recordings: messages in, whole chunks out.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, McapResult, WriteOptions};
use protocol::{CavId, Header, Key, Limits, RunId, Topic, wire};
use ros2::{Distribution, Mount, RosMessage, RosTopic, Translator};
use support::atomic_file;

use super::sink::{Store, WholeChunks};
use super::{OWN_ENCODING, RecordingError};
use crate::Result;

/// Size at which a chunk is closed: the largest loss of a crash, besides the last second.
const CHUNK_BYTES: usize = 4 << 20;
/// Recorded data are passed to ROS 2 tools unchanged: sweeps in map coordinates (UTM, for example) exceed the limits of
/// a receiver.
const ANY_SIZE: Limits = Limits {
    max_abs_value: f32::MAX,
    max_points: u64::MAX,
    max_body_bytes: u64::MAX,
    ..Limits::DEFAULT
};

/// Channels of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Contents {
    /// The messages as transmitted, and their translations for ROS 2 tools.
    #[default]
    All,
    /// The messages as transmitted.
    Messages,
    /// The translations: a bag of ROS 2.
    Ros2,
}

/// Options of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RecordingOptions {
    /// zstd level, 1 to 22; `None`: chunks are not compressed. Clouds and feature maps hardly shrink, and compression
    /// occupies a core.
    pub zstd_level: Option<u32>,
    /// Channels of the file.
    pub contents: Contents,
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
    /// Translator of each run.
    translators: BTreeMap<RunId, Translator>,
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
    pub fn create(path: &Path, options: RecordingOptions) -> Result<Self> {
        let file = File::create_new(path).map_err(RecordingError::io(path))?;
        Self::over(file, path, options)
    }

    /// A new file that `write` writes and finishes, and that has its name only then.
    ///
    /// # Errors
    /// [`RecordingError::Io`] if the file exists already, or an unfinished one of a killed process; those of `write`.
    /// No part of the file is left then.
    pub(super) fn whole<T>(
        path: &Path,
        options: RecordingOptions,
        write: impl FnOnce(&mut Self) -> Result<T>,
    ) -> Result<T> {
        if path.exists() {
            return Err(RecordingError::io(path)(ErrorKind::AlreadyExists.into()));
        }
        let part = path.with_added_extension("unfinished");
        // Never over an older one: it may be the recording that is read, or one that another process writes.
        let file = File::create_new(&part).map_err(RecordingError::io(&part))?;
        let named = Self::over(file, &part, options).and_then(|mut writer| {
            let written = write(&mut writer)?;
            let named = fs::rename(&part, path).and_then(|()| atomic_file::sync_name(path));
            named.map_err(RecordingError::io(path)).map(|()| written)
        });
        named.inspect_err(|_| drop(fs::remove_file(&part)))
    }
}

impl<S: Store> RecordingWriter<S> {
    /// Begins a recording in `store`; `path` is its name in errors.
    ///
    /// # Errors
    /// [`RecordingError::Io`] if the header cannot be written.
    pub fn over(store: S, path: &Path, options: RecordingOptions) -> Result<Self> {
        // The profile promises that every channel is one of ROS 2.
        let profile = match options.contents {
            Contents::Ros2 => "ros2",
            Contents::All | Contents::Messages => "",
        };
        let format = WriteOptions::new()
            .profile(profile)
            .library(concat!("v2vloc ", env!("CARGO_PKG_VERSION")))
            .compression(options.zstd_level.map(|_| Compression::Zstd))
            .compression_level(options.zstd_level.unwrap_or_default())
            .compression_threads(0)
            // Chunks end at a flush only: by it this writer counts the messages that can be read back.
            .chunk_size(None)
            // The sink appends and cannot go back to fill in the length of a chunk.
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
            translators: BTreeMap::new(),
            unconverted: BTreeSet::new(),
            ended: None,
        };
        // A store that cannot be written fails here, not at the end of the first chunk.
        writer.flush()?;
        Ok(writer)
    }

    /// Writes a message that arrived on `key` at `arrived_nanos` (Unix clock), unchanged and, if ROS 2 has a type for
    /// it, once more for ROS 2 tools. A payload that is no valid message is written unchanged.
    ///
    /// # Errors
    /// [`RecordingError`] if the message, and with it its chunk, is not written.
    pub fn write(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> Result<()> {
        self.attempt(|writer| writer.add(key, arrived_nanos, payload))?;
        if self.open.1 > CHUNK_BYTES {
            self.flush()?;
        }
        Ok(())
    }

    #[expect(
        clippy::cast_possible_truncation,
        reason = "MCAP has 32 bits for the sequence number, which may wrap"
    )]
    fn add(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> McapResult<()> {
        // Without a valid header the arrival is the only time that is known.
        let (sequence, publish_time) = match wire::decode_header([payload]) {
            Ok(Header { stamp, .. }) => (stamp.sequence as u32, stamp.publish_nanos),
            Err(_) => (0, arrived_nanos),
        };
        let is_bag = self.options.contents == Contents::Ros2;
        if !is_bag {
            let head = MessageHeader {
                channel_id: self.own_channel(key)?,
                sequence,
                log_time: arrived_nanos,
                publish_time,
            };
            self.put(&head, payload)?;
        }
        let translations = self.translated(key, payload);
        self.open.0 += u64::from(!is_bag || !translations.is_empty());
        translations
            .iter()
            .try_for_each(|message| self.add_ros(arrived_nanos, sequence, message))
    }

    fn add_ros(&mut self, nanos: u64, sequence: u32, message: &RosMessage) -> McapResult<()> {
        // Published at the time of its arrival: several senders share /tf, whose times have to be in order.
        let head = MessageHeader {
            channel_id: self.ros_channel(&message.topic)?,
            sequence,
            log_time: nanos,
            publish_time: nanos,
        };
        self.put(&head, &message.cdr)
    }

    fn put(&mut self, head: &MessageHeader, data: &[u8]) -> McapResult<()> {
        self.open.1 += data.len();
        self.mcap.write_to_known_channel(head, data)
    }

    /// Writes the fixed transforms of `vehicles` at `nanos`, for bags.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn write_static_transforms(
        &mut self,
        nanos: u64,
        vehicles: &BTreeSet<CavId>,
        mount: &Mount,
    ) -> Result<()> {
        let cdr = ros2::static_transforms(nanos, vehicles.iter(), mount);
        let message = RosMessage::new(RosTopic::TfStatic, cdr);
        self.attempt(|writer| writer.add_ros(nanos, 0, &message))
    }

    /// Ends the open chunk: everything written so far survives a crash of this process.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn flush(&mut self) -> Result<()> {
        self.attempt(|writer| writer.mcap.flush())?;
        // After the flush has succeeded: messages of a chunk that was cut off do not count.
        self.whole_messages += std::mem::take(&mut self.open).0;
        Ok(())
    }

    /// Messages in whole chunks: those that can be read back. Translations are not counted again; a bag counts messages
    /// that have one.
    pub fn whole_messages(&self) -> u64 {
        self.whole_messages
    }

    /// Writes the index and ends the recording, which then survives a power cut.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn finish(&mut self) -> Result<()> {
        self.flush()?;
        self.attempt(|writer| writer.mcap.finish().map(drop))?;
        self.ended = Some("it is complete".into());
        S::sync(&self.path).map_err(RecordingError::io(&self.path))
    }

    /// The channel of messages as transmitted, declared on first use.
    fn own_channel(&mut self, key: &Key) -> McapResult<u16> {
        let topic = key.to_string();
        match self.channels.get(&topic) {
            Some(id) => Ok(*id),
            // The topic alone decides: an invalid first message must not affect those after it.
            None if key.topic.is_json() => self.add_channel(topic, 0, "json", &BTreeMap::new()),
            None => self.add_channel(topic, 0, OWN_ENCODING, &BTreeMap::new()),
        }
    }

    /// The channel of a ROS 2 topic, declared on first use with what rosbag2 asks for: a schema and the quality of service.
    fn ros_channel(&mut self, topic: &RosTopic) -> McapResult<u16> {
        let name = topic.name(None).to_string();
        if let Some(id) = self.channels.get(&name) {
            return Ok(*id);
        }
        let ros_type = topic.ros_type();
        let schema_id =
            self.mcap
                .add_schema(&ros_type.name(), "ros2msg", ros_type.schema().as_bytes())?;
        let profiles = topic.qos().offered_profiles();
        let hash = ros_type.hash(Distribution::Jazzy);
        let metadata = [
            ("offered_qos_profiles".to_owned(), profiles),
            ("topic_type_hash".to_owned(), hash),
        ];
        self.add_channel(name, schema_id, "cdr", &metadata.into())
    }

    fn add_channel(
        &mut self,
        topic: String,
        schema_id: u16,
        encoding: &str,
        metadata: &BTreeMap<String, String>,
    ) -> McapResult<u16> {
        let id = self
            .mcap
            .add_channel(schema_id, &topic, encoding, metadata)?;
        self.channels.insert(topic, id);
        Ok(id)
    }

    /// The ROS 2 messages of a message; none if ROS has no type for it. An invalid message is reported, once for its
    /// topic.
    fn translated(&mut self, key: &Key, payload: &[u8]) -> Vec<RosMessage> {
        if self.options.contents == Contents::Messages || !Translator::wants(&key.topic) {
            return Vec::new();
        }
        match wire::decode_any([payload], &ANY_SIZE) {
            Ok((header, message)) => {
                let translator = self.translators.entry(key.run.clone());
                let translator = translator.or_insert_with(|| Translator::new(&key.run));
                translator.translate(&key.topic, header.stamp.capture_nanos, &message)
            }
            Err(error) => {
                if self.unconverted.insert(key.topic.clone()) {
                    tracing::warn!("{key}: not translated for ROS 2 tools: {error}");
                }
                Vec::new()
            }
        }
    }

    /// Writes, unless an earlier write has failed; an error ends the recording.
    fn attempt(&mut self, write: impl FnOnce(&mut Self) -> McapResult<()>) -> Result<()> {
        if let Some(reason) = &self.ended {
            return Err(RecordingError::Ended {
                path: self.path.clone(),
                reason: reason.clone(),
            });
        }
        write(self).map_err(|error| {
            let error = failure(&self.path, error);
            self.ended = Some(error.to_string());
            error
        })
    }
}

fn failure(path: &Path, error: McapError) -> RecordingError {
    let source = match error {
        McapError::Io(source) => source,
        other => std::io::Error::other(other),
    };
    RecordingError::io(path)(source)
}
