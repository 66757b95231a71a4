//! Trajectory field of TraF-Align, and the sampling points along it.

use perception::layers::convolution::ConvLayer;
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::config::TrafAlignConfig;

/// Channels of the U-Net: at full and at half resolution.
const WIDTHS: [i64; 2] = [16, 32];

/// Predicts earlier positions of each token's object.
#[derive(Debug)]
pub(super) struct Trajectories {
    inner: ConvLayer,
    down: ConvLayer,
    deep: ConvLayer,
    up: ConvLayer,
    joined: ConvLayer,
    field: ConvLayer,
    before_offsets: ConvLayer,
    /// `[2 K, F, 3, 3]` and `[2 K]`: zero at first, so that points begin as a square around their token.
    offsets: (Tensor, Tensor),
    kernel: i64,
}

impl Trajectories {
    pub(super) fn new(path: &nn::Path<'_>, config: &TrafAlignConfig) -> Self {
        let [full, half] = WIDTHS;
        let points = config.kernel * config.kernel;
        let offsets = path / "offsets";
        Self {
            inner: layer(path, "inner", [config.dim, full], 1),
            down: layer(path, "down", [full, half], 2),
            deep: layer(path, "deep", [half, half], 1),
            up: ConvLayer::upsampling(&(path / "up"), &(path / "up_norm"), [half, full], 2),
            joined: layer(path, "joined", [2 * full, full], 1),
            field: ConvLayer::biased(&(path / "field"), [full, config.field], 1, 1),
            before_offsets: layer(path, "before_offsets", [config.field, 2 * points], 1),
            offsets: (
                offsets.var("weight", &[2 * points, 2 * points, 3, 3], Init::Const(0.0)),
                offsets.var("bias", &[2 * points], Init::Const(0.0)),
            ),
            kernel: config.kernel,
        }
    }

    /// Tokens `[A, D, h, w]`, both sizes even, to sampling positions `[A, K h, w, 2]`: x, y of every point of every
    /// token, -1..1 over the extent of the map.
    pub(super) fn points(&self, tokens: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let fine = self.inner.forward(tokens, train);
        let coarse = self.deep.forward(&self.down.forward(&fine, train), train);
        let joined = Tensor::f_cat(&[&fine, &self.up.forward(&coarse, train)], 1)?;
        let joined = self.joined.forward(&joined, train);
        let field = self.field.forward(&joined, train).f_sigmoid()?;
        let (weight, bias) = &self.offsets;
        let before = self.before_offsets.forward(&field, train);
        let offsets = before.f_conv2d(weight, Some(bias), [1, 1], [1, 1], [1, 1], 1)?;
        self.sampling_grid(&offsets)
    }

    /// Offsets `[A, 2 K, h, w]` in tokens, x of all points and then y, around the points of a square.
    fn sampling_grid(&self, offsets: &Tensor) -> Result<Tensor, TchError> {
        let (agents, channels, height, width) = offsets.size4()?;
        let (points, options) = (channels / 2, (Kind::Float, offsets.device()));
        let middle = (self.kernel - 1) as f64 / 2.0;
        let square = Tensor::f_arange(self.kernel, options)? - middle;
        // Point k is in row k / kernel and column k % kernel of the square.
        let [x, y] = [
            (0, [1, self.kernel], width, [1, 1, 1, width]),
            (points, [self.kernel, 1], height, [1, 1, height, 1]),
        ]
        .map(|(first, across, size, along)| {
            let of_points = square.f_view(across)?.f_expand([self.kernel; 2], false)?;
            let tokens = Tensor::f_arange(size, options)?.f_view(along)?;
            let place = offsets.f_narrow(1, first, points)?
                + of_points.f_reshape([1, points, 1, 1])?
                + tokens;
            // -1 and 1 are the edges of the outer tokens, so the centre of the first is half a token from -1.
            Ok::<_, TchError>((place + 0.5) * (2.0 / size as f64) - 1.0)
        });
        let sampling_grid = Tensor::f_stack(&[x?, y?], -1)?;
        sampling_grid.f_view([agents, points * height, width, 2])
    }
}

/// A normed layer with a kernel of 3 tokens.
fn layer(path: &nn::Path<'_>, name: &str, io: [i64; 2], stride: i64) -> ConvLayer {
    let norm = path / format!("{name}_norm");
    ConvLayer::normed(&(path / name), &norm, io, 3, stride)
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn untrained_points_are_the_tokens_around() {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let config = TrafAlignConfig::lean(8);
        let trajectories = Trajectories::new(&variables.root(), &config);
        let tokens = Tensor::randn([1, config.dim, 6, 4], (Kind::Float, Device::Cpu));
        let points = tch::no_grad(|| trajectories.points(&tokens, false))
            .unwrap()
            .view([3, 3, 6, 4, 2]);
        // Of the token in row 2, column 1, the point one row below and one column to the left.
        let [x, y] = [0, 1].map(|axis| points.double_value(&[2, 0, 2, 1, axis]));
        assert!((x - (0.5 / 4.0 * 2.0 - 1.0)).abs() < 1e-6, "{x}");
        assert!((y - (3.5 / 6.0 * 2.0 - 1.0)).abs() < 1e-6, "{y}");
    }
}
