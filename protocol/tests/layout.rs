//! Wire layout: the bytes of every message are pinned; a change requires a new `WIRE_VERSION` and new pins.

mod sample;

use protocol::{Compression, HEADER_LEN, Message, wire};

/// Kind, length and FNV-1a of each sample in order. Maps compressed by zstd are omitted, as their bytes depend on the
/// version of zstd. (A CRC is not usable here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 34] = [
    ("lidar", 1693, 0x9e41_3ad2_739a_27a4),
    ("lidar", 93, 0xdf43_6de5_44fb_29f4),
    ("radar", 1693, 0xec97_ee5a_05a8_4a13),
    ("camera", 389, 0x3616_81b3_d61f_f9b3),
    ("pace", 104, 0x9107_8125_6d4d_dc8f),
    ("imu", 102, 0xc158_a37a_b351_83e1),
    ("gnss", 165, 0xf297_4e5f_f3c5_6204),
    ("pose", 154, 0xcf3e_6988_0153_1d07),
    ("pose", 170, 0x7a7d_3498_6b8d_d07b),
    ("pose", 95, 0x6862_0bf8_c6c8_72cf),
    ("boxes", 475, 0xfe48_bfd3_c112_2141),
    ("points", 1755, 0xf163_fdb7_41b2_5d65),
    ("descriptor", 207, 0x8551_d6b6_150d_86d5),
    ("detections", 389, 0x8074_a234_fbf2_fd72),
    ("truth", 576, 0xaee0_3a8f_c53d_73c7),
    ("stats", 242, 0x6f2f_99b9_9aa8_578a),
    ("bev", 2490, 0xd2bb_1c32_4c64_bab3),
    ("bev", 583, 0x46cc_bb82_5c9b_2da5),
    ("bev", 1338, 0x3c06_3ddc_7d1c_e4b0),
    ("bev", 583, 0xc4c0_7226_da25_cece),
    ("bev", 774, 0x31d4_bc8e_1124_a9e8),
    ("bev", 586, 0xf408_45f4_4728_1fb6),
    ("bev", 533, 0xe79b_d45c_6e10_2660),
    ("bev", 2491, 0xc515_4489_07c3_65c7),
    ("control", 101, 0x39b3_bbec_9271_6127),
    ("control", 93, 0x007b_a45c_dafd_31e6),
    ("control", 93, 0x6e80_5f0b_40c3_c017),
    ("control", 94, 0x11e6_1dc9_1a7d_5cd0),
    ("control", 94, 0xf4e2_08e3_d346_0f5d),
    ("control", 107, 0x235b_5f67_63d5_3d0b),
    ("control", 116, 0x547f_5502_878a_2905),
    ("control", 93, 0x2fb0_e158_45a1_939c),
    ("control", 105, 0x773c_2742_03e3_9e23),
    ("tracks", 486, 0x061e_9914_73c5_6ea6),
];

fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

fn compressed(message: &Message) -> bool {
    matches!(message, Message::Bev(bev) if bev.features.codec.compression == Compression::Zstd)
}

#[test]
fn bytes_are_stable() {
    let found = sample::every_kind()
        .into_iter()
        .filter(|message| !compressed(message))
        .map(|message| {
            let kind = message.kind().to_string();
            let bytes = wire::encode_any(&sample::stamp(), message)
                .unwrap()
                .to_vec();
            (kind, bytes.len(), fnv1a(&bytes))
        });
    let found: Vec<_> = found.collect();
    let pinned: Vec<_> = PINNED
        .iter()
        .map(|(kind, len, hash)| ((*kind).to_owned(), *len, *hash))
        .collect();
    assert_eq!(found, pinned, "found {found:#x?}");
}

#[test]
fn a_pose_without_a_covariance_is_sixty_two_bytes_behind_its_header() {
    let bytes = wire::encode(&sample::stamp(), sample::pose())
        .unwrap()
        .to_vec();
    let mut expected = vec![0];
    for number in [120.5f64, -30.25, 1.75, 0.8, 0.0, 0.0, 0.6] {
        expected.extend(number.to_le_bytes());
    }
    expected.extend(0.875f32.to_le_bytes());
    expected.push(0);
    assert_eq!(&bytes[HEADER_LEN..], expected);
}
