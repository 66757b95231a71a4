//! MCAP file of any program: scanned once, then its messages in any order; complete, truncated, or with damaged parts.

use std::collections::VecDeque;
use std::fs::File;
use std::ops::ControlFlow;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use mcap::Message;
use mcap::records::op;
use support::bounded_file;

use super::chunk::{Channels, in_words, unpack};
use super::damage::Damage;
use super::lengths::{self, RECORD_HEAD};
use super::records::{RawRecord, Records};
use super::{OWN_ENCODING, RecordingError};

/// Unpacked chunks in the cache: neighbours in time are neighbours in the file.
const KEPT_CHUNKS: usize = 4;
/// Reading stops after more damaged parts than this.
const MAX_DAMAGED: usize = 1000;

/// Position of a message in an MCAP file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct McapPlace {
    /// Index of the record that holds it.
    holder: usize,
    /// Index of the message in that record.
    index: usize,
}

/// A record that holds messages: a chunk, or a message outside of chunks.
#[derive(Debug, Clone, Copy)]
struct Holder {
    begin: u64,
    /// Length of its body.
    len: usize,
    is_chunk: bool,
}

/// Messages of one record.
pub(super) type RecordMessages = Arc<Vec<Message<'static>>>;

/// All channels, and a cache of the messages read last.
#[derive(Debug)]
struct Unpacked {
    channels: Channels,
    kept: VecDeque<(usize, RecordMessages)>,
}

/// An MCAP file of any program, whose messages can be read in any order.
#[derive(Debug)]
pub struct McapFile {
    path: PathBuf,
    file: File,
    holders: Vec<Holder>,
    damage: Vec<Damage>,
    unpacked: Mutex<Unpacked>,
}

/// True for a file of another program, as far as its summary shows: no message is read.
pub(super) fn is_foreign(path: &Path) -> Result<bool, RecordingError> {
    let file = bounded_file::open(path).map_err(RecordingError::io(path))?;
    let size = file.metadata().map_err(RecordingError::io(path))?.len();
    let channels = Channels::of_summary(&file, size).map_err(RecordingError::io(path))?;
    Ok(channels.are_foreign())
}

