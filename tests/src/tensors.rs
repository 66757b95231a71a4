//! Golden archives as tensors and networks.

use std::collections::BTreeMap;

use perception::model_config::DetectorConfig;
use perception::pillars::voxels::Pillars;
use serde_json::Value;
use tch::nn::VarStore;
use tch::{Kind, Tensor};

use crate::fixtures::Golden;

/// An `f32` tensor of an archive.
pub fn tensor(golden: &Golden, name: &str) -> Tensor {
    let (shape, values) = golden.f32(name);
    Tensor::from_slice(&values).reshape(shape.iter().map(|&size| size as i64).collect::<Vec<_>>())
}

/// All values of a tensor, row-major.
///
/// # Panics
/// When it does not hold floating point numbers.
#[must_use]
pub fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.detach().to_kind(Kind::Float).contiguous().view([-1])).expect("f32 values")
}

/// Copies the weights `w.<prefix><name>` of an archive into the variables of a network, by name; each must be there.
///
/// # Panics
/// When one is missing or of another shape.
pub fn load(network: &VarStore, golden: &Golden, prefix: &str) {
    let variables: BTreeMap<String, Tensor> = network.variables().into_iter().collect();
    assert!(!variables.is_empty(), "a network without variables");
    for (name, mut variable) in variables {
        let source = tensor(golden, &format!("w.{prefix}{name}"));
        assert_eq!(source.size(), variable.size(), "{name}");
        tch::no_grad(|| variable.copy_(&source));
    }
}

/// The pillars of each sweep of a case with voxels, and the row of each pillar of the file.
#[must_use]
pub fn pillars(golden: &Golden) -> (Vec<Pillars>, Vec<usize>) {
    let (shape, features) = golden.f32("in.voxel_features");
    let (_, coords) = golden.i32("in.voxel_coords");
    let (_, counts) = golden.i32("in.voxel_num_points");
    let coords = coords.as_chunks::<4>().0;
    let sweeps = coords
        .iter()
        .map(|coord| coord[0])
        .max()
        .map_or(0, |last| last as usize + 1);
    let mut pillars = vec![Pillars::default(); sweeps];
    for (index, &[sweep, z, y, x]) in coords.iter().enumerate() {
        let pillar = &mut pillars[sweep as usize];
        let points = features[index * shape[1] * 4..].as_chunks::<4>().0;
        pillar.points.extend(&points[..counts[index] as usize]);
        pillar.counts.push(counts[index] as u32);
        pillar.coords.push([z, y, x]);
    }
    let mut next: Vec<usize> = (0..sweeps)
        .map(|sweep| pillars[..sweep].iter().map(Pillars::len).sum())
        .collect();
    let rows = coords.iter().map(|coord| {
        let row = &mut next[coord[0] as usize];
        *row += 1;
        *row - 1
    });
    let rows = rows.collect();
    (pillars, rows)
}

/// The detector of a case with a whole network, from the part of its configuration that describes the backbone.
///
/// # Panics
/// When the configuration is of another shape.
#[must_use]
pub fn detector_config(golden: &Golden, backbone: &str) -> DetectorConfig {
    let config = golden.config();
    let levels = &config[backbone];
    let (points, _) = golden.f32("in.voxel_features");
    DetectorConfig {
        name: "golden".into(),
        lidar_range_m: array(&config["lidar_range"]),
        voxel_size_m: array(&config["voxel_size"]),
        max_points_per_pillar: points[1],
        pillar_channels: integer(&config["pillar_vfe"]["num_filters"][0]),
        layer_nums: integers(&levels["layer_nums"])
            .iter()
            .map(|&count| count as usize)
            .collect(),
        layer_strides: integers(&levels["layer_strides"]),
        num_filters: integers(&levels["num_filters"]),
        upsample_strides: integers(&levels["upsample_strides"]),
        num_upsample_filters: integers(&levels["num_upsample_filter"]),
        shrink: None,
        ..DetectorConfig::full()
    }
}

/// An integer of a configuration.
///
/// # Panics
/// When it is no integer.
#[must_use]
pub fn integer(value: &Value) -> i64 {
    value
        .as_i64()
        .unwrap_or_else(|| panic!("{value} is not an integer"))
}

/// A number of a configuration.
///
/// # Panics
/// When it is no number.
#[must_use]
pub fn number(value: &Value) -> f64 {
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} is not a number"))
}

/// A list of integers of a configuration.
///
/// # Panics
/// When it is no such list.
#[must_use]
pub fn integers(value: &Value) -> Vec<i64> {
    value
        .as_array()
        .unwrap_or_else(|| panic!("{value} is not a list"))
        .iter()
        .map(integer)
        .collect()
}

/// `N` numbers of a configuration.
///
/// # Panics
/// When there are more or fewer.
#[must_use]
pub fn array<const N: usize>(value: &Value) -> [f64; N] {
    let values: Vec<f64> = value
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(Value::as_f64)
        .collect();
    values
        .try_into()
        .unwrap_or_else(|_| panic!("{value} has not {N} numbers"))
}
