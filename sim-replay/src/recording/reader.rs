//! Reading a recording, whole or cut.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read};
use std::ops::ControlFlow;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use mcap::read::ChannelAccumulator;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult, Message, parse_record};
use protocol::{Header, Key, wire};

use super::lengths::{self, RECORD_HEAD};
use super::{OWN_ENCODING, RecordingError};

/// A chunk that claims more than this, packed or not, is not ours: we close them at a few MiB and one message.
const MAX_CHUNK_BYTES: usize = 256 << 20;
/// Bytes taken from a file at once: a length that is wrong costs no more memory than what is there.
const READ_BYTES: usize = 1 << 20;
/// Chunks that are kept unpacked: neighbours in time are neighbours in the file.
const KEPT_CHUNKS: usize = 4;

/// A message of a recording, where it lies and what its header says.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Where it was published.
    pub key: Key,
    /// Its header.
    pub header: Header,
    /// When it reached the recorder, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    chunk: usize,
    /// Which message of the chunk.
    place: usize,
}

/// What is wrong with the end of a recording.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Damage {
    /// Where the whole part ends, bytes.
    pub whole_bytes: u64,
    /// Bytes behind it: of these nothing is read.
    pub lost_bytes: u64,
    /// What was found there.
    pub reason: String,
}

/// Where a chunk's record begins, and how long its body is.
#[derive(Debug, Clone, Copy)]
struct ChunkPlace {
    begin: u64,
    len: usize,
}

type Messages = Arc<Vec<Message<'static>>>;

/// All channels, and the chunks that were read last.
#[derive(Debug)]
struct Unpacked {
    channels: ChannelAccumulator<'static>,
    chunks: VecDeque<(usize, Messages)>,
}

/// A recording whose messages can be read in any order.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    file: File,
    chunks: Vec<ChunkPlace>,
    entries: Vec<Entry>,
    damage: Option<Damage>,
    unpacked: Mutex<Unpacked>,
}

impl Recording {
    /// Opens a recording and looks through all of it once; every chunk is compared with its checksum. One that is cut is
    /// read up to its last whole chunk, see [`Self::damage`].
    ///
    /// # Errors
    /// [`RecordingError`] when the file cannot be read or is no recording of ours.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::io(path, source);
        let file = File::open(path).map_err(io)?;
        let size = file.metadata().map_err(io)?.len();
        let mut contents = Contents { whole_bytes: mcap::MAGIC.len() as u64, ..Contents::default() };
        let options = LinearReaderOptions::default().with_emit_chunks(true);
        let read = for_each_record(BufReader::new(&file), options, |opcode, body| contents.take(opcode, body));
        let not_ours = |reason| RecordingError::NotOurs { path: path.into(), reason };
        let reason = match read {
            Err(McapError::BadMagic) => return Err(not_ours("not an MCAP file".into())),
            Err(error) => Some(error.to_string()),
            Ok(()) => (!contents.has_end).then(|| "the file ends without an index".into()),
        };
        let Contents { channels, has_own, chunks, entries, whole_bytes, has_end: _ } = contents;
        if !has_own {
            let what = reason.map_or(String::new(), |reason| format!("; {reason}"));
            return Err(not_ours(format!("no channel of encoding {OWN_ENCODING:?} in it{what}")));
        }
        let lost_bytes = size.saturating_sub(whole_bytes);
        let damage = reason.map(|reason| Damage { whole_bytes, lost_bytes, reason });
        let unpacked = Mutex::new(Unpacked { channels, chunks: VecDeque::new() });
        Ok(Self { path: path.into(), file, chunks, entries, damage, unpacked })
    }

    /// The file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The messages, in the order in which they were recorded.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// What of the file could not be read, if anything.
    #[must_use]
    pub fn damage(&self) -> Option<&Damage> {
        self.damage.as_ref()
    }

    /// The bytes of a message, as they were on the wire.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed since it was opened.
    pub fn read(&self, entry: &Entry) -> Result<Vec<u8>, RecordingError> {
        let messages = self.messages(entry.chunk)?;
        let changed = || RecordingError::malformed(&self.path, self.chunks[entry.chunk].begin, "the file has changed");
        messages.get(entry.place).map(|message| message.data.to_vec()).ok_or_else(changed)
    }

    /// The messages of whatever channel, chunk by chunk. For [`super::recover`].
    pub(super) fn chunks(&self) -> impl Iterator<Item = Result<Messages, RecordingError>> {
        (0..self.chunks.len()).map(|chunk| self.messages(chunk))
    }

    fn messages(&self, chunk: usize) -> Result<Messages, RecordingError> {
        let mut unpacked = self.unpacked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, messages)) = unpacked.chunks.iter().find(|(known, _)| *known == chunk) {
            return Ok(Arc::clone(messages));
        }
        let ChunkPlace { begin, len } = self.chunks[chunk];
        let mut body = vec![0; len];
        let read = self.file.read_exact_at(&mut body, begin + RECORD_HEAD as u64);
        read.map_err(|source| RecordingError::io(&self.path, source))?;
        let messages = unpack(&body, &mut unpacked.channels);
        let messages = messages.map_err(|error| RecordingError::malformed(&self.path, begin, error.to_string()))?;
        let messages = Arc::new(messages);
        unpacked.chunks.truncate(KEPT_CHUNKS - 1);
        unpacked.chunks.push_front((chunk, Arc::clone(&messages)));
        Ok(messages)
    }
}

