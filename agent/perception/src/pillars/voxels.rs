//! Voxelisation: sorts points into pillars on a ground grid.
//!
//! The order and the limits are those of the reference library (spconv's CPU generator): pillars are numbered by their
//! first point, the first points of a pillar and the first pillars of a sweep are kept.

use std::sync::Once;

use support::output;

use crate::model_config::DetectorConfig;

/// Mark of a cell that has no pillar yet, and of a point that was dropped.
const NONE: u32 = u32::MAX;

/// Pillars of one sweep: the points of a pillar are contiguous, in the order of the sweep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Pillars {
    /// `[P]` of x, y, z (metres) and intensity: pillar after pillar.
    pub points: Vec<[f32; 4]>,
    /// `[M]`: number of points of each pillar, at least 1.
    pub counts: Vec<u32>,
    /// `[M]` of cell indices z, y, x.
    pub coords: Vec<[i32; 3]>,
}

impl Pillars {
    /// Number of pillars `M`.
    pub fn len(&self) -> usize {
        self.counts.len()
    }

    /// True if no point was inside the area.
    pub fn is_empty(&self) -> bool {
        self.counts.is_empty()
    }

    /// The points of each pillar, in the order of the pillars.
    pub fn iter(&self) -> impl Iterator<Item = (&[[f32; 4]], [i32; 3])> {
        let mut rest = self.points.as_slice();
        let counted = self.counts.iter().zip(&self.coords);
        counted.map(move |(&count, &coord)| {
            let (points, tail) = rest.split_at(count as usize);
            rest = tail;
            (points, coord)
        })
    }
}

/// Sorts sweeps into pillars; reuses its tables between calls.
#[derive(Debug, Clone)]
pub struct Voxeliser {
    low: [f32; 3],
    size: [f32; 3],
    /// Number of cells along x, y, z.
    grid: [usize; 3],
    max_points: u32,
    max_pillars: usize,
    /// Pillar on each cell, [`NONE`] between calls.
    pillar_of_cell: Vec<u32>,
    /// Pillar of each point of the sweep.
    pillar_of_point: Vec<u32>,
    /// Points of the sweep in cells beyond the last pillar.
    points_beyond: usize,
}

impl Voxeliser {
    /// The voxeliser of a detector: its cells begin at the lower corner of the area.
    pub fn for_detector(config: &DetectorConfig) -> Self {
        let grid = config.pillar_grid();
        Self {
            low: std::array::from_fn(|axis| config.lidar_range_m[axis] as f32),
            size: config.voxel_size_m.map(|size| size as f32),
            grid,
            max_points: u32::try_from(config.max_points_per_pillar).unwrap_or(u32::MAX),
            max_pillars: config.max_pillars,
            pillar_of_cell: vec![NONE; grid.iter().product()],
            pillar_of_point: Vec::new(),
            points_beyond: 0,
        }
    }

    /// Sorts the points of one sweep into pillars; points outside the area and points that are not finite are dropped.
    /// Points beyond the last pillar too, and the first sweep of the process that has such is named.
    pub fn voxelise(&mut self, points: &[[f32; 4]]) -> Pillars {
        // First pass: the pillar of every point, and the counts and coordinates of the pillars.
        let mut pillars = Pillars::default();
        self.points_beyond = 0;
        self.pillar_of_point.clear();
        self.pillar_of_point.reserve(points.len());
        for point in points {
            let pillar = match self.cell(point) {
                Some(coord) => self.admit(coord, &mut pillars),
                None => NONE,
            };
            self.pillar_of_point.push(pillar);
        }
        self.gather(points, &mut pillars);
        if self.points_beyond > 0 {
            static NAMED: Once = Once::new();
            let (beyond, most) = (self.points_beyond, self.max_pillars);
            NAMED.call_once(|| {
                output::note(format_args!(
                    "{beyond} points of a sweep are beyond {most} pillars (max_pillars): left out"
                ));
            });
        }
        // Only cells with a pillar are reset, not the whole grid.
        for coord in &pillars.coords {
            let [z, y, x] = coord.map(|index| index as usize);
            self.pillar_of_cell[(z * self.grid[1] + y) * self.grid[0] + x] = NONE;
        }
        pillars
    }

    /// Indices x, y, z of the cell under a point.
    ///
    /// The division is done in `f32` as in the reference: in `f64` some points on a border change sides. Truncation
    /// is the floor of a non-negative number, and the comparison excludes NaN.
    fn cell(&self, point: &[f32; 4]) -> Option<[u32; 3]> {
        let mut cell = [0; 3];
        for axis in 0..3 {
            let index = (point[axis] - self.low[axis]) / self.size[axis];
            if !(index >= 0.0 && index < self.grid[axis] as f32) {
                return None;
            }
            cell[axis] = index as u32;
        }
        Some(cell)
    }

