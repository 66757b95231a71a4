//! Weights: trained parameters on disk as safetensors in `f32` or `f16`, with their configuration.
//!
//! A file is self-contained: the key `config` of its metadata holds the JSON of the configuration that the network is
//! built from. Names of the tensors are those of the reference's state dictionary.

mod annotate;
mod save;

use std::collections::{BTreeMap, HashMap};
use std::fmt::Display;
use std::path::{Path, PathBuf};

use half::{bf16, f16};
use protocol::text::hex;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use support::bounded_file;
use support::file_error::{AtFile, Result};
use tch::Device;
use tch::nn::{self, VarStore};

use crate::int8::{ActivationScales, InferencePrecision, QuantiseError, SCALES_KEY};
use crate::model_config::DetectorConfig;
use crate::tensor_values::tensor;
use crate::torch_error::first_line;

pub use annotate::annotate;
pub use save::{Precision, save, with_header};
pub(crate) use save::{Stored, file_bytes};
pub use support::file_error::FileError;

/// Metadata key of the configuration.
pub const CONFIG_KEY: &str = "config";
/// Metadata key of the kind of the network.
pub const KIND_KEY: &str = "kind";
/// Metadata key of the fusion method; files of detectors contain it, and no kind.
pub const METHOD_KEY: &str = "method";

/// Kind of a detector.
const DETECTOR_KIND: &str = "detector";
/// End of the names of variances of normalisation layers.
const VARIANCE_NAME: &str = "running_var";

/// One file of parameters, read and checked.
#[derive(Debug)]
pub struct Weights {
    path: PathBuf,
    metadata: BTreeMap<String, String>,
    tensors: BTreeMap<String, Values>,
    sha256: String,
}

#[derive(Debug)]
struct Values {
    shape: Vec<i64>,
    values: Vec<f32>,
}

/// Largest file that is read, bytes: a hundred times the largest network here.
pub(crate) const MAX_BYTES: u64 = 4 << 30;

impl Weights {
    /// Reads a whole file.
    ///
    /// Tensors of 64-bit integers, which only count batches in the reference, are ignored.
    ///
    /// # Errors
    /// [`FileError`] when the file is missing, truncated, or holds values that are no parameters.
    pub fn load(path: &Path) -> Result<Self> {
        if path.is_dir() {
            return Err(FileError::new(path, "a folder, must be one weights file"));
        }
        let bytes = bounded_file::read(path, MAX_BYTES).at(path)?;
        let (metadata, file) = parsed(&bytes).at(path)?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.iter() {
            if let Some(values) = read_values(path, name, &view)? {
                let shape = view.shape().iter().map(|&size| size as i64).collect();
                tensors.insert(name.to_owned(), Values { shape, values });
            }
        }
        Ok(Self {
            path: path.to_owned(),
            metadata: metadata.into_iter().collect(),
            tensors,
            sha256: hex(&Sha256::digest(&bytes)),
        })
    }

