//! What can be wrong with a weights file.

use std::io;
use std::path::PathBuf;

use safetensors::tensor::{Dtype, SafeTensorError};
use tch::TchError;

use crate::torch_error::first_line;

/// Why parameters could not be read or written. Every message begins with the file.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file is missing or not readable, or the folder not writable.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is cut off or no safetensors file.
    #[error("{}: not a whole safetensors file ({size} bytes): {source}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Its size.
        size: usize,
        /// What is wrong.
        source: SafeTensorError,
    },
    /// The weights are those of another network.
    #[error("{}: weights of kind {found:?}, needed are those of kind {expected:?}", path.display())]
    Kind {
        /// The file.
        path: PathBuf,
        /// What it holds.
        found: String,
        /// What is needed.
        expected: &'static str,
    },
    /// The metadata has no such key.
    #[error("{}: metadata has no key {key:?}; it has {found:?}", path.display())]
    NoMetadata {
        /// The file.
        path: PathBuf,
        /// The key looked for.
        key: String,
        /// The keys there are.
        found: Vec<String>,
    },
    /// The JSON under a metadata key does not say what is needed.
    #[error("{}: metadata {key:?}: {source}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// The key.
        key: String,
        /// What is wrong.
        source: serde_json::Error,
    },
    /// The network has a parameter that the file lacks.
    #[error("{}: tensor {name:?} is missing (the network expects shape {expected:?})", path.display())]
    MissingTensor {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Shape in the network.
        expected: Vec<i64>,
    },
    /// A tensor of the file was made for another configuration.
    #[error("{}: tensor {name:?} has shape {found:?}, the network expects {expected:?}", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Shape in the file.
        found: Vec<i64>,
        /// Shape in the network.
        expected: Vec<i64>,
    },
    /// A tensor is of a type that parameters are not stored in.
    #[error("{}: tensor {name:?} is of type {dtype:?}; parameters are F16, BF16, F32 or F64", path.display())]
    Dtype {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Its type.
        dtype: Dtype,
    },
    /// A parameter is NaN or infinite.
    #[error("{}: tensor {name:?} holds {value} at index {index}", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Where.
        index: usize,
        /// What.
        value: f32,
    },
    /// The tensor library refused.
    #[error("{}: tensor {name:?}: {}", path.display(), first_line(source))]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// What it said.
        source: TchError,
    },
}
