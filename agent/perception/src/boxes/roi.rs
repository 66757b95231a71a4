//! RoI encoder: features of a region of interest, the feature map in and around a box, sampled along the axes of the box.
//!
//! As the second stage of PV-RCNN and CenterPoint does from the points of a grid or the faces of a box.

use std::f64::consts::PI;

use protocol::{BevGrid, Box3d};
use tch::nn::{self, Module};
use tch::{Result, Tensor};

use crate::model_config::DetectorConfig;
use crate::tensor_values::tensor;

/// Sampling positions along and across a box, as shares of its half length and half width.
const ALONG: [f64; 5] = [-1.5, -0.75, 0.0, 0.75, 1.5];
const ACROSS: [f64; 3] = [-1.8, 0.0, 1.8];
/// Number of sampling positions of a box.
const POSITIONS: usize = ALONG.len() * ACROSS.len();
/// Length and width up to which a box is sampled, metres: larger than any vehicle.
const MAX_SIZE_M: [f64; 2] = [26.0, 5.0];
/// Channels to which the map is reduced at each position.
const REDUCED: i64 = 24;
/// Largest logarithm of the ratio of a size to a usual one: 4.5 times as long.
pub const MAX_LOG_RATIO: f64 = 1.5;
/// Channels of the output.
pub const CHANNELS: i64 = 96;

/// Network that encodes the map in and around boxes.
#[derive(Debug)]
pub struct RoiEncoder {
    reduce: nn::Linear,
    layers: [nn::Linear; 2],
    grid: BevGrid,
}

impl RoiEncoder {
    /// For maps of a detector, and `values` numbers of each box; its variables are below `path`.
    pub fn new(path: &nn::Path<'_>, detector: &DetectorConfig, values: usize) -> Self {
        let (channels, usual) = (detector.feature_channels(), nn::LinearConfig::default());
        let read = POSITIONS as i64 * REDUCED + values as i64;
        Self {
            reduce: nn::linear(path / "reduce", channels, REDUCED, usual),
            layers: [
                nn::linear(path / "around", read, CHANNELS, usual),
                nn::linear(path / "box", CHANNELS, CHANNELS, usual),
            ],
            grid: detector.feature_grid(),
        }
    }

    /// `[N, CHANNELS]` of boxes in the frame of a map `[1, C, H, W]`, and their values `[N, values]`. Gradients flow to its
    /// own variables only.
    ///
    /// # Errors
    /// [`tch::TchError`] when the map is of another shape.
    pub fn forward(&self, map: &Tensor, boxes: &[Box3d], values: &Tensor) -> Result<Tensor> {
        let read = read(map, boxes, &self.grid)?;
        let reduced = self.reduce.forward(&read).f_relu()?;
        let reduced = reduced.f_view([-1, POSITIONS as i64 * REDUCED])?;
        let mut hidden = Tensor::f_cat(&[&reduced, values], 1)?;
        for layer in &self.layers {
            hidden = layer.forward(&hidden).f_relu()?;
        }
        Ok(hidden)
    }
}

/// `[N * POSITIONS, C]`: the map at the sampling positions of each box, bilinear between cells; zeros beyond its edges.
fn read(map: &Tensor, boxes: &[Box3d], grid: &BevGrid) -> Result<Tensor> {
    let [width_m, height_m] = [grid.width, grid.height].map(|cells| grid.cell_m * f64::from(cells));
    let positions = boxes.iter().flat_map(sampling_positions);
    let positions = positions.flat_map(|[x_m, y_m]| {
        let x = normalised(x_m - grid.x_min_m, width_m);
        // x comes first, although the map is `[1, C, H, W]`.
        [x, normalised(y_m - grid.y_min_m, height_m)]
    });
    let positions: Vec<f32> = positions.collect();
    let positions = tensor(&positions, &[1, -1, 1, 2], map.device())?;
    // Bilinear between the cells, zeros beyond them.
    // Without aligned corners: -1 and 1 are the outer edges of the outer cells.
    let sampled = map.f_detach()?.f_grid_sampler(&positions, 0, 0, false)?;
    sampled.f_view([map.size4()?.1, -1])?.f_transpose(0, 1)
}

