use std::fs;
use std::path::Path;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

const FRAMES: usize = 24;

/// Posts, walls and the ground, in the world.
fn street() -> Vec<Point3<f64>> {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut points = Vec::new();
    for _ in 0..60 {
        let [x, y] = [
            random.random_range(-30.0..60.0),
            random.random_range(-30.0..30.0),
        ];
        points.extend((0..12).map(|step| Point3::new(x, y, 0.25 * f64::from(step))));
    }
    for (x, y) in [(-10.0, 12.0), (15.0, -9.0), (30.0, 14.0)] {
        for along in 0..30 {
            points
                .extend((0..8).map(|step| {
                    Point3::new(x + 0.25 * f64::from(along), y, 0.4 * f64::from(step))
                }));
        }
    }
    points
}

/// `world_from_lidar` of a drive: 1 m a frame, from the tenth on in a curve to the left.
fn drive() -> Vec<Isometry3<f64>> {
    let mut pose = Isometry3::translation(0.0, 0.0, 1.8);
    (0..FRAMES)
        .map(|frame| {
            let now = pose;
            let turn = if frame < 10 { 0.0 } else { 0.08 };
            pose *= Isometry3::from_parts(
                Translation3::new(1.0, 0.0, 0.0),
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn),
            );
            now
        })
        .collect()
}

/// Cars that drive along, in the LiDAR frame: beside, ahead and behind on four lanes.
fn alongside(cars: u32) -> impl Iterator<Item = Point3<f64>> {
    (0..cars).flat_map(|car| {
        let ahead_m = [6.0, -14.0, 18.0, -24.0][car as usize / 4 % 4];
        let left_m = [-3.0, 4.0, -7.0, 8.0][car as usize % 4];
        (0..200).map(move |index| {
            let [x, z] = [index % 20, index / 20].map(f64::from);
            Point3::new(ahead_m + 0.2 * x, left_m, 0.15 * z - 1.6)
        })
    })
}

/// Clouds as they are seen from `seen` among cars, with the poses `stated`.
fn write(dir: &Path, seen: &[Isometry3<f64>], stated: &[Isometry3<f64>], cars: u32) {
    fs::create_dir_all(dir.join("clouds")).unwrap();
    let world = street();
    for (frame, pose) in seen.iter().enumerate() {
        let points = world
            .iter()
            .map(|point| pose.inverse_transform_point(point));
        let bytes: Vec<u8> = points
            .chain(alongside(cars))
            .flat_map(|point| [point.x, point.y, point.z, 0.5])
            .flat_map(|value| (value as f32).to_le_bytes())
            .collect();
        fs::write(dir.join(format!("clouds/{frame}.bin")), bytes).unwrap();
    }
    let rows = stated.iter().map(|pose| {
        let matrix = pose.to_homogeneous();
        let values: Vec<String> = (0..12)
            .map(|index| matrix[(index / 4, index % 4)].to_string())
            .collect();
        values.join(" ") + "\n"
    });
    fs::write(dir.join("poses.txt"), rows.collect::<String>()).unwrap();
}

fn problems(seen: &[Isometry3<f64>], stated: &[Isometry3<f64>]) -> Vec<String> {
    problems_among(1, seen, stated)
}

fn problems_among(cars: u32, seen: &[Isometry3<f64>], stated: &[Isometry3<f64>]) -> Vec<String> {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), seen, stated, cars);
    let dataset = crate::open(dir.path()).unwrap();
    assert_eq!(
        (dataset.scenarios[0].ticks.len(), dataset.problems.len()),
        (seen.len(), 0)
    );
    let problems = pose_problems(&dataset.scenarios[0]);
    problems
        .into_iter()
        .map(|problem| problem.message)
        .collect()
}

fn moved(
    poses: &[Isometry3<f64>],
    change: impl Fn(&Isometry3<f64>) -> Isometry3<f64>,
) -> Vec<Isometry3<f64>> {
    poses.iter().map(change).collect()
}

#[test]
fn sound_poses_have_no_problem() {
    let poses = drive();
    assert_eq!(problems(&poses, &poses), Vec::<String>::new());
    assert_eq!(
        problems(&poses[..2], &poses[..2]),
        Vec::<String>::new(),
        "two frames"
    );
    let standing = vec![poses[3]; FRAMES];
    assert_eq!(
        problems(&standing, &standing),
        Vec::<String>::new(),
        "beside a moving car"
    );
    // The frame of the world is free.
    let elsewhere = Isometry3::new(Vector3::new(4e5, 5e6, 100.0), Vector3::new(0.0, 0.0, 2.0));
    let poses_elsewhere = moved(&poses, |pose| elsewhere * pose);
    assert_eq!(problems(&poses, &poses_elsewhere), Vec::<String>::new());
}

