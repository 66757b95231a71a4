//! PCD files of any fields in all three encodings.

use crate::pcd::lzf;

/// A number of a point, by its type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Number {
    F4(f32),
    F8(f64),
    U1(u8),
    U2(u16),
    U4(u32),
    I1(i8),
    I2(i16),
    I4(i32),
    /// This number of padding bytes.
    Padding(usize),
}

impl Number {
    fn format(self) -> (char, usize, usize) {
        match self {
            Self::F4(_) => ('F', 4, 1),
            Self::F8(_) => ('F', 8, 1),
            Self::U1(_) => ('U', 1, 1),
            Self::U2(_) => ('U', 2, 1),
            Self::U4(_) => ('U', 4, 1),
            Self::I1(_) => ('I', 1, 1),
            Self::I2(_) => ('I', 2, 1),
            Self::I4(_) => ('I', 4, 1),
            Self::Padding(count) => ('U', 1, count),
        }
    }

    fn bytes(self) -> Vec<u8> {
        match self {
            Self::F4(value) => value.to_le_bytes().to_vec(),
            Self::F8(value) => value.to_le_bytes().to_vec(),
            Self::U1(value) => vec![value],
            Self::U2(value) => value.to_le_bytes().to_vec(),
            Self::U4(value) => value.to_le_bytes().to_vec(),
            Self::I1(value) => value.to_le_bytes().to_vec(),
            Self::I2(value) => value.to_le_bytes().to_vec(),
            Self::I4(value) => value.to_le_bytes().to_vec(),
            Self::Padding(count) => vec![0xaa; count],
        }
    }

    /// As printed by C's `%.10g`.
    fn text(self) -> String {
        match self {
            Self::F4(value) => ten_digits(f64::from(value)),
            Self::F8(value) => ten_digits(value),
            Self::U1(value) => value.to_string(),
            Self::U2(value) => value.to_string(),
            Self::U4(value) => value.to_string(),
            Self::I1(value) => value.to_string(),
            Self::I2(value) => value.to_string(),
            Self::I4(value) => value.to_string(),
            Self::Padding(count) => vec!["0"; count].join(" "),
        }
    }
}

fn ten_digits(value: f64) -> String {
    if !value.is_finite() {
        return format!("{value}").to_lowercase();
    }
    let text = format!("{value:.9e}");
    let (mantissa, exponent) = text.split_once('e').unwrap();
    let exponent: i32 = exponent.parse().unwrap();
    let trimmed = |text: &str| text.trim_end_matches('0').trim_end_matches('.').to_owned();
    if (-4..10).contains(&exponent) {
        let decimals = usize::try_from(9 - exponent).unwrap();
        let text = format!("{value:.decimals$}");
        return if decimals > 0 { trimmed(&text) } else { text };
    }
    format!(
        "{}e{}{:02}",
        trimmed(mantissa),
        if exponent < 0 { '-' } else { '+' },
        exponent.abs()
    )
}

/// A file before it is written.
#[derive(Debug, Clone)]
pub(super) struct File {
    names: Vec<&'static str>,
    rows: Vec<Vec<Number>>,
    height: usize,
}

impl File {
    /// This number of copies of one point.
    pub(super) fn new(fields: &[(&'static str, Number)], points: usize) -> Self {
        let (names, row): (Vec<_>, Vec<_>) = fields.iter().copied().unzip();
        Self {
            names,
            rows: vec![row; points],
            height: 1,
        }
    }

    /// Points of these fields; every row has the same types.
    pub(super) fn of_rows(names: &[&'static str], rows: Vec<Vec<Number>>) -> Self {
        Self {
            names: names.to_vec(),
            rows,
            height: 1,
        }
    }

    /// The same points as an organised cloud with this number of rows.
    pub(super) fn in_rows_of_height(self, height: usize) -> Self {
        Self { height, ..self }
    }

    pub(super) fn header(&self, data: &str) -> String {
        let row = self.rows.first().expect("a point");
        let of_each = |text: &dyn Fn(Number) -> String| {
            row.iter()
                .map(|&number| text(number))
                .collect::<Vec<_>>()
                .join(" ")
        };
        format!(
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {}\n\
             HEIGHT {}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA {data}\n",
            self.names.join(" "),
            of_each(&|number| number.format().1.to_string()),
            of_each(&|number| number.format().0.to_string()),
            of_each(&|number| number.format().2.to_string()),
            self.rows.len() / self.height,
            self.height,
            self.rows.len(),
        )
    }

    pub(super) fn ascii(&self, end_of_line: &str) -> Vec<u8> {
        let line = |row: &Vec<Number>| {
            let words: Vec<String> = row
                .iter()
                .map(|number| number.text())
                .filter(|text| !text.is_empty())
                .collect();
            words.join(" ") + end_of_line
        };
        (self.header("ascii") + &self.rows.iter().map(line).collect::<String>()).into_bytes()
    }

    pub(super) fn binary(&self) -> Vec<u8> {
        let mut file = self.header("binary").into_bytes();
        file.extend(self.rows.iter().flatten().flat_map(|number| number.bytes()));
        file
    }

    pub(super) fn compressed(&self) -> Vec<u8> {
        let columns = 0..self.names.len();
        let unpacked: Vec<u8> = columns
            .flat_map(|column| self.rows.iter().flat_map(move |row| row[column].bytes()))
            .collect();
        let packed = lzf::tests::compress(&unpacked);
        let mut file = self.header("binary_compressed").into_bytes();
        file.extend((packed.len() as u32).to_le_bytes());
        file.extend((unpacked.len() as u32).to_le_bytes());
        file.extend(packed);
        file
    }

    pub(super) fn in_all_encodings(&self) -> [Vec<u8>; 3] {
        [self.ascii("\n"), self.binary(), self.compressed()]
    }
}
