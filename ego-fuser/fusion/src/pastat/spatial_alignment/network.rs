//! The alignment network of FSA: convolutions and fully connected layers that predict `(dx, dy, theta)` of a map.

use std::rc::Rc;

use protocol::Pose;
use tch::nn::{self, Init, Module};
use tch::{Result, Tensor};

use super::area::{Area, resample, sampling_grid};
use super::correlation::{PARTS, Shifted, peaks, shifts};
use super::pairs::{Displacements, Pairs};
use crate::f64_tensor::{pointwise, sum_over_first};
use crate::layers::{ZERO, around};
use crate::pastat::confidence_embedding::CONFIDENCES;
use crate::pastat::config::FsaConfig;
use crate::warp::WarpedMaps;

/// Prevents division by the weight of a map that matches nowhere.
const EPSILON: f64 = 1e-6;
/// Initial sharpness of the softmax over shifts: correlations lie between -1 and 1.
const SHARPNESS: f64 = 20.0;
/// Added to the lever arm of a rotation, metres.
const ARM_M: f64 = 5.0;

/// Predicts `(dx, dy, theta)` of every neighbour's map from its content and the ego's, and the trust in its pose:
/// convolutions make both comparable; the shifts with the best match, part by part of the grid, are the input of fully
/// connected layers.
#[derive(Debug)]
pub(crate) struct AlignmentNetwork {
    pub(crate) config: FsaConfig,
    matching: [nn::Conv2D; 2],
    /// Logarithm of the sharpness of the softmax over shifts.
    sharpness: Tensor,
    hidden: nn::Linear,
    /// Additive correction of the motion that fits the parts' shifts, and the share of that motion that is applied.
    delta: nn::Linear,
    /// Part of the map's tokens: quality of the match.
    fit: nn::Linear,
}

impl AlignmentNetwork {
    /// Before training it moves nothing and adds nothing to tokens of `dim` channels.
    pub(crate) fn new(path: &nn::Path<'_>, [channels, dim]: [i64; 2], config: &FsaConfig) -> Self {
        let (matching, hidden) = (config.matching, config.hidden);
        let by_cell = nn::ConvConfig::default();
        // For each part the shift along x and y and its quality; the same for the whole; the motion; the confidences.
        let inputs = 3 * (PARTS * PARTS + 1) + 3 + CONFIDENCES;
        Self {
            matching: [
                nn::conv2d(path / "matching0", channels, matching, 1, by_cell),
                nn::conv2d(path / "matching1", matching, matching, 3, around()),
            ],
            sharpness: path.var("sharpness", &[], Init::Const(SHARPNESS.ln())),
            hidden: nn::linear(path / "hidden", inputs, hidden, nn::LinearConfig::default()),
            delta: nn::linear(path / "delta", hidden, 6, ZERO),
            fit: nn::linear(path / "fit", hidden, dim, ZERO),
            config: config.clone(),
        }
    }

    /// The reduced channels in which maps are compared.
    pub(crate) fn reduced(&self, WarpedMaps { features, mask }: &WarpedMaps) -> Result<WarpedMaps> {
        let features = pointwise(&self.matching[0], features)?;
        Ok(WarpedMaps::new(features, mask.shallow_clone()))
    }

    /// `K` maps and the ego's, all [reduced](Self::reduced), prepared for comparison.
    ///
    /// # Shapes
    /// - `maps`: 1 and `K` maps on the grid of `area`
    /// - `confidences`: `[K, CONFIDENCES]`; zeros: not known
    /// - `ego_from_cav`: `K` poses of the maps' senders
    pub(crate) fn pairs(
        &self,
        [ego, others]: [&WarpedMaps; 2],
        confidences: &Tensor,
        ego_from_cav: &[Pose],
        area: &Area,
    ) -> Result<Pairs> {
        let (ego, shown) = (self.shown(ego)?, self.shown(others)?);
        Ok(Pairs {
            own: Rc::new(Shifted::new(&ego, area.radius, PARTS)?),
            ego,
            shown,
            mask: others.mask.shallow_clone(),
            confidences: confidences.shallow_clone(),
            ego_from_cav: ego_from_cav.to_vec(),
        })
    }

