//! Refinement network: predicts the position of each cell, given the sweep's pose to a metre or two.
//!
//! The head predicts positions in the whole scene; the refiner searches a window. A key grid over the scene holds a
//! learnt key for every corner. The feature of the cell is the query, the corners around the position that the pose
//! gives the cell are the candidates, and the prediction is their mean by attention. Neither the paper nor LightLoc has
//! this stage; the solver's 'final refinement' is run on its predictions.

use perception::sparse::rows;
use perception::tensor_values::tensor;
use tch::nn::{self, Init};
use tch::{Kind, Tensor};

use super::dense::Dense;
use super::error::LocalizerError;
use super::head_config::RefinerConfig;
use super::scene_coordinates::Regression;

/// Initial factor of the similarities; learnt from there on.
const FIRST_SHARPNESS: f64 = 2.0;

/// Locates cells on a learnt key grid over the scene.
#[derive(Debug)]
pub struct Refiner {
    config: RefinerConfig,
    /// `[corners, keys]`.
    keys: Tensor,
    /// `[corners, 1]`: height of the surface at each corner, metres.
    heights: Tensor,
    sharpness: Tensor,
    inward: Dense,
    query: Dense,
    height: Dense,
    epsilon: [Dense; 2],
}

impl Refiner {
    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &RefinerConfig) -> Result<Self, LocalizerError> {
        config.validate()?;
        let [columns, rows] = config.corners();
        let corners = columns * rows;
        let (keys, width) = (config.keys, config.width);
        let stdev = 0.2;
        Ok(Self {
            config: config.clone(),
            keys: path.var("keys", &[corners, keys], Init::Randn { mean: 0.0, stdev }),
            heights: path.var("heights", &[corners, 1], Init::Const(0.0)),
            sharpness: path.var("sharpness", &[1], Init::Const(FIRST_SHARPNESS)),
            inward: Dense::new(&(path / "inward"), config.local_channels + 3, width, 1.0),
            query: Dense::new(&(path / "query"), width, keys, 0.5),
            height: Dense::new(&(path / "height"), width, 1, 0.1),
            epsilon: [
                Dense::new(&(path / "epsilon" / 0), width + 2, 32, 1.0),
                Dense::new(&(path / "epsilon" / 1), 32, 1, 0.1),
            ],
        })
    }

    /// Predicted positions of cells, given their positions under a pose.
    ///
    /// # Shapes and frames
    /// - `cells`: `[N, channels >= local_channels]`, normalised features; the first `local_channels` are used
    /// - `assumed_m`: `[N, 3]`, world coordinates relative to the head's origin, metres
    /// - `heading`: `[N, 2]`, cosine and sine of the sensor's heading in the world
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn look(
        &self,
        cells: &Tensor,
        assumed_m: &Tensor,
        heading: &Tensor,
        kind: Kind,
    ) -> tch::Result<Regression> {
        let local = cells.f_narrow(1, 0, self.config.local_channels)?;
        let height = assumed_m.f_narrow(1, 2, 1)? / 10.0;
        let input = Tensor::f_cat(&[&local, heading, &height], 1)?.f_to_kind(kind)?;
        let hidden = self.inward.forward(&input)?.f_relu()?;
        let query = self.query.forward(&hidden)?.f_to_kind(Kind::Float)?;

        // Step: attention over the corners of the window, each with its learnt key.
        let window = self.window(assumed_m)?;
        let keys = window.of_corners(&self.keys)?;
        let similarity = keys.f_bmm(&query.f_unsqueeze(2)?)?.f_squeeze_dim(2)? * &self.sharpness;
        let shares = similarity.f_softmax(1, Kind::Float)?.f_unsqueeze(1)?;
        let plane_m = shares.f_bmm(&window.places_m)?.f_squeeze_dim(1)?;
        let heights = window.of_corners(&self.heights)?;
        let floor_m = shares.f_bmm(&heights)?.f_squeeze_dim(1)?;
        let above_m = self.height.forward(&hidden)?.f_to_kind(Kind::Float)?;
        // The spread of the attention weights and the largest of them indicate the error of the prediction.
        let squares = shares.f_bmm(&window.places_m.f_square()?)?;
        let variance = squares.f_squeeze_dim(1)? - plane_m.f_square()?;
        let variance = variance.f_sum_dim_intlist(1_i64, true, Kind::Float)?;
        let spread = variance.f_clamp_min(1e-6)?.f_sqrt()?;
        let largest = shares.f_amax([2_i64], false)?;
        let evidence = Tensor::f_cat(&[hidden.f_to_kind(Kind::Float)?, spread, largest], 1)?;
        let epsilon = self.epsilon[1].forward(&self.epsilon[0].forward(&evidence)?.f_relu()?)?;
        Ok(Regression {
            coordinates_m: Tensor::f_cat(&[plane_m + window.middle_m, floor_m + above_m], 1)?,
            epsilon_m: epsilon.f_squeeze_dim(1)?.f_softplus()?,
        })
    }

    /// The corners around each position.
    fn window(&self, assumed_m: &Tensor) -> tch::Result<RefinementWindow> {
        let config = &self.config;
        let (spacing_m, reach, low_m) = (config.spacing_m, config.reach, config.low_m);
        let [columns, rows] = config.corners();
        let device = assumed_m.device();
        // The whole window stays on the grid: a cell beyond the edge gets the outermost one.
        let [column, row] = [(0, columns), (1, rows)].map(|(axis, size): (usize, i64)| {
            let steps = (assumed_m.f_select(1, axis as i64)? - low_m[axis]) / spacing_m;
            steps
                .f_round()?
                .f_clamp(reach as f64, (size - 1 - reach) as f64)
        });
        let (column, row) = (column?, row?);
        let middle = [&column * spacing_m + low_m[0], &row * spacing_m + low_m[1]];
        // Row by row. Single precision holds whole numbers up to 2^24 exactly.
        let first = (row * columns as f64 + column).f_to_kind(Kind::Int64)?;
        let (mut shifts, mut places) = (Vec::new(), Vec::new());
        for y in -reach..=reach {
            for x in -reach..=reach {
                shifts.push(y * columns + x);
                places.extend([x, y].map(|steps| (steps as f64 * spacing_m) as f32));
            }
        }
        let count = assumed_m.size()[0];
        Ok(RefinementWindow {
            corners: first.f_unsqueeze(1)? + tensor(&shifts, &[-1], device)?,
            places_m: tensor(&places, &[1, -1, 2], device)?.f_expand([count, -1, -1], false)?,
            middle_m: Tensor::f_stack(&middle, 1)?,
        })
    }
}

