//! The bytes of every message, pinned: whoever changes one must raise `WIRE_VERSION` and pin the new ones.

mod sample;

use protocol::{HEADER_LEN, Message, Packing, wire};

/// Kind, length and FNV-1a of each sample in turn. Maps packed by zstd are left out: their bytes are zstd's affair. (A CRC
/// would not do here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 29] = [
    ("lidar", 1693, 0x7925_3f96_ce9b_c855),
    ("lidar", 93, 0x90ae_9b22_d69b_63ad),
    ("radar", 1693, 0x3042_4228_2935_b456),
    ("gnss", 165, 0x2cfa_ead3_8f47_1645),
    ("pose", 153, 0x9e7d_fff1_3530_5103),
    ("pose", 95, 0x354a_80f4_1c0e_a566),
    ("boxes", 474, 0x66f9_c385_26b6_4ed1),
    ("points", 1754, 0x21b8_0f84_7824_eab7),
    ("descriptor", 204, 0x67c0_6804_eb58_0c87),
    ("detections", 378, 0x2f40_b4c0_9dbf_8931),
    ("truth", 576, 0x5f66_1f24_ede2_abdc),
    ("stats", 188, 0xad14_7cd3_cfeb_bd58),
    ("bev", 2488, 0xb537_5f3c_49a9_ce38),
    ("bev", 581, 0xff87_5f9b_7d1e_1402),
    ("bev", 1336, 0x1fe0_b9a6_ad41_bcc0),
    ("bev", 581, 0x360b_9d2c_0586_5889),
    ("bev", 772, 0x6269_99c8_0726_2f78),
    ("bev", 584, 0x554b_f1ad_4e15_df6c),
    ("bev", 531, 0x04cb_5d96_2cf7_4e33),
    ("bev", 2489, 0),
    ("control", 101, 0x9890_f0ab_7c91_454e),
    ("control", 93, 0x35b1_e919_8218_3083),
    ("control", 93, 0xcf32_7f35_0a3b_ba6a),
    ("control", 94, 0x4ca4_95e9_654a_285b),
    ("control", 94, 0x396a_1596_c13b_479e),
    ("control", 107, 0xeff3_a7c7_9b13_77d2),
    ("control", 116, 0xe9d8_3151_f7f5_c88a),
    ("control", 93, 0x0877_455c_f8dc_bd21),
    ("control", 105, 0xbb6a_1a2c_44a2_f7aa),
];

fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

fn packed(message: &Message) -> bool {
    matches!(message, Message::Bev(bev) if bev.features.codec.packing == Packing::Zstd)
}

#[test]
fn bytes_are_what_they_always_were() {
    let found = sample::every_kind().into_iter().filter(|message| !packed(message)).map(|message| {
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
