//! Raster of boxes: neighbours' detections as channels on the ego's grid.

use protocol::rotated_iou::Polygon;
use protocol::{BevGrid, Box3d, Detection, Pose};

/// Channels of the raster: share of the cell that a box covers, age, score and pose confidence, then the box as an anchor
/// of the head would encode it from this cell.
pub const CHANNELS: usize = 12;

/// Boxes that are drawn at most; those of low confidence are left out first.
const MAX_BOXES: usize = 256;
/// Length and width up to which a box is drawn, metres: larger than any vehicle, so that no sender's boxes take long.
const MAX_SIZE_M: [f64; 2] = [26.0, 5.0];
/// Size of a usual vehicle, metres: length, width, height.
const USUAL_M: [f64; 3] = [3.9, 1.6, 1.56];
/// Centre height of a usual vehicle in the ego's frame, metres.
const USUAL_Z_M: f64 = -1.0;

/// A neighbour's box in the frame of the ego.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedBox {
    /// The box.
    pub box3d: Box3d,
    /// Age relative to the ego's frame, seconds.
    pub age_secs: f64,
    /// Score of the detection, 0..1.
    pub score: f64,
    /// Confidence of the sender's pose, 0..1.
    pub pose_confidence: f64,
}

impl PlacedBox {
    fn confidence(&self) -> f64 {
        self.score * self.pose_confidence
    }
}

/// The detections of a sender in the frame of the ego; `pose_confidence` is that of its pose.
pub fn placed(
    detections: &[Detection],
    ego_from_cav: &Pose,
    age_secs: f64,
    pose_confidence: f64,
) -> Vec<PlacedBox> {
    let ego_from_cav = ego_from_cav.isometry();
    let place = |detection: &Detection| PlacedBox {
        box3d: detection.box3d.transformed(&ego_from_cav),
        age_secs,
        score: f64::from(detection.score),
        pose_confidence,
    };
    detections.iter().map(place).collect()
}

/// Draws boxes on `grid`: `[CHANNELS, H, W]`, row-major; zero where there is no box. Of several boxes on a cell the one
/// with the largest product of share, score and pose confidence is drawn.
pub fn draw(boxes: &[PlacedBox], grid: &BevGrid) -> Vec<f32> {
    let cells = grid.cells();
    let mut raster = vec![0.0; CHANNELS * cells];
    let mut strongest = vec![0.0; cells];
    let mut order: Vec<&PlacedBox> = boxes.iter().collect();
    order.sort_by(|a, b| b.confidence().total_cmp(&a.confidence()));
    for placed in order.into_iter().take(MAX_BOXES) {
        for (cell, center_m, share) in covered(&placed.box3d, grid) {
            let strength = share * placed.confidence();
            if strength > strongest[cell] {
                strongest[cell] = strength;
                for (channel, value) in values(placed, center_m, share).into_iter().enumerate() {
                    raster[channel * cells + cell] = value as f32;
                }
            }
        }
    }
    raster
}

/// The channels of a cell around `center_m`.
fn values(placed: &PlacedBox, center_m: [f64; 2], share: f64) -> [f64; CHANNELS] {
    let Box3d {
        center_m: [x, y, z],
        size_m,
        heading_rad,
    } = placed.box3d;
    let [length, width, height] = USUAL_M;
    let diagonal = length.hypot(width);
    // A heading and its opposite are the same box.
    let (sin, cos) = (2.0 * heading_rad).sin_cos();
    let size = |axis: usize| (size_m[axis].max(0.1) / USUAL_M[axis]).ln();
    [
        share,
        placed.age_secs.clamp(-1.0, 1.0),
        placed.score,
        placed.pose_confidence,
        (x - center_m[0]) / diagonal,
        (y - center_m[1]) / diagonal,
        ((z - USUAL_Z_M) / height).clamp(-2.0, 2.0),
        sin,
        cos,
        size(0),
        size(1),
        size(2),
    ]
}

