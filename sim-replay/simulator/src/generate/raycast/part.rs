//! Convex parts of bodies, and the kernels that intersect one of them with a column of rays.

use super::column::ColumnRays;

/// Directions shorter than this count as parallel to a face, and are nudged off it.
const PARALLEL: f32 = 1e-20;

/// A convex solid in the frame of its body, metres.
#[derive(Debug, Clone, PartialEq)]
pub enum Convex {
    /// Half-spaces `n . x <= d` as `[nx, ny, nz, d]`, which together bound a solid, and the box around it.
    Hull {
        /// The half-spaces; normals of length one.
        planes: Vec<[f32; 4]>,
        /// Box around the solid.
        bounds: Bounds,
    },
    /// A box along the axes of the body.
    Box(Bounds),
    /// An upright cylinder with its two lids, around the origin.
    Cylinder {
        /// Radius.
        radius_m: f32,
        /// Half of the height.
        half_height_m: f32,
    },
    /// An ellipsoid along the axes of the body, around the origin.
    Ellipsoid {
        /// Radii along x, y, z.
        radii_m: [f32; 3],
    },
}

/// A box along the axes, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lower corner.
    pub min_m: [f32; 3],
    /// Upper corner.
    pub max_m: [f32; 3],
}

/// Depths and hits along a column of rays, and the id of the body that is cast.
type Pixels<'a> = (&'a mut [f32], &'a mut [u32], u32);

impl Bounds {
    /// A box from its centre and half sizes.
    pub(crate) fn centered(center_m: [f32; 3], half_m: [f32; 3]) -> Self {
        Self {
            min_m: std::array::from_fn(|axis| center_m[axis] - half_m[axis]),
            max_m: std::array::from_fn(|axis| center_m[axis] + half_m[axis]),
        }
    }

    /// The smallest box around both.
    pub fn union(&self, other: &Self) -> Self {
        Self {
            min_m: std::array::from_fn(|axis| self.min_m[axis].min(other.min_m[axis])),
            max_m: std::array::from_fn(|axis| self.max_m[axis].max(other.max_m[axis])),
        }
    }

    /// Radius of the upright cylinder around the origin that holds the box.
    pub fn radius_m(&self) -> f64 {
        let [x, y] =
            [0, 1].map(|axis: usize| f64::from(self.min_m[axis].abs().max(self.max_m[axis].abs())));
        x.hypot(y)
    }

    /// The eight corners.
    pub fn corners(&self) -> [[f32; 3]; 8] {
        std::array::from_fn(|corner| {
            std::array::from_fn(|axis| [self.min_m, self.max_m][corner >> axis & 1][axis])
        })
    }

    /// True if the plane through `origin` with unit normal `normal` touches the box.
    fn meets_plane(&self, origin: &[f32; 3], normal: &[f32; 3]) -> bool {
        // One millimetre against rounding.
        let (mut distance, mut reach) = (0.0f32, 1e-3f32);
        for axis in 0..3 {
            distance += normal[axis] * ((self.min_m[axis] + self.max_m[axis]) * 0.5 - origin[axis]);
            reach += normal[axis].abs() * (self.max_m[axis] - self.min_m[axis]) * 0.5;
        }
        distance.abs() <= reach
    }
}

impl Convex {
    /// The box around the part.
    pub fn bounds(&self) -> Bounds {
        match self {
            Self::Hull { bounds, .. } | Self::Box(bounds) => *bounds,
            Self::Cylinder {
                radius_m,
                half_height_m,
            } => Bounds::centered([0.0; 3], [*radius_m, *radius_m, *half_height_m]),
            Self::Ellipsoid { radii_m } => Bounds::centered([0.0; 3], *radii_m),
        }
    }

    /// Shortens the depths of a column to this part where it is hit from outside, and writes `id` there.
    pub(super) fn cast(&self, rays: &ColumnRays<'_>, depth: &mut [f32], hit: &mut [u32], id: u32) {
        let rays = &rays.cut(depth.len());
        // All rays of a column lie in one plane: a part beside it is not hit.
        if !self.bounds().meets_plane(&rays.origin, &rays.normal()) {
            return;
        }
        let pixels = (depth, hit, id);
        match self {
            Self::Hull { planes, .. } => cast_hull(planes, rays, pixels),
            Self::Box(bounds) => cast_box(bounds, rays, pixels),
            Self::Cylinder {
                radius_m,
                half_height_m,
            } => cast_cylinder([*radius_m, *half_height_m], rays, pixels),
            Self::Ellipsoid { radii_m } => cast_ellipsoid(*radii_m, rays, pixels),
        }
    }
}

/// Replaces the depth by the entry into a solid where that is nearer.
///
/// Written with selects instead of a branch so that the loops around it become vector code.
#[inline(always)]
pub(super) fn shorten(enter: f32, is_hit: bool, depth: &mut f32, hit: &mut u32, id: u32) {
    // Entries behind the origin do not count: a sensor inside a solid does not see it.
    let nearer = is_hit & (enter > 0.0) & (enter < *depth);
    *depth = if nearer { enter } else { *depth };
    *hit = if nearer { id } else { *hit };
}

