//! The LiDAR of the vehicles: 64 channels from -25 to 2 degrees, 120 m, 20 turns a second, 1.3 million rays a second.

use std::f32::consts::{PI, TAU};

use super::raycast::{Caster, Course, GROUND, MISS, RayBody, RayPattern, Surface};
use super::weather::{Echo, Weather};
use support::random::SplitMix64;

/// Position of the LiDAR on its vehicle: x forward, y left, z up from the ground under the centre, metres.
pub const LIDAR_MOUNT_M: [f64; 3] = [-0.5, 0.0, 1.95];

/// Channels of the LiDAR.
pub(super) const CHANNELS: usize = 64;
/// Columns of one turn: 1.3 million rays a second over 64 channels and 20 turns a second, rounded as CARLA does.
const COLUMNS: usize = 1016;
/// Elevations of the lowest and the highest channel, degrees.
pub(super) const ELEVATIONS_DEG: [f32; 2] = [-25.0, 2.0];
/// Range, metres.
const RANGE_M: f32 = 120.0;
/// Deviation of the range noise, metres.
const NOISE_M: f64 = 0.02;
/// Share of rays that is lost regardless of the target.
const DROP_ALWAYS: f64 = 0.1;
/// Weaker returns than this may be lost as well.
const DROP_BELOW_INTENSITY: f32 = 0.7;
/// Share that is lost at intensity 0; falls linearly to 0 at [`DROP_BELOW_INTENSITY`].
const DROP_AT_ZERO: f32 = 0.15;
/// Loss of light in clear air, per metre: CARLA's attenuation, the only term of its intensity.
const ATTENUATION_PER_M: f32 = 0.004;
/// Reflectance of the ground.
const GROUND_REFLECTIVITY: f32 = 0.25;

/// A LiDAR that keeps its buffers from one sweep to the next.
#[derive(Debug, Clone)]
pub struct Lidar {
    caster: Caster,
    sweep: LidarSweep,
}

/// One sweep as the sensor reports it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LidarSweep {
    /// x, y, z in metres and intensity, in the (right-handed) frame of the sensor at the end of the sweep.
    pub points: Vec<[f32; 4]>,
    /// Number of points on each body.
    pub hits: Vec<u32>,
    /// For each point 0 if it lies on a surface, as in clear air, and 1 if it is clutter: fog or a flake.
    pub labels: Vec<u8>,
}

impl Default for Lidar {
    fn default() -> Self {
        let [low, high] = ELEVATIONS_DEG.map(f32::to_radians);
        // The sensor turns clockwise seen from above and passes the rear when a sweep begins and ends.
        let azimuth_step_rad = -TAU / COLUMNS as f32;
        let pattern = RayPattern {
            first_azimuth_rad: PI + azimuth_step_rad,
            azimuth_step_rad,
            columns: COLUMNS,
            first_elevation_rad: low,
            elevation_step_rad: (high - low) / (CHANNELS - 1) as f32,
            channels: CHANNELS,
            range_m: RANGE_M,
            rolling: true,
        };
        Self {
            caster: Caster::new(pattern),
            sweep: LidarSweep::default(),
        }
    }
}

