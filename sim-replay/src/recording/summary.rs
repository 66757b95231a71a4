//! The end of a recording: what is in it and where.

use std::collections::BTreeMap;

use super::chunk::ClosedChunk;
use super::mcap::{Channel, Fields, MAGIC, append_head, op};
use super::ros_schema::RosType;

/// What the last part of a file says of those before it.
#[derive(Default)]
pub(super) struct Summary {
    pub(super) schemas: BTreeMap<RosType, (u16, Fields)>,
    pub(super) channels: Vec<Channel>,
    by_topic: BTreeMap<String, u16>,
    chunks: Vec<Fields>,
    counts: BTreeMap<u16, u64>,
    times: Option<(u64, u64)>,
}

impl Summary {
    /// The channel of a topic that is known.
    pub(super) fn channel(&self, topic: &str) -> Option<u16> {
        self.by_topic.get(topic).copied()
    }

    /// Takes a channel in.
    pub(super) fn declare(&mut self, channel: Channel) {
        self.by_topic.insert(channel.topic.clone(), channel.id);
        self.channels.push(channel);
    }

    /// The number of the next channel.
    ///
    /// # Panics
    /// With 65,535 channels: keys are of 65 vehicles at most.
    pub(super) fn next_channel(&self) -> u16 {
        u16::try_from(self.channels.len() + 1).expect("a run has some hundred keys")
    }

    /// Takes a chunk in that begins at `offset`.
    pub(super) fn add(&mut self, chunk: &ClosedChunk, offset: u64) {
        self.chunks.push(chunk.index(offset));
        for (channel, count) in &chunk.counts {
            *self.counts.entry(*channel).or_default() += count;
        }
        if let Some((first, last)) = chunk.times() {
            let (begin, end) = self.times.unwrap_or((first, last));
            self.times = Some((begin.min(first), end.max(last)));
        }
    }

    /// Everything behind the last chunk of a file in which it begins at `offset`.
    pub(super) fn bytes(&self, offset: u64) -> Vec<u8> {
        let mut bytes = Vec::new();
        // 0: no checksum over all of the data, as each chunk has its own.
        Fields::default().u32(0).append(op::DATA_END, &mut bytes);
        let begin = bytes.len();
        let mut groups = Vec::new();
        let mut group = |opcode: u8, records: &mut dyn Iterator<Item = Fields>, bytes: &mut Vec<u8>| {
            let first = bytes.len();
            records.for_each(|fields| fields.append(opcode, bytes));
            if bytes.len() > first {
                groups.push((opcode, offset + first as u64, (bytes.len() - first) as u64));
            }
        };
        group(op::SCHEMA, &mut self.schemas.values().map(|(_, fields)| fields.clone()), &mut bytes);
        group(op::CHANNEL, &mut self.channels.iter().map(Channel::fields), &mut bytes);
        group(op::STATISTICS, &mut std::iter::once(self.statistics()), &mut bytes);
        group(op::CHUNK_INDEX, &mut self.chunks.iter().cloned(), &mut bytes);
        let offsets = offset + bytes.len() as u64;
        for (opcode, first, len) in groups {
            Fields::default().u8(opcode).u64(first).u64(len).append(op::SUMMARY_OFFSET, &mut bytes);
        }
        // The footer's own checksum covers the summary and the footer up to it.
        append_head(op::FOOTER, 20, &mut bytes);
        bytes.extend((offset + begin as u64).to_le_bytes());
        bytes.extend(offsets.to_le_bytes());
        bytes.extend(crc32fast::hash(&bytes[begin..]).to_le_bytes());
        bytes.extend(MAGIC);
        bytes
    }

    fn statistics(&self) -> Fields {
        let (first, last) = self.times.unwrap_or((0, 0));
        Fields::default()
            .u64(self.counts.values().sum())
            .u16(self.schemas.len() as u16)
            .u32(self.channels.len() as u32)
            .u32(0)
            .u32(0)
            .u32(self.chunks.len() as u32)
            .u64(first)
            .u64(last)
            .by_channel(self.counts.iter().map(|(channel, count)| (*channel, *count)))
    }
}
