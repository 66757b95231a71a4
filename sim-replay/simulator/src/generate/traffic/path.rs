//! Path of one vehicle: its current lane, the previous one, and those ahead.

use std::collections::VecDeque;

use crate::generate::raycast::Placement;
use crate::map::{Lane, LaneGraph, LaneId};

/// A position on a chain of lanes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Path {
    /// Lanes in driving order, each a successor of the one before it.
    lanes: VecDeque<LaneId>,
    /// Index of the lane under the vehicle's centre.
    current: usize,
    /// Position along that lane, metres.
    pub(crate) s_m: f64,
    /// The change of lanes under way.
    change: Option<Change>,
}

/// A lane of the path, and its neighbour which the vehicle leaves for it. Equal shares of their lengths lie side by
/// side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Beside {
    pub(crate) lane: LaneId,
    pub(crate) left: LaneId,
}

/// A change of lanes: a curve from one to the other, parametrised by distance and not by time, so that a vehicle that
/// has to stop stops across the lanes and does not slide sideways.
#[derive(Debug, Clone, PartialEq)]
struct Change {
    beside: Vec<Beside>,
    /// Distance of the vehicle's centre past the beginning of the curve, metres.
    done_m: f64,
    length_m: f64,
    wheelbase_m: f64,
}

impl Change {
    /// Share of the lateral shift from the old lane to the new one that is done `offset_m` ahead of the vehicle's
    /// centre, 0 to 1.
    fn share(&self, offset_m: f64) -> f64 {
        let t = ((self.done_m + offset_m) / self.length_m).clamp(0.0, 1.0);
        // Position, heading and curvature begin and end with those of the lanes.
        t * t * t * (10.0 + t * (6.0 * t - 15.0))
    }

    fn left_beside(&self, lane: LaneId) -> Option<LaneId> {
        let pair = self.beside.iter().find(|pair| pair.lane == lane);
        pair.map(|pair| pair.left)
    }
}

/// A changing vehicle also counts on its old lane until this share of the change is done.
const LEFT_SHARE: f64 = 0.7;

impl Path {
    /// Starts on one lane.
    pub(crate) fn new(lane: LaneId, s_m: f64) -> Self {
        Self {
            lanes: VecDeque::from([lane]),
            current: 0,
            s_m,
            change: None,
        }
    }

    /// The lane under the vehicle's centre.
    pub(crate) fn lane(&self) -> LaneId {
        self.lanes[self.current]
    }

    /// The last lane that is decided.
    pub(crate) fn last(&self) -> LaneId {
        self.lanes[self.lanes.len() - 1]
    }

    /// Appends a successor of the last lane.
    pub(crate) fn push(&mut self, lane: LaneId) {
        self.lanes.push_back(lane);
    }

    /// Leaves the present lane for its neighbour over `length_m` metres: `beside` are the lanes of the new path from
    /// there on, `s_m` is the vehicle's position on the first. The curve begins at the front axle.
    pub(crate) fn change(
        &mut self,
        beside: Vec<Beside>,
        s_m: f64,
        length_m: f64,
        wheelbase_m: f64,
    ) {
        // The lanes behind stay: the rear may still be on them.
        self.lanes.truncate(self.current);
        self.lanes.extend(beside.iter().map(|pair| pair.lane));
        self.s_m = s_m;
        self.change = Some(Change {
            beside,
            done_m: -0.5 * wheelbase_m,
            length_m,
            wheelbase_m,
        });
    }

    /// True if the vehicle is between two lanes.
    pub(crate) fn is_changing(&self) -> bool {
        self.change.is_some()
    }

    /// The lane that the vehicle is leaving and its position there, metres, while it occupies space there.
    pub(crate) fn leaving(&self, graph: &LaneGraph) -> Option<(LaneId, f64)> {
        let change = self.change.as_ref();
        let change = change.filter(|change| change.share(0.0) < LEFT_SHARE)?;
        let left = change.left_beside(self.lane())?;
        let [own, beside] = [self.lane(), left].map(|lane| graph.lane(lane).length_m);
        Some((left, self.s_m / own * beside))
    }

    /// Length of the decided path ahead, metres.
    pub(crate) fn remaining_m(&self, graph: &LaneGraph) -> f64 {
        let last = self.ahead(graph).last();
        last.map_or(0.0, |(lane, start_m)| start_m + graph.lane(lane).length_m)
    }

