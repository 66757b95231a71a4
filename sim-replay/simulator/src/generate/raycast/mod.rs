//! Ray casting for scanning sensors.
//!
//! Targets are bodies of convex parts, and the ground. A sweep is rendered like an image with a depth buffer: each body
//! is projected to the columns and channels that can hit it, and exactly those rays are intersected, without
//! approximation, at the time at which their column is measured. For a spinning LiDAR this is faster than a tree
//! traversal per ray: neighbouring rays share nearly all of the work, and the loops over the channels of a column are
//! vector code.

mod column;
mod footprint;
mod part;
mod placement;
#[cfg(test)]
mod tests;

pub(crate) use column::{ColumnPose, RayPattern};
pub use part::{Bounds, Convex};
pub use placement::{Course, Placement, wrapped};

use nalgebra::{Matrix3, Vector3};

use column::ColumnRays;
use footprint::{RaySpan, SensorFrames};
use part::{greater, shorten};

/// [`RangeImage::hits`] of a ray without a hit.
pub(crate) const MISS: u32 = u32::MAX;
/// [`RangeImage::hits`] of a ray that hit the ground.
pub(crate) const GROUND: u32 = u32::MAX - 1;

/// Geometry of a body: convex parts in its own frame.
#[derive(Debug, Clone, PartialEq)]
pub struct SolidShape {
    /// The parts; they may overlap.
    pub parts: Vec<Convex>,
    /// The box around all parts.
    pub bounds: Bounds,
    /// Reflectance, 0..1.
    pub reflectivity: f32,
}

impl SolidShape {
    /// A shape of at least one part.
    ///
    /// # Panics
    /// If `parts` is empty: a body without extent is an error of the caller.
    pub fn new(parts: Vec<Convex>, reflectivity: f32) -> Self {
        let bounds = parts.iter().map(Convex::bounds).reduce(|a, b| a.union(&b));
        let bounds = bounds.expect("a body has parts");
        Self {
            parts,
            bounds,
            reflectivity,
        }
    }
}

/// A shape and its motion during one sweep.
#[derive(Debug, Clone, Copy)]
pub struct RayBody<'a> {
    /// Its form.
    pub shape: &'a SolidShape,
    /// `world_from_body` over the sweep.
    pub motion: Course,
}

impl RayBody<'_> {
    /// `body_from_world`, the turning part, at a time of the sweep, and the position relative to `anchor`.
    fn frame(&self, time: f32, anchor: &Vector3<f64>) -> (Matrix3<f32>, Vector3<f32>) {
        let placement = self.motion.at(f64::from(time));
        let body_from_world = placement.rotation().transpose().cast();
        (body_from_world, (placement.position_m - anchor).cast())
    }
}

/// The ground surface.
pub trait Surface {
    /// Shortens `depth` to the ground where rays hit it, and writes `GROUND` into `hit` there.
    ///
    /// Ray `i` leaves `origin` (world, metres) along `forward * cos[i] + up * sin[i]`, a unit vector.
    fn cast(&self, rays: &SurfaceRays<'_>, depth: &mut [f32], hit: &mut [u32]);
}

/// One column of rays in the world.
#[derive(Debug, Clone, Copy)]
pub struct SurfaceRays<'a> {
    /// Common origin of the rays, metres.
    pub origin: Vector3<f64>,
    /// Direction at elevation 0.
    pub forward: Vector3<f32>,
    /// Direction at elevation 90 degrees.
    pub up: Vector3<f32>,
    /// Cosines of the elevations.
    pub cos: &'a [f32],
    /// Sines of the elevations.
    pub sin: &'a [f32],
}

/// A level plane at this height, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane(pub f64);

impl Surface for Plane {
    fn cast(&self, rays: &SurfaceRays<'_>, depth: &mut [f32], hit: &mut [u32]) {
        let drop = (self.0 - rays.origin.z) as f32;
        for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
            // A ray along the plane gives an infinite distance or NaN, and neither is nearer.
            let at = drop / (rays.forward.z * cos + rays.up.z * sin);
            shorten(at, true, depth, hit, GROUND);
        }
    }
}

/// Hits of one sweep: `[columns, channels]`, the channels of a column side by side.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct RangeImage {
    /// Distance of the first hit, metres; the pattern's range where there is none.
    pub depths_m: Vec<f32>,
    /// Index into the bodies that were cast, [`GROUND`] or [`MISS`].
    pub hits: Vec<u32>,
}

/// Casts sweeps of one pattern; keeps its buffers from one to the next.
#[derive(Debug, Clone)]
pub(crate) struct Caster {
    pub(crate) pattern: RayPattern,
    cos: Vec<f32>,
    sin: Vec<f32>,
    columns: Vec<ColumnPose>,
    /// The last sweep, as [`Caster::cast`] left it.
    pub(crate) image: RangeImage,
}

