//! Sparse 3-D convolution layer, and the same in 8-bit integers.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::rulebook::{GatherIndex, KERNEL_VOLUME};
use crate::int8::{Int8Linear, LayerFormat};

/// Bytes of the values by which rows are gathered.
const WORD_BYTES: i64 = 4;

/// A 3x3x3 convolution over sites, with bias.
#[derive(Debug)]
pub struct SparseConv {
    /// `[27 * C_in, C_out]`.
    weight: Tensor,
    /// `[C_out]`.
    bias: Tensor,
}

impl SparseConv {
    /// He-initialised for the ReLU that follows; about ten of a kernel's neighbours exist on a surface.
    pub fn new(path: &nn::Path<'_>, inputs: i64, outputs: i64) -> Self {
        let stdev = (2.0 / (10.0 * inputs as f64)).sqrt();
        let shape = [KERNEL_VOLUME as i64 * inputs, outputs];
        let weight = path.var("weight", &shape, Init::Randn { mean: 0.0, stdev });
        let bias = path.var("bias", &[outputs], Init::Const(0.0));
        Self { weight, bias }
    }

    /// `[N_in, C_in]` to `[N_out, C_out]`, in the precision of `x`.
    ///
    /// # Errors
    /// Those of the tensor library, for example when the rows are not those of the rulebook.
    pub fn forward(&self, x: &Tensor, index: &GatherIndex) -> Result<Tensor, TchError> {
        let width = KERNEL_VOLUME as i64 * x.size2()?.1;
        let columns = index.gather(x)?.f_view([-1, width])?;
        let [bias, weight] = [&self.bias, &self.weight].map(|tensor| tensor.to_kind(x.kind()));
        bias.f_addmm(&columns, &weight)
    }

    /// The same in integers, see [`Int8SparseConv`].
    ///
    /// # Errors
    /// Those of the tensor library; [`TchError::Shape`] unless the input channels are a multiple of four.
    pub fn int8(&self, format: LayerFormat) -> Result<Int8SparseConv, TchError> {
        let inputs = self.weight.size2()?.0 / KERNEL_VOLUME as i64;
        if inputs % WORD_BYTES != 0 {
            return Err(TchError::Shape(format!(
                "{inputs} input channels, must be a multiple of {WORD_BYTES}"
            )));
        }
        let linear = Int8Linear::new(&self.weight, Some(&self.bias), format)?;
        Ok(Int8SparseConv(linear))
    }
}

/// A 3x3x3 convolution over sites of `u8` features that are never negative.
#[derive(Debug)]
pub struct Int8SparseConv(Int8Linear);

