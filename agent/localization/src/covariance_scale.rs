//! Scale of covariances: how much larger the errors of poses are than their covariances, fitted to sweeps with known poses.

use nalgebra::{Isometry3, Matrix2, Matrix6, Vector2, Vector6};
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

/// Metadata key of a head's or a surfel map's file that holds its [`CovarianceScale`], as JSON.
pub const COVARIANCE_KEY: &str = "covariance";

/// Largest variance, square metres or radians: that of a pose that nothing constrains.
pub const MAX_VARIANCE: f64 = 1e6;
/// Fewest poses to fit a scale on.
const MIN_POSES: usize = 50;
/// Share of the errors within the fitted limits, and that many standard deviations of a Gaussian: along one axis, and
/// within an ellipse.
const SHARE: f64 = 0.95;
const SHARE_STD: [f64; 2] = [1.960, 2.448];
/// Fewest poses to fit a bound on: if none of them is beyond it, at most one in 1,000 of others is, with a confidence of
/// 95 % (Wilks 1941). Of four times as many it is one in 4,000.
const MIN_BOUND_POSES: usize = 2995;
/// The same where the confidence above which the bound holds is chosen from these poses, too: two limits of one sample.
const MIN_CHOSEN_POSES: usize = 4742;
/// Smallest standard deviation to which a bound is a ratio, metres: maps of real places are not better than that.
const BOUND_FLOOR_M: f64 = 0.01;
/// Largest factor in a file.
const MAX_FACTOR: f64 = 1e6;

/// Factors on the standard deviations of poses, fitted to the errors of sweeps with known poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CovarianceScale {
    /// Of x and y.
    pub planar: f64,
    /// Of z.
    pub height: f64,
    /// Of the rotations about x and y.
    pub tilt: f64,
    /// Of the rotation about z.
    pub yaw: f64,
    /// Largest error of a position of the fit, in standard deviations along the worst axis of the plane (of a registered
    /// pose with that of its start): at most one in 1,000 exceeds it, with a confidence of 95 %. `None` if it was fitted on
    /// fewer than 2,995 poses, or than 4,742 that are surer than a wrong one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<f64>,
    /// Confidence of the surest wrong pose of the fit: the bound is of poses above it. Absent if none was wrong.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound_above: Option<f64>,
}

/// Reason why no scale can be fitted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NoScale {
    /// There are too few poses.
    #[error("covariances are fitted on {MIN_POSES} poses or more, there are {0}")]
    TooFew(usize),
    /// More than one error in twenty is beyond any multiple of its covariance.
    #[error("the errors exceed any multiple of their covariances: {0}")]
    Unbounded(#[from] FieldError),
}

/// A pose estimated for a sweep, with its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseSample {
    /// Error of x, y, z (metres) and rotations about the world's x, y, z (radians).
    pub error: [f64; 6],
    /// Covariance without a scale.
    pub covariance: [[f64; 6]; 6],
    /// Standard deviation per axis of the position at which its registration began, metres; 0 without one.
    pub start_std_m: f64,
    /// Confidence.
    pub sigma: f64,
}

impl PoseSample {
    /// Sample of a pose of confidence `sigma` of a sweep that was taken at `truth`; its registration began with
    /// `start_std_m`.
    pub fn of(
        (pose, sigma, start_std_m): (&Isometry3<f64>, f64, f64),
        covariance: [[f64; 6]; 6],
        truth: &Isometry3<f64>,
    ) -> Self {
        let off = pose.translation.vector - truth.translation.vector;
        // On the left: the axis is in the world's frame, as that of the covariance.
        let turned = (pose.rotation * truth.rotation.inverse()).scaled_axis();
        Self {
            error: [off.x, off.y, off.z, turned.x, turned.y, turned.z],
            covariance,
            start_std_m,
            sigma,
        }
    }

    /// Distance from the true position in the plane, metres.
    pub fn off_m(&self) -> f64 {
        self.error[0].hypot(self.error[1])
    }

    /// Error along an axis, standard deviations.
    fn deviations(&self, axis: usize) -> f64 {
        self.error[axis].abs() / self.covariance[axis][axis].sqrt()
    }

