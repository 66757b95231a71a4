//! Sweeps of an agent: form, source of intensities, and plausibility of both.

use std::path::Path;

use serde::Serialize;

use crate::pcd::{IntensityKind, IntensityOrigin, PcdCloud};
use crate::points::{NO_INTENSITY, faint};
use crate::{IntensityScale, Plausibility, Problem};
use support::statistics;

/// Largest number of points of a sweep used for its median.
const MEDIAN_OF: usize = 4096;
/// Height of the middle four fifths of a sweep's points above which z does not point up: in multiples of their smaller
/// width along x and y, and in metres. A street of houses is below the former, a slope below the latter.
const UPRIGHT: (f64, f64) = (4.0, 5.0);
/// Fewer points than this may all have the same intensity.
const LEAST_POINTS: usize = 20;

/// The sweeps of an agent.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SweepReport {
    /// Form of the files, for example `PCD, binary` or `5 floats per point: x y z intensity ring`.
    pub form: &'static str,
    /// Source of intensities; `None` if there are none.
    pub intensity: Option<IntensityOrigin>,
    /// Smallest intensity, after division.
    pub min_intensity: f32,
    /// Median over the sweeps of each sweep's median (of 4,096 of its points, evenly picked).
    pub median_intensity: f32,
    /// Largest intensity.
    pub max_intensity: f32,
}

/// Findings of one sweep.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SweepFindings {
    /// Number of points.
    pub points: usize,
    form: &'static str,
    intensity: Option<IntensityOrigin>,
    /// Smallest, median and largest intensity; `None` without points.
    range: Option<[f32; 3]>,
    above_one: usize,
    below_zero: usize,
    plausibility: Plausibility,
    /// Distances from the lower to the upper tenth of x, y and z, metres.
    spread_m: Option<[f64; 3]>,
}

impl SweepFindings {
    /// Findings of a sweep with intensities from 0 to 1.
    pub fn of(cloud: &PcdCloud) -> Self {
        let values = cloud.points.xyzi.iter().map(|point| point[3]);
        // Evenly picked: the first points may all be of one laser.
        let step = cloud.points.len().div_ceil(MEDIAN_OF).max(1);
        let median = median(&values.clone().step_by(step).collect::<Vec<_>>());
        let range = median.map(|median| {
            [
                values.clone().fold(f32::INFINITY, f32::min),
                median,
                values.clone().fold(f32::NEG_INFINITY, f32::max),
            ]
        });
        Self {
            points: cloud.points.len(),
            form: cloud.form,
            intensity: cloud.intensity.clone(),
            range,
            above_one: values.clone().filter(|&value| value > 1.0).count(),
            below_zero: values.filter(|&value| value < 0.0).count(),
            plausibility: Plausibility::of(&cloud.points),
            spread_m: spread_m(&cloud.points.xyzi, step),
        }
    }
}

/// Distances from the lower to the upper tenth of x, y and z; `None` of few points.
fn spread_m(points: &[[f32; 4]], step: usize) -> Option<[f64; 3]> {
    let along = |axis: usize| {
        let values = points.iter().step_by(step);
        let values = values.filter_map(|point| point.get(axis).copied().map(f64::from));
        let sorted = statistics::sorted(&values.collect::<Vec<_>>());
        Some(statistics::quantile(&sorted, 0.9)? - statistics::quantile(&sorted, 0.1)?)
    };
    let enough = points.len() >= LEAST_POINTS;
    enough.then_some([along(0)?, along(1)?, along(2)?])
}

/// Names an axis beside z that points up.
fn axes_fault(sweeps: &[&SweepFindings]) -> Option<String> {
    let spreads = sweeps.iter().filter_map(|sweep| sweep.spread_m);
    let spreads: Vec<[f64; 3]> = spreads.collect();
    let median = |axis: usize| {
        let along = spreads
            .iter()
            .filter_map(|spread| spread.get(axis).copied());
        statistics::median(&along.collect::<Vec<_>>())
    };
    let [x, y, z] = [0, 1, 2].map(median);
    let (x, y, z, (ratio, least_m)) = (x?, y?, z?, UPRIGHT);
    (z > least_m && z > ratio * x.min(y)).then(|| {
        format!(
            "from the lower to the upper tenth they have {x:.1} m along x, {y:.1} m along y and {z:.1} m along z: z must point \
             up, as in the frame of a LiDAR (not of a camera)"
        )
    })
}

