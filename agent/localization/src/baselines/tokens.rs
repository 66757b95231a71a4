//! Tokens of a sweep: the features of its cells, pooled around the sensor, and their principal components.
//!
//! Networks that regress poses begin with them: PGC's frozen encoder takes the place of the image networks that the
//! published ones are pretrained from.

use std::f32::consts::{PI, TAU};

use perception::tensor_values::tensor;
use tch::{Kind, Tensor, nn, no_grad};

use crate::pgc::SweepCell;

/// Directions around the sensor, counter-clockwise from the rear.
pub const SECTORS: i64 = 32;
/// Distances from the sensor.
pub const RINGS: i64 = 2;
/// Tokens of a sweep, ring after ring.
pub const TOKENS: i64 = RINGS * SECTORS;
/// Distance at which the second ring begins, metres.
const RING_EDGE_M: f32 = 20.0;
/// Largest number of principal components of a token.
const COMPONENTS: i64 = 64;
/// Numbers of a token beside them: of cells, their mean and least distance, mean and greatest height, mean direction.
const GEOMETRY: i64 = 6;
/// Units of distances and heights, metres.
const UNITS_M: [f32; 2] = [32.0, 5.0];
/// Smallest deviation of a channel, and variance of a component relative to the greatest.
const LEAST: f64 = 1e-4;

/// Token of a point in the sensor frame, metres, and its direction within the sector, -1..=1.
pub fn token_of([x, y, _]: [f32; 3]) -> (usize, f32) {
    // Straight behind is both -pi and pi: the latter gives SECTORS, which the next line bounds.
    let turn = ((y.atan2(x) + PI) / TAU * SECTORS as f32).max(0.0);
    let sector = (turn as usize).min(SECTORS as usize - 1);
    let ring = usize::from(x.hypot(y) >= RING_EDGE_M);
    let across = 2.0 * (turn - sector as f32) - 1.0;
    (ring * SECTORS as usize + sector, across)
}

/// `[TOKENS, C + GEOMETRY]`, single precision, of a sweep with these cells and their features `[N, C]`: means of the
/// cells that stand out of the ground; 0 where there is none.
///
/// # Errors
/// Those of the tensor library.
pub fn pool(cells: &[SweepCell], features: &Tensor) -> tch::Result<Tensor> {
    let (mut rows, mut tokens) = (Vec::new(), Vec::new());
    let mut geometry =
        vec![[0.0, 0.0, f32::INFINITY, 0.0, f32::NEG_INFINITY, 0.0]; TOKENS as usize];
    for (row, cell) in cells.iter().enumerate().filter(|(_, cell)| !cell.is_flat()) {
        let [x, y, z] = cell.centroid_m;
        let (token, across) = token_of(cell.centroid_m);
        let (range, height) = (x.hypot(y) / UNITS_M[0], z / UNITS_M[1]);
        let [count, ranges, nearest, heights, top, directions] = &mut geometry[token];
        (*count, *ranges, *heights) = (*count + 1.0, *ranges + range, *heights + height);
        (*nearest, *top) = (nearest.min(range), top.max(height));
        *directions += across;
        rows.push(row as i64);
        tokens.push(token as i64);
    }
    let device = features.device();
    let counts: Vec<f32> = geometry.iter().map(|of| of[0].max(1.0)).collect();
    for of in &mut geometry {
        let [count, ranges, nearest, heights, top, directions] = *of;
        let [range, height, direction] = [ranges, heights, directions].map(|sum| sum / count);
        // Counts span orders of magnitude. Never 0 in an occupied token, which marks it as such.
        let occupied = count.ln_1p() / 3.0;
        *of = match count > 0.0 {
            true => [occupied, range, nearest, height, top, direction],
            false => [0.0; GEOMETRY as usize],
        };
    }
    let tokens = tensor(&tokens, &[-1], device)?;
    let standing = features.f_index_select(0, &tensor(&rows, &[-1], device)?)?;
    let means = Tensor::f_zeros([TOKENS, features.size()[1]], (Kind::Float, device))?
        .f_index_add(0, &tokens, &standing.f_to_kind(Kind::Float)?)?
        .f_div(&tensor(&counts, &[-1, 1], device)?)?;
    let geometry = tensor(geometry.as_flattened(), &[-1, GEOMETRY], device)?;
    Tensor::f_cat(&[means, geometry], 1)
}

/// Principal components of pooled features; computed, not learnt.
#[derive(Debug)]
pub struct TokenProjection {
    mean: Tensor,
    basis: Tensor,
}

impl TokenProjection {
    /// All components are 0 until [`Self::fit`].
    pub fn new(path: &nn::Path<'_>, cell_channels: i64) -> Self {
        Self {
            mean: path.zeros_no_train("mean", &[cell_channels]),
            basis: path.zeros_no_train("basis", &[cell_channels, cell_channels.min(COMPONENTS)]),
        }
    }

    /// Channels of a token.
    pub fn channels(&self) -> i64 {
        self.basis.size()[1] + GEOMETRY
    }

