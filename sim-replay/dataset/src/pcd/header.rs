//! Header of a PCD file: type of every field and number of points.
//!
//! Writers differ: `VERSION` is `.7`, `0.5` or missing, `FIELDS` may be called `COLUMNS`, `COUNT` (1 each), `HEIGHT`,
//! `VIEWPOINT`, and `POINTS` or `WIDTH` may be missing, keys may be in lower case, and a field may have no numbers at
//! all.

mod points;

use protocol::{COLOUR_FIELDS, INTENSITY_FIELDS};

use super::{IntensityKind, PcdError};

const MAX_FIELDS: usize = 64;
/// Longest header line that is read, bytes.
const MAX_LINE: usize = 8192;
/// Most numbers in one field of one point.
const MAX_COUNT: u64 = 65_536;
/// Most bytes of one number.
const MAX_SIZE: usize = 8;
/// Storage of the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Data {
    /// A line of decimal numbers per point.
    Ascii,
    /// Points one after another, little-endian.
    Binary,
    /// Fields one after another, little-endian, packed by LZF.
    BinaryCompressed,
}

impl Data {
    /// Name of the storage.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Ascii => "PCD, ascii",
            Self::Binary => "PCD, binary",
            Self::BinaryCompressed => "PCD, compressed",
        }
    }
}

/// Type of one number of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// `TYPE F`, 4 or 8 bytes.
    Float,
    /// `TYPE I`, 1, 2, 4 or 8 bytes.
    Signed,
    /// `TYPE U`, 1, 2, 4 or 8 bytes.
    Unsigned,
    /// Any other type: accepted only for fields that are not read.
    Other,
}

/// One field of a point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) name: String,
    pub(super) kind: Kind,
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
pub(super) struct Header {
    pub(super) fields: Vec<Field>,
    pub(super) points: usize,
    pub(super) data: Data,
    /// Indices of x, y and z in `fields`.
    pub(super) xyz: [usize; 3],
    pub(super) intensity: IntensitySource,
    /// Lines up to and including `DATA`.
    pub(super) lines: u64,
}

/// The values of one header line and their position.
struct Entry<'a> {
    line: u64,
    values: Vec<&'a str>,
}

/// The header lines by key, unchecked.
#[derive(Default)]
struct Entries<'a> {
    found: Vec<(&'static str, Entry<'a>)>,
}

const KEYS: [&str; 10] = [
    "VERSION",
    "FIELDS",
    "SIZE",
    "TYPE",
    "COUNT",
    "WIDTH",
    "HEIGHT",
    "VIEWPOINT",
    "POINTS",
    "DATA",
];
const VERSIONS: [&str; 6] = ["0.7", ".7", "0.6", ".6", "0.5", ".5"];

