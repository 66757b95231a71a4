//! Fusion at all levels of the backbone.

use perception::layers::agent_attention::attend_ego;
use perception::layers::backbone::BevBackbone;
use protocol::{BevGrid, Pose};
use tch::{TchError, Tensor};

use fusion::warp::{cav_from_ego_normalized, coalign};
use fusion::where2comm::MapAggregation;

/// Alignment of the maps of a sample; the first is the ego's.
#[derive(Debug)]
pub struct MapAlignment {
    /// Number of agents.
    pub agents: i64,
    /// `[agents, 2, 3]`, from coordinates -1..1 of the ego's map to those of each agent's, outer edges at -1 and 1: the
    /// same at every level. `None`: clouds were transformed to the frame of the ego before they were encoded.
    pub theta: Option<Tensor>,
}

impl MapAlignment {
    /// By poses, the ego's first; `grid` is that of any level.
    ///
    /// # Errors
    /// [`TchError`] when there is no pose.
    pub(crate) fn of_poses(ego_from_cav: &[Pose], grid: &BevGrid) -> Result<Self, TchError> {
        let entries: Vec<f32> = ego_from_cav
            .iter()
            .flat_map(|pose| cav_from_ego_normalized(pose, grid))
            .collect();
        let agents = ego_from_cav.len() as i64;
        Ok(Self {
            agents,
            theta: Some(Tensor::f_from_slice(&entries)?.f_view([agents, 2, 3])?),
        })
    }
}

/// Runs a backbone on canvases `[sum of agents, C, H, W]` and fuses at each level: `[samples, sum of C_up, H', W']`.
///
/// The agents of each of the `samples` follow each other along dimension 0 of the maps. `aggregation` fuses the features of
/// a cell; cells that were not received are zeros, as in the training of these networks. `sent`, `[sum of agents, 1, h,
/// w]`, is the mask of the sent cells of the first level's maps, and thereby of those below.
///
/// # Errors
/// [`TchError`] when the samples do not add up to the canvases.
pub fn fuse_levels(
    backbone: &BevBackbone,
    canvas: &Tensor,
    samples: &[MapAlignment],
    aggregation: MapAggregation,
    sent: Option<&Tensor>,
) -> Result<Tensor, TchError> {
    let mut maps = canvas.shallow_clone();
    let mut fused = Vec::with_capacity(backbone.levels());
    for level in 0..backbone.levels() {
        maps = backbone.level(level, &maps, false);
        if let (0, Some(sent)) = (level, sent) {
            let (_, _, height, width) = maps.size4()?;
            maps = maps.f_mul(&resized(sent, [height, width])?)?;
        }
        // Each agent's own map goes on to the next level, not the fused one.
        fused.push(fuse_samples(&maps, samples, aggregation)?);
    }
    Ok(backbone.upsampled(&fused, false))
}

/// A mask of another level, interpolated between its cells.
pub(super) fn resized(mask: &Tensor, size: [i64; 2]) -> Result<Tensor, TchError> {
    let (_, _, height, width) = mask.size4()?;
    if [height, width] == size {
        return Ok(mask.shallow_clone());
    }
    mask.f_upsample_bilinear2d(size, false, None, None)
}

fn fuse_samples(
    maps: &Tensor,
    samples: &[MapAlignment],
    aggregation: MapAggregation,
) -> Result<Tensor, TchError> {
    let counts: Vec<i64> = samples.iter().map(|sample| sample.agents).collect();
    let of_samples = maps.f_split_with_sizes(&counts, 0)?.into_iter();
    let fused = of_samples.zip(samples).map(|(maps, sample)| {
        let maps = match &sample.theta {
            Some(theta) => coalign::warp_affine(&maps, theta)?,
            None => maps,
        };
        match aggregation {
            MapAggregation::Attention => attend_ego(&maps, None),
            MapAggregation::Max => maps.f_amax([0i64].as_slice(), false),
        }
    });
    Tensor::f_stack(&fused.collect::<Result<Vec<_>, _>>()?, 0)
}

#[cfg(test)]
mod tests {
    use perception::model_config::DetectorConfig;
    use tch::nn::VarStore;
    use tch::{Device, Kind, no_grad};

    use super::*;

    fn fused(
        backbone: &BevBackbone,
        canvas: &Tensor,
        samples: &[MapAlignment],
        aggregation: MapAggregation,
    ) -> Result<Tensor, TchError> {
        no_grad(|| fuse_levels(backbone, canvas, samples, aggregation, None))
    }

    #[test]
    fn ego_only_it_is_the_backbone_and_wrong_counts_are_rejected() {
        tch::set_num_threads(1);
        let config = DetectorConfig {
            lidar_range_m: [-6.4, -6.4, -3.0, 6.4, 6.4, 1.0],
            ..DetectorConfig::lean()
        };
        let variables = VarStore::new(Device::Cpu);
        let backbone = BevBackbone::new(&variables.root(), &config);
        let canvas = Tensor::randn(
            [2, config.pillar_channels, 32, 32],
            (Kind::Float, Device::Cpu),
        );
        let expected = no_grad(|| backbone.forward(&canvas, false));
        let grid = config.feature_grid();
        let ego_only = [(); 2].map(|()| MapAlignment::of_poses(&[Pose::IDENTITY], &grid).unwrap());
        let [both, too_many] = [2, 3].map(|agents| {
            [MapAlignment {
                agents,
                theta: None,
            }]
        });
        for aggregation in [MapAggregation::Attention, MapAggregation::Max] {
            let alone = fused(&backbone, &canvas, &ego_only, aggregation).unwrap();
            assert!(
                alone.allclose(&expected, 1e-4, 1e-4, false),
                "{aggregation:?}"
            );
            let together = fused(&backbone, &canvas, &both, aggregation).unwrap();
            assert_eq!(together.size()[0], 1);
            assert!(
                !together
                    .get(0)
                    .allclose(&expected.get(0), 1e-3, 1e-3, false),
                "{aggregation:?}"
            );
        }
        assert!(fused(&backbone, &canvas, &too_many, MapAggregation::Max).is_err());
    }
}
