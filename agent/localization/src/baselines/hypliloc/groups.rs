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

/// `[S, centres, neighbours]`: rows of the nearest neighbours of each centre within the radius among points `[S, N, 3]`,
/// metres; where there are too few, the centre again. 16-bit integers, on the device of the points.
pub(super) fn neighbours(points_m: &Tensor, around: Neighbourhood) -> Result<Tensor, TchError> {
    let centres_m = points_m.f_narrow(1, 0, around.centres)?;
    let distances = Tensor::f_cdist(&centres_m, points_m, 2.0, None)?;
    let (distances, rows) = distances.f_topk(around.neighbours, 2, false, true)?;
    let is_near = distances.f_le(around.radius_m)?;
    rows.f_where_self(&is_near, &centre_rows(&rows)?)?
        .f_to_kind(Kind::Int16)
}

/// Neighbours `[S, centres, neighbours]`, replaced by their centre where they are dropped, `[S, N]`.
pub(super) fn without(groups: &Tensor, is_dropped: &Tensor) -> Result<Tensor, TchError> {
    let rows = groups.f_to_kind(Kind::Int64)?;
    let flat = rows.f_view([rows.size()[0], -1])?;
    let is_kept = is_dropped.f_gather(1, &flat, false)?.f_logical_not()?;
    rows.f_where_self(&is_kept.f_view_as(&rows)?, &centre_rows(&rows)?)
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
        let fine = neighbours(&grid(), FINE).unwrap();
        let coarse = neighbours(&grid().narrow(1, 0, FINE.centres), COARSE).unwrap();
        assert_eq!(
            (fine.size(), coarse.size()),
            (vec![1, 256, 24], vec![1, 64, 32])
        );
        // The corner has six points within 8 m: itself, two at 4 m, one at 5.7 m and two at 8 m.
        let mut corner: Vec<i64> =
            Vec::try_from(&fine.select(1, 0).view([-1]).to_kind(Kind::Int64)).unwrap();
        corner.sort_unstable();
        corner.dedup();
        assert_eq!(corner, [0, 1, 2, 32, 33, 64]);
    }

    #[test]
    fn dropped_points_are_nobodys_neighbour() {
        tch::set_num_threads(1);
        let dropped = Tensor::zeros([1, 1024], (Kind::Bool, Device::Cpu));
        let _ = dropped.narrow(1, 1, 1).fill_(1);
        let fine = without(&neighbours(&grid(), FINE).unwrap(), &dropped).unwrap();
        let holders = fine.eq(1).any_dim(2, false).nonzero();
        let holders: Vec<i64> = Vec::try_from(&holders.narrow(1, 1, 1).reshape([-1])).unwrap();
        assert_eq!(holders, [1], "only a centre remains its own neighbour");
    }
}
