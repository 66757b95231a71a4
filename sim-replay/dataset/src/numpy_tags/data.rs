//! Number formats and base64 data of pickled arrays.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::super::ReadError;
use super::super::yaml::{Field, Value};
use super::{APPLY, args, expect_tag, items};

/// A number format: kind and bytes a number, as in NumPy's names, and its byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Dtype {
    kind: Kind,
    size: usize,
    is_big_endian: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Float,
    Signed,
    /// Booleans are unsigned numbers of one byte.
    Unsigned,
}

/// `dtype('f8', False, True)` with a state whose second item is the byte order.
pub(super) fn read_dtype(field: &Field<'_>) -> Result<Dtype, ReadError> {
    expect_tag(field, "python/object/apply:numpy.dtype")?;
    let [name, ..] = items::<3>(&field.required("args")?)?;
    let (kind, size) = match name.text()? {
        "f2" => (Kind::Float, 2),
        "f4" => (Kind::Float, 4),
        "f8" => (Kind::Float, 8),
        "i1" => (Kind::Signed, 1),
        "i2" => (Kind::Signed, 2),
        "i4" => (Kind::Signed, 4),
        "i8" => (Kind::Signed, 8),
        "b1" | "u1" => (Kind::Unsigned, 1),
        "u2" => (Kind::Unsigned, 2),
        "u4" => (Kind::Unsigned, 4),
        "u8" => (Kind::Unsigned, 8),
        other => {
            return Err(name.error(format!(
                "dtype {other:?}, expected f2 to f8, i1 to i8, u1 to u8 or b1"
            )));
        }
    };
    let state = field.required("state")?;
    expect_tag(&state, "python/tuple")?;
    let order = state
        .items()?
        .into_iter()
        .nth(1)
        .ok_or_else(|| state.error("no byte order"))?;
    match order.text()? {
        // `=` is the order of the machine that wrote it, `|` that of single bytes.
        "<" | "=" | "|" => Ok(Dtype {
            kind,
            size,
            is_big_endian: false,
        }),
        ">" => Ok(Dtype {
            kind,
            size,
            is_big_endian: true,
        }),
        other => Err(order.error(format!(
            "byte order {other:?}, expected \"<\", \">\", \"=\" or \"|\""
        ))),
    }
}

/// Bytes in base64, on their own or as the one argument of `bytearray`.
pub(super) fn binary(field: &Field<'_>) -> Result<Vec<u8>, ReadError> {
    let is_bytearray = field
        .node()
        .tag
        .as_deref()
        .and_then(|tag| tag.strip_prefix(APPLY))
        == Some("builtins.bytearray");
    if is_bytearray && !matches!(field.node().value, Value::Text(_)) {
        let [inner] = items::<1>(&args(field)?)?;
        return base64(&inner);
    }
    base64(field)
}

fn base64(field: &Field<'_>) -> Result<Vec<u8>, ReadError> {
    expect_tag(field, "binary")?;
    // The lines of a block are part of the text.
    let text: String = field.text()?.split_ascii_whitespace().collect();
    STANDARD
        .decode(text)
        .map_err(|error| field.error(format!("no base64: {error}")))
}

/// Exactly `count` numbers.
pub(super) fn numbers(
    field: &Field<'_>,
    dtype: Dtype,
    count: usize,
) -> Result<Vec<f64>, ReadError> {
    let bytes = binary(field)?;
    if count.checked_mul(dtype.size) != Some(bytes.len()) {
        return Err(field.error(format!(
            "{} bytes for {count} numbers of {} bytes",
            bytes.len(),
            dtype.size
        )));
    }
    Ok(bytes
        .chunks_exact(dtype.size)
        .map(|chunk| dtype.number(chunk))
        .collect())
}

impl Dtype {
    /// Decodes `bytes`, whose length is the size, at most 8.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "numbers of two and four bytes fill the lower ones; a size is at most 8"
    )]
    fn number(self, bytes: &[u8]) -> f64 {
        let mut little = [0; 8];
        for (place, byte) in little.iter_mut().zip(bytes) {
            *place = *byte;
        }
        if self.is_big_endian {
            little
                .iter_mut()
                .take(self.size)
                .rev()
                .zip(bytes)
                .for_each(|(place, byte)| *place = *byte);
        }
        let bits = u64::from_le_bytes(little);
        match (self.kind, self.size) {
            (Kind::Float, 2) => half(bits as u16),
            (Kind::Float, 4) => f64::from(f32::from_bits(bits as u32)),
            (Kind::Float, _) => f64::from_bits(bits),
            (Kind::Unsigned, _) => bits as f64,
            (Kind::Signed, size) => {
                let unused = 64 - 8 * size as u32;
                ((bits << unused) as i64 >> unused) as f64
            }
        }
    }
}

/// IEEE 754 binary16.
fn half(bits: u16) -> f64 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 0x1f), f64::from(bits & 0x3ff));
    sign * match exponent {
        0 => fraction * 2f64.powi(-24),
        0x1f if fraction == 0.0 => f64::INFINITY,
        0x1f => f64::NAN,
        _ => (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(kind: Kind, bytes: &[u8], is_big_endian: bool) -> f64 {
        Dtype {
            kind,
            size: bytes.len(),
            is_big_endian,
        }
        .number(bytes)
    }

    #[test]
    fn numbers_of_every_format_and_order() {
        assert_eq!(number(Kind::Signed, &[0xfe], false), -2.0);
        assert_eq!(number(Kind::Unsigned, &[0xfe], false), 254.0);
        assert_eq!(number(Kind::Signed, &(-300i16).to_be_bytes(), true), -300.0);
        assert_eq!(
            number(Kind::Signed, &(-70_000i32).to_le_bytes(), false),
            -70_000.0
        );
        assert_eq!(
            number(Kind::Signed, &i64::MIN.to_be_bytes(), true),
            i64::MIN as f64
        );
        assert_eq!(
            number(Kind::Unsigned, &u64::MAX.to_le_bytes(), false),
            u64::MAX as f64
        );
        assert_eq!(number(Kind::Float, &1.5f32.to_be_bytes(), true), 1.5);
        assert_eq!(number(Kind::Float, &(-0.1f64).to_be_bytes(), true), -0.1);
    }

    #[test]
    fn halves_are_those_of_ieee() {
        for (bits, expected) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 2f64.powi(-24)),
            (0x3555, 0.333_251_953_125),
        ] {
            assert_eq!(half(bits), expected);
        }
        assert_eq!(half(0xfc00), f64::NEG_INFINITY);
        assert!(half(0x7e00).is_nan());
    }
}
