//! Variants of sweeps: the same drive as other LiDARs, mounts and filters would have stored it.
//!
//! `vary_sweeps DATASET OUT [EVERY]` writes a folder of clouds with poses per variant, from every EVERY-th tick (1) of all
//! vehicles. `agent eval --dataset OUT/VARIANT --head HEAD` measures how many of them a head finds.

use std::collections::HashMap;
use std::fmt::Write;
use std::fs;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use dataset::LoadOptions;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion};

/// Height of the LiDAR on the vehicles of generated scenes, metres.
const LIDAR_HEIGHT_M: f64 = 1.9;
/// Rays of one laser differ less than lasers do, degrees.
const LASER_GAP_DEG: f64 = 0.05;

type Point = [f32; 4];
/// Change of the points of a sweep that keeps their frame.
type Filter = fn(&[Point]) -> Vec<Point>;

/// A variant: what happens to the points, and the frame in which they are stored then.
struct Variant {
    name: &'static str,
    filter: Filter,
    stored_from_lidar: Isometry3<f64>,
}

fn turned(roll_deg: f64, pitch_deg: f64, yaw_deg: f64) -> Isometry3<f64> {
    let [roll, pitch, yaw] = [roll_deg, pitch_deg, yaw_deg].map(f64::to_radians);
    let turn = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
    Isometry3::from_parts(Translation3::identity(), turn)
}

fn variants() -> Vec<Variant> {
    let same: Filter = <[Point]>::to_vec;
    let filtered: [(&str, Filter); 22] = [
        ("as-recorded", same),
        ("other-order", |points| {
            points.iter().rev().copied().collect()
        }),
        ("lasers-32", |points| every_laser(points, 2)),
        ("lasers-16", |points| every_laser(points, 4)),
        ("view-180", |points| ahead(points, 180.0)),
        ("view-120", |points| ahead(points, 120.0)),
        ("view-90", |points| ahead(points, 90.0)),
        ("view-70", |points| ahead(points, 70.0)),
        ("view-38", |points| ahead(points, 38.0)),
        ("range-50m", |points| within(points, 50.0)),
        ("range-30m", |points| within(points, 30.0)),
        ("range-15m", |points| within(points, 15.0)),
        ("no-ground", |points| above(points, 0.3)),
        ("half-1-of-2", |points| each(points, 2)),
        ("thinned-1-of-10", |points| each(points, 10)),
        ("voxels-0.2m", |points| voxels(points, 0.2)),
        ("voxels-0.5m", |points| voxels(points, 0.5)),
        ("noise-5cm", |points| noisy(points, 0.05)),
        ("noise-10cm", |points| noisy(points, 0.1)),
        ("two-lorries-beside", |points| {
            hidden(points, &[0.0, 180.0], 60.0)
        }),
        ("four-lorries-around", |points| {
            hidden(points, &[0.0, 90.0, 180.0, 270.0], 60.0)
        }),
        ("millimetres", |points| {
            points
                .iter()
                .map(|[x, y, z, i]| [x * 1e3, y * 1e3, z * 1e3, *i])
                .collect()
        }),
    ];
    let moved = |x, z| Isometry3::translation(x, 0.0, z);
    let camera = Rotation3::from_matrix_unchecked(Matrix3::new(
        0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0,
    ));
    let stored = [
        ("half-metre-higher", moved(0.0, -0.5)),
        ("half-metre-lower", moved(0.0, 0.5)),
        ("metre-higher", moved(0.0, -1.0)),
        ("two-metres-ahead", moved(-2.0, 0.0)),
        ("pitch-2", turned(0.0, 2.0, 0.0)),
        ("pitch-5", turned(0.0, 5.0, 0.0)),
        ("pitch-10", turned(0.0, 10.0, 0.0)),
        ("roll-5", turned(5.0, 0.0, 0.0)),
        ("yaw-90", turned(0.0, 0.0, 90.0)),
        ("yaw-180", turned(0.0, 0.0, 180.0)),
        ("upside-down", turned(180.0, 0.0, 0.0)),
        (
            "camera-axes",
            Isometry3::from_parts(Translation3::identity(), camera.into()),
        ),
        ("base-link", moved(0.0, LIDAR_HEIGHT_M)),
    ];
    let filtered = filtered.into_iter().map(|(name, filter)| Variant {
        name,
        filter,
        stored_from_lidar: Isometry3::identity(),
    });
    let stored = stored.into_iter().map(|(name, stored_from_lidar)| Variant {
        name,
        filter: same,
        stored_from_lidar,
    });
    filtered.chain(stored).collect()
}

/// Every `step`-th laser, from the lowest.
fn every_laser(points: &[Point], step: usize) -> Vec<Point> {
    let elevation_deg = |[x, y, z, _]: &Point| f64::from(z.atan2(x.hypot(*y))).to_degrees();
    let mut elevations: Vec<f64> = points.iter().map(elevation_deg).collect();
    elevations.sort_by(f64::total_cmp);
    let mut lasers: Vec<f64> = Vec::new();
    let mut last = f64::NEG_INFINITY;
    for elevation in elevations {
        if elevation - last > LASER_GAP_DEG {
            lasers.push(elevation);
        }
        last = elevation;
    }
    let laser = |point: &&Point| lasers.partition_point(|low| *low <= elevation_deg(point));
    points
        .iter()
        .filter(|point| laser(point) % step == 0)
        .copied()
        .collect()
}

