//! Reading a recording, whole or cut.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use protocol::{Header, Key, wire};

use super::chunk::{self, MAX_CHUNK_BYTES};
use super::mcap::{Channel, MAGIC, RECORD_HEAD, op};
use super::{OWN_ENCODING, RecordingError};

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
    begin: usize,
    end: usize,
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

#[derive(Debug, Clone, Copy)]
struct ChunkPlace {
    begin: u64,
    len: usize,
    /// Where the records begin in the body, where they are not packed.
    records: Option<usize>,
}

/// A recording whose messages can be read in any order.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    file: File,
    chunks: Vec<ChunkPlace>,
    entries: Vec<Entry>,
    damage: Option<Damage>,
    /// The packed chunk that was read last: neighbours in time are neighbours in the file.
    last: Mutex<Option<(usize, Arc<Vec<u8>>)>>,
}

impl Recording {
    /// Opens a recording and looks through all of it once; every chunk is compared with its checksum. One that is cut is
    /// read up to its last whole chunk, see [`Self::damage`].
    ///
    /// # Errors
    /// [`RecordingError`] when the file cannot be read or is no recording of ours.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|source| RecordingError::io(path, source))?;
        let recording = Self {
            path: path.into(),
            file,
            chunks: Vec::new(),
            entries: Vec::new(),
            damage: None,
            last: Mutex::new(None),
        };
        recording.scan()
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
        let place = self.chunks[entry.chunk];
        if let Some(records) = place.records {
            let mut bytes = vec![0; entry.end - entry.begin];
            let offset = place.begin + (records + entry.begin) as u64;
            self.file.read_exact_at(&mut bytes, offset).map_err(|source| RecordingError::io(&self.path, source))?;
            return Ok(bytes);
        }
        let records = self.unpacked(entry.chunk)?;
        match records.get(entry.begin..entry.end) {
            Some(bytes) => Ok(bytes.to_vec()),
            None => Err(RecordingError::malformed(&self.path, place.begin, "the file has changed")),
        }
    }

    /// Every message of whatever channel, in order: topic, encoding, and the record's body. For [`super::recover`].
    pub(super) fn for_each(
        &self,
        mut visit: impl FnMut(&str, &str, u64, &[u8]) -> Result<(), RecordingError>,
    ) -> Result<(), RecordingError> {
        let mut channels = BTreeMap::new();
        for (index, place) in self.chunks.iter().enumerate() {
            let records = self.unpacked(index)?;
            let mut failed = None;
            let walked = chunk::for_each_message(&records, &mut channels, |channel, head, data| {
                visit(&channel.topic, &channel.encoding, head.log_time, &records[data]).map_err(|error| {
                    failed = Some(error);
                    String::new()
                })
            });
            match (failed, walked) {
                (Some(error), _) => return Err(error),
                (None, Err(reason)) => return Err(RecordingError::malformed(&self.path, place.begin, reason)),
                (None, Ok(())) => {}
            }
        }
        Ok(())
    }

    fn unpacked(&self, index: usize) -> Result<Arc<Vec<u8>>, RecordingError> {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((known, records)) = last.as_ref()
            && *known == index
        {
            return Ok(Arc::clone(records));
        }
        let place = self.chunks[index];
        let mut body = vec![0; place.len];
        self.file.read_exact_at(&mut body, place.begin).map_err(|source| RecordingError::io(&self.path, source))?;
        let unpacked =
            chunk::unpack(&body).map_err(|reason| RecordingError::malformed(&self.path, place.begin, reason))?;
        let records = Arc::new(unpacked.records);
        *last = Some((index, Arc::clone(&records)));
        Ok(records)
    }

    /// Goes through the file record by record as long as they are whole.
    fn scan(mut self) -> Result<Self, RecordingError> {
        let size = self.file.metadata().map_err(|source| RecordingError::io(&self.path, source))?.len();
        let magic = self.bytes_at(0, 8.min(size as usize))?;
        if magic != MAGIC {
            return Err(self.not_ours(format!("not an MCAP file: it begins with {magic:02x?}")));
        }
        let mut channels = BTreeMap::new();
        let mut at = MAGIC.len() as u64;
        let reason = loop {
            match self.scan_record(at, size, &mut channels) {
                Ok(Some(next)) => at = next,
                Ok(None) => break None,
                Err(reason) => break Some(reason),
            }
        };
        self.damage = reason.map(|reason| Damage { whole_bytes: at, lost_bytes: size - at, reason });
        if !channels.values().any(|channel: &Channel| channel.encoding == OWN_ENCODING) {
            let what = self.damage.as_ref().map_or(String::new(), |damage| format!("; {}", damage.reason));
            return Err(self.not_ours(format!("no channel of encoding {OWN_ENCODING:?} in it{what}")));
        }
        Ok(self)
    }

    /// Takes the record at `at` in and says where the next one begins; `None` behind the last one of the data.
    fn scan_record(
        &mut self,
        at: u64,
        size: u64,
        channels: &mut BTreeMap<u16, Channel>,
    ) -> Result<Option<u64>, String> {
        let left = size - at;
        if left < RECORD_HEAD as u64 {
            return Err(format!("the file ends without an index, {left} bytes behind a record"));
        }
        let head: [u8; RECORD_HEAD] = self
            .bytes_at(at, RECORD_HEAD)
            .map_err(|error| error.to_string())?
            .try_into()
            .map_err(|_| "a short read".to_owned())?;
        let (opcode, len) = chunk::record_head(&head);
        let begin = at + RECORD_HEAD as u64;
        let next = begin.checked_add(len).filter(|next| *next <= size);
        let next = next.ok_or_else(|| format!("a record of {len} bytes where {} are left", size - begin))?;
        match opcode {
            op::DATA_END | op::FOOTER => return Ok(None),
            op::CHUNK if len > MAX_CHUNK_BYTES => return Err(format!("a chunk of {len} bytes")),
            op::CHUNK => {
                let body = self.bytes_at(begin, len as usize).map_err(|error| error.to_string())?;
                self.take_chunk(begin, &body, channels)?;
            }
            _ => {}
        }
        Ok(Some(next))
    }

    fn take_chunk(&mut self, begin: u64, body: &[u8], channels: &mut BTreeMap<u16, Channel>) -> Result<(), String> {
        let unpacked = chunk::unpack(body)?;
        let chunk = self.chunks.len();
        chunk::for_each_message(&unpacked.records, channels, |channel, head, data| {
            let key = channel.topic.parse().ok().filter(|_| channel.encoding == OWN_ENCODING);
            // What was no sound message when it was recorded is none now.
            let header = wire::decode_header([&unpacked.records[data.clone()]]).ok();
            if let Some((key, header)) = key.zip(header) {
                let arrived_nanos = head.log_time;
                self.entries.push(Entry { key, header, arrived_nanos, chunk, begin: data.start, end: data.end });
            }
            Ok::<(), String>(())
        })?;
        self.chunks.push(ChunkPlace { begin, len: body.len(), records: unpacked.offset });
        Ok(())
    }

    fn bytes_at(&self, offset: u64, len: usize) -> Result<Vec<u8>, RecordingError> {
        let mut bytes = vec![0; len];
        self.file.read_exact_at(&mut bytes, offset).map_err(|source| RecordingError::io(&self.path, source))?;
        Ok(bytes)
    }

    fn not_ours(&self, reason: String) -> RecordingError {
        RecordingError::NotOurs { path: self.path.clone(), reason }
    }
}
