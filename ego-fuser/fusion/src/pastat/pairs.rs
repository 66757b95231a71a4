//! What FSA compares, and what it finds.

use protocol::Pose;
use tch::{TchError, Tensor};

use super::correlation::Shifted;

/// The ego's map and `K` others, as they are compared.
#[derive(Debug)]
pub(super) struct Pairs<'a> {
    pub(super) own: &'a Shifted,
    /// `[K, M, H, W]`, where their poses put them.
    pub(super) shown: Tensor,
    /// `[K, 1, H, W]`, 1 where they show something.
    pub(super) mask: Tensor,
    /// `[K, TRUST]`: how much their poses are trusted.
    pub(super) trust: Tensor,
    /// Where their senders say that they were.
    pub(super) ego_from_cav: Vec<Pose>,
}

impl Pairs<'_> {
    /// Some of the others.
    pub(super) fn only(&self, rows: &[i64]) -> Result<Self, TchError> {
        Ok(Self {
            own: self.own,
            shown: picked(&self.shown, rows)?,
            mask: picked(&self.mask, rows)?,
            trust: picked(&self.trust, rows)?,
            ego_from_cav: rows.iter().map(|&row| self.ego_from_cav[row as usize]).collect(),
        })
    }
}

/// What the comparison of `K` maps with the ego's has found.
#[derive(Debug)]
pub(super) struct Found {
    /// `[K, 3]`: shift along x and y of the ego in metres, turn about the sender in radians.
    pub(super) deltas: Tensor,
    /// `[K, D]`: how well each map fits, as a token. A map that fits nowhere is of a sender that is not where it says.
    pub(super) fit: Tensor,
    /// `[K]`: the correlation of the whole map with the ego's, where it is highest.
    pub(super) alike: Tensor,
}

impl Found {
    /// What several comparisons have found, one after another.
    pub(super) fn all(found: &[Self]) -> Result<Self, TchError> {
        let cat = |of: fn(&Self) -> &Tensor| Tensor::f_cat(&found.iter().map(of).collect::<Vec<_>>(), 0);
        Ok(Self {
            deltas: cat(|found| &found.deltas)?,
            fit: cat(|found| &found.fit)?,
            alike: cat(|found| &found.alike)?,
        })
    }

    /// What was found of some maps.
    pub(super) fn only(&self, rows: &[i64]) -> Result<Self, TchError> {
        Ok(Self {
            deltas: picked(&self.deltas, rows)?,
            fit: picked(&self.fit, rows)?,
            alike: picked(&self.alike, rows)?,
        })
    }

    /// The same with what another comparison has `found` of the maps in `rows`.
    pub(super) fn with(&self, rows: &[i64], found: &Self) -> Result<Self, TchError> {
        let index = Tensor::f_from_slice(rows)?.f_to_device(self.deltas.device())?;
        let with = |of: fn(&Self) -> &Tensor| of(self).f_index_copy(0, &index, of(found));
        Ok(Self {
            deltas: with(|found| &found.deltas)?,
            fit: with(|found| &found.fit)?,
            alike: with(|found| &found.alike)?,
        })
    }
}

/// Some rows of a tensor.
pub(super) fn picked(tensor: &Tensor, rows: &[i64]) -> Result<Tensor, TchError> {
    tensor.f_index_select(0, &Tensor::f_from_slice(rows)?.f_to_device(tensor.device())?)
}

/// The rows of `[K]` that are true.
pub(super) fn rows_where(is_so: &Tensor) -> Result<Vec<i64>, TchError> {
    Vec::try_from(is_so.f_nonzero()?.f_squeeze_dim(1)?)
}
