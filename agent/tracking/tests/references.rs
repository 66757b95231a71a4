//! Metrics, assignment and filter against nuscenes-devkit, trackeval, motmetrics, SciPy and filterpy: the golden cases of
//! `tests/golden/tracking`.

use std::path::Path;

use nalgebra::{DMatrix, Matrix2, Matrix4, Vector2, Vector4};
use serde_json::Value;
use tracking::assignment;
use tracking::kalman::ConstantVelocity;
use tracking::metrics::{
    Amota, ClearMot, Hota, IdentityCounts, MATCH_DISTANCE_M, Sequence, TrackPoint, TrackedFrame,
    TruePoint,
};

const TOLERANCE: f64 = 1e-9;

fn golden(name: &str) -> Value {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/tracking");
    let text = std::fs::read_to_string(folder.join(name)).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    list(value)
        .iter()
        .map(|number| number.as_f64().unwrap())
        .collect()
}

fn sequence(frames: &Value) -> Sequence {
    let mut sequence = Sequence::default();
    for frame in list(frames) {
        let objects = list(&frame["truth"]).iter().map(|object| TruePoint {
            id: object[0].as_i64().unwrap(),
            center_m: [object[1].as_f64().unwrap(), object[2].as_f64().unwrap()],
        });
        let tracks = list(&frame["tracks"]).iter().map(|track| TrackPoint {
            id: track[0].as_u64().unwrap(),
            center_m: [track[1].as_f64().unwrap(), track[2].as_f64().unwrap()],
            score: track[3].as_f64().unwrap(),
        });
        let frame = TrackedFrame {
            objects: objects.collect(),
            tracks: tracks.collect(),
        };
        sequence.add(frame).unwrap();
    }
    sequence
}

/// Sequences and references of each case.
fn cases() -> Vec<(String, Vec<Sequence>, Value)> {
    let Value::Object(cases) = golden("metrics.json") else {
        panic!("metrics.json is no object");
    };
    let of_case = |(name, case): (String, Value)| {
        let sequences = list(&case["sequences"]).iter().map(sequence).collect();
        (name, sequences, case)
    };
    cases.into_iter().map(of_case).collect()
}

fn assert_equal(what: &str, ours: Option<f64>, reference: &Value) {
    match (ours, reference.as_f64()) {
        (Some(ours), Some(reference)) if (ours - reference).abs() <= TOLERANCE => {}
        (None, None) => {}
        (ours, reference) => panic!("{what}: {ours:?}, the reference has {reference:?}"),
    }
}

fn count(value: usize) -> Option<f64> {
    Some(value as f64)
}

#[test]
fn clear_mot_is_that_of_motmetrics() {
    for (name, sequences, case) in cases() {
        let ours = ClearMot::of(&sequences, MATCH_DISTANCE_M);
        for (field, ours) in [
            ("mota", ours.mota()),
            ("motp", ours.motp_m()),
            ("recall", ours.recall()),
            ("num_switches", count(ours.switches)),
            ("num_fragmentations", count(ours.fragmentations)),
            ("mostly_tracked", count(ours.mostly_tracked)),
            ("mostly_lost", count(ours.mostly_lost)),
            ("num_false_positives", count(ours.false_positives)),
            ("num_misses", count(ours.misses)),
            ("num_matches", count(ours.matches)),
        ] {
            assert_equal(
                &format!("{name}: {field}"),
                ours,
                &case["motmetrics"][field],
            );
        }
    }
}

