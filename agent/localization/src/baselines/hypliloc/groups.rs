//! Neighbours of the centres of both set abstractions, which a rotation does not change.

use tch::{Kind, TchError, Tensor};

/// Neighbourhood of the centres of a set abstraction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Neighbourhood {
    /// Number of centres: the first of the points, which are in the order of farthest-point sampling.
    pub(super) centres: i64,
    /// Radius, metres.
    pub(super) radius_m: f64,
    /// Number of neighbours.
    pub(super) neighbours: i64,
}

/// First set abstraction: centres among all points.
pub(super) const FINE: Neighbourhood = Neighbourhood {
    centres: 256,
    radius_m: 8.0,
    neighbours: 24,
};
/// Second set abstraction: centres among those of the first.
pub(super) const COARSE: Neighbourhood = Neighbourhood {
    centres: 64,
    radius_m: 20.0,
    neighbours: 32,
};

/// Indices of the neighbours of each centre.
#[derive(Debug)]
pub struct Groups {
    /// `[S, 256, 24]` rows of the points.
    pub(super) fine: Tensor,
    /// `[S, 64, 32]` rows of the centres of the first set abstraction.
    pub(super) coarse: Tensor,
}

impl Groups {
    /// The nearest neighbours within the radius among points `[S, N, 3]`, metres; where there are too few, the centre
    /// again. 16-bit integers, on the device of the points.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn find(points_m: &Tensor) -> Result<Self, TchError> {
        let centres = points_m.f_narrow(1, 0, FINE.centres)?;
        Ok(Self {
            fine: neighbours(points_m, FINE)?,
            coarse: neighbours(&centres, COARSE)?,
        })
    }

    /// Those of several batches of sweeps, in their order.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn concatenate(batches: &[Self]) -> Result<Self, TchError> {
        let all = |part: fn(&Self) -> &Tensor| {
            Tensor::f_cat(&batches.iter().map(part).collect::<Vec<_>>(), 0)
        };
        Ok(Self {
            fine: all(|batch| &batch.fine)?,
            coarse: all(|batch| &batch.coarse)?,
        })
    }

    /// Those of the sweeps `rows` `[B]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn select(&self, rows: &Tensor) -> Result<Self, TchError> {
        Ok(Self {
            fine: self.fine.f_index_select(0, rows)?,
            coarse: self.coarse.f_index_select(0, rows)?,
        })
    }

    /// Replaces neighbours by their centre where `is_dropped` `[S, N]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn without(&self, is_dropped: &Tensor) -> Result<Self, TchError> {
        let fine = self.fine.f_to_kind(Kind::Int64)?;
        let sweeps = fine.size()[0];
        let dropped = is_dropped
            .f_gather(1, &fine.f_view([sweeps, -1])?, false)?
            .f_view_as(&fine)?;
        let own = centre_rows(&fine)?;
        Ok(Self {
            fine: fine.f_where_self(&dropped.f_logical_not()?, &own)?,
            coarse: self.coarse.shallow_clone(),
        })
    }
}

/// `[S, centres, neighbours]` rows of `points_m`.
fn neighbours(
    points_m: &Tensor,
    Neighbourhood {
        centres,
        radius_m,
        neighbours,
    }: Neighbourhood,
) -> Result<Tensor, TchError> {
    let distances = Tensor::f_cdist(&points_m.f_narrow(1, 0, centres)?, points_m, 2.0, None)?;
    let (distances, rows) = distances.f_topk(neighbours, 2, false, true)?;
    let own = centre_rows(&rows)?;
    rows.f_where_self(&distances.f_le(radius_m)?, &own)?
        .f_to_kind(Kind::Int16)
}

/// `[1, centres, 1]` the row of each centre itself.
fn centre_rows(groups: &Tensor) -> Result<Tensor, TchError> {
    Tensor::f_arange(groups.size()[1], (Kind::Int64, groups.device()))?.f_view([1, -1, 1])
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    fn grid() -> Tensor {
        let points: Vec<f32> = (0..1024)
            .flat_map(|k| [(k % 32) as f32 * 4.0, (k / 32) as f32 * 4.0, 0.0])
            .collect();
        Tensor::from_slice(&points).view([1, 1024, 3])
    }

    #[test]
    fn neighbours_lie_within_the_radius_and_the_centre_fills_up() {
        tch::set_num_threads(1);
        let groups = Groups::find(&grid()).unwrap();
        assert_eq!(
            (groups.fine.size(), groups.coarse.size()),
            (vec![1, 256, 24], vec![1, 64, 32])
        );
        // The corner has six points within 8 m: itself, two at 4 m, one at 5.7 m and two at 8 m.
        let mut corner: Vec<i64> =
            Vec::try_from(&groups.fine.select(1, 0).view([-1]).to_kind(Kind::Int64)).unwrap();
        corner.sort_unstable();
        corner.dedup();
        assert_eq!(corner, [0, 1, 2, 32, 33, 64]);
    }

    #[test]
    fn dropped_points_are_nobodys_neighbour() {
        tch::set_num_threads(1);
        let dropped = Tensor::zeros([1, 1024], (Kind::Bool, Device::Cpu));
        let _ = dropped.narrow(1, 1, 1).fill_(1);
        let groups = Groups::find(&grid()).unwrap().without(&dropped).unwrap();
        let fine = groups.fine.to_kind(Kind::Int64);
        let holders = fine.eq(1).any_dim(2, false).nonzero();
        let holders: Vec<i64> = Vec::try_from(&holders.narrow(1, 1, 1).reshape([-1])).unwrap();
        assert_eq!(holders, [1], "only a centre remains its own neighbour");
    }
}
