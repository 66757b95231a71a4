//! GNSS and IMU of an agent, and the filter that estimates its pose from them.

use super::raycast::{Course, Placement, wrapped};
use super::traffic::STEP_S;
use support::random::SplitMix64;

/// Deviation of GNSS latitude and longitude, degrees (OpenCDA's set-up of the paper's recordings).
const LATITUDE_DEG: f64 = 1e-6;
/// Deviation of GNSS altitude, metres.
const ALTITUDE_M: f64 = 0.001;
/// Deviation of the IMU's heading, degrees.
const HEADING_DEG: f64 = 0.1;
/// Deviation of the measured speed, metres per second.
const SPEED_MPS: f64 = 0.2;
/// Deviation of one sample of the gyroscope, degrees per second: a MEMS sensor with a noise density of 0.014 degrees/s
/// per root hertz (data sheet of the Bosch BMG160) at a bandwidth of 50 Hz.
const GYROSCOPE_NOISE_DEGPS: f64 = 0.1;
/// Deviation of the gyroscope's bias, constant in a drive, degrees per second: the rest of the zero-rate offset of that
/// sensor (1 degree/s) after a calibration at standstill.
const GYROSCOPE_BIAS_DEGPS: f64 = 0.1;
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
    /// Yaw rate of the gyroscope, radians per second: the mean since the last fix; at the first one, over the last step.
    pub(crate) yaw_rate_radps: f64,
    /// The filter's pose of the vehicle's origin: no pitch, as in OpenCDA.
    pub(crate) estimate: Placement,
}

impl Fix {
    /// GNSS latitude and longitude in degrees (the map's origin is at 0, 0; north is +y) and altitude in metres.
    pub(crate) fn geodetic(&self) -> [f64; 3] {
        let [x, y, altitude_m] = self.gnss_m;
        [y / METRES_PER_DEG, x / METRES_PER_DEG, altitude_m]
    }
}

/// A Kalman filter over the planar position, driven by IMU heading and speed, corrected by GNSS.
#[derive(Debug)]
pub(crate) struct Positioning {
    random: SplitMix64,
    /// Random numbers of the gyroscope, whose samples have white noise and a constant bias.
    gyroscope: SplitMix64,
    bias_radps: f64,
    state: Option<([f64; 2], f64)>,
    last_yaw_rad: Option<f64>,
}

impl Positioning {
    pub(crate) fn new(seed: u64) -> Self {
        let mut gyroscope = SplitMix64::derived(seed, &[1]);
        Self {
            random: SplitMix64::new(seed),
            bias_radps: (GYROSCOPE_BIAS_DEGPS * gyroscope.normal()).to_radians(),
            gyroscope,
            state: None,
            last_yaw_rad: None,
        }
    }

