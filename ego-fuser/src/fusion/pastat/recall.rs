//! What was seen a moment before, to the cell: earlier maps steady what the newest show.
//!
//! A map errs anew in every sweep: points fall elsewhere, and cells begin elsewhere on a vehicle. Part of that is not there in
//! the mean of several sweeps.

use tch::nn::{self, Init, Module};
use tch::{TchError, Tensor};

use super::entries::Maps;

/// What all agents have shown at one time step before their newest.
#[derive(Debug)]
pub(super) struct Earlier {
    /// 0 for the step before the newest.
    pub(super) step: i64,
    /// One map.
    pub(super) maps: Maps,
}

impl Earlier {
    /// Of the maps `entries` of one time step the strongest at each cell.
    pub(super) fn strongest(step: i64, maps: &Maps, entries: &[i64]) -> Result<Self, TchError> {
        let Maps { features, mask } = Maps::picked(&maps.features, &maps.mask, entries)?;
        let over_all = |tensor: &Tensor| tensor.f_amax([0_i64].as_slice(), true);
        let strongest = over_all(&features.f_masked_fill(&mask.f_eq(0.0)?, f64::NEG_INFINITY)?)?;
        let mask = over_all(&mask)?;
        let features = strongest.f_masked_fill(&mask.f_eq(0.0)?, 0.0)?;
        Ok(Self { step, maps: Maps { features, mask } })
    }
}

/// Blends earlier maps into the newest, by cell and channel; nothing of them before it is trained.
#[derive(Debug)]
pub(super) struct Recall {
    now: nn::Conv2D,
    past: nn::Conv2D,
    token: nn::Linear,
    /// `[steps, hidden]`.
    step: Tensor,
    gate: nn::Conv2D,
    patch: i64,
}

impl Recall {
    /// For maps of `channels`, tokens of `dim` with `patch` cells along each edge, and `steps` time steps before the newest;
    /// from `hidden` channels it is told how much of an earlier map is taken.
    pub(super) fn new(path: &nn::Path<'_>, [channels, dim, patch, steps]: [i64; 4], hidden: i64) -> Self {
        let around = nn::ConvConfig { padding: 1, ..Default::default() };
        let bare = nn::ConvConfig { bias: false, ..around };
        let neutral = nn::ConvConfig { ws_init: Init::Const(0.0), bs_init: Init::Const(0.0), ..Default::default() };
        Self {
            now: nn::conv2d(path / "now", channels, hidden, 3, around),
            past: nn::conv2d(path / "past", channels, hidden, 3, bare),
            token: nn::linear(path / "token", dim, hidden, nn::LinearConfig { bias: false, ..Default::default() }),
            step: path.var("step", &[steps, hidden], Init::Const(0.0)),
            gate: nn::conv2d(path / "gate", hidden, channels, 1, neutral),
            patch,
        }
    }

    /// `[C, H, W]` of the newest `now` of that shape.
    ///
    /// # Shapes
    /// - `past`: maps of the same size
    /// - `ego`: `[1, h, w, D]`, the ego's tokens after the transformer
    pub(super) fn forward(&self, now: &Tensor, past: &[Earlier], ego: &Tensor) -> Result<Tensor, TchError> {
        if past.is_empty() {
            return Ok(now.shallow_clone());
        }
        let now = now.f_unsqueeze(0)?;
        let known = self.now.forward(&now) + self.told(ego)?;
        let blend = |blended: Tensor, earlier: &Earlier| -> Result<Tensor, TchError> {
            let Earlier { step, maps: Maps { features, mask } } = earlier;
            let step = self.step.f_get(*step)?.f_view([1, -1, 1, 1])?;
            let hidden = (&known + self.past.forward(&(features * mask)) + step).f_relu()?;
            let gate = self.gate.forward(&hidden).f_tanh()? * mask;
            Ok(blended + gate * (features - &now))
        };
        past.iter().try_fold(now.shallow_clone(), blend)?.f_squeeze_dim(0)
    }

    /// What the tokens know, on the cells.
    fn told(&self, ego: &Tensor) -> Result<Tensor, TchError> {
        let (_, rows, columns, _) = ego.size4()?;
        let told = self.token.forward(ego).f_permute([0, 3, 1, 2])?;
        told.f_upsample_nearest2d([rows * self.patch, columns * self.patch], None, None)
    }
}
