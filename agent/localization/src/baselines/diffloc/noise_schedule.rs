//! Noise schedule: how much of a pose remains at each step of the diffusion, and the way back (DDIM, Song et al. 2021).

use perception::tensor_values::tensor;
use tch::{Device, Tensor};

/// Steps of the diffusion.
const STEPS: usize = 100;
/// Variance that the first and the last step add; it grows linearly between them.
const BETAS: [f64; 2] = [1e-4, 0.1];
/// Largest magnitude of a predicted pose, in the units of a pose relative to its class.
const LIMIT: f64 = 4.0;

/// Shares of signal and noise at each step.
#[derive(Debug)]
pub struct NoiseSchedule {
    /// Product of `1 - beta` up to each step.
    kept: Vec<f64>,
    /// `[STEPS]`: factors of the pose and of the noise.
    factors: [Tensor; 2],
}

impl NoiseSchedule {
    /// The schedule, with its tables on a device.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(device: Device) -> tch::Result<Self> {
        let kept = (0..STEPS).scan(1.0, |product, step| {
            let beta = BETAS[0] + (BETAS[1] - BETAS[0]) * step as f64 / (STEPS - 1) as f64;
            *product *= 1.0 - beta;
            Some(*product)
        });
        let kept: Vec<f64> = kept.collect();
        let signal: Vec<f32> = kept.iter().map(|kept| kept.sqrt() as f32).collect();
        let noise = kept.iter().map(|&kept| (1.0 - kept).sqrt() as f32);
        let signal = tensor(&signal, &[-1], device)?;
        let noise = tensor(&noise.collect::<Vec<_>>(), &[-1], device)?;
        let factors = [signal, noise];
        Ok(Self { kept, factors })
    }

    /// Number of steps.
    pub fn steps(&self) -> i64 {
        self.kept.len() as i64
    }

    /// Poses `[W, F, D]` with `noise` of the same shape, at steps `[W]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn add_noise(&self, poses: &Tensor, noise: &Tensor, steps: &Tensor) -> tch::Result<Tensor> {
        let [signal, deviation] = (self.factors.each_ref())
            .map(|table| table.f_index_select(0, steps)?.f_view([-1, 1, 1]));
        let noise = noise.f_mul(&deviation?)?;
        poses.f_mul(&signal?)?.f_add(&noise)
    }

    /// Poses `[W, F, D]` that `noisy` poses come from if their velocity at steps `[W]` is this (Salimans and Ho 2022).
    /// A velocity is near the noise at the first steps and near the negated pose at the last.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn poses(&self, noisy: &Tensor, velocity: &Tensor, steps: &Tensor) -> tch::Result<Tensor> {
        // sqrt(kept) noisy - sqrt(1 - kept) velocity: the form of `add_noise` with the sign reversed.
        self.add_noise(noisy, &velocity.f_neg()?, steps)
    }

    /// Finds poses from noise in `count` steps without randomness; `predict` returns the velocity of noisy poses
    /// at a step.
    ///
    /// # Errors
    /// Those of the tensor library and of `predict`.
    pub fn denoise(
        &self,
        noise: &Tensor,
        count: usize,
        mut predict: impl FnMut(&Tensor, i64) -> tch::Result<Tensor>,
    ) -> tch::Result<Tensor> {
        let last = (self.kept.len() - 1) as f64;
        let shares = (0..count.max(1)).map(|number| number as f64 / (count.max(2) - 1) as f64);
        let steps = shares.map(|share| (last * (1.0 - share)).round() as usize);
        let mut steps: Vec<usize> = steps.collect();
        steps.dedup();
        let mut noisy = noise.shallow_clone();
        let mut poses = noise.shallow_clone();
        for (place, &step) in steps.iter().enumerate() {
            let kept = self.kept[step];
            let noise = predict(&noisy, step as i64)? * (1.0 - kept).sqrt();
            poses = (noisy.f_mul_scalar(kept.sqrt())?.f_sub(&noise)?).f_clamp(-LIMIT, LIMIT)?;
            if let Some(&next) = steps.get(place + 1) {
                // The noise that leads from these poses to where they came from.
                let noise = noisy.f_sub(&(&poses * kept.sqrt()))? / (1.0 - kept).sqrt();
                noisy = &poses * self.kept[next].sqrt() + noise * (1.0 - self.kept[next]).sqrt();
            }
        }
        Ok(poses)
    }
}

#[cfg(test)]
mod tests {
    use tch::Kind;

    use super::*;

    #[test]
    fn a_perfect_denoiser_finds_the_pose_from_any_noise() {
        tch::set_num_threads(1);
        tch::manual_seed(1);
        let schedule = NoiseSchedule::new(Device::Cpu).unwrap();
        let truth = Tensor::from_slice(&[0.5f32, -1.5, 0.1, 0.6, -0.8]).view([1, 1, 5]);
        let start = Tensor::randn([1, 1, 5], (Kind::Float, Device::Cpu));
        let mut calls = 0;
        let found = schedule
            .denoise(&start, 10, |noisy, step| {
                calls += 1;
                let kept = schedule.kept[step as usize];
                Ok((noisy * kept.sqrt() - &truth) / (1.0 - kept).sqrt())
            })
            .unwrap();
        assert_eq!(calls, 10);
        assert!((found - &truth).abs().max().double_value(&[]) < 1e-4);
    }

    #[test]
    fn little_noise_is_added_at_the_first_step_and_little_pose_remains_at_the_last() {
        let schedule = NoiseSchedule::new(Device::Cpu).unwrap();
        let poses = Tensor::ones([2, 3, 5], (Kind::Float, Device::Cpu));
        let noise = -&poses;
        let noisy = schedule
            .add_noise(
                &poses,
                &noise,
                &Tensor::from_slice(&[0_i64, schedule.steps() - 1]),
            )
            .unwrap();
        let [first, last] = [0, 1].map(|window| noisy.double_value(&[window, 2, 4]));
        assert!((first - (0.9999_f64.sqrt() - 0.01)).abs() < 1e-6);
        assert!(last < -0.9, "{last}");
    }

    #[test]
    fn an_error_of_the_velocity_counts_little_at_the_first_step_and_fully_at_the_last() {
        let schedule = NoiseSchedule::new(Device::Cpu).unwrap();
        let steps = Tensor::from_slice(&[0_i64, schedule.steps() - 1]);
        let noisy = Tensor::full([2, 1, 5], 3.0, (Kind::Float, Device::Cpu));
        let velocity = noisy.zeros_like();
        let [right, wrong] = [&velocity, &(&velocity + 1.0)]
            .map(|velocity| schedule.poses(&noisy, velocity, &steps).unwrap());
        let moved = right - wrong;
        assert!(
            (moved.double_value(&[0, 0, 0]) - 0.01).abs() < 1e-3,
            "{moved}"
        );
        assert!(
            (moved.double_value(&[1, 0, 0]) - 1.0).abs() < 0.01,
            "{moved}"
        );
    }
}
