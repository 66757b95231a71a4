//! The bytes of every message, pinned: whoever changes one must raise `WIRE_VERSION` and pin the new ones.

mod sample;

use protocol::{HEADER_LEN, Message, Packing, wire};

/// Kind, length and FNV-1a of each sample in turn. Maps packed by zstd are left out: their bytes are zstd's affair. (A CRC
/// would not do here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 27] = [
    ("lidar", 1693, 0xf488_a3a8_3ae7_9671),
    ("lidar", 93, 0x0c06_e4d1_3a48_4965),
    ("radar", 1693, 0x74ce_aee6_ae32_f0fe),
    ("gnss", 165, 0x7cb1_8955_eee3_e9c9),
    ("pose", 153, 0x1a28_7ec3_a345_732b),
    ("pose", 95, 0x1c9f_6b90_5d3f_66b6),
    ("boxes", 474, 0x7e07_4289_2d6f_68c5),
    ("points", 1754, 0xcc60_b299_9800_ad1b),
    ("descriptor", 204, 0xe518_cb94_bca5_db97),
    ("detections", 339, 0x4802_7df0_ddb6_6359),
    ("truth", 576, 0x71d1_dcd1_28eb_6b80),
    ("stats", 184, 0x0f1b_437b_fdb6_67e7),
    ("bev", 2487, 0x03fd_a1b8_0b86_af97),
    ("bev", 580, 0x7581_f54e_864b_cefa),
    ("bev", 1335, 0xa348_a6da_a19b_b45f),
    ("bev", 580, 0x7825_f469_225b_bd27),
    ("bev", 771, 0xb573_b37c_db9f_1c9e),
    ("bev", 583, 0x8370_8cae_502b_3d8b),
    ("control", 101, 0xe9d4_1a1d_ccea_491e),
    ("control", 93, 0xa46e_9842_2ee8_4ef7),
    ("control", 93, 0xa8bc_a2e1_fe50_fc82),
    ("control", 94, 0xbea4_f795_483b_0b4b),
    ("control", 94, 0x0b95_2318_2ffe_ff7e),
    ("control", 107, 0x8d89_b5f9_a114_7902),
    ("control", 116, 0x359b_1d3c_7d07_08c2),
    ("control", 93, 0xf2c0_5474_ca5f_a7d9),
    ("control", 105, 0x9001_148f_78f9_1ea2),
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
