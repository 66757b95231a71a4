//! Contradictions between what a vehicle measures of its motion and the poses of its sweeps.

/// Speed (metres per second) or yaw rate (radians per second) that poses contradict.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionContradiction {
    /// Value that the vehicle measures.
    pub measured: f64,
    /// Value that the poses of its sweeps give.
    pub of_poses: f64,
}

/// Contradictions of a measured quantity, over all tracks of a vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct Contradictions {
    /// Their number, less what agreements took off.
    count: f64,
    pub(super) refuted: Option<MotionContradiction>,
}

impl Contradictions {
    /// Counts the comparison of a measured value with that of the poses: `most` contradictions refute it, of which each
    /// agreement takes off `relief`.
    pub(super) fn count(&mut self, is_wrong: bool, [most, relief]: [f64; 2], values: [f64; 2]) {
        let change = if is_wrong { 1.0 } else { -relief };
        self.count = (self.count + change).max(0.0);
        if self.count >= most {
            self.refute(values);
        }
    }

    /// The measured value is wrong, at that of the poses; the first such values are kept.
    pub(super) fn refute(&mut self, [measured, of_poses]: [f64; 2]) {
        let refuted = MotionContradiction { measured, of_poses };
        self.refuted.get_or_insert(refuted);
    }
}