impl Int8SparseConv {
    /// `[N_in, C_in]`, `u8`, to `[N_out, C_out]`.
    ///
    /// # Errors
    /// Those of the tensor library, for example when the rows are not those of the rulebook.
    pub fn forward(&self, x: &Tensor, index: &GatherIndex) -> Result<Tensor, TchError> {
        let channels = x.size2()?.1;
        // The library gathers rows of floats many times faster than rows of bytes; nothing is computed with them here.
        // The zeros of missing neighbours are the quantised zero, as features are never negative.
        let words = index.gather(&x.f_view_dtype(Kind::Float)?)?;
        let columns = words.f_view_dtype(Kind::Uint8)?;
        let columns = columns.f_view([-1, KERNEL_VOLUME as i64 * channels])?;
        self.0.forward(&columns)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tch::nn::VarStore;
    use tch::{Device, IndexOp, Kind};

    use super::*;
    use crate::int8::{Quantisation, Scale};
    use crate::sparse::{Rulebook, Sites};

    const SIZE: i64 = 6;

    /// Rows into a dense `[1, C, SIZE, SIZE, SIZE]` block.
    fn dense(rows: &Tensor, sites: &Sites, size: i64) -> Tensor {
        let block = Tensor::zeros(
            [rows.size()[1], size, size, size],
            (Kind::Float, Device::Cpu),
        );
        for (row, coord) in sites.coords().iter().enumerate() {
            let [x, y, z] = coord.map(i64::from);
            block.i((.., x, y, z)).copy_(&rows.get(row as i64));
        }
        block.unsqueeze(0)
    }

    fn rows(block: &Tensor, sites: &Sites) -> Tensor {
        let rows = sites.coords().iter().map(|coord| {
            let [x, y, z] = coord.map(i64::from);
            block.i((0, .., x, y, z))
        });
        Tensor::stack(&rows.collect::<Vec<_>>(), 0)
    }

    /// Values and gradients of a sparse convolution and of a dense one over the same occupancy.
    fn agrees(occupied: Vec<[i32; 3]>, stride: i64, seed: i64) -> bool {
        tch::set_num_threads(1);
        tch::manual_seed(seed);
        let (sites, _) = Sites::collect(occupied);
        let outputs = if stride == 1 {
            sites.clone()
        } else {
            sites.halved().0
        };
        let book = if stride == 1 {
            Rulebook::submanifold(&sites)
        } else {
            Rulebook::strided(&sites, &outputs)
        };
        let index = Rulebook::stacked([&book], Device::Cpu).unwrap();
        let network = VarStore::new(Device::Cpu);
        let conv = SparseConv::new(&network.root(), 3, 5);
        let x = Tensor::randn([sites.len() as i64, 3], (Kind::Float, Device::Cpu));
        let pull = Tensor::randn([outputs.len() as i64, 5], (Kind::Float, Device::Cpu));

        let sparse_x = x.detach().set_requires_grad(true);
        let sparse = conv.forward(&sparse_x, &index).unwrap();
        (&sparse * &pull).sum(Kind::Float).backward();
        let weight_gradient = conv.weight.grad();

        let dense_x = x.detach().set_requires_grad(true);
        let kernel = conv
            .weight
            .detach()
            .view([3, 3, 3, 3, 5])
            .permute([4, 3, 0, 1, 2])
            .contiguous();
        let kernel = kernel.set_requires_grad(true);
        let block = dense(&dense_x, &sites, SIZE);
        let full = block.conv3d(
            &kernel,
            Some(&conv.bias.detach()),
            [stride; 3],
            [1; 3],
            [1; 3],
            1,
        );
        let expected = rows(&full, &outputs);
        (&expected * &pull).sum(Kind::Float).backward();
        let expected_gradient = kernel
            .grad()
            .permute([2, 3, 4, 1, 0])
            .contiguous()
            .view([81, 5]);

        sparse.allclose(&expected, 1e-4, 1e-5, false)
            && sparse_x.grad().allclose(&dense_x.grad(), 1e-4, 1e-5, false)
            && weight_gradient.allclose(&expected_gradient, 1e-4, 1e-4, false)
    }

    fn occupancy() -> impl Strategy<Value = Vec<[i32; 3]>> {
        proptest::collection::vec([0..SIZE as i32, 0..SIZE as i32, 0..SIZE as i32], 1..80)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn equals_dense_convolution_at_stride_1(occupied in occupancy(), seed in 0..1000_i64) {
            prop_assert!(agrees(occupied, 1, seed));
        }

        #[test]
        fn equals_dense_convolution_at_stride_2(occupied in occupancy(), seed in 0..1000_i64) {
            prop_assert!(agrees(occupied, 2, seed));
        }
    }

    #[test]
    fn integers_give_nearly_the_same() {
        tch::set_num_threads(1);
        tch::manual_seed(6);
        let (sites, _) = Sites::collect((0..60).map(|k| [k % 5, k / 5 % 4, k / 20]));
        let index = Rulebook::stacked([&Rulebook::submanifold(&sites)], Device::Cpu).unwrap();
        let network = VarStore::new(Device::Cpu);
        let conv = SparseConv::new(&network.root(), 8, 12);
        let input = Quantisation {
            scale: Scale::of_exponent(-6),
            zero_point: 0,
        };
        let x = Tensor::rand([sites.len() as i64, 8], (Kind::Float, Device::Cpu)) * 3.0;
        let expected = tch::no_grad(|| conv.forward(&x, &index).unwrap());
        let int8 = tch::no_grad(|| conv.int8(LayerFormat::last(input))).unwrap();
        let found = int8.forward(&input.quantise(&x).unwrap(), &index).unwrap();
        let error = (&found - &expected)
            .square()
            .mean(Kind::Float)
            .sqrt()
            .double_value(&[]);
        assert!(
            error > 0.0 && error < 0.02 * expected.std(true).double_value(&[]),
            "{error}"
        );
        let odd = SparseConv::new(&(network.root() / "odd"), 3, 4);
        let message = odd.int8(LayerFormat::last(input)).unwrap_err().to_string();
        assert!(message.contains("3 input channels"), "{message}");
    }

    #[test]
    fn rows_of_another_rulebook_are_rejected() {
        let network = VarStore::new(Device::Cpu);
        let conv = SparseConv::new(&network.root(), 2, 2);
        let book = Rulebook::submanifold(&Sites::collect([[0, 0, 0]]).0);
        let index = Rulebook::stacked([&book], Device::Cpu).unwrap();
        let message = conv
            .forward(&Tensor::zeros([2, 2], (Kind::Float, Device::Cpu)), &index)
            .unwrap_err();
        assert!(message.to_string().contains("2 rows") && message.to_string().contains("of 1"));
    }

    #[test]
    fn stacked_sweeps_do_not_influence_each_other() {
        let book = Rulebook::submanifold(&Sites::collect([[0, 0, 0], [0, 0, 1]]).0);
        let network = VarStore::new(Device::Cpu);
        let conv = SparseConv::new(&network.root(), 2, 3);
        let x = Tensor::randn([4, 2], (Kind::Float, Device::Cpu));
        let both = conv
            .forward(&x, &Rulebook::stacked([&book, &book], Device::Cpu).unwrap())
            .unwrap();
        let one = conv
            .forward(&x.i(2..), &Rulebook::stacked([&book], Device::Cpu).unwrap())
            .unwrap();
        assert!(both.i(2..).allclose(&one, 1e-6, 1e-6, false));
    }
}
