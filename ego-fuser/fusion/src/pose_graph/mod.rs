//! Pose graph of CoAlign (Lu et al., ICRA 2023): corrects poses by commonly observed objects.
//!
//! Agents and objects are nodes, every box is an edge between the agent that detects it and its object, weighted by the
//! accuracy of the box. The ego is fixed; agents and objects move until the boxes fit best.
//!
//! Differences from the published code: there, boxes are one object when they lie within 1.5 m of each other, which
//! fails with an error of 2 m and a degree at 60 m; here the matching may move an agent by as much as its pose may be
//! wrong, and uses the motion with the most inliers ([`consensus`](self)). Its detector predicts the uncertainty of
//! every box; this one does not, and the uncertainty is derived from score and distance. Agents stay near their own
//! poses by a weak prior, so that few common boxes do not rotate an agent; and corrections below the accuracy of boxes
//! are discarded.

mod config;
mod consensus;
mod optimise;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use protocol::{Detection, Pose};

pub use config::PoseGraphConfig;
use consensus::{apart, consensus, moved};
use optimise::{Graph, Observation, PlanarPose};

/// An agent with its detections.
#[derive(Debug, Clone, Copy)]
pub struct Observer<'a> {
    /// Its uncorrected pose, LiDAR frames.
    pub ego_from_agent: Pose,
    /// Its boxes in the frame of its own LiDAR.
    pub boxes: &'a [Detection],
}

/// Distance at which a box is half as accurate as nearby, metres.
const HALF_EXACT_M: f64 = 60.0;

/// A box of an agent, in the plane.
struct ObservedBox {
    /// In the frame of the agent, height left out.
    center: Vector3<f64>,
    heading_rad: f64,
    std_m: f64,
    std_rad: f64,
}

impl ObservedBox {
    fn new(found: &Detection, config: &PoseGraphConfig) -> Option<Self> {
        let [x, y, _] = found.box3d.center_m;
        let center = Vector3::new(x, y, 0.0);
        let heading_rad = found.box3d.heading_rad;
        let is_sound =
            // NaN and infinity fail the comparison too.
            center.norm() < 1e4 && heading_rad.is_finite() && found.score >= config.min_score;
        let scale =
            (1.0 + center.norm() / HALF_EXACT_M) / f64::from(found.score.clamp(0.1, 1.0)).sqrt();
        is_sound.then_some(Self {
            center,
            heading_rad,
            std_m: config.box_std_m * scale,
            std_rad: config.box_std_deg.to_radians() * scale,
        })
    }
}

/// Corrects the poses of all agents relative to the first, the ego, whose pose stays, as do those of agents that share
/// too few objects.
///
/// Agents join one after another, those first that share most with the joined ones: an agent that shares nothing with
/// the ego may still be aligned through a third.
pub fn correct(agents: &[Observer<'_>], config: &PoseGraphConfig) -> Vec<Pose> {
    let seen = agents.iter().map(|agent| sound_boxes(agent.boxes, config));
    let seen: Vec<Vec<ObservedBox>> = seen.collect();
    let priors = agents.iter().map(|agent| flattened(&agent.ego_from_agent));
    let priors: Vec<Isometry3<f64>> = priors.collect();
    let mut corrected: Vec<Pose> = agents.iter().map(|agent| agent.ego_from_agent).collect();
    let Some(own) = seen.first() else {
        return corrected;
    };
    let mut graph = Assembly::default();
    graph.join(0, &Isometry3::identity(), own, &[]);
    let mut waiting: Vec<usize> = (1..agents.len()).collect();
    while let Some((place, found)) = graph.next(&waiting, &seen, &priors, config) {
        let agent = waiting.remove(place);
        graph.join(agent, &found.motion, &seen[agent], &found.matches);
    }
    if graph.joined.len() < 2 {
        return corrected;
    }
    for (agent, solved) in graph.solve(&priors, config) {
        let centers = seen[agent].iter().map(|seen| &seen.center);
        if apart(centers, &priors[agent], &solved) < config.dead_zone_m {
            continue;
        }
        // The planar correction is applied from the left, so height, roll and pitch of the pose are kept.
        let moved = solved * priors[agent].inverse();
        corrected[agent] = (moved * agents[agent].ego_from_agent.isometry()).into();
    }
    corrected
}

fn sound_boxes(boxes: &[Detection], config: &PoseGraphConfig) -> Vec<ObservedBox> {
    let mut sorted: Vec<&Detection> = boxes.iter().collect();
    sorted.sort_by(|a, b| b.score.total_cmp(&a.score));
    sorted
        .into_iter()
        .filter_map(|found| ObservedBox::new(found, config))
        // After the filter: boxes that are not sound do not use up the limit.
        .take(config.max_boxes)
        .collect()
}

/// Planar position and heading.
fn flattened(pose: &Pose) -> Isometry3<f64> {
    planar(&PlanarPose::new(&pose.translation_m.into(), pose.yaw_rad()))
}

fn planar(node: &PlanarPose) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), node.heading_rad);
    Isometry3::from_parts(node.place().into(), turn)
}

