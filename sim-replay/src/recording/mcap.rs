//! MCAP's records, as far as recordings use them: <https://mcap.dev/spec>.
//!
//! The crate of that name would read and write more kinds of records than are needed here, at the price of two more derive
//! frameworks and a second zstd; and it keeps to itself how far a file is whole, which is what a full disk and a crash are
//! about. Files are compared with the public Python reader (`deploy/tools/check_recording.py`).

/// First and last bytes of a file.
pub(super) const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";

/// Kinds of records.
pub(super) mod op {
    pub(in super::super) const HEADER: u8 = 0x01;
    pub(in super::super) const FOOTER: u8 = 0x02;
    pub(in super::super) const SCHEMA: u8 = 0x03;
    pub(in super::super) const CHANNEL: u8 = 0x04;
    pub(in super::super) const MESSAGE: u8 = 0x05;
    pub(in super::super) const CHUNK: u8 = 0x06;
    pub(in super::super) const MESSAGE_INDEX: u8 = 0x07;
    pub(in super::super) const CHUNK_INDEX: u8 = 0x08;
    pub(in super::super) const STATISTICS: u8 = 0x0b;
    pub(in super::super) const SUMMARY_OFFSET: u8 = 0x0e;
    pub(in super::super) const DATA_END: u8 = 0x0f;
}

/// Opcode and length before every record.
pub(super) const RECORD_HEAD: usize = 9;
/// Bytes of a message record before its data.
pub(super) const MESSAGE_HEAD: usize = 22;

/// The body of a record in the making; all numbers are little-endian.
#[derive(Clone, Default)]
pub(super) struct Fields(Vec<u8>);

impl Fields {
    pub(super) fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    pub(super) fn u16(self, value: u16) -> Self {
        self.raw(&value.to_le_bytes())
    }

    pub(super) fn u32(self, value: u32) -> Self {
        self.raw(&value.to_le_bytes())
    }

    pub(super) fn u64(self, value: u64) -> Self {
        self.raw(&value.to_le_bytes())
    }

    /// A text, or bytes, behind their number in 32 bits.
    pub(super) fn prefixed(self, bytes: &[u8]) -> Self {
        self.u32(length(bytes.len())).raw(bytes)
    }

    /// A map from channels to numbers.
    pub(super) fn by_channel(self, entries: impl Iterator<Item = (u16, u64)>) -> Self {
        let inner = entries.fold(Self::default(), |fields, (channel, number)| fields.u16(channel).u64(number));
        self.prefixed(&inner.0)
    }

    pub(super) fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    /// Appends the record to `out`.
    pub(super) fn append(&self, opcode: u8, out: &mut Vec<u8>) {
        append_head(opcode, self.0.len() as u64, out);
        out.extend(&self.0);
    }
}

/// Appends opcode and length of a record.
pub(super) fn append_head(opcode: u8, len: u64, out: &mut Vec<u8>) {
    out.push(opcode);
    out.extend(len.to_le_bytes());
}

fn length(bytes: usize) -> u32 {
    u32::try_from(bytes).expect("texts and indexes are far below 4 GiB")
}

/// A channel: what is on it, and in which encoding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Channel {
    pub(super) id: u16,
    /// 0: none.
    pub(super) schema_id: u16,
    pub(super) topic: String,
    pub(super) encoding: String,
}

impl Channel {
    pub(super) fn fields(&self) -> Fields {
        let fields = Fields::default().u16(self.id).u16(self.schema_id);
        // No metadata.
        fields.prefixed(self.topic.as_bytes()).prefixed(self.encoding.as_bytes()).u32(0)
    }

    pub(super) fn read(body: &[u8]) -> Result<Self, String> {
        let mut reader = Reader(body);
        Ok(Self { id: reader.u16()?, schema_id: reader.u16()?, topic: reader.text()?, encoding: reader.text()? })
    }
}

/// What stands before a message's data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct MessageHead {
    pub(super) channel_id: u16,
    pub(super) sequence: u32,
    /// When it reached the recorder, nanoseconds.
    pub(super) log_time: u64,
    /// When it was published, nanoseconds.
    pub(super) publish_time: u64,
}

impl MessageHead {
    pub(super) fn fields(&self) -> Fields {
        Fields::default().u16(self.channel_id).u32(self.sequence).u64(self.log_time).u64(self.publish_time)
    }

    pub(super) fn read(body: &[u8]) -> Result<Self, String> {
        let mut reader = Reader(body);
        Ok(Self {
            channel_id: reader.u16()?,
            sequence: reader.u32()?,
            log_time: reader.u64()?,
            publish_time: reader.u64()?,
        })
    }
}

/// What stands before a chunk's records.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ChunkHead {
    pub(super) first_time: u64,
    pub(super) last_time: u64,
    pub(super) unpacked_bytes: u64,
    /// CRC-32 of the records before packing; 0: none.
    pub(super) unpacked_crc: u32,
    /// `zstd`, or empty.
    pub(super) compression: String,
    pub(super) packed_bytes: u64,
}

impl ChunkHead {
    pub(super) fn fields(&self) -> Fields {
        let fields = Fields::default().u64(self.first_time).u64(self.last_time).u64(self.unpacked_bytes);
        fields.u32(self.unpacked_crc).prefixed(self.compression.as_bytes()).u64(self.packed_bytes)
    }

    /// The head, and the records behind it.
    pub(super) fn read(body: &[u8]) -> Result<(Self, &[u8]), String> {
        let mut reader = Reader(body);
        let head = Self {
            first_time: reader.u64()?,
            last_time: reader.u64()?,
            unpacked_bytes: reader.u64()?,
            unpacked_crc: reader.u32()?,
            compression: reader.text()?,
            packed_bytes: reader.u64()?,
        };
        let Reader(records) = reader;
        if records.len() as u64 != head.packed_bytes {
            return Err(format!("a chunk of {} bytes that claims {}", records.len(), head.packed_bytes));
        }
        Ok((head, records))
    }
}

/// Takes fields off the front of a body.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let short = || format!("a record that ends {} bytes early", count - self.0.len());
        let (taken, rest) = self.0.split_at_checked(count).ok_or_else(short)?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        Ok(bytes)
    }

    fn u16(&mut self) -> Result<u16, String> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, String> {
        self.array().map(u64::from_le_bytes)
    }

    fn text(&mut self) -> Result<String, String> {
        let len = self.u32()? as usize;
        String::from_utf8(self.take(len)?.to_vec()).map_err(|_| "a text that is not UTF-8".into())
    }
}
