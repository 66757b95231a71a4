//! Compression of a body with zstd.

use crate::WireError;

/// Compresses `bytes`; `None` if that does not make them fewer.
///
/// # Errors
/// [`WireError::Compression`] when zstd fails, for example for lack of memory.
pub(super) fn pack(bytes: &[u8], level: i32) -> Result<Option<Vec<u8>>, WireError> {
    let packed = zstd::bulk::compress(bytes, level);
    let packed = packed.map_err(|error| failed(0, bytes.len(), &error.to_string()))?;
    Ok(Some(packed).filter(|packed| packed.len() < bytes.len()))
}

/// Decompresses to exactly `expected` bytes, a size that the caller has checked against its limits. The decoder writes
/// into a buffer of that size and fails at its end, whatever the frame claims, so a decompression bomb has no effect.
/// The frame is decoded in one call: zstd then reads back its own output and allocates no window, however large the
/// window that the frame asks for.
///
/// # Errors
/// [`WireError::Compression`] when the frame is corrupt, or decompresses to more or fewer bytes.
pub(super) fn unpack(packed: Vec<u8>, expected: usize) -> Result<Vec<u8>, WireError> {
    decompress(&packed, expected).map_err(|detail| failed(packed.len(), expected, &detail))
}

fn failed(bytes: usize, expected: usize, detail: &str) -> WireError {
    WireError::Compression(format!("{bytes} bytes, {expected} unpacked: {detail}"))
}

fn decompress(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    // A frame states its content size before anything is allocated for it.
    match zstd::zstd_safe::get_frame_content_size(packed).map_err(|_| "no zstd frame")? {
        Some(claimed) if claimed == expected as u64 => {}
        Some(claimed) => return Err(format!("the frame states {claimed} bytes of content")),
        None => return Err("the frame does not state its content size".into()),
    }
    let mut bytes = Vec::with_capacity(expected);
    let found = zstd::bulk::Decompressor::new()
        .and_then(|mut decompressor| decompressor.decompress_to_buffer(packed, &mut bytes))
        .map_err(|error| error.to_string())?;
    if found == expected {
        Ok(bytes)
    } else {
        Err(format!("the frame contains {found} bytes"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_and_exact_size() {
        let bytes: Vec<u8> = (0..10_000u32).map(|n| (n / 100) as u8).collect();
        let packed = pack(&bytes, 3).unwrap().unwrap();
        assert_eq!(unpack(packed.clone(), bytes.len()).unwrap(), bytes);
        for wrong in [0, 1, bytes.len() - 1, bytes.len() + 1] {
            assert!(
                matches!(
                    unpack(packed.clone(), wrong),
                    Err(WireError::Compression { .. })
                ),
                "{wrong}"
            );
        }
        for cut in 0..packed.len() {
            assert!(
                unpack(packed[..cut].to_vec(), bytes.len()).is_err(),
                "cut at {cut}"
            );
        }
    }

    #[test]
    fn noise_is_left_unpacked() {
        let mut state = 1u64;
        let bytes: Vec<u8> = std::iter::repeat_with(|| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        })
        .take(4096)
        .collect();
        assert_eq!(pack(&bytes, 3).unwrap(), None);
    }

    /// A valid frame of zeros whose window descriptor asks for 2 GiB, with or without its content size; format: RFC
    /// 8878.
    fn wide(bytes: u32, states_size: bool) -> Vec<u8> {
        const BLOCK: u32 = 128 << 10;
        let mut frame = vec![
            0x28,
            0xb5,
            0x2f,
            0xfd,
            if states_size { 0x80 } else { 0 },
            21 << 3,
        ];
        frame.extend(bytes.to_le_bytes().iter().filter(|_| states_size));
        for begin in (0..bytes).step_by(BLOCK as usize) {
            // One byte, repeated.
            let len = BLOCK.min(bytes - begin);
            let head = len << 3 | 1 << 1 | u32::from(begin + len == bytes);
            frame.extend(&head.to_le_bytes()[..3]);
            frame.push(0);
        }
        frame
    }

    #[test]
    fn a_huge_window_allocates_nothing_and_a_frame_without_size_is_refused() {
        let zeros = 300 << 10;
        assert_eq!(
            unpack(wide(zeros, true), zeros as usize).unwrap(),
            vec![0; zeros as usize]
        );
        let error = unpack(wide(zeros, false), zeros as usize).unwrap_err();
        assert!(error.to_string().contains("does not state"), "{error}");
    }

    #[test]
    fn a_decompression_bomb_is_refused() {
        let bomb = pack(&vec![0; 64 << 20], 19).unwrap().unwrap();
        assert!(bomb.len() < 10_000);
        assert!(matches!(
            unpack(bomb.clone(), 1000),
            Err(WireError::Compression { .. })
        ));
        // Two frames that together contain more than announced.
        let mut twice = pack(&[0; 1000], 3).unwrap().unwrap();
        twice.extend(bomb);
        assert!(matches!(
            unpack(twice, 1000),
            Err(WireError::Compression { .. })
        ));
    }
}
