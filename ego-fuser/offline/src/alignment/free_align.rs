//! FreeAlign: alignment by the largest common subgraph of both vehicles' boxes with equal distances.
//!
//! After FreeAlign (Lei et al., ICRA 2024): each vehicle's boxes are the nodes of a complete graph whose edges are the
//! distances between box centres, which are invariant to motion; from pairs of anchors the common subgraph grows
//! greedily; the largest one gives the motion. As in the code published with the paper, edges are plain distances.
//! Differences:
//!
//! - that code's loader discards matches that are far from the true pose. Here no true pose is available: a match must
//!   be plausible by itself, by its size, by boxes lying on the same side of the anchors (a mirror image has all the
//!   same distances), and by no other motion having nearly as many inliers ([`NoAlignment::Ambiguous`]);
//! - the graph network that scores edges in the paper, and the search over time steps, are left out.

use nalgebra::{Isometry3, Vector2, Vector3};
use protocol::Box3d;

use fusion::planar_fit;

/// Motions that are refined after the search, best first.
const FINALISTS: usize = 8;
/// Motions whose headings differ by less than this, radians, and positions by less than twice the tolerance of the fit,
/// are one.
const SAME_HEADING_RAD: f64 = 0.1;
/// Largest number of boxes of each vehicle, the first ones.
///
/// This and the following were chosen on detections of 160 pairs of validation scenes: 61 % are right to 3 m and 3 %
/// wrong. With edges to 0.5 m, as in the published code, 42 % and 1 %; with three matches and a lead of one 66 % and 6 %.
pub(super) const MAX_BOXES: usize = 40;
/// Edges shorter than this are ignored as ambiguous, metres.
const MIN_EDGE_M: f64 = 2.0;
/// Largest difference between the lengths of an edge in both graphs, metres.
const EDGE_TOLERANCE_M: f64 = 1.2;
/// Largest distance between two matched boxes after alignment, metres.
const FIT_TOLERANCE_M: f64 = 1.0;
/// Fewest boxes in common. Three agree by chance in every other frame.
pub const MIN_MATCHES: usize = 4;
/// Number of boxes by which the best motion must lead any other.
const MIN_LEAD: usize = 2;

/// Pose of a neighbour relative to the ego by boxes.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxAlignment {
    /// Transforms points of the neighbour's frame to the ego's; without roll and pitch.
    pub ego_from_neighbour: Isometry3<f64>,
    /// Boxes in common: index in the ego's list, index in the neighbour's.
    pub matches: Vec<(usize, usize)>,
    /// Root mean square of the horizontal distances between them, metres.
    pub rms_m: f64,
}

/// Reason for which boxes give no alignment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoAlignment {
    /// One of the two has too few boxes.
    #[error("the ego has {ego} boxes and the neighbour {neighbour}, both need at least {required}")]
    TooFewBoxes {
        /// Boxes of the ego.
        ego: usize,
        /// Boxes of the neighbour.
        neighbour: usize,
        /// Number of boxes that is required.
        required: usize,
    },
    /// They have too few boxes in common.
    #[error("at most {found} boxes are inliers, at least {required} must be")]
    TooFewMatches {
        /// Largest number of inliers.
        found: usize,
        /// Number of inliers that is required.
        required: usize,
    },
    /// Two motions have about as many inliers.
    #[error("{matches} inliers of one motion and {rival} of another")]
    Ambiguous {
        /// Inliers of the best motion.
        matches: usize,
        /// Inliers of another motion.
        rival: usize,
    },
}

/// Aligns two vehicles by their boxes, each in the frame of its own LiDAR, the most confident first, if they have at least
/// `min_matches` in common, usually [`MIN_MATCHES`].
///
/// # Errors
/// [`NoAlignment`] where the evidence is thin.
pub fn align(
    ego: &[Box3d],
    neighbour: &[Box3d],
    min_matches: usize,
) -> Result<BoxAlignment, NoAlignment> {
    let (ego, neighbour) = (BoxGraph::new(ego), BoxGraph::new(neighbour));
    let required = min_matches.max(2);
    if ego.len() < required || neighbour.len() < required {
        return Err(NoAlignment::TooFewBoxes {
            ego: ego.len(),
            neighbour: neighbour.len(),
            required,
        });
    }
    let mut search = MatchSearch {
        ego: &ego,
        neighbour: &neighbour,
        min_matches,
        largest: 0,
        motions: Vec::new(),
    };
    search.run();
    let too_few = NoAlignment::TooFewMatches {
        found: search.largest,
        required,
    };
    let mut finalists = search.finalists();
    finalists.sort_by(|a, b| {
        let by_matches = b.matches.len().cmp(&a.matches.len());
        by_matches.then(a.rms_m.total_cmp(&b.rms_m))
    });
    let best = finalists
        .first()
        .filter(|best| best.matches.len() >= required)
        .ok_or(too_few)?;
    // Repetitive scenes have several motions with many inliers: then none can be trusted.
    let motion = &best.ego_from_neighbour;
    let mut others = finalists.iter();
    let rival = others.find(|other| !same_motion(&other.ego_from_neighbour, motion));
    let rival = rival.map_or(0, |rival| rival.matches.len());
    if rival + MIN_LEAD > best.matches.len() {
        return Err(NoAlignment::Ambiguous {
            matches: best.matches.len(),
            rival,
        });
    }
    // Some boxes may not be nodes: back to the indices of the given lists.
    let matches = best.matches.iter();
    let given = matches.map(|&(a, b)| (ego.given[a], neighbour.given[b]));
    Ok(BoxAlignment {
        matches: given.collect(),
        ..best.clone()
    })
}

