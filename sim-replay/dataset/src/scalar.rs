//! Numbers of binary point files: type, size and byte order.

use half::f16;
use protocol::IntensityKind;

/// Type of one stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ScalarKind {
    /// Two's complement, 1, 2, 4 or 8 bytes.
    Signed,
    /// Without a sign, 1, 2, 4 or 8 bytes.
    Unsigned,
    /// IEEE, 2, 4 or 8 bytes.
    Float,
    /// Bytes that are skipped.
    Padding,
}

/// One stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Scalar {
    pub(super) kind: ScalarKind,
    /// Bytes.
    pub(super) size: usize,
    pub(super) is_big_endian: bool,
}

impl Scalar {
    pub(super) fn new(kind: ScalarKind, size: usize, is_big_endian: bool) -> Self {
        Self {
            kind,
            size,
            is_big_endian,
        }
    }

    /// The number at the start of `bytes`; `None` if they are too few, or there is no such type.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the upper bytes of a shorter number are zero"
    )]
    pub(super) fn read(self, bytes: &[u8]) -> Option<f64> {
        let stored = bytes.get(..self.size)?;
        let mut little = [0; 8];
        let place = little.get_mut(..self.size)?;
        place.copy_from_slice(stored);
        if self.is_big_endian {
            place.reverse();
        }
        let bits = u64::from_le_bytes(little);
        match (self.kind, self.size) {
            (ScalarKind::Float, 2) => Some(f16::from_bits(bits as u16).to_f64()),
            (ScalarKind::Float, 4) => Some(f64::from(f32::from_bits(bits as u32))),
            (ScalarKind::Float, 8) => Some(f64::from_bits(bits)),
            (ScalarKind::Unsigned, 1 | 2 | 4 | 8) => Some(bits as f64),
            (ScalarKind::Signed, 1 | 2 | 4 | 8) => {
                // Up to the top and back: the arithmetic shift fills in the sign.
                let unused = 64 - 8 * self.size;
                Some((bits.cast_signed() << unused >> unused) as f64)
            }
            _ => None,
        }
    }

    /// How intensities stored so are scaled: the largest value of a byte without a sign is 255.
    pub(super) fn intensity_kind(self) -> IntensityKind {
        match (self.kind, self.size) {
            (ScalarKind::Unsigned, 1) => IntensityKind::Byte,
            _ => IntensityKind::Number,
        }
    }
}

/// Bytes of fields one after another.
pub(super) fn size_of(fields: &[(String, Scalar)]) -> usize {
    fields.iter().map(|(_, scalar)| scalar.size).sum()
}

/// Index of the first field of numbers with one of the names, the first preferred.
pub(super) fn find(fields: &[(String, Scalar)], names: &[&str]) -> Option<usize> {
    names.iter().find_map(|wanted| {
        fields.iter().position(|(name, scalar)| {
            scalar.kind != ScalarKind::Padding && name.eq_ignore_ascii_case(wanted)
        })
    })
}

/// First byte and type of a field.
pub(super) fn place(fields: &[(String, Scalar)], index: usize) -> Option<(usize, Scalar)> {
    let (_, scalar) = fields.get(index)?;
    Some((size_of(fields.get(..index)?), *scalar))
}

/// The point at the start of `bytes`, by the first byte and the type of x, y, z and intensity; 0 for those without.
#[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
pub(super) fn read_point(bytes: &[u8], places: &[Option<(usize, Scalar)>; 4]) -> [f32; 4] {
    places.map(|place| {
        let value = place.and_then(|(first, scalar)| scalar.read(bytes.get(first..)?));
        value.map_or(0.0, |value| value as f32)
    })
}

