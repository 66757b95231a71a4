//! Structure of a sweep seen from above: what stands on the ground, as a likelihood field.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use protocol::PointCloud;

/// Half side of the field, metres.
const RANGE_M: f32 = 32.0;
/// Points nearer than this are of the vehicle itself, metres.
const OWN_M: f32 = 3.0;
/// Side of a cell of the field, metres.
const CELL_M: f32 = 0.25;
/// Cells of a side.
const SIDE: usize = 256;
/// Cells of a column's side.
const PER_COLUMN: usize = 2;
/// Least height of structure, metres.
const HEIGHT_M: f32 = 0.6;
/// Height above the foot of a column from which points are structure, metres.
const ABOVE_FOOT_M: f32 = 0.3;
/// Standard deviation of the field around a point, metres, and its reach in cells.
const SIGMA_M: f32 = 0.3;
const REACH: isize = 3;
/// Cells of a sweep that are compared.
const SAMPLES: usize = 500;
/// Fewest cells that are judged.
const LEAST_CELLS: usize = 60;
/// Tolerance of heights, metres.
const HEIGHT_TOLERANCE_M: f32 = 0.5;
/// Likelihood below which a point coincides with nothing: 0.6 m away.
const APART: f32 = 0.1;
/// Turns around no motion that are tried, degrees, and their step.
const MOST_TURN_DEG: i16 = 9;
const TURN_STEP: usize = 3;
/// Steps of the refinement: metres, and degrees.
const REFINEMENTS: [[f32; 2]; 3] = [[0.25, 1.5], [0.12, 0.75], [0.06, 0.4]];

/// Structures above the ground around a sensor.
pub(super) struct Structure {
    /// Centres of cells with structure, in the LiDAR frame.
    samples: Vec<Point3<f32>>,
    /// Likelihood, lowest and highest structure of each cell, row by row.
    field: Vec<(f32, f32, f32)>,
}

/// A motion at which two sweeps overlap.
#[derive(Debug, Clone, Copy)]
pub(super) struct Match {
    pub(super) first_from_second: Isometry3<f32>,
    /// Share of the structure that coincides.
    pub(super) overlap: f32,
}