    /// SHA-256 of the file, 64 hexadecimal digits: identifies the model in run records and descriptors.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// SHA-256 over the tensors whose name is `wanted`: the same for files that share these and differ in others.
    pub fn sha256_of(&self, wanted: impl Fn(&str) -> bool) -> String {
        let mut hash = Sha256::new();
        for (name, tensor) in self.tensors.iter().filter(|(name, _)| wanted(name)) {
            hash.update(format!("{name} {:?}\n", tensor.shape));
            for value in &tensor.values {
                // As `f32`: the number format of the file does not matter.
                hash.update(value.to_le_bytes());
            }
        }
        hex(&hash.finalize())
    }

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Names of the tensors, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// True if there is a tensor of that name.
    pub fn contains(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// The text under a metadata key.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    /// Checks the kind of the network, if the file contains it.
    ///
    /// # Errors
    /// [`FileError`] when it is another one.
    pub fn check_kind(&self, expected: &'static str) -> Result<()> {
        let kind = self.metadata(KIND_KEY);
        match kind.or_else(|| self.metadata(METHOD_KEY).map(|_| DETECTOR_KIND)) {
            Some(found) if found != expected => Err(self.error(format_args!(
                "weights of kind {found:?}, needed are those of kind {expected:?}"
            ))),
            _ => Ok(()),
        }
    }

    /// The configuration under the key `config`.
    ///
    /// # Errors
    /// See [`Self::metadata_json`].
    pub fn config<T: DeserializeOwned>(&self) -> Result<T> {
        self.metadata_json(CONFIG_KEY)
    }

    /// Network of the file's configuration with its parameters, frozen; `build` gets the path of its variables.
    ///
    /// # Errors
    /// [`FileError`] when the file is of another kind, `build` refuses its configuration, or its tensors are not those of
    /// the network.
    pub fn network<C: DeserializeOwned, N, E: From<FileError> + Display + 'static>(
        &self,
        kind: &'static str,
        device: Device,
        build: impl FnOnce(&nn::Path<'_>, C) -> Result<N, E>,
    ) -> Result<N, E> {
        self.check_kind(kind)?;
        let mut variables = VarStore::new(device);
        let network = build(&variables.root(), self.config()?).at(&self.path)?;
        self.copy_into(&variables)?;
        variables.freeze();
        Ok(network)
    }

    /// Configuration of a detector, from which a network can be built.
    ///
    /// # Errors
    /// [`FileError`] when the file names another kind of network, or a value is out of range; see [`Self::metadata_json`].
    pub fn detector_config(&self) -> Result<DetectorConfig> {
        self.check_kind(DETECTOR_KIND)?;
        let config: DetectorConfig = self.config()?;
        config.validate().at(&self.path)?;
        Ok(config)
    }

    /// The JSON under a metadata key.
    ///
    /// # Errors
    /// [`FileError`] when the key is missing, or its JSON has another form.
    pub fn metadata_json<T: DeserializeOwned>(&self, key: &str) -> Result<T> {
        let Some(text) = self.metadata.get(key) else {
            let found: Vec<&String> = self.metadata.keys().collect();
            let problem = format_args!("metadata has no key {key:?}; it has {found:?}");
            return Err(self.error(problem));
        };
        serde_json::from_str(text)
            .map_err(|error| self.error(format_args!("metadata {key:?}: {error}")))
    }

    /// Scales of the activations for 8-bit inference; `None` if the file has none, or if it is for floating point.
    ///
    /// # Errors
    /// [`FileError`] when the JSON has another form.
    pub fn activation_scales(&self) -> Result<Option<ActivationScales>> {
        let is_there = self.metadata.contains_key(SCALES_KEY);
        is_there.then(|| self.metadata_json(SCALES_KEY)).transpose()
    }

    /// The same weights for a number format: in [`InferencePrecision::Float`] the scales of activations are ignored.
    pub fn with_precision(mut self, precision: InferencePrecision) -> Self {
        if precision == InferencePrecision::Float {
            self.metadata.remove(SCALES_KEY);
        }
        self
    }

    /// The error of quantising these weights.
    pub fn quantise_error(&self, error: impl Into<QuantiseError>) -> FileError {
        self.error(format_args!("int8: {}", error.into()))
    }

    fn error(&self, problem: impl Display) -> FileError {
        FileError::new(&self.path, problem)
    }

    /// Copies the parameters into a network; tensors that the network does not have are ignored.
    ///
    /// # Errors
    /// [`FileError`] names the tensor that does not fit; nothing is copied
    /// then.
    pub fn copy_into(&self, network: &VarStore) -> Result<()> {
        self.copy_some_into(network, |_| true)
    }

    /// The same for the parameters whose name is `wanted`; the network's others keep their values.
    ///
    /// # Errors
    /// As [`Self::copy_into`].
    pub fn copy_some_into(&self, network: &VarStore, wanted: impl Fn(&str) -> bool) -> Result<()> {
        let mut variables: BTreeMap<_, _> = network.variables().into_iter().collect();
        variables.retain(|name, _| wanted(name));
        // All are checked before the first is copied: after an error the network is as it was.
        for (name, variable) in &variables {
            self.checked(name, variable.size())?;
        }
        for (name, mut variable) in variables {
            let source = self.checked(&name, variable.size())?;
            let copied = tch::no_grad(|| {
                let values = tensor(&source.values, &source.shape, Device::Cpu)?;
                variable.f_copy_(&values)
            });
            copied.map_err(|error| {
                self.error(format_args!("tensor {name:?}: {}", first_line(&error)))
            })?;
        }
        Ok(())
    }

    fn checked(&self, name: &str, expected: Vec<i64>) -> Result<&Values> {
        match self.tensors.get(name) {
            Some(tensor) if tensor.shape == expected => Ok(tensor),
            Some(Values { shape, .. }) => Err(self.error(format_args!(
                "tensor {name:?} has shape {shape:?}, the network expects {expected:?}"
            ))),
            None => Err(self.error(format_args!(
                "tensor {name:?} is missing (the network expects shape {expected:?})"
            ))),
        }
    }
}

/// Metadata and tensors of a safetensors file.
///
/// # Errors
/// A message if it is truncated or of another format.
pub fn parsed(bytes: &[u8]) -> Result<(HashMap<String, String>, SafeTensors<'_>), String> {
    let parts = SafeTensors::read_metadata(bytes)
        .and_then(|(_, header)| Ok((header, SafeTensors::deserialize(bytes)?)));
    let (header, tensors) = parts.map_err(|error| {
        let size = bytes.len();
        format!("not a complete safetensors file ({size} bytes): {error}")
    })?;
    Ok((header.metadata().clone().unwrap_or_default(), tensors))
}

/// The values of one tensor as `f32`; `None` for 64-bit integers.
fn read_values(path: &Path, name: &str, view: &TensorView<'_>) -> Result<Option<Vec<f32>>> {
    let data = view.data();
    let values: Vec<f32> = match view.dtype() {
        Dtype::F16 => numbers(data, |bytes| f16::from_le_bytes(bytes).to_f32()),
        Dtype::BF16 => numbers(data, |bytes| bf16::from_le_bytes(bytes).to_f32()),
        Dtype::F32 => numbers(data, f32::from_le_bytes),
        // Beyond the range of `f32` it becomes infinite, which the check below refuses.
        Dtype::F64 => numbers(data, |bytes| f64::from_le_bytes(bytes) as f32),
        Dtype::I64 => return Ok(None),
        dtype => {
            let problem = format_args!(
                "tensor {name:?} is of type {dtype:?}; parameters are F16, BF16, F32 or F64"
            );
            return Err(FileError::new(path, problem));
        }
    };
    check_finite(path, name, &values)?;
    match values.iter().position(|value| *value < 0.0) {
        // The square root of a negative variance is NaN.
        Some(index) if name.ends_with(VARIANCE_NAME) => {
            let holds = holds(name, &values, index);
            let problem = format_args!("{holds}; a variance is at least 0");
            Err(FileError::new(path, problem))
        }
        _ => Ok(Some(values)),
    }
}

/// Numbers of `N` bytes each.
pub(crate) fn numbers<const N: usize>(data: &[u8], number: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let chunks = data.as_chunks().0.iter();
    chunks.map(|&bytes| number(bytes)).collect()
}

fn check_finite(path: &Path, name: &str, values: &[f32]) -> Result<()> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(FileError::new(path, holds(name, values, index))),
    }
}

