//! GNSS and IMU of an agent, and the filter that estimates its pose from them.

use super::raycast::{Placement, wrapped};
use support::random::SplitMix64;

/// Deviation of GNSS latitude and longitude, degrees (OpenCDA's set-up of the paper's recordings).
const LATITUDE_DEG: f64 = 1e-6;
/// Deviation of GNSS altitude, metres.
const ALTITUDE_M: f64 = 0.001;
/// Deviation of the IMU's heading, degrees.
const HEADING_DEG: f64 = 0.1;
/// Deviation of the measured speed, metres per second.
const SPEED_MPS: f64 = 0.2;
/// Metres per degree of latitude on CARLA's spherical Earth.
const METRES_PER_DEG: f64 = 6_378_137.0 * std::f64::consts::PI / 180.0;

/// Measurements of the receivers at one capture time; right-handed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Fix {
    /// GNSS position in the map, metres.
    pub(crate) gnss_m: [f64; 3],
    /// Heading of the IMU, radians.
    pub(crate) heading_rad: f64,
    /// Speed, metres per second.
    pub(crate) speed_mps: f64,
    /// Turn rate, radians per second.
    pub(crate) yaw_rate_radps: f64,
    /// The filter's pose of the vehicle's origin: no pitch, as in OpenCDA.
    pub(crate) estimate: Placement,
}

impl Fix {
    /// GNSS latitude and longitude in degrees (the map's origin is at 0, 0; north is +y) and altitude in metres.
    pub(crate) fn geodetic(&self) -> [f64; 3] {
        [self.gnss_m[1] / METRES_PER_DEG, self.gnss_m[0] / METRES_PER_DEG, self.gnss_m[2]]
    }
}

/// A Kalman filter over the planar position, driven by IMU heading and speed, corrected by GNSS.
#[derive(Debug)]
pub(crate) struct Positioning {
    random: SplitMix64,
    state: Option<([f64; 2], f64)>,
    last_yaw_rad: f64,
}

impl Positioning {
    pub(crate) fn new(seed: u64) -> Self {
        Self { random: SplitMix64::new(seed), state: None, last_yaw_rad: 0.0 }
    }

    /// The next fix of a vehicle, `elapsed_s` after the last one.
    pub(crate) fn fix(&mut self, truth: &Placement, speed_mps: f64, elapsed_s: f64) -> Fix {
        let planar_m = LATITUDE_DEG * METRES_PER_DEG;
        let deviations = [planar_m, planar_m, ALTITUDE_M];
        let gnss_m = std::array::from_fn(|axis| truth.position_m[axis] + deviations[axis] * self.random.normal());
        let heading_rad = wrapped(truth.yaw_rad + (HEADING_DEG * self.random.normal()).to_radians());
        let speed_mps = speed_mps + SPEED_MPS * self.random.normal();
        let is_first = self.state.is_none();
        let yaw_rate_radps = if is_first { 0.0 } else { wrapped(truth.yaw_rad - self.last_yaw_rad) / elapsed_s };
        self.last_yaw_rad = truth.yaw_rad;

        let measured = planar_m * planar_m;
        let (position, variance) = match self.state {
            None => ([gnss_m[0], gnss_m[1]], measured),
            Some((position, variance)) => {
                let (sin, cos) = heading_rad.sin_cos();
                let moved = speed_mps * elapsed_s;
                // A bend driven as a chord, in addition to the noise of the speed.
                let drift = (SPEED_MPS * elapsed_s).powi(2) + (0.5 * yaw_rate_radps * elapsed_s * moved).powi(2);
                let predicted = [position[0] + moved * cos, position[1] + moved * sin];
                let gain = (variance + drift) / (variance + drift + measured);
                let mix = |axis: usize| predicted[axis] + gain * (gnss_m[axis] - predicted[axis]);
                ([mix(0), mix(1)], (1.0 - gain) * (variance + drift))
            }
        };
        self.state = Some((position, variance));
        let estimate = Placement::level([position[0], position[1], gnss_m[2]], heading_rad);
        Fix { gnss_m, heading_rad, speed_mps, yaw_rate_radps, estimate }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_filter_is_better_than_the_receiver() {
        let mut positioning = Positioning::new(4);
        let (mut raw, mut filtered) = (0.0, 0.0);
        for step in 0..2000 {
            let angle = f64::from(step) * 0.1 * 10.0 / 60.0;
            let truth = Placement::level([60.0 * angle.sin(), -60.0 * angle.cos(), 0.0], wrapped(angle));
            let fix = positioning.fix(&truth, 10.0, 0.1);
            if step > 20 {
                let off = |x: f64, y: f64| (x - truth.position_m.x).powi(2) + (y - truth.position_m.y).powi(2);
                raw += off(fix.gnss_m[0], fix.gnss_m[1]);
                filtered += off(fix.estimate.position_m.x, fix.estimate.position_m.y);
            }
        }
        assert!((raw / 1979.0 / 2.0 - 0.111f64.powi(2)).abs() < 0.002, "{}", raw / 1979.0);
        assert!(filtered < 0.6 * raw, "{filtered} {raw}");
    }
}