    /// The lane under the vehicle and those ahead, each with the distance to its start (negative for the first),
    /// metres.
    pub(crate) fn ahead(&self, graph: &LaneGraph) -> impl Iterator<Item = (LaneId, f64)> {
        let mut start_m = -self.s_m;
        self.lanes.iter().skip(self.current).map(move |&lane| {
            let entry = (lane, start_m);
            start_m += graph.lane(lane).length_m;
            entry
        })
    }

    /// Drives on. Lanes farther back than the previous one are removed, unless a long vehicle still stands on them.
    pub(crate) fn advance(&mut self, graph: &LaneGraph, distance_m: f64, keep_behind_m: f64) {
        self.s_m += distance_m;
        if let Some(change) = &mut self.change {
            change.done_m += distance_m;
        }
        // Ends when the rear axle has left the curve too.
        self.change
            .take_if(|change| change.done_m > change.length_m + 0.5 * change.wheelbase_m);
        while self.s_m > graph.lane(self.lane()).length_m && self.current + 1 < self.lanes.len() {
            self.s_m -= graph.lane(self.lane()).length_m;
            self.current += 1;
        }
        while self.current > 0 && self.behind_m(graph) > keep_behind_m {
            self.lanes.pop_front();
            self.current -= 1;
        }
    }

    /// Distance from the end of the first lane to the centre of the vehicle, metres.
    fn behind_m(&self, graph: &LaneGraph) -> f64 {
        let lanes = self.lanes.iter().take(self.current).skip(1);
        lanes.map(|&lane| graph.lane(lane).length_m).sum::<f64>() + self.s_m
    }

    /// Lanes touched by the stretch from `behind_m` behind to the vehicle's centre, the current one first.
    pub(crate) fn lanes_under(
        &self,
        graph: &LaneGraph,
        behind_m: f64,
    ) -> impl Iterator<Item = LaneId> {
        let mut left_m = behind_m - self.s_m;
        let behind = self.lanes.iter().take(self.current).rev().copied();
        let touched = behind.take_while(move |&lane| {
            let is_touched = left_m > 0.0;
            left_m -= graph.lane(lane).length_m;
            is_touched
        });
        std::iter::once(self.lane()).chain(touched)
    }

    /// The point `offset_m` ahead of (or behind) the vehicle's centre, extrapolated straight beyond the known path.
    pub(crate) fn point_m(&self, graph: &LaneGraph, offset_m: f64) -> [f64; 3] {
        self.mixed(graph, offset_m, point_on)
    }

    /// Values of a lane property `offset_m` ahead of the vehicle's centre; during a change, mixed from both lanes.
    fn mixed<const N: usize>(
        &self,
        graph: &LaneGraph,
        offset_m: f64,
        on: impl Fn(&Lane, f64) -> [f64; N],
    ) -> [f64; N] {
        let (mut index, mut s_m) = (self.current, self.s_m + offset_m);
        while s_m < 0.0 && index > 0 {
            index -= 1;
            s_m += graph.lane(self.lanes[index]).length_m;
        }
        while s_m > graph.lane(self.lanes[index]).length_m && index + 1 < self.lanes.len() {
            s_m -= graph.lane(self.lanes[index]).length_m;
            index += 1;
        }
        let lane = graph.lane(self.lanes[index]);
        let own = on(lane, s_m);
        let Some(change) = &self.change else {
            return own;
        };
        let share = change.share(offset_m);
        match change.left_beside(lane.id) {
            Some(left) if share < 1.0 => {
                let left = graph.lane(left);
                let from = on(left, s_m / lane.length_m * left.length_m);
                std::array::from_fn(|axis| from[axis] + share * (own[axis] - from[axis]))
            }
            // Lanes behind the change are those that the vehicle came from.
            _ => own,
        }
    }

    /// Placement of a vehicle of this wheelbase after `drive_m` more metres, both axles on the path, `aside_m` to the
    /// left of it.
    pub(crate) fn placement(
        &self,
        graph: &LaneGraph,
        drive_m: f64,
        wheelbase_m: f64,
        aside_m: f64,
    ) -> Placement {
        let front = self.point_m(graph, drive_m + 0.5 * wheelbase_m);
        let rear = self.point_m(graph, drive_m - 0.5 * wheelbase_m);
        let (dx, dy, dz) = (front[0] - rear[0], front[1] - rear[1], front[2] - rear[2]);
        let base = dx.hypot(dy).max(1e-6);
        let middle: [f64; 3] = std::array::from_fn(|axis| 0.5 * (front[axis] + rear[axis]));
        let [roll_rad] = self.mixed(graph, drive_m, |lane, s_m| [lane.bank_rad(s_m)]);
        let (rise, flat) = roll_rad.sin_cos();
        let aside_flat_m = aside_m * flat;
        let position = [
            // (-dy, dx) points to the left of the heading.
            middle[0] - aside_flat_m * dy / base,
            middle[1] + aside_flat_m * dx / base,
            middle[2] + aside_m * rise,
        ];
        Placement {
            pitch_rad: dz.atan2(base),
            roll_rad,
            ..Placement::level(position, dy.atan2(dx))
        }
    }
}