#[expect(clippy::cast_possible_truncation, reason = "of f32")]
fn median(values: &[f32]) -> Option<f32> {
    let values: Vec<f64> = values.iter().copied().map(f64::from).collect();
    statistics::median(&values).map(|median| median as f32)
}

impl SweepReport {
    /// The sweeps of an agent together, in order; `None` if no sweep has a point.
    pub fn of(sweeps: &[&SweepFindings]) -> Option<Self> {
        let first = sweeps.iter().find(|sweep| sweep.range.is_some())?;
        let ranges = sweeps.iter().filter_map(|sweep| sweep.range);
        let medians: Vec<f32> = ranges.clone().map(|[_, median, _]| median).collect();
        Some(Self {
            form: first.form,
            intensity: first.intensity.clone(),
            min_intensity: ranges
                .clone()
                .fold(f32::INFINITY, |least, [min, ..]| least.min(min)),
            median_intensity: median(&medians)?,
            max_intensity: ranges.fold(f32::NEG_INFINITY, |most, [.., max]| most.max(max)),
        })
    }
}

/// Problems of `named` sweeps of a folder together, for example those `of agent 1`.
pub(super) fn problems(
    folder: &Path,
    named: &str,
    sweeps: &[&SweepFindings],
    scale: IntensityScale,
) -> Vec<Problem> {
    let Some(report) = SweepReport::of(sweeps) else {
        return Vec::new();
    };
    let mut plausibility = Plausibility::default();
    sweeps
        .iter()
        .for_each(|sweep| plausibility.join(&sweep.plausibility));
    let fault = plausibility.fault().or_else(|| axes_fault(sweeps));
    let points = fault.map(|fault| ("x y z", fault));
    let intensity = intensity_fault(&report, sweeps, scale).map(|fault| ("intensity", fault));
    let path = folder.display().to_string();
    let faults = points.into_iter().chain(intensity);
    faults
        .map(|(field, fault)| Problem::about(&path, field, &format!("sweeps{named}: {fault}")))
        .collect()
}

/// The first fault of the intensities.
fn intensity_fault(
    report: &SweepReport,
    sweeps: &[&SweepFindings],
    scale: IntensityScale,
) -> Option<String> {
    let Some(origin) = &report.intensity else {
        return Some(NO_INTENSITY.to_owned());
    };
    let (min, max) = (report.min_intensity, report.max_intensity);
    let points: usize = sweeps.iter().map(|sweep| sweep.points).sum();
    let from = format!("field {} divided by {}", origin.field, origin.divisor);
    let above: usize = sweeps.iter().map(|sweep| sweep.above_one).sum();
    if above > 0 {
        return Some(format!(
            "{above} of {points} intensities are above 1, up to {max} ({from}): see --intensity-scale"
        ));
    }
    let below: usize = sweeps.iter().map(|sweep| sweep.below_zero).sum();
    if below > 0 {
        return Some(format!(
            "{below} of {points} intensities are below 0, down to {min} ({from})"
        ));
    }
    if points >= LEAST_POINTS && min.total_cmp(&max).is_eq() {
        return Some(format!(
            "all {points} intensities are {min} ({from}), expected a sensor's, which differ"
        ));
    }
    (scale.unusual(origin.divisor, max * origin.divisor)).or_else(|| faint(points, max, &from))
}

impl std::fmt::Display for SweepReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; ", self.form)?;
        let Some(origin) = &self.intensity else {
            return f.write_str("no intensity");
        };
        let (field, divisor) = (&origin.field, origin.divisor);
        let (min, max) = (self.min_intensity, self.max_intensity);
        let stored = match origin.kind {
            IntensityKind::RedByte => ", red byte",
            IntensityKind::Byte => ", a byte",
            IntensityKind::Number => "",
        };
        write!(
            f,
            "intensity from {field}{stored}, divided by {divisor}: {min:.3} to {max:.3}, median {:.3}",
            self.median_intensity
        )
    }
}
