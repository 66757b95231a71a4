//! Seeded pose errors: functions of seed, vehicle and capture time only.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use protocol::{CavId, Pose};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use sha2::{Digest, Sha256};

use super::NoisyPoseConfig;
use super::numpy_normals::NumpyNormals;

/// Random words reserved for one draw; four normals take about eight.
const WORDS_PER_DRAW: u128 = 64;

/// Innovations that have decayed below this share of an error are left out.
const NEGLIGIBLE: f64 = 1e-3;

/// An error of position and heading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlanarError {
    /// x, y, z, metres.
    pub position_m: [f64; 3],
    /// Heading error, radians.
    pub yaw_rad: f64,
}

impl PlanarError {
    /// The pose with this error added to its position in the world and to its yaw, as the reference does.
    pub(crate) fn added_in_world(&self, pose: &Pose) -> Pose {
        let exact = pose.isometry();
        // On the left: about the vertical of the world, however the vehicle is tilted.
        let rotation =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw_rad) * exact.rotation;
        let translation = exact.translation.vector + Vector3::from(self.position_m);
        Isometry3::from_parts(Translation3::from(translation), rotation).into()
    }

    /// The pose with this error in the vehicle's frame: x forward, y left.
    pub(crate) fn added_in_vehicle(&self, pose: &Pose) -> Pose {
        let error = Isometry3::new(Vector3::from(self.position_m), Vector3::z() * self.yaw_rad);
        (pose.isometry() * error).into()
    }

    /// Length of the position error, metres.
    pub fn distance_m(&self) -> f64 {
        Vector3::from(self.position_m).norm()
    }
}

/// Normal errors with the same standard deviations throughout.
impl NoisyPoseConfig {
    /// The constant error of all vehicles: to the digit the draw of OpenCOOD with this seed at every call. Of six
    /// normals, three are of the position, the fifth of the heading.
    pub(super) fn fixed(&self) -> PlanarError {
        let mut random = NumpyNormals::new(self.seed);
        let [x, y, z, _, yaw] = std::array::from_fn(|_| random.normal());
        self.scaled([x, y, z, yaw])
    }

    /// The error of a vehicle at a capture time, nanoseconds, independent of all others.
    pub(super) fn independent(&self, cav: &CavId, capture_nanos: u64) -> PlanarError {
        self.scaled(draw(&self.random(cav), capture_nanos))
    }

    /// The error of a vehicle at a step of time, correlated by `rho` from one step to the next.
    ///
    /// `e_k = rho e_{k-1} + sqrt(1 - rho^2) n_k`, written out as the sum of the innovations `n` back to where they have
    /// decayed: so it depends on no earlier call, and frames may be lost, repeated or started anywhere.
    pub(super) fn autoregressive(&self, cav: &CavId, step: u64, rho: f64) -> PlanarError {
        let random = self.random(cav);
        // 0 without correlation, whose logarithm is minus infinity.
        let depth = (NEGLIGIBLE.ln() / rho.ln()).ceil() as u64;
        let mut sum = [0.0; 4];
        // With this first weight the variance of the sum is 1 for any rho.
        let mut weight = (1.0 - rho * rho).sqrt();
        for back in 0..=depth {
            // Steps before the scene's zero have innovations too: the error starts in its stationary state.
            let innovation = draw(&random, step.wrapping_sub(back));
            for (sum, innovation) in sum.iter_mut().zip(innovation) {
                *sum += weight * innovation;
            }
            weight *= rho;
        }
        self.scaled(sum)
    }

    fn scaled(&self, [x, y, z, yaw]: [f64; 4]) -> PlanarError {
        PlanarError {
            position_m: [x, y, z].map(|normal| normal * self.position_std_m),
            yaw_rad: yaw * self.heading_std_deg.to_radians(),
        }
    }

    fn random(&self, cav: &CavId) -> ChaCha8Rng {
        ChaCha8Rng::from_seed(key(self.seed, cav))
    }
}

