//! Streets: makes roads, corners and junctions from a graph of nodes and edges.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::super::lane::wrap_angle;
use super::super::profile::Profile;
use super::super::road::{LaneKind, LaneSection, RoadEnd};
use super::builder::{Builder, path, section};

/// Half of the largest angle by which a street leaves its edge's direction, radians.
const WIGGLE_RAD: f64 = 0.16;
/// Shortest straight distance between two ends of a street that may wiggle, metres.
const WIGGLE_MIN_M: f64 = 55.0;
/// Kerb radius at junctions, metres.
const KERB_RADIUS_M: f64 = 5.0;

/// Half width of a broad street, metres.
const BROAD_M: f64 = 10.0;
/// Least length of a street between its junctions, metres.
const LEAST_STREET_M: f64 = 12.0;

/// A place where streets meet, turn or end.
#[derive(Debug, Clone, Copy)]
pub(super) struct StreetNode {
    pub x: f64,
    pub y: f64,
    /// Set where the one street of this node ends at a road that is already laid out: the pose there, facing outwards,
    /// into the street.
    pub port: Option<Pose2>,
}

/// Places and the streets between them.
#[derive(Debug, Clone, Default)]
pub(super) struct StreetGraph {
    pub nodes: Vec<StreetNode>,
    pub edges: Vec<[usize; 2]>,
}

/// A street from junction to junction (or port), past corners.
struct Chain {
    /// Nodes in order.
    nodes: Vec<usize>,
    lanes: LaneSection,
    /// Angles by which it leaves its first and its last edge's direction, radians.
    wiggle_rad: [f64; 2],
}

impl Chain {
    /// Its first and its last node, each with the node beside it.
    fn ends(&self) -> [[usize; 2]; 2] {
        let last = self.nodes.len() - 1;
        [[0, 1], [last, last - 1]].map(|places| places.map(|place| self.nodes[place]))
    }
}

impl StreetGraph {
    pub(super) fn degree(&self, node: usize) -> usize {
        let ends = self.edges.iter().flatten();
        ends.filter(|&&end| end == node).count()
    }

    fn angle(&self, from: usize, to: usize) -> f64 {
        (self.nodes[to].y - self.nodes[from].y).atan2(self.nodes[to].x - self.nodes[from].x)
    }

    fn distance_m(&self, a: usize, b: usize) -> f64 {
        (self.nodes[b].x - self.nodes[a].x).hypot(self.nodes[b].y - self.nodes[a].y)
    }

    /// True if every street is long enough for the junctions and corners at its ends, even a broad one.
    pub(super) fn has_room(&self) -> bool {
        let mut edges = self.edges.iter();
        edges.all(|&[a, b]| {
            let radii_m = self.broad_radius_m(a) + self.broad_radius_m(b);
            self.distance_m(a, b) > radii_m + LEAST_STREET_M
        })
    }

    /// Distance from a node's middle at which broad streets begin, metres.
    fn broad_radius_m(&self, node: usize) -> f64 {
        if self.nodes[node].port.is_some() {
            return 0.0;
        }
        let around = self.edges.iter().filter(|edge| edge.contains(&node));
        let others = around.map(|&[a, b]| if a == node { b } else { a });
        let arms = others.map(|other| (self.angle(node, other), BROAD_M));
        junction_radius_m(&arms.collect::<Vec<_>>())
    }

    /// A node at which streets end: three or more meet there, or it is a port.
    fn is_end(&self, node: usize) -> bool {
        self.nodes[node].port.is_some() || self.degree(node) != 2
    }
}

