//! The 4D radar of the vehicles: 150 m, 120 by 30 degrees ahead, with the radial velocity of every return.

use nalgebra::Vector3;

use super::lidar::LIDAR_MOUNT_M;
use super::raycast::{Caster, Course, GROUND, MISS, RayBody, RayPattern, Surface};
use super::traffic::STEP_S;
use support::random::SplitMix64;

/// Radial velocities between plus and minus this fill the red channel, metres per second.
///
/// Red 0 is -64 m/s (approaching), 255 is +64 m/s, `v = (red / 255 - 0.5) * 128`; steps of half a metre per second.
/// V2X-R stores its velocities in the red channel too and leaves the mapping open.
const RADAR_VELOCITY_SPAN_MPS: f64 = 64.0;

/// Height of the radar above the ground, metres; it sits at the front bumper.
const HEIGHT_M: f64 = 0.7;
/// Shares of lost returns: of vehicles and static objects, and of the ground, which reflects most away specularly.
const LOST: f64 = 0.15;
const LOST_GROUND: f64 = 0.96;
/// Deviations of range (metres), direction (radians) and radial velocity (metres per second).
const RANGE_NOISE_M: f64 = 0.1;
const DIRECTION_NOISE_RAD: f64 = 0.004;
const VELOCITY_NOISE_MPS: f64 = 0.1;

/// A radar that keeps its buffers from one frame to the next.
#[derive(Debug, Clone)]
pub struct Radar {
    caster: Caster,
    points: Vec<[f32; 4]>,
}

impl Default for Radar {
    fn default() -> Self {
        let pattern = RayPattern {
            first_azimuth_rad: 60.0f32.to_radians(),
            azimuth_step_rad: (-1.0f32).to_radians(),
            columns: 121,
            first_elevation_rad: (-15.0f32).to_radians(),
            elevation_step_rad: 1.5f32.to_radians(),
            channels: 21,
            range_m: 150.0,
            rolling: false,
        };
        Self {
            caster: Caster::new(pattern),
            points: Vec::new(),
        }
    }
}

impl Radar {
    /// The returns at the end of `vehicle`'s motion: x, y, z in metres and radial velocity in metres per second
    /// (growing distance is positive), in the (right-handed) frame of the vehicle's LiDAR.
    ///
    /// `half_length_m` is the vehicle's; the motions take one simulation step.
    pub fn returns(
        &mut self,
        vehicle: &Course,
        half_length_m: f64,
        ground: &dyn Surface,
        bodies: &[RayBody<'_>],
        seed: u64,
    ) -> &[[f32; 4]] {
        let mount_m = [half_length_m + 0.05, 0.0, HEIGHT_M];
        let moved = vehicle.mounted(mount_m);
        // Of the mount and not of the vehicle's centre: a turn moves the front sideways.
        let own_velocity = velocity_mps(&moved);
        let sensor = Course::still(moved.end);
        self.caster.cast(&sensor, ground, bodies);
        self.points.clear();
        let mut random = SplitMix64::new(seed);
        let shift: Vector3<f64> = Vector3::from(mount_m) - Vector3::from(LIDAR_MOUNT_M);
        let (image, channels) = (&self.caster.image, self.caster.pattern.channels);
        let rotation = sensor.end.rotation();
        for (index, column) in self.caster.columns_at_end(&sensor).enumerate() {
            for (channel, elevation) in self.caster.elevations().enumerate() {
                let ray = index * channels + channel;
                let hit = image.hits[ray];
                if hit == MISS || random.chance(if hit == GROUND { LOST_GROUND } else { LOST }) {
                    continue;
                }
                let velocity = match hit {
                    GROUND => Vector3::zeros(),
                    // The velocity of the centre stands for the whole body, whose turn is neglected.
                    body => velocity_mps(&bodies[body as usize].motion),
                };
                let exact =
                    Vector3::from(column.point_m(elevation, image.depths_m[ray])).cast::<f64>();
                let direction = exact / exact.norm();
                // Doppler: the part of the relative velocity along the ray.
                let radial = (rotation.transpose() * (velocity - own_velocity)).dot(&direction);
                let aside = Vector3::new(random.normal(), random.normal(), random.normal())
                    * DIRECTION_NOISE_RAD
                    * exact.norm();
                // `shift` moves the point from the radar's mount to the LiDAR's. Both have the same axes.
                let point = exact + direction * (RANGE_NOISE_M * random.normal()) + aside + shift;
                let radial = radial + VELOCITY_NOISE_MPS * random.normal();
                let [x, y, z]: [f32; 3] = point.map(|metres| metres as f32).into();
                self.points.push([x, y, z, radial as f32]);
            }
        }
        &self.points
    }
}

fn velocity_mps(motion: &Course) -> Vector3<f64> {
    (motion.end.position_m - motion.start.position_m) / STEP_S
}

/// A radial velocity as the red channel holds it, 0..1; see [`RADAR_VELOCITY_SPAN_MPS`].
pub(crate) fn velocity_to_red(velocity_mps: f32) -> f32 {
    (velocity_mps / (2.0 * RADAR_VELOCITY_SPAN_MPS as f32) + 0.5).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::raycast::{Bounds, Convex, Placement, Plane, SolidShape};

    fn drive(from_m: [f64; 3], to_m: [f64; 3]) -> Course {
        Course {
            start: Placement::level(from_m, 0.0),
            end: Placement::level(to_m, 0.0),
        }
    }

    #[test]
    fn velocities_are_relative_and_along_the_ray() {
        let block = SolidShape::new(
            vec![Convex::Box(Bounds::centered(
                [0.0, 0.0, 1.0],
                [1.0, 1.0, 1.0],
            ))],
            0.5,
        );
        let own = drive([-0.5, 0.0, 0.0], [0.0, 0.0, 0.0]);
        // One comes towards us at 5 m/s, one stands beside the road.
        let bodies = [
            RayBody {
                shape: &block,
                motion: drive([40.25, 0.0, 0.0], [40.0, 0.0, 0.0]),
            },
            RayBody {
                shape: &block,
                motion: Course::still(Placement::level([20.0, 20.0, 0.0], 0.0)),
            },
        ];
        let mut radar = Radar::default();
        let points = radar.returns(&own, 2.2, &Plane(-500.0), &bodies, 1);
        assert!(points.len() > 8);
        for point in points {
            let expected = if point[1].abs() < 3.0 {
                -15.0
            } else {
                -10.0 * 17.75 / 17.75f64.hypot(20.0)
            };
            assert!(
                (f64::from(point[3]) - expected).abs() < 0.8,
                "{point:?} {expected}"
            );
        }
        let ahead = points.iter().find(|point| point[1].abs() < 3.0).unwrap();
        // The face at 39 m, seen from a LiDAR half a metre behind the vehicle's origin.
        assert!((ahead[0] - 39.5).abs() < 1.0, "{ahead:?}");
    }

    #[test]
    fn velocities_survive_the_red_channel() {
        assert_eq!((velocity_to_red(-80.0), velocity_to_red(80.0)), (0.0, 1.0));
        for velocity in [-30.0f32, 0.0, 12.3] {
            let byte = (velocity_to_red(velocity) * 255.0).round();
            let read = (byte / 255.0 - 0.5) * 2.0 * RADAR_VELOCITY_SPAN_MPS as f32;
            assert!((read - velocity).abs() < 0.26);
        }
    }
}
