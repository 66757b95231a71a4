//! Neighbours' boxes in samples: some neighbours send what their own network detects in place of their map, and not all of
//! it is true.

use std::f64::consts::TAU;

use fusion::MapMetadata;
use fusion::box_input::{PlacedBox, placed};
use fusion::model::CooperativeModel;
use perception::tensor_values::tensor;
use protocol::{Box3d, Detection, Pose};
use rand::Rng;
use tch::Tensor;

use super::builder::Views;
use super::loader::Batch;
use super::refined_boxes::refined_boxes;
use crate::Error;

/// Share of the neighbours in training that send boxes only; the others send their map.
const BOXES_ONLY: f64 = 0.7;
/// Share of the boxes that are lost.
const LOST: f64 = 0.1;
/// Shares of the samples with a wrong pose of each neighbour, and with the same error of all.
const SHIFTED: [f64; 2] = [0.3, 0.3];
/// Largest errors of such a pose: metres in the plane, metres in height, degrees.
const LARGEST_SHIFT: [f64; 3] = [2.5, 1.0, 5.0];
/// Share of these whose sender is overconfident.
const OVERCONFIDENT: f64 = 0.2;
/// Share of the neighbours that invent boxes, and the largest number of these.
const INVENTING: (f64, usize) = (0.1, 4);
/// Share of the neighbours whose boxes are late, and the largest age, seconds.
const LATE: (f64, f64) = (0.5, 0.5);
/// Largest error of the velocity by which a late box was carried to the time of the frame, metres per second: of most
/// boxes, and of vehicles without a track.
const CARRIED_MPS: [f64; 2] = [2.0, 12.0];
/// Share of the vehicles without a track.
const UNTRACKED: f64 = 0.15;

/// Augmentation of neighbours' boxes in training, for the model card.
pub(crate) fn augmentation_summary() -> String {
    let ([of_each, of_all], [plane_m, _, turn_deg]) = (SHIFTED, LARGEST_SHIFT);
    let ((late, late_s), [tracked_mps, untracked_mps]) = (LATE, CARRIED_MPS);
    let [boxes_only, lost, shifted, late, inventing] =
        [BOXES_ONLY, LOST, of_each + of_all, late, INVENTING.0]
            .map(|share| (100.0 * share).round());
    format!(
        "{boxes_only} % send boxes in place of their map: {lost} % of the boxes lost, poses up to {plane_m} m and \
         {turn_deg} degrees off in {shifted} % of the samples, boxes of {late} % of the neighbours up to {late_s} s late \
         and displaced by up to {tracked_mps} to {untracked_mps} m/s, invented boxes of {inventing} %"
    )
}

/// A sample's maps, their metadata, and the boxes of neighbours without a map.
pub(crate) type SampleWithBoxes = (Tensor, Vec<MapMetadata>, Vec<PlacedBox>);

impl Batch {
    /// The samples with boxes, and the losses of the refinement of each vehicle's boxes. With `rng`, some neighbours send
    /// boxes, with all errors; without, all do, as detected.
    pub(crate) fn with_boxes(
        &self,
        model: &CooperativeModel,
        mut rng: Option<&mut impl Rng>,
    ) -> Result<(Vec<SampleWithBoxes>, Vec<Tensor>), Error> {
        let Views::Maps(maps) = &self.views else {
            return Err(Error::NothingToFreeze);
        };
        let maps = maps.f_to_device(model.device())?;
        // Maps are stored as they are before the compressor.
        let maps = model.network.through_compressor(&maps, false);
        let mut first = 0;
        let (mut samples, mut refinement_losses) = (Vec::new(), Vec::new());
        for (facts, truth) in self.facts.iter().zip(&self.truth) {
            let of_sample = maps.f_narrow(0, first, facts.len() as i64)?;
            first += facts.len() as i64;
            let agents = facts.iter().map(|fact| fact.agent + 1).max().unwrap_or(0);
            let mut found = vec![Vec::new(); agents];
            for (agent, boxes) in found.iter_mut().enumerate() {
                if let Some(index) = newest_of(agent, facts) {
                    let map = of_sample.f_narrow(0, index as i64, 1)?;
                    let pose = &facts[index].ego_from_cav;
                    let (refined, loss) = refined_boxes(model, &map, pose, truth)?;
                    refinement_losses.extend(loss);
                    *boxes = refined;
                }
            }
            let rng = rng.as_deref_mut();
            samples.push(sample(model, &of_sample, facts, &found, rng)?);
        }
        Ok((samples, refinement_losses))
    }
}

