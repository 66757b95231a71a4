//! Poses, relative transforms and world objects against the reference implementations.
//!
//! The archives are left-handed. Inputs go through the readers' conversion, results are mirrored back.

use dataset::carla_pose::{CarlaPose, mirrored_point};
use dataset::frame::{Frame, Object, ObjectClass};
use dataset::ground_truth::{self, GroundTruthRule};
use nalgebra::{Matrix4, Point3};
use perception::crop::Crop;
use perception::model_config::DetectorConfig;
use protocol::{CavId, Handedness, Pose};
use serde_json::Value;
use tests::fixtures::{Golden, assert_close, golden};

/// Tolerance of matrices that the reference computed in doubles.
const F64_ATOL: f64 = 1e-10;
/// Tolerance of values that it computed in floats.
const F32_ATOL: f64 = 1e-4;

/// `N` numbers per row.
fn rows<const N: usize>(golden: &Golden, name: &str) -> Vec<[f64; N]> {
    let (shape, values) = golden.f64(name);
    assert_eq!(shape.last(), Some(&N), "{name}");
    values.as_chunks::<N>().0.to_vec()
}

fn poses(golden: &Golden, name: &str) -> Vec<Pose> {
    rows::<6>(golden, name)
        .into_iter()
        .map(|six| CarlaPose::from(six).to_pose())
        .collect()
}

/// A transform as the row-major left-handed matrix of the archives.
fn left_handed(pose: &Pose) -> Vec<f64> {
    let mirror = Matrix4::from_diagonal(&[1.0, -1.0, 1.0, 1.0].into());
    let matrix = mirror * pose.isometry().to_homogeneous() * mirror;
    matrix.transpose().as_slice().to_vec()
}

fn to_f32(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&value| value as f32).collect()
}

/// The integers after `key` in the archive's note.
fn numbers_after(note: &str, key: &str) -> Vec<f64> {
    let rest = note
        .split_once(key)
        .unwrap_or_else(|| panic!("{key:?} is not in the note {note:?}"))
        .1;
    let end = rest
        .find(|c: char| !c.is_ascii_digit() && !",-.".contains(c))
        .unwrap_or(rest.len());
    rest[..end]
        .split(',')
        .map(|number| number.parse().unwrap())
        .collect()
}

#[test]
fn golden_pose_matrices() {
    let golden = golden("c5_poses");
    let (_, expected) = golden.f64("out.x_to_world");
    let raw: Vec<f64> = rows::<6>(&golden, "in.poses")
        .into_iter()
        .flat_map(|six| {
            CarlaPose::from(six)
                .left_handed_matrix()
                .transpose()
                .as_slice()
                .to_vec()
        })
        .collect();
    assert_close(
        "x_to_world before the mirror",
        &raw,
        &expected,
        F64_ATOL,
        0.0,
    );
    let converted: Vec<f64> = poses(&golden, "in.poses")
        .iter()
        .flat_map(left_handed)
        .collect();
    assert_close("x_to_world", &converted, &expected, F64_ATOL, 0.0);
}

#[test]
fn golden_relative_transforms() {
    let golden = golden("c5_poses");
    let poses = poses(&golden, "in.poses");
    let (_, expected) = golden.f64("out.x1_to_x2");
    let pairs = poses
        .iter()
        .flat_map(|source| poses.iter().map(move |target| target.from_world(source)));
    let actual: Vec<f64> = pairs.flat_map(|pose| left_handed(&pose)).collect();
    assert_close("x1_to_x2", &actual, &expected, F64_ATOL, 0.0);
}

#[test]
fn golden_pairwise_matrices() {
    let golden = golden("c5_poses");
    let all = poses(&golden, "in.poses");
    let note = golden.config()["note"].as_str().unwrap();
    let cavs: Vec<Pose> = numbers_after(note, "pairwise uses poses ")
        .into_iter()
        .map(|index| all[index as usize])
        .collect();
    let (shape, expected) = golden.f64("out.pairwise_opencood_zero_padded");
    let mut actual = Vec::with_capacity(expected.len());
    for i in 0..shape[0] {
        for j in 0..shape[1] {
            match (cavs.get(i), cavs.get(j)) {
                (Some(source), Some(target)) => {
                    actual.extend(left_handed(&target.from_world(source)))
                }
                _ => actual.extend([0.0; 16]),
            }
        }
    }
    assert_close("pairwise", &actual, &expected, F64_ATOL, 0.0);
    // Clouds that were projected first need no transform any more.
    let (shape, projected_first) = golden.f64("out.pairwise_opencood_proj_first");
    let identity = left_handed(&Pose::IDENTITY).repeat(shape[0] * shape[1]);
    assert_close(
        "pairwise, projected first",
        &identity,
        &projected_first,
        0.0,
        0.0,
    );
}

