//! Records of a recording in order, and resynchronisation after a damaged part.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use mcap::records::op;
use protocol::HEADER_LEN;

use super::lengths::{self, RECORD_HEAD};

/// A larger record is not of this program: chunks are closed at a few MiB and one message.
pub(super) const MAX_RECORD_BYTES: usize = 256 << 20;
/// Bytes searched at once.
const WINDOW: usize = 1 << 20;
/// Bytes by which a record is recognised: those before a chunk's records, or those before a message's payload.
const KNOWN_BY: usize = RECORD_HEAD + lengths::MESSAGE_HEAD + HEADER_LEN;

/// A record in the file.
pub(super) struct RawRecord<'a> {
    pub(super) opcode: u8,
    pub(super) body: &'a [u8],
}

/// Iterates over the records of a file.
pub(super) struct Records<'a> {
    file: &'a File,
    size: u64,
    /// Start of the next record, bytes.
    pub(super) at: u64,
    body: Vec<u8>,
    /// Checksum of everything read so far.
    crc: crc32fast::Hasher,
}

impl<'a> Records<'a> {
    /// The records of a file of `size` bytes, after its magic number; `None` if it neither begins nor ends with one.
    pub(super) fn open(file: &'a File, size: u64) -> io::Result<Option<Self>> {
        let magic_len = mcap::MAGIC.len() as u64;
        // One of the two suffices: the first bytes may be damaged, and the last ones cut off.
        if size < magic_len || !has_magic(file, 0)? && !has_magic(file, size - magic_len)? {
            return Ok(None);
        }
        let mut crc = crc32fast::Hasher::new();
        crc.update(mcap::MAGIC);
        Ok(Some(Self {
            file,
            size,
            at: magic_len,
            body: Vec::new(),
            crc,
        }))
    }

    /// CRC-32 of the file up to the next record, if nothing was skipped.
    pub(super) fn crc(&self) -> u32 {
        self.crc.clone().finalize()
    }

    /// The next record; `None` at the end of the file. If no record can be here, the reason, and nothing is read.
    pub(super) fn next(&mut self) -> io::Result<Result<Option<RawRecord<'_>>, String>> {
        let (begin, left) = (self.at, self.size - self.at);
        if left == 0 {
            return Ok(Ok(None));
        }
        let mut head = [0; RECORD_HEAD];
        if left < RECORD_HEAD as u64 {
            return Ok(Err("the file ends in the middle of a record".into()));
        }
        self.file.read_exact_at(&mut head, begin)?;
        let [opcode, claimed @ ..] = head;
        let claimed = u64::from_le_bytes(claimed);
        if !is_known(opcode) {
            return Ok(Err(format!(
                "a record of kind {opcode:#04x} where none can be"
            )));
        }
        // Checked before the buffer grows: a damaged length must not reserve memory.
        let len = match usize::try_from(claimed) {
            Ok(len) if len <= MAX_RECORD_BYTES => len,
            _ => {
                return Ok(Err(format!(
                    "a record of {claimed} bytes, {MAX_RECORD_BYTES} at most are read"
                )));
            }
        };
        if claimed > left - RECORD_HEAD as u64 {
            return Ok(Err("the file ends in the middle of a record".into()));
        }
        self.body.resize(len, 0);
        self.file
            .read_exact_at(&mut self.body, begin + RECORD_HEAD as u64)?;
        if !lengths::is_filled(opcode, &self.body) {
            return Ok(Err(format!(
                "a record of kind {opcode:#04x} differs in length from its contents"
            )));
        }
        // The checksum in this record covers everything before it.
        if opcode != op::DATA_END {
            self.crc.update(&head);
            self.crc.update(&self.body);
        }
        self.at = begin + (RECORD_HEAD + len) as u64;
        Ok(Ok(Some(RawRecord {
            opcode,
            body: &self.body,
        })))
    }

    /// Continues at the next chunk or end of the data from `from` on whose lengths agree, or at the next message
    /// outside of chunks whose channel `is_own` and whose header is valid; else at the end of the file.
    pub(super) fn seek(&mut self, from: u64, is_own: impl Fn(u16) -> bool) -> io::Result<()> {
        let mut window = Vec::new();
        let mut begin = from;
        while begin < self.size {
            let left = self.size - begin;
            // Windows overlap by the bytes that recognise a record: one at their border is found.
            let len = usize::try_from(left).unwrap_or(usize::MAX);
            let len = len.min(WINDOW + KNOWN_BY);
            window.resize(len, 0);
            self.file.read_exact_at(&mut window, begin)?;
            let opcodes = window.iter().take(WINDOW).enumerate();
            let known = opcodes.filter(|(_, opcode)| is_known(**opcode));
            let mut known = known.map(|(place, _)| (place as u64, window.get(place..)));
            let found = known.find(|(place, bytes)| {
                bytes.is_some_and(|bytes| is_record(bytes, left - place, &is_own))
            });
            if let Some((place, _)) = found {
                self.at = begin + place;
                return Ok(());
            }
            begin += len.min(WINDOW) as u64;
        }
        self.at = self.size;
        Ok(())
    }
}

fn has_magic(file: &File, at: u64) -> io::Result<bool> {
    let mut found = [0; mcap::MAGIC.len()];
    file.read_exact_at(&mut found, at)?;
    Ok(found == *mcap::MAGIC)
}

/// True if records of this kind occur in the data section.
fn is_known(opcode: u8) -> bool {
    matches!(
        opcode,
        op::HEADER
            | op::SCHEMA
            | op::CHANNEL
            | op::MESSAGE
            | op::CHUNK
            | op::MESSAGE_INDEX
            | op::ATTACHMENT
            | op::METADATA
            | op::DATA_END
    )
}

/// True if a record certainly begins here, `left` bytes before the end of the file.
fn is_record(bytes: &[u8], left: u64, is_own: &impl Fn(u16) -> bool) -> bool {
    let Some((opcode, len, body)) = lengths::split_head(bytes) else {
        return false;
    };
    if len > left - RECORD_HEAD as u64 {
        return false;
    }
    match opcode {
        op::CHUNK => lengths::chunk_len(body) == Some(len),
        op::MESSAGE => lengths::message(body).is_some_and(|(channel, payload)| {
            let payload_len = len.saturating_sub(lengths::MESSAGE_HEAD as u64);
            is_own(channel) && lengths::own_message(payload) == Some(payload_len)
        }),
        // Too short to be told from other data by itself: a summary has to follow.
        op::DATA_END => {
            len == lengths::DATA_END_LEN as u64
                && begins_summary(body.get(lengths::DATA_END_LEN..).unwrap_or_default())
        }
        _ => false,
    }
}

/// True if the bytes after an apparent end of the data are those of a summary or footer.
fn begins_summary(bytes: &[u8]) -> bool {
    lengths::split_head(bytes).is_some_and(|(opcode, len, _)| {
        let is_of_summary = matches!(
            opcode,
            op::FOOTER | op::SCHEMA | op::CHANNEL | op::CHUNK_INDEX | op::STATISTICS
        );
        is_of_summary && len < 1 << 32
    })
}
