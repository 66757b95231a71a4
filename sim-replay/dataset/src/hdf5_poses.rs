//! HDF5 files of LightLoc with the poses of a localization sequence.
//!
//! Datasets `valid_timestamps` (`n`, microseconds) and `poses` (`n x 12`). LightLoc leaves out the first and the last
//! five entries (`datasets/lidarloc.py`), and so does this reader.

use std::collections::BTreeMap;
use std::path::Path;

use hdf5_reader::{Dataset, Datatype, Hdf5File, OpenOptions};
use protocol::{InvalidPose, Pose};

use super::faults::Faults;
use super::{ReadError, Result, files, poses};
use support::rounding;

/// Largest HDF5 file, and largest dataset in it, that is read, bytes: a million poses.
const MAX_BYTES: usize = 128 << 20;
/// Entries left out at either end.
const TRIMMED: usize = 5;

/// Arrangement of the 12 numbers of a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RowOrder {
    /// A 3x4 matrix row by row, translation at 3, 7, 11 (Oxford, NCLT).
    Matrix,
    /// Nine numbers of the rotation row by row, then the translation (QEOxford).
    RotationFirst,
}

/// Poses by time stamp in microseconds, in the axes of the file. Invalid entries are left out and reported.
pub(super) fn read(
    path: &Path,
    order: RowOrder,
    problems: &mut Vec<ReadError>,
) -> Result<BTreeMap<u64, Pose>> {
    let bytes = files::read_limited(path, MAX_BYTES as u64)?;
    parse(path, bytes, order, problems)
}

fn parse(
    path: &Path,
    bytes: Vec<u8>,
    order: RowOrder,
    problems: &mut Vec<ReadError>,
) -> Result<BTreeMap<u64, Pose>> {
    let options = OpenOptions::default()
        .with_max_read_bytes(MAX_BYTES)
        .with_max_chunk_bytes(MAX_BYTES);
    let file = Hdf5File::from_vec_with_options(bytes, options)
        .map_err(|error| ReadError::malformed(path, format!("no sound HDF5: {error}")))?;
    let (stamps_shape, stamps) = numbers(path, &file, "valid_timestamps")?;
    let (poses_shape, poses) = numbers(path, &file, "poses")?;
    let [count] = stamps_shape[..] else {
        let reason = format!("shape {stamps_shape:?}, expected [n]");
        return Err(wrong(path, "valid_timestamps", reason));
    };
    if poses_shape != [count, 12] {
        let reason = format!("shape {poses_shape:?}, expected [{count}, 12]");
        return Err(wrong(path, "poses", reason));
    }
    let (rows, _) = poses.as_chunks::<12>();
    let kept = TRIMMED..stamps.len().saturating_sub(TRIMMED);
    let mut faults = Faults::default();
    let mut by_time = BTreeMap::new();
    let entries = stamps.iter().zip(rows).enumerate();
    for (index, (stamp, row)) in entries.filter(|(index, _)| kept.contains(index)) {
        if !(0.0..=1e18).contains(stamp) {
            let reason = format!("entry {index}: {stamp} are no microseconds");
            faults.push(wrong(path, "valid_timestamps", reason));
            continue;
        }
        let pose = pose(row, order)
            .map_err(|error| wrong(path, "poses", format!("entry {index}: {error}")));
        let pose = faults.take(pose);
        by_time.extend(pose.map(|pose| (rounding::to_u64(stamp.floor()), pose)));
    }
    faults.report("row", problems);
    Ok(by_time)
}

fn pose(row: &[f64; 12], order: RowOrder) -> Result<Pose, InvalidPose> {
    let &[a, b, c, d, e, f, g, h, i, x, y, z] = row;
    poses::of_rows(&match order {
        RowOrder::Matrix => *row,
        RowOrder::RotationFirst => [a, b, c, x, d, e, f, y, g, h, i, z],
    })
}

fn wrong(path: &Path, field: &str, reason: String) -> ReadError {
    ReadError::malformed_at(path, None, Some(field), reason)
}

/// Shape and values of a dataset of numbers. Microseconds since 1970 fit a double exactly.
fn numbers(path: &Path, file: &Hdf5File, name: &str) -> Result<(Vec<u64>, Vec<f64>)> {
    let dataset = file.dataset(name);
    let dataset = dataset.map_err(|error| wrong(path, name, error.to_string()))?;
    let values = match dataset.dtype() {
        Datatype::FloatingPoint { size: 4, .. } => values::<f32>(&dataset, f64::from),
        Datatype::FloatingPoint { .. } => values::<f64>(&dataset, |value| value),
        Datatype::FixedPoint { signed: false, .. } => values::<u64>(&dataset, |value| value as f64),
        Datatype::FixedPoint { .. } => values::<i64>(&dataset, |value| value as f64),
        other => return Err(wrong(path, name, format!("{other:?}, expected numbers"))),
    };
    let values = values.map_err(|error| wrong(path, name, error.to_string()))?;
    Ok((dataset.shape().to_vec(), values))
}

