//! Checks of lengths in a record against the available bytes: the `mcap` crate (0.26.0) allocates the stated length of
//! a text, and underflows if a record reaches beyond its chunk.

use mcap::records::op;
use mcap::{McapError, McapResult};
use protocol::{HEADER_LEN, wire};

/// Opcode and length before every record.
pub(super) const RECORD_HEAD: usize = 9;
/// Times, size and checksum before a chunk's first text.
const CHUNK_HEAD: usize = 28;
/// Channel, sequence and times before a message's payload.
pub(super) const MESSAGE_HEAD: usize = 22;
/// Length of the record that ends the data.
pub(super) const DATA_END_LEN: usize = 4;
/// Supported compressions of chunks.
const COMPRESSIONS: [&[u8]; 3] = [b"", b"zstd", b"lz4"];

/// Checks the lengths in a chunk, a schema or a channel. The records of a compressed chunk are checked when they are
/// unpacked.
///
/// # Errors
/// [`McapError::UnexpectedEoc`] if a length reaches beyond its record.
pub(super) fn check(opcode: u8, record: &[u8]) -> McapResult<()> {
    let fits = match opcode {
        op::CHUNK => chunk_fits(record),
        // Its number; name and encoding.
        op::SCHEMA => behind(record, 2, 2).map(|_| ()),
        op::CHANNEL => channel_fits(record),
        _ => Some(()),
    };
    fits.ok_or(McapError::UnexpectedEoc)
}

/// True if the contents of a record in the data section fill it exactly.
pub(super) fn is_filled(opcode: u8, record: &[u8]) -> bool {
    let rest = match opcode {
        op::HEADER | op::METADATA => behind(record, 0, 2),
        // The text of the schema has the same kind of length as its name and encoding.
        op::SCHEMA => behind(record, 2, 3),
        op::CHANNEL => behind(record, 4, 3),
        // The payload has no length of its own: any rest is valid.
        op::MESSAGE => return record.len() >= MESSAGE_HEAD,
        op::CHUNK => behind(record, CHUNK_HEAD, 1).and_then(long),
        op::MESSAGE_INDEX => behind(record, 2, 1),
        // The contents are followed by their checksum.
        op::ATTACHMENT => behind(record, 16, 2)
            .and_then(long)
            .filter(|rest| rest.len() == 4)
            .map(|_| [].as_slice()),
        op::DATA_END => record.get(DATA_END_LEN..),
        _ => None,
    };
    rest.is_some_and(<[u8]>::is_empty)
}

/// Opcode and length of the record that begins here, and what follows.
pub(super) fn split_head(bytes: &[u8]) -> Option<(u8, u64, &[u8])> {
    let (&[opcode, len @ ..], rest) = bytes.split_first_chunk::<RECORD_HEAD>()?;
    Some((opcode, u64::from_le_bytes(len), rest))
}

/// The bytes behind `count` texts, which begin at `head`.
fn behind(record: &[u8], head: usize, count: usize) -> Option<&[u8]> {
    let mut rest = record.get(head..)?;
    for _ in 0..count {
        rest = text(rest)?.1;
    }
    Some(rest)
}

/// The length of a chunk that begins here, from its head: its records fill the rest. `None` if its compression is not
/// known.
pub(super) fn chunk_len(bytes: &[u8]) -> Option<u64> {
    let (compression, rest) = text(bytes.get(CHUNK_HEAD..)?)?;
    let (&records_len, _) = rest.split_first_chunk()?;
    // 4 and 8 are the lengths written before the compression and before the records.
    let head_len = (CHUNK_HEAD + 4 + compression.len() + 8) as u64;
    let len = u64::from_le_bytes(records_len).checked_add(head_len);
    len.filter(|_| COMPRESSIONS.contains(&compression))
}

/// The channel of a message, and its payload.
pub(super) fn message(record: &[u8]) -> Option<(u16, &[u8])> {
    let (&channel, _) = record.split_first_chunk()?;
    Some((u16::from_le_bytes(channel), record.get(MESSAGE_HEAD..)?))
}

