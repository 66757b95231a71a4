//! Evidence for and against a neighbour in one frame.
//!
//! The weights are logarithms of the relative frequencies of such messages among honest neighbours and each type of
//! attacker on the validation scenes (seed 910: 591 messages of honest neighbours, as many of each type of attack, maps
//! and boxes of `max`; 304 messages of boxes beside an own map), rounded. Attacks differ, and evidence against one is no
//! evidence against another, so the strongest evidence counts.

use std::f64::consts::FRAC_PI_6;

use nalgebra::{Isometry2, Isometry3, Point2, Vector3};
use perception::boxes::roi::within_quarter_turn;
use protocol::{Box3d, MisbehaviourReason};

use super::seen::{SeenMessage, place};

/// Two boxes this near are the same vehicle, metres; the radius grows with age.
const SAME_M: f64 = 2.0;
/// Two detections of one vehicle differ by less than this in heading, radians up to half turns: all but 4 of 1451 pairs
/// on 9 scenes, of which none differ by more than a factor of 1.2 in length or width.
const SAME_HEADING_RAD: f64 = FRAC_PI_6;
/// They differ by less than this factor in length and in width, or by less than [`SAME_SIZE_M`].
const SAME_SIZE: f64 = 1.5;
/// Sizes of pedestrians and bicycles that differ by less than this agree, metres.
const SAME_SIZE_M: f64 = 1.0;
/// A box has a heading if it is longer than this multiple of its width.
const LONG: f64 = 1.5;
/// Assumed speed of vehicles while a message is in flight, metres per second.
const DRIVES_MPS: f64 = 12.0;
/// A box this near to a sensor is the vehicle that carries it, metres.
const OWN_BODY_M: f64 = 2.5;
/// Both vehicles detect objects within this distance of both, unless they are occluded, metres.
const NEAR_M: f64 = 35.0;
/// A vehicle within this distance of the ego is in full view unless another one hides it, metres.
const FULL_VIEW_M: f64 = 20.0;
/// A vehicle hides what is behind it within this distance of the line of sight, metres.
const HIDDEN_M: f64 = 1.5;
/// Log odds of a single vehicle in full view where the ego detects none: two such frames leave a newcomer out,
/// four one that has agreed for long.
const FULL_VIEW: f64 = -1.2;
/// A confidence of a vehicle below this means that the ego observes an empty place.
const EMPTY: f32 = 0.06;
/// Maps of one vehicle 0.1 s apart have a higher similarity than this: 0.92 nearly always. Noise does not.
const SUCCESSIVE: f64 = 0.85;
/// Log odds of points without a single vehicle, where the ego detects some: rare for an honest neighbour, always so for
/// noise. It is the only evidence against distant noise, as such maps are similar to each other.
const BLIND: f64 = -1.5;

/// Comparison of a neighbour's message with the ego's own.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Evidence {
    /// Distance between the sensors by their poses, metres.
    pub(super) distance_m: f64,
    /// Vehicles of the neighbour near both that the ego detects too.
    pub(super) matched: u32,
    /// Vehicles of the neighbour near both where the ego detects none.
    pub(super) contradicted: u32,
    /// Boxes of the neighbour near both that the ego detects with another heading or size.
    pub(super) misshapen: u32,
    /// Of the contradicted ones, those near the ego that no vehicle hides from it.
    pub(super) in_full_view: u32,
    /// Vehicles of the neighbour further away where the ego detects none.
    pub(super) strange: u32,
    /// Vehicles of the ego near both where the neighbour detects none, in cells that it sent.
    pub(super) missed: u32,
    /// Confidence of the ego in a vehicle at the neighbour's reported position, 0..1; `None` where it cannot observe
    /// it.
    pub(super) ego_sees_it: Option<f32>,
    /// Confidence of the neighbour in a vehicle at the ego's position, 0..1; `None` where it did not send it.
    pub(super) it_sees_ego: Option<f32>,
    /// True if the message is one of another sender, now or before.
    pub(super) is_copied: bool,
    /// Similarity to the neighbour's own previous message.
    pub(super) like_before: Option<f64>,
    /// True if its pose is not reachable from the previous one.
    pub(super) jumped: bool,
    /// True if its map has values that the network does not give.
    pub(super) is_out_of_range: bool,
    /// True if its points contain no vehicle, and the ego's own do.
    pub(super) is_blind: bool,
    /// True if all this is derived from boxes, which do not distinguish empty places from uncertain ones.
    pub(super) boxes_only: bool,
    /// True for boxes that are judged by an own map, which has to agree with them in any case.
    pub(super) beside_map: bool,
}

