//! Contradictions between what a vehicle measures of its motion and the poses of its sweeps.

/// Speed (metres per second) or yaw rate (radians per second) that poses contradict.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionContradiction {
    /// Value that the vehicle measures.
    pub measured: f64,
    /// Value that the poses of its sweeps give.
    pub of_poses: f64,
}

/// Contradictions in a row of a measured quantity, over all tracks of a vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct Contradictions {
    in_a_row: u32,
    pub(super) refuted: Option<MotionContradiction>,
}

impl Contradictions {
    /// Counts the comparison of a measured value with that of the poses; `most` contradictions in a row refute it.
    pub(super) fn count(
        &mut self,
        is_contradicted: bool,
        most: u32,
        [measured, of_poses]: [f64; 2],
    ) {
        self.in_a_row = (self.in_a_row + 1) * u32::from(is_contradicted);
        if self.in_a_row >= most {
            self.refuted = Some(MotionContradiction { measured, of_poses });
        }
    }
}
