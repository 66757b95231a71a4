//! Runs of a grid, in order.

use std::path::Path;

use agent::rate::RateConfig;
use anyhow::{Context, Result};
use ego_fuser_offline::evaluation::AgentPool;
use fusion::{Exchange, Method};
use link::{CapacityConfig, LatencyModel, LinkConfig, LossModel, LossUnit};
use localization::pose_source::{NoisyPoseConfig, PoseSourceConfig};
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::{BevGrid, CodecConfig, Dtype};
use serde::{Deserialize, Serialize};

use crate::experiment::evaluation::Trial;
use crate::experiment::spec::{CodecSpec, Experiment, Grid, NoiseSpec};

/// One point of a grid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Fusion method.
    pub method: Method,
    /// Encoding of feature maps.
    pub codec: CodecSpec,
    /// Mean delay, milliseconds; absent: that of the link. The same for those below.
    pub latency_ms: Option<f64>,
    /// Its standard deviation, milliseconds.
    pub jitter_ms: Option<f64>,
    /// Rate, Mbit/s; absent for unlimited too, as JSON has no infinity.
    pub bandwidth_mbps: Option<f64>,
    /// Fraction of the messages that are lost.
    pub loss: Option<f64>,
    /// Error of the poses.
    pub pose_noise: Option<NoiseSpec>,
    /// Number of participating vehicles; absent: all.
    pub vehicles: Option<usize>,
    /// Seed of losses, delays and pose errors.
    pub seed: u64,
}

/// Number of values of each axis.
pub(in crate::experiment) fn sizes(grid: &Grid) -> Vec<(&'static str, usize)> {
    let (methods, codecs) = (grid.method.iter(), size(&grid.codec));
    let encoded = methods.filter(|method| is_encoded(method)).count();
    let others = grid.method.len() - encoded + grid.reference.len();
    let mut sizes = match (codecs, others) {
        (1, _) | (_, 0) => vec![("method", encoded + others), ("codec", codecs)],
        // These come with the first encoding only, so they add up and do not multiply.
        _ => vec![("method with codec", encoded * codecs + others)],
    };
    sizes.extend([
        ("latency_ms", size(&grid.latency_ms)),
        ("jitter_ms", size(&grid.jitter_ms)),
        ("bandwidth_mbps", size(&grid.bandwidth_mbps)),
        ("loss", size(&grid.loss)),
        ("pose_noise", size(&grid.pose_noise)),
        ("vehicles", size(&grid.vehicles)),
        ("seed", size(&grid.seed)),
    ]);
    sizes
}

/// True if a method exchanges feature maps. Others run with the first encoding only, in which `none` has its own map.
fn is_encoded(method: &Method) -> bool {
    method.exchange() == Exchange::Features
}

/// Number of values of an axis; 1 if it is absent.
fn size<T>(axis: &Option<Vec<T>>) -> usize {
    axis.as_ref().map_or(1, Vec::len)
}

/// Number of points of the grid.
pub(in crate::experiment) fn count(grid: &Grid) -> usize {
    sizes(grid)
        .into_iter()
        // Too many values have to end in a refusal of the grid, not in an overflow.
        .fold(1, |product, (_, size)| product.saturating_mul(size))
}

/// Every point of an experiment's grid; the last field varies fastest.
pub fn points(experiment: &Experiment) -> Vec<Point> {
    let grid = &experiment.grid;
    let codec = CodecSpec {
        dtype: experiment.dtype,
        ..CodecSpec::default()
    };
    let codecs = grid.codec.as_ref();
    let first = codecs.map(|codecs| codecs.iter().take(1).copied().collect());
    let mut points = Vec::new();
    for (place, &method) in grid.method.iter().chain(&grid.reference).enumerate() {
        let plain = Point {
            method,
            codec,
            latency_ms: None,
            jitter_ms: None,
            bandwidth_mbps: None,
            loss: None,
            pose_noise: None,
            vehicles: None,
            seed: 0,
        };
        let is_varied = place < grid.method.len() && is_encoded(&method);
        let codecs = if is_varied { &grid.codec } else { &first };
        points.extend(spread(vec![plain], codecs, |point| &mut point.codec));
    }
    let points = spread(points, &grid.latency_ms, |point| &mut point.latency_ms);
    let points = spread(points, &grid.jitter_ms, |point| &mut point.jitter_ms);
    let mut points = spread(points, &grid.bandwidth_mbps, |point| {
        &mut point.bandwidth_mbps
    });
    for point in &mut points {
        // JSON has no infinity, so an unlimited rate is an absent one.
        point.bandwidth_mbps = point.bandwidth_mbps.filter(|mbps| mbps.is_finite());
    }
    let points = spread(points, &grid.loss, |point| &mut point.loss);
    let points = spread(points, &grid.pose_noise, |point| &mut point.pose_noise);
    let points = spread(points, &grid.vehicles, |point| &mut point.vehicles);
    spread(points, &grid.seed, |point| &mut point.seed)
}

