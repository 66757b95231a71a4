//! Class head of the detector: likelihood of a vehicle at each cell of a feature map.

use tch::nn::{self, Init};
use tch::{TchError, Tensor};

/// Initial values before weights are read or trained.
const RANDOM: Init = Init::Randn {
    mean: 0.0,
    stdev: 0.01,
};

/// The detector's class head.
#[derive(Debug)]
pub(crate) struct Classes {
    weight: Tensor,
    bias: Tensor,
}

impl Classes {
    /// The head for feature maps of `channels` with `anchors` per cell whose parameters are under `path`. A detector
    /// that is trained with the fusion has created them; otherwise they are created here.
    pub(crate) fn under(path: &nn::Path<'_>, [channels, anchors]: [i64; 2]) -> Self {
        let path = path / "cls_head";
        let [weight, bias] = [
            ("weight", &[anchors, channels, 1, 1][..]),
            ("bias", &[anchors][..]),
        ]
        .map(|(name, size)| {
            path.get(name)
                .unwrap_or_else(|| path.var(name, size, RANDOM))
        });
        Self { weight, bias }
    }

    /// The same head; nothing is copied.
    pub(crate) fn shallow_clone(&self) -> Self {
        Self {
            weight: self.weight.shallow_clone(),
            bias: self.bias.shallow_clone(),
        }
    }

    /// Likelihood of a vehicle around each cell of a feature map `[1, C, H, W]`: `[1, 1, H, W]`, the logit of the best
    /// anchor of a cell. No gradient flows.
    pub(crate) fn likely(&self, map: &Tensor) -> Result<Tensor, TchError> {
        let [map, weight, bias] = [map, &self.weight, &self.bias].map(Tensor::f_detach);
        let logits = map?
            .f_permute([0, 2, 3, 1])?
            .f_linear(&weight?.f_flatten(1, 3)?, Some(&bias?))?;
        logits.f_amax([3_i64].as_slice(), false)?.f_unsqueeze(1)
    }
}

#[cfg(test)]
mod tests {
    use perception::layers::head::DetectionHead;
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;
    use crate::test_data::uniform;

    #[test]
    fn it_is_the_existing_head_and_gives_the_same_output() {
        let variables = VarStore::new(Device::Cpu);
        let head = DetectionHead::new(&variables.root(), 5, 2);
        let parameters = variables.variables().len();
        let classes = Classes::under(&variables.root(), [5, 2]);
        assert_eq!(variables.variables().len(), parameters);
        let map = uniform(3, &[1, 5, 6, 8]);
        let scores = head.forward(&map).unwrap().scores.amax([1], true);
        let likely = classes.likely(&map).unwrap();
        assert!(!likely.requires_grad() && likely.allclose(&scores, 1e-5, 1e-5, false));
        assert_eq!(likely.kind(), Kind::Float);
        let separate = VarStore::new(Device::Cpu);
        let _ = Classes::under(&separate.root(), [5, 2]);
        let mut names: Vec<String> = separate.variables().into_keys().collect();
        names.sort();
        assert_eq!(names, ["cls_head.bias", "cls_head.weight"]);
    }
}