/// Index of the newest map of an agent.
fn newest_of(agent: usize, facts: &[MapMetadata]) -> Option<usize> {
    facts.iter().position(|fact| fact.agent == agent)
}

/// A sample in which some of the agents send what they have `found`.
fn sample(
    model: &CooperativeModel,
    maps: &Tensor,
    facts: &[MapMetadata],
    found: &[Vec<Detection>],
    mut rng: Option<&mut impl Rng>,
) -> Result<SampleWithBoxes, Error> {
    let agents = found.len();
    // The ego always has its own map.
    let sends_boxes = (0..agents).map(|agent| {
        agent > 0
            && rng
                .as_deref_mut()
                .is_none_or(|rng| rng.random_bool(BOXES_ONLY))
    });
    let sends_boxes: Vec<bool> = sends_boxes.collect();
    let shifts: Vec<Shift> = match rng.as_deref_mut() {
        Some(rng) => Shift::draw_all(agents, rng),
        None => vec![Shift::default(); agents],
    };
    let mut boxes = Vec::new();
    for (agent, shift) in (0..agents).zip(&shifts) {
        let Some(index) = newest_of(agent, facts).filter(|_| sends_boxes[agent]) else {
            continue;
        };
        let mut of_agent = shift.placed(&found[agent], agent, &facts[index]);
        if let Some(rng) = rng.as_deref_mut() {
            of_agent.retain(|_| !rng.random_bool(LOST));
            if rng.random_bool(INVENTING.0) {
                of_agent.append(&mut invented(model, agent, facts[index].age_secs, rng));
            }
            if rng.random_bool(LATE.0) {
                let age_secs = rng.random_range(0.0..LATE.1);
                of_agent
                    .iter_mut()
                    .for_each(|placed| carry(placed, age_secs, rng));
            }
        }
        boxes.append(&mut of_agent);
    }
    // The others, numbered without gaps.
    let kept = (0..facts.len()).filter(|&index| !sends_boxes[facts[index].agent]);
    let kept: Vec<usize> = kept.collect();
    let indices: Vec<i64> = kept.iter().map(|&index| index as i64).collect();
    let maps = maps.f_index_select(0, &tensor(&indices, &[-1], maps.device())?)?;
    let facts = kept.into_iter().map(|index| {
        let before = sends_boxes[..facts[index].agent].iter();
        MapMetadata {
            agent: before.filter(|boxes| !**boxes).count(),
            ..facts[index]
        }
    });
    Ok((maps, facts.collect(), boxes))
}

/// Makes a box late: it was carried to the time of the frame by a velocity with an error.
fn carry(placed: &mut PlacedBox, age_secs: f64, rng: &mut impl Rng) {
    let [tracked_mps, untracked_mps] = CARRIED_MPS;
    let most_mps = match rng.random_bool(UNTRACKED) {
        true => untracked_mps,
        false => tracked_mps,
    };
    let off_m = rng.random_range(-most_mps..most_mps) * age_secs;
    // Along the heading, in which a vehicle moves; forwards or backwards.
    let (sin, cos) = placed.box3d.heading_rad.sin_cos();
    placed.box3d.center_m[0] += off_m * cos;
    placed.box3d.center_m[1] += off_m * sin;
    placed.age_secs += age_secs;
}

/// Boxes anywhere in the area, in the frame of the ego.
fn invented(
    model: &CooperativeModel,
    sender: usize,
    age_secs: f64,
    rng: &mut impl Rng,
) -> Vec<PlacedBox> {
    let [x0, y0, _, x1, y1, _] = model.config().lidar_range_m;
    let count = rng.random_range(1..=INVENTING.1);
    let boxes = (0..count).map(|_| PlacedBox {
        box3d: Box3d {
            center_m: [
                rng.random_range(x0..x1),
                rng.random_range(y0..y1),
                rng.random_range(-1.5..-0.5),
            ],
            size_m: [rng.random_range(3.5..5.0), rng.random_range(1.5..2.1), 1.6],
            heading_rad: rng.random_range(0.0..TAU),
        },
        sender,
        age_secs,
        score: rng.random_range(0.2..1.0),
        pose_confidence: 1.0,
    });
    boxes.collect()
}

