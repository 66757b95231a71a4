//! Normal numbers of NumPy's legacy generator, which reference code seeds at every call: only the same generator gives
//! the same offsets.

/// Words of state of the Mersenne Twister MT19937 (Matsumoto and Nishimura 1998).
const WORDS: usize = 624;
/// Distance of the word that each one is mixed with.
const SHIFT: usize = 397;

/// `numpy.random.RandomState(seed)`, the part that `normal` needs.
pub(super) struct NumpyNormals {
    words: [u32; WORDS],
    next: usize,
    /// Second of the two numbers that the polar method draws at a time.
    second: Option<f64>,
}

impl NumpyNormals {
    /// Seeded with the lower 32 bits of `seed`, as NumPy does with an integer.
    pub(super) fn new(seed: u64) -> Self {
        let mut words = [0; WORDS];
        words[0] = seed as u32;
        for index in 1..WORDS {
            let before = words[index - 1];
            words[index] = 1_812_433_253_u32
                .wrapping_mul(before ^ (before >> 30))
                .wrapping_add(index as u32);
        }
        Self {
            words,
            next: WORDS,
            second: None,
        }
    }

    /// A normal number of mean 0 and deviation 1: Marsaglia's polar method, the second of a pair first.
    pub(super) fn normal(&mut self) -> f64 {
        if let Some(second) = self.second.take() {
            return second;
        }
        loop {
            let (x, y) = (2.0 * self.unit() - 1.0, 2.0 * self.unit() - 1.0);
            let square = x * x + y * y;
            if square < 1.0 && square != 0.0 {
                let factor = (-2.0 * square.ln() / square).sqrt();
                self.second = Some(factor * x);
                return factor * y;
            }
        }
    }

    /// A number in 0..1 of 53 bits.
    fn unit(&mut self) -> f64 {
        // 27 and 26 bits of two words, the high ones first, divided by 2^53.
        let (high, low) = (self.word() >> 5, self.word() >> 6);
        (f64::from(high) * 67_108_864.0 + f64::from(low)) / 9_007_199_254_740_992.0
    }

    fn word(&mut self) -> u32 {
        if self.next == WORDS {
            for index in 0..WORDS {
                // In place, as in the reference: where the index wraps round, the other words are new already.
                let mixed = (self.words[index] & 0x8000_0000)
                    | (self.words[(index + 1) % WORDS] & 0x7fff_ffff);
                let odd = if mixed & 1 == 1 { 0x9908_b0df } else { 0 };
                self.words[index] = self.words[(index + SHIFT) % WORDS] ^ (mixed >> 1) ^ odd;
            }
            self.next = 0;
        }
        let mut word = self.words[self.next];
        self.next += 1;
        // Tempering. The state itself stays as it is.
        word ^= word >> 11;
        word ^= (word << 7) & 0x9d2c_5680;
        word ^= (word << 15) & 0xefc6_0000;
        word ^ (word >> 18)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_numpy() {
        // `numpy.random.seed(20); numpy.random.normal(size=6)`.
        let expected = [
            0.883_893_11,
            0.195_865_02,
            0.357_536_52,
            -2.343_261_91,
            -1.084_832_59,
            0.559_696_29,
        ];
        let mut random = NumpyNormals::new(20);
        for value in expected {
            assert!((random.normal() - value).abs() < 1e-8);
        }
        // `numpy.random.seed(0); numpy.random.normal(size=1000)[-1]`: the state has turned over.
        let mut random = NumpyNormals::new(0);
        let last = (0..1000).map(|_| random.normal()).last().unwrap();
        assert!((last - (-0.358_114_08)).abs() < 1e-8, "{last}");
    }
}
