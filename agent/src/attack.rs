//! A vehicle that lies, to find out what its lies do to others: off unless asked for.
//!
//! Everything it says is sound by itself: right sizes, finite numbers, a pose that is one. Only what is told is not so.
//! The same seed tells the same lies, offline and live.

use protocol::{BevFeatures, BevGrid, Box3d, CavId, Detection, PointCloud, Pose, PoseEstimate};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::random::SplitMix64;

use crate::agent::Perception;
use crate::output_filter::OutputFilter;

/// Objects that are made up in every frame.
const INVENTED: usize = 10;
/// How far from itself a liar puts them, metres.
const INVENTED_WITHIN_M: f64 = 35.0;
/// How much stronger it shows them than what is there.
const LOUDER: f32 = 2.0;
/// Half the edge of the piece of a map that a vehicle makes up, cells.
const PATCH_CELLS: i64 = 3;

/// What a vehicle lies about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Falsification {
    /// Its pose is 5 to 30 m off, always by the same, and it is sure of it.
    ShiftedPose,
    /// What it sees is noise of the same mean and spread as the truth.
    Noise,
    /// What it sees is what another vehicle said, or where nobody is heard what it saw first, under its own pose.
    Copied,
    /// Beside what is there it sees ten vehicles that are not.
    Invented,
}

impl Falsification {
    /// Every lie, in the order of tables.
    pub const ALL: [Self; 4] = [Self::ShiftedPose, Self::Noise, Self::Copied, Self::Invented];

    /// The name in settings and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::ShiftedPose => "shifted_pose",
            Self::Noise => "noise",
            Self::Copied => "copied",
            Self::Invented => "invented",
        }
    }
}

/// Who lies in an evaluation, and what about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AttackConfig {
    /// What they lie about.
    pub lie: Falsification,
    /// How many: the first neighbours of every scenario.
    #[serde(default = "one")]
    pub liars: usize,
    /// Same seed, same lies.
    #[serde(default)]
    pub seed: u64,
}

fn one() -> usize {
    1
}

impl AttackConfig {
    /// The lies of the vehicle at `place` of its scenario, the ego being at 0; none where it is honest.
    #[must_use]
    pub fn of(&self, place: usize, cav: &CavId) -> Option<Attack> {
        (1..=self.liars).contains(&place).then(|| Attack::new(self.lie, cav, self.seed))
    }
}

/// What a vehicle saw, as a copier repeats it.
#[derive(Debug, Clone, Default)]
pub struct CapturedMessages {
    /// A map.
    pub features: Option<BevFeatures>,
    /// Detections.
    pub detections: Option<Vec<Detection>>,
    /// Points.
    pub points: Option<PointCloud>,
}

/// A liar's state.
#[derive(Debug)]
pub struct Attack {
    lie: Falsification,
    random: SplitMix64,
    offset_m: [f64; 2],
    /// Where it puts what it makes up, in its own frame: x, y, heading.
    places: Vec<[f64; 3]>,
    overheard: CapturedMessages,
}

impl Attack {
    /// The lies that the vehicle `cav` tells under `seed`.
    #[must_use]
    pub fn new(lie: Falsification, cav: &CavId, seed: u64) -> Self {
        let letters: Vec<u64> = cav.as_str().bytes().map(u64::from).collect();
        let mut random = SplitMix64::derived(seed, &letters);
        let (distance_m, direction) = (random.between(5.0, 30.0), random.between(0.0, std::f64::consts::TAU));
        let place = |random: &mut SplitMix64| {
            let reach = |random: &mut SplitMix64| random.between(-INVENTED_WITHIN_M, INVENTED_WITHIN_M);
            [reach(random), reach(random), random.between(-0.2, 0.2)]
        };
        let places = (0..INVENTED).map(|_| place(&mut random)).collect();
        let offset_m = [distance_m * direction.cos(), distance_m * direction.sin()];
        tracing::warn!(%cav, lie = lie.name(), "this vehicle has been told to LIE to its neighbours");
        Self { lie, random, offset_m, places, overheard: CapturedMessages::default() }
    }

    /// Another vehicle's words, for [`Falsification::Copied`].
    pub fn overhear(&mut self, overheard: CapturedMessages) {
        if self.lie == Falsification::Copied {
            self.overheard = overheard;
        }
    }

