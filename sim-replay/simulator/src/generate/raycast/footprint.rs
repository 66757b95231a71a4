//! Footprint of a body: the rays of a sweep that can hit it.

use std::f32::consts::{PI, TAU};
use std::ops::Range;

use nalgebra::{Matrix3, Vector2, Vector3};

use super::column::RayPattern;
use super::placement::Course;
use super::{Bounds, RayBody};

/// Closer than this, metres, a body may be seen in every direction.
const TOUCHING_M: f32 = 0.3;
/// Deviation of a turning motion of 50 ms from the straight line between its ends, metres.
const BEND_M: f32 = 0.05;

/// The columns and channels which can hit a body, a superset of those which do.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RaySpan {
    /// First column; may be below 0, or the range may exceed the last column, if the pattern covers a full turn.
    pub(super) first_column: i64,
    pub(super) columns: usize,
    pub(super) channels: Range<usize>,
    /// Lower bound of the distance of a hit, metres.
    pub(super) nearest_m: f32,
}

/// The frames of a sensor at the start and the end of a sweep.
pub(super) struct SensorFrames {
    ends: [(Matrix3<f64>, Vector3<f64>); 2],
}

impl SensorFrames {
    pub(super) fn new(sensor: &Course) -> Self {
        Self {
            ends: [&sensor.start, &sensor.end]
                .map(|end| (end.rotation().transpose(), end.position_m)),
        }
    }

    /// The footprint of `body`, or nothing if it is out of range or outside the field of view.
    ///
    /// Bounded by the corners of the body's box at both ends of the sweep: between them the motion is straight up to
    /// [`BEND_M`], so the body stays in their convex hull.
    pub(super) fn footprint(&self, pattern: &RayPattern, body: &RayBody<'_>) -> Option<RaySpan> {
        if self.is_surely_out_of_range(pattern.range_m, body) {
            return None;
        }
        let corners = self.corners(&body.shape.bounds, &body.motion);
        let flat = corners.map(|corner| corner.xy());
        let center = flat.iter().sum::<Vector2<f32>>() / 16.0;
        let nearest_m = self.nearest(&body.motion, &flat, &center) - BEND_M;
        if nearest_m > pattern.range_m {
            return None;
        }
        // Next to the sensor the azimuths have no bounds.
        if nearest_m < TOUCHING_M {
            return Some(RaySpan {
                first_column: 0,
                columns: pattern.columns,
                channels: 0..pattern.channels,
                nearest_m: 0.0,
            });
        }
        let channels = channels(pattern, &corners, nearest_m)?;
        let (first_column, columns) = columns(pattern, &flat, &center, nearest_m)?;
        Some(RaySpan {
            first_column,
            columns,
            channels,
            nearest_m,
        })
    }

    /// Cheap early test: most bodies of a scene are too far away.
    fn is_surely_out_of_range(&self, range_m: f32, body: &RayBody<'_>) -> bool {
        let Bounds { min_m, max_m } = &body.shape.bounds;
        let [near_x, near_y] = [0, 1].map(|axis: usize| min_m[axis].abs().max(max_m[axis].abs()));
        // Both ends may be a sweep's motion apart; the margin is conservative.
        let reach_m = f64::from(range_m + near_x + near_y) + 10.0;
        let offset = body.motion.end.position_m - self.ends[1].1;
        offset.x * offset.x + offset.y * offset.y > reach_m * reach_m
    }

    fn corners(&self, bounds: &Bounds, motion: &Course) -> [Vector3<f32>; 16] {
        let ends = [&motion.start, &motion.end];
        let poses = [0, 1].map(|end| {
            let (sensor_from_world, sensor_position) = &self.ends[end];
            let rotation: Matrix3<f32> = (sensor_from_world * ends[end].rotation()).cast();
            let position: Vector3<f32> =
                (sensor_from_world * (ends[end].position_m - sensor_position)).cast();
            (rotation, position)
        });
        let corners = bounds.corners();
        std::array::from_fn(|index| {
            let (rotation, position) = &poses[index / 8];
            rotation * Vector3::from(corners[index % 8]) + position
        })
    }

