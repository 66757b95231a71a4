//! Observation: content of one vehicle's message, evaluated separately and in its own frame.

use nalgebra::Point2;
use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::detector::{Detector, DetectorError};
use perception::model_config::YAxis;
use protocol::{BevGrid, Box3d};
use tch::Tensor;

use super::fingerprint::Fingerprint;
use crate::view::Content;

/// Boxes below this score are no evidence about their sender.
const SURE: f32 = 0.3;
/// Boxes at or below this score are no evidence for or against their sender. It is independent of the boxes that are
/// scored.
const EVIDENT: f32 = 0.2;
/// Range of a detector when there is no map that gives it, metres.
const REACH_M: f64 = 35.0;

/// Content of a message.
#[derive(Debug)]
pub(super) struct SeenMessage {
    /// Confidently detected vehicles.
    pub(super) vehicles: Vec<Box3d>,
    /// Confidence of the head in a vehicle at each cell; or all boxes and their scores, where there are boxes only.
    sure: Sure,
    /// Enough values to detect a copy.
    pub(super) fingerprint: Fingerprint,
    /// True for points that contain no vehicle.
    pub(super) is_blind: bool,
    /// The map, `[C, H, W]`; empty where there are boxes only.
    pub(super) map: Vec<f32>,
}

#[derive(Debug)]
enum Sure {
    /// `None` for cells that were not sent.
    Cells(BevGrid, Vec<Option<f32>>),
    Boxes(Vec<(Box3d, f32)>),
}

impl SeenMessage {
    /// Evaluates a message; `empty` is the map of an empty world, `[C, H, W]`. Points are encoded for it.
    pub(super) fn in_message(
        content: &Content,
        detector: &mut Detector,
        empty: &[f32],
    ) -> Result<Self, DetectorError> {
        match content {
            Content::Features(map) => {
                let received = detector.received(map)?;
                Self::in_map(&received, map.sent.as_deref(), detector, empty)
            }
            Content::Boxes(_) => {
                let evident = content.detections().filter(|found| found.score > EVIDENT);
                let boxes = evident.map(|found| (found.box3d, found.score));
                Ok(Self::of_boxes(boxes.collect()))
            }
            Content::Points(points) => {
                let encoded = detector.encode(points)?.features;
                let map = detector.through_compressor(&encoded)?;
                let mut seen = Self::in_map(&map, None, detector, empty)?;
                seen.is_blind = seen.vehicles.is_empty();
                Ok(seen)
            }
        }
    }

    /// [`Self::in_message`] of a neighbour: a map from which the head makes values or boxes of no detector is evidence
    /// against its sender only.
    pub(super) fn of_neighbour(
        content: &Content,
        detector: &mut Detector,
        empty: &[f32],
    ) -> Result<Self, DetectorError> {
        match Self::in_message(content, detector, empty) {
            Err(DetectorError::Values { .. } | DetectorError::Box(_)) => Ok(Self {
                map: vec![f32::INFINITY],
                ..Self::of_boxes(Vec::new())
            }),
            seen => seen,
        }
    }

    pub(super) fn of_boxes(all: Vec<(Box3d, f32)>) -> Self {
        let sure = all.iter().filter(|(_, score)| *score >= SURE);
        let values = all.iter().flat_map(|(found, score)| {
            let [x, y, _] = found.center_m;
            [x as f32, y as f32, *score]
        });
        Self {
            vehicles: sure.map(|(found, _)| *found).collect(),
            fingerprint: Fingerprint::of_values(values.collect()),
            sure: Sure::Boxes(all),
            is_blind: false,
            map: Vec::new(),
        }
    }

