//! Map refinement, an extension: two convolutions refine the fused map (`refine`; absent: off).
//!
//! Measured gain: not measured separately; every training in the tables has it.
//!
//! In integers only the tiles are refined in or near which a vehicle is likely, where the detector's head is at hand:
//! elsewhere nothing is detected before or after.

mod tiles;

use perception::int8::{
    ActivationScales, ConvGeometry, Int8Convolution, LayerFormat, Quantisation, QuantiseError,
    ScaleSearch,
};
use tch::nn::{self, Init};
use tch::{TchError, Tensor};

use self::tiles::Tiles;
use crate::layers::around;

/// Refines the fused map from its own cells and their neighbours: the warp blurs maps, and 1x1 heads cannot correct
/// that. Changes nothing before it is trained.
#[derive(Debug)]
pub(crate) struct MapRefinement {
    convolutions: [nn::Conv2D; 2],
    int8: Option<Int8Refinement>,
}

/// The same convolutions in 8-bit integers.
#[derive(Debug)]
struct Int8Refinement {
    input: Quantisation,
    convolutions: [Int8Convolution; 2],
}

/// Share of the tiles that are refined in integers.
const SHARE: f64 = 0.25;
/// Name of the input among the activations.
const INPUT: &str = "fusion.refine.input";
/// Name of the map between the convolutions.
const HIDDEN: &str = "fusion.refine.hidden";

impl MapRefinement {
    /// Its variables are `refine.*` below `path`; `hidden` are the channels between its two convolutions.
    pub(crate) fn new(path: &nn::Path<'_>, channels: i64, hidden: i64) -> Self {
        let path = path / "refine";
        let neutral = nn::ConvConfig {
            ws_init: Init::Const(0.0),
            bs_init: Init::Const(0.0),
            ..around()
        };
        Self {
            convolutions: [
                nn::conv2d(&path / "conv0", channels, hidden, 3, around()),
                nn::conv2d(&path / "conv1", hidden, channels, 3, neutral),
            ],
            int8: None,
        }
    }

    /// `[1, C, H, W]` of a fused map of that shape; `likely` `[1, 1, H, W]` is larger where a vehicle is more likely.
    pub(crate) fn forward(
        &self,
        fused: Tensor,
        likely: Option<&Tensor>,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let (_, _, height, width) = fused.size4()?;
        if let (Some(int8), false, true) = (&self.int8, train, Tiles::fit([height, width])) {
            return int8.forward(fused, likely);
        }
        let [first, second] = &self.convolutions;
        convolve(second, &convolve(first, &fused)?.f_relu_()?)?.f_add_(&fused)
    }

    /// Adds the activations for a fused map `[1, C, H, W]`.
    pub(crate) fn observe(&self, fused: &Tensor, search: &mut ScaleSearch) -> Result<(), TchError> {
        search.observe(INPUT, fused)?;
        search.observe(HIDDEN, &convolve(&self.convolutions[0], fused)?.f_relu_()?)
    }

    /// Computes in integers from here on, except in training.
    pub(crate) fn quantise(&mut self, scales: &ActivationScales) -> Result<(), QuantiseError> {
        let (input, hidden) = (scales.get(INPUT)?, scales.get(HIDDEN)?);
        // Tiles come with the cells around them, so nothing is padded.
        let geometry = ConvGeometry {
            stride: 1,
            padding: 0,
            upsampling: 1,
        };
        let [first, second] = &self.convolutions;
        let [first, second] = [
            (first, LayerFormat::hidden(input, hidden)),
            (second, LayerFormat::last(hidden)),
        ]
        .map(|(nn::Conv2D { ws, bs, .. }, format)| {
            Int8Convolution::new(ws, bs.as_ref(), geometry, format)
        });
        self.int8 = Some(Int8Refinement {
            input,
            convolutions: [first?, second?],
        });
        Ok(())
    }
}

/// A size-preserving 3x3 convolution.
fn convolve(convolution: &nn::Conv2D, maps: &Tensor) -> Result<Tensor, TchError> {
    let nn::Conv2D { ws, bs, .. } = convolution;
    maps.f_conv2d(ws, bs.as_ref(), [1, 1], [1, 1], [1, 1], 1)
}

impl Int8Refinement {
    /// The refined map; `fused` may be overwritten.
    fn forward(&self, fused: Tensor, likely: Option<&Tensor>) -> Result<Tensor, TchError> {
        let (_, channels, height, width) = fused.size4()?;
        let tiles = match likely {
            Some(likely) => Tiles::most_likely(likely, SHARE)?,
            None => Tiles::all([height, width]),
        };
        let cells = fused.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        let [first, second] = &self.convolutions;
        let cut = tiles.cut(&cells.f_view([-1, channels])?)?;
        let hidden = first.forward(&self.input.quantise(&cut)?)?;
        // Beyond the edge of the map the second convolution reads zeros, not what the first computes there.
        let hidden = hidden.f_mul(&tiles.hidden_mask()?)?;
        let refined = cells.f_permute([0, 3, 1, 2])?;
        tiles.add_to(&refined, &second.forward(&hidden)?)?;
        Ok(refined)
    }
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn untrained_it_changes_nothing() {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let refinement = MapRefinement::new(&variables.root(), 8, 12);
        let fused = Tensor::rand([1, 8, 16, 24], (Kind::Float, Device::Cpu));
        assert_eq!(
            refinement.forward(fused.copy(), None, false).unwrap(),
            fused
        );
    }

    #[test]
    fn integers_change_little_and_training_stays_in_floating_point() {
        tch::set_num_threads(1);
        tch::manual_seed(2);
        let variables = VarStore::new(Device::Cpu);
        let mut refinement = MapRefinement::new(&variables.root(), 8, 12);
        let fused = Tensor::rand([1, 8, 16, 24], (Kind::Float, Device::Cpu)) * 4.0 - 0.5;
        let weight = &variables.variables()["refine.conv1.weight"];
        let _ = tch::no_grad(|| weight.shallow_clone().normal_(0.0, 0.1));
        let (exact, mut search) = (
            refinement.forward(fused.copy(), None, true).unwrap(),
            ScaleSearch::default(),
        );
        tch::no_grad(|| refinement.observe(&fused, &mut search)).unwrap();
        tch::no_grad(|| refinement.quantise(&search.scales())).unwrap();
        let found = tch::no_grad(|| refinement.forward(fused.copy(), None, false)).unwrap();
        let error = (&found - &exact)
            .square()
            .mean(Kind::Float)
            .sqrt()
            .double_value(&[]);
        assert!(
            error > 0.0 && error < 0.03 * (&exact - &fused).std(true).double_value(&[]),
            "{error}"
        );
        assert_eq!(refinement.forward(fused.copy(), None, true).unwrap(), exact);
        let missing = MapRefinement::new(&variables.root(), 8, 12)
            .quantise(&Default::default())
            .unwrap_err();
        assert!(
            missing.to_string().contains("fusion.refine.input"),
            "{missing}"
        );
    }
}