    /// Compares maps at `deltas` `[K, 3]`, metres and radians in the ego's frame; the displacements include those.
    pub(crate) fn displacements(
        &self,
        pairs: &Pairs,
        deltas: &Tensor,
        area: &Area,
    ) -> Result<Displacements> {
        let ego_from_cav = &pairs.ego_from_cav;
        let device = deltas.device();
        let found = pairs.own.correlate(&moved(pairs, deltas, area)?)?;
        let shifts = (shifts(area.radius)? * area.cell_m).f_to_device(device)?;
        let sharpness = self.sharpness.f_exp()?;
        let parts = peaks(&found.parts, &sharpness, &shifts)?;
        let whole = peaks(&found.whole, &sharpness, &shifts)?;
        let [fit, similarity] =
            [&found.parts, &found.whole].map(|found| found.f_amax([-1_i64].as_slice(), false));
        let (fit, similarity) = (fit?, similarity?);
        // Parts count by how well and by how much they match. Negative correlation counts as none.
        let weight = fit.f_relu()?.f_square()? * &found.energy;
        let senders =
            area.places_of(ego_from_cav)?.f_to_device(device)? + deltas.f_narrow(1, 0, 2)?;
        let motion = rigid_motion(&parts, &weight, &senders, area)?;
        let count = ego_from_cav.len() as i64;
        let [parts, fit] =
            [parts, fit].map(|by_part| by_part.f_transpose(0, 1)?.f_reshape([count, -1]));
        let inputs = [
            parts?,
            fit?,
            whole,
            similarity.f_unsqueeze(1)?,
            motion.shallow_clone(),
            pairs.confidences.shallow_clone(),
        ];
        let hidden = self.hidden.forward(&Tensor::f_cat(&inputs, 1)?).f_relu()?;
        let near = self.bounded(&self.delta.forward(&hidden), motion)?;
        Ok(Displacements {
            deltas: near + deltas,
            fit: self.fit.forward(&hidden),
            similarity,
        })
    }

    /// `[K, 3]` from the network's output `learnt` `[K, 6]`, an addition and the share of the `motion` `[K, 3]`, within
    /// bounds.
    fn bounded(&self, learnt: &Tensor, motion: Tensor) -> Result<Tensor> {
        let shift_m = self.config.max_shift_m as f32;
        let bounds = Tensor::f_from_slice(&[shift_m, shift_m, self.config.max_turn_rad as f32])?;
        let bounds = bounds.f_to_device(motion.device())?;
        // In units of the bounds, as the tanh takes it: with share 1 a small motion passes unchanged.
        let raw = learnt.f_narrow(1, 0, 3)? + motion / &bounds * learnt.f_narrow(1, 3, 3)?;
        Ok(raw.f_tanh()? * bounds)
    }

    /// Compared form of maps, `[N, M, H, W]`: zero mean over the valid cells, so that empty road matches nothing.
    fn shown(&self, WarpedMaps { features, mask }: &WarpedMaps) -> Result<Tensor> {
        let shown = self.matching[1].forward(&features.f_relu()?);
        let [sum, count] = [&(&shown * mask), mask]
            .map(|maps| maps.f_sum_dim_intlist([2_i64, 3].as_slice(), true, None));
        let mean = sum? / count?.f_clamp_min(1.0)?;
        Ok((shown - mean) * mask)
    }
}

/// Compared form of others, moved by `deltas` `[K, 3]`.
fn moved(pairs: &Pairs, deltas: &Tensor, area: &Area) -> Result<Tensor> {
    let shown = &pairs.shown;
    // Usual outside training, whose first comparison is at the poses: resampling would change nothing.
    if deltas.f_count_nonzero(None::<i64>)?.f_int64_value(&[])? == 0 {
        return Ok(shown.shallow_clone());
    }
    let (.., height, width) = shown.size4()?;
    let places = sampling_grid(deltas, &pairs.ego_from_cav, area, [height, width])?;
    let (moved, valid) = resample(shown, &pairs.mask, &places)?;
    moved.f_mul(&valid)
}

/// The motion that fits the shifts of the parts best, `[N, 3]`: a shift, metres, after a small rotation about the
/// sender, radians.
///
/// # Shapes
/// - `parts`: `[PARTS^2, N, 2]` shifts, metres
/// - `weight`: `[PARTS^2, N]`, confidence of each of them
/// - `senders`: `[N, 2]`, positions of the maps' senders, metres from the centre of `area`
fn rigid_motion(parts: &Tensor, weight: &Tensor, senders: &Tensor, area: &Area) -> Result<Tensor> {
    let share = weight / sum_over_first(weight)?.f_add_scalar(EPSILON)?;
    let share = share.f_unsqueeze(2)?;
    // Centres of the parts, from the centre of the grid.
    let middles = area
        .middles_of_parts()?
        .f_to_device(parts.device())?
        .f_unsqueeze(1)?;
    let mean = sum_over_first(&(parts * &share))?;
    let middle = sum_over_first(&(&middles * &share))?;
    let shift = parts - mean.f_unsqueeze(0)?;
    let arm = &middles - middle.f_unsqueeze(0)?;
    // Least squares for a small angle: the sum of arm x shift over the sum of |arm|^2.
    let turning = arm.f_narrow(2, 0, 1)? * shift.f_narrow(2, 1, 1)?
        - arm.f_narrow(2, 1, 1)? * shift.f_narrow(2, 0, 1)?;
    let squared = arm.f_square()?;
    let squared = squared.f_sum_dim_intlist([2_i64].as_slice(), true, None)?;
    let inertia = sum_over_first(&(squared * &share))?;
    // A single part does not determine a rotation: a few metres of lever arm prevent division by zero.
    let turn = sum_over_first(&(turning * &share))? / inertia.f_add_scalar(ARM_M * ARM_M)?;
    let to_sender = senders - middle;
    // The weighted centre of the observed parts moves by `mean`; a rotation moves the sender relative to it.
    let [x, y] = [0, 1].map(|axis| to_sender.f_narrow(1, axis, 1));
    let across = Tensor::f_cat(&[-y?, x?], 1)?;
    Tensor::f_cat(&[mean + across * &turn, turn], 1)
}

