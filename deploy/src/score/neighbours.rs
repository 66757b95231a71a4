//! Record of each neighbour over a run.

use std::collections::BTreeMap;

use protocol::{CavId, Detections, DropReason, MisbehaviourReason};
use serde::{Deserialize, Serialize};

/// Largest number of neighbours with a record: no scene has more.
const MAX_NEIGHBOURS: usize = 256;

/// Record of a neighbour over all frames of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct NeighbourRecord {
    /// Number of frames that its data were fused in.
    pub fused: u64,
    /// Number of frames without its data, by reason; frames without a message of it are not counted.
    pub left_out: BTreeMap<DropReason, u64>,
    /// Number of frames that it was excluded from by misbehaviour detection, by reason.
    pub misbehaviour_counts: BTreeMap<MisbehaviourReason, u64>,
    /// Trust score of the neighbour at the end, 0..=1; `None` without misbehaviour detection.
    pub trust: Option<f64>,
    /// Lowest trust score.
    pub least_trust: Option<f64>,
    /// Offset of its clock from the ego's, less the shortest transmission time, at the end, seconds; `None` in
    /// simulation time.
    pub clock_offset_s: Option<f64>,
    /// Offset of its capture times from the ego's that the ego corrected last, seconds; `None` if they agreed.
    pub capture_offset_s: Option<f64>,
    /// Misbehaviour reason at the end, if it was excluded.
    pub misbehaviour: Option<MisbehaviourReason>,
}

/// Adds the neighbours of a result.
pub(super) fn add(neighbours: &mut BTreeMap<CavId, NeighbourRecord>, result: &Detections) {
    for fused in &result.fused {
        if let Some(record) = record_of(&fused.cav, neighbours) {
            record.fused += 1;
        }
    }
    for skipped in &result.skipped {
        if let Some(reason) = skipped.reason
            && let Some(record) = record_of(&skipped.cav, neighbours)
        {
            *record.left_out.entry(reason).or_default() += 1;
        }
    }
    for neighbour in &result.neighbours {
        let Some(record) = record_of(&neighbour.cav, neighbours) else {
            continue;
        };
        if let Some(misbehaviour) = neighbour.misbehaviour {
            *record.misbehaviour_counts.entry(misbehaviour).or_default() += 1;
        }
        record.misbehaviour = neighbour.misbehaviour;
        // One that cannot be fused gets no new trust score.
        record.trust = neighbour.trust.or(record.trust);
        let trusts = [record.least_trust, neighbour.trust].into_iter().flatten();
        record.least_trust = trusts.reduce(f64::min);
        record.clock_offset_s = neighbour.clock_offset_s.or(record.clock_offset_s);
        record.capture_offset_s = neighbour.capture_offset_s.or(record.capture_offset_s);
    }
}

/// The record of a vehicle; `None` if there is no room for another one.
fn record_of<'a>(
    cav: &CavId,
    neighbours: &'a mut BTreeMap<CavId, NeighbourRecord>,
) -> Option<&'a mut NeighbourRecord> {
    let has_room = neighbours.len() < MAX_NEIGHBOURS || neighbours.contains_key(cav);
    has_room.then(|| neighbours.entry(cav.clone()).or_default())
}
