//! Iterative closest point, point to plane (Chen and Medioni 1992), on voxels and from coarse to fine.
//!
//! The target becomes small planes, one per voxel; every step pairs the source's points with the nearest of them,
//! weighs the pairs by their residuals (Geman and McClure 1987), and solves one Gauss-Newton step. There is no global
//! search: a start some metres off ends in a wrong pose without an error. That is the method, not this code.
//!
//! Two uses: a neighbour's sweep against the ego's, and a sweep against a map of many sweeps ([`IcpTarget::add`]).

pub mod surfel_map;
mod surfels;

use nalgebra::{
    Isometry3, Matrix6, Point3, SymmetricEigen, Translation3, UnitQuaternion, Vector3, Vector6,
};

pub(crate) use surfels::{Surfel as Plane, is_level};
use surfels::{Surfels, decimate};

/// Distance that a rotation of one radian moves a typical point, metres: makes rotations and translations comparable.
const LEVER_M: f64 = 10.0;
/// A step smaller than this ends a level: metres and, times [`LEVER_M`], radians.
const CONVERGED_M: f64 = 1e-3;

/// Largest distance of two planes that agree, metres, and smallest cosine between their normals.
const AGREED_M: f64 = 0.2;
const AGREED_COSINE: f64 = 0.85;
/// Smallest and largest range of points that are used, metres: nearer ones are hits on the vehicle itself.
const RANGE_M: [f64; 2] = [2.5, 80.0];
/// Side of the voxels that the source is decimated with, one point per voxel, metres.
const SOURCE_VOXEL_M: f64 = 0.5;
/// Share of the source's points that must have a partner in the end. Vehicles 50 m apart share a tenth of what they
/// measure.
const MIN_OVERLAP: f64 = 0.05;
/// Required constraint of the worst direction: 1 if every pair constrains it, 0 if none does.
const MIN_CONSTRAINT: f64 = 2e-3;

/// One level of resolution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpLevel {
    /// Side of the target's voxels, metres. Points farther than one and a half of it from any plane have no partner.
    pub voxel_m: f64,
    /// Distance to the plane at which a pair has a quarter of its weight, metres.
    pub scale_m: f64,
    /// Largest number of steps.
    pub max_steps: u32,
}

impl IcpLevel {
    fn new(voxel_m: f64, scale_m: f64, max_steps: u32) -> Self {
        Self {
            voxel_m,
            scale_m,
            max_steps,
        }
    }
}

/// Settings of a registration.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpConfig {
    /// From coarse to fine.
    pub levels: Vec<IcpLevel>,
    /// Approximate number of points of the source at each level.
    pub max_points: usize,
}

impl Default for IcpConfig {
    /// For 64-channel sweeps of streets.
    fn default() -> Self {
        Self {
            levels: vec![
                IcpLevel::new(2.0, 1.0, 40),
                IcpLevel::new(1.0, 0.4, 20),
                IcpLevel::new(0.5, 0.15, 20),
            ],
            max_points: 5000,
        }
    }
}

/// Target of a registration: one sweep, or a map of many.
#[derive(Debug, Clone)]
pub struct IcpTarget {
    /// Relative to `origin_m`; later levels of a configuration use the last one.
    levels: Vec<Surfels>,
    /// Position of the first sweep: keeps numbers small far out in the world.
    origin_m: Option<Vector3<f64>>,
}

impl IcpTarget {
    /// Target without a point.
    pub fn new(config: &IcpConfig) -> Self {
        let levels = config.levels.iter();
        Self {
            levels: levels.map(|level| Surfels::new(level.voxel_m)).collect(),
            origin_m: None,
        }
    }

    /// Target of one sweep, in the frame of its sensor.
    pub fn of_sweep(xyzi: &[[f32; 4]], config: &IcpConfig) -> Self {
        let mut target = Self::new(config);
        target.add(xyzi, &Isometry3::identity());
        target.fit();
        target
    }

    /// Adds a sweep taken at `target_from_sensor`. [`Self::fit`] before registering.
    pub fn add(&mut self, xyzi: &[[f32; 4]], target_from_sensor: &Isometry3<f64>) {
        let rotation = target_from_sensor.rotation.to_rotation_matrix();
        let sensor = target_from_sensor.translation.vector;
        // World coordinates of a map may be large: sums of their squares would lose precision.
        let shift = sensor - *self.origin_m.get_or_insert(sensor);
        for point in within(xyzi) {
            let moved = rotation * point + shift;
            self.levels.iter_mut().for_each(|level| level.add(&moved));
        }
    }

    /// Fits the planes to all that has been added.
    pub fn fit(&mut self) {
        self.levels.iter_mut().for_each(Surfels::fit);
    }

