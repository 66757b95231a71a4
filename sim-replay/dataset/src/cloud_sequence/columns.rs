//! Columns of a file of poses: by the names of its header, or by their number.

use crate::time_stamps::Unit;

/// Places of the values in a row.
#[derive(Debug, PartialEq)]
pub(super) struct Columns {
    /// Number of columns.
    pub(super) width: usize,
    pub(super) pose: PoseColumns,
    /// Name of the cloud's file.
    pub(super) name: Option<usize>,
    /// Number of the cloud.
    pub(super) number: Option<usize>,
    pub(super) time: Option<TimeColumns>,
    /// A name, number or time: the values show which.
    pub(super) key: Option<usize>,
}

/// Columns of `world_from_lidar`.
#[derive(Debug, PartialEq)]
pub(super) enum PoseColumns {
    /// x, y, z, qx, qy, qz, qw.
    Quaternion([usize; 7]),
    /// The first of 12 or 16 columns, a matrix row by row.
    Matrix(usize),
}

/// Columns of the time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum TimeColumns {
    /// In a unit, or one that its size shows.
    One(usize, Option<Unit>),
    /// Whole seconds, and the nanoseconds after them.
    SecondsAndNanos(usize, usize),
}

/// Meaning of a column's name.
#[derive(Debug, Clone, Copy, PartialEq)]
enum ColumnRole {
    /// Value of a pose: index into [`VALUES`].
    Value(usize),
    Time(Option<Unit>),
    /// `sec` of `sec, nsec`.
    Seconds,
    /// `nsec` of `sec, nsec`.
    Nanos,
    Number,
    Name,
    Other,
}

/// The values of a pose in the order of TUM files.
const VALUES: [&str; 7] = ["x", "y", "z", "qx", "qy", "qz", "qw"];
/// Words of names that are no part of the pose: velocities, biases, covariances.
const OTHER_WORDS: &str =
    "v vel velocity acc acceleration b bias ba bg bw cov covariance std sigma twist imu";
/// Words of the names of quaternions.
const QUATERNION_WORDS: &str = "q quat quaternion orientation rotation rot ori";
/// Words of the names of positions.
const POSITION_WORDS: &str = "p t pos position trans translation loc location pose";
/// Words of the names of times.
const TIME_WORDS: &str = "t ts time times stamp timestamp utime";
/// Words of the numbers of clouds.
const NUMBER_WORDS: &str = "index idx id frame num number scan no keyframe";
/// Words of the names of files.
const NAME_WORDS: &str = "file filename name path filepath cloud pcd pointcloud image lidar";

impl Columns {
    /// True if a value of a row says to which cloud it belongs, or when it was.
    pub(super) fn has_key(&self) -> bool {
        let keys = [self.name, self.number, self.key];
        keys.iter().any(Option::is_some) || self.time.is_some()
    }

    /// Columns of a row without header: TUM's order, or matrices; before these possibly a key, or seconds and
    /// nanoseconds.
    ///
    /// # Errors
    /// A sentence if no form has so many columns.
    pub(super) fn of_width(width: usize) -> Result<Self, String> {
        // The seven values of a quaternion's row are the last.
        let pose = match width {
            7..=9 => PoseColumns::Quaternion(std::array::from_fn(|value| width - 7 + value)),
            12 | 16 => PoseColumns::Matrix(0),
            13 | 17 => PoseColumns::Matrix(1),
            _ => return Err(format!("{width} values, expected 7, 12 or 16, or one more")),
        };
        Ok(Self {
            width,
            pose,
            name: None,
            number: None,
            time: (width == 9).then_some(TimeColumns::SecondsAndNanos(0, 1)),
            key: matches!(width, 8 | 13 | 17).then_some(0),
        })
    }