    /// Adds one point to a cell; [`NONE`] if its pillar is full or there are enough pillars.
    fn admit(&mut self, [x, y, z]: [u32; 3], pillars: &mut Pillars) -> u32 {
        let cell = (z as usize * self.grid[1] + y as usize) * self.grid[0] + x as usize;
        let mut pillar = self.pillar_of_cell[cell];
        if pillar == NONE {
            // No new pillar, but those that exist still take points.
            if pillars.len() >= self.max_pillars {
                self.points_beyond += 1;
                return NONE;
            }
            pillar = pillars.len() as u32;
            self.pillar_of_cell[cell] = pillar;
            pillars.counts.push(0);
            pillars.coords.push([z as i32, y as i32, x as i32]);
        }
        let count = &mut pillars.counts[pillar as usize];
        if *count >= self.max_points {
            return NONE;
        }
        *count += 1;
        pillar
    }

    /// Second pass: copies the points of a pillar together.
    fn gather(&self, points: &[[f32; 4]], pillars: &mut Pillars) {
        let mut next = Vec::with_capacity(pillars.len());
        let mut total = 0;
        for &count in &pillars.counts {
            next.push(total);
            total += count as usize;
        }
        pillars.points = vec![[0.0; 4]; total];
        for (point, &pillar) in points.iter().zip(&self.pillar_of_point) {
            if pillar != NONE {
                let slot = &mut next[pillar as usize];
                pillars.points[*slot] = *point;
                *slot += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn voxeliser(max_points: usize, max_pillars: usize) -> Voxeliser {
        Voxeliser::for_detector(&DetectorConfig {
            lidar_range_m: [0.0, 0.0, -3.0, 4.0, 2.0, 1.0],
            voxel_size_m: [1.0, 1.0, 4.0],
            max_points_per_pillar: max_points,
            max_pillars,
            ..DetectorConfig::lean()
        })
    }

    #[test]
    fn points_of_a_pillar_lie_together_in_order_of_appearance() {
        let points = [
            [3.5, 1.5, 0.0, 0.1],
            [0.5, 0.5, 0.0, 0.2],
            [3.2, 1.1, 0.0, 0.3],
        ];
        let pillars = voxeliser(8, 8).voxelise(&points);
        assert_eq!(pillars.coords, [[0, 1, 3], [0, 0, 0]]);
        assert_eq!(pillars.counts, [2, 1]);
        assert_eq!(pillars.points, [points[0], points[2], points[1]]);
        let second = pillars.iter().nth(1).unwrap();
        assert_eq!(second, (&points[1..2], [0, 0, 0]));
    }

    #[test]
    fn the_lower_border_is_in_and_the_upper_is_out() {
        let points = [
            [0.0, 0.0, -3.0, 0.0],
            [4.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [-1e-6, 0.0, 0.0, 0.0],
        ];
        assert_eq!(voxeliser(8, 8).voxelise(&points).counts, [1]);
    }

    #[test]
    fn full_pillars_and_full_sweeps_drop_the_late_points() {
        let a = [0.5, 0.5, 0.0, 0.0];
        let b = [1.5, 0.5, 0.0, 0.0];
        let mut voxeliser = voxeliser(2, 1);
        let pillars = voxeliser.voxelise(&[a, b, a, a]);
        assert_eq!(
            (pillars.counts.as_slice(), pillars.points.len()),
            ([2].as_slice(), 2)
        );
        assert_eq!(voxeliser.points_beyond, 1, "a full pillar is usual");
        voxeliser.voxelise(&[a]);
        assert_eq!(voxeliser.points_beyond, 0, "counted per sweep");
    }

    #[test]
    fn points_that_are_not_finite_are_dropped_and_tables_are_clean_afterwards() {
        let mut voxeliser = voxeliser(2, 8);
        let good = [0.5, 0.5, 0.0, 0.0];
        let bad = [
            [f32::NAN, 0.5, 0.0, 0.0],
            [0.5, f32::INFINITY, 0.0, 0.0],
            [0.5, 0.5, f32::NEG_INFINITY, 0.0],
        ];
        for _ in 0..2 {
            assert!(voxeliser.voxelise(&bad).is_empty());
            assert_eq!(voxeliser.voxelise(&[good]).points, [good]);
        }
    }
}
