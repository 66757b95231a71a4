//! Time steps of a sample: late neighbours and earlier maps.

use dataset::Tick;
use fusion::history::MAX_AGE_NANOS;
use rand::Rng;

/// Time steps of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moments {
    /// Time steps of every vehicle, the newest included.
    pub frames: usize,
    /// Largest number of ticks between two time steps; every sample draws its own number.
    pub gap: usize,
    /// Largest delay of neighbours' newest maps relative to the ego's, nanoseconds.
    pub max_delay_nanos: u64,
}

impl Default for Moments {
    /// The current tick only.
    fn default() -> Self {
        Self {
            frames: 1,
            gap: 1,
            max_delay_nanos: 0,
        }
    }
}

impl Moments {
    /// Draws the newest tick that has arrived from a neighbour when the ego is at tick `now`.
    pub(super) fn draw_newest(&self, ticks: &[Tick], now: usize, rng: &mut impl Rng) -> usize {
        let is_young =
            |tick: &&Tick| ticks[now].capture_nanos - tick.capture_nanos <= self.max_delay_nanos;
        // Ticks ascend in time, so those that are young enough are the last ones.
        let arrived = ticks[..=now].iter().rev().take_while(is_young).count();
        now - rng.random_range(0..arrived.max(1))
    }

    /// The ticks of a vehicle whose newest is `newest`, that first, when the ego is at tick `now`.
    pub(super) fn steps(
        &self,
        ticks: &[Tick],
        now: usize,
        newest: usize,
        gap: usize,
    ) -> Vec<usize> {
        // The ego keeps none that is older.
        let is_young =
            |tick: &usize| ticks[now].capture_nanos - ticks[*tick].capture_nanos <= MAX_AGE_NANOS;
        let earlier = (1..self.frames.max(1))
            .map_while(|step| newest.checked_sub(step * gap))
            .take_while(is_young);
        std::iter::once(newest).chain(earlier).collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn ticks(count: u64, period_nanos: u64) -> Vec<Tick> {
        (0..count)
            .map(|tick| Tick {
                stem: tick.to_string(),
                capture_nanos: tick * period_nanos,
            })
            .collect()
    }

    #[test]
    fn steps_go_back_to_the_beginning_or_to_a_second() {
        let moments = Moments {
            frames: 3,
            gap: 2,
            ..Moments::default()
        };
        let tenths = ticks(20, 100_000_000);
        assert_eq!(moments.steps(&tenths, 9, 8, 2), [8, 6, 4]);
        assert_eq!(moments.steps(&tenths, 3, 3, 2), [3, 1]);
        assert_eq!(
            moments.steps(&tenths, 19, 13, 5),
            [13],
            "a second is the limit"
        );
        assert_eq!(moments.steps(&ticks(20, 1_500_000_000), 9, 9, 1), [9]);
        assert_eq!(Moments::default().steps(&tenths, 9, 9, 1), [9]);
    }

    #[test]
    fn delays_are_drawn_up_to_their_limit_and_not_before_the_scene() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let tenths = ticks(20, 100_000_000);
        let moments = Moments {
            max_delay_nanos: 500_000_000,
            ..Moments::default()
        };
        let mut drawn: Vec<usize> = (0..200)
            .map(|_| moments.draw_newest(&tenths, 10, &mut rng))
            .collect();
        drawn.sort_unstable();
        drawn.dedup();
        assert_eq!(drawn, [5, 6, 7, 8, 9, 10]);
        assert!((0..50).all(|_| moments.draw_newest(&tenths, 1, &mut rng) <= 1));
        assert!((0..50).all(|_| Moments::default().draw_newest(&tenths, 10, &mut rng) == 10));
    }
}
