//! Token cache: tokens of all sweeps of a scene with their poses, computed once and kept on the device.

use std::f64::consts::TAU;
use std::sync::Arc;

use dataset::frame::Object;
use localization::baselines::tokens::{RINGS, SECTORS, TOKENS, TokenProjection, pool, token_of};
use localization::pgc::{SceneEncoder, SceneEncoderConfig, SweepCell, SweepVoxels, VoxelBatch};
use nalgebra::{Isometry3, Point3, Vector3};
use perception::tensor_values::tensor;
use perception::train::{Observe, Prefetch, RunConfig, TrainingEvent};
use tch::{Kind, TchError, Tensor, no_grad};

use crate::Error;
use crate::training::SweepList;
use crate::training::sweep_store::heading_rad;

/// Sweeps that are encoded together.
const BATCH: u64 = 4;
/// Sweeps that components are computed from.
const FITTED: i64 = 1000;
/// Width that is added to a box on each side, metres: a vehicle moves while the sensor turns.
const BOX_MARGIN_M: f64 = 0.2;
/// Largest distance between two sweeps of a window, in sweeps of their drive.
const LONGEST_SKIP: i64 = 3;
/// Largest share of tokens that is dropped, and largest deviation of noise.
const SPOILT: [f64; 2] = [0.3, 0.3];

/// Sweeps as an encoder leaves them.
pub(super) struct PooledSweeps {
    /// `[S, TOKENS, C]`, half precision.
    pooled: Tensor,
    statics: Vec<[f32; TOKENS as usize]>,
    drives: Vec<usize>,
    pub(super) world_from_sensor: Vec<Isometry3<f64>>,
}

/// Tokens and poses of sweeps.
#[derive(Debug)]
pub(super) struct TokenSweeps {
    /// `[S, TOKENS, channels]`.
    pub(super) tokens: Tensor,
    /// `[S, TOKENS]`: 1 where at least half of the cells are of static objects.
    pub(super) statics: Tensor,
    /// `[S, 5]`: position relative to the origin in metres, cosine and sine of the heading.
    pub(super) poses: Tensor,
}

/// All sweeps of a scene.
pub(super) struct TokenCache {
    pub(super) sweeps: TokenSweeps,
    /// `[S]`: number of the first sweep of the same drive.
    first_of_drive: Tensor,
}

/// A sweep before the encoder: voxels, static tokens, drive, and pose of the sensor.
type ReadSweep = (SweepVoxels, [f32; TOKENS as usize], usize, Isometry3<f64>);

impl PooledSweeps {
    /// Encodes every sweep of `list` that has a pose; `observe` gets the number of sweeps done and of all.
    ///
    /// # Errors
    /// [`Error`] when no sweep has a pose.
    pub(super) fn encode(
        list: &Arc<SweepList>,
        encoder: &SceneEncoder,
        run: &RunConfig,
        observe: &mut Observe<'_>,
    ) -> Result<Self, Error> {
        let total = list.len();
        let (source, config) = (Arc::clone(list), encoder.config().clone());
        let mut loader = Prefetch::start(run.loader_threads, 0, move |batch| {
            // The threads also ask for batches beyond the end: their range is empty.
            let numbers = batch * BATCH..((batch + 1) * BATCH).min(total as u64);
            let read = numbers.filter_map(|index| prepared(&source, index as usize, &config));
            read.collect::<Vec<_>>()
        });
        let mut parts = Vec::new();
        let (mut statics, mut drives, mut poses) = (Vec::new(), Vec::new(), Vec::new());
        for done in (0..total).step_by(BATCH as usize) {
            let sweeps = loader.next_batch()?;
            let voxels: Vec<&SweepVoxels> = sweeps.iter().map(|(voxels, ..)| voxels).collect();
            let batch = VoxelBatch::new(&voxels, encoder.config(), run.device)?;
            if !sweeps.is_empty() {
                let cells = encoder.encode(&batch, run.precision.kind())?.cells;
                for (voxels, rows) in voxels.iter().zip(&batch.cell_rows) {
                    let own = cells.f_narrow(0, rows.start, rows.end - rows.start)?;
                    // Half precision: the pooled features of all sweeps lie on the device at once.
                    parts.push(pool(voxels.cells(), &own)?.f_to_kind(Kind::Half)?);
                }
            }
            for (_, is_static, drive, world_from_sensor) in sweeps {
                statics.push(is_static);
                drives.push(drive);
                poses.push(world_from_sensor);
            }
            let done = (done + BATCH as usize).min(total);
            observe(&TrainingEvent::Encoding(done, total));
        }
        if parts.is_empty() {
            return Err(Error::NoSweeps(Vec::new(), String::new()));
        }
        Ok(Self {
            pooled: Tensor::f_stack(&parts, 0)?,
            statics,
            drives,
            world_from_sensor: poses,
        })
    }