/// What a first look through a file finds.
#[derive(Default)]
struct Contents {
    channels: ChannelAccumulator<'static>,
    /// Whether one of the channels is ours.
    has_own: bool,
    chunks: Vec<ChunkPlace>,
    entries: Vec<Entry>,
    /// Where the last whole record ends.
    whole_bytes: u64,
    /// Whether the data end where they were meant to.
    has_end: bool,
}

impl Contents {
    /// Takes the next record of the file in.
    fn take(&mut self, opcode: u8, body: &[u8]) -> McapResult<ControlFlow<()>> {
        match opcode {
            op::DATA_END => {
                self.has_end = true;
                return Ok(ControlFlow::Break(()));
            }
            op::CHUNK => self.take_chunk(body)?,
            _ => {}
        }
        self.whole_bytes += (RECORD_HEAD + body.len()) as u64;
        Ok(ControlFlow::Continue(()))
    }

    fn take_chunk(&mut self, body: &[u8]) -> McapResult<()> {
        let messages = unpack(body, &mut self.channels)?;
        let chunk = self.chunks.len();
        self.chunks.push(ChunkPlace { begin: self.whole_bytes, len: body.len() });
        for (place, message) in messages.iter().enumerate() {
            if message.channel.message_encoding != OWN_ENCODING {
                continue;
            }
            self.has_own = true;
            // What was no sound message when it was recorded is none now.
            let header = wire::decode_header([message.data.as_ref()]).ok();
            if let Some((key, header)) = message.channel.topic.parse().ok().zip(header) {
                self.entries.push(Entry { key, header, arrived_nanos: message.log_time, chunk, place });
            }
        }
        Ok(())
    }
}

/// The messages of a chunk, once it has been compared with its checksum; its channels are added to `channels`.
fn unpack(body: &[u8], channels: &mut ChannelAccumulator<'static>) -> McapResult<Vec<Message<'static>>> {
    lengths::check(op::CHUNK, body)?;
    let head = [[op::CHUNK].as_slice(), &(body.len() as u64).to_le_bytes()].concat();
    let options = LinearReaderOptions::default().with_skip_start_magic(true).with_prevalidate_chunk_crcs(true);
    let (mut messages, mut unpacked_bytes) = (Vec::new(), 0);
    for_each_record(head.chain(body), options, |opcode, data| {
        unpacked_bytes += data.len();
        if unpacked_bytes > MAX_CHUNK_BYTES {
            return Err(McapError::ChunkTooLarge(unpacked_bytes as u64));
        }
        // Others have no place in a chunk, and the parser trusts the lengths in some of them.
        if !matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE) {
            return Ok(ControlFlow::Continue(()));
        }
        lengths::check(opcode, data)?;
        match parse_record(opcode, data)? {
            Record::Schema { header, data } => channels.add_schema_from_slice(header, &data)?,
            Record::Channel(channel) => channels.add_channel(channel)?,
            Record::Message { header, data } => {
                if let Some(channel) = channels.get(header.channel_id) {
                    messages.push(Message {
                        channel,
                        sequence: header.sequence,
                        log_time: header.log_time,
                        publish_time: header.publish_time,
                        data: data.into_owned().into(),
                    });
                }
            }
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    })?;
    Ok(messages)
}

/// Gives the records of `source` to `visit`, one after the other, until it has had enough or there are no more.
fn for_each_record(
    mut source: impl Read,
    options: LinearReaderOptions,
    mut visit: impl FnMut(u8, &[u8]) -> McapResult<ControlFlow<()>>,
) -> McapResult<()> {
    let options = options.with_record_length_limit(MAX_CHUNK_BYTES).with_skip_end_magic(true);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => match source.read(reader.insert(wanted.min(READ_BYTES))) {
                Ok(count) => reader.notify_read(count),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            },
            LinearReadEvent::Record { opcode, data } => {
                if visit(opcode, data)?.is_break() {
                    return Ok(());
                }
            }
        }
    }
    Ok(())
}