impl Structure {
    /// `None` for sweeps with too little structure.
    pub(super) fn of(points: &PointCloud) -> Option<Self> {
        let side = SIDE / PER_COLUMN;
        let mut columns = vec![(f32::INFINITY, f32::NEG_INFINITY); side * side];
        let positions = points.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]);
        // The vehicle's own body moves with the sensor, and would confirm no motion.
        let near = positions.filter(|[x, y, _]| x.hypot(*y) > OWN_M);
        for [x, y, z] in near.clone() {
            if let Some(column) = index(x, y, PER_COLUMN).and_then(|place| columns.get_mut(place)) {
                *column = (column.0.min(z), column.1.max(z));
            }
        }
        let mut samples: Vec<Option<Point3<f32>>> = vec![None; SIDE * SIDE];
        let mut field = vec![(0.0, f32::INFINITY, f32::NEG_INFINITY); SIDE * SIDE];
        for [x, y, z] in near {
            let column = index(x, y, PER_COLUMN).and_then(|place| columns.get(place));
            // Step: columns that are high enough, without a model of the ground.
            let Some((low, high)) = column.filter(|(low, high)| high - low > HEIGHT_M) else {
                continue;
            };
            let sample = index(x, y, 1).and_then(|place| samples.get_mut(place));
            if let Some(sample) = sample
                // The foot of a column is ground, which coincides at any motion.
                && z > low + ABOVE_FOOT_M
                && sample.is_none()
            {
                *sample = Some(Point3::new(x, y, z));
                splat(&mut field, [x, y], (*low, *high));
            }
        }
        let samples: Vec<Point3<f32>> = samples.into_iter().flatten().collect();
        let step = samples.len().div_ceil(SAMPLES).max(1);
        (samples.len() >= LEAST_CELLS).then(|| Self {
            samples: samples.into_iter().step_by(step).collect(),
            field,
        })
    }

    /// Likelihood of a point, 0 to 1.
    fn likelihood(&self, point: Point3<f32>) -> f32 {
        let cell = index(point.x, point.y, 1).and_then(|place| self.field.get(place));
        match cell {
            Some((likelihood, low, high))
                if point.z > low - HEIGHT_TOLERANCE_M && point.z < high + HEIGHT_TOLERANCE_M =>
            {
                *likelihood
            }
            _ => 0.0,
        }
    }

    /// Share of the other sweep's structure that coincides with this one's at a motion.
    pub(super) fn overlap(&self, other: &Self, first_from_second: &Isometry3<f32>) -> f32 {
        let points = other.samples.iter().map(|point| first_from_second * point);
        points.map(|point| self.likelihood(point)).sum::<f32>() / other.samples.len() as f32
    }

    /// The same for that part of the other sweep's structure that does not coincide without a motion.
    pub(super) fn overlap_of_rest(&self, other: &Self, first_from_second: &Isometry3<f32>) -> f32 {
        let rest = (other.samples.iter()).filter(|point| self.likelihood(**point) < APART);
        let overlaps = rest.map(|point| self.likelihood(first_from_second * point));
        let overlaps: Vec<f32> = overlaps.collect();
        overlaps.iter().sum::<f32>() / overlaps.len().max(1) as f32
    }

    /// The overlap without a motion.
    pub(super) fn at_rest(&self, other: &Self) -> Match {
        let first_from_second = Isometry3::identity();
        Match {
            first_from_second,
            overlap: self.overlap(other, &first_from_second),
        }
    }

    /// The motion in the plane, up to a distance from none, at which the sweeps overlap best.
    pub(super) fn best_overlap(&self, other: &Self, radius_m: f32) -> Match {
        let mut best = self.at_rest(other);
        let steps = (0_u16..).map(|step| 2.0 * CELL_M * f32::from(step) - radius_m);
        let offsets: Vec<f32> = steps.take_while(|&offset| offset <= radius_m).collect();
        let turns = (-MOST_TURN_DEG..=MOST_TURN_DEG).step_by(TURN_STEP);
        let turns: Vec<f32> = turns.map(f32::from).collect();
        // Step: a coarse grid of planar motions.
        self.improve(other, &offsets, &turns, &mut best);
        // Step: the neighbourhood of the best one, with smaller and smaller steps.
        for steps in REFINEMENTS {
            let [offsets, turns] = steps.map(|step| [-step, 0.0, step]);
            self.improve(other, &offsets, &turns, &mut best);
        }
        best
    }

    /// Tries planar motions around the best one: offsets along x and y, metres, and turns, degrees.
    fn improve(&self, other: &Self, offsets_m: &[f32], turns_deg: &[f32], best: &mut Match) {
        let around = best.first_from_second;
        for turn in turns_deg {
            for x in offsets_m {
                for y in offsets_m {
                    let first_from_second = around * planar(*x, *y, *turn);
                    let overlap = self.overlap(other, &first_from_second);
                    if overlap > best.overlap {
                        *best = Match {
                            first_from_second,
                            overlap,
                        };
                    }
                }
            }
        }
    }
}

fn planar(x: f32, y: f32, degrees: f32) -> Isometry3<f32> {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), degrees.to_radians());
    Isometry3::from_parts(Translation3::new(x, y, 0.0), turn)
}

/// Raises the likelihood around a point with structure of this height.
fn splat(field: &mut [(f32, f32, f32)], [x, y]: [f32; 2], (low, high): (f32, f32)) {
    for row in -REACH..=REACH {
        for column in -REACH..=REACH {
            let [dx, dy] = [row, column].map(|cells| cells as f32 * CELL_M);
            let likelihood = (-(dx * dx + dy * dy) / (2.0 * SIGMA_M * SIGMA_M)).exp();
            if let Some(cell) = index(x + dx, y + dy, 1).and_then(|place| field.get_mut(place)) {
                *cell = (cell.0.max(likelihood), cell.1.min(low), cell.2.max(high));
            }
        }
    }
}

/// Place of a position among cells that are joined by `joined` per side; `None` outside of the field.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "both are within 0 and the number of cells"
)]
fn index(x: f32, y: f32, joined: usize) -> Option<usize> {
    let side = SIDE / joined;
    let size_m = CELL_M * joined as f32;
    let [column, row] = [x, y].map(|value| (value + RANGE_M) / size_m);
    let inside = 0.0..side as f32;
    (inside.contains(&column) && inside.contains(&row))
        .then(|| row as usize * side + column as usize)
}
