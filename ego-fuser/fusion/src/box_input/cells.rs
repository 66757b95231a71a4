//! Cells of boxes: the cells of the ego's grid that each box covers, and the box as the anchors there encode it.

use perception::boxes::anchors::Anchors;
use perception::boxes::roi::{MAX_LOG_RATIO, shape, within_quarter_turn};
use protocol::rotated_iou::Polygon;
use protocol::{BevGrid, Box3d};

use super::placed::{PlacedBox, support};
use crate::targets::{BOX_CODE, encode};

/// Length and width up to which a box covers cells, metres: larger than any vehicle, so that no sender's boxes take long.
const MAX_SIZE_M: [f64; 2] = [26.0, 5.0];
/// Numbers that describe a box.
pub(super) const VALUES: usize = 11;

/// Boxes and the cells that they cover.
#[derive(Debug, Default)]
pub(super) struct BoxCells {
    /// `[N, VALUES]`: age, score, pose confidence, support by other senders, distance, height,
    /// logarithms of sizes, sine and cosine of twice the heading.
    pub(super) values: Vec<f32>,
    /// `[K]`: box of each pair of box and cell.
    pub(super) box_of: Vec<i64>,
    /// `[K]`: cell of each pair.
    pub(super) cell_of: Vec<i64>,
    /// `[K]`: share of the cell that the box covers.
    pub(super) share: Vec<f32>,
    /// `[K, A, BOX_CODE]`: the box relative to the anchors of the cell.
    pub(super) code: Vec<f32>,
}

impl BoxCells {
    /// Those of `boxes` on `grid`.
    pub(super) fn new(boxes: &[PlacedBox], grid: &BevGrid, anchors: &Anchors) -> Self {
        let mut cells = Self::default();
        for ((placed, support), index) in boxes.iter().zip(support(boxes)).zip(0..) {
            cells.values.extend(values(placed, support, anchors));
            for (cell, share) in covered(&placed.box3d, grid) {
                cells.box_of.push(index);
                cells.cell_of.push(cell as i64);
                cells.share.push(share as f32);
                for anchor in 0..anchors.yaws_rad.len() {
                    let anchor = anchors.box_at(cell * anchors.yaws_rad.len() + anchor);
                    cells.code.extend(code(&placed.box3d, &anchor));
                }
            }
        }
        cells
    }
}

/// The numbers of a box that are the same in all its cells.
fn values(placed: &PlacedBox, support: f64, anchors: &Anchors) -> [f32; VALUES] {
    let [x, y, z] = placed.box3d.center_m;
    let [_, _, height] = anchors.size_lwh_m;
    let [length, width, high, sin, cos] = shape(&placed.box3d, anchors.size_lwh_m);
    [
        // Bounded, since a neighbour may state a box of any age, place and height.
        placed.age_secs.clamp(-1.0, 1.0),
        placed.score,
        placed.pose_confidence,
        support,
        (x.hypot(y) / 50.0).min(2.0),
        ((z - anchors.z_m) / height).clamp(-2.0, 2.0),
        length,
        width,
        high,
        sin,
        cos,
    ]
    .map(|value| value as f32)
}

/// The box relative to an anchor, within the limits of what boxes of vehicles need.
fn code(box3d: &Box3d, anchor: &Box3d) -> [f32; BOX_CODE] {
    let [x, y, z, logs @ .., yaw] = encode(box3d, anchor);
    let [height, width, length] = logs.map(|log| log.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO));
    [
        x,
        y,
        z.clamp(-2.0, 2.0),
        height,
        width,
        length,
        within_quarter_turn(yaw),
    ]
    .map(|value| value as f32)
}

