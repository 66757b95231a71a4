//! Quantised operators of oneDNN in libtorch, called through TorchScript.
//!
//! libtorch offers them to its dispatcher only, so a TorchScript module of four methods calls them. Its archive is made
//! here: a zip of a few text files.

use std::io::{Cursor, Write};
use std::sync::OnceLock;

use tch::{CModule, IValue, TchError, Tensor};
use zip::result::ZipError;
use zip::write::FileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Source of the module.
const SOURCE: &str = include_str!("operators.py");
/// The module object: an instance of `Operators` whose only attribute is `training = False` (pickle, protocol 2).
const INSTANCE: &[u8] =
    b"\x80\x02c__torch__\nOperators\nq\x00)\x81}(X\x08\x00\x00\x00trainingq\x01\x89ubq\x02.";
/// Constants of the source: an empty tuple (pickle, protocol 2).
const CONSTANTS: &[u8] = b"\x80\x02).";
/// Version of the archive's format.
const VERSION: &[u8] = b"3\n";

/// The operators.
pub(super) struct Operators(CModule);

impl Operators {
    /// The operators of this process.
    ///
    /// # Errors
    /// That of the tensor library when it was built without oneDNN.
    pub(super) fn get() -> Result<&'static Self, TchError> {
        static OPERATORS: OnceLock<Operators> = OnceLock::new();
        if let Some(operators) = OPERATORS.get() {
            return Ok(operators);
        }
        // Outside of `get_or_init`, as it may fail: of two threads that load at once one drops its module.
        let module = CModule::load_data(&mut Cursor::new(archive()?))?;
        Ok(OPERATORS.get_or_init(|| Self(module)))
    }

    /// Calls a method.
    pub(super) fn call(&self, method: &str, arguments: &[IValue]) -> Result<Tensor, TchError> {
        match self.0.method_is(method, arguments)? {
            IValue::Tensor(tensor) => Ok(tensor),
            other => Err(TchError::Kind(format!(
                "{method} gave {other:?} instead of a tensor"
            ))),
        }
    }
}

/// The module as TorchScript stores it.
fn archive() -> Result<Vec<u8>, TchError> {
    let files = [
        ("data.pkl", INSTANCE),
        ("code/__torch__.py", SOURCE.as_bytes()),
        ("constants.pkl", CONSTANTS),
        ("version", VERSION),
    ];
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in files {
        let options = FileOptions::default().compression_method(CompressionMethod::Stored);
        zip.start_file(format!("operators/{name}"), options)
            .map_err(failed)?;
        zip.write_all(content)?;
    }
    Ok(zip.finish().map_err(failed)?.into_inner())
}

fn failed(error: ZipError) -> TchError {
    TchError::FileFormat(error.to_string())
}
