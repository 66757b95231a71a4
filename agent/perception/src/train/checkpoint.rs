//! Checkpoint of a training on disk: parameters, moments and counters in one file that is replaced atomically.
//!
//! Order and augmentation of samples follow from seed and step, so no state of a random number generator has to be
//! stored. The one exception are scene-specific heads: one that is resumed begins a new pass over its cells, with all
//! of its sweeps.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors};
use serde::Serialize;
use serde::de::DeserializeOwned;
use support::file_error::{AtFile, FileError};
use support::{atomic_file, bounded_file};
use tch::nn::VarStore;
use tch::{Tensor, no_grad};

use super::adamw::AdamW;
use crate::tensor_values::values;
use crate::weights::{MAX_BYTES, Stored, file_bytes, numbers};

/// Name of the checkpoint in the folder of the results.
pub(super) const CHECKPOINT_FILE: &str = "checkpoint.safetensors";
/// Metadata key of the progress of the training.
const PROGRESS_KEY: &str = "progress";
/// Metadata key of the steps of the optimizer.
const STEPS_KEY: &str = "optimizer_steps";

/// Writes the whole state of a training; `progress` is its state beside parameters and moments.
///
/// # Errors
/// [`FileError`] when the file cannot be written.
pub fn save<P: Serialize>(
    path: &Path,
    variables: &HashMap<String, Tensor>,
    optimizer: &AdamW,
    progress: &P,
) -> Result<(), FileError> {
    let (moments, steps) = optimizer.state();
    let parameters = variables
        .iter()
        .map(|(name, tensor)| (format!("parameter.{name}"), tensor.shallow_clone()));
    let mut stored = Vec::new();
    for (name, tensor) in parameters.chain(moments) {
        let values = values(&tensor).at(path)?;
        stored.push(Stored::new(name, &tensor, &values, Dtype::F32));
    }
    let progress = serde_json::to_string(progress).unwrap_or_default();
    let texts = [(PROGRESS_KEY, progress), (STEPS_KEY, steps.to_string())];
    let header = texts.map(|(key, text)| (key.to_owned(), text)).into();
    let bytes = file_bytes(&stored, header).at(path)?;
    atomic_file::write(path, bytes).at(path)
}

/// Restores a training from a file of [`save`].
///
/// # Errors
/// [`FileError`] when the file is missing, truncated or of another network; nothing has been changed in that
/// case.
pub(crate) fn restore<P: DeserializeOwned>(
    path: &Path,
    variables: &VarStore,
    optimizer: &mut AdamW,
) -> Result<P, FileError> {
    let bytes = bounded_file::read(path, MAX_BYTES).at(path)?;
    let header = SafeTensors::read_metadata(&bytes).map_err(incomplete);
    let (_, header) = header.at(path)?;
    let header = header.metadata().clone().unwrap_or_default();
    let [Some(progress), Some(steps)] = [PROGRESS_KEY, STEPS_KEY].map(|key| header.get(key)) else {
        let problem = format_args!("the header has no {PROGRESS_KEY:?} and {STEPS_KEY:?}");
        return Err(FileError::new(path, problem));
    };
    let progress = serde_json::from_str(progress).at(path)?;
    let steps = steps.parse().at(path)?;
    let tensors = read_tensors(&bytes).map_err(incomplete).at(path)?;
    let mut targets = Vec::new();
    for (name, variable) in variables.variables() {
        let stored = tensors.get(&format!("parameter.{name}"));
        let size = variable.size();
        let stored = stored.filter(|stored| stored.size() == size);
        let stored = stored.ok_or_else(|| format!("no {name:?} of shape {size:?}"));
        targets.push((variable, stored.at(path)?));
    }
    let restored = optimizer.restore(&tensors, steps);
    let restored = restored.map_err(|name| format!("no {name:?} of the right shape"));
    restored.at(path)?;
    // Parameters last: the optimizer may still refuse the file.
    for (mut variable, stored) in targets {
        no_grad(|| variable.f_copy_(stored)).at(path)?;
    }
    Ok(progress)
}

fn incomplete(error: SafeTensorError) -> String {
    format!("not a complete checkpoint: {error}")
}

fn read_tensors(bytes: &[u8]) -> Result<BTreeMap<String, Tensor>, SafeTensorError> {
    let file = SafeTensors::deserialize(bytes)?;
    // Tensors of another type are none of a checkpoint: they are missed by name.
    let all = file.iter().filter(|(_, view)| view.dtype() == Dtype::F32);
    let all = all.map(|(name, view)| {
        let values = numbers(view.data(), f32::from_le_bytes);
        let shape: Vec<i64> = view.shape().iter().map(|&size| size as i64).collect();
        (name.to_owned(), Tensor::from_slice(&values).reshape(shape))
    });
    Ok(all.collect())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use tch::nn::Init;
    use tch::{Device, Kind};

    use super::super::adamw::AdamWConfig;
    use super::*;

    fn network(size: i64) -> (VarStore, AdamW) {
        let variables = VarStore::new(Device::Cpu);
        let _ = variables.root().var(
            "weight",
            &[size, 2],
            Init::Randn {
                mean: 0.0,
                stdev: 1.0,
            },
        );
        let optimizer = AdamW::new(&variables, AdamWConfig::default());
        (variables, optimizer)
    }

    fn step(variables: &VarStore, optimizer: &mut AdamW) {
        optimizer.zero_grad();
        variables.variables()["weight"]
            .exp()
            .sum(Kind::Float)
            .backward();
        optimizer.step(0.01).unwrap();
    }

    #[test]
    fn a_resumed_training_is_the_uninterrupted_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let (variables, mut optimizer) = network(3);
        step(&variables, &mut optimizer);
        let progress = (1_u64, "max".to_owned());
        save(&path, &variables.variables(), &optimizer, &progress).unwrap();
        step(&variables, &mut optimizer);
        let (resumed, mut resumed_optimizer) = network(3);
        assert_eq!(
            restore::<(u64, String)>(&path, &resumed, &mut resumed_optimizer).unwrap(),
            progress
        );
        step(&resumed, &mut resumed_optimizer);
        assert_eq!(
            resumed.variables()["weight"],
            variables.variables()["weight"]
        );
    }

    #[test]
    fn files_of_another_network_and_truncated_files_are_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let (variables, optimizer) = network(3);
        save(&path, &variables.variables(), &optimizer, &1).unwrap();
        let (other, mut other_optimizer) = network(4);
        let message = restore::<u64>(&path, &other, &mut other_optimizer)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("weight") && message.contains("[4, 2]"),
            "{message}"
        );
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let message = restore::<u64>(&path, &other, &mut other_optimizer)
            .unwrap_err()
            .to_string();
        assert!(message.contains("not a complete checkpoint"), "{message}");
    }
}
