//! One LiDAR sweep.

use serde::{Deserialize, Serialize};

/// Which way the axes of a recording turned before its reader made them right-handed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Handedness {
    /// x forward, y right, z up (CARLA, OPV2V and its relatives).
    Left,
    /// x forward, y left, z up.
    Right,
}

/// Points of one sweep in the frame of the sensor.
///
/// `xyzi` is `[N]` of x, y, z in metres (right-handed) and intensity, usually 0..1.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointCloud {
    /// x, y, z, intensity of every point.
    pub xyzi: Vec<[f32; 4]>,
}

impl PointCloud {
    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.xyzi.len()
    }

    /// Whether the sweep has no point at all.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.xyzi.is_empty()
    }

    /// Every so manieth point, so that there are at most `most`.
    #[must_use]
    pub fn decimate(&self, most: usize) -> Self {
        let step = self.len().div_ceil(most.max(1)).max(1);
        Self { xyzi: self.xyzi.iter().step_by(step).copied().collect() }
    }
}
