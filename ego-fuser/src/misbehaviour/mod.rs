//! Misbehaviour detection: compares a neighbour's detections with the ego's in the jointly observed area.
//!
//! Every message is evaluated separately, by the ego's own head, before any of it is fused: vehicles that only one of
//! the two detects, mutual detection at the reported positions, similarity to other senders' messages, values that the
//! network does not give. Evidence is
//! averaged over frames, the newest counting half; a neighbour below a threshold is left out until its average has
//! recovered. A neighbour without evidence keeps its trust. Maps, and boxes beside an own map, are accepted until there
//! is evidence against them, as they must agree with the ego's own features in any case; boxes of late fusion, which
//! count as received, are accepted only with evidence in their favour.

mod evidence;
mod fingerprint;
mod seen;
mod value_range;

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry2;
use perception::detector::{Detector, DetectorError};
use protocol::{CavId, MisbehaviourReason, PointCloud, Pose};

use crate::view::View;
use evidence::Evidence;
use fingerprint::Fingerprint;
use fusion::method::Exchange;
use seen::SeenMessage;
use value_range::ValueRange;

/// Weight of a frame against all before it.
const NEWEST: f64 = 0.5;
/// Largest number of neighbours with a state.
const MAX_PEERS: usize = 64;
/// Neighbours without a message for this long are removed, nanoseconds: long enough that an attacker gains nothing by
/// going offline.
const FORGOTTEN_NANOS: u64 = 60_000_000_000;
/// Messages further apart than this are not compared with each other, seconds.
const SUCCESSIVE_S: f64 = 0.25;
/// A sender that moves by less than this between two maps selects much the same cells of both, metres.
const STAYS_M: f64 = 2.0;
/// Largest speed of a vehicle, metres per second.
const MAX_SPEED_MPS: f64 = 70.0;
/// Largest error between successive poses, metres.
const MAX_JUMP_M: f64 = 20.0;
/// Largest turn rate of a vehicle, radians per second, and largest heading error between successive poses, radians.
const MAX_TURN: (f64, f64) = (2.0, 1.0);

/// Below this running mean of the evidence a neighbour is left out, log odds.
const LEAVE_OUT_BELOW: f64 = -0.7;
/// Above this it is readmitted, log odds.
const TAKE_BACK_ABOVE: f64 = 0.7;

/// State of all neighbours.
#[derive(Debug)]
pub(crate) struct MisbehaviourDetector {
    /// The map of an empty world, `[C, H, W]`.
    empty: Vec<f32>,
    /// Of the own maps so far, and of the empty one.
    range: ValueRange,
    peers: BTreeMap<CavId, Reputation>,
}

#[derive(Debug)]
struct Reputation {
    log_odds: f64,
    is_out: bool,
    /// Reason of the last evidence against it.
    reason: MisbehaviourReason,
    /// Capture time of the ego's own view at its last message, nanoseconds.
    last_message_nanos: u64,
    /// Capture time, pose and fingerprint of the last judged map or points, and of the last judged boxes.
    last: [Option<(u64, Pose, Fingerprint)>; 2],
}

/// Assessment of a neighbour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Assessment {
    /// Probability that it is honest, 0..1.
    pub trust: f64,
    /// Reason for which it is left out; absent: it is fused.
    pub misbehaviour: Option<MisbehaviourReason>,
}

impl MisbehaviourDetector {
    /// Starts with all neighbours trusted.
    pub(crate) fn new(detector: &mut Detector) -> Result<Self, DetectorError> {
        let encoded = detector.encode(&PointCloud::default())?.features;
        let empty = detector.through_compressor(&encoded)?;
        let empty: Vec<f32> = Vec::try_from(&empty.f_contiguous()?.f_view([-1])?)?;
        let [channels, ..] = detector.map_shape();
        Ok(Self {
            range: ValueRange::of(&empty, usize::try_from(channels).unwrap_or(0)),
            empty,
            peers: BTreeMap::new(),
        })
    }

    /// Removes all neighbours: another scene begins.
    pub(crate) fn clear(&mut self) {
        self.peers.clear();
    }

