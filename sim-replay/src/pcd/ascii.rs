//! Points as lines of decimal numbers.

use super::header::{Header, IntensitySource, Kind};
use super::{Collector, PcdCloud, PcdError, Place, unpack_rgb};

/// What to do with a column of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    /// Goes to this component of the point.
    Component(usize),
    /// A packed colour printed as a float: its bits count.
    FloatColour,
    /// A packed colour printed as an integer.
    IntegerColour,
    Ignored,
}

pub(super) fn decode(header: &Header, body: &[u8]) -> Result<PcdCloud, PcdError> {
    let columns = columns(header);
    // A number and its separator are two bytes at least: the header cannot make us reserve more than the file's size.
    let possible = body.len().div_ceil(2 * columns.len());
    let labelled = matches!(header.intensity, IntensitySource::Red(_));
    let mut collector = Collector::with_capacity(header.points.min(possible), labelled);
    let mut read = 0;
    for (line, text) in (header.lines + 1..).zip(body.split_inclusive(|&byte| byte == b'\n')) {
        let mut tokens = text.split(u8::is_ascii_whitespace).filter(|token| !token.is_empty()).peekable();
        if tokens.peek().is_none() {
            continue;
        }
        if read == header.points {
            return Err(PcdError::at(line, "POINTS", format!("{} stated, but here is another point", header.points)));
        }
        let is_complete = text.ends_with(b"\n");
        let (point, label) = parse_point(header, &columns, tokens, line)
            .map_err(|error| if is_complete { error } else { cut_off(error, read, header.points) })?;
        collector.push(point, labelled.then_some(label), Place::Line(line));
        read += 1;
    }
    if read != header.points {
        return Err(PcdError::of("POINTS", format!("{} stated, {read} found: the file is cut off", header.points)));
    }
    Ok(collector.finish())
}

/// A last line that is wrong and does not end is no typing mistake.
fn cut_off(error: PcdError, read: usize, stated: usize) -> PcdError {
    let reason = format!("{}: the file is cut off here, after {read} of {stated} POINTS", error.reason);
    PcdError { reason, ..error }
}

fn columns(header: &Header) -> Vec<Column> {
    let mut columns = Vec::with_capacity(header.columns());
    for (index, field) in header.fields.iter().enumerate() {
        let column = match header.intensity {
            IntensitySource::Value(intensity) if intensity == index => Column::Component(3),
            IntensitySource::Red(colour) if colour == index && field.kind == Kind::Float => Column::FloatColour,
            IntensitySource::Red(colour) if colour == index => Column::IntegerColour,
            _ => header.xyz.iter().position(|&xyz| xyz == index).map_or(Column::Ignored, Column::Component),
        };
        columns.extend(std::iter::repeat_n(column, field.count));
    }
    columns
}

fn parse_point<'a>(
    header: &Header,
    columns: &[Column],
    mut tokens: impl Iterator<Item = &'a [u8]>,
    line: u64,
) -> Result<([f32; 4], u8), PcdError> {
    let mut point = [0.0; 4];
    let mut label = 0;
    for (index, column) in columns.iter().enumerate() {
        let Some(token) = tokens.next() else {
            return Err(wrong_count(header, line, index, columns.len()));
        };
        match column {
            Column::Ignored => {}
            Column::Component(component) => point[*component] = number(header, index, token, line)?,
            Column::FloatColour => {
                let value: f32 = number(header, index, token, line)?;
                (point[3], label) = unpack_rgb(value.to_bits());
                if value.is_nan() {
                    // The bits of a printed NaN are lost, and the intensity with them.
                    point[3] = f32::NAN;
                }
            }
            Column::IntegerColour => {
                let value: i64 = number(header, index, token, line)?;
                // `TYPE I` prints colours with alpha as negative numbers; the low 32 bits are what counts.
                (point[3], label) = unpack_rgb(value as u32);
            }
        }
    }
    match tokens.count() {
        0 => Ok((point, label)),
        more => Err(wrong_count(header, line, columns.len() + more, columns.len())),
    }
}

fn number<T: std::str::FromStr>(header: &Header, column: usize, token: &[u8], line: u64) -> Result<T, PcdError> {
    let number = std::str::from_utf8(token).ok().and_then(|text| text.parse().ok());
    number.ok_or_else(|| {
        let token: String = String::from_utf8_lossy(token).chars().take(40).collect();
        PcdError::at(line, column_name(header, column), format!("{token:?} is no number"))
    })
}

fn wrong_count(header: &Header, line: u64, found: usize, expected: usize) -> PcdError {
    let field = column_name(header, found.min(expected.saturating_sub(1)));
    PcdError::at(line, field, format!("{found} values in the line, expected {expected}"))
}

fn column_name(header: &Header, column: usize) -> &str {
    let mut end = 0;
    let field = header.fields.iter().find(|field| {
        end += field.count;
        column < end
    });
    field.map_or("", |field| &field.name)
}

#[cfg(test)]
mod tests {
    use crate::pcd::{Place, decode};

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

    /// Red of the word a dataset stores, printed as it prints it.
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
            let file = file("x y z rgb", &format!("F F F {kind}"), &[&format!("1 2 3 {token}")]);
            assert_eq!(decode(&file).unwrap().points.xyzi[0][3], 64.0 / 255.0);
        }
    }

    #[test]
    fn the_green_byte_is_a_label_where_it_says_anything() {
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
        let file = file("x y z intensity", "F F F F", &["1 2 3 0", "nan 2 3 0", "1 2 inf 0", "4 5 6 0"]);
        let cloud = decode(&file).unwrap();
        assert_eq!(cloud.points.xyzi, [[1.0, 2.0, 3.0, 0.0], [4.0, 5.0, 6.0, 0.0]]);
        assert_eq!((cloud.dropped, cloud.first_dropped), (2, Some(Place::Line(12))));
    }

    #[test]
    fn what_is_wrong_in_a_line_is_named() {
        let message = |lines: &[&str]| decode(&file("x y z rgb", "F F F F", lines)).unwrap_err().to_string();
        assert_eq!(message(&["1 2 3 0", "1 2 three 0"]), "line 12: z: \"three\" is no number");
        assert_eq!(message(&["1 2 3"]), "line 11: rgb: 3 values in the line, expected 4");
        assert_eq!(message(&["1 2 3 4 5"]), "line 11: rgb: 5 values in the line, expected 4");
    }

    #[test]
    fn too_few_and_too_many_lines_are_named() {
        let text = String::from_utf8(file("x y z", "F F F", &["1 2 3", "4 5 6"])).unwrap();
        let cut = text.replace("4 5 6\n", "");
        assert_eq!(decode(cut.as_bytes()).unwrap_err().to_string(), "POINTS: 2 stated, 1 found: the file is cut off");
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
