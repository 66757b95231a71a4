//! Image branch: a residual network on the spherical image, to tokens of its last map.

use perception::layers::convolution::ConvLayer;
use perception::layers::residual::ResidualBlock;
use tch::{Kind, TchError, Tensor, nn};

use super::network::WIDTH;
use super::range_image::{CHANNELS, channels};

/// Channels of the stages; every one but the first halves the map.
const STAGES: [i64; 4] = [16, 32, 64, 128];
/// Blocks of each stage, as in ResNet-18.
const BLOCKS: usize = 2;

/// Image to a map of tokens.
#[derive(Debug)]
pub(super) struct ImageBranch {
    stem: ConvLayer,
    blocks: Vec<ResidualBlock>,
    outward: ConvLayer,
}

impl ImageBranch {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        let mut blocks = Vec::new();
        let mut inputs = STAGES[0];
        for (stage, filters) in STAGES.into_iter().enumerate() {
            let (path, stride) = (path / "stages" / stage, if stage == 0 { 1 } else { 2 });
            blocks.extend(ResidualBlock::chain(
                &path,
                [inputs, filters],
                BLOCKS,
                stride,
            ));
            inputs = filters;
        }
        let layer = |name: &str, io, kernel, stride| {
            let (conv, norm) = (path / name / "conv", path / name / "norm");
            ConvLayer::normed(&conv, &norm, io, kernel, stride)
        };
        Self {
            stem: layer("stem", [CHANNELS, STAGES[0]], 7, 2),
            blocks,
            outward: layer("outward", [inputs, WIDTH], 1, 1),
        }
    }

    /// `[S, WIDTH, 2, 23]` of ranges `[S, ROWS, COLUMNS]`, metres. Computes in `kind`, the result is single.
    pub(super) fn forward(
        &self,
        ranges_m: &Tensor,
        kind: Kind,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let channels = channels(ranges_m)?.f_to_kind(kind)?;
        let x = self.stem.forward(&channels, train);
        let x = ResidualBlock::through(&self.blocks, x, train);
        self.outward.forward(&x, train).f_to_kind(Kind::Float)
    }
}
