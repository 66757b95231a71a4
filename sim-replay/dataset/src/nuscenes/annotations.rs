//! Annotated objects of nuScenes tables, and the selection of those hit by a LiDAR.

use std::collections::HashMap;
use std::path::Path;

use nalgebra::Isometry3;
use protocol::PointCloud;

use super::rows::{Indices, read_all, referred, transform};
use super::samples::SceneSample;
use crate::findings::cells::PointCells;
use crate::frame::{Object, ObjectClass};
use crate::json::JsonField;
use crate::{ReadError, Result, classes};

/// Largest distance of a point outside a box that counts as a hit, metres: the margin of the public converter of
/// V2X-Sim.
const HIT_MARGIN_M: f64 = 0.2;
/// Unknown categories that are reported one by one.
const MAX_UNKNOWN: usize = 20;
/// Distance from the LiDAR within which a sweep hits most objects, metres.
const NEAR_M: f64 = 20.0;
/// Highest mount of a LiDAR above the roof, metres. Roadside units are mounted higher.
const MAX_MOUNT_M: f64 = 1.5;

/// Adds the objects to their samples. Rows that cannot be read are left out, with a problem; without
/// `sample_annotation.json` there are none.
pub(super) fn read(
    version: &Path,
    indices: &Indices,
    samples: &mut [SceneSample],
    problems: &mut Vec<ReadError>,
) {
    if !version.join("sample_annotation.json").is_file() {
        return;
    }
    let read = read_instances(version, problems).and_then(|instances| {
        read_all(version, "sample_annotation.json", problems, |row| {
            let sample = referred(row, "sample_token", indices)?;
            let object = object(row, &instances)?;
            if let Some(sample) = samples.get_mut(sample) {
                sample.objects.push(object);
            }
            Ok(())
        })
    });
    problems.extend(read.err());
}

/// Id and class of a physical object over time.
type Instance = (i64, ObjectClass);

fn read_instances(
    version: &Path,
    problems: &mut Vec<ReadError>,
) -> Result<HashMap<String, Instance>> {
    let (mut categories, mut unknown) = (HashMap::new(), Vec::new());
    read_all(version, "category.json", problems, |row| {
        let name = row.required("name")?;
        let class = classes::of_name(name.text()?);
        if class.is_none() && unknown.len() < MAX_UNKNOWN {
            let shown: String = name.text()?.chars().take(40).collect();
            unknown.push(name.error(format!(
                "{shown:?} is an unknown type of object: it counts as other, not as a vehicle"
            )));
        }
        let class = class.unwrap_or(ObjectClass::Other);
        categories.insert(row.required("token")?.id()?, class);
        Ok(())
    })?;
    problems.append(&mut unknown);
    let mut instances = HashMap::new();
    read_all(version, "instance.json", problems, |row| {
        let category = row.required("category_token")?;
        let class = *categories
            .get(&category.id()?)
            .ok_or_else(|| category.error("no row of category.json has this token"))?;
        let id = instances.len() as i64;
        instances.insert(row.required("token")?.id()?, (id, class));
        Ok(())
    })?;
    Ok(instances)
}

fn object(row: &JsonField<'_>, instances: &HashMap<String, Instance>) -> Result<Object> {
    let token = row.required("instance_token")?;
    let (id, class) = *instances
        .get(&token.id()?)
        .ok_or_else(|| token.error("no row of instance.json has this token"))?;
    let size = row.required("size")?;
    // nuScenes has the width first. Sizes here begin with the length.
    let [width, length, height] = size.checked_size(size.numbers()?)?;
    let (pose, size_m) = (transform(row)?.into(), [length, width, height]);
    Ok(Object::new(id, class, pose, size_m))
}

/// The objects that a sweep hits with at least one point, and the number of the others near the LiDAR. An object with
/// the LiDAR inside or on its roof is the vehicle that carries it: a vehicle does not list itself.
#[expect(
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    reason = "axes of vectors of three, rounded to f32"
)]
pub(super) fn seen<'a>(
    objects: &'a [Object],
    points: &PointCloud,
    world_from_lidar: &Isometry3<f64>,
) -> (Vec<&'a Object>, usize) {
    let (cells, mut missed) = (PointCells::new(points), 0);
    let hit = objects.iter().filter(|object| {
        let world_from_object = object.world_from_object.isometry();
        let object_from_lidar = world_from_object.inv_mul(world_from_lidar);
        let lidar = object_from_lidar.translation.vector;
        let half_m = object.size_m.map(|size| size / 2.0);
        let roof_m = [0.0, 0.0, MAX_MOUNT_M];
        // The mount is added at both ends of z: the test is symmetric about the centre of the box.
        let carries_lidar = (0..3).all(|axis| lidar[axis].abs() <= half_m[axis] + roof_m[axis]);
        let reach_m = half_m.map(|half| (half + HIT_MARGIN_M) as f32);
        let object_from_lidar = object_from_lidar.cast();
        let mut hits = cells.points_in(&object_from_lidar, reach_m, [1.0; 2]);
        let is_hit = hits.next().is_some();
        missed += usize::from(!carries_lidar && !is_hit && lidar.norm() < NEAR_M);
        !carries_lidar && is_hit
    });
    (hit.collect(), missed)
}
