//! Charts of average precision against each axis that varies.

use std::collections::BTreeMap;

use deploy::score::metrics::Metrics;
use figures::{Axis, Chart, Mark, Series};
use fusion::Exchange;

use super::Run;
use super::grid::Point;
use super::spec::Experiment;

/// One figure.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Figure {
    /// Name of its files.
    pub(super) name: &'static str,
    pub(super) charts: Vec<Chart>,
}

/// A quantity that each point has.
struct Dimension {
    name: &'static str,
    label: &'static str,
    is_logarithmic: bool,
    value: fn(&Run) -> Option<f64>,
    /// Label that distinguishes series by it, if it is not on the axis.
    text: fn(&Point) -> Option<String>,
}

const DIMENSIONS: [Dimension; 7] = [
    Dimension {
        name: "latency",
        label: "latency, ms",
        is_logarithmic: false,
        value: |run| run.point.latency_ms,
        text: |point| point.latency_ms.map(|ms| format!("{ms} ms")),
    },
    Dimension {
        name: "jitter",
        label: "standard deviation of the latency, ms",
        is_logarithmic: false,
        value: |run| run.point.jitter_ms,
        text: |point| point.jitter_ms.map(|ms| format!("jitter {ms} ms")),
    },
    Dimension {
        name: "bandwidth",
        label: "rate of a link, Mbit/s",
        is_logarithmic: true,
        value: |run| run.point.bandwidth_mbps,
        text: |point| {
            Some(
                point
                    .bandwidth_mbps
                    .map_or("unlimited".into(), |mbps| format!("{mbps} Mbit/s")),
            )
        },
    },
    Dimension {
        name: "loss",
        label: "share of messages lost",
        is_logarithmic: false,
        value: |run| run.point.loss,
        text: |point| point.loss.map(|share| format!("loss {share}")),
    },
    Dimension {
        name: "pose_noise",
        label: "pose noise, m (degrees alike)",
        is_logarithmic: false,
        value: |run| run.point.pose_noise.map(|noise| noise.position_std_m),
        text: |point| {
            point
                .pose_noise
                .map(|noise| format!("{} m {} deg", noise.position_std_m, noise.heading_std_deg))
        },
    },
    Dimension {
        name: "agents",
        label: "vehicles that take part",
        is_logarithmic: false,
        value: |run| run.point.agents.map(|agents| agents as f64),
        text: |point| point.agents.map(|agents| format!("{agents} vehicles")),
    },
    Dimension {
        name: "bytes",
        label: "log2 of a message's bytes",
        is_logarithmic: false,
        value: |run| run.cell.metrics.comm.log2_payload,
        text: codec,
    },
];

fn codec(point: &Point) -> Option<String> {
    if point.method.exchange() != Exchange::Features {
        return None;
    }
    let name = point.codec.name();
    Some(
        point
            .codec
            .keep
            .map_or(name.clone(), |keep| format!("{name} {} %", 100.0 * keep)),
    )
}

/// A figure for each field with several values, AP at 0.5 and at 0.7 side by side; means over seeds.
pub(super) fn figures(experiment: &Experiment, runs: &[Run]) -> Vec<Figure> {
    let varies = |dimension: &Dimension| {
        let mut texts: Vec<_> = runs
            .iter()
            .filter_map(|run| (dimension.text)(&run.point))
            .collect();
        texts.sort();
        texts.dedup();
        texts.len() > 1
    };
    let varying: Vec<usize> = (0..DIMENSIONS.len())
        .filter(|&place| varies(&DIMENSIONS[place]))
        .collect();
    let figure = |&place: &usize| {
        let chart = |title: &str, precision: fn(&Metrics) -> Option<f64>| {
            chart(experiment, runs, place, &varying, title, precision)
        };
        let charts = [
            chart("AP@0.5", |metrics| metrics.ap_global.at_50),
            chart("AP@0.7", |metrics| metrics.ap_global.at_70),
        ];
        let charts: Vec<Chart> = charts.into_iter().flatten().collect();
        (!charts.is_empty()).then(|| Figure {
            name: file_name(place),
            charts,
        })
    };
    varying.iter().filter_map(figure).collect()
}

