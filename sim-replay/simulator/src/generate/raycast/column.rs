//! The rays of a scanning sensor: columns of rays that share an azimuth and a time.

use std::f32::consts::TAU;

use nalgebra::Vector3;

use super::placement::Course;

/// Rays of a sensor in one sweep: columns at even azimuths, each with the same even elevations.
///
/// The rays of one column share one origin and lie in one plane, so most of an intersection is done once a column.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RayPattern {
    /// Azimuth of the first column, radians.
    pub first_azimuth_rad: f32,
    /// Step from one column to the next, radians; negative turns clockwise seen from above.
    pub azimuth_step_rad: f32,
    /// Number of columns.
    pub columns: usize,
    /// Elevation of the first channel, radians.
    pub first_elevation_rad: f32,
    /// Step from one channel to the next, radians, positive.
    pub elevation_step_rad: f32,
    /// Number of channels.
    pub channels: usize,
    /// Largest range of a hit, metres.
    pub range_m: f32,
    /// True if the columns are measured one after another over the sweep, the last one at its end, or all at its end.
    pub rolling: bool,
}

impl RayPattern {
    /// True if the columns go all the way round.
    pub(crate) fn is_full_turn(&self) -> bool {
        // Half a step of tolerance against rounding.
        self.azimuth_step_rad.abs() * self.columns as f32 > TAU - 0.5 * self.azimuth_step_rad.abs()
    }

    /// Azimuth of a column, radians.
    pub(crate) fn azimuth_rad(&self, column: usize) -> f32 {
        self.first_azimuth_rad + self.azimuth_step_rad * column as f32
    }

    /// Elevation of a channel, radians.
    pub(crate) fn elevation_rad(&self, channel: usize) -> f32 {
        self.first_elevation_rad + self.elevation_step_rad * channel as f32
    }

    /// Time at which a column is measured: 0 at the start of the sweep, 1 at its end.
    pub(crate) fn time(&self, column: usize) -> f64 {
        if self.rolling {
            (column + 1) as f64 / self.columns as f64
        } else {
            1.0
        }
    }
}

/// One column of rays in some frame: ray `i` leaves `origin` along `forward * cos[i] + up * sin[i]`.
#[derive(Debug, Clone, Copy)]
pub(super) struct ColumnRays<'a> {
    pub(super) origin: [f32; 3],
    pub(super) forward: [f32; 3],
    pub(super) up: [f32; 3],
    pub(super) cos: &'a [f32],
    pub(super) sin: &'a [f32],
}

impl ColumnRays<'_> {
    /// The first `count` rays; lets the compiler assume that all slices of a kernel have this length.
    #[inline]
    pub(super) fn cut(&self, count: usize) -> Self {
        Self {
            cos: &self.cos[..count],
            sin: &self.sin[..count],
            ..*self
        }
    }

    /// Unit normal of the plane in which the rays lie.
    #[inline]
    pub(super) fn normal(&self) -> [f32; 3] {
        let (forward, up) = (Vector3::from(self.forward), Vector3::from(self.up));
        up.cross(&forward).into()
    }
}

/// Position and direction of the sensor when one column was measured, relative to a point near the sensor (so that
/// `f32` is exact enough) or to the sensor at the sweep's end.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ColumnPose {
    pub(super) time: f32,
    pub(super) origin: Vector3<f32>,
    pub(super) forward: Vector3<f32>,
    pub(super) up: Vector3<f32>,
}

impl ColumnPose {
    /// The column of `sensor` at `column` of `pattern`, relative to `anchor`.
    pub(super) fn new(
        pattern: &RayPattern,
        column: usize,
        sensor: &Course,
        anchor: &Vector3<f64>,
    ) -> Self {
        let time = pattern.time(column);
        let placement = sensor.at(time);
        let rotation = placement.rotation();
        let (sin, cos) = f64::from(pattern.azimuth_rad(column)).sin_cos();
        Self {
            time: time as f32,
            origin: (placement.position_m - anchor).cast(),
            forward: (rotation * Vector3::new(cos, sin, 0.0)).cast(),
            up: (rotation * Vector3::z()).cast(),
        }
    }

    /// The point at `range_m` along the ray of an elevation given by its cosine and sine.
    #[inline]
    pub(crate) fn point_m(&self, (cos, sin): (f32, f32), range_m: f32) -> [f32; 3] {
        (self.origin + (self.forward * cos + self.up * sin) * range_m).into()
    }
}
