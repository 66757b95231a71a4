//! Attacks: falsify what a vehicle publishes, to measure the effect on its neighbours. Off unless configured.
//!
//! Every falsified message is well-formed: right sizes, finite numbers, a valid pose. Only its content is false.
//! The same seed gives the same falsified messages, offline and live.

use protocol::{
    BevFeatures, BevGrid, Box3d, Boxes, CavId, Detection, ObjectTrack, PointCloud, PoseEstimate,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::random::SplitMix64;

use crate::agent_output::Perception;

/// Number of synthetic objects in every frame.
const INVENTED: usize = 10;
/// The same of a flood.
const FLOOD: usize = 1000;
/// Score of a synthetic object: no honest detection has a higher one.
const INVENTED_SCORE: f32 = 1.0;
/// Largest distance of a synthetic object from the attacker, metres.
const INVENTED_WITHIN_M: f64 = 35.0;
/// Gain of the features of synthetic objects relative to those of real ones.
const GAIN: f32 = 2.0;
/// Half the edge of the patch of a feature map that is copied, cells.
const PATCH_CELLS: i64 = 3;

/// Kind of falsification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[derive(clap::ValueEnum, strum::IntoStaticStr)]
#[value(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Falsification {
    /// The pose is shifted by a constant offset of 5 to 30 m, with full confidence.
    ShiftedPose,
    /// The perception is noise with the mean and standard deviation of the true one.
    Noise,
    /// The perception is a copy of another vehicle's messages, or of its own first frame if none is received, under its
    /// own pose. Refused where a vehicle is a process of its own (live, `stepped.processes`): it gets no such messages.
    Copied,
    /// Ten vehicles that do not exist are added to the true perception.
    Invented,
    /// A thousand vehicles that do not exist are added to the true perception.
    Flood,
    /// All detected objects have one false velocity of 5 to 30 m/s, stated with certainty.
    FalseVelocity,
}

impl Falsification {
    /// Name in settings and tables.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// Attackers of an evaluation and their falsification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AttackConfig {
    /// Kind of falsification.
    pub falsification: Falsification,
    /// Number of attackers: the first neighbours of every scenario.
    #[serde(default = "one")]
    pub attackers: usize,
    /// Seed of the falsification.
    #[serde(default)]
    pub seed: u64,
}

fn one() -> usize {
    1
}

impl AttackConfig {
    /// The attack of the vehicle at `place` of its scenario, the ego being at 0; none if it is honest.
    pub fn of(&self, place: usize, cav: &CavId) -> Option<Attack> {
        let is_attacker = (1..=self.attackers).contains(&place);
        is_attacker.then(|| Attack::new(self.falsification, cav, self.seed))
    }
}

/// Captured perception of a vehicle, for replay by [`Falsification::Copied`].
#[derive(Debug, Clone, Default)]
pub struct CapturedMessages {
    /// BEV feature map.
    pub features: Option<BevFeatures>,
    /// Detections, in the LiDAR frame of the captured vehicle.
    pub detections: Option<Vec<Detection>>,
    /// Points, in the LiDAR frame of the captured vehicle.
    pub points: Option<PointCloud>,
}

/// State of an attacker.
#[derive(Debug)]
pub struct Attack {
    falsification: Falsification,
    random: SplitMix64,
    offset_m: [f64; 2],
    /// Poses of the synthetic objects in the attacker's frame: x and y in metres, heading in radians.
    places: Vec<[f64; 3]>,
    captured: CapturedMessages,
}

impl Attack {
    /// The attack of the vehicle `cav` under `seed`.
    pub fn new(falsification: Falsification, cav: &CavId, seed: u64) -> Self {
        // The id is part of the seed: several attackers of one run differ.
        let letters: Vec<u64> = cav.as_str().bytes().map(u64::from).collect();
        let mut random = SplitMix64::derived(seed, &letters);
        // Drawn first: the offset depends on id and seed alone, whatever the falsification.
        let distance_m = random.between(5.0, 30.0);
        let direction = random.between(0.0, std::f64::consts::TAU);
        let invented = [INVENTED, FLOOD][usize::from(falsification == Falsification::Flood)];
        let places = (0..invented).map(|_| {
            let [x, y] = invented_position(&mut random);
            [x, y, random.between(-0.2, 0.2)]
        });
        let offset_m = [distance_m * direction.cos(), distance_m * direction.sin()];
        tracing::warn!(%cav, falsification = falsification.name(), "ATTACK: this vehicle falsifies its messages");
        Self {
            falsification,
            places: places.collect(),
            random,
            offset_m,
            captured: CapturedMessages::default(),
        }
    }