    /// Columns by their names.
    ///
    /// # Errors
    /// A sentence that names the columns which are missing or given twice.
    pub(super) fn of_names(names: &[&str]) -> Result<Self, String> {
        let roles: Vec<ColumnRole> = names.iter().map(|name| role(name)).collect();
        let mut values = [0; 7];
        for (index, (place, value)) in values.iter_mut().zip(VALUES).enumerate() {
            let wanted = ColumnRole::Value(index);
            *place = match roles.iter().filter(|role| **role == wanted).count() {
                1 => place_of(&roles, wanted).unwrap_or_default(),
                0 => return Err(format!("no column {value} {}", expected(names))),
                _ => return Err(format!("two columns {value} {}", expected(names))),
            };
        }
        Ok(Self {
            width: names.len(),
            pose: PoseColumns::Quaternion(values),
            name: place_of(&roles, ColumnRole::Name),
            number: place_of(&roles, ColumnRole::Number),
            time: time_of(&roles),
            key: None,
        })
    }
}

fn place_of(roles: &[ColumnRole], wanted: ColumnRole) -> Option<usize> {
    roles.iter().position(|role| *role == wanted)
}

/// Seconds and nanoseconds, or the first column that is a time.
fn time_of(roles: &[ColumnRole]) -> Option<TimeColumns> {
    let seconds = place_of(roles, ColumnRole::Seconds);
    if let Some((seconds, nanos)) = seconds.zip(place_of(roles, ColumnRole::Nanos)) {
        return Some(TimeColumns::SecondsAndNanos(seconds, nanos));
    }
    (0..).zip(roles).find_map(|(column, role)| match role {
        ColumnRole::Time(unit) => Some(TimeColumns::One(column, *unit)),
        ColumnRole::Seconds => Some(TimeColumns::One(column, Some(Unit::Seconds))),
        ColumnRole::Nanos => Some(TimeColumns::One(column, Some(Unit::Nanoseconds))),
        _ => None,
    })
}

fn expected(names: &[&str]) -> String {
    let names = names.join(", ");
    format!("in the header ({names}), expected x, y, z, qx, qy, qz, qw by name, in any order")
}

/// Values of a quaternion that names give, in their order: 0 to 3 for x, y, z, w.
pub(super) fn quaternion_order(names: &[&str]) -> Vec<usize> {
    let parts = names.iter().filter_map(|name| match role(name) {
        ColumnRole::Value(index) => index.checked_sub(3),
        _ => None,
    });
    parts.collect()
}

/// Meaning of a name such as `qw`, `p_RS_R_x [m]`, `field.pose.orientation.w` or `timestamp [ns]`.
fn role(name: &str) -> ColumnRole {
    let lower = name.to_ascii_lowercase();
    let (plain, bracket) = lower.split_once(['[', '(']).unwrap_or((&lower, ""));
    let words: Vec<&str> = words(plain).collect();
    let (Some(last), false) = (words.last(), has(&words, OTHER_WORDS)) else {
        return ColumnRole::Other;
    };
    // Axes first: `t_x` is a position, though `t` alone is a time.
    if let Some(axis) = axis(last, &words) {
        return axis;
    }
    let stated = self::words(bracket).find_map(unit);
    match unit(last) {
        // `sec` may be one half of `sec, nsec`, which `time_of` decides.
        Some(Unit::Seconds) if *last != "s" && stated.is_none() => return ColumnRole::Seconds,
        Some(Unit::Nanoseconds) if *last != "ns" && stated.is_none() => return ColumnRole::Nanos,
        _ => {}
    }
    if has(&words, TIME_WORDS) || last.ends_with("timestamp") || unit(last).is_some() {
        let of_name = (*last == "utime").then_some(Unit::Microseconds);
        return ColumnRole::Time(stated.or(of_name).or_else(|| unit(last)));
    }
    // `header.frame_id` names a frame of coordinates.
    if has(&[last], NUMBER_WORDS) && !words.contains(&"header") {
        return ColumnRole::Number;
    }
    match has(&[last], NAME_WORDS) {
        true => ColumnRole::Name,
        false => ColumnRole::Other,
    }
}