fn holds(name: &str, values: &[f32], index: usize) -> String {
    let value = values[index];
    format!("tensor {name:?} holds {value} at index {index}")
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::model_config::ConfigError;
    use crate::pillars::point_pillars::PointPillars;

    fn small() -> DetectorConfig {
        DetectorConfig {
            lidar_range_m: [-6.4, -6.4, -3.0, 6.4, 6.4, 1.0],
            pillar_channels: 8,
            num_filters: vec![8; 3],
            num_upsample_filters: vec![8; 3],
            ..DetectorConfig::lean()
        }
    }

    fn network(config: &DetectorConfig) -> VarStore {
        let network = VarStore::new(Device::Cpu);
        PointPillars::new(&network.root(), config).unwrap();
        network
    }

    fn metadata(config: &DetectorConfig) -> BTreeMap<String, String> {
        [(
            CONFIG_KEY.to_owned(),
            serde_json::to_string(config).unwrap(),
        )]
        .into()
    }

    #[test]
    fn a_saved_network_comes_back_with_its_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("net.safetensors");
        let config = small();
        let first = network(&config);
        let sha256 = save(&path, &first, &metadata(&config), Precision::Single).unwrap();
        let weights = Weights::load(&path).unwrap();
        assert_eq!(weights.sha256(), sha256);
        assert_eq!(weights.detector_config().unwrap(), config);
        assert_ne!(
            weights.sha256_of(|name| name.starts_with("cls_head")),
            weights.sha256_of(|name| !name.starts_with("cls_head"))
        );
        let second = network(&config);
        weights.copy_into(&second).unwrap();
        let copies = second.variables();
        assert!(
            first
                .variables()
                .iter()
                .all(|(name, tensor)| tensor.equal(&copies[name]))
        );
    }

    #[test]
    fn a_configuration_of_no_network_is_named_with_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flat.safetensors");
        let mut config = small();
        config.anchors.size_lwh_m[0] = -3.9;
        let nothing = VarStore::new(Device::Cpu);
        save(&path, &nothing, &metadata(&config), Precision::Single).unwrap();
        let weights = Weights::load(&path).unwrap();
        let message = weights.detector_config().unwrap_err().to_string();
        let reason = "anchors.size_lwh_m is [-3.9, 1.6, 1.56]";
        assert!(message.contains("flat.safetensors: "), "{message}");
        assert!(message.contains(reason), "{message}");
        let build = |_: &nn::Path<'_>, config: DetectorConfig| config.validate();
        let built: Result<(), ConfigError> = weights.network(DETECTOR_KIND, Device::Cpu, build);
        assert_eq!(built.unwrap_err().to_string(), message);
    }

    #[test]
    fn another_kind_of_network_is_named_before_its_configuration_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("encoder.safetensors");
        let about = [
            (CONFIG_KEY, r#"{"voxel_m": 0.5}"#),
            (KIND_KEY, "scene encoder"),
        ];
        let about = about
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .into();
        save(&path, &network(&small()), &about, Precision::Single).unwrap();
        let message = Weights::load(&path)
            .unwrap()
            .detector_config()
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("\"scene encoder\"") && message.contains("\"detector\""),
            "{message}"
        );
        let about = [(METHOD_KEY.to_owned(), "max".to_owned())].into();
        save(&path, &network(&small()), &about, Precision::Single).unwrap();
        let message = Weights::load(&path)
            .unwrap()
            .check_kind("scene encoder")
            .unwrap_err()
            .to_string();
        assert!(message.contains("\"detector\""), "{message}");
    }

    #[test]
    fn half_precision_halves_matrices_and_keeps_vectors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("net.safetensors");
        let first = network(&small());
        save(&path, &first, &metadata(&small()), Precision::Half).unwrap();
        let second = network(&small());
        Weights::load(&path).unwrap().copy_into(&second).unwrap();
        let copies = second.variables();
        for (name, tensor) in first.variables() {
            let tolerance = if tensor.dim() > 1 { 1e-3 } else { 0.0 };
            assert!(
                tensor.allclose(&copies[&name], tolerance, 1e-6, false),
                "{name}"
            );
        }
    }

    #[test]
    fn a_file_of_another_configuration_is_named_with_both_shapes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.safetensors");
        save(
            &path,
            &network(&small()),
            &metadata(&small()),
            Precision::Single,
        )
        .unwrap();
        let weights = Weights::load(&path).unwrap();
        let wide = DetectorConfig {
            pillar_channels: 16,
            ..small()
        };
        let message = weights.copy_into(&network(&wide)).unwrap_err().to_string();
        for part in [
            "other.safetensors",
            "backbone.blocks.0.1.weight",
            "[8, 8, 3, 3]",
            "[8, 16, 3, 3]",
        ] {
            assert!(message.contains(part), "{message}");
        }
        let deep = DetectorConfig {
            layer_nums: vec![2, 3, 4],
            ..small()
        };
        let message = weights.copy_into(&network(&deep)).unwrap_err().to_string();
        assert!(
            message.contains("backbone.blocks.2.13.weight") && message.contains("missing"),
            "{message}"
        );
        let message = weights
            .metadata_json::<DetectorConfig>("fusion")
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("fusion") && message.contains("config"),
            "{message}"
        );
    }

    #[test]
    fn missing_and_truncated_files_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cut.safetensors");
        assert_eq!(Weights::load(&path).unwrap_err().path, path);
        save(
            &path,
            &network(&small()),
            &metadata(&small()),
            Precision::Single,
        )
        .unwrap();
        let bytes = std::fs::read(&path).unwrap();
        for length in [0, 7, 100, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let message = Weights::load(&path).unwrap_err().to_string();
            assert!(
                message.contains("cut.safetensors") && message.contains(&length.to_string()),
                "{message}"
            );
        }
    }

    #[test]
    fn a_negative_variance_is_refused_with_the_name_of_its_tensor() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("variance.safetensors");
        let network = network(&small());
        let name = "backbone.blocks.0.2.running_var";
        let _ = tch::no_grad(|| network.variables()[name].get(3).fill_(-0.25));
        save(&path, &network, &metadata(&small()), Precision::Single).unwrap();
        let message = Weights::load(&path).unwrap_err().to_string();
        let expected = format!("tensor {name:?} holds -0.25 at index 3");
        assert!(message.contains(&expected), "{message}");
    }

    #[test]
    fn a_parameter_of_32_bit_integers_is_refused_with_its_type() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("int.safetensors");
        save(
            &path,
            &network(&small()),
            &metadata(&small()),
            Precision::Single,
        )
        .unwrap();
        // The type of the first tensor of the header.
        let bytes = std::fs::read(&path).unwrap();
        let at = bytes
            .windows(5)
            .position(|part| part == b"\"F32\"")
            .unwrap();
        let mut changed = bytes;
        changed[at + 1] = b'I';
        std::fs::write(&path, changed).unwrap();
        let message = Weights::load(&path).unwrap_err().to_string();
        assert!(
            message.contains("is of type I32; parameters are"),
            "{message}"
        );
    }

    #[test]
    fn values_that_are_not_finite_are_neither_written_nor_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("nan.safetensors");
        let network = network(&small());
        let _ = tch::no_grad(|| network.variables()["cls_head.bias"].get(1).fill_(f64::NAN));
        let message = save(&path, &network, &metadata(&small()), Precision::Half)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("cls_head.bias") && message.contains("index 1"),
            "{message}"
        );
        assert!(!path.exists());
    }
}
