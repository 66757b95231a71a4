//! Join of clouds and poses: by name, number or time, or by their order where nothing contradicts it.

use std::collections::{HashMap, HashSet};
use std::hash::Hash;

use super::pose_file::PoseFile;
use crate::keys::Keys;

/// Largest difference between the time of a pose and that of its cloud, nanoseconds.
const SAME_TIME_NANOS: u64 = 1_000_000;

/// The row of each cloud.
#[derive(Debug, PartialEq)]
pub(super) struct Join {
    /// Index of the row; `None` for a cloud without one.
    pub(super) rows: Vec<Option<usize>>,
    /// The property by which they were joined.
    pub(super) by: &'static str,
    /// True if the clouds were taken for the beginning of a longer list, by their numbers alone.
    pub(super) is_beginning: bool,
}

impl Join {
    fn new(by: &'static str, rows: impl Iterator<Item = Option<usize>>) -> Self {
        Self {
            rows: rows.collect(),
            by,
            is_beginning: false,
        }
    }
}

/// Joins clouds, given by the stems of their files in natural order and the keys of these, with the rows of a file of
/// poses.
///
/// # Errors
/// A sentence with the keys of both where rows cannot be assigned to clouds.
pub(super) fn join(stems: &[&str], clouds: &Keys, poses: &PoseFile) -> Result<Join, String> {
    let mut most = 0;
    for keys in &poses.keys {
        let joined = match (clouds, keys) {
            (_, Keys::Names(names)) => by_name(stems, names),
            (Keys::Numbers(clouds), Keys::Numbers(rows)) => {
                // Before the join: shifted numbers would join most clouds, each to the pose of a neighbour.
                if let Some(contradiction) = shift(clouds, rows) {
                    return Err(contradiction);
                }
                by_key("number", clouds, rows)
            }
            (Keys::Times(clouds), Keys::Times(rows)) => by_time(clouds, rows),
            _ => continue,
        };
        // At least half of the shorter list have a partner: there may be more poses than clouds, or fewer.
        let found = joined.rows.iter().flatten().count();
        if 2 * found >= joined.rows.len().min(poses.poses.len()) && found > 0 {
            return Ok(joined);
        }
        most = most.max(found);
    }
    let have = format!("{most} of {} clouds have", stems.len());
    by_order(stems.len(), clouds, poses, &have)
}

/// Stems or names of files; the endings and folders of the rows' names do not count.
fn by_name(stems: &[&str], names: &[String]) -> Join {
    let known: HashSet<&str> = stems.iter().copied().collect();
    let names = names.iter().map(|name| {
        let name = name.trim_matches('"');
        let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
        match name.rsplit_once('.') {
            // A stem may contain a dot itself: then it has no ending to remove.
            Some((stem, _)) if !known.contains(name) => stem,
            _ => name,
        }
    });
    by_key("name", stems, &names.collect::<Vec<&str>>())
}

/// Rows of equal key; a key of two rows is none.
fn by_key<K: Eq + Hash>(by: &'static str, clouds: &[K], rows: &[K]) -> Join {
    let mut index: HashMap<&K, Option<usize>> = HashMap::with_capacity(rows.len());
    for (row, key) in rows.iter().enumerate() {
        let known = index.entry(key).and_modify(|known| *known = None);
        known.or_insert(Some(row));
    }
    let rows = clouds.iter().map(|key| index.get(key).copied().flatten());
    Join::new(by, rows)
}

/// The row nearest to each cloud in time, if it is of the same time.
fn by_time(clouds: &[u64], rows: &[u64]) -> Join {
    let mut sorted: Vec<(u64, usize)> = rows.iter().copied().zip(0..).collect();
    sorted.sort_unstable();
    Join::new("time", clouds.iter().map(|time| at(&sorted, *time)))
}

/// Index of the entry nearest to a time, if it is of the same time.
fn at(sorted: &[(u64, usize)], time: u64) -> Option<usize> {
    let next = sorted.partition_point(|(row, _)| *row < time);
    let around = sorted.get(next.saturating_sub(1)..)?.iter().take(2);
    let nearest = around.min_by_key(|(row, _)| row.abs_diff(time));
    let (_, index) = nearest.filter(|(row, _)| row.abs_diff(time) < SAME_TIME_NANOS)?;
    Some(*index)
}