impl Evidence {
    /// Compares a neighbour's message with the ego's own; `age_s` is the difference of their ages, seconds.
    pub(super) fn between(
        own: &SeenMessage,
        theirs: &SeenMessage,
        ego_from_cav: &Isometry2<f64>,
        age_s: f64,
    ) -> Self {
        let radius_m = SAME_M + DRIVES_MPS * age_s.abs().min(1.0);
        let cav_from_ego = ego_from_cav.inverse();
        let mut evidence = Self {
            ego_sees_it: own.sure_at(ego_from_cav.translation.vector.into(), radius_m),
            it_sees_ego: theirs.sure_at(cav_from_ego.translation.vector.into(), radius_m),
            distance_m: ego_from_cav.translation.vector.norm(),
            boxes_only: own.is_boxes() || theirs.is_boxes(),
            beside_map: !own.is_boxes() && theirs.is_boxes(),
            is_blind: theirs.is_blind && !own.vehicles.is_empty(),
            ..Self::default()
        };
        let sender = Point2::from(ego_from_cav.translation.vector);
        let sent = |at: &Point2<f64>| theirs.sure_at((cav_from_ego * at).into(), radius_m);
        let mine = &own.vehicles;
        let there = moved(&theirs.vehicles, ego_from_cav);
        for (one, at) in there.iter().map(|one| (one, place(one))) {
            let sure = own.sure_at(at.into(), radius_m);
            let is_empty = sure.is_some_and(|sure| sure < EMPTY);
            match (is_near_both(&at, &sender), found_among(one, mine, radius_m)) {
                _ if at.coords.norm() < OWN_BODY_M => {}
                // The boxes of a map are of the ego's own head, and their shapes are no claim of the sender.
                (true, Some(is_same)) if is_same || !theirs.is_boxes() => evidence.matched += 1,
                (true, Some(_)) => evidence.misshapen += 1,
                (true, None) if is_empty => {
                    evidence.contradicted += 1;
                    evidence.in_full_view += u32::from(is_in_full_view(&at, mine));
                }
                (true, None) => {}
                (false, is_mine) => evidence.strange += u32::from(is_mine.is_none() && is_empty),
            }
        }
        let near = mine.iter().filter(|one| is_near_both(&place(one), &sender));
        let missed = near.filter(|one| found_among(one, &there, radius_m).is_none());
        // What the neighbour did not send it may have detected.
        evidence.missed = missed.filter(|one| sent(&place(one)).is_some()).count() as u32;
        evidence
    }

    /// Log likelihood ratio of an honest neighbour and the most likely type of attacker, and that type; `None` without
    /// anything to compare.
    pub(super) fn judgement(&self) -> Option<(f64, MisbehaviourReason)> {
        use MisbehaviourReason::{GhostObjects, PositionMismatch};
        let elsewhere = self.against_elsewhere();
        let elsewhere = elsewhere.map(|odds| (odds, PositionMismatch));
        let invention = self.against_invention().map(|odds| (odds, GhostObjects));
        let candidates = [elsewhere, invention, self.against_other_attacks()].into_iter();
        candidates
            .flatten()
            .min_by(|(one, _), (other, _)| one.total_cmp(other))
    }