/// The points in a field of view to the front.
fn ahead(points: &[Point], view_deg: f32) -> Vec<Point> {
    let half = view_deg.to_radians() / 2.0;
    let sees = |[x, y, ..]: &&Point| y.atan2(*x).abs() <= half;
    points.iter().filter(sees).copied().collect()
}

fn within(points: &[Point], range_m: f32) -> Vec<Point> {
    points
        .iter()
        .filter(|[x, y, ..]| x.hypot(*y) <= range_m)
        .copied()
        .collect()
}

/// Without the points less than this above a plane of the vehicle's height.
fn above(points: &[Point], height_m: f32) -> Vec<Point> {
    let low = height_m - LIDAR_HEIGHT_M as f32;
    points
        .iter()
        .filter(|[_, _, z, _]| *z > low)
        .copied()
        .collect()
}

fn each(points: &[Point], step: usize) -> Vec<Point> {
    points.iter().step_by(step).copied().collect()
}

/// The first point of each cell.
fn voxels(points: &[Point], edge_m: f32) -> Vec<Point> {
    let mut cells = HashMap::new();
    for point in points {
        let [x, y, z, _] = point.map(|value| (value / edge_m).floor() as i32);
        cells.entry([x, y, z]).or_insert(*point);
    }
    let mut cells: Vec<_> = cells.into_iter().collect();
    cells.sort_by_key(|(cell, _)| *cell);
    cells.into_iter().map(|(_, point)| point).collect()
}

/// Normal noise of the range.
fn noisy(points: &[Point], std_m: f32) -> Vec<Point> {
    let mut random = support::random::SplitMix64::new(7);
    let mut shifted = |&[x, y, z, i]: &Point| {
        let range = (x * x + y * y + z * z).sqrt().max(0.1);
        let scale = 1.0 + std_m * random.normal() as f32 / range;
        [x * scale, y * scale, z * scale, i]
    };
    points.iter().map(&mut shifted).collect()
}

/// Without the points behind something that hides `width_deg` on each of these sides.
fn hidden(points: &[Point], sides_deg: &[f32], width_deg: f32) -> Vec<Point> {
    let sees = |[x, y, ..]: &&Point| {
        let side_deg = y.atan2(*x).to_degrees() - 90.0;
        let apart_deg = |other: &f32| ((side_deg - other + 540.0).rem_euclid(360.0) - 180.0).abs();
        sides_deg
            .iter()
            .all(|side| apart_deg(side) > width_deg / 2.0)
    };
    points.iter().filter(sees).copied().collect()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let folder: PathBuf = arguments.next().ok_or("which data set?")?.into();
    let out: PathBuf = arguments
        .next()
        .ok_or("which folder for the variants?")?
        .into();
    let every: NonZeroUsize = match arguments.next() {
        Some(text) => text.to_str().ok_or("EVERY is no number")?.parse()?,
        None => NonZeroUsize::MIN,
    };
    let dataset = dataset::open(&folder)?;
    let mut sweeps = Vec::new();
    for scenario in &dataset.scenarios {
        for tick in (0..scenario.ticks.len()).step_by(every.get()) {
            for agent in
                (0..scenario.agents.len()).filter(|agent| scenario.is_present(*agent, tick))
            {
                let frame = scenario.load(agent, tick, &LoadOptions::default())?;
                let pose = frame.world_from_lidar.ok_or("a sweep without a pose")?;
                sweeps.push((frame.points.xyzi, pose.isometry()));
            }
        }
    }
    for Variant {
        name,
        filter,
        stored_from_lidar,
    } in variants()
    {
        let clouds = out.join(name).join("clouds");
        fs::create_dir_all(&clouds)?;
        let mut poses = String::new();
        for (number, (points, world_from_lidar)) in sweeps.iter().enumerate() {
            let stored = filter(points).into_iter().flat_map(|[x, y, z, intensity]| {
                let point = stored_from_lidar * Point3::new(x, y, z).cast();
                [point.x as f32, point.y as f32, point.z as f32, intensity]
            });
            let bytes: Vec<u8> = stored.flat_map(f32::to_le_bytes).collect();
            fs::write(clouds.join(format!("{number:06}.bin")), bytes)?;
            let world_from_stored =
                (world_from_lidar * stored_from_lidar.inverse()).to_homogeneous();
            let rows = world_from_stored.fixed_rows::<3>(0).transpose();
            let values: Vec<String> = rows.iter().map(f64::to_string).collect();
            writeln!(poses, "{}", values.join(" "))?;
        }
        fs::write(out.join(name).join("poses.txt"), poses)?;
        println!("{name}: {} sweeps", sweeps.len());
    }
    Ok(())
}
