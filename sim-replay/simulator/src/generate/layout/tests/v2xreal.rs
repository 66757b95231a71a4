//! V2X-Real, read according to the description of its files.

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use serde_json::Value;

use super::{Tick, assert_same, expected, floats, numbers, object, write};
use crate::generate::SceneLayout;
use dataset::carla_pose::CarlaPose;
use dataset::ground_truth::upright_box;

fn sorted(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    paths.sort();
    paths
}

/// Six numbers in right-handed axes.
fn pose(numbers: &[f64]) -> Isometry3<f64> {
    let six: [f64; 6] = numbers.try_into().unwrap();
    let matrix = CarlaPose::from(six).left_handed_matrix();
    protocol::Pose::from_matrix(&matrix).unwrap().isometry()
}

fn tick(yamls: &[PathBuf]) -> Tick {
    let (mut tick, mut objects) = (Tick::default(), std::collections::BTreeMap::new());
    for path in yamls {
        let frame: Value = serde_saphyr::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        tick.poses.push(pose(&numbers(&frame["lidar_pose"])));
        tick.clouds.push(floats::<4>(&path.with_extension("bin")));
        for (id, vehicle) in frame["vehicles"].as_object().unwrap() {
            let [location, center, angle, extent] =
                ["location", "center", "angle", "extent"].map(|key| numbers(&vehicle[key]));
            let place = (0..3).map(|axis| location[axis] + center[axis]);
            let six: Vec<f64> = place.chain(angle).collect();
            assert!(
                ["Car", "Van", "Truck", "Bus"].contains(&vehicle["obj_type"].as_str().unwrap())
            );
            let size = [0, 1, 2].map(|axis| 2.0 * extent[axis]);
            objects.insert(id.clone(), object(0, pose(&six), size));
        }
    }
    let ego_from_world = tick.poses[0].inverse();
    tick.boxes = objects
        .values()
        .map(|object| upright_box(object, &ego_from_world))
        .collect();
    tick
}

#[test]
fn v2xreal_keeps_poses_points_and_boxes() {
    let folder = tempfile::tempdir().unwrap();
    assert!(
        write(SceneLayout::V2xreal, folder.path())
            .omitted
            .is_empty()
    );
    let mut ticks = Vec::new();
    for scenario in sorted(folder.path()) {
        let agents: Vec<PathBuf> = sorted(&scenario)
            .into_iter()
            .filter(|path| path.is_dir())
            .collect();
        let is_yaml = |path: &PathBuf| path.extension().is_some_and(|kind| kind == "yaml");
        let [first, second] =
            [0, 1].map(|agent: usize| sorted(&agents[agent]).into_iter().filter(is_yaml).collect());
        let (first, second): (Vec<PathBuf>, Vec<PathBuf>) = (first, second);
        ticks.extend(
            first
                .into_iter()
                .zip(second)
                .map(|(first, second)| tick(&[first, second])),
        );
    }
    assert_same(&ticks, &expected(), SceneLayout::V2xreal);
}
