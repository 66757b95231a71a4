//! Oxford as LightLoc converts it: `<day and time>/velodyne_left/<microseconds>.bin`, floats component by component,
//! and poses in `velodyne_left_False.h5`; axes have z down.

use std::path::Path;

use super::boxes::of_255;
use super::disk::write_file;
use super::sequences::{SequenceStyle, SweepPose, WrittenSequence, date, pose_z_down, z_down};
use crate::generate::error::SynthError;
use dataset::hdf5_file::poses_file;

/// Poses at either end that LightLoc drops.
const TRIMMED: usize = 5;

/// The style.
pub(super) static STYLE: SequenceStyle = SequenceStyle {
    epoch_micros: 1_547_120_000_000_000,
    folder: |sequence| {
        let [year, month, day] = date(2019, sequence);
        format!("{year}-{month:02}-{day:02}-12-00-00-radar-oxford-10k")
    },
    sweeps_folder: "velodyne_left",
    file_name: |_, micros| format!("{micros}.bin"),
    points: |points, _| {
        let numbers = (0..4).flat_map(|index| {
            points.iter().map(move |&point| {
                let [x, y, z, intensity] = z_down(point);
                [x, y, z, of_255(intensity)][index]
            })
        });
        numbers.flat_map(f32::to_le_bytes).collect()
    },
    write_poses,
};

fn write_poses(root: &Path, sequence: &WrittenSequence<'_>) -> Result<(), SynthError> {
    let (Some(first), Some(last)) = (sequence.sweeps.first(), sequence.sweeps.last()) else {
        return Ok(());
    };
    // The entries that readers drop are copies of the first and of the last pose.
    let before = (1..=TRIMMED as u64)
        .rev()
        .map(|step| (first.micros - step, first));
    let own = sequence.sweeps.iter().map(|sweep| (sweep.micros, sweep));
    let after = (1..=TRIMMED as u64).map(|step| (last.micros + step, last));
    let all = before.chain(own).chain(after);
    let (stamps, rows): (Vec<i64>, Vec<[f64; 12]>) = all
        .map(|(micros, sweep)| (micros as i64, row(sweep)))
        .unzip();
    let file = root.join(&sequence.folder).join("velodyne_left_False.h5");
    write_file(&file, poses_file(&stamps, &rows))
}

/// The 3x4 matrix of a pose, row by row.
fn row(sweep: &SweepPose) -> [f64; 12] {
    let rows = pose_z_down(&sweep.world_from_lidar).matrix_rows();
    std::array::from_fn(|place| rows[place / 4][place % 4])
}