    /// From a map `[1, C, H, W]`, of which the `sent` cells were received; all where absent.
    fn in_map(
        map: &Tensor,
        sent: Option<&[bool]>,
        detector: &Detector,
        empty: &[f32],
    ) -> Result<Self, DetectorError> {
        let grid = detector.grid();
        let heads = detector.heads(map)?;
        let limits = PostprocessConfig {
            score_threshold: SURE,
            ..PostprocessConfig::for_late_fusion(detector.config())
        };
        let cells = known_cells(detector, &heads.confidence, sent);
        let boxes = detector.boxes(&heads, SURE)?;
        let mut found = Vec::new();
        for detection in detections(&boxes, &limits) {
            let [x, y, _] = detection.box3d.center_m;
            // Cells that were not sent have no features that a head can interpret.
            if cell_of(&grid, x, y).is_none_or(|cell| cells[cell].is_some()) {
                found.push((detection.box3d, detection.score));
            }
        }
        let values: Vec<f32> = Vec::try_from(&map.f_contiguous()?.f_view([-1])?)?;
        let mut seen = Self {
            fingerprint: Fingerprint::of_map(&values, empty, grid.cells(), sent),
            map: values,
            ..Self::of_boxes(found)
        };
        // Boxes say enough of a whole map of a mirrored network.
        if detector.config().y_axis == YAxis::Left || sent.is_some() {
            seen.sure = Sure::Cells(grid, cells);
        }
        Ok(seen)
    }

    /// True if only boxes are known: a place without one may then be empty or merely uncertain.
    pub(super) fn is_boxes(&self) -> bool {
        matches!(self.sure, Sure::Boxes(_))
    }

    /// Confidence of the detector in a vehicle within `radius_m` of a position, 0..1; `None` outside its range, and where
    /// no cell was sent: a place that is not sent is not empty.
    pub(super) fn sure_at(&self, at_m: [f64; 2], radius_m: f64) -> Option<f32> {
        match &self.sure {
            Sure::Cells(grid, cells) => {
                let near = around(grid, at_m, radius_m);
                near.filter_map(|cell| cells[cell]).reduce(f32::max)
            }
            Sure::Boxes(_) if at_m[0].hypot(at_m[1]) > REACH_M => None,
            Sure::Boxes(all) => {
                let at = Point2::from(at_m);
                let near = all
                    .iter()
                    .filter(|(found, _)| (place(found) - at).norm() <= radius_m);
                Some(near.map(|(_, score)| *score).fold(0.0, f32::max))
            }
        }
    }
}

/// Place of a box seen from above, metres.
pub(super) fn place(found: &Box3d) -> Point2<f64> {
    let [x, y, _] = found.center_m;
    Point2::new(x, y)
}

/// Confidence of each cell in the vehicle's frame, `None` where it was not sent: the rows of a mirrored network are in
/// reverse order.
fn known_cells(detector: &Detector, confidence: &[f32], sent: Option<&[bool]>) -> Vec<Option<f32>> {
    let known = confidence.iter().enumerate();
    let known = known.map(|(cell, sure)| sent.is_none_or(|sent| sent[cell]).then_some(*sure));
    let mut cells: Vec<Option<f32>> = known.collect();
    if detector.config().y_axis == YAxis::Right {
        let rows = cells.chunks(detector.grid().width as usize).rev();
        cells = rows.flatten().copied().collect();
    }
    cells
}

/// The cell of a grid that contains a point.
fn cell_of(grid: &BevGrid, x_m: f64, y_m: f64) -> Option<usize> {
    let column = ((x_m - grid.x_min_m) / grid.cell_m).floor();
    let row = ((y_m - grid.y_min_m) / grid.cell_m).floor();
    let inside = (0.0..f64::from(grid.width)).contains(&column)
        && (0.0..f64::from(grid.height)).contains(&row);
    inside.then(|| row as usize * grid.width as usize + column as usize)
}

/// The cells of a grid whose centres lie within a radius; none for a position outside.
fn around(grid: &BevGrid, [x, y]: [f64; 2], radius_m: f64) -> impl Iterator<Item = usize> + use<> {
    let grid = *grid;
    let reach = (radius_m / grid.cell_m).ceil() as i64;
    let inside = cell_of(&grid, x, y).is_some();
    let offsets = (-reach..=reach).flat_map(move |down| {
        (-reach..=reach).map(move |right| [down, right].map(|step| step as f64 * grid.cell_m))
    });
    offsets
        .filter(move |[down, right]| inside && down.hypot(*right) <= radius_m)
        .filter_map(move |[down, right]| cell_of(&grid, x + right, y + down))
}

