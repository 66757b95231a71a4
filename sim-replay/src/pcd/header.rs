//! The header of a PCD file: what every field is and how many points follow.

use super::PcdError;

/// More points than any sweep has; a header that promises more is wrong.
const MAX_POINTS: u64 = 50_000_000;
const MAX_FIELDS: usize = 64;
/// Longest header line that is looked at, bytes.
const MAX_LINE: usize = 8192;
/// Most numbers in one field of one point.
const MAX_COUNT: u64 = 65_536;

/// How the points are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Data {
    /// A line of decimal numbers per point.
    Ascii,
    /// Points one after another, little-endian.
    Binary,
    /// Fields one after another, little-endian, packed by LZF.
    BinaryCompressed,
}

/// What one number of a field is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// `TYPE F`, 4 or 8 bytes.
    Float,
    /// `TYPE I`, 1, 2, 4 or 8 bytes.
    Signed,
    /// `TYPE U`, 1, 2, 4 or 8 bytes.
    Unsigned,
}

/// One field of a point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) name: String,
    pub(super) kind: Kind,
    /// Bytes of one number.
    pub(super) size: usize,
    /// Numbers per point.
    pub(super) count: usize,
}

/// Which field the fourth value of a point comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum IntensitySource {
    /// The field at this index, as it is.
    Value(usize),
    /// The red byte of the packed field at this index.
    Red(usize),
    /// There is none: 0 for all.
    None,
}

/// A header whose parts fit each other.
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

/// The values of one header line and where they stand.
struct Entry<'a> {
    line: u64,
    values: Vec<&'a str>,
}

/// The header lines by key, before anything is checked.
#[derive(Default)]
struct Entries<'a> {
    found: Vec<(&'static str, Entry<'a>)>,
}

const KEYS: [&str; 10] =
    ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"];

impl Header {
    /// Splits a file into its header and what follows it.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), PcdError> {
        let mut entries = Entries::default();
        let mut rest = bytes;
        let mut line = 0;
        while !entries.has("DATA") {
            line += 1;
            let Some(end) = rest.iter().take(MAX_LINE).position(|&byte| byte == b'\n') else {
                return Err(PcdError::at(line, "DATA", "the header ends before a DATA line"));
            };
            let text = std::str::from_utf8(&rest[..end]).map_err(|_| not_text(line))?;
            rest = &rest[end + 1..];
            entries.add(line, text)?;
        }
        Ok((Self::from_entries(&entries, line)?, rest))
    }

    fn from_entries(entries: &Entries<'_>, lines: u64) -> Result<Self, PcdError> {
        entries.check_version()?;
        let fields = entries.fields()?;
        let points = entries.points()?;
        entries.check_viewpoint()?;
        let xyz = find_xyz(&fields, entries.get("FIELDS")?.line)?;
        let intensity = find_intensity(&fields, entries.get("FIELDS")?.line)?;
        Ok(Self { xyz, intensity, points, data: entries.data()?, fields, lines })
    }

    /// Numbers per point.
    pub(super) fn columns(&self) -> usize {
        self.fields.iter().map(|field| field.count).sum()
    }

    /// Bytes per point.
    pub(super) fn stride(&self) -> usize {
        self.fields.iter().map(|field| field.count * field.size).sum()
    }
}

impl<'a> Entries<'a> {
    fn has(&self, key: &str) -> bool {
        self.found.iter().any(|(found, _)| *found == key)
    }

    fn add(&mut self, line: u64, text: &'a str) -> Result<(), PcdError> {
        let mut words = text.split_ascii_whitespace();
        let Some(word) = words.next().filter(|word| !word.starts_with('#')) else { return Ok(()) };
        let Some(key) = KEYS.into_iter().find(|key| *key == word) else {
            let word: String = word.chars().take(40).collect();
            return Err(PcdError { line: Some(line), field: None, reason: format!("{word:?} is no PCD header key") });
        };
        if self.has(key) {
            return Err(PcdError::at(line, key, "stands here a second time"));
        }
        self.found.push((key, Entry { line, values: words.collect() }));
        Ok(())
    }

