//! Header of a PCD file: type of every field and number of points.
//!
//! Writers differ: `VERSION` is `.7`, `0.5` or missing, `FIELDS` may be called `COLUMNS`, `COUNT` (1 each), `HEIGHT`,
//! `VIEWPOINT`, and `POINTS` or `WIDTH` may be missing, keys may be in lower case, and a field may have no numbers at
//! all.

mod points;

use std::ops::RangeInclusive;

use protocol::{COLOUR_FIELDS, INTENSITY_FIELDS};

use super::{IntensityKind, PcdError};
use crate::scalar::{Scalar, ScalarKind};

const MAX_FIELDS: usize = 64;
/// Longest header line that is read, bytes.
const MAX_LINE: usize = 8192;
/// Most numbers in one field of one point.
const MAX_COUNT: usize = 65_536;
/// Most bytes of one number.
const MAX_SIZE: usize = 8;
/// Storage of the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::EnumString)]
#[strum(serialize_all = "snake_case", ascii_case_insensitive)]
pub(super) enum Data {
    /// A line of decimal numbers per point.
    Ascii,
    /// Points one after another, little-endian.
    Binary,
    /// Fields one after another, little-endian, packed by LZF.
    BinaryCompressed,
}

/// One field of a point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PcdField {
    pub(super) name: String,
    /// `TYPE` F, I or U; any other is padding, accepted only for fields that are not read.
    pub(super) kind: ScalarKind,
    /// Bytes of one number.
    pub(super) size: usize,
    /// Numbers per point; PCL's padding may have none.
    pub(super) count: usize,
}

/// Source of the fourth value of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum IntensitySource {
    /// The field at this index, unchanged.
    Value(usize),
    /// The red byte of the packed field at this index.
    Red(usize),
    /// No source: 0 for all.
    None,
}

/// A header whose parts are consistent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PcdHeader {
    pub(super) fields: Vec<PcdField>,
    pub(super) points: usize,
    pub(super) data: Data,
    /// Indices of x, y and z in `fields`.
    pub(super) xyz: [usize; 3],
    pub(super) intensity: IntensitySource,
    /// Lines up to and including `DATA`.
    pub(super) lines: u64,
}

/// The values of one header line and their position.
struct HeaderEntry<'a> {
    key: &'static str,
    line: u64,
    values: Vec<&'a str>,
}

impl<'a> HeaderEntry<'a> {
    fn error(&self, reason: String) -> PcdError {
        PcdError::at(self.line, self.key, reason)
    }

    /// The value of a field; as many as there are fields.
    fn of_field(&self, index: usize) -> &'a str {
        self.values.get(index).copied().unwrap_or_default()
    }

    /// The only value.
    fn single(&self) -> Result<&'a str, PcdError> {
        match self.values[..] {
            [value] => Ok(value),
            _ => Err(self.error(format!("{} values, expected 1", self.values.len()))),
        }
    }
}

/// The header lines, unchecked.
#[derive(Default)]
struct Entries<'a>(Vec<HeaderEntry<'a>>);

/// The keys of header lines.
const KEYS: &str = "VERSION FIELDS SIZE TYPE COUNT WIDTH HEIGHT VIEWPOINT POINTS DATA";
const VERSIONS: [&str; 6] = ["0.7", ".7", "0.6", ".6", "0.5", ".5"];