#[test]
fn golden_projected_and_cropped_points() {
    let golden = golden("c5_poses");
    let poses = poses(&golden, "in.poses");
    let note = golden.config()["note"].as_str().unwrap();
    let indices = numbers_after(note, "x1_to_x2[");
    let ego_from_cav = poses[indices[1] as usize]
        .from_world(&poses[indices[0] as usize])
        .isometry();
    let (_, flat) = golden.f32("in.points");
    let xyzi: Vec<[f32; 4]> = flat
        .as_chunks::<4>()
        .0
        .iter()
        .map(|&[x, y, z, i]| [x, -y, z, i])
        .collect();

    let projected: Vec<f32> = xyzi
        .iter()
        .flat_map(|&[x, y, z, _]| {
            let point = ego_from_cav * Point3::new(x, y, z).cast::<f64>();
            mirrored_point(point.into()).map(|value| value as f32)
        })
        .collect();
    assert_close(
        "projected",
        &projected,
        &golden.f32("out.points_projected").1,
        F32_ATOL,
        0.0,
    );

    let kept_by = |config: DetectorConfig| {
        let mut kept = Vec::new();
        Crop::for_detector(&config).keep(&xyzi, &mut kept);
        kept.into_iter()
            .flat_map(|[x, y, z, i]| [x, -y, z, i])
            .collect::<Vec<f32>>()
    };
    let everywhere = [-1e6, -1e6, -1e6, 1e6, 1e6, 1e6];
    let without_body = kept_by(DetectorConfig {
        lidar_range_m: everywhere,
        ..DetectorConfig::full()
    });
    assert_close(
        "without own body",
        &without_body,
        &golden.f32("out.points_ego_masked").1,
        0.0,
        0.0,
    );

    let bounds: [f64; 6] = numbers_after(note, "range mask [").try_into().unwrap();
    // y is mirrored, and with it the lower and upper bounds.
    let lidar_range_m = [
        bounds[0], -bounds[4], bounds[2], bounds[3], -bounds[1], bounds[5],
    ];
    let in_range = kept_by(DetectorConfig {
        lidar_range_m,
        own_body_m: None,
        ..DetectorConfig::full()
    });
    assert_close(
        "in range",
        &in_range,
        &golden.f32("out.points_range_masked").1,
        0.0,
        0.0,
    );
}

#[test]
fn golden_coalign_poses() {
    let golden = golden("c5_pairwise_coalign");
    let six = rows::<6>(&golden, "in.poses6");
    let poses: Vec<Pose> = six
        .iter()
        .map(|&six| CarlaPose::from(six).to_pose())
        .collect();
    let matrices: Vec<f64> = poses.iter().flat_map(left_handed).collect();
    assert_close(
        "pose_to_tfm, six numbers",
        &to_f32(&matrices),
        &golden.f32("out.pose_to_tfm6").1,
        F32_ATOL,
        0.0,
    );
    let back: Vec<f64> = poses
        .iter()
        .flat_map(|pose| <[f64; 6]>::from(CarlaPose::from_pose(pose)))
        .collect();
    assert_close(
        "tfm_to_pose, six numbers",
        &to_f32(&back),
        &golden.f32("out.tfm_to_pose6").1,
        F32_ATOL,
        0.0,
    );

    let planar: Vec<Pose> = rows::<3>(&golden, "in.poses3")
        .into_iter()
        .map(|[x, y, yaw]| CarlaPose::from([x, y, 0.0, 0.0, yaw, 0.0]).to_pose())
        .collect();
    let matrices: Vec<f64> = planar.iter().flat_map(left_handed).collect();
    assert_close(
        "pose_to_tfm, three numbers",
        &to_f32(&matrices),
        &golden.f32("out.pose_to_tfm3").1,
        F32_ATOL,
        0.0,
    );
    let back: Vec<f64> = planar
        .iter()
        .flat_map(|pose| {
            let [x, y, _, _, yaw, _] = CarlaPose::from_pose(pose).into();
            [x, y, yaw]
        })
        .collect();
    assert_close(
        "tfm_to_pose, three numbers",
        &to_f32(&back),
        &golden.f32("out.tfm_to_pose3").1,
        F32_ATOL,
        0.0,
    );

    let relative: Vec<f64> = poses
        .iter()
        .flat_map(|pose| left_handed(&poses[0].from_world(pose)))
        .collect();
    assert_close(
        "relative to the first",
        &relative,
        &golden.f64("out.relative_to_first").1,
        F64_ATOL,
        0.0,
    );
}