    fn anything(&mut self) -> Detection {
        let mut reach = || self.random.between(-INVENTED_WITHIN_M, INVENTED_WITHIN_M);
        let (x, y) = (reach(), reach());
        let heading = self.random.between(-3.1, 3.1);
        vehicle([x, y, heading], self.random.between(0.3, 1.0) as f32)
    }
}

impl OutputFilter for Attack {
    /// The pose it gives instead of its own.
    fn pose(&self, pose: PoseEstimate) -> PoseEstimate {
        let (Falsification::ShiftedPose, Some(own)) = (self.lie, pose.world_from_cav()) else { return pose };
        let [x, y, z] = own.translation_m;
        let [dx, dy] = self.offset_m;
        PoseEstimate::new(Pose { translation_m: [x + dx, y + dy, z], ..*own }, 1.0)
    }

    /// What it says to see instead of what it does.
    fn perception(&mut self, truth: Perception) -> Perception {
        let mut told = truth;
        match self.lie {
            Falsification::ShiftedPose => {}
            Falsification::Noise => {
                make_noise(&mut told.features, &mut self.random);
                told.confidence.fill_with(|| self.random.unit() as f32);
                told.detections = (0..2 * INVENTED).map(|_| self.anything()).collect();
            }
            Falsification::Copied => {
                let features = self.overheard.features.get_or_insert_with(|| told.features.clone());
                if features.values.len() == told.features.values.len() {
                    told.features = features.clone();
                }
                told.detections = self.overheard.detections.get_or_insert(told.detections).clone();
            }
            Falsification::Invented => {
                invent(&mut told.features, &mut told.confidence, &self.places);
                told.detections.extend(self.places.iter().map(|&place| vehicle(place, 0.9)));
            }
        }
        told
    }

    /// The points it says to have measured instead of its own.
    fn points(&mut self, truth: PointCloud) -> PointCloud {
        match self.lie {
            Falsification::ShiftedPose => truth,
            Falsification::Noise => {
                let random = &mut self.random;
                let any = |_: &[f32; 4]| {
                    [(40.0, -40.0), (40.0, -40.0), (0.5, -2.5), (1.0, 0.0)]
                        .map(|(high, low)| random.between(low, high) as f32)
                };
                PointCloud { xyzi: truth.xyzi.iter().map(any).collect() }
            }
            Falsification::Copied => self.overheard.points.get_or_insert(truth).clone(),
            Falsification::Invented => {
                let mut told = truth;
                for &place in &self.places {
                    points_of(place, &mut self.random, &mut told.xyzi);
                }
                told
            }
        }
    }
}

/// A car that stands on the road there, for a sensor 1.9 m above it.
fn vehicle([x, y, heading_rad]: [f64; 3], score: f32) -> Detection {
    Detection { box3d: Box3d { center_m: [x, y, -1.1], size_m: [4.4, 1.9, 1.6], heading_rad }, score, source: None }
}

/// Points on the sides of such a car.
fn points_of([x, y, heading]: [f64; 3], random: &mut SplitMix64, points: &mut Vec<[f32; 4]>) {
    let (sin, cos) = heading.sin_cos();
    for _ in 0..150 {
        let (along, across) = (random.between(-2.2, 2.2), random.between(-0.95, 0.95));
        let (along, across) =
            if random.chance(0.7) { (along, 0.95_f64.copysign(across)) } else { (2.2_f64.copysign(along), across) };
        let height = random.between(-1.8, -0.4);
        points.push(
            [x + cos * along - sin * across, y + sin * along + cos * across, height, 0.4].map(|value| value as f32),
        );
    }
}

/// Normal noise with the mean and the spread of each channel.
fn make_noise(features: &mut BevFeatures, random: &mut SplitMix64) {
    let cells = features.grid.cells().max(1);
    for channel in features.values.chunks_mut(cells) {
        let mean = channel.iter().map(|value| f64::from(*value)).sum::<f64>() / cells as f64;
        let variance = channel.iter().map(|value| (f64::from(*value) - mean).powi(2)).sum::<f64>() / cells as f64;
        let spread = variance.sqrt();
        channel.fill_with(|| (mean + spread * random.normal()) as f32);
    }
}

