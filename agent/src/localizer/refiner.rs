//! The second look: once a sweep's pose is known to a metre or two, how far is each cell from where that pose puts it.
//!
//! The head answers from the whole town; the refiner only compares. It keeps a learnt description of every patch of the
//! town (a plane of embeddings at two resolutions) and sets what the cell looks like against what the town looks like
//! there. Neither the paper nor LightLoc has this stage; the solver's 'final refinement' is run on its answers.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::dense::Dense;
use super::error::LocalizerError;
use super::head_config::RefinerConfig;
use super::scene_head::Regression;

/// Wavelengths by which a place within a patch is told, metres.
const WAVELENGTHS_M: [f64; 2] = [4.0, 1.5];

/// Compares cells with the town.
#[derive(Debug)]
pub struct Refiner {
    config: RefinerConfig,
    planes: Vec<EmbeddingPlane>,
    layers: [Dense; 2],
    outward: Dense,
}

impl Refiner {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &RefinerConfig) -> Result<Self, LocalizerError> {
        config.validate().map_err(LocalizerError::Config)?;
        let plane = |(level, &patch_m): (usize, &f64)| EmbeddingPlane::new(&(path / "planes" / level), patch_m, config);
        let planes: Vec<EmbeddingPlane> = config.patch_m.iter().enumerate().map(plane).collect();
        // Features, embeddings, heading, height, and sine and cosine of x and y at each wavelength.
        let inputs =
            config.local_channels + config.embedding * planes.len() as i64 + 3 + 4 * WAVELENGTHS_M.len() as i64;
        let width = config.width;
        Ok(Self {
            config: config.clone(),
            planes,
            layers: [Dense::new(&(path / 0), inputs, width, 1.0), Dense::new(&(path / 1), width, width, 1.0)],
            outward: Dense::new(&(path / 2), width, 4, 0.05),
        })
    }

    /// What it was built from.
    #[must_use]
    pub fn config(&self) -> &RefinerConfig {
        &self.config
    }

    /// Where cells really are, given where a pose puts them.
    ///
    /// # Shapes and frames
    /// - `cells`: `[N, channels >= local_channels]`, normalised features; the first `local_channels` are used
    /// - `assumed_m`: `[N, 3]`, world coordinates relative to the head's origin, metres
    /// - `heading`: `[N, 2]`, cosine and sine of the sensor's heading in the world
    ///
    /// # Errors
    /// The tensor library's.
    pub fn compare(
        &self,
        cells: &Tensor,
        assumed_m: &Tensor,
        heading: &Tensor,
        kind: Kind,
    ) -> Result<Regression, TchError> {
        let plane_m = assumed_m.f_narrow(1, 0, 2)?;
        let mut input = vec![cells.f_narrow(1, 0, self.config.local_channels)?];
        for plane in &self.planes {
            input.push(plane.at(&plane_m)?);
        }
        input.push(heading.shallow_clone());
        input.push(assumed_m.f_narrow(1, 2, 1)? / 10.0);
        for wavelength_m in WAVELENGTHS_M {
            let phase = &plane_m * (std::f64::consts::TAU / wavelength_m);
            input.extend([phase.f_sin()?, phase.f_cos()?]);
        }
        let mut x = Tensor::f_cat(&input, 1)?.f_to_kind(kind)?;
        for layer in &self.layers {
            x = layer.forward(&x)?.f_relu()?;
        }
        let output = self.outward.forward(&x)?.f_to_kind(Kind::Float)?;
        Ok(Regression {
            coordinates_m: assumed_m + output.f_narrow(1, 0, 3)?,
            epsilon_m: output.f_narrow(1, 3, 1)?.f_squeeze_dim(1)?.f_softplus()?,
        })
    }
}

/// Learnt descriptions of square patches, bilinear between their corners.
#[derive(Debug)]
struct EmbeddingPlane {
    /// `[rows * columns, channels]`.
    corners: Tensor,
    low_m: [f64; 2],
    patch_m: f64,
    size: [i64; 2],
}

