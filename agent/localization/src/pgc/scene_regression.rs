//! Scene-specific head: classifies the part of the scene of a sweep and predicts the world coordinates of each cell.

use tch::nn::{self, LinearConfig, Module};
use tch::{Kind, Tensor};

use super::dense::{Dense, of_unit_length};
use super::error::LocalizerError;
use super::feature_norm::FeatureNorm;
use super::head_config::SceneHeadConfig;
use super::int8_block::Int8Block;
use super::refinement_network::Refiner;
use super::residual_group::OnActivation;
use super::scene_coordinates::Regression;
use perception::int8::{ActivationScales, LayerFormat, QuantiseError, ScaleSearch};
use perception::layers::convolution::Norm;

/// Hidden layers of the classifier of sweeps, as in LightLoc.
const CLASSIFIER_WIDTHS: [i64; 2] = [512, 256];
/// Share of channels that the classifier is trained without.
const DROPOUT: f64 = 0.5;
/// Unit of the offset from the weighted centres, metres.
const OFFSET_SCALE_M: f64 = 10.0;

/// Classifier of sweeps and regressor of cells.
#[derive(Debug)]
pub struct SceneHead {
    config: SceneHeadConfig,
    /// Mean and scale of features over the training sweeps.
    cell_norm: FeatureNorm,
    sweep_norm: FeatureNorm,
    classifier: Classifier,
    /// `[centres, 3]`, metres relative to the origin.
    centres: Tensor,
    inward: Dense,
    blocks: Vec<[Dense; 3]>,
    outward: Dense,
    refiner: Option<Refiner>,
    int8: Option<Vec<Int8Block>>,
}

/// Name of the output of the first layer among the activations.
const INWARD: &str = "head.inward";

fn block_activation(block: usize, part: &str) -> String {
    format!("head.blocks.{block}.{part}")
}

