//! Partition: splits a feature map into groups of cells that attend to one another.

use tch::{TchError, Tensor};

/// Partition of a feature map into groups of `window * window` cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Partition {
    /// Neighbouring cells.
    Window,
    /// Cells spread evenly.
    Grid,
}

impl Partition {
    /// `[S, H, W, C]` to `[groups, S, cells of a group, C]`.
    pub(super) fn cut(self, map: &Tensor, window: i64) -> Result<Tensor, TchError> {
        let &[slots, height, width, channels] = &map.size()[..] else {
            return Err(shape_error(map));
        };
        let (rows, columns) = (height / window, width / window);
        // A row is (window, cell) for windows and (cell, group) for grids, whose cells lie `rows` apart.
        let cut = match self {
            Self::Window => map
                .f_view([slots, rows, window, columns, window, channels])?
                .f_permute([1, 3, 0, 2, 4, 5])?,
            Self::Grid => map
                .f_view([slots, window, rows, window, columns, channels])?
                .f_permute([2, 4, 0, 1, 3, 5])?,
        };
        cut.f_reshape([rows * columns, slots, window * window, channels])
    }

    /// Inverse of [`Self::cut`].
    pub(super) fn map(
        self,
        groups: &Tensor,
        [height, width]: [i64; 2],
        window: i64,
    ) -> Result<Tensor, TchError> {
        let &[_, slots, _, channels] = &groups.size()[..] else {
            return Err(shape_error(groups));
        };
        let (rows, columns) = (height / window, width / window);
        let groups = groups.f_view([rows, columns, slots, window, window, channels])?;
        let map = match self {
            Self::Window => groups.f_permute([2, 0, 3, 1, 4, 5])?,
            Self::Grid => groups.f_permute([2, 3, 0, 4, 1, 5])?,
        };
        map.f_reshape([slots, height, width, channels])
    }
}

pub(super) fn shape_error(found: &Tensor) -> TchError {
    TchError::Shape(format!(
        "swap fusion does not support maps of shape {:?}",
        found.size()
    ))
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn both_partitions_lead_back() {
        let map = Tensor::randn([2, 6, 9, 4], (Kind::Float, Device::Cpu));
        for partition in [Partition::Window, Partition::Grid] {
            let groups = partition.cut(&map, 3).unwrap();
            assert_eq!(groups.size(), [6, 2, 9, 4]);
            assert_eq!(
                partition.map(&groups, [6, 9], 3).unwrap(),
                map,
                "{partition:?}"
            );
        }
    }

    #[test]
    fn windows_are_neighbours_and_grids_are_spread() {
        let map = Tensor::arange(36, (Kind::Int64, Device::Cpu)).view([1, 6, 6, 1]);
        for (partition, expected) in [
            (Partition::Window, [0, 1, 6, 7]),
            (Partition::Grid, [0, 3, 18, 21]),
        ] {
            let first = partition.cut(&map, 2).unwrap().get(0).view(-1);
            assert_eq!(Vec::<i64>::try_from(first).unwrap(), expected);
        }
    }
}
