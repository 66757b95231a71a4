//! Whom the ego believes: whether what a neighbour says fits what the ego sees itself where both look.
//!
//! Every message is looked at alone, by the ego's own head, before any of it is fused: vehicles that only one of the two
//! sees, whether each sees the other where it says to be, whether the message is somebody else's. What frames say is averaged, the newest counting half; who falls below a threshold is left out until it
//! has been believable for a while. A neighbour of whom nothing can be said keeps the trust that it has. Maps are believed
//! until something speaks against them, as what is fused must agree with the ego's own in any case; boxes, which count
//! as they come, only when something speaks for them.

mod evidence;
mod seen;

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry2;
use perception::detector::{Detector, DetectorError};
use protocol::message::HeardNeighbour;
use protocol::{CavId, MisbehaviourReason, PointCloud, Pose};
use serde::{Deserialize, Serialize};

use crate::view::View;
use evidence::Evidence;
use seen::{Observation, cosine_similarity};

/// How much a frame counts against all before it.
const NEWEST: f64 = 0.5;
/// Vehicles that are remembered at most.
const MAX_PEERS: usize = 64;
/// Who has not been heard for so long is forgotten, nanoseconds: long enough that a liar gains nothing by staying away.
const FORGOTTEN_NANOS: u64 = 60_000_000_000;
/// Messages further apart than this are not compared with each other, seconds.
const SUCCESSIVE_S: f64 = 0.25;
/// No vehicle drives faster, metres a second.
const MAX_SPEED_MPS: f64 = 70.0;
/// Poses are off by no more than this from one to the next, metres.
const MAX_JUMP_M: f64 = 20.0;
/// No vehicle turns faster, radians a second, and no pose is turned further from one to the next, radians.
const MAX_TURN: (f64, f64) = (2.0, 1.0);

/// When a neighbour is left out and when it is taken back.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MisbehaviourConfig {
    /// Below this running mean of the evidence a neighbour is left out, log odds.
    pub leave_out_below: f64,
    /// Above this it is taken back.
    pub take_back_above: f64,
}

impl Default for MisbehaviourConfig {
    fn default() -> Self {
        Self { leave_out_below: -0.7, take_back_above: 0.7 }
    }
}

/// What is remembered of each neighbour.
#[derive(Debug)]
pub(crate) struct MisbehaviourDetector {
    config: MisbehaviourConfig,
    /// The map of an empty world, `[C, H, W]`.
    empty: Vec<f32>,
    peers: BTreeMap<CavId, Reputation>,
}

#[derive(Debug)]
struct Reputation {
    log_odds: f64,
    is_out: bool,
    /// What spoke against it last.
    doubt: MisbehaviourReason,
    /// Capture time of the ego's own view when it was heard last, nanoseconds.
    heard_nanos: u64,
    /// Capture time, place and looks of the message that was judged last.
    last: Option<(u64, Pose, Vec<f32>)>,
}

/// How far a neighbour is believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Assessment {
    /// How likely it is honest, 0..1.
    pub trust: f64,
    /// Why it is left out, where it is.
    pub doubt: Option<MisbehaviourReason>,
}

impl Assessment {
    /// Whether it is left out.
    #[must_use]
    pub fn is_out(&self) -> bool {
        self.doubt.is_some()
    }
}

/// What is said of the neighbours that were looked at, but for their clocks; `beliefs` are those of an `EgoOutput`.
#[must_use]
pub fn heard(beliefs: &[(usize, Assessment)], views: &[View]) -> Vec<HeardNeighbour> {
    let of = |(index, view): (usize, &View)| {
        let belief = beliefs.iter().find(|(known, _)| *known == index).map(|(_, belief)| belief);
        HeardNeighbour {
            cav: view.cav.clone(),
            trust: belief.map(|belief| belief.trust),
            doubt: belief.and_then(|belief| belief.doubt),
            clock_offset_s: None,
        }
    };
    views.iter().enumerate().map(of).collect()
}

