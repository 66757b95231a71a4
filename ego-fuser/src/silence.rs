//! Silence of neighbours: a frame waits for those that have been heard recently.

use std::collections::BTreeMap;

use protocol::CavId;

/// Consecutive frames without a message after which a neighbour is not awaited any more, until its next message.
const SILENT_AFTER: u32 = 3;

/// Consecutive frames that were decided without a message, by neighbour.
#[derive(Debug, Default)]
pub struct Silence(BTreeMap<CavId, u32>);

impl Silence {
    /// True if frames wait for the neighbour.
    pub fn is_awaited(&self, cav: &CavId) -> bool {
        self.0.get(cav).is_none_or(|frames| *frames < SILENT_AFTER)
    }

    /// Records a message, or that the neighbour has left.
    pub fn reset(&mut self, cav: &CavId) {
        self.0.remove(cav);
    }

    /// Records that a frame was decided without a message.
    pub fn missed(&mut self, cav: &CavId) {
        let frames = self.0.entry(cav.clone()).or_default();
        *frames = frames.saturating_add(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_neighbour_is_awaited_until_it_misses_three_frames_and_again_after_a_message() {
        let cav = CavId::new("4288").unwrap();
        let mut silence = Silence::default();
        for _ in 0..SILENT_AFTER {
            assert!(silence.is_awaited(&cav));
            silence.missed(&cav);
        }
        assert!(!silence.is_awaited(&cav));
        silence.reset(&cav);
        assert!(silence.is_awaited(&cav));
    }
}
