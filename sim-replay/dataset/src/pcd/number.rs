//! Decimal numbers at the start of a text, as `f32`, bit by bit as the standard library parses them.
//!
//! Nearly all numbers of sweeps have a mantissa below 2^53 and a small exponent. Both are exact as `f64` then, so that
//! one multiplication or division gives the nearest `f64`. Rounding that to `f32` is right unless it lies exactly
//! halfway between two; these numbers, and all unusual ones, are left to the standard library.

/// Powers of ten that are exact as `f64`.
const EXACT_POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16,
    1e17, 1e18, 1e19, 1e20, 1e21, 1e22,
];
/// Powers of ten by the number of digits in a word.
const POWERS: [u64; 9] = [
    1,
    10,
    100,
    1_000,
    10_000,
    100_000,
    1_000_000,
    10_000_000,
    100_000_000,
];
/// Largest number of digits that always fits `u64`.
const MOST_DIGITS: usize = 19;
/// Bits of an `f64` beyond the precision of an `f32`.
const LOST_BITS: u64 = (1 << 29) - 1;
/// Value of these bits halfway between two `f32`.
const MIDDLE: u64 = 1 << 28;

/// True if a byte ends a token: whitespace and control characters.
pub(super) fn is_separator(byte: u8) -> bool {
    byte <= b' '
}

/// The number of a token at the start of `text` and the token's length, if the number is an ordinary one.
#[inline]
pub(super) fn ordinary(text: &[u8]) -> Option<(f32, usize)> {
    let is_negative = text.first() == Some(&b'-');
    let begin = usize::from(is_negative);
    let mut mantissa = Digits {
        value: 0,
        at: begin,
    };
    mantissa.read(text);
    let mut digits = mantissa.at - begin;
    let mut exponent = 0;
    if text.get(mantissa.at) == Some(&b'.') {
        mantissa.at += 1;
        let fraction_at = mantissa.at;
        mantissa.read(text);
        let fraction = mantissa.at - fraction_at;
        digits += fraction;
        exponent = -i32::try_from(fraction).ok()?;
    }
    // More digits have overflowed the mantissa.
    if digits == 0 || digits > MOST_DIGITS {
        return None;
    }
    let mut at = mantissa.at;
    if let Some(b'e' | b'E') = text.get(at) {
        let (stated, end) = exponent_of(text, at + 1)?;
        exponent += stated;
        at = end;
    }
    if text.get(at).is_some_and(|&byte| !is_separator(byte)) {
        return None;
    }
    Some((exact(is_negative, mantissa.value, exponent)?, at))
}

/// The value if `f64` determines it exactly.
#[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
fn exact(is_negative: bool, mantissa: u64, exponent: i32) -> Option<f32> {
    if mantissa >= 1 << 53 {
        return None;
    }
    let power = *EXACT_POWERS.get(exponent.unsigned_abs() as usize)?;
    let value = if exponent < 0 {
        mantissa as f64 / power
    } else {
        mantissa as f64 * power
    };
    if value.to_bits() & LOST_BITS == MIDDLE {
        return None;
    }
    let value = if is_negative { -value } else { value };
    Some(value as f32)
}

/// The exponent from `at` on and its end.
fn exponent_of(text: &[u8], at: usize) -> Option<(i32, usize)> {
    let sign = text.get(at).filter(|byte| matches!(byte, b'-' | b'+'));
    let mut digits = Digits {
        value: 0,
        at: at + usize::from(sign.is_some()),
    };
    let from = digits.at;
    digits.read(text);
    if !(1..=3).contains(&(digits.at - from)) {
        return None;
    }
    let value = i32::try_from(digits.value).ok()?;
    Some((if sign == Some(&b'-') { -value } else { value }, digits.at))
}

/// Digits as a number, and their end. More digits than fit overflow; their count shows it.
struct Digits {
    value: u64,
    at: usize,
}

impl Digits {
    #[inline]
    fn read(&mut self, text: &[u8]) {
        while let Some(bytes) = text.get(self.at..).and_then(|rest| rest.first_chunk()) {
            let (value, count) = leading_digits(*bytes);
            let Some(power) = POWERS.get(count) else {
                return;
            };
            self.value = self.value.wrapping_mul(*power).wrapping_add(value);
            self.at += count;
            if count < 8 {
                return;
            }
        }
        // Fewer than eight bytes are left of the text.
        while let Some(digit) = text
            .get(self.at)
            .map(|byte| byte.wrapping_sub(b'0'))
            .filter(|&digit| digit < 10)
        {
            self.value = self.value.wrapping_mul(10).wrapping_add(u64::from(digit));
            self.at += 1;
        }
    }
}