/// The cells that the footprint of a box covers, within [`MAX_SIZE_M`]: index, centre in metres, and covered share.
fn covered(box3d: &Box3d, grid: &BevGrid) -> Vec<(usize, [f64; 2], f64)> {
    let mut drawn = *box3d;
    for (size_m, most_m) in drawn.size_m.iter_mut().zip(MAX_SIZE_M) {
        *size_m = size_m.min(most_m);
    }
    let corners = drawn.corners();
    let size = [i64::from(grid.width), i64::from(grid.height)];
    let low_m = [grid.x_min_m, grid.y_min_m];
    let range = |axis: usize| {
        let along = corners[..4].iter().map(|corner| corner[axis]);
        let (low, high) = along.fold((f64::MAX, f64::MIN), |(low, high), at| {
            (low.min(at), high.max(at))
        });
        let cell = |at: f64| ((at - low_m[axis]) / grid.cell_m).floor() as i64;
        cell(low).max(0)..cell(high).saturating_add(1).min(size[axis])
    };
    let (columns, rows) = (range(0), range(1));
    let footprint = Polygon::footprint(&corners);
    let mut found = Vec::new();
    for row in rows {
        for column in columns.clone() {
            let low = [column, row];
            let low: [f64; 2] =
                std::array::from_fn(|axis| low_m[axis] + low[axis] as f64 * grid.cell_m);
            let [x0, y0] = low;
            let [x1, y1] = low.map(|edge| edge + grid.cell_m);
            let cell = Polygon::new([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]);
            let share = footprint.intersection(&cell) / cell.area();
            if share > 0.0 {
                let center_m = low.map(|edge| edge + grid.cell_m / 2.0);
                found.push(((row * size[0] + column) as usize, center_m, share));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

    use proptest::prelude::*;

    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.8,
        width: 20,
        height: 10,
    };

    fn car(center_m: [f64; 3], heading_rad: f64) -> PlacedBox {
        PlacedBox {
            box3d: Box3d {
                center_m,
                size_m: [4.0, 1.6, 1.5],
                heading_rad,
            },
            age_secs: 0.2,
            score: 0.8,
            pose_confidence: 0.5,
        }
    }

    fn channel(raster: &[f32], channel: usize) -> &[f32] {
        &raster[channel * GRID.cells()..(channel + 1) * GRID.cells()]
    }

    /// Covered area, square metres.
    fn area_m2(raster: &[f32]) -> f64 {
        let shares = channel(raster, 0).iter();
        shares.map(|share| f64::from(*share)).sum::<f64>() * GRID.cell_m.powi(2)
    }

    #[test]
    fn no_box_draws_nothing() {
        assert!(draw(&[], &GRID).iter().all(|value| *value == 0.0));
    }

    #[test]
    fn a_box_on_cell_edges_fills_whole_cells() {
        // Five by two cells from column 10 and row 5 on.
        let raster = draw(&[car([2.0, 0.8, -1.0], 0.0)], &GRID);
        for row in 0..10 {
            for column in 0..20 {
                let is_in = (10..15).contains(&column) && (5..7).contains(&row);
                let share = channel(&raster, 0)[row * 20 + column];
                assert!((share - f32::from(u8::from(is_in))).abs() < 1e-6);
            }
        }
        let cell = 5 * 20 + 10;
        let at = |index: usize| f64::from(channel(&raster, index)[cell]);
        let diagonal = 3.9_f64.hypot(1.6);
        for (index, expected) in [
            (1, 0.2),
            (2, 0.8),
            (3, 0.5),
            (4, 1.6 / diagonal),
            (5, 0.4 / diagonal),
            (6, 0.0),
            (7, 0.0),
            (8, 1.0),
            (9, (4.0_f64 / 3.9).ln()),
        ] {
            assert!(
                (at(index) - expected).abs() < 1e-6,
                "{index}: {}",
                at(index)
            );
        }
    }

    #[test]
    fn a_turned_box_covers_its_area_in_partial_cells() {
        for heading_rad in [0.3, FRAC_PI_4, FRAC_PI_2, -2.0] {
            let raster = draw(&[car([0.3, -0.2, -1.0], heading_rad)], &GRID);
            assert!((area_m2(&raster) - 6.4).abs() < 1e-4, "{heading_rad}");
            let shares = channel(&raster, 0).iter();
            assert!(
                shares
                    .filter(|share| **share > 0.01 && **share < 0.99)
                    .count()
                    > 4
            );
        }
        let [ahead, back] = [0.4, 0.4 + PI].map(|heading| draw(&[car([0.0; 3], heading)], &GRID));
        let off = ahead.iter().zip(&back).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 1e-5, "the opposite heading");
    }

    #[test]
    fn a_box_at_the_edge_is_cut_and_one_outside_is_not_drawn() {
        let raster = draw(&[car([8.0, 0.0, -1.0], 0.0)], &GRID);
        assert!((area_m2(&raster) - 3.2).abs() < 1e-5);
        for far in [[30.0, 0.0, 0.0], [0.0, -50.0, 0.0], [1e7, 1e7, 0.0]] {
            assert!(area_m2(&draw(&[car(far, 0.5)], &GRID)) < 1e-9);
        }
        // A box of impossible size is drawn as the largest one.
        let [endless, largest] = [[1e3, 1e3], [26.0, 5.0]].map(|[length, width]| {
            let mut long = car([0.0; 3], 0.3);
            long.box3d.size_m = [length, width, 1.5];
            area_m2(&draw(&[long], &GRID))
        });
        assert!(largest > 30.0 && endless == largest);
    }

    #[test]
    fn the_more_confident_of_two_boxes_is_drawn_in_any_order() {
        let weak = PlacedBox {
            score: 0.3,
            ..car([2.0, 0.8, -1.0], 0.0)
        };
        let strong = car([2.0, 0.8, -1.0], 0.0);
        let raster = draw(&[weak, strong], &GRID);
        assert_eq!(raster, draw(&[strong, weak], &GRID));
        assert_eq!(raster, draw(&[strong], &GRID));
    }

    #[test]
    fn boxes_are_placed_by_the_pose_of_their_sender() {
        let detection = Detection {
            box3d: car([4.0, 0.0, -1.0], 0.0).box3d,
            score: 0.8,
            source: None,
        };
        let pose = Pose::from_xyz_yaw([1.0, 2.0, 0.0], FRAC_PI_2);
        let [placed] = placed(&[detection], &pose, 0.2, 0.5)[..] else {
            panic!("one box");
        };
        let [x, y, _] = placed.box3d.center_m;
        assert!((x - 1.0).abs() < 1e-9 && (y - 6.0).abs() < 1e-9);
        assert!((placed.box3d.heading_rad - FRAC_PI_2).abs() < 1e-9);
    }

    proptest! {
        /// Whatever a message may hold is drawn in bounded time as finite numbers.
        #[test]
        fn any_box_is_drawn(
            center_m in prop::array::uniform3(-1e7_f64..1e7), size_m in prop::array::uniform3(1e-3_f64..1e3),
            heading_rad in -1e3_f64..1e3, score in 0.0_f64..1.0, near in any::<bool>(),
        ) {
            let center_m = if near { center_m.map(|at| at * 1e-6) } else { center_m };
            let found = PlacedBox { box3d: Box3d { center_m, size_m, heading_rad }, score, ..car([0.0; 3], 0.0) };
            prop_assert!(draw(&[found; 3], &GRID).iter().all(|value| value.is_finite()));
        }
    }
}
