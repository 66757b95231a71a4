//! The readers on recorded data that nobody here made. What is expected stands in the data's own notes.

use sim_replay::dataset::{self, Dataset, Layout, LoadOptions};
use sim_replay::frame::Frame;
use sim_replay::ground_truth::{self, GroundTruthRule};
use tests::fixtures::data;

fn open(name: &str) -> Option<Dataset> {
    let dir = data(name)?;
    let dataset = dataset::open(&dir).unwrap_or_else(|error| panic!("{error}"));
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    Some(dataset)
}

fn v2xset_frames() -> Option<[Frame; 2]> {
    let dataset = open("v2xset-scene")?;
    let scenario = &dataset.scenarios[0];
    Some([0, 1].map(|agent| scenario.load(agent, 0, &LoadOptions::default()).unwrap_or_else(|error| panic!("{error}"))))
}

#[test]
fn v2xset_scene_is_found_at_every_level() {
    let Some(dir) = data("v2xset-scene") else { return };
    for below in ["", "validate", "validate/2021_08_21_17_30_41"] {
        let dataset = dataset::open(&dir.join(below)).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!((dataset.layout, dataset.scenarios.len()), (Layout::Opv2v, 1));
        assert_eq!(scenario.agents.iter().map(|id| id.as_str()).collect::<Vec<_>>(), ["4279", "4288"]);
        assert_eq!(scenario.ticks.iter().map(|tick| tick.stem.as_str()).collect::<Vec<_>>(), ["000069"]);
        // 69 ticks of 0.05 s, as the protocol of the recording says.
        assert_eq!(scenario.ticks[0].capture_nanos, 3_450_000_000);
        assert!(scenario.name.ends_with("2021_08_21_17_30_41"), "{}", scenario.name);
    }
    let error = dataset::open(&dir.join("validate/2021_08_21_17_30_41/4279")).unwrap_err();
    assert!(error.to_string().contains("open the scenario above it"), "{error}");
}

#[test]
fn v2xset_ground_truth_is_21_boxes_alone_and_26_together() {
    let Some([ego, partner]) = v2xset_frames() else { return };
    let alone = ground_truth::merge(&[&ego], 0, &GroundTruthRule::OPV2V);
    let together = ground_truth::merge(&[&ego, &partner], 0, &GroundTruthRule::OPV2V);
    assert_eq!((alone.len(), together.len()), (21, 26));
    let lists_ego = |merged: &[(i64, protocol::Box3d)]| merged.iter().any(|(id, _)| *id == 4279);
    assert!(!lists_ego(&alone) && lists_ego(&together), "4288 lists the ego, the ego never lists itself");
    assert_eq!((ego.objects.len(), partner.objects.len()), (21, 22));
    let ego_box = together.iter().find(|(id, _)| *id == 4279).unwrap().1;
    assert!(ego_box.center_m[0].hypot(ego_box.center_m[1]) < 1.0, "{ego_box:?}");
}

#[test]
fn v2xset_sweeps_have_their_points_and_intensities() {
    let Some(frames) = v2xset_frames() else { return };
    for (frame, points) in frames.iter().zip([39_719, 39_833]) {
        assert_eq!((frame.points.len(), frame.dropped_points), (points, 0));
        for &[x, y, z, intensity] in &frame.points.xyzi {
            assert!((158.0 / 255.0..=253.0 / 255.0).contains(&intensity));
            // CARLA's attenuation: intensity says how far the point is, and nothing else.
            let range = x.hypot(y).hypot(z);
            assert!((intensity - (-0.004 * range).exp()).abs() < 0.0025, "{intensity} at {range} m");
        }
    }
}

#[test]
fn v2xset_poses_are_47_metres_apart_and_gnss_is_near() {
    let Some([ego, partner]) = v2xset_frames() else { return };
    let position = |frame: &Frame| frame.world_from_lidar.unwrap().translation_m;
    let ([ax, ay, _], [bx, by, _]) = (position(&ego), position(&partner));
    assert!(((ax - bx).hypot(ay - by) - 46.97).abs() < 0.005);
    for frame in [&ego, &partner] {
        let mount = frame.world_from_vehicle.unwrap().from_world(&frame.world_from_lidar.unwrap());
        let [x, y, z] = mount.translation_m;
        assert!((x + 0.5).abs() < 0.01 && y.abs() < 0.01 && (z - 1.9).abs() < 0.01, "{mount:?}");
        let off = frame.world_from_lidar.unwrap().from_world(&frame.gnss_world_from_lidar().unwrap());
        assert!(off.translation_m[0].hypot(off.translation_m[1]) < 1.5 && off.yaw_rad().abs() < 0.02, "{off:?}");
        assert!(frame.speed_mps.unwrap().abs() < 20.0);
    }
}

/// How many of a frame's points lie in an object's box.
fn points_inside(frame: &Frame, object: &sim_replay::frame::Object) -> usize {
    let object_from_lidar = object.world_from_object.isometry().inverse() * frame.world_from_lidar.unwrap().isometry();
    let half = object.size_m.map(|size| size / 2.0);
    let inside = |point: &&[f32; 4]| {
        let [x, y, z, _] = point.map(f64::from);
        let local = object_from_lidar * nalgebra::Point3::new(x, y, z);
        (0..3).all(|axis| local[axis].abs() <= half[axis])
    };
    frame.points.xyzi.iter().filter(inside).count()
}

#[test]
fn every_box_of_v2xset_holds_points_of_its_own_agent() {
    let Some(frames) = v2xset_frames() else { return };
    for frame in &frames {
        for object in &frame.objects {
            assert!(points_inside(frame, object) > 0, "object {} of {}", object.id, frame.cav);
        }
    }
}
