//! Transforms between the frames of a bag: fixed ones and moving ones, over any number of frames between.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::Isometry3;

use crate::trajectory::{Trajectory, Unposed};

/// Frames whose coordinates do not drift, by the last part of their names (REP-105, and those of mapping programs).
const MAP_FRAMES: [&str; 6] = ["map", "world", "earth", "utm", "enu", "global"];

/// All transforms.
#[derive(Debug, Default)]
pub(super) struct Transforms {
    edges: Vec<Edge>,
}

#[derive(Debug)]
struct Edge {
    parent: String,
    child: String,
    motion: Motion,
}

/// A transform over time.
#[derive(Debug)]
pub(super) enum Motion {
    /// `parent_from_child`.
    Fixed(Isometry3<f64>),
    Moving(Trajectory),
}

/// Transforms from one frame to another, in the order in which they are multiplied.
#[derive(Debug, Clone, Default)]
pub(super) struct FrameRoute(Vec<RouteStep>);

#[derive(Debug, Clone, Copy)]
struct RouteStep {
    edge: usize,
    /// True from parent to child.
    is_down: bool,
}

impl Transforms {
    pub(super) fn add(&mut self, parent: &str, child: &str, motion: Motion) {
        self.edges.push(Edge {
            parent: parent.to_owned(),
            child: child.to_owned(),
            motion,
        });
    }

    /// A frame whose last part is `name` and that carries `frame`, by [`Self::route_down`].
    pub(super) fn find(&self, name: &str, frame: &str) -> Option<&str> {
        let frames = self
            .edges
            .iter()
            .flat_map(|edge| [edge.parent.as_str(), &edge.child]);
        let mut named = frames.filter(|frame| last_part(frame) == name);
        named.find(|body| self.route_down(body, frame).is_some())
    }

    /// The shortest way from the body of a robot to a frame on it: joints may move, the body itself does not.
    pub(super) fn route_down(&self, body: &str, frame: &str) -> Option<FrameRoute> {
        let route = self.route(body, frame)?;
        let mut steps = route.0.iter();
        let is_held = steps.all(|step| step.is_down || self.moving(step).is_none());
        is_held.then_some(route)
    }

    /// The trajectory of a step, if it is no fixed transform.
    fn moving(&self, step: &RouteStep) -> Option<&Trajectory> {
        match &self.edges.get(step.edge)?.motion {
            Motion::Moving(poses) => Some(poses),
            Motion::Fixed(_) => None,
        }
    }

    /// The shortest way from `target` to `source`; `None` if they are not connected.
    pub(super) fn route(&self, target: &str, source: &str) -> Option<FrameRoute> {
        let mut reached = BTreeMap::<&str, Option<(&str, RouteStep)>>::from([(target, None)]);
        // Breadth first, over transforms in both directions: the first way found is the shortest.
        let mut open = VecDeque::from([target]);
        while let Some(frame) = open.pop_front().filter(|frame| *frame != source) {
            for (edge, Edge { parent, child, .. }) in self.edges.iter().enumerate() {
                for (from, to, is_down) in [(parent, child, true), (child, parent, false)] {
                    if from == frame && !reached.contains_key(to.as_str()) {
                        reached.insert(to, Some((frame, RouteStep { edge, is_down })));
                        open.push_back(to);
                    }
                }
            }
        }
        let mut steps = Vec::new();
        let mut at = reached.get(source)?;
        while let Some((before, step)) = at {
            steps.push(*step);
            at = reached.get(before)?;
        }
        steps.reverse();
        Some(FrameRoute(steps))
    }

    /// `target_from_source` along a route, at a time in nanoseconds.
    pub(super) fn along(&self, route: &FrameRoute, nanos: u64) -> Result<Isometry3<f64>, Unposed> {
        let mut target_from_source = Isometry3::identity();
        for step in &route.0 {
            let parent_from_child = match self.edges.get(step.edge).map(|edge| &edge.motion) {
                Some(Motion::Fixed(pose)) => *pose,
                Some(Motion::Moving(poses)) => poses.at(nanos)?,
                None => return Err(Unposed::Outside),
            };
            // On the right: the route leads from the target to the source.
            target_from_source *= match step.is_down {
                true => parent_from_child,
                false => parent_from_child.inverse(),
            };
        }
        Ok(target_from_source)
    }

