//! Retrieval by polar descriptors: the pose of the training sweep that looks most alike in any direction of the sensor.

use std::f64::consts::TAU;
use std::fmt::Debug;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use protocol::{NoPoseReason, PointCloud};
use support::stage_times::StageTimes;
use tch::{Device, Kind, Tensor};

use super::regressed_pose::{PoseRegressor, RegressPose, localization};
use super::tokens::{RINGS, SECTORS};
use crate::pgc::localization::{ENCODE, SOLVE};
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use perception::tensor_values::tensor;

/// Describes sweeps by direction.
pub trait DescribePolar: Debug + Send {
    /// `[sectors, D]`, counter-clockwise from the rear; `None` for a sweep that shows too little.
    ///
    /// # Errors
    /// Those of the tensor library.
    fn polar(&self, cloud: &PointCloud, times: &mut StageTimes) -> tch::Result<Option<Tensor>>;
}

/// Scan Context (Kim and Kim 2018): the greatest height of points in 20 rings and 60 sectors.
#[derive(Debug, Clone, Copy)]
pub struct ScanContext;

impl ScanContext {
    const SECTORS: usize = 60;
    const RINGS: usize = 20;
    const RANGE_M: f32 = 80.0;
    /// Height of the sensor, metres: the ground is near 0.
    const SENSOR_M: f32 = 2.0;

    fn heights(cloud: &PointCloud) -> Vec<f32> {
        let mut heights = vec![0_f32; Self::SECTORS * Self::RINGS];
        for &[x, y, z, _] in &cloud.xyzi {
            let ring = (x.hypot(y) / Self::RANGE_M * Self::RINGS as f32) as usize;
            let turn = f64::from(y.atan2(x)) / TAU + 0.5;
            let sector = ((turn * Self::SECTORS as f64) as usize).min(Self::SECTORS - 1);
            if ring < Self::RINGS && [x, y, z].iter().all(|at| at.is_finite()) {
                let height = &mut heights[sector * Self::RINGS + ring];
                *height = height.max(z + Self::SENSOR_M);
            }
        }
        heights
    }
}

impl DescribePolar for ScanContext {
    fn polar(&self, cloud: &PointCloud, times: &mut StageTimes) -> tch::Result<Option<Tensor>> {
        let heights = Self::heights(cloud);
        let described = heights.iter().any(|&height| height > 0.0);
        times.lap(ENCODE);
        (described.then(|| tensor(&heights, &[-1, Self::RINGS as i64], Device::Cpu))).transpose()
    }
}

impl<N: RegressPose> DescribePolar for PoseRegressor<N> {
    /// Tokens, ring beside ring.
    fn polar(&self, cloud: &PointCloud, times: &mut StageTimes) -> tch::Result<Option<Tensor>> {
        let Some(tokens) = self.tokens(cloud, times)? else {
            return Ok(None);
        };
        let sectors = tokens.f_view([RINGS, SECTORS, -1])?.f_transpose(0, 1)?;
        Ok(Some(sectors.f_reshape([SECTORS, -1])?))
    }
}

/// Sweeps with poses, described by direction.
#[derive(Debug)]
pub struct PolarRetrieval {
    describe: Box<dyn DescribePolar>,
    /// `[N, sectors * D]`: each sector of length 1, or 0 if nothing is there.
    descriptors: Tensor,
    world_from_sensor: Vec<Isometry3<f64>>,
}

impl PolarRetrieval {
    /// Retrieval from sweeps `[sectors, D]` that were described alike.
    ///
    /// # Errors
    /// Those of the tensor library, also where there is none.
    pub fn new(
        describe: Box<dyn DescribePolar>,
        sweeps: Vec<(Tensor, Isometry3<f64>)>,
    ) -> tch::Result<Self> {
        let (descriptors, world_from_sensor): (Vec<_>, Vec<_>) = sweeps.into_iter().unzip();
        let rows = descriptors.iter().map(|of| normalised(of)?.f_view([-1]));
        let rows: Vec<Tensor> = rows.collect::<Result<_, _>>()?;
        Ok(Self {
            describe,
            descriptors: Tensor::f_stack(&rows, 0)?,
            world_from_sensor,
        })
    }