    /// Evidence against a neighbour with a wrong position or without perception.
    fn against_elsewhere(&self) -> Option<f64> {
        let seen = [self.ego_sees_it, self.it_sees_ego].into_iter().flatten();
        let seen = seen.map(|sure| self.seeing(sure)).collect::<Vec<_>>();
        if self.is_blind {
            return Some(BLIND.min(-0.3 * f64::from(self.missed)));
        }
        if seen.iter().all(|odds| *odds == 0.0)
            && self.matched + self.contradicted + self.missed == 0
        {
            return None;
        }
        let matched = [0.0, 1.5, 2.2, 2.8][self.matched.min(3) as usize];
        let unmatched = match self.matched {
            0 => -0.5 * f64::from(self.contradicted.min(3)),
            _ => 0.0,
        };
        let missed = -0.3 * f64::from(self.missed.saturating_sub(1).min(4));
        Some(matched + seen.iter().sum::<f64>().clamp(-4.0, 2.0) + unmatched + missed)
    }

    /// Evidence against a neighbour at its reported position with ghost objects.
    fn against_invention(&self) -> Option<f64> {
        let odds: &[f64] = match self.boxes_only {
            false => &[0.0, -0.6, -3.6, -5.0],
            // The nearer the two are, the more the areas that only one of them observes.
            true if self.distance_m < 30.0 => &[0.0, 0.0, -0.5, -3.0, -5.0],
            // One object that the ego does not detect leaves none out that is right otherwise.
            true if self.beside_map => &[0.0, -0.6, -4.0],
            true => &[0.0, -1.0, -4.0],
        };
        // Further away an honest neighbour may detect some objects that the ego does not, but few.
        let unconfirmed = self.boxes_only && !self.beside_map;
        let enough = match (unconfirmed, self.contradicted > 0) {
            (false, false) => 6,
            (false, true) | (true, false) => 3,
            (true, true) => 2,
        };
        let most = if self.strange >= enough { -3.6 } else { 0.0 };
        let plain = match self.in_full_view {
            0 => 0.0,
            _ => FULL_VIEW,
        };
        let odds = odds[(self.contradicted as usize).min(odds.len() - 1)];
        let odds = odds.min(most).min(plain).min(self.against_shapes());
        (odds < 0.0).then_some(odds)
    }

    /// Evidence against boxes of another shape than the ego's. One is no evidence, nor is the smaller part of the common
    /// boxes: two vehicles may see the two ends of a bus.
    fn against_shapes(&self) -> f64 {
        match self.misshapen >= self.matched {
            true => FULL_VIEW * f64::from(self.misshapen.saturating_sub(1).min(4)),
            false => 0.0,
        }
    }

    /// Evidence against values of no network, against a copier, against unrelated successive maps and against jumps.
    fn against_other_attacks(&self) -> Option<(f64, MisbehaviourReason)> {
        use MisbehaviourReason::{Duplicated, ImplausibleMotion, ImplausibleValues, Inconsistent};
        let is_torn = !self.boxes_only && self.like_before.is_some_and(|like| like < SUCCESSIVE);
        let sure = [
            (self.is_out_of_range, -8.0, ImplausibleValues),
            (self.is_copied, -8.0, Duplicated),
            (self.jumped, -4.0, ImplausibleMotion),
            (is_torn, -3.0, Inconsistent),
        ];
        sure.into_iter()
            .find_map(|(is_so, odds, reason)| is_so.then_some((odds, reason)))
    }

    /// Evidence from one vehicle's confidence in the other at its reported position: within 35 m an honest neighbour is
    /// always detected with more than 0.06 and hardly ever with less than 0.15; four of five attackers are not. Further
    /// away occlusion is common. Boxes that are evidence begin at 0.2.
    fn seeing(&self, sure: f32) -> f64 {
        let blind = sure < if self.boxes_only { 0.01 } else { EMPTY };
        match (sure, self.distance_m) {
            (sure, _) if sure >= 0.25 => 1.2,
            (sure, _) if sure >= 0.15 => 0.3,
            (_, distance_m) if distance_m > 50.0 => 0.0,
            (_, distance_m) if distance_m > NEAR_M && blind => -0.7,
            (_, distance_m) if distance_m > NEAR_M => -0.3,
            (_, distance_m) if self.boxes_only && distance_m > 25.0 => -1.2,
            _ if blind => -3.0,
            _ => -1.5,
        }
    }
}

