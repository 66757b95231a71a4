//! AttFuse (OPV2V): scaled dot-product self-attention over the agents at every cell, without projections.

use tch::{TchError, Tensor};

use super::{AlignedViews, Fusion};

/// Per-cell attention of the ego over all agents.
///
/// Of the attention matrix only the ego's row is kept in the end, so only that row is computed.
#[derive(Debug, Clone, Copy, Default)]
pub struct AttentionFusion;

impl Fusion for AttentionFusion {
    fn fuse(&self, views: &AlignedViews<'_>, _train: bool) -> Result<Tensor, TchError> {
        let features = views.features;
        let (agents, channels, _, _) = features.size4()?;
        if agents == 1 {
            return features.f_get(0);
        }
        let ego = features.f_narrow(0, 0, 1)?;
        let scale = (channels as f64).sqrt();
        let similarity = (ego * features).f_sum_dim_intlist([1i64].as_slice(), true, None)? / scale;
        let weight = similarity.f_masked_fill(&views.mask.f_eq(0.0)?, f64::NEG_INFINITY)?.f_softmax(0, None)?;
        (weight * features).f_sum_dim_intlist([0i64].as_slice(), false, None)
    }
}
