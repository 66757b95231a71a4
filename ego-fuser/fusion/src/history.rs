//! History: the last feature maps of every vehicle, kept by the ego so that nothing is sent twice.
//!
//! Each is stored with the pose that its sender had at capture, so that it can be warped to any later frame of the ego.

use std::collections::{BTreeMap, VecDeque};

use protocol::{CavId, Pose};

use crate::ReceivedMaps;

/// Largest age of a feature map that is kept, nanoseconds.
pub const MAX_AGE_NANOS: u64 = 1_000_000_000;
/// Largest number of vehicles in the history.
const MAX_VEHICLES: usize = 64;

/// A feature map as received.
#[derive(Debug)]
pub struct KeptMap {
    /// Capture time, nanoseconds.
    pub capture_nanos: u64,
    /// Pose that its sender reported for that time.
    pub world_from_cav: Pose,
    /// Confidence of that pose, 0..1.
    pub confidence: f64,
    /// One map, as the fusion stage keeps it.
    pub map: ReceivedMaps,
}

/// Feature maps by vehicle, oldest first.
#[derive(Debug)]
pub struct History {
    frames: usize,
    kept: BTreeMap<CavId, VecDeque<KeptMap>>,
    latest_nanos: u64,
}

impl History {
    /// History for a fusion of `frames` time steps; with one, nothing is kept.
    pub fn new(frames: usize) -> Self {
        Self {
            frames,
            kept: BTreeMap::new(),
            latest_nanos: 0,
        }
    }

    /// Removes everything: another scene begins.
    pub fn clear(&mut self) {
        self.kept.clear();
        self.latest_nanos = 0;
    }

    /// Sets the ego's clock to `now_nanos`: removes maps that are too old, and all where the clock went backwards.
    pub fn advance(&mut self, now_nanos: u64) {
        if now_nanos < self.latest_nanos {
            self.clear();
        }
        self.latest_nanos = now_nanos;
        for maps in self.kept.values_mut() {
            maps.retain(|kept| kept.capture_nanos.saturating_add(MAX_AGE_NANOS) >= now_nanos);
        }
        self.kept.retain(|_, maps| !maps.is_empty());
    }

    /// Maps of a vehicle from before the one that is fused now, newest first: at most one per time step.
    pub fn before(&self, cav: &CavId, capture_nanos: u64) -> impl Iterator<Item = &KeptMap> {
        self.kept
            .get(cav)
            .into_iter()
            .flatten()
            .rev()
            .filter(move |kept| kept.capture_nanos < capture_nanos)
            .take(self.frames.saturating_sub(1))
    }

    /// Keeps a map for later frames. A map that served more than one frame is kept once.
    pub fn keep(&mut self, cav: &CavId, kept: KeptMap) {
        let is_new = !self.kept.contains_key(cav);
        if self.frames < 2 || (is_new && self.kept.len() >= MAX_VEHICLES) {
            return;
        }
        let maps = self.kept.entry(cav.clone()).or_default();
        // Repeated or out of order: `before` relies on the order of capture times.
        let last = maps.back();
        if last.is_some_and(|last| last.capture_nanos >= kept.capture_nanos) {
            return;
        }
        maps.push_back(kept);
        // One more than `before` gives: a map that serves another frame is itself among those kept.
        if maps.len() > self.frames {
            maps.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tch::{Device, Kind, Tensor};

    use super::*;

    const FRAME: u64 = 100_000_000;

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn map(frame: u64) -> KeptMap {
        KeptMap {
            capture_nanos: frame * FRAME,
            world_from_cav: Pose::IDENTITY,
            confidence: 1.0,
            map: ReceivedMaps::new(
                Tensor::zeros([1, 1, 1, 1], (Kind::Float, Device::Cpu)),
                None,
            ),
        }
    }

    fn frames_before(history: &History, name: &str, frame: u64) -> Vec<u64> {
        history
            .before(&cav(name), frame * FRAME)
            .map(|kept| kept.capture_nanos / FRAME)
            .collect()
    }

    #[test]
    fn the_last_maps_of_each_come_back_newest_first() {
        let mut history = History::new(3);
        for frame in 0..6 {
            history.advance(frame * FRAME);
            history.keep(&cav("a"), map(frame));
        }
        assert_eq!(frames_before(&history, "a", 5), [4, 3]);
        assert_eq!(frames_before(&history, "a", 6), [5, 4]);
        assert!(frames_before(&history, "b", 6).is_empty());
        history.keep(&cav("a"), map(5));
        history.keep(&cav("a"), map(2));
        assert_eq!(
            frames_before(&history, "a", 6),
            [5, 4],
            "what served before is not kept twice"
        );
    }

    #[test]
    fn what_is_old_goes_and_a_clock_that_is_turned_back_clears_all() {
        let mut history = History::new(3);
        history.keep(&cav("a"), map(0));
        history.keep(&cav("b"), map(8));
        history.advance(11 * FRAME);
        assert!(frames_before(&history, "a", 11).is_empty());
        assert_eq!(frames_before(&history, "b", 11), [8]);
        history.advance(2 * FRAME);
        assert!(history.kept.is_empty());
    }

    #[test]
    fn one_frame_needs_no_memory() {
        let mut history = History::new(1);
        history.keep(&cav("a"), map(0));
        assert!(history.kept.is_empty());
    }

    proptest! {
        #[test]
        fn it_never_grows_beyond_its_bounds(events in prop::collection::vec((0u64..200, 0u32..100), 0..300)) {
            let mut history = History::new(3);
            for (frame, vehicle) in events {
                history.advance(frame * FRAME);
                history.keep(&cav(&vehicle.to_string()), map(frame));
                prop_assert!(history.kept.len() <= MAX_VEHICLES);
                prop_assert!(history.kept.values().all(|maps| maps.len() <= 3));
                prop_assert!(history.before(&cav(&vehicle.to_string()), (frame + 1) * FRAME).count() <= 2);
            }
        }
    }
}
