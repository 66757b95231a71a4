//! Poses of a sample's vehicles: recorded or localised, with an optional error.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use dataset::frame::Frame;
use fusion::planar_pose::moved;
use localization::pose_source::{NoisyPose, NoisyPoseConfig, PoseSourceError, PoseTable};
use protocol::config::within;
use protocol::{CavId, Pose, PoseEstimate};
use rand::Rng;

use crate::Error;

/// Poses of samples: the recording's, or those of a pose generator; some samples with an added error.
#[derive(Debug, Clone, Default)]
pub struct SamplePoses {
    /// Localised poses, in place of the recording's; each table covers some of the scenarios.
    pub tables: Vec<Arc<PoseTable>>,
    /// Added error; its seed is drawn anew for every sample.
    pub noise: Option<NoisyPoseConfig>,
    /// Share of the samples that have that error.
    pub noise_share: f64,
    /// Share of the samples in which one neighbour has a wrong pose and is overconfident.
    pub lost_share: f64,
}

/// Distance of such a neighbour from its reported position, metres.
const LOST_M: std::ops::Range<f64> = 5.0..30.0;

impl SamplePoses {
    /// Checks the settings of the error.
    ///
    /// # Errors
    /// [`PoseSourceError`] names the field.
    pub fn validate(&self) -> Result<(), PoseSourceError> {
        within("noise_share", self.noise_share, 0.0, 1.0)?;
        within("lost_share", self.lost_share, 0.0, 1.0)?;
        self.noise.as_ref().map(NoisyPose::new).transpose()?;
        Ok(())
    }

    /// Draws the error of one sample.
    pub(super) fn draw(&self, rng: &mut impl Rng) -> Result<DrawnError, Error> {
        // One draw fewer where the share is all or nothing: earlier samples stay the same.
        let is_lost = self.lost_share > 0.0 && rng.random_bool(self.lost_share);
        let lost = is_lost.then(|| Lost::draw(rng));
        let is_noisy = self.noise_share >= 1.0 || rng.random_bool(self.noise_share);
        // Drawn in any case: later draws are the same with and without noise.
        let seed = rng.random();
        let noise = self.noise.clone().filter(|_| is_noisy);
        let spares_ego = noise.as_ref().is_some_and(|noise| noise.mode.spares_ego());
        let noise = noise.map(|noise| NoisyPose::new(&NoisyPoseConfig { seed, ..noise }));
        Ok(DrawnError {
            noise: noise.transpose()?,
            spares_ego,
            lost,
        })
    }

    /// Pose of a vehicle without the added error.
    pub(super) fn found(&self, scenario: &str, frame: &Frame) -> Result<PoseEstimate, Error> {
        let (cav, nanos, real) = (&frame.cav, frame.capture_nanos, frame.world_from_lidar);
        let found = match self.tables.as_slice() {
            [] => real.map(|pose| PoseEstimate::new(pose, 1.0)),
            tables => tables
                .iter()
                .find_map(|table| table.get(scenario, cav, nanos).copied()),
        };
        found.ok_or_else(|| without_pose(scenario, frame))
    }
}

/// Correction that moves a map with a wrong pose to its place: a shift along x and y of the ego, metres, and a rotation
/// about the map's sender, radians.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PoseOffset(pub [f64; 3]);

impl PoseOffset {
    /// The offset between a sender's reported and true pose, both in the ego frame.
    pub fn between(reported: &Pose, real: &Pose) -> Self {
        let [dx, dy] = [0, 1].map(|axis| real.translation_m[axis] - reported.translation_m[axis]);
        let turn_rad = real.yaw_rad() - reported.yaw_rad();
        // Sine and cosine wrap the difference into half a turn to either side.
        Self([dx, dy, turn_rad.sin().atan2(turn_rad.cos())])
    }
}

/// The error of the poses of one sample.
#[derive(Debug)]
pub(super) struct DrawnError {
    noise: Option<NoisyPose>,
    /// The reference code leaves the ego exact where all others have the same offset.
    spares_ego: bool,
    lost: Option<Lost>,
}

/// A neighbour with a wrong pose that is overconfident.
#[derive(Debug, Clone, Copy)]
struct Lost {
    /// Selects the neighbour.
    draw: usize,
    /// Along x and y, metres, and about its own position, radians.
    offset: [f64; 3],
}

impl Lost {
    fn draw(rng: &mut impl Rng) -> Self {
        let distance_m = rng.random_range(LOST_M);
        let (sin, cos) = rng.random_range(0.0..TAU).sin_cos();
        // Half of them have the right heading.
        let turn_rad = match rng.random_bool(0.5) {
            true => rng.random_range(-PI..PI),
            false => 0.0,
        };
        Self {
            // The number of neighbours is not known yet: reduced to it later.
            draw: rng.random_range(0..usize::MAX),
            offset: [distance_m * cos, distance_m * sin, turn_rad],
        }
    }
}

impl DrawnError {
    /// A pose with the added error; the confidence falls with it, unless the vehicle is lost.
    ///
    /// `agent` is its index in a sample of `agents`, the ego being 0.
    pub(super) fn added(
        &self,
        found: PoseEstimate,
        cav: &CavId,
        capture_nanos: u64,
        [agent, agents]: [usize; 2],
    ) -> PoseEstimate {
        let noisy = self.noisy(found, cav, capture_nanos, agent == 0);
        // The ego is never lost; where there is a neighbour, the divisor is 1 or more.
        let lost = self
            .lost
            .as_ref()
            .filter(|lost| agent > 0 && lost.draw % (agents - 1) == agent - 1);
        let (Some(lost), Some((pose, confidence))) = (lost, known(&noisy)) else {
            return noisy;
        };
        PoseEstimate::new(moved(&pose, lost.offset), confidence)
    }

