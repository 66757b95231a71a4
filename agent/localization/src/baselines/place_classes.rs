//! Place classes: the nearest of some training poses, relative to which networks state a pose.
//!
//! Not in the papers of the networks that use them: one regression over a whole town answers with the mean of places
//! that look alike (GLACE, Wang et al. 2024; LightLoc, Li et al. 2025).

use perception::tensor_values::tensor;
use tch::nn::{self, Init};
use tch::{Kind, Tensor, no_grad};

use crate::pgc::dense::Dense;

/// Numbers of a pose: position, cosine and sine of the heading.
pub const POSE: i64 = 5;
/// Unit of positions relative to a class, metres.
pub const UNIT_M: f64 = 10.0;
/// Distance of two headings 60 degrees apart, metres: opposite lanes are different classes.
const HEADING_M: f64 = 15.0;

/// Centres of the classes of a scene; computed, not learnt.
#[derive(Debug)]
pub struct PlaceClasses {
    /// `[K, POSE]`, metres.
    centres_m: Tensor,
}

impl PlaceClasses {
    /// All centres are at the origin until [`Self::set`].
    pub fn new(path: &nn::Path<'_>, classes: i64) -> Self {
        Self {
            centres_m: path.zeros_no_train("centres", &[classes, POSE]),
        }
    }

    /// Sets the centres from as many rows of [`Self::in_metres`].
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn set(&mut self, centres_m: &[[f64; POSE as usize]]) -> tch::Result<()> {
        let device = self.centres_m.device();
        let centres_m = tensor(centres_m.as_flattened(), &[-1, POSE], device)?;
        // As they are stored.
        no_grad(|| self.centres_m.f_copy_(&centres_m.f_to_kind(Kind::Half)?))
    }

    /// Poses `[N, POSE]` (position in metres, cosine and sine of the heading) as points whose distance is that of places.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn in_metres(poses: &Tensor) -> tch::Result<Tensor> {
        let heading = poses.f_narrow(1, 3, 2)?.f_mul_scalar(HEADING_M)?;
        Tensor::f_cat(&[poses.f_narrow(1, 0, 3)?, heading], 1)
    }

    /// `[N]`: the class of each of `poses` `[N, POSE]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn nearest(&self, poses: &Tensor) -> tch::Result<Tensor> {
        Tensor::f_cdist(&Self::in_metres(poses)?, &self.centres_m, 2.0, None)?.f_argmin(1, false)
    }

    /// `poses` `[N, POSE]`, their positions relative to the centres of `classes` `[N]` in [`UNIT_M`].
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn relative(&self, poses: &Tensor, classes: &Tensor) -> tch::Result<Tensor> {
        let position = poses.f_narrow(1, 0, 3)?.f_sub(&self.positions(classes)?)? / UNIT_M;
        Tensor::f_cat(&[position, poses.f_narrow(1, 3, 2)?], 1)
    }

    /// The inverse of [`Self::relative`].
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn absolute(&self, relative: &Tensor, classes: &Tensor) -> tch::Result<Tensor> {
        // Headings are absolute already: only positions are relative to the class.
        let position = relative.f_narrow(1, 0, 3)? * UNIT_M + self.positions(classes)?;
        Tensor::f_cat(&[position, relative.f_narrow(1, 3, 2)?], 1)
    }

    fn positions(&self, classes: &Tensor) -> tch::Result<Tensor> {
        self.centres_m.f_index_select(0, classes)?.f_narrow(1, 0, 3)
    }
}

/// Layers from the features of a sweep to its class, and to what depends on the class.
#[derive(Debug)]
pub(super) struct PlaceHead {
    /// Features `[N, width]` to logits `[N, K]`.
    pub(super) logits: Dense,
    /// `[K, width]`.
    scale: Tensor,
    shift: Tensor,
}

impl PlaceHead {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>, width: i64, classes: i64) -> Self {
        let size = [classes, width];
        Self {
            logits: Dense::new(&(path / "logits"), width, classes, 0.3),
            scale: path.var("scale", &size, Init::Const(1.0)),
            shift: path.var("shift", &size, Init::Const(0.0)),
        }
    }

    /// The features scaled and shifted as `classes` `[N]` have learnt.
    pub(super) fn of_class(&self, features: &Tensor, classes: &Tensor) -> tch::Result<Tensor> {
        let scale = self.scale.f_index_select(0, classes)?;
        let shift = self.shift.f_index_select(0, classes)?;
        features.f_mul(&scale)?.f_add(&shift)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn places_and_directions_are_classes_of_their_own_and_poses_come_back() {
        let rows: [[f32; 5]; 4] = [
            [0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, -1.0, 0.0],
            [100.0, 50.0, 0.0, 0.0, 1.0],
            [100.0, 50.0, 0.0, 0.0, -1.0],
        ];
        let poses = Tensor::from_slice(rows.as_flattened()).view([4, 5]);
        let variables = VarStore::new(Device::Cpu);
        let mut places = PlaceClasses::new(&variables.root(), 4);
        let metres = PlaceClasses::in_metres(&poses).unwrap();
        let metres: Vec<f64> = Vec::try_from(metres.to_kind(Kind::Double).view([-1])).unwrap();
        places.set(metres.as_chunks().0).unwrap();
        let found: Vec<i64> = Vec::try_from(places.nearest(&poses).unwrap()).unwrap();
        assert_eq!(found, [0, 1, 2, 3]);
        // 3 m and 10 degrees away.
        let (sine, cosine) = 10f32.to_radians().sin_cos();
        let near = Tensor::from_slice(&[3f32, 0.0, 0.0, cosine, sine]).view([1, 5]);
        let class = places.nearest(&near).unwrap();
        assert_eq!(class.int64_value(&[0]), 0);
        let relative = places.relative(&near, &class).unwrap();
        assert!((relative.double_value(&[0, 0]) - 0.3).abs() < 1e-6);
        let back = places.absolute(&relative, &class).unwrap();
        assert!(back.allclose(&near, 1e-5, 1e-5, false), "{back}");
    }
}
