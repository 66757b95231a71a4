//! The caster against ray-by-ray intersection in `f64` that shares none of its code.

use std::f64::consts::PI;

use nalgebra::{Point3, Vector3};

use super::*;
use support::random::SplitMix64;

fn spinning() -> RayPattern {
    RayPattern {
        first_azimuth_rad: std::f32::consts::PI,
        azimuth_step_rad: -std::f32::consts::TAU / 360.0,
        columns: 360,
        first_elevation_rad: (-25.0f32).to_radians(),
        elevation_step_rad: 27.0f32.to_radians() / 63.0,
        channels: 64,
        range_m: 120.0,
        rolling: true,
    }
}

fn fan() -> RayPattern {
    RayPattern {
        first_azimuth_rad: -1.0,
        azimuth_step_rad: 0.02,
        columns: 101,
        first_elevation_rad: -0.25,
        elevation_step_rad: 0.02,
        channels: 25,
        range_m: 150.0,
        rolling: false,
    }
}

fn random_part(random: &mut SplitMix64) -> Convex {
    let mut size = |low: f64, high: f64| random.between(low, high) as f32;
    let center = [size(-1.0, 1.0), size(-1.0, 1.0), size(-1.0, 1.0)];
    let half = [size(0.1, 6.0), size(0.1, 3.0), size(0.1, 4.0)];
    match random.below(4) {
        0 => Convex::Box(Bounds::centered(center, half)),
        1 => Convex::Cylinder {
            radius_m: half[0] * 0.2,
            half_height_m: half[2],
        },
        2 => Convex::Ellipsoid { radii_m: half },
        _ => {
            // A box with its upper edges cut off obliquely.
            let bounds = Bounds::centered(center, half);
            let mut planes = Vec::new();
            for axis in 0..3 {
                let mut normal = [0.0f32; 3];
                normal[axis] = 1.0;
                planes.push([normal[0], normal[1], normal[2], bounds.max_m[axis]]);
                planes.push([-normal[0], -normal[1], -normal[2], -bounds.min_m[axis]]);
            }
            let (s, c) = 0.7f32.sin_cos();
            planes.push([s, 0.0, c, s * center[0] + c * center[2] + 0.5 * half[2]]);
            planes.push([0.0, s, c, s * center[1] + c * center[2] + 0.5 * half[2]]);
            Convex::Hull { planes, bounds }
        }
    }
}

fn random_motion(random: &mut SplitMix64, reach_m: f64) -> Course {
    let position = [
        random.between(-reach_m, reach_m),
        random.between(-reach_m, reach_m),
        random.between(-1.0, 3.0),
    ];
    let start = Placement {
        pitch_rad: random.between(-0.1, 0.1),
        ..Placement::level(position, random.between(-PI, PI))
    };
    if random.chance(0.4) {
        return Course::still(start);
    }
    let mut end = start;
    end.position_m += Vector3::new(random.between(-1.5, 1.5), random.between(-1.5, 1.5), 0.0);
    end.yaw_rad = wrapped(end.yaw_rad + random.between(-0.04, 0.04));
    Course { start, end }
}

/// Entry and exit of a ray that is clipped at each half-space.
fn clip(planes: &[[f64; 4]], o: &Point3<f64>, d: &Vector3<f64>) -> Option<(f64, f64)> {
    let (mut near, mut far) = (f64::MIN, f64::MAX);
    for p in planes {
        let n = Vector3::new(p[0], p[1], p[2]);
        let (inside, slope) = (p[3] - n.dot(&o.coords), n.dot(d));
        if slope < 0.0 {
            near = near.max(inside / slope);
        } else if slope > 0.0 {
            far = far.min(inside / slope);
        } else if inside < 0.0 {
            return None;
        }
    }
    (near <= far).then_some((near, far))
}

/// Half-spaces of a box along some axes.
fn slabs(b: &Bounds, axes: &[usize]) -> Vec<[f64; 4]> {
    axes.iter()
        .flat_map(|&axis| {
            let mut up = [0.0; 4];
            up[axis] = 1.0;
            up[3] = f64::from(b.max_m[axis]);
            let mut down = [0.0; 4];
            down[axis] = -1.0;
            down[3] = -f64::from(b.min_m[axis]);
            [up, down]
        })
        .collect()
}

/// Roots of `a t^2 + 2 b t + c`.
fn roots(a: f64, b: f64, c: f64) -> Option<(f64, f64)> {
    let room = b * b - a * c;
    (room >= 0.0).then(|| ((-b - room.sqrt()) / a, (-b + room.sqrt()) / a))
}

/// Entry of a ray into a part, by clipping the ray at each half-space or by the quadratic formula.
fn enter(part: &Convex, o: &Point3<f64>, d: &Vector3<f64>) -> Option<f64> {
    match part {
        Convex::Box(bounds) => clip(&slabs(bounds, &[0, 1, 2]), o, d).map(|(near, _)| near),
        Convex::Hull { planes, .. } => {
            let planes: Vec<[f64; 4]> = planes.iter().map(|p| p.map(f64::from)).collect();
            clip(&planes, o, d).map(|(near, _)| near)
        }
        Convex::Cylinder { radius_m, .. } => {
            let r = f64::from(*radius_m);
            let (near, far) = roots(
                d.x * d.x + d.y * d.y,
                o.x * d.x + o.y * d.y,
                o.x * o.x + o.y * o.y - r * r,
            )?;
            let (bottom, top) = clip(&slabs(&part.bounds(), &[2]), o, d)?;
            (near.max(bottom) <= far.min(top)).then(|| near.max(bottom))
        }
        Convex::Ellipsoid { radii_m } => {
            let r: Vector3<f64> = Vector3::from(*radii_m).cast();
            let o = o.coords.component_div(&r);
            let d = d.component_div(&r);
            roots(d.dot(&d), o.dot(&d), o.dot(&o) - 1.0).map(|(near, _)| near)
        }
    }
}

