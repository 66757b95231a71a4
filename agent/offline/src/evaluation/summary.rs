//! Summary of an evaluation: error and calibration figures, and the reliability curve.

use std::collections::BTreeMap;

use serde::Serialize;
use support::statistics::{SUCCESS_M, mean, median, quantile, share_below, sorted};

use super::{EvaluatedSweep, outcome};
use figures::{Axis, Chart, Mark, Series};
use localization::pgc::confidence::{BAD_M, observed};
use localization::pgc::pose_solver::FoundPose;
use localization::statistics::spearman;

/// Number of groups of equally many sweeps in the calibration curve.
const BINS: usize = 10;

/// Results of an evaluation. Errors are those of published poses; a sweep without one is no success.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LocalizationSummary {
    /// Number of sweeps.
    pub sweeps: usize,
    /// Share of sweeps with an error below 3 m, 0..=1.
    pub success_3m: f64,
    /// Share of sweeps with an error below 1 m, 0..=1.
    pub success_1m: f64,
    /// Mean distance error, metres.
    pub mean_m: Option<f64>,
    /// Median distance error, metres.
    pub p50_m: Option<f64>,
    /// 95th percentile of the distance error, metres.
    pub p95_m: Option<f64>,
    /// 99th percentile of the distance error, metres.
    pub p99_m: Option<f64>,
    /// Largest distance error, metres.
    pub max_m: Option<f64>,
    /// Mean angle error, degrees.
    pub mean_deg: Option<f64>,
    /// Median angle error, degrees.
    pub p50_deg: Option<f64>,
    /// 95th percentile of the angle error, degrees.
    pub p95_deg: Option<f64>,
    /// Largest angle error, degrees.
    pub max_deg: Option<f64>,
    /// Number of sweeps without a pose, rejected ones included.
    pub no_pose: usize,
    /// Sweeps with few or no training sweeps of the head nearby; absent if it does not state its drives.
    pub low_coverage: Option<CoverageSummary>,
    /// Number of estimated poses that a surfel map registered; absent without one.
    pub registered: Option<usize>,
    /// Number of sweeps by outcome.
    pub outcomes: BTreeMap<&'static str, usize>,
    /// Spearman's correlation of sigma and distance error over all estimated poses, rejected ones included; -1 is
    /// perfect.
    pub sigma_spearman: Option<f64>,
    /// The same of the inlier ratio alone.
    pub inlier_ratio_spearman: Option<f64>,
    /// Mean absolute difference of sigma from its target, over groups of equally many poses.
    pub calibration_error: Option<f64>,
    /// Those groups, by ascending sigma.
    pub calibration: Vec<CalibrationBin>,
    /// Rejected poses, and the good ones among them.
    pub rejected: RejectionSummary,
    /// Share of the localizer's published poses whose error lies beyond the 95 % ellipse in the plane, and beyond 1.96
    /// standard deviations of z, roll, pitch and yaw, 0..=1; empty without such poses.
    pub beyond_95: BTreeMap<&'static str, f64>,
    /// Integrity of the covariances of published poses, whose bounds are of 95 %; absent if they have none.
    pub integrity: Option<IntegritySummary>,
    /// Integrity of the bound that at most one position in 1,000 exceeds; absent without a fitted bound.
    pub bound: Option<IntegritySummary>,
    /// Median milliseconds by stage; `total` is that of all stages of a sweep.
    pub ms: BTreeMap<String, f64>,
    /// Mean milliseconds of all stages of a sweep.
    pub mean_ms: f64,
}

/// Planar errors of published poses against the bounds that were published with them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct IntegritySummary {
    /// Number of poses with a bound.
    pub poses: usize,
    /// Number of them whose error exceeds it.
    pub exceeded: usize,
    /// The same as a share, 0..=1.
    pub exceeded_share: f64,
    /// Median bound, metres.
    pub p50_bound_m: f64,
}

/// Sweeps with few or no training sweeps of the head nearby.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CoverageSummary {
    /// Number of these sweeps.
    pub sweeps: usize,
    /// Number of them without a pose.
    pub no_pose: usize,
}

/// Poses of similar sigma.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CalibrationBin {
    /// Number of poses.
    pub poses: usize,
    /// Mean sigma, 0..=1.
    pub sigma: f64,
    /// Target of sigma: the mean of `1 / (1 + e^2)` of their errors in metres.
    pub observed: f64,
    /// Median distance error, metres.
    pub p50_m: f64,
    /// Share of them with an error below 3 m, 0..=1.
    pub success_3m: f64,
}