/// An error if `rest`, the bytes behind the `stated` points of `size` bytes each, holds further points. Zeros, blanks
/// and line ends alone are none: writers fill up pages with them.
pub(super) fn check_end(rest: &[u8], stated: usize, size: usize) -> Result<(), String> {
    let further = rest.len().checked_div(size).unwrap_or(0);
    let mut bytes = rest.iter();
    if further == 0 || bytes.all(|&byte| byte == 0 || byte.is_ascii_whitespace()) {
        return Ok(());
    }
    let found = stated.saturating_add(further);
    Err(format!(
        "{stated} points stated, {found} found: the header is not of this file"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fills_up_a_file_is_no_point() {
        for rest in [&b""[..], b" \r\n\0\0\0\0\0\0", b"\0\0\x01"] {
            assert_eq!(check_end(rest, 7, 4), Ok(()), "{rest:?}");
        }
        let fault = check_end(b"\0\0\0\x01\0\0\0\x01\0", 7, 4).unwrap_err();
        assert!(fault.starts_with("7 points stated, 9 found"), "{fault}");
        assert_eq!(check_end(b"point", 7, 0), Ok(()));
    }

    #[test]
    fn numbers_of_every_type_and_order_are_read() {
        type Case<'a> = (ScalarKind, usize, bool, &'a [u8], Option<f64>);
        let cases: [Case<'_>; 9] = [
            (ScalarKind::Signed, 2, false, &[0xfe, 0xff, 9], Some(-2.0)),
            (ScalarKind::Signed, 2, true, &[0xff, 0xfe], Some(-2.0)),
            (
                ScalarKind::Signed,
                8,
                false,
                &(-7_i64).to_le_bytes(),
                Some(-7.0),
            ),
            (ScalarKind::Unsigned, 1, false, &[0xfe], Some(254.0)),
            (
                ScalarKind::Float,
                4,
                true,
                &1.5_f32.to_be_bytes(),
                Some(1.5),
            ),
            (
                ScalarKind::Float,
                8,
                false,
                &(-1e300_f64).to_le_bytes(),
                Some(-1e300),
            ),
            (ScalarKind::Float, 8, false, &[0; 7], None),
            (ScalarKind::Float, 3, false, &[0; 8], None),
            (ScalarKind::Padding, 4, false, &[0; 8], None),
        ];
        for (kind, size, is_big_endian, bytes, expected) in cases {
            let scalar = Scalar::new(kind, size, is_big_endian);
            assert_eq!(scalar.read(bytes), expected, "{scalar:?}");
        }
    }

    fn number(kind: ScalarKind, bytes: &[u8], is_big_endian: bool) -> f64 {
        Scalar {
            kind,
            size: bytes.len(),
            is_big_endian,
        }
        .read(bytes)
        .unwrap()
    }

    #[test]
    fn numbers_of_every_format_and_order() {
        assert_eq!(number(ScalarKind::Signed, &[0xfe], false), -2.0);
        assert_eq!(number(ScalarKind::Unsigned, &[0xfe], false), 254.0);
        assert_eq!(
            number(ScalarKind::Signed, &(-300i16).to_be_bytes(), true),
            -300.0
        );
        assert_eq!(
            number(ScalarKind::Signed, &(-70_000i32).to_le_bytes(), false),
            -70_000.0
        );
        assert_eq!(
            number(ScalarKind::Signed, &i64::MIN.to_be_bytes(), true),
            i64::MIN as f64
        );
        assert_eq!(
            number(ScalarKind::Unsigned, &u64::MAX.to_le_bytes(), false),
            u64::MAX as f64
        );
        assert_eq!(number(ScalarKind::Float, &1.5f32.to_be_bytes(), true), 1.5);
        assert_eq!(
            number(ScalarKind::Float, &(-0.1f64).to_be_bytes(), true),
            -0.1
        );
    }

    #[test]
    fn halves_are_those_of_ieee() {
        let half = |bits: u16| Scalar::new(ScalarKind::Float, 2, false).read(&bits.to_le_bytes());
        for (bits, expected) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 2f64.powi(-24)),
            (0x3555, 0.333_251_953_125),
        ] {
            assert_eq!(half(bits), Some(expected));
        }
        assert_eq!(half(0xfc00), Some(f64::NEG_INFINITY));
        assert!(half(0x7e00).is_some_and(f64::is_nan));
    }
}
