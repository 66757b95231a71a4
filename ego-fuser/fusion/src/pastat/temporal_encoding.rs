//! TE, Temporal Encoding (Eq. 10-12): encodes the true age of a map.

use perception::tensor_values::tensor;
use tch::{Device, Kind, TchError, Tensor};

use super::config::PastatConfig;
use super::patches::Tokens;

/// Ages are clamped to this, seconds.
const MAX_AGE_SECS: f64 = 10.0;

/// Adds the encodings of each map to its tokens, Eq. 10: `z^(0) = Flatten(F) + E_t`, with the terms `of_maps` `[N, D]`: of
/// the confidence (Eq. 7) and of the match quality from FSA. It has no variables.
pub(super) fn encode(
    Tokens { values, valid }: Tokens,
    of_maps: [&Option<Tensor>; 2],
    age_secs: &[f64],
    config: &PastatConfig,
) -> Result<Tokens, TchError> {
    let of_ages = of_ages(age_secs, config, values.device())?;
    let mut terms = of_maps.into_iter().flatten();
    let of_map = terms.try_fold(of_ages, |sum, term| sum.f_add(term))?;
    let values = values + of_map.f_unsqueeze(2)?.f_unsqueeze(3)?;
    Ok(Tokens { values, valid })
}

/// `[N, D]`: `E_t` of each map; zeros without the encoding, for the ablation.
fn of_ages(age_secs: &[f64], config: &PastatConfig, device: Device) -> Result<Tensor, TchError> {
    let size = [age_secs.len() as i64, config.dim];
    if config.te.is_none() {
        return Tensor::f_zeros(size, (Kind::Float, device));
    }
    let values = age_secs.iter().flat_map(|&age| encoding(age, config));
    tensor(&values.collect::<Vec<f32>>(), &size, device)
}

/// Eq. 11 and 12: `E_t` of a map of this age, `D` values.
///
/// The paper counts time steps from 1, the oldest, to T, the newest. A map between two steps lies between them: `t` is
/// not a slot but T less the age in steps, so a late message is not encoded as a fresh one.
fn encoding(age_secs: f64, config: &PastatConfig) -> Vec<f32> {
    let t = config.frames as f64 - age_secs.clamp(-MAX_AGE_SECS, MAX_AGE_SECS) / config.frame_secs;
    let dim = config.dim as f64;
    (0..config.dim)
        .map(|channel| {
            // Even channels 2k have the sine, odd channels 2k + 1 the cosine, each with its own exponent.
            let angle = t / 10_000_f64.powf(channel as f64 / dim);
            let (sin, cos) = angle.sin_cos();
            let wave = if channel % 2 == 1 { cos } else { sin };
            wave as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> PastatConfig {
        PastatConfig {
            frames: 3,
            frame_secs: 0.1,
            dim: 8,
            ..PastatConfig::lean(64)
        }
    }

    #[test]
    fn the_newest_of_three_frames_is_step_three_as_printed() {
        let found = encoding(0.0, &config());
        for (channel, value) in found.iter().enumerate() {
            let angle = 3.0 / 10_000_f64.powf(channel as f64 / 8.0);
            let expected = if channel % 2 == 0 {
                angle.sin()
            } else {
                angle.cos()
            };
            assert!(
                (f64::from(*value) - expected).abs() < 1e-6,
                "channel {channel}"
            );
        }
    }

    #[test]
    fn the_oldest_is_step_one_and_a_late_map_lies_between_steps() {
        for (age_secs, step) in [(0.2, 1.0_f32), (0.05, 2.5)] {
            let found = encoding(age_secs, &config())[0];
            assert!((found - step.sin()).abs() < 1e-6, "{age_secs}: {found}");
        }
        assert_ne!(encoding(0.0, &config()), encoding(0.5, &config()));
        assert!(
            encoding(f64::INFINITY, &config())
                .iter()
                .all(|value| value.is_finite())
        );
    }
}
