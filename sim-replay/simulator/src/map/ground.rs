//! The ground: terrain under everything, and road surfaces that pass above it.

/// A triangle in the world frame, metres; anticlockwise seen from above.
pub(crate) type Triangle = [[f64; 3]; 3];

/// Terrain and decks.
#[derive(Debug, Clone, PartialEq)]
pub struct Ground {
    /// The surface that lies under everything.
    pub terrain: Terrain,
    /// Road surfaces that pass above the terrain (bridges); empty on a flat map.
    pub decks: Vec<Triangle>,
}

/// The surface that lies under everything.
#[derive(Debug, Clone, PartialEq)]
pub enum Terrain {
    /// Level ground everywhere.
    Plane {
        /// Height, metres.
        z_m: f64,
    },
    /// Heights on a regular grid.
    Grid(HeightGrid),
}

/// Heights on a regular grid; each cell is two triangles, split along the diagonal from its lowest x and y to its
/// highest. Beyond its edge the ground goes on level at the height of the edge.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightGrid {
    /// World x and y of the node in column 0, row 0, metres.
    pub origin_m: [f64; 2],
    /// Distance between nodes, metres.
    pub cell_m: f64,
    /// Nodes along x.
    pub columns: usize,
    /// Nodes along y.
    pub rows: usize,
    /// Heights in metres, `rows * columns`, row by row.
    pub heights_m: Vec<f32>,
}

impl Ground {
    /// Level ground without decks.
    pub fn plane(z_m: f64) -> Self {
        let (terrain, decks) = (Terrain::Plane { z_m }, Vec::new());
        Self { terrain, decks }
    }

    /// Height of the terrain (not of decks) at `x`, `y`, metres.
    pub fn height_m(&self, x: f64, y: f64) -> f64 {
        match &self.terrain {
            Terrain::Plane { z_m } => *z_m,
            Terrain::Grid(grid) => grid.height_m(x, y),
        }
    }
}

impl HeightGrid {
    /// Height of the node in `column` and `row`, clamped to the grid, metres.
    pub(crate) fn node_m(&self, column: usize, row: usize) -> f64 {
        f64::from(
            self.heights_m[row.min(self.rows - 1) * self.columns + column.min(self.columns - 1)],
        )
    }

    /// World x and y of the node in `column` and `row`, metres.
    pub(crate) fn place_m(&self, column: usize, row: usize) -> [f64; 2] {
        let [x, y] = self.origin_m;
        [
            x + column as f64 * self.cell_m,
            y + row as f64 * self.cell_m,
        ]
    }

    /// Height of the surface at `x`, `y`, metres.
    pub fn height_m(&self, x: f64, y: f64) -> f64 {
        let column = ((x - self.origin_m[0]) / self.cell_m).clamp(0.0, (self.columns - 1) as f64);
        let row = ((y - self.origin_m[1]) / self.cell_m).clamp(0.0, (self.rows - 1) as f64);
        let (i, j) = (column as usize, row as usize);
        let (u, v) = (column - i as f64, row - j as f64);
        let (low, high) = (self.node_m(i, j), self.node_m(i + 1, j + 1));
        let (corner, first, second) = match u >= v {
            true => (self.node_m(i + 1, j), u, v),
            false => (self.node_m(i, j + 1), v, u),
        };
        // Barycentric weights on the triangle's two legs.
        low + first * (corner - low) + second * (high - corner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_reproduces_an_inclined_plane_and_is_level_beyond_it() {
        let heights_m = (0..4)
            .flat_map(|row| (0..5).map(move |column| (column * 2 + row * 3) as f32))
            .collect();
        let grid = HeightGrid {
            origin_m: [-1.0, 2.0],
            cell_m: 2.0,
            columns: 5,
            rows: 4,
            heights_m,
        };
        for (x, y) in [(-1.0, 2.0), (0.3, 2.9), (3.3, 6.1), (6.9, 7.9)] {
            let expected = (x + 1.0) + (y - 2.0) * 1.5;
            assert!((grid.height_m(x, y) - expected).abs() < 1e-9, "{x} {y}");
        }
        assert_eq!(grid.height_m(100.0, 100.0), 17.0);
        assert_eq!(grid.height_m(-100.0, -100.0), 0.0);
    }
}