    fn noisy(
        &self,
        found: PoseEstimate,
        cav: &CavId,
        capture_nanos: u64,
        is_ego: bool,
    ) -> PoseEstimate {
        let (Some(noise), Some((pose, confidence))) = (&self.noise, known(&found)) else {
            return found;
        };
        if is_ego && self.spares_ego {
            return found;
        }
        let noisy = noise.disturbed(cav, capture_nanos, &pose);
        match known(&noisy) {
            Some((pose, of_error)) => PoseEstimate::new(pose, confidence * of_error),
            None => noisy,
        }
    }
}

/// Pose and confidence of an estimate.
pub(super) fn known(estimate: &PoseEstimate) -> Option<(Pose, f32)> {
    Some((*estimate.world_from_cav()?, estimate.confidence()))
}

/// The error of a frame without a pose, whose view cannot be aligned.
pub(super) fn without_pose(scenario: &str, frame: &Frame) -> Error {
    let (cav, capture_nanos) = (&frame.cav, frame.capture_nanos);
    Error::Data(format!(
        "scenario {scenario}, {capture_nanos} ns: agent {cav} has no pose"
    ))
}

#[cfg(test)]
mod tests {
    use localization::pose_source::NoiseMode;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn drawn(mode: NoiseMode, noise_share: f64, seed: u64) -> DrawnError {
        let noise = NoisyPoseConfig {
            mode,
            position_std_m: 1.0,
            ..NoisyPoseConfig::default()
        };
        let poses = SamplePoses {
            noise: Some(noise),
            noise_share,
            ..SamplePoses::default()
        };
        poses.validate().unwrap();
        poses.draw(&mut ChaCha8Rng::seed_from_u64(seed)).unwrap()
    }

    #[test]
    fn each_sample_draws_its_own_error_and_confidence_falls_with_it() {
        let cav = CavId::new("a").unwrap();
        let found = PoseEstimate::new(Pose::IDENTITY, 0.8);
        let [first, again, other] = [1, 1, 2].map(|seed| {
            let error = drawn(NoiseMode::Independent, 1.0, seed);
            error.added(found, &cav, 5, [0, 2])
        });
        assert_eq!(first, again);
        assert_ne!(first, other);
        let PoseEstimate::Pose {
            world_from_cav,
            confidence,
            ..
        } = first
        else {
            panic!()
        };
        let [x, y, z] = world_from_cav.translation_m;
        let square = x * x + y * y + z * z;
        assert!((f64::from(confidence) - 0.8 / (1.0 + square)).abs() < 1e-5);
    }

    #[test]
    fn a_share_that_is_none_is_refused_by_name() {
        for share in [-0.1, 1.1, f64::NAN] {
            let lost = SamplePoses {
                lost_share: share,
                ..SamplePoses::default()
            };
            let noisy = SamplePoses {
                noise_share: share,
                ..SamplePoses::default()
            };
            for (poses, name) in [(lost, "lost_share"), (noisy, "noise_share")] {
                let refused = poses.validate().unwrap_err().to_string();
                assert!(refused.contains(name), "{refused}");
            }
        }
    }

    #[test]
    fn one_neighbour_is_lost_at_all_moments_and_does_not_know() {
        let cav = CavId::new("a").unwrap();
        let found = PoseEstimate::new(Pose::IDENTITY, 0.8);
        let poses = SamplePoses {
            lost_share: 1.0,
            ..SamplePoses::default()
        };
        for seed in 0..20 {
            let error = poses.draw(&mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
            let reported: Vec<_> = (0..4)
                .map(|agent| error.added(found, &cav, 5, [agent, 4]))
                .collect();
            let lost: Vec<_> = (0..4).filter(|&agent| reported[agent] != found).collect();
            assert!(lost.len() == 1 && lost[0] > 0, "{lost:?}");
            let PoseEstimate::Pose {
                world_from_cav,
                confidence,
                ..
            } = reported[lost[0]]
            else {
                panic!()
            };
            let [x, y, _] = world_from_cav.translation_m;
            assert!(LOST_M.contains(&x.hypot(y)) && (confidence - 0.8).abs() < 1e-6);
            assert_eq!(
                error.added(found, &cav, 99, [lost[0], 4]),
                reported[lost[0]]
            );
            assert_eq!(error.added(found, &cav, 5, [0, 1]), found, "ego-only");
        }
    }

    #[test]
    fn an_offset_brings_a_map_back() {
        let real = Pose::from_xyz_yaw([20.0, -5.0, 0.0], 3.1);
        let reported = Pose::from_xyz_yaw([21.0, -5.5, 0.0], -3.1);
        let PoseOffset([dx, dy, turn_rad]) = PoseOffset::between(&reported, &real);
        assert!((dx + 1.0).abs() < 1e-9 && (dy - 0.5).abs() < 1e-9);
        assert!(
            (turn_rad - (6.2 - std::f64::consts::TAU)).abs() < 1e-9,
            "{turn_rad}"
        );
        assert_eq!(PoseOffset::between(&real, &real), PoseOffset::default());
    }

    #[test]
    fn a_fixed_error_spares_the_ego_and_some_samples_have_none() {
        let cav = CavId::new("a").unwrap();
        let found = PoseEstimate::new(Pose::IDENTITY, 0.8);
        let fixed = drawn(NoiseMode::Fixed, 1.0, 3);
        assert_eq!(fixed.added(found, &cav, 5, [0, 2]), found);
        assert_ne!(fixed.added(found, &cav, 5, [1, 2]), found);
        let noisy = (0..200)
            .filter(|&seed| drawn(NoiseMode::Independent, 0.25, seed).noise.is_some())
            .count();
        assert!((30..70).contains(&noisy), "{noisy}");
    }
}
