//! The large part of a message: raw little-endian tensor bytes.

use std::mem;

use crc32fast::Hasher;

use crate::checks::{check_each, check_limit};
use crate::{Result, WireError};

// Bodies are cast, not converted.
#[cfg(target_endian = "big")]
compile_error!(
    "message bodies are little-endian in memory; a big-endian target would need a converting copy"
);

/// Bytes copied and checked at a time: a block stays in the first-level cache for every pass over it. Whole values of
/// every kind.
const BLOCK_BYTES: usize = 8 << 10;

/// The body of one message, owned, in the type of its values.
///
/// As bytes (`AsRef<[u8]>`) it is transmitted without a copy, for example through `bytes::Bytes::from_owner`.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Body {
    /// No body.
    #[default]
    Empty,
    /// Bytes of a codec.
    Bytes(Vec<u8>),
    /// A tensor.
    Floats(Vec<f32>),
    /// Points: x, y, z in metres and one more value.
    Points(Vec<[f32; 4]>),
}

impl Body {
    /// The body's bytes as they are on the wire.
    pub fn as_bytes(&self) -> &[u8] {
        match self {
            Self::Empty => &[],
            Self::Bytes(bytes) => bytes,
            Self::Floats(values) => bytemuck::cast_slice(values),
            Self::Points(points) => bytemuck::cast_slice(points),
        }
    }

    /// Number of bytes.
    pub fn len(&self) -> usize {
        self.as_bytes().len()
    }

    /// True if the body has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl AsRef<[u8]> for Body {
    fn as_ref(&self) -> &[u8] {
        self.as_bytes()
    }
}

/// Shape of the body that the metadata require, known before the body is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BodyShape {
    /// No body.
    Empty,
    /// Between `min` and `max` bytes.
    Bytes {
        /// Least bytes.
        min: u64,
        /// Most bytes.
        max: u64,
    },
    /// This many `f32`.
    Floats(u64),
    /// This many points.
    Points(u64),
}

impl BodyShape {
    /// Checks a length in bytes against the shape.
    pub(crate) fn check(self, body_len: u64) -> Result<()> {
        let (min, max) = self.bounds();
        if (min..=max).contains(&body_len) {
            return Ok(());
        }
        let expected = if body_len < min { min } else { max };
        Err(WireError::shape("body bytes", expected, body_len))
    }

    /// Least and greatest length in bytes.
    pub(crate) fn bounds(self) -> (u64, u64) {
        match self {
            Self::Empty => (0, 0),
            Self::Bytes { min, max } => (min, max),
            Self::Floats(count) => exactly(count, 4),
            Self::Points(count) => exactly(count, 16),
        }
    }
}

/// A count that overflows matches no length.
fn exactly(count: u64, size: u64) -> (u64, u64) {
    count
        .checked_mul(size)
        .map_or((u64::MAX, 0), |bytes| (bytes, bytes))
}

/// Reads a payload that consists of many pieces, front to back, and updates the checksum.
pub(crate) struct PayloadReader<'a> {
    pieces: std::vec::IntoIter<&'a [u8]>,
    piece: &'a [u8],
    crc: Hasher,
}

impl<'a> PayloadReader<'a> {
    /// Begins after the first `skip` bytes.
    pub(crate) fn new(pieces: Vec<&'a [u8]>, skip: usize) -> Self {
        let mut reader = Self {
            pieces: pieces.into_iter(),
            piece: &[],
            crc: Hasher::new(),
        };
        reader.read_bytes(skip);
        // What was skipped is not part of the checksum.
        reader.crc = Hasher::new();
        reader
    }

    /// The next contiguous bytes, at most `max`, which the checksum covers; `None` at the end.
    fn next_run(&mut self, max: usize) -> Option<&'a [u8]> {
        while self.piece.is_empty() {
            self.piece = self.pieces.next()?;
        }
        let (run, rest) = self.piece.split_at(max.min(self.piece.len()));
        self.piece = rest;
        self.crc.update(run);
        Some(run)
    }

    /// The next `len` bytes; the caller has checked that they are there.
    pub(crate) fn read_bytes(&mut self, len: usize) -> Vec<u8> {
        let mut out = Vec::with_capacity(len);
        while out.len() < len
            && let Some(run) = self.next_run(BLOCK_BYTES.min(len - out.len()))
        {
            out.extend_from_slice(run);
        }
        out
    }

    /// The body, `len` bytes that the caller has checked to be there, in the given `shape`, and true if all its values
    /// are finite and bounded.
    ///
    /// # Errors
    /// [`WireError::Shape`] when the length does not match the shape.
    pub(crate) fn read_body(
        &mut self,
        len: u64,
        shape: BodyShape,
        max_abs: f32,
    ) -> Result<(Body, bool)> {
        shape.check(len)?;
        check_limit("body bytes", len, usize::MAX as u64)?;
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        Ok(match shape {
            BodyShape::Empty => (Body::Empty, true),
            BodyShape::Bytes { .. } => (Body::Bytes(self.read_bytes(len)), true),
            BodyShape::Floats(_) => {
                let (values, valid) = self.read_values::<1>(len, max_abs);
                (Body::Floats(values.into_flattened()), valid)
            }
            BodyShape::Points(_) => {
                let (points, valid) = self.read_values(len, max_abs);
                (Body::Points(points), valid)
            }
        })
    }

    /// `len` bytes as values of `N` numbers: the only copy from the network's pieces into aligned memory, and true if
    /// every number is finite and bounded.
    ///
    /// Works block by block, so that memory of another core is read once: the second pass over a block, which checks
    /// and copies in one step, finds it in the first-level cache. Only a value that spans two pieces is copied through
    /// the stack.
    fn read_values<const N: usize>(&mut self, len: usize, max_abs: f32) -> (Vec<[f32; N]>, bool) {
        let value_bytes = size_of::<[f32; N]>();
        let headroom = headroom(max_abs);
        let mut values = Vec::with_capacity(len / value_bytes);
        let mut excess = 0;
        let mut left = len;
        while left > 0 {
            let mut across = [[[0; 4]; N]];
            // Whole values within the piece. Zero: the next value spans two pieces, or the piece is used up.
            let whole = self.piece.len().min(left).min(BLOCK_BYTES) / value_bytes * value_bytes;
            let block = if whole > 0
                && let Some(run) = self.next_run(whole)
            {
                run.as_chunks().0.as_chunks().0
            } else if (self.fill(across.as_flattened_mut().as_flattened_mut())).is_some() {
                &across
            } else {
                break;
            };
            left -= size_of_val(block);
            values.extend(block.iter().map(|value: &[[u8; 4]; N]| {
                value.map(|bytes| {
                    let number = f32::from_le_bytes(bytes);
                    // The sign bit collects the result of all values without a branch.
                    excess |= excess_over(headroom, number);
                    number
                })
            }));
        }
        (values, excess >= 0)
    }

    /// Fills `bytes`; `None` when the pieces end before.
    fn fill(&mut self, bytes: &mut [u8]) -> Option<()> {
        let mut left = bytes;
        while !left.is_empty() {
            let run = self.next_run(left.len())?;
            let (filled, rest) = left.split_at_mut_checked(run.len())?;
            filled.copy_from_slice(run);
            left = rest;
        }
        Some(())
    }

    /// The checksum over all bytes of the payload, including those not yet read.
    pub(crate) fn finish(&mut self) -> u32 {
        // After an error in the metadata the body is unread, but the checksum covers it too.
        while self.next_run(usize::MAX).is_some() {}
        mem::take(&mut self.crc).finalize()
    }
}

