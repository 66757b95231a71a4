//! Inputs and true poses of all sweeps, on the device of the network.

use std::path::PathBuf;
use std::sync::Arc;

use nalgebra::{Isometry3, Vector3};
use tch::{Kind, TchError, Tensor};

use crate::Error;
use crate::training::sweep_store::{SweepList, heading_rad};
use localization::baselines::hypliloc::{InputBatch, RANGE_M, SweepInput};
use perception::train::{DataListing, Prefetch, RunConfig};

/// Sweeps that are copied onto the device together.
const CHUNK: usize = 64;
/// Smallest deviation of positions, metres: a scene is flat.
const LEAST_DEVIATION_M: f64 = 1.0;

/// All sweeps of a training.
pub(super) struct Examples {
    inputs: InputBatch,
    truth: Truth,
    /// Mean position, metres in the world.
    pub(super) origin_m: [f64; 3],
    /// Standard deviation of the positions, metres.
    pub(super) deviation_m: [f64; 3],
    /// `[3]` the same on the device.
    pub(super) scale_m: Tensor,
    /// Identity of the data.
    pub(super) data: DataListing,
}

/// True poses of some sweeps.
pub(super) struct Truth {
    /// `[S, 3]` relative to the mean, in standard deviations.
    pub(super) position: Tensor,
    /// `[S, 2]` cosine and sine of the heading.
    pub(super) heading: Tensor,
}

impl Examples {
    /// Reads and samples every sweep once.
    pub(super) fn read(
        scenes: &[PathBuf],
        run: &RunConfig,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, Error> {
        let list = Arc::new(SweepList::open(scenes)?);
        let total = list.len();
        let source = Arc::clone(&list);
        let mut loader = Prefetch::start(run.loader_threads, 0, move |chunk| {
            let first = chunk as usize * CHUNK;
            let read =
                (first..(first + CHUNK).min(total)).filter_map(|index| source.read(index, RANGE_M));
            let sampled = read.map(|sweep| {
                let points_m: Vec<[f32; 3]> = sweep.points().collect();
                (SweepInput::new(&points_m), sweep.world_from_sensor)
            });
            sampled.collect::<Vec<_>>()
        });
        let (mut chunks, mut poses, mut too_empty) = (Vec::new(), Vec::new(), 0);
        for first in (0..total).step_by(CHUNK) {
            let mut inputs = Vec::with_capacity(CHUNK);
            for (input, pose) in loader.next_batch()? {
                let Some(input) = input else {
                    too_empty += 1;
                    continue;
                };
                inputs.push(input);
                poses.push(pose);
            }
            if !inputs.is_empty() {
                chunks.push(InputBatch::new(&inputs, run.device)?);
            }
            progress((first + CHUNK).min(total), total);
        }
        if poses.is_empty() {
            let reasons = dataset::reasons(&list.data().problems);
            return Err(Error::NoSweeps(scenes.to_vec(), reasons));
        }
        let mut data = list.data();
        if too_empty > 0 {
            data.problems.push(format!(
                "{too_empty} sweeps show too little to be localized"
            ));
        }
        let (origin_m, deviation_m) = statistics(&poses);
        let scale_m = Tensor::f_from_slice(&deviation_m)?
            .f_to_kind(Kind::Float)?
            .f_to_device(run.device)?;
        let truth = Truth::new(&poses, origin_m, deviation_m)?.to_device(run.device)?;
        Ok(Self {
            inputs: InputBatch::concatenate(chunks)?,
            truth,
            origin_m,
            deviation_m,
            scale_m,
            data,
        })
    }

    /// Number of sweeps.
    pub(super) fn len(&self) -> i64 {
        self.inputs.len()
    }

    /// `[S, 5]`: position and heading of all sweeps.
    pub(super) fn poses(&self) -> Result<Tensor, TchError> {
        self.truth.poses()
    }

    pub(super) fn draw(&self, count: i64) -> Result<(InputBatch, Truth), TchError> {
        let rows = Tensor::f_randint(self.len(), [count], (Kind::Int64, self.scale_m.device()))?;
        let of = |all: &Tensor| all.f_index_select(0, &rows);
        let truth = Truth {
            position: of(&self.truth.position)?,
            heading: of(&self.truth.heading)?,
        };
        Ok((self.inputs.select(&rows)?, truth))
    }
}

impl Truth {
    fn new(
        world_from_sensor: &[Isometry3<f64>],
        origin_m: [f64; 3],
        deviation_m: [f64; 3],
    ) -> Result<Self, TchError> {
        let (mut positions, mut headings) = (Vec::new(), Vec::new());
        for pose in world_from_sensor {
            let position = (pose.translation.vector - Vector3::from(origin_m))
                .component_div(&Vector3::from(deviation_m));
            let heading = heading_rad(pose);
            positions.extend(position.iter().map(|&axis| axis as f32));
            headings.extend([heading.cos() as f32, heading.sin() as f32]);
        }
        let tensor =
            |values: &[f32], columns: i64| Tensor::f_from_slice(values)?.f_view([-1, columns]);
        Ok(Self {
            position: tensor(&positions, 3)?,
            heading: tensor(&headings, 2)?,
        })
    }

    /// `[S, 5]`: position and heading.
    pub(super) fn poses(&self) -> Result<Tensor, TchError> {
        Tensor::f_cat(&[&self.position, &self.heading], 1)
    }

    fn to_device(&self, device: tch::Device) -> Result<Self, TchError> {
        Ok(Self {
            position: self.position.f_to_device(device)?,
            heading: self.heading.f_to_device(device)?,
        })
    }
}

/// Mean and standard deviation of the positions, metres.
fn statistics(poses: &[Isometry3<f64>]) -> ([f64; 3], [f64; 3]) {
    let mean = |value: &dyn Fn(&Isometry3<f64>) -> f64| {
        poses.iter().map(value).sum::<f64>() / poses.len() as f64
    };
    let origin_m: [f64; 3] =
        std::array::from_fn(|axis| mean(&|pose| pose.translation.vector[axis]));
    let variance =
        |axis: usize| mean(&|pose| (pose.translation.vector[axis] - origin_m[axis]).powi(2));
    (
        origin_m,
        std::array::from_fn(|axis| variance(axis).sqrt().max(LEAST_DEVIATION_M)),
    )
}
