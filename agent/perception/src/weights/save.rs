//! Writer of weights files.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use half::f16;
use protocol::text::hex;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView};
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
        stored.push(store(path, name, &variable, precision)?);
    }
    let views: Result<Vec<_>, SafeTensorError> = (stored.iter())
        .map(|tensor| {
            Ok((
                &tensor.name,
                TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes)?,
            ))
        })
        .collect();
    let header: HashMap<_, _> = metadata.clone().into_iter().collect();
    let bytes = safetensors::serialize(views.at(path)?, Some(header)).at(path)?;
    let bytes = with_sorted_header(bytes);
    atomic_file::write(path, &bytes).at(path)?;
    Ok(hex(&Sha256::digest(&bytes)))
}

/// The same file with its header in the order of names: the library writes metadata in the order of a hash map, and
/// equal weights should give equal files.
fn with_sorted_header(bytes: Vec<u8>) -> Vec<u8> {
    let Some((length, rest)) = bytes.split_first_chunk::<8>() else {
        return bytes;
    };
    let Some((header, data)) = rest.split_at_checked(u64::from_le_bytes(*length) as usize) else {
        return bytes;
    };
    let Ok(mut entries) = serde_json::from_slice::<BTreeMap<String, serde_json::Value>>(header)
    else {
        return bytes;
    };
    entries
        .values_mut()
        .for_each(serde_json::Value::sort_all_objects);
    let Ok(mut header) = serde_json::to_vec(&entries) else {
        return bytes;
    };
    // Tensor data begin at a multiple of eight.
    header.resize(header.len().next_multiple_of(8), b' ');
    [
        &(header.len() as u64).to_le_bytes(),
        header.as_slice(),
        data,
    ]
    .concat()
}

struct Stored {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

fn store(
    path: &Path,
    name: String,
    variable: &Tensor,
    precision: Precision,
) -> Result<Stored, FileError> {
    let shape: Vec<usize> = variable.size().iter().map(|&size| size as usize).collect();
    let values = values(variable).map_err(|error| {
        FileError::new(
            path,
            format_args!("tensor {name:?}: {}", first_line(&error)),
        )
    })?;
    check_finite(path, &name, &values)?;
    let fits = values.iter().all(|value| value.abs() <= f16::MAX.to_f32());
    let (dtype, bytes) = if precision == Precision::Half && shape.len() > 1 && fits {
        (
            Dtype::F16,
            values
                .iter()
                .flat_map(|&value| f16::from_f32(value).to_le_bytes())
                .collect(),
        )
    } else {
        (
            Dtype::F32,
            values
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect(),
        )
    };
    Ok(Stored {
        name,
        dtype,
        shape,
        bytes,
    })
}
