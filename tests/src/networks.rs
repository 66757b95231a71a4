//! Networks that detect vehicles everywhere: parameters from names and shapes only, equal in every run.
//!
//! libtorch has one random number generator for a process, so parameters that are drawn from it depend on what other
//! tests draw meanwhile.

use std::path::{Path, PathBuf};

use fusion::Method;
use fusion::model::CooperativeModel;
use perception::model_config::DetectorConfig;
use perception::weights::{Precision, save};
use tch::{Device, Kind, Tensor};

/// Writes the weights of a method: a small area, the encoder the same for every method and compressor.
///
/// # Panics
/// When the file cannot be written.
#[must_use]
pub fn write(folder: &Path, method: Method, compress_ratio: Option<i64>) -> PathBuf {
    let config = DetectorConfig {
        lidar_range_m: [-25.6, -12.8, -3.0, 25.6, 12.8, 1.0],
        compress_ratio,
        ..DetectorConfig::lean()
    };
    let model = CooperativeModel::new(&config, method, Device::Cpu).expect("a network");
    for (name, mut variable) in model.variables.variables() {
        tch::no_grad(|| variable.copy_(&values(&name, &variable)));
    }
    let ratio = compress_ratio.unwrap_or(1);
    let path = folder.join(format!("{method}-{ratio}.safetensors"));
    save(&path, &model.variables, &model.about(), Precision::Single).expect("a writable folder");
    path
}

/// Values of a parameter: of the size that trained ones have.
fn values(name: &str, variable: &Tensor) -> Tensor {
    let (count, size) = (variable.numel() as i64, variable.size());
    // Without a pattern that a convolution would amplify; from -1 to 1.
    let noise = ((Tensor::arange(count, (Kind::Double, Device::Cpu)) * 78.233).sin() * 43_758.545)
        .frac()
        .to_kind(Kind::Float)
        .view(size.as_slice());
    match name {
        "cls_head.bias" => noise * 0.1 + 0.3,
        "cls_head.weight" => noise * 0.1,
        "reg_head.weight" => noise * 0.01,
        // Residual steps one after the other.
        _ if name.starts_with("fusion.") && size.len() > 1 => noise * 0.1,
        _ if size.len() > 1 => noise * (6.0 / (count as f64 / size[0] as f64)).sqrt(),
        // Scales of norms.
        _ if name.ends_with("weight") || name.ends_with("running_var") => noise * 0.1 + 1.0,
        _ => noise * 0.1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locks::random_generator_lock;

    #[test]
    fn files_are_equal_whatever_was_drawn_before() {
        let _generator = random_generator_lock();
        for method in Method::ALL {
            let [one, other] = [3, 4].map(|seed| {
                let folder = tempfile::tempdir().unwrap();
                tch::manual_seed(seed);
                std::fs::read(write(folder.path(), method, None)).unwrap()
            });
            assert!(one == other, "{method}");
        }
    }
}