fn same_motion(a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
    // The length of its translation is the distance between the neighbour's two positions.
    let off = a.inv_mul(b);
    off.translation.vector.norm() < 2.0 * FIT_TOLERANCE_M && off.rotation.angle() < SAME_HEADING_RAD
}

/// Boxes and the distances between them.
struct BoxGraph {
    /// Index of each node in the given list.
    given: Vec<usize>,
    centres: Vec<Vector3<f64>>,
    /// `[N, N]`, metres, in the plane.
    edges: Vec<f64>,
}

impl BoxGraph {
    fn new(boxes: &[Box3d]) -> Self {
        // NaN fails the comparison and is left out too.
        let centres = boxes.iter().map(|node| Vector3::from(node.center_m));
        let nodes = centres
            .enumerate()
            .filter(|(_, at)| at.iter().all(|c| c.abs() < 1e6));
        let (given, centres): (Vec<_>, Vec<_>) = nodes.take(MAX_BOXES).unzip();
        let edges = centres
            .iter()
            .flat_map(|a| centres.iter().map(move |b| (a - b).xy().norm()))
            .collect();
        Self {
            given,
            centres,
            edges,
        }
    }

    fn len(&self) -> usize {
        self.centres.len()
    }

    fn edge(&self, a: usize, b: usize) -> f64 {
        self.edges[a * self.len() + b]
    }

    /// Distance of `node` to the left of the line from `a` to `b`, metres.
    fn left_of(&self, (a, b): (usize, usize), node: usize) -> f64 {
        let way: Vector2<f64> = (self.centres[b] - self.centres[a]).xy();
        // Cross product over the length of the base: positive to the left.
        way.perp(&(self.centres[node] - self.centres[a]).xy()) / way.norm()
    }
}

/// A node of the ego's graph and its candidate in the neighbour's.
type BoxMatch = (usize, usize);

struct MatchSearch<'a> {
    ego: &'a BoxGraph,
    neighbour: &'a BoxGraph,
    min_matches: usize,
    /// Most inliers so far.
    largest: usize,
    /// Different motions, each with the most boxes that led to it.
    motions: Vec<(usize, Isometry3<f64>)>,
}

