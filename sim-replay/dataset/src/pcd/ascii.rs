//! Points as lines of decimal numbers.

use super::header::{IntensitySource, PcdHeader};
use super::number::{is_separator, ordinary, unusual};
use super::{PcdCloud, PcdError, PcdPlace, unpack_rgb};
use crate::scalar::ScalarKind;

/// Use of the numbers of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AsciiColumn {
    /// Stored in this component of the point.
    Component(usize),
    /// A packed colour printed as a float: its bits are used.
    FloatColour,
    /// A packed colour printed as an integer.
    IntegerColour,
    Ignored,
}

pub(super) fn decode(header: &PcdHeader, body: &[u8]) -> Result<PcdCloud, PcdError> {
    // A number and its separator are two bytes at least: the header cannot cause a reservation of more than the file's
    // size.
    let possible = body.len() / (2 * header.columns()) + 1;
    let is_labelled = matches!(header.intensity, IntensitySource::Red(_));
    let mut points = Vec::with_capacity(header.points.min(possible));
    let mut labels = Vec::with_capacity(if is_labelled { points.capacity() } else { 0 });
    let mut first_dropped = None;
    let columns = columns(header);
    let mut lines = Lines {
        header,
        columns: &columns,
        rest: body,
        begun: body,
        line: header.lines + 1,
        // No token is empty, so that none has this key.
        colours: Colours(vec![(0, (0.0, 0)); 256]),
    };
    while let Some((point, label)) = lines
        .next_point()
        .map_err(|error| lines.cut_off(error, points.len()))?
    {
        if points.len() == header.points {
            let reason = format!("{} stated, but here is another point", header.points);
            return Err(PcdError::at(lines.line, "POINTS", reason));
        }
        if first_dropped.is_none() && !point.iter().all(|value| value.is_finite()) {
            first_dropped = Some(PcdPlace::Line(lines.line));
        }
        points.push(point);
        if is_labelled {
            labels.push(label);
        }
    }
    let (stated, found) = (header.points, points.len());
    if found != stated {
        let reason = format!("{stated} stated, {found} found: the file is cut off");
        return Err(PcdError::of("POINTS", reason));
    }
    Ok(PcdCloud {
        first_dropped,
        ..PcdCloud::of_finite(points, labels)
    })
}

/// The lines that are left to read.
struct Lines<'a> {
    header: &'a PcdHeader,
    columns: &'a [AsciiColumn],
    rest: &'a [u8],
    /// From the first value of the line that was begun last.
    begun: &'a [u8],
    /// The line of the point that was read last, from 1.
    line: u64,
    colours: Colours,
}

impl<'a> Lines<'a> {
    /// The point of the next line that is not blank, and its label.
    fn next_point(&mut self) -> Result<Option<([f32; 4], u8)>, PcdError> {
        while self.is_at_end_of_line() {
            match self.rest.split_first() {
                None => return Ok(None),
                Some((_, rest)) => (self.rest, self.line) = (rest, self.line + 1),
            }
        }
        self.begun = self.rest;
        let (mut point, mut label) = ([0.0; 4], 0);
        for (index, (field, &column)) in self.header.fields.iter().zip(self.columns).enumerate() {
            for _ in 0..field.count {
                if self.is_at_end_of_line() {
                    return Err(self.wrong_count());
                }
                match column {
                    // Not parsed: a field that is not read need not be a number.
                    AsciiColumn::Ignored => drop(self.token()),
                    AsciiColumn::Component(component) => {
                        let value = self.float(index)?;
                        if let Some(place) = point.get_mut(component) {
                            *place = value;
                        }
                    }
                    colour => (point[3], label) = self.colour(colour, index)?,
                }
            }
        }
        if !self.is_at_end_of_line() {
            return Err(self.wrong_count());
        }
        Ok(Some((point, label)))
    }

