//! A recorded run as it was scored: protocol and ego, from the files beside its recording.

use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;

use protocol::CavId;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use support::file_error::{AtFile, FileError};

use super::{EgoKind, EvaluationProtocol};
use crate::Scenario;

/// Protocol and ego by which a recorded run was scored; neither outside of a run folder.
#[derive(Debug, Default)]
pub struct ScoredRun {
    /// The protocol, with the ground-truth range as it was applied.
    pub protocol: Option<EvaluationProtocol>,
    /// The ego.
    pub ego: Option<CavId>,
}

impl ScoredRun {
    /// The run of a recording.
    ///
    /// # Errors
    /// The error of a file that cannot be read.
    pub fn beside(recording: &Path) -> Result<Self, FileError> {
        Ok(Self {
            protocol: first_entry(&recording.with_file_name("metrics.json"), "protocol")?,
            ego: first_entry(&recording.with_file_name("detections.jsonl"), "ego")?,
        })
    }

    /// The scenario of the run, its ego first. A recording does not tell the kinds of its agents: where the ego was a
    /// roadside unit all count as such, and the protocol keeps their order.
    #[must_use]
    pub fn arrange(&self, scenario: &Scenario) -> Scenario {
        let mut order: Vec<usize> = (0..scenario.agents.len()).collect();
        order.sort_by_key(|&index| scenario.agents.get(index) != self.ego.as_ref());
        let mut arranged = scenario.arranged(&order);
        let protocol = self.protocol.as_ref();
        if protocol.is_some_and(|protocol| protocol.ego == EgoKind::Unit) {
            arranged.roadside_units.clone_from(&arranged.agents);
        }
        arranged
    }
}

/// An entry of the first JSON value of a file; `None` if there is no such file or entry.
fn first_entry<T: DeserializeOwned>(path: &Path, key: &str) -> Result<Option<T>, FileError> {
    let file = match File::open(path) {
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(None),
        opened => BufReader::new(opened.at(path)?),
    };
    let values = serde_json::Deserializer::from_reader(file);
    let first: Option<Value> = values.into_iter().next().transpose().at(path)?;
    match first.as_ref().and_then(|first| first.get(key)) {
        None => Ok(None),
        Some(entry) => Option::<T>::deserialize(entry)
            .map_err(|cause| FileError::new(path, format!("{key}: {cause}"))),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_run_has_the_protocol_and_the_ego_by_which_it_was_scored() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene");
        for agent in ["1", "2", "3"] {
            fs::create_dir_all(scene.join(agent)).unwrap();
            let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
            fs::write(scene.join(agent).join("000000.yaml"), pose).unwrap();
            fs::write(scene.join(agent).join("000000.pcd"), "").unwrap();
        }
        let scenario = crate::open(&scene).unwrap().scenarios.swap_remove(0);
        let recording = folder.path().join("recording.mcap");
        let alone = ScoredRun::beside(&recording).unwrap();
        assert!(alone.protocol.is_none() && alone.ego.is_none());
        assert_eq!(alone.arrange(&scenario).agents, scenario.agents);
        let rcooper = EvaluationProtocol::preset("rcooper").unwrap();
        let metrics = serde_json::json!({ "protocol": &rcooper }).to_string();
        fs::write(folder.path().join("metrics.json"), metrics).unwrap();
        let results = "{\"ego\": \"2\"}\n{\"ego\": \"2\"}\n";
        fs::write(folder.path().join("detections.jsonl"), results).unwrap();
        let scored = ScoredRun::beside(&recording).unwrap();
        assert_eq!(scored.protocol.as_ref(), Some(&rcooper));
        let arranged = rcooper.arrange(&scored.arrange(&scenario)).unwrap();
        let agents: Vec<&str> = arranged.agents.iter().map(CavId::as_str).collect();
        assert_eq!(agents, ["2", "1", "3"]);
        fs::write(folder.path().join("detections.jsonl"), "{").unwrap();
        let error = ScoredRun::beside(&recording).unwrap_err();
        assert!(error.path.ends_with("detections.jsonl"), "{error}");
    }
}
