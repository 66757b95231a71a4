//! Round trip of messages: every kind and every codec, from pieces of any size.

mod sample;

use bytes::Bytes;
use proptest::prelude::*;
use protocol::{
    Bev, BevFeatures, Body, CodecConfig, DecodedFeatures, DetectionsReport, Dtype, Limits, Message,
    TracksReport, WireError, encode_features, wire,
};
use sample::any::{any_map, any_message, any_stamp};

#[test]
fn every_kind_survives_the_wire() {
    let stamp = sample::stamp();
    for message in sample::every_kind() {
        let bytes = wire::encode_any(&stamp, message.clone()).unwrap().to_vec();
        for size in [1, 7, 64, 1 << 20] {
            let (header, back) = wire::decode_any(bytes.chunks(size), &Limits::DEFAULT).unwrap();
            assert_eq!((&header.stamp, header.kind), (&stamp, message.kind()));
            assert_eq!(back, message);
            assert_eq!(wire::decode_header(bytes.chunks(size)).unwrap(), header);
        }
    }
}

#[test]
fn a_dense_map_is_never_copied_on_its_way_out() {
    let features = sample::features();
    let address = features.values.as_ptr().cast::<u8>();
    let features = encode_features(features, &CodecConfig::default(), None).unwrap();
    let encoded = wire::encode(
        &sample::stamp(),
        Bev {
            pose: sample::pose(),
            features,
        },
    )
    .unwrap();
    let payload = Bytes::from_owner(encoded.body);
    assert_eq!(payload.as_ptr(), address);
    assert_eq!(payload.len(), 4 * 3 * 12 * 16);
}

#[test]
fn a_dense_map_is_moved_out_of_its_message() {
    let bytes = wire::encode(&sample::stamp(), sample::bev(&CodecConfig::default()))
        .unwrap()
        .to_vec();
    let (_, bev) = wire::decode::<Bev>([&bytes[..]], &Limits::DEFAULT).unwrap();
    let Body::Floats(values) = &bev.features.body else {
        panic!("a tensor")
    };
    let address = values.as_ptr();
    let decoded = bev.features.decode(&Limits::DEFAULT).unwrap();
    assert_eq!(decoded.features.values.as_ptr(), address);
    assert_eq!(
        decoded,
        DecodedFeatures {
            features: sample::features(),
            sent: None
        }
    );
}

#[test]
fn a_message_of_another_kind_is_refused() {
    let bytes = wire::encode(&sample::stamp(), sample::pose())
        .unwrap()
        .to_vec();
    let error = wire::decode::<Bev>([&bytes[..]], &Limits::DEFAULT).unwrap_err();
    assert!(matches!(error, WireError::Kind { .. }), "{error}");
}

#[test]
fn detections_json_is_stable() {
    let json = DetectionsReport::new(&sample::stamp(), Some(7), sample::detections()).to_json();
    let value: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(
        (&value["tick"], &value["agent_frame"]),
        (&7.into(), &3.into())
    );
    assert_eq!(value["ego"], "4279");
    assert_eq!(value["capture_nanos"], 1_500_000_000u64);
    assert_eq!(value["detections"][1]["score"], 1.0);
    assert_eq!(
        value["detections"][0]["box"]["center_m"],
        serde_json::json!([10.0, -3.5, 0.4])
    );
    assert_eq!(value["fused"][0]["cav"], "4288");
    assert_eq!(value["fused"][0]["age_nanos"], -5_000_000);
    assert_eq!(value["skipped"][1]["reason"], "stale");
    assert_eq!(value["pose"]["pose"]["confidence"], 0.875);
    let back: DetectionsReport = serde_json::from_str(&json).unwrap();
    assert_eq!((back.tick, back.result), (Some(7), sample::detections()));
}

