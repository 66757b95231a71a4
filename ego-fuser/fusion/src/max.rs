//! F-Cooper: the largest value over the agents, channel by channel, cell by cell.

use tch::{TchError, Tensor};

use super::{AlignedViews, Fusion};

/// Element-wise maximum over the agents that reach a cell.
#[derive(Debug, Clone, Copy, Default)]
pub struct MaxFusion;

impl Fusion for MaxFusion {
    fn fuse(&self, views: &AlignedViews<'_>, _train: bool) -> Result<Tensor, TchError> {
        if views.features.size4()?.0 == 1 {
            return views.features.f_get(0);
        }
        // Zero is a value like any other to the maximum, so cells out of reach must fall below all of them.
        let out_of_reach = views.mask.f_eq(0.0)?;
        views.features.f_masked_fill(&out_of_reach, f64::NEG_INFINITY)?.f_amax([0i64].as_slice(), false)
    }
}