impl MisbehaviourDetector {
    /// Trusts everybody.
    pub(crate) fn new(config: MisbehaviourConfig, detector: &mut Detector) -> Result<Self, DetectorError> {
        let encoded = detector.encode(&PointCloud::default())?.features;
        let empty = detector.through_compressor(&encoded)?;
        let empty = Vec::try_from(&empty.f_contiguous()?.f_view([-1])?)?;
        Ok(Self { config, empty, peers: BTreeMap::new() })
    }

    /// Forgets everybody: another scene begins.
    pub(crate) fn clear(&mut self) {
        self.peers.clear();
    }

    /// How far each of the neighbours, with where they lie, is believed.
    pub(crate) fn judge(
        &mut self,
        own: &View,
        neighbours: &[(&View, Pose)],
        detector: &mut Detector,
    ) -> Result<Vec<Assessment>, DetectorError> {
        self.forget_absent(own.capture_nanos, neighbours.iter().map(|(view, _)| &view.cav));
        let mine = Observation::in_message(&own.content, detector, &self.empty)?;
        let mut all = Vec::with_capacity(neighbours.len());
        for (view, _) in neighbours {
            all.push(Observation::in_message(&view.content, detector, &self.empty)?);
        }
        // A message that serves a second frame says nothing new.
        let is_new = |view: &View| self.last_of(&view.cav).is_none_or(|(nanos, ..)| *nanos != view.capture_nanos);
        let evidence = neighbours.iter().zip(&all);
        let mut evidence: Vec<Option<Evidence>> = evidence
            .map(|((view, ego_from_cav), seen)| {
                is_new(view).then(|| self.evidence(own, &mine, view, ego_from_cav, seen))
            })
            .collect();
        flag_duplicates(&mut evidence, &all);
        let mut beliefs = Vec::with_capacity(neighbours.len());
        for ((view, _), evidence) in neighbours.iter().zip(evidence) {
            let judgement = evidence.as_ref().and_then(Evidence::judgement);
            tracing::debug!(cav = %view.cav, ?judgement, ?evidence, "neighbour judged");
            beliefs.push(self.add_up(own.capture_nanos, &view.cav, judgement, mine.is_boxes()));
        }
        for ((view, _), seen) in neighbours.iter().zip(all) {
            if let (Some(standing), Some(pose)) = (self.peers.get_mut(&view.cav), view.pose.world_from_cav()) {
                standing.last = Some((view.capture_nanos, *pose, seen.print));
            }
        }
        Ok(beliefs)
    }

    fn last_of(&self, cav: &CavId) -> Option<&(u64, Pose, Vec<f32>)> {
        self.peers.get(cav)?.last.as_ref()
    }

    /// What there is to say of a message but for its cosine_similarity to those of other neighbours in the same frame.
    fn evidence(
        &self,
        own: &View,
        mine: &Observation,
        view: &View,
        ego_from_cav: &Pose,
        seen: &Observation,
    ) -> Evidence {
        let [x, y, _] = ego_from_cav.translation_m;
        let lies = Isometry2::new([x, y].into(), ego_from_cav.yaw_rad());
        let mut evidence = Evidence::between(mine, seen, &lies, view.age_nanos(own) as f64 * 1e-9);
        let earlier = self.peers.iter().filter(|(cav, _)| **cav != view.cav).filter_map(|(_, peer)| peer.last.as_ref());
        let others = earlier.map(|(_, _, print)| print).chain([&mine.print]);
        evidence.like_another = others.map(|print| alike(&seen.print, print)).fold(0.0, f64::max);
        if let (Some((capture_nanos, before, print)), Some(now)) = (self.last_of(&view.cav), view.pose.world_from_cav())
        {
            let elapsed_s = (view.capture_nanos as f64 - *capture_nanos as f64).abs() * 1e-9;
            evidence.jumped = is_jump(before, now, elapsed_s);
            evidence.like_before = (elapsed_s < SUCCESSIVE_S).then(|| cosine_similarity(&seen.print, print));
        }
        evidence
    }

