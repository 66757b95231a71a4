//! Synthetic tensors for tests, the same in every run: torch's own generator is shared by all tests of a process.

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;
use tch::nn::VarStore;

/// Values from 0 to 1 of this shape.
pub(crate) fn uniform(seed: u64, shape: &[i64]) -> Tensor {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| random.random())
        .collect();
    Tensor::from_slice(&values).view(shape)
}

/// Redraws every parameter whose name has one of `parts`, from -`size` to `size`.
pub(crate) fn redraw(variables: &VarStore, parts: &[&str], size: f64) {
    let mut named: Vec<_> = variables.variables().into_iter().collect();
    named.sort_by(|a, b| a.0.cmp(&b.0));
    for (seed, (name, mut variable)) in named.into_iter().enumerate() {
        if parts.iter().any(|part| name.contains(part)) {
            tch::no_grad(|| {
                variable.copy_(&((uniform(seed as u64, &variable.size()) * 2.0 - 1.0) * size))
            });
        }
    }
}