impl MatchSearch<'_> {
    /// Grows a common subgraph from every pair of anchors.
    fn run(&mut self) {
        for a in 0..self.ego.len() {
            for b in 0..self.neighbour.len() {
                let candidates = self.agreeing_with((a, b));
                // The other order of the two anchors is the same pair.
                for &(_, second) in candidates.iter().filter(|(_, second)| second.0 > a) {
                    let matches = self.grown([(a, b), second], &candidates);
                    self.largest = self.largest.max(matches.len());
                    // Two anchors agree by construction: only further nodes are evidence.
                    if matches.len() >= self.min_matches.max(3) {
                        self.note(&matches);
                    }
                }
            }
        }
    }

    /// All matches whose edge to the anchor has the same length in both graphs, best first.
    fn agreeing_with(&self, anchor: BoxMatch) -> Vec<(f64, BoxMatch)> {
        let mut found = Vec::new();
        for k in 0..self.ego.len() {
            let length = self.ego.edge(anchor.0, k);
            // Short edges have about the same length everywhere.
            if length < MIN_EDGE_M {
                continue;
            }
            for l in 0..self.neighbour.len() {
                let difference = (length - self.neighbour.edge(anchor.1, l)).abs();
                if difference < EDGE_TOLERANCE_M && l != anchor.1 {
                    found.push((difference, (k, l)));
                }
            }
        }
        // Growing is greedy: the closest lengths come first.
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found
    }

    /// The anchors and, greedily, all nodes with the same distances to every node of the subgraph, on the same side.
    fn grown(&self, anchors: [BoxMatch; 2], candidates: &[(f64, BoxMatch)]) -> Vec<BoxMatch> {
        let [first, second] = anchors;
        let mut matches = anchors.to_vec();
        for &(_, (k, l)) in candidates {
            // A mirror image has the same distances and the other sign.
            let sides = self.ego.left_of((first.0, second.0), k)
                - self.neighbour.left_of((first.1, second.1), l);
            // Near the line the sign is uncertain: within the tolerance either side fits.
            if matches.iter().all(|&(a, b)| {
                a != k
                    && b != l
                    && (self.ego.edge(a, k) - self.neighbour.edge(b, l)).abs() < EDGE_TOLERANCE_M
            }) && sides.abs() < 2.0 * EDGE_TOLERANCE_M
            {
                matches.push((k, l));
            }
        }
        matches
    }

    fn note(&mut self, matches: &[BoxMatch]) {
        let Some(motion) = self.fit(matches) else {
            return;
        };
        match self
            .motions
            .iter_mut()
            .find(|(_, known)| same_motion(known, &motion))
        {
            Some(known) if known.0 < matches.len() => *known = (matches.len(), motion),
            Some(_) => {}
            None => self.motions.push((matches.len(), motion)),
        }
    }

    fn fit(&self, matches: &[BoxMatch]) -> Option<Isometry3<f64>> {
        let (ego, neighbour) = (&self.ego.centres, &self.neighbour.centres);
        planar_fit::fit(&matches.iter().map(|&(a, b)| (neighbour[b], ego[a])))
    }

    /// The best motions, each with its inliers and fitted to these.
    fn finalists(mut self) -> Vec<BoxAlignment> {
        self.motions
            .sort_by_key(|(size, _)| std::cmp::Reverse(*size));
        self.motions.truncate(FINALISTS);
        self.motions
            .iter()
            .filter_map(|(_, motion)| self.settled(motion))
            .collect()
    }

    fn settled(&self, start: &Isometry3<f64>) -> Option<BoxAlignment> {
        let mut motion = *start;
        // Inliers change with the motion: it is fitted to them twice.
        for _ in 0..2 {
            motion = self.fit(&self.together(&motion))?;
        }
        let matches = self.together(&motion);
        let apart = matches.iter().map(|&pair| self.apart(pair, &motion));
        let squares: f64 = apart.map(|apart_m| apart_m.powi(2)).sum();
        let rms_m = (squares / matches.len().max(1) as f64).sqrt();
        Some(BoxAlignment {
            ego_from_neighbour: motion,
            matches,
            rms_m,
        })
    }

    /// Inliers of a motion, one to one, nearest first.
    fn together(&self, motion: &Isometry3<f64>) -> Vec<BoxMatch> {
        let all = (0..self.ego.len()).flat_map(|a| (0..self.neighbour.len()).map(move |b| (a, b)));
        let distances = all.map(|pair| (self.apart(pair, motion), pair));
        let near = distances.filter(|(distance, _)| *distance < FIT_TOLERANCE_M);
        planar_fit::one_to_one(near.collect())
    }

    /// Horizontal distance between two boxes after a motion, metres.
    fn apart(&self, (a, b): BoxMatch, motion: &Isometry3<f64>) -> f64 {
        let moved = motion.rotation * self.neighbour.centres[b] + motion.translation.vector;
        (moved - self.ego.centres[a]).xy().norm()
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn boxes(centres: impl IntoIterator<Item = Vector3<f64>>) -> Vec<Box3d> {
        centres
            .into_iter()
            .map(|centre| Box3d {
                center_m: centre.into(),
                size_m: [4.5, 1.9, 1.6],
                heading_rad: 0.0,
            })
            .collect()
    }

    fn scattered(count: usize, random: &mut ChaCha8Rng) -> Vec<Vector3<f64>> {
        (0..count)
            .map(|_| {
                Vector3::new(
                    random.random_range(-50.0..50.0),
                    random.random_range(-38.0..38.0),
                    -1.0,
                )
            })
            .collect()
    }

    /// A point with noise up to `noise_m` in x and in y.
    fn noisy(point: &Vector3<f64>, noise_m: f64, random: &mut ChaCha8Rng) -> Vector3<f64> {
        let x = random.random_range(-noise_m..=noise_m);
        let y = random.random_range(-noise_m..=noise_m);
        point + Vector3::new(x, y, 0.0)
    }

    /// Boxes that two vehicles detect of `shared` vehicles and of `others` each, in their own frames, with noise up to
    /// `noise_m`.
    fn views(
        seed: u64,
        shared: usize,
        others: usize,
        noise_m: f64,
    ) -> (Isometry3<f64>, Vec<Box3d>, Vec<Box3d>) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let heading = random.random_range(-3.1..3.1);
        let truth = Isometry3::new(
            Vector3::new(random.random_range(-40.0..40.0), 15.0, 0.3),
            Vector3::z() * heading,
        );
        let common = scattered(shared, &mut random);
        let mut ego: Vec<_> = common
            .iter()
            .map(|point| noisy(point, noise_m, &mut random))
            .collect();
        let inverse = truth.inverse();
        let mut neighbour: Vec<_> = common
            .iter()
            .map(|point| {
                let point = inverse.rotation * point + inverse.translation.vector;
                noisy(&point, noise_m, &mut random)
            })
            .collect();
        ego.extend(scattered(others, &mut random));
        neighbour.splice(0..0, scattered(others, &mut random));
        (truth, boxes(ego), boxes(neighbour))
    }

    #[test]
    fn shared_boxes_are_found_among_others() {
        for seed in 0..40 {
            let (truth, ego, neighbour) = views(seed, 7, 8, 0.1);
            let found = align(&ego, &neighbour, MIN_MATCHES).unwrap();
            let off = truth.inv_mul(&found.ego_from_neighbour);
            assert!(
                off.translation.vector.norm() < 0.4 && off.rotation.angle() < 0.02,
                "seed {seed}: {off}"
            );
            let right = found
                .matches
                .iter()
                .filter(|(a, b)| *b == a + 8 && *a < 7)
                .count();
            assert!(right >= 7 && found.rms_m < 0.3, "seed {seed}: {found:?}");
        }
    }

    #[test]
    fn views_without_common_boxes_are_rarely_aligned() {
        let aligned = (0..60).filter(|seed| {
            let (_, ego, neighbour) = views(*seed, 0, 12, 0.0);
            align(&ego, &neighbour, 5).is_ok()
        });
        let count = aligned.count();
        assert!(count <= 6, "{count} of 60");
    }

    #[test]
    fn too_few_boxes_are_reported() {
        let (_, ego, neighbour) = views(1, 3, 0, 0.0);
        let refused = NoAlignment::TooFewBoxes {
            ego: 3,
            neighbour: 3,
            required: 4,
        };
        assert_eq!(align(&ego, &neighbour, MIN_MATCHES), Err(refused));
        assert!(align(&[], &[], MIN_MATCHES).is_err());
        let nowhere = boxes([Vector3::repeat(f64::NAN); 9]);
        let refused = NoAlignment::TooFewBoxes {
            ego: 0,
            neighbour: 3,
            required: 4,
        };
        assert_eq!(align(&nowhere, &neighbour, MIN_MATCHES), Err(refused));
    }

    #[test]
    fn a_mirror_image_is_no_match() {
        for seed in 0..20 {
            let (_, ego, _) = views(seed, 9, 0, 0.0);
            let mirrored: Vec<_> = ego
                .iter()
                .map(|node| Box3d {
                    center_m: [node.center_m[0], -node.center_m[1], node.center_m[2]],
                    ..*node
                })
                .collect();
            let found = align(&ego, &mirrored, 6);
            assert!(
                matches!(found, Err(NoAlignment::TooFewMatches { required: 6, .. })),
                "{found:?}"
            );
        }
    }

    #[test]
    fn a_row_of_parked_cars_could_be_anywhere_along_itself() {
        let [ego, neighbour] = [0..8, -3..5]
            .map(|row| boxes(row.map(|k| Vector3::new(f64::from(k) * 6.0, 5.0, -1.0))));
        let found = align(&ego, &neighbour, MIN_MATCHES);
        assert!(
            matches!(found, Err(NoAlignment::Ambiguous { .. })),
            "{found:?}"
        );
        // And an arrangement that is symmetric under a half turn.
        let cross = [
            [20.0, 4.0],
            [-20.0, -4.0],
            [12.0, -9.0],
            [-12.0, 9.0],
            [30.0, -17.0],
            [-30.0, 17.0],
        ];
        let cross = boxes(cross.map(|[x, y]| Vector3::new(x, y, -1.0)));
        let found = align(&cross, &cross, MIN_MATCHES);
        assert_eq!(
            found,
            Err(NoAlignment::Ambiguous {
                matches: 6,
                rival: 6
            })
        );
    }

    #[test]
    fn one_car_more_settles_where_along_the_row() {
        let mut row: Vec<_> = (0..6)
            .map(|k| Vector3::new(f64::from(k) * 6.0, 5.0, -1.0))
            .collect();
        row.extend([
            Vector3::new(11.0, -14.0, -1.0),
            Vector3::new(-20.0, 1.0, -1.0),
        ]);
        let truth = Isometry3::new(Vector3::new(7.0, 3.0, 0.0), Vector3::z() * 1.3);
        let moved = row
            .iter()
            .map(|point| truth.inverse().rotation * point + truth.inverse().translation.vector);
        let found = align(&boxes(row.clone()), &boxes(moved), MIN_MATCHES).unwrap();
        assert!(
            truth
                .inv_mul(&found.ego_from_neighbour)
                .translation
                .vector
                .norm()
                < 1e-6
        );
        assert_eq!(found.matches.len(), 8);
    }
}
