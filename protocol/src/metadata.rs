//! Binary encoding of metadata, the small structured part of a message.
//!
//! The only file of the wire that depends on the format: bincode 2.0.1, little-endian, variable-length integers, a hard limit of
//! bytes read by a decoder. bincode is no longer maintained, so this interface is limited to two functions.

use bincode::config::{Configuration, Limit, LittleEndian, Varint};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::checks::check_limit;
use crate::text::excerpt;
use crate::{Kind, Limits, Result, WireError};

const HARD_LIMIT: usize = Limits::HARD_METADATA_BYTES as usize;

const CONFIG: Configuration<LittleEndian, Varint, Limit<HARD_LIMIT>> =
    bincode::config::standard().with_limit();

/// Appends `metadata` to `head`.
///
/// # Errors
/// [`WireError::Metadata`] when a value cannot be written, [`WireError::Limit`] when it exceeds the limit of every
/// receiver.
pub(crate) fn append<T: Serialize>(kind: Kind, metadata: &T, head: &mut Vec<u8>) -> Result<u32> {
    let len = bincode::serde::encode_into_std_write(metadata, head, CONFIG).map_err(|error| {
        let detail = error.to_string();
        WireError::Metadata { kind, detail }
    })?;
    check_limit("metadata bytes", len as u64, HARD_LIMIT as u64)?;
    Ok(u32::try_from(len).unwrap_or(u32::MAX))
}

/// Reads metadata that fill `bytes` completely.
///
/// The claimed length of a list reserves at most 1 MiB before its elements are read, so memory follows the bytes that
/// are there rather than those that are claimed.
///
/// # Errors
/// [`WireError::Metadata`] when they do not decode or leave bytes over.
pub(crate) fn decode<T: DeserializeOwned>(kind: Kind, bytes: &[u8]) -> Result<T> {
    let detail = match bincode::serde::decode_from_slice(bytes, CONFIG) {
        Ok((metadata, used)) if used == bytes.len() => return Ok(metadata),
        Ok((_, used)) => {
            let left = bytes.len() - used;
            format!("{left} of {} bytes are left over", bytes.len())
        }
        Err(error) => excerpt(&error.to_string(), 200),
    };
    Err(WireError::Metadata { kind, detail })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip<T: Serialize + DeserializeOwned>(value: &T) -> (Vec<u8>, T) {
        let mut bytes = Vec::new();
        let len = append(Kind::Control, value, &mut bytes).unwrap();
        assert_eq!(len as usize, bytes.len());
        let back = decode(Kind::Control, &bytes).unwrap();
        (bytes, back)
    }

    #[test]
    fn bytes_are_stable() {
        let (bytes, back) = round_trip(&(7u32, 1.5f64, Some("ab".to_owned()), vec![300u64]));
        assert_eq!(
            bytes,
            [
                7, 0, 0, 0, 0, 0, 0, 0xf8, 0x3f, 1, 2, b'a', b'b', 1, 251, 44, 1
            ]
        );
        assert_eq!(back, (7, 1.5, Some("ab".to_owned()), vec![300]));
    }

    #[test]
    fn leftover_bytes_are_refused() {
        let (mut bytes, _) = round_trip(&1u64);
        bytes.push(0);
        assert!(matches!(
            decode::<u64>(Kind::Control, &bytes),
            Err(WireError::Metadata { .. })
        ));
    }

    #[test]
    fn an_absurd_length_is_refused_without_its_memory() {
        // 253: a u64 follows, here 2^42.
        let mut bytes = vec![253];
        bytes.extend((1u64 << 42).to_le_bytes());
        assert!(decode::<Vec<f64>>(Kind::Control, &bytes).is_err());
        assert!(decode::<Vec<String>>(Kind::Control, &bytes).is_err());
        assert!(decode::<String>(Kind::Control, &bytes).is_err());
    }
}
