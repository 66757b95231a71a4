//! Settings of the evaluation of each point of a grid.

use std::path::Path;

use anyhow::{Context, Result};
use dataset::IntensityScale;
use ego_fuser_offline::evaluation::EvaluateConfig;
use ego_fuser_offline::evaluation::stepped::{AgentPool, SteppedConfig};
use fusion::Exchange;
use perception::model_config::DetectorConfig;
use perception::weights::Weights;
use protocol::Dtype;
use training::feature_store::KeptMaps;

use super::grid::Point;
use super::spec::Experiment;
use crate::experiment::evaluation::EvaluationOptions;
use crate::scenario::weights_choice::weights_of;

/// Settings of the evaluation of a point.
pub(super) fn options(
    experiment: &Experiment,
    point: &Point,
    maps: &Path,
) -> Result<EvaluationOptions> {
    let weights = weights_of(&experiment.weights, point.method).context("weights")?;
    let config: DetectorConfig = Weights::load(&weights)?.config()?;
    let channels = u64::try_from(config.sent_channels()).unwrap_or(0);
    let settings = EvaluateConfig {
        weights,
        precision: experiment.precision,
        pose_source: point.poses(experiment),
        codec: point.codec(config.feature_grid(), channels),
        rate: point.rate(),
        trust: experiment.ego.trust(),
        ..EvaluateConfig::default()
    };
    let (ego, link) = (&experiment.ego, point.link(experiment).context("link")?);
    Ok(EvaluationOptions {
        dataset: experiment.dataset.clone(),
        settings,
        maps: (point.method.exchange() != Exchange::Points).then(|| kept_maps(experiment, maps)),
        stepped: Some(SteppedConfig {
            crew: AgentPool::First(point.vehicles.unwrap_or(usize::MAX)),
            ..SteppedConfig::new(link, point.seed, ego, experiment.compute)
        }),
        part: experiment.part(),
        protocol: experiment.protocol.clone(),
        ..EvaluationOptions::default()
    })
}

/// Feature maps are cached losslessly, so that the cache changes no result.
pub(super) fn kept_maps(experiment: &Experiment, folder: &Path) -> KeptMaps {
    let limit_bytes = (experiment.feature_maps_limit_gb * 1e9) as u64;
    KeptMaps {
        folder: folder.to_owned(),
        dtype: Dtype::F32,
        limit_bytes,
        intensity_scale: IntensityScale::AUTO,
    }
}
