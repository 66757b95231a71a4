//! Box input: neighbours' boxes change scores and box offsets of the detection head, behind the fusion of any method.
//!
//! Boxes need no common network and take less than a kilobyte. A small network encodes the fused map in and around each
//! box, the box, and its support by other senders. For each cell that the box covers it predicts a change of the head's
//! scores and a gate between the head's own box and the neighbour's. It is trained with late, lost, shifted and invented
//! boxes, so age and confidence determine their weight. Without boxes the output of the head is unchanged.

mod cells;
mod placed;

use std::f64::consts::PI;

use perception::boxes::anchors::Anchors;
use perception::boxes::roi::{CHANNELS, RoiEncoder};
use perception::layers::head::HeadOutput;
use perception::model_config::DetectorConfig;
use perception::tensor_values::tensor;
use perception::weights::Weights;
use protocol::{BevGrid, Box3d};
use tch::nn::{self, Module};
use tch::{Kind, Result, Tensor};

pub use placed::{PlacedBox, placed};

use self::cells::{BoxCells, VALUES};
use crate::layers::BARE;
use crate::targets::BOX_CODE;

/// Prefix of its variables in a weights file.
pub(crate) const PREFIX: &str = "box_input.";
/// A variable that every box input has.
const WEIGHT: &str = "box_input.out.weight";

/// Channels of the layers.
const HIDDEN: i64 = 96;
/// Numbers of the component that holds the heading.
const YAW: i64 = BOX_CODE as i64 - 1;
/// Changes of an anchor: of its score, gate to the neighbour's box, and of each number of its own box.
const CHANGES: i64 = 2 + BOX_CODE as i64;
/// Range of the gate: 0 keeps the head's own box, 1 gives the neighbour's. Limits keep every box valid whatever neighbours
/// send.
const GATE_RANGE: [f64; 2] = [-0.5, 1.5];
/// Largest change of an offset of the own box.
const MAX_OFFSET_CHANGE: f64 = 0.5;
/// Largest change of the logit of a score.
const MAX_LOGIT_CHANGE: f64 = 20.0;
/// Largest exponent of the weight of a box among those on a cell.
const MAX_LOG_WEIGHT: f64 = 8.0;

/// True if a weights file has a box input.
pub fn is_in(weights: &Weights) -> bool {
    weights.contains(WEIGHT)
}

/// The network.
#[derive(Debug)]
pub struct BoxInput {
    roi: RoiEncoder,
    cell: [nn::Linear; 2],
    /// Zero at the start and without bias: an untrained box input changes nothing.
    out: nn::Linear,
    grid: BevGrid,
    anchors: Anchors,
}

impl BoxInput {
    /// The network behind the head of a detector; its variables are below `path`, `box_input.*`.
    pub fn new(path: &nn::Path<'_>, detector: &DetectorConfig) -> Self {
        let path = path / "box_input";
        let anchors = Anchors::for_detector(detector);
        let (channels, count) = (detector.feature_channels(), anchors.yaws_rad.len() as i64);
        // Map, own scores and boxes, the box, its difference, covered share, and features of the region of interest.
        let of_cell = channels + count * (1 + 3 * BOX_CODE as i64) + 1 + CHANNELS;
        let out = nn::LinearConfig {
            ws_init: nn::Init::Const(0.0),
            ..BARE
        };
        Self {
            roi: RoiEncoder::new(&path, detector, VALUES),
            cell: [("cell", of_cell), ("second", HIDDEN)].map(|(name, from)| {
                nn::linear(&path / name, from, HIDDEN, nn::LinearConfig::default())
            }),
            out: nn::linear(&path / "out", HIDDEN, count * CHANGES + 1, out),
            grid: detector.feature_grid(),
            anchors,
        }
    }

