//! Which weights a method runs with.

use std::path::{Path, PathBuf};

use ego_fuser::Method;

/// Why a method has no weights.
#[derive(Debug, thiserror::Error)]
pub enum WeightsChoiceError {
    /// The folder cannot be listed.
    #[error("{}: {source}", folder.display())]
    Io {
        /// The folder.
        folder: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder has none, or several.
    #[error("{}: {found} files named *-{name}.safetensors, method {method} needs one", folder.display())]
    NotOne {
        /// The folder.
        folder: PathBuf,
        /// The method.
        method: Method,
        /// The method it would be trained for.
        name: Method,
        /// How many there are.
        found: usize,
    },
}

/// The weights of a method: `path` itself, or the one file `*-METHOD.safetensors` in the folder `path`.
///
/// `late` exchanges what every vehicle finds alone, so it runs with the weights of `none`; so does `early` where the
/// folder has none of its own.
///
/// # Errors
/// [`WeightsChoiceError`] when the folder does not hold exactly one.
pub fn weights_of(path: &Path, method: Method) -> Result<PathBuf, WeightsChoiceError> {
    if !path.is_dir() {
        return Ok(path.to_path_buf());
    }
    let candidates: &[Method] = match method {
        Method::Late => &[Method::None],
        Method::Early => &[Method::Early, Method::None],
        _ => &[method],
    };
    let mut last = (method, 0);
    for &name in candidates {
        let mut files = files_of(path, name)?;
        match (files.pop(), files.len()) {
            (Some(file), 0) => return Ok(file),
            (None, _) => last = (name, 0),
            (Some(_), others) => {
                last = (name, others + 1);
                break;
            }
        }
    }
    let (name, found) = last;
    Err(WeightsChoiceError::NotOne { folder: path.to_path_buf(), method, name, found })
}

fn files_of(folder: &Path, name: Method) -> Result<Vec<PathBuf>, WeightsChoiceError> {
    let io = |source| WeightsChoiceError::Io { folder: folder.to_path_buf(), source };
    let ending = format!("-{name}.safetensors");
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        if entry.file_name().to_string_lossy().ends_with(&ending) {
            files.push(entry.path());
        }
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_holds_one_file_per_method() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["lean-none.safetensors", "lean-max.safetensors", "full-max.safetensors", "lean-none.md"] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        let of = |method| weights_of(folder.path(), method);
        for method in [Method::None, Method::Late, Method::Early] {
            assert!(of(method).unwrap().ends_with("lean-none.safetensors"), "{method}");
        }
        std::fs::write(folder.path().join("lean-early.safetensors"), b"").unwrap();
        assert!(of(Method::Early).unwrap().ends_with("lean-early.safetensors"));
        assert!(of(Method::Max).unwrap_err().to_string().contains("2 files named *-max.safetensors"));
        assert!(of(Method::Attention).unwrap_err().to_string().contains("0 files"));
        assert_eq!(weights_of(Path::new("w.safetensors"), Method::Late).unwrap(), Path::new("w.safetensors"));
    }
}
