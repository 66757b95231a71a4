//! NCLT's ground truth: one CSV file a day, some hundred poses a second.
//!
//! A row is time in microseconds, x, y, z in metres, roll, pitch, heading in radians: the pose of the robot's body in a
//! local world, both with z down, `R = Rz(heading) Ry(pitch) Rx(roll)`. Rows before the first fix hold NaN.

use std::path::{Path, PathBuf};

use csv::StringRecord;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use protocol::text::excerpt;

use super::faults::Faults;
use super::trajectory::Trajectory;
use super::{ReadError, Result, files};
use support::{csv_file, rounding};

/// Largest file that is read, bytes: some two million rows.
const MAX_BYTES: u64 = 256 << 20;
/// Largest gap between rows over which poses are interpolated, microseconds.
const MAX_GAP_MICROS: u64 = 1_000_000;
/// Names of the columns, for messages.
const COLUMNS: [&str; 7] = ["utime", "x", "y", "z", "roll", "pitch", "heading"];

/// The file that belongs to a sequence: `groundtruth_<day>.csv` in its folder or the one above, or in a folder
/// `ground_truth` there.
pub(super) fn find(dir: &Path, name: &str) -> Option<PathBuf> {
    let file = format!("groundtruth_{name}.csv");
    let folders = std::iter::once(dir.to_owned()).chain(files::above(dir));
    let mut places =
        folders.flat_map(|folder| [folder.join(&file), folder.join("ground_truth").join(&file)]);
    places.find(|path| path.is_file())
}

/// Reads the poses of one day, `world_from_body` by microseconds in the axes of the file. Rows that cannot be read, or
/// whose time is not between their neighbours', are left out and reported.
pub(super) fn read(path: &Path, problems: &mut Vec<ReadError>) -> Result<Trajectory> {
    let text = files::read_text(path, MAX_BYTES)?;
    let mut faults = Faults::default();
    let mut rows = Vec::new();
    for (number, record) in csv_file::records(&text) {
        let row = faults.take(row(path, number, &record)).flatten();
        rows.extend(row.map(|(micros, pose)| (number, micros, pose)));
    }
    let timed = rows.iter().map(|(_, micros, pose)| (*micros, *pose));
    let (poses, out_of_order) = Trajectory::new(timed.collect(), MAX_GAP_MICROS);
    for index in out_of_order {
        if let Some((number, micros, _)) = rows.get(index) {
            let reason = format!("{micros} is not between the times around it");
            faults.push(wrong(path, *number, 0, reason));
        }
    }
    faults.report("row", problems);
    Ok(poses)
}

/// Time and pose of a row; `None` if it holds no pose.
fn row(path: &Path, line: u64, record: &StringRecord) -> Result<Option<(u64, Isometry3<f64>)>> {
    if record.len() != COLUMNS.len() {
        let reason = format!("{} columns, expected {}", record.len(), COLUMNS.len());
        return Err(ReadError::malformed_at(path, Some(line), None, reason));
    }
    let mut numbers = [0.0; COLUMNS.len()];
    for (column, (number, word)) in numbers.iter_mut().zip(record).enumerate() {
        *number = word.parse::<f64>().map_err(|_| {
            let reason = format!("{:?} is no number", excerpt(word, 40));
            wrong(path, line, column, reason)
        })?;
    }
    let [micros, x, y, z, roll, pitch, heading] = numbers;
    // Times may be written like any other number: 1.326652795e15.
    if !(0.0..=1e18).contains(&micros) {
        let reason = format!("{micros} are no microseconds");
        return Err(wrong(path, line, 0, reason));
    }
    if numbers.iter().any(|number| !number.is_finite()) {
        return Ok(None);
    }
    // nalgebra's Euler angles are Rz(yaw) Ry(pitch) Rx(roll) too.
    let rotation = UnitQuaternion::from_euler_angles(roll, pitch, heading);
    let pose = Isometry3::from_parts(Translation3::new(x, y, z), rotation);
    Ok(Some((rounding::to_u64(micros.floor()), pose)))
}