    /// The planes of the finest level, in the target frame.
    pub(crate) fn finest_planes(&self) -> impl Iterator<Item = Plane> {
        let origin_m = self.origin_m.unwrap_or_default();
        let planes = self.levels.last().into_iter().flat_map(Surfels::planes);
        planes.map(move |(_, plane)| Plane {
            centre_m: plane.centre_m + origin_m,
            normal: plane.normal,
        })
    }

    /// Planes of a sweep that lie on a plane of the same direction, of how many: of level ones, which fit everywhere, those
    /// that have a level one above or below them, or of the others.
    pub(crate) fn agreement(
        &self,
        planes: &[Plane],
        target_from_sensor: &Isometry3<f64>,
        of_level: bool,
    ) -> [usize; 2] {
        let Some(target) = self.levels.last() else {
            return [0; 2];
        };
        let origin_m = self.origin_m.unwrap_or_default();
        let (mut count, mut agreed) = (0, 0);
        for plane in planes {
            let centre_m = (target_from_sensor * Point3::from(plane.centre_m)).coords - origin_m;
            let normal = target_from_sensor * plane.normal;
            if is_level(&normal) != of_level || of_level && !target.has_level_at(&centre_m) {
                continue;
            }
            let near = target.near(&centre_m);
            count += 1;
            agreed += usize::from(near.is_some_and(|near| {
                let distance_m = near.normal.dot(&(centre_m - near.centre_m));
                distance_m.abs() < AGREED_M && near.normal.dot(&normal).abs() > AGREED_COSINE
            }));
        }
        [agreed, count]
    }

    /// Planes at the finest level.
    pub fn planes(&self) -> usize {
        self.levels.last().map_or(0, |level| level.count)
    }
}

/// A sweep prepared for registration, and the data that a vehicle would have to send of it.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpSource {
    /// The points that are left `[N]`, in the frame of the sensor, metres.
    pub points_m: Vec<Vector3<f64>>,
}

impl IcpSource {
    /// Decimates a sweep.
    pub fn of_sweep(xyzi: &[[f32; 4]]) -> Self {
        Self {
            points_m: decimate(within(xyzi), SOURCE_VOXEL_M),
        }
    }
}

/// Points in range.
fn within(xyzi: &[[f32; 4]]) -> impl Iterator<Item = Vector3<f64>> {
    let [nearest_m, farthest_m] = RANGE_M;
    let points = xyzi
        .iter()
        .map(|[x, y, z, _]| Vector3::new(*x, *y, *z).cast());
    points.filter(move |point: &Vector3<f64>| (nearest_m..=farthest_m).contains(&point.norm()))
}

/// Pose of a registered sweep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpFit {
    /// Takes points of the source's sensor to the target frame.
    pub target_from_source: Isometry3<f64>,
    /// Share of the source's points with a partner near its plane.
    pub overlap: f64,
    /// The same share of those points that do not lie on the ground: the ground fits everywhere.
    pub overlap_above_ground: f64,
    /// Root mean square of their distances to the planes, metres.
    pub rms_m: f64,
    /// Inverse of the normal equations times the mean squared distance: covariance of the position (metres) and of the
    /// rotation about the target's axes (radians), if distances were independent.
    pub covariance: Matrix6<f64>,
    /// Steps taken.
    pub steps: u32,
}

/// Reason why a sweep cannot be registered.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum NoIcpFit {
    /// Source or target are (nearly) empty.
    #[error("{found} {what}, at least {MIN_POINTS} are needed")]
    TooFew {
        /// Kind: source points or target planes.
        what: &'static str,
        /// Number found.
        found: usize,
    },
    /// The clouds do not overlap at the resulting pose: share of points with a partner.
    #[error("{0:.2} of the points have a partner, at least {MIN_OVERLAP:.2} must")]
    TooLittleOverlap(f64),
    /// Some direction is unconstrained: nothing but ground, or a street between two walls. Constraint of the worst
    /// direction, 0..1.
    #[error(
        "the planes constrain the worst direction to {0:.1e} only, at least {MIN_CONSTRAINT:.1e} is needed"
    )]
    Unconstrained(f64),
}

/// Fewest source points and target planes.
pub(crate) const MIN_POINTS: usize = 50;