/// Two lists of equal length whose numbers differ by a constant: which of them is right cannot be known.
fn shift(clouds: &[u64], rows: &[u64]) -> Option<String> {
    let (first, row) = (clouds.first()?, rows.first()?);
    let mut pairs = clouds.iter().zip(rows);
    let is_shifted = first != row
        && clouds.len() == rows.len()
        && pairs.all(|(cloud, number)| cloud.checked_sub(*first) == number.checked_sub(*row));
    is_shifted.then(|| {
        format!(
            "as many poses as clouds, but poses are numbered from {row} and clouds from {first}: number them alike, or \
             leave the numbers out"
        )
    })
}

/// One row per cloud, in order. `have` says how many clouds have the key of a pose.
fn by_order(count: usize, clouds: &Keys, poses: &PoseFile, have: &str) -> Result<Join, String> {
    let rows = poses.poses.len();
    let row = poses.keys.first().map_or("no key".to_owned(), Keys::shown);
    let keys = format!("clouds have {}, poses {row}", clouds.shown());
    // The order is the weakest key: each check below excludes a contradiction.
    if !clouds.have_one_form() {
        return Err(format!(
            "the order of the clouds is not known, since their names are no numbers; {keys}"
        ));
    }
    if poses.has_names() {
        return Err(format!("{have} the name of a pose; {keys}"));
    }
    if poses.times().is_some_and(|times| !times.is_sorted()) {
        return Err(format!(
            "the times of the poses are not in order, so rows cannot be assigned to clouds; {keys}"
        ));
    }
    if let (Keys::Times(clouds), Some(times)) = (clouds, poses.times())
        && (clouds.len() != times.len() || !have_equal_steps(clouds, times))
    {
        return Err(format!("{have} the time of a pose; {keys}"));
    }
    if rows == count && is_without_gap(clouds, poses.times()) {
        return Ok(Join::new("order", (0..count).map(Some)));
    }
    if let Some(joined) = by_line(clouds, rows) {
        return Ok(joined);
    }
    let gaps = match rows == count {
        true => " whose numbers have gaps",
        false => "",
    };
    Err(format!(
        "{rows} poses for {count} clouds{gaps}, and {have} the name, number or time of a pose: \
         lines cannot be assigned; {keys}"
    ))
}

/// True if no cloud is missing between two others: numbers follow one another, or have the gaps that the times of the
/// poses have.
fn is_without_gap(clouds: &Keys, times: Option<&[u64]>) -> bool {
    let Keys::Numbers(numbers) = clouds else {
        return true;
    };
    let (Some(first), Some(last)) = (numbers.first(), numbers.last()) else {
        return true;
    };
    if last - first + 1 == numbers.len() as u64 {
        return true;
    }
    let ends = times.and_then(|times| Some((times, *times.first()?, *times.last()?)));
    ends.is_some_and(|(times, start, end)| {
        let step = end.saturating_sub(start) as f64 / (last - first) as f64;
        numbers.iter().zip(times).all(|(number, time)| {
            let expected = step * (number - first) as f64;
            // A missing cloud shifts all later ones by a whole step.
            (time.saturating_sub(start) as f64 - expected).abs() < 0.5 * step
        })
    })
}

/// Clouds that are numbered as the rows are: the number is that of the row. The last cloud has the last row; or clouds
/// are numbered from 0, and at least two thirds of the rows have one: with half of them every second row may be a sweep's.
fn by_line(clouds: &Keys, rows: usize) -> Option<Join> {
    let Keys::Numbers(numbers) = clouds else {
        return None;
    };
    let (first, last) = (*numbers.first()?, *numbers.last()?);
    let is_of_rows = first <= 1 && (last + 1).checked_sub(first) == Some(rows as u64);
    let is_beginning = first == 0 && last + 1 < rows as u64 && 3 * numbers.len() >= 2 * rows;
    let places = numbers.iter();
    let places = places.map(|number| usize::try_from(number - first).ok());
    (is_of_rows || is_beginning).then(|| Join {
        is_beginning,
        ..Join::new("number of the row", places)
    })
}

