//! Charts of average precision against each axis that varies.

use std::collections::{BTreeMap, BTreeSet};

use figures::{Axis, Chart, Mark, Series};
use fusion::Exchange;

use super::Run;
use super::grid::Point;
use crate::experiment::spec::Experiment;

/// Name of the files of a figure, and its charts.
type Figure = (&'static str, Vec<Chart>);

/// A quantity that each point has.
struct Dimension {
    /// Name of its figure.
    name: &'static str,
    label: &'static str,
    value: fn(&Run) -> Option<f64>,
    /// Label that distinguishes series by it, if it is not on the axis.
    text: fn(&Point) -> Option<String>,
}

const DIMENSIONS: [Dimension; 7] = [
    Dimension {
        name: "ap_latency",
        label: "latency, ms",
        value: |run| run.point.latency_ms,
        text: |point| point.latency_ms.map(|ms| format!("{ms} ms")),
    },
    Dimension {
        name: "ap_jitter",
        label: "standard deviation of the latency, ms",
        value: |run| run.point.jitter_ms,
        text: |point| point.jitter_ms.map(|ms| format!("jitter {ms} ms")),
    },
    Dimension {
        name: BANDWIDTH,
        label: "rate of a link, Mbit/s",
        value: |run| run.point.bandwidth_mbps,
        text: |point| {
            let limited = point.bandwidth_mbps.map(|mbps| format!("{mbps} Mbit/s"));
            limited.or_else(|| Some("unlimited".into()))
        },
    },
    Dimension {
        name: "ap_loss",
        label: "share of messages lost",
        value: |run| run.point.loss,
        text: |point| point.loss.map(|share| format!("loss {share}")),
    },
    Dimension {
        name: POSE_NOISE,
        label: "position noise, m (degrees alike, unless named)",
        value: |run| run.point.pose_noise.map(|noise| noise.position_std_m),
        text: |point| {
            let noise = point.pose_noise?;
            let (position_m, heading_deg) = (noise.position_std_m, noise.heading_std_deg);
            Some(format!("{position_m} m {heading_deg} deg"))
        },
    },
    Dimension {
        name: "ap_agents",
        label: "vehicles that take part",
        value: |run| run.point.vehicles.map(|vehicles| vehicles as f64),
        text: |point| {
            point
                .vehicles
                .map(|vehicles| format!("{vehicles} vehicles"))
        },
    },
    Dimension {
        name: BYTES,
        label: "log2 of a message's bytes",
        value: |run| run.cell.metrics.comm.log2_payload,
        text: codec,
    },
];

/// The one figure whose values are two numbers each.
const POSE_NOISE: &str = "ap_pose_noise";
/// The one figure with a logarithmic axis.
const BANDWIDTH: &str = "ap_bandwidth";
/// The one figure whose values are far from zero.
const BYTES: &str = "ap_bytes";

fn codec(point: &Point) -> Option<String> {
    if point.method.exchange() != Exchange::Features {
        return None;
    }
    let kept = point.codec.keep;
    let kept = kept.map_or(String::new(), |keep| format!(" {} %", 100.0 * keep));
    let level = point.codec.zstd_level;
    let packed = level.map_or(String::new(), |level| format!(" zstd {level}"));
    Some(point.codec.name() + &kept + &packed)
}

/// Names of all figures that a sweep may have.
pub(super) fn names() -> impl Iterator<Item = &'static str> {
    DIMENSIONS.iter().map(|dimension| dimension.name)
}

