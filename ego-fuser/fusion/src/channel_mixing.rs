//! Orientation-conditioned channel mixing: converts a neighbour's features to the axes of the ego.
//!
//! An encoder writes headings and offsets into its channels relative to its own axes. The reference codes train and
//! test with clouds that were projected to the ego's frame before encoding, so that all feature maps share its axes; a
//! vehicle that broadcasts one feature map to all receivers cannot do that. Resampling moves cells and leaves the
//! directions in their channels unrotated. The channels are therefore mixed here by a learnt matrix that depends on the
//! relative heading.

use perception::tensor_values::tensor;
use protocol::Pose;
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use crate::f64_tensor::{Order, are_numbers, with_order};

/// Name of the parameter in weights files; absent in weights that were trained without it.
pub(crate) const WEIGHT: &str = "steering.weight";
/// 1, cos, sin, cos 2, sin 2 of the heading: directions rotate with the first pair, axes (which are the same from both
/// ends, as anchors are) with the second.
const BASIS: i64 = 5;

/// Mixes the channels of neighbours: `f + sum_k basis_k(heading) * W_k f`, then ReLU as after the encoder.
#[derive(Debug)]
pub(crate) struct ChannelMixing {
    /// `[BASIS, C, C]`.
    weight: Tensor,
}

impl ChannelMixing {
    /// Changes nothing before it is trained; its parameter is `steering.weight`, `[5, C, C]`, under `path`.
    pub(crate) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let weight =
            (path / "steering").var("weight", &[BASIS, channels, channels], Init::Const(0.0));
        Self { weight }
    }

    /// Converts feature maps `[N, C, H, W]` to the axes of the ego; those at the identity pose, the ego's own, are
    /// unchanged. Where no gradient flows, the result has the given memory order.
    ///
    /// # Errors
    /// [`TchError`] when the channels differ from its own, or there is not one pose per feature map.
    pub(crate) fn turn(
        &self,
        features: &Tensor,
        ego_from_cav: &[Pose],
        order: Order,
    ) -> Result<Tensor, TchError> {
        let matrices = ego_from_cav.iter().map(|pose| {
            let is_other = *pose != Pose::IDENTITY;
            is_other.then(|| self.matrix(pose)).transpose()
        });
        let matrices: Vec<Option<Tensor>> = matrices.collect::<Result<_, TchError>>()?;
        let learns = matrices.iter().flatten().any(Tensor::requires_grad);
        // Products that are written into a prepared tensor have no gradient.
        if learns || !are_numbers(features) {
            let turned = (0..)
                .zip(&matrices)
                .map(|(map, matrix)| turned(&features.f_narrow(0, map, 1)?, matrix.as_ref()));
            return Tensor::f_cat(&turned.collect::<Result<Vec<_>, TchError>>()?, 0);
        }
        let result = with_order(features, order)?;
        for (map, matrix) in (0..).zip(&matrices) {
            let from = features.f_get(map)?.f_flatten(1, 2)?;
            let mut to = result.f_get(map)?.f_flatten(1, 2)?;
            match matrix {
                Some(matrix) => drop(matrix.f_mm_out(&to, &from)?.f_relu_()?),
                // The library transposes blocks if rows of the result are contiguous.
                None if order == Order::Cells => {
                    to.f_transpose(0, 1)?.f_copy_(&from.f_transpose(0, 1)?)?
                }
                None => to.f_copy_(&from)?,
            }
        }
        Ok(result)
    }

    /// `[C, C]`: the mixing of a neighbour's channels, the identity included.
    fn matrix(&self, ego_from_cav: &Pose) -> Result<Tensor, TchError> {
        let yaw_rad = ego_from_cav.yaw_rad();
        let ((sin, cos), (sin_2, cos_2)) = (yaw_rad.sin_cos(), (2.0 * yaw_rad).sin_cos());
        let basis = [1.0, cos, sin, cos_2, sin_2].map(|value| value as f32);
        let basis = tensor(&basis, &[BASIS, 1, 1], self.weight.device())?;
        let change =
            (&self.weight * basis).f_sum_dim_intlist([0i64].as_slice(), false, Kind::Float)?;
        let options = (Kind::Float, self.weight.device());
        Ok(Tensor::f_eye(self.weight.size3()?.1, options)? + change)
    }
}