impl McapFile {
    /// Opens a file and scans all of it once; the checksum of every chunk is verified. Truncated or damaged parts are left
    /// out, see [`Self::damage`]. `visit` receives each message and its position, and returns true for those between which
    /// damage is timed.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read or is no MCAP file.
    pub fn open(
        path: &Path,
        visit: &mut dyn FnMut(&Message<'static>, McapPlace) -> bool,
    ) -> Result<Self, RecordingError> {
        let file = bounded_file::open(path).map_err(RecordingError::io(path))?;
        let size = file.metadata().map_err(RecordingError::io(path))?.len();
        let mut records = Records::open(&file, size)
            .map_err(RecordingError::io(path))?
            .ok_or_else(|| RecordingError::not_ours(path, "not an MCAP file"))?;
        let mut contents = FileScan {
            channels: Channels::of_summary(&file, size).map_err(RecordingError::io(path))?,
            holders: Vec::new(),
            arrivals: Vec::new(),
            lost: Vec::new(),
            unpacked_bytes: 0,
            most_unpacked: bounded_file::most_unpacked(size),
            visit,
        };
        let read = contents.look_through(&mut records, size);
        read.map_err(RecordingError::io(path))?;
        Ok(Self {
            path: path.into(),
            damage: contents.damage(),
            holders: contents.holders,
            unpacked: Mutex::new(Unpacked {
                channels: contents.channels,
                kept: VecDeque::new(),
            }),
            file,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The parts of the file that could not be read, in its order.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    /// The bytes of a message.
    ///
    /// # Errors
    /// [`RecordingError`] if the file has changed since it was opened.
    pub fn read(&self, place: McapPlace) -> Result<Vec<u8>, RecordingError> {
        let messages = self.messages(place.holder)?;
        let message = messages
            .get(place.index)
            .ok_or_else(|| self.changed(place.holder, "the file has changed"))?;
        Ok(message.data.to_vec())
    }

    /// The messages of all channels, in the order of the file.
    pub(super) fn all(&self) -> impl Iterator<Item = Result<RecordMessages, RecordingError>> {
        (0..self.holders.len()).map(|holder| self.messages(holder))
    }

    fn changed(&self, holder: usize, reason: impl Into<String>) -> RecordingError {
        RecordingError::Malformed {
            path: self.path.clone(),
            offset: self.holders.get(holder).map_or(0, |holder| holder.begin),
            reason: reason.into(),
        }
    }

    fn messages(&self, holder: usize) -> Result<RecordMessages, RecordingError> {
        // Held while the chunk is read: two readers of the same chunk would unpack it twice.
        let mut unpacked = self.unpacked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, messages)) = unpacked.kept.iter().find(|(known, _)| *known == holder) {
            return Ok(Arc::clone(messages));
        }
        let Some(held) = self.holders.get(holder) else {
            return Err(self.changed(holder, "there is no such chunk"));
        };
        let mut body = vec![0; held.len];
        let begin = held.begin + RECORD_HEAD as u64;
        let read = self.file.read_exact_at(&mut body, begin);
        read.map_err(RecordingError::io(&self.path))?;
        let messages = match held.is_chunk {
            true => unpack(&body, &mut unpacked.channels).map(|chunk| chunk.messages),
            false => unpacked
                .channels
                .message(&body)
                .map(|message| message.into_iter().collect()),
        };
        let messages = Arc::new(messages.map_err(|error| self.changed(holder, in_words(error)))?);
        unpacked.kept.truncate(KEPT_CHUNKS - 1);
        unpacked.kept.push_front((holder, Arc::clone(&messages)));
        Ok(messages)
    }
}

/// A part of the file that is skipped.
#[derive(Debug)]
struct LostPart {
    begin: u64,
    end: u64,
    /// Number of timed messages before it.
    before: usize,
    reason: String,
}

/// Result of scanning a file.
struct FileScan<'a> {
    channels: Channels,
    holders: Vec<Holder>,
    /// Times of the messages between which damage is timed.
    arrivals: Vec<u64>,
    lost: Vec<LostPart>,
    /// Bytes that the chunks so far unpack to, and the most that those of a file of this size may.
    unpacked_bytes: u64,
    most_unpacked: u64,
    visit: &'a mut dyn FnMut(&Message<'static>, McapPlace) -> bool,
}