    /// Makes room for others where vehicles have not been heard for long, by the ego's own time: what others say of theirs
    /// keeps nobody here.
    fn forget_absent<'a>(&mut self, now_nanos: u64, present: impl Iterator<Item = &'a CavId>) {
        let present: BTreeSet<&CavId> = present.collect();
        self.peers.retain(|cav, standing| {
            present.contains(cav) || now_nanos.abs_diff(standing.heard_nanos) <= FORGOTTEN_NANOS
        });
    }

    /// Takes in what a frame says; whoever `probation` it is left out until something speaks for it.
    fn add_up(
        &mut self,
        now_nanos: u64,
        cav: &CavId,
        judgement: Option<(f64, MisbehaviourReason)>,
        probation: bool,
    ) -> Assessment {
        let MisbehaviourConfig { leave_out_below, take_back_above } = self.config;
        if self.peers.len() >= MAX_PEERS && !self.peers.contains_key(cav) {
            // Of more vehicles than an ego can listen to, nothing is known.
            return Assessment { trust: 0.5, doubt: probation.then_some(MisbehaviourReason::Probation) };
        }
        let standing = self.peers.entry(cav.clone()).or_insert(Reputation {
            log_odds: 0.0,
            is_out: probation,
            doubt: MisbehaviourReason::Probation,
            heard_nanos: now_nanos,
            last: None,
        });
        standing.heard_nanos = now_nanos;
        if let Some((log_odds, doubt)) = judgement {
            standing.log_odds += NEWEST * (log_odds - standing.log_odds);
            if log_odds < 0.0 {
                standing.doubt = doubt;
            }
        }
        let was_out = standing.is_out;
        standing.is_out = standing.log_odds < if was_out { take_back_above } else { leave_out_below };
        let doubt = standing.doubt;
        match (was_out, standing.is_out) {
            (false, true) => tracing::warn!(%cav, %doubt, "its words do not fit what the ego sees: it is left out"),
            (true, false) => tracing::info!(%cav, "its words fit what the ego sees: it is believed"),
            _ => {}
        }
        Assessment { trust: 1.0 / (1.0 + (-standing.log_odds).exp()), doubt: standing.is_out.then_some(doubt) }
    }
}

/// Of two neighbours that say the same, the one whose words fit worse in any case is the copier; both where neither's do.
fn flag_duplicates(evidence: &mut [Option<Evidence>], all: &[Observation]) {
    let fits: Vec<f64> =
        evidence.iter().map(|evidence| evidence.as_ref().and_then(Evidence::log_odds).unwrap_or(0.0)).collect();
    for (index, evidence) in evidence.iter_mut().enumerate() {
        let Some(evidence) = evidence else { continue };
        for other in (0..all.len()).filter(|&other| other != index && fits[other] >= fits[index]) {
            evidence.like_another = evidence.like_another.max(alike(&all[index].print, &all[other].print));
        }
    }
}

/// How alike two messages are, where they say enough to be a copy: two vehicles that see a single box may well agree.
fn alike(one: &[f32], other: &[f32]) -> f64 {
    const ENOUGH: usize = 9;
    if one.len() < ENOUGH { 0.0 } else { cosine_similarity(one, other) }
}