fn wrong(path: &Path, line: u64, column: usize, reason: String) -> ReadError {
    ReadError::malformed_at(path, Some(line), COLUMNS.get(column).copied(), reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    const T0: u64 = 1_326_652_795_000_000;

    fn parse(text: &str) -> (Trajectory, Vec<String>) {
        let mut problems = Vec::new();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("groundtruth_2012-01-15.csv");
        std::fs::write(&path, text).unwrap();
        let truth = read(&path, &mut problems).unwrap();
        let root = format!("{}/", dir.path().display());
        let problems = problems.iter();
        let problems = problems.map(|problem| problem.to_string().replace(&root, ""));
        (truth, problems.collect())
    }

    fn sound(text: &str) -> Trajectory {
        let (truth, problems) = parse(text);
        assert!(problems.is_empty(), "{problems:?}");
        truth
    }

    #[test]
    fn poses_lie_evenly_between_the_rows() {
        let text = format!(
            "{},NaN,NaN,NaN,NaN,NaN,NaN\n{T0},10,20,-1,0,0,3.1\n{:.10e}, 12, 20, -3, 0.2, 0, -3.1\n",
            T0 - 10_000,
            (T0 + 100_000) as f64
        );
        let truth = sound(&text);
        assert_eq!(truth.at(T0 - 5_000).ok(), None);
        assert_eq!(
            truth.at(T0).unwrap().translation.vector.as_slice(),
            [10.0, 20.0, -1.0]
        );
        let middle = truth.at(T0 + 25_000).unwrap();
        assert!(
            (middle.translation.vector - nalgebra::Vector3::new(10.5, 20.0, -1.5)).norm() < 1e-9
        );
        // The shorter rotation, through pi.
        let (_, _, heading) = truth.at(T0 + 50_000).unwrap().rotation.euler_angles();
        assert!(heading.abs() > 3.13, "{heading}");
        assert_eq!(truth.at(T0 + 100_001).ok(), None);
    }

    #[test]
    fn angles_turn_about_z_then_y_then_x() {
        let truth = sound(&format!("{T0},0,0,0,0.1,0.2,0.3"));
        let [x, y, z] = [
            (nalgebra::Vector3::x_axis(), 0.1),
            (nalgebra::Vector3::y_axis(), 0.2),
            (nalgebra::Vector3::z_axis(), 0.3),
        ]
        .map(|(axis, angle)| UnitQuaternion::from_axis_angle(&axis, angle));
        let expected = z * y * x;
        assert!(truth.at(T0).unwrap().rotation.angle_to(&expected) < 1e-12);
    }

    #[test]
    fn gaps_are_not_interpolated() {
        let truth = sound(&format!(
            "{T0},0,0,0,0,0,0\n{},9,0,0,0,0,0\n",
            T0 + 1_000_001
        ));
        assert_eq!(truth.at(T0 + 500_000).ok(), None);
        assert!(truth.at(T0 + 1_000_001).is_ok());
    }

    fn row_text(micros: u64, x: u64) -> String {
        format!("{micros},{x},0,0,0,0,0\n")
    }

    #[test]
    fn a_bad_row_is_left_out_and_named_with_its_line() {
        for (bad, expected) in [
            (
                "2,0,0\n".to_owned(),
                ":2: 3 columns, expected 7: the row is left out",
            ),
            (
                format!("{},0,up,0,0,0,0\n", T0 + 10),
                ":2: y: \"up\" is no number: the row is left out",
            ),
            (
                "-5,0,0,0,0,0,0\n".into(),
                ":2: utime: -5 are no microseconds: the row is left out",
            ),
            (
                row_text(T0, 99),
                ":2: utime: 1326652795000000 is not between the times around it: the row is left out",
            ),
            (
                row_text(T0 + 999, 99),
                ":2: utime: 1326652795000999 is not between the times around it: the row is left out",
            ),
        ] {
            let text = row_text(T0, 1) + &bad + &row_text(T0 + 20, 3) + &row_text(T0 + 30, 4);
            let (truth, problems) = parse(&text);
            assert_eq!(
                problems,
                [format!("groundtruth_2012-01-15.csv{expected}")],
                "{bad}"
            );
            // Of two rows of one time the first may be left out.
            assert_eq!(truth.at(T0 + 20).unwrap().translation.vector.x, 3.0);
            assert_eq!(truth.len(), 3);
        }
        let (_, problems) = parse("a\nb\n1,2,3,4,5,6,7\n");
        let expected = "groundtruth_2012-01-15.csv:1: 1 columns, expected 7: 2 rows are left out, this is the first";
        assert_eq!(problems, [expected]);
        assert!(sound("").at(0).is_err());
    }
}
