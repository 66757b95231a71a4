//! Choice of the weights of a method.

use std::path::{Path, PathBuf};

use fusion::method::Exchange;
use fusion::{Method, box_input};
use perception::weights::Weights;
use support::file_error::{AtFile, FileError, Result};

/// File name of the weights of a training.
const TRAINED_FILE: &str = "weights.safetensors";

/// The weights of a method: `path` itself; of the folder `path` the one file `*-METHOD.safetensors` or
/// `METHOD/weights.safetensors`, or if it has neither, `weights.safetensors` of a training of that method. With
/// `reads_boxes`, where neighbours send boxes, the one file `*-METHOD-boxes.safetensors` or
/// `METHOD-boxes/weights.safetensors` comes first.
///
/// `late` exchanges the ego-only detections of every vehicle, so it runs with the weights of `none`; so does `early` if
/// the folder has none of its own.
///
/// # Errors
/// [`FileError`] when the folder does not hold exactly one, and with `reads_boxes` when a method that fuses feature maps
/// would leave boxes out.
pub(crate) fn weights_of(path: &Path, method: Method, reads_boxes: bool) -> Result<PathBuf> {
    // Only a method that fuses feature maps needs a box input beside them.
    if !reads_boxes || method.exchange() != Exchange::Features {
        return one_of(path, method);
    }
    let file = match path.is_dir() {
        false => path.to_path_buf(),
        true => match &files_of(path, &format!("{method}-boxes"))?[..] {
            [file] => file.clone(),
            [] => one_of(path, method)?,
            several => {
                let problem = format!("{} files are {method}-boxes, expected one", several.len());
                return Err(FileError::new(path, problem));
            }
        },
    };
    if !box_input::is_in(&Weights::load(&file)?) {
        let problem = "has no box input, and the boxes of neighbours would be left out";
        return Err(FileError::new(file, problem));
    }
    Ok(file)
}

/// The weights of a method where neighbours send what it fuses.
fn one_of(path: &Path, method: Method) -> Result<PathBuf> {
    if !path.is_dir() {
        return Ok(path.to_path_buf());
    }
    let candidates = method.weights_names();
    let (mut name, mut found) = (method.name(), Vec::new());
    for &candidate in &candidates {
        // Several files of a better name are an error, which a worse name must not hide.
        (name, found) = (candidate, files_of(path, candidate)?);
        if !found.is_empty() {
            break;
        }
    }
    if let [file] = &found[..] {
        return Ok(file.clone());
    }
    let (trained, found) = (path.join(TRAINED_FILE), found.len());
    if found == 0 && trained.is_file() {
        method.check_training(&Weights::load(&trained)?)?;
        return Ok(trained);
    }
    let files = format!("*-{name}.safetensors or {name}/{TRAINED_FILE}");
    let problem =
        format!("{found} files named {files}, method {method} needs one, or {TRAINED_FILE}");
    Err(FileError::new(path, problem))
}

fn files_of(folder: &Path, name: &str) -> Result<Vec<PathBuf>> {
    let ending = format!("-{name}.safetensors");
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).at(folder)? {
        let entry = entry.at(folder)?;
        if entry.file_name().to_string_lossy().ends_with(&ending) {
            files.push(entry.path());
        }
    }
    let trained = folder.join(name).join(TRAINED_FILE);
    files.extend(trained.is_file().then_some(trained));
    Ok(files)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use perception::weights::{METHOD_KEY, Precision, save};
    use tch::Device;
    use tch::nn::{Init, VarStore};

    use super::*;

    #[test]
    fn a_folder_holds_one_file_per_method() {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "lean-none.safetensors",
            "lean-max.safetensors",
            "full-max.safetensors",
            "lean-none.md",
        ] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        for method in [Method::NONE, Method::LATE, Method::EARLY] {
            let file = weights_of(folder.path(), method, false).unwrap();
            assert!(file.ends_with("lean-none.safetensors"), "{method}");
        }
        std::fs::write(folder.path().join("lean-early.safetensors"), b"").unwrap();
        let file = weights_of(folder.path(), Method::EARLY, false).unwrap();
        assert!(file.ends_with("lean-early.safetensors"));
        for (method, problem) in [
            (Method::MAX, "2 files named *-max.safetensors"),
            (Method::ATTENTION, "0 files"),
        ] {
            let error = weights_of(folder.path(), method, false).unwrap_err();
            assert!(error.to_string().contains(problem), "{error}");
        }
        assert_eq!(
            weights_of(Path::new("w.safetensors"), Method::LATE, true).unwrap(),
            Path::new("w.safetensors")
        );
    }

    /// A training's folder with weights that name their method.
    fn write_trained(folder: &Path, method: Method) {
        std::fs::create_dir_all(folder).unwrap();
        let variables = VarStore::new(Device::Cpu);
        let _ = variables.root().var("weight", &[2], Init::Const(1.0));
        let about = BTreeMap::from([(METHOD_KEY.to_owned(), method.name().to_owned())]);
        save(
            &folder.join(TRAINED_FILE),
            &variables,
            &about,
            Precision::Single,
        )
        .unwrap();
    }

    #[test]
    fn where_neighbours_send_boxes_weights_read_them_or_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for method in [Method::NONE, Method::MAX] {
            write_trained(&folder.path().join(method.name()), method);
        }
        let file = weights_of(folder.path(), Method::LATE, true).unwrap();
        assert!(file.ends_with("none/weights.safetensors"));
        let error = weights_of(folder.path(), Method::MAX, true).unwrap_err();
        let refused = error.to_string();
        assert!(
            refused.contains("max/weights.safetensors") && refused.contains("no box input"),
            "{refused}"
        );
        let variables = VarStore::new(Device::Cpu);
        let out = variables.root() / "box_input" / "out";
        let _ = out.var("weight", &[2], Init::Const(1.0));
        let with = folder.path().join("lean-max-boxes.safetensors");
        save(&with, &variables, &BTreeMap::new(), Precision::Single).unwrap();
        assert_eq!(weights_of(folder.path(), Method::MAX, true).unwrap(), with);
    }

    #[test]
    fn the_folder_of_a_training_serves_the_method_it_was_trained_for() {
        let folder = tempfile::tempdir().unwrap();
        write_trained(folder.path(), Method::NONE);
        for method in [Method::NONE, Method::LATE, Method::EARLY] {
            let file = weights_of(folder.path(), method, false).unwrap();
            assert!(file.ends_with(TRAINED_FILE), "{method}");
        }
        let error = weights_of(folder.path(), Method::ATTENTION, false).unwrap_err();
        let refused = error.to_string();
        assert!(
            refused.contains(
                "trained for none, and method attention needs weights trained for attention"
            ),
            "{refused}"
        );
    }

    #[test]
    fn trainings_side_by_side_are_found_by_the_names_of_their_methods() {
        let folder = tempfile::tempdir().unwrap();
        for method in [Method::NONE, Method::MAX] {
            write_trained(&folder.path().join(method.name()), method);
        }
        for (method, name) in [(Method::MAX, "max"), (Method::LATE, "none")] {
            assert_eq!(
                weights_of(folder.path(), method, false).unwrap(),
                folder.path().join(name).join(TRAINED_FILE)
            );
        }
        let error = weights_of(folder.path(), Method::ATTENTION, false).unwrap_err();
        assert!(error.to_string().contains("attention/weights.safetensors"));
        std::fs::write(folder.path().join("lean-max.safetensors"), b"").unwrap();
        let error = weights_of(folder.path(), Method::MAX, false).unwrap_err();
        assert!(
            error.to_string().contains("2 files"),
            "two that could be meant"
        );
    }
}
