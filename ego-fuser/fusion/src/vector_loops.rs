//! Loops over plain floats in the form that compilers turn into vector instructions. Callers are compiled for several
//! instruction sets, see `multiversion`; results are the same bits with each.

/// Numbers that are processed side by side.
pub(crate) const LANES: usize = 8;
/// 1.5 times 2 to the power of 23: `f32` of this magnitude are whole numbers.
const WHOLE: f32 = 12_582_912.0;
/// Arguments below this count as this.
const LEAST: f32 = -87.0;

/// `e^x` for `x` up to 80 and within 2 units in the last place, as of Cephes' `expf`: a call of the C library for each
/// number takes ten times as long.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    // Also minus infinity, the score of places without a token: the exponent below stays in range.
    let x = if x < LEAST { LEAST } else { x };
    // At this magnitude the sum is rounded to a whole number, the power of two, in its lowest bits.
    let shifted = x * std::f32::consts::LOG2_E + WHOLE;
    let power = shifted - WHOLE;
    // The logarithm of 2 in two parts, of which the first has few digits.
    let rest = (x - power * 0.693_359_4) + power * 2.121_944_4e-4;
    let series = [
        1.987_569_1e-4,
        1.398_2e-3,
        8.333_452e-3,
        4.166_579_6e-2,
        1.666_666_5e-1,
        0.5,
        1.0,
        1.0,
    ];
    let mantissa = series
        .into_iter()
        .fold(0.0, |sum, factor| sum * rest + factor);
    // Times 2^power, by an addition to the bits of the exponent.
    f32::from_bits(mantissa.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// Turns `scores`, a multiple of [`LANES`], into exponentials of their distances from the highest; returns the sum.
#[inline(always)]
pub(crate) fn exponentials(scores: &mut [f32]) -> f32 {
    let mut most = [f32::NEG_INFINITY; LANES];
    for scores in scores.chunks_exact(LANES) {
        for (most, score) in most.iter_mut().zip(scores) {
            *most = if *most < *score { *score } else { *most };
        }
    }
    let most = most.into_iter().fold(f32::NEG_INFINITY, f32::max);
    let mut sums = [0.0; LANES];
    for scores in scores.chunks_exact_mut(LANES) {
        for (sum, score) in sums.iter_mut().zip(scores) {
            *score = exp(*score - most);
            *sum += *score;
        }
    }
    sums.iter().sum()
}

/// Adds the products of two rows of equal length to sums side by side.
#[inline(always)]
pub(crate) fn add_products(sums: &mut [f32; LANES], a: &[f32], b: &[f32]) {
    let (a_chunks, b_chunks) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = a_chunks
        .remainder()
        .iter()
        .zip(b_chunks.remainder())
        .zip(sums.iter_mut());
    rest.for_each(|((a, b), sum)| *sum += a * b);
    for (a, b) in a_chunks.zip(b_chunks) {
        sums.iter_mut()
            .zip(a)
            .zip(b)
            .for_each(|((sum, a), b)| *sum += a * b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponentials_are_those_of_the_standard_library() {
        for step in -8_600..8_000 {
            let x = step as f32 * 0.01;
            let (found, expected) = (f64::from(exp(x)), f64::from(x).exp());
            assert!((found / expected - 1.0).abs() < 3e-7, "{x}: {found}");
        }
        assert!(exp(f32::NEG_INFINITY) < 1e-37 && exp(f32::NAN).is_nan());
        let mut scores = [1.0, -2.0, 3.0, f32::NEG_INFINITY, 0.0, 0.5, 2.0, 3.0];
        let sum = exponentials(&mut scores);
        assert!((sum - scores.iter().sum::<f32>()).abs() < 1e-6 && scores[2] == 1.0);
    }
}