    /// Sets mean and components of pooled tokens `[.., C + GEOMETRY]`, each component with deviation 1.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn fit(&mut self, pooled: &Tensor) -> tch::Result<()> {
        let (channels, components) = self.basis.size2()?;
        let pooled = pooled.f_reshape([-1, channels + GEOMETRY])?;
        // Empty tokens are all 0 and would pull the mean towards it.
        let is_occupied = pooled.f_select(1, channels)?.f_gt(0.0)?;
        let rows = is_occupied.f_nonzero()?.f_view([-1])?;
        let features = pooled.f_index_select(0, &rows)?.f_narrow(1, 0, channels)?;
        let features = features.f_to_kind(Kind::Double)?;
        let mean = features.f_mean_dim(0_i64, false, Kind::Double)?;
        let deviation = features
            .f_std_dim(0_i64, false, false)?
            .f_clamp_min(LEAST)?;
        let normal = (features - &mean).f_div(&deviation)?;
        let covariance = normal.f_tr()?.f_matmul(&normal)? / (rows.size()[0].max(1) as f64);
        let (variances, vectors) = covariance.f_linalg_eigh("L")?;
        let least = LEAST * variances.f_max()?.f_double_value(&[])?.max(LEAST);
        // Eigenvalues ascend: the last components are the principal ones.
        let first = channels - components;
        let variances = variances
            .f_narrow(0, first, components)?
            .f_clamp_min(least)?;
        let vectors = vectors.f_narrow(1, first, components)?;
        // Whitening: one product standardises the channels, turns them and scales the components to 1.
        let basis = (vectors.f_div(&deviation.f_view([-1, 1])?)?).f_div(&variances.f_sqrt()?)?;
        // As they are stored.
        no_grad(|| {
            self.mean.f_copy_(&mean.f_to_kind(Kind::Half)?)?;
            self.basis.f_copy_(&basis.f_to_kind(Kind::Half)?)
        })
    }

    /// `[.., channels]`, single precision, of pooled tokens `[.., C + GEOMETRY]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn forward(&self, pooled: &Tensor) -> tch::Result<Tensor> {
        let pooled = pooled.f_to_kind(Kind::Float)?;
        let channels = self.basis.size()[0];
        let geometry = pooled.f_narrow(-1, channels, GEOMETRY)?;
        let is_occupied = geometry
            .f_narrow(-1, 0, 1)?
            .f_gt(0.0)?
            .f_to_kind(Kind::Float)?;
        let centred = pooled.f_narrow(-1, 0, channels)?.f_sub(&self.mean)?;
        let components = centred.f_matmul(&self.basis)?.f_mul(&is_occupied)?;
        Tensor::f_cat(&[components, geometry], -1)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    fn cell(centroid_m: [f32; 3], extent_m: f32) -> SweepCell {
        SweepCell {
            centroid_m,
            extent_m,
            points: 5,
        }
    }

    fn value(pooled: &Tensor, token: i64, channel: i64) -> f32 {
        pooled.double_value(&[token, channel]) as f32
    }

    #[test]
    fn cells_that_stand_out_are_averaged_by_direction_and_distance() {
        // Two ahead and near, one of them of the ground; two behind and far.
        let cells = [
            cell([10.0, 0.5, 1.0], 1.0),
            cell([10.0, 0.6, -2.0], 0.1),
            cell([-30.0, -0.5, 0.0], 1.0),
            cell([-34.0, -0.5, 2.0], 1.0),
        ];
        let features = Tensor::from_slice(&[1f32, 2.0, 3.0, 5.0]).view([4, 1]);
        let pooled = pool(&cells, &features).unwrap();
        assert_eq!(pooled.size(), [TOKENS, 1 + GEOMETRY]);
        let (near, far) = (SECTORS / 2, SECTORS);
        for (token, channel, expected) in [
            (near, 0, 1.0),
            (far, 0, 4.0),
            (far, 3, 30f32.hypot(0.5) / 32.0),
            (far, 5, 0.4),
        ] {
            assert_eq!(value(&pooled, token, channel), expected);
        }
        assert!((value(&pooled, near, 2) - 10f32.hypot(0.5) / 32.0).abs() < 1e-6);
        let occupied = pooled.select(1, 1).gt(0.0).sum(Kind::Int64);
        assert_eq!(occupied.int64_value(&[]), 2);
    }

    #[test]
    fn components_have_deviation_1_and_empty_tokens_none() {
        tch::manual_seed(1);
        let variables = VarStore::new(Device::Cpu);
        let mut projection = TokenProjection::new(&variables.root(), 3);
        let on = (Kind::Float, Device::Cpu);
        let mixed = Tensor::randn([500, 2], on)
            .matmul(&Tensor::from_slice(&[9f32, 1.0, 2.0, 0.0, 0.5, 3.0]).view([2, 3]));
        let mut pooled = Tensor::cat(&[mixed + 7.0, Tensor::ones([500, GEOMETRY], on)], 1);
        let _ = pooled.get(0).zero_();
        projection.fit(&pooled).unwrap();
        let tokens = projection.forward(&pooled).unwrap();
        assert_eq!(tokens.size(), [500, projection.channels()]);
        assert_eq!(tokens.get(0).abs().max().double_value(&[]), 0.0);
        // The plane that they lie in has two.
        let deviations = tokens.narrow(0, 1, 499).std_dim(0, false, false);
        let [flat, first, second] =
            [0, 1, 2].map(|component| deviations.double_value(&[component]));
        assert!(flat < 0.1, "{deviations}");
        assert!((first - 1.0).abs() < 0.02 && (second - 1.0).abs() < 0.02);
        pooled = pooled.view([50, 10, 3 + GEOMETRY]);
        assert_eq!(projection.forward(&pooled).unwrap().size(), [50, 10, 9]);
    }
}
