//! Convex outlines in the plane, and a grid index over them.

use super::curve::Pose2;

/// Corners of a convex quadrilateral, in order around it, metres.
pub(crate) type Quad = [[f64; 2]; 4];

/// A rectangle seen from above.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlanRectangle {
    pub center_m: [f64; 2],
    pub half_m: [f64; 2],
    pub yaw_rad: f64,
}

impl PlanRectangle {
    /// The rectangle in the middle of which a pose lies, along its heading.
    pub(crate) fn around(pose: Pose2, half_m: [f64; 2]) -> Self {
        Self {
            center_m: [pose.x, pose.y],
            half_m,
            yaw_rad: pose.heading_rad,
        }
    }

    /// The square around a point, along the axes of the map.
    pub(crate) fn square(center_m: [f64; 2], half_m: f64) -> Self {
        Self {
            center_m,
            half_m: [half_m; 2],
            yaw_rad: 0.0,
        }
    }

    /// The same rectangle, larger by `margin_m` on every side.
    pub(crate) fn grown(&self, margin_m: f64) -> Self {
        let half_m = self.half_m.map(|half| half + margin_m);
        Self { half_m, ..*self }
    }

    pub(crate) fn corners(&self) -> Quad {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let ([x, y], [a, b]) = (self.center_m, self.half_m);
        [[-a, -b], [a, -b], [a, b], [-a, b]]
            .map(|[u, v]| [x + u * cos - v * sin, y + u * sin + v * cos])
    }
}

/// Lowest and highest of some values.
pub(crate) fn range(values: impl Iterator<Item = f64>) -> [f64; 2] {
    values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
        [low.min(value), high.max(value)]
    })
}

/// Lowest and highest x and y of some points.
pub(crate) fn bounds(points: impl IntoIterator<Item = [f64; 2]>) -> [[f64; 2]; 2] {
    let none = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
    points.into_iter().fold(none, |[low, high], p| {
        [
            [low[0].min(p[0]), low[1].min(p[1])],
            [high[0].max(p[0]), high[1].max(p[1])],
        ]
    })
}

/// True if two convex outlines have more than their edges in common (separating axes).
pub(crate) fn overlap(a: &[[f64; 2]], b: &[[f64; 2]]) -> bool {
    !separated_by_edge_of(a, b) && !separated_by_edge_of(b, a)
}

fn separated_by_edge_of(a: &[[f64; 2]], b: &[[f64; 2]]) -> bool {
    (0..a.len()).any(|i| {
        let (from, to) = (a[i], a[(i + 1) % a.len()]);
        let normal = [to[1] - from[1], from[0] - to[0]];
        // Corners may coincide, and an edge without length separates nothing.
        if normal == [0.0, 0.0] {
            return false;
        }
        let [[low_a, high_a], [low_b, high_b]] = [a, b]
            .map(|outline| range(outline.iter().map(|p| p[0] * normal[0] + p[1] * normal[1])));
        high_a <= low_b || high_b <= low_a
    })
}

/// Numbered outlines by the cells of a square grid that their bounds touch.
#[derive(Debug, Clone)]
pub(crate) struct CellIndex {
    origin_m: [f64; 2],
    cell_m: f64,
    columns: usize,
    rows: usize,
    cells: Vec<Vec<u32>>,
}

impl CellIndex {
    /// An empty index over a rectangle; outlines outside it go into the cells at its edge.
    pub(crate) fn new([low, high]: [[f64; 2]; 2], cell_m: f64) -> Self {
        // Huge maps get larger cells rather than more of them.
        let cell_m = cell_m.max((high[0] - low[0]).max(high[1] - low[1]) / 2000.0);
        let [columns, rows] =
            [0, 1].map(|axis| ((high[axis] - low[axis]).max(0.0) / cell_m) as usize + 1);
        Self {
            origin_m: low,
            cell_m,
            columns,
            rows,
            cells: vec![Vec::new(); columns * rows],
        }
    }

    pub(crate) fn insert(&mut self, number: u32, bounds: [[f64; 2]; 2]) {
        for cell in self.cells_within(bounds) {
            self.cells[cell].push(number);
        }
    }

    /// True if `test` is true for any outline whose cells touch the bounds. One outline may be tested several times.
    pub(crate) fn any(&self, bounds: [[f64; 2]; 2], mut test: impl FnMut(u32) -> bool) -> bool {
        let mut cells = self.cells_within(bounds).map(|cell| &self.cells[cell]);
        cells.any(|numbers| numbers.iter().copied().any(&mut test))
    }

    /// Places in `cells` of the cells that bounds touch, row by row.
    fn cells_within(&self, [low, high]: [[f64; 2]; 2]) -> impl Iterator<Item = usize> + use<> {
        let ([c0, r0], [c1, r1]) = (self.cell(low), self.cell(high));
        let columns = self.columns;
        (r0..=r1).flat_map(move |row| (c0..=c1).map(move |column| row * columns + column))
    }

    fn cell(&self, point: [f64; 2]) -> [usize; 2] {
        let counts = [self.columns, self.rows];
        [0, 1].map(|axis| {
            let place = ((point[axis] - self.origin_m[axis]) / self.cell_m).max(0.0) as usize;
            place.min(counts[axis] - 1)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, yaw_rad: f64) -> Quad {
        PlanRectangle {
            center_m: [x, 0.0],
            half_m: [1.0, 1.0],
            yaw_rad,
        }
        .corners()
    }

    #[test]
    fn turned_squares_overlap_only_when_they_do() {
        let diamond = std::f64::consts::FRAC_PI_4;
        assert!(overlap(&square(0.0, 0.0), &square(1.9, 0.0)));
        assert!(!overlap(&square(0.0, 0.0), &square(2.1, 0.0)));
        // A diamond's corner reaches 1.414 towards the square.
        assert!(overlap(&square(0.0, 0.0), &square(2.3, diamond)));
        assert!(!overlap(&square(0.0, 0.0), &square(2.5, diamond)));
    }

    #[test]
    fn index_finds_outlines_near_and_outside() {
        let mut index = CellIndex::new([[0.0, 0.0], [100.0, 50.0]], 10.0);
        index.insert(1, [[12.0, 12.0], [28.0, 14.0]]);
        index.insert(2, [[-50.0, -50.0], [-40.0, -40.0]]);
        assert!(index.any([[21.0, 11.0], [22.0, 12.0]], |n| n == 1));
        assert!(!index.any([[51.0, 11.0], [52.0, 12.0]], |_| true));
        assert!(index.any([[-45.0, -45.0], [-44.0, -44.0]], |n| n == 2));
    }
}