/// From -1 to 1 over the extent of the map, as `grid_sampler` takes positions.
fn normalised(from_edge_m: f64, extent_m: f64) -> f32 {
    (2.0 * from_edge_m / extent_m - 1.0) as f32
}

/// Sampling positions of a box: x and y in the frame of the map, metres.
fn sampling_positions(box3d: &Box3d) -> impl Iterator<Item = [f64; 2]> + use<> {
    let (sin, cos) = box3d.heading_rad.sin_cos();
    let [x_m, y_m, _] = box3d.center_m;
    let [half_length_m, half_width_m] =
        [0, 1].map(|axis| box3d.size_m[axis].min(MAX_SIZE_M[axis]) / 2.0);
    ALONG.into_iter().flat_map(move |along| {
        ACROSS.into_iter().map(move |across| {
            let (along_m, across_m) = (along * half_length_m, across * half_width_m);
            [
                x_m + cos * along_m - sin * across_m,
                y_m + sin * along_m + cos * across_m,
            ]
        })
    })
}

/// Shape of a box relative to a usual size, which is length, width and height in metres: logarithms of the size ratios, at
/// most [`MAX_LOG_RATIO`] in magnitude, then sine and cosine of twice the heading. A heading and its opposite are the same
/// box.
pub fn shape(box3d: &Box3d, usual_m: [f64; 3]) -> [f64; 5] {
    let [length, width, height] = [0, 1, 2].map(|axis: usize| {
        let ratio = box3d.size_m[axis] / usual_m[axis];
        ratio.ln().clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
    });
    let (sin, cos) = (2.0 * box3d.heading_rad).sin_cos();
    [length, width, height, sin, cos]
}

/// An angle within a quarter turn of zero, radians, up to half turns.
pub fn within_quarter_turn(angle_rad: f64) -> f64 {
    angle_rad - PI * (angle_rad / PI).round()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use tch::{Device, Kind};

    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.8,
        width: 20,
        height: 10,
    };

    fn car(center_m: [f64; 3], heading_rad: f64) -> Box3d {
        Box3d {
            center_m,
            size_m: [4.0, 1.6, 1.5],
            heading_rad,
        }
    }

    #[test]
    fn sampling_positions_lie_along_the_axes_of_the_box() {
        let found: Vec<[f64; 2]> = sampling_positions(&car([0.0, 0.0, -1.0], FRAC_PI_2)).collect();
        assert_eq!(found.len(), POSITIONS);
        // The first is behind and to the right: turned by 90 degrees right is +x and behind is -y.
        let [x_m, y_m] = found[0];
        assert!((x_m - 1.44).abs() < 1e-9 && (y_m + 3.0).abs() < 1e-9);
        let [x_m, y_m] = found[POSITIONS / 2];
        assert!(x_m.abs() < 1e-9 && y_m.abs() < 1e-9);
    }

    /// Centres of a number of cells along an axis, metres.
    fn centres_m(count: i64, low_m: f64) -> Tensor {
        Tensor::arange(count, (Kind::Float, Device::Cpu)) * 0.8 + low_m + 0.4
    }

    #[test]
    fn a_map_is_read_between_its_cells_and_as_zeros_beyond_its_edges() {
        // Two channels: x and y of the centres of the cells.
        let x = centres_m(20, -8.0)
            .view([1, 1, 1, 20])
            .expand([1, 1, 10, 20], true);
        let y = centres_m(10, -4.0)
            .view([1, 1, 10, 1])
            .expand([1, 1, 10, 20], true);
        let map = Tensor::cat(&[x, y], 1);
        let inside = car([0.33, -0.21, 0.0], 0.4);
        let found = read(&map, &[inside], &GRID).unwrap();
        for (index, [x_m, y_m]) in (0..).zip(sampling_positions(&inside)) {
            assert!((found.double_value(&[index, 0]) - x_m).abs() < 1e-5);
            assert!((found.double_value(&[index, 1]) - y_m).abs() < 1e-5);
        }
        for far in [[100.0, 0.0, 0.0], [1e7, -1e7, 0.0]] {
            let found = read(&map, &[car(far, 0.4)], &GRID).unwrap();
            assert_eq!(found.abs().max().double_value(&[]), 0.0);
        }
    }
}