/// The inverse of [`planar`].
fn node_of(motion: &Isometry3<f64>) -> PlanarPose {
    PlanarPose::new(&motion.translation.vector, motion.rotation.euler_angles().2)
}

/// The graph while agents join it.
#[derive(Default)]
struct Assembly {
    /// In the frame of the ego.
    objects: Vec<PlanarPose>,
    /// Agents here are indices into `joined`.
    observations: Vec<Observation>,
    joined: Vec<(usize, Isometry3<f64>)>,
}

impl Assembly {
    /// Of those waiting, the index of the one that shares most with the objects so far, and its matches.
    fn next(
        &self,
        waiting: &[usize],
        seen: &[Vec<ObservedBox>],
        priors: &[Isometry3<f64>],
        config: &PoseGraphConfig,
    ) -> Option<(usize, consensus::ConsensusMotion)> {
        let objects: Vec<Vector3<f64>> = self.objects.iter().map(PlanarPose::place).collect();
        let found = waiting.iter().enumerate().filter_map(|(place, &agent)| {
            let centers: Vec<Vector3<f64>> = seen[agent].iter().map(|seen| seen.center).collect();
            let consensus = consensus(&objects, &centers, &priors[agent], config)?;
            Some((place, consensus))
        });
        found.max_by(|(_, one), (_, other)| one.score.total_cmp(&other.score))
    }

    /// `matches` are pairs of object and box; boxes without an object create one.
    fn join(
        &mut self,
        agent: usize,
        ego_from_agent: &Isometry3<f64>,
        seen: &[ObservedBox],
        matches: &[(usize, usize)],
    ) {
        let node = self.joined.len();
        let heading = ego_from_agent.rotation.euler_angles().2;
        for (index, seen) in seen.iter().enumerate() {
            let object = match matches.iter().find(|(_, matched)| *matched == index) {
                Some((object, _)) => *object,
                None => {
                    let place = moved(ego_from_agent, &seen.center);
                    let heading_rad = heading + seen.heading_rad;
                    self.objects.push(PlanarPose::new(&place, heading_rad));
                    self.objects.len() - 1
                }
            };
            self.observations.push(Observation {
                agent: node,
                object,
                seen: PlanarPose::new(&seen.center, seen.heading_rad),
                information: [seen.std_m, seen.std_m, seen.std_rad].map(|std| std.powi(-2)),
            });
        }
        self.joined.push((agent, *ego_from_agent));
    }

    /// Agent and pose of all joined agents but the ego.
    fn solve(
        self,
        priors: &[Isometry3<f64>],
        config: &PoseGraphConfig,
    ) -> impl Iterator<Item = (usize, Isometry3<f64>)> {
        let mut viewers = vec![0usize; self.objects.len()];
        self.observations
            .iter()
            .for_each(|observation| viewers[observation.object] += 1);
        // An object seen by one agent only does not constrain poses.
        let mut shared = self.observations;
        shared.retain(|observation| viewers[observation.object] > 1);
        let (std_m, std_rad) = (config.pose_std_m, config.pose_std_deg.to_radians());
        let joined = self.joined.iter();
        let nodes = joined.map(|(agent, motion)| (node_of(motion), node_of(&priors[*agent])));
        let (agents, priors) = nodes.unzip();
        let mut graph = Graph {
            agents,
            priors,
            prior_information: [std_m, std_m, std_rad].map(|std| std.powi(-2)),
            objects: self.objects,
            observations: shared,
        };
        graph.optimise();
        let solved = self.joined.into_iter().zip(graph.agents).skip(1);
        solved.map(|((agent, _), solved)| (agent, planar(&solved)))
    }
}

#[cfg(test)]
mod tests;
