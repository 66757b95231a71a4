//! Hostile input: any bytes may arrive; none panics, and only messages that their sender sealed are accepted.
//!
//! `PROPTEST_CASES=1000000 cargo test --release -p protocol --test hostile` tests more cases.

mod sample;

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::{Index, select};
use protocol::{
    Bev, BevGrid, Body, Codec, CodecConfig, Compression, DropReason, Dtype, EncodedFeatures,
    HEADER_LEN, Header, Lidar, Limits, Message, Points, Selection, WireError, wire,
};
use sample::any::any_message;

fn every_message() -> Vec<Vec<u8>> {
    let encode = |message| {
        wire::encode_any(&sample::stamp(), message)
            .unwrap()
            .to_vec()
    };
    sample::every_kind().into_iter().map(encode).collect()
}

fn decode(bytes: &[u8]) -> Result<(Header, Message), WireError> {
    wire::decode_any([bytes], &Limits::DEFAULT)
}

/// Updates lengths and checksums, so that the checks behind them are tested.
fn reseal(bytes: &mut [u8], metadata_len: Option<u32>) {
    if bytes.len() < HEADER_LEN {
        return;
    }
    let payload = (bytes.len() - HEADER_LEN) as u64;
    let metadata_len =
        metadata_len.unwrap_or_else(|| u32::from_le_bytes(bytes[80..84].try_into().unwrap()));
    let metadata_len = metadata_len.min(payload as u32);
    bytes[72..80].copy_from_slice(&(payload - u64::from(metadata_len)).to_le_bytes());
    bytes[80..84].copy_from_slice(&metadata_len.to_le_bytes());
    let crc = crc32fast::hash(&bytes[HEADER_LEN..]);
    bytes[84..88].copy_from_slice(&crc.to_le_bytes());
    reseal_header(bytes);
}

fn reseal_header(bytes: &mut [u8]) {
    let crc = crc32fast::hash(&bytes[..88]);
    bytes[88..92].copy_from_slice(&crc.to_le_bytes());
}

#[test]
fn every_truncation_is_refused() {
    for bytes in every_message() {
        for len in 0..bytes.len() {
            let error = decode(&bytes[..len]).unwrap_err();
            assert!(matches!(error, WireError::Truncated { .. }), "{error}");
            assert!(matches!(error.drop_reason(), DropReason::Decode));
        }
    }
}

#[test]
fn leftover_bytes_are_refused() {
    for mut bytes in every_message() {
        bytes.push(0);
        assert!(matches!(
            decode(&bytes),
            Err(WireError::TrailingBytes { .. })
        ));
    }
}

#[test]
fn every_flipped_bit_is_noticed() {
    for bytes in every_message() {
        for bit in 0..8 * bytes.len() {
            let mut bytes = bytes.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            let error = decode(&bytes).unwrap_err();
            if bit / 8 >= HEADER_LEN {
                assert!(
                    matches!(error, WireError::Checksum { .. }),
                    "bit {bit}: {error}"
                );
            }
        }
    }
}

#[test]
fn fifteen_bytes_that_claim_2_to_the_42_are_rejected() {
    let mut bytes = [0; 15];
    bytes[..8].copy_from_slice(&(1u64 << 42).to_le_bytes());
    assert!(matches!(
        decode(&bytes),
        Err(WireError::Truncated {
            expected: 92,
            found: 15
        })
    ));
}