    fn get(&self, key: &str) -> Result<&Entry<'a>, PcdError> {
        let found = self.found.iter().find(|(found, _)| *found == key);
        found.map(|(_, entry)| entry).ok_or_else(|| PcdError::of(key, "missing in the header"))
    }

    fn single(&self, key: &str) -> Result<(u64, &'a str), PcdError> {
        let entry = self.get(key)?;
        match entry.values[..] {
            [value] => Ok((entry.line, value)),
            _ => Err(PcdError::at(entry.line, key, format!("{} values, expected 1", entry.values.len()))),
        }
    }

    fn count(&self, key: &str) -> Result<(u64, u64), PcdError> {
        let (line, value) = self.single(key)?;
        let number = value.parse().map_err(|_| PcdError::at(line, key, format!("{value:?} is no count")))?;
        Ok((line, number))
    }

    fn check_version(&self) -> Result<(), PcdError> {
        let (line, version) = self.single("VERSION")?;
        if ["0.7", ".7", "0.6", ".6"].contains(&version) {
            return Ok(());
        }
        Err(PcdError::at(line, "VERSION", format!("{version:?}, expected 0.7")))
    }

    /// One value for each field, or an error with both counts.
    fn per_field(&self, key: &'static str, fields: usize) -> Result<&Entry<'a>, PcdError> {
        let entry = self.get(key)?;
        if entry.values.len() == fields {
            return Ok(entry);
        }
        Err(PcdError::at(entry.line, key, format!("{} values for {fields} FIELDS", entry.values.len())))
    }

    fn fields(&self) -> Result<Vec<Field>, PcdError> {
        let names = self.get("FIELDS")?;
        if names.values.is_empty() || names.values.len() > MAX_FIELDS {
            let reason = format!("{} fields, expected 1 to {MAX_FIELDS}", names.values.len());
            return Err(PcdError::at(names.line, "FIELDS", reason));
        }
        let sizes = self.per_field("SIZE", names.values.len())?;
        let kinds = self.per_field("TYPE", names.values.len())?;
        let counts = if self.has("COUNT") { Some(self.per_field("COUNT", names.values.len())?) } else { None };
        (0..names.values.len())
            .map(|index| {
                let name = names.values[index];
                let (kind, size) =
                    number_format(name, (kinds.line, kinds.values[index]), (sizes.line, sizes.values[index]))?;
                let count = match counts {
                    Some(counts) => field_count(name, counts.line, counts.values[index])?,
                    None => 1,
                };
                Ok(Field { name: name.to_owned(), kind, size, count })
            })
            .collect()
    }

    fn points(&self) -> Result<usize, PcdError> {
        let (_, width) = self.count("WIDTH")?;
        let (_, height) = self.count("HEIGHT")?;
        let (line, points) = if self.has("POINTS") { self.count("POINTS")? } else { (0, width.saturating_mul(height)) };
        if width.checked_mul(height) != Some(points) {
            let reason = format!("{points}, but WIDTH {width} x HEIGHT {height} says otherwise");
            return Err(PcdError::at(line, "POINTS", reason));
        }
        if points > MAX_POINTS {
            return Err(PcdError::at(line, "POINTS", format!("{points}, at most {MAX_POINTS} are read")));
        }
        usize::try_from(points).map_err(|_| PcdError::at(line, "POINTS", format!("{points} do not fit this machine")))
    }

    /// The sensor's place is not applied to the points (PCL does not either), but must make sense.
    fn check_viewpoint(&self) -> Result<(), PcdError> {
        if !self.has("VIEWPOINT") {
            return Ok(());
        }
        let entry = self.get("VIEWPOINT")?;
        if entry.values.len() != 7 {
            return Err(PcdError::at(entry.line, "VIEWPOINT", format!("{} values, expected 7", entry.values.len())));
        }
        match entry.values.iter().find(|value| !value.parse::<f64>().is_ok_and(f64::is_finite)) {
            Some(value) => Err(PcdError::at(entry.line, "VIEWPOINT", format!("{value:?} is no finite number"))),
            None => Ok(()),
        }
    }

    fn data(&self) -> Result<Data, PcdError> {
        let (line, data) = self.single("DATA")?;
        match data {
            "ascii" => Ok(Data::Ascii),
            "binary" => Ok(Data::Binary),
            "binary_compressed" => Ok(Data::BinaryCompressed),
            _ => Err(PcdError::at(line, "DATA", format!("{data:?}, expected ascii, binary or binary_compressed"))),
        }
    }
}

fn not_text(line: u64) -> PcdError {
    PcdError { line: Some(line), field: None, reason: "the header is not text: is this a PCD file?".into() }
}

fn number_format(name: &str, kind: (u64, &str), size: (u64, &str)) -> Result<(Kind, usize), PcdError> {
    let (sizes, parsed): (&[usize], Kind) = match kind.1 {
        "F" => (&[4, 8], Kind::Float),
        "I" => (&[1, 2, 4, 8], Kind::Signed),
        "U" => (&[1, 2, 4, 8], Kind::Unsigned),
        other => {
            return Err(PcdError::at(kind.0, "TYPE", format!("{other:?} of field {name}, expected F, I or U")));
        }
    };
    match size.1.parse().ok().filter(|size| sizes.contains(size)) {
        Some(size) => Ok((parsed, size)),
        None => {
            let reason = format!("{:?} of field {name}, expected one of {sizes:?} for TYPE {}", size.1, kind.1);
            Err(PcdError::at(size.0, "SIZE", reason))
        }
    }
}

fn field_count(name: &str, line: u64, value: &str) -> Result<usize, PcdError> {
    let count = value.parse().ok().filter(|count| (1..=MAX_COUNT).contains(count));
    count
        .and_then(|count| usize::try_from(count).ok())
        .ok_or_else(|| PcdError::at(line, "COUNT", format!("{value:?} of field {name}, expected 1 to {MAX_COUNT}")))
}

