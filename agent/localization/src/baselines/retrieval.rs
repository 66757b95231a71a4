//! Retrieval: the pose of the training sweep that looks most alike, the floor of every localizer that regresses.
//!
//! A regression that does not beat it has learnt less than the poses of its training sweeps (Sattler et al. 2019).

use nalgebra::Isometry3;
use protocol::NoPoseReason;

use super::regressed_pose::localization;
use crate::pgc::localization::SOLVE;
use crate::pgc::{Localization, Localize, Localizer, LocalizerError, LocalizerInput, stopwatch};

/// Smallest deviation of a channel: constant ones are scaled as if they had this one.
const LEAST_DEVIATION: f32 = 1e-4;

/// Descriptors of sweeps with their poses.
#[derive(Debug, Clone)]
pub struct SweepDatabase {
    mean: Vec<f32>,
    scale: Vec<f32>,
    /// Normalised, one after another.
    descriptors: Vec<f32>,
    world_from_sensor: Vec<Isometry3<f64>>,
}

impl SweepDatabase {
    /// A database of sweeps: features of the whole sweep, `[sweep_channels]`, and true pose of its sensor, metres. `None` if
    /// there is none or they have no features.
    pub fn new(sweeps: &[(Vec<f32>, Isometry3<f64>)]) -> Option<Self> {
        let channels = Some(sweeps.first()?.0.len()).filter(|&channels| channels > 0)?;
        let mean = (0..channels).map(|channel| mean_of(sweeps, |of| of[channel]));
        let mean: Vec<f32> = mean.collect();
        let variances = (0..channels)
            .map(|channel| mean_of(sweeps, |of| (of[channel] - mean[channel]).powi(2)));
        let scale = variances.map(|variance| 1.0 / variance.sqrt().max(LEAST_DEVIATION));
        let mut database = Self {
            scale: scale.collect(),
            mean,
            descriptors: Vec::new(),
            world_from_sensor: sweeps.iter().map(|(_, pose)| *pose).collect(),
        };
        let normalised = sweeps
            .iter()
            .flat_map(|(descriptor, _)| database.normalise(descriptor));
        database.descriptors = normalised.collect();
        Some(database)
    }

    /// Pose of the sweep whose descriptor is nearest.
    pub fn nearest(&self, descriptor: &[f32]) -> Isometry3<f64> {
        let wanted = self.normalise(descriptor);
        let stored = self.descriptors.chunks_exact(self.mean.len());
        let squared = stored.map(|stored| {
            let squares = stored.iter().zip(&wanted).map(|(a, b)| (a - b).powi(2));
            squares.sum::<f32>()
        });
        let nearest = squared.enumerate().min_by(|(_, a), (_, b)| a.total_cmp(b));
        nearest.map_or_else(Isometry3::identity, |(row, _)| self.world_from_sensor[row])
    }

    fn normalise(&self, descriptor: &[f32]) -> Vec<f32> {
        let channels = descriptor.iter().zip(&self.mean).zip(&self.scale);
        let normalised = channels.map(|((value, mean), scale)| (value - mean) * scale);
        normalised.collect()
    }
}

/// Retrieval with the features of the localizer's encoder as descriptor.
#[derive(Debug)]
pub struct Retrieval {
    /// Localizer whose encoder describes the sweeps.
    pub localizer: Localizer,
    /// Database of descriptors of the same localizer ([`Localizer::sweep_features`]).
    pub database: SweepDatabase,
}

impl Localize for Retrieval {
    /// Every pose has full confidence: nothing tells a good one from a bad one.
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let Some(descriptor) = self.localizer.sweep_features(sweep.cloud, &mut times)? else {
            return Ok(Localization::no_pose(NoPoseReason::TooFewPoints, times));
        };
        let pose = self.database.nearest(&descriptor);
        times.lap(SOLVE);
        Ok(localization(Some(pose), times))
    }
}

fn mean_of(sweeps: &[(Vec<f32>, Isometry3<f64>)], value: impl Fn(&[f32]) -> f32) -> f32 {
    let values = sweeps.iter().map(|(descriptor, _)| value(descriptor));
    values.sum::<f32>() / sweeps.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(x: f64) -> Isometry3<f64> {
        Isometry3::translation(x, 0.0, 0.0)
    }

    fn sweep(descriptor: &[f32], x: f64) -> (Vec<f32>, Isometry3<f64>) {
        (descriptor.to_vec(), place(x))
    }

    #[test]
    fn the_nearest_descriptor_is_found_whatever_the_scale_of_a_channel() {
        let sweeps = [
            sweep(&[0.0, 1000.0], 1.0),
            sweep(&[1.0, 1001.0], 2.0),
            sweep(&[0.5, 3000.0], 3.0),
        ];
        let database = SweepDatabase::new(&sweeps).unwrap();
        assert_eq!(database.nearest(&[0.9, 1300.0]), place(2.0));
        assert_eq!(database.nearest(&[0.9, 2900.0]), place(3.0));
        assert!(
            SweepDatabase::new(&[]).is_none() && SweepDatabase::new(&[sweep(&[], 0.0)]).is_none()
        );
    }
}