#[test]
fn absurd_lengths_in_the_header_are_refused() {
    for bytes in every_message() {
        for (offset, len) in [(72, 1u64 << 42), (72, u64::MAX), (72, 65 << 20)] {
            let mut bytes = bytes.clone();
            bytes[offset..offset + 8].copy_from_slice(&len.to_le_bytes());
            reseal_header(&mut bytes);
            let error = decode(&bytes).unwrap_err();
            assert!(
                matches!(
                    error,
                    WireError::Limit {
                        what: "body bytes",
                        ..
                    }
                ),
                "{error}"
            );
        }
        let mut bytes = bytes.clone();
        bytes[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        reseal_header(&mut bytes);
        assert!(matches!(
            decode(&bytes),
            Err(WireError::Limit {
                what: "metadata bytes",
                ..
            })
        ));
    }
}

fn absurd_map(
    grid: BevGrid,
    channels: u32,
    selection: Selection,
    compression: Compression,
) -> WireError {
    let codec = Codec {
        dtype: Dtype::I8,
        selection,
        compression,
    };
    let features = EncodedFeatures {
        grid,
        channels,
        code_of: None,
        codec,
        rate: None,
        body: Body::Bytes(vec![0; 15]),
    };
    features.decode(&Limits::DEFAULT).unwrap_err()
}

#[test]
fn absurd_shapes_in_the_metadata_are_refused() {
    let (grid, none) = (sample::grid(), Selection::TopK { cells: 0 });
    let huge = BevGrid {
        width: u32::MAX,
        height: u32::MAX,
        ..grid
    };
    let large = BevGrid {
        width: 1024,
        height: 1024,
        ..grid
    };
    for compression in [Compression::Raw, Compression::Zstd] {
        assert!(matches!(
            absurd_map(huge, u32::MAX, Selection::Dense, compression),
            WireError::Limit { .. }
        ));
        assert!(matches!(
            absurd_map(huge, 1, none, compression),
            WireError::Limit {
                what: "grid cells",
                ..
            }
        ));
        assert!(matches!(
            absurd_map(grid, u32::MAX, none, compression),
            WireError::Limit {
                what: "channels",
                ..
            }
        ));
        // 4 GiB decompressed, from an empty body.
        assert!(matches!(
            absurd_map(large, 1024, none, compression),
            WireError::Limit {
                what: "feature map bytes",
                ..
            }
        ));
        let all_and_one = Selection::TopK {
            cells: grid.cells() as u32 + 1,
        };
        assert!(matches!(
            absurd_map(grid, 1, all_and_one, compression),
            WireError::Limit {
                what: "selected cells",
                ..
            }
        ));
        let empty = BevGrid { height: 0, ..grid };
        assert!(matches!(
            absurd_map(empty, 1, Selection::Dense, compression),
            WireError::Shape { .. }
        ));
        for cell_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let error = absurd_map(BevGrid { cell_m, ..grid }, 1, none, compression);
            assert!(
                matches!(
                    error,
                    WireError::Value {
                        what: "grid cell_m",
                        ..
                    }
                ),
                "{error}"
            );
        }
    }
}

#[test]
fn a_code_has_no_more_channels_than_its_map_and_the_map_no_more_than_the_limit() {
    for (decoded, is_right) in [
        (2, false),
        (3, true),
        (1024, true),
        (1025, false),
        (u32::MAX, false),
    ] {
        let mut bev = sample::compressed_bev();
        bev.features.code_of = Some(decoded);
        // An attacker can write a message that the encoder rejects.
        let encoded = wire::encode(&sample::stamp(), bev);
        assert_eq!(encoded.is_ok(), decoded > 2, "{decoded}");
        let Ok(encoded) = encoded else { continue };
        match decode(&encoded.to_vec()) {
            Ok((_, Message::Bev(bev))) => assert!(
                is_right && bev.features.code_of == Some(decoded),
                "{decoded}"
            ),
            Ok(other) => panic!("{other:?}"),
            Err(error) => assert!(
                !is_right && error.drop_reason() == DropReason::Shape,
                "{error}"
            ),
        }
    }
}

#[test]
fn smaller_limits_are_kept_too() {
    let limits = Limits {
        max_points: 99,
        max_boxes: 1,
        max_entries: 0,
        max_channels: 2,
        ..Limits::DEFAULT
    };
    for bytes in every_message() {
        let (_, message) = decode(&bytes).unwrap();
        let refused = match &message {
            Message::Lidar(lidar) => lidar.points.len() > 99,
            Message::Radar(_) | Message::Points(_) | Message::Boxes(_) | Message::Bev(_) => true,
            Message::Descriptor(_)
            | Message::Detections(_)
            | Message::Tracks(_)
            | Message::Truth(_)
            | Message::Stats(_) => true,
            Message::Control(protocol::Control::End { .. } | protocol::Control::Ready { .. }) => {
                true
            }
            Message::Camera(_) => false,
            Message::Control(_)
            | Message::Gnss(_)
            | Message::Imu(_)
            | Message::Pace(_)
            | Message::Pose(_) => false,
        };
        match wire::decode_any([&bytes[..]], &limits) {
            Ok(_) => assert!(!refused, "{message:?}"),
            Err(error) => assert!(
                refused && error.drop_reason() == DropReason::Shape,
                "{error}"
            ),
        }
    }
}

#[test]
fn numbers_that_are_not_finite_are_never_accepted() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30] {
        let mut features = sample::features();
        features.values[500] = bad;
        let features = protocol::encode_features(features, &CodecConfig::default(), None).unwrap();
        let mut points = sample::points();
        points.xyzi[50][2] = bad;
        for message in [
            Message::Bev(Bev {
                pose: sample::pose(),
                features,
            }),
            Message::Lidar(Lidar {
                points: points.clone(),
            }),
            Message::Points(Points {
                pose: sample::pose(),
                points,
            }),
        ] {
            let bytes = wire::encode_any(&sample::stamp(), message)
                .unwrap()
                .to_vec();
            for size in [7, 1 << 20] {
                let error = wire::decode_any(bytes.chunks(size), &Limits::DEFAULT).unwrap_err();
                assert!(
                    matches!(
                        error,
                        WireError::Value {
                            index: 500 | 202,
                            ..
                        }
                    ),
                    "{error}"
                );
                assert_eq!(error.drop_reason(), DropReason::NotFinite);
            }
        }
    }
}