fn brute_force(
    pattern: &RayPattern,
    sensor: &Course,
    ground: f64,
    bodies: &[RayBody<'_>],
) -> RangeImage {
    let mut image = RangeImage::default();
    for column in 0..pattern.columns {
        let time = pattern.time(column);
        let world_from_sensor = sensor.at(time).isometry();
        let azimuth = f64::from(pattern.azimuth_rad(column));
        for channel in 0..pattern.channels {
            let elevation = f64::from(pattern.elevation_rad(channel));
            let direction = world_from_sensor
                * Vector3::new(
                    elevation.cos() * azimuth.cos(),
                    elevation.cos() * azimuth.sin(),
                    elevation.sin(),
                );
            let origin = world_from_sensor * Point3::origin();
            let (mut best, mut hit) = (f64::from(pattern.range_m), MISS);
            let at = (ground - origin.z) / direction.z;
            if at > 0.0 && at < best {
                (best, hit) = (at, GROUND);
            }
            for (index, body) in bodies.iter().enumerate() {
                let body_from_world = body.motion.at(time).isometry().inverse();
                let (o, d) = (body_from_world * origin, body_from_world * direction);
                for part in &body.shape.parts {
                    if let Some(at) = enter(part, &o, &d).filter(|&at| at > 0.0 && at < best) {
                        (best, hit) = (at, index as u32);
                    }
                }
            }
            image.depths_m.push(best as f32);
            image.hits.push(hit);
        }
    }
    image
}

fn check_against_brute_force(
    pattern: RayPattern,
    seeds: std::ops::Range<u64>,
    reach_m: f64,
    sensor_z: f64,
) {
    let mut caster = Caster::new(pattern.clone());
    let (mut rays, mut on_bodies, mut silhouettes) = (0, 0, 0);
    for seed in seeds {
        let mut random = SplitMix64::new(seed);
        let shapes: Vec<SolidShape> = (0..60)
            .map(|_| {
                SolidShape::new(
                    (0..=random.below(3))
                        .map(|_| random_part(&mut random))
                        .collect(),
                    1.0,
                )
            })
            .collect();
        let bodies: Vec<RayBody<'_>> = shapes
            .iter()
            .map(|shape| RayBody {
                shape,
                motion: random_motion(&mut random, reach_m),
            })
            .collect();
        let mut sensor = random_motion(&mut random, 1.0);
        // Far from the origin of the world, where `f32` alone would be too coarse.
        let offset = Vector3::new(4_000.0, -7_000.0, sensor_z);
        sensor.start.position_m += offset;
        sensor.end.position_m += offset;
        let bodies: Vec<RayBody<'_>> = bodies
            .into_iter()
            .map(|mut body| {
                body.motion.start.position_m += offset;
                body.motion.end.position_m += offset;
                body
            })
            .collect();
        let ground = sensor_z - 3.0;
        let expected = brute_force(&pattern, &sensor, ground, &bodies);
        caster.cast(&sensor, &Plane(ground), &bodies);
        let image = &caster.image;
        for ray in 0..expected.hits.len() {
            rays += 1;
            on_bodies += usize::from(expected.hits[ray] < GROUND);
            let error = (image.depths_m[ray] - expected.depths_m[ray]).abs();
            // Rays that graze an edge may fall on either side of it in `f32`; they are counted, not exempted one by
            // one.
            silhouettes += usize::from(error > 2e-3 || image.hits[ray] != expected.hits[ray]);
        }
    }
    assert!(
        on_bodies * 5 > rays,
        "too few rays meet a body to prove anything: {on_bodies} of {rays}"
    );
    assert!(
        silhouettes * 2_000 < rays,
        "{silhouettes} of {rays} rays differ"
    );
}

#[test]
fn a_spinning_sweep_equals_brute_force() {
    check_against_brute_force(spinning(), 0..6, 60.0, 5.0);
}

#[test]
fn a_fan_equals_brute_force() {
    check_against_brute_force(fan(), 10..20, 40.0, 5.0);
}

#[test]
fn bodies_around_the_sensor_do_not_hide_the_rest() {
    let shell = SolidShape::new(
        vec![Convex::Box(Bounds::centered([0.0; 3], [3.0, 1.0, 2.0]))],
        1.0,
    );
    let wall = SolidShape::new(
        vec![Convex::Box(Bounds::centered([0.0; 3], [0.5, 40.0, 8.0]))],
        1.0,
    );
    let bodies = [
        RayBody {
            shape: &shell,
            motion: Course::still(Placement::level([0.0; 3], 0.0)),
        },
        RayBody {
            shape: &wall,
            motion: Course::still(Placement::level([20.5, 0.0, 0.0], 0.0)),
        },
    ];
    let mut caster = Caster::new(spinning());
    let sensor = Course::still(Placement::level([0.0, 0.0, 1.9], 0.0));
    caster.cast(&sensor, &Plane(0.0), &bodies);
    let image = &caster.image;
    assert!(image.hits.iter().all(|&hit| hit != 0) && image.hits.contains(&1));
    // Column 180 looks straight ahead: the wall's face is 20 m away in the channel nearest to level.
    let level = 180 * 64 + 58;
    assert!(
        (image.depths_m[level] - 20.0).abs() < 0.01,
        "{}",
        image.depths_m[level]
    );
}