    /// Whether the error lies beyond the 95 % ellipse in the plane, and beyond 1.96 standard deviations of z, roll, pitch
    /// and yaw.
    pub fn beyond_95(&self) -> [(&'static str, bool); 5] {
        let [axis, ellipse] = SHARE_STD;
        [
            ("plane", self.planar_deviations(), ellipse),
            ("z", self.deviations(2), axis),
            ("roll", self.deviations(3), axis),
            ("pitch", self.deviations(4), axis),
            ("yaw", self.deviations(5), axis),
        ]
        // A singular covariance is exceeded by any error.
        .map(|(of, deviations, limit)| (of, deviations.is_nan() || deviations > limit))
    }

    /// Mahalanobis distance of x and y.
    fn planar_deviations(&self) -> f64 {
        let off = Vector2::new(self.error[0], self.error[1]);
        let inverse = planar(&self.covariance).try_inverse();
        inverse.map_or(f64::NAN, |inverse| off.dot(&(inverse * off)).sqrt())
    }
}

impl CovarianceScale {
    /// The scale that changes nothing, without a bound.
    pub const NONE: Self = Self {
        planar: 1.0,
        height: 1.0,
        tilt: 1.0,
        yaw: 1.0,
        bound: None,
        bound_above: None,
    };

    /// Fits the factors so that 95 % of the errors lie within the ellipse in the plane and within 1.96 standard
    /// deviations of every other axis, and within the bound all positions that are surer than any wrong one, which is
    /// more than `wrong_m` off.
    ///
    /// # Errors
    /// [`NoScale`] of too few poses, and where errors exceed any multiple of their covariances.
    pub fn fit(samples: &[PoseSample], wrong_m: f64) -> Result<Self, NoScale> {
        if samples.len() < MIN_POSES {
            return Err(NoScale::TooFew(samples.len()));
        }
        let planar = limit(samples.iter().map(PoseSample::planar_deviations), SHARE);
        let scale = Self {
            planar: planar.unwrap_or(f64::INFINITY) / SHARE_STD[1],
            height: axes_factor(samples, &[2]),
            tilt: axes_factor(samples, &[3, 4]),
            yaw: axes_factor(samples, &[5]),
            ..Self::NONE
        };
        scale.check()?;
        Ok(scale.with_bound(samples, wrong_m))
    }

    /// The scale with a bound of these poses, if they are enough.
    fn with_bound(self, samples: &[PoseSample], wrong_m: f64) -> Self {
        let wrong = samples.iter().filter(|sample| sample.off_m() > wrong_m);
        let bound_above = wrong.map(|sample| sample.sigma).reduce(f64::max);
        let scale = Self {
            bound_above,
            ..self
        };
        let sure = samples.iter().filter(|sample| scale.is_surer(sample.sigma));
        // After the factors: the bound is in scaled standard deviations.
        let ratios = sure.map(|sample| {
            let covariance = scale.applied(&sample.covariance);
            sample.off_m() / bound_std_m(&covariance, sample.start_std_m)
        });
        let ratios: Vec<f64> = ratios.collect();
        let bound = ratios.iter().copied().fold(0.0, f64::max);
        let least = match bound_above {
            Some(_) => MIN_CHOSEN_POSES,
            None => MIN_BOUND_POSES,
        };
        match ratios.len() >= least && bound <= MAX_FACTOR {
            true => Self {
                bound: Some(bound),
                ..scale
            },
            false => self,
        }
    }

    /// Checks values from a file.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn check(&self) -> Result<(), FieldError> {
        for (field, factor) in [
            ("planar", self.planar),
            ("height", self.height),
            ("tilt", self.tilt),
            ("yaw", self.yaw),
            ("bound", self.bound.unwrap_or(1.0)),
        ] {
            require(factor > 0.0, field, factor, "must be above 0")?;
            within(field, factor, 0.0, MAX_FACTOR)?;
        }
        within("bound_above", self.bound_above.unwrap_or(0.0), 0.0, 1.0)
    }

    /// Distance in the plane that at most one of 1,000 poses of this confidence and unscaled covariance exceeds, whose
    /// registration began at a pose of `start_std_m` ([`PoseSample::start_std_m`]), metres; `None` where it was not
    /// fitted, and for a pose that is no surer than a wrong one of the fit.
    pub fn bound_m(&self, sigma: f64, covariance: &[[f64; 6]; 6], start_std_m: f64) -> Option<f64> {
        let bound = self.bound.filter(|_| self.is_surer(sigma))?;
        Some(bound * bound_std_m(&self.applied(covariance), start_std_m))
    }

