//! Wire layout: the bytes of every message are pinned; a change requires a new `WIRE_VERSION` and new pins.

mod sample;

use protocol::{Compression, HEADER_LEN, Message, wire};

/// Kind, length and FNV-1a of each sample in order. Maps compressed by zstd are omitted, as their bytes depend on the
/// version of zstd. (A CRC is not usable here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 33] = [
    ("lidar", 1693, 0x4120_a970_ce7d_6541),
    ("lidar", 93, 0xbef7_3984_f99b_c609),
    ("radar", 1693, 0x8acc_1614_26da_860e),
    ("camera", 389, 0x077c_0158_1239_a20a),
    ("pace", 102, 0xa290_9e67_f48a_b5f1),
    ("imu", 102, 0xb6fd_95f9_b18c_2aa6),
    ("gnss", 165, 0xb831_6fe7_9510_84f1),
    ("pose", 154, 0xd383_90f9_656a_ecdc),
    ("pose", 170, 0x59b3_5774_8dfe_83d4),
    ("pose", 95, 0x6ce0_6aba_77a1_a616),
    ("boxes", 475, 0x0f4f_3814_7b9f_69f8),
    ("points", 1755, 0x3bc8_0c16_70e5_d028),
    ("descriptor", 204, 0x74a3_26fe_b862_302b),
    ("detections", 379, 0x3285_e95c_a74d_987f),
    ("truth", 576, 0xffd6_d436_540c_1d3c),
    ("stats", 222, 0x1808_33f0_af29_3e8f),
    ("bev", 2490, 0x8b41_c845_b8e4_c030),
    ("bev", 583, 0x1bbc_1d96_9890_ca1c),
    ("bev", 1338, 0x37e0_f886_dc11_f023),
    ("bev", 583, 0x0a8d_ac53_73d1_79af),
    ("bev", 774, 0x3d7d_9d95_52ff_f35f),
    ("bev", 586, 0xd501_8114_ff21_ca09),
    ("bev", 533, 0x8baa_0dee_b726_1f39),
    ("bev", 2491, 0x8a96_8d2f_e6d1_4396),
    ("control", 101, 0xab60_6b6c_6274_525e),
    ("control", 93, 0x6698_c74d_c4fa_9c4b),
    ("control", 93, 0x95ba_99b1_1838_54ee),
    ("control", 94, 0xe1c5_5b21_d8b5_88d3),
    ("control", 94, 0xef51_88f8_341b_edd2),
    ("control", 107, 0x4210_696e_cbb3_f8fe),
    ("control", 116, 0x47f6_87a1_7310_33f2),
    ("control", 93, 0xeec0_7a57_834d_6f45),
    ("control", 105, 0x4d5d_a537_7e97_4d9a),
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
