//! AttFuse (OPV2V): scaled dot-product self-attention over the agents at every cell, without projections.

use perception::layers::agent_attention::attend_ego;
use tch::{TchError, Tensor};

use super::settings::without_settings;
use crate::warp::WarpedMaps;
use crate::{AlignedMaps, Fusion, FusionOutput, MethodSpec};

/// AttFuse.
pub static METHOD: MethodSpec = MethodSpec::of_features::<AttentionConfig>(
    "feature maps, self-attention over agents at each cell (AttFuse)",
);

without_settings!(AttentionConfig, "attention", AttentionFusion);

/// Per-cell attention of the ego to all agents.
///
/// Only the ego's row of the attention matrix is used, so only that row is computed.
#[derive(Debug, Clone, Copy, Default)]
pub struct AttentionFusion;

impl Fusion for AttentionFusion {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        Ok(attended(&maps.warped)?.into())
    }
}

/// `[C, H, W]`: attention output of the ego at every cell.
pub(super) fn attended(WarpedMaps { features, mask }: &WarpedMaps) -> Result<Tensor, TchError> {
    // The softmax over one map is 1, so the map passes through unchanged, without a copy of all its cells.
    if features.size4()?.0 == 1 {
        return features.f_get(0);
    }
    let is_seen = mask.f_squeeze_dim(1)?.f_ne(0.0)?;
    attend_ego(features, Some(&is_seen))
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};
    use tch::{Device, Kind};

    use super::*;
    use crate::MapMetadata;

    #[test]
    fn where_a_neighbour_has_seen_nothing_the_ego_attends_to_the_others() {
        let grid = BevGrid {
            x_min_m: 0.0,
            y_min_m: 0.0,
            cell_m: 1.0,
            width: 7,
            height: 5,
        };
        let features = Tensor::randn([3, 4, 5, 7], (Kind::Float, Device::Cpu));
        let mask = Tensor::ones([3, 1, 5, 7], (Kind::Float, Device::Cpu));
        let _ = mask.narrow(0, 2, 1).narrow(2, 1, 2).fill_(0.0);
        let facts = [0, 1, 2].map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY));
        let maps = AlignedMaps::newest(&features, &mask, &facts, &grid);
        let scores =
            (features.narrow(0, 0, 1) * &features).sum_dim_intlist([1_i64].as_slice(), true, None)
                / 2.0;
        let shares = scores
            .masked_fill(&mask.eq(0.0), f64::NEG_INFINITY)
            .softmax(0, None);
        let expected = (shares * &features).sum_dim_intlist([0_i64].as_slice(), false, None);
        assert_eq!(
            AttentionFusion.fuse(&maps).unwrap().map,
            expected,
            "to the bit"
        );
    }
}
