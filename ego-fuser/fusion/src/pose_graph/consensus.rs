//! Consensus matching: assigns an agent's boxes to objects by the motion near its pose with the most inliers.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::config::PoseGraphConfig;
use crate::planar_fit;

/// Two boxes nearer than this determine no heading, metres.
const MIN_EDGE_M: f64 = 2.0;
/// Margin by which the score of the best motion must exceed that of any other; every box counts up to one.
const MIN_LEAD: f64 = 0.5;

/// A motion with its inliers.
pub(super) struct ConsensusMotion {
    /// Transforms points of the agent's frame to the ego's.
    pub(super) motion: Isometry3<f64>,
    /// Pairs of object and box.
    pub(super) matches: Vec<(usize, usize)>,
    /// One for every box that fits exactly, less for those that fit less, less for a motion far from the prior.
    pub(super) score: f64,
}

/// A point after a motion.
pub(super) fn moved(motion: &Isometry3<f64>, point: &Vector3<f64>) -> Vector3<f64> {
    motion.rotation * point + motion.translation.vector
}

/// Mean distance between the places of some points after two motions.
pub(super) fn apart<'a>(
    points: impl ExactSizeIterator<Item = &'a Vector3<f64>>,
    one: &Isometry3<f64>,
    other: &Isometry3<f64>,
) -> f64 {
    let count = points.len().max(1) as f64;
    let distances = points.map(|point| (moved(one, point) - moved(other, point)).norm());
    distances.sum::<f64>() / count
}

/// Matches boxes with objects; both lie at height zero.
pub(super) fn consensus(
    objects: &[Vector3<f64>],
    boxes: &[Vector3<f64>],
    prior: &Isometry3<f64>,
    config: &PoseGraphConfig,
) -> Option<ConsensusMotion> {
    // Pairs of object and box that may match at the uncorrected pose.
    let mut candidates = Vec::new();
    for (index, center) in boxes.iter().enumerate() {
        let place = moved(prior, center);
        let near = (0..objects.len()).filter(|&at| (objects[at] - place).norm() < config.search_m);
        candidates.extend(near.map(|object| (object, index)));
    }
    let search = MotionSearch {
        objects,
        boxes,
        prior,
        config,
        candidates,
    };
    let motions = search.motions();
    let (best, score) = motions
        .iter()
        .max_by(|one, other| one.1.total_cmp(&other.1))?;
    // A different motion that fits almost as well makes the match ambiguous: then none is used.
    let far_m = 2.0 * config.fit_tolerance_m;
    let rival = motions
        .iter()
        .filter(|(other, _)| apart(boxes.iter(), best, other) > far_m);
    let rival = rival.map(|(_, score)| *score);
    if rival.fold(f64::NEG_INFINITY, f64::max) + MIN_LEAD > *score {
        return None;
    }
    let refined = search.refined(*best);
    let matches = search.matches(&refined);
    (matches.len() >= config.min_shared.max(2)).then(|| ConsensusMotion {
        score: search.score(&refined, &matches),
        matches,
        motion: refined,
    })
}

struct MotionSearch<'a> {
    objects: &'a [Vector3<f64>],
    boxes: &'a [Vector3<f64>],
    prior: &'a Isometry3<f64>,
    config: &'a PoseGraphConfig,
    candidates: Vec<(usize, usize)>,
}

impl MotionSearch<'_> {
    /// Motion and score by each pair of candidates, where it is within bounds and has enough inliers.
    fn motions(&self) -> Vec<(Isometry3<f64>, f64)> {
        let candidates = self.candidates.iter().enumerate();
        let pairs = candidates.flat_map(|(index, &first)| {
            let later = self.candidates[index + 1..].iter();
            later.map(move |&second| (first, second))
        });
        let motions = pairs.filter_map(|(first, second)| {
            let motion = self.motion(first, second)?;
            let matches = self.matches(&motion);
            let are_enough = matches.len() >= self.config.min_shared.max(2);
            are_enough.then(|| (motion, self.score(&motion, &matches)))
        });
        motions.collect()
    }

    fn motion(&self, first: (usize, usize), second: (usize, usize)) -> Option<Isometry3<f64>> {
        if first.0 == second.0 || first.1 == second.1 {
            return None;
        }
        // Rigid motion keeps distances: pairs of clearly different length are not the same two objects.
        let edge = self.objects[second.0] - self.objects[first.0];
        let seen = self.prior.rotation * (self.boxes[second.1] - self.boxes[first.1]);
        let fits = (edge.norm() - seen.norm()).abs() < self.config.fit_tolerance_m;
        if !fits || edge.norm().min(seen.norm()) < MIN_EDGE_M {
            return None;
        }
        // Relative to the prior, whose rotation `seen` has already.
        let turn = seen.xy().perp(&edge.xy()).atan2(seen.dot(&edge));
        if turn.abs() > self.config.max_turn_deg.to_radians() {
            return None;
        }
        let rotation =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn) * self.prior.rotation;
        let middle = (self.objects[first.0] + self.objects[second.0]) / 2.0;
        let from = rotation * (self.boxes[first.1] + self.boxes[second.1]) / 2.0;
        let shift = Translation3::from(middle - from);
        Some(Isometry3::from_parts(shift, rotation))
    }

    /// Candidates that a motion aligns, each box and each object once, the nearest first.
    fn matches(&self, motion: &Isometry3<f64>) -> Vec<(usize, usize)> {
        let candidates = self.candidates.iter();
        let distances = candidates.map(|&(object, index)| {
            let distance = self.distance(motion, object, index);
            (distance, (object, index))
        });
        let near = distances.filter(|(distance, _)| *distance < self.config.fit_tolerance_m);
        planar_fit::one_to_one(near.collect())
    }

    fn distance(&self, motion: &Isometry3<f64>, object: usize, index: usize) -> f64 {
        (self.objects[object] - moved(motion, &self.boxes[index])).norm()
    }

    fn score(&self, motion: &Isometry3<f64>, matches: &[(usize, usize)]) -> f64 {
        let fits = matches.iter().map(|&(object, index)| {
            1.0 - (self.distance(motion, object, index) / self.config.fit_tolerance_m).powi(2)
        });
        // A weak prior: moving the boxes by the whole search range costs as much as one exact match.
        let off = apart(self.boxes.iter(), motion, self.prior) / self.config.search_m;
        fits.sum::<f64>() - off * off
    }

    /// The best fit to the inliers of a motion.
    fn refined(&self, motion: Isometry3<f64>) -> Isometry3<f64> {
        let matches = self.matches(&motion);
        let pairs = matches
            .iter()
            .map(|&(object, index)| (self.boxes[index], self.objects[object]));
        planar_fit::fit(&pairs).unwrap_or(motion)
    }
}