#[inline(always)]
fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
pub(super) fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn off_zero(value: f32) -> f32 {
    let is_parallel = value.abs() < PARALLEL;
    if is_parallel { -PARALLEL } else { value }
}

fn cast_box(bounds: &Bounds, rays: &ColumnRays<'_>, (depth, hit, id): Pixels<'_>) {
    let low: [f32; 3] = std::array::from_fn(|axis| bounds.min_m[axis] - rays.origin[axis]);
    let high: [f32; 3] = std::array::from_fn(|axis| bounds.max_m[axis] - rays.origin[axis]);
    let (h, u) = (rays.forward, rays.up);
    for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
        // Slab test: the ray is inside between its last entry and its first exit.
        let [(x_in, x_out), (y_in, y_out), (z_in, z_out)] = [0, 1, 2].map(|axis| {
            let inverse = 1.0 / off_zero(h[axis] * cos + u[axis] * sin);
            let (a, b) = (low[axis] * inverse, high[axis] * inverse);
            (lesser(a, b), greater(a, b))
        });
        let enter = greater(greater(x_in, y_in), z_in);
        let exit = lesser(lesser(x_out, y_out), z_out);
        shorten(enter, enter <= exit, depth, hit, id);
    }
}

fn cast_hull(planes: &[[f32; 4]], rays: &ColumnRays<'_>, (depth, hit, id): Pixels<'_>) {
    const LANES: usize = 64;
    for start in (0..depth.len()).step_by(LANES) {
        let count = LANES.min(depth.len() - start);
        let range = start..start + count;
        let (mut enter, mut exit) = ([f32::MIN; LANES], [f32::MAX; LANES]);
        for plane in planes {
            // Distance to the plane from inside, and its decrease along the two directions that span the column.
            let [origin, along, rise] = [rays.origin, rays.forward, rays.up]
                .map(|v| plane[0] * v[0] + plane[1] * v[1] + plane[2] * v[2]);
            let inside = plane[3] - origin;
            let lanes = enter[..count].iter_mut().zip(&mut exit[..count]);
            for ((enter, exit), (cos, sin)) in
                lanes.zip(rays.cos[range.clone()].iter().zip(&rays.sin[range.clone()]))
            {
                let slope = off_zero(along * cos + rise * sin);
                let at = inside / slope;
                let (latest, earliest) = (greater(*enter, at), lesser(*exit, at));
                // Against the normal the ray enters through the plane, along the normal it leaves.
                *enter = if slope < 0.0 { latest } else { *enter };
                *exit = if slope < 0.0 { *exit } else { earliest };
            }
        }
        let lanes = enter[..count].iter().zip(&exit[..count]);
        for ((enter, exit), (depth, hit)) in
            lanes.zip(depth[range.clone()].iter_mut().zip(&mut hit[range]))
        {
            shorten(*enter, enter <= exit, depth, hit, id);
        }
    }
}

fn cast_cylinder(
    [radius, half_height]: [f32; 2],
    rays: &ColumnRays<'_>,
    (depth, hit, id): Pixels<'_>,
) {
    let (o, h, u) = (rays.origin, rays.forward, rays.up);
    for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
        let [dx, dy, dz] = [0, 1, 2].map(|axis| h[axis] * cos + u[axis] * sin);
        let dz = off_zero(dz);
        let flat = greater(dx * dx + dy * dy, PARALLEL);
        // From the ray's distance to the axis rather than from b^2 - ac, which cancels for a thin pole far away.
        let aside = o[0] * dy - o[1] * dx;
        let room = radius * radius * flat - aside * aside;
        let half_chord = greater(room, 0.0).sqrt();
        let middle = -(o[0] * dx + o[1] * dy);
        let inverse = 1.0 / dz;
        let a = (-half_height - o[2]) * inverse;
        let b = (half_height - o[2]) * inverse;
        let enter = greater((middle - half_chord) / flat, lesser(a, b));
        let exit = lesser((middle + half_chord) / flat, greater(a, b));
        shorten(enter, (room >= 0.0) & (enter <= exit), depth, hit, id);
    }
}

fn cast_ellipsoid(radii: [f32; 3], rays: &ColumnRays<'_>, (depth, hit, id): Pixels<'_>) {
    // In the space where the ellipsoid is the unit sphere.
    let o: [f32; 3] = std::array::from_fn(|axis| rays.origin[axis] / radii[axis]);
    let h: [f32; 3] = std::array::from_fn(|axis| rays.forward[axis] / radii[axis]);
    let u: [f32; 3] = std::array::from_fn(|axis| rays.up[axis] / radii[axis]);
    for (((cos, sin), depth), hit) in rays.cos.iter().zip(rays.sin).zip(depth).zip(hit) {
        let d = [0, 1, 2].map(|axis| h[axis] * cos + u[axis] * sin);
        let square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
        // From the place nearest to the centre, since b^2 - ac would cancel for a small ellipsoid far away.
        let middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / square;
        let [x, y, z] = [0, 1, 2].map(|axis| o[axis] + middle * d[axis]);
        let room = 1.0 - (x * x + y * y + z * z);
        let enter = middle - (greater(room, 0.0) / square).sqrt();
        shorten(enter, room >= 0.0, depth, hit, id);
    }
}
