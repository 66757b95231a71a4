//! Roundabouts: a one-way ring, with a junction at every arm.

use std::f64::consts::{FRAC_PI_2, PI};

use super::super::curve::{CurveShape, PlanCurve, Pose2};
use super::super::profile::Profile;
use super::super::road::{LaneKind, RoadEnd};
use super::builder::{Builder, section};

/// Width of the ring's lane, metres.
const LANE_M: f64 = 5.0;
/// Distance from the ring's centre line to the ends of the arms, metres.
const PORT_M: f64 = 15.0;
/// Distance along the ring from an arm to the point where it joins, metres.
const JOIN_M: f64 = 12.5;
/// Speed on the ring, metres per second.
const LIMIT_MPS: f64 = 8.0;

/// Position and size of a roundabout.
#[derive(Debug, Clone, Copy)]
pub(super) struct Roundabout {
    pub center_m: [f64; 2],
    /// Radius of the middle of its lane, metres.
    pub radius_m: f64,
}

impl Roundabout {
    /// End of the arm at an angle, facing away from the roundabout.
    pub(super) fn port(&self, angle_rad: f64) -> Pose2 {
        let [x, y] = self.center_m;
        Pose2::new(x, y, angle_rad).moved(self.radius_m + PORT_M, 0.0, 0.0)
    }

    /// x, y and radius of the free middle, metres.
    pub(super) fn island(&self) -> [f64; 3] {
        let [x, y] = self.center_m;
        [x, y, self.radius_m - LANE_M / 2.0 - 2.5]
    }

    /// Builds the ring and joins the arms to it, by rising angle; the roads of the arms end at their ports.
    pub(super) fn join(&self, builder: &mut Builder, arms: &[(f64, RoadEnd)]) {
        let ring: Vec<usize> = (0..arms.len())
            .map(|place| self.ring_road(builder, arms, place))
            .collect();
        for (place, &(_, arm)) in arms.iter().enumerate() {
            let junction = builder.junction();
            let before = ring[(place + ring.len() - 1) % ring.len()];
            let end = RoadEnd::end(before).lane(-1);
            let start = RoadEnd::start(ring[place]).lane(-1);
            builder.connect(junction, end, start, LIMIT_MPS);
            for incoming in builder.incoming(arm) {
                builder.connect(junction, incoming, start, LIMIT_MPS);
            }
            for outgoing in builder.outgoing(arm) {
                builder.connect(junction, end, outgoing, LIMIT_MPS);
            }
        }
    }

    /// The ring from one arm to the next, anticlockwise.
    fn ring_road(&self, builder: &mut Builder, arms: &[(f64, RoadEnd)], place: usize) -> usize {
        let join_rad = JOIN_M / self.radius_m;
        let from = arms[place].0 + join_rad;
        let next = arms[(place + 1) % arms.len()].0;
        let turn = (next - join_rad - from).rem_euclid(2.0 * PI);
        // The reference line is the left edge of the lane: the inner one.
        let inner = self.radius_m - LANE_M / 2.0;
        let [x, y] = self.center_m;
        let start = Pose2::new(x, y, from).moved(inner, 0.0, FRAC_PI_2);
        let right = [(LaneKind::Driving, LANE_M), (LaneKind::Shoulder, 0.6)];
        let lanes = section(&[(LaneKind::Shoulder, 1.0)], &right);
        let curvature = 1.0 / inner;
        let arc = PlanCurve::new(0.0, start, inner * turn, CurveShape::Arc { curvature });
        builder.road(vec![arc], Profile::default(), lanes, LIMIT_MPS)
    }
}
