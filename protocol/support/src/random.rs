//! Seeded random numbers: streams fixed by this file, so that a seed gives the same bytes on every machine.
//!
//! Two generators, each with one use:
//!
//! - [`SplitMix64`] for simulations: sensors, traffic, weather, the channel, attacks, damaged test inputs. A stream is
//!   cheap to start, so each event has one of its own by [`SplitMix64::derived`] and no draw depends on the number of
//!   draws before it; a run may be divided into ticks, processes and threads.
//! - `ChaCha8Rng` for algorithms that draw in one sequence: training and its augmentation, RANSAC, k-means, noise of
//!   poses, the layout of a generated scene. It can seek to any position of its stream and supports `rand`'s
//!   distributions and shuffles.
//!
//! Results and published data sets depend on both streams: new code follows the rule, and existing code keeps its
//! generator.

use rand::RngCore;

/// SplitMix64 (Steele, Lea and Flood 2014): one addition and one mix per number, and any 64-bit state is a good seed.
///
/// Preferred to a generator of a crate because a scene draws two numbers per ray, and because a new release of a crate
/// must not change the numbers of a seed.
#[derive(Debug, Clone)]
pub struct SplitMix64 {
    state: u64,
}

impl SplitMix64 {
    /// A stream with the state `seed`.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// The stream of one `purpose` under `seed`, for example the noise of one sweep: streams of different labels do not
    /// overlap in practice, and no stream depends on the number of draws of another.
    pub fn derived(seed: u64, purpose: &[u64]) -> Self {
        Self::new(derive_seed(seed, purpose))
    }

    /// Uniform random number in 0..1.
    pub fn unit(&mut self) -> f64 {
        // The upper 53 bits fill the mantissa.
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform random number in `low..high`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Uniform integer in `0..count`; 0 if `count` is 0.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the product's upper half is below `count`"
    )]
    pub fn below(&mut self, count: usize) -> usize {
        // Multiply and shift instead of a remainder: its bias is at most count / 2^64.
        ((u128::from(self.next_u64()) * count as u128) >> 64) as usize
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Normal random number with mean 0 and standard deviation 1.
    pub fn normal(&mut self) -> f64 {
        rand_distr::Distribution::sample(&rand_distr::StandardNormal, self)
    }

    /// Puts `items` in random order.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }
}

impl RngCore for SplitMix64 {
    fn next_u32(&mut self) -> u32 {
        (self.next_u64() >> 32) as u32
    }

    fn next_u64(&mut self) -> u64 {
        // 2^64 divided by the golden ratio, odd: the state takes all 2^64 values.
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.state)
    }

    fn fill_bytes(&mut self, bytes: &mut [u8]) {
        for chunk in bytes.chunks_mut(8) {
            for (byte, random) in chunk.iter_mut().zip(self.next_u64().to_le_bytes()) {
                *byte = random;
            }
        }
    }
}

/// A seed for one purpose under another seed.
pub fn derive_seed(seed: u64, purpose: &[u64]) -> u64 {
    purpose
        .iter()
        .fold(mix(seed ^ 0x5851_f42d_4c95_7f2d), |state, &label| {
            mix(state.wrapping_add(0x9e37_79b9_7f4a_7c15)
                ^ mix(label.wrapping_add(0x1405_7b7e_f767_814f)))
        })
}

/// The seed of one recorded scenario under the seed of a run. It follows from the name: the draws of a scenario do not
/// depend on those before it, and are the same live, in simulation time and offline.
pub fn scenario_seed(seed: u64, scenario: &str) -> u64 {
    let name: Vec<u64> = scenario.bytes().map(u64::from).collect();
    derive_seed(seed, &name)
}

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stream_matches_the_reference() {
        // First outputs of the reference implementation for seed 1234567.
        let mut random = SplitMix64::new(1_234_567);
        assert_eq!(random.next_u64(), 6_457_827_717_110_365_317);
        assert_eq!(random.next_u64(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn derived_seeds_differ_by_every_label() {
        let seeds = [
            derive_seed(1, &[]),
            derive_seed(1, &[0]),
            derive_seed(1, &[0, 0]),
            derive_seed(1, &[1]),
            derive_seed(2, &[0]),
        ];
        for (index, seed) in seeds.iter().enumerate() {
            assert!(!seeds[..index].contains(seed));
        }
    }

    #[test]
    fn each_scenario_has_a_seed_of_its_own_under_that_of_the_run() {
        // Stepped runs and evaluations have drawn from this number: it must stay.
        let seed = scenario_seed(1, "v2vdet_town1_s1000_0000");
        assert_eq!(seed, 7_783_756_778_165_459_306);
        assert_ne!(seed, scenario_seed(1, "v2vdet_town1_s1000_0002"));
        assert_ne!(seed, scenario_seed(2, "v2vdet_town1_s1000_0000"));
    }

    #[test]
    fn unit_numbers_have_the_moments_of_a_uniform_distribution() {
        let mut random = SplitMix64::new(7);
        let draws: Vec<f64> = (0..100_000).map(|_| random.unit()).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance =
            draws.iter().map(|draw| (draw - mean).powi(2)).sum::<f64>() / draws.len() as f64;
        assert!(
            (mean - 0.5).abs() < 0.005 && (variance - 1.0 / 12.0).abs() < 0.002,
            "{mean} {variance}"
        );
    }

    #[test]
    fn below_stays_below() {
        let mut random = SplitMix64::new(3);
        assert!((0..1000).all(|_| random.below(7) < 7));
        assert_eq!(random.below(0), 0);
    }
}