/// A generator's key from seed and vehicle.
pub(super) fn key(seed: u64, cav: &CavId) -> [u8; 32] {
    let mut hash = Sha256::new();
    hash.update(b"v2vloc pose noise");
    hash.update(seed.to_le_bytes());
    hash.update(cav.as_str().as_bytes());
    hash.finalize().into()
}

/// Four standard normals, those of this number.
fn draw(random: &ChaCha8Rng, number: u64) -> [f64; 4] {
    let mut random = random.clone();
    // The generator goes to any draw at once: none depends on those before it.
    random.set_word_pos(u128::from(number) * WORDS_PER_DRAW);
    std::array::from_fn(|_| random.sample(StandardNormal))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn normal(position_std_m: f64, heading_std_deg: f64, seed: u64) -> NoisyPoseConfig {
        NoisyPoseConfig {
            position_std_m,
            heading_std_deg,
            seed,
            ..NoisyPoseConfig::default()
        }
    }

    /// Correlation of values with the next ones, and their spread.
    fn correlation(values: impl Iterator<Item = f64>) -> (f64, f64) {
        let values: Vec<f64> = values.collect();
        let pairs = values.windows(2);
        let variance = pairs.clone().map(|pair| pair[0] * pair[0]).sum::<f64>();
        (
            pairs.clone().map(|pair| pair[0] * pair[1]).sum::<f64>() / variance,
            (variance / pairs.len() as f64).sqrt(),
        )
    }

    #[test]
    fn the_fixed_error_is_that_of_opencood() {
        let error = normal(1.0, 1.0, 20).fixed();
        let off = error
            .position_m
            .iter()
            .zip([0.884, 0.196, 0.358])
            .map(|(found, known)| (found - known).abs());
        assert!(
            off.fold(0.0, f64::max) < 1e-3 && (error.yaw_rad.to_degrees() + 1.085).abs() < 1e-3,
            "{error:?}"
        );
    }

    #[test]
    fn the_fixed_error_is_the_same_for_all() {
        let noise = normal(0.2, 0.5, 25);
        assert_eq!(noise.fixed(), noise.fixed());
        assert_ne!(noise.fixed(), normal(0.2, 0.5, 26).fixed());
    }

    #[test]
    fn independent_errors_have_the_configured_spread_and_no_correlation() {
        let noise = normal(0.5, 1.0, 1);
        let errors = (0..=4000).map(|step| noise.independent(&cav("a"), step));
        let (correlation, spread) = correlation(errors.map(|error| error.position_m[0]));
        assert!(
            (spread - 0.5).abs() < 0.03 && correlation.abs() < 0.05,
            "{spread} {correlation}"
        );
        let [a, b] = ["a", "b"].map(|name| noise.independent(&cav(name), 7));
        assert_ne!(a.position_m[0], b.position_m[0]);
    }

    #[test]
    fn autoregressive_errors_are_correlated_by_rho() {
        let noise = normal(0.5, 1.0, 1);
        let errors = (0..=4000).map(|step| noise.autoregressive(&cav("a"), step, 0.9));
        let (correlation, spread) = correlation(errors.map(|error| error.position_m[0]));
        assert!(
            (spread - 0.5).abs() < 0.06 && (correlation - 0.9).abs() < 0.03,
            "{spread} {correlation}"
        );
        let forgetful = noise.autoregressive(&cav("a"), 3, 0.0);
        assert_eq!(forgetful, noise.independent(&cav("a"), 3));
    }

    #[test]
    fn errors_in_the_vehicle_turn_with_it() {
        let pose = Pose::from_xyz_yaw([10.0, 0.0, 0.0], std::f64::consts::FRAC_PI_2);
        let error = PlanarError {
            position_m: [1.0, 0.0, 0.0],
            yaw_rad: 0.1,
        };
        let forward = error.added_in_vehicle(&pose);
        assert!(
            (forward.translation_m[0] - 10.0).abs() < 1e-9
                && (forward.translation_m[1] - 1.0).abs() < 1e-9
        );
        let east = error.added_in_world(&pose);
        assert!((east.translation_m[0] - 11.0).abs() < 1e-9);
        assert!((east.yaw_rad() - pose.yaw_rad() - 0.1).abs() < 1e-9);
    }
}