fn file_name(place: usize) -> &'static str {
    [
        "ap_latency",
        "ap_jitter",
        "ap_bandwidth",
        "ap_loss",
        "ap_pose_noise",
        "ap_agents",
        "ap_bytes",
    ][place]
}

fn chart(
    experiment: &Experiment,
    runs: &[Run],
    place: usize,
    varying: &[usize],
    title: &str,
    precision: fn(&Metrics) -> Option<f64>,
) -> Option<Chart> {
    let dimension = &DIMENSIONS[place];
    // Along bytes, the cells of all values of a codec form one line.
    let mut series: Vec<(String, Points)> = Vec::new();
    for run in runs {
        let (Some(x), Some(y)) = ((dimension.value)(run), precision(&run.cell.metrics)) else {
            continue;
        };
        let point = &run.point;
        let others = varying.iter().filter(|other| **other != place);
        let texts = others.filter_map(|&other| (DIMENSIONS[other].text)(point));
        let name = std::iter::once(point.method.name().to_owned())
            .chain(texts)
            .collect::<Vec<_>>()
            .join(", ");
        let known = series
            .iter()
            .position(|(known, _)| *known == name)
            .unwrap_or_else(|| {
                series.push((name.clone(), BTreeMap::new()));
                series.len() - 1
            });
        let key = (dimension.text)(point).map_or(Key::Value(x.to_bits()), Key::Text);
        series[known].1.entry(key).or_default().push((x, y));
    }
    let series: Vec<Series> = series
        .into_iter()
        .map(|(name, points)| line(name, points))
        .collect();
    let xs = || {
        series
            .iter()
            .flat_map(|series| series.points.iter().map(|(x, _)| *x))
    };
    let (low, high) = (
        xs().fold(f64::INFINITY, f64::min),
        xs().fold(f64::NEG_INFINITY, f64::max),
    );
    if low > high {
        return None;
    }
    let x = if dimension.is_logarithmic {
        let decades = [
            low.log10().floor(),
            high.log10().ceil().max(low.log10().floor() + 1.0),
        ];
        Axis::logarithmic(dimension.label, decades.map(|decade| 10f64.powf(decade)))
    } else {
        Axis::linear(dimension.label, span(low, high, dimension.name == "bytes"))
    };
    let title = format!("{}: {title}", experiment.name);
    Some(Chart {
        title,
        x,
        y: Axis::linear("AP, ordered by score", [0.0, 1.0]),
        series,
    })
}

/// Points of a line, grouped for the mean over seeds.
type Points = BTreeMap<Key, Vec<(f64, f64)>>;

/// Group of the mean over seeds.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Key {
    Value(u64),
    Text(String),
}

fn line(name: String, points: Points) -> Series {
    let mean = |values: &[(f64, f64)], of: fn(&(f64, f64)) -> f64| {
        values.iter().map(of).sum::<f64>() / values.len() as f64
    };
    let mut points: Vec<(f64, f64)> = points
        .values()
        .map(|values| (mean(values, |value| value.0), mean(values, |value| value.1)))
        .collect();
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
    use super::*;

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
        let mut by_key: BTreeMap<Key, Vec<(f64, f64)>> = BTreeMap::new();
        for (x, y) in points {
            by_key
                .entry(Key::Text(format!("{x}")))
                .or_default()
                .push((x, y));
        }
        let line = line("max".into(), by_key);
        assert_eq!(line.points[0], (0.0, 0.9));
        assert!((line.points[1].0 - 100.0).abs() < 1e-12 && (line.points[1].1 - 0.7).abs() < 1e-12);
    }
}