/// Registers a sweep, starting at `start`.
///
/// # Errors
/// [`NoIcpFit`] if there is too little to register, or the result is not constrained by it. A result is no proof: a
/// wrong start gives a wrong one.
pub fn register(
    source: &IcpSource,
    target: &IcpTarget,
    start: &Isometry3<f64>,
    config: &IcpConfig,
) -> Result<IcpFit, NoIcpFit> {
    for (what, found) in [
        ("source points", source.points_m.len()),
        ("target planes", target.planes()),
    ] {
        if found < MIN_POINTS {
            return Err(NoIcpFit::TooFew { what, found });
        }
    }
    let stride = source.points_m.len().div_ceil(config.max_points.max(1));
    let points: Vec<&Vector3<f64>> = source.points_m.iter().step_by(stride).collect();
    let origin = Translation3::from(target.origin_m.unwrap_or_default());
    // The planes lie relative to the origin, so the motion does too until the end.
    let (mut motion, mut steps) = (origin.inverse() * start, 0);
    let mut last = NormalEquations::default();
    for (index, level) in config.levels.iter().enumerate() {
        // A surfel map has one grid: its later levels differ by their kernel only.
        let Some(planes) = target.levels.get(index).or(target.levels.last()) else {
            break;
        };
        for _ in 0..level.max_steps {
            // The sums that judge the result are those at the pose before its last step.
            last = NormalEquations::gather(&points, planes, &motion, level);
            let Some(step) = last.step() else { break };
            motion = moved(&motion, &step);
            steps += 1;
            if step.norm() < CONVERGED_M {
                break;
            }
        }
    }
    // `last` is of the finest level by now: the wide kernel of a coarse one would overstate the overlap.
    last.judge(points.len())?;
    let points = points.len() as f64;
    let mean_square_m2 = last.squares / last.pairs;
    Ok(IcpFit {
        target_from_source: origin * motion,
        overlap: last.pairs / points,
        // A partner on level ground takes its point out of the numerator and the denominator.
        overlap_above_ground: (last.pairs - last.ground_pairs)
            / (points - last.ground_pairs).max(1.0),
        rms_m: mean_square_m2.sqrt(),
        covariance: last.covariance(mean_square_m2),
        steps,
    })
}

/// `motion`, rotated about the sensor and translated: the step's rotation is in units of 1 / [`LEVER_M`] radians.
fn moved(motion: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let turn = Vector3::new(step[0], step[1], step[2]) / LEVER_M;
    let shift = Vector3::new(step[3], step[4], step[5]);
    // On the left: the step turns about the axes of the target. It does not move the sensor.
    let rotation = UnitQuaternion::from_scaled_axis(turn) * motion.rotation;
    Isometry3::from_parts((motion.translation.vector + shift).into(), rotation)
}

/// Sums of one Gauss-Newton step: rotation about the sensor times [`LEVER_M`], then translation, all in metres.
#[derive(Debug, Clone, Copy, Default)]
struct NormalEquations {
    hessian: Matrix6<f64>,
    gradient: Vector6<f64>,
    /// Sum of the weights.
    weight: f64,
    /// Pairs within three scales of their planes, and those of them on level planes.
    pairs: f64,
    ground_pairs: f64,
    /// Sum of their squared distances.
    squares: f64,
}

impl NormalEquations {
    fn gather(
        points: &[&Vector3<f64>],
        planes: &Surfels,
        motion: &Isometry3<f64>,
        level: &IcpLevel,
    ) -> Self {
        let rotation = motion.rotation.to_rotation_matrix();
        let sensor = motion.translation.vector;
        let mut sums = Self::default();
        for point in points {
            // From the sensor: a turn about a distant origin would shift all points as well.
            let arm = rotation * *point;
            let moved = arm + sensor;
            let Some(plane) = planes.near(&moved) else {
                continue;
            };
            let distance = plane.normal.dot(&(moved - plane.centre_m));
            let scaled = (distance / level.scale_m).powi(2);
            // Three scales, squared. Pairs beyond have less than a hundredth of the weight: no overlap.
            if scaled < 9.0 {
                sums.pairs += 1.0;
                if is_level(&plane.normal) {
                    sums.ground_pairs += 1.0;
                }
                sums.squares += distance * distance;
            }
            let weight = 1.0 / ((1.0 + scaled) * (1.0 + scaled));
            // d(distance) = n . (dw x arm + dt) = (arm x n) . dw + n . dt. The lever gives both one unit.
            let (normal, turn) = (plane.normal, arm.cross(&plane.normal) / LEVER_M);
            let row = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
            sums.weight += weight;
            sums.hessian += row * row.transpose() * weight;
            sums.gradient += row * (distance * weight);
        }
        sums
    }

    /// The step, `None` without any pair. Unconstrained directions are not changed.
    fn step(&self) -> Option<Vector6<f64>> {
        // Makes the matrix positive definite, and relative to the weights hardly changes a step.
        let damped = self.hessian + Matrix6::identity() * (1e-6 * self.weight);
        let step = damped.cholesky()?.solve(&-self.gradient);
        step.iter().all(|value| value.is_finite()).then_some(step)
    }

