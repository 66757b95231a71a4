//! The bytes of every message, pinned: whoever changes one must raise `WIRE_VERSION` and pin the new ones.

mod sample;

use protocol::{HEADER_LEN, Message, Packing, wire};

/// Kind, length and FNV-1a of each sample in turn. Maps packed by zstd are left out: their bytes are zstd's affair. (A CRC
/// would not do here: over data that end in their own CRC it is constant.)
const PINNED: [(&str, usize, u64); 28] = [
    ("lidar", 1693, 0xded6_6114_d8bb_c4bc),
    ("lidar", 93, 0xfa39_d079_92bb_7b30),
    ("radar", 1693, 0xe0f4_5900_7f85_e60b),
    ("gnss", 165, 0xffa2_a701_238b_10f4),
    ("pose", 153, 0xb858_2d67_af55_1672),
    ("pose", 95, 0x30e6_1037_688c_bcef),
    ("boxes", 474, 0x51fb_4142_324d_bc3a),
    ("points", 1754, 0xf5fe_d380_a6b7_f720),
    ("descriptor", 204, 0x0b86_3d4e_daa4_a590),
    ("detections", 339, 0x8df6_0994_f172_c308),
    ("truth", 576, 0xbf53_d861_7d07_c603),
    ("stats", 188, 0x74df_20e6_2f15_219b),
    ("bev", 2488, 0x2e35_81d7_e0ea_facf),
    ("bev", 581, 0x7f8b_9424_ec55_2893),
    ("bev", 1336, 0x50b2_2138_c206_6c1b),
    ("bev", 581, 0x6805_7c49_94dd_4658),
    ("bev", 772, 0xe7fe_27e5_bfe7_7703),
    ("bev", 584, 0x0584_e516_b695_e5b3),
    ("bev", 531, 0xd0c8_5a0f_a439_7486),
    ("control", 101, 0x726e_129e_9fd9_d4f7),
    ("control", 93, 0x84e7_45bb_638b_7fea),
    ("control", 93, 0x8c16_324e_3a66_c70b),
    ("control", 94, 0x866a_852e_1963_af18),
    ("control", 94, 0xb0e1_f9a0_6bb9_a381),
    ("control", 107, 0xbdeb_c644_46fe_475f),
    ("control", 116, 0xacae_e79a_745a_ecd5),
    ("control", 93, 0x7803_e3e4_7ec5_b0d0),
    ("control", 105, 0x5f4f_c21f_1455_2d73),
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