impl FileScan<'_> {
    /// Reads all records of a file of `size` bytes, except damaged ones.
    fn look_through(&mut self, records: &mut Records<'_>, size: u64) -> std::io::Result<()> {
        loop {
            let begin = records.at;
            let taken = match records.next()? {
                Ok(Some(record)) => self.take(begin, &record),
                // A damaged part that reaches the end of the file is reported already.
                Ok(None) if self.lost.last().is_some_and(|lost| lost.end == size) => return Ok(()),
                Ok(None) => {
                    self.lose((begin, begin), "the file ends without an index".into());
                    return Ok(());
                }
                Err(reason) => Err(reason),
            };
            match taken {
                Ok(ControlFlow::Continue(())) => {}
                Ok(ControlFlow::Break(stated_crc)) => {
                    // Verifies the checksum of all data, for files without checksums of chunks.
                    let found = records.crc();
                    // 0 means that no checksum was computed. After a skipped part it differs in any case.
                    if stated_crc != 0
                        && stated_crc != found
                        && self.lost.is_empty()
                        && self.holders.iter().all(|holder| !holder.is_chunk)
                    {
                        let reason = "the checksum of the data does not agree with them";
                        self.lose((begin, begin), reason.into());
                    }
                    return Ok(());
                }
                Err(reason) if self.lost.len() >= MAX_DAMAGED => {
                    self.lose((begin, size), format!("too many damaged parts; {reason}"));
                    return Ok(());
                }
                Err(reason) => {
                    // The search begins at the next byte: a damaged record's length is not to be trusted.
                    let has_chunks = self.has_chunks();
                    records.seek(begin + 1, |id| {
                        let channel = (!has_chunks).then(|| self.channels.get(id)).flatten();
                        channel.is_some_and(|channel| channel.message_encoding == OWN_ENCODING)
                    })?;
                    self.lose((begin, records.at), reason);
                }
            }
        }
    }

    /// True if messages are in chunks: then those of a damaged chunk are not read one by one.
    fn has_chunks(&self) -> bool {
        let first = self.holders.first().map(|holder| holder.is_chunk);
        self.channels.has_chunks.or(first).unwrap_or(false)
    }

    /// Processes the next record of the file, which starts at byte `begin`; ends with the checksum of the data section.
    fn take(&mut self, begin: u64, record: &RawRecord<'_>) -> Result<ControlFlow<u32>, String> {
        let body = record.body;
        match record.opcode {
            op::DATA_END => {
                let crc = body.first_chunk().map_or(0, |crc| u32::from_le_bytes(*crc));
                return Ok(ControlFlow::Break(crc));
            }
            op::CHUNK => {
                // Each chunk has a limit of its own. This one is for all of them together.
                if self.unpacked_bytes > self.most_unpacked {
                    return Err(format!(
                        "a chunk after others that unpack to {} bytes, {} at most are read of a file of this size",
                        self.unpacked_bytes, self.most_unpacked
                    ));
                }
                let chunk = unpack(body, &mut self.channels).map_err(in_words)?;
                self.unpacked_bytes += chunk.bytes as u64;
                self.add(begin, body.len(), true, &chunk.messages);
                if chunk.orphans > 0 {
                    // An empty range: the chunk itself was read. It does not merge with a neighbour.
                    let orphans = chunk.orphans;
                    let what = format!("{orphans} messages of channels that are described nowhere");
                    self.lose((begin, begin), what);
                }
            }
            op::MESSAGE => self.take_message(begin, body)?,
            opcode => self.channels.add(opcode, body).map_err(in_words)?,
        }
        Ok(ControlFlow::Continue(()))
    }

    /// A message outside of chunks has no checksum but its own.
    fn take_message(&mut self, begin: u64, body: &[u8]) -> Result<(), String> {
        let message = self.channels.message(body).map_err(in_words)?;
        let message = message.ok_or("a message of a channel that is described nowhere")?;
        if message.channel.message_encoding == OWN_ENCODING {
            let stated = lengths::own_message(&message.data)
                .ok_or("a damaged message, or one of another version of this program")?;
            if stated != message.data.len() as u64 {
                return Err("a message whose length differs from the one in its header".into());
            }
        }
        self.add(begin, body.len(), false, &[message]);
        Ok(())
    }

    fn add(&mut self, begin: u64, len: usize, is_chunk: bool, messages: &[Message<'static>]) {
        for (index, message) in messages.iter().enumerate() {
            let place = McapPlace {
                holder: self.holders.len(),
                index,
            };
            if (self.visit)(message, place) {
                self.arrivals.push(message.log_time);
            }
        }
        self.holders.push(Holder {
            begin,
            len,
            is_chunk,
        });
    }

    /// Records a skipped part; one that continues the last one is merged with it.
    fn lose(&mut self, (begin, end): (u64, u64), reason: String) {
        match self.lost.last_mut() {
            Some(last) if last.end == begin && end > begin && last.end > last.begin => {
                last.end = end
            }
            _ => self.lost.push(LostPart {
                begin,
                end,
                before: self.arrivals.len(),
                reason,
            }),
        }
    }

    fn damage(&self) -> Vec<Damage> {
        let first = self.arrivals.first().map_or(0, |nanos| *nanos);
        let damage = self.lost.iter().map(|lost| {
            let before = self.arrivals.get(..lost.before).and_then(<[u64]>::last);
            // Floats, because arrivals may go back in time. Their error is below 0.3 us.
            let [from_s, to_s] = [before, self.arrivals.get(lost.before)]
                .map(|nanos| Some((*nanos? as f64 - first as f64) * 1e-9));
            Damage {
                begin_bytes: lost.begin,
                lost_bytes: lost.end - lost.begin,
                from_s,
                to_s,
                reason: lost.reason.clone(),
            }
        });
        damage.collect()
    }
}
