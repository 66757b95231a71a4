//! Lost data of a run: the reasons for exit code 3 and what would help, in one sentence.

use protocol::DropReason;

use crate::run::capacity::listed;
use crate::run::common::RunResult;

/// Drop reasons of messages that came too late for a busy process, or were not computed for that.
const OVERLOAD: [DropReason; 3] = [DropReason::Superseded, DropReason::Stale, DropReason::Paced];

impl RunResult {
    /// True if data were lost beyond the drops of the link.
    pub fn lost_data(&self) -> bool {
        sentence(self).is_some()
    }
}

/// Reasons for exit code 3 and what would help; `None` if nothing was lost beyond the drops of the link.
pub(crate) fn sentence(result: &RunResult) -> Option<String> {
    let (reasons, help) = (reasons(result), help(result));
    let help = help.map_or(String::new(), |help| format!("; {help}"));
    (!reasons.is_empty()).then(|| listed(&reasons, "and") + &help)
}

fn reasons(result: &RunResult) -> Vec<String> {
    let (missed, metrics) = (result.missed, &result.metrics);
    let messages = &metrics.messages;
    let dropped = messages.dropped.iter();
    let lost = dropped.filter(|(reason, count)| reason.is_loss() && **count > 0);
    let lost = lost.map(|(reason, count)| format!("{count} {}", reason.as_str().replace('_', " ")));
    let lost: Vec<String> = lost.collect();
    let has_begun = !result.interrupted || metrics.ticks + metrics.left_out.ticks > 0;
    let (accounts, files) = (result.balance.discrepancies.len(), result.unwritten.len());
    let counted = [
        (!has_begun).then(|| "ended before its first tick".into()),
        (missed > 0).then(|| format!("{missed} of {} ticks unanswered", metrics.ticks)),
        (!lost.is_empty()).then(|| format!("messages lost ({})", lost.join(", "))),
        messages
            .are_stuck()
            .then(|| "most messages were still in flight at the end".into()),
        (!result.balance.is_exact())
            .then(|| format!("{accounts} accounts of ledger.json do not add up")),
        (!metrics.left_out.is_nothing()).then(|| metrics.left_out.to_string()),
    ];
    let killed = result.killed.iter();
    let killed = killed.map(|process| format!("{process} did not end in time"));
    let reasons = counted.into_iter().flatten();
    let reasons = reasons.chain(result.failures.iter().cloned()).chain(killed);
    let unwritten = (files > 0).then(|| format!("{files} files of the run are incomplete"));
    reasons.chain(unwritten).collect()
}

/// What would help, from the first cause that applies.
fn help(result: &RunResult) -> Option<String> {
    let dropped = &result.metrics.messages.dropped;
    let without_pose = dropped.get(&DropReason::NoPose).copied().unwrap_or(0);
    let mut late = OVERLOAD.iter().filter_map(|reason| dropped.get(reason));
    let log = format!("see {}", result.folder.path().join("log").display());
    let mut causes = result.report.causes.clone();
    // A failure is listed among the reasons already.
    causes.retain(|cause| !result.failures.contains(cause));
    if result.interrupted && result.metrics.ticks > 0 {
        causes.push("the run was ended before its time".into());
    }
    if !result.unwritten.is_empty() {
        Some("free disk space".into())
    } else if result.interrupted {
        (!causes.is_empty()).then(|| listed(&causes, "and"))
    } else if !result.failures.is_empty() || !causes.is_empty() {
        causes.push(log);
        Some(causes.join(", "))
    } else if without_pose > 0 && result.metrics.pose.success_3m == Some(0.0) {
        Some("no vehicle found itself: is the head of agents.pose that of this scene?".into())
    } else if result.metrics.messages.are_stuck() || late.any(|count| *count > 0) {
        let remedies = result.remedies.as_ref();
        remedies.map(|remedies| format!("{remedies} would answer more"))
    } else if !result.metrics.left_out.is_nothing() {
        None
    } else {
        Some(log)
    }
}