    /// A lower bound of the horizontal distance: the best of a few lines that separate the sensor from the corners.
    fn nearest(&self, motion: &Course, flat: &[Vector2<f32>; 16], center: &Vector2<f32>) -> f32 {
        let axes: Matrix3<f32> = (self.ends[1].0 * motion.end.rotation()).cast();
        let closest = flat
            .iter()
            .min_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        let closest = closest.unwrap_or(center);
        let (x, y) = (axes.column(0).xy(), axes.column(1).xy());
        let directions = [x, -x, y, -y, *center, *closest];
        directions
            .iter()
            .filter_map(|direction| {
                let direction = direction.try_normalize(1e-6)?;
                let along = flat.iter().map(|corner| corner.dot(&direction));
                along.min_by(f32::total_cmp)
            })
            .fold(f32::MIN, f32::max)
    }
}

/// The channels between the lowest and the highest elevation at which a corner's height can be seen.
fn channels(
    pattern: &RayPattern,
    corners: &[Vector3<f32>; 16],
    nearest_m: f32,
) -> Option<Range<usize>> {
    let distances = corners.iter().map(|corner| corner.xy().norm());
    let farthest_m = distances.fold(0.0, f32::max) + BEND_M;
    let heights = corners.iter().map(|corner| corner.z);
    let low = heights.clone().fold(f32::MAX, f32::min) - BEND_M;
    let high = heights.fold(f32::MIN, f32::max) + BEND_M;
    // For each sign of the height, the distance that gives the outermost elevation.
    let low_at_m = if low < 0.0 { nearest_m } else { farthest_m };
    let high_at_m = if high < 0.0 { farthest_m } else { nearest_m };
    let [first, last] = [low / low_at_m, high / high_at_m].map(|tangent: f32| {
        (tangent.atan() - pattern.first_elevation_rad) / pattern.elevation_step_rad
    });
    let (first, last) = (first.floor().max(0.0), last.ceil());
    let last = last.min((pattern.channels - 1) as f32);
    (first <= last).then(|| first as usize..last as usize + 1)
}

/// The columns between the outermost azimuths of the corners: the first one and how many.
fn columns(
    pattern: &RayPattern,
    flat: &[Vector2<f32>; 16],
    center: &Vector2<f32>,
    nearest_m: f32,
) -> Option<(i64, usize)> {
    let middle = center.y.atan2(center.x);
    let (mut low, mut high) = (0.0f32, 0.0f32);
    for corner in flat {
        // The hull does not contain the sensor, so all azimuths lie within half a turn of the central one.
        let aside = corner.y * center.x - corner.x * center.y;
        let delta = aside.atan2(corner.dot(center));
        (low, high) = (low.min(delta), high.max(delta));
    }
    let margin = BEND_M / nearest_m;
    let outermost = [middle + low - margin, middle + high + margin];
    let count = pattern.columns as i64;
    if pattern.is_full_turn() {
        let (first, last) = interval(pattern, outermost, 0.0);
        return Some((first, (last - first + 1).min(count) as usize));
    }
    debug_assert!(middle.abs() <= PI + 1e-3);
    // An azimuth beyond half a turn may meet the pattern a full turn away.
    let turns = [-TAU, 0.0, TAU].into_iter();
    let intervals = turns.map(|turn| interval(pattern, outermost, turn));
    let clipped = intervals.filter(|(first, last)| *last >= 0 && *first < count);
    let (first, last) = clipped.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    let (first, last) = (first.max(0), last.min(count - 1));
    Some((first, (last - first + 1) as usize))
}

/// The first and the last column between two azimuths turned by `turn`, with one more at either end against rounding.
fn interval(pattern: &RayPattern, azimuths: [f32; 2], turn: f32) -> (i64, i64) {
    let [a, b] = azimuths
        .map(|azimuth| (azimuth + turn - pattern.first_azimuth_rad) / pattern.azimuth_step_rad);
    (a.min(b).floor() as i64 - 1, a.max(b).ceil() as i64 + 1)
}
