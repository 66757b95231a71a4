//! A closed motorway line in the shape of an eight, which passes over itself where it crosses.

use std::f64::consts::PI;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::convex::range;
use super::super::curve::Pose2;

/// Samples of the length along the line.
const SAMPLES: usize = 4096;
/// Clear rise of the upper branch over the lower: headroom, slab and some reserve, metres.
const RISE_M: [f64; 2] = [6.6, 7.6];

/// The middle between the two carriageways, by length along it.
pub(super) struct Ring {
    half_m: [f64; 2],
    lean: [f64; 2],
    waves: [[f64; 2]; 4],
    /// Length at the start of each sample of the parameter, and in all.
    lengths_m: Vec<f64>,
    bumps: Vec<Bump>,
}

/// A smooth rise along the line.
#[derive(Debug, Clone, Copy)]
struct Bump {
    middle_m: f64,
    height_m: f64,
    /// Half of the level stretch: the distance at which the rise begins.
    plateau_m: f64,
    reach_m: f64,
}

impl Ring {
    /// A line of some 2.8 km: its right-hand lobe reaches to about x = 500 m.
    pub(super) fn random(rng: &mut ChaCha8Rng) -> Self {
        let half_m = [480.0..540.0, 235.0..270.0].map(|range| rng.random_range(range));
        let lean = [rng.random_range(-0.07..0.07), rng.random_range(-0.09..0.09)];
        let waves = [(); 4].map(|()| [rng.random_range(0.0..9.0), rng.random_range(0.0..2.0 * PI)]);
        let mut ring = Self {
            half_m,
            lean,
            waves,
            lengths_m: vec![0.0],
            bumps: Vec::new(),
        };
        let mut length = 0.0;
        for sample in 0..SAMPLES {
            let [from, to] = [sample, sample + 1]
                .map(|sample| ring.point(2.0 * PI * sample as f64 / SAMPLES as f64));
            length += (to[0] - from[0]).hypot(to[1] - from[1]);
            ring.lengths_m.push(length);
        }
        let upper = ring.crossing()[usize::from(rng.random_bool(0.5))];
        let bumps = [
            (upper, 45.0, 240.0..300.0),
            (ring.apex_m(), 25.0, 290.0..340.0),
        ];
        let bumps = bumps.map(|(middle_m, plateau_m, reach_m)| Bump {
            middle_m,
            height_m: rng.random_range(RISE_M[0]..RISE_M[1]),
            plateau_m,
            reach_m: rng.random_range(reach_m),
        });
        ring.bumps = bumps.into();
        ring
    }

    pub(super) fn length_m(&self) -> f64 {
        self.lengths_m[SAMPLES]
    }

    /// Length at the far end of the right-hand lobe.
    pub(super) fn apex_m(&self) -> f64 {
        self.lengths_m[SAMPLES / 4]
    }

    /// Length at the far end of the left-hand lobe.
    pub(super) fn far_apex_m(&self) -> f64 {
        self.lengths_m[SAMPLES * 3 / 4]
    }

    /// Place and heading at a length, which may lie beyond one round.
    pub(super) fn pose(&self, s_m: f64) -> Pose2 {
        let s = s_m.rem_euclid(self.length_m());
        let after = self.lengths_m.partition_point(|&length| length <= s);
        let after = after.clamp(1, SAMPLES);
        let (low, high) = (self.lengths_m[after - 1], self.lengths_m[after]);
        let t = 2.0 * PI * ((after - 1) as f64 + (s - low) / (high - low)) / SAMPLES as f64;
        let [x, y] = self.point(t);
        let (before, behind) = (self.point(t - 1e-4), self.point(t + 1e-4));
        Pose2::new(x, y, (behind[1] - before[1]).atan2(behind[0] - before[0]))
    }

    /// Height at a length, metres.
    pub(super) fn height_m(&self, s_m: f64) -> f64 {
        let total = self.length_m();
        let heights = self.bumps.iter().map(|bump| {
            // The shorter way round the closed line, with a sign.
            let away = (s_m - bump.middle_m + total / 2.0).rem_euclid(total) - total / 2.0;
            let share =
                ((bump.reach_m - away.abs()) / (bump.reach_m - bump.plateau_m)).clamp(0.0, 1.0);
            bump.height_m * share * share * (3.0 - 2.0 * share)
        });
        heights.fold(0.0, f64::max)
    }