/// The cells that the footprint of a box covers, within [`MAX_SIZE_M`]: index and covered share.
fn covered(box3d: &Box3d, grid: &BevGrid) -> Vec<(usize, f64)> {
    let mut seen = *box3d;
    for (size_m, most_m) in seen.size_m.iter_mut().zip(MAX_SIZE_M) {
        *size_m = size_m.min(most_m);
    }
    let corners = seen.corners();
    let size = [i64::from(grid.width), i64::from(grid.height)];
    let low_m = [grid.x_min_m, grid.y_min_m];
    let [columns, rows] = [0, 1].map(|axis: usize| {
        // The first four corners are the bottom face.
        let along = corners[..4].iter().map(|corner| corner[axis]);
        let (low, high) = along.fold((f64::MAX, f64::MIN), |(low, high), at| {
            (low.min(at), high.max(at))
        });
        // Casts saturate, and the range is half-open: a box beyond the grid, or one of NaN, covers no cells.
        let [first, last] =
            [low, high].map(|at: f64| ((at - low_m[axis]) / grid.cell_m).floor() as i64);
        first.max(0)..last.saturating_add(1).min(size[axis])
    });
    let footprint = Polygon::footprint(&corners);
    let mut found = Vec::new();
    for row in rows {
        for column in columns.clone() {
            let [x0, y0] = [(low_m[0], column), (low_m[1], row)]
                .map(|(low_m, cell)| low_m + cell as f64 * grid.cell_m);
            let [x1, y1] = [x0, y0].map(|edge| edge + grid.cell_m);
            let cell = Polygon::new([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]);
            let share = footprint.intersection(&cell) / cell.area();
            if share > 0.0 {
                found.push(((row * size[0] + column) as usize, share));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};

    use perception::boxes::decode::decode_box;
    use perception::model_config::DetectorConfig;
    use proptest::prelude::*;

    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.8,
        width: 20,
        height: 10,
    };

    fn anchors() -> Anchors {
        let config = DetectorConfig {
            lidar_range_m: [-8.0, -4.0, -3.0, 8.0, 4.0, 1.0],
            ..DetectorConfig::lean()
        };
        Anchors::for_detector(&config)
    }

    fn car(center_m: [f64; 3], heading_rad: f64) -> PlacedBox {
        PlacedBox {
            box3d: Box3d {
                center_m,
                size_m: [4.0, 1.6, 1.5],
                heading_rad,
            },
            sender: 1,
            age_secs: 0.2,
            score: 0.8,
            pose_confidence: 0.5,
        }
    }

    /// Covered area, square metres.
    fn area_m2(placed: &PlacedBox) -> f64 {
        let shares = covered(&placed.box3d, &GRID);
        shares.iter().map(|(_, share)| share).sum::<f64>() * GRID.cell_m.powi(2)
    }

    #[test]
    fn a_box_on_cell_edges_covers_whole_cells() {
        // Five by two cells from column 10 and row 5 on.
        let found = covered(&car([2.0, 0.8, -1.0], 0.0).box3d, &GRID);
        let cells: Vec<usize> = (5..7)
            .flat_map(|row| (10..15).map(move |column| row * 20 + column))
            .collect();
        let whole = found.iter().filter(|(_, share)| *share > 1e-6);
        let whole: Vec<usize> = whole
            .map(|(cell, share)| {
                assert!((share - 1.0).abs() < 1e-6);
                *cell
            })
            .collect();
        assert_eq!(whole, cells);
    }

    #[test]
    fn a_turned_box_covers_its_area_in_partial_cells() {
        for heading_rad in [0.3, FRAC_PI_4, FRAC_PI_2, -2.0] {
            let turned = car([0.3, -0.2, -1.0], heading_rad);
            assert!((area_m2(&turned) - 6.4).abs() < 1e-4, "{heading_rad}");
            let shares = covered(&turned.box3d, &GRID);
            let partial = shares
                .iter()
                .filter(|(_, share)| (0.01..0.99).contains(share));
            assert!(partial.count() > 4);
        }
    }

    #[test]
    fn a_box_at_the_edge_is_cut_and_one_outside_covers_nothing() {
        assert!((area_m2(&car([8.0, 0.0, -1.0], 0.0)) - 3.2).abs() < 1e-5);
        for far in [[30.0, 0.0, 0.0], [0.0, -50.0, 0.0], [1e7, 1e7, 0.0]] {
            assert!(area_m2(&car(far, 0.5)) < 1e-9);
        }
        // A box of impossible size covers what the largest one covers.
        let [endless, largest] = [[1e3, 1e3], [26.0, 5.0]].map(|[length, width]| {
            let mut long = car([0.0; 3], 0.3);
            long.box3d.size_m = [length, width, 1.5];
            area_m2(&long)
        });
        assert!(largest > 30.0 && endless == largest);
    }

    #[test]
    fn every_anchor_decodes_its_code_to_the_box() {
        let anchors = anchors();
        let placed = car([1.3, -0.7, -1.2], 2.8);
        let cells = BoxCells::new(&[placed], &GRID, &anchors);
        assert_eq!(cells.code.len(), cells.cell_of.len() * 2 * BOX_CODE);
        for (index, code) in cells.code.chunks_exact(BOX_CODE).enumerate() {
            let anchor = cells.cell_of[index / 2] as usize * 2 + index % 2;
            let code = std::array::from_fn(|component| code[component]);
            let found = decode_box(code, &anchors.box_at(anchor)).unwrap();
            for axis in 0..3 {
                assert!((found.center_m[axis] - placed.box3d.center_m[axis]).abs() < 1e-5);
                assert!((found.size_m[axis] - placed.box3d.size_m[axis]).abs() < 1e-5);
            }
            assert!((found.heading_rad - 2.8).sin().abs() < 1e-5);
            assert!(code[6].abs() < 1.6);
        }
    }

    proptest! {
        /// Whatever a message may hold is read in bounded time as finite numbers.
        #[test]
        fn any_box_has_finite_numbers(
            center_m in prop::array::uniform3(-1e7_f64..1e7), size_m in prop::array::uniform3(1e-3_f64..1e3),
            heading_rad in -1e3_f64..1e3, score in 0.0_f64..1.0, near in any::<bool>(),
        ) {
            let center_m = if near { center_m.map(|at| at * 1e-6) } else { center_m };
            let found = PlacedBox { box3d: Box3d { center_m, size_m, heading_rad }, score, ..car([0.0; 3], 0.0) };
            let cells = BoxCells::new(&[found; 3], &GRID, &anchors());
            prop_assert!(cells.values.iter().chain(&cells.code).all(|value| value.is_finite()));
            prop_assert!(cells.cell_of.iter().all(|cell| (0..200).contains(cell)));
        }
    }
}
