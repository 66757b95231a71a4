//! Point files of all layouts, and the mirror for left-handed ones.

use std::path::Path;

use protocol::PointCloud;

use super::{ReadError, files};
use crate::pcd::{self, PcdCloud, Place};

/// Largest point file that is read, bytes: a sweep of a 128-channel LiDAR has some 10 MB.
const MAX_BYTES: u64 = 1 << 30;

/// Reads a PCD file.
pub(super) fn read_pcd(path: &Path) -> Result<PcdCloud, ReadError> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    pcd::decode(&bytes).map_err(|error| ReadError::Malformed {
        path: path.to_owned(),
        line: error.line,
        field: error.field,
        reason: error.reason,
    })
}

/// Reads little-endian `f32` x, y, z, intensity per point (KITTI, converted NCLT).
pub(super) fn read_interleaved(path: &Path) -> Result<PcdCloud, ReadError> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let points = whole_points::<16>(path, &bytes)?;
    Ok(finite_points(points.iter().map(|point| {
        let (numbers, _) = point.as_chunks::<4>();
        [0, 1, 2, 3].map(|index| f32::from_le_bytes(numbers[index]))
    })))
}

/// Reads little-endian `f32`, component by component: all x, all y, all z, all intensities (Oxford).
pub(super) fn read_planar(path: &Path) -> Result<PcdCloud, ReadError> {
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let count = whole_points::<16>(path, &bytes)?.len();
    let (numbers, _) = bytes.as_chunks::<4>();
    Ok(finite_points((0..count).map(|point| [0, 1, 2, 3].map(|c| f32::from_le_bytes(numbers[c * count + point])))))
}

/// Reads NCLT's raw points: `u16` x, y, z in steps of 5 mm from -100 m, `u8` intensity, `u8` laser.
pub(super) fn read_nclt_raw(path: &Path) -> Result<PcdCloud, ReadError> {
    const STEP_M: f64 = 0.005;
    const OFFSET_M: f64 = -100.0;
    let bytes = files::read_limited(path, MAX_BYTES)?;
    let points = whole_points::<8>(path, &bytes)?;
    Ok(finite_points(points.iter().map(|&[x0, x1, y0, y1, z0, z1, intensity, _laser]| {
        let metres = |bytes| (f64::from(u16::from_le_bytes(bytes)) * STEP_M + OFFSET_M) as f32;
        [metres([x0, x1]), metres([y0, y1]), metres([z0, z1]), f32::from(intensity)]
    })))
}

/// Turns y round: left-handed points become right-handed ones.
pub(super) fn mirror_y(cloud: &mut PointCloud) {
    for [_, y, ..] in &mut cloud.xyzi {
        *y = -*y;
    }
}

fn whole_points<'a, const N: usize>(path: &Path, bytes: &'a [u8]) -> Result<&'a [[u8; N]], ReadError> {
    let (points, rest) = bytes.as_chunks::<N>();
    if rest.is_empty() {
        return Ok(points);
    }
    let reason = format!("{} bytes are not a whole number of points of {N} bytes: the file is cut off", bytes.len());
    Err(ReadError::malformed(path, reason))
}

fn finite_points(points: impl ExactSizeIterator<Item = [f32; 4]>) -> PcdCloud {
    let mut cloud = PcdCloud::default();
    cloud.points.xyzi.reserve_exact(points.len());
    for (index, point) in points.enumerate() {
        if point.iter().all(|value| value.is_finite()) {
            cloud.points.xyzi.push(point);
        } else {
            cloud.dropped += 1;
            cloud.first_dropped.get_or_insert(Place::Point(index as u64));
        }
    }
    cloud
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn file(dir: &tempfile::TempDir, bytes: &[u8]) -> PathBuf {
        let path = dir.path().join("0.bin");
        std::fs::write(&path, bytes).unwrap();
        path
    }

    #[test]
    fn interleaved_and_planar_differ_in_order_only() {
        let dir = tempfile::tempdir().unwrap();
        let numbers = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let expected = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]];
        let path = file(&dir, &numbers(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]));
        assert_eq!(read_interleaved(&path).unwrap().points.xyzi, expected);
        let path = file(&dir, &numbers(&[1.0, 5.0, 2.0, 6.0, 3.0, 7.0, 4.0, 8.0]));
        assert_eq!(read_planar(&path).unwrap().points.xyzi, expected);
    }

    #[test]
    fn raw_points_are_in_steps_of_five_millimetres() {
        let dir = tempfile::tempdir().unwrap();
        let path = file(&dir, &[0, 0, 0x20, 0x4e, 0xff, 0xff, 55, 31]);
        let cloud = read_nclt_raw(&path).unwrap();
        assert_eq!(cloud.points.xyzi, [[-100.0, 0.0, 227.675, 55.0]]);
    }

    #[test]
    fn a_cut_file_and_a_nan_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let message = read_interleaved(&file(&dir, &[0; 17])).unwrap_err().to_string();
        assert!(message.contains("17 bytes are not a whole number of points of 16 bytes"), "{message}");
        let mut bytes = vec![0; 16];
        bytes.extend(f32::NAN.to_le_bytes().repeat(4));
        let cloud = read_interleaved(&file(&dir, &bytes)).unwrap();
        assert_eq!((cloud.points.len(), cloud.dropped, cloud.first_dropped), (1, 1, Some(Place::Point(1))));
    }
}