    /// Assesses each of the neighbours, given with their poses.
    pub(crate) fn judge(
        &mut self,
        own: &View,
        neighbours: &[(&View, Pose)],
        detector: &mut Detector,
    ) -> Result<Vec<Assessment>, DetectorError> {
        let present = neighbours.iter().map(|(view, _)| &view.cav);
        self.forget_absent(own.capture_nanos, present);
        let mine = SeenMessage::in_message(&own.content, detector, &self.empty)?;
        self.range.widen(&mine.map);
        let mut all = Vec::with_capacity(neighbours.len());
        for (view, _) in neighbours {
            let seen = SeenMessage::of_neighbour(&view.content, detector, &self.empty);
            all.push(seen?);
        }
        let mut evidence = Vec::with_capacity(neighbours.len());
        for ((view, ego_from_cav), seen) in neighbours.iter().zip(&all) {
            // A message that serves a second frame is no new evidence.
            let last = self.last_of(view);
            let is_new = last.is_none_or(|(nanos, ..)| *nanos != view.capture_nanos);
            evidence.push(is_new.then(|| self.evidence(own, &mine, view, ego_from_cav, seen)));
        }
        mark_copies(&mut evidence, &all);
        let probation = mine.is_boxes();
        let of_cav = worst_of_each(neighbours, &evidence).into_iter();
        let of_cav: BTreeMap<_, _> = of_cav
            .map(|(cav, found)| (cav, self.add_up(own.capture_nanos, cav, found, probation)))
            .collect();
        let assessments = neighbours.iter().map(|(view, _)| of_cav[&view.cav]);
        let assessments = assessments.collect();
        for ((view, _), seen) in neighbours.iter().zip(all) {
            if let (Some(reputation), Some(pose)) =
                (self.peers.get_mut(&view.cav), view.pose.world_from_cav())
            {
                reputation.last[kind(view)] = Some((view.capture_nanos, *pose, seen.fingerprint));
            }
        }
        Ok(assessments)
    }

    fn last_of(&self, view: &View) -> Option<&(u64, Pose, Fingerprint)> {
        self.peers.get(&view.cav)?.last[kind(view)].as_ref()
    }

    /// Evidence of a message except its similarity to those of other neighbours in the same frame.
    fn evidence(
        &self,
        own: &View,
        mine: &SeenMessage,
        view: &View,
        ego_from_cav: &Pose,
        seen: &SeenMessage,
    ) -> Evidence {
        let [x, y, _] = ego_from_cav.translation_m;
        let relative = Isometry2::new([x, y].into(), ego_from_cav.yaw_rad());
        let age_s = view.age_nanos(own) as f64 * 1e-9;
        let mut evidence = Evidence::between(mine, seen, &relative, age_s);
        evidence.is_out_of_range = self.range.is_left_by(&seen.map);
        let others = self.peers.iter().filter(|(cav, _)| **cav != view.cav);
        let earlier = others.flat_map(|(_, peer)| peer.last.iter().flatten());
        let fingerprints = earlier.map(|(_, _, fingerprint)| fingerprint);
        let mut others = fingerprints.chain([&mine.fingerprint]);
        evidence.is_copied = others.any(|other| seen.fingerprint.is_copy_of(other));
        if let (Some((capture_nanos, before, fingerprint)), Some(now)) =
            (self.last_of(view), view.pose.world_from_cav())
        {
            let elapsed_s = (view.capture_nanos as f64 - *capture_nanos as f64).abs() * 1e-9;
            evidence.jumped = is_jump(before, now, elapsed_s);
            let [x, y, _] = before.from_world(now).translation_m;
            let is_torn = x.hypot(y) < STAYS_M && seen.fingerprint.is_unrelated(fingerprint);
            let torn = is_torn.then_some(0.0);
            let likeness = torn.or_else(|| seen.fingerprint.likeness(fingerprint));
            evidence.like_before = likeness.filter(|_| elapsed_s < SUCCESSIVE_S);
        }
        evidence
    }

