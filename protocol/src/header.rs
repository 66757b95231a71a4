//! Fixed-size header at the start of every message.
//!
//! It can be read and verified without the rest of the message: it carries its own checksum beside that of the payload.
//!
//! | offset | bytes | field |
//! | ---: | ---: | --- |
//! | 0 | 4 | magic `V2VL` |
//! | 4 | 2 | wire version |
//! | 6 | 1 | kind |
//! | 7 | 1 | length of the CAV id |
//! | 8 | 32 | CAV id, padded with zeros |
//! | 40 | 8 | epoch |
//! | 48 | 8 | sequence |
//! | 56 | 8 | capture time, nanoseconds on the scene's clock |
//! | 64 | 8 | publish time, nanoseconds on the Unix clock (stepped runs: the scene's) |
//! | 72 | 8 | body length, bytes |
//! | 80 | 4 | metadata length, bytes |
//! | 84 | 4 | CRC-32 of metadata and body |
//! | 88 | 4 | CRC-32 of the 88 bytes above |
//!
//! All numbers are little-endian. Metadata follow, then the body, then nothing.

use serde::{Deserialize, Serialize};

use crate::{CavId, IdError, Kind, WireError};

/// First four bytes of every message.
pub const MAGIC: [u8; 4] = *b"V2VL";
/// Version of the whole wire format; any change of layout or metadata raises it.
pub const WIRE_VERSION: u16 = 7;
/// Bytes of a header.
pub const HEADER_LEN: usize = 92;

const CRC_OFFSET: usize = HEADER_LEN - 4;

/// Identity and times of a message: sender, sequence number, capture and publish time.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Stamp {
    /// The vehicle that sends, or that a sensor message belongs to. Processes without a vehicle use a name of their
    /// own, for example `replay`.
    pub cav: CavId,
    /// Random number of the process instance: distinguishes a restarted sender from its previous instance.
    pub epoch: u64,
    /// Strictly increasing within an epoch and stream.
    pub sequence: u64,
    /// Capture time of the content, nanoseconds on the scene's clock.
    pub capture_nanos: u64,
    /// Time of handing over to the network, nanoseconds: Unix clock, or the scene's in stepped runs.
    pub publish_nanos: u64,
}

/// The decoded header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Kind of the message.
    pub kind: Kind,
    /// Identity and times.
    pub stamp: Stamp,
    /// Bytes of metadata.
    pub metadata_len: u32,
    /// Bytes of body.
    pub body_len: u64,
    /// CRC-32 of metadata and body.
    pub payload_crc: u32,
}

impl Header {
    /// The header as it is transmitted.
    #[expect(
        clippy::indexing_slicing,
        clippy::cast_possible_truncation,
        reason = "offsets are constants, and an id has at most 32 bytes"
    )]
    pub fn to_bytes(&self) -> [u8; HEADER_LEN] {
        // Destructured in full, so that a new field stops the build here.
        let Self {
            kind,
            stamp,
            metadata_len,
            body_len,
            payload_crc,
        } = self;
        let Stamp {
            cav,
            epoch,
            sequence,
            capture_nanos,
            publish_nanos,
        } = stamp;
        let cav = cav.as_str().as_bytes();
        let mut bytes = [0; HEADER_LEN];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..6].copy_from_slice(&WIRE_VERSION.to_le_bytes());
        bytes[6] = *kind as u8;
        // An identifier has at most 32 bytes.
        bytes[7] = cav.len() as u8;
        bytes[8..8 + cav.len()].copy_from_slice(cav);
        for (offset, number) in [
            (40, epoch),
            (48, sequence),
            (56, capture_nanos),
            (64, publish_nanos),
            (72, body_len),
        ] {
            bytes[offset..offset + 8].copy_from_slice(&number.to_le_bytes());
        }
        bytes[80..84].copy_from_slice(&metadata_len.to_le_bytes());
        bytes[84..88].copy_from_slice(&payload_crc.to_le_bytes());
        let crc = crc32fast::hash(&bytes[..CRC_OFFSET]);
        bytes[CRC_OFFSET..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Reads a header; the payload is not checked.
    ///
    /// # Errors
    /// [`WireError`] when it is no header of this version, was corrupted in transit, or names no kind or vehicle.
    pub fn from_bytes(bytes: &[u8; HEADER_LEN]) -> Result<Self, WireError> {
        let magic = take::<4>(bytes, 0);
        if magic != MAGIC {
            return Err(WireError::Magic(magic));
        }
        // Before the checksum: another version may keep its checksum elsewhere.
        let version = u16::from_le_bytes(take(bytes, 4));
        if version != WIRE_VERSION {
            return Err(WireError::Version(version));
        }
        let found = u32::from_le_bytes(take(bytes, CRC_OFFSET));
        let expected = crc32fast::hash(&bytes[..CRC_OFFSET]);
        if found != expected {
            return Err(WireError::HeaderChecksum { expected, found });
        }
        let [epoch, sequence, capture_nanos, publish_nanos, body_len] =
            [40, 48, 56, 64, 72].map(|offset| u64::from_le_bytes(take(bytes, offset)));
        Ok(Self {
            kind: Kind::from_wire(bytes[6])?,
            stamp: Stamp {
                cav: cav_from_wire(bytes[7], &take(bytes, 8))?,
                epoch,
                sequence,
                capture_nanos,
                publish_nanos,
            },
            body_len,
            metadata_len: u32::from_le_bytes(take(bytes, 80)),
            payload_crc: u32::from_le_bytes(take(bytes, 84)),
        })
    }

    /// Checks that the message is of a kind.
    ///
    /// # Errors
    /// [`WireError::Kind`] states both.
    pub fn check_kind(&self, expected: Kind) -> Result<(), WireError> {
        if self.kind == expected {
            return Ok(());
        }
        let found = self.kind;
        Err(WireError::Kind { expected, found })
    }

    /// Checks that the sender in the header is the vehicle that owns the key.
    ///
    /// # Errors
    /// [`WireError::Identity`] states both.
    pub fn check_sender(&self, expected: &CavId) -> Result<(), WireError> {
        if self.stamp.cav == *expected {
            return Ok(());
        }
        let (expected, found) = (expected.clone(), self.stamp.cav.clone());
        Err(WireError::Identity { expected, found })
    }
}

