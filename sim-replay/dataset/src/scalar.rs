//! Numbers of binary point files: type, size and byte order.

/// Type of one stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ScalarKind {
    /// Two's complement, 1, 2, 4 or 8 bytes.
    Signed,
    /// Without a sign, 1, 2, 4 or 8 bytes.
    Unsigned,
    /// IEEE, 4 or 8 bytes.
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
            (ScalarKind::Float, 4) => Some(f64::from(f32::from_bits(bits as u32))),
            (ScalarKind::Float, 8) => Some(f64::from_bits(bits)),
            (ScalarKind::Unsigned, 1 | 2 | 4 | 8) => Some(bits as f64),
            (ScalarKind::Signed, 1 | 2 | 4 | 8) => {
                let unused = 64 - 8 * self.size;
                Some((bits.cast_signed() << unused >> unused) as f64)
            }
            _ => None,
        }
    }

    /// True for a byte without a sign, whose largest value is 255.
    pub(super) fn is_byte(self) -> bool {
        self.kind == ScalarKind::Unsigned && self.size == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_every_type_and_order_are_read() {
        let read = |kind, size, is_big_endian, bytes: &[u8]| {
            Scalar {
                kind,
                size,
                is_big_endian,
            }
            .read(bytes)
        };
        assert_eq!(
            read(ScalarKind::Signed, 2, false, &[0xfe, 0xff, 9]),
            Some(-2.0)
        );
        assert_eq!(read(ScalarKind::Signed, 2, true, &[0xff, 0xfe]), Some(-2.0));
        assert_eq!(
            read(ScalarKind::Signed, 8, false, &(-7_i64).to_le_bytes()),
            Some(-7.0)
        );
        assert_eq!(read(ScalarKind::Unsigned, 1, false, &[0xfe]), Some(254.0));
        assert_eq!(
            read(ScalarKind::Float, 4, true, &1.5_f32.to_be_bytes()),
            Some(1.5)
        );
        assert_eq!(
            read(ScalarKind::Float, 8, false, &(-1e300_f64).to_le_bytes()),
            Some(-1e300)
        );
        assert_eq!(read(ScalarKind::Float, 8, false, &[0; 7]), None);
        assert_eq!(read(ScalarKind::Float, 2, false, &[0; 8]), None);
        assert_eq!(read(ScalarKind::Padding, 4, false, &[0; 8]), None);
    }
}