/// The number that the digits at the start make, and their count: neighbours are joined to numbers of two, four and
/// eight digits within one word.
#[inline]
fn leading_digits(bytes: [u8; 8]) -> (u64, usize) {
    const TOPS: u64 = 0x8080_8080_8080_8080;
    // Digits become 0 to 9; the top bit of every other byte is set, at least in the first of them.
    let word = u64::from_le_bytes(bytes) ^ 0x3030_3030_3030_3030;
    let others = (word | word.wrapping_add(0x7676_7676_7676_7676)) & TOPS;
    let bits = (others.trailing_zeros() / 8) * 8;
    // Leading zeros take the place of what follows. In two steps: without any digit all 64 bits are moved out.
    let ones = (word << ((64 - bits) / 2)) << ((64 - bits) / 2);
    // The first digit is in the lowest byte: it weighs ten times its neighbour.
    let twos = (ones.wrapping_mul(10) + (ones >> 8)) & 0x00ff_00ff_00ff_00ff;
    let fours = (twos * 100 + (twos >> 16)) & 0x0000_ffff_0000_ffff;
    (
        (fours.wrapping_mul(10_000) + (fours >> 32)) & 0xffff_ffff,
        (bits / 8) as usize,
    )
}

/// The number of a token that is not ordinary: more digits, large exponents, subnormal, infinite or NaN, in the
/// spellings of C libraries too (`-nan`, `nan(ind)`, `1.#QNAN`).
pub(super) fn unusual(token: &[u8]) -> Option<f32> {
    let text = std::str::from_utf8(token).ok()?;
    if let Ok(number) = text.parse() {
        return Some(number);
    }
    let text = text.trim_start_matches(['-', '+']).to_ascii_lowercase();
    let mut nans = ["nan(", "1.#qnan", "1.#snan", "1.#ind"].iter();
    match nans.any(|nan| text.starts_with(nan)) {
        true => Some(f32::NAN),
        false => text.starts_with("1.#inf").then_some(f32::INFINITY),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Compares with the standard library, if the fast path accepts the token.
    fn check(token: &str) {
        for behind in ["", " 7", "\n", "\r\n", "\t"] {
            if let Some((number, len)) = ordinary(format!("{token}{behind}").as_bytes()) {
                assert_eq!(len, token.len(), "{token}");
                assert_eq!(
                    number.to_bits(),
                    token.parse::<f32>().unwrap().to_bits(),
                    "{token}"
                );
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4096))]

        #[test]
        fn every_float_in_every_spelling_is_as_the_standard_library_reads_it(number in any::<f32>(), digits in 0..18usize) {
            check(&format!("{number}"));
            check(&format!("{number:e}"));
            check(&format!("{number:.digits$}"));
            check(&format!("{number:.digits$e}"));
            let plain = number.abs() % 200.0;
            check(&format!("{plain:.digits$}"));
        }

        #[test]
        fn middles_of_two_floats_are_rounded_once(bits in any::<u32>(), beyond in -3..=3i64) {
            let number = f32::from_bits(bits & 0x7fff_ffff);
            let middle = (f64::from(number) + f64::from(f32::from_bits((bits & 0x7fff_ffff).wrapping_add(1)))) / 2.0;
            let near = f64::from_bits(middle.to_bits().wrapping_add_signed(beyond));
            check(&format!("{near}"));
            check(&format!("{near:.16e}"));
            check(&format!("{near:.9e}"));
        }

        #[test]
        fn any_text_of_these_characters_is_read_alike(token in "[-+0-9.eE]{1,24}") {
            if let Some((number, len)) = ordinary(token.as_bytes()) {
                prop_assert_eq!(len, token.len());
                prop_assert_eq!(Ok(number.to_bits()), token.parse().map(f32::to_bits));
            }
        }

        #[test]
        fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
            let _ = (ordinary(&bytes), unusual(&bytes));
        }
    }

    #[test]
    fn the_numbers_of_sweeps_are_ordinary() {
        for token in [
            "-68.34235382",
            "0",
            "-0",
            "-1.954882282e-05",
            "0.5",
            "5.",
            ".5",
            "1e-22",
            "39719",
            "1.5e+3",
        ] {
            assert!(ordinary(token.as_bytes()).is_some(), "{token}");
            check(token);
        }
        for token in [
            "",
            "-",
            ".",
            "1.781608625e-38",
            "1e",
            "1e+",
            "+1",
            "nan",
            "1.0.0",
            "0x10",
            "1_0",
        ] {
            assert!(ordinary(token.as_bytes()).is_none(), "{token}");
        }
    }

    #[test]
    fn c_libraries_have_many_spellings_of_nan() {
        for nan in [
            "nan",
            "-nan",
            "NaN",
            "nan(ind)",
            "-nan(0x8000)",
            "1.#QNAN",
            "-1.#IND",
            "1.#QNAN0",
        ] {
            assert!(unusual(nan.as_bytes()).unwrap().is_nan(), "{nan}");
        }
        for infinite in ["inf", "-inf", "Infinity", "1.#INF"] {
            assert!(
                unusual(infinite.as_bytes()).unwrap().is_infinite(),
                "{infinite}"
            );
        }
        assert_eq!(
            unusual(b"1.781608625e-38").unwrap().to_bits(),
            "1.781608625e-38".parse::<f32>().unwrap().to_bits()
        );
        assert!(unusual(b"nano").is_none() && unusual(b"1.#").is_none());
    }
}
