//! Sweeps of an agent: form, source of intensities, and plausibility of both.

use std::path::Path;

use protocol::CavId;
use serde::Serialize;

use super::Problem;
use dataset::pcd::{IntensityKind, IntensityOrigin, PcdCloud};
use dataset::{IntensityScale, Plausibility};
use support::statistics;

/// Largest number of points of a sweep used for its median.
const MEDIAN_OF: usize = 4096;
/// Fewer points than this may all have the same intensity.
const LEAST_POINTS: usize = 20;
/// Divisors that need no explanation: 0 to 1, and a byte.
const USUAL_DIVISORS: [f32; 2] = [1.0, 255.0];

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
#[derive(Debug, Default)]
pub(super) struct SweepFindings {
    points: usize,
    form: &'static str,
    intensity: Option<IntensityOrigin>,
    /// Smallest, median and largest intensity; `None` without points.
    range: Option<[f32; 3]>,
    above_one: usize,
    below_zero: usize,
    plausibility: Plausibility,
}

impl SweepFindings {
    pub(super) fn of(cloud: &PcdCloud) -> Self {
        let mut plausibility = Plausibility::default();
        plausibility.add(&cloud.points);
        let values = || cloud.points.xyzi.iter().map(|point| point[3]);
        let step = cloud.points.len().div_ceil(MEDIAN_OF).max(1);
        let median = median(&values().step_by(step).collect::<Vec<_>>());
        let range = median.map(|median| {
            [
                values().fold(f32::INFINITY, f32::min),
                median,
                values().fold(f32::NEG_INFINITY, f32::max),
            ]
        });
        Self {
            points: cloud.points.len(),
            form: cloud.form,
            intensity: cloud.intensity.clone(),
            range,
            above_one: values().filter(|&value| value > 1.0).count(),
            below_zero: values().filter(|&value| value < 0.0).count(),
            plausibility,
        }
    }
}

fn median(values: &[f32]) -> Option<f32> {
    let values: Vec<f64> = values.iter().copied().map(f64::from).collect();
    statistics::median(&values).map(|median| median as f32)
}

/// The sweeps of an agent together, in order; `None` if no sweep has a point.
pub(super) fn summarize(sweeps: &[&SweepFindings]) -> Option<SweepReport> {
    let first = sweeps.iter().find(|sweep| sweep.range.is_some())?;
    let ranges = || sweeps.iter().filter_map(|sweep| sweep.range);
    Some(SweepReport {
        form: first.form,
        intensity: first.intensity.clone(),
        min_intensity: ranges().map(|[min, ..]| min).fold(f32::INFINITY, f32::min),
        median_intensity: median(&ranges().map(|[_, median, _]| median).collect::<Vec<_>>())?,
        max_intensity: ranges()
            .map(|[.., max]| max)
            .fold(f32::NEG_INFINITY, f32::max),
    })
}

/// Problems of the sweeps of an agent in `folder`.
pub(super) fn problems(
    folder: &Path,
    agent: &CavId,
    sweeps: &[&SweepFindings],
    scale: IntensityScale,
) -> Vec<Problem> {
    let Some(report) = summarize(sweeps) else {
        return Vec::new();
    };
    let mut plausibility = Plausibility::default();
    sweeps
        .iter()
        .for_each(|sweep| plausibility.join(&sweep.plausibility));
    let mut problems = Vec::new();
    let mut add = |field: &str, what: String| {
        let path = folder.display().to_string();
        let message = format!("{path}: sweeps of agent {agent}: {what}");
        problems.push(Problem {
            path,
            line: None,
            field: Some(field.into()),
            message,
        });
    };
    if let Some(fault) = plausibility.fault() {
        add("x y z", fault);
    }
    if let Some(fault) = intensity_fault(&report, sweeps, scale) {
        add("intensity", fault);
    }
    problems
}

/// The first fault of the intensities.
fn intensity_fault(
    report: &SweepReport,
    sweeps: &[&SweepFindings],
    scale: IntensityScale,
) -> Option<String> {
    let Some(origin) = &report.intensity else {
        return Some(
            "no intensity field (intensity, reflectivity, remission, rgb, ...): it is 0 for all points".into(),
        );
    };
    let SweepReport {
        min_intensity: min,
        max_intensity: max,
        ..
    } = *report;
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
    let is_unusual = scale == IntensityScale::AUTO && !USUAL_DIVISORS.contains(&origin.divisor);
    is_unusual.then(|| {
        let stored = max * origin.divisor;
        format!(
            "intensities reach {stored}, neither 0 to 1 nor 0 to 255 ({from}): state the scale by --intensity-scale"
        )
    })
}

impl std::fmt::Display for SweepReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            form,
            intensity,
            min_intensity: min,
            median_intensity: median,
            max_intensity: max,
        } = self;
        write!(f, "{form}; ")?;
        let Some(IntensityOrigin {
            field,
            kind,
            divisor,
        }) = intensity
        else {
            return f.write_str("no intensity");
        };
        let stored = match kind {
            IntensityKind::RedByte => ", red byte",
            IntensityKind::Byte => ", a byte",
            IntensityKind::Number => "",
        };
        write!(
            f,
            "intensity from {field}{stored}, divided by {divisor}: {min:.3} to {max:.3}, median {median:.3}"
        )
    }
}
