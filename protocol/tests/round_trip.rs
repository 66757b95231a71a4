//! Quick sanity of every kind; the thorough tests follow.

mod sample;

use protocol::{Limits, wire};

#[test]
fn every_kind_survives_the_wire() {
    let stamp = sample::stamp();
    for message in sample::every_kind() {
        let encoded = wire::encode_any(&stamp, message.clone()).unwrap();
        for size in [1, 7, 64, 1 << 20] {
            let bytes = encoded.to_vec();
            let (header, back) = wire::decode_any(bytes.chunks(size), &Limits::DEFAULT).unwrap();
            assert_eq!(header.stamp, stamp);
            assert_eq!(header.kind, message.kind());
            assert_eq!(back, message);
        }
    }
}