#[test]
fn a_wrong_scale_is_found_where_successive_sweeps_are_near() {
    // 6 m/s, to the side: walls lie across.
    let poses: Vec<Isometry3<f64>> = (0..40)
        .map(|frame| Isometry3::translation(5.0, 0.6 * f64::from(frame) - 12.0, 1.8))
        .collect();
    assert_eq!(problems(&poses, &poses), Vec::<String>::new());
    let longer = moved(&poses, |pose| {
        Isometry3::from_parts((pose.translation.vector * 1.3).into(), pose.rotation)
    });
    assert_eq!(problems(&poses, &longer).len(), 1);
}

#[test]
fn dense_traffic_that_drives_along_is_no_problem_of_the_poses() {
    let poses = drive();
    assert_eq!(problems_among(16, &poses, &poses), Vec::<String>::new());
    let backwards: Vec<_> = poses.iter().rev().copied().collect();
    assert_eq!(problems_among(16, &poses, &backwards).len(), 1);
}

#[test]
fn a_lidar_that_repeats_its_sweep_is_no_traffic() {
    let poses = &drive()[..10];
    let found = problems(&vec![poses[3]; poses.len()], poses);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(
        found[0].contains("or a LiDAR that repeats a sweep"),
        "{}",
        found[0]
    );
}

#[test]
fn sweeps_in_the_frame_of_a_map_are_no_traffic() {
    let poses: Vec<Isometry3<f64>> = (0..FRAMES)
        .map(|frame| Isometry3::translation(frame as f64, 0.0, 1.8))
        .collect();
    assert_eq!(problems(&poses, &poses), Vec::<String>::new());
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &poses, &poses, 0);
    let world = street();
    for (frame, pose) in poses.iter().enumerate() {
        // What is within range, in the world already. Every sweep misses some of the posts.
        let seen = world.iter().enumerate().filter(|(index, point)| {
            (index / 12 + frame) % 5 > 0 && (point.coords - pose.translation.vector).norm() < 30.0
        });
        let bytes: Vec<u8> = seen
            .flat_map(|(_, point)| [point.x, point.y, point.z, 0.5])
            .flat_map(|value| (value as f32).to_le_bytes())
            .collect();
        fs::write(dir.path().join(format!("clouds/{frame}.bin")), bytes).unwrap();
    }
    let scenario = &crate::open(dir.path()).unwrap().scenarios[0];
    let found = pose_problems(scenario);
    assert_eq!(found.len(), 1, "{found:?}");
    let part = "sweeps in the frame of a map";
    assert!(found[0].message.contains(part), "{found:?}");
}

#[test]
fn independent_frames_have_no_poses_to_contradict() {
    let poses = drive();
    let dir = tempfile::tempdir().unwrap();
    let backwards: Vec<_> = poses.iter().rev().copied().collect();
    write(dir.path(), &poses, &backwards, 1);
    let mut scenario = crate::open(dir.path()).unwrap().scenarios.swap_remove(0);
    assert_eq!(pose_problems(&scenario).len(), 1);
    scenario.layout = Layout::KITTI_OBJECT;
    assert_eq!(pose_problems(&scenario), []);
}

#[test]
fn wrong_joins_axes_and_units_are_found() {
    let poses = drive();
    let text_order: Vec<Isometry3<f64>> = {
        let mut names: Vec<String> = (0..FRAMES).map(|frame| frame.to_string()).collect();
        names.sort();
        names
            .iter()
            .map(|name| poses[name.parse::<usize>().unwrap()])
            .collect()
    };
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let tipped = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    for (what, stated) in [
        ("joined in text order", text_order),
        ("joined backwards", poses.iter().rev().copied().collect()),
        (
            "millimetres",
            moved(&poses, |pose| {
                Isometry3::from_parts((pose.translation.vector * 1e3).into(), pose.rotation)
            }),
        ),
        (
            "kilometres",
            moved(&poses, |pose| {
                Isometry3::from_parts((pose.translation.vector * 1e-3).into(), pose.rotation)
            }),
        ),
        ("y forward", moved(&poses, |pose| pose * quarter)),
        ("z up to y up", moved(&poses, |pose| pose * tipped)),
        ("lidar_from_world", moved(&poses, Isometry3::inverse)),
        (
            "y mirrored",
            moved(&poses, |pose| {
                let [x, y, z] = pose.translation.vector.into();
                let yaw = pose.rotation.euler_angles().2;
                Isometry3::new(Vector3::new(x, -y, z), Vector3::new(0.0, 0.0, -yaw))
            }),
        ),
    ] {
        let found = problems(&poses, &stated);
        assert_eq!(found.len(), 1, "{what}: {found:?}");
        assert!(
            found[0].contains("pairs of sweeps contradict the poses"),
            "{}",
            found[0]
        );
    }
}