    /// The output of the head for one fused map `[1, C, H, W]` with the changes by `boxes`, in the frame of the map. Gradients
    /// flow to its own variables only.
    ///
    /// # Errors
    /// [`tch::TchError`] when map and output are of another shape.
    pub fn change(
        &self,
        fused: &Tensor,
        head: HeadOutput,
        boxes: &[PlacedBox],
    ) -> Result<HeadOutput> {
        let found = BoxCells::new(boxes, &self.grid, &self.anchors);
        if found.cell_of.is_empty() {
            // In training every sample has a gradient.
            let nothing = self.out.ws.f_sum(Kind::Float)? * 0.0;
            return Ok(HeadOutput {
                scores: head.scores.f_add(&nothing)?,
                ..head
            });
        }
        let pairs = CoveredCells::new(&found, &head)?;
        let by_cell = fused
            .f_detach()?
            .f_squeeze_dim(0)?
            .f_flatten(1, 2)?
            .f_transpose(0, 1)?;
        let values = tensor(&found.values, &[-1, VALUES as i64], fused.device())?;
        let placed: Vec<Box3d> = boxes.iter().map(|placed| placed.box3d).collect();
        let around = self.roi.forward(fused, &placed, &values)?;
        let input = [
            &by_cell.f_index_select(0, &pairs.cell_of)?,
            // The logits of the head have no bound, and beyond 8 they mean no more than certainty.
            &pairs.own.f_clamp(-8.0, 8.0)?,
            &pairs.code.f_flatten(1, 2)?,
            &pairs.difference.f_flatten(1, 2)?,
            &pairs.share,
            &around.f_index_select(0, &pairs.box_of)?,
        ];
        let mut hidden = Tensor::f_cat(&input, 1)?;
        for layer in &self.cell {
            hidden = layer.forward(&hidden).f_relu()?;
        }
        pairs.apply(head, &self.out.forward(&hidden))
    }
}

/// Pairs of a box and a cell that it covers.
struct CoveredCells {
    /// `[K]`.
    box_of: Tensor,
    /// `[K]`.
    cell_of: Tensor,
    /// `[K, 1]`.
    share: Tensor,
    /// `[K, A, BOX_CODE]`: the box relative to the anchors of the cell.
    code: Tensor,
    /// The same relative to the head's own boxes.
    difference: Tensor,
    /// `[K, A (1 + BOX_CODE)]`: the head's own scores and boxes.
    own: Tensor,
}

impl CoveredCells {
    fn new(found: &BoxCells, head: &HeadOutput) -> Result<Self> {
        let device = head.scores.device();
        let [box_of, cell_of] = [&found.box_of, &found.cell_of]
            .map(|indices| Tensor::f_from_slice(indices)?.f_to_device(device));
        let cell_of = cell_of?;
        let anchors = head.scores.size4()?.1;
        let code = tensor(&found.code, &[-1, anchors, BOX_CODE as i64], device)?;
        let [scores, offsets] = [&head.scores, &head.offsets].map(|map| {
            let flat = map.f_detach()?.f_squeeze_dim(0)?.f_flatten(1, 2)?;
            flat.f_index_select(1, &cell_of)?.f_transpose(0, 1)
        });
        let (scores, offsets) = (scores?, offsets?);
        let difference = code.f_sub(&offsets.f_reshape(code.size())?)?;
        let turn = difference.f_narrow(2, YAW, 1)?;
        // A heading and its opposite are the same box.
        let turn = turn.f_sub(&((&turn / PI).f_round()? * PI))?;
        let difference = Tensor::f_cat(&[difference.f_narrow(2, 0, YAW)?, turn], 2)?;
        Ok(Self {
            box_of: box_of?,
            share: tensor(&found.share, &[-1, 1], device)?,
            own: Tensor::f_cat(&[scores, offsets], 1)?,
            cell_of,
            code,
            difference,
        })
    }