#[cfg(test)]
mod tests {
    use perception::model_config::DetectorConfig;
    use perception::pillars::point_pillars::PointPillars;
    use protocol::{DecodedFeatures, Detection};
    use tch::nn::VarStore;

    use super::*;

    impl SeenMessage {
        pub(in crate::misbehaviour) fn of_cells(grid: BevGrid, sure: Vec<Option<f32>>) -> Self {
            Self {
                sure: Sure::Cells(grid, sure),
                ..Self::of_boxes(Vec::new())
            }
        }
    }

    fn detector(y_axis: YAxis) -> Detector {
        let network = VarStore::new(tch::Device::Cpu);
        let config = DetectorConfig {
            lidar_range_m: [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0],
            y_axis,
            ..DetectorConfig::lean()
        };
        Detector::from_network(PointPillars::new(&network.root(), &config).unwrap())
    }

    #[test]
    fn cells_that_were_not_sent_are_not_empty() {
        for (y_axis, sent_y_m) in [(YAxis::Left, -3.0), (YAxis::Right, 3.0)] {
            let mut detector = detector(y_axis);
            let [channels, height, width] = detector.sent_shape();
            let map = Tensor::zeros(
                [1, channels, height, width],
                (tch::Kind::Float, tch::Device::Cpu),
            );
            let features = detector.to_message(&map).unwrap();
            let (cells, empty) = (features.grid.cells(), features.values.clone());
            // The rows that the network has at negative y.
            let sent = Some((0..cells).map(|cell| cell < cells / 2).collect());
            let content = Content::Features(DecodedFeatures { features, sent });
            let seen = SeenMessage::in_message(&content, &mut detector, &empty).unwrap();
            assert!(seen.sure_at([4.0, sent_y_m], 1.0).is_some(), "{y_axis:?}");
            assert_eq!(seen.sure_at([4.0, -sent_y_m], 1.0), None, "{y_axis:?}");
        }
    }

    #[test]
    fn cells_around_a_place_are_found_and_none_outside() {
        let grid = BevGrid {
            x_min_m: -4.0,
            y_min_m: -2.0,
            cell_m: 0.5,
            width: 16,
            height: 8,
        };
        assert_eq!(cell_of(&grid, -3.9, -1.9), Some(0));
        assert_eq!(cell_of(&grid, 3.9, 1.9), Some(127));
        assert_eq!(around(&grid, [0.1, 0.1], 0.5).count(), 5);
        assert_eq!(around(&grid, [9.0, 0.0], 6.0).count(), 0);
        let mut sure = vec![Some(0.0); 128];
        sure[cell_of(&grid, 1.2, 0.7).unwrap()] = Some(0.8);
        let seen = SeenMessage::of_cells(grid, sure);
        assert_eq!(seen.sure_at([1.0, 0.5], 1.0), Some(0.8));
        assert_eq!(seen.sure_at([-2.0, 0.5], 1.0), Some(0.0));
        assert_eq!(seen.sure_at([20.0, 0.5], 1.0), None);
    }

    #[test]
    fn boxes_that_are_judged_but_hardly_seen_are_no_evidence() {
        let mut detector = detector(YAxis::Left);
        let found = [(4.0, 0.7), (8.0, 0.25), (12.0, 0.15)].map(|(x, score)| Detection {
            box3d: Box3d {
                center_m: [x, 0.0, -1.0],
                size_m: [4.4, 1.9, 1.6],
                heading_rad: 0.0,
            },
            score,
            source: None,
        });
        let seen = SeenMessage::in_message(
            &Content::Boxes(found.clone().map(Into::into).to_vec()),
            &mut detector,
            &[],
        )
        .unwrap();
        assert_eq!(seen.vehicles, [found[0].box3d]);
        assert_eq!(
            (
                seen.sure_at([8.0, 0.0], 1.0),
                seen.sure_at([12.0, 0.0], 1.0)
            ),
            (Some(0.25), Some(0.0))
        );
        let expected = Fingerprint::of_values(vec![4.0, 0.0, 0.7, 8.0, 0.0, 0.25]);
        assert_eq!(seen.fingerprint, expected);
    }
}