impl Lidar {
    /// Casts the rays of one turn for [`Self::sweep`]; `sensor` is `world_from_lidar` over it.
    pub fn cast(&mut self, sensor: &Course, ground: &dyn Surface, bodies: &[RayBody<'_>]) {
        self.caster.cast(sensor, ground, bodies);
    }

    /// A sweep of the last turn in one weather, with one noise: `sensor` and `bodies` are those of [`Self::cast`].
    ///
    /// The same arguments give the same points, bit for bit.
    pub fn sweep(
        &mut self,
        sensor: &Course,
        bodies: &[RayBody<'_>],
        weather: Weather,
        seed: u64,
    ) -> &LidarSweep {
        let sweep = &mut self.sweep;
        sweep.points.clear();
        sweep.labels.clear();
        sweep.hits.clear();
        sweep.hits.resize(bodies.len(), 0);
        let mut random = SplitMix64::new(seed);
        let image = &self.caster.image;
        let depths = image.depths_m.chunks_exact(CHANNELS);
        let rows = depths.zip(image.hits.chunks_exact(CHANNELS));
        for (column, (depths, hits)) in self.caster.columns_at_end(sensor).zip(rows) {
            for ((elevation, &depth), &hit) in self.caster.elevations().zip(depths).zip(hits) {
                let measured = measure(depth, hit, bodies, weather, &mut random);
                let Some((range_m, intensity, hit)) = measured else {
                    continue;
                };
                let [x, y, z] = column.point_m(elevation, range_m);
                sweep.points.push([x, y, z, intensity]);
                sweep.labels.push(u8::from(hit == MISS));
                // GROUND and MISS lie beyond the list.
                if let Some(count) = sweep.hits.get_mut(hit as usize) {
                    *count += 1;
                }
            }
        }
        sweep
    }
}

/// Result of one ray: range with noise, intensity, and the index of the body; `None` if the return is lost.
#[inline]
fn measure(
    depth_m: f32,
    hit: u32,
    bodies: &[RayBody<'_>],
    weather: Weather,
    random: &mut SplitMix64,
) -> Option<(f32, f32, u32)> {
    let reflectivity = match hit {
        MISS | GROUND => GROUND_REFLECTIVITY,
        body => bodies[body as usize].shape.reflectivity,
    };
    let target_m = (hit != MISS).then_some(depth_m);
    let (range_m, intensity, hit) = match weather.echo(target_m, reflectivity, random) {
        Echo::Target(kept) => (depth_m, kept * (-ATTENUATION_PER_M * depth_m).exp(), hit),
        Echo::Backscatter(range_m, intensity) => (range_m, intensity, MISS),
        Echo::Lost => return None,
    };
    // One draw decides both losses: they are independent, so their survival shares multiply.
    let faint = (1.0 - intensity / DROP_BELOW_INTENSITY).max(0.0) * DROP_AT_ZERO;
    let kept = (1.0 - DROP_ALWAYS) * (1.0 - f64::from(faint));
    if random.unit() >= kept {
        return None;
    }
    Some((range_m + (NOISE_M * random.normal()) as f32, intensity, hit))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::raycast::{Bounds, Convex, Placement, Plane, SolidShape};

    #[test]
    fn a_pole_stands_straight_while_the_sensor_drives_past() {
        let pole = SolidShape::new(
            vec![Convex::Cylinder {
                radius_m: 0.15,
                half_height_m: 2.0,
            }],
            0.5,
        );
        let bodies = [[8.0, 6.0], [-7.0, 5.0], [3.0, -9.0]].map(|[x, y]| RayBody {
            shape: &pole,
            motion: Course::still(Placement::level([x, y, 2.0], 0.0)),
        });
        // 30 m/s and 60 degrees a second.
        let vehicle = Course {
            start: Placement::level([0.0, 0.0, 0.0], 0.0),
            end: Placement::level([1.5, 0.0, 0.0], 3f64.to_radians()),
        };
        let sensor = vehicle.mounted(LIDAR_MOUNT_M);
        let mut lidar = Lidar::default();
        lidar.cast(&sensor, &Plane(0.0), &bodies);
        let sweep = lidar.sweep(&sensor, &bodies, Weather::Sunny, 3);
        let world_from_lidar = sensor.end.isometry();
        for body in &bodies {
            let center = body.motion.end.position_m;
            let offsets: Vec<f64> = sweep
                .points
                .iter()
                .map(|&[x, y, z, _]| {
                    world_from_lidar * nalgebra::Point3::new(x, y, z).cast::<f64>()
                })
                .filter(|point| {
                    point.z > 0.3 && (point.x - center.x).hypot(point.y - center.y) < 1.0
                })
                .map(|point| (point.x - center.x).hypot(point.y - center.y))
                .collect();
            assert!(offsets.len() > 30, "{}", offsets.len());
            // On the surface of the pole up to the noise of the range.
            assert!(
                offsets.iter().all(|offset| (offset - 0.15).abs() < 0.12),
                "{offsets:?}"
            );
        }
        assert!(sweep.hits.iter().all(|&hits| hits > 30));
    }

    #[test]
    fn noise_and_losses_have_the_stated_shares() {
        let shell = SolidShape::new(
            vec![Convex::Box(Bounds::centered(
                [0.0, 0.0, 0.0],
                [0.5, 200.0, 200.0],
            ))],
            0.5,
        );
        let wall = RayBody {
            shape: &shell,
            motion: Course::still(Placement::level([20.5, 0.0, 0.0], 0.0)),
        };
        let sensor = Course::still(Placement::level([0.0; 3], 0.0));
        let mut lidar = Lidar::default();
        lidar.cast(&sensor, &Plane(-500.0), &[wall]);
        let sweep = lidar.sweep(&sensor, &[wall], Weather::Sunny, 1);
        let ahead: Vec<_> = sweep
            .points
            .iter()
            .filter(|p| p[1].abs() < 8.0 && p[0] > 0.0)
            .collect();
        let ranges: Vec<f64> = ahead
            .iter()
            .map(|p| f64::from(p[0] / (p[0].hypot(p[1]).hypot(p[2]))))
            .collect();
        let errors: Vec<f64> = ahead
            .iter()
            .zip(&ranges)
            .map(|(p, cos)| (f64::from(p[0]) - 20.0) / cos)
            .collect();
        let deviation = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        assert!((deviation - NOISE_M).abs() < 0.002, "{deviation}");
        // Nearly all returns in this fan are nearer than 89 m, where only the general loss applies.
        let fan = 64 * (2.0 * (8.0f64 / 20.0).atan() / f64::from(TAU) * COLUMNS as f64) as usize;
        let kept = ahead.len() as f64 / fan as f64;
        assert!((kept - 0.9).abs() < 0.02, "{kept}");
    }

    #[test]
    fn the_same_seed_gives_the_same_points() {
        let mut lidar = Lidar::default();
        let sensor = Course::still(Placement::level([0.0, 0.0, 1.95], 0.0));
        let [once, twice, other] = [5, 5, 6].map(|seed| {
            lidar.cast(&sensor, &Plane(0.0), &[]);
            let sweep = lidar.sweep(&sensor, &[], Weather::Snow, seed);
            sweep.points.clone()
        });
        assert_eq!(once, twice);
        assert_ne!(once, other);
    }
}