/// Results of the rejection threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RejectionSummary {
    /// Number of estimated poses that are rejected.
    pub poses: usize,
    /// Number of estimated poses with an error above 3 m.
    pub bad: usize,
    /// Share of them that is rejected, 0..=1.
    pub bad_share: Option<f64>,
    /// Share of the others that is rejected, 0..=1.
    pub good_share: Option<f64>,
}

/// An estimated pose and its error, metres.
type Judged = (FoundPose, f64);

impl LocalizationSummary {
    /// Summary of sweeps.
    pub fn of(sweeps: &[EvaluatedSweep]) -> Self {
        let published = sweeps.iter().filter_map(EvaluatedSweep::published_error);
        let (metres, degrees): (Vec<f64>, Vec<f64>) = published
            .map(|error| (error.distance_m, error.angle_deg))
            .unzip();
        let (metres, degrees) = (sorted(&metres), sorted(&degrees));
        let [success_3m, success_1m] =
            [SUCCESS_M, 1.0].map(|limit_m| share_below(&metres, limit_m, sweeps.len()));
        let judged = judged(sweeps);
        let sigmas = each(&judged, |(found, _)| found.sigma);
        let ratios = each(&judged, |(found, _)| found.evidence.inlier_ratio);
        let errors = each(&judged, |(_, error_m)| *error_m);
        let calibration = calibration(&judged);
        let mut outcomes = BTreeMap::new();
        for sweep in sweeps {
            let outcome = outcome(&sweep.localization.estimate);
            *outcomes.entry(outcome).or_default() += 1;
        }
        let totals = sweeps.iter().map(|sweep| sweep.localization.times.total());
        let total_ms: Vec<f64> = totals.map(|total| total.as_secs_f64() * 1e3).collect();
        let bins = calibration.iter();
        let gaps: Vec<f64> = bins.map(|bin| (bin.sigma - bin.observed).abs()).collect();
        Self {
            sweeps: sweeps.len(),
            success_3m,
            success_1m,
            mean_m: mean(&metres),
            p50_m: quantile(&metres, 0.5),
            p95_m: quantile(&metres, 0.95),
            p99_m: quantile(&metres, 0.99),
            max_m: metres.last().copied(),
            mean_deg: mean(&degrees),
            p50_deg: quantile(&degrees, 0.5),
            p95_deg: quantile(&degrees, 0.95),
            max_deg: degrees.last().copied(),
            no_pose: sweeps.len() - metres.len(),
            low_coverage: low_coverage(sweeps),
            registered: None,
            outcomes,
            sigma_spearman: spearman(&sigmas, &errors),
            inlier_ratio_spearman: spearman(&ratios, &errors),
            calibration_error: mean(&gaps),
            calibration,
            rejected: rejected(&judged),
            beyond_95: beyond_95(sweeps),
            integrity: integrity(sweeps.iter().filter_map(covariance_bound)),
            bound: integrity(sweeps.iter().filter_map(EvaluatedSweep::bounded_error)),
            ms: median_times(sweeps),
            mean_ms: mean(&total_ms).unwrap_or(0.0),
        }
    }
}

fn low_coverage(sweeps: &[EvaluatedSweep]) -> Option<CoverageSummary> {
    let known = sweeps.iter().any(|sweep| sweep.is_covered.is_some());
    let outside = sweeps.iter();
    let outside = outside.filter(|sweep| sweep.is_covered == Some(false));
    known.then(|| CoverageSummary {
        sweeps: outside.clone().count(),
        no_pose: (outside.filter(|sweep| sweep.published_error().is_none())).count(),
    })
}

fn judged(sweeps: &[EvaluatedSweep]) -> Vec<Judged> {
    let judged = sweeps.iter();
    let judged = judged.filter_map(|of| Some((of.localization.found?, of.error()?.distance_m)));
    judged.collect()
}

fn calibration(judged: &[Judged]) -> Vec<CalibrationBin> {
    let mut by_sigma = judged.to_vec();
    by_sigma.sort_by(|(a, _), (b, _)| a.sigma.total_cmp(&b.sigma));
    let all = by_sigma.len();
    (0..BINS)
        .map(|bin| &by_sigma[bin * all / BINS..(bin + 1) * all / BINS])
        .filter(|poses| !poses.is_empty())
        .map(|poses| CalibrationBin {
            poses: poses.len(),
            sigma: mean(&each(poses, |(found, _)| found.sigma)).unwrap_or(0.0),
            observed: mean(&each(poses, |(_, error_m)| observed(*error_m))).unwrap_or(0.0),
            p50_m: median(&each(poses, |(_, error_m)| *error_m)).unwrap_or(0.0),
            success_3m: mean(&each(poses, |(_, error_m)| f64::from(*error_m < BAD_M)))
                .unwrap_or(0.0),
        })
        .collect()
}

