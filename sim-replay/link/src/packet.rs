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
    /// Distance between sender and receiver at that time, metres; see [`Self::distance_m`].
    pub distance_m: f64,
}

impl Packet {
    /// Horizontal distance between two positions, metres. Infinite if one is unknown: losses by distance are those of
    /// the last point then.
    pub fn distance_m(positions_m: [Option<[f64; 3]>; 2]) -> f64 {
        match positions_m {
            [Some(one), Some(other)] => (one[0] - other[0]).hypot(one[1] - other[1]),
            _ => f64::INFINITY,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_position_is_far_away() {
        let [one, other] = [[1.0, 2.0, 3.0], [4.0, 6.0, 9.0]].map(Some);
        assert_eq!(Packet::distance_m([one, other]), 5.0);
        assert_eq!(Packet::distance_m([one, None]), f64::INFINITY);
    }
}
