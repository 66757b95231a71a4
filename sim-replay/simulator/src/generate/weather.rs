//! Weather model: the effect of fog and snow on a beam.
//!
//! Simplified from the simulations of Hahner et al. (fog, ICCV 2021; snowfall, CVPR 2022), ray by ray:
//!
//! - A solid target at range `R` with reflectivity `r` returns `r / R^2 * exp(-2 a R)`. It is detected if that is at
//!   least the return of a target of 10 % in clear air at the sensor's range of 120 m. `a` is 0.06 per metre in fog
//!   (visibility 50 m) and 0.008 per metre in snow.
//! - Fog also returns light: a beam without a detected target, and sometimes one with a target, returns a point from
//!   the first metres of the fog (gamma law of shape 3, mean 5.4 m beyond the first metre).
//! - In snow a beam hits a flake after an exponential distance; a flake within 30 m that is nearer than the target
//!   replaces it.
//! - The intensity of the remaining returns is reduced by the same two-way loss; fog and flakes have low intensities.

use clap::ValueEnum;

use support::random::SplitMix64;

/// Reflectance of the weakest target that is detected in clear air at [`CLEAR_RANGE_M`].
const WEAKEST_REFLECTIVITY: f32 = 0.1;
/// Range of the sensor in clear air, metres.
const CLEAR_RANGE_M: f32 = 120.0;

/// The weather of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, ValueEnum, strum::IntoStaticStr)]
#[strum(serialize_all = "lowercase")]
pub enum Weather {
    /// Clear air.
    #[default]
    Sunny,
    /// Dense fog: visibility 50 m.
    Fog,
    /// Snowfall of about 2.5 mm of water per hour.
    Snow,
}

/// Result of a beam in the weather.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Echo {
    /// The target, dimmed to this share of its intensity.
    Target(f32),
    /// Backscatter of fog or a flake: range in metres and intensity.
    Backscatter(f32, f32),
    /// No return.
    Lost,
}

impl Weather {
    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The name of a sweep in this weather beside the clear one, as in V2X-R: with the extinction of fog per metre, or
    /// with the rate of the snow in millimetres per hour and the speed of its flakes. Clear air has none.
    pub fn variant(self) -> Option<&'static str> {
        match self {
            Self::Sunny => None,
            Self::Fog => Some("fog_0.060"),
            Self::Snow => Some("snow_2.5_2.0"),
        }
    }

    /// Return of a beam whose target has this range (`None`: open sky) and reflectivity.
    pub(crate) fn echo(
        self,
        target_m: Option<f32>,
        reflectivity: f32,
        random: &mut SplitMix64,
    ) -> Echo {
        match self {
            Self::Sunny => target_m.map_or(Echo::Lost, |_| Echo::Target(1.0)),
            Self::Fog => Self::fog(target_m, reflectivity, random),
            Self::Snow => Self::snow(target_m, reflectivity, random),
        }
    }

    fn fog(target_m: Option<f32>, reflectivity: f32, random: &mut SplitMix64) -> Echo {
        let target = seen(target_m, reflectivity, 0.06);
        if random.chance(if target.is_some() { 0.04 } else { 0.30 }) {
            // A gamma law of shape 3 is the sum of three exponential ones.
            let product: f64 = (0..3).map(|_| 1.0 - random.unit()).product();
            // A scale of 1.8 m gives the mean of 5.4 m, counted from the first metre on.
            let range_m = (1.0 - 1.8 * product.ln()) as f32;
            if target_m.is_none_or(|target_m| range_m < target_m) {
                return Echo::Backscatter(range_m, random.between(0.02, 0.12) as f32);
            }
        }
        target.map_or(Echo::Lost, Echo::Target)
    }

    fn snow(target_m: Option<f32>, reflectivity: f32, random: &mut SplitMix64) -> Echo {
        // An exponential law by inversion. `1 - u` is never 0, so the logarithm is finite.
        let flake_m = (1.5 - 110.0 * (1.0 - random.unit()).ln()) as f32;
        if flake_m < 30.0
            && target_m.is_none_or(|target_m| flake_m < target_m)
            && random.chance(0.7)
        {
            return Echo::Backscatter(flake_m, random.between(0.02, 0.25) as f32);
        }
        seen(target_m, reflectivity, 0.008).map_or(Echo::Lost, Echo::Target)
    }
}

/// The share of the light that remains of a target, if that is enough for detection.
fn seen(target_m: Option<f32>, reflectivity: f32, extinction: f32) -> Option<f32> {
    let range_m = target_m?;
    let kept = (-2.0 * extinction * range_m).exp();
    let returned = reflectivity * kept / (range_m * range_m);
    (returned >= WEAKEST_REFLECTIVITY / (CLEAR_RANGE_M * CLEAR_RANGE_M)).then_some(kept)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(weather: Weather, target_m: Option<f32>, is: impl Fn(&Echo) -> bool) -> f64 {
        let mut random = SplitMix64::new(9);
        let echoes = (0..20_000).map(|_| weather.echo(target_m, 0.4, &mut random));
        echoes.filter(|echo| is(echo)).count() as f64 / 20_000.0
    }

    fn is_target(echo: &Echo) -> bool {
        matches!(echo, Echo::Target(_))
    }

    fn is_backscatter(echo: &Echo) -> bool {
        matches!(echo, Echo::Backscatter(..))
    }

    #[test]
    fn fog_hides_far_targets_and_backscatters() {
        assert!(share(Weather::Fog, Some(15.0), is_target) > 0.95);
        assert_eq!(share(Weather::Fog, Some(60.0), is_target), 0.0);
        assert!((share(Weather::Fog, Some(60.0), is_backscatter) - 0.3).abs() < 0.02);
        assert!(share(Weather::Snow, Some(60.0), is_target) > 0.8);
        assert!((0.08..0.25).contains(&share(Weather::Snow, None, is_backscatter)));
        assert_eq!(share(Weather::Sunny, Some(119.0), is_target), 1.0);
    }
}
