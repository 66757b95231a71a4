//! Memory that a peer can make a receiver allocate: measured, on Linux, as the process's peak.
#![cfg(target_os = "linux")]

mod sample;

use std::io::Write;

use protocol::{
    BevGrid, Body, Codec, Compression, Dtype, EncodedFeatures, HEADER_LEN, Limits, Message,
    Selection, WireError, wire,
};

const MIB: u64 = 1 << 20;
const LIMITS: Limits = Limits {
    max_body_bytes: 8 * MIB,
    ..Limits::DEFAULT
};

/// Resident memory in bytes, now or at its peak.
fn resident(field: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix(field))
        .unwrap();
    line.trim_start_matches(':')
        .trim()
        .trim_end_matches(" kB")
        .parse::<u64>()
        .unwrap()
        * 1024
}

/// `[1024, 32, 64]`: 8 MiB as `f32`, the maximum of the limits.
fn largest_map(
    dtype: Dtype,
    selection: Selection,
    compression: Compression,
    body: Vec<u8>,
) -> EncodedFeatures {
    let grid = BevGrid {
        width: 64,
        height: 32,
        ..sample::grid()
    };
    let codec = Codec {
        dtype,
        selection,
        compression,
    };
    EncodedFeatures {
        grid,
        channels: 1024,
        code_of: None,
        codec,
        rate: None,
        body: Body::Bytes(body),
    }
}

/// A zstd frame of zeros, written in small parts so that making it allocates little memory.
fn zeros(bytes: u64) -> Vec<u8> {
    let mut encoder = zstd::stream::Encoder::new(Vec::new(), 3).unwrap();
    encoder.set_pledged_src_size(Some(bytes)).unwrap();
    // 128 MiB of window, the size of the decoder's buffer.
    encoder.window_log(27).unwrap();
    for _ in 0..bytes / (64 << 10) {
        encoder.write_all(&[0; 64 << 10]).unwrap();
    }
    encoder.finish().unwrap()
}

/// A message whose metadata claim 2^42 elements without content.
fn claim(kind: u8, before: &[u8], body_len: u64) -> Vec<u8> {
    let mut bytes = wire::encode(&sample::stamp(), sample::pose()).unwrap().head;
    bytes.truncate(HEADER_LEN);
    bytes[6] = kind;
    bytes.extend(before);
    bytes.push(253);
    bytes.extend((1u64 << 42).to_le_bytes());
    let metadata_len = (bytes.len() - HEADER_LEN) as u32;
    let crc = crc32fast::hash(&bytes[HEADER_LEN..]);
    bytes[72..80].copy_from_slice(&body_len.to_le_bytes());
    bytes[80..84].copy_from_slice(&metadata_len.to_le_bytes());
    bytes[84..88].copy_from_slice(&crc.to_le_bytes());
    let crc = crc32fast::hash(&bytes[..88]);
    bytes[88..92].copy_from_slice(&crc.to_le_bytes());
    bytes
}

#[test]
fn claims_allocate_no_memory_and_bombs_at_most_twice_the_limit() {
    let (small_bomb, bomb) = (zeros(8 * MIB), zeros(1024 * MIB));
    let no_pose = [1, 0, 0];
    let claims = [
        // Points of a sweep, detections behind a pose, objects of a truth, a body of the maximum size.
        claim(1, &[], 0),
        claim(6, &no_pose, 0),
        claim(10, &[0], 0),
        claim(1, &[], 8 * MIB),
        claim(12, &[1, b'x'], 0),
    ];
    // 5: resets the peak.
    std::fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = resident("VmRSS");

    for _ in 0..20 {
        for bytes in &claims {
            let error = wire::decode_any([&bytes[..]], &LIMITS).unwrap_err();
            assert!(
                matches!(
                    error,
                    WireError::Limit { .. }
                        | WireError::Metadata { .. }
                        | WireError::Truncated { .. }
                ),
                "{error}"
            );
        }
    }
    let after_claims = resident("VmHWM") - before;
    assert!(after_claims < 4 * MIB, "claims took {after_claims} bytes");

    let dense = |bomb: &[u8]| {
        largest_map(
            Dtype::F32,
            Selection::Dense,
            Compression::Zstd,
            bomb.to_vec(),
        )
    };
    assert!(matches!(
        dense(&bomb).decode(&LIMITS),
        Err(WireError::Compression { .. })
    ));
    assert!(
        dense(&small_bomb)
            .decode(&LIMITS)
            .unwrap()
            .features
            .values
            .iter()
            .all(|value| *value == 0.0)
    );
    let nothing = largest_map(
        Dtype::F16,
        Selection::TopK { cells: 0 },
        Compression::Raw,
        vec![0; 64 * 32 / 8],
    );
    let message = Message::Bev(protocol::Bev {
        pose: sample::pose(),
        features: nothing,
    });
    let bytes = wire::encode_any(&sample::stamp(), message)
        .unwrap()
        .to_vec();
    let (_, message) = wire::decode_any([&bytes[..]], &LIMITS).unwrap();
    let Message::Bev(bev) = message else {
        panic!("a map")
    };
    assert!(
        bev.features
            .decode(&LIMITS)
            .unwrap()
            .sent
            .unwrap()
            .iter()
            .all(|sent| !sent)
    );
    let peak = resident("VmHWM") - before;
    assert!(
        peak < 2 * LIMITS.max_body_bytes + 4 * MIB,
        "bombs took {peak} bytes"
    );
}