impl PcdHeader {
    /// Splits a file into its header and the rest.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), PcdError> {
        let mut entries = Entries::default();
        // The byte order mark of UTF-8 would be part of the first key.
        let mut rest = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let mut line = 0;
        while entries.find("DATA").is_none() {
            line += 1;
            let Some(end) = rest.iter().take(MAX_LINE).position(|&byte| byte == b'\n') else {
                let reason = "the header ends before a DATA line";
                return Err(PcdError::at(line, "DATA", reason));
            };
            let (text, after) = rest.split_at(end);
            entries.add(line, without_comment(text))?;
            rest = after.strip_prefix(b"\n").unwrap_or(after);
        }
        Ok((Self::from_entries(&entries, line)?, rest))
    }

    fn from_entries(entries: &Entries<'_>, lines: u64) -> Result<Self, PcdError> {
        entries.check_version()?;
        let fields = entries.fields()?;
        let points = entries.points()?;
        entries.check_viewpoint()?;
        let line = entries.get("FIELDS")?.line;
        let [x, y, z] = ["x", "y", "z"].map(|name| find_coordinate(&fields, name, line));
        let value = find_number(&fields, &INTENSITY_FIELDS).map(IntensitySource::Value);
        let intensity =
            value.or_else(|| find_number(&fields, &COLOUR_FIELDS).map(IntensitySource::Red));
        let header = Self {
            xyz: [x?, y?, z?],
            intensity: intensity.unwrap_or(IntensitySource::None),
            points,
            data: entries.data()?,
            fields,
            lines,
        };
        header.check_formats(entries)?;
        Ok(header)
    }

    /// Numbers per point.
    pub(super) fn columns(&self) -> usize {
        self.fields.iter().map(|field| field.count).sum()
    }

    /// Bytes per point.
    pub(super) fn stride(&self) -> usize {
        self.fields
            .iter()
            .map(|field| field.count * field.size)
            .sum()
    }

    /// Name and number type of the field from which intensity is read.
    pub(super) fn intensity_origin(&self) -> Option<(&str, IntensityKind)> {
        match self.intensity {
            IntensitySource::Red(index) => {
                Some((&self.fields.get(index)?.name, IntensityKind::RedByte))
            }
            IntensitySource::Value(index) => {
                let field = self.fields.get(index)?;
                let stored = Scalar::new(field.kind, field.size, false);
                Some((&field.name, stored.intensity_kind()))
            }
            IntensitySource::None => None,
        }
    }

    /// The fields that are read must be numbers; of all others only the size is needed.
    fn check_formats(&self, entries: &Entries<'_>) -> Result<(), PcdError> {
        let intensity = match self.intensity {
            IntensitySource::Value(index) | IntensitySource::Red(index) => Some(index),
            IntensitySource::None => None,
        };
        let read = self.xyz.into_iter().chain(intensity);
        let read = read.filter_map(|index| Some((index, self.fields.get(index)?)));
        for (index, field) in read {
            let (name, kind, size) = (&field.name, field.kind, field.size);
            let (kinds, sizes) = (entries.get("TYPE")?, entries.get("SIZE")?);
            let allowed: &[usize] = match kind {
                ScalarKind::Padding => {
                    let kind = kinds.of_field(index);
                    let reason = format!("{kind:?} of field {name}, expected F, I or U");
                    return Err(kinds.error(reason));
                }
                // Ahead of the types: a packed colour has four bytes, as a float and as an integer.
                _ if self.intensity == IntensitySource::Red(index) => &[4],
                ScalarKind::Float => &[4, 8],
                ScalarKind::Signed | ScalarKind::Unsigned => &[1, 2, 4, 8],
            };
            if !allowed.contains(&size) {
                let reason = format!(
                    "{size} of field {name}, expected one of {allowed:?} for TYPE {}",
                    kinds.of_field(index)
                );
                return Err(sizes.error(reason));
            }
        }
        Ok(())
    }
}

/// A header line as text. Comments may be in any encoding.
fn without_comment(line: &[u8]) -> &[u8] {
    let before = std::iter::once(&b' ').chain(line);
    let begin = line
        .iter()
        .zip(before)
        // Only after a blank: a sign within a word is part of it.
        .position(|(&byte, before)| byte == b'#' && before.is_ascii_whitespace());
    begin.and_then(|begin| line.get(..begin)).unwrap_or(line)
}

impl<'a> Entries<'a> {
    fn add(&mut self, line: u64, text: &'a [u8]) -> Result<(), PcdError> {
        let text = std::str::from_utf8(text)
            .map_err(|_| fault(line, "the header is not text: is this a PCD file?"))?;
        let mut words = text.split_ascii_whitespace();
        let Some(word) = words.next() else {
            return Ok(());
        };
        let asked = match word.eq_ignore_ascii_case("COLUMNS") {
            true => "FIELDS",
            false => word,
        };
        let mut keys = KEYS.split(' ');
        let Some(key) = keys.find(|key| key.eq_ignore_ascii_case(asked)) else {
            let word: String = word.chars().take(40).collect();
            return Err(fault(line, format!("{word:?} is no PCD header key")));
        };
        if self.find(key).is_some() {
            return Err(PcdError::at(line, key, "is given a second time"));
        }
        let values = words.collect();
        self.0.push(HeaderEntry { key, line, values });
        Ok(())
    }

