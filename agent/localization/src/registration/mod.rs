//! Rigid registration of correspondences: pose of the sensor from points it measured and their positions in the world.
//!
//! Clouds against clouds without correspondences: [`icp`].
//!
//! Pure geometry: [`ransac`] and [`sc2pcr`] find the motion among outliers, [`kabsch`] fits it to inliers and
//! [`refine`] refines it. Each returns a [`Registration`] or the reason why there is none.
//!
//! ```
//! use localization::registration::{Correspondence, ransac};
//! let points = (0..60).map(|k| [(k % 8) as f32 * 4.0, (k / 8) as f32 * 5.0 - 20.0, (k % 3) as f32]);
//! let pairs: Vec<_> = points
//!     .map(|[x, y, z]| Correspondence { source_m: [x, y, z], target_m: [100.0 - y, x, z + 2.0], weight: 1.0 })
//!     .collect();
//! let found = ransac::solve(&pairs, &ransac::RansacConfig::default()).unwrap();
//! assert!((found.target_from_source.translation.vector.x - 100.0).abs() < 1e-3);
//! assert_eq!(found.inliers.len(), 60);
//! ```

pub mod icp;
pub mod kabsch;
pub mod ransac;
pub mod refine;
pub mod sc2pcr;

mod compatibility;
mod pairs;
#[cfg(test)]
pub(crate) mod test_problem;

use nalgebra::{Isometry3, Point3, Vector3};

use kabsch::Degenerate;

/// Largest valid coordinate, metres: larger ones are errors.
const MAX_ABS_M: f32 = 1e7;

/// A measured point and its predicted position in the target frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// In the source frame, the sensor's: metres.
    pub source_m: [f32; 3],
    /// In the target frame, the world's: metres.
    pub target_m: [f32; 3],
    /// Weight above 0; only ratios matter. Pairs with zero, negative or non-finite weights are ignored.
    pub weight: f32,
}

impl Correspondence {
    /// True if it can be used: finite coordinates and a positive finite weight.
    pub fn usable(&self) -> bool {
        let mut coordinates = self.source_m.iter().chain(&self.target_m);
        self.weight > 0.0
            && self.weight.is_finite()
            && coordinates.all(|coordinate| coordinate.abs() <= MAX_ABS_M)
    }

    /// Distance between the target and the transformed source, metres.
    pub(crate) fn residual_m(&self, target_from_source: &Isometry3<f64>) -> f64 {
        let moved = target_from_source * Point3::from(self.source_m.map(f64::from));
        (Vector3::from(self.target_m.map(f64::from)) - moved.coords).norm()
    }
}

/// A motion with its inliers.
#[derive(Debug, Clone, PartialEq)]
pub struct Registration {
    /// Transforms points of the source frame to the target frame.
    pub target_from_source: Isometry3<f64>,
    /// Indices of the inliers in the given list, ascending.
    pub inliers: Vec<u32>,
    /// Inliers as a share of the given correspondences, 0..=1.
    pub inlier_ratio: f64,
    /// Root mean square of the inliers' residuals, metres.
    pub rms_m: f64,
}

impl Registration {
    /// Counts the inliers of a motion within `threshold_m`.
    pub fn judge(
        pairs: &[Correspondence],
        target_from_source: Isometry3<f64>,
        threshold_m: f64,
    ) -> Self {
        let mut inliers = Vec::new();
        let mut squares = 0.0;
        for (index, pair) in pairs.iter().enumerate().filter(|(_, pair)| pair.usable()) {
            let residual_m = pair.residual_m(&target_from_source);
            if residual_m < threshold_m {
                inliers.push(u32::try_from(index).unwrap_or(u32::MAX));
                squares += residual_m * residual_m;
            }
        }
        Self {
            target_from_source,
            inlier_ratio: inliers.len() as f64 / pairs.len().max(1) as f64,
            rms_m: (squares / inliers.len().max(1) as f64).sqrt(),
            inliers,
        }
    }

    /// Itself if there are at least `required` inliers.
    fn with_at_least(self, required: usize, given: usize) -> Result<Self, NoRegistration> {
        match self.inliers.len() {
            found if found < required => Err(NoRegistration::TooFewInliers(found, given, required)),
            _ => Ok(self),
        }
    }
}

/// Reason why correspondences give no motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NoRegistration {
    /// There is too little to start from: number with finite coordinates and a positive weight, number of all
    /// correspondences, number required.
    #[error("{0} of {1} correspondences are usable, at least {2} are needed")]
    TooFewCorrespondences(usize, usize, usize),
    /// Too few are inliers of any motion: largest number of inliers, number of all correspondences, number required.
    #[error("at most {0} of {1} correspondences agree on one motion, at least {2} must")]
    TooFewInliers(usize, usize, usize),
    /// The inliers do not constrain the motion: their number, and the reason of the fit.
    #[error("{0} inliers do not constrain a motion: {1}")]
    Degenerate(usize, Degenerate),
}

impl NoRegistration {
    /// The largest number of inliers.
    pub fn inlier_count(&self) -> usize {
        match self {
            Self::TooFewCorrespondences(..) => 0,
            Self::TooFewInliers(inliers, ..) | Self::Degenerate(inliers, _) => *inliers,
        }
    }
}

/// `Err` when fewer than `required` are usable.
fn check_enough(pairs: &[Correspondence], required: usize) -> Result<(), NoRegistration> {
    let usable = pairs.iter().filter(|pair| pair.usable()).count();
    if usable < required {
        let none = NoRegistration::TooFewCorrespondences(usable, pairs.len(), required);
        return Err(none);
    }
    Ok(())
}
