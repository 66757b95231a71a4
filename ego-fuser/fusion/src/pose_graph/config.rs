//! Settings of the pose graph.

use serde::{Deserialize, Serialize};

/// Settings of the correction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseGraphConfig {
    /// Largest number of boxes of each agent, the most confident ones.
    pub max_boxes: usize,
    /// Boxes below this score are ignored.
    pub min_score: f32,
    /// Fewest objects that an agent must share with those that are aligned already; below, its pose is not corrected.
    pub min_shared: usize,
    /// Largest distance between two boxes of one object at the uncorrected poses, metres.
    pub search_m: f64,
    /// Largest rotation of an agent, degrees.
    pub max_turn_deg: f64,
    /// Largest distance between two boxes of one object after the correction, metres.
    pub fit_tolerance_m: f64,
    /// Standard deviation of the centre of a confident box nearby, metres.
    pub box_std_m: f64,
    /// The same of its heading, degrees.
    pub box_std_deg: f64,
    /// An agent whose boxes would be moved by less than this on average is not corrected, metres: boxes are less
    /// accurate than a good pose.
    pub dead_zone_m: f64,
    /// Standard deviation of the uncorrected poses, metres.
    pub pose_std_m: f64,
    /// The same of their heading, degrees.
    pub pose_std_deg: f64,
}

impl Default for PoseGraphConfig {
    fn default() -> Self {
        Self {
            max_boxes: 40,
            min_score: 0.25,
            min_shared: 3,
            search_m: 6.0,
            max_turn_deg: 6.0,
            fit_tolerance_m: 1.0,
            box_std_m: 0.3,
            box_std_deg: 4.0,
            dead_zone_m: 0.4,
            pose_std_m: 3.0,
            pose_std_deg: 3.0,
        }
    }
}