    fn get(&self, key: &str) -> Result<&HeaderEntry<'a>, PcdError> {
        self.find(key)
            .ok_or_else(|| PcdError::of(key, "missing in the header"))
    }

    fn find(&self, key: &str) -> Option<&HeaderEntry<'a>> {
        self.0.iter().find(|entry| entry.key == key)
    }

    fn check_version(&self) -> Result<(), PcdError> {
        let Some(entry) = self.find("VERSION") else {
            return Ok(());
        };
        let version = entry.single()?;
        match VERSIONS.contains(&version) {
            true => Ok(()),
            false => Err(entry.error(format!("{version:?}, expected 0.7, 0.6 or 0.5"))),
        }
    }

    /// One value for each field, or an error with both counts.
    fn per_field(&self, key: &str, fields: usize) -> Result<&HeaderEntry<'a>, PcdError> {
        let entry = self.get(key)?;
        match entry.values.len() {
            found if found == fields => Ok(entry),
            found => Err(entry.error(format!("{found} values for {fields} FIELDS"))),
        }
    }

    fn fields(&self) -> Result<Vec<PcdField>, PcdError> {
        let names = self.get("FIELDS")?;
        let fields = names.values.len();
        if !(1..=MAX_FIELDS).contains(&fields) {
            return Err(names.error(format!("{fields} fields, expected 1 to {MAX_FIELDS}")));
        }
        let sizes = self.per_field("SIZE", fields)?;
        let kinds = self.per_field("TYPE", fields)?;
        let counts = self.find("COUNT").map(|_| self.per_field("COUNT", fields));
        let counts = counts.transpose()?;
        let fields = names.values.iter().enumerate().map(|(index, name)| {
            Ok(PcdField {
                name: (*name).to_owned(),
                kind: number_kind(kinds.of_field(index)),
                size: number_of(name, sizes, index, 1..=MAX_SIZE)?,
                count: match counts {
                    Some(counts) => number_of(name, counts, index, 0..=MAX_COUNT)?,
                    None => 1,
                },
            })
        });
        fields.collect()
    }

    /// The sensor's pose is not applied to the points (PCL does not either), but must be valid.
    fn check_viewpoint(&self) -> Result<(), PcdError> {
        let Some(entry) = self.find("VIEWPOINT") else {
            return Ok(());
        };
        if entry.values.len() != 7 {
            return Err(entry.error(format!("{} values, expected 7", entry.values.len())));
        }
        for value in &entry.values {
            if !value.parse::<f64>().is_ok_and(f64::is_finite) {
                return Err(entry.error(format!("{value:?} is no finite number")));
            }
        }
        Ok(())
    }

    fn data(&self) -> Result<Data, PcdError> {
        let entry = self.get("DATA")?;
        let data = entry.single()?;
        data.parse().map_err(|_| {
            entry.error(format!(
                "{data:?}, expected ascii, binary or binary_compressed"
            ))
        })
    }
}

/// The fault of a line without a key.
fn fault(line: u64, reason: impl Into<String>) -> PcdError {
    PcdError {
        line: Some(line),
        field: None,
        reason: reason.into(),
    }
}

fn number_kind(kind: &str) -> ScalarKind {
    match kind {
        "F" | "f" => ScalarKind::Float,
        "I" | "i" => ScalarKind::Signed,
        "U" | "u" => ScalarKind::Unsigned,
        _ => ScalarKind::Padding,
    }
}

/// The number that a header line gives for a field.
fn number_of(
    name: &str,
    entry: &HeaderEntry<'_>,
    index: usize,
    range: RangeInclusive<usize>,
) -> Result<usize, PcdError> {
    let value = entry.of_field(index);
    let number = value.parse().ok().filter(|number| range.contains(number));
    number.ok_or_else(|| {
        let (low, high) = (range.start(), range.end());
        entry.error(format!(
            "{value:?} of field {name}, expected {low} to {high}"
        ))
    })
}

/// The only coordinate of that name, which must hold one number.
fn find_coordinate(fields: &[PcdField], name: &str, line: u64) -> Result<usize, PcdError> {
    let mut found = fields
        .iter()
        .enumerate()
        .filter(|(_, field)| field.name.eq_ignore_ascii_case(name));
    let (index, field) = found
        .next()
        .ok_or_else(|| PcdError::at(line, "FIELDS", format!("no field {name}")))?;
    if found.next().is_some() {
        let reason = format!("{name} is given twice");
        return Err(PcdError::at(line, "FIELDS", reason));
    }
    if field.count != 1 {
        let reason = format!("{} of field {name}, expected 1", field.count);
        return Err(PcdError::at(line, "COUNT", reason));
    }
    Ok(index)
}

/// The first field of the most preferred name that holds one number.
fn find_number(fields: &[PcdField], names: &[&str]) -> Option<usize> {
    names.iter().find_map(|name| {
        fields
            .iter()
            .position(|field| field.count == 1 && field.name.eq_ignore_ascii_case(name))
    })
}

#[cfg(test)]
mod tests;