    fn is_surer(&self, sigma: f64) -> bool {
        self.bound_above.is_none_or(|wrong| sigma > wrong)
    }

    /// The scaled covariance.
    pub(crate) fn applied(&self, covariance: &[[f64; 6]; 6]) -> [[f64; 6]; 6] {
        let (planar, tilt) = (self.planar, self.tilt);
        let factors = [planar, planar, self.height, tilt, tilt, self.yaw];
        scaled(covariance, &Vector6::from(factors))
    }
}

/// Factor of the standard deviations of these axes, fitted to the errors of all of them.
fn axes_factor(samples: &[PoseSample], axes: &[usize]) -> f64 {
    let all = samples.iter();
    let all = all.flat_map(|sample| axes.iter().map(move |&axis| sample.deviations(axis)));
    limit(all, SHARE).unwrap_or(f64::INFINITY) / SHARE_STD[0]
}

/// Smallest value that a new one does not exceed with a probability of `share`, if it is of the same distribution;
/// `None` of too few values.
fn limit(values: impl Iterator<Item = f64>, share: f64) -> Option<f64> {
    // A singular covariance states that there is no error: any error is beyond it.
    let values = values.map(|value| if value.is_nan() { f64::INFINITY } else { value });
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    // A new value has each of n + 1 ranks with the same probability.
    let rank = ((sorted.len() + 1) as f64 * share).ceil() as usize;
    sorted.get(rank.checked_sub(1)?).copied()
}

/// A covariance with its standard deviations times these factors.
pub(crate) fn scaled(covariance: &[[f64; 6]; 6], factors: &Vector6<f64>) -> [[f64; 6]; 6] {
    let scale = Matrix6::from_diagonal(factors);
    let matrix = Matrix6::from_fn(|row, column| covariance[row][column]);
    let scaled = (scale * matrix * scale).transpose();
    let bounded = scaled.map(|entry| entry.clamp(-MAX_VARIANCE, MAX_VARIANCE));
    bounded.data.0
}

fn planar(covariance: &[[f64; 6]; 6]) -> Matrix2<f64> {
    Matrix2::from_fn(|row, column| covariance[row][column])
}

