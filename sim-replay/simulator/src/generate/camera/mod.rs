//! The four cameras of the vehicles: ahead, to both sides and back, 100 degrees wide, rendered from the geometry that
//! the LiDAR hits.

mod ground_paint;
mod paint;
mod png_image;
mod shading;

use std::fmt;
use std::str::FromStr;

use dataset::camera_files::body_from_optical;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use protocol::{Camera, CameraMetadata, ImageFormat, Pinhole};

pub(super) use ground_paint::GroundPaint;
pub(super) use paint::{Paint, of_shape, of_vehicle};

use super::lidar::LIDAR_MOUNT_M;
use super::raycast::{Caster, Course, Placement, RayBody, RayPattern, Surface};
use super::weather::Weather;
use shading::Shader;

/// Field of view along the rows, degrees: that of OPV2V's cameras.
const FIELD_OF_VIEW_DEG: f64 = 100.0;
/// Rays per pixel on the optical axis, along rows and columns.
const RAYS_PER_PIXEL: f64 = 1.6;
/// Range, metres; what is farther is sky.
const RANGE_M: f32 = 150.0;

/// Size of the images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

impl fmt::Display for ImageSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width_px, self.height_px)
    }
}

impl FromStr for ImageSize {
    type Err = String;

    /// Reads `WIDTHxHEIGHT`.
    fn from_str(text: &str) -> Result<Self, String> {
        let edges = text.split_once('x').and_then(|(width, height)| {
            Some(Self {
                width_px: width.parse().ok()?,
                height_px: height.parse().ok()?,
            })
        });
        edges.ok_or_else(|| format!("{text:?} is not WIDTHxHEIGHT, for example 480x300"))
    }
}

/// The mounts of OPV2V and V2VLoc, by number: position on the vehicle, metres, and yaw, degrees.
const MOUNTS: [([f64; 3], f64); 4] = [
    ([2.5, 0.0, 1.0], 0.0),
    ([0.0, -0.3, 1.8], -100.0),
    ([0.0, 0.3, 1.8], 100.0),
    ([-2.0, 0.0, 1.5], 180.0),
];

/// A camera that keeps its buffers from one image to the next.
#[derive(Debug, Clone)]
struct MountedCamera {
    position_m: Vector3<f64>,
    caster: Caster,
    metadata: CameraMetadata,
    /// Column and channel of the ray of each pixel, row by row.
    rays: Vec<(u32, u32)>,
}

/// The cameras of one thread, for all vehicles in turn.
#[derive(Debug, Clone)]
pub(super) struct CameraRig {
    cameras: Vec<MountedCamera>,
}

/// Surroundings of a vehicle as its cameras see them.
pub(super) struct Surroundings<'a> {
    pub(super) ground: &'a dyn Surface,
    pub(super) bodies: &'a [RayBody<'a>],
    /// Paint of each body.
    pub(super) paints: &'a [Paint],
    pub(super) weather: Weather,
}

impl CameraRig {
    pub(super) fn new(size: ImageSize) -> Self {
        Self {
            cameras: MOUNTS.map(|mount| MountedCamera::new(mount, size)).into(),
        }
    }

    /// The images of all cameras on a vehicle at `vehicle`, by number. The same arguments give the same bytes.
    pub(super) fn images(
        &mut self,
        vehicle: &Placement,
        surroundings: &Surroundings<'_>,
        ground_paint: &mut GroundPaint<'_>,
        seed: u64,
    ) -> Vec<(u8, Camera)> {
        let images = self.cameras.iter_mut().zip(0u8..).map(|(camera, number)| {
            let seed = seed.wrapping_add(number.into());
            let rgb = camera.render(vehicle, surroundings, ground_paint, seed);
            let metadata = camera.metadata;
            let image = png_image::encode(&rgb, &metadata);
            (number, Camera { metadata, image })
        });
        images.collect()
    }
}

impl MountedCamera {
    fn new((position_m, yaw_deg): ([f64; 3], f64), size: ImageSize) -> Self {
        let (width, height) = (f64::from(size.width_px), f64::from(size.height_px));
        let focal_px = width / 2.0 / (FIELD_OF_VIEW_DEG.to_radians() / 2.0).tan();
        let pinhole = Pinhole {
            fx_px: focal_px,
            fy_px: focal_px,
            cx_px: width / 2.0,
            cy_px: height / 2.0,
        };
        let yaw_rad = yaw_deg.to_radians();
        let step_rad = 1.0 / (RAYS_PER_PIXEL * focal_px);
        // Two rays beyond the edge, as the shading takes normals from neighbouring rays.
        let half_rad = [width, height].map(|edge| (edge / 2.0 / focal_px).atan() + 2.0 * step_rad);
        let [columns, channels] =
            half_rad.map(|half_rad| (2.0 * half_rad / step_rad).ceil() as usize + 1);
        let pattern = RayPattern {
            // Columns run to the right in the image, so azimuths, positive to the left, fall.
            first_azimuth_rad: (yaw_rad + half_rad[0]) as f32,
            azimuth_step_rad: -step_rad as f32,
            columns,
            first_elevation_rad: -half_rad[1] as f32,
            elevation_step_rad: step_rad as f32,
            channels,
            range_m: RANGE_M,
            rolling: false,
        };
        let pixels =
            (0..size.height_px).flat_map(|row| (0..size.width_px).map(move |column| (row, column)));
        let rays = pixels.map(|(row, column)| {
            // Through the middle of the pixel: to the left and up, for one unit ahead.
            let left = -(f64::from(column) + 0.5 - pinhole.cx_px) / focal_px;
            let up = -(f64::from(row) + 0.5 - pinhole.cy_px) / focal_px;
            let (azimuth, elevation) = (left.atan(), (up / left.hypot(1.0)).atan());
            let [column, channel] = [half_rad[0] - azimuth, half_rad[1] + elevation]
                .map(|angle_rad| (angle_rad / step_rad).round().max(0.0) as u32);
            (column, channel)
        });
        let position_m = Vector3::from(position_m);
        Self {
            rays: rays.collect(),
            metadata: CameraMetadata {
                format: ImageFormat::Png,
                width_px: size.width_px,
                height_px: size.height_px,
                pinhole: Some(pinhole),
                lidar_from_camera: Some(lidar_from_camera(position_m, yaw_rad).into()),
            },
            position_m,
            caster: Caster::new(pattern),
        }
    }

    fn render(
        &mut self,
        vehicle: &Placement,
        surroundings: &Surroundings<'_>,
        ground_paint: &mut GroundPaint<'_>,
        seed: u64,
    ) -> Vec<u8> {
        let sensor = Course::still(vehicle.mounted(self.position_m.into()));
        // At the end of the sweep, the capture time, everything stands where it is then.
        let mut bodies = surroundings.bodies.to_vec();
        for body in &mut bodies {
            body.motion = Course::still(body.motion.end);
        }
        self.caster.cast(&sensor, surroundings.ground, &bodies);
        let shader = Shader::new(&self.caster, &sensor, surroundings);
        shader.render(&self.rays, ground_paint, seed)
    }
}

/// Pose of the optical frame, z ahead, x right, y down, in the LiDAR's.
fn lidar_from_camera(position_m: Vector3<f64>, yaw_rad: f64) -> Isometry3<f64> {
    let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad);
    let lidar_from_body = Translation3::from(position_m - Vector3::from(LIDAR_MOUNT_M)) * turned;
    lidar_from_body * body_from_optical()
}

#[cfg(test)]
mod tests;