    /// Sets the components of tokens from some of these sweeps.
    pub(super) fn fit(&self, projection: &mut TokenProjection) -> Result<(), TchError> {
        let count = self.pooled.size()[0];
        let step = (count / FITTED).max(1);
        projection.fit(&self.pooled.f_slice(0, None, None, step)?)
    }

    /// Tokens, and poses relative to an origin, metres in the world.
    pub(super) fn cache(
        &self,
        projection: &TokenProjection,
        origin_m: [f64; 3],
    ) -> Result<TokenCache, TchError> {
        let device = self.pooled.device();
        let poses = self.world_from_sensor.iter().map(|pose| {
            // The difference is taken in f64: world coordinates are too large for f32.
            let position = pose.translation.vector - Vector3::from(origin_m);
            let (sin, cos) = heading_rad(pose).sin_cos();
            [position.x, position.y, position.z, cos, sin].map(|value| value as f32)
        });
        let poses: Vec<[f32; 5]> = poses.collect();
        let mut first_of_drive: Vec<i64> = Vec::new();
        for drive in self.drives.chunk_by(|one, next| one == next) {
            let first = first_of_drive.len();
            first_of_drive.resize(first + drive.len(), first as i64);
        }
        let mut parts = Vec::new();
        for part in self.pooled.f_split(FITTED, 0)? {
            parts.push(no_grad(|| projection.forward(&part))?);
        }
        Ok(TokenCache {
            sweeps: TokenSweeps {
                tokens: Tensor::f_cat(&parts, 0)?,
                statics: tensor(self.statics.as_flattened(), &[-1, TOKENS], device)?,
                poses: tensor(poses.as_flattened(), &[-1, 5], device)?,
            },
            first_of_drive: tensor(&first_of_drive, &[-1], device)?,
        })
    }
}

fn prepared(list: &SweepList, index: usize, config: &SceneEncoderConfig) -> Option<ReadSweep> {
    let (frame, world_from_sensor) = list.posed_frame(index)?;
    let points = frame.points.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]);
    let voxels = SweepVoxels::new(points, config);
    let statics = static_tokens(voxels.cells(), &frame.objects, &world_from_sensor);
    Some((voxels, statics, list.drive(index)?, world_from_sensor))
}

/// 1 for each token of which at most half of the cells that stand out lie in annotated boxes, else 0.
fn static_tokens(
    cells: &[SweepCell],
    objects: &[Object],
    world_from_sensor: &Isometry3<f64>,
) -> [f32; TOKENS as usize] {
    let boxes = objects.iter().map(|object| {
        let world_from_object = object.world_from_object.isometry();
        let [length, width, height] = object.size_m.map(|size| size / 2.0);
        // No margin in height: a vehicle moves along the road.
        let half_m = [length + BOX_MARGIN_M, width + BOX_MARGIN_M, height];
        (world_from_object.inv_mul(world_from_sensor), half_m)
    });
    let boxes: Vec<_> = boxes.collect();
    let mut balance = [0_i32; TOKENS as usize];
    for cell in cells.iter().filter(|cell| !cell.is_flat()) {
        let [x, y, z] = cell.centroid_m.map(f64::from);
        let is_movable = boxes.iter().any(|(object_from_sensor, half_m)| {
            let inside = object_from_sensor * Point3::new(x, y, z);
            (0..3).all(|axis| inside[axis].abs() <= half_m[axis])
        });
        balance[token_of(cell.centroid_m).0] += if is_movable { 1 } else { -1 };
    }
    // A token without cells has balance 0 and counts as static.
    balance.map(|balance| f32::from(u8::from(balance <= 0)))
}

