//! Smooth noise over the plane.

use support::random::SplitMix64;

/// Height of the hills at a place, metres; from about -3 to 9, features of some 60 to 150 m.
pub(crate) fn hills_m(x: f64, y: f64, seed: u64) -> f64 {
    let coarse = value_noise(x / 140.0, y / 140.0, seed);
    // Another seed, so that the fine hills do not repeat the coarse ones.
    let fine = value_noise(x / 55.0, y / 55.0, seed ^ 0x5bd1_e995);
    9.0 * coarse + 3.0 * fine - 3.0
}

/// Random values 0..1 at whole places, with smooth passages between them.
fn value_noise(x: f64, y: f64, seed: u64) -> f64 {
    let (column, row) = (x.floor(), y.floor());
    let [u, v] = [x - column, y - row].map(|t| t * t * (3.0 - 2.0 * t));
    let [a, b, c, d] = [(0, 0), (1, 0), (0, 1), (1, 1)]
        .map(|(dx, dy)| hashed(column as i64 + dx, row as i64 + dy, seed));
    let low = a + u * (b - a);
    let high = c + u * (d - c);
    low + v * (high - low)
}

/// A value 0..1 from two whole numbers and a seed.
fn hashed(x: i64, y: i64, seed: u64) -> f64 {
    const STEP: u64 = 0x9e37_79b9_7f4a_7c15;
    let hash =
        seed ^ (x as u64).wrapping_mul(STEP) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    // The generator takes this step before it mixes.
    SplitMix64::new(hash.wrapping_sub(STEP)).unit()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hills_are_smooth_and_differ_with_the_seed() {
        for i in 0..200 {
            let x = f64::from(i) * 3.7 - 300.0;
            let step = (hills_m(x, 10.0, 5) - hills_m(x + 0.1, 10.0, 5)).abs();
            assert!(step < 0.05, "{step} m in 0.1 m at {x}");
            assert!((-3.0..=9.0).contains(&hills_m(x, 10.0, 5)));
        }
        assert!((hills_m(1.0, 2.0, 5) - hills_m(1.0, 2.0, 6)).abs() > 1e-6);
    }
}