    /// The next fix of a vehicle at the end of `motion`, one step of the traffic, and `elapsed_s` after the last fix.
    pub(crate) fn fix(&mut self, motion: &Course, speed_mps: f64, elapsed_s: f64) -> Fix {
        let truth = &motion.end;
        let planar_m = LATITUDE_DEG * METRES_PER_DEG;
        let deviations = [planar_m, planar_m, ALTITUDE_M];
        let gnss_m = std::array::from_fn(|axis| {
            truth.position_m[axis] + deviations[axis] * self.random.normal()
        });
        let heading_rad =
            wrapped(truth.yaw_rad + (HEADING_DEG * self.random.normal()).to_radians());
        let speed_mps = speed_mps + SPEED_MPS * self.random.normal();
        let true_radps = match self.last_yaw_rad.replace(truth.yaw_rad) {
            Some(last_rad) => wrapped(truth.yaw_rad - last_rad) / elapsed_s,
            None => wrapped(truth.yaw_rad - motion.start.yaw_rad) / STEP_S,
        };

        let measured = planar_m * planar_m;
        // One variance for both axes: noise of motion and of GNSS is the same along x and y.
        let (position, variance) = match self.state {
            None => ([gnss_m[0], gnss_m[1]], measured),
            Some((position, variance)) => {
                let (sin, cos) = heading_rad.sin_cos();
                let moved = speed_mps * elapsed_s;
                // A bend driven as a chord, in addition to the noise of the speed.
                let drift = (SPEED_MPS * elapsed_s).powi(2)
                    + (0.5 * true_radps * elapsed_s * moved).powi(2);
                let predicted = [position[0] + moved * cos, position[1] + moved * sin];
                let gain = (variance + drift) / (variance + drift + measured);
                let corrected =
                    [0, 1].map(|axis| predicted[axis] + gain * (gnss_m[axis] - predicted[axis]));
                (corrected, (1.0 - gain) * (variance + drift))
            }
        };
        self.state = Some((position, variance));
        // The filter is planar: the height is that of GNSS.
        let estimate = Placement::level([position[0], position[1], gnss_m[2]], heading_rad);
        let noise_radps = (GYROSCOPE_NOISE_DEGPS * self.gyroscope.normal()).to_radians();
        Fix {
            gnss_m,
            heading_rad,
            speed_mps,
            yaw_rate_radps: true_radps + self.bias_radps + noise_radps,
            estimate,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Place at a time of a drive at 10 m/s, 60 m from the origin.
    fn place_on_a_circle(time_s: f64) -> Placement {
        let angle = time_s * 10.0 / 60.0;
        Placement::level(
            [60.0 * angle.sin(), -60.0 * angle.cos(), 0.0],
            wrapped(angle),
        )
    }

    /// Last step before a time of that drive.
    fn on_a_circle(time_s: f64) -> Course {
        Course {
            start: place_on_a_circle(time_s - STEP_S),
            end: place_on_a_circle(time_s),
        }
    }

    fn squared_error_m2(truth: &Placement, x: f64, y: f64) -> f64 {
        (x - truth.position_m.x).powi(2) + (y - truth.position_m.y).powi(2)
    }

    #[test]
    fn the_filter_is_better_than_the_receiver() {
        let mut positioning = Positioning::new(4);
        let (mut raw, mut filtered) = (0.0, 0.0);
        for step in 0..2000 {
            let motion = on_a_circle(f64::from(step) * 0.1);
            let (truth, fix) = (motion.end, positioning.fix(&motion, 10.0, 0.1));
            if step > 20 {
                let estimate_m = fix.estimate.position_m;
                raw += squared_error_m2(&truth, fix.gnss_m[0], fix.gnss_m[1]);
                filtered += squared_error_m2(&truth, estimate_m.x, estimate_m.y);
            }
        }
        assert!(
            (raw / 1979.0 / 2.0 - 0.111f64.powi(2)).abs() < 0.002,
            "{}",
            raw / 1979.0
        );
        assert!(filtered < 0.6 * raw, "{filtered} {raw}");
    }

    /// Mean and deviation of the error of the yaw rate over a drive, degrees per second.
    fn yaw_rate_errors_degps(seed: u64) -> (f64, f64) {
        let mut positioning = Positioning::new(seed);
        let error_degps: Vec<f64> = (0..2000)
            .map(|step| {
                positioning
                    .fix(&on_a_circle(f64::from(step) * 0.1), 10.0, 0.1)
                    .yaw_rate_radps
                    - 1.0 / 6.0
            })
            .map(f64::to_degrees)
            .collect();
        let mean = error_degps.iter().sum::<f64>() / 2000.0;
        (
            mean,
            (error_degps
                .iter()
                .map(|error| (error - mean).powi(2))
                .sum::<f64>()
                / 2000.0)
                .sqrt(),
        )
    }

    #[test]
    fn a_gyroscope_has_noise_and_a_bias_of_its_own() {
        let drives: Vec<(f64, f64)> = (0..100).map(yaw_rate_errors_degps).collect();
        assert!(
            drives
                .iter()
                .all(|(_, noise)| (noise - GYROSCOPE_NOISE_DEGPS).abs() < 0.01),
            "from the first fix on"
        );
        let bias_degps = (drives.iter().map(|(bias, _)| bias * bias).sum::<f64>() / 100.0).sqrt();
        assert!(
            (bias_degps - GYROSCOPE_BIAS_DEGPS).abs() < 0.02,
            "{bias_degps}"
        );
    }

    #[test]
    fn a_vehicle_that_stands_has_a_yaw_rate_of_noise_and_bias_alone() {
        let mut positioning = Positioning::new(9);
        let still = Course::still(Placement::level([5.0, 6.0, 0.0], 3.0));
        let rates = (0..50).map(|_| {
            positioning
                .fix(&still, 0.0, 0.1)
                .yaw_rate_radps
                .to_degrees()
        });
        assert!(
            rates
                .into_iter()
                .all(|rate| rate != 0.0 && rate.abs() < 1.0)
        );
    }
}
