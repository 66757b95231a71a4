//! File of poses: `world_from_lidar` per row, with the key by which it belongs to a cloud.

use std::collections::BTreeMap;
use std::path::Path;

use protocol::Pose;

use super::columns::{Columns, PoseColumns, TimeColumns, quaternion_order};
use crate::faults::Faults;
use crate::keys::{Keys, stamp_nanos, whole_numbers};
use crate::kitti_text::{counted_lines, malformed};
use crate::{ReadError, Result, poses};

/// Signs that begin a comment.
const COMMENT: [char; 2] = ['#', '%'];

/// The poses of a file.
#[derive(Debug)]
pub(super) struct PoseFile {
    /// `world_from_lidar` of each row; `None` if it cannot be read.
    pub(super) poses: Vec<Option<Pose>>,
    /// Keys of all rows, the most telling first; none if the file has none.
    pub(super) keys: Vec<Keys>,
}

/// A line of values, or a blank one.
struct FileRow<'a> {
    line: u64,
    words: Vec<&'a str>,
}

impl PoseFile {
    /// Reads a file. Its header, if it has one, gives the columns, else their number does. A row that cannot be read
    /// has no pose and is a fault; without keys a blank line is such a row.
    ///
    /// # Errors
    /// [`ReadError`] if the file cannot be read, or its header is not understood.
    pub(super) fn read(path: &Path, faults: &mut Faults) -> Result<Self> {
        let lines = counted_lines(path)?;
        let (comments, mut rows): (Vec<FileRow<'_>>, Vec<FileRow<'_>>) = lines
            .iter()
            .map(|(line, text)| FileRow::of(*line, text))
            .partition(FileRow::is_comment);
        let first = rows.iter().position(|row| !row.words.is_empty());
        let header = first.filter(|&first| rows.get(first).is_some_and(FileRow::is_names));
        let header = header.map(|first| rows.remove(first));
        let columns = columns(path, header, &comments, usual_width(&rows))?;
        if columns.has_key() {
            rows.retain(|row| !row.words.is_empty());
        }
        let poses = rows
            .iter()
            .map(|row| faults.take(row.pose(path, &columns)))
            .collect();
        Ok(Self {
            poses,
            keys: keys(&rows, &columns),
        })
    }

    /// True if rows name their clouds.
    pub(super) fn has_names(&self) -> bool {
        (self.keys.iter()).any(|keys| matches!(keys, Keys::Names(_)))
    }

    /// Times of all rows, nanoseconds.
    pub(super) fn times(&self) -> Option<&[u64]> {
        self.keys.iter().find_map(|keys| match keys {
            Keys::Times(times) => Some(times.as_slice()),
            _ => None,
        })
    }
}

/// The columns: by the header, or a comment that names all of them, else by their number.
fn columns(
    path: &Path,
    header: Option<FileRow<'_>>,
    comments: &[FileRow<'_>],
    width: usize,
) -> Result<Columns> {
    if let Some(header) = &header {
        return header.columns(path, width);
    }
    for comment in comments {
        // Prose may name the columns of a quaternion too: in TUM's order it changes nothing.
        let names = comment.names();
        let order = quaternion_order(&names);
        if order.len() == 4 && (names.len() == width || order != [0, 1, 2, 3]) {
            return comment.columns(path, width);
        }
    }
    Columns::of_width(width).map_err(|reason| ReadError::malformed(path, reason))
}

/// The number of values that most rows have.
fn usual_width(rows: &[FileRow<'_>]) -> usize {
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    for row in rows.iter().filter(|row| !row.words.is_empty()) {
        *counts.entry(row.words.len()).or_default() += 1;
    }
    let usual = counts.into_iter().max_by_key(|(_, count)| *count);
    usual.map_or(0, |(width, _)| width)
}

fn words<'a>(rows: &[FileRow<'a>], column: usize) -> Vec<&'a str> {
    rows.iter().map(|row| row.word(column)).collect()
}

