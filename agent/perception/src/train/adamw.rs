//! AdamW: Adam with decoupled weight decay, with a state that can be saved and restored exactly.
//!
//! `tch`'s own optimizer does not expose its moments, so a training could not be resumed with it.

use std::collections::BTreeMap;

use tch::nn::VarStore;
use tch::{Kind, TchError, Tensor, no_grad};

/// Decay of the mean gradient.
const BETA1: f64 = 0.9;
/// Decay of the mean squared gradient.
const BETA2: f64 = 0.999;
/// Added to the denominator, so that the division is finite.
const EPS: f64 = 1e-8;

/// The constants of AdamW that trainings choose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamWConfig {
    /// Decoupled weight decay per unit of learning rate; vectors (norms, biases) have none.
    pub weight_decay: f64,
    /// Gradients are scaled down to this norm.
    pub max_gradient_norm: f64,
}

impl Default for AdamWConfig {
    fn default() -> Self {
        Self {
            weight_decay: 1e-2,
            max_gradient_norm: 10.0,
        }
    }
}

/// Optimizer of the trainable variables of a network.
#[derive(Debug)]
pub struct AdamW {
    config: AdamWConfig,
    entries: Vec<TrainedVariable>,
    steps: i64,
}

#[derive(Debug)]
struct TrainedVariable {
    name: String,
    variable: Tensor,
    mean: Tensor,
    square: Tensor,
    decays: bool,
}

impl AdamW {
    /// Optimizer before its first step.
    pub fn new(variables: &VarStore, config: AdamWConfig) -> Self {
        let named: BTreeMap<String, Tensor> = variables.variables().into_iter().collect();
        let trained = named
            .into_iter()
            .filter(|(_, variable)| variable.requires_grad());
        let entries = trained.map(|(name, variable)| TrainedVariable {
            name,
            mean: no_grad(|| variable.zeros_like()),
            square: no_grad(|| variable.zeros_like()),
            decays: variable.dim() > 1,
            variable,
        });
        Self {
            config,
            entries: entries.collect(),
            steps: 0,
        }
    }

    /// Clears the gradients of the last step.
    pub fn zero_grad(&mut self) {
        for entry in &mut self.entries {
            entry.variable.zero_grad();
        }
    }

    /// Updates every variable by its gradient; false, and nothing is updated, if the gradient is not finite.
    ///
    /// # Errors
    /// [`TchError`] from the tensor library.
    pub fn step(&mut self, learning_rate: f64) -> Result<bool, TchError> {
        no_grad(|| {
            let gradients = self.entries.iter().map(|entry| entry.variable.grad());
            let gradients: Vec<Tensor> = gradients.collect();
            let norm = global_norm(&gradients)?;
            if !norm.is_finite() {
                return Ok(false);
            }
            // The small term keeps a gradient of zero from a division by zero.
            let scale = (self.config.max_gradient_norm / (norm + 1e-6)).min(1.0);
            self.steps += 1;
            let (config, steps) = (self.config, self.steps as f64);
            // The moments start at zero: without these corrections the first steps are biased.
            let mean_correction = 1.0 - BETA1.powf(steps);
            let square_correction = 1.0 - BETA2.powf(steps);
            for (entry, gradient) in self.entries.iter_mut().zip(&gradients) {
                // A variable that is not part of the loss does not decay either.
                if !gradient.defined() {
                    continue;
                }
                let (mean, square) = (&mut entry.mean, &mut entry.square);
                let gradient = gradient * scale;
                let squared = gradient.f_square()?.f_mul_scalar_(1.0 - BETA2)?;
                let _ = square.f_mul_scalar_(BETA2)?.f_add_(&squared)?;
                let change = gradient * (1.0 - BETA1);
                let _ = mean.f_mul_scalar_(BETA1)?.f_add_(&change)?;
                let mut root = (&*square / square_correction).f_sqrt_()?;
                let deviation = root.f_add_scalar_(EPS)?;
                // Decoupled: on the variable itself, not through the gradient and its moments.
                if entry.decays {
                    let kept = 1.0 - learning_rate * config.weight_decay;
                    let _ = entry.variable.f_mul_scalar_(kept)?;
                }
                let change = (&*mean * (learning_rate / mean_correction)).f_div_(&deviation)?;
                let _ = entry.variable.f_sub_(&change)?;
            }
            Ok(true)
        })
    }