/// The only field of that name, which must hold one number.
fn find(fields: &[Field], name: &str, line: u64) -> Result<Option<usize>, PcdError> {
    let mut found = fields.iter().enumerate().filter(|(_, field)| field.name == name);
    let Some((index, field)) = found.next() else { return Ok(None) };
    if found.next().is_some() {
        return Err(PcdError::at(line, "FIELDS", format!("{name} stands there twice")));
    }
    if field.count != 1 {
        return Err(PcdError::at(line, "COUNT", format!("{} of field {name}, expected 1", field.count)));
    }
    Ok(Some(index))
}

fn find_xyz(fields: &[Field], line: u64) -> Result<[usize; 3], PcdError> {
    let find = |name| find(fields, name, line)?.ok_or_else(|| PcdError::at(line, "FIELDS", format!("no field {name}")));
    Ok([find("x")?, find("y")?, find("z")?])
}

fn find_intensity(fields: &[Field], line: u64) -> Result<IntensitySource, PcdError> {
    if let Some(index) = find(fields, "intensity", line)? {
        return Ok(IntensitySource::Value(index));
    }
    for name in ["rgb", "rgba"] {
        let Some(index) = find(fields, name, line)? else { continue };
        if fields[index].size != 4 {
            let reason = format!("{} of field {name}, expected 4: a packed colour", fields[index].size);
            return Err(PcdError::at(line, "SIZE", reason));
        }
        return Ok(IntensitySource::Red(index));
    }
    Ok(IntensitySource::None)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOUND: &str = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n\
                         WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n";

    fn error_after(from: &str, to: &str) -> String {
        let text = SOUND.replace(from, to);
        assert_ne!(text, SOUND, "{from}");
        Header::parse(text.as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn a_sound_header_is_taken_apart() {
        let (header, body) = Header::parse(format!("{SOUND}rest").as_bytes()).map(|(h, b)| (h, b.to_vec())).unwrap();
        assert_eq!((header.points, header.columns(), header.stride(), header.lines), (2, 4, 16, 11));
        assert_eq!((header.xyz, header.intensity), ([0, 1, 2], IntensitySource::Red(3)));
        assert_eq!(body, b"rest");
    }

    #[test]
    fn what_does_not_fit_is_named_with_line_and_both_values() {
        let cases = [
            ("VERSION 0.7", "VERSION 1.0", "line 2: VERSION: \"1.0\", expected 0.7"),
            ("SIZE 4 4 4 4", "SIZE 4 4 4", "line 4: SIZE: 3 values for 4 FIELDS"),
            ("SIZE 4 4 4 4", "SIZE 4 2 4 4", "line 4: SIZE: \"2\" of field y, expected one of [4, 8] for TYPE F"),
            ("TYPE F F F F", "TYPE F F Q F", "line 5: TYPE: \"Q\" of field z, expected F, I or U"),
            ("COUNT 1 1 1 1", "COUNT 1 1 0 1", "line 6: COUNT: \"0\" of field z, expected 1 to 65536"),
            ("COUNT 1 1 1 1", "COUNT 2 1 1 1", "line 3: COUNT: 2 of field x, expected 1"),
            ("FIELDS x y z rgb", "FIELDS x y h rgb", "line 3: FIELDS: no field z"),
            ("FIELDS x y z rgb", "FIELDS x y z x", "line 3: FIELDS: x stands there twice"),
            ("POINTS 2", "POINTS 3", "line 10: POINTS: 3, but WIDTH 2 x HEIGHT 1 says otherwise"),
            ("WIDTH 2", "WIDTH two", "line 7: WIDTH: \"two\" is no count"),
            ("WIDTH 2", "WIDTH -2", "line 7: WIDTH: \"-2\" is no count"),
            ("HEIGHT 1\n", "", "HEIGHT: missing in the header"),
            ("HEIGHT 1", "HEIGHT 1\nHEIGHT 1", "line 9: HEIGHT: stands here a second time"),
            ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0", "line 9: VIEWPOINT: 2 values, expected 7"),
            ("VIEWPOINT 0 0 0 1 0 0 0", "VIEWPOINT 0 0 0 1 0 0 x", "line 9: VIEWPOINT: \"x\" is no finite number"),
            ("DATA ascii", "DATA hex", "line 11: DATA: \"hex\", expected ascii, binary or binary_compressed"),
            ("DATA ascii\n", "", "line 11: DATA: the header ends before a DATA line"),
            ("VERSION 0.7", "HELLO 0.7", "line 2: \"HELLO\" is no PCD header key"),
        ];
        for (from, to, message) in cases {
            assert_eq!(error_after(from, to), message);
        }
    }

    #[test]
    fn absurd_counts_are_refused() {
        let absurd = SOUND.replace("WIDTH 2", "WIDTH 99999999999").replace("POINTS 2", "POINTS 99999999999");
        assert!(Header::parse(absurd.as_bytes()).unwrap_err().reason.contains("at most 50000000"));
        let wrapping = SOUND.replace("WIDTH 2", "WIDTH 9223372036854775808").replace("HEIGHT 1", "HEIGHT 2");
        assert!(Header::parse(wrapping.replace("POINTS 2", "POINTS 0").as_bytes()).is_err());
    }

    #[test]
    fn carriage_returns_are_whitespace() {
        assert!(Header::parse(SOUND.replace('\n', "\r\n").as_bytes()).is_ok());
    }
}
