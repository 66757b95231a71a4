//! Alignment error: the part of a known pose offset between two vehicles that a method's own alignment leaves.
//!
//! An offset of known size is added to the true pose of a neighbour, in a direction drawn by a seed; the method's
//! correction of the neighbour's map is applied to it, and both poses are compared with the true one.

use std::f64::consts::TAU;

use dataset::frame::Frame;
use dataset::{LeftOut, LoadOptions, Scenario, ground_truth};
use perception::detector::Detector;
use perception::weights::Weights;
use protocol::{PointCloud, Pose};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use support::statistics;
use tch::{Device, Kind, Tensor, no_grad};

use ego_fuser::ego::EgoError;
use fusion::method::Method;
use fusion::model::FusionStage;
use fusion::planar_pose::moved;
use fusion::{MapMetadata, ReceivedMaps};
use training::samples::PoseOffset;

/// Reason why nothing is measured.
#[derive(Debug, thiserror::Error)]
pub enum AlignmentMeterError {
    /// The weights are not usable, or the network reported an error.
    #[error(transparent)]
    Ego(#[from] EgoError),
    /// The fusion has no alignment to measure.
    #[error("the fusion of these weights has no alignment of its own")]
    NoAlignment,
}

/// An offset added to the pose of a neighbour.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Offset {
    /// Distance, metres.
    pub shift_m: f64,
    /// Angle, degrees, to either side.
    pub turn_deg: f64,
}

/// Errors of relative poses before and after a method's own alignment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlignmentError {
    /// Offset added to true poses.
    pub offset: Offset,
    /// Pairs of vehicles.
    pub pairs: usize,
    /// Mean distance from the true position before and after, metres.
    pub mean_m: [f64; 2],
    /// Median of the same, metres.
    pub p50_m: [f64; 2],
    /// Mean angle before and after, degrees.
    pub mean_deg: [f64; 2],
}

/// Encoder and fusion of a weights file.
#[derive(Debug)]
pub struct AlignmentMeter {
    detector: Detector,
    fusion: FusionStage,
}

impl AlignmentMeter {
    /// Reads the weights.
    ///
    /// # Errors
    /// [`EgoError`] names the file and what is wrong with it.
    pub fn load(weights: &Weights) -> Result<Self, EgoError> {
        let method = Method::of_weights(weights, None)?;
        let detector = Detector::from_weights(weights, &weights.detector_config()?, Device::Cpu)?;
        let fusion = FusionStage::from_weights(weights, method, detector.config(), Device::Cpu)?;
        Ok(Self { detector, fusion })
    }

    /// Measures on every `every`-th tick of scenarios, each with its communication range, metres, the first vehicle being
    /// the ego; the same directions for the same seed. Frames that cannot be read are added to `left_out`.
    ///
    /// # Errors
    /// [`AlignmentMeterError`] at the first frame that cannot be computed, and when the fusion has no alignment of its
    /// own.
    pub fn measure(
        &mut self,
        scenarios: &[(Scenario, f64)],
        every: usize,
        offsets: &[Offset],
        seed: u64,
        left_out: &mut LeftOut,
    ) -> Result<Vec<AlignmentError>, AlignmentMeterError> {
        let mut errors: Vec<Vec<[[f64; 2]; 2]>> = offsets.iter().map(|_| Vec::new()).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for (scenario, comm_range_m) in scenarios {
            for tick in (0..scenario.ticks.len()).step_by(every.max(1)) {
                for pair in self.pairs((scenario, *comm_range_m), tick, left_out)? {
                    // Directions come from one generator: the order of these loops is part of the result.
                    for (offset, errors) in offsets.iter().zip(&mut errors) {
                        errors.push(self.around(&pair, offset, &mut rng)?);
                    }
                }
            }
        }
        let measured = offsets.iter().zip(&errors);
        let summaries = measured.map(|(offset, errors)| summary(offset, errors));
        Ok(summaries.collect())
    }

    /// The ego with each of its neighbours in range: two maps, and the true pose of the second.
    fn pairs(
        &mut self,
        (scenario, comm_range_m): (&Scenario, f64),
        tick: usize,
        left_out: &mut LeftOut,
    ) -> Result<Vec<(Tensor, Pose)>, AlignmentMeterError> {
        let agents = scenario.present_agents(tick);
        let loaded = scenario.load_tick(tick, agents, &LoadOptions::default());
        left_out.add_tick(&loaded);
        // Agent 0 is the ego: without its frame there is no pair.
        if loaded.frames.first().is_none_or(|(agent, _)| *agent != 0) {
            return Ok(Vec::new());
        }
        let frames: Vec<&Frame> = loaded.frames.iter().map(|(_, frame)| frame).collect();
        let near = ground_truth::contributors(&frames, 0, comm_range_m).into_iter();
        let mut near =
            near.filter_map(|index| Some((frames[index], frames[index].world_from_lidar?)));
        let Some((ego, world_from_ego)) = near.next() else {
            return Ok(Vec::new());
        };
        let own = self.map(&ego.points)?;
        let mut pairs = Vec::new();
        for (frame, world_from_cav) in near {
            let maps =
                Tensor::f_cat(&[&own, &self.map(&frame.points)?], 0).map_err(EgoError::from)?;
            pairs.push((maps, world_from_ego.from_world(&world_from_cav)));
        }
        Ok(pairs)
    }