impl Header {
    /// Splits a file into its header and the rest.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), PcdError> {
        let mut entries = Entries::default();
        // The byte order mark of UTF-8 would be part of the first key.
        let mut rest = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        let mut line = 0;
        while !entries.has("DATA") {
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
        let xyz = find_xyz(&fields, line)?;
        let intensity = find_intensity(&fields);
        let header = Self {
            xyz,
            intensity,
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
                let is_byte = field.kind == Kind::Unsigned && field.size == 1;
                Some((
                    &field.name,
                    if is_byte {
                        IntensityKind::Byte
                    } else {
                        IntensityKind::Number
                    },
                ))
            }
            IntensitySource::None => None,
        }
    }

    /// The fields that are read must be numbers; of all others only the size is needed.
    #[expect(
        clippy::indexing_slicing,
        reason = "indices of the fields, of which each has one type"
    )]
    fn check_formats(&self, entries: &Entries<'_>) -> Result<(), PcdError> {
        let intensity = match self.intensity {
            IntensitySource::Value(index) | IntensitySource::Red(index) => Some(index),
            IntensitySource::None => None,
        };
        for index in self.xyz.into_iter().chain(intensity) {
            let Field {
                name, kind, size, ..
            } = &self.fields[index];
            let (kinds, sizes) = (entries.get("TYPE")?, entries.get("SIZE")?);
            let allowed: &[usize] = match kind {
                Kind::Other => {
                    let reason = format!(
                        "{:?} of field {name}, expected F, I or U",
                        kinds.values[index]
                    );
                    return Err(PcdError::at(kinds.line, "TYPE", reason));
                }
                // Ahead of the types: a packed colour has four bytes, as a float and as an integer.
                _ if self.intensity == IntensitySource::Red(index) => &[4],
                Kind::Float => &[4, 8],
                Kind::Signed | Kind::Unsigned => &[1, 2, 4, 8],
            };
            if !allowed.contains(size) {
                let reason = format!(
                    "{size} of field {name}, expected one of {allowed:?} for TYPE {}",
                    kinds.values[index]
                );
                return Err(PcdError::at(sizes.line, "SIZE", reason));
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
    fn has(&self, key: &str) -> bool {
        self.found.iter().any(|(found, _)| *found == key)
    }

    fn add(&mut self, line: u64, text: &'a [u8]) -> Result<(), PcdError> {
        let text = std::str::from_utf8(text).map_err(|_| not_text(line))?;
        let mut words = text.split_ascii_whitespace();
        let Some(word) = words.next() else {
            return Ok(());
        };
        let asked = if word.eq_ignore_ascii_case("COLUMNS") {
            "FIELDS"
        } else {
            word
        };
        let Some(key) = KEYS.into_iter().find(|key| key.eq_ignore_ascii_case(asked)) else {
            let word: String = word.chars().take(40).collect();
            return Err(PcdError {
                line: Some(line),
                field: None,
                reason: format!("{word:?} is no PCD header key"),
            });
        };
        if self.has(key) {
            return Err(PcdError::at(line, key, "is given a second time"));
        }
        self.found.push((
            key,
            Entry {
                line,
                values: words.collect(),
            },
        ));
        Ok(())
    }

    fn get(&self, key: &str) -> Result<&Entry<'a>, PcdError> {
        self.find(key)
            .ok_or_else(|| PcdError::of(key, "missing in the header"))
    }

    fn find(&self, key: &str) -> Option<&Entry<'a>> {
        self.found
            .iter()
            .find(|(found, _)| *found == key)
            .map(|(_, entry)| entry)
    }

    fn single(&self, key: &str) -> Result<(u64, &'a str), PcdError> {
        let entry = self.get(key)?;
        match entry.values[..] {
            [value] => Ok((entry.line, value)),
            _ => {
                let reason = format!("{} values, expected 1", entry.values.len());
                Err(PcdError::at(entry.line, key, reason))
            }
        }
    }

    fn check_version(&self) -> Result<(), PcdError> {
        if !self.has("VERSION") {
            return Ok(());
        }
        let (line, version) = self.single("VERSION")?;
        if VERSIONS.contains(&version) {
            return Ok(());
        }
        let reason = format!("{version:?}, expected 0.7, 0.6 or 0.5");
        Err(PcdError::at(line, "VERSION", reason))
    }

    /// One value for each field, or an error with both counts.
    fn per_field(&self, key: &'static str, fields: usize) -> Result<&Entry<'a>, PcdError> {
        let entry = self.get(key)?;
        if entry.values.len() == fields {
            return Ok(entry);
        }
        let reason = format!("{} values for {fields} FIELDS", entry.values.len());
        Err(PcdError::at(entry.line, key, reason))
    }

    #[expect(
        clippy::indexing_slicing,
        reason = "as many sizes, types and counts as names"
    )]
    fn fields(&self) -> Result<Vec<Field>, PcdError> {
        let names = self.get("FIELDS")?;
        if names.values.is_empty() || names.values.len() > MAX_FIELDS {
            let reason = format!("{} fields, expected 1 to {MAX_FIELDS}", names.values.len());
            return Err(PcdError::at(names.line, "FIELDS", reason));
        }
        let sizes = self.per_field("SIZE", names.values.len())?;
        let kinds = self.per_field("TYPE", names.values.len())?;
        let counts = if self.has("COUNT") {
            Some(self.per_field("COUNT", names.values.len())?)
        } else {
            None
        };
        (0..names.values.len())
            .map(|index| {
                let name = names.values[index];
                let size = number_size(name, sizes.line, sizes.values[index])?;
                let count = match counts {
                    Some(counts) => field_count(name, counts.line, counts.values[index])?,
                    None => 1,
                };
                Ok(Field {
                    name: name.to_owned(),
                    kind: number_kind(kinds.values[index]),
                    size,
                    count,
                })
            })
            .collect()
    }

    /// The sensor's pose is not applied to the points (PCL does not either), but must be valid.
    fn check_viewpoint(&self) -> Result<(), PcdError> {
        let Some(entry) = self.find("VIEWPOINT") else {
            return Ok(());
        };
        if entry.values.len() != 7 {
            let reason = format!("{} values, expected 7", entry.values.len());
            return Err(PcdError::at(entry.line, "VIEWPOINT", reason));
        }
        for value in &entry.values {
            if !value.parse::<f64>().is_ok_and(f64::is_finite) {
                let reason = format!("{value:?} is no finite number");
                return Err(PcdError::at(entry.line, "VIEWPOINT", reason));
            }
        }
        Ok(())
    }

    fn data(&self) -> Result<Data, PcdError> {
        let (line, data) = self.single("DATA")?;
        let kinds = [
            ("ascii", Data::Ascii),
            ("binary", Data::Binary),
            ("binary_compressed", Data::BinaryCompressed),
        ];
        let found = kinds
            .into_iter()
            .find(|(name, _)| name.eq_ignore_ascii_case(data));
        found.map(|(_, kind)| kind).ok_or_else(|| {
            let reason = format!("{data:?}, expected ascii, binary or binary_compressed");
            PcdError::at(line, "DATA", reason)
        })
    }
}