/// The length of a message of this program, from its header; `None` without a valid header.
pub(super) fn own_message(payload: &[u8]) -> Option<u64> {
    let header = wire::decode_header([payload]).ok()?;
    let payload_len = header.body_len.checked_add(header.metadata_len.into())?;
    payload_len.checked_add(HEADER_LEN as u64)
}

fn chunk_fits(chunk: &[u8]) -> Option<()> {
    let (compression, rest) = text(chunk.get(CHUNK_HEAD..)?)?;
    let (&len, rest) = rest.split_first_chunk()?;
    let mut records = rest.get(..usize::try_from(u64::from_le_bytes(len)).ok()?)?;
    while compression.is_empty() && !records.is_empty() {
        let (_, len, rest) = split_head(records)?;
        records = rest.get(usize::try_from(len).ok()?..)?;
    }
    Some(())
}

/// Its number and its schema's; topic, encoding, and texts within a text.
fn channel_fits(channel: &[u8]) -> Option<()> {
    let (mut metadata, _) = text(behind(channel, 4, 2)?)?;
    while !metadata.is_empty() {
        metadata = text(metadata)?.1;
    }
    Some(())
}

/// The text at the beginning, after its length, and what follows.
fn text(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (&len, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(usize::try_from(u32::from_le_bytes(len)).ok()?)
}

/// The rest after bytes with a length of 64 bits.
fn long(bytes: &[u8]) -> Option<&[u8]> {
    let (&len, rest) = bytes.split_first_chunk()?;
    rest.get(usize::try_from(u64::from_le_bytes(len)).ok()?..)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_len(text: &[u8], len: usize) -> Vec<u8> {
        [&u32::try_from(len).unwrap().to_le_bytes(), text].concat()
    }

    fn chunk(compression: &[u8], len: u64, records: &[u8]) -> Vec<u8> {
        [&[0; CHUNK_HEAD], compression, &len.to_le_bytes(), records].concat()
    }

    #[test]
    fn a_length_beyond_its_record_is_refused() {
        let word = with_len(b"abc", 3);
        let long = with_len(b"abc", 4);
        let pair = with_len(&[word.clone(), word.clone()].concat(), 14);
        let broken_pair = with_len(&[word.clone(), long.clone()].concat(), 14);
        let cases = [
            (op::SCHEMA, [&[0; 2][..], &word, &word].concat(), true),
            (op::SCHEMA, [&[0; 2][..], &word, &long].concat(), false),
            (op::SCHEMA, vec![0], false),
            (
                op::CHANNEL,
                [&[0; 4][..], &word, &word, &pair].concat(),
                true,
            ),
            (op::CHANNEL, [&[0; 4][..], &long, &[0; 9]].concat(), true),
            (
                op::CHANNEL,
                [&[0; 4][..], &word, &word, &broken_pair].concat(),
                false,
            ),
            (
                op::CHANNEL,
                [&[0; 4][..], &word, &with_len(b"", 1 << 31)].concat(),
                false,
            ),
            (op::CHUNK, chunk(&with_len(b"", 1 << 31), 0, b""), false),
            (
                op::CHUNK,
                chunk(&with_len(b"zstd", 4), 8, b"anything"),
                true,
            ),
            (
                op::CHUNK,
                chunk(&with_len(b"zstd", 4), 9, b"anything"),
                false,
            ),
            (
                op::CHUNK,
                chunk(&with_len(b"", 0), 10, &[5, 1, 0, 0, 0, 0, 0, 0, 0, 7]),
                true,
            ),
            (
                op::CHUNK,
                chunk(&with_len(b"", 0), 10, &[5, 2, 0, 0, 0, 0, 0, 0, 0, 7]),
                false,
            ),
            (op::MESSAGE, vec![], true),
        ];
        for (opcode, record, is_sound) in cases {
            assert_eq!(
                check(opcode, &record).is_ok(),
                is_sound,
                "{opcode} {record:?}"
            );
        }
    }
}