    /// The trajectory along a route that has the fewest poses.
    pub(super) fn sparsest(&self, route: &FrameRoute) -> Option<&Trajectory> {
        let moving = route.0.iter().filter_map(|step| self.moving(step));
        moving.min_by_key(|poses| poses.len())
    }

    /// The frames in which `frame` moves and that may serve as the world: those of maps and odometry, and the topmost.
    /// A frame that is fixed to one of these adds nothing.
    pub(super) fn worlds_of(&self, frame: &str) -> Vec<(&str, FrameRoute)> {
        let moving = self
            .edges
            .iter()
            .filter(|edge| matches!(edge.motion, Motion::Moving(_)));
        let parents: BTreeSet<&str> = moving.map(|edge| edge.parent.as_str()).collect();
        let worlds = parents.into_iter().filter(|parent| {
            let is_topmost = !self.edges.iter().any(|edge| edge.child == *parent);
            let name = last_part(parent);
            is_map(parent) || name.contains("odom") || is_topmost && !name.starts_with("base")
        });
        worlds
            .filter_map(|parent| Some((parent, self.route(parent, frame)?)))
            .filter(|(_, route)| self.begins_moving(route))
            .collect()
    }

    fn begins_moving(&self, route: &FrameRoute) -> bool {
        let first = route.0.first();
        first.is_some_and(|step| step.is_down && self.moving(step).is_some())
    }
}

/// True for the frame of a map, whose coordinates do not drift.
pub(super) fn is_map(frame: &str) -> bool {
    MAP_FRAMES.contains(&last_part(frame))
}

fn last_part(frame: &str) -> &str {
    frame.rsplit('/').next().unwrap_or(frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moved(x: f64) -> Isometry3<f64> {
        Isometry3::translation(x, 0.0, 0.0)
    }

    /// From x = 0 at 0 to `x` at 10.
    fn moving(x: f64) -> Trajectory {
        Trajectory::new(vec![(0, moved(0.0)), (10, moved(x))], 100).0
    }

    fn robot() -> Transforms {
        let mut transforms = Transforms::default();
        transforms.add("base_link", "mast", Motion::Fixed(moved(1.0)));
        transforms.add("mast", "lidar", Motion::Fixed(moved(0.5)));
        transforms.add("odom", "base_link", Motion::Moving(moving(20.0)));
        transforms.add("map", "odom", Motion::Moving(moving(2.0)));
        transforms.add("base_link", "wheel", Motion::Moving(moving(9.0)));
        transforms
    }

    #[test]
    fn frames_are_connected_over_others_in_both_directions() {
        let transforms = robot();
        for (target, source, nanos, expected) in [
            ("map", "lidar", 5, Ok(1.0 + 10.0 + 1.5)),
            ("lidar", "map", 5, Ok(-12.5)),
            ("wheel", "lidar", 10, Ok(1.5 - 9.0)),
            ("lidar", "lidar", 99, Ok(0.0)),
            ("odom", "lidar", 11, Err(Unposed::Outside)),
        ] {
            let route = transforms.route(target, source).unwrap();
            let pose = transforms.along(&route, nanos);
            assert_eq!(
                pose.map(|pose| pose.translation.x),
                expected,
                "{target} {source}"
            );
        }
        assert!(transforms.route("map", "camera").is_none());
    }

    fn world_names<'a>(transforms: &'a Transforms, frame: &str) -> Vec<&'a str> {
        let worlds = transforms.worlds_of(frame);
        worlds.into_iter().map(|(world, _)| world).collect()
    }

    #[test]
    fn worlds_are_maps_odometry_and_the_topmost_moving_frame() {
        assert_eq!(world_names(&robot(), "lidar"), ["map", "odom"]);
        let mut fixed = Transforms::default();
        fixed.add("map", "odom", Motion::Fixed(moved(5.0)));
        fixed.add("odom", "base_link", Motion::Moving(moving(1.0)));
        assert_eq!(
            world_names(&fixed, "base_link"),
            ["odom"],
            "the map is odometry by another name"
        );
        let mut head = Transforms::default();
        head.add("base_link", "head", Motion::Moving(moving(1.0)));
        assert!(
            world_names(&head, "head").is_empty(),
            "a robot does not move in its own body"
        );
        let mut other = Transforms::default();
        other.add("camera_init", "body", Motion::Moving(moving(1.0)));
        assert_eq!(world_names(&other, "body"), ["camera_init"]);
        assert!(is_map("robot1/map") && !is_map("odom"));
    }
}
