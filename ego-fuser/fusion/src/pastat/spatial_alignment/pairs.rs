//! Pairs of maps that FSA compares, and the displacements that it finds.

use std::rc::Rc;

use protocol::Pose;
use tch::{TchError, Tensor};

use super::correlation::Shifted;
use crate::f64_tensor::picked;

/// The ego's map and `K` others, prepared for comparison.
#[derive(Debug)]
pub(crate) struct Pairs {
    /// `[1, M, H, W]`: the ego's map.
    pub(crate) ego: Tensor,
    /// The same at every shift.
    pub(crate) own: Rc<Shifted>,
    /// `[K, M, H, W]`, at their poses.
    pub(crate) shown: Tensor,
    /// `[K, 1, H, W]`, 1 where they are valid.
    pub(crate) mask: Tensor,
    /// `[K, CONFIDENCES]` of their poses.
    pub(crate) confidences: Tensor,
    /// Poses that their senders reported.
    pub(crate) ego_from_cav: Vec<Pose>,
}

impl Pairs {
    /// Some of the others.
    pub(crate) fn only(&self, rows: &[i64]) -> Result<Self, TchError> {
        let poses = rows.iter().map(|&row| self.ego_from_cav[row as usize]);
        Ok(Self {
            ego: self.ego.shallow_clone(),
            own: Rc::clone(&self.own),
            shown: picked(&self.shown, rows)?,
            mask: picked(&self.mask, rows)?,
            confidences: picked(&self.confidences, rows)?,
            ego_from_cav: poses.collect(),
        })
    }
}

/// Displacements of `K` maps from the ego's.
#[derive(Debug)]
pub(crate) struct Displacements {
    /// `[K, 3]`: shift along x and y of the ego in metres, turn about the sender in radians.
    pub(crate) deltas: Tensor,
    /// `[K, D]`: quality of each map's match, as a part of its tokens. A map that matches nowhere has a wrong pose.
    pub(crate) fit: Tensor,
    /// `[K]`: the highest correlation of the whole map with the ego's.
    pub(crate) similarity: Tensor,
}

impl Displacements {
    /// Concatenation of several comparisons.
    pub(crate) fn all(several: &[Self]) -> Result<Self, TchError> {
        Self::each(|part| Tensor::f_cat(&several.iter().map(part).collect::<Vec<_>>(), 0))
    }

    /// Each part by `change`, which is given how to get at it.
    fn each(
        change: impl Fn(fn(&Self) -> &Tensor) -> Result<Tensor, TchError>,
    ) -> Result<Self, TchError> {
        Ok(Self {
            deltas: change(|of| &of.deltas)?,
            fit: change(|of| &of.fit)?,
            similarity: change(|of| &of.similarity)?,
        })
    }

    /// Rows of some maps.
    pub(crate) fn only(&self, rows: &[i64]) -> Result<Self, TchError> {
        Self::each(|part| picked(part(self), rows))
    }

    /// The same with rows of another comparison for the maps in `rows`.
    pub(crate) fn with(&self, rows: &[i64], other: &Self) -> Result<Self, TchError> {
        let index = Tensor::f_from_slice(rows)?.f_to_device(self.deltas.device())?;
        Self::each(|part| part(self).f_index_copy(0, &index, part(other)))
    }
}

/// The rows of `[K]` that are true.
pub(crate) fn rows_where(is_so: &Tensor) -> Result<Vec<i64>, TchError> {
    Vec::try_from(is_so.f_nonzero()?.f_squeeze_dim(1)?)
}
