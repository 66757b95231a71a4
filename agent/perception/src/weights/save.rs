//! Writer of weights files.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use half::f16;
use protocol::text::hex;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView};
use serde_json::Value;
use sha2::{Digest, Sha256};
use support::atomic_file;
use support::file_error::{AtFile, FileError};
use tch::Tensor;
use tch::nn::VarStore;

use super::check_finite;
use crate::tensor_values::values;
use crate::torch_error::first_line;

/// Number format of parameters on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// Single precision, bit-exact: checkpoints.
    Single,
    /// Half precision: released weights. Vectors (norms, biases) and values out of the range of `f16` stay `f32`.
    Half,
}

/// Writes all variables of a network.
///
/// `metadata` holds texts for the header; the configuration belongs under [`CONFIG_KEY`](super::CONFIG_KEY). The file
/// is replaced atomically.
///
/// Returns the SHA-256 of the file.
///
/// # Errors
/// [`FileError`] when a parameter is not finite or the file cannot be written.
pub fn save(
    path: &Path,
    network: &VarStore,
    metadata: &BTreeMap<String, String>,
    precision: Precision,
) -> Result<String, FileError> {
    let mut stored = Vec::new();
    for (name, variable) in network.variables() {
        let values = values(&variable).map_err(|error| {
            let problem = format_args!("tensor {name:?}: {}", first_line(&error));
            FileError::new(path, problem)
        })?;
        check_finite(path, &name, &values)?;
        let fits = values.iter().all(|value| value.abs() <= f16::MAX.to_f32());
        let dtype = match precision {
            Precision::Half if variable.dim() > 1 && fits => Dtype::F16,
            _ => Dtype::F32,
        };
        stored.push(Stored::new(name, &variable, &values, dtype));
    }
    let bytes = file_bytes(&stored, metadata.clone().into_iter().collect()).at(path)?;
    let bytes = with_header(&bytes, |_| ()).at(path)?;
    atomic_file::write(path, &bytes).at(path)?;
    Ok(hex(&Sha256::digest(&bytes)))
}

/// The same file with a changed header, in the order of names: the library writes metadata in the order of a hash map,
/// and equal weights should give equal files. `file` was read or written by the library: its length and header are valid.
pub fn with_header(
    file: &[u8],
    change: impl FnOnce(&mut BTreeMap<String, Value>),
) -> Result<Vec<u8>, serde_json::Error> {
    // Length of the header (8 bytes, little endian), header, data. Offsets count from the data.
    let length: [u8; 8] = std::array::from_fn(|byte| file.get(byte).copied().unwrap_or(0));
    let (header, data) = file[8..].split_at(u64::from_le_bytes(length) as usize);
    let mut entries = serde_json::from_slice(header)?;
    change(&mut entries);
    entries.values_mut().for_each(Value::sort_all_objects);
    let mut header = serde_json::to_vec(&entries)?;
    // Tensor data begin at a multiple of eight.
    header.resize(header.len().next_multiple_of(8), b' ');
    let length = (header.len() as u64).to_le_bytes();
    Ok([&length, header.as_slice(), data].concat())
}

/// A tensor as it is in a file.
pub(crate) struct Stored {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Stored {
    /// The `values` of a tensor as `dtype`: `f16` or `f32`.
    pub(crate) fn new(name: String, tensor: &Tensor, values: &[f32], dtype: Dtype) -> Self {
        let values = values.iter().copied();
        Self {
            name,
            dtype,
            shape: tensor.size().iter().map(|&size| size as usize).collect(),
            bytes: match dtype {
                Dtype::F16 => values
                    .flat_map(|value| f16::from_f32(value).to_le_bytes())
                    .collect(),
                _ => values.flat_map(f32::to_le_bytes).collect(),
            },
        }
    }
}

/// The file of some tensors with texts in its header.
pub(crate) fn file_bytes(
    tensors: &[Stored],
    header: HashMap<String, String>,
) -> Result<Vec<u8>, SafeTensorError> {
    let mut views = Vec::new();
    for stored in tensors {
        let view = TensorView::new(stored.dtype, stored.shape.clone(), &stored.bytes)?;
        views.push((&stored.name, view));
    }
    safetensors::serialize(views, Some(header))
}