fn values<T: hdf5_reader::H5Type>(
    dataset: &Dataset,
    convert: fn(T) -> f64,
) -> Result<Vec<f64>, hdf5_reader::error::Error> {
    let values = dataset.read_array::<T>()?;
    Ok(values.into_iter().map(convert).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;
    pub(crate) use crate::hdf5_file::poses_file as file;

    fn parse(bytes: Vec<u8>, order: RowOrder) -> Result<BTreeMap<u64, Pose>> {
        let mut problems = Vec::new();
        let poses = super::parse(Path::new("a.h5"), bytes, order, &mut problems);
        assert!(problems.is_empty(), "{problems:?}");
        poses
    }

    const MATRIX: [f64; 12] = [0.0, -1.0, 0.0, 4.0, 1.0, 0.0, 0.0, 5.0, 0.0, 0.0, 1.0, 6.0];
    const ROTATION_FIRST: [f64; 12] = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0, 6.0];

    #[test]
    fn both_arrangements_give_the_same_and_the_ends_are_left_out() {
        let stamps: Vec<i64> = (0..12).map(|index| 1_326_652_795_280_148 + index).collect();
        let by_matrix = parse(file(&stamps, &[MATRIX; 12]), RowOrder::Matrix).unwrap();
        let by_rotation = parse(
            file(&stamps, &[ROTATION_FIRST; 12]),
            RowOrder::RotationFirst,
        )
        .unwrap();
        assert_eq!(by_matrix, by_rotation);
        assert_eq!(
            by_matrix.keys().copied().collect::<Vec<_>>(),
            [1_326_652_795_280_153, 1_326_652_795_280_154]
        );
        let pose = by_matrix[&1_326_652_795_280_153];
        assert_eq!(pose.translation_m, [4.0, 5.0, 6.0]);
        assert!((pose.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }

    fn refusal(bytes: Vec<u8>) -> String {
        parse(bytes, RowOrder::Matrix).unwrap_err().to_string()
    }

    #[test]
    fn what_is_wrong_is_named() {
        let stamps: Vec<i64> = (0..11).collect();
        assert!(
            refusal(file(&stamps, &[MATRIX; 10])).contains("shape [10, 12], expected [11, 12]")
        );
        assert!(refusal(b"no".to_vec()).starts_with("a.h5: no sound HDF5"));
    }

    #[test]
    fn a_bad_entry_is_left_out_and_named() {
        let stamps: Vec<i64> = (0..13).collect();
        for (value, expected) in [
            (7.0, "a.h5: poses: entry 6: pose matrix is not a rotation"),
            (f64::NAN, "a.h5: poses: entry 6: pose component NaN"),
        ] {
            let mut rows = [MATRIX; 13];
            rows[6][0] = value;
            let mut problems = Vec::new();
            let poses = super::parse(
                Path::new("a.h5"),
                file(&stamps, &rows),
                RowOrder::Matrix,
                &mut problems,
            )
            .unwrap();
            assert_eq!(poses.keys().copied().collect::<Vec<_>>(), [5, 7]);
            let message = problems[0].to_string();
            assert!(
                message.starts_with(expected) && message.ends_with("the row is left out"),
                "{message}"
            );
            assert_eq!(problems.len(), 1);
        }
    }

    #[test]
    fn truncations_are_errors_or_empty_and_never_panic() {
        let stamps: Vec<i64> = (0..12).collect();
        let whole = file(&stamps, &[MATRIX; 12]);
        for length in 0..whole.len() {
            assert!(
                parse(whole[..length].to_vec(), RowOrder::Matrix).is_err(),
                "{length} of {}",
                whole.len()
            );
        }
    }

    proptest! {
        #[test]
        fn damage_never_panics(at in any::<prop::sample::Index>(), byte in any::<u8>()) {
            let mut bytes = file(&(0..12).collect::<Vec<i64>>(), &[MATRIX; 12]);
            let at = at.index(bytes.len());
            bytes[at] = byte;
            let _ = super::parse(Path::new("a.h5"), bytes, RowOrder::Matrix, &mut Vec::new());
        }
    }
}
