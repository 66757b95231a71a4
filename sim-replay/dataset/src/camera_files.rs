//! Camera images of the OPV2V family: their files beside the sweeps, and their calibration in the frame's YAML.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use imagesize::ImageSize;
use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion};
use protocol::{Camera, CameraMetadata, ImageFormat, Limits, Payload, Pinhole, Pose};

use super::yaml::YamlField;
use super::{ReadError, Result, files};

/// Prefixes of the number of a camera in file names and in the YAML: OPV2V's and V2X-Real's.
const PREFIXES: [&str; 2] = ["camera", "cam"];
/// Most digits of the number of a camera, zeros in front included.
const MAX_DIGITS: usize = 3;
/// Endings of image files.
const ENDINGS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];
/// Largest image file that is read, bytes.
const MAX_BYTES: u64 = 32 << 20;

/// Numbers of the cameras that have images among the files of an agent.
pub(super) fn numbers(names: &[String]) -> BTreeSet<u8> {
    names.iter().filter_map(|name| number(name)).collect()
}

/// The camera of `<stem>_camera<k>.png`.
fn number(name: &str) -> Option<u8> {
    let (name, ending) = name.rsplit_once('.')?;
    let (_, camera) = name.rsplit_once('_')?;
    let mut prefixes = PREFIXES.iter();
    let digits = prefixes.find_map(|prefix| camera.strip_prefix(prefix))?;
    let is_image = ENDINGS.contains(&ending);
    let is_number = digits.len() <= MAX_DIGITS && digits.bytes().all(|byte| byte.is_ascii_digit());
    digits.parse().ok().filter(|_| is_image && is_number)
}

/// The names of a camera: its number may have zeros in front.
fn names_of(number: u8) -> impl Iterator<Item = String> {
    let digits = number.to_string().len()..=MAX_DIGITS;
    PREFIXES.into_iter().flat_map(move |prefix| {
        let digits = digits.clone();
        digits.map(move |digits| format!("{prefix}{number:0digits$}"))
    })
}

/// The image of a camera beside `dir/stem.yaml`.
pub(super) fn find(dir: &Path, stem: &str, number: u8) -> Result<PathBuf> {
    let mut found = names_of(number).filter_map(|name| {
        let paths = ENDINGS.map(|ending| dir.join(format!("{stem}_{name}.{ending}")));
        paths.into_iter().find(|path| path.is_file())
    });
    let Some(image) = found.next() else {
        let path = dir.join(format!("{stem}_{}{number}.{}", PREFIXES[0], ENDINGS[0]));
        let reason = "there is no image of this camera, which has some of other frames";
        return Err(ReadError::malformed(&path, reason));
    };
    if let Some(other) = found.next() {
        let reason = format!("camera {number} has another image, {}", other.display());
        return Err(ReadError::malformed(&image, reason));
    }
    Ok(image)
}

/// Reads an image; its calibration is that of the entry for the camera in `root`, if there is one.
///
/// `world_from_lidar` and the poses of the cameras in the file are as `pose` reads them.
pub(super) fn read(
    path: &Path,
    number: u8,
    root: &YamlField<'_>,
    pose: &dyn Fn(&YamlField<'_>) -> Result<Pose>,
) -> Result<Camera> {
    let image = files::read_limited(path, MAX_BYTES)?;
    let format = ImageFormat::of_bytes(&image)
        .ok_or_else(|| ReadError::malformed(path, "neither a PNG nor a JPEG by its first bytes"))?;
    let ImageSize { width, height } = imagesize::blob_size(&image)
        .map_err(|error| ReadError::malformed(path, error.to_string()))?;
    let [width_px, height_px] = [width, height].map(|edge| u32::try_from(edge).unwrap_or(u32::MAX));
    let mut metadata = CameraMetadata {
        format,
        width_px,
        height_px,
        pinhole: None,
        lidar_from_camera: None,
    };
    for name in names_of(number) {
        let Some(entry) = root.optional(&name)? else {
            continue;
        };
        let intrinsic = entry.optional("intrinsic")?;
        metadata.pinhole = intrinsic.map(|field| pinhole(&field)).transpose()?;
        if let (Some(cords), Some(lidar)) = (entry.optional("cords")?, root.optional("lidar_pose")?)
        {
            metadata.lidar_from_camera = Some(lidar_from_camera(&pose(&lidar)?, &pose(&cords)?));
        }
    }
    Camera::check(&metadata, &Limits::DEFAULT)
        .map_err(|error| ReadError::malformed(path, error.to_string()))?;
    Ok(Camera { metadata, image })
}

fn pinhole(field: &YamlField<'_>) -> Result<Pinhole> {
    let items = field.items()?;
    let rows = items.iter().map(YamlField::numbers::<3>);
    let rows = rows.collect::<Result<Vec<_>, _>>()?;
    match rows.as_slice() {
        &[[fx_px, _, cx_px], [_, fy_px, cy_px], _] => Ok(Pinhole {
            fx_px,
            fy_px,
            cx_px,
            cy_px,
        }),
        _ => Err(field.error(format!("{} rows, expected 3", rows.len()))),
    }
}

/// The optical frame, z ahead, x right, y down, in the frame of a camera that looks along x, with y left and z up.
pub fn body_from_optical() -> Isometry3<f64> {
    // Columns: the optical x (right), y (down) and z (ahead) as -y, -z and x of the camera's body.
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(nalgebra::Translation3::identity(), rotation)
}

fn lidar_from_camera(world_from_lidar: &Pose, world_from_body: &Pose) -> Pose {
    let (lidar, body) = (world_from_lidar.isometry(), world_from_body.isometry());
    (lidar.inv_mul(&body) * body_from_optical()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_recognised_by_their_names() {
        let names = [
            "000069_camera0.png",
            "000069_camera3.JPG",
            "000069_cam2.jpeg",
            "000069_camera_gt.png",
            "a.png",
        ];
        let found = numbers(&names.map(str::to_owned));
        assert_eq!(found.into_iter().collect::<Vec<_>>(), [0, 2, 3]);
    }

    #[test]
    fn an_image_is_found_by_a_number_with_zeros_and_two_of_a_camera_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let [first, second] = ["1_camera07.png", "1_cam7.jpg"].map(|name| folder.path().join(name));
        std::fs::write(&first, "").unwrap();
        assert_eq!(find(folder.path(), "1", 7).unwrap(), first);
        std::fs::write(&second, "").unwrap();
        let problem = find(folder.path(), "1", 7).unwrap_err().to_string();
        assert!(
            problem.contains("camera07.png") && problem.contains("cam7.jpg"),
            "{problem}"
        );
    }

    #[test]
    fn a_camera_that_looks_ahead_sees_what_is_ahead_in_its_middle() {
        let lidar = Pose::from_xyz_yaw([10.0, 5.0, 1.9], 0.3);
        let ahead = lidar.isometry() * Isometry3::translation(3.0, 0.0, -0.9);
        let found = lidar_from_camera(&lidar, &ahead.into()).isometry();
        let point = found.inverse() * nalgebra::Point3::new(13.0, 1.0, -1.9);
        assert!(
            (point.coords - nalgebra::Vector3::new(-1.0, 1.0, 10.0)).norm() < 1e-9,
            "{point}"
        );
        let pinhole = Pinhole {
            fx_px: 100.0,
            fy_px: 100.0,
            cx_px: 50.0,
            cy_px: 40.0,
        };
        assert_eq!(pinhole.project([-1.0, 1.0, 10.0]), Some([40.0, 50.0]));
        assert_eq!(pinhole.project([0.0, 0.0, -1.0]), None);
    }
}
