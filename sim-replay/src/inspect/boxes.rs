//! Plausibility of annotated boxes as a whole: boxes in wrong frames or units can be valid one by one.

use super::{AgentReport, Problem};

/// Least number of boxes of an agent for which shares are evaluated.
const ENOUGH_BOXES: usize = 20;
/// Largest share of boxes without any of the agent's own points, of those in frames with points.
const MAX_EMPTY_SHARE: f64 = 0.5;
const HINT: &str = "frames (axes, order of the pose's numbers) or units of the boxes may be wrong";

/// The finding that agents list `targets` objects of the protocol's classes, and none is ground truth of any ego.
pub(super) fn without_ground_truth(
    scenario: &str,
    targets: usize,
    merged: usize,
) -> Option<Problem> {
    let reason = format!(
        "ground truth 0 for every ego and tick, though agents list {targets} objects of its classes: {HINT}"
    );
    (targets > 0 && merged == 0).then(|| problem(scenario, "ground truth", &reason))
}

/// The finding that most boxes of an agent are empty. `boxes` are those of frames whose points were read.
pub(super) fn mostly_empty(scenario: &str, agent: &AgentReport, boxes: usize) -> Option<Problem> {
    let empty = agent.boxes_without_points;
    let share = empty as f64 / boxes.max(1) as f64;
    let reason = format!(
        "agent {}: {empty} of {boxes} boxes ({:.0} %) hold none of its points: {HINT}",
        agent.id,
        100.0 * share
    );
    (boxes >= ENOUGH_BOXES && share > MAX_EMPTY_SHARE).then(|| problem(scenario, "boxes", &reason))
}

fn problem(scenario: &str, field: &str, reason: &str) -> Problem {
    let message = format!("{scenario}: {reason}");
    Problem {
        path: scenario.to_owned(),
        line: None,
        field: Some(field.to_owned()),
        message,
    }
}