/// Standard deviation of which a bound is a multiple, metres: root of the sum of the variance along the worst axis of the
/// plane, that of the start and that of [`BOUND_FLOOR_M`].
fn bound_std_m(covariance: &[[f64; 6]; 6], start_std_m: f64) -> f64 {
    let variance = planar(covariance).symmetric_eigenvalues().max();
    // Rounding may make the eigenvalues of a singular matrix negative.
    let worst_std_m = variance.max(0.0).sqrt();
    worst_std_m.hypot(BOUND_FLOOR_M).hypot(start_std_m)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const WRONG_M: f64 = 3.0;

    /// Poses whose errors are these factors times as large as their residuals say; x and y are correlated.
    fn samples(count: usize, factors: [f64; 6], seed: u64) -> Vec<PoseSample> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let root = Matrix6::from_fn(|row, column| match (row, column) {
            (0, 1) => 0.02,
            _ if row == column => 0.01 * (row + 1) as f64,
            _ => 0.0,
        });
        let covariance = root * root.transpose();
        let samples = (0..count).map(|_| {
            let normal = Vector6::from_fn(|_, _| StandardNormal.sample(&mut random));
            PoseSample {
                error: (root * normal)
                    .component_mul(&Vector6::from(factors))
                    .into(),
                covariance: covariance.data.0,
                start_std_m: 0.0,
                sigma: 0.9,
            }
        });
        samples.collect()
    }

    #[test]
    fn a_fitted_covariance_holds_on_other_poses() {
        let factors = [3.0, 3.0, 7.0, 5.0, 5.0, 0.5];
        let scale = CovarianceScale::fit(&samples(4000, factors, 1), WRONG_M).unwrap();
        let fitted = [scale.planar, scale.height, scale.tilt, scale.yaw];
        for (fitted, factor) in fitted.into_iter().zip([3.0, 7.0, 5.0, 0.5]) {
            assert!((fitted / factor - 1.0).abs() < 0.1, "{fitted}, {factor}");
        }
        let (mut beyond, mut beyond_bound) = (0, 0);
        let others = samples(4000, factors, 2);
        for sample in &others {
            let stated = PoseSample {
                covariance: scale.applied(&sample.covariance),
                ..*sample
            };
            beyond += usize::from(stated.planar_deviations() > SHARE_STD[1]);
            let bound_m = scale.bound_m(sample.sigma, &sample.covariance, 0.0);
            beyond_bound += usize::from(sample.off_m() > bound_m.unwrap());
        }
        assert!((0.03..0.07).contains(&(beyond as f64 / 4000.0)), "{beyond}");
        assert!(beyond_bound <= 4, "{beyond_bound}");
    }

    #[test]
    fn few_poses_fit_nothing_and_three_thousand_are_needed_for_the_bound() {
        let all = samples(2995, [2.0; 6], 3);
        assert_eq!(
            CovarianceScale::fit(&all[..MIN_POSES - 1], WRONG_M),
            Err(NoScale::TooFew(49))
        );
        assert_eq!(
            CovarianceScale::fit(&all[..2994], WRONG_M).unwrap().bound,
            None
        );
        let scale = CovarianceScale::fit(&all, WRONG_M).unwrap();
        for sample in &all {
            let bound_m = scale.bound_m(0.9, &sample.covariance, 0.0).unwrap();
            assert!(
                sample.off_m() <= bound_m * (1.0 + 1e-9),
                "it is that of the worst of them"
            );
        }
        // A pose that was registered from an unsure one has a larger bound, and errors there count less.
        let bounds_m =
            [0.0, 1.0].map(|start_std_m| scale.bound_m(0.9, &all[0].covariance, start_std_m));
        assert!(bounds_m[1].unwrap() > scale.bound.unwrap() && bounds_m[0] < bounds_m[1]);
        let mut unsure = all.clone();
        unsure
            .iter_mut()
            .for_each(|sample| sample.start_std_m = 1.0);
        assert!(CovarianceScale::fit(&unsure, WRONG_M).unwrap().bound < scale.bound);
        // Singular covariances count as exceeded: a few do not matter, more than one in twenty cannot be fitted.
        let mut singular = samples(100, [2.0; 6], 3);
        singular[..4]
            .iter_mut()
            .for_each(|sample| sample.covariance = [[0.0; 6]; 6]);
        let regular = CovarianceScale::fit(&all[..100], WRONG_M).unwrap();
        assert!(CovarianceScale::fit(&singular, WRONG_M).unwrap().planar >= regular.planar);
        singular[..9]
            .iter_mut()
            .for_each(|sample| sample.covariance = [[0.0; 6]; 6]);
        let refused = CovarianceScale::fit(&singular, WRONG_M).unwrap_err();
        assert!(matches!(refused, NoScale::Unbounded(_)), "{refused}");
    }

    #[test]
    fn poses_that_are_no_surer_than_a_wrong_one_have_no_bound() {
        let mut all = samples(5000, [2.0; 6], 5);
        let unsure = all.split_at_mut(200).0;
        unsure.iter_mut().for_each(|sample| sample.sigma = 0.7);
        unsure[7].error[0] = 40.0;
        let scale = CovarianceScale::fit(&all, WRONG_M).unwrap();
        let of_sure = CovarianceScale::fit(&all[200..], WRONG_M).unwrap();
        assert_eq!((scale.bound_above, of_sure.bound_above), (Some(0.7), None));
        assert!((scale.bound.unwrap() / of_sure.bound.unwrap() - 1.0).abs() < 0.1);
        let bounds = [0.7, 0.71].map(|sigma| scale.bound_m(sigma, &all[0].covariance, 0.0));
        assert!(bounds[0].is_none() && bounds[1].is_some());
        // Among the surest: too few are left.
        all[4500].error[0] = 40.0;
        assert_eq!(CovarianceScale::fit(&all, WRONG_M).unwrap().bound, None);
    }

    #[test]
    fn factors_that_no_fit_has_are_refused_by_name() {
        let good = CovarianceScale::fit(&samples(100, [2.0; 6], 3), WRONG_M).unwrap();
        assert_eq!(good.check(), Ok(()));
        for factor in [0.0, -1.0, f64::NAN, 1e9] {
            let bad = CovarianceScale {
                tilt: factor,
                ..good
            };
            assert!(bad.check().unwrap_err().to_string().contains("tilt"));
        }
    }
}