    /// Removes neighbours without messages for long, by the ego's own clock, so that reported times cannot keep an
    /// entry.
    fn forget_absent<'a>(&mut self, now_nanos: u64, present: impl Iterator<Item = &'a CavId>) {
        let present: BTreeSet<&CavId> = present.collect();
        self.peers.retain(|cav, reputation| {
            present.contains(cav)
                || now_nanos.abs_diff(reputation.last_message_nanos) <= FORGOTTEN_NANOS
        });
    }

    /// Adds the evidence of a frame; a neighbour on `probation` is left out until there is evidence in its favour.
    fn add_up(
        &mut self,
        now_nanos: u64,
        cav: &CavId,
        judgement: Option<(f64, MisbehaviourReason)>,
        probation: bool,
    ) -> Assessment {
        if self.peers.len() >= MAX_PEERS && !self.peers.contains_key(cav) {
            // Beyond the limit of neighbours nothing is known.
            return Assessment {
                trust: 0.5,
                misbehaviour: probation.then_some(MisbehaviourReason::Probation),
            };
        }
        let reputation = self.peers.entry(cav.clone()).or_insert(Reputation {
            log_odds: 0.0,
            is_out: probation,
            reason: MisbehaviourReason::Probation,
            last_message_nanos: now_nanos,
            last: [None, None],
        });
        reputation.last_message_nanos = now_nanos;
        if let Some((log_odds, reason)) = judgement {
            reputation.log_odds += NEWEST * (log_odds - reputation.log_odds);
            if log_odds < 0.0 {
                reputation.reason = reason;
            }
        }
        let was_out = reputation.is_out;
        let threshold = [LEAVE_OUT_BELOW, TAKE_BACK_ABOVE][usize::from(was_out)];
        reputation.is_out = reputation.log_odds < threshold;
        // Too weak to leave it out, evidence only prolongs the probation.
        let reason = match reputation.log_odds < LEAVE_OUT_BELOW {
            true => reputation.reason,
            false => MisbehaviourReason::Probation,
        };
        match (was_out, reputation.is_out) {
            (false, true) => {
                tracing::warn!(%cav, %reason, "its messages contradict the ego's perception: left out")
            }
            (true, false) => {
                tracing::info!(%cav, "its messages agree with the ego's perception: readmitted")
            }
            _ => {}
        }
        Assessment {
            trust: 1.0 / (1.0 + (-reputation.log_odds).exp()),
            misbehaviour: reputation.is_out.then_some(reason),
        }
    }
}

/// Of two neighbours with the same message, the one with the weaker evidence otherwise is the copier; both where neither
/// has any in its favour.
fn mark_copies(evidence: &mut [Option<Evidence>], all: &[SeenMessage]) {
    let log_odds = evidence.iter().map(|one| one.as_ref()?.judgement());
    let log_odds = log_odds.map(|found| found.map_or(0.0, |(odds, _)| odds));
    let fits: Vec<f64> = log_odds.collect();
    for (index, evidence) in evidence.iter_mut().enumerate() {
        let Some(evidence) = evidence else { continue };
        let message = &all[index].fingerprint;
        evidence.is_copied |= (0..all.len())
            .filter(|&other| other != index && fits[other] >= fits[index])
            .any(|other| message.is_copy_of(&all[other].fingerprint));
    }
}

/// Of a neighbour's map and boxes the worse judgement, once: true boxes are no excuse for a false map.
fn worst_of_each<'a>(
    neighbours: &[(&'a View, Pose)],
    evidence: &[Option<Evidence>],
) -> BTreeMap<&'a CavId, Option<(f64, MisbehaviourReason)>> {
    let mut judgements: BTreeMap<&CavId, Option<(f64, MisbehaviourReason)>> = BTreeMap::new();
    for ((view, _), evidence) in neighbours.iter().zip(evidence) {
        let judgement = evidence.as_ref().and_then(Evidence::judgement);
        tracing::debug!(cav = %view.cav, ?judgement, ?evidence, "neighbour judged");
        let worst = judgements.entry(&view.cav).or_default();
        let both = worst.iter().copied().chain(judgement);
        *worst = both.min_by(|one, other| one.0.total_cmp(&other.0));
    }
    judgements
}

/// Index of the last judged message of its kind.
fn kind(view: &View) -> usize {
    usize::from(view.content.exchange() == Exchange::Boxes)
}

