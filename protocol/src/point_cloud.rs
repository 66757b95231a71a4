//! Point cloud of one LiDAR sweep.

use serde::{Deserialize, Serialize};

/// Handedness of a recording before its reader converts it to right-handed axes.
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
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PointCloud {
    /// x, y, z, intensity of every point.
    pub xyzi: Vec<[f32; 4]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.xyzi.len()
    }

    /// True if the sweep has no point.
    pub fn is_empty(&self) -> bool {
        self.xyzi.is_empty()
    }

    /// Every n-th point, with n such that at most `most` points remain.
    pub fn decimate(&self, most: usize) -> Self {
        let step = self.len().div_ceil(most.max(1)).max(1);
        let xyzi = self.xyzi.iter().step_by(step).copied().collect();
        Self { xyzi }
    }

    /// Negates y of every point: exchanges left and right.
    pub fn mirror(&mut self) {
        for [_, y, ..] in &mut self.xyzi {
            *y = -*y;
        }
    }
}