fn each(poses: &[Judged], value: fn(&Judged) -> f64) -> Vec<f64> {
    poses.iter().map(value).collect()
}

fn rejected(judged: &[Judged]) -> RejectionSummary {
    let (good, bad): (Vec<&Judged>, Vec<&Judged>) =
        judged.iter().partition(|(_, error_m)| *error_m <= BAD_M);
    let [bad_share, good_share] = [&bad, &good].map(|poses| {
        let rejected = poses.iter().filter(|(found, _)| found.is_rejected).count();
        (!poses.is_empty()).then_some(rejected as f64 / poses.len() as f64)
    });
    RejectionSummary {
        poses: (judged.iter().filter(|(found, _)| found.is_rejected)).count(),
        bad: bad.len(),
        bad_share,
        good_share,
    }
}

fn beyond_95(sweeps: &[EvaluatedSweep]) -> BTreeMap<&'static str, f64> {
    let samples = sweeps.iter().filter_map(EvaluatedSweep::published_sample);
    let mut by_axis: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (axis, is_beyond) in samples.flat_map(|sample| sample.beyond_95()) {
        by_axis.entry(axis).or_default().push(f64::from(is_beyond));
    }
    let by_axis = by_axis.into_iter();
    let shares = by_axis.filter_map(|(axis, all)| Some((axis, mean(&all)?)));
    shares.collect()
}

/// Error in the plane of a published pose with a covariance, and its bound of 95 %, metres.
fn covariance_bound(sweep: &EvaluatedSweep) -> Option<(f64, f64)> {
    let estimate = &sweep.localization.estimate;
    let (world_from_cav, covariance) = (estimate.world_from_cav()?, estimate.covariance()?);
    let [x, y] =
        [0, 1].map(|axis| world_from_cav.translation_m[axis] - sweep.truth.translation_m[axis]);
    Some((x.hypot(y), covariance.bound_95_m()))
}

/// Integrity of errors with their bounds; `None` without any.
fn integrity(judged: impl Iterator<Item = (f64, f64)>) -> Option<IntegritySummary> {
    let judged: Vec<(f64, f64)> = judged.collect();
    let exceeded = judged.iter().filter(|(error_m, bound_m)| error_m > bound_m);
    let exceeded = exceeded.count();
    let bounds: Vec<f64> = judged.iter().map(|(_, bound_m)| *bound_m).collect();
    // Without any bound the median is `None`, and the share of 0 / 0 is not returned.
    Some(IntegritySummary {
        poses: judged.len(),
        exceeded,
        exceeded_share: exceeded as f64 / judged.len() as f64,
        p50_bound_m: median(&bounds)?,
    })
}

fn median_times(sweeps: &[EvaluatedSweep]) -> BTreeMap<String, f64> {
    let mut times: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for sweep in sweeps {
        let stages = &sweep.localization.times;
        let of_stages = stages.timings().iter().map(|timing| {
            let stage = timing.stage.trim_start_matches("pose ");
            (stage, timing.nanos as f64 * 1e-6)
        });
        for (stage, ms) in of_stages.chain([("total", stages.total().as_secs_f64() * 1e3)]) {
            times.entry(stage.to_owned()).or_default().push(ms);
        }
    }
    let medians = times.into_iter();
    let medians = medians.map(|(stage, ms)| (stage, median(&ms).unwrap_or(0.0)));
    medians.collect()
}

