//! Damaged messages: every accepted message is valid.

use protocol::{HEADER_LEN, Header, Limits, Message, WireError, wire};
use support::random::SplitMix64;

use super::damage;

/// Limits under which damaged messages are decoded.
pub const LIMITS: Limits = Limits::DEFAULT;

/// Damages a sealed message; in most cases lengths and checksums are corrected afterwards, so that the damage passes
/// their checks.
pub fn damage_message(bytes: &mut Vec<u8>, other: &[u8], random: &mut SplitMix64) {
    damage(bytes, other, random);
    match random.below(10) {
        0..=5 => reseal(bytes, true),
        6 | 7 => reseal(bytes, false),
        _ => {}
    }
}

/// Corrects the checksums, and the lengths if `lengths`.
pub fn reseal(bytes: &mut [u8], lengths: bool) {
    if bytes.len() < HEADER_LEN {
        return;
    }
    if lengths {
        let payload = (bytes.len() - HEADER_LEN) as u64;
        let claimed = u32::from_le_bytes([bytes[80], bytes[81], bytes[82], bytes[83]]);
        let metadata = u64::from(claimed).min(payload);
        bytes[72..80].copy_from_slice(&(payload - metadata).to_le_bytes());
        bytes[80..84].copy_from_slice(&(metadata as u32).to_le_bytes());
    }
    let payload = crc32fast::hash(&bytes[HEADER_LEN..]);
    bytes[84..88].copy_from_slice(&payload.to_le_bytes());
    let header = crc32fast::hash(&bytes[..HEADER_LEN - 4]);
    bytes[HEADER_LEN - 4..HEADER_LEN].copy_from_slice(&header.to_le_bytes());
}

/// Decodes a message, feature maps to the last value; returns true if it was accepted.
///
/// # Panics
/// When an accepted message has a wrong checksum, or values that are not finite.
pub fn read(bytes: &[u8]) -> bool {
    let whole: Result<(Header, Message), WireError> = wire::decode_any([bytes], &LIMITS);
    let Ok((_, message)) = whole else {
        return false;
    };
    let sealed = |at: usize, over: &[u8]| bytes[at..at + 4] == crc32fast::hash(over).to_le_bytes();
    assert!(
        sealed(84, &bytes[HEADER_LEN..]),
        "accepted with a wrong checksum of the payload"
    );
    assert!(
        sealed(HEADER_LEN - 4, &bytes[..HEADER_LEN - 4]),
        "accepted with a wrong checksum of the header"
    );
    match message {
        Message::Bev(bev) => match bev.features.decode(&LIMITS) {
            Ok(map) => {
                assert!(
                    map.features.values.iter().all(|value| value.is_finite()),
                    "a map with values that are not finite"
                );
                true
            }
            Err(_) => false,
        },
        Message::Lidar(lidar) => are_finite(&lidar.points.xyzi),
        Message::Points(points) => are_finite(&points.points.xyzi),
        _ => true,
    }
}

fn are_finite(points: &[[f32; 4]]) -> bool {
    assert!(
        points.iter().flatten().all(|value| value.is_finite()),
        "points with values that are not finite"
    );
    true
}