    /// Skips blanks; true if the line, or the text, ends after them.
    fn is_at_end_of_line(&mut self) -> bool {
        while let Some((&byte, rest)) = self.rest.split_first()
            && byte != b'\n'
            && is_separator(byte)
        {
            self.rest = rest;
        }
        matches!(self.rest.first(), None | Some(b'\n'))
    }

    fn token(&mut self) -> &'a [u8] {
        let end = self.rest.iter().position(|&byte| is_separator(byte));
        let (token, rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
        self.rest = rest;
        token
    }

    fn float(&mut self, field: usize) -> Result<f32, PcdError> {
        if let Some((number, len)) = ordinary(self.rest) {
            self.rest = self.rest.get(len..).unwrap_or_default();
            return Ok(number);
        }
        let token = self.token();
        unusual(token).ok_or_else(|| self.no_number(field, token))
    }

    /// Red and green of a packed colour.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the low 32 bits are the colour"
    )]
    fn colour(&mut self, column: AsciiColumn, field: usize) -> Result<(f32, u8), PcdError> {
        let key = short_token(self.rest);
        if let Some((key, len)) = key
            && let Some(colour) = self.colours.find(key)
        {
            self.rest = self.rest.get(len..).unwrap_or_default();
            return Ok(colour);
        }
        let token = self.token();
        let colour = match column {
            AsciiColumn::FloatColour => unusual(token).map(|value| {
                let (red, green) = unpack_rgb(value.to_bits());
                // The bits of a printed NaN are lost, and the intensity with them.
                (if value.is_nan() { f32::NAN } else { red }, green)
            }),
            // `TYPE I` prints colours with alpha as negative numbers; only the low 32 bits are used.
            _ => std::str::from_utf8(token)
                .ok()
                .and_then(|text| text.parse().ok())
                .map(|value: i64| unpack_rgb(value as u32)),
        };
        let colour = colour.ok_or_else(|| self.no_number(field, token))?;
        if let Some((key, _)) = key {
            self.colours.keep(key, colour);
        }
        Ok(colour)
    }

    fn no_number(&self, field: usize, token: &[u8]) -> PcdError {
        let token: String = String::from_utf8_lossy(token).chars().take(40).collect();
        let field = self.header.fields.get(field);
        let name = field.map_or("", |field| &field.name);
        PcdError::at(self.line, name, format!("{token:?} is no number"))
    }

    /// The line has fewer or more values than the header states. They are counted from its start.
    fn wrong_count(&self) -> PcdError {
        let mut lines = self.begun.split(|&byte| byte == b'\n');
        let line = lines.next().unwrap_or_default();
        let tokens = line.split(|&byte| is_separator(byte));
        let found = tokens.filter(|token| !token.is_empty()).count();
        let expected = self.header.columns();
        let mut end = 0;
        let field = self.header.fields.iter().find(|field| {
            end += field.count;
            // With too many values the last field is named.
            found.min(expected.saturating_sub(1)) < end
        });
        let name = field.map_or("", |field| &field.name);
        let reason = format!("{found} values in the line, expected {expected}");
        PcdError::at(self.line, name, reason)
    }

    /// A malformed last line without line end means a truncated file.
    fn cut_off(&self, error: PcdError, read: usize) -> PcdError {
        if self.begun.contains(&b'\n') {
            return error;
        }
        let (fault, stated) = (&error.reason, self.header.points);
        let reason = format!("{fault}: the file is cut off here, after {read} of {stated} POINTS");
        PcdError { reason, ..error }
    }
}

fn columns(header: &PcdHeader) -> Vec<AsciiColumn> {
    let fields = header.fields.iter().enumerate();
    let columns = fields.map(|(index, field)| match header.intensity {
        IntensitySource::Value(intensity) if intensity == index => AsciiColumn::Component(3),
        IntensitySource::Red(colour) if colour == index && field.kind == ScalarKind::Float => {
            AsciiColumn::FloatColour
        }
        IntensitySource::Red(colour) if colour == index => AsciiColumn::IntegerColour,
        _ => header
            .xyz
            .iter()
            .position(|&xyz| xyz == index)
            .map_or(AsciiColumn::Ignored, AsciiColumn::Component),
    });
    columns.collect()
}