/// True if no vehicle can drive from one pose to the other in that time, with the largest pose errors added.
fn is_jump(before: &Pose, now: &Pose, elapsed_s: f64) -> bool {
    let moved = before.from_world(now);
    let [x, y, _] = moved.translation_m;
    let (turns, error) = MAX_TURN;
    x.hypot(y) > MAX_JUMP_M + MAX_SPEED_MPS * elapsed_s
        || moved.yaw_rad().abs() > error + turns * elapsed_s
}

#[cfg(test)]
mod tests {
    use fusion::method::Method;

    use super::*;
    use crate::ego::tests::{HERE, detector, near, view};
    use crate::view::Content;

    fn trust() -> MisbehaviourDetector {
        MisbehaviourDetector {
            empty: vec![],
            range: ValueRange::default(),
            peers: BTreeMap::new(),
        }
    }

    #[test]
    fn a_neighbour_that_was_left_out_is_readmitted_with_delay() {
        let mut trust = trust();
        let cav = CavId::new("a").unwrap();
        let mut assess = |log_odds: Option<f64>| {
            trust.add_up(
                0,
                &cav,
                log_odds.map(|odds| (odds, MisbehaviourReason::Duplicated)),
                false,
            )
        };
        assert!(
            assess(None).misbehaviour.is_none(),
            "left out only with evidence"
        );
        assert_eq!(
            assess(Some(-3.0)).misbehaviour,
            Some(MisbehaviourReason::Duplicated),
            "strong evidence counts at once"
        );
        assert!(
            assess(None).misbehaviour.is_some(),
            "the same message is no new evidence"
        );
        let returns = (0..20)
            .position(|_| assess(Some(1.5)).misbehaviour.is_none())
            .unwrap();
        assert!((1..6).contains(&returns), "after {returns} frames");
        assert!(
            assess(Some(-1.0)).misbehaviour.is_none(),
            "one frame with weak evidence is tolerated"
        );
        assert!((0..20).map(|_| assess(Some(4.0))).last().unwrap().trust > 0.97);
        assert!(
            assess(Some(-8.0)).misbehaviour.is_some(),
            "a clear attack is rejected whatever the trust"
        );
    }

    #[test]
    fn boxes_are_accepted_with_evidence_in_their_favour() {
        let mut trust = trust();
        let cav = CavId::new("a").unwrap();
        assert_eq!(
            trust.add_up(0, &cav, None, true).misbehaviour,
            Some(MisbehaviourReason::Probation)
        );
        assert!(
            trust
                .add_up(
                    0,
                    &cav,
                    Some((2.0, MisbehaviourReason::PositionMismatch)),
                    true
                )
                .misbehaviour
                .is_none()
        );
        assert!(trust.add_up(0, &cav, None, true).misbehaviour.is_none());
    }

    #[test]
    fn weak_evidence_against_a_neighbour_on_probation_is_no_misbehaviour() {
        let mut trust = trust();
        let cav = CavId::new("a").unwrap();
        let mut assess = |log_odds| {
            let judgement = Some((log_odds, MisbehaviourReason::PositionMismatch));
            trust.add_up(0, &cav, judgement, true).misbehaviour
        };
        assert_eq!(assess(-0.6), Some(MisbehaviourReason::Probation));
        assert_eq!(assess(-3.0), Some(MisbehaviourReason::PositionMismatch));
        assert_eq!(
            assess(1.0),
            Some(MisbehaviourReason::Probation),
            "its average recovers"
        );
    }