#[test]
fn amota_is_that_of_the_nuscenes_devkit() {
    for (name, sequences, case) in cases() {
        let reference = &case["nuscenes"];
        let ours = Amota::of(&sequences);
        let check =
            |field: &str, ours| assert_equal(&format!("{name}: {field}"), ours, &reference[field]);
        check("amota", ours.as_ref().map(|ours| ours.amota));
        check("amotp", ours.as_ref().map(|ours| ours.amotp_m));
        let best = ours.and_then(|ours| ours.best);
        check("confidence", best.as_ref().map(|best| best.min_score));
        let counts = best.map(|best| best.counts);
        let of = |get: fn(&ClearMot) -> Option<f64>| counts.as_ref().and_then(get);
        // The devkit cuts MOTA at 0.
        check("mota", of(|counts| counts.mota().map(|mota| mota.max(0.0))));
        check("motp", of(ClearMot::motp_m));
        check("recall", of(ClearMot::recall));
        check("mt", of(|counts| count(counts.mostly_tracked)));
        check("ml", of(|counts| count(counts.mostly_lost)));
        check("fp", of(|counts| count(counts.false_positives)));
        check("fn", of(|counts| count(counts.misses)));
        check("ids", of(|counts| count(counts.switches)));
        check("frag", of(|counts| count(counts.fragmentations)));
        check("tp", of(|counts| count(counts.matches)));
    }
}

#[test]
fn hota_and_idf1_are_those_of_trackeval() {
    for (name, sequences, case) in cases() {
        let reference = &case["trackeval"];
        let ours = Hota::of(&sequences).unwrap();
        let idf1 = IdentityCounts::of(&sequences, MATCH_DISTANCE_M).f1();
        for (field, ours) in [
            ("hota", Some(ours.hota)),
            ("det_a", Some(ours.det_a)),
            ("ass_a", Some(ours.ass_a)),
            ("idf1", idf1),
        ] {
            assert_equal(&format!("{name}: {field}"), ours, &reference[field]);
        }
        assert_equal(
            &format!("{name}: motmetrics idf1"),
            idf1,
            &case["motmetrics"]["idf1"],
        );
    }
}

#[test]
fn totals_of_ten_thousand_assignments_are_those_of_scipy() {
    let reference = golden("assignments.json");
    let mut state = reference["seed"].as_u64().unwrap();
    let mut draw = |below: u64| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % below
    };
    let totals = numbers(&reference["totals"]);
    assert_eq!(totals.len(), 10_000);
    for (index, total) in totals.into_iter().enumerate() {
        let (rows, columns) = (draw(12) as usize + 1, draw(12) as usize + 1);
        let values: Vec<f64> = (0..rows * columns).map(|_| draw(10_000) as f64).collect();
        let costs = DMatrix::from_row_slice(rows, columns, &values);
        let pairs = assignment::of_lowest_cost(&costs);
        assert_eq!(pairs.len(), rows.min(columns));
        let ours: f64 = pairs.into_iter().map(|pair| costs[pair]).sum();
        assert_eq!(ours, total, "matrix {index}: {costs}");
    }
}

#[test]
fn the_filter_is_that_of_filterpy() {
    let reference = golden("filter.json");
    let vector = |value: &Value| Vector2::from_iterator(numbers(value));
    let matrix = |value: &Value| Matrix2::from_row_iterator(list(value).iter().flat_map(numbers));
    let number = |name: &str| reference[name].as_f64().unwrap();
    let mut filter = ConstantVelocity::at(
        vector(&reference["start"]),
        &matrix(&reference["start_noise"]),
        number("sigma_mps"),
    );
    for (index, step) in list(&reference["steps"]).iter().enumerate() {
        let noise = matrix(&step["noise"]);
        filter.predict(
            step["elapsed_s"].as_f64().unwrap(),
            number("acceleration_mps2"),
        );
        let innovation = filter
            .innovation(vector(&step["measured"]), &noise)
            .unwrap();
        filter.correct(&innovation, &noise);
        let distance = Some(innovation.mahalanobis_squared());
        assert_equal(
            &format!("step {index}"),
            distance,
            &step["mahalanobis_squared"],
        );
        let state = Vector4::from_iterator(numbers(&step["state"]));
        let covariance =
            Matrix4::from_row_iterator(list(&step["covariance"]).iter().flat_map(numbers));
        assert!((filter.state - state).amax() < TOLERANCE, "step {index}");
        assert!(
            (filter.covariance - covariance).amax() < TOLERANCE,
            "step {index}"
        );
    }
}