/// One change to a message.
#[derive(Debug, Clone)]
enum Mutation {
    Set(Index, u8),
    Number(Index, u64),
    Insert(Index, Vec<u8>),
    Remove(Index, usize),
    Swap(Index, Index),
}

fn any_mutation() -> impl Strategy<Value = Mutation> {
    // Limits of integers, varints, floats and halves.
    let numbers = vec![
        0,
        1,
        0x7f,
        0xfa,
        0xfb_ffff,
        0xfd,
        u64::MAX,
        u64::MAX >> 1,
        1 << 42,
        1 << 31,
        1 << 20,
        f64::NAN.to_bits(),
        f64::INFINITY.to_bits(),
        1e30f64.to_bits(),
        u64::from(f32::NAN.to_bits()) << 32 | u64::from(f32::INFINITY.to_bits()),
        0x7c00_7e00_fc00_7bff,
    ];
    prop_oneof![
        3 => (any::<Index>(), any::<u8>()).prop_map(|(at, byte)| Mutation::Set(at, byte)),
        2 => (any::<Index>(), select(numbers)).prop_map(|(at, number)| Mutation::Number(at, number)),
        1 => (any::<Index>(), vec(any::<u8>(), 1..20)).prop_map(|(at, bytes)| Mutation::Insert(at, bytes)),
        1 => (any::<Index>(), 1..40usize).prop_map(|(at, count)| Mutation::Remove(at, count)),
        1 => (any::<Index>(), any::<Index>()).prop_map(|(a, b)| Mutation::Swap(a, b)),
    ]
}

impl Mutation {
    /// Applies itself to the bytes from `begin` on.
    fn apply(&self, bytes: &mut Vec<u8>, begin: usize) {
        let span = bytes.len().saturating_sub(begin);
        if span == 0 {
            return;
        }
        let position = |at: &Index| begin + at.index(span);
        match self {
            Self::Set(at, byte) => bytes[position(at)] = *byte,
            Self::Number(at, number) => {
                let at = position(at);
                let len = (bytes.len() - at).min(8);
                bytes[at..at + len].copy_from_slice(&number.to_le_bytes()[..len]);
            }
            Self::Insert(at, new) => {
                let at = position(at);
                bytes.splice(at..at, new.iter().copied());
            }
            Self::Remove(at, count) => {
                let at = position(at);
                bytes.drain(at..(at + count).min(bytes.len()));
            }
            Self::Swap(a, b) => bytes.swap(position(a), position(b)),
        }
    }
}

/// An accepted message must be valid: it can be used and encoded, and decodes to the same message.
fn check_accepted(message: Message) -> Result<(), TestCaseError> {
    let bytes = wire::encode_any(&sample::stamp(), message.clone())
        .expect("valid")
        .to_vec();
    prop_assert_eq!(&decode(&bytes).expect("valid").1, &message);
    if let Message::Bev(bev) = message
        && let Ok(decoded) = bev.features.decode(&Limits::DEFAULT)
    {
        let grid = decoded.features.grid;
        prop_assert_eq!(
            decoded.features.values.len(),
            grid.cells() * decoded.features.channels as usize
        );
        prop_assert!(
            decoded
                .features
                .values
                .iter()
                .all(|value| value.is_finite())
        );
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

    #[test]
    fn random_bytes_are_refused(bytes in vec(any::<u8>(), 0..400)) {
        prop_assert!(decode(&bytes).is_err());
    }

    #[test]
    fn random_payloads_under_a_valid_header_are_harmless(kind in 1..=12u8, metadata_len in 0..200u32, payload in vec(any::<u8>(), 0..400)) {
        let mut bytes = wire::encode(&sample::stamp(), sample::pose()).unwrap().head;
        bytes.truncate(HEADER_LEN);
        bytes[6] = kind;
        bytes.extend(payload);
        reseal(&mut bytes, Some(metadata_len));
        if let Ok((_, message)) = decode(&bytes) {
            check_accepted(message)?;
        }
    }

    #[test]
    fn changed_messages_are_refused(message in any_message(), mutations in vec(any_mutation(), 1..6)) {
        let original = wire::encode_any(&sample::stamp(), message).unwrap().to_vec();
        let mut bytes = original.clone();
        mutations.iter().for_each(|mutation| mutation.apply(&mut bytes, 0));
        prop_assert!(bytes == original || decode(&bytes).is_err());
    }

    #[test]
    fn changed_and_resealed_messages_are_harmless(message in any_message(), mutations in vec(any_mutation(), 1..6), anywhere: bool) {
        let mut bytes = wire::encode_any(&sample::stamp(), message).unwrap().to_vec();
        let begin = if anywhere { 0 } else { HEADER_LEN };
        mutations.iter().for_each(|mutation| mutation.apply(&mut bytes, begin));
        reseal(&mut bytes, None);
        if let Ok((_, message)) = decode(&bytes) {
            check_accepted(message)?;
        }
    }
}
