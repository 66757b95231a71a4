//! Synthetic scene coordinates: cells with drawn errors, without a network, for tests and benches.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::error::LocalizerError;
use super::localization::{Localization, stopwatch};
use super::localize::{Localize, LocalizerInput};
use super::pose_solver::PoseSolver;
use super::scene_coordinates::SceneCoordinates;

/// Origin of the scene in the world: far away, as in maps in UTM coordinates, metres.
const ORIGIN_M: [f64; 3] = [500_000.0, 5_700_000.0, 100.0];

/// Error distribution of the cells of a scene's sweeps.
#[derive(Debug, Clone)]
pub struct SyntheticScene {
    /// Number of cells of a sweep.
    pub cells: usize,
    /// Share of cells with a random position in the scene, 0..=1.
    pub outliers: f64,
    /// Share of the others that are mistaken for a similar place, 25 m away, 0..=1.
    pub twins: f64,
    /// Standard deviation of the others per axis, metres.
    pub noise_m: f64,
    /// Seed of the next sweep; the content of the sweep is not used.
    pub next_seed: u64,
}

impl Default for SyntheticScene {
    fn default() -> Self {
        Self {
            cells: 300,
            outliers: 0.2,
            twins: 0.0,
            noise_m: 0.2,
            next_seed: 0,
        }
    }
}

impl SyntheticScene {
    /// True pose of the sweep of a seed.
    pub fn world_from_sensor(&self, seed: u64) -> Isometry3<f64> {
        let mut local = local_pose(seed);
        local.translation.vector += Vector3::from(ORIGIN_M);
        local
    }

    /// The cells of a seed's sweep.
    pub fn coordinates(&self, seed: u64) -> SceneCoordinates {
        let pose = local_pose(seed);
        let mut random = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
        let noise = Normal::new(0.0, self.noise_m).expect("a standard deviation");
        let mut coordinates = SceneCoordinates {
            origin_m: ORIGIN_M,
            ..SceneCoordinates::default()
        };
        for _ in 0..self.cells {
            let sensor = [50.0, 50.0, 5.0].map(|reach: f64| random.random_range(-reach..reach));
            let sensor = Point3::from(sensor);
            let mut predicted = pose * sensor;
            if random.random_bool(self.twins) {
                // The predicted error does not show the mistake.
                predicted += Vector3::new(24.0, 7.0, 0.0);
            }
            let world = if random.random_bool(self.outliers) {
                let world = [200.0, 200.0, 5.0];
                Point3::from(world.map(|reach: f64| random.random_range(-reach..reach)))
            } else {
                predicted + Vector3::from_fn(|_, _| noise.sample(&mut random))
            };
            let off_m = (world - predicted).abs().sum().min(10.0);
            coordinates
                .epsilon_m
                .push((off_m * random.random_range(0.5..1.5)) as f32);
            coordinates
                .sensor_m
                .push(sensor.coords.map(|axis| axis as f32).into());
            coordinates
                .world_m
                .push(world.coords.map(|axis| axis as f32).into());
        }
        coordinates
    }
}

impl Localize for SyntheticScene {
    fn localize(&mut self, _: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        self.next_seed += 1;
        let solved = PoseSolver::default().solve(&self.coordinates(self.next_seed - 1));
        Ok(Localization::new(&solved, stopwatch()))
    }
}

fn local_pose(seed: u64) -> Isometry3<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let reaches = [150.0, 150.0, 0.5, 0.03, 0.03, 3.1];
    let [x, y, z, roll, pitch, yaw] = reaches.map(|reach: f64| random.random_range(-reach..reach));
    Isometry3::from_parts(
        Translation3::new(x, y, 2.0 + z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}
