//! One scene in every layout: the same poses, points and boxes.
//!
//! Layouts with a reader in `dataset` are read by it. The others are read by a few lines here that follow the
//! description of the format and share nothing with the writers.

mod dair;
mod family;
mod interruption;
mod nuscenes;
mod single;
mod v2xreal;

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use protocol::{Box3d, Pose};
use serde_json::Value;

use super::SceneLayout;
use crate::generate::{Subset, Summary, SynthOptions, generate};
use dataset::frame::{Frame, Object};
use dataset::ground_truth::upright_box;
use dataset::{self, Dataset, LoadOptions};

/// Two scenes of two agents at two capture times.
fn options(layout: SceneLayout, out: &Path) -> SynthOptions {
    let options = SynthOptions::new(Subset::V2vdet, 7, out.to_owned());
    SynthOptions {
        layout,
        scenes: 2,
        frames: 2,
        agents: 2..=2,
        ..options
    }
}

fn write(layout: SceneLayout, out: &Path) -> Summary {
    generate(&options(layout, out), &|_| {}).unwrap()
}

/// Content of a data set at one capture time.
#[derive(Debug, Clone, Default)]
struct Tick {
    /// `world_from_lidar` of each agent, ego first.
    poses: Vec<Isometry3<f64>>,
    clouds: Vec<Vec<[f32; 4]>>,
    /// All objects listed by any agent, upright in the frame of the ego's LiDAR.
    boxes: Vec<Box3d>,
}

/// Frames of one capture time, ego first.
fn tick_of(frames: &[Frame]) -> Tick {
    let poses: Vec<_> = frames
        .iter()
        .map(|frame| frame.world_from_lidar.unwrap().isometry())
        .collect();
    let ego_from_world = poses[0].inverse();
    let mut seen = std::collections::HashSet::new();
    let objects = frames
        .iter()
        .flat_map(|frame| &frame.objects)
        .filter(|object| seen.insert(object.id));
    Tick {
        boxes: objects
            .map(|object| upright_box(object, &ego_from_world))
            .collect(),
        clouds: frames
            .iter()
            .map(|frame| frame.points.xyzi.clone())
            .collect(),
        poses,
    }
}

/// All capture times of all scenarios in order, as read.
fn ticks(dataset: &Dataset) -> Vec<Tick> {
    let mut ticks = Vec::new();
    for scenario in &dataset.scenarios {
        for tick in 0..scenario.ticks.len() {
            let load = |agent: usize| scenario.load(agent, tick, &LoadOptions::default()).unwrap();
            ticks.push(tick_of(
                &(0..scenario.agents.len()).map(load).collect::<Vec<_>>(),
            ));
        }
    }
    ticks
}

fn open(path: &Path) -> Dataset {
    let dataset = dataset::open(path).unwrap();
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    dataset
}

/// The scenes in the layout of OPV2V.
fn expected() -> Vec<Tick> {
    let folder = tempfile::tempdir().unwrap();
    write(SceneLayout::Opv2v, folder.path());
    let ticks = ticks(&open(folder.path()));
    assert_eq!(ticks.len(), 4);
    assert!(
        ticks
            .iter()
            .all(|tick| tick.poses.len() == 2 && tick.boxes.len() > 3),
        "{ticks:?}"
    );
    ticks
}

/// Poses to a nanometre, points bit by bit but for intensities that a factor of 255 rounds, boxes to a micrometre.
fn assert_same(ticks: &[Tick], expected: &[Tick], layout: SceneLayout) {
    assert_eq!(ticks.len(), expected.len(), "{layout:?}");
    for (tick, expected) in ticks.iter().zip(expected) {
        assert_eq!(tick.poses.len(), expected.poses.len(), "{layout:?}");
        for (pose, expected) in tick.poses.iter().zip(&expected.poses) {
            assert_same_pose(pose, expected, layout);
        }
        for (cloud, expected) in tick.clouds.iter().zip(&expected.clouds) {
            assert_same_points(cloud, expected, layout);
        }
        assert_same_boxes(&tick.boxes, &expected.boxes, layout);
    }
}

fn assert_same_pose(pose: &Isometry3<f64>, expected: &Isometry3<f64>, layout: SceneLayout) {
    let distance = (pose.translation.vector - expected.translation.vector).norm();
    // Maps are some hundred metres wide, where the last bit of a double is 1e-13 m.
    assert!(
        distance < 1e-9 && pose.rotation.angle_to(&expected.rotation) < 1e-7,
        "{layout:?}: {distance}"
    );
}

fn assert_same_points(cloud: &[[f32; 4]], expected: &[[f32; 4]], layout: SceneLayout) {
    assert!(
        cloud.len() == expected.len() && !cloud.is_empty(),
        "{layout:?}: {} {}",
        cloud.len(),
        expected.len()
    );
    for ([x, y, z, i], [ex, ey, ez, expected]) in cloud.iter().zip(expected) {
        assert_eq!([x, y, z], [ex, ey, ez], "{layout:?}");
        let one_step = *i == *expected || *i == expected.next_up() || *i == expected.next_down();
        assert!(one_step, "{layout:?}: intensity {i}, not {expected}");
    }
}

fn assert_same_boxes(boxes: &[Box3d], expected: &[Box3d], layout: SceneLayout) {
    assert_eq!(boxes.len(), expected.len(), "{layout:?}");
    let distance = |a: &Box3d, b: &Box3d| {
        (0..3)
            .map(|axis| (a.center_m[axis] - b.center_m[axis]).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    for expected in expected {
        let nearest = boxes
            .iter()
            .min_by(|a, b| distance(a, expected).total_cmp(&distance(b, expected)))
            .unwrap();
        let turn = ((nearest.heading_rad - expected.heading_rad) / 2.0)
            .sin()
            .abs();
        let sizes = (0..3)
            .map(|axis| (nearest.size_m[axis] - expected.size_m[axis]).abs())
            .fold(0.0, f64::max);
        assert!(
            distance(nearest, expected) < 1e-6 && turn < 1e-6 && sizes < 1e-6,
            "{layout:?}: {nearest:?} {expected:?}"
        );
    }
}

fn json(path: &Path) -> Value {
    let text =
        std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap()
}

/// Nested lists of numbers, one after another.
fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(items) => items.iter().flat_map(numbers).collect(),
        value => vec![
            value
                .as_f64()
                .unwrap_or_else(|| panic!("{value} is no number")),
        ],
    }
}

/// A pose from 9 numbers of a rotation by rows and 3 of a translation.
fn from_rows(rotation: &[f64], translation: &[f64]) -> Isometry3<f64> {
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(rotation));
    let translation = Translation3::new(translation[0], translation[1], translation[2]);
    Isometry3::from_parts(translation, UnitQuaternion::from_rotation_matrix(&rotation))
}

/// An object without a name of its own.
fn object(id: i64, world_from_object: Isometry3<f64>, size_m: [f64; 3]) -> Object {
    let class = dataset::frame::ObjectClass::Car;
    Object {
        id,
        class,
        world_from_object: Pose::from(world_from_object),
        size_m,
        speed_mps: None,
    }
}

/// Rows of `N` floats.
fn floats<const N: usize>(path: &Path) -> Vec<[f32; N]> {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let (numbers, rest) = bytes.as_chunks::<4>();
    assert!(rest.is_empty());
    let numbers: Vec<f32> = numbers
        .iter()
        .map(|number| f32::from_le_bytes(*number))
        .collect();
    let (rows, rest) = numbers.as_chunks::<N>();
    assert!(rest.is_empty());
    rows.to_vec()
}
