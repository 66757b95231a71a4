//! Ground of a place, and below a sensor: its height and its direction.

use std::collections::HashMap;

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use crate::registration::icp::{Plane, is_level};

/// Side of a cell of the ground, metres.
const CELL_M: f64 = 8.0;

/// Sums over level planes.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LevelSums {
    height: f64,
    /// Of normals that point up.
    normal: Vector3<f64>,
    count: f64,
}

impl LevelSums {
    /// Sums over level planes.
    pub(super) fn of(planes: &[Plane]) -> Self {
        let mut sums = Self::default();
        planes.iter().for_each(|plane| sums.add(plane));
        sums
    }

    fn add(&mut self, plane: &Plane) {
        self.height += plane.centre_m.z;
        self.normal += plane.normal * plane.normal.z.signum();
        self.count += 1.0;
    }

    /// Mean height, metres; `None` without a plane.
    pub(super) fn height_m(&self) -> Option<f64> {
        (self.count > 0.0).then(|| self.height / self.count)
    }

    /// Takes the normal of the ground to the vertical.
    pub(super) fn levelled(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::rotation_between(&self.normal, &Vector3::z()).unwrap_or_default()
    }
}

/// Ground of a place, by cell.
#[derive(Debug, Default)]
pub(super) struct PlaceGround {
    cells: HashMap<[i32; 2], LevelSums>,
}

impl PlaceGround {
    /// The ground of level planes in the world.
    pub(super) fn of(planes: &[Plane]) -> Self {
        let mut ground = Self::default();
        for plane in planes.iter().filter(|plane| is_level(&plane.normal)) {
            let cell = cell_at(&plane.centre_m.xy());
            ground.cells.entry(cell).or_default().add(plane);
        }
        ground
    }

    /// Height, metres, and the rotation that tilts the vertical to the ground's normal; `None` where there is no ground.
    pub(super) fn at(&self, at_m: &Vector2<f64>) -> Option<(f64, UnitQuaternion<f64>)> {
        let sums = self.cells.get(&cell_at(at_m))?;
        Some((sums.height_m()?, sums.levelled().inverse()))
    }
}

fn cell_at(at_m: &Vector2<f64>) -> [i32; 2] {
    (at_m / CELL_M).map(|at| at.floor() as i32).into()
}
