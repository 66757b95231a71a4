//! Options of opening a data set.

use super::points::IntensityScale;

/// Properties that a data set does not record itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenOptions {
    /// Time from one stored frame to the next if neither time stamps nor the length of a simulator's tick are recorded,
    /// nanoseconds. The data sets of the OPV2V family store ten frames a second.
    pub period_nanos: u64,
    /// Divisor of the intensities of LiDAR sweeps.
    pub intensity_scale: IntensityScale,
}

impl OpenOptions {
    /// The defaults, with another divisor of intensities.
    pub fn with_intensity_scale(intensity_scale: IntensityScale) -> Self {
        Self {
            period_nanos: 100_000_000,
            intensity_scale,
        }
    }
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self::with_intensity_scale(IntensityScale::AUTO)
    }
}