/// `[samples, slots, slots]` matrices, entry `i, j` from frame `i` to frame `j`, identity where there is no agent.
fn padded_pairwise(poses: &[Pose], record_len: &[i64], slots: usize) -> Vec<f64> {
    let mut rest = poses;
    let mut matrices = Vec::new();
    for &len in record_len {
        let (sample, others) = rest.split_at(usize::try_from(len).unwrap());
        rest = others;
        for i in 0..slots {
            for j in 0..slots {
                let pair = sample.get(i).zip(sample.get(j));
                let pose =
                    pair.map_or(Pose::IDENTITY, |(source, target)| target.from_world(source));
                matrices.extend(left_handed(&pose));
            }
        }
    }
    matrices
}

#[test]
fn golden_coalign_pairwise() {
    let golden = golden("c5_pairwise_coalign");
    let (_, record_len) = golden.i64("in.record_len");
    let (shape, expected) = golden.f32("out.pairwise_torch6");
    let six = poses(&golden, "in.poses6");
    let actual = padded_pairwise(&six, &record_len, shape[1]);
    assert_close(
        "pairwise, six numbers",
        &to_f32(&actual),
        &expected,
        F32_ATOL,
        0.0,
    );
    let first = padded_pairwise(&six, &record_len[..1], shape[1]);
    assert_close(
        "pairwise of the first sample",
        &first,
        &golden.f64("out.pairwise_np_first_sample").1,
        F64_ATOL,
        0.0,
    );
    let planar: Vec<Pose> = rows::<3>(&golden, "in.poses3")
        .into_iter()
        .map(|[x, y, yaw]| CarlaPose::from([x, y, 0.0, 0.0, yaw, 0.0]).to_pose())
        .collect();
    let actual = padded_pairwise(&planar, &record_len, shape[1]);
    assert_close(
        "pairwise, three numbers",
        &to_f32(&actual),
        &golden.f32("out.pairwise_torch3").1,
        F32_ATOL,
        0.0,
    );
}

fn range(config: &Value) -> [f64; 6] {
    std::array::from_fn(|index| config["range"][index].as_f64().unwrap())
}

#[test]
fn golden_world_objects() {
    let golden = golden("c3_world_objects");
    let objects = rows::<12>(&golden, "in.objects")
        .into_iter()
        .enumerate()
        .map(|(id, columns)| {
            let part = |first: usize| [columns[first], columns[first + 1], columns[first + 2]];
            Object {
                id: id as i64,
                class: ObjectClass::Car,
                world_from_object: CarlaPose::of_box(part(0), part(3), part(6)).to_pose(),
                size_m: part(9).map(|half| 2.0 * half),
                speed_mps: None,
            }
        });
    let ego = Frame {
        world_from_lidar: Some(poses(&golden, "in.lidar_pose")[0]),
        objects: objects.collect(),
        ..Frame::empty(CavId::new("0").unwrap(), 0, Handedness::Left)
    };
    let [x_low, y_low, z_low, x_high, y_high, z_high] = range(golden.config());
    let rule = GroundTruthRule {
        x_m: [x_low, x_high],
        y_m: [-y_high, -y_low],
        z_m: [z_low, z_high],
        ..GroundTruthRule::OPV2V
    };
    let merged = ground_truth::merged_objects(&[&ego], 0, &rule);
    let ids: Vec<i64> = merged.iter().map(|(object, _)| object.id).collect();
    assert_eq!(ids, golden.i64("out.ids").1);
    let boxes = merged.iter().map(|(object, box3d)| (object.id, box3d));
    for ((id, box3d), expected) in boxes.zip(rows::<7>(&golden, "out.boxes_hwl")) {
        let [x, y, z] = mirrored_point(box3d.center_m);
        let [l, w, h] = box3d.size_m;
        assert_close(
            &format!("object {id}"),
            &[x, y, z, h, w, l],
            &expected[..6],
            F32_ATOL,
            0.0,
        );
        let yaw = -box3d.heading_rad;
        // Within 1e-6 of half a turn the reference's average of four angles may result in 0.
        let reference_is_torn = std::f64::consts::PI - yaw.abs() < 1e-6;
        assert!(
            reference_is_torn || (yaw - expected[6]).abs() <= 1e-5,
            "object {id}: {yaw} is not {}",
            expected[6]
        );
    }
}
