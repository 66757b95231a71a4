//! NCLT as recorded: `<day>/velodyne_sync/<microseconds>.bin` and `ground_truth/groundtruth_<day>.csv`.
//!
//! A point is three `u16` in steps of 5 mm from -100 m on, a byte of intensity and one of the laser; axes have z down.

use std::path::Path;

use super::Omissions;
use super::boxes::{byte, ring};
use super::disk::{make_folder, write_file};
use super::sequences::{SequenceStyle, WrittenSequence, date, pose_z_down, z_down};
use crate::generate::error::SynthError;

/// Resolution of a coordinate, metres, and the least coordinate.
const STEP_M: f64 = 0.005;
const LEAST_M: f64 = -100.0;

/// The style.
pub(super) static STYLE: SequenceStyle = SequenceStyle {
    epoch_micros: 1_326_030_000_000_000,
    folder: day,
    sweeps_folder: "velodyne_sync",
    file_name: |_, micros| format!("{micros}.bin"),
    points,
    write_poses,
};

fn day(sequence: usize) -> String {
    let [year, month, day] = date(2012, sequence);
    format!("{year}-{month:02}-{day:02}")
}

fn points(points: &[[f32; 4]], omitted: &Omissions) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(8 * points.len());
    let mut outside = 0;
    for &point in points {
        let [x, y, z, intensity] = z_down(point);
        let [Some(x), Some(y), Some(z)] = [x, y, z].map(steps) else {
            outside += 1;
            continue;
        };
        bytes.extend([x, y, z].into_iter().flat_map(u16::to_le_bytes));
        // The ring is computed in the original axes, where z points up.
        bytes.extend([byte(intensity), ring(point)]);
    }
    let what = "points beyond the coordinates that can be written (-100 m to 227 m)";
    omitted.add(what, outside);
    bytes
}

fn write_poses(root: &Path, sequence: &WrittenSequence<'_>) -> Result<(), SynthError> {
    let folder = root.join("ground_truth");
    make_folder(&folder)?;
    let rows = sequence.sweeps.iter().map(|sweep| {
        let pose = pose_z_down(&sweep.world_from_lidar);
        let [x, y, z] = pose.translation_m;
        let (roll, pitch, heading) = pose.isometry().rotation.euler_angles();
        let micros = sweep.micros;
        format!("{micros},{x},{y},{z},{roll},{pitch},{heading}\n")
    });
    let name = format!("groundtruth_{}.csv", day(sequence.number));
    write_file(&folder.join(name), rows.collect::<String>())
}

/// A coordinate as a number of steps, if it is in range.
fn steps(metres: f32) -> Option<u16> {
    let steps = ((f64::from(metres) - LEAST_M) / STEP_M).round();
    let fits = (0.0..=f64::from(u16::MAX)).contains(&steps);
    fits.then_some(steps as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_rounded_and_those_outside_are_counted() {
        let omitted = Omissions::default();
        let bytes = points(
            &[[1.0024, -2.0026, 0.5, 0.2], [-100.5, 0.0, 0.0, 0.5]],
            &omitted,
        );
        let numbers: Vec<u16> = bytes[..6]
            .as_chunks::<2>()
            .0
            .iter()
            .map(|pair| u16::from_le_bytes(*pair))
            .collect();
        assert_eq!(
            (numbers, bytes[6], bytes.len()),
            (vec![20_200, 20_401, 19_900], 51, 8)
        );
        assert_eq!(omitted.into_counts().into_values().collect::<Vec<_>>(), [1]);
    }
}
