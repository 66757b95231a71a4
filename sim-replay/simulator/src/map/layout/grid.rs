//! Street graphs: a grid with some streets left out and everything a little out of line.

use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::streets::{StreetGraph, StreetNode};

/// Parameters of a grid of streets.
pub(super) struct GridPlan {
    /// x of the columns, metres, rising.
    pub columns_m: Vec<f64>,
    /// Number of rows.
    pub rows: usize,
    /// Share of the streets to leave out.
    pub left_out: f64,
    /// Largest shift of a crossing, metres.
    pub jitter_m: f64,
}

/// Spreads `count` values over `low..=high`, the inner ones shifted by up to `share` of their distance.
pub(super) fn spread(
    low: f64,
    high: f64,
    count: usize,
    share: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<f64> {
    let step = (high - low) / (count - 1) as f64;
    (0..count)
        .map(|place| {
            let is_end = place == 0 || place + 1 == count;
            let shift = if is_end {
                0.0
            } else {
                rng.random_range(-share..share)
            };
            low + (place as f64 + shift) * step
        })
        .collect()
}

/// A grid whose column at `x` reaches over `y_range(x)`. Every street can be left at both ends: every node has at least
/// two streets, and the grid is connected. With a `port`, the node nearest to it has a street to it.
pub(super) fn grid(
    plan: &GridPlan,
    port: Option<Pose2>,
    rng: &mut ChaCha8Rng,
    y_range: impl Fn(f64) -> [f64; 2],
) -> StreetGraph {
    let mut calm = 1.0;
    loop {
        let mut graph = full_grid(plan, &y_range, calm, rng);
        leave_out(&mut graph, plan.left_out, rng);
        if let Some(port) = port {
            // Ties the node nearest to `port` to it.
            let nodes = graph.nodes.iter();
            let distances = nodes.map(|node| (node.x - port.x).hypot(node.y - port.y));
            let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
            let nearest = nearest.map_or(0, |(node, _)| node);
            graph.nodes.push(StreetNode {
                x: port.x,
                y: port.y,
                port: Some(port),
            });
            graph.edges.push([nearest, graph.nodes.len() - 1]);
        }
        // Without any jitter the grid matches its plan: accept it as it is.
        if graph.has_room() || calm < 0.05 {
            return graph;
        }
        calm *= 0.9;
    }
}

/// All streets of a plan, with its irregularity times `calm`.
fn full_grid(
    plan: &GridPlan,
    y_range: impl Fn(f64) -> [f64; 2],
    calm: f64,
    rng: &mut ChaCha8Rng,
) -> StreetGraph {
    let rows = spread(0.0, 1.0, plan.rows, 0.2 * calm, rng);
    // A range without width cannot be drawn from.
    let jitter = (plan.jitter_m * calm).max(1e-3);
    let mut graph = StreetGraph::default();
    let ranges: Vec<[f64; 2]> = plan.columns_m.iter().map(|&x| y_range(x)).collect();
    // The smaller `calm`, the closer all columns are to their common shape: then the rows are at right angles to them.
    let common = ranges
        .iter()
        .fold([f64::NEG_INFINITY, f64::INFINITY], |[a, b], [low, high]| {
            [a.max(*low), b.min(*high)]
        });
    for (&x, own) in plan.columns_m.iter().zip(&ranges) {
        let [low, high] = [0, 1].map(|end| common[end] + calm * (own[end] - common[end]));
        for &row in &rows {
            let [dx, dy] = [(); 2].map(|()| rng.random_range(-jitter..jitter));
            let (x, y, port) = (x + dx, low + row * (high - low) + dy, None);
            graph.nodes.push(StreetNode { x, y, port });
        }
    }
    for column in 0..plan.columns_m.len() {
        for row in 0..plan.rows {
            let node = column * plan.rows + row;
            if row + 1 < plan.rows {
                graph.edges.push([node, node + 1]);
            }
            if column + 1 < plan.columns_m.len() {
                graph.edges.push([node, node + plan.rows]);
            }
        }
    }
    graph
}

fn leave_out(graph: &mut StreetGraph, share: f64, rng: &mut ChaCha8Rng) {
    let wanted = (graph.edges.len() as f64 * share).round() as usize;
    let mut order = graph.edges.clone();
    order.shuffle(rng);
    let mut removed = 0;
    for edge in order {
        if removed == wanted {
            break;
        }
        // A node with two streets would become a dead end.
        if edge.iter().any(|&node| graph.degree(node) <= 2) {
            continue;
        }
        let mut without = graph.clone();
        without.edges.retain(|other| *other != edge);
        if two_ways_everywhere(&without) {
            *graph = without;
            removed += 1;
        }
    }
}

/// True if everything stays connected with any one street closed: then no street is a dead end.
fn two_ways_everywhere(graph: &StreetGraph) -> bool {
    (0..graph.edges.len()).all(|closed| {
        let mut reached = vec![false; graph.nodes.len()];
        let mut open = vec![0];
        reached[0] = true;
        while let Some(node) = open.pop() {
            for (index, &[a, b]) in graph.edges.iter().enumerate() {
                if index != closed && (a == node || b == node) {
                    let next = if a == node { b } else { a };
                    if !reached[next] {
                        reached[next] = true;
                        open.push(next);
                    }
                }
            }
        }
        reached.into_iter().all(|reached| reached)
    })
}
