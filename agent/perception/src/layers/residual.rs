//! Residual blocks (He et al., 2016), the elements of CoAlign's backbone.

use tch::{Tensor, nn};

use crate::layers::convolution::{ConvLayer, Norm};

/// Two 3x3 convolutions with a skip connection, strided and projected if its shape has to change.
#[derive(Debug)]
pub struct ResidualBlock {
    first: ConvLayer,
    second: ConvLayer,
    shortcut: Option<ConvLayer>,
}

impl ResidualBlock {
    /// Chain of `blocks`, the first with `stride`; parameters `<position>.{conv1,bn1,conv2,bn2}.*` and
    /// `0.downsample.{0,1}.*` under `path`.
    pub fn chain(
        path: &nn::Path<'_>,
        [input, filters]: [i64; 2],
        blocks: usize,
        stride: i64,
    ) -> Vec<Self> {
        let blocks = (0..blocks).map(|position| match position {
            0 => Self::new(&(path / position), [input, filters], stride),
            _ => Self::new(&(path / position), [filters, filters], 1),
        });
        blocks.collect()
    }

    fn new(path: &nn::Path<'_>, [input, filters]: [i64; 2], stride: i64) -> Self {
        let shortcut = path / "downsample";
        let is_changed = stride != 1 || input != filters;
        Self {
            first: layer([path / "conv1", path / "bn1"], [input, filters], 3, stride).with_relu(),
            second: layer([path / "conv2", path / "bn2"], [filters, filters], 3, 1),
            shortcut: is_changed
                .then(|| layer([&shortcut / 0, &shortcut / 1], [input, filters], 1, stride)),
        }
    }

    /// `[N, C_in, H, W]` to `[N, C, H', W']`.
    pub fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        let beside = match &self.shortcut {
            Some(shortcut) => shortcut.forward(x, train),
            None => x.shallow_clone(),
        };
        (self.second.forward(&self.first.forward(x, train), train) + beside).relu()
    }

    /// The same for inference, norms folded in.
    pub(crate) fn folded(&self) -> Self {
        Self {
            first: self.first.folded(),
            second: self.second.folded(),
            shortcut: self.shortcut.as_ref().map(ConvLayer::folded),
        }
    }
}

fn layer([conv, norm]: [nn::Path<'_>; 2], io: [i64; 2], kernel: i64, stride: i64) -> ConvLayer {
    // Epsilon and momentum are PyTorch's own rather than those of PointPillars.
    ConvLayer::unbiased(&conv, io, kernel, stride).with_norm(Norm::with_defaults(&norm, io[1]))
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    fn through(blocks: &[ResidualBlock], x: &Tensor) -> Tensor {
        tch::no_grad(|| {
            blocks
                .iter()
                .fold(x.shallow_clone(), |x, block| block.forward(&x, false))
        })
    }

    #[test]
    fn the_first_halves_the_map_and_folding_changes_nothing() {
        tch::set_num_threads(1);
        tch::manual_seed(4);
        let network = VarStore::new(Device::Cpu);
        let blocks = ResidualBlock::chain(&network.root(), [6, 10], 2, 2);
        for (name, mut variable) in network.variables() {
            let low = if name.contains("var") { 0.3 } else { -0.5 };
            let _ = tch::no_grad(|| variable.uniform_(low, 0.9));
        }
        let x = Tensor::randn([2, 6, 8, 12], (Kind::Float, Device::Cpu));
        let expected = through(&blocks, &x);
        assert_eq!(expected.size(), [2, 10, 4, 6]);
        let folded: Vec<ResidualBlock> = blocks.iter().map(ResidualBlock::folded).collect();
        assert!(through(&folded, &x).allclose(&expected, 1e-4, 1e-4, false));
    }
}
