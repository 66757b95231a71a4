//! Inputs and outputs of an agent's loop.

use perception::detector::DetectorError;
use protocol::message::StageTiming;
use protocol::{CavId, DropReason, EgoMotion, Gnss, Pace, PointCloud, Stream};
use serde::{Deserialize, Serialize};

use super::message::Unsent;

/// Something that happens to an agent. Capture times are on the clock of the scene, nanoseconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum LoopInput {
    /// A sweep has arrived.
    Sweep(Sweep),
    /// A pose of that capture time was measured, or is stated.
    Gnss(u64, Gnss),
    /// The motion at that capture time was measured.
    Motion(u64, EgoMotion),
    /// An ego has set its pace.
    Pace(CavId, Pace),
    /// An ego sets no more pace.
    PaceEnded(CavId),
    /// There are no more sweeps. After the last one the loop ends.
    Ended,
    /// The scene has ended, and the loop waits for the next one.
    SceneEnded,
    /// The next step is made, if it is time for it.
    Wake,
}

/// A sweep as received.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Capture time, nanoseconds.
    pub capture_nanos: u64,
    /// Arrival, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    /// Its points, in the LiDAR frame.
    pub cloud: PointCloud,
}

/// Something that an agent does.
#[derive(Debug)]
pub enum LoopOutput {
    /// Publishes a message.
    Publish(Box<Unsent>),
    /// Counts a message of a sensor as used.
    Received(Stream),
    /// Counts a message of a sensor as not used.
    Dropped(Stream, DropReason),
    /// Counts the durations of stages.
    Timed(Vec<StageTiming>),
    /// A sweep was computed, and everything of it is published, or could not be computed.
    Computed {
        /// Capture time, nanoseconds.
        capture_nanos: u64,
        /// Arrival, nanoseconds on the Unix clock.
        arrived_nanos: u64,
    },
    /// A sweep could not be computed.
    Failed(DetectorError),
    /// The problem of the pose, in place of the one before, with the time of its beginning, nanoseconds; `None`: none.
    PoseProblem(Option<(String, u64)>),
}
