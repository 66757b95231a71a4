//! What became of each neighbour over a run.

use std::collections::BTreeMap;

use protocol::{CavId, Detections, DropReason, MisbehaviourReason};
use serde::{Deserialize, Serialize};

/// Neighbours that are told apart: no scene has more.
const MAX_NEIGHBOURS: usize = 256;

/// A neighbour over all frames of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct NeighbourRecord {
    /// Frames that its data are in.
    pub fused: u64,
    /// Frames that they are not in, by reason; those for which nothing came are not counted.
    pub left_out: BTreeMap<DropReason, u64>,
    /// Frames that it was left out of because it was not believed, by what spoke against it.
    pub doubts: BTreeMap<MisbehaviourReason, u64>,
    /// How likely the ego thought it honest at last, 0..=1; none where the ego does not ask.
    pub trust: Option<f64>,
    /// The least that it ever was.
    pub least_trust: Option<f64>,
    /// Its clock less the ego's, less the shortest time a message was under way, at last, seconds; none in virtual time.
    pub clock_offset_s: Option<f64>,
    /// Why it was not believed at last, if it was not.
    pub doubt: Option<MisbehaviourReason>,
}

/// Adds what a result says of the neighbours.
pub(super) fn add(neighbours: &mut BTreeMap<CavId, NeighbourRecord>, result: &Detections) {
    let mut change = |cav: &CavId, change: &dyn Fn(&mut NeighbourRecord)| {
        if neighbours.len() < MAX_NEIGHBOURS || neighbours.contains_key(cav) {
            change(neighbours.entry(cav.clone()).or_default());
        }
    };
    for fused in &result.fused {
        change(&fused.cav, &|record| record.fused += 1);
    }
    for skipped in &result.skipped {
        if let Some(reason) = skipped.reason {
            change(&skipped.cav, &|record| *record.left_out.entry(reason).or_default() += 1);
        }
    }
    for heard in &result.heard {
        change(&heard.cav, &|record| {
            if let Some(doubt) = heard.doubt {
                *record.doubts.entry(doubt).or_default() += 1;
            }
            record.doubt = heard.doubt;
            // Of one that cannot be fused the ego makes up no mind.
            record.trust = heard.trust.or(record.trust);
            record.least_trust = [record.least_trust, heard.trust].into_iter().flatten().reduce(f64::min);
            record.clock_offset_s = heard.clock_offset_s.or(record.clock_offset_s);
        });
    }
}