#[expect(
    clippy::indexing_slicing,
    reason = "offsets are constants within the header"
)]
fn take<const N: usize>(bytes: &[u8; HEADER_LEN], offset: usize) -> [u8; N] {
    std::array::from_fn(|index| bytes[offset + index])
}

/// One vehicle has exactly one encoding: the bytes after the name must be zero.
fn cav_from_wire(len: u8, field: &[u8; CavId::MAX_LEN]) -> Result<CavId, WireError> {
    let (name, padding) = field.split_at(usize::from(len).min(field.len()));
    let text = String::from_utf8_lossy(name);
    if usize::from(len) > field.len() || padding.iter().any(|byte| *byte != 0) {
        let error = IdError::malformed("CAV id", &text, CavId::MAX_LEN);
        return Err(WireError::Cav(error));
    }
    CavId::new(&text).map_err(WireError::Cav)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> Header {
        Header {
            kind: Kind::Bev,
            stamp: Stamp {
                cav: CavId::new("4279").unwrap(),
                epoch: 0x0102_0304_0506_0708,
                sequence: 9,
                capture_nanos: 1_000_000_000,
                publish_nanos: 1_700_000_000_000_000_000,
            },
            metadata_len: 40,
            body_len: 1 << 20,
            payload_crc: 0xdead_beef,
        }
    }

    fn resealed(change: impl FnOnce(&mut [u8; HEADER_LEN])) -> Result<Header, WireError> {
        let mut bytes = header().to_bytes();
        change(&mut bytes);
        let crc = crc32fast::hash(&bytes[..CRC_OFFSET]);
        bytes[CRC_OFFSET..].copy_from_slice(&crc.to_le_bytes());
        Header::from_bytes(&bytes)
    }

    #[test]
    fn bytes_are_stable() {
        let mut golden = Vec::new();
        golden.extend(b"V2VL");
        golden.extend([7, 0, 5, 4]);
        golden.extend(b"4279");
        golden.extend([0; 28]);
        golden.extend([8, 7, 6, 5, 4, 3, 2, 1]);
        golden.extend([9, 0, 0, 0, 0, 0, 0, 0]);
        golden.extend([0x00, 0xca, 0x9a, 0x3b, 0, 0, 0, 0]);
        golden.extend([0x00, 0x00, 0x2a, 0x36, 0xfe, 0x9c, 0x97, 0x17]);
        golden.extend([0, 0, 0x10, 0, 0, 0, 0, 0]);
        golden.extend([40, 0, 0, 0]);
        golden.extend([0xef, 0xbe, 0xad, 0xde]);
        // zlib.crc32 of the above.
        golden.extend([0x70, 0xca, 0xd3, 0xf7]);
        assert_eq!(header().to_bytes().as_slice(), golden);
        assert_eq!(Header::from_bytes(&header().to_bytes()).unwrap(), header());
    }

    #[test]
    fn every_flipped_bit_is_noticed() {
        for bit in 0..8 * HEADER_LEN {
            let mut bytes = header().to_bytes();
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(Header::from_bytes(&bytes).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn errors_state_the_cause() {
        assert!(matches!(
            resealed(|b| b[0] = b'X'),
            Err(WireError::Magic([b'X', ..]))
        ));
        assert!(matches!(resealed(|b| b[4] = 8), Err(WireError::Version(8))));
        assert!(matches!(
            resealed(|b| b[6] = 99),
            Err(WireError::UnknownKind(99))
        ));
        assert!(matches!(resealed(|b| b[7] = 33), Err(WireError::Cav(_))));
        assert!(matches!(resealed(|b| b[7] = 0), Err(WireError::Cav(_))));
        assert!(matches!(resealed(|b| b[8] = b'*'), Err(WireError::Cav(_))));
        assert!(matches!(resealed(|b| b[20] = b'x'), Err(WireError::Cav(_))));
        let other = CavId::new("4288").unwrap();
        assert!(matches!(
            header().check_sender(&other),
            Err(WireError::Identity { .. })
        ));
    }
}