/// Boxes of a sender in the ego's frame.
fn moved(boxes: &[Box3d], ego_from_cav: &Isometry2<f64>) -> Vec<Box3d> {
    let [x, y]: [f64; 2] = ego_from_cav.translation.vector.into();
    let turn_rad = Vector3::z() * ego_from_cav.rotation.angle();
    let flat = Isometry3::new([x, y, 0.0].into(), turn_rad);
    boxes.iter().map(|one| one.transformed(&flat)).collect()
}

/// True if a place is within the distance of the ego and of the sender in which both detect objects.
fn is_near_both(at: &Point2<f64>, sender: &Point2<f64>) -> bool {
    let mut distances = [at.coords.norm(), (at - sender).norm()].into_iter();
    distances.all(|distance| (OWN_BODY_M..NEAR_M).contains(&distance))
}

/// True if a box within a radius has the heading and size of this one, or is farther away than [`SAME_M`] and so may be of
/// another vehicle. `None` without a box within the radius.
fn found_among(one: &Box3d, others: &[Box3d], radius_m: f64) -> Option<bool> {
    let away = others
        .iter()
        .map(|other| (other, (place(one) - place(other)).norm()));
    away.filter(|(_, away_m)| *away_m < radius_m)
        .map(|(other, away_m)| away_m >= SAME_M || is_alike(one, other))
        .reduce(|one, other| one || other)
}

/// True if two boxes may be detections of one vehicle by their sizes and headings; those of roundish objects agree.
fn is_alike(one: &Box3d, other: &Box3d) -> bool {
    let [of_one, of_other] = [one, other].map(|found| [found.size_m[0], found.size_m[1]]);
    let is_long = |[length_m, width_m]: [f64; 2]| length_m > LONG * width_m;
    let turn_rad = within_quarter_turn(one.heading_rad - other.heading_rad);
    let is_turned = is_long(of_one) && is_long(of_other) && turn_rad.abs() > SAME_HEADING_RAD;
    let mut sizes = of_one.into_iter().zip(of_other);
    !is_turned && sizes.all(|(a, b)| (a - b).abs() < SAME_SIZE_M || a.max(b) < SAME_SIZE * a.min(b))
}

