//! Annotation of an existing weights file with a text.

use std::path::Path;

use protocol::text::hex;
use serde_json::{Map, Value};
use sha2::{Digest, Sha256};
use support::file_error::{AtFile, FileError};
use support::{atomic_file, bounded_file};

use super::save::with_header;
use super::{MAX_BYTES, parsed};

/// Key of the header that contains the metadata.
const METADATA: &str = "__metadata__";

/// Sets the text of a metadata key of a file. Tensors stay as they are; the file is replaced atomically. Returns its
/// SHA-256.
///
/// # Errors
/// [`FileError`] when the file is missing, not a complete safetensors file or not writable.
pub fn annotate(path: &Path, key: &str, text: &str) -> Result<String, FileError> {
    let old = bounded_file::read(path, MAX_BYTES).at(path)?;
    // `with_header` relies on a valid length and header.
    parsed(&old).at(path)?;
    let new = with_header(&old, |entries| {
        let metadata = entries.entry(METADATA.to_owned());
        if let Value::Object(texts) = metadata.or_insert_with(|| Value::Object(Map::new())) {
            texts.insert(key.to_owned(), Value::String(text.to_owned()));
        }
    });
    let new =
        new.map_err(|error| FileError::new(path, format_args!("metadata {key:?}: {error}")))?;
    atomic_file::write(path, &new).at(path)?;
    Ok(hex(&Sha256::digest(&new)))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;

    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;
    use crate::weights::{Precision, Weights, save};

    #[test]
    fn a_text_is_added_and_replaced_and_nothing_else_changes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        let network = VarStore::new(Device::Cpu);
        let _ = network.root().ones("a", &[3]);
        let _ = network.root().randn_standard("b", &[2, 2]);
        let metadata = BTreeMap::from([("config".to_owned(), "{\"x\":1}".to_owned())]);
        save(&path, &network, &metadata, Precision::Single).unwrap();
        let before = network.variables()["b"].copy();
        for text in ["first", "second \"text\""] {
            let sha256 = annotate(&path, "confidence", text).unwrap();
            let weights = Weights::load(&path).unwrap();
            assert_eq!(
                (weights.metadata("confidence"), weights.sha256()),
                (Some(text), sha256.as_str())
            );
            assert_eq!(weights.metadata("config"), Some("{\"x\":1}"));
            let _ = tch::no_grad(|| network.variables()["b"].shallow_clone().zero_());
            weights.copy_into(&network).unwrap();
            let off = (network.variables()["b"].shallow_clone() - &before)
                .abs()
                .max()
                .to_kind(Kind::Double);
            assert_eq!(off.double_value(&[]), 0.0);
        }
    }

    #[test]
    fn other_files_are_not_changed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        fs::write(&path, b"12345678 and no header").unwrap();
        let message = annotate(&path, "a", "b").unwrap_err().to_string();
        assert!(message.contains("w.safetensors"), "{message}");
        assert_eq!(fs::read(&path).unwrap(), b"12345678 and no header");
    }
}