    /// The moments by name (the next step changes them), `mean.<variable>` and `square.<variable>`, and the number of
    /// steps.
    pub fn state(&self) -> (BTreeMap<String, Tensor>, i64) {
        let both = self.entries.iter().flat_map(|entry| {
            [("mean", &entry.mean), ("square", &entry.square)].map(|(prefix, moment)| {
                (format!("{prefix}.{}", entry.name), moment.shallow_clone())
            })
        });
        (both.collect(), self.steps)
    }

    /// Restores a state of [`Self::state`].
    ///
    /// # Errors
    /// The name of a moment that is missing or of another shape.
    pub(crate) fn restore(
        &mut self,
        moments: &BTreeMap<String, Tensor>,
        steps: i64,
    ) -> Result<(), String> {
        for entry in &mut self.entries {
            for (prefix, moment) in [("mean", &mut entry.mean), ("square", &mut entry.square)] {
                let name = format!("{prefix}.{}", entry.name);
                let stored = moments.get(&name);
                let stored = stored.filter(|stored| stored.size() == moment.size());
                *moment = stored.ok_or(name)?.to_device(moment.device());
            }
        }
        self.steps = steps;
        Ok(())
    }
}

/// Norm of all gradients together; variables that are not part of the loss count as zero.
fn global_norm(gradients: &[Tensor]) -> Result<f64, TchError> {
    let defined = gradients.iter().filter(|gradient| gradient.defined());
    let squares = defined.map(|gradient| gradient.f_square()?.f_sum(Kind::Double));
    let squares = squares.collect::<Result<Vec<Tensor>, TchError>>()?;
    if squares.is_empty() {
        return Ok(0.0);
    }
    let sum = Tensor::f_stack(&squares, 0)?.f_sum(Kind::Double)?;
    Ok(sum.f_double_value(&[])?.sqrt())
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::Init;

    use super::*;

    fn quadratic() -> (VarStore, Tensor) {
        let variables = VarStore::new(Device::Cpu);
        let point = variables.root().var("point", &[2], Init::Const(3.0));
        (variables, point)
    }

    fn descend(optimizer: &mut AdamW, point: &Tensor, steps: usize) {
        for _ in 0..steps {
            optimizer.zero_grad();
            (point - Tensor::from_slice(&[1f32, -1.0]))
                .square()
                .sum(Kind::Float)
                .backward();
            assert!(optimizer.step(0.1).unwrap());
        }
    }

    #[test]
    fn finds_the_minimum_of_a_quadratic() {
        let (variables, point) = quadratic();
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        descend(&mut optimizer, &point, 300);
        let found: Vec<f32> = Vec::try_from(&point.detach()).unwrap();
        assert!(
            (found[0] - 1.0).abs() < 1e-2 && (found[1] + 1.0).abs() < 1e-2,
            "{found:?}"
        );
    }

    #[test]
    fn a_restored_state_continues_bit_for_bit() {
        let (variables, point) = quadratic();
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        descend(&mut optimizer, &point, 5);
        let (other_variables, other_point) = quadratic();
        let mut other = AdamW::new(&other_variables, AdamWConfig::default());
        no_grad(|| other_point.shallow_clone().copy_(&point));
        let (moments, steps) = optimizer.state();
        let moments = moments
            .into_iter()
            .map(|(name, moment)| (name, moment.copy()))
            .collect();
        other.restore(&moments, steps).unwrap();
        descend(&mut optimizer, &point, 5);
        descend(&mut other, &other_point, 5);
        assert_eq!(point, other_point);
        assert_eq!(
            other.restore(&BTreeMap::new(), 0).unwrap_err(),
            "mean.point"
        );
    }

    #[test]
    fn a_gradient_that_is_not_finite_updates_nothing() {
        let (variables, point) = quadratic();
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        (&point * f64::NAN).sum(Kind::Float).backward();
        assert!(!optimizer.step(0.1).unwrap());
        assert_eq!(Vec::<f32>::try_from(&point.detach()).unwrap(), [3.0, 3.0]);
    }
}
