//! Scene coordinates: positions of the cells of a sweep in the sensor frame and, predicted, in the world.

use tch::Tensor;

use crate::registration::Correspondence;

/// Output of the head for some cells.
#[derive(Debug)]
pub struct Regression {
    /// `[N, 3]`: world coordinates relative to the origin, metres.
    pub coordinates_m: Tensor,
    /// `[N]`: predicted L1 error, metres, not negative.
    pub epsilon_m: Tensor,
}

/// Predicted world coordinates of the cells of a sweep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SceneCoordinates {
    /// `[N, 3]`: in the sensor frame, metres.
    pub sensor_m: Vec<[f32; 3]>,
    /// `[N, 3]`: in the world relative to the head's origin, metres.
    pub world_m: Vec<[f32; 3]>,
    /// `[N]`: predicted L1 error, metres.
    pub epsilon_m: Vec<f32>,
    /// The head's origin in the world, metres.
    pub origin_m: [f64; 3],
}

impl SceneCoordinates {
    /// Each cell in the sensor frame and in the world, with its predicted error.
    pub(super) fn cells(&self) -> impl Iterator<Item = ([f32; 3], [f32; 3], f32)> {
        let cells = self.sensor_m.iter().zip(&self.world_m).zip(&self.epsilon_m);
        cells.map(|((&sensor_m, &world_m), &epsilon_m)| (sensor_m, world_m, epsilon_m))
    }

    /// Correspondences for the solver, weighted by Eq. 6.
    pub fn correspondences(&self) -> Vec<Correspondence> {
        let pairs = self
            .cells()
            .map(|(source_m, target_m, epsilon_m)| Correspondence {
                source_m,
                target_m,
                weight: sigma(epsilon_m),
            });
        pairs.collect()
    }
}

/// Confidence of a cell (Eq. 6): 0.5 at an expected error of 1 m.
pub fn sigma(epsilon_m: f32) -> f32 {
    1.0 / (1.0 + epsilon_m * epsilon_m)
}
