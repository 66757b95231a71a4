//! Branch and bound over poses in the plane: the likeliest ones, one after another.

use std::f64::consts::TAU;

use nalgebra::Rotation2;

use super::grid::{CELL_M, COARSEST, UprightGrid, UprightPlane, direction_bit};

/// Headings that are searched: a step moves a plane at the farthest by a cell and a third.
const HEADINGS: usize = 240;
/// Poses nearer than this to one that was found, metres and steps of the heading, are not found.
const APART_M: f64 = 2.0;
const APART_STEPS: usize = 6;
/// Largest number of windows that are scored: 2 s on one core.
const MAX_WINDOWS: usize = 8_000_000;

/// Poses of one heading at the positions of a square.
#[derive(Debug, Clone, Copy)]
struct PoseWindow {
    heading: usize,
    /// Column and row of the square's first cell.
    position: [usize; 2],
    /// The square's side is two to this power, cells: at level 0 it is one pose.
    level: u32,
}

/// A pose in the plane with its score.
#[derive(Debug, Clone, Copy)]
pub(super) struct PoseCandidate {
    /// Column and row of the place.
    pub(super) position: [usize; 2],
    pub(super) heading_rad: f64,
    /// Number of planes of the sweep that lie on one of the place.
    pub(super) matched: usize,
}

/// A search under way.
pub(super) struct BranchAndBound<'a> {
    grid: &'a UprightGrid,
    /// By heading: the offset of each plane's cell from the sensor's, and the bit of its direction.
    turned: Vec<Vec<(usize, u16)>>,
    /// By the largest number of planes that can be matched in them: windows that are not divided yet.
    open: Vec<Vec<PoseWindow>>,
    scored: usize,
    found: Vec<PoseWindow>,
}

impl<'a> BranchAndBound<'a> {
    /// Begins with all poses in the place.
    pub(super) fn new(grid: &'a UprightGrid, planes: &[UprightPlane]) -> Self {
        let turned = (0..HEADINGS).map(|heading| turned(grid, planes, heading));
        let mut search = Self {
            grid,
            turned: turned.collect(),
            open: vec![Vec::new(); planes.len() + 1],
            scored: 0,
            found: Vec::new(),
        };
        for heading in 0..HEADINGS {
            for row in (0..grid.place[1]).step_by(1 << COARSEST) {
                for column in (0..grid.place[0]).step_by(1 << COARSEST) {
                    search.open(PoseWindow {
                        heading,
                        position: [column, row],
                        level: COARSEST,
                    });
                }
            }
        }
        search
    }

    /// True if it has taken too long: there may be better poses.
    pub(super) fn is_exhausted(&self) -> bool {
        self.scored >= MAX_WINDOWS
    }

    /// The best pose apart from those before it; `None` if less than `least` planes are matched at it, or it takes too long.
    pub(super) fn next(&mut self, least: usize) -> Option<PoseCandidate> {
        while !self.is_exhausted() && self.open.len() > least {
            let matched = self.open.len() - 1;
            let Some(window) = self.open[matched].pop() else {
                self.open.pop();
                continue;
            };
            if self.found.iter().any(|found| found.is_near_all(&window)) {
                continue;
            }
            if window.level == 0 {
                self.found.push(window);
                return Some(PoseCandidate {
                    position: window.position,
                    heading_rad: heading_rad(window.heading),
                    matched,
                });
            }
            self.divide(window);
        }
        None
    }

    fn divide(&mut self, window: PoseWindow) {
        let level = window.level - 1;
        for quarter in 0..4 {
            let position = [
                window.position[0] + ((quarter & 1) << level),
                window.position[1] + ((quarter >> 1) << level),
            ];
            let is_inside = position
                .iter()
                .zip(&self.grid.place)
                .all(|(at, end)| at < end);
            if is_inside {
                self.open(PoseWindow {
                    position,
                    level,
                    ..window
                });
            }
        }
    }

    fn open(&mut self, window: PoseWindow) {
        let cells = &self.grid.levels[window.level as usize];
        let sensor = self.grid.cell(window.position);
        let planes = self.turned[window.heading].iter();
        let matched = planes.filter(|(offset, bit)| {
            let directions = cells.get(sensor.wrapping_add(*offset));
            directions.is_some_and(|directions| directions & bit != 0)
        });
        let matched = matched.count();
        self.scored += 1;
        self.open[matched].push(window);
    }
}

impl PoseWindow {
    /// True if all poses of another window are near this one.
    fn is_near_all(&self, other: &Self) -> bool {
        let steps = self.heading.abs_diff(other.heading);
        let side = (1 << other.level) - 1;
        let axes = self.position.iter().zip(other.position);
        let farthest =
            axes.map(|(at, first)| at.abs_diff(first).max(at.abs_diff(first + side)) as f64);
        farthest.fold(0.0, f64::hypot) * CELL_M < APART_M
            && steps.min(HEADINGS - steps) <= APART_STEPS
    }
}

fn heading_rad(heading: usize) -> f64 {
    heading as f64 / HEADINGS as f64 * TAU
}

fn turned(grid: &UprightGrid, planes: &[UprightPlane], heading: usize) -> Vec<(usize, u16)> {
    let angle = heading_rad(heading);
    let rotation = Rotation2::new(angle);
    let planes = planes.iter().map(|plane| {
        // From the centre of the sensor's cell.
        let cell = (rotation * plane.at_m / CELL_M).map(|at| (at + 0.5).floor() as isize);
        let offset = cell.y * grid.columns as isize + cell.x;
        // Wraps where it is negative, and back when the sensor's cell is added.
        (offset as usize, direction_bit(plane.normal_rad + angle))
    });
    planes.collect()
}