/// Each point with every value of an axis in turn in the field `place`.
fn spread<T: Copy, V: From<T>>(
    points: Vec<Point>,
    values: &Option<Vec<T>>,
    place: impl Fn(&mut Point) -> &mut V,
) -> Vec<Point> {
    let Some(values) = values else { return points };
    let mut spread = Vec::with_capacity(points.len() * values.len());
    for point in points {
        for &value in values {
            let mut point = point.clone();
            *place(&mut point) = value.into();
            spread.push(point);
        }
    }
    spread
}

impl Point {
    /// The cell of this point. Its feature maps are cached losslessly in `maps`, so that the cache changes no result.
    ///
    /// # Errors
    /// An error when the weights or the link cannot be read.
    pub(super) fn trial(&self, experiment: &Experiment, maps: &Path) -> Result<Trial> {
        let mut trial = experiment.trial().context("link")?;
        let weights = experiment.weights_of(self.method, self.codec.boxes);
        let weights = weights.context("weights")?;
        let config: DetectorConfig = Weights::load(&weights)?.config()?;
        let channels = u64::try_from(config.sent_channels()).unwrap_or(0);
        let setup = &mut trial.setup;
        setup.models.weights = weights;
        setup.agents.pose = self.poses(experiment);
        setup.agents.boxes = self.codec.boxes;
        setup.agents.codec = self.codec(config.feature_grid(), channels);
        setup.agents.rate = self.rate();
        if let Some(link) = &mut setup.link {
            self.shape(&mut link.config);
            link.config.validate().context("link")?;
            link.seed = self.seed;
        }
        setup.pool = self.vehicles.map_or(AgentPool::All, AgentPool::First);
        trial.maps = Some(experiment.kept_maps(maps));
        Ok(trial)
    }

    /// Applies the values of the grid to a link.
    fn shape(&self, link: &mut LinkConfig) {
        if let Some(mean_ms) = self.latency_ms {
            link.latency = match self.jitter_ms.unwrap_or(0.0) {
                0.0 => LatencyModel::ConstantMs(mean_ms),
                std_ms => LatencyModel::Normal { mean_ms, std_ms },
            };
        }
        if let Some(bandwidth_mbps) = self.bandwidth_mbps {
            link.capacity = CapacityConfig::of_mbps(bandwidth_mbps);
        }
        if let Some(share) = self.loss {
            // The axis is the fraction of the messages, whatever the link's own unit.
            (link.loss, link.loss_unit) = (LossModel::Bernoulli(share), LossUnit::Message);
        }
    }

    /// Pose source of this point.
    fn poses(&self, experiment: &Experiment) -> PoseSourceConfig {
        let Some(noise) = self.pose_noise else {
            let mut poses = experiment.poses.clone();
            if let (PoseSourceConfig::Noisy(noisy), Some(_)) = (&mut poses, &experiment.grid.seed) {
                noisy.seed = self.seed;
            }
            return poses;
        };
        PoseSourceConfig::Noisy(NoisyPoseConfig {
            mode: experiment.noise_mode,
            position_std_m: noise.position_std_m,
            heading_std_deg: noise.heading_std_deg,
            seed: self.seed,
            ..NoisyPoseConfig::default()
        })
    }

    /// Encoding of feature maps of `channels` on `grid`.
    fn codec(&self, grid: BevGrid, channels: u64) -> CodecConfig {
        let CodecSpec { dtype, keep, .. } = self.codec;
        let cells = grid.cells() as u64;
        // All cells need no budget, and a mask would only cost bytes.
        let budget_bytes = keep.filter(|keep| *keep < 1.0).map(|keep| {
            let kept = (keep * cells as f64).ceil() as u64;
            // Layout of a sparse map: scales (4 bytes per channel of I8), mask (1 bit per cell), values.
            let scales = if dtype == Dtype::I8 { 4 * channels } else { 0 };
            scales + cells.div_ceil(8) + kept * channels * dtype.size()
        });
        CodecConfig {
            dtype,
            gate: None,
            budget_bytes,
            zstd_level: self.codec.zstd_level,
        }
    }