impl Caster {
    /// A caster for sweeps of `pattern`.
    pub(crate) fn new(pattern: RayPattern) -> Self {
        let elevations = (0..pattern.channels).map(|channel| pattern.elevation_rad(channel));
        Self {
            cos: elevations.clone().map(f32::cos).collect(),
            sin: elevations.map(f32::sin).collect(),
            columns: Vec::new(),
            image: RangeImage::default(),
            pattern,
        }
    }

    /// Casts one sweep: `sensor` is `world_from_sensor` over it. Bodies around the sensor itself are transparent.
    pub(crate) fn cast(&mut self, sensor: &Course, ground: &dyn Surface, bodies: &[RayBody<'_>]) {
        let anchor = sensor.end.position_m;
        let (pattern, channels) = (&self.pattern, self.pattern.channels);
        self.columns.clear();
        let columns = 0..pattern.columns;
        let poses = columns.map(|column| ColumnPose::new(pattern, column, sensor, &anchor));
        self.columns.extend(poses);
        let RangeImage { depths_m, hits } = &mut self.image;
        depths_m.clear();
        depths_m.resize(pattern.columns * channels, pattern.range_m);
        hits.clear();
        hits.resize(pattern.columns * channels, MISS);
        let depths = depths_m.chunks_exact_mut(channels);
        let image = depths.zip(hits.chunks_exact_mut(channels));
        for (pose, (depths, hits)) in self.columns.iter().zip(image) {
            let rays = SurfaceRays {
                origin: anchor + pose.origin.cast::<f64>(),
                forward: pose.forward,
                up: pose.up,
                cos: &self.cos,
                sin: &self.sin,
            };
            ground.cast(&rays, depths, hits);
        }

        let frames = SensorFrames::new(sensor);
        let visible = bodies
            .iter()
            .enumerate()
            .filter_map(|(index, body)| Some((frames.footprint(&self.pattern, body)?, index)));
        let mut order: Vec<(RaySpan, usize)> = visible.collect();
        // Near bodies first: bodies behind them need not be intersected. The index makes the order of ties
        // deterministic.
        order.sort_unstable_by(|(a, i), (b, j)| a.nearest_m.total_cmp(&b.nearest_m).then(i.cmp(j)));
        for (footprint, body) in &order {
            self.cast_body(&bodies[*body], footprint, *body as u32, anchor);
        }
    }

    /// The columns of the last sweep in the frame of the sensor at the sweep's end, where de-skewed points lie.
    pub(crate) fn columns_at_end(&self, sensor: &Course) -> impl Iterator<Item = ColumnPose> {
        let end_from_world: Matrix3<f32> = sensor.end.rotation().transpose().cast();
        self.columns.iter().map(move |pose| ColumnPose {
            origin: end_from_world * pose.origin,
            forward: end_from_world * pose.forward,
            up: end_from_world * pose.up,
            ..*pose
        })
    }

    /// Cosine and sine of the elevation of each channel.
    pub(crate) fn elevations(&self) -> impl Iterator<Item = (f32, f32)> + '_ {
        self.cos.iter().copied().zip(self.sin.iter().copied())
    }

    fn cast_body(&mut self, body: &RayBody<'_>, span: &RaySpan, id: u32, anchor: Vector3<f64>) {
        let count = self.pattern.columns as i64;
        let channels = span.channels.clone();
        let (cos, sin) = (&self.cos[channels.clone()], &self.sin[channels.clone()]);
        // Most bodies stand still: one frame serves all columns.
        let still = (body.motion.start == body.motion.end).then(|| body.frame(1.0, &anchor));
        for column in span.first_column..span.first_column + span.columns as i64 {
            // A span may reach over the seam of a full turn.
            let column = column.rem_euclid(count) as usize;
            let offset = column * self.pattern.channels;
            let range = offset + channels.start..offset + channels.end;
            let depths = &mut self.image.depths_m[range.clone()];
            // All rays of the column already end nearer, so the body is hidden here.
            if depths.iter().fold(0.0, |far, &depth| greater(depth, far)) < span.nearest_m {
                continue;
            }
            let hits = &mut self.image.hits[range];
            let pose = &self.columns[column];
            let (body_from_world, position) =
                still.unwrap_or_else(|| body.frame(pose.time, &anchor));
            let rays = ColumnRays {
                origin: (body_from_world * (pose.origin - position)).into(),
                forward: (body_from_world * pose.forward).into(),
                up: (body_from_world * pose.up).into(),
                cos,
                sin,
            };
            for part in &body.shape.parts {
                part.cast(&rays, depths, hits, id);
            }
        }
    }
}
