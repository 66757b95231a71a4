//! Grid index over the points of a sweep: a box tests only the points near it.

use nalgebra::{Isometry3, Point3};
use protocol::PointCloud;

/// Width of a cell, metres: about that of a car.
const CELL_M: f32 = 4.0;
/// Cells on each side of the sensor; points beyond are in the outermost.
const CELLS: usize = 40;
const ACROSS: usize = 2 * CELLS;

/// The points of a sweep, sorted by cell.
pub(crate) struct PointCells {
    points: Vec<[f32; 3]>,
    /// Start of the points of each cell, and the end of the last.
    begins: Vec<usize>,
}

#[expect(
    clippy::indexing_slicing,
    reason = "columns and rows are below ACROSS, begins has one for each cell and the end, axes are 0 to 2"
)]
impl PointCells {
    pub(crate) fn new(cloud: &PointCloud) -> Self {
        let mut begins = vec![0; ACROSS * ACROSS + 1];
        for point in &cloud.xyzi {
            // Step: counting sort. One place behind, so that the sums are the beginnings.
            begins[cell_of(point) + 1] += 1;
        }
        for cell in 1..begins.len() {
            begins[cell] += begins[cell - 1];
        }
        let mut ends = begins.clone();
        let mut points = vec![[0.0; 3]; cloud.len()];
        for point in &cloud.xyzi {
            let end = &mut ends[cell_of(point)];
            points[*end] = [point[0], point[1], point[2]];
            *end += 1;
        }
        Self { points, begins }
    }

    /// The points in a box, in its frame, once x and y of the points are multiplied by the signs; other arguments are
    /// its transform from the LiDAR frame and its half sizes.
    pub(crate) fn points_in(
        &self,
        box_from_lidar: &Isometry3<f32>,
        half: [f32; 3],
        [sign_x, sign_y]: [f32; 2],
    ) -> impl Iterator<Item = Point3<f32>> {
        // Slightly larger than the box, to allow for rounding.
        let radius = 1.0 + half.iter().map(|half| half * half).sum::<f32>().sqrt();
        let center = box_from_lidar.inverse().translation.vector;
        let (x, y) = (sign_x * center.x, sign_y * center.y);
        let columns = index(x - radius)..=index(x + radius);
        let rows = index(y - radius)..=index(y + radius);
        rows.flat_map(move |row| {
            // Neighbouring columns of a row are neighbours in memory: one range of points.
            let (first, last) = (row * ACROSS + columns.start(), row * ACROSS + columns.end());
            self.points[self.begins[first]..self.begins[last + 1]]
                .iter()
                .map(move |&[x, y, z]| box_from_lidar * Point3::new(sign_x * x, sign_y * y, z))
                .filter(move |local| (0..3).all(|axis| local[axis].abs() <= half[axis]))
        })
    }
}

fn cell_of(&[x, y, ..]: &[f32; 4]) -> usize {
    index(y) * ACROSS + index(x)
}

/// The column or row of a coordinate. NaN is 0.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "from 0 to ACROSS - 1"
)]
fn index(metres: f32) -> usize {
    let cell = (metres / CELL_M + CELLS as f32).clamp(0.0, (ACROSS - 1) as f32);
    cell as usize
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn cells_find_the_same_as_a_scan_of_all_points(
            points in prop::collection::vec(prop::array::uniform4(-200.0..200.0f32), 0..60),
            center in prop::array::uniform3(-200.0..200.0f32),
            yaw in -3.2..3.2f32,
            half in prop::array::uniform3(0.1..60.0f32),
            signs in prop::sample::select(vec![[1.0f32, 1.0], [1.0, -1.0], [-1.0, 1.0]]),
        ) {
            let box_from_lidar = Isometry3::new(center.into(), nalgebra::Vector3::new(0.0, 0.0, yaw)).inverse();
            let cells = PointCells::new(&PointCloud { xyzi: points.clone() });
            let expected = points.iter().any(|point| {
                let local = box_from_lidar * Point3::new(signs[0] * point[0], signs[1] * point[1], point[2]);
                (0..3).all(|axis| local[axis].abs() <= half[axis])
            });
            let found = cells.points_in(&box_from_lidar, half, signs).next().is_some();
            prop_assert_eq!(found, expected);
        }
    }
}