    /// Stores another vehicle's messages, for [`Falsification::Copied`]. What is absent replaces nothing.
    pub fn capture(&mut self, captured: CapturedMessages) {
        if self.falsification == Falsification::Copied {
            let last = std::mem::take(&mut self.captured);
            self.captured = CapturedMessages {
                features: captured.features.or(last.features),
                detections: captured.detections.or(last.detections),
                points: captured.points.or(last.points),
            };
        }
    }

    fn random_detection(&mut self) -> Detection {
        let [x, y] = invented_position(&mut self.random);
        let heading = self.random.between(-3.1, 3.1);
        vehicle([x, y, heading], self.random.between(0.3, 1.0) as f32)
    }

    /// The pose that is published instead of the vehicle's own.
    pub fn pose(&self, pose: PoseEstimate) -> PoseEstimate {
        let (Falsification::ShiftedPose, Some(own)) = (self.falsification, pose.world_from_cav())
        else {
            return pose;
        };
        let mut shifted = *own;
        for (along_m, offset_m) in shifted.translation_m.iter_mut().zip(self.offset_m) {
            *along_m += offset_m;
        }
        PoseEstimate::new(shifted, 1.0)
    }

    /// The perception that is published instead of the true one.
    pub fn perception(&mut self, truth: Perception) -> Perception {
        let mut falsified = truth;
        match self.falsification {
            Falsification::ShiftedPose | Falsification::FalseVelocity => {}
            Falsification::Noise => {
                // Normal noise with the mean and the standard deviation of each channel.
                let cells = falsified.features.grid.cells().max(1);
                for channel in falsified.features.values.chunks_mut(cells) {
                    let mean =
                        channel.iter().map(|value| f64::from(*value)).sum::<f64>() / cells as f64;
                    let offsets = channel.iter().map(|value| f64::from(*value) - mean);
                    let spread =
                        (offsets.map(|offset| offset.powi(2)).sum::<f64>() / cells as f64).sqrt();
                    channel.fill_with(|| (mean + spread * self.random.normal()) as f32);
                }
                falsified.confidence.fill_with(|| self.random.unit() as f32);
                falsified.detections = (0..2 * INVENTED).map(|_| self.random_detection()).collect();
            }
            Falsification::Copied => {
                let (captured, own) = (&mut self.captured, &falsified.features);
                let features = captured.features.get_or_insert_with(|| own.clone());
                // A map of another size would not be well-formed: the own one is sent then.
                if features.values.len() == own.values.len() {
                    falsified.features = features.clone();
                }
                let detections = &mut captured.detections;
                falsified.detections = detections.get_or_insert(falsified.detections).clone();
            }
            Falsification::Invented | Falsification::Flood => {
                let confidence = &mut falsified.confidence;
                invent(&mut falsified.features, confidence, &self.places);
                let invented = self
                    .places
                    .iter()
                    .map(|&place| vehicle(place, INVENTED_SCORE));
                falsified.detections.extend(invented);
            }
        }
        falsified
    }

    /// The boxes that are published instead of these, which are those of the published perception.
    pub fn boxes(&self, truth: Boxes) -> Boxes {
        if self.falsification != Falsification::FalseVelocity {
            return truth;
        }
        let track = ObjectTrack {
            id: 1,
            // The offset of a shifted pose, 5 to 30 m, serves as the velocity too.
            velocity_mps: self.offset_m.map(|per_second| per_second as f32),
            position_covariance: [0.0; 3],
            velocity_covariance: [0.0; 3],
        };
        let mut objects = truth.objects().to_vec();
        for (object, id) in objects.iter_mut().zip(1..) {
            object.track = Some(ObjectTrack { id, ..track });
        }
        Boxes::new(truth.pose, &objects)
    }

    /// The points that are published instead of the measured ones.
    pub fn points(&mut self, truth: PointCloud) -> PointCloud {
        match self.falsification {
            Falsification::ShiftedPose | Falsification::FalseVelocity => truth,
            Falsification::Noise => {
                let points = truth.xyzi.iter().map(|_| {
                    // Upper and lower bounds of x, y and z in metres, and of the intensity.
                    [(40.0, -40.0), (40.0, -40.0), (0.5, -2.5), (1.0, 0.0)]
                        .map(|(high, low)| self.random.between(low, high) as f32)
                });
                let xyzi = points.collect();
                PointCloud { xyzi }
            }
            Falsification::Copied => self.captured.points.get_or_insert(truth).clone(),
            Falsification::Invented | Falsification::Flood => {
                let mut falsified = truth;
                for &place in &self.places {
                    points_of(place, &mut self.random, &mut falsified.xyzi);
                }
                falsified
            }
        }
    }
}