/// Candidates of some cells.
struct RefinementWindow {
    /// `[N, K]` rows of keys.
    corners: Tensor,
    /// `[N, K, 2]`: positions relative to the centre, metres.
    places_m: Tensor,
    /// `[N, 2]`: the central corner, metres relative to the head's origin.
    middle_m: Tensor,
}

impl RefinementWindow {
    /// `[N, K, C]` values of the candidates, of the values `[corners, C]` of the whole key grid.
    fn of_corners(&self, grid: &Tensor) -> tch::Result<Tensor> {
        let (cells, candidates) = self.corners.size2()?;
        let values = rows(grid, &self.corners.f_reshape([-1])?)?;
        values.f_view([cells, candidates, grid.size()[1]])
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
            spacing_m: 2.0,
            reach: 2,
            keys: 4,
            width: 8,
        }
    }

    fn refiner() -> (VarStore, Refiner) {
        tch::set_num_threads(1);
        tch::manual_seed(1);
        let network = VarStore::new(Device::Cpu);
        let refiner = Refiner::new(&network.root(), &config()).unwrap();
        (network, refiner)
    }

    #[test]
    fn predictions_lie_within_the_window_around_the_assumption() {
        let (_network, refiner) = refiner();
        let assumed = Tensor::from_slice(&[1.3f32, 2.2, 3.0, -7.9, 11.0, 0.0]).view([2, 3]);
        let cells = Tensor::randn([2, 6], (Kind::Float, Device::Cpu)) * 5.0;
        let heading = Tensor::from_slice(&[1.0f32, 0.0, 0.0, 1.0]).view([2, 2]);
        let answer = refiner
            .look(&cells, &assumed, &heading, Kind::Float)
            .unwrap();
        let off = (answer.coordinates_m - assumed)
            .narrow(1, 0, 2)
            .abs()
            .max()
            .double_value(&[]);
        assert!(off <= 5.0, "{off}");
        assert!(answer.epsilon_m.min().double_value(&[]) > 0.0);
    }

    #[test]
    fn the_corner_whose_key_is_like_the_query_wins() {
        let (_network, refiner) = refiner();
        let assumed = Tensor::from_slice(&[0.2f32, 0.1, 0.0]).view([1, 3]);
        let window = refiner.window(&assumed).unwrap();
        assert_eq!(
            Vec::<f32>::try_from(window.middle_m.view([-1])).unwrap(),
            [0.0, 0.0]
        );
        let corner: i64 = window.corners.int64_value(&[0, 2 * 5 + 3]);
        assert_eq!(
            window.corners.int64_value(&[0, 12]) + 1,
            corner,
            "one step along x"
        );
        let places: Vec<f32> = Vec::try_from(window.places_m.get(0).get(13)).unwrap();
        assert_eq!(places, [2.0, 0.0]);
    }

    #[test]
    fn positions_outside_are_clamped_to_the_edge() {
        let (_network, refiner) = refiner();
        let assumed =
            Tensor::from_slice(&[1e4f32, -1e4, 0.0, f32::MAX, f32::MIN, 0.0]).view([2, 3]);
        let window = refiner.window(&assumed).unwrap();
        let [columns, rows] = config().corners();
        assert!(
            window.corners.min().int64_value(&[]) >= 0
                && window.corners.max().int64_value(&[]) < columns * rows
        );
    }
}
