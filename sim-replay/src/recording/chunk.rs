//! Chunks on their way in and out: the records of some messages, with a checksum, perhaps packed.

use std::collections::BTreeMap;

use super::mcap::{Channel, ChunkHead, Fields, MESSAGE_HEAD, MessageHead, RECORD_HEAD, append_head, op};

/// A chunk that claims more than this is not ours: we close them at a few MiB and one message.
pub(super) const MAX_CHUNK_BYTES: u64 = 256 << 20;

/// A chunk that is being filled.
#[derive(Default)]
pub(super) struct OpenChunk {
    records: Vec<u8>,
    /// Log time and place of every message, by channel.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
    times: Option<(u64, u64)>,
}

/// A chunk as it goes into a file, with what the index at the end of the file says of it.
pub(super) struct ClosedChunk {
    /// The chunk record and the message indexes behind it.
    pub(super) bytes: Vec<u8>,
    head: ChunkHead,
    chunk_len: u64,
    /// Where the message index of each channel begins, from the beginning of `bytes`.
    index_places: BTreeMap<u16, u64>,
    /// Messages by channel.
    pub(super) counts: BTreeMap<u16, u64>,
}

impl OpenChunk {
    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    /// Adds a schema or channel.
    pub(super) fn declare(&mut self, opcode: u8, fields: &Fields) {
        fields.append(opcode, &mut self.records);
    }

    pub(super) fn push(&mut self, head: &MessageHead, data: &[u8]) {
        let place = self.records.len() as u64;
        self.index.entry(head.channel_id).or_default().push((head.log_time, place));
        let (first, last) = self.times.unwrap_or((head.log_time, head.log_time));
        self.times = Some((first.min(head.log_time), last.max(head.log_time)));
        append_head(op::MESSAGE, (MESSAGE_HEAD + data.len()) as u64, &mut self.records);
        self.records.extend(head.fields().into_bytes());
        self.records.extend(data);
    }

    /// Packs the chunk and writes its indexes.
    pub(super) fn close(self, zstd_level: Option<i32>) -> std::io::Result<ClosedChunk> {
        let Self { records, index, times } = self;
        let (first_time, last_time) = times.unwrap_or((0, 0));
        let mut head = ChunkHead {
            first_time,
            last_time,
            unpacked_bytes: records.len() as u64,
            unpacked_crc: crc32fast::hash(&records),
            compression: String::new(),
            packed_bytes: records.len() as u64,
        };
        let packed = match zstd_level {
            Some(level) => {
                let packed = zstd::bulk::compress(&records, level)?;
                (head.compression, head.packed_bytes) = ("zstd".into(), packed.len() as u64);
                packed
            }
            None => records,
        };
        let fields = head.fields().into_bytes();
        let mut bytes = Vec::with_capacity(packed.len() + 4096);
        append_head(op::CHUNK, (fields.len() + packed.len()) as u64, &mut bytes);
        bytes.extend(fields);
        bytes.extend(packed);
        let chunk_len = bytes.len() as u64;
        let mut index_places = BTreeMap::new();
        let mut counts = BTreeMap::new();
        for (channel, entries) in index {
            index_places.insert(channel, bytes.len() as u64);
            counts.insert(channel, entries.len() as u64);
            let list = entries.iter().fold(Fields::default(), |list, (time, place)| list.u64(*time).u64(*place));
            Fields::default().u16(channel).prefixed(&list.into_bytes()).append(op::MESSAGE_INDEX, &mut bytes);
        }
        Ok(ClosedChunk { bytes, head, chunk_len, index_places, counts })
    }
}

impl ClosedChunk {
    /// When its messages came, first and last; `None` without any.
    pub(super) fn times(&self) -> Option<(u64, u64)> {
        (!self.counts.is_empty()).then_some((self.head.first_time, self.head.last_time))
    }

    /// Its line in the index of a file in which it begins at `offset`.
    pub(super) fn index(&self, offset: u64) -> Fields {
        let head = &self.head;
        let places = self.index_places.iter().map(|(channel, place)| (*channel, offset + place));
        Fields::default()
            .u64(head.first_time)
            .u64(head.last_time)
            .u64(offset)
            .u64(self.chunk_len)
            .by_channel(places)
            .u64(self.bytes.len() as u64 - self.chunk_len)
            .prefixed(head.compression.as_bytes())
            .u64(head.packed_bytes)
            .u64(head.unpacked_bytes)
    }
}

