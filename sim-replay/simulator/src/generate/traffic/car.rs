//! One vehicle in traffic.

use super::driver::{Driver, Obstacle};
use super::path::Path;
use super::rectangle::Rectangle;
use super::roads::Roads;
use crate::generate::raycast::{Course, Placement};
use crate::generate::vehicle::Vehicle;
use crate::map::{Lane, LaneId};

/// One vehicle in traffic.
#[derive(Debug, Clone)]
pub(crate) struct Car {
    /// Changes when the vehicle leaves the scene and another one replaces it.
    pub(crate) id: i64,
    pub(crate) vehicle: Vehicle,
    pub(crate) driver: Driver,
    pub(crate) path: Path,
    /// Offset to the left of the lane's centre line, metres.
    pub(crate) aside_m: f64,
    pub(crate) speed_mps: f64,
    /// Obstacle ahead in the last step.
    pub(crate) leader: Option<Obstacle>,
    /// State of the lane-change model.
    pub(crate) lane_change: LaneChangeState,
    /// The motion of the last step.
    pub(crate) motion: Course,
    /// True if it is part of the scene.
    pub(crate) is_present: bool,
    /// Duration of the current stop, seconds.
    pub(crate) standing_s: f64,
    /// Junction lanes reserved for it.
    pub(crate) held: Vec<LaneId>,
}

impl Car {
    pub(crate) fn half_length_m(&self) -> f64 {
        0.5 * self.vehicle.size_m[0]
    }

    pub(crate) fn wheelbase_m(&self) -> f64 {
        0.6 * self.vehicle.size_m[0]
    }

    /// Placement after `drive_m` more metres of its path.
    pub(crate) fn placement_after(&self, roads: &Roads<'_>, drive_m: f64) -> Placement {
        self.path
            .placement(roads.graph, drive_m, self.wheelbase_m(), self.aside_m)
    }

    /// Its footprint now.
    pub(crate) fn rectangle(&self) -> Rectangle {
        Rectangle::new(&self.motion.end, &self.vehicle.size_m)
    }

    /// Its position in the plane now, metres.
    pub(crate) fn point_m(&self) -> [f64; 2] {
        self.motion.end.position_m.xy().into()
    }
}

/// A side, seen in driving direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Left,
    Right,
}

impl Side {
    pub(super) fn of(self, lane: &Lane) -> Option<LaneId> {
        match self {
            Self::Left => lane.left,
            Self::Right => lane.right,
        }
    }

    pub(super) fn opposite(self) -> Self {
        match self {
            Self::Left => Self::Right,
            Self::Right => Self::Left,
        }
    }
}

/// State of a driver's wish to change lanes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LaneChangeState {
    /// Time behind a slower vehicle ahead, seconds.
    pub(super) held_up_s: f64,
    /// Side of a random change.
    pub(super) random_change: Option<Side>,
    /// Time until the random change expires, or until the next one may start, seconds.
    pub(super) random_change_timer_s: f64,
}
