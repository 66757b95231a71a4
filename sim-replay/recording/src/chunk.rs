//! Messages from chunks, compressed or not, and from message records outside of chunks.

use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::FileExt;
use std::sync::Arc;

use mcap::read::ChannelAccumulator;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Channel, MAGIC, McapError, McapResult, Message, parse_record};

use super::OWN_ENCODING;
use super::lengths::{self, RECORD_HEAD};
use super::records::MAX_RECORD_BYTES;

/// Bytes read from a source at once: an invalid length allocates no more memory than there are bytes.
const READ_BYTES: usize = 1 << 20;
/// Footer before the final magic number: position of the summary, and its checksum.
const FOOTER_LEN: usize = 20;
/// Larger summaries are not read.
const MAX_SUMMARY_BYTES: u64 = 64 << 20;

/// Names of channels. They are described before their first message, usually in the same chunk, and again in the
/// summary, which also names those whose chunk is damaged.
#[derive(Debug, Default)]
pub(super) struct Channels {
    declared: ChannelAccumulator<'static>,
    repeated: ChannelAccumulator<'static>,
    /// True if the summary lists chunks; `None` if there is no valid one.
    pub(super) has_chunks: Option<bool>,
}

impl Channels {
    /// The channels repeated by the summary of a file of `size` bytes; none if it has no valid one.
    pub(super) fn of_summary(file: &File, size: u64) -> io::Result<Self> {
        let mut channels = Self::default();
        if let Some(summary) = summary(file, size)? {
            let options = LinearReaderOptions::default().with_skip_start_magic(true);
            let mut has_chunks = false;
            // Records after one that cannot be in a summary are not used.
            let _ = for_each_record(&summary[..], options, |opcode, data| {
                has_chunks |= opcode == op::CHUNK_INDEX;
                add(&mut channels.repeated, opcode, data)
            });
            channels.has_chunks = Some(has_chunks);
        }
        Ok(channels)
    }

    /// True if the summary names channels, and none of this program.
    pub(super) fn are_foreign(&self) -> bool {
        let mut named = (0..=u16::MAX)
            .filter_map(|id| self.repeated.get(id))
            .peekable();
        named.peek().is_some() && named.all(|channel| channel.message_encoding != OWN_ENCODING)
    }

    pub(super) fn get(&self, id: u16) -> Option<Arc<Channel<'static>>> {
        self.declared.get(id).or_else(|| self.repeated.get(id))
    }

    /// Adds a schema or a channel record; others are ignored.
    pub(super) fn add(&mut self, opcode: u8, data: &[u8]) -> McapResult<()> {
        add(&mut self.declared, opcode, data)
    }

    /// The message of a record; `None` if its channel is not described anywhere.
    pub(super) fn message(&self, record: &[u8]) -> McapResult<Option<Message<'static>>> {
        let Record::Message { header, data } = parse_record(op::MESSAGE, record)? else {
            return Ok(None);
        };
        Ok(self.get(header.channel_id).map(|channel| Message {
            channel,
            sequence: header.sequence,
            log_time: header.log_time,
            publish_time: header.publish_time,
            data: data.into_owned().into(),
        }))
    }
}

fn add(channels: &mut ChannelAccumulator<'static>, opcode: u8, data: &[u8]) -> McapResult<()> {
    if !matches!(opcode, op::SCHEMA | op::CHANNEL) {
        return Ok(());
    }
    lengths::check(opcode, data)?;
    match parse_record(opcode, data)? {
        Record::Schema { header, data } => channels.add_schema_from_slice(header, &data),
        Record::Channel(channel) => channels.add_channel(channel),
        _ => Ok(()),
    }
}

/// The summary of a complete file, after its checksum was verified.
fn summary(file: &File, size: u64) -> io::Result<Option<Vec<u8>>> {
    let end_len = (RECORD_HEAD + FOOTER_LEN + MAGIC.len()) as u64;
    let Some(footer_begin) = size.checked_sub(end_len) else {
        return Ok(None);
    };
    let mut end = [0; RECORD_HEAD + FOOTER_LEN + MAGIC.len()];
    file.read_exact_at(&mut end, footer_begin)?;
    let (head, rest) = end.split_at(RECORD_HEAD);
    let (footer, magic) = rest.split_at(FOOTER_LEN);
    let begin = footer.first_chunk().copied().map_or(0, u64::from_le_bytes);
    let len = footer_begin
        .checked_sub(begin)
        // A position of 0 means that the file has no summary.
        .filter(|len| begin > 0 && *len <= MAX_SUMMARY_BYTES);
    let Some(len) = len.filter(|_| head.first() == Some(&op::FOOTER) && magic == MAGIC) else {
        return Ok(None);
    };
    let mut summary = vec![0; usize::try_from(len).unwrap_or_default()];
    file.read_exact_at(&mut summary, begin)?;
    let mut crc = crc32fast::Hasher::new();
    crc.update(&summary);
    crc.update(head);
    // The checksum covers the summary and the footer up to itself. 0 means that it was not computed.
    let (summed, stated) = footer.split_at(FOOTER_LEN - 4);
    crc.update(summed);
    Ok((stated == [0; 4] || stated == crc.finalize().to_le_bytes()).then_some(summary))
}

/// Contents of a chunk.
#[derive(Debug, Default)]
pub(super) struct UnpackedChunk {
    pub(super) messages: Vec<Message<'static>>,
    /// Messages whose channel is not described anywhere.
    pub(super) orphans: usize,
    /// Bytes of all records.
    pub(super) bytes: usize,
}

/// Unpacks a chunk and verifies its checksum; its channels are added to `channels`.
pub(super) fn unpack(body: &[u8], channels: &mut Channels) -> McapResult<UnpackedChunk> {
    lengths::check(op::CHUNK, body)?;
    // The parser takes whole records, so the chunk gets its opcode and length back.
    let head = [[op::CHUNK].as_slice(), &(body.len() as u64).to_le_bytes()].concat();
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_prevalidate_chunk_crcs(true);
    let mut chunk = UnpackedChunk::default();
    for_each_record(head.chain(body), options, |opcode, data| {
        chunk.bytes += data.len();
        // Counted while unpacking: a few compressed bytes may unpack to any number.
        if chunk.bytes > MAX_RECORD_BYTES {
            return Err(McapError::ChunkTooLarge(chunk.bytes as u64));
        }
        // Other records are not allowed in a chunk, and the parser trusts the lengths in some of them.
        match opcode {
            op::MESSAGE => match channels.message(data)? {
                Some(message) => chunk.messages.push(message),
                None => chunk.orphans += 1,
            },
            _ => channels.add(opcode, data)?,
        }
        Ok(())
    })?;
    Ok(chunk)
}

/// The text of an error, as the decompressor gives it.
pub(super) fn in_words(error: McapError) -> String {
    match error {
        McapError::Io(source) => source.to_string(),
        other => other.to_string(),
    }
}

/// Passes the records of `source` to `visit`, one after the other, until it fails or there are no more.
fn for_each_record(
    mut source: impl Read,
    options: LinearReaderOptions,
    mut visit: impl FnMut(u8, &[u8]) -> McapResult<()>,
) -> McapResult<()> {
    let options = options
        .with_record_length_limit(MAX_RECORD_BYTES)
        .with_skip_end_magic(true);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                match source.read(reader.insert(wanted.min(READ_BYTES))) {
                    Ok(count) => reader.notify_read(count),
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(error) => return Err(error.into()),
                }
            }
            LinearReadEvent::Record { opcode, data } => visit(opcode, data)?,
        }
    }
    Ok(())
}
