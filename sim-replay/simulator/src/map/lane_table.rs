//! Lane table: the lane of the graph that a lane of the road network became, and back.

use super::LaneId;
use super::road::Contact;

/// Lane ids by road, section and lane id of the network.
#[derive(Default)]
pub(super) struct LaneTable {
    /// First section of each road in `ids`.
    pub(super) first_section: Vec<usize>,
    /// By section: lowest lane id, and the graph's id of each lane from there on.
    pub(super) ids: Vec<(i32, Vec<Option<LaneId>>)>,
}

impl LaneTable {
    pub(super) fn get(&self, road: usize, section: usize, lane: i32) -> Option<LaneId> {
        let (lowest, ids) = &self.ids[self.first_section[road] + section];
        // Ids run from the lowest upwards and leave out 0.
        let place = lane - lowest - i32::from(lane > 0);
        let place = usize::try_from(place).ok().filter(|_| lane != 0)?;
        ids.get(place).copied().flatten()
    }

    /// The section of a road at one of its ends.
    pub(super) fn end_section(&self, road: usize, contact: Contact) -> usize {
        match contact {
            Contact::Start => 0,
            Contact::End => {
                let next = self.first_section.get(road + 1).copied();
                next.unwrap_or(self.ids.len()) - self.first_section[road] - 1
            }
        }
    }
}

/// Origin of a lane of the graph in the road network.
#[derive(Clone, Copy)]
pub(super) struct LaneOrigin {
    pub(super) road: usize,
    pub(super) section: usize,
    pub(super) lane: i32,
}

impl LaneOrigin {
    /// The section that follows along the road, or against it.
    pub(super) fn next_section(self, forward: bool) -> Option<usize> {
        let step = if forward { 1 } else { -1 };
        self.section.checked_add_signed(step)
    }
}
