//! Longitudinal driver model: the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000) and speed in bends.

use crate::map::Lane;
use support::random::SplitMix64;

/// Lateral acceleration that drivers accept in bends, metres per second squared.
const SIDEWAYS_MPS2: f64 = 2.2;
/// Lowest speed in a bend, metres per second.
const CRAWL_MPS: f64 = 2.5;
/// Hardest braking, metres per second squared.
const EMERGENCY_MPS2: f64 = 8.0;

/// Parameters of one driver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Driver {
    /// Share of the speed limit driven on a free road.
    pub(crate) pace: f64,
    /// Time gap to the vehicle ahead, seconds.
    headway_s: f64,
    /// Gap when standing, metres.
    jam_gap_m: f64,
    /// Acceleration from standing, metres per second squared.
    acceleration_mps2: f64,
    /// Comfortable deceleration, metres per second squared.
    pub(crate) comfort_mps2: f64,
}

/// An obstacle ahead.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Obstacle {
    /// Free distance from bumper to bumper (or line), metres.
    pub(crate) gap_m: f64,
    /// Its speed away from the vehicle, metres per second.
    pub(crate) speed_mps: f64,
}

impl Driver {
    /// A driver with random parameters.
    pub(crate) fn random(random: &mut SplitMix64) -> Self {
        Self {
            pace: random.between(0.75, 1.1),
            headway_s: random.between(0.9, 1.7),
            jam_gap_m: random.between(1.4, 2.8),
            acceleration_mps2: random.between(1.3, 2.3),
            comfort_mps2: random.between(2.0, 2.8),
        }
    }

    /// Acceleration at `speed_mps` for a desired speed of `wanted_mps`, metres per second squared.
    pub(crate) fn acceleration_mps2(
        &self,
        speed_mps: f64,
        wanted_mps: f64,
        obstacles: &[Obstacle],
    ) -> f64 {
        let wanted = wanted_mps.max(0.1);
        let free = if speed_mps <= wanted {
            self.acceleration_mps2 * (1.0 - (speed_mps / wanted).powi(4))
        } else {
            // The model's own term brakes far too hard before a mere bend.
            -self.comfort_mps2 * (1.0 - wanted / speed_mps).max(0.0).sqrt() * 1.5
        };
        let interactions = obstacles
            .iter()
            .map(|obstacle| self.interaction(speed_mps, obstacle));
        // The strongest interaction counts: several obstacles do not add up.
        let most = interactions.fold(0.0, f64::max);
        (free - self.acceleration_mps2 * most).max(-EMERGENCY_MPS2)
    }

    fn interaction(&self, speed_mps: f64, obstacle: &Obstacle) -> f64 {
        let closing = speed_mps - obstacle.speed_mps;
        let braking = 2.0 * (self.acceleration_mps2 * self.comfort_mps2).sqrt();
        // A leader that pulls away must not reduce the gap below that of standing vehicles.
        let wanted_gap =
            self.jam_gap_m + (speed_mps * self.headway_s + speed_mps * closing / braking).max(0.0);
        // Overlapping vehicles have a gap below zero and must brake too.
        (wanted_gap / obstacle.gap_m.max(0.1)).powi(2)
    }
}

/// The highest speed at each point of a lane's centre line: its limit, or less where it bends, metres per second.
pub(crate) fn bend_speeds_mps(lane: &Lane) -> Vec<f32> {
    // Over 3 m to either side, since the corner between two points of the line is no bend by itself.
    const REACH: usize = 3;
    let points = &lane.centerline;
    (0..points.len())
        .map(|index| {
            let (before, after) = (index.saturating_sub(REACH), index + REACH);
            let [a, b, c] = [before, index, after.min(points.len() - 1)]
                .map(|index| [points[index][0], points[index][1]]);
            let [ab, bc, ac] =
                [[a, b], [b, c], [a, c]].map(|[p, q]| (q[0] - p[0]).hypot(q[1] - p[1]));
            let doubled_area =
                ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
            let product = ab * bc * ac;
            // Curvature of the circle through the three points.
            let curvature = match product > 1e-6 {
                // k = 4 A / (a b c), with A half of the doubled area.
                true => 2.0 * doubled_area / product,
                false => 0.0,
            };
            let bend = (SIDEWAYS_MPS2 / curvature.max(1e-6)).sqrt().max(CRAWL_MPS);
            lane.speed_limit_mps.min(bend) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::LaneId;

    #[test]
    fn a_driver_reaches_the_wanted_speed_and_keeps_a_gap() {
        let driver = Driver::random(&mut SplitMix64::new(1));
        let (mut speed, mut position) = (0.0, 0.0);
        for _ in 0..4000 {
            speed += 0.05 * driver.acceleration_mps2(speed, 12.0, &[]);
        }
        assert!((speed - 12.0).abs() < 0.3, "{speed}");
        for _ in 0..4000 {
            let obstacle = Obstacle {
                gap_m: 400.0 - position,
                speed_mps: 0.0,
            };
            speed = f64::max(
                0.0,
                speed + 0.05 * driver.acceleration_mps2(speed, 12.0, &[obstacle]),
            );
            position += 0.05 * speed;
        }
        assert!(
            speed < 0.05 && position < 399.0 && position > 395.0,
            "{speed} {position}"
        );
    }

    #[test]
    fn bends_are_slow_and_straights_are_not() {
        let circle = (0..60).map(|i| {
            [
                20.0 * (f64::from(i) / 20.0).cos(),
                20.0 * (f64::from(i) / 20.0).sin(),
                0.0,
            ]
        });
        let bend = Lane::new(LaneId(0), circle.collect(), 3.5, 20.0);
        let speeds = bend_speeds_mps(&bend);
        let expected = (SIDEWAYS_MPS2 * 20.0).sqrt() as f32;
        assert!(
            speeds[5..55]
                .iter()
                .all(|speed| (speed - expected).abs() < 0.1),
            "{speeds:?}"
        );
        let straight = Lane::new(
            LaneId(0),
            (0..60).map(|i| [f64::from(i), 0.0, 0.0]).collect(),
            3.5,
            20.0,
        );
        assert!(
            bend_speeds_mps(&straight)
                .iter()
                .all(|&speed| speed == 20.0)
        );
    }
}