    #[test]
    fn state_is_bounded() {
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
    fn long_offline_neighbours_are_removed_and_an_attacker_is_known_after_a_short_interval() {
        let mut trust = trust();
        let names: Vec<CavId> = (0..=MAX_PEERS)
            .map(|number| CavId::new(&format!("v{number}")).unwrap())
            .collect();
        let attack = Some((-9.0, MisbehaviourReason::ImplausibleMotion));
        for cav in &names[..MAX_PEERS] {
            assert!(trust.add_up(0, cav, attack, false).misbehaviour.is_some());
        }
        let newcomer = &names[MAX_PEERS];
        trust.forget_absent(FORGOTTEN_NANOS, [newcomer].into_iter());
        assert!(
            trust
                .add_up(FORGOTTEN_NANOS, newcomer, attack, false)
                .misbehaviour
                .is_none(),
            "the state is full"
        );
        assert!(
            trust
                .add_up(FORGOTTEN_NANOS, &names[0], None, false)
                .misbehaviour
                .is_some(),
            "it has not washed itself"
        );
        let later = FORGOTTEN_NANOS + 1;
        trust.forget_absent(later, [newcomer, &names[1]].into_iter());
        let known: Vec<&CavId> = trust.peers.keys().collect();
        assert_eq!(known, [&names[0], &names[1]]);
        assert!(
            trust
                .add_up(later, newcomer, attack, false)
                .misbehaviour
                .is_some(),
            "a newcomer is judged"
        );
    }

    #[test]
    fn an_unreachable_pose_is_detected() {
        let here = Pose::from_xyz_yaw([100.0, 50.0, 2.0], 0.0);
        assert!(
            !is_jump(&here, &Pose::from_xyz_yaw([115.0, 50.0, 2.0], 0.5), 0.1),
            "noise of a poor pose"
        );
        assert!(is_jump(
            &here,
            &Pose::from_xyz_yaw([140.0, 50.0, 2.0], 0.0),
            0.1
        ));
        assert!(is_jump(
            &here,
            &Pose::from_xyz_yaw([100.0, 50.0, 2.0], 2.0),
            0.1
        ));
        assert!(!is_jump(
            &here,
            &Pose::from_xyz_yaw([140.0, 50.0, 2.0], 2.0),
            1.0
        ));
    }
    #[test]
    fn map_and_boxes_are_judged_together_each_against_its_own_last_message() {
        let mut detector = detector();
        let mut trust = MisbehaviourDetector::new(&mut detector).unwrap();
        let own = view("a", HERE, Method::MAX, 0.0);
        let sent = [Method::MAX, Method::LATE].map(|method| view("b", near(), method, 0.15));
        let neighbours = [(&sent[0], near()), (&sent[1], near())];
        let found = trust.judge(&own, &neighbours, &mut detector).unwrap();
        assert_eq!(found[0], found[1]);
        let empty = trust.empty.clone();
        let mine = SeenMessage::in_message(&own.content, &mut detector, &empty).unwrap();
        for view in &sent {
            let later = View {
                capture_nanos: view.capture_nanos + 100_000_000,
                ..view.clone()
            };
            let seen = SeenMessage::in_message(&later.content, &mut detector, &empty).unwrap();
            let evidence = trust.evidence(&own, &mine, &later, &near(), &seen);
            let like_before = evidence.like_before.unwrap();
            assert!(
                (like_before - 1.0).abs() < 1e-6,
                "{:?}: {like_before}",
                later.content.exchange()
            );
        }
    }

    #[test]
    fn partial_maps_of_unrelated_cells_are_inconsistent_unless_their_sender_drives() {
        let mut detector = detector();
        let mut trust = MisbehaviourDetector::new(&mut detector).unwrap();
        let own = view("a", HERE, Method::MAX, 0.0);
        let whole = view("b", near(), Method::MAX, 0.15);
        let cells = detector.grid().cells();
        let partial = |first: usize| {
            let mut partial = whole.clone();
            let Content::Features(map) = &mut partial.content else {
                panic!("a map")
            };
            let sent = (0..cells).map(|cell| (first..first + 210).contains(&cell));
            map.sent = Some(sent.collect());
            partial
        };
        let before = partial(0);
        trust
            .judge(&own, &[(&before, near())], &mut detector)
            .unwrap();
        let empty = trust.empty.clone();
        let mine = SeenMessage::in_message(&own.content, &mut detector, &empty).unwrap();
        for (first, moved_m, is_alike) in [
            (250, 0.5, Some(false)),
            (250, 5.0, None),
            (5, 0.5, Some(true)),
        ] {
            let mut later = partial(first);
            later.capture_nanos += 100_000_000;
            let mut pose = near();
            pose.translation_m[0] += moved_m;
            later.pose = protocol::PoseEstimate::new(pose, 1.0);
            let seen = SeenMessage::in_message(&later.content, &mut detector, &empty).unwrap();
            let evidence = trust.evidence(&own, &mine, &later, &near(), &seen);
            let found = evidence.like_before.map(|like| like > 0.99);
            assert_eq!(found, is_alike, "from cell {first}, {moved_m} m further");
        }
    }
}
