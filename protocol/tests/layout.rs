//! Wire layout: the bytes of every message are pinned; a change requires a new `WIRE_VERSION` and new pins.

mod sample;

use protocol::{Compression, HEADER_LEN, Message, wire};

/// Kind, length and FNV-1a of each sample in order. Maps compressed by zstd are omitted, as their bytes depend on the
/// version of zstd. (A CRC is not usable here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 34] = [
    ("lidar", 1693, 0x398d_125d_2a46_bca1),
    ("lidar", 93, 0x32ef_e048_3663_ac0d),
    ("radar", 1693, 0x9ba5_c01d_570c_1b62),
    ("camera", 389, 0xb84c_599a_bfae_836e),
    ("pace", 104, 0x54df_bfc5_aae3_1a40),
    ("imu", 102, 0xac28_ffb3_a2d7_8a6a),
    ("gnss", 165, 0x1037_4dc7_8dbe_3949),
    ("pose", 154, 0x5d20_b4d7_b332_cf64),
    ("pose", 170, 0x0209_78ad_eff1_39e8),
    ("pose", 95, 0xcdd6_48c4_58dd_05a2),
    ("boxes", 387, 0x9b35_efdc_63a0_4ad0),
    ("points", 1755, 0x1825_fa1d_e899_883c),
    ("descriptor", 207, 0x44ee_520b_ed0f_b2a8),
    ("detections", 389, 0x2be8_5fd7_c978_796b),
    ("truth", 576, 0x212b_c713_8a81_7624),
    ("stats", 266, 0xd8d1_7ae8_6f6c_b5d8),
    ("bev", 2490, 0x5bf4_63b3_474e_5fbc),
    ("bev", 583, 0x4ae1_aeb2_c5a9_6c84),
    ("bev", 1338, 0x8e99_9884_4a20_688f),
    ("bev", 583, 0x346d_c284_dede_32f7),
    ("bev", 774, 0xa790_e705_8314_b42f),
    ("bev", 586, 0x09b8_6305_818a_0771),
    ("bev", 533, 0x4be4_1555_15fe_acb9),
    ("bev", 2491, 0x63a9_5617_6b58_ef6e),
    ("control", 101, 0x9cc1_ed9b_0f8a_b132),
    ("control", 93, 0x7df7_196c_3478_7f0b),
    ("control", 93, 0xb690_8beb_28c1_a8da),
    ("control", 94, 0xca0c_363e_12f7_896f),
    ("control", 94, 0xff24_483a_a550_894e),
    ("control", 107, 0x4195_d5f9_f950_49ca),
    ("control", 116, 0xd155_3a9b_ee2e_cf8e),
    ("control", 93, 0x5eb5_c215_4030_38d9),
    ("control", 105, 0xee33_5b01_5578_27d6),
    ("tracks", 486, 0x7f8b_48a0_0e2a_1641),
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