/// A position on a lane, straight on before its start and behind its end.
fn point_on(lane: &Lane, s_m: f64) -> [f64; 3] {
    let (point, heading) = lane.at(s_m);
    let beyond_m = s_m - s_m.clamp(0.0, lane.length_m);
    let (sin, cos) = heading.sin_cos();
    let [x, y, z] = point;
    [x + beyond_m * cos, y + beyond_m * sin, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_lanes() -> LaneGraph {
        let [mut first, second] = [(0, 0..=20), (1, 20..=50)].map(|(id, along_m)| {
            let line = along_m
                .map(|x| [f64::from(x), 0.0, 0.1 * f64::from(x)])
                .collect();
            Lane::new(LaneId(id), line, 3.5, 10.0)
        });
        first.successors = vec![LaneId(1)];
        LaneGraph::new(vec![first, second])
    }

    #[test]
    fn a_vehicle_between_two_lanes_stands_on_both() {
        let graph = two_lanes();
        let mut path = Path::new(LaneId(0), 18.0);
        path.push(LaneId(1));
        path.advance(&graph, 3.0, 6.0);
        assert_eq!((path.lane(), path.s_m), (LaneId(1), 1.0));
        assert_eq!(
            path.lanes_under(&graph, 3.0).collect::<Vec<_>>(),
            [LaneId(1), LaneId(0)]
        );
        let placement = path.placement(&graph, 0.0, 3.0, 0.5);
        assert!((placement.position_m - nalgebra::Vector3::new(21.0, 0.5, 2.1)).norm() < 1e-9);
        assert!((placement.pitch_rad - 0.1f64.atan()).abs() < 1e-9);
        assert!((path.remaining_m(&graph) - 29.0).abs() < 1e-9);
    }

    #[test]
    fn a_change_begins_and_ends_on_the_lanes_without_a_jump() {
        let lanes = [(0, 0.0), (1, 3.5)].map(|(id, y)| {
            let line = (0..=100).map(|x| [f64::from(x), y, 0.0]).collect();
            Lane::new(LaneId(id), line, 3.5, 10.0)
        });
        let graph = LaneGraph::new(lanes.into());
        let mut path = Path::new(LaneId(0), 20.0);
        let before = path.placement(&graph, 0.0, 3.0, 0.0);
        path.change(
            vec![Beside {
                lane: LaneId(1),
                left: LaneId(0),
            }],
            20.0,
            40.0,
            3.0,
        );
        assert_eq!(path.placement(&graph, 0.0, 3.0, 0.0), before);
        assert_eq!(
            (path.lane(), path.leaving(&graph)),
            (LaneId(1), Some((LaneId(0), 20.0)))
        );
        let mut last = before;
        while path.is_changing() {
            let next = path.placement(&graph, 0.5, 3.0, 0.0);
            path.advance(&graph, 0.5, 5.0);
            assert!(
                (path.placement(&graph, 0.0, 3.0, 0.0).position_m - next.position_m).norm() < 1e-9
            );
            let moved = next.position_m - last.position_m;
            assert!(
                moved.y >= 0.0 && (moved.norm() - 0.5).abs() < 0.01,
                "{moved}"
            );
            // The nose points where the vehicle goes.
            assert!(
                (moved.y.atan2(moved.x) - next.yaw_rad).abs() < 0.02,
                "{moved} {}",
                next.yaw_rad
            );
            last = next;
        }
        assert_eq!((last.position_m.y, last.yaw_rad), (3.5, 0.0));
        assert!((last.position_m.x - 63.0).abs() < 0.6, "{last:?}");
    }

    #[test]
    fn lanes_that_lie_behind_are_forgotten() {
        let graph = two_lanes();
        let mut path = Path::new(LaneId(0), 18.0);
        path.push(LaneId(1));
        path.advance(&graph, 20.0, 6.0);
        assert_eq!(path.lanes.len(), 1);
        assert_eq!(path.point_m(&graph, 20.0)[0], 58.0);
    }
}
