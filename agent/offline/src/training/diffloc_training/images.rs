//! Range images of all sweeps of a scene with their poses, computed once and kept on the device.

use std::f32::consts::PI;
use std::sync::Arc;

use dataset::frame::{Frame, Object};
use nalgebra::{Isometry3, Point3, Vector3};
use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::Error;
use crate::training::SweepList;
use crate::training::pose_scale::PoseScale;
use localization::baselines::diffloc::{CHANNELS, RangeImageConfig, UNITS};
use perception::tensor_values::tensor;
use perception::train::{Prefetch, RunConfig};

/// Channels of a stored image: those of the network, and 1 where a movable object is seen.
pub(super) const STORED_CHANNELS: i64 = CHANNELS as i64 + 1;
/// Width that is added to a box on each side, metres: a vehicle moves while the sensor turns.
const BOX_MARGIN_M: f32 = 0.2;
/// Largest distance between two sweeps of a window, in sweeps of their drive.
const LONGEST_SKIP: i64 = 3;

/// Images and poses of a scene.
pub(super) struct SweepImages {
    /// `[S, STORED_CHANNELS, rows, columns]`, half precision.
    images: Tensor,
    /// `[S, 5]`: position in deviations from the origin, cosine and sine of the heading.
    pub(super) poses: Tensor,
    /// `[S]`: number of the first sweep of the same drive.
    first_of_drive: Tensor,
    pub(super) scale: PoseScale,
}

/// Some sweeps as they are stored.
pub(super) struct SweepBatch {
    /// `[N, STORED_CHANNELS, rows, columns]`, half precision.
    pub(super) images: Tensor,
    /// `[N, 5]`.
    pub(super) poses: Tensor,
}

struct Prepared {
    values: Vec<f32>,
    world_from_sensor: Isometry3<f64>,
    drive: usize,
}

impl SweepImages {
    /// Reads every sweep of `list` that has a pose; positions are normalised as given, or by their own mean and
    /// deviation. `progress` gets the number of sweeps done and of all.
    ///
    /// # Errors
    /// [`Error`] when no sweep has a pose.
    pub(super) fn read(
        list: &Arc<SweepList>,
        config: RangeImageConfig,
        scale: Option<PoseScale>,
        run: &RunConfig,
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self, Error> {
        let total = list.len();
        let source = Arc::clone(list);
        let mut loader = Prefetch::start(run.loader_threads, 0, move |number| {
            prepare(&source, number as usize, config)
        });
        let [rows, columns] = [config.rows, config.columns].map(|size| size as i64);
        let size = [total as i64, STORED_CHANNELS, rows, columns];
        let images = Tensor::f_empty(size, (Kind::Half, run.device))?;
        let (mut poses, mut drives) = (Vec::new(), Vec::new());
        for done in 1..=total {
            if let Some(sweep) = loader.next_batch()? {
                let image = Tensor::f_from_slice(&sweep.values)?.f_to_kind(Kind::Half)?;
                let image = image.f_view(&size[1..])?;
                no_grad(|| images.f_get(poses.len() as i64)?.f_copy_(&image))?;
                poses.push(sweep.world_from_sensor);
                drives.push(sweep.drive);
            }
            progress(done, total);
        }
        if poses.is_empty() {
            return Err(Error::NoSweeps(Vec::new(), String::new()));
        }
        let scale = scale.unwrap_or_else(|| PoseScale::of(&poses));
        Ok(Self {
            images: images.f_narrow(0, 0, poses.len() as i64)?,
            poses: scale.normalise(&poses, run.device)?,
            first_of_drive: first_of_drive(&drives, run.device)?,
            scale,
        })
    }

    /// Number of sweeps.
    pub(super) fn len(&self) -> i64 {
        self.images.size()[0]
    }

    /// Some images `[N, STORED_CHANNELS, rows, columns]`, one after another.
    pub(super) fn narrow(&self, first: i64, count: i64) -> Result<Tensor, TchError> {
        self.images.f_narrow(0, first, count)
    }

    /// `count` random windows of `frames` sweeps of a drive, oldest first, equally far apart; where a drive has just
    /// begun, its first sweep several times.
    pub(super) fn draw(&self, count: i64, frames: i64) -> Result<SweepBatch, TchError> {
        let on = (Kind::Int64, self.images.device());
        let last = Tensor::f_randint(self.len(), [count, 1], on)?;
        let skip = Tensor::f_randint_low(1, LONGEST_SKIP + 1, [count, 1], on)?;
        let back = Tensor::f_arange_start_step(frames - 1, -1, -1, on)?;
        let of_drive = self.first_of_drive.f_index_select(0, &last.f_view([-1])?)?;
        let rows = last.f_sub(&skip.f_mul(&back)?)?;
        let rows = rows.f_maximum(&of_drive.f_view([-1, 1])?)?.f_view([-1])?;
        Ok(SweepBatch {
            images: self.images.f_index_select(0, &rows)?,
            poses: self.poses.f_index_select(0, &rows)?,
        })
    }
}

fn prepare(list: &SweepList, index: usize, config: RangeImageConfig) -> Option<Prepared> {
    let (frame, world_from_sensor) = list.posed_frame(index)?;
    let mut values = config.image(&frame.points.xyzi);
    let movable = movable_pixels(&frame, &world_from_sensor, &values, config.pixels());
    values.extend(movable);
    Some(Prepared {
        values,
        world_from_sensor,
        drive: list.drive(index)?,
    })
}

/// `[pixels]`: 1 for each pixel of an image that shows a point in an annotated box, else 0.
fn movable_pixels(
    frame: &Frame,
    world_from_sensor: &Isometry3<f64>,
    image: &[f32],
    pixels: usize,
) -> Vec<f32> {
    let boxes = frame.objects.iter();
    let boxes = boxes.map(|object| SensorBox::new(object, world_from_sensor));
    let boxes: Vec<SensorBox> = boxes.collect();
    let axis = |channel: usize, pixel: usize| image[channel * pixels + pixel] * UNITS[channel];
    let is_movable = |pixel: usize| {
        let point = Point3::new(axis(1, pixel), axis(2, pixel), axis(3, pixel));
        image[pixel] > 0.0 && boxes.iter().any(|of| of.contains(&point))
    };
    (0..pixels)
        .map(|pixel| f32::from(u8::from(is_movable(pixel))))
        .collect()
}

/// An annotated box as seen from the sensor.
struct SensorBox {
    center: Point3<f32>,
    object_from_sensor: Isometry3<f32>,
    half_m: [f32; 3],
    radius_m: f32,
}

impl SensorBox {
    fn new(object: &Object, world_from_sensor: &Isometry3<f64>) -> Self {
        let world_from_object = object.world_from_object.isometry();
        let object_from_sensor = world_from_object.inv_mul(world_from_sensor);
        let [length, width, height] = object.size_m.map(|size| size as f32 / 2.0);
        let half_m = [length + BOX_MARGIN_M, width + BOX_MARGIN_M, height];
        let center = object_from_sensor.inverse().translation.vector.cast();
        Self {
            center: center.into(),
            object_from_sensor: object_from_sensor.cast(),
            half_m,
            radius_m: Vector3::from(half_m).norm(),
        }
    }

