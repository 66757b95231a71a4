//! Inputs and true poses of all sweeps, on the device of the network.

use std::path::PathBuf;
use std::sync::Arc;

use tch::{Kind, TchError, Tensor};

use crate::Error;
use crate::training::pose_scale::PoseScale;
use crate::training::sweep_store::SweepList;
use localization::baselines::hypliloc::{InputBatch, RANGE_M, SweepInput};
use perception::train::{DataListing, Prefetch, RunConfig};

/// Sweeps that are copied onto the device together.
const CHUNK: usize = 64;

/// Sweeps of a training.
pub(super) struct Examples {
    pub(super) inputs: InputBatch,
    /// `[S, 5]`: position in deviations from the origin, cosine and sine of the heading.
    pub(super) poses: Tensor,
}

impl Examples {
    /// Reads and samples every sweep once; also the scale of their poses and the identity of the data.
    pub(super) fn read(
        scenes: &[PathBuf],
        run: &RunConfig,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<(Self, PoseScale, DataListing), Error> {
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
                match input {
                    Some(input) => {
                        inputs.push(input);
                        poses.push(pose);
                    }
                    None => too_empty += 1,
                }
            }
            if !inputs.is_empty() {
                chunks.push(InputBatch::new(&inputs, run.device)?);
            }
            progress((first + CHUNK).min(total), total);
        }
        let mut data = list.data();
        if poses.is_empty() {
            return Err(Error::NoSweeps(
                scenes.to_vec(),
                dataset::reasons(&data.problems),
            ));
        }
        if too_empty > 0 {
            let problem = format!("{too_empty} sweeps show too little to be localized");
            data.problems.push(problem);
        }
        let scale = PoseScale::of(&poses);
        let examples = Self {
            inputs: InputBatch::concatenate(&chunks)?,
            poses: scale.normalise(&poses, run.device)?,
        };
        Ok((examples, scale, data))
    }

    /// `count` random sweeps.
    pub(super) fn draw(&self, count: i64) -> Result<Self, TchError> {
        let on = (Kind::Int64, self.poses.device());
        let rows = Tensor::f_randint(self.inputs.len(), [count], on)?;
        Ok(Self {
            poses: self.poses.f_index_select(0, &rows)?,
            inputs: self.inputs.select(&rows)?,
        })
    }
}
