use std::f64::consts::PI;

use nalgebra::Point3;
use protocol::Box3d;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// A street with vehicles at least a length apart, some of which both agents detect.
struct Scene {
    cars: Vec<Box3d>,
    rng: ChaCha8Rng,
}

impl Scene {
    fn new(seed: u64, count: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut cars: Vec<Box3d> = Vec::new();
        while cars.len() < count {
            let center_m = [
                rng.random_range(-40.0..70.0),
                rng.random_range(-25.0..25.0),
                -1.0,
            ];
            let is_near_another = cars.iter().any(|car| {
                (car.center_m[0] - center_m[0]).hypot(car.center_m[1] - center_m[1]) < 7.0
            });
            if !is_near_another {
                let heading_rad = rng.random_range(-PI..PI);
                cars.push(Box3d {
                    center_m,
                    size_m: [4.4, 1.9, 1.6],
                    heading_rad,
                });
            }
        }
        Self { cars, rng }
    }

    /// Detections of an agent at `ego_from_agent` of `cars`, with the errors of a detector.
    fn seen(
        &mut self,
        ego_from_agent: &Pose,
        cars: std::ops::Range<usize>,
        error_m: f64,
    ) -> Vec<Detection> {
        let agent_from_ego = ego_from_agent.isometry().inverse();
        let rng = &mut self.rng;
        self.cars[cars]
            .iter()
            .map(|car| {
                let mut box3d = car.transformed(&agent_from_ego);
                box3d.center_m[0] += error_m * rng.random_range(-1.0..1.0);
                box3d.center_m[1] += error_m * rng.random_range(-1.0..1.0);
                box3d.heading_rad += 0.1 * error_m * rng.random_range(-1.0..1.0);
                if rng.random_bool(0.2) {
                    box3d.heading_rad += PI;
                }
                Detection {
                    box3d,
                    score: rng.random_range(0.4..1.0),
                    source: None,
                }
            })
            .collect()
    }

    fn disturbed(&mut self, pose: &Pose) -> Pose {
        let (shift, direction) = (
            self.rng.random_range(0.5..2.0),
            self.rng.random_range(-PI..PI),
        );
        let turn = self.rng.random_range(1.0f64..2.0).to_radians()
            * if self.rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let [x, y, z] = pose.translation_m;
        Pose::from_xyz_yaw(
            [x + shift * direction.cos(), y + shift * direction.sin(), z],
            pose.yaw_rad() + turn,
        )
    }

    fn pose(&mut self) -> Pose {
        let place = [
            self.rng.random_range(-30.0..50.0),
            self.rng.random_range(-15.0..15.0),
            0.1,
        ];
        Pose::from_xyz_yaw(place, self.rng.random_range(-PI..PI))
    }
}

/// Mean distance between the boxes under two poses.
fn off(one: &Pose, other: &Pose, boxes: &[Detection]) -> f64 {
    let distances_m = boxes.iter().map(|found| {
        let center = Point3::from(found.box3d.center_m);
        (one.isometry() * center - other.isometry() * center).norm()
    });
    distances_m.sum::<f64>() / boxes.len() as f64
}

#[test]
fn injected_errors_shrink_by_what_is_shared() {
    let (mut before, mut after, mut worse) = (0.0, 0.0, 0);
    for seed in 0..100 {
        let mut scene = Scene::new(seed, 12);
        let shared = scene.rng.random_range(3..=8);
        let truth = scene.pose();
        // The ego sees the first of the cars, the neighbour the last; `shared` of them are seen by both.
        let (ego, neighbour) = (
            scene.seen(&Pose::IDENTITY, 0..8, 0.15),
            scene.seen(&truth, 8 - shared..12, 0.15),
        );
        let reported = scene.disturbed(&truth);
        let agents = [
            Observer {
                ego_from_agent: Pose::IDENTITY,
                boxes: &ego,
            },
            Observer {
                ego_from_agent: reported,
                boxes: &neighbour,
            },
        ];
        let corrected = correct(&agents, &PoseGraphConfig::default());
        assert_eq!(corrected[0], Pose::IDENTITY);
        let (was, is) = (
            off(&reported, &truth, &neighbour),
            off(&corrected[1], &truth, &neighbour),
        );
        before += was;
        after += is;
        worse += usize::from(is > was);
        if shared >= 5 {
            assert!(
                is < 0.6,
                "seed {seed}: {was} to {is} with {:?}",
                corrected[1]
            );
        }
    }
    assert!(after < 0.25 * before, "{before} to {after} m in 100 scenes");
    assert!(worse <= 2, "{worse} of 100 scenes are worse than before");
}

