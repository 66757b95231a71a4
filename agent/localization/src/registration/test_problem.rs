//! Synthetic registration problems with a known solution, for tests.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::Correspondence;

/// Parameters of a problem, and the pairs drawn.
#[derive(Debug, Clone)]
pub(crate) struct TestProblem {
    /// Number of pairs.
    pub(crate) count: usize,
    /// Share of pairs whose target is anywhere in the scene.
    pub(crate) outliers: f64,
    /// Standard deviation of the targets of the others per axis, metres.
    pub(crate) noise_m: f64,
    /// Largest tilt of the vehicle, radians.
    pub(crate) tilt_rad: f64,
    /// True `target_from_source`.
    pub(crate) truth: Isometry3<f64>,
    /// Drawn pairs.
    pub(crate) pairs: Vec<Correspondence>,
}

impl Default for TestProblem {
    fn default() -> Self {
        Self {
            count: 300,
            outliers: 0.0,
            noise_m: 0.0,
            tilt_rad: 0.05,
            truth: Isometry3::identity(),
            pairs: Vec::new(),
        }
    }
}

impl TestProblem {
    /// Draws motion and pairs: a sweep of 60 m radius in a scene of 400 m.
    pub(crate) fn drawn(mut self, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let tilt = self.tilt_rad.max(1e-12);
        self.truth = Isometry3::from_parts(
            Translation3::new(
                random.random_range(-200.0..200.0),
                random.random_range(-200.0..200.0),
                2.0,
            ),
            UnitQuaternion::from_euler_angles(
                random.random_range(-tilt..tilt),
                random.random_range(-tilt..tilt),
                random.random_range(-3.1..3.1),
            ),
        );
        let noise = Normal::new(0.0, self.noise_m).expect("a standard deviation");
        for _ in 0..self.count {
            let source = Point3::new(
                random.random_range(-60.0..60.0),
                random.random_range(-60.0..60.0),
                random.random_range(-2.0..8.0),
            );
            let is_outlier = random.random_bool(self.outliers);
            let target = if is_outlier {
                let reaches = [260.0, 260.0, 5.0];
                Point3::from(reaches.map(|reach: f64| random.random_range(-reach..reach)))
            } else {
                let mut shaken = self.truth * source;
                shaken
                    .coords
                    .iter_mut()
                    .for_each(|coordinate| *coordinate += noise.sample(&mut random));
                shaken
            };
            let weight = if is_outlier {
                random.random_range(0.1..0.6)
            } else {
                random.random_range(0.3..1.0)
            };
            self.pairs.push(Correspondence {
                source_m: source.coords.map(|x| x as f32).into(),
                target_m: target.coords.map(|x| x as f32).into(),
                weight,
            });
        }
        self
    }

    /// Distance in metres and angle in degrees to the solution.
    pub(crate) fn error(&self, found: &Isometry3<f64>) -> (f64, f64) {
        let distance_m = (found.translation.vector - self.truth.translation.vector).norm();
        (
            distance_m,
            found.rotation.angle_to(&self.truth.rotation).to_degrees(),
        )
    }
}
