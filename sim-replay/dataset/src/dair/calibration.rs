//! Poses of the two sides from their calibration files, one per frame.

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::Sides;
use super::index::{FramePair, Kind, offset_m};
use crate::Result;
use crate::json::{self, JsonField};

/// Folders of the vehicle's calibration: from LiDAR to its GNSS and IMU unit (NovAtel), and from there to the world.
pub(super) const VEHICLE: [&str; 2] = [
    "vehicle-side/calib/lidar_to_novatel",
    "vehicle-side/calib/novatel_to_world",
];
/// Folder of the roadside unit's calibration. Its LiDAR frame is level: a virtual one.
pub(super) const INFRASTRUCTURE: &str = "infrastructure-side/calib/virtuallidar_to_world";

/// Largest deviation of a published matrix from orthonormality. Some deviate by a few thousandths; the nearest rotation
/// is used.
const ROTATION_TOLERANCE: f64 = 0.05;

/// Poses of the vehicle and its LiDAR.
#[derive(Debug, Clone, Copy)]
pub(super) struct VehiclePoses {
    pub(super) world_from_novatel: Isometry3<f64>,
    pub(super) world_from_lidar: Isometry3<f64>,
}

/// Reads the poses of the vehicle.
pub(super) fn vehicle(sides: &Sides, pair: &FramePair) -> Result<VehiclePoses> {
    let [novatel_from_lidar, world_from_novatel] =
        VEHICLE.map(|folder| sides.json(folder, &pair.vehicle));
    let (world_from_novatel, _) = read_transform(&world_from_novatel)?;
    let (novatel_from_lidar, _) = read_transform(&novatel_from_lidar)?;
    Ok(VehiclePoses {
        world_from_novatel,
        world_from_lidar: world_from_novatel * novatel_from_lidar,
    })
}

/// Reads the pose of the roadside unit's LiDAR.
///
/// The world frames of the two sides differ slightly. DAIR-V2X adds the pair's offset in the world, V2X-Seq in the
/// vehicle's LiDAR frame (`Coord_transformation` and `Coord_transformation_spd` of the data sets' own code). Without an
/// offset of the pair that of the calibration file is used (`relative_error`), as in early releases.
pub(super) fn infrastructure(sides: &Sides, pair: &FramePair) -> Result<Isometry3<f64>> {
    let path = sides.json(INFRASTRUCTURE, &pair.infrastructure);
    let (world_from_lidar, own_offset_m) = read_transform(&path)?;
    let [x_m, y_m] = pair.offset_m.unwrap_or(own_offset_m);
    let offset = Translation3::new(x_m, y_m, 0.0);
    // Without an offset the files of the vehicle are not needed.
    if sides.kind == Kind::Dair || [x_m, y_m] == [0.0; 2] {
        return Ok(offset * world_from_lidar);
    }
    let world_from_vehicle = vehicle(sides, pair)?.world_from_lidar;
    Ok(world_from_vehicle * offset * world_from_vehicle.inverse() * world_from_lidar)
}

/// A transform, and the offset given with it, metres: `{rotation, translation}`, in some files below `transform`.
fn read_transform(path: &Path) -> Result<(Isometry3<f64>, [f64; 2])> {
    let value = json::read(path)?;
    let root = JsonField::root(path, &value);
    let own_offset_m = root.optional_of("relative_error", offset_m)?;
    let transform = root.optional("transform")?.unwrap_or(root);
    let rotation = nearest_rotation(&transform.required("rotation")?)?;
    let translation = Translation3::from(transform.required("translation")?.numbers::<3>()?);
    let transform = Isometry3::from_parts(translation, rotation);
    Ok((transform, own_offset_m.unwrap_or_default()))
}

/// The rotation nearest to a 3x3 matrix, row by row.
fn nearest_rotation(field: &JsonField<'_>) -> Result<UnitQuaternion<f64>> {
    let matrix = Matrix3::from_row_slice(&field.numbers::<9>()?);
    let deviation = (matrix * matrix.transpose() - Matrix3::identity()).amax();
    let determinant = matrix.determinant();
    let is_rotation = deviation <= ROTATION_TOLERANCE && determinant > 0.0;
    if !is_rotation {
        let reason = format!(
            "no rotation: off orthonormal by {deviation:.3}, determinant {determinant:.3}, expected at most \
             {ROTATION_TOLERANCE} and 1"
        );
        return Err(field.error(reason));
    }
    let parts = matrix.svd(true, true);
    let (Some(u), Some(v_transposed)) = (parts.u, parts.v_t) else {
        return Err(field.error("no rotation"));
    };
    // U V^T is the nearest rotation. The determinant was checked, so it is no reflection.
    let rotation = Rotation3::from_matrix_unchecked(u * v_transposed);
    Ok(UnitQuaternion::from_rotation_matrix(&rotation))
}