/// A record in a slice: its opcode and where its body lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) opcode: u8,
    pub(super) begin: usize,
    pub(super) end: usize,
}

/// Opcode and body length of the record whose first bytes these are.
pub(super) fn record_head(bytes: &[u8; RECORD_HEAD]) -> (u8, u64) {
    let mut len = [0; 8];
    len.copy_from_slice(&bytes[1..]);
    (bytes[0], u64::from_le_bytes(len))
}

/// The records in `bytes`, one after the other; an error where the last one is cut.
pub(super) fn places(bytes: &[u8]) -> Result<Vec<Place>, String> {
    let mut places = Vec::new();
    let mut at = 0;
    while at < bytes.len() {
        let Some(head) = bytes.get(at..at + RECORD_HEAD).and_then(|head| head.try_into().ok()) else {
            return Err(format!("{} bytes behind the last record", bytes.len() - at));
        };
        let (opcode, len) = record_head(head);
        let begin = at + RECORD_HEAD;
        let end = usize::try_from(len).ok().and_then(|len| begin.checked_add(len)).filter(|end| *end <= bytes.len());
        let end = end.ok_or_else(|| format!("a record of {len} bytes where {} are left", bytes.len() - begin))?;
        places.push(Place { opcode, begin, end });
        at = end;
    }
    Ok(places)
}

/// The records inside a chunk: unpacked, and compared with their checksum.
pub(super) struct Unpacked {
    pub(super) records: Vec<u8>,
    /// Where the records begin in the chunk's body, where they are not packed.
    pub(super) offset: Option<usize>,
}

/// Unpacks the body of a chunk record.
pub(super) fn unpack(body: &[u8]) -> Result<Unpacked, String> {
    let (ChunkHead { unpacked_bytes, unpacked_crc, compression, .. }, data) = ChunkHead::read(body)?;
    if unpacked_bytes > MAX_CHUNK_BYTES {
        return Err(format!("a chunk of {unpacked_bytes} bytes, more than {MAX_CHUNK_BYTES}"));
    }
    let (records, offset) = match compression.as_str() {
        "" => (data.to_vec(), Some(body.len() - data.len())),
        "zstd" => (unpack_zstd(data, unpacked_bytes)?, None),
        other => return Err(format!("packed with {other:?}; zstd and nothing are understood")),
    };
    if records.len() as u64 != unpacked_bytes {
        return Err(format!("a chunk of {} bytes that claims {unpacked_bytes}", records.len()));
    }
    let found = crc32fast::hash(&records);
    if unpacked_crc != 0 && unpacked_crc != found {
        return Err(format!("checksum {unpacked_crc:08x}, but the chunk has {found:08x}"));
    }
    Ok(Unpacked { records, offset })
}

fn unpack_zstd(data: &[u8], size: u64) -> Result<Vec<u8>, String> {
    use std::io::Read;
    let decoder = zstd::stream::read::Decoder::new(data).map_err(|error| error.to_string())?;
    let mut records = Vec::new();
    // One byte more than is claimed tells of a bomb without unpacking it.
    decoder.take(size + 1).read_to_end(&mut records).map_err(|error| error.to_string())?;
    Ok(records)
}

/// Calls `visit` for every message among `records` with its channel and where its data lie; channels that are declared
/// among them are added to `channels`.
pub(super) fn for_each_message<E: From<String>>(
    records: &[u8],
    channels: &mut BTreeMap<u16, Channel>,
    mut visit: impl FnMut(&Channel, &MessageHead, std::ops::Range<usize>) -> Result<(), E>,
) -> Result<(), E> {
    for Place { opcode, begin, end } in places(records)? {
        let body = &records[begin..end];
        match opcode {
            op::CHANNEL => {
                let channel = Channel::read(body)?;
                channels.insert(channel.id, channel);
            }
            op::MESSAGE => {
                let head = MessageHead::read(body)?;
                if let Some(channel) = channels.get(&head.channel_id) {
                    visit(channel, &head, begin + MESSAGE_HEAD..end)?;
                }
            }
            _ => {}
        }
    }
    Ok(())
}