    fn contains(&self, point: &Point3<f32>) -> bool {
        let near = (point - self.center).norm_squared() <= self.radius_m * self.radius_m;
        near && {
            let inside = self.object_from_sensor * point;
            (0..3).all(|axis| inside[axis].abs() <= self.half_m[axis])
        }
    }
}

fn first_of_drive(drives: &[usize], device: Device) -> Result<Tensor, TchError> {
    let mut first = 0;
    let of = |row: usize| {
        if row > 0 && drives[row] != drives[row - 1] {
            first = row as i64;
        }
        first
    };
    let rows: Vec<i64> = (0..drives.len()).map(of).collect();
    tensor(&rows, &[-1], device)
}

/// Largest number of columns that a turn by `turn_rad` moves an image.
pub(super) fn columns_of(turn_rad: f32, config: RangeImageConfig) -> i64 {
    (turn_rad / (2.0 * PI) * config.columns as f32).round() as i64
}

#[cfg(test)]
mod tests {
    use dataset::frame::ObjectClass;
    use protocol::{CavId, Handedness, Pose};

    use super::*;

    #[test]
    fn pixels_of_annotated_vehicles_are_movable() {
        // A car 10 m ahead of a sensor that looks north, and across its way; a wall 3 m behind the car.
        let sensor = Pose::from_xyz_yaw([100.0, 50.0, 2.0], std::f64::consts::FRAC_PI_2);
        let car = Object {
            id: 1,
            class: ObjectClass::Car,
            world_from_object: Pose::from_xyz_yaw([100.0, 60.0, 0.8], 0.0),
            size_m: [4.0, 2.0, 1.6],
            speed_mps: None,
        };
        let mut frame = Frame::empty(CavId::new("7").unwrap(), 0, Handedness::Right);
        frame.objects = vec![car];
        let points = [
            [9.0, 1.5, -1.2, 0.5],
            [9.0, -1.5, -1.2, 0.5],
            [13.0, 4.0, -1.0, 0.5],
            [9.0, 2.6, -1.2, 0.5],
        ];
        let config = RangeImageConfig::default();
        let image = config.image(&points);
        let movable = movable_pixels(&frame, &sensor.isometry(), &image, config.pixels());
        let found = points.map(|[x, y, z, _]| movable[config.pixel([x, y, z]).unwrap().0]);
        assert_eq!(found, [1.0, 1.0, 0.0, 0.0]);
        assert_eq!(movable.iter().sum::<f32>(), 2.0);
    }

    #[test]
    fn windows_stay_within_a_drive() {
        let drives = [0, 0, 0, 4, 4];
        let first: Vec<i64> = Vec::try_from(first_of_drive(&drives, Device::Cpu).unwrap()).unwrap();
        assert_eq!(first, [0, 0, 0, 3, 3]);
        let place = |number: usize| Isometry3::translation(number as f64, 0.0, 0.0);
        let poses: Vec<_> = (0..5).map(place).collect();
        let scale = PoseScale::of(&poses);
        assert_eq!(
            scale,
            PoseScale {
                origin_m: [2.0, 0.0, 0.0],
                scale_m: [2.0_f64.sqrt(), 1.0, 1.0]
            }
        );
        let images = SweepImages {
            images: Tensor::zeros([5, 1, 1, 1], (Kind::Half, Device::Cpu)),
            poses: scale.normalise(&poses, Device::Cpu).unwrap(),
            first_of_drive: Tensor::from_slice(&first),
            scale,
        };
        let windows = images.draw(200, 3).unwrap().poses.narrow(1, 0, 1) * 2.0_f64.sqrt() + 2.0;
        let rows: Vec<f32> = Vec::try_from(windows.round().view([-1])).unwrap();
        for window in rows.chunks_exact(3) {
            assert!(
                window.is_sorted() && drives[window[0] as usize] == drives[window[2] as usize],
                "{window:?}"
            );
        }
        assert!(rows.chunks_exact(3).any(|window| window == [0.0, 1.0, 2.0]));
    }
}