#[test]
fn right_poses_and_exact_boxes_stay_as_they_are() {
    for seed in 0..20 {
        let mut scene = Scene::new(seed, 8);
        let truth = scene.pose();
        let (ego, neighbour) = (
            scene.seen(&Pose::IDENTITY, 0..8, 0.0),
            scene.seen(&truth, 0..8, 0.0),
        );
        let agents = [
            Observer {
                ego_from_agent: Pose::IDENTITY,
                boxes: &ego,
            },
            Observer {
                ego_from_agent: truth,
                boxes: &neighbour,
            },
        ];
        let corrected = correct(&agents, &PoseGraphConfig::default());
        assert_eq!(corrected[1], truth, "seed {seed}");
    }
}

#[test]
fn a_good_pose_is_not_spoilt_by_boxes() {
    for seed in 0..20 {
        let mut scene = Scene::new(seed, 8);
        let truth = scene.pose();
        let (ego, neighbour) = (
            scene.seen(&Pose::IDENTITY, 0..8, 0.25),
            scene.seen(&truth, 0..8, 0.25),
        );
        let agents = [
            Observer {
                ego_from_agent: Pose::IDENTITY,
                boxes: &ego,
            },
            Observer {
                ego_from_agent: truth,
                boxes: &neighbour,
            },
        ];
        assert_eq!(
            correct(&agents, &PoseGraphConfig::default())[1],
            truth,
            "seed {seed}"
        );
    }
}

#[test]
fn with_too_little_in_common_poses_stay_bit_for_bit() {
    let mut scene = Scene::new(5, 12);
    let truth = scene.pose();
    let reported = scene.disturbed(&truth);
    for shared in 0..3 {
        let (ego, neighbour) = (
            scene.seen(&Pose::IDENTITY, 0..6, 0.1),
            scene.seen(&truth, 6 - shared..9, 0.1),
        );
        let agents = [
            Observer {
                ego_from_agent: Pose::IDENTITY,
                boxes: &ego,
            },
            Observer {
                ego_from_agent: reported,
                boxes: &neighbour,
            },
        ];
        let corrected = correct(&agents, &PoseGraphConfig::default());
        assert_eq!(corrected[1], reported, "{shared} shared");
    }
    assert!(correct(&[], &PoseGraphConfig::default()).is_empty());
}

#[test]
fn a_neighbour_beyond_the_egos_sight_is_placed_by_a_third() {
    let mut scene = Scene::new(11, 15);
    let truths = [scene.pose(), scene.pose()];
    let ego = scene.seen(&Pose::IDENTITY, 0..6, 0.05);
    let between = scene.seen(&truths[0], 1..11, 0.05);
    let beyond = scene.seen(&truths[1], 6..15, 0.05);
    let reported = truths.map(|truth| scene.disturbed(&truth));
    let agents = [
        Observer {
            ego_from_agent: Pose::IDENTITY,
            boxes: &ego,
        },
        Observer {
            ego_from_agent: reported[1],
            boxes: &beyond,
        },
        Observer {
            ego_from_agent: reported[0],
            boxes: &between,
        },
    ];
    let corrected = correct(&agents, &PoseGraphConfig::default());
    assert!(off(&corrected[2], &truths[0], &between) < 0.3);
    assert!(off(&corrected[1], &truths[1], &beyond) < 0.5);
}

#[test]
fn boxes_that_are_none_are_passed_over() {
    let mut scene = Scene::new(3, 8);
    let truth = scene.pose();
    let ego = scene.seen(&Pose::IDENTITY, 0..8, 0.0);
    let mut neighbour = scene.seen(&truth, 0..8, 0.0);
    neighbour[0].box3d.center_m[0] = f64::NAN;
    neighbour[1].box3d.heading_rad = f64::INFINITY;
    neighbour[2].score = f32::NAN;
    let agents = [
        Observer {
            ego_from_agent: Pose::IDENTITY,
            boxes: &ego,
        },
        Observer {
            ego_from_agent: scene.disturbed(&truth),
            boxes: &neighbour,
        },
    ];
    let corrected = correct(&agents, &PoseGraphConfig::default());
    assert!(off(&corrected[1], &truth, &neighbour[3..]) < 0.1);
}