/// x and y of a synthetic object in the attacker's frame, metres.
fn invented_position(random: &mut SplitMix64) -> [f64; 2] {
    std::array::from_fn(|_| random.between(-INVENTED_WITHIN_M, INVENTED_WITHIN_M))
}

/// A car on the road at this pose, for a sensor 1.9 m above it.
fn vehicle([x, y, heading_rad]: [f64; 3], score: f32) -> Detection {
    Detection {
        box3d: Box3d {
            // The lower face is on the road: -1.1 - 1.6 / 2 = -1.9 m.
            center_m: [x, y, -1.1],
            size_m: [4.4, 1.9, 1.6],
            heading_rad,
        },
        score,
        source: None,
    }
}

/// Points on the sides of such a car.
fn points_of([x, y, heading]: [f64; 3], random: &mut SplitMix64, points: &mut Vec<[f32; 4]>) {
    let (sin, cos) = heading.sin_cos();
    for _ in 0..150 {
        let (along, across) = (random.between(-2.2, 2.2), random.between(-0.95, 0.95));
        // Moved to a side of the footprint: the long sides are 70 % of its perimeter.
        let (along, across) = match random.chance(0.7) {
            true => (along, 0.95_f64.copysign(across)),
            false => (2.2_f64.copysign(along), across),
        };
        let height = random.between(-1.8, -0.4);
        let x = x + cos * along - sin * across;
        let y = y + sin * along + cos * across;
        points.push([x, y, height, 0.4].map(|value| value as f32));
    }
}

/// Copies the features around the most confident cell to other positions, amplified.
fn invent(features: &mut BevFeatures, confidence: &mut [f32], places: &[[f64; 3]]) {
    let BevGrid { width, height, .. } = features.grid;
    let (width, height) = (i64::from(width), i64::from(height));
    let cells = features.grid.cells();
    let most_confident = (confidence.iter().enumerate())
        .max_by(|one, other| one.1.total_cmp(other.1))
        .map(|(cell, _)| cell as i64);
    // Without a head there is no confidence, and no patch to copy.
    let Some(from) = most_confident else { return };
    let (from_row, from_column) = (from / width.max(1), from % width.max(1));
    // Copied before the loop: patches may overlap the source and each other.
    let (original, original_confidence) = (features.values.clone(), confidence.to_vec());
    let means: Vec<f32> = original
        .chunks(cells.max(1))
        .map(|channel| channel.iter().sum::<f32>() / cells.max(1) as f32)
        .collect();
    for [x, y, _] in places {
        let column = ((x - features.grid.x_min_m) / features.grid.cell_m).floor() as i64;
        let row = ((y - features.grid.y_min_m) / features.grid.cell_m).floor() as i64;
        for (down, right) in (-PATCH_CELLS..=PATCH_CELLS)
            .flat_map(|down| (-PATCH_CELLS..=PATCH_CELLS).map(move |right| (down, right)))
        {
            let source = cell([from_row + down, from_column + right], [height, width]);
            let target = cell([row + down, column + right], [height, width]);
            let (Some(source), Some(target)) = (source, target) else {
                continue;
            };
            confidence[target] = original_confidence[source];
            for (channel, mean) in means.iter().enumerate() {
                let value = original[channel * cells + source];
                features.values[channel * cells + target] = mean + GAIN * (value - mean);
            }
        }
    }
}

/// Index of a cell of a map of `size` rows and columns; `None` outside.
fn cell(place: [i64; 2], size: [i64; 2]) -> Option<usize> {
    let ([row, column], [height, width]) = (place, size);
    let is_inside = (0..height).contains(&row) && (0..width).contains(&column);
    is_inside.then(|| (row * width + column) as usize)
}

#[cfg(test)]
mod tests {
    use protocol::Pose;