/// Keys of the rows.
fn keys(rows: &[FileRow<'_>], columns: &Columns) -> Vec<Keys> {
    let mut keys = Vec::new();
    if let Some(column) = columns.name {
        let names = words(rows, column).into_iter().map(str::to_owned).collect();
        keys.push(Keys::Names(names));
    }
    let of_clouds = columns
        .number
        .and_then(|column| whole_numbers(&words(rows, column)));
    keys.extend(of_clouds.map(Keys::Numbers));
    let times = match columns.time {
        Some(TimeColumns::SecondsAndNanos(seconds, nanos)) => (words(rows, seconds).iter())
            .zip(words(rows, nanos))
            .map(|(seconds, nanos)| stamp_nanos(seconds, nanos))
            .collect::<Option<Vec<u64>>>()
            .map(Keys::Times),
        Some(TimeColumns::One(column, unit)) => {
            // A clock without unit may count clouds.
            let numbers = unit.map_or_else(|| whole_numbers(&words(rows, column)), |_| None);
            keys.extend(numbers.map(Keys::Numbers));
            Keys::of_times(&words(rows, column), unit)
        }
        None => None,
    };
    keys.extend(times);
    let unknown = columns.key.map(|column| words(rows, column));
    keys.extend(unknown.and_then(|words| Keys::of_words(&words)));
    keys
}

impl<'a> FileRow<'a> {
    fn of(line: u64, text: &'a str) -> Self {
        let text = text.trim();
        let mut words: Vec<&str> = match text.contains([',', ';']) {
            true => text.split([',', ';']).map(str::trim).collect(),
            false => text.split_ascii_whitespace().collect(),
        };
        // A line may end with a separator.
        while words.last().is_some_and(|word| word.is_empty()) {
            words.pop();
        }
        Self { line, words }
    }

    fn word(&self, column: usize) -> &'a str {
        self.words.get(column).copied().unwrap_or_default()
    }

    fn is_comment(&self) -> bool {
        self.word(0).starts_with(COMMENT)
    }

    /// True for a line without any number.
    fn is_names(&self) -> bool {
        self.words.len() > 1 && self.words.iter().all(|word| word.parse::<f64>().is_err())
    }

    /// The words without the sign of a comment and units that stand apart.
    fn names(&self) -> Vec<&'a str> {
        let names = self
            .words
            .iter()
            .map(|word| word.trim_start_matches(COMMENT).trim());
        // Only the sign of a comment stands alone; a column may have no name.
        let is_comment = self.is_comment();
        names
            .filter(|name| !(name.starts_with('[') || is_comment && name.is_empty()))
            .collect()
    }

    /// The columns that a header names.
    fn columns(&self, path: &Path, width: usize) -> Result<Columns> {
        let names = self.names();
        let (found, listed) = (names.len(), names.join(", "));
        let columns = match found == width {
            true => Columns::of_names(&names),
            false => Err(format!("{found} names for {width} columns: {listed}")),
        };
        columns.map_err(|reason| malformed(path, self.line, None, reason))
    }

    fn number(&self, column: usize) -> Result<f64, String> {
        let number = self.word(column).parse::<f64>().ok();
        number
            .filter(|number| number.is_finite())
            .ok_or_else(|| "not all values are finite numbers".to_owned())
    }

    fn pose(&self, path: &Path, columns: &Columns) -> Result<Pose> {
        let (found, expected) = (self.words.len(), columns.width);
        let pose = match found == expected {
            true => self.pose_at(columns),
            false => Err(format!("{found} values, expected {expected}")),
        };
        pose.map_err(|reason| malformed(path, self.line, None, reason))
    }

    fn pose_at(&self, columns: &Columns) -> Result<Pose, String> {
        match &columns.pose {
            PoseColumns::Quaternion(places) => {
                // TUM writes w last.
                let [x, y, z, qx, qy, qz, qw] = places.map(|column| self.number(column));
                let pose = Pose {
                    translation_m: [x?, y?, z?],
                    rotation_wxyz: [qw?, qx?, qy?, qz?],
                };
                poses::of_rounded(&pose).map(Pose::from)
            }
            PoseColumns::Matrix(first) => {
                let values = (*first..columns.width).map(|column| self.number(column));
                let values = values.collect::<Result<Vec<f64>, String>>()?;
                poses::of_rows(&values).map_err(|error| error.to_string())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn read(text: &str) -> Result<PoseFile, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("poses.csv");
        fs::write(&path, text).unwrap();
        PoseFile::read(&path, &mut Faults::default()).map_err(|error| {
            error
                .to_string()
                .replace(&*path.to_string_lossy(), "poses.csv")
        })
    }

    #[test]
    fn the_header_gives_the_order_of_the_quaternion() {
        let half = "0.70710678";
        for text in [
            format!("1000 1 2 3 0 0 {half} {half}\n"),
            format!("timestamp,x,y,z,qw,qx,qy,qz\n1000,1,2,3,{half},0,0,{half}\n"),
            format!("#timestamp Tx Ty Tz Qw Qx Qy Qz\n1000 1 2 3 {half} 0 0 {half}\n"),
            format!(
                "#timestamp [ns],qz [],qw [],qx [],qy [],z [m],y [m],x [m]\n1000,{half},{half},0,0,3,2,1\n"
            ),
            format!("# made by x\n# time, position, qx qy qz qw\n1000 1 2 3 0 0 {half} {half}\n"),
        ] {
            let pose = read(&text).unwrap().poses[0].unwrap();
            assert_eq!(pose.translation_m, [1.0, 2.0, 3.0], "{text}");
            assert!((pose.yaw_rad().to_degrees() - 90.0).abs() < 1e-6, "{text}");
        }
    }

    #[test]
    fn headers_that_are_not_understood_are_refused() {
        for (text, expected) in [
            (
                "t,x,y,z,roll,pitch,yaw\n1,2,3,4,0,0,0\n",
                "poses.csv:1: no column qx in the header (t, x, y, z, roll, pitch, yaw)",
            ),
            (
                "time x y z qx qy qz\n1 0 0 0 0 0 0 1\n",
                "poses.csv:1: 7 names for 8 columns: time, x, y, z",
            ),
            (
                "# order: time, x, y, z, qw, qx, qy, qz, as in EuRoC\n1 0 0 0 1 0 0 0\n",
                "poses.csv:1: 9 names for 8 columns",
            ),
            ("1 2 3\n", "poses.csv: 3 values, expected 7, 12 or 16"),
        ] {
            let message = read(text).unwrap_err();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn keys_are_numbers_times_or_names() {
        let keys = |text: &str| read(text).unwrap().keys;
        let pose = "1 0 0 5 0 1 0 0 0 0 1 0";
        assert_eq!(
            keys(&format!("0 {pose}\n7 {pose}\n")),
            [Keys::Numbers(vec![0, 7])]
        );
        assert_eq!(keys("0.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n"), []);
        assert_eq!(
            keys("sec,nsec,x,y,z,qx,qy,qz,qw\n1583836591,182590976,0,0,0,0,0,0,1\n"),
            [Keys::Times(vec![1_583_836_591_182_590_976])]
        );
        assert_eq!(
            keys("timestamp,x,y,z,qx,qy,qz,qw\n1000,0,0,0,0,0,0,1\n"),
            [
                Keys::Numbers(vec![1000]),
                Keys::Times(vec![1_000_000_000_000])
            ]
        );
        assert_eq!(
            keys("file,x,y,z,qx,qy,qz,qw\na.pcd,0,0,0,0,0,0,1\n"),
            [Keys::Names(vec!["a.pcd".into()])]
        );
    }

    fn rows_with_pose(text: &str) -> Vec<bool> {
        let poses = read(text).unwrap().poses;
        poses.iter().map(Option::is_some).collect()
    }

    #[test]
    fn a_blank_line_is_a_row_without_pose_where_rows_have_no_key() {
        let pose = "1 0 0 5 0 1 0 0 0 0 1 0";
        assert_eq!(
            rows_with_pose(&format!("{pose}\n\n{pose}\n\n")),
            [true, false, true]
        );
        assert_eq!(
            rows_with_pose(&format!("0 {pose}\n\n1 {pose}\n")),
            [true, true]
        );
    }
}