/// The reliability curve, and every pose by sigma and error.
pub fn reliability_charts(sweeps: &[EvaluatedSweep]) -> Vec<Chart> {
    let judged = judged(sweeps);
    let bins = calibration(&judged);
    let published = sweeps.iter().filter_map(EvaluatedSweep::published_error);
    let [kept, rejected] = [("published", false), ("rejected", true)].map(|(name, is_rejected)| {
        let poses = judged.iter();
        let poses = poses.filter(|(found, _)| found.is_rejected == is_rejected);
        // The axis is logarithmic: errors beyond its ends are drawn there.
        let points = poses.map(|(found, error_m)| (found.sigma, error_m.clamp(0.01, 1000.0)));
        series(name, points.collect(), Mark::Dots)
    });
    let (all, published) = (sweeps.len(), published.count());
    let groups = bins.iter().map(|bin| (bin.sigma, bin.observed)).collect();
    let diagonal = vec![(0.0, 0.0), (1.0, 1.0)];
    let reliability = Chart {
        title: format!("Reliability, {all} sweeps, {published} poses published"),
        x: Axis::linear("sigma", [0.0, 1.0]),
        y: Axis::linear("mean of 1 / (1 + e^2), e in m", [0.0, 1.0]),
        series: vec![
            series("poses in groups of equal size", groups, Mark::LineAndDots),
            series("perfectly calibrated", diagonal, Mark::Line),
        ],
    };
    let errors = Chart {
        title: "Error of every estimated pose".into(),
        x: Axis::linear("sigma", [0.0, 1.0]),
        y: Axis::logarithmic("distance to the true position, m", [0.01, 1000.0]),
        series: vec![
            kept,
            series("3 m", vec![(0.0, BAD_M), (1.0, BAD_M)], Mark::Line),
            rejected,
        ],
    };
    vec![reliability, errors]
}

fn series(name: &str, points: Vec<(f64, f64)>, mark: Mark) -> Series {
    Series {
        name: name.into(),
        points,
        mark,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::evaluated;
    use super::*;
    use localization::pgc::confidence::{Confidence, ConfidenceModel};

    #[test]
    fn shares_count_all_sweeps_and_errors_only_poses() {
        let mut sweeps = evaluated(40);
        let summary = LocalizationSummary::of(&sweeps);
        assert_eq!(summary.sweeps, 40);
        assert_eq!(summary.outcomes.values().sum::<usize>(), 40);
        assert!(summary.success_1m <= summary.success_3m && summary.success_3m < 1.0);
        assert!(summary.p50_m < summary.p95_m && summary.p95_m <= summary.max_m);
        assert_eq!(
            summary
                .calibration
                .iter()
                .map(|bin| bin.poses)
                .sum::<usize>(),
            40 - summary.no_pose
        );
        assert!(summary.sigma_spearman.unwrap() < -0.5);
        assert_eq!(
            (summary.rejected.poses, summary.rejected.good_share),
            (0, Some(0.0))
        );
        assert_eq!(summary.ms.len(), 6);
        // Rejecting everything leaves every sweep without a pose, and the errors of unpublished poses do not count.
        let all = Confidence::Calibrated(ConfidenceModel {
            reject_below: 1.1,
            ..ConfidenceModel::example()
        });
        sweeps.iter_mut().for_each(|sweep| sweep.judge_again(&all));
        let silent = LocalizationSummary::of(&sweeps);
        assert_eq!(
            (silent.no_pose, silent.success_3m, silent.mean_m),
            (40, 0.0, None)
        );
        assert_eq!(silent.rejected.bad_share, Some(1.0));
        assert!(silent.sigma_spearman.is_some());
    }

    #[test]
    fn sweeps_of_low_coverage_are_counted() {
        let mut sweeps = evaluated(20);
        assert_eq!(low_coverage(&sweeps), None);
        // Sweeps 9 and 19 are empty.
        for (number, sweep) in sweeps.iter_mut().enumerate() {
            sweep.is_covered = Some(!(8..11).contains(&number));
        }
        let outside = low_coverage(&sweeps).unwrap();
        assert_eq!((outside.sweeps, outside.no_pose), (3, 1));
    }

    #[test]
    fn the_serialised_names_are_there() {
        let json = serde_json::to_value(LocalizationSummary::of(&evaluated(12))).unwrap();
        for name in [
            "sweeps",
            "success_3m",
            "success_1m",
            "mean_m",
            "p50_m",
            "p95_m",
            "mean_deg",
            "p50_deg",
            "sigma_spearman",
        ] {
            assert!(json[name].is_number(), "{name}: {}", json[name]);
        }
        assert!(json["no_pose"].is_u64() && json["ms"]["total"].is_number());
        assert!(LocalizationSummary::of(&[]).mean_m.is_none());
    }

    #[test]
    fn the_charts_show_every_pose() {
        let sweeps = evaluated(30);
        let charts = reliability_charts(&sweeps);
        let found = sweeps
            .iter()
            .filter(|sweep| sweep.localization.found.is_some())
            .count();
        assert_eq!(
            charts[1].series[0].points.len() + charts[1].series[2].points.len(),
            found
        );
        assert_eq!(charts[0].series[0].points.len(), BINS);
    }
}