    /// Rate that feature maps are adapted to; empty without adaptation, or if the link is unlimited.
    fn rate(&self) -> RateConfig {
        let share = self.codec.fit.zip(self.bandwidth_mbps);
        RateConfig {
            // 1 Mbit/s is 1e6 bits per second, and the codec counts bytes.
            bytes_per_second: share.map(|(share, mbps)| (share * mbps * 1e6 / 8.0) as u64),
            ..RateConfig::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn experiment(grid: &str) -> Experiment {
        serde_saphyr::from_str(&format!("name: e\ndataset: d\nweights: w\ngrid: {grid}\n")).unwrap()
    }

    #[test]
    fn a_grid_is_every_value_with_every_other() {
        let grid = experiment("{method: [max, late], latency_ms: [0, 100], seed: [1, 2, 3]}");
        let points = points(&grid);
        assert_eq!((points.len(), count(&grid.grid)), (12, 12));
        assert_eq!(
            (points[0].method, points[0].latency_ms, points[0].seed),
            (Method::MAX, Some(0.0), 1)
        );
        assert_eq!((points[1].latency_ms, points[1].seed), (Some(0.0), 2));
        assert_eq!(
            (points[11].method, points[11].latency_ms, points[11].seed),
            (Method::LATE, Some(100.0), 3)
        );
    }

    #[test]
    fn methods_for_comparison_have_the_first_codec_alone() {
        let codecs = "[{dtype: i8}, {dtype: i8, keep: 0.1}]";
        let grid = format!("{{method: [max], reference: [late], codec: {codecs}, loss: [0, 0.5]}}");
        let grid = experiment(&grid);
        let points = points(&grid);
        assert_eq!((points.len(), count(&grid.grid)), (6, 6));
        assert!(points[4..].iter().all(|point| point.method == Method::LATE));
        assert!(points[4..].iter().all(|point| point.codec.keep.is_none()));
    }

    #[test]
    fn methods_without_feature_maps_have_the_first_codec_alone() {
        let codecs = "[{dtype: i8}, {dtype: i8, boxes: only}]";
        let grid = format!("{{method: [late, max], codec: {codecs}, loss: [0, 0.5]}}");
        let grid = experiment(&grid);
        let points = points(&grid);
        assert_eq!((points.len(), count(&grid.grid)), (6, 6));
        let late = points.iter().filter(|point| point.method == Method::LATE);
        let late: Vec<_> = late.map(|point| (point.codec.boxes, point.loss)).collect();
        assert_eq!(late, [(None, Some(0.0)), (None, Some(0.5))]);
    }

    #[test]
    fn a_seed_of_the_grid_is_that_of_noisy_poses_too() {
        let seeds = |grid: &str| -> Vec<u64> {
            let mut experiment = experiment(grid);
            experiment.poses = PoseSourceConfig::Noisy(NoisyPoseConfig::default());
            let points = points(&experiment).into_iter();
            let poses = points.map(|point| match point.poses(&experiment) {
                PoseSourceConfig::Noisy(noisy) => noisy.seed,
                other => panic!("{}", other.name()),
            });
            poses.collect()
        };
        assert_eq!(seeds("{method: [max], seed: [3, 4]}"), [3, 4]);
        let own = NoisyPoseConfig::default().seed;
        assert_eq!(seeds("{method: [max]}"), [own], "unless the grid has one");
    }

    fn shaped_link(point: &Point) -> LinkConfig {
        let mut link = LinkConfig {
            loss_unit: LossUnit::Fragment,
            ..LinkConfig::default()
        };
        point.shape(&mut link);
        link
    }

    #[test]
    fn a_point_shapes_the_link() {
        let text = "{method: [max], latency_ms: [50], jitter_ms: [0, 10], bandwidth_mbps: [.inf, 6], loss: [0.1]}";
        let experiment = experiment(text);
        let points = points(&experiment);
        let first = shaped_link(&points[0]);
        assert_eq!(
            (first.latency, first.capacity),
            (LatencyModel::ConstantMs(50.0), CapacityConfig::Unlimited)
        );
        let last = shaped_link(&points[3]);
        assert_eq!(
            last.latency,
            LatencyModel::Normal {
                mean_ms: 50.0,
                std_ms: 10.0
            }
        );
        assert_eq!(
            last.capacity,
            CapacityConfig::TokenBucket {
                bandwidth_mbps: 6.0,
                burst_bytes: 0
            }
        );
        assert_eq!(
            (last.loss, last.loss_unit),
            (LossModel::Bernoulli(0.1), LossUnit::Message)
        );
    }

    #[test]
    fn a_share_of_the_link_is_a_rate_of_bytes() {
        let text = "{method: [max], codec: [{dtype: f32}, {dtype: f32, fit: 0.5}], bandwidth_mbps: [6, .inf]}";
        let points = points(&experiment(text));
        let rates: Vec<_> = points
            .iter()
            .map(|point| (point.codec.name(), point.rate().bytes_per_second))
            .collect();
        let expected = [
            ("f32", None),
            ("f32", None),
            ("f32 fitted to 0.5", Some(375_000)),
            ("f32 fitted to 0.5", None),
        ];
        assert_eq!(rates, expected.map(|(name, rate)| (name.to_owned(), rate)));
    }

    #[test]
    fn a_share_of_cells_is_a_budget_of_bytes() {
        let grid = BevGrid {
            x_min_m: 0.0,
            y_min_m: 0.0,
            cell_m: 1.0,
            width: 10,
            height: 8,
        };
        let experiment =
            experiment("{method: [max], codec: [{dtype: f16}, {dtype: i8, keep: 0.25}]}");
        let points = points(&experiment);
        assert_eq!(points[0].codec(grid, 4).budget_bytes, None);
        // Four scales, ten bytes of mask, twenty cells of four bytes.
        assert_eq!(points[1].codec(grid, 4).budget_bytes, Some(16 + 10 + 80));
    }
}