/// Puts what the map shows around its surest cell in other places, too, and more of it.
fn invent(features: &mut BevFeatures, confidence: &mut [f32], places: &[[f64; 3]]) {
    let BevGrid { width, height, .. } = features.grid;
    let (width, height) = (i64::from(width), i64::from(height));
    let cells = features.grid.cells();
    let surest =
        (confidence.iter().enumerate()).max_by(|one, other| one.1.total_cmp(other.1)).map(|(cell, _)| cell as i64);
    let Some(from) = surest else { return };
    let (from_row, from_column) = (from / width.max(1), from % width.max(1));
    let (original, original_confidence) = (features.values.clone(), confidence.to_vec());
    let mean = |channel: &[f32]| channel.iter().sum::<f32>() / cells.max(1) as f32;
    let means: Vec<f32> = original.chunks(cells.max(1)).map(mean).collect();
    let index = |row: i64, column: i64| {
        ((0..height).contains(&row) && (0..width).contains(&column)).then(|| (row * width + column) as usize)
    };
    for [x, y, _] in places {
        let column = ((x - features.grid.x_min_m) / features.grid.cell_m).floor() as i64;
        let row = ((y - features.grid.y_min_m) / features.grid.cell_m).floor() as i64;
        for (down, right) in
            (-PATCH_CELLS..=PATCH_CELLS).flat_map(|down| (-PATCH_CELLS..=PATCH_CELLS).map(move |right| (down, right)))
        {
            let (source, target) = (index(from_row + down, from_column + right), index(row + down, column + right));
            let (Some(source), Some(target)) = (source, target) else { continue };
            confidence[target] = original_confidence[source];
            for (channel, mean) in means.iter().enumerate() {
                let value = original[channel * cells + source];
                features.values[channel * cells + target] = mean + LOUDER * (value - mean);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn truth() -> Perception {
        let grid = BevGrid { x_min_m: -40.0, y_min_m: -40.0, cell_m: 0.8, width: 100, height: 100 };
        let values = (0..2 * grid.cells()).map(|cell| (cell % 97) as f32 * 0.1).collect();
        let mut confidence = vec![0.0; grid.cells()];
        confidence[5050] = 0.9;
        let features = BevFeatures { grid, channels: 2, code_of: None, values };
        Perception { features, confidence, detections: vec![], times: vec![] }
    }

    #[test]
    fn a_shifted_pose_is_off_by_the_same_every_time_and_sure_of_itself() {
        let attack = Attack::new(Falsification::ShiftedPose, &cav("a"), 1);
        let told = |x: f64| {
            let told = attack.pose(PoseEstimate::new(Pose::from_xyz_yaw([x, 0.0, 0.0], 0.3), 0.4));
            assert_eq!(told.confidence(), 1.0);
            let pose = *told.world_from_cav().unwrap();
            assert!(pose.validate().is_ok());
            [pose.translation_m[0] - x, pose.translation_m[1]]
        };
        let [dx, dy] = told(10.0);
        assert!((5.0..=30.0).contains(&dx.hypot(dy)));
        assert!((told(20.0)[0] - dx).abs() < 1e-9);
        let other = Attack::new(Falsification::ShiftedPose, &cav("b"), 1).offset_m;
        assert!(other != attack.offset_m, "every liar has its own");
    }

    #[test]
    fn what_is_told_has_the_shape_of_the_truth_and_other_values() {
        for lie in [Falsification::Noise, Falsification::Invented] {
            let told = Attack::new(lie, &cav("a"), 1).perception(truth());
            assert_eq!(told.features.values.len(), truth().features.values.len());
            assert!(told.features.values != truth().features.values && !told.detections.is_empty(), "{lie:?}");
            assert!(told.features.values.iter().all(|value| value.is_finite()));
        }
        let invented = Attack::new(Falsification::Invented, &cav("a"), 1).perception(truth());
        assert!(invented.confidence.iter().filter(|sure| **sure > 0.8).count() > 5);
    }

    #[test]
    fn a_copier_repeats_what_it_heard_or_what_it_saw_first() {
        let mut attack = Attack::new(Falsification::Copied, &cav("a"), 1);
        let later = || {
            let mut later = truth();
            later.features.values.fill(1.0);
            later
        };
        assert_eq!(attack.perception(truth()).features, truth().features);
        assert_eq!(attack.perception(later()).features, truth().features);
        let heard = CapturedMessages { features: Some(later().features), ..CapturedMessages::default() };
        attack.overhear(heard);
        assert_eq!(attack.perception(truth()).features, later().features);
    }
}