/// A figure for each field with several values, AP at 0.5 and at 0.7 side by side; means over seeds.
pub(super) fn figures(experiment: &Experiment, runs: &[Run]) -> Vec<Figure> {
    // Compared by their labels: the bytes of a message are known only after a run, its codec before.
    let varying: Vec<&Dimension> = DIMENSIONS
        .iter()
        .filter(|dimension| {
            let texts = runs.iter().filter_map(|run| (dimension.text)(&run.point));
            texts.collect::<BTreeSet<_>>().len() > 1
        })
        .collect();
    let figures = varying.iter().map(|dimension| {
        // Precisions by their place among those at three IoUs.
        let charts = [("AP@0.5", 1), ("AP@0.7", 2)].map(|(title, iou)| {
            let series = series(runs, dimension, &varying, iou);
            let order = runs.first()?.cell.metrics.ap_order().name();
            Some(Chart {
                title: format!("{}: {title}", experiment.name),
                x: axis(dimension, &series)?,
                y: Axis::linear(&format!("AP, {order} order"), [0.0, 1.0]),
                series,
            })
        });
        (dimension.name, Vec::from_iter(charts.into_iter().flatten()))
    });
    figures.filter(|(_, charts)| !charts.is_empty()).collect()
}

/// The axis of a chart's field; `None` without values.
fn axis(dimension: &Dimension, series: &[Series]) -> Option<Axis> {
    let xs = series
        .iter()
        .flat_map(|series| series.points.iter().map(|(x, _)| (*x, *x)));
    let (low, high) = xs.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    Some(if dimension.name == BANDWIDTH {
        let first = low.log10().floor();
        // At least one decade, so that the axis has a width where all values are equal.
        let decades = [first, high.log10().ceil().max(first + 1.0)];
        Axis::logarithmic(dimension.label, decades.map(|decade| 10f64.powf(decade)))
    } else {
        Axis::linear(dimension.label, span(low, high, dimension.name == BYTES))
    })
}

/// Lines of a chart. Along bytes, the cells of all values of a codec form one line; along the noise of the position there
/// is a line for each noise of the heading, unless they are alike.
fn series(runs: &[Run], dimension: &Dimension, varying: &[&Dimension], iou: usize) -> Vec<Series> {
    let mut noises = runs.iter().filter_map(|run| run.point.pose_noise);
    // True if the noise of each heading, degrees, is the number of that of its position, metres.
    let is_alike = noises.all(|noise| noise.heading_std_deg == noise.position_std_m);
    let names_heading = dimension.name == POSE_NOISE && !is_alike;
    let mut series: Vec<(String, GroupedPoints)> = Vec::new();
    for run in runs {
        let precision = run.cell.metrics.headline().values()[iou];
        let (Some(x), Some(y)) = ((dimension.value)(run), precision) else {
            continue;
        };
        let point = &run.point;
        let others = varying.iter().filter(|other| other.name != dimension.name);
        let mut names = vec![point.method.name().to_owned()];
        names.extend(others.filter_map(|other| (other.text)(point)));
        let noise = point.pose_noise.filter(|_| names_heading);
        names.extend(noise.map(|noise| format!("heading {} deg", noise.heading_std_deg)));
        let name = names.join(", ");
        let known = series.iter().position(|(known, _)| *known == name);
        let known = known.unwrap_or_else(|| {
            series.push((name.clone(), BTreeMap::new()));
            series.len() - 1
        });
        // Runs that differ in nothing but their seed share a key and become one point.
        let key = (dimension.text)(point).unwrap_or_else(|| x.to_bits().to_string());
        series[known].1.entry(key).or_default().push((x, y));
    }
    let series = series.into_iter().map(|(name, points)| line(name, points));
    series.collect()
}

/// Points of a line, grouped for the mean over seeds: by their label, or else by the bits of their x.
type GroupedPoints = BTreeMap<String, Vec<(f64, f64)>>;

fn line(name: String, points: GroupedPoints) -> Series {
    let means = points.values().map(|values| {
        let (xs, ys) = (values.iter().map(|it| it.0), values.iter().map(|it| it.1));
        let count = values.len() as f64;
        (xs.sum::<f64>() / count, ys.sum::<f64>() / count)
    });
    let mut points: Vec<(f64, f64)> = means.collect();
    // The keys are in the order of bits or letters, not of values.
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    Series {
        name,
        points,
        mark: Mark::LineAndDots,
    }
}