#[cfg(test)]
mod tests {
    use protocol::BevGrid;
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.5,
        width: 32,
        height: 16,
    };

    fn area() -> Area {
        Area::new(&GRID, [16, 32], 4)
    }

    /// Without the search, in which random maps match anywhere.
    fn near() -> FsaConfig {
        FsaConfig {
            alignment_search: None,
            ..FsaConfig::default()
        }
    }

    /// Random maps, with the channels that are matched.
    fn random(fsa: &AlignmentNetwork, maps: i64) -> WarpedMaps {
        let whole = WarpedMaps {
            features: Tensor::randn([maps, 4, 16, 32], FLOAT),
            mask: Tensor::ones([maps, 1, 16, 32], FLOAT),
        };
        fsa.reduced(&whole).unwrap()
    }

    fn compared(fsa: &AlignmentNetwork, maps: [&WarpedMaps; 2], poses: &[Pose]) -> Displacements {
        let maps_count = poses.len() as i64;
        let pairs = fsa
            .pairs(
                maps,
                &Tensor::ones([maps_count, CONFIDENCES], FLOAT),
                poses,
                &area(),
            )
            .unwrap();
        fsa.displacements(&pairs, &Tensor::zeros([maps_count, 3], FLOAT), &area())
            .unwrap()
    }

    #[test]
    fn untrained_it_moves_nothing_and_gradients_reach_it() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = AlignmentNetwork::new(&variables.root(), [4, 6], &near());
        let poses = [Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
        let maps = [&random(&fsa, 1), &random(&fsa, 2)];
        let found = compared(&fsa, maps, &poses);
        assert_eq!(found.fit, Tensor::zeros([2, 6], FLOAT));
        let deltas = found.deltas;
        assert_eq!(deltas, Tensor::zeros([2, 3], FLOAT));
        let maps = Tensor::randn([2, 4, 16, 32], FLOAT);
        let sampling_grid = sampling_grid(&deltas, &poses, &area(), [16, 32]).unwrap();
        let (same, valid) =
            resample(&maps, &Tensor::ones([2, 1, 16, 32], FLOAT), &sampling_grid).unwrap();
        assert!(same.allclose(&maps, 1e-4, 1e-4, false));
        assert_eq!(valid.min().double_value(&[]), 1.0);
        (same * Tensor::randn([2, 4, 16, 32], FLOAT))
            .sum(Kind::Float)
            .backward();
        let gradient = variables.variables()["delta.weight"].grad();
        assert!(gradient.abs().max().double_value(&[]) > 0.0);
    }

    #[test]
    fn the_shift_is_bounded_whatever_is_learnt() {
        let variables = VarStore::new(Device::Cpu);
        let config = near();
        let fsa = AlignmentNetwork::new(&variables.root(), [4, 6], &config);
        let _ = tch::no_grad(|| {
            variables.variables()["delta.bias"]
                .shallow_clone()
                .fill_(1e6)
        });
        let maps = [&random(&fsa, 1), &random(&fsa, 1)];
        let deltas = compared(&fsa, maps, &[Pose::IDENTITY]).deltas;
        let found = Vec::<f32>::try_from(deltas.view(-1)).unwrap();
        assert!(
            (found[0] - 3.0).abs() < 1e-6
                && (f64::from(found[2]) - config.max_turn_rad).abs() < 1e-6
        );
    }

    #[test]
    fn shifts_of_parts_make_the_motion_that_a_wrong_pose_needs() {
        let sender = Pose::from_xyz_yaw([3.0, -1.0, 0.0], 0.4);
        let (turn, shift) = (0.02_f64, [0.7, -0.3]);
        let (middles, senders) = (
            area().middles_of_parts().unwrap(),
            area().places_of(&[sender]).unwrap(),
        );
        // Each part moves by the shift, and by the rotation about the sender.
        let parts: Vec<f32> = (0..PARTS * PARTS)
            .flat_map(|part| {
                let [x, y] = [0, 1].map(|axis| {
                    middles.double_value(&[part, axis]) - senders.double_value(&[0, axis])
                });
                [(shift[0] - turn * y) as f32, (shift[1] + turn * x) as f32]
            })
            .collect();
        let parts = Tensor::from_slice(&parts).view([-1, 1, 2]);
        let motion = rigid_motion(
            &parts,
            &Tensor::ones([PARTS * PARTS, 1], FLOAT),
            &senders,
            &area(),
        )
        .unwrap();
        let [dx, dy, theta] = [0, 1, 2].map(|index| motion.double_value(&[0, index]));
        // The rotation is underestimated by the added arm, and the shift by the corresponding move of the sender.
        assert!(theta > 0.4 * turn && theta <= turn, "{theta}");
        assert!(
            (dx - shift[0]).abs() < 0.05 && (dy - shift[1]).abs() < 0.05,
            "{dx} {dy}"
        );
    }
}