    /// The map `[1, C, H, W]` of a sweep as other vehicles receive it.
    fn map(&mut self, points: &PointCloud) -> Result<Tensor, EgoError> {
        let encoded = self.detector.encode(points)?.features;
        Ok(self.detector.through_compressor(&encoded)?)
    }

    /// Errors of a pair with an offset, before and after: metres and degrees.
    fn around(
        &self,
        (maps, ego_from_cav): &(Tensor, Pose),
        offset: &Offset,
        rng: &mut impl Rng,
    ) -> Result<[[f64; 2]; 2], AlignmentMeterError> {
        let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
        let turn_rad = offset.turn_deg.to_radians() * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let shift = [offset.shift_m * cos, offset.shift_m * sin, turn_rad];
        let off = moved(ego_from_cav, shift);
        let correction = self.correction(maps, off)?;
        let corrected = moved(&off, correction.ok_or(AlignmentMeterError::NoAlignment)?);
        Ok([off, corrected].map(|found| error(ego_from_cav, &found)))
    }

    /// The method's correction of the pose of the second of two maps: x and y, metres, and heading, radians.
    fn correction(&self, maps: &Tensor, reported: Pose) -> Result<Option<[f64; 3]>, EgoError> {
        let facts = [
            MapMetadata::fresh(0, Pose::IDENTITY),
            MapMetadata::fresh(1, reported),
        ];
        let fused = no_grad(|| {
            let received = ReceivedMaps::new(maps.shallow_clone(), None);
            self.fusion.fuse(&self.fusion.align(&received, &facts)?)
        })?;
        let Some(correction) = fused.corrections else {
            return Ok(None);
        };
        let values: Vec<f64> = Vec::try_from(correction.f_to_kind(Kind::Double)?.f_view([-1])?)?;
        Ok(values.first_chunk().copied())
    }
}

/// Distance in the plane, metres, and angle, degrees.
fn error(truth: &Pose, found: &Pose) -> [f64; 2] {
    let PoseOffset([dx, dy, turn_rad]) = PoseOffset::between(found, truth);
    [dx.hypot(dy), turn_rad.abs().to_degrees()]
}

fn summary(offset: &Offset, errors: &[[[f64; 2]; 2]]) -> AlignmentError {
    let [mean_m, mean_deg] = [0, 1].map(|which| {
        [0, 1].map(|moment| {
            let values = errors.iter().map(|error| error[moment][which]);
            values.sum::<f64>() / errors.len().max(1) as f64
        })
    });
    let p50_m = [0, 1].map(|moment| {
        let metres: Vec<f64> = errors.iter().map(|error| error[moment][0]).collect();
        statistics::median(&metres).unwrap_or(0.0)
    });
    AlignmentError {
        offset: *offset,
        pairs: errors.len(),
        mean_m,
        p50_m,
        mean_deg,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offset_is_its_own_error_and_its_opposite_takes_it_away() {
        let truth = Pose::from_xyz_yaw([20.0, -5.0, 0.3], 3.1);
        let off = moved(&truth, [0.6, -0.8, 0.1]);
        let [distance_m, angle_deg] = error(&truth, &off);
        assert!((distance_m - 1.0).abs() < 1e-9 && (angle_deg - 0.1_f64.to_degrees()).abs() < 1e-6);
        let [distance_m, angle_deg] = error(&truth, &moved(&off, [-0.6, 0.8, -0.1]));
        assert!(distance_m < 1e-9 && angle_deg < 1e-6);
    }

    #[test]
    fn before_and_after_are_summed_up_apart() {
        let offset = Offset {
            shift_m: 1.0,
            turn_deg: 0.0,
        };
        let found = summary(
            &offset,
            &[
                [[1.0, 0.0], [0.5, 0.2]],
                [[1.0, 0.0], [0.1, 0.0]],
                [[1.0, 0.0], [0.3, 0.1]],
            ],
        );
        assert_eq!((found.pairs, found.p50_m), (3, [1.0, 0.3]));
        assert!((found.mean_m[1] - 0.3).abs() < 1e-9 && (found.mean_deg[1] - 0.1).abs() < 1e-9);
    }
}