impl TokenCache {
    /// Number of sweeps.
    pub(super) fn len(&self) -> i64 {
        self.first_of_drive.size()[0]
    }

    /// `count` random windows of `frames` sweeps of a drive, one after another, oldest first, equally far apart; where a
    /// drive has just begun, its first sweep several times.
    pub(super) fn draw(&self, count: i64, frames: i64) -> Result<TokenSweeps, TchError> {
        let on = (Kind::Int64, self.first_of_drive.device());
        let last = Tensor::f_randint(self.len(), [count, 1], on)?;
        let skip = Tensor::f_randint_low(1, LONGEST_SKIP + 1, [count, 1], on)?;
        let back = Tensor::f_arange_start_step(frames - 1, -1, -1, on)?;
        let of_drive = self.first_of_drive.f_index_select(0, &last.f_view([-1])?)?;
        let rows = last.f_sub(&skip.f_mul(&back)?)?;
        let rows = rows.f_maximum(&of_drive.f_view([-1, 1])?)?.f_view([-1])?;
        Ok(TokenSweeps {
            tokens: self.sweeps.tokens.f_index_select(0, &rows)?,
            statics: self.sweeps.statics.f_index_select(0, &rows)?,
            poses: self.sweeps.poses.f_index_select(0, &rows)?,
        })
    }
}

impl TokenSweeps {
    /// The sweeps of sensors that are turned by up to `sectors`, all of a window of `frames` alike, with noise and without
    /// some tokens.
    pub(super) fn augmented(&self, frames: i64, sectors: i64) -> Result<Self, TchError> {
        let device = self.tokens.device();
        let (count, _, channels) = self.tokens.size3()?;
        let size = [count / frames];
        let turns = Tensor::f_randint_low(-sectors, sectors + 1, size, (Kind::Int64, device))?;
        // All sweeps of a window turn alike: their relative poses stay.
        let turns = turns.f_repeat_interleave_self_int(frames, 0, count)?;
        let turned = self.turned(&turns)?;
        let on = (Kind::Float, device);
        let [most_dropped, most_noise] = SPOILT;
        let is_kept = Tensor::f_rand([count, TOKENS, 1], on)?;
        let is_kept = is_kept.f_ge_tensor(&(Tensor::f_rand([count, 1, 1], on)? * most_dropped))?;
        let noise = Tensor::f_randn([count, TOKENS, channels], on)?;
        let noise = noise.f_mul(&(Tensor::f_rand([count, 1, 1], on)? * most_noise))?;
        let is_kept = is_kept.f_to_kind(Kind::Float)?;
        let tokens = turned.tokens.f_add(&noise)?.f_mul(&is_kept)?;
        Ok(Self { tokens, ..turned })
    }

    /// The sweeps of sensors whose surroundings lie `turns` `[S]` sectors further counter-clockwise.
    fn turned(&self, turns: &Tensor) -> Result<Self, TchError> {
        let source = Tensor::f_arange(SECTORS, (Kind::Int64, turns.device()))?;
        let source = source.f_sub(&turns.f_unsqueeze(1)?)?.f_remainder(SECTORS)?;
        let source = source.f_view([-1, 1, SECTORS, 1])?;
        // The sensor itself has turned the other way.
        let angle = turns.f_to_kind(Kind::Float)?.f_unsqueeze(1)? * (TAU / SECTORS as f64);
        let (cos, sin) = (angle.f_cos()?, angle.f_sin()?);
        let [x, y] = [3, 4].map(|of| self.poses.narrow(1, of, 1));
        let (x, y) = (&x * &cos + &y * &sin, &y * &cos - &x * &sin);
        let position = self.poses.f_narrow(1, 0, 3)?;
        Ok(Self {
            tokens: rolled(&self.tokens, &source)?,
            statics: rolled(&self.statics, &source)?,
            poses: Tensor::f_cat(&[position, x, y], 1)?,
        })
    }
}

/// Values of all tokens, each from the sector `source` `[S, 1, SECTORS, 1]` of the same ring.
fn rolled(values: &Tensor, source: &Tensor) -> Result<Tensor, TchError> {
    let of_rings = values.f_view([source.size()[0], RINGS, SECTORS, -1])?;
    let source = source.f_expand(of_rings.size(), false)?;
    of_rings
        .f_gather(2, &source, false)?
        .f_view(values.size().as_slice())
}