/// Bytes of a token of up to 15 bytes at the start of a text as one number, and its length.
fn short_token(text: &[u8]) -> Option<(u128, usize)> {
    const ONES: u128 = u128::MAX / 0xff;
    let word = u128::from_le_bytes(*text.first_chunk()?);
    // The top bit of the first byte below 0x21, a separator, is set; bits behind it have no meaning.
    let separators = word.wrapping_sub(ONES * 0x21) & !word & (ONES << 7);
    let bits = (separators.trailing_zeros() / 8) * 8;
    // Without a separator in 16 bytes the token is too long for a key.
    let token = word & !u128::MAX.checked_shl(bits).filter(|_| separators != 0)?;
    Some((token, (bits / 8) as usize))
}

/// Cache of parsed colours, by the bytes of their tokens: a sweep has few distinct ones, and parsing is slow.
struct Colours(Vec<(u128, (f32, u8))>);

impl Colours {
    fn find(&self, key: u128) -> Option<(f32, u8)> {
        let (kept, colour) = *self.0.get(Self::slot(key))?;
        (kept == key).then_some(colour)
    }

    fn keep(&mut self, key: u128, colour: (f32, u8)) {
        if let Some(place) = self.0.get_mut(Self::slot(key)) {
            *place = (key, colour);
        }
    }

    #[expect(clippy::cast_possible_truncation, reason = "a hash of both halves")]
    fn slot(key: u128) -> usize {
        let mixed = ((key >> 64) as u64 ^ key as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (mixed >> 56) as usize
    }
}

#[cfg(test)]
mod tests {
    use crate::pcd::{PcdPlace, decode};

    fn file(fields: &str, types: &str, lines: &[&str]) -> Vec<u8> {
        let columns = fields.split(' ').count();
        let (sizes, counts) = (vec!["4"; columns].join(" "), vec!["1"; columns].join(" "));
        let points = lines.len();
        format!(
            "VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA ascii\n{}\n",
            lines.join("\n")
        )
        .into_bytes()
    }

    /// Red of the word stored by a data set, printed in the same way.
    fn red_of(token: &str) -> f32 {
        let file = file("x y z rgb", "F F F F", &[&format!("1 2 3 {token}")]);
        decode(&file).unwrap().points.xyzi[0][3] * 255.0
    }

    #[test]
    fn intensity_survives_in_normal_and_subnormal_words() {
        assert_eq!(red_of("1.781608625e-38"), 194.0);
        assert_eq!(red_of("2.259153205e-38"), 246.0);
        // Everything below 128 is subnormal: a parser that flushes to zero loses it.
        assert_eq!(red_of("1.1754944e-38"), 128.0);
        assert_eq!(red_of("1.1663108e-38"), 127.0);
        assert_eq!(red_of("5.877472e-39"), 64.0);
        assert_eq!(red_of("9.1835e-41"), 1.0);
        assert_eq!(red_of("0"), 0.0);
    }

    #[test]
    fn every_red_survives_printing() {
        for red in 0..=255u32 {
            let printed = format!("{:e}", f32::from_bits(red << 16));
            assert_eq!(red_of(&printed), red as f32, "{printed}");
        }
    }

    #[test]
    fn a_colour_may_be_an_integer_with_alpha() {
        let word = 0xff40_0000_u32;
        for (kind, token) in [("U", word.to_string()), ("I", (word as i32).to_string())] {
            let file = file(
                "x y z rgb",
                &format!("F F F {kind}"),
                &[&format!("1 2 3 {token}")],
            );
            assert_eq!(decode(&file).unwrap().points.xyzi[0][3], 64.0 / 255.0);
        }
    }