    /// Slope at a length.
    pub(super) fn slope(&self, s_m: f64) -> f64 {
        (self.height_m(s_m + 0.5) - self.height_m(s_m - 0.5)) / 1.0
    }

    /// Lowest and highest y inside the right-hand lobe at `x`, on the line itself.
    pub(super) fn lobe_m(&self, x: f64) -> [f64; 2] {
        let samples =
            (1..SAMPLES / 2).map(|sample| self.point(2.0 * PI * sample as f64 / SAMPLES as f64));
        let near = samples.filter(|point| (point[0] - x).abs() < 4.0);
        range(near.map(|point| point[1]))
    }

    /// The two lengths at which the line crosses itself.
    fn crossing(&self) -> [f64; 2] {
        // The line crosses itself near the parameters 0 and pi.
        let window = SAMPLES / 16;
        let mut best = (f64::INFINITY, [0, 0]);
        for a in (0..window).chain(SAMPLES - window..SAMPLES).step_by(2) {
            let p = self.point(2.0 * PI * a as f64 / SAMPLES as f64);
            for b in (SAMPLES / 2 - window..SAMPLES / 2 + window).step_by(2) {
                let q = self.point(2.0 * PI * b as f64 / SAMPLES as f64);
                let distance = (p[0] - q[0]).hypot(p[1] - q[1]);
                if distance < best.0 {
                    best = (distance, [a, b]);
                }
            }
        }
        best.1.map(|sample| self.lengths_m[sample])
    }

    /// A leaning figure of eight with some waves. At a quarter of the parameter it heads down the right-hand end.
    fn point(&self, t: f64) -> [f64; 2] {
        let [a, b] = [0, 1].map(|axis| self.half_m[axis] * (1.0 + self.lean[axis] * t.sin()));
        let frequencies = [2.0, 2.0, 3.0, 3.0];
        let [x2, y2, x3, y3]: [f64; 4] = std::array::from_fn(|wave| {
            let [height, phase] = self.waves[wave];
            height * (frequencies[wave] * t + phase).sin()
        });
        [a * t.sin() + x2 + x3, b * (2.0 * t).sin() + y2 + y3]
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use rand::SeedableRng;

    use super::super::super::lane::wrap_angle;
    use super::*;

    #[test]
    fn branches_cross_steeply_and_one_passes_above() {
        for seed in 0..40 {
            let ring = Ring::random(&mut ChaCha8Rng::seed_from_u64(seed));
            let [a, b] = ring.crossing();
            assert!(ring.pose(a).distance_m(&ring.pose(b)) < 3.0, "{seed}");
            let angle = wrap_angle(ring.pose(a).heading_rad - ring.pose(b).heading_rad).abs();
            assert!((angle - FRAC_PI_2).abs() < 0.6, "{seed}: {angle}");
            assert!((ring.height_m(a) - ring.height_m(b)).abs() > 6.0, "{seed}");
            assert!(
                (2300.0..3400.0).contains(&ring.length_m()),
                "{seed}: {}",
                ring.length_m()
            );
            // The right-hand end leads down, as the interchange expects.
            assert!(
                (ring.pose(ring.apex_m()).heading_rad + FRAC_PI_2).abs() < 0.3,
                "{seed}"
            );
        }
    }

    #[test]
    fn length_is_length() {
        let ring = Ring::random(&mut ChaCha8Rng::seed_from_u64(7));
        for s in [0.0, 500.0, 1300.0, 2400.0] {
            let (a, b) = (ring.pose(s), ring.pose(s + 1.0));
            assert!((a.distance_m(&b) - 1.0).abs() < 1e-2);
            let along = (b.y - a.y).atan2(b.x - a.x);
            assert!(wrap_angle(along - ring.pose(s + 0.5).heading_rad).abs() < 1e-3);
        }
    }
}