fn not_text(line: u64) -> PcdError {
    PcdError {
        line: Some(line),
        field: None,
        reason: "the header is not text: is this a PCD file?".into(),
    }
}

fn number_kind(kind: &str) -> Kind {
    match kind {
        "F" | "f" => Kind::Float,
        "I" | "i" => Kind::Signed,
        "U" | "u" => Kind::Unsigned,
        _ => Kind::Other,
    }
}

fn number_size(name: &str, line: u64, value: &str) -> Result<usize, PcdError> {
    let size = value
        .parse()
        .ok()
        .filter(|size| (1..=MAX_SIZE).contains(size));
    size.ok_or_else(|| {
        let reason = format!("{value:?} of field {name}, expected 1 to {MAX_SIZE}");
        PcdError::at(line, "SIZE", reason)
    })
}

fn field_count(name: &str, line: u64, value: &str) -> Result<usize, PcdError> {
    let count = value.parse().ok().filter(|&count: &u64| count <= MAX_COUNT);
    let count = count.and_then(|count| usize::try_from(count).ok());
    count.ok_or_else(|| {
        let reason = format!("{value:?} of field {name}, expected 0 to {MAX_COUNT}");
        PcdError::at(line, "COUNT", reason)
    })
}

/// The only coordinate of that name, which must hold one number.
fn find_coordinate(fields: &[Field], name: &str, line: u64) -> Result<usize, PcdError> {
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

fn find_xyz(fields: &[Field], line: u64) -> Result<[usize; 3], PcdError> {
    let [x, y, z] = ["x", "y", "z"].map(|name| find_coordinate(fields, name, line));
    Ok([x?, y?, z?])
}

/// The first field of the most preferred name that holds one number.
fn find_intensity(fields: &[Field]) -> IntensitySource {
    if let Some(index) = find_number(fields, &INTENSITY_FIELDS) {
        return IntensitySource::Value(index);
    }
    find_number(fields, &COLOUR_FIELDS).map_or(IntensitySource::None, IntensitySource::Red)
}

fn find_number(fields: &[Field], names: &[&str]) -> Option<usize> {
    names.iter().find_map(|name| {
        fields
            .iter()
            .position(|field| field.count == 1 && field.name.eq_ignore_ascii_case(name))
    })
}

#[cfg(test)]
mod tests;