    /// The output of the head with `changes` `[K, A CHANGES + 1]`: of several boxes on a cell a weighted mean, in which
    /// the head's own output has the weight 1.
    fn apply(&self, head: HeadOutput, changes: &Tensor) -> Result<HeadOutput> {
        let (_, anchors, height, width) = head.scores.size4()?;
        // The last column is the logarithm of the weight of the whole box, those before it are by anchor.
        let last = anchors * CHANGES;
        let weight = changes
            .f_narrow(1, last, 1)?
            .f_clamp(-MAX_LOG_WEIGHT, MAX_LOG_WEIGHT)?
            .f_exp()?;
        let changes = changes
            .f_narrow(1, 0, last)?
            .f_view([-1, anchors, CHANGES])?;
        let [score, gate, own_box] = [
            (0, 1, [-MAX_LOGIT_CHANGE, MAX_LOGIT_CHANGE]),
            (1, 1, GATE_RANGE),
            (2, BOX_CODE as i64, [-MAX_OFFSET_CHANGE, MAX_OFFSET_CHANGE]),
        ]
        .map(|(first, count, [least, most])| {
            changes.f_narrow(2, first, count)?.f_clamp(least, most)
        });
        let gated = gate?.f_mul(&self.difference)?;
        let change = Tensor::f_cat(&[score?, own_box?.f_add(&gated)?], 2)?;
        let numbers = anchors * (1 + BOX_CODE as i64);
        let change = change.f_view([-1, numbers])?.f_mul(&weight)?;
        let options = (change.kind(), change.device());
        let [change, weight] = [(numbers, &change), (1, &weight)].map(|(count, values)| {
            Tensor::f_zeros([height * width, count], options)?.f_index_add(0, &self.cell_of, values)
        });
        // The head itself has change 0 and weight 1, so the denominator is at least 1 at every cell.
        let mean = change? / (weight? + 1.0);
        let mean = mean
            .f_view([height, width, anchors, 1 + BOX_CODE as i64])?
            .f_permute([2, 3, 0, 1])?;
        let HeadOutput { scores, offsets } = head;
        let score_change = mean.f_narrow(1, 0, 1)?.f_reshape(scores.size())?;
        let offset_change = mean.f_narrow(1, 1, BOX_CODE as i64)?;
        Ok(HeadOutput {
            scores: scores.f_add(&score_change)?,
            offsets: offsets.f_add(&offset_change.f_reshape(offsets.size())?)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    fn detector() -> DetectorConfig {
        DetectorConfig {
            lidar_range_m: [-8.0, -8.0, -3.0, 8.0, 8.0, 1.0],
            ..DetectorConfig::lean()
        }
    }

    fn map(detector: &DetectorConfig) -> Tensor {
        tch::manual_seed(3);
        let grid = detector.feature_grid();
        let size = [
            1,
            detector.feature_channels(),
            grid.height.into(),
            grid.width.into(),
        ];
        Tensor::rand(size, (Kind::Float, Device::Cpu))
    }

    fn random_output(detector: &DetectorConfig, channels: i64) -> Tensor {
        let grid = detector.feature_grid();
        let size = [1, channels, grid.height.into(), grid.width.into()];
        Tensor::randn(size, (Kind::Float, Device::Cpu))
    }

    fn head(detector: &DetectorConfig) -> HeadOutput {
        HeadOutput {
            scores: random_output(detector, 2),
            offsets: random_output(detector, 14),
        }
    }

    fn car(sender: usize) -> PlacedBox {
        PlacedBox {
            box3d: Box3d {
                center_m: [2.0, 0.8, -1.0],
                size_m: [4.0, 1.6, 1.5],
                heading_rad: 0.0,
            },
            sender,
            age_secs: 0.1,
            score: 0.7,
            pose_confidence: 1.0,
        }
    }

    fn copy(head: &HeadOutput) -> HeadOutput {
        HeadOutput {
            scores: head.scores.copy(),
            offsets: head.offsets.copy(),
        }
    }

    #[test]
    fn an_untrained_input_and_no_box_change_nothing() {
        let (variables, detector) = (VarStore::new(Device::Cpu), detector());
        let input = BoxInput::new(&variables.root(), &detector);
        let (map, before) = (map(&detector), head(&detector));
        let changed = |boxes: &[PlacedBox]| input.change(&map, copy(&before), boxes).unwrap();
        let untrained = changed(&[car(1)]);
        assert_eq!(untrained.scores, before.scores);
        assert_eq!(untrained.offsets, before.offsets);
        let _ = tch::no_grad(|| variables.variables()[WEIGHT].shallow_clone().fill_(0.5));
        assert_eq!(changed(&[]).scores, before.scores);
        let mut far = car(1);
        far.box3d.center_m = [1e6, 0.0, 0.0];
        assert_eq!(changed(&[far]).scores, before.scores);
    }

    #[test]
    fn a_trained_one_changes_the_covered_cells_only_in_any_order_of_boxes() {
        let (variables, detector) = (VarStore::new(Device::Cpu), detector());
        let input = BoxInput::new(&variables.root(), &detector);
        let (map, before) = (map(&detector), head(&detector));
        let _ = tch::no_grad(|| {
            variables.variables()[WEIGHT]
                .shallow_clone()
                .normal_(0.0, 0.1)
        });
        let boxes = [
            car(1),
            PlacedBox {
                score: 0.4,
                ..car(2)
            },
        ];
        let after = input.change(&map, copy(&before), &boxes).unwrap();
        let change = (&after.scores - &before.scores).abs().amax([0, 1], false);
        // The box covers columns 10 to 14 and rows 10 and 11.
        for (row, column) in [(10, 10), (11, 14)] {
            assert!(change.double_value(&[row, column]) > 1e-4, "{row} {column}");
        }
        for (row, column) in [(8, 12), (13, 12), (10, 8), (11, 16), (0, 0)] {
            assert_eq!(change.double_value(&[row, column]), 0.0, "{row} {column}");
        }
        let turned = input
            .change(&map, copy(&before), &[boxes[1], boxes[0]])
            .unwrap();
        let off = (&turned.offsets - &after.offsets).abs().max();
        assert!(off.double_value(&[]) < 1e-5);
    }

    #[test]
    fn whatever_is_received_and_learnt_the_changes_are_bounded() {
        let (variables, detector) = (VarStore::new(Device::Cpu), detector());
        let input = BoxInput::new(&variables.root(), &detector);
        let map = map(&detector);
        for (weight, size_m) in [(50.0, [1e3; 3]), (-50.0, [1e-3; 3])] {
            let _ = tch::no_grad(|| variables.variables()[WEIGHT].shallow_clone().fill_(weight));
            let mut strange = car(1);
            strange.box3d.size_m = size_m;
            let head = head(&detector);
            let nothing = HeadOutput {
                scores: head.scores.zeros_like(),
                offsets: head.offsets.zeros_like(),
            };
            let after = input.change(&map, nothing, &[strange]).unwrap();
            // Sizes of an anchor change by up to e^2.75, scores by as much as they can.
            let sizes = after.offsets.narrow(1, 3, 3).abs().max().double_value(&[]);
            assert!(sizes > 0.0 && sizes <= 2.75 + 1e-5, "{sizes}");
            assert!(after.scores.abs().max().double_value(&[]) <= MAX_LOGIT_CHANGE);
        }
    }

    #[test]
    fn a_gate_of_one_gives_the_box_of_the_neighbour() {
        let detector = detector();
        let before = head(&detector);
        let anchors = Anchors::for_detector(&detector);
        let found = BoxCells::new(&[car(1)], &detector.feature_grid(), &anchors);
        let pairs = CoveredCells::new(&found, &before).unwrap();
        let count = found.cell_of.len() as i64;
        let changes = Tensor::zeros([count, 2 * CHANGES + 1], (Kind::Float, Device::Cpu));
        for anchor in 0..2 {
            let _ = changes.narrow(1, anchor * CHANGES + 1, 1).fill_(1.0);
        }
        let _ = changes.narrow(1, 2 * CHANGES, 1).fill_(50.0);
        let after = pairs.apply(copy(&before), &changes).unwrap();
        let cell = found.cell_of[0];
        let at =
            |map: &Tensor, component: i64| map.flatten(2, 3).double_value(&[0, component, cell]);
        for component in 0..6 {
            let expected = f64::from(found.code[component as usize]);
            // The head's own output keeps a weight of 1 beside one of e^8.
            assert!((at(&after.offsets, component) - expected).abs() < 2e-3);
        }
        assert_eq!(at(&after.scores, 0), at(&before.scores, 0));
    }
}