/// A map `[1, C, H, W]` with its channels mixed; unchanged without a `matrix`.
fn turned(map: &Tensor, matrix: Option<&Tensor>) -> Result<Tensor, TchError> {
    let Some(matrix) = matrix else {
        return Ok(map.shallow_clone());
    };
    let weight = matrix.f_to_kind(map.kind())?;
    let weight = weight.f_unsqueeze(-1)?.f_unsqueeze(-1)?;
    map.f_conv2d(&weight, None::<&Tensor>, [1, 1], [0, 0], [1, 1], 1)?
        .f_relu()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn turned(yaw_rad: f64) -> Pose {
        Pose::from_xyz_yaw([3.0, 1.0, 0.0], yaw_rad)
    }

    #[test]
    fn untrained_it_changes_nothing() {
        let variables = VarStore::new(Device::Cpu);
        let mixing = ChannelMixing::new(&variables.root(), 4);
        let features = Tensor::rand([2, 4, 3, 5], FLOAT);
        assert_eq!(
            mixing
                .turn(&features, &[Pose::IDENTITY, turned(1.0)], Order::Planes)
                .unwrap(),
            features
        );
    }

    #[test]
    fn only_neighbours_are_turned_and_only_by_their_heading() {
        let weight = Tensor::zeros([BASIS, 2, 2], FLOAT);
        // Channel 0 gains sin(heading) of channel 1: a direction along y now has a part along x.
        let _ = weight.get(2).get(0).get(1).fill_(1.0);
        let mixing = ChannelMixing { weight };
        let features = Tensor::ones([3, 2, 1, 1], FLOAT);
        let poses = [Pose::IDENTITY, turned(FRAC_PI_2), turned(PI)];
        let out = Vec::<f32>::try_from(
            mixing
                .turn(&features, &poses, Order::Planes)
                .unwrap()
                .view(-1),
        )
        .unwrap();
        let expected = [1.0, 1.0, 2.0, 1.0, 1.0, 1.0];
        assert!(
            out.iter()
                .zip(expected)
                .all(|(found, expected)| (found - expected).abs() < 1e-6),
            "{out:?}"
        );
    }

    #[test]
    fn the_order_of_numbers_in_memory_changes_nothing() {
        let weight = Tensor::rand([BASIS, 3, 3], FLOAT) - 0.5;
        let (mixing, planes) = (ChannelMixing { weight }, Tensor::rand([1, 3, 4, 5], FLOAT));
        let cells = planes
            .permute([0, 2, 3, 1])
            .contiguous()
            .permute([0, 3, 1, 2]);
        let poses = [turned(0.4)];
        let expected = super::turned(&planes, Some(&mixing.matrix(&poses[0]).unwrap())).unwrap();
        for (maps, order) in [&planes, &cells]
            .into_iter()
            .flat_map(|maps| [Order::Planes, Order::Cells].map(|to| (maps, to)))
        {
            let found = mixing.turn(maps, &poses, order).unwrap();
            assert!(found.allclose(&expected, 1e-5, 1e-6, false));
            assert_eq!(
                found.permute([0, 2, 3, 1]).is_contiguous(),
                order == Order::Cells
            );
        }
    }

    #[test]
    fn another_number_of_channels_is_refused() {
        let variables = VarStore::new(Device::Cpu);
        let mixing = ChannelMixing::new(&variables.root(), 4);
        assert!(
            mixing
                .turn(
                    &Tensor::ones([1, 3, 2, 2], FLOAT),
                    &[turned(0.5)],
                    Order::Planes
                )
                .is_err()
        );
    }
}