/// Lays out the streets of `graph`. Returns the road ends at ports, by rising node.
pub(super) fn lay_out(
    builder: &mut Builder,
    graph: &StreetGraph,
    limit_mps: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<RoadEnd> {
    let chains = chains(graph, rng);
    // Distance from each junction's middle at which its roads begin, metres: far enough that their edges do not
    // overlap.
    let mut arms: Vec<Vec<(f64, f64)>> = vec![Vec::new(); graph.nodes.len()];
    for chain in &chains {
        let half = half_width_m(&chain.lanes);
        for [node, next] in chain.ends() {
            arms[node].push((graph.angle(node, next), half));
        }
    }
    let radii: Vec<f64> = arms.iter().map(|arms| junction_radius_m(arms)).collect();
    // Road ends by node, in the order of the chains.
    let mut ends: Vec<Vec<RoadEnd>> = vec![Vec::new(); graph.nodes.len()];
    for chain in &chains {
        let curves = path(&poses(graph, chain, &radii));
        let lanes = chain.lanes.clone();
        let road = builder.road(curves, Profile::default(), lanes, limit_mps);
        let [[first, _], [last, _]] = chain.ends();
        ends[first].push(RoadEnd::start(road));
        ends[last].push(RoadEnd::end(road));
    }
    let mut ports: Vec<RoadEnd> = Vec::new();
    for (node, ends) in ends.iter().enumerate() {
        if graph.nodes[node].port.is_some() {
            ports.extend(ends);
        } else if ends.len() > 1 {
            let junction = builder.junction();
            join(builder, junction, ends, limit_mps);
        }
    }
    ports
}

/// Connects every lane into a junction with a lane out of every other road.
fn join(builder: &mut Builder, junction: usize, ends: &[RoadEnd], limit_mps: f64) {
    for &from in ends {
        for &to in ends {
            if from == to {
                continue;
            }
            let [from_rad, to_rad] = [from, to].map(|end| builder.outward_pose(end).heading_rad);
            // Both poses face into the junction, so the way out is the opposite heading of `to`.
            let turn = wrap_angle(to_rad + std::f64::consts::PI - from_rad);
            // Turning traffic slows down.
            let most_mps = if turn.abs() > 0.5 { 7.0 } else { f64::INFINITY };
            let limit = limit_mps.min(most_mps);
            let (incoming, outgoing) = (builder.incoming(from), builder.outgoing(to));
            for (&lane_in, &lane_out) in incoming.iter().zip(&outgoing) {
                builder.connect(junction, lane_in, lane_out, limit);
            }
        }
    }
}

fn chains(graph: &StreetGraph, rng: &mut ChaCha8Rng) -> Vec<Chain> {
    let mut used = vec![false; graph.edges.len()];
    let mut chains = Vec::new();
    for start in 0..graph.nodes.len() {
        if !graph.is_end(start) {
            continue;
        }
        while let Some(first) =
            (0..used.len()).find(|&edge| !used[edge] && graph.edges[edge].contains(&start))
        {
            let mut nodes = vec![start];
            let mut edge = Some(first);
            while let Some(current) = edge {
                used[current] = true;
                let [a, b] = graph.edges[current];
                let next = if a == nodes[nodes.len() - 1] { b } else { a };
                nodes.push(next);
                let ends_here = graph.is_end(next);
                edge = (0..used.len())
                    .find(|&edge| !ends_here && !used[edge] && graph.edges[edge].contains(&next));
            }
            let wiggle_rad = [(); 2].map(|()| rng.random_range(-WIGGLE_RAD..WIGGLE_RAD));
            chains.push(Chain {
                nodes,
                lanes: street_lanes(rng),
                wiggle_rad,
            });
        }
    }
    chains
}

/// Lanes of one street: a lane each way, with or without parking, verge and broad pavements.
fn street_lanes(rng: &mut ChaCha8Rng) -> LaneSection {
    let has_verge = rng.random_bool(0.3);
    let verge_m = has_verge.then(|| rng.random_range(1.2..2.4));
    let sidewalk_m = rng.random_range(1.6..3.4);
    let [left, right] = [(); 2].map(|()| {
        let mut lanes = vec![(LaneKind::Driving, 3.5)];
        lanes.push(match rng.random_bool(0.6) {
            true => (LaneKind::Parking, 2.3),
            false => (LaneKind::Shoulder, 0.5),
        });
        lanes.extend(verge_m.map(|verge_m| (LaneKind::Other, verge_m)));
        lanes.push((LaneKind::Sidewalk, sidewalk_m));
        lanes
    });
    section(&left, &right)
}

/// Width of the wider side of a street, metres.
fn half_width_m(lanes: &LaneSection) -> f64 {
    let [left, right] = [&lanes.left, &lanes.right].map(|side| {
        let widths = side.iter().map(|lane| lane.width.at(0.0));
        widths.sum::<f64>()
    });
    left.max(right)
}

/// Distance from a junction's middle at which its roads begin, metres, from the directions and half widths of its arms.
fn junction_radius_m(arms: &[(f64, f64)]) -> f64 {
    let mut radius = arms.iter().map(|&(_, half)| half).fold(0.0, f64::max) + KERB_RADIUS_M;
    for (i, &(angle_a, half_a)) in arms.iter().enumerate() {
        for &(angle_b, half_b) in &arms[i + 1..] {
            // Two neighbouring streets may wiggle towards each other.
            let between = wrap_angle(angle_b - angle_a).abs() - 2.0 * WIGGLE_RAD;
            if between < 1.5 {
                // w (1 + cos) / sin = w / tan(angle / 2): where the edges of two arms of half width w meet.
                let corner = (half_a.max(half_b) * (1.0 + between.cos())) / between.max(0.4).sin();
                radius = radius.max(corner + 2.0);
            }
        }
    }
    radius
}

/// Poses through which a street's reference line leads.
fn poses(graph: &StreetGraph, chain: &Chain, radii: &[f64]) -> Vec<Pose2> {
    let last = chain.nodes.len() - 1;
    let mut poses = vec![end_pose(graph, chain, radii, 0)];
    for place in 1..last {
        let [before, corner, after] = [place - 1, place, place + 1].map(|place| chain.nodes[place]);
        let shorter_m = graph
            .distance_m(before, corner)
            .min(graph.distance_m(corner, after));
        let reach = (0.4 * shorter_m).min(22.0);
        let StreetNode { x, y, .. } = graph.nodes[corner];
        poses.push(Pose2::new(x, y, graph.angle(before, corner)).moved(-reach, 0.0, 0.0));
        poses.push(Pose2::new(x, y, graph.angle(corner, after)).moved(reach, 0.0, 0.0));
    }
    poses.push(end_pose(graph, chain, radii, 1).reversed());
    poses
}

/// Pose at which a street begins at its first (0) or last (1) node, facing into the street.
fn end_pose(graph: &StreetGraph, chain: &Chain, radii: &[f64], which: usize) -> Pose2 {
    let [node, next] = chain.ends()[which];
    if let Some(port) = graph.nodes[node].port {
        return port;
    }
    let mut heading_rad = graph.angle(node, next);
    if graph.distance_m(node, next) > WIGGLE_MIN_M {
        heading_rad += chain.wiggle_rad[which];
    }
    let middle = Pose2::new(graph.nodes[node].x, graph.nodes[node].y, heading_rad);
    middle.moved(radii[node], 0.0, 0.0)
}