    #[test]
    fn short_tokens_end_at_any_separator() {
        for (text, len) in [
            ("1.5e-38 2 3 4 5 6 7 8", 7),
            ("123456789012345\n", 15),
            ("7\t1234567890123456", 1),
        ] {
            let (key, found) = super::short_token(text.as_bytes()).unwrap();
            assert_eq!(
                (found, &key.to_le_bytes()[..len]),
                (len, &text.as_bytes()[..len])
            );
            assert!(key.to_le_bytes()[len..].iter().all(|&byte| byte == 0));
        }
        assert!(super::short_token(b"1234567890123456 ").is_none());
        assert!(super::short_token(b"7 ").is_none());
    }

    #[test]
    fn the_green_byte_is_a_label_if_it_is_not_zero() {
        let clean = file("x y z rgb", "F F F U", &["1 2 3 65536", "1 2 3 65536"]);
        assert_eq!(decode(&clean).unwrap().labels, None);
        let snow = file("x y z rgb", "F F F U", &["1 2 3 65536", "1 2 3 66048"]);
        assert_eq!(decode(&snow).unwrap().labels, Some(vec![0, 2]));
    }

    #[test]
    fn order_and_extra_fields_do_not_matter() {
        let file = file("ring intensity z y x", "U F F F F", &["7 0.5 3 2 1"]);
        assert_eq!(decode(&file).unwrap().points.xyzi, [[1.0, 2.0, 3.0, 0.5]]);
    }

    #[test]
    fn a_file_without_intensity_has_zeros() {
        let file = file("x y z", "F F F", &["1 2 3"]);
        assert_eq!(decode(&file).unwrap().points.xyzi, [[1.0, 2.0, 3.0, 0.0]]);
    }

    #[test]
    fn points_that_are_not_finite_are_dropped_and_counted() {
        let file = file(
            "x y z intensity",
            "F F F F",
            &["1 2 3 0", "nan 2 3 0", "1 2 inf 0", "4 5 6 0"],
        );
        let cloud = decode(&file).unwrap();
        assert_eq!(
            cloud.points.xyzi,
            [[1.0, 2.0, 3.0, 0.0], [4.0, 5.0, 6.0, 0.0]]
        );
        assert_eq!(
            (cloud.dropped, cloud.first_dropped),
            (2, Some(PcdPlace::Line(12)))
        );
    }

    #[test]
    fn a_fault_in_a_line_is_reported() {
        let cases: [(&[&str], &str); 3] = [
            (
                &["1 2 3 0", "1 2 three 0"],
                "line 12: z: \"three\" is no number",
            ),
            (&["1 2 3"], "line 11: rgb: 3 values in the line, expected 4"),
            (
                &["1 2 3 4 5"],
                "line 11: rgb: 5 values in the line, expected 4",
            ),
        ];
        for (lines, expected) in cases {
            let error = decode(&file("x y z rgb", "F F F F", lines)).unwrap_err();
            assert_eq!(error.to_string(), expected);
        }
    }

    #[test]
    fn too_few_and_too_many_lines_are_named() {
        let text = String::from_utf8(file("x y z", "F F F", &["1 2 3", "4 5 6"])).unwrap();
        let cut = text.replace("4 5 6\n", "");
        assert_eq!(
            decode(cut.as_bytes()).unwrap_err().to_string(),
            "POINTS: 2 stated, 1 found: the file is cut off"
        );
        let inside = text.strip_suffix("5 6\n").unwrap();
        assert_eq!(
            decode(inside.as_bytes()).unwrap_err().to_string(),
            "line 12: y: 1 values in the line, expected 3: the file is cut off here, after 1 of 2 POINTS"
        );
        let long = text + "7 8 9\n";
        assert_eq!(
            decode(long.as_bytes()).unwrap_err().to_string(),
            "line 13: POINTS: 2 stated, but here is another point"
        );
    }
}