/// Whether no vehicle gets from one pose to the other in that time, whatever the poses' errors.
fn is_jump(before: &Pose, now: &Pose, elapsed_s: f64) -> bool {
    let moved = before.from_world(now);
    let [x, y, _] = moved.translation_m;
    let (turns, error) = MAX_TURN;
    x.hypot(y) > MAX_JUMP_M + MAX_SPEED_MPS * elapsed_s || moved.yaw_rad().abs() > error + turns * elapsed_s
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trust() -> MisbehaviourDetector {
        MisbehaviourDetector { config: MisbehaviourConfig::default(), empty: vec![], peers: BTreeMap::new() }
    }

    #[test]
    fn who_is_left_out_comes_back_after_a_while_and_not_at_once() {
        let mut trust = trust();
        let cav = CavId::new("a").unwrap();
        let mut hear = |log_odds: Option<f64>| {
            trust.add_up(0, &cav, log_odds.map(|odds| (odds, MisbehaviourReason::Duplicated)), false)
        };
        assert!(!hear(None).is_out(), "nobody is doubted without a reason");
        assert_eq!(hear(Some(-3.0)).doubt, Some(MisbehaviourReason::Duplicated), "strong evidence counts at once");
        assert!(hear(None).is_out(), "the same message says nothing new");
        let returns = (0..20).position(|_| !hear(Some(1.5)).is_out()).unwrap();
        assert!((1..6).contains(&returns), "after {returns} frames");
        assert!(!hear(Some(-1.0)).is_out(), "one doubtful frame is forgiven");
        assert!((0..20).map(|_| hear(Some(4.0))).last().unwrap().trust > 0.97);
        assert!(hear(Some(-8.0)).is_out(), "no trust is so great that a plain lie passes");
    }

    #[test]
    fn boxes_are_believed_when_something_speaks_for_them() {
        let mut trust = trust();
        let cav = CavId::new("a").unwrap();
        assert_eq!(trust.add_up(0, &cav, None, true).doubt, Some(MisbehaviourReason::Probation));
        assert!(!trust.add_up(0, &cav, Some((2.0, MisbehaviourReason::PositionMismatch)), true).is_out());
        assert!(!trust.add_up(0, &cav, None, true).is_out());
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut trust = trust();
        for number in 0..1000 {
            trust.add_up(
                0,
                &CavId::new(&format!("v{number}")).unwrap(),
                Some((-9.0, MisbehaviourReason::ImplausibleMotion)),
                false,
            );
        }
        assert_eq!(trust.peers.len(), MAX_PEERS);
    }

    #[test]
    fn who_stays_away_for_long_makes_room_and_a_liar_is_known_after_a_short_absence() {
        let mut trust = trust();
        let names: Vec<CavId> = (0..=MAX_PEERS).map(|number| CavId::new(&format!("v{number}")).unwrap()).collect();
        let lie = Some((-9.0, MisbehaviourReason::ImplausibleMotion));
        for cav in &names[..MAX_PEERS] {
            assert!(trust.add_up(0, cav, lie, false).is_out());
        }
        let newcomer = &names[MAX_PEERS];
        trust.forget_absent(FORGOTTEN_NANOS, [newcomer].into_iter());
        assert!(!trust.add_up(FORGOTTEN_NANOS, newcomer, lie, false).is_out(), "there is no place yet");
        assert!(trust.add_up(FORGOTTEN_NANOS, &names[0], None, false).is_out(), "it has not washed itself");
        let later = FORGOTTEN_NANOS + 1;
        trust.forget_absent(later, [newcomer, &names[1]].into_iter());
        let known: Vec<&CavId> = trust.peers.keys().collect();
        assert_eq!(known, [&names[0], &names[1]]);
        assert!(trust.add_up(later, newcomer, lie, false).is_out(), "a newcomer is judged");
    }

    #[test]
    fn a_pose_nobody_can_have_driven_to_is_told() {
        let here = Pose::from_xyz_yaw([100.0, 50.0, 2.0], 0.0);
        assert!(!is_jump(&here, &Pose::from_xyz_yaw([115.0, 50.0, 2.0], 0.5), 0.1), "noise of a poor pose");
        assert!(is_jump(&here, &Pose::from_xyz_yaw([140.0, 50.0, 2.0], 0.0), 0.1));
        assert!(is_jump(&here, &Pose::from_xyz_yaw([100.0, 50.0, 2.0], 2.0), 0.1));
        assert!(!is_jump(&here, &Pose::from_xyz_yaw([140.0, 50.0, 2.0], 2.0), 1.0));
    }
}