    /// Covariance of position and rotation, in this order, of pairs with this mean squared distance.
    fn covariance(&self, mean_square_m2: f64) -> Matrix6<f64> {
        // Damped far less than a step: damping states a constraint that the pairs do not give.
        let damped = self.hessian + Matrix6::identity() * (1e-9 * self.weight);
        let inverse = damped.try_inverse().unwrap_or_else(Matrix6::identity) * mean_square_m2;
        // Rotation is first there, in units of 1 / LEVER_M radians.
        let axis = [3, 4, 5, 0, 1, 2];
        let unit = [1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M];
        Matrix6::from_fn(|row, column| {
            inverse[(axis[row], axis[column])] / (unit[row] * unit[column])
        })
    }

    fn judge(&self, points: usize) -> Result<(), NoIcpFit> {
        let overlap = self.pairs / points as f64;
        if overlap < MIN_OVERLAP {
            return Err(NoIcpFit::TooLittleOverlap(overlap));
        }
        let eigen = SymmetricEigen::new(self.hessian / self.weight);
        let constraint = eigen.eigenvalues.min();
        if constraint < MIN_CONSTRAINT {
            return Err(NoIcpFit::Unconstrained(constraint));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn span(from: f64, to: f64, step: f64) -> impl Iterator<Item = f64> {
        (0..((to - from) / step) as usize).map(move |k| from + step * (k as f64 + 0.37))
    }

    /// Sweep of a LiDAR at a height of 2 m at `world_from_sensor` in a crossing of two streets: ground, eight walls,
    /// posts.
    fn crossing(world_from_sensor: &Isometry3<f64>, shift: f64) -> Vec<[f32; 4]> {
        let mut world = Vec::new();
        for x in span(-40.0, 40.0, 0.6) {
            for y in span(-40.0, 40.0, 0.6) {
                world.push(Vector3::new(x + shift, y - shift, 0.0));
            }
        }
        for along in span(10.0, 40.0, 0.3) {
            for z in span(0.0, 6.0, 0.3) {
                for (sx, sy) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
                    // Corners of different depth, so that no two views are alike.
                    let depth = 8.0 + sx + 0.5 * sy;
                    world.push(Vector3::new(sx * (along + shift), sy * depth, z));
                    let y = sy * (along - shift);
                    world.push(Vector3::new(sx * depth, y, z + 0.1 * shift));
                }
            }
        }
        let sensor_from_world = world_from_sensor.inverse();
        let points = world.into_iter().map(|point| {
            let seen = sensor_from_world * Point3::from(point);
            [seen.x as f32, seen.y as f32, seen.z as f32, 0.5]
        });
        points.collect()
    }

    fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::new(Vector3::new(x, y, 2.0), Vector3::z() * yaw)
    }

    fn error(truth: &Isometry3<f64>, found: &Isometry3<f64>) -> (f64, f64) {
        let off = truth.inv_mul(found);
        (
            off.translation.vector.norm(),
            off.rotation.angle().to_degrees(),
        )
    }

    #[test]
    fn a_sweep_is_put_in_place_from_near() {
        let config = IcpConfig::default();
        let (here, there) = (pose(0.0, 0.0, 0.2), pose(3.0, -1.5, 0.6));
        let target = IcpTarget::of_sweep(&crossing(&here, 0.0), &config);
        let source = IcpSource::of_sweep(&crossing(&there, 0.11));
        let truth = here.inv_mul(&there);
        let start = truth
            * Isometry3::new(
                Vector3::new(0.8, -0.6, 0.2),
                Vector3::new(0.01, -0.02, 0.05),
            );
        let fit = register(&source, &target, &start, &config).unwrap();
        let (metres, degrees) = error(&truth, &fit.target_from_source);
        assert!(
            metres < 0.03 && degrees < 0.05,
            "{metres} m, {degrees} degrees"
        );
        assert!(
            fit.overlap > 0.6 && fit.rms_m < 0.05 && fit.steps > 2,
            "{fit:?}"
        );
    }

