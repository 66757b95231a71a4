//! Branch: from tokens to the place class and the pose relative to it.

use perception::layers::convolution::Norm;
use tch::{Kind, Tensor, nn};

use super::token_layer::WIDTH;
use crate::baselines::place_classes::PlaceHead;
use crate::pgc::dense::Dense;

/// Channels of a sweep.
const SWEEP: i64 = 256;

/// Layers behind the tokens of points, panorama or fusion.
#[derive(Debug)]
pub struct Branch {
    outward: Dense,
    norm: Norm,
    head: PlaceHead,
    position: [Dense; 3],
    heading: [Dense; 3],
}

impl Branch {
    /// Builds the layers for so many tokens and classes below `path`.
    pub(super) fn new(path: &nn::Path<'_>, tokens: i64, classes: i64) -> Self {
        Self {
            outward: Dense::new(&(path / "outward"), tokens * WIDTH, SWEEP, 0.7),
            norm: Norm::with_defaults(&(path / "norm"), SWEEP),
            head: PlaceHead::new(&(path / "head"), SWEEP, classes),
            position: perceptron(&(path / "position"), 3),
            heading: perceptron(&(path / "heading"), 2),
        }
    }

    /// `[S, SWEEP]` features of tokens `[S, T, WIDTH]`, single precision.
    pub(super) fn features(&self, tokens: &Tensor, train: bool) -> tch::Result<Tensor> {
        let features = self.outward.forward(&tokens.f_flatten(1, 2)?)?;
        (self.norm.forward(&features.f_to_kind(Kind::Float)?, train)).f_relu()
    }

    /// `[S, K]` logits of the classes of features `[S, SWEEP]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn classify(&self, features: &Tensor) -> tch::Result<Tensor> {
        self.head.logits.forward(features)
    }

    /// `[S, 5]` poses relative to `classes` `[S]`; cosine and sine of the heading have any length.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn poses(&self, features: &Tensor, classes: &Tensor) -> tch::Result<Tensor> {
        let features = self.head.of_class(features, classes)?;
        let [position, heading] = [&self.position, &self.heading].map(|[first, second, third]| {
            let hidden = first.forward(&features)?.f_relu()?;
            third.forward(&second.forward(&hidden)?.f_relu()?)
        });
        Tensor::f_cat(&[position?, heading?], 1)
    }
}

fn perceptron(path: &nn::Path<'_>, outputs: i64) -> [Dense; 3] {
    [
        Dense::new(&(path / 0), SWEEP, 128, 1.0),
        Dense::new(&(path / 1), 128, 64, 1.0),
        Dense::new(&(path / 2), 64, outputs, 0.1),
    ]
}
