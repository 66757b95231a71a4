//! Errors of weights files.

use std::io;
use std::path::PathBuf;

use safetensors::tensor::{Dtype, SafeTensorError};
use tch::TchError;

use crate::int8::QuantiseError;
use crate::torch_error::first_line;

/// Error of reading or writing parameters. Every message begins with the file.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file is missing or not readable, or the folder not writable.
    #[error("{}: {source}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The file is truncated or no safetensors file.
    #[error("{}: not a complete safetensors file ({size} bytes): {source}", path.display())]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Its size, bytes.
        size: usize,
        /// Error of the format.
        source: SafeTensorError,
    },
    /// The weights are those of another network.
    #[error("{}: weights of kind {found:?}, needed are those of kind {expected:?}", path.display())]
    Kind {
        /// Path of the file.
        path: PathBuf,
        /// Kind in the file.
        found: String,
        /// Required kind.
        expected: &'static str,
    },
    /// The metadata has no such key.
    #[error("{}: metadata has no key {key:?}; it has {found:?}", path.display())]
    NoMetadata {
        /// Path of the file.
        path: PathBuf,
        /// Missing key.
        key: String,
        /// Existing keys.
        found: Vec<String>,
    },
    /// The JSON under a metadata key does not have the required form.
    #[error("{}: metadata {key:?}: {source}", path.display())]
    Metadata {
        /// Path of the file.
        path: PathBuf,
        /// Key of the metadata.
        key: String,
        /// Error of the JSON.
        source: serde_json::Error,
    },
    /// The weights cannot be quantised.
    #[error("{}: int8: {source}", path.display())]
    Quantise {
        /// Path of the file.
        path: PathBuf,
        /// Missing scale, or error of the tensor library.
        source: QuantiseError,
    },
    /// The network has a parameter that the file lacks.
    #[error("{}: tensor {name:?} is missing (the network expects shape {expected:?})", path.display())]
    MissingTensor {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Shape in the network.
        expected: Vec<i64>,
    },
    /// A tensor of the file was made for another configuration.
    #[error("{}: tensor {name:?} has shape {found:?}, the network expects {expected:?}", path.display())]
    Shape {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Shape in the file.
        found: Vec<i64>,
        /// Shape in the network.
        expected: Vec<i64>,
    },
    /// A tensor is of a type that is not valid for parameters.
    #[error("{}: tensor {name:?} is of type {dtype:?}; parameters are F16, BF16, F32 or F64", path.display())]
    Dtype {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Type of the tensor.
        dtype: Dtype,
    },
    /// A parameter is NaN or infinite.
    #[error("{}: tensor {name:?} holds {value} at index {index}", path.display())]
    NotFinite {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Index in row-major order.
        index: usize,
        /// Value at the index.
        value: f32,
    },
    /// A variance of a normalisation layer is negative.
    #[error("{}: tensor {name:?} holds {value} at index {index}; a variance is at least 0", path.display())]
    Variance {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Index in row-major order.
        index: usize,
        /// Value at the index.
        value: f32,
    },
    /// The tensor library failed.
    #[error("{}: tensor {name:?}: {}", path.display(), first_line(source))]
    Tensor {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
        /// Error of the tensor library.
        source: TchError,
    },
}