/// Reports the first value of a tensor that is not finite or exceeds `max_abs`.
pub(crate) fn check_body(body: &Body, max_abs: f32) -> Result<()> {
    match body {
        Body::Floats(values) => check_values("feature", values, max_abs),
        Body::Points(points) => check_values("point value", points.as_flattened(), max_abs),
        Body::Empty | Body::Bytes(_) => Ok(()),
    }
}

/// Distance of the bits of `max_abs` from the largest integer.
#[inline]
fn headroom(max_abs: f32) -> i32 {
    i32::MAX - max_abs.abs().to_bits() as i32
}

/// Negative if `number` is NaN, infinite or larger in absolute value than the number from which `headroom` was
/// computed.
///
/// Without their sign, bit patterns have the order of the numbers, and those of infinity and NaN are the largest: one
/// integer addition, which overflows into the sign, detects all three.
#[inline]
fn excess_over(headroom: i32, number: f32) -> i32 {
    (number.abs().to_bits() as i32).wrapping_add(headroom)
}

/// Reports the first value that is not finite or exceeds `max_abs` in absolute value.
pub(crate) fn check_values(what: &'static str, values: &[f32], max_abs: f32) -> Result<()> {
    let headroom = headroom(max_abs);
    let excess = values
        .iter()
        .fold(0, |excess, value| excess | excess_over(headroom, *value));
    // Searched only if there is one: the search does not vectorise.
    if excess >= 0 {
        return Ok(());
    }
    check_each(what, values, [-max_abs, max_abs], |value| {
        excess_over(headroom, value) >= 0
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(bytes: &[u8], size: usize) -> PayloadReader<'_> {
        PayloadReader::new(bytes.chunks(size).collect(), 0)
    }

    #[test]
    fn pieces_of_any_size_give_the_same_values() {
        let values: Vec<f32> = (0..10_000u16).map(f32::from).collect();
        let body = Body::Floats(values);
        let bytes = body.as_bytes().to_vec();
        for size in [1, 2, 3, 5, 7, 16, 4095, 16 << 10, 65_535, 1 << 20] {
            let mut reader = split(&bytes, size);
            let (read, valid) = reader
                .read_body(40_000, BodyShape::Floats(10_000), 1e6)
                .unwrap();
            assert!(valid && read == body, "pieces of {size}");
            assert_eq!(reader.finish(), crc32fast::hash(&bytes));
            let (read, _) = split(&bytes, size)
                .read_body(40_000, BodyShape::Points(2_500), 1e6)
                .unwrap();
            assert_eq!(read.as_bytes(), bytes);
        }
    }

    #[test]
    fn a_length_that_does_not_match_the_shape_is_refused() {
        for (shape, len) in [
            (BodyShape::Empty, 1),
            (BodyShape::Floats(2), 7),
            (BodyShape::Floats(1 << 62), 0),
            (BodyShape::Points(1), 15),
            (BodyShape::Bytes { min: 2, max: 3 }, 4),
        ] {
            assert!(matches!(
                split(&[0; 64], 64).read_body(len, shape, 1.0),
                Err(WireError::Shape { .. })
            ));
        }
    }

    #[test]
    fn values_out_of_bounds_are_named() {
        for bad in [
            f32::NAN,
            -f32::NAN,
            f32::INFINITY,
            f32::NEG_INFINITY,
            1e30,
            -1.1e6,
        ] {
            let values = [0.0, -0.0, 1e6, -1e6, f32::MIN_POSITIVE / 2.0, bad];
            assert_eq!(check_values("feature", &values[..5], 1e6), Ok(()));
            let error = check_values("feature", &values, 1e6).unwrap_err();
            assert!(
                matches!(error, WireError::Value { index: 5, .. }),
                "{error}"
            );
        }
    }
}