#[cfg(test)]
mod tests {
    use dataset::frame::ObjectClass;
    use protocol::Pose;
    use tch::Device;

    use super::*;

    fn cell([x, y, z]: [f64; 3]) -> SweepCell {
        SweepCell {
            centroid_m: [x as f32, y as f32, z as f32],
            extent_m: 1.0,
            points: 5,
        }
    }

    #[test]
    fn tokens_of_annotated_vehicles_are_not_static() {
        // A car 10 m ahead of a sensor that looks north, and across its way; a wall beside it.
        let sensor = Pose::from_xyz_yaw([100.0, 50.0, 2.0], std::f64::consts::FRAC_PI_2);
        let car = Object {
            id: 1,
            class: ObjectClass::Car,
            world_from_object: Pose::from_xyz_yaw([100.0, 60.0, 0.8], 0.0),
            size_m: [4.0, 2.0, 1.6],
            speed_mps: None,
        };
        let cells = [
            [9.0, 1.0, -1.2],
            [9.0, 0.8, -1.2],
            [9.5, 0.7, 2.0],
            [9.0, 6.0, -1.2],
        ];
        let cells = cells.map(cell);
        let statics = static_tokens(&cells, &[car], &sensor.isometry());
        let [car, wall] = [0, 3].map(|cell: usize| statics[token_of(cells[cell].centroid_m).0]);
        assert_eq!((car, wall), (0.0, 1.0));
        assert_eq!(statics.iter().sum::<f32>(), TOKENS as f32 - 1.0);
    }

    /// A sweep of a sensor that has turned to the right from east, with a wall to the left of where it was.
    fn turned_sweep(turn: f64) -> TokenSweeps {
        let (sin, cos) = (1.7 + turn).sin_cos();
        let features = Tensor::ones([1, 1], (Kind::Float, Device::Cpu));
        let wall = pool(&[cell([9.0 * cos, 9.0 * sin, 0.0])], &features).unwrap();
        TokenSweeps {
            tokens: wall.unsqueeze(0),
            statics: wall.narrow(1, 0, 1).view([1, TOKENS]),
            poses: Tensor::from_slice(&[5f32, 6.0, 7.0, turn.cos() as f32, -turn.sin() as f32])
                .view([1, 5]),
        }
    }

    #[test]
    fn turned_sweeps_are_those_of_a_turned_sensor() {
        // By two sectors to the right.
        let angle = 2.0 * TAU / SECTORS as f64;
        let turns = Tensor::from_slice(&[2_i64]);
        let found = turned_sweep(0.0).turned(&turns).unwrap();
        let wanted = turned_sweep(angle);
        for (found, wanted) in [
            (&found.tokens, &wanted.tokens),
            (&found.statics, &wanted.statics),
            (&found.poses, &wanted.poses),
        ] {
            assert!(
                found.allclose(wanted, 1e-4, 1e-4, false),
                "{found} {wanted}"
            );
        }
    }

    #[test]
    fn windows_stay_within_a_drive() {
        let places = (0..5).map(|number| Isometry3::translation(f64::from(number), 0.0, 0.0));
        let drives = vec![0, 0, 0, 4, 4];
        let projection = TokenProjection::new(&tch::nn::VarStore::new(Device::Cpu).root(), 1);
        let sweeps = PooledSweeps {
            pooled: Tensor::zeros(
                [5, TOKENS, projection.channels()],
                (Kind::Half, Device::Cpu),
            ),
            statics: vec![[1.0; TOKENS as usize]; 5],
            drives: drives.clone(),
            world_from_sensor: places.collect(),
        };
        let cache = sweeps.cache(&projection, [0.0; 3]).unwrap();
        let windows = cache.draw(200, 3).unwrap().poses.narrow(1, 0, 1);
        let rows: Vec<f32> = Vec::try_from(windows.reshape([-1])).unwrap();
        for window in rows.chunks_exact(3) {
            assert!(
                window.is_sorted() && drives[window[0] as usize] == drives[window[2] as usize],
                "{window:?}"
            );
        }
        assert!(rows.chunks_exact(3).any(|window| window == [0.0, 1.0, 2.0]));
    }
}
