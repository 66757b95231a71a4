//! Sequence: true and reported tracks of one recording.

use std::collections::{BTreeMap, HashSet};

/// A true object in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruePoint {
    /// Id of the object, the same in all frames of its sequence.
    pub id: i64,
    /// Centre x, y, metres, in any frame of reference that all points of the frame share.
    pub center_m: [f64; 2],
}

/// A track in a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPoint {
    /// Id of the track, the same in all frames of its sequence.
    pub id: u64,
    /// Centre x, y, metres, as in [`TruePoint`].
    pub center_m: [f64; 2],
    /// Confidence; higher is surer.
    pub score: f64,
}

/// All points of a capture time.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrackedFrame {
    /// True objects.
    pub objects: Vec<TruePoint>,
    /// Tracks.
    pub tracks: Vec<TrackPoint>,
}

/// Two objects or two tracks of a frame have the same id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("two points of a frame have the id {0}")]
pub struct DuplicateId(pub i128);

/// Frames in the order of time.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sequence {
    pub(crate) frames: Vec<TrackedFrame>,
}

impl Sequence {
    /// Adds the next frame.
    ///
    /// # Errors
    /// [`DuplicateId`]; the frame is not added then.
    pub fn add(&mut self, frame: TrackedFrame) -> Result<(), DuplicateId> {
        let objects = frame.objects.iter().map(|object| object.id.into());
        let tracks = frame.tracks.iter().map(|track| track.id.into());
        if let Some(id) = first_duplicate(objects).or_else(|| first_duplicate(tracks)) {
            return Err(DuplicateId(id));
        }
        self.frames.push(frame);
        Ok(())
    }

    /// The sequences without track points of a lower score.
    pub(crate) fn with_min_score(sequences: &[Self], min_score: f64) -> Vec<Self> {
        let mut kept = sequences.to_vec();
        for frame in kept.iter_mut().flat_map(|sequence| &mut sequence.frames) {
            frame.tracks.retain(|track| track.score >= min_score);
        }
        kept
    }

    /// The sequence with the mean score of its track in each point.
    pub(crate) fn with_mean_scores(&self) -> Self {
        let mut sums: BTreeMap<u64, (f64, f64)> = BTreeMap::new();
        for track in self.frames.iter().flat_map(|frame| &frame.tracks) {
            let (sum, count) = sums.entry(track.id).or_default();
            (*sum, *count) = (*sum + track.score, *count + 1.0);
        }
        let mut averaged = self.clone();
        let frames = averaged.frames.iter_mut();
        for track in frames.flat_map(|frame| &mut frame.tracks) {
            if let Some((sum, count)) = sums.get(&track.id) {
                track.score = sum / count;
            }
        }
        averaged
    }

    /// Number of frames of each object, and of each track.
    pub(crate) fn lengths(&self) -> (Lengths<i64>, Lengths<u64>) {
        let (mut objects, mut tracks) = (Lengths::new(), Lengths::new());
        for frame in &self.frames {
            for object in &frame.objects {
                *objects.entry(object.id).or_default() += 1;
            }
            for track in &frame.tracks {
                *tracks.entry(track.id).or_default() += 1;
            }
        }
        (objects, tracks)
    }
}

/// Number of frames by id.
pub(crate) type Lengths<T> = BTreeMap<T, u32>;

impl TrackedFrame {
    /// Centre distance of an object and a track, given by their indices, metres.
    pub(crate) fn distance_m(&self, object: usize, track: usize) -> f64 {
        let [x, y] = self.objects[object].center_m;
        let [track_x, track_y] = self.tracks[track].center_m;
        (x - track_x).hypot(y - track_y)
    }
}

fn first_duplicate(mut ids: impl Iterator<Item = i128>) -> Option<i128> {
    let mut seen = HashSet::new();
    ids.find(|id| !seen.insert(*id))
}