/// A component of the position or the quaternion: its letter, after a word or as the end of one.
fn axis(last: &str, words: &[&str]) -> Option<ColumnRole> {
    let letter = last.chars().next_back()?;
    let index = ['x', 'y', 'z', 'w']
        .iter()
        .position(|axis| *axis == letter)?;
    // `qx` has the letter at the end of the word, `q_x` apart from it.
    let fused = last.strip_suffix(letter)?;
    let stem = [fused];
    let stems = if fused.is_empty() { words } else { &stem };
    if has(stems, QUATERNION_WORDS) {
        return Some(ColumnRole::Value(3 + index));
    }
    let is_plain = words == [last] && fused.is_empty();
    (index < 3 && (is_plain || has(stems, POSITION_WORDS))).then_some(ColumnRole::Value(index))
}

fn has(words: &[&str], known: &str) -> bool {
    known.split(' ').any(|known| words.contains(&known))
}

fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|letter: char| !letter.is_alphanumeric())
        .filter(|word| !word.is_empty())
}

fn unit(word: &str) -> Option<Unit> {
    Some(match word {
        "s" | "sec" | "secs" | "second" | "seconds" => Unit::Seconds,
        "ms" | "msec" | "milliseconds" => Unit::Milliseconds,
        "us" | "usec" | "micros" | "microseconds" => Unit::Microseconds,
        "ns" | "nsec" | "nsecs" | "nanosec" | "nanosecs" | "nanos" | "nanoseconds" => {
            Unit::Nanoseconds
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quaternion(names: &str) -> Result<Columns, String> {
        Columns::of_names(&names.split(',').map(str::trim).collect::<Vec<_>>())
    }

    #[test]
    fn columns_are_found_by_name() {
        let unknown = Some(TimeColumns::One(0, None));
        let nanos = Some(TimeColumns::One(0, Some(Unit::Nanoseconds)));
        let w_first = [1, 2, 3, 5, 6, 7, 4];
        for (names, values, time) in [
            (
                "timestamp,tx,ty,tz,qx,qy,qz,qw",
                [1, 2, 3, 4, 5, 6, 7],
                unknown,
            ),
            ("timestamp,x,y,z,qw,qx,qy,qz", w_first, unknown),
            ("timestamp,Tx,Ty,Tz,Qw,Qx,Qy,Qz", w_first, unknown),
            (
                "timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],\
                 v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1]",
                w_first,
                nanos,
            ),
            (
                "%time,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,\
                 field.pose.pose.orientation.w,field.pose.pose.orientation.x,field.pose.pose.orientation.y,\
                 field.pose.pose.orientation.z,field.twist.twist.linear.x,field.pose.covariance0",
                w_first,
                unknown,
            ),
            (
                "timestamp_ns,pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z",
                w_first,
                nanos,
            ),
            (
                "sec,nsec,x,y,z,qx,qy,qz,qw",
                [2, 3, 4, 5, 6, 7, 8],
                Some(TimeColumns::SecondsAndNanos(0, 1)),
            ),
        ] {
            let columns = quaternion(names).unwrap();
            let PoseColumns::Quaternion(found) = columns.pose else {
                panic!("{names}");
            };
            assert_eq!((found, columns.time), (values, time), "{names}");
        }
        let named = quaternion("file,frame,x,y,z,qx,qy,qz,qw").unwrap();
        assert_eq!(
            (named.name, named.number, named.time),
            (Some(0), Some(1), None)
        );
    }

    #[test]
    fn incomplete_headers_are_refused() {
        for (names, expected) in [
            ("t,x,y,z,roll,pitch,yaw", "no column qx"),
            ("t,x,y,z,q0,q1,q2,q3", "no column qx"),
            ("t,x,y,z,x,qx,qy,qz,qw", "two columns x"),
        ] {
            let message = quaternion(names).unwrap_err();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