/// True if the ego would detect a vehicle there: it is near, and no detected one hides it.
fn is_in_full_view(at: &Point2<f64>, detected: &[Box3d]) -> bool {
    let distance_m = at.coords.norm();
    distance_m < FULL_VIEW_M
        && !detected.iter().map(place).any(|other| {
            let along_m = other.coords.dot(&at.coords) / distance_m;
            let beside_m = other.coords.perp(&at.coords).abs() / distance_m;
            (OWN_BODY_M..distance_m).contains(&along_m) && beside_m < HIDDEN_M
        })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use protocol::Detection;

    use super::*;
    use crate::view::Content;

    impl Evidence {
        /// The log likelihood ratio without the type.
        fn log_odds(&self) -> Option<f64> {
            self.judgement().map(|(log_odds, _)| log_odds)
        }
    }

    /// Boxes that a vehicle at a position detects of the vehicles in a world.
    fn boxes(world: &[[f64; 2]], from: [f64; 2]) -> Content {
        let seen = world.iter().map(|[x, y]| Detection {
            box3d: Box3d {
                center_m: [x - from[0], y - from[1], -1.0],
                size_m: [4.4, 1.9, 1.6],
                heading_rad: 0.0,
            },
            score: 0.7,
            source: None,
        });
        Content::Boxes(
            seen.filter(|found| found.box3d.center_m[0].hypot(found.box3d.center_m[1]) > 1.0)
                .map(Into::into)
                .collect(),
        )
    }

    fn seen(content: &Content) -> SeenMessage {
        let Content::Boxes(objects) = content else {
            panic!("boxes")
        };
        let found = objects.iter().map(|object| {
            let detection = &object.detection;
            (detection.box3d, detection.score)
        });
        SeenMessage::of_boxes(found.collect())
    }

    const WORLD: [[f64; 2]; 6] = [
        [0.0, 0.0],
        [20.0, 3.0],
        [10.0, -6.0],
        [-8.0, 4.0],
        [25.0, -9.0],
        [14.0, 12.0],
    ];

    const GRID: protocol::BevGrid = protocol::BevGrid {
        x_min_m: -40.0,
        y_min_m: -40.0,
        cell_m: 1.0,
        width: 80,
        height: 80,
    };

    /// Evidence about a neighbour that invents a vehicle.
    fn with_invented(vehicle: [f64; 2]) -> Evidence {
        let mut echo = WORLD.to_vec();
        echo.push(vehicle);
        let (own, theirs) = (
            seen(&boxes(&WORLD, WORLD[0])),
            seen(&boxes(&echo, WORLD[1])),
        );
        Evidence::between(&own, &theirs, &Isometry2::translation(20.0, 3.0), 0.0)
    }

    #[test]
    fn an_honest_neighbour_is_accepted_and_a_wrong_position_is_not() {
        let (own, theirs) = (
            seen(&boxes(&WORLD, WORLD[0])),
            seen(&boxes(&WORLD, WORLD[1])),
        );
        let honest = Evidence::between(&own, &theirs, &Isometry2::translation(20.0, 3.0), 0.0);
        assert_eq!(
            (honest.matched, honest.contradicted, honest.missed),
            (4, 0, 0)
        );
        assert!(honest.log_odds().unwrap() > 3.0, "{honest:?}");
        let elsewhere = Evidence::between(&own, &theirs, &Isometry2::translation(12.0, 14.0), 0.0);
        assert!(
            elsewhere.matched <= 1 && elsewhere.log_odds().unwrap() < -3.0,
            "{elsewhere:?}"
        );
    }

    /// Evidence about a neighbour at a pose whose boxes are all changed before it sends them.
    fn with_changed(at: [f64; 2], count: usize, change: impl Fn(&mut Box3d)) -> Evidence {
        let own = seen(&boxes(&WORLD, WORLD[0]));
        let mut sent = boxes(&WORLD, WORLD[1]);
        if let Content::Boxes(objects) = &mut sent {
            for object in objects.iter_mut().rev().take(count) {
                change(&mut object.detection.box3d);
            }
        }
        Evidence::between(
            &own,
            &seen(&sent),
            &Isometry2::translation(at[0], at[1]),
            0.0,
        )
    }

    #[test]
    fn boxes_that_are_turned_or_scaled_count_against_their_sender_and_honest_differences_do_not() {
        let turned = |found: &mut Box3d| found.heading_rad += FRAC_PI_2;
        let small = |found: &mut Box3d| found.size_m = found.size_m.map(|size_m| 0.3 * size_m);
        for evidence in [
            with_changed(WORLD[1], 9, turned),
            with_changed(WORLD[1], 9, small),
        ] {
            let counts = (evidence.matched, evidence.misshapen, evidence.contradicted);
            assert_eq!(counts, (0, 4, 0));
            let (log_odds, reason) = evidence.judgement().unwrap();
            assert!(log_odds < -3.0 && reason == MisbehaviourReason::GhostObjects);
        }
        let opposite = |found: &mut Box3d| {
            found.heading_rad += PI - 0.4;
            found.size_m = found.size_m.map(|size_m| 1.3 * size_m);
        };
        // A pose error of 1 m moves all boxes, by half their width and more.
        let honest = with_changed([20.8, 3.6], 9, opposite);
        assert_eq!((honest.matched, honest.misshapen), (4, 0));
        let round = [0.0, FRAC_PI_2].map(|heading_rad| Box3d {
            size_m: [0.8, 0.6, 1.7],
            heading_rad,
            ..Box3d::default()
        });
        assert!(is_alike(&round[0], &round[1]), "a pedestrian");
        let one = with_changed(WORLD[1], 1, turned);
        assert!(
            one.misshapen == 1 && one.log_odds().unwrap() > 3.0,
            "{one:?}"
        );
    }

    #[test]
    fn what_a_neighbour_did_not_send_it_has_not_missed() {
        let own = seen(&boxes(&WORLD, WORLD[0]));
        for (sure, missed) in [(Some(0.0), 4), (None, 0)] {
            let theirs = SeenMessage::of_cells(GRID, vec![sure; GRID.cells()]);
            let evidence =
                Evidence::between(&own, &theirs, &Isometry2::translation(20.0, 3.0), 0.0);
            assert_eq!((evidence.missed, evidence.it_sees_ego), (missed, sure));
        }
    }

    #[test]
    fn boxes_of_a_neighbour_are_judged_as_boxes_beside_an_own_map() {
        let own = SeenMessage::of_cells(GRID, vec![Some(0.0); GRID.cells()]);
        let theirs = seen(&boxes(&WORLD, WORLD[1]));
        let mut evidence =
            Evidence::between(&own, &theirs, &Isometry2::translation(20.0, 3.0), 0.0);
        assert!(evidence.boxes_only && evidence.contradicted > 2);
        // Lists of boxes differ from frame to frame, in their length alone: that is no noise in a map.
        let before = evidence.judgement();
        evidence.like_before = Some(0.0);
        assert_eq!(evidence.judgement(), before);
    }

    #[test]
    fn vehicles_that_only_the_neighbour_sees_count_against_it() {
        let own = seen(&boxes(&WORLD, WORLD[0]));
        let mut more = WORLD.to_vec();
        more.extend([
            [5.0, 12.0],
            [-4.0, -9.0],
            [12.0, 5.0],
            [18.0, -14.0],
            [3.0, 18.0],
        ]);
        let theirs = seen(&boxes(&more, WORLD[1]));
        let evidence = Evidence::between(&own, &theirs, &Isometry2::translation(20.0, 3.0), 0.0);
        assert_eq!((evidence.matched, evidence.contradicted), (4, 5));
        let (log_odds, reason) = evidence.judgement().unwrap();
        assert!(log_odds < -3.0 && reason == MisbehaviourReason::GhostObjects);
    }

    #[test]
    fn a_single_invented_vehicle_in_full_view_counts_and_a_hidden_one_does_not() {
        let phantom = with_invented([12.0, -1.0]);
        assert_eq!((phantom.contradicted, phantom.in_full_view), (1, 1));
        assert_eq!(
            phantom.judgement(),
            Some((FULL_VIEW, MisbehaviourReason::GhostObjects))
        );
        // Behind the vehicle at (10, -6).
        let hidden = with_invented([15.0, -9.0]);
        assert_eq!((hidden.contradicted, hidden.in_full_view), (1, 0));
        assert!(hidden.log_odds() > phantom.log_odds());
        let far = with_invented([24.0, 5.5]);
        assert_eq!(far.in_full_view, 0);
    }

    #[test]
    fn a_copy_a_jump_and_noise_are_detected() {
        let fine = Evidence {
            matched: 3,
            ego_sees_it: Some(0.6),
            it_sees_ego: Some(0.6),
            ..Evidence::default()
        };
        assert!(fine.log_odds().unwrap() > 4.0);
        let copied = Evidence {
            is_copied: true,
            ..fine.clone()
        };
        let jumped = Evidence {
            jumped: true,
            ..Evidence::default()
        };
        let torn = Evidence {
            like_before: Some(0.7),
            ..Evidence::default()
        };
        let constant = Evidence {
            is_out_of_range: true,
            ..fine.clone()
        };
        for (evidence, reason) in [
            (constant, MisbehaviourReason::ImplausibleValues),
            (copied, MisbehaviourReason::Duplicated),
            (jumped, MisbehaviourReason::ImplausibleMotion),
            (torn, MisbehaviourReason::Inconsistent),
        ] {
            let (log_odds, found) = evidence.judgement().unwrap();
            assert!(log_odds < -2.0 && found == reason, "{found}");
        }
        let blind = Evidence {
            is_blind: true,
            ego_sees_it: Some(0.6),
            ..Evidence::default()
        };
        assert_eq!(
            blind.judgement(),
            Some((BLIND, MisbehaviourReason::PositionMismatch))
        );
        assert_eq!(
            Evidence::default().log_odds(),
            None,
            "no content, no evidence"
        );
    }
}
