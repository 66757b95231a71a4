//! Box input: adds what neighbours' boxes say to the fused feature map of any method.
//!
//! Boxes need no common network and take a kilobyte. They are drawn on the ego's grid ([`raster`]); a small network reads
//! them beside the fused map and adds a correction to it near the boxes. It is trained with late, lost, shifted and
//! invented boxes, so that age and confidence decide what they are worth. Without boxes the map stays as it is.

pub mod raster;

use perception::tensor_values::tensor;
use perception::weights::Weights;
use protocol::BevGrid;
use tch::nn::{self, ConvConfig, Init, Module};
use tch::{Result, Tensor};

pub use raster::{PlacedBox, placed};

/// Prefix of its variables in a weights file.
pub(crate) const PREFIX: &str = "box_input.";
/// A variable that every box input has.
const WEIGHT: &str = "box_input.out.weight";

/// Channels to which the fused map is reduced beside the boxes.
const REDUCED: i64 = 32;
/// Channels of the layers.
const HIDDEN: i64 = 48;
/// Cells around a box in which the map is changed.
const REACH: i64 = 2;

/// True if a weights file has a box input.
pub fn is_in(weights: &Weights) -> bool {
    weights.contains(WEIGHT)
}

/// The network.
#[derive(Debug)]
pub struct BoxInput {
    reduce: nn::Conv2D,
    layers: [nn::Conv2D; 3],
    /// Zero at the start and without bias: an untrained box input changes nothing.
    out: nn::Conv2D,
}

impl BoxInput {
    /// The network behind a fused map of `channels`; its variables are below `path`, `box_input.*`.
    pub fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let path = path / "box_input";
        let conv = |name: &str, from: i64, kernel: i64, dilation: i64| {
            let config = ConvConfig {
                padding: dilation * (kernel / 2),
                dilation,
                ..ConvConfig::default()
            };
            let to = if kernel == 1 { REDUCED } else { HIDDEN };
            nn::conv2d(&path / name, from, to, kernel, config)
        };
        let out = ConvConfig {
            bias: false,
            ws_init: Init::Const(0.0),
            ..ConvConfig::default()
        };
        Self {
            reduce: conv("reduce", channels, 1, 1),
            layers: [
                conv("first", REDUCED + raster::CHANNELS as i64, 3, 1),
                conv("second", HIDDEN, 3, 2),
                conv("third", HIDDEN, 3, 1),
            ],
            out: nn::conv2d(&path / "out", HIDDEN, channels, 1, out),
        }
    }

    /// The fused map `[C, H, W]` of `grid` with the correction by `boxes`.
    ///
    /// # Errors
    /// [`tch::TchError`] when the map is of another shape.
    pub fn add(&self, fused: &Tensor, boxes: &[PlacedBox], grid: &BevGrid) -> Result<Tensor> {
        let shape = [
            raster::CHANNELS as i64,
            grid.height.into(),
            grid.width.into(),
        ];
        let drawn = tensor(&raster::draw(boxes, grid), &shape, fused.device())?.f_unsqueeze(0)?;
        let window = [2 * REACH + 1; 2];
        let near = drawn
            .f_narrow(1, 0, 1)?
            .f_gt(0.0)?
            .f_to_kind(fused.kind())?
            .f_max_pool2d(window, [1, 1], [REACH; 2], [1, 1], false)?;
        let reduced = self.reduce.forward(&fused.f_unsqueeze(0)?).f_relu()?;
        let mut hidden = Tensor::f_cat(&[reduced, drawn], 1)?;
        for layer in &self.layers {
            hidden = layer.forward(&hidden).f_relu()?;
        }
        let change = self.out.forward(&hidden).f_mul(&near)?;
        fused.f_add(&change.f_squeeze_dim(0)?)
    }
}

#[cfg(test)]
mod tests {
    use protocol::Box3d;
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -8.0,
        cell_m: 0.8,
        width: 20,
        height: 20,
    };

    fn map() -> Tensor {
        tch::manual_seed(3);
        Tensor::rand([8, 20, 20], (Kind::Float, Device::Cpu))
    }

    fn boxes() -> [PlacedBox; 1] {
        [PlacedBox {
            box3d: Box3d {
                center_m: [2.0, 0.8, -1.0],
                size_m: [4.0, 1.6, 1.5],
                heading_rad: 0.0,
            },
            age_secs: 0.1,
            score: 0.7,
            pose_confidence: 1.0,
        }]
    }

    #[test]
    fn an_untrained_input_changes_nothing() {
        let variables = VarStore::new(Device::Cpu);
        let input = BoxInput::new(&variables.root(), 8);
        assert_eq!(input.add(&map(), &boxes(), &GRID).unwrap(), map());
    }

    #[test]
    fn a_trained_one_changes_the_map_near_boxes_only() {
        let variables = VarStore::new(Device::Cpu);
        let input = BoxInput::new(&variables.root(), 8);
        let _ = tch::no_grad(|| variables.variables()[WEIGHT].shallow_clone().fill_(0.5));
        let change = |boxes: &[PlacedBox]| {
            (input.add(&map(), boxes, &GRID).unwrap() - map())
                .abs()
                .amax([0_i64].as_slice(), false)
        };
        assert_eq!(change(&[]).max().double_value(&[]), 0.0);
        let changed = change(&boxes());
        assert!(changed.max().double_value(&[]) > 0.0);
        // The box is in columns 10 to 14 and rows 10 to 12.
        let is_still = |row: i64, column: i64| changed.double_value(&[row, column]) == 0.0;
        for (row, column) in [(10, 7), (10, 17), (7, 12), (15, 12), (0, 0)] {
            assert!(is_still(row, column), "{row} {column}");
        }
        assert!(!is_still(11, 12));
    }
}
