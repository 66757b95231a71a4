//! What fog and snow do to a beam.
//!
//! Simplified from the simulations of Hahner et al. (fog, ICCV 2021; snowfall, CVPR 2022), ray by ray:
//!
//! - A solid target at range `R` with reflectivity `r` returns `r / R^2 * exp(-2 a R)`. It is seen where that is at least
//!   what a target of 10 % returns in clear air at the sensor's range of 120 m. `a` is 0.06 per metre in fog (one sees
//!   50 m far) and 0.008 per metre in snow.
//! - Fog also answers by itself: a beam that lost its target, and now and then one that did not, returns a point from
//!   the first metres of the fog (gamma law of shape 3, mean 5.4 m).
//! - In snow a beam meets a flake after an exponential distance; flakes within 30 m that come before the target answer
//!   in its place.
//! - The intensity of what is left is dimmed by the same two-way loss; fog and flakes answer faintly.

use clap::ValueEnum;

use support::random::SplitMix64;

/// Share of light that a target must throw back to be seen in clear air at [`CLEAR_RANGE_M`].
const WEAKEST_REFLECTIVITY: f32 = 0.1;
/// Range of the sensor in clear air, metres.
const CLEAR_RANGE_M: f32 = 120.0;

/// The weather of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, ValueEnum)]
pub enum Weather {
    /// Clear air.
    #[default]
    Sunny,
    /// Dense fog: one sees 50 m far.
    Fog,
    /// Snowfall of about 2.5 mm of water per hour.
    Snow,
}

/// What became of a beam in the weather.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Echo {
    /// The target, dimmed to this share of its intensity.
    Target(f32),
    /// A point in the air: its range in metres and its intensity.
    LinkEmulator(f32, f32),
    /// Nothing.
    Lost,
}

impl Weather {
    /// The name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Sunny => "sunny",
            Self::Fog => "fog",
            Self::Snow => "snow",
        }
    }

    /// The name of a sweep in this weather beside the plain one, as V2X-R has them: with the extinction of fog per metre,
    /// with the rate of the snow in millimetres an hour and the speed of its flakes. Clear air has none.
    #[must_use]
    pub fn variant(self) -> Option<&'static str> {
        match self {
            Self::Sunny => None,
            Self::Fog => Some("fog_0.060"),
            Self::Snow => Some("snow_2.5_2.0"),
        }
    }

    /// What a beam returns whose target has this range (`None`: open sky) and reflectivity.
    pub(crate) fn echo(self, target_m: Option<f32>, reflectivity: f32, random: &mut SplitMix64) -> Echo {
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
            let range_m = (1.0 - 1.8 * product.ln()) as f32;
            if target_m.is_none_or(|target_m| range_m < target_m) {
                return Echo::LinkEmulator(range_m, random.between(0.02, 0.12) as f32);
            }
        }
        target.map_or(Echo::Lost, Echo::Target)
    }

    fn snow(target_m: Option<f32>, reflectivity: f32, random: &mut SplitMix64) -> Echo {
        let flake_m = (1.5 - 110.0 * (1.0 - random.unit()).ln()) as f32;
        if flake_m < 30.0 && target_m.is_none_or(|target_m| flake_m < target_m) && random.chance(0.7) {
            return Echo::LinkEmulator(flake_m, random.between(0.02, 0.25) as f32);
        }
        seen(target_m, reflectivity, 0.008).map_or(Echo::Lost, Echo::Target)
    }
}

/// The share of its light that a target keeps, where enough comes back to be seen.
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

    #[test]
    fn fog_hides_what_is_far_and_answers_itself() {
        let is_target = |echo: &Echo| matches!(echo, Echo::Target(_));
        let is_air = |echo: &Echo| matches!(echo, Echo::LinkEmulator(..));
        assert!(share(Weather::Fog, Some(15.0), is_target) > 0.95);
        assert_eq!(share(Weather::Fog, Some(60.0), is_target), 0.0);
        assert!((share(Weather::Fog, Some(60.0), is_air) - 0.3).abs() < 0.02);
        assert!(share(Weather::Snow, Some(60.0), is_target) > 0.8);
        assert!((0.08..0.25).contains(&share(Weather::Snow, None, is_air)));
        assert_eq!(share(Weather::Sunny, Some(119.0), is_target), 1.0);
    }
}