    use super::*;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn truth() -> Perception {
        let grid = BevGrid {
            x_min_m: -40.0,
            y_min_m: -40.0,
            cell_m: 0.8,
            width: 100,
            height: 100,
        };
        let values = (0..2 * grid.cells())
            .map(|cell| (cell % 97) as f32 * 0.1)
            .collect();
        let mut confidence = vec![0.0; grid.cells()];
        confidence[5050] = 0.9;
        let features = BevFeatures {
            grid,
            channels: 2,
            code_of: None,
            values,
        };
        Perception {
            features,
            confidence,
            detections: vec![],
            times: vec![],
        }
    }

    /// Offset of the falsified pose from one at `x`, metres.
    fn falsified_offset_m(attack: &Attack, x: f64) -> [f64; 2] {
        let pose = Pose::from_xyz_yaw([x, 0.0, 0.0], 0.3);
        let falsified = attack.pose(PoseEstimate::new(pose, 0.4));
        assert_eq!(falsified.confidence(), 1.0);
        let pose = *falsified.world_from_cav().unwrap();
        assert!(pose.validate().is_ok());
        [pose.translation_m[0] - x, pose.translation_m[1]]
    }

    #[test]
    fn a_shifted_pose_has_a_constant_offset_and_full_confidence() {
        let attack = Attack::new(Falsification::ShiftedPose, &cav("a"), 1);
        let [dx, dy] = falsified_offset_m(&attack, 10.0);
        assert!((5.0..=30.0).contains(&dx.hypot(dy)));
        assert!((falsified_offset_m(&attack, 20.0)[0] - dx).abs() < 1e-9);
        let other = Attack::new(Falsification::ShiftedPose, &cav("b"), 1).offset_m;
        assert!(other != attack.offset_m, "every attacker has its own");
    }

    #[test]
    fn falsified_output_has_the_shape_of_the_truth_and_other_values() {
        for falsification in [
            Falsification::Noise,
            Falsification::Invented,
            Falsification::Flood,
        ] {
            let falsified = Attack::new(falsification, &cav("a"), 1).perception(truth());
            assert_eq!(
                falsified.features.values.len(),
                truth().features.values.len()
            );
            assert!(
                falsified.features.values != truth().features.values
                    && !falsified.detections.is_empty(),
                "{falsification:?}"
            );
            assert!(
                falsified
                    .features
                    .values
                    .iter()
                    .all(|value| value.is_finite())
            );
        }
        let invented = Attack::new(Falsification::Invented, &cav("a"), 1).perception(truth());
        assert!(
            invented
                .confidence
                .iter()
                .filter(|sure| **sure > 0.8)
                .count()
                > 5
        );
    }

    #[test]
    fn copied_repeats_captured_messages_or_the_own_first_frame() {
        let mut attack = Attack::new(Falsification::Copied, &cav("a"), 1);
        let mut later = truth();
        later.features.values.fill(1.0);
        assert_eq!(attack.perception(truth()).features, truth().features);
        assert_eq!(attack.perception(later.clone()).features, truth().features);
        let captured = CapturedMessages {
            features: Some(later.features.clone()),
            ..CapturedMessages::default()
        };
        attack.capture(captured);
        assert_eq!(attack.perception(truth()).features, later.features);
        // Boxes of the other were never received: the own first ones stay.
        let mut moved = truth();
        moved.detections.clear();
        assert_eq!(attack.perception(moved).detections, truth().detections);
    }

    #[test]
    fn a_flood_is_a_thousand_objects_of_the_highest_score() {
        let [ten, flood] = [Falsification::Invented, Falsification::Flood].map(|falsification| {
            let mut attack = Attack::new(falsification, &cav("a"), 1);
            attack.perception(truth()).detections
        });
        assert_eq!((ten.len(), flood.len()), (10, 1000));
        assert!(flood.iter().all(|found| found.score == 1.0));
        assert_eq!(ten, flood[..10]);
    }

    #[test]
    fn a_false_velocity_is_stated_for_every_object_and_only_by_its_attack() {
        let pose = PoseEstimate::new(Pose::IDENTITY, 1.0);
        let boxes = Boxes::new(pose, &[vehicle([5.0, 0.0, 0.0], 0.5).into()]);
        let [kept, falsified] = [Falsification::Invented, Falsification::FalseVelocity]
            .map(|falsification| Attack::new(falsification, &cav("a"), 1).boxes(boxes.clone()));
        assert_eq!(kept, boxes);
        let [u, v] = falsified.objects()[0].track.unwrap().velocity_mps;
        assert!((5.0..=30.0).contains(&u.hypot(v)));
        assert!(falsified.detections().eq(boxes.detections()));
    }
}