    #[test]
    fn a_map_of_several_sweeps_places_one_more_far_out_in_the_world() {
        let config = IcpConfig::default();
        let far = Isometry3::translation(4.2e5, -5.1e6, 300.0);
        let mut map = IcpTarget::new(&config);
        for (step, shift) in [(-4.0, 0.0), (0.0, 0.1), (4.0, 0.2)] {
            let at = pose(step, 0.0, 0.1 * step);
            map.add(&crossing(&at, shift), &(far * at));
        }
        map.fit();
        let there = pose(1.0, 1.0, 0.3);
        let source = IcpSource::of_sweep(&crossing(&there, 0.15));
        let start =
            far * there * Isometry3::new(Vector3::new(-0.7, 0.7, 0.0), Vector3::z() * -0.04);
        let fit = register(&source, &map, &start, &config).unwrap();
        let (metres, degrees) = error(&(far * there), &fit.target_from_source);
        assert!(
            metres < 0.05 && degrees < 0.1,
            "{metres} m, {degrees} degrees"
        );
    }

    /// A side of a lorry that begins at `x`.
    fn lorry(x: f64) -> impl Iterator<Item = [f64; 3]> {
        (0..800).map(move |k| [x + f64::from(k % 40) * 0.2, 4.0, f64::from(k / 40) * 0.15])
    }

    #[test]
    fn traffic_that_has_moved_is_an_outlier() {
        let config = IcpConfig::default();
        let (here, there) = (pose(0.0, 0.0, 0.0), pose(1.0, 0.3, 0.02));
        let mut moved = crossing(&there, 0.1);
        let static_points = moved.len();
        let mut target = crossing(&here, 0.0);
        target.extend(lorry(3.0).map(|p| [p[0] as f32, p[1] as f32, p[2] as f32 - 2.0, 0.1]));
        // Two metres farther than in the target.
        moved.extend(
            lorry(5.0).map(|p| [p[0] as f32 - 1.0, p[1] as f32 - 0.3, p[2] as f32 - 2.0, 0.1]),
        );
        assert!(moved.len() > static_points);
        let source = IcpSource::of_sweep(&moved);
        let fit = register(
            &source,
            &IcpTarget::of_sweep(&target, &config),
            &Isometry3::identity(),
            &config,
        )
        .unwrap();
        let (metres, degrees) = error(&here.inv_mul(&there), &fit.target_from_source);
        assert!(
            metres < 0.04 && degrees < 0.1,
            "{metres} m, {degrees} degrees"
        );
    }

    fn ground(shift: f32) -> Vec<[f32; 4]> {
        let points = (0..10_000).map(|k| {
            [
                (k % 100) as f32 * 0.5 - 25.0 + shift,
                (k / 100) as f32 * 0.5 - 25.0,
                -2.0,
                0.1,
            ]
        });
        points.collect()
    }

    /// Two parallel walls along x.
    fn walls(shift: f32) -> impl Iterator<Item = [f32; 4]> {
        [6.0, -6.0].into_iter().flat_map(move |y| {
            (0..2_000).map(move |k| {
                [
                    (k % 200) as f32 * 0.25 - 25.0 + shift,
                    y,
                    (k / 200) as f32 * 0.4 - 2.0,
                    0.1,
                ]
            })
        })
    }

    #[test]
    fn bare_ground_and_a_tunnel_leave_directions_unconstrained() {
        let config = IcpConfig::default();
        for (source, target) in [
            (ground(0.1), ground(0.0)),
            (
                ground(0.1).into_iter().chain(walls(0.2)).collect(),
                ground(0.0).into_iter().chain(walls(0.0)).collect(),
            ),
        ] {
            let target = IcpTarget::of_sweep(&target, &config);
            let found = register(
                &IcpSource::of_sweep(&source),
                &target,
                &Isometry3::identity(),
                &config,
            );
            assert!(
                matches!(found, Err(NoIcpFit::Unconstrained(_))),
                "{found:?}"
            );
        }
    }

    #[test]
    fn too_little_evidence_is_an_error() {
        let config = IcpConfig::default();
        let sweep = crossing(&pose(0.0, 0.0, 0.0), 0.0);
        let (source, target) = (
            IcpSource::of_sweep(&sweep),
            IcpTarget::of_sweep(&sweep, &config),
        );
        let none = IcpSource::of_sweep(&[[f32::NAN; 4]; 1000]);
        let start = Isometry3::identity();
        assert!(matches!(
            register(&none, &target, &start, &config),
            Err(NoIcpFit::TooFew {
                what: "source points",
                found: 0,
                ..
            })
        ));
        let empty = IcpTarget::of_sweep(&[], &config);
        assert!(matches!(
            register(&source, &empty, &start, &config),
            Err(NoIcpFit::TooFew {
                what: "target planes",
                ..
            })
        ));
        let elsewhere = Isometry3::translation(500.0, 0.0, 0.0);
        assert!(matches!(
            register(&source, &target, &elsewhere, &config),
            Err(NoIcpFit::TooLittleOverlap(_))
        ));
    }
}