/// True if both lists of times have the same intervals: their clocks differ by a constant only.
fn have_equal_steps(clouds: &[u64], rows: &[u64]) -> bool {
    let Some((start, row_start)) = clouds.first().zip(rows.first()) else {
        return true;
    };
    clouds.iter().zip(rows).all(|(cloud, row)| {
        let since = cloud.saturating_sub(*start);
        since.abs_diff(row.saturating_sub(*row_start)) < SAME_TIME_NANOS
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses(keys: Vec<Keys>, count: usize) -> PoseFile {
        PoseFile {
            poses: vec![Some(protocol::Pose::IDENTITY); count],
            keys,
        }
    }

    fn joined(
        stems: &[&str],
        keys: Vec<Keys>,
        count: usize,
    ) -> Result<(Vec<usize>, &'static str), String> {
        let Join { rows, by, .. } = join(stems, &Keys::of_stems(stems), &poses(keys, count))?;
        Ok((rows.into_iter().map(|row| row.unwrap_or(99)).collect(), by))
    }

    fn times(nanos: &[u64]) -> Vec<Keys> {
        vec![Keys::Times(nanos.to_vec())]
    }

    fn times_in_tenths(tenths: &[u64]) -> Vec<Keys> {
        let nanos: Vec<u64> = tenths.iter().map(|tenth| tenth * 100_000_000).collect();
        times(&nanos)
    }

    #[test]
    fn rows_belong_to_clouds_by_key_or_by_a_proven_order() {
        type Case<'a> = (&'a [&'a str], Vec<Keys>, usize, &'a [usize], &'a str);
        let cases: [Case<'_>; 12] = [
            (
                &["1", "2"],
                vec![Keys::Numbers(vec![2, 1])],
                2,
                &[1, 0],
                "number",
            ),
            (
                &["1", "3", "4"],
                vec![Keys::Numbers(vec![4, 1])],
                2,
                &[1, 99, 0],
                "number",
            ),
            (
                &["1", "3", "4", "5", "6"],
                vec![Keys::Numbers(vec![4, 1])],
                2,
                &[1, 99, 0, 99, 99],
                "number",
            ),
            (
                &["000001", "000002"],
                times_in_tenths(&[0, 1]),
                2,
                &[0, 1],
                "order",
            ),
            (&["scan_1", "scan_2"], vec![], 2, &[0, 1], "order"),
            (
                &["0", "12", "20"],
                times_in_tenths(&[3, 15, 23]),
                3,
                &[0, 1, 2],
                "order",
            ),
            (&["0", "2"], vec![], 3, &[0, 2], "number of the row"),
            (&["1", "3"], vec![], 3, &[0, 2], "number of the row"),
            (
                &["0", "1", "2", "4"],
                vec![],
                6,
                &[0, 1, 2, 4],
                "number of the row",
            ),
            (
                &["7.1", "7.2"],
                times_in_tenths(&[71, 99, 72]),
                3,
                &[0, 2],
                "time",
            ),
            (
                &["1600000000.1", "1600000000.2"],
                times_in_tenths(&[0, 1]),
                2,
                &[0, 1],
                "order",
            ),
            (
                &["a", "b"],
                vec![Keys::Names(vec!["x/b.pcd".into(), "a.pcd".into()])],
                2,
                &[1, 0],
                "name",
            ),
        ];
        for (stems, keys, count, rows, by) in cases {
            assert_eq!(
                joined(stems, keys, count),
                Ok((rows.to_vec(), by)),
                "{stems:?}"
            );
        }
    }

    #[test]
    fn lists_that_contradict_each_other_are_refused() {
        let cases: [(&[&str], Vec<Keys>, usize, &str); 9] = [
            (
                &["1", "2"],
                vec![Keys::Numbers(vec![0, 1])],
                2,
                "poses are numbered from 0 and clouds from 1",
            ),
            (&["1", "2"], vec![], 3, "3 poses for 2 clouds"),
            (&["0", "2"], vec![], 5, "5 poses for 2 clouds"),
            (
                &["0", "2", "3"],
                vec![],
                3,
                "3 poses for 3 clouds whose numbers have gaps",
            ),
            (
                &["first", "second"],
                vec![],
                2,
                "the order of the clouds is not known",
            ),
            (
                &["1", "2"],
                times(&[5_000_000_000, 4_000_000_000]),
                2,
                "not in order",
            ),
            (
                &["5.5", "6.5"],
                times(&[1_000_000, 3_000_000]),
                2,
                "0 of 2 clouds have the time of a pose",
            ),
            (
                &["5.5", "6.5", "7.5", "8.5"],
                times_in_tenths(&[55, 100, 200]),
                3,
                "1 of 4 clouds have the time of a pose",
            ),
            (
                &["1", "2"],
                vec![Keys::Names(vec!["a".into(), "b".into()])],
                2,
                "0 of 2 clouds have the name of a pose",
            ),
        ];
        for (stems, keys, count, expected) in cases {
            let message = joined(stems, keys, count).unwrap_err();
            assert!(message.contains(expected), "{message}");
        }
    }
}