impl SceneHead {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "scene head";

    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &SceneHeadConfig) -> Result<Self, LocalizerError> {
        config.validate()?;
        let (cells, sweeps, width) = (config.cell_channels, config.sweep_channels, config.width);
        let (classes, centres) = (config.classes, config.centres);
        Ok(Self {
            config: config.clone(),
            cell_norm: FeatureNorm::new(&(path / "cell_norm"), cells),
            sweep_norm: FeatureNorm::new(&(path / "sweep_norm"), sweeps),
            classifier: Classifier::new(&(path / "classifier"), sweeps, classes),
            centres: (path / "centres").zeros_no_train("position", &[centres, 3]),
            inward: Dense::new(&(path / "inward"), cells + classes, width, 1.0),
            blocks: (0..config.blocks)
                .map(|number| {
                    let path = path / "blocks" / number;
                    [0, 1, 2].map(|layer| Dense::new(&(&path / layer), width, width, 1.0))
                })
                .collect(),
            outward: Dense::new(&(path / "outward"), width, centres + 4, 0.1),
            refiner: (config.refiner.as_ref())
                .map(|config| Refiner::new(&(path / "refiner"), config))
                .transpose()?,
            int8: None,
        })
    }

    /// Configuration that it was built from.
    pub fn config(&self) -> &SceneHeadConfig {
        &self.config
    }

    /// Pose refinement network, if there is one.
    pub fn refiner(&self) -> Option<&Refiner> {
        self.refiner.as_ref()
    }

    /// Normalises features of cells to mean 0 and deviation 1 over the training sweeps.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn normalise(&self, cells: &Tensor) -> tch::Result<Tensor> {
        self.cell_norm.forward(cells)
    }

    /// Part of the scene: `[sweeps, classes]` logits of `[sweeps, sweep_channels]`; with `train` dropout is applied.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn classify(&self, sweeps: &Tensor, train: bool) -> tch::Result<Tensor> {
        self.classifier
            .forward(&self.sweep_norm.forward(sweeps)?, train)
    }

    /// World coordinates of `[N, cell_channels]` normalised features, given the logits `[N, classes]` of the sweep of
    /// each.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn regress(&self, cells: &Tensor, logits: &Tensor, kind: Kind) -> tch::Result<Regression> {
        Ok(self.regress_among_centres(cells, logits, kind)?.0)
    }

    /// The same, and the logarithms `[N, centres]` of the weights of the centres in each prediction.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn regress_among_centres(
        &self,
        cells: &Tensor,
        logits: &Tensor,
        kind: Kind,
    ) -> tch::Result<(Regression, Tensor)> {
        let input = self.input(cells, logits)?;
        let inward = self.inward.forward(&input.f_to_kind(kind)?)?.f_relu()?;
        let hidden = match &self.int8 {
            Some(blocks) => blocks
                .iter()
                .try_fold(inward, |x, block| block.forward(&x))?,
            None => self.hidden(inward, &mut |_, _| Ok(()))?,
        };
        // Half precision would round positions beyond 256 m to quarters of a metre.
        let output = self.outward.forward(&hidden)?.f_to_kind(Kind::Float)?;
        let centres = self.config.centres;
        let log_shares = output
            .f_narrow(1, 0, centres)?
            .f_log_softmax(1, Kind::Float)?;
        let offset = output.f_narrow(1, centres, 3)? * OFFSET_SCALE_M;
        let epsilon_m = output.f_narrow(1, centres + 3, 1)?.f_squeeze_dim(1)?;
        let regression = Regression {
            coordinates_m: log_shares.f_exp()?.f_matmul(&self.centres)? + offset,
            epsilon_m: epsilon_m.f_softplus()?,
        };
        Ok((regression, log_shares))
    }

    /// Residual blocks in floating point, from the output of the first layer on.
    fn hidden(&self, inward: Tensor, on_activation: &mut OnActivation<'_>) -> tch::Result<Tensor> {
        on_activation(INWARD, &inward)?;
        let mut x = inward;
        for (number, [first, second, third]) in self.blocks.iter().enumerate() {
            let inner = first.forward(&x)?.f_relu()?;
            on_activation(&block_activation(number, "0"), &inner)?;
            let inner = second.forward(&inner)?.f_relu()?;
            on_activation(&block_activation(number, "1"), &inner)?;
            x = (x + third.forward(&inner)?).f_relu()?;
            on_activation(&block_activation(number, "output"), &x)?;
        }
        Ok(x)
    }

    /// Adds the activations that [`Self::quantise`] needs scales of, for the input of [`Self::regress`].
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn observe(
        &self,
        cells: &Tensor,
        logits: &Tensor,
        search: &mut ScaleSearch,
    ) -> tch::Result<()> {
        let inward = self.inward.forward(&self.input(cells, logits)?)?.f_relu()?;
        self.hidden(inward, &mut |name, values| search.observe(name, values))
            .map(drop)
    }

    /// Computes the residual blocks in integers from here on.
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    pub fn quantise(&mut self, scales: &ActivationScales) -> Result<(), QuantiseError> {
        let (mut input, mut blocks) = (scales.get(INWARD)?, Vec::with_capacity(self.blocks.len()));
        for (number, [first, second, third]) in self.blocks.iter().enumerate() {
            let inner = scales.get(&block_activation(number, "0"))?;
            let innermost = scales.get(&block_activation(number, "1"))?;
            let layers = [
                first.int8(LayerFormat::hidden(input, inner))?,
                second.int8(LayerFormat::hidden(inner, innermost))?,
                // In floating point, since the skip connection is added before the ReLU.
                third.int8(LayerFormat::last(innermost))?,
            ];
            blocks.push(Int8Block { input, layers });
            input = scales.get(&block_activation(number, "output"))?;
        }
        self.int8 = Some(blocks);
        Ok(())
    }

    /// `[N, cell_channels + classes]`: features of cells beside the normalised logits of their sweeps.
    fn input(&self, cells: &Tensor, logits: &Tensor) -> tch::Result<Tensor> {
        // The regressor sees which classes are likely, not how large the logits are.
        Tensor::f_cat(&[cells, &of_unit_length(logits)?], 1)
    }

    /// `[centres, 3]`: reference points of the cells' offsets, metres relative to the origin.
    pub fn centres_m(&self) -> &Tensor {
        &self.centres
    }

    /// Sets the values that are computed from the training data, not learnt: statistics of the features `[N,
    /// cell_channels]` and `[S, sweep_channels]`, and the centres.
    ///
    /// # Errors
    /// Those of the tensor library, when shapes do not fit.
    pub fn set_statistics(
        &mut self,
        cells: &Tensor,
        sweeps: &Tensor,
        centres: &Tensor,
    ) -> tch::Result<()> {
        self.cell_norm.fit(cells)?;
        self.sweep_norm.fit(sweeps)?;
        tch::no_grad(|| self.centres.f_copy_(centres))
    }
}

/// Two hidden layers with batch norm and dropout.
#[derive(Debug)]
struct Classifier {
    layers: [nn::Linear; 2],
    norms: [Norm; 2],
    last: nn::Linear,
}

impl Classifier {
    fn new(path: &nn::Path<'_>, inputs: i64, classes: i64) -> Self {
        let [first, second] = CLASSIFIER_WIDTHS;
        let config = LinearConfig::default();
        Self {
            layers: [(inputs, first, 0), (first, second, 1)]
                .map(|(from, to, layer)| nn::linear(path / layer, from, to, config)),
            norms: [(first, 0), (second, 1)]
                .map(|(width, layer)| Norm::with_defaults(&(path / "norms" / layer), width)),
            last: nn::linear(path / 2, second, classes, config),
        }
    }

    fn forward(&self, x: &Tensor, train: bool) -> tch::Result<Tensor> {
        let mut x = x.shallow_clone();
        for (layer, norm) in self.layers.iter().zip(&self.norms) {
            x = (norm.forward(&layer.forward(&x), train).f_relu()?).f_dropout(DROPOUT, train)?;
        }
        Ok(self.last.forward(&x))
    }
}
