//! Packet: a message as the link emulation sees it.

use protocol::{CavId, Stream};

/// A message as seen by the link.
#[derive(Debug, Clone, PartialEq)]
pub struct Packet {
    /// The caller's id; not used by the emulator.
    pub id: u64,
    /// Sender.
    pub from: CavId,
    /// Receiver.
    pub to: CavId,
    /// Stream of the sender.
    pub stream: Stream,
    /// Sequence number in the stream.
    pub sequence: u64,
    /// Bytes on the wire, headers included.
    pub bytes: u64,
    /// Time at which it is submitted, nanoseconds since the beginning of the scene.
    pub submitted_nanos: u64,
    /// Distance between sender and receiver at that time, metres.
    pub distance_m: f64,
}
