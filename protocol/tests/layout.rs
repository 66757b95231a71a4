//! Wire layout: the bytes of every message are pinned; a change requires a new `WIRE_VERSION` and new pins.

mod sample;

use protocol::{Compression, HEADER_LEN, Message, wire};

/// Kind, length and FNV-1a of each sample in order. Maps compressed by zstd are omitted, as their bytes depend on the
/// version of zstd. (A CRC is not usable here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 29] = [
    ("lidar", 1693, 0x90ac_38a1_10ac_6db8),
    ("lidar", 93, 0xec61_5713_afbd_787c),
    ("radar", 1693, 0xcfca_7471_47ce_9b9b),
    ("gnss", 165, 0xc386_8919_850a_f418),
    ("pose", 153, 0xf2cf_e85e_6d47_c56e),
    ("pose", 95, 0x384b_ad78_7544_561f),
    ("boxes", 474, 0xc563_d28d_8867_a14e),
    ("points", 1754, 0x3113_5976_1cf4_c108),
    ("descriptor", 204, 0xaa5_02e1_c83e_c874),
    ("detections", 378, 0xab01_95c3_f035_c6b6),
    ("truth", 576, 0x866b_fd3d_fb29_d1db),
    ("stats", 188, 0xd094_bd86_524f_ac0b),
    ("bev", 2489, 0xb1b8_003f_c115_632a),
    ("bev", 582, 0xf011_2f3a_dcc4_c607),
    ("bev", 1337, 0xefd1_46a0_3cc6_ba87),
    ("bev", 582, 0x6103_1939_e234_bfa8),
    ("bev", 773, 0x4a88_7680_23d3_c929),
    ("bev", 585, 0x217a_00cb_a06e_cc6f),
    ("bev", 532, 0x381_5dfc_dc53_7b19),
    ("bev", 2490, 0x1af7_9c66_94c5_ec83),
    ("control", 101, 0xf7d0_cea3_fd44_a0a7),
    ("control", 93, 0x22a5_198a_8002_dd8a),
    ("control", 93, 0xc8c7_2c22_7485_7447),
    ("control", 94, 0x9c73_6d66_e61a_72a0),
    ("control", 94, 0xa287_1837_b71c_b9fd),
    ("control", 107, 0x3097_38f6_5b86_8f8b),
    ("control", 116, 0xc09a_68cf_bd88_246d),
    ("control", 93, 0x341_d1d8_108a_d374),
    ("control", 105, 0x7255_a2c8_3b75_4ff3),
];

fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

fn compressed(message: &Message) -> bool {
    matches!(message, Message::Bev(bev) if bev.features.codec.compression == Compression::Zstd)
}

#[test]
fn bytes_are_stable() {
    let found = sample::every_kind().into_iter().filter(|message| !compressed(message)).map(|message| {
        let kind = message.kind().to_string();
        let bytes = wire::encode_any(&sample::stamp(), message).unwrap().to_vec();
        (kind, bytes.len(), fnv1a(&bytes))
    });
    let found: Vec<_> = found.collect();
    let pinned: Vec<_> = PINNED.iter().map(|(kind, len, hash)| ((*kind).to_owned(), *len, *hash)).collect();
    assert_eq!(found, pinned, "found {found:#x?}");
}

#[test]
fn a_pose_is_sixty_one_bytes_behind_its_header() {
    let bytes = wire::encode(&sample::stamp(), sample::pose()).unwrap().to_vec();
    let mut expected = vec![0];
    for number in [120.5f64, -30.25, 1.75, 0.8, 0.0, 0.0, 0.6] {
        expected.extend(number.to_le_bytes());
    }
    expected.extend(0.875f32.to_le_bytes());
    assert_eq!(&bytes[HEADER_LEN..], expected);
}