    /// Pose of a sensor whose sweep is described so: that of the sweep with the greatest mean cosine of sectors, turned.
    fn nearest(&self, descriptor: &Tensor) -> tch::Result<Isometry3<f64>> {
        let descriptor = normalised(descriptor)?;
        let sectors = descriptor.size()[0];
        // A sensor turned k sectors to the left sees all things k sectors further right: a roll undoes it.
        let turned = (0..sectors).map(|turn| descriptor.f_roll(turn, 0)?.f_view([-1]));
        let turned: Vec<Tensor> = turned.collect::<Result<_, _>>()?;
        let alike = self.descriptors.f_matmul(&Tensor::f_stack(&turned, 1)?)?;
        let best = alike.f_argmax(None, false)?.f_int64_value(&[])?;
        let (row, turn) = (best / sectors, best % sectors);
        let angle = turn as f64 / sectors as f64 * TAU;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        Ok(self.world_from_sensor[row as usize] * turn)
    }
}

fn normalised(descriptor: &Tensor) -> tch::Result<Tensor> {
    let length = descriptor
        .f_square()?
        .f_sum_dim_intlist(1_i64, true, Kind::Float)?;
    descriptor.f_div(&length.f_sqrt()?.f_clamp_min(1e-6)?)
}

impl Localize for PolarRetrieval {
    /// Every pose has full confidence: nothing tells a good one from a bad one.
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let Some(descriptor) = self.describe.polar(sweep.cloud, &mut times)? else {
            return Ok(Localization::no_pose(NoPoseReason::TooFewPoints, times));
        };
        let pose = self.nearest(&descriptor)?;
        times.lap(SOLVE);
        Ok(localization(Some(pose), times))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Posts of several heights, each before a low wall, around a sensor that has turned by an angle.
    fn sweep(heights: [f32; 3], turn: f64) -> PointCloud {
        let posts = heights
            .into_iter()
            .enumerate()
            .flat_map(|(number, height)| {
                let (sin, cos) = (number as f64 * 1.9 + 0.25 - turn).sin_cos();
                let range = 11.0 + 9.0 * number as f64;
                [(range, height), (range + 20.0, 0.5)]
                    .map(|(range, z)| [(range * cos) as f32, (range * sin) as f32, z, 0.1])
            });
        PointCloud {
            xyzi: posts.collect(),
        }
    }

    fn described(cloud: &PointCloud) -> Option<Tensor> {
        ScanContext.polar(cloud, &mut stopwatch()).unwrap()
    }

    #[test]
    fn a_sweep_is_found_in_another_direction() {
        let known = [[0.0, 2.0, 0.5], [3.0, 1.0, 4.0]].map(|heights| sweep(heights, 0.0));
        let known = known.iter().zip([20.0, 10.0]);
        let known = known.map(|(cloud, x)| {
            let place = Isometry3::translation(x, 0.0, 0.0);
            (described(cloud).unwrap(), place)
        });
        let mut database = PolarRetrieval::new(Box::new(ScanContext), known.collect()).unwrap();
        let angle = TAU / 12.0;
        let turned = sweep([3.1, 1.0, 3.9], angle);
        let found = database.localize(LocalizerInput::of(&turned)).unwrap();
        let pose = found.estimate.world_from_cav().unwrap();
        assert!((pose.translation_m[0] - 10.0).abs() < 1e-9);
        assert!((pose.yaw_rad() - angle).abs() < 1e-6, "{}", pose.yaw_rad());
        let empty = PolarRetrieval::new(Box::new(ScanContext), Vec::new());
        assert!(empty.is_err() && described(&PointCloud::default()).is_none());
    }
}
