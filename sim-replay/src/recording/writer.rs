//! Writing a recording: messages in, whole chunks out.

use std::fs::File;
use std::path::{Path, PathBuf};

use protocol::{Key, Limits, wire};

use super::chunk::OpenChunk;
use super::mcap::{Channel, Fields, MAGIC, MessageHead, op};
use super::ros::{self, RosMessage};
use super::ros_schema::RosType;
use super::sink::Store;
use super::summary::Summary;
use super::{OWN_ENCODING, RecordingError};

/// A chunk is closed when it holds this much: what a crash costs, beside the last second.
const CHUNK_BYTES: usize = 4 << 20;

/// How to write a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordingOptions {
    /// zstd level, 1 to 22; `None`: chunks are not packed. Clouds and maps hardly shrink, and packing costs a core.
    pub zstd_level: Option<i32>,
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
    store: S,
    chunk: OpenChunk,
    summary: Summary,
    /// Bytes up to the end of the last whole chunk.
    whole: u64,
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
        let mut writer = Self {
            path: path.into(),
            options,
            store,
            chunk: OpenChunk::default(),
            summary: Summary::default(),
            whole: 0,
            ended: None,
        };
        let mut head = MAGIC.to_vec();
        let library = concat!("v2vloc ", env!("CARGO_PKG_VERSION"));
        Fields::default().prefixed(b"ros2").prefixed(library.as_bytes()).append(op::HEADER, &mut head);
        writer.put(&head)?;
        Ok(writer)
    }

    /// Writes a message that came on `key` at `arrived_nanos` (Unix clock), as it is and, where ROS 2 has a word for it,
    /// once more for ROS 2 tools. A payload that is no sound message of ours is written as it is.
    ///
    /// # Errors
    /// [`RecordingError`] when the message, and with it the chunk that it would have gone into, is not written.
    pub fn write(&mut self, key: &Key, arrived_nanos: u64, payload: &[u8]) -> Result<(), RecordingError> {
        self.check_open()?;
        let header = wire::decode_header([payload]).ok();
        let encoding = if header.is_some() { OWN_ENCODING } else { "json" };
        let channel_id = self.channel(&key.to_string(), encoding, None);
        let head = MessageHead {
            channel_id,
            sequence: header.as_ref().map_or(0, |header| header.stamp.sequence as u32),
            log_time: arrived_nanos,
            publish_time: header.as_ref().map_or(arrived_nanos, |header| header.stamp.publish_nanos),
        };
        self.chunk.push(&head, payload);
        if self.options.with_ros {
            for RosMessage { topic, ros_type, cdr } in translated(key, payload) {
                let channel_id = self.channel(&topic, "cdr", Some(ros_type));
                self.chunk.push(&MessageHead { channel_id, ..head }, &cdr);
            }
        }
        if self.chunk.len() > CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

    /// Ends the chunk that is open: everything written so far will be there whatever becomes of this process.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.check_open()?;
        if self.chunk.is_empty() {
            return Ok(());
        }
        let chunk = std::mem::take(&mut self.chunk).close(self.options.zstd_level);
        let chunk = chunk.map_err(|source| RecordingError::io(&self.path, source))?;
        let offset = self.whole;
        self.put(&chunk.bytes)?;
        self.summary.add(&chunk, offset);
        Ok(())
    }

    /// Bytes up to the end of the last whole chunk.
    #[must_use]
    pub fn whole_bytes(&self) -> u64 {
        self.whole
    }

    /// Writes the index and ends the recording.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub fn finish(mut self) -> Result<S, RecordingError> {
        self.flush()?;
        let end = self.summary.bytes(self.whole);
        self.put(&end)?;
        Ok(self.store)
    }

    /// The channel of a topic, declared when it is first needed.
    fn channel(&mut self, topic: &str, encoding: &str, ros: Option<RosType>) -> u16 {
        if let Some(id) = self.summary.channel(topic) {
            return id;
        }
        let schema_id = ros.map_or(0, |ros| self.schema(ros));
        let id = self.summary.next_channel();
        let channel = Channel { id, schema_id, topic: topic.to_owned(), encoding: encoding.to_owned() };
        self.chunk.declare(op::CHANNEL, &channel.fields());
        self.summary.declare(channel);
        id
    }

    fn schema(&mut self, ros: RosType) -> u16 {
        if let Some((id, _)) = self.summary.schemas.get(&ros) {
            return *id;
        }
        let id = self.summary.schemas.len() as u16 + 1;
        let definition = ros.definition();
        let fields = || {
            let named = Fields::default().u16(id).prefixed(ros.name().as_bytes()).prefixed(b"ros2msg");
            named.prefixed(definition.as_bytes())
        };
        self.chunk.declare(op::SCHEMA, &fields());
        self.summary.schemas.insert(ros, (id, fields()));
        id
    }

    fn check_open(&self) -> Result<(), RecordingError> {
        match &self.ended {
            None => Ok(()),
            Some(reason) => Err(RecordingError::Ended { path: self.path.clone(), reason: reason.clone() }),
        }
    }

    /// Hands whole records to the store; what it takes only a part of is taken away again.
    fn put(&mut self, bytes: &[u8]) -> Result<(), RecordingError> {
        match self.store.write_all(bytes).and_then(|()| self.store.flush()) {
            Ok(()) => {
                self.whole += bytes.len() as u64;
                Ok(())
            }
            Err(source) => {
                let error = RecordingError::io(&self.path, source);
                self.ended = Some(error.to_string());
                if let Err(error) = self.store.cut(self.whole) {
                    tracing::error!("{}: what was begun cannot be taken away: {error}", self.path.display());
                }
                Err(error)
            }
        }
    }
}

fn translated(key: &Key, payload: &[u8]) -> Vec<RosMessage> {
    if !ros::has_word_for(&key.topic) {
        return Vec::new();
    }
    match wire::decode_any([payload], &Limits::DEFAULT) {
        Ok((header, message)) => ros::translate(&key.topic, header.stamp.capture_nanos, &message),
        Err(_) => Vec::new(),
    }
}
