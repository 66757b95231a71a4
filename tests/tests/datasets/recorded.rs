//! Readers on recorded sweeps of other projects, against the values in their notes; and a localizer on one of them.

use std::collections::HashSet;
use std::path::Path;

use dataset::evaluation_protocol::ProtocolConfig;
use dataset::frame::{Frame, Object, ObjectClass};
use dataset::ground_truth::{self, GroundTruthRule};
use dataset::pcd;
use dataset::{self, Dataset, Layout, LoadOptions, OpenOptions};
use localization::pgc::{Localize, Localizer, LocalizerInput};
use perception::inference::Inference;
use sim_replay::inspect::{TickReport, inspect};
use tests::fixtures::data;

fn open(name: &str) -> Dataset {
    let dataset = dataset::open(&data(name)).unwrap_or_else(|error| panic!("{error}"));
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    dataset
}

fn v2xset_frames() -> [Frame; 2] {
    let dataset = open("v2xset-scene");
    let scenario = &dataset.scenarios[0];
    [0, 1].map(|agent| {
        scenario
            .load(agent, 0, &LoadOptions::default())
            .unwrap_or_else(|error| panic!("{error}"))
    })
}

#[test]
#[ignore = "needs V2V_DATA"]
fn v2xset_scene_is_found_at_every_level() {
    let dir = data("v2xset-scene");
    for below in ["", "validate", "validate/2021_08_21_17_30_41"] {
        let dataset = dataset::open(&dir.join(below)).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!(
            (dataset.layout, dataset.scenarios.len()),
            (Layout::OPV2V, 1)
        );
        assert_eq!(
            scenario
                .agents
                .iter()
                .map(|id| id.as_str())
                .collect::<Vec<_>>(),
            ["4279", "4288"]
        );
        assert_eq!(
            scenario
                .ticks
                .iter()
                .map(|tick| tick.stem.as_str())
                .collect::<Vec<_>>(),
            ["000069"]
        );
        // 69 ticks of 0.05 s, as in the protocol of the recording.
        assert_eq!(scenario.ticks[0].capture_nanos, 3_450_000_000);
        assert!(
            scenario.name.ends_with("2021_08_21_17_30_41"),
            "{}",
            scenario.name
        );
    }
    let error = dataset::open(&dir.join("validate/2021_08_21_17_30_41/4279")).unwrap_err();
    assert!(
        error.to_string().contains("open the scenario above it"),
        "{error}"
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn v2xset_ground_truth_is_21_boxes_ego_only_and_26_together() {
    let [ego, partner] = v2xset_frames();
    let ego_only = ground_truth::merged_objects(&[&ego], 0, &GroundTruthRule::OPV2V);
    let together = ground_truth::merged_objects(&[&ego, &partner], 0, &GroundTruthRule::OPV2V);
    assert_eq!((ego_only.len(), together.len()), (21, 26));
    let lists_ego =
        |merged: &[(&Object, protocol::Box3d)]| merged.iter().any(|(one, _)| one.id == 4279);
    assert!(
        !lists_ego(&ego_only) && lists_ego(&together),
        "4288 lists the ego, the ego never lists itself"
    );
    assert_eq!((ego.objects.len(), partner.objects.len()), (21, 22));
    let ego_box = together.iter().find(|(one, _)| one.id == 4279).unwrap().1;
    assert!(
        ego_box.center_m[0].hypot(ego_box.center_m[1]) < 1.0,
        "{ego_box:?}"
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn v2xset_sweeps_have_their_points_and_intensities() {
    let frames = v2xset_frames();
    for (frame, points) in frames.iter().zip([39_719, 39_833]) {
        assert_eq!((frame.points.len(), frame.dropped_points), (points, 0));
        for &[x, y, z, intensity] in &frame.points.xyzi {
            assert!((158.0 / 255.0..=253.0 / 255.0).contains(&intensity));
            // CARLA's attenuation: intensity is a function of the range, and of nothing else.
            let range = x.hypot(y).hypot(z);
            assert!(
                (intensity - (-0.004 * range).exp()).abs() < 0.0025,
                "{intensity} at {range} m"
            );
        }
    }
}

#[test]
#[ignore = "needs V2V_DATA"]
fn v2xset_poses_are_47_metres_apart_and_gnss_is_near() {
    let [ego, partner] = v2xset_frames();
    let position = |frame: &Frame| frame.world_from_lidar.unwrap().translation_m;
    let ([ax, ay, _], [bx, by, _]) = (position(&ego), position(&partner));
    assert!(((ax - bx).hypot(ay - by) - 46.97).abs() < 0.005);
    for frame in [&ego, &partner] {
        let mount = frame
            .world_from_vehicle
            .unwrap()
            .from_world(&frame.world_from_lidar.unwrap());
        let [x, y, z] = mount.translation_m;
        assert!(
            (x + 0.5).abs() < 0.01 && y.abs() < 0.01 && (z - 1.9).abs() < 0.01,
            "{mount:?}"
        );
        let off = frame
            .world_from_lidar
            .unwrap()
            .from_world(&frame.gnss_world_from_lidar().unwrap());
        assert!(
            off.translation_m[0].hypot(off.translation_m[1]) < 1.5 && off.yaw_rad().abs() < 0.02,
            "{off:?}"
        );
        assert!(frame.speed_mps.unwrap().abs() < 20.0);
    }
}

/// Number of a frame's points in an object's box.
fn points_inside(frame: &Frame, object: &Object) -> usize {
    let object_from_lidar =
        object.world_from_object.isometry().inverse() * frame.world_from_lidar.unwrap().isometry();
    let half = object.size_m.map(|size| size / 2.0);
    let inside = |point: &&[f32; 4]| {
        let [x, y, z, _] = point.map(f64::from);
        let local = object_from_lidar * nalgebra::Point3::new(x, y, z);
        (0..3).all(|axis| local[axis].abs() <= half[axis])
    };
    frame.points.xyzi.iter().filter(inside).count()
}

#[test]
#[ignore = "needs V2V_DATA"]
fn every_box_of_v2xset_holds_points_of_its_own_agent() {
    let frames = v2xset_frames();
    for frame in &frames {
        for object in &frame.objects {
            assert!(
                points_inside(frame, object) > 0,
                "object {} of {}",
                object.id,
                frame.cav
            );
        }
    }
}

fn load_all(dataset: &Dataset, scenario: usize) -> Vec<Frame> {
    let scenario = &dataset.scenarios[scenario];
    let load = |tick| {
        scenario
            .load(0, tick, &LoadOptions::default())
            .unwrap_or_else(|error| panic!("{error}"))
    };
    (0..scenario.ticks.len()).map(load).collect()
}

/// Share of the 0.2 m voxels above z = -1 m that `from` fills and `other`, moved by `from_other`, fills as well.
fn voxel_overlap(from: &Frame, other: &Frame, from_other: &nalgebra::Isometry3<f64>) -> f64 {
    let voxels = |frame: &Frame, moved: &nalgebra::Isometry3<f64>| -> HashSet<[i64; 3]> {
        let points = frame.points.xyzi.iter().map(|&[x, y, z, _]| {
            moved * nalgebra::Point3::new(f64::from(x), f64::from(y), f64::from(z))
        });
        points
            .filter(|point| point.z > -1.0)
            .map(|p| [p.x, p.y, p.z].map(|v| (v / 0.2).floor() as i64))
            .collect()
    };
    let (first, second) = (
        voxels(from, &nalgebra::Isometry3::identity()),
        voxels(other, from_other),
    );
    first.intersection(&second).count() as f64 / first.len() as f64
}

#[test]
#[ignore = "needs V2V_DATA"]
fn kitti_odometry_motion_and_overlap_are_those_of_the_data() {
    let dataset = open("kitti-odometry-00");
    assert_eq!(
        (dataset.layout, dataset.scenarios.len()),
        (Layout::KITTI_ODOMETRY, 1)
    );
    let frames = load_all(&dataset, 0);
    assert_eq!(
        frames
            .iter()
            .map(|frame| frame.points.len())
            .collect::<Vec<_>>(),
        [124_668, 124_605, 121_618, 121_671]
    );
    let expected = [
        ([0.859, 0.047, 0.022], 0.40, 0.19),
        ([0.474, -0.015, 0.009], 0.68, 0.15),
    ];
    for (pair, (motion, aligned, unaligned)) in frames.as_chunks::<2>().0.iter().zip(expected) {
        let [first, second] = pair;
        let from_second = first
            .world_from_lidar
            .unwrap()
            .from_world(&second.world_from_lidar.unwrap());
        for (moved, expected) in from_second.translation_m.iter().zip(motion) {
            assert!(
                (moved - expected).abs() < 6e-4,
                "{from_second:?}, expected {motion:?}"
            );
        }
        let with_pose = voxel_overlap(first, second, &from_second.isometry());
        let without = voxel_overlap(first, second, &nalgebra::Isometry3::identity());
        assert!(
            (with_pose - aligned).abs() < 0.01 && (without - unaligned).abs() < 0.01,
            "{with_pose} {without}"
        );
    }
}

#[test]
#[ignore = "needs V2V_DATA"]
fn kitti_object_boxes_hold_the_points_that_were_counted() {
    let dataset = open("kitti-object");
    assert_eq!(
        (dataset.layout, dataset.scenarios[0].name.as_str()),
        (Layout::KITTI_OBJECT, "training")
    );
    let frames = load_all(&dataset, 0);
    assert_eq!(
        frames
            .iter()
            .map(|frame| frame.points.len())
            .collect::<Vec<_>>(),
        [115_384, 120_268]
    );
    let counted: Vec<Vec<(ObjectClass, usize)>> = frames
        .iter()
        .map(|frame| {
            frame
                .objects
                .iter()
                .map(|object| (object.class, points_inside(frame, object)))
                .collect()
        })
        .collect();
    let expected = [
        vec![(ObjectClass::Pedestrian, 376)],
        vec![
            (ObjectClass::Truck, 70),
            (ObjectClass::Car, 9),
            (ObjectClass::TwoWheeler, 18),
        ],
    ];
    assert_eq!(counted, expected);
}

#[test]
#[ignore = "needs V2V_DATA"]
fn nclt_raw_scan_is_turned_to_z_up() {
    let dataset = open("nclt");
    assert_eq!(
        (dataset.layout, dataset.scenarios[0].name.as_str()),
        (Layout::NCLT, "2012-01-15")
    );
    let frame = &load_all(&dataset, 0)[0];
    assert_eq!(
        (frame.points.len(), frame.capture_nanos),
        (23_546, 1_326_652_795_280_148_000)
    );
    let span = |component: usize| {
        let values = frame.points.xyzi.iter().map(|point| point[component]);
        let (low, high) = (
            values.clone().fold(f32::INFINITY, f32::min),
            values.fold(f32::NEG_INFINITY, f32::max),
        );
        [low, high]
    };
    // The file has x -61.5..80.3, y -68.3..57.3, z -18.3..2.7 (down) and intensities 55..255.
    let expected = [
        [-61.5, 80.3],
        [-57.3, 68.3],
        [-2.7, 18.3],
        [55.0 / 255.0, 1.0],
    ];
    for (component, [low, high]) in expected.into_iter().enumerate() {
        let [found_low, found_high] = span(component);
        assert!(
            (found_low - low).abs() < 0.06 && (found_high - high).abs() < 0.06,
            "{component}: {found_low} {found_high}"
        );
    }
}

#[test]
#[ignore = "needs V2V_DATA"]
fn binary_pcd_pair_overlaps_by_its_relative_pose() {
    let dir = data("fast_gicp-pair");
    let read = |name: &str| {
        pcd::decode(&std::fs::read(dir.join(name)).unwrap())
            .unwrap_or_else(|error| panic!("{error}"))
    };
    let clouds = ["251370668.pcd", "251371071.pcd"].map(read);
    assert_eq!(
        clouds
            .each_ref()
            .map(|cloud| cloud.points.len() + cloud.dropped),
        [69_088, 69_792]
    );
    let highest = clouds[0]
        .points
        .xyzi
        .iter()
        .map(|point| point[3])
        .fold(0.0, f32::max);
    assert!(
        (0.0..=255.0).contains(&highest) && highest > 1.0,
        "intensity is as stored: {highest}"
    );

    let text = std::fs::read_to_string(dir.join("relative.txt")).unwrap();
    let numbers: Vec<f64> = text
        .split_whitespace()
        .map(|number| number.parse().unwrap())
        .collect();
    let first_from_second =
        protocol::Pose::from_matrix(&nalgebra::Matrix4::from_row_slice(&numbers))
            .unwrap()
            .isometry();
    let voxels = |cloud: &pcd::PcdCloud, moved: &nalgebra::Isometry3<f64>| -> HashSet<[i64; 3]> {
        let move_point = |&[x, y, z, _]: &[f32; 4]| {
            moved * nalgebra::Point3::new(f64::from(x), f64::from(y), f64::from(z))
        };
        cloud
            .points
            .xyzi
            .iter()
            .map(move_point)
            .map(|p| [p.x, p.y, p.z].map(|v| (v / 0.2).floor() as i64))
            .collect()
    };
    let still = voxels(&clouds[0], &nalgebra::Isometry3::identity());
    let overlap =
        |moved: &nalgebra::Isometry3<f64>| still.intersection(&voxels(&clouds[1], moved)).count();
    let counts = [
        first_from_second,
        nalgebra::Isometry3::identity(),
        first_from_second.inverse(),
    ]
    .map(|moved| overlap(&moved));
    // Rounding at voxel borders may differ by a few.
    for (found, expected) in counts.into_iter().zip([3_977usize, 2_510, 1_615]) {
        assert!(found.abs_diff(expected) <= 20, "{counts:?}");
    }
}

#[test]
#[ignore = "needs V2V_DATA"]
fn inspect_counts_21_and_26_and_finds_nothing_wrong() {
    let dir = data("v2xset-scene");
    let report = inspect(
        &dir,
        &OpenOptions::default(),
        &ProtocolConfig::default(),
        &|_, _| {},
    );
    assert!(report.problems.is_empty(), "{:?}", report.problems);
    let merged = |agents: &[&str]| {
        let of_agents = |tick: &&TickReport| {
            tick.agents
                .iter()
                .map(|id| id.as_str())
                .eq(agents.iter().copied())
        };
        report
            .ticks
            .iter()
            .find(of_agents)
            .map(|tick| (tick.ego.as_str(), tick.stem.as_str(), tick.merged_boxes))
    };
    assert_eq!(merged(&["4279"]), Some(("4279", "000069", 21)));
    assert_eq!(merged(&["4279", "4288"]), Some(("4279", "000069", 26)));
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["ticks"][1]["merged_boxes"], 26);
    assert_eq!(json["scenarios"][0]["agents"][0]["boxes_without_points"], 0);
}

#[test]
#[ignore = "needs V2V_DATA"]
fn a_real_sweep_passes_through_the_shipped_networks_and_is_placed_nowhere() {
    let dataset = open("nclt");
    tch::set_num_threads(1);
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/weights");
    let [encoder, head] =
        ["pgc-encoder", "pgc-town1"].map(|name| weights.join(format!("{name}.safetensors")));
    let mut localizer = Localizer::load(&encoder, &head, Inference::default()).unwrap();
    let frame = dataset.scenarios[0]
        .load(0, 0, &LoadOptions::default())
        .unwrap();
    let (coordinates, _) = localizer
        .scene_coordinates(LocalizerInput::of(&frame.points))
        .unwrap();
    assert!(
        coordinates.sensor_m.len() > 100,
        "{} cells",
        coordinates.sensor_m.len()
    );
    assert!(
        coordinates
            .world_m
            .iter()
            .flatten()
            .chain(&coordinates.epsilon_m)
            .all(|number| number.is_finite())
    );
    // Recorded in another town than that of the head.
    let estimate = localizer
        .localize(LocalizerInput::of(&frame.points))
        .unwrap()
        .estimate;
    assert!(estimate.confidence() < 0.1, "{estimate:?}");
}