#[test]
fn tracks_json_is_stable() {
    let json = TracksReport::new(&sample::stamp(), Some(7), sample::tracks()).to_json();
    let value: serde_json::Value = serde_json::from_str(&json).unwrap();
    let track = &value["tracks"][1];
    assert_eq!((&value["tick"], &value["left_out"]), (&7.into(), &2.into()));
    assert_eq!(
        (&track["id"], &track["unseen_s"]),
        (&7.into(), &0.25.into())
    );
    assert_eq!(track["velocity_mps"], serde_json::json!([8.5, -0.25]));
    assert_eq!(track["covariance"][0][2], 0.125);
    let back: TracksReport = serde_json::from_str(&json).unwrap();
    assert_eq!((back.tick, back.result), (Some(7), sample::tracks()));
}

/// Largest error of a value that was sent, given the largest value of its channel among those sent.
fn error_bound(dtype: Dtype, value: f32, largest: f32) -> f32 {
    match dtype {
        Dtype::F32 => 0.0,
        Dtype::F16 => (value.abs() * 2f32.powi(-11)).max(2f32.powi(-25)),
        Dtype::I8 => largest / 127.0 * 0.5 + largest * 1e-6,
    }
}

fn check_channel(
    dtype: Dtype,
    before: &[f32],
    after: &[f32],
    sent: &[bool],
) -> Result<(), TestCaseError> {
    let sent_values = before
        .iter()
        .zip(sent)
        .filter(|(_, sent)| **sent)
        .map(|(value, _)| value.abs());
    let largest = sent_values.fold(0f32, f32::max);
    for ((before, after), sent) in before.iter().zip(after).zip(sent) {
        let (expected, bound) = if *sent {
            (*before, error_bound(dtype, *before, largest))
        } else {
            (0.0, 0.0)
        };
        prop_assert!(
            (expected - after).abs() <= bound,
            "{before} came back as {after}, sent: {sent}"
        );
    }
    Ok(())
}

proptest! {
    #[test]
    fn any_message_survives_the_wire(message in any_message(), stamp in any_stamp(), size in 1..5000usize) {
        let bytes = wire::encode_any(&stamp, message.clone()).unwrap().to_vec();
        let (header, back) = wire::decode_any(bytes.chunks(size), &Limits::DEFAULT).unwrap();
        prop_assert_eq!(header.stamp, stamp);
        prop_assert_eq!(&back, &message);
        if let Message::Bev(bev) = back {
            bev.features.decode(&Limits::DEFAULT).unwrap();
        }
    }

    #[test]
    fn any_map_survives_its_codec((features, confidence, config) in any_map()) {
        let BevFeatures { grid, channels, code_of, values } = features.clone();
        let encoded = encode_features(features, &config, Some(&confidence)).unwrap();
        if let Some(budget) = config.budget_bytes {
            prop_assert!(encoded.body.len() as u64 <= budget);
        }
        let DecodedFeatures { features: back, sent } = encoded.decode(&Limits::DEFAULT).unwrap();
        prop_assert_eq!((back.grid, back.channels, back.code_of), (grid, channels, code_of));

        let cells = grid.cells();
        let sent = sent.unwrap_or_else(|| vec![true; cells]);
        let least_sent = (0..cells).filter(|cell| sent[*cell]).map(|cell| confidence[cell]).fold(1.0, f32::min);
        let most_kept = (0..cells).filter(|cell| !sent[*cell]).map(|cell| confidence[cell]).fold(0.0, f32::max);
        // A smoothing window selects cells by their surroundings.
        let is_smoothed = config.gate.is_some_and(|gate| gate.smoothing.is_some());
        prop_assert!(is_smoothed || most_kept <= least_sent);
        for (before, after) in values.chunks(cells).zip(back.values.chunks(cells)) {
            check_channel(config.dtype, before, after, &sent)?;
        }
    }

    #[test]
    fn encoding_is_deterministic((features, confidence, config) in any_map()) {
        let once = encode_features(features.clone(), &config, Some(&confidence)).unwrap();
        prop_assert_eq!(encode_features(features, &config, Some(&confidence)).unwrap(), once);
    }
}