/// Error of a sender's pose that is not in its metadata, and what is left of its confidence.
#[derive(Debug, Clone, Copy)]
struct Shift {
    by_m: [f64; 3],
    turn_rad: f64,
    confidence: f64,
}

impl Default for Shift {
    fn default() -> Self {
        Self {
            by_m: [0.0; 3],
            turn_rad: 0.0,
            confidence: 1.0,
        }
    }
}

impl Shift {
    /// The errors of all vehicles of a sample.
    fn draw_all(agents: usize, rng: &mut impl Rng) -> Vec<Self> {
        let [of_each, of_all] = SHIFTED;
        // One draw decides among errors of each, a common error and none.
        let draw: f64 = rng.random();
        if draw < of_each {
            return (0..agents).map(|_| Self::draw(rng)).collect();
        }
        let common = match draw < of_each + of_all {
            true => Self::draw(rng),
            false => Self::default(),
        };
        vec![common; agents]
    }

    fn draw(rng: &mut impl Rng) -> Self {
        let [plane_m, height_m, turn_deg] = LARGEST_SHIFT;
        let distance_m = rng.random_range(0.0..plane_m);
        let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
        let up_m = rng.random_range(-height_m..height_m);
        let confidence = match rng.random_bool(OVERCONFIDENT) {
            true => 1.0,
            // As a noisy pose source states it.
            false => 1.0 / (1.0 + distance_m.powi(2) + up_m.powi(2)),
        };
        Self {
            by_m: [distance_m * cos, distance_m * sin, up_m],
            turn_rad: rng.random_range(-turn_deg..turn_deg).to_radians(),
            confidence,
        }
    }

    /// The boxes of a sender whose pose has this error.
    fn placed(&self, found: &[Detection], sender: usize, fact: &MapMetadata) -> Vec<PlacedBox> {
        let pose = &fact.ego_from_cav;
        let translation_m = std::array::from_fn(|axis| pose.translation_m[axis] + self.by_m[axis]);
        // Without a turn roll and pitch are kept; a planar pose has none.
        let moved = match self.turn_rad == 0.0 {
            true => Pose {
                translation_m,
                ..*pose
            },
            false => Pose::from_xyz_yaw(translation_m, pose.yaw_rad() + self.turn_rad),
        };
        let confidence = fact.confidence * self.confidence;
        placed(found.iter(), &moved, sender, fact.age_secs, confidence)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn errors_of_poses_are_of_each_of_all_or_of_none() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut none, mut same, mut own) = (0, 0, 0);
        for _ in 0..500 {
            let drawn = Shift::draw_all(3, &mut rng);
            match (drawn[0].by_m == [0.0; 3], drawn[0].by_m == drawn[1].by_m) {
                (true, _) => none += 1,
                (_, true) => same += 1,
                _ => own += 1,
            }
            let [x, y, z] = drawn[0].by_m;
            assert!(x.hypot(y) <= 2.5 && z.abs() <= 1.0 && drawn[0].turn_rad.abs() < 0.09);
            assert!((0.0..=1.0).contains(&drawn[0].confidence));
        }
        assert!(
            [none, same, own].iter().all(|count| *count > 100),
            "{none} {same} {own}"
        );
    }

    #[test]
    fn a_shift_moves_boxes_and_lowers_the_confidence() {
        let fact = MapMetadata {
            age_secs: 0.3,
            confidence: 0.8,
            ..MapMetadata::fresh(1, Pose::from_xyz_yaw([10.0, 0.0, 0.0], 0.0))
        };
        let found = Detection {
            box3d: Box3d {
                center_m: [5.0, 0.0, -1.0],
                size_m: [4.0, 2.0, 1.5],
                heading_rad: 0.0,
            },
            score: 0.5,
            source: None,
        };
        let shift = Shift {
            by_m: [1.0, -2.0, 0.5],
            turn_rad: 0.0,
            confidence: 0.5,
        };
        let [placed] = shift.placed(&[found], 1, &fact)[..] else {
            panic!("one box");
        };
        assert_eq!(placed.box3d.center_m, [16.0, -2.0, -0.5]);
        assert_eq!((placed.age_secs, placed.pose_confidence), (0.3, 0.4));
    }
}