impl EmbeddingPlane {
    fn new(path: &nn::Path<'_>, patch_m: f64, config: &RefinerConfig) -> Self {
        let size = config.corners(patch_m);
        let corners =
            path.var("corners", &[size[0] * size[1], config.embedding], Init::Randn { mean: 0.0, stdev: 0.1 });
        Self { corners, low_m: config.low_m, patch_m, size }
    }

    /// `[N, channels]` at `[N, 2]` of x and y; places outside have the description of the edge.
    fn at(&self, plane_m: &Tensor) -> Result<Tensor, TchError> {
        let axis = |axis: i64| {
            let steps = (plane_m.f_select(1, axis)? - self.low_m[axis as usize]) / self.patch_m;
            let steps = steps.f_clamp(0.0, self.size[axis as usize] as f64 - 1.001)?;
            let low = steps.f_floor()?;
            Ok::<_, TchError>((low.f_to_kind(Kind::Int64)?, (steps - low).f_unsqueeze(1)?))
        };
        let ((column, share_x), (row, share_y)) = (axis(0)?, axis(1)?);
        let first = row * self.size[0] + column;
        let corner = |shift: i64| {
            let index = (&first + shift).f_unsqueeze(1)?.f_expand([-1, self.corners.size()[1]], false)?;
            self.corners.f_gather(0, &index, false)
        };
        let along_x = |shift: i64| {
            let (left, right) = (corner(shift)?, corner(shift + 1)?);
            Ok::<_, TchError>(&left + (right - &left) * &share_x)
        };
        let (low, high) = (along_x(0)?, along_x(self.size[0])?);
        Ok(&low + (high - &low) * share_y)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    fn config() -> RefinerConfig {
        RefinerConfig {
            local_channels: 4,
            low_m: [-20.0, -10.0],
            high_m: [20.0, 30.0],
            patch_m: vec![4.0],
            embedding: 2,
            width: 8,
        }
    }

    #[test]
    fn descriptions_are_bilinear() {
        let network = VarStore::new(Device::Cpu);
        let plane = EmbeddingPlane::new(&network.root(), 4.0, &config());
        let [columns, rows] = plane.size;
        // A slope is its own bilinear interpolation.
        let slope: Vec<f32> =
            (0..rows).flat_map(|y| (0..columns).flat_map(move |x| [x as f32, (10 * y) as f32])).collect();
        let _ = tch::no_grad(|| plane.corners.shallow_clone().copy_(&Tensor::from_slice(&slope).view([-1, 2])));
        let at = plane.at(&Tensor::from_slice(&[-19.0f32, -9.0, 3.0, 12.0, -500.0, 5.0]).view([3, 2])).unwrap();
        let expected = Tensor::from_slice(&[0.25f32, 2.5, 5.75, 55.0, 0.0, 37.5]).view([3, 2]);
        assert!(at.allclose(&expected, 1e-4, 1e-4, false), "{at:?}");
    }

    #[test]
    fn answers_are_near_the_assumption_before_training() {
        tch::manual_seed(1);
        let network = VarStore::new(Device::Cpu);
        let refiner = Refiner::new(&network.root(), &config()).unwrap();
        let assumed = Tensor::from_slice(&[1.0f32, 2.0, 3.0, 900.0, -900.0, 0.0]).view([2, 3]);
        let cells = Tensor::randn([2, 6], (Kind::Float, Device::Cpu));
        let heading = Tensor::from_slice(&[1.0f32, 0.0, 0.0, 1.0]).view([2, 2]);
        let answer = refiner.compare(&cells, &assumed, &heading, Kind::Float).unwrap();
        assert!((answer.coordinates_m - assumed).abs().max().double_value(&[]) < 2.0);
        assert!(answer.epsilon_m.min().double_value(&[]) > 0.0);
    }
}
