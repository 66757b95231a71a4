//! Scenarios as a protocol evaluates them: choice of the ego and agents, number of scenarios and frames.

use std::collections::HashSet;
use std::path::Path;

use support::file_error::FileError;
use support::sampling::evenly_spread;

use super::{EvaluationProtocol, ProtocolConfig, ScoredRun};
use crate::{Dataset, Scenario, recording_of};

impl ProtocolConfig {
    /// The protocol for the data set that was opened at `path`, and the scenarios that have an ego of it, each with the
    /// agents that take part and its first `frames` ticks. A recorded run has the protocol and the ego by which it was
    /// scored, unless others are asked for.
    ///
    /// # Errors
    /// An error where no scenario has an ego of the protocol, the options contradict each other, or the scores of a run
    /// cannot be read.
    pub fn arrange_all(
        &self,
        path: &Path,
        dataset: &Dataset,
        frames: Option<usize>,
    ) -> Result<(EvaluationProtocol, Vec<Scenario>), FileError> {
        let scored = recording_of(path).map(|file| ScoredRun::beside(&file));
        let mut scored = scored.transpose()?.unwrap_or_default();
        let protocol = self.resolve_over(scored.protocol.clone(), dataset.layout);
        let protocol = protocol
            .map_err(|problem| FileError::new(path, format!("evaluation protocol: {problem}")))?;
        if self.preset.is_some() || self.ego_kind.is_some() {
            // Another protocol has its own ego.
            scored = ScoredRun::default();
        }
        let recorded = dataset.scenarios.iter();
        let arranged = recorded.filter_map(|one| protocol.arrange(&scored.arrange(one)));
        let mut arranged: Vec<Scenario> = arranged.collect();
        if arranged.is_empty() && !dataset.scenarios.is_empty() {
            let kind = protocol.ego;
            let problem =
                format!("no scenario in it has an ego of the protocol: ego_kind is {kind:?}");
            return Err(FileError::new(path, problem));
        }
        for scenario in &mut arranged {
            scenario.ticks.truncate(frames.unwrap_or(usize::MAX));
        }
        Ok((protocol, arranged))
    }
}

/// Sentences about numbers below the requested ones: scenarios with an ego of the protocol, scenarios, frames of the
/// longest scenario.
pub fn lacking(
    recorded: &[Scenario],
    arranged: &[Scenario],
    scenarios: Option<usize>,
    frames: Option<usize>,
) -> Vec<String> {
    let kept: HashSet<&str> = arranged.iter().map(|one| one.name.as_str()).collect();
    let all = recorded.iter().map(|one| one.name.as_str());
    let others: Vec<&str> = all.filter(|name| !kept.contains(name)).collect();
    let others = (!others.is_empty()).then(|| others.join(", "));
    let others = others.map(|names| format!("left out, without an ego of the protocol: {names}"));
    let lengths: Vec<usize> = arranged.iter().map(|one| one.ticks.len()).collect();
    let chosen = evenly_spread(&lengths, scenarios.unwrap_or(usize::MAX));
    let longest = chosen.into_iter().max().unwrap_or(0);
    let fewer = [
        fewer("scenarios", arranged.len(), scenarios),
        fewer("frames", longest, frames),
    ];
    others
        .into_iter()
        .chain(fewer.into_iter().flatten())
        .collect()
}

/// Sentence about a number that is below the one that was asked for; `what` it counts.
pub fn fewer(what: &str, found: usize, asked: Option<usize>) -> Option<String> {
    let asked = asked.filter(|asked| *asked > found)?;
    Some(format!("{asked} {what} were asked for, there were {found}"))
}