/// Ends of an axis: from 0 unless all values are far from it, and of a width above 0.
fn span(low: f64, high: f64, is_far_from_zero: bool) -> [f64; 2] {
    let from = if is_far_from_zero { low.floor() } else { 0.0 };
    [from, if high > from { high } else { from + 1.0 }]
}

#[cfg(test)]
mod tests {
    use dataset::evaluation_protocol::EvaluationProtocol;

    use super::super::table::tests::runs;
    use super::*;

    #[test]
    fn levels_of_compression_are_points_of_their_own() {
        let codecs = "[{dtype: i8}, {dtype: i8, zstd_level: 3}, {dtype: i8, zstd_level: 19}]";
        let (experiment, runs) = runs(&format!("{{method: [max], codec: {codecs}}}"));
        let figures = figures(&experiment, &runs);
        assert_eq!(figures.len(), 1);
        assert_eq!(
            (figures[0].0, figures[0].1[0].series[0].points.len()),
            (BYTES, 3)
        );
        assert!(names().any(|name| name == BYTES));
    }

    #[test]
    fn every_heading_noise_has_a_line_of_its_own_unless_it_is_that_of_the_position() {
        let chart_of = |noises: [[f64; 2]; 4]| {
            let noises = noises.map(|[position_m, heading_deg]| {
                format!("{{position_std_m: {position_m}, heading_std_deg: {heading_deg}}}")
            });
            let noises = noises.join(", ");
            let (experiment, runs) = runs(&format!("{{method: [max], pose_noise: [{noises}]}}"));
            figures(&experiment, &runs).remove(0).1.remove(0)
        };
        let apart = chart_of([[1.0, 0.0], [1.0, 10.0], [2.0, 0.0], [2.0, 10.0]]);
        let lines: Vec<_> = apart
            .series
            .iter()
            .map(|line| (line.name.as_str(), line.points.len()))
            .collect();
        assert_eq!(
            lines,
            [("max, heading 0 deg", 2), ("max, heading 10 deg", 2)]
        );
        let alike = chart_of([[0.0, 0.0], [0.2, 0.2], [0.4, 0.4], [0.6, 0.6]]);
        assert_eq!((alike.series.len(), alike.series[0].points.len()), (1, 4));
        assert_eq!(alike.series[0].name, "max");
    }

    #[test]
    fn the_order_of_the_protocol_is_drawn_and_named() {
        let (experiment, mut runs) = runs("{method: [max], loss: [0, 0.5]}");
        for run in &mut runs {
            run.cell.metrics.protocol = EvaluationProtocol::preset("v2v4real");
            run.cell.metrics.ap_frame_order.at_50 = Some(0.625);
        }
        let chart = &figures(&experiment, &runs)[0].1[0];
        assert_eq!(chart.y.label, "AP, frame order");
        assert_eq!(chart.series[0].points, [(0.0, 0.625), (0.5, 0.625)]);
    }

    #[test]
    fn axes_begin_at_zero_unless_all_values_are_far_from_it() {
        assert_eq!(
            [span(100.0, 500.0, false), span(0.0, 0.0, false)],
            [[0.0, 500.0], [0.0, 1.0]]
        );
        assert_eq!(span(14.3, 20.9, true), [14.0, 20.9]);
    }

    #[test]
    fn lines_are_means_over_seeds_in_order() {
        let points = [(100.0, 0.6), (0.0, 0.9), (100.0, 0.8)];
        let mut by_key = GroupedPoints::new();
        for (x, y) in points {
            by_key.entry(format!("{x}")).or_default().push((x, y));
        }
        let line = line("max".into(), by_key);
        assert_eq!(line.points[0], (0.0, 0.9));
        assert!((line.points[1].0 - 100.0).abs() < 1e-12 && (line.points[1].1 - 0.7).abs() < 1e-12);
    }
}
