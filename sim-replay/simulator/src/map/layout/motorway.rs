//! Carriageways along a ring, and ramps between them and the roads below.

use std::f64::consts::PI;

use super::super::curve::Pose2;
use super::super::profile::Profile;
use super::super::road::{Contact, LaneKind, RoadEnd};
use super::builder::{Builder, path, section};
use super::ring::Ring;

/// Distance between the poses that a carriageway's clothoids connect, metres.
const KNOT_M: f64 = 35.0;
/// Lane width, metres.
const LANE_M: f64 = 3.5;
/// Speed limits: 65 mph, and 18 m/s on ramps.
const LIMIT_MPS: f64 = 29.06;
const RAMP_LIMIT_MPS: f64 = 18.0;
/// Length of the stretch where a ramp leaves or joins, metres.
pub(super) const RAMP_ZONE_M: f64 = 55.0;
/// Distance between the outer lane's left edge and the ramp's at the end of that stretch, metres, and the angle between
/// them, radians.
const RAMP_OFFSET_M: f64 = 6.2;
const RAMP_ANGLE_RAD: f64 = 0.1;

/// The two carriageways.
pub(super) struct Motorway {
    pub ring: Ring,
    pub lanes: usize,
    /// Distance from the middle to the left edge of each carriageway's first lane, metres.
    pub median_m: f64,
}

/// One direction: 1 along the ring, -1 against it.
pub(super) type Direction = f64;

/// Pose of an end of a ramp, with height and slope there.
pub(super) type RampEnd = (Pose2, [f64; 2]);

impl Motorway {
    /// A carriageway from one length of the ring to another, in driving direction (to rising lengths along the ring, to
    /// falling ones against it).
    pub(super) fn carriageway(
        &self,
        builder: &mut Builder,
        from_m: f64,
        to_m: f64,
        direction: Direction,
    ) -> usize {
        let steps = ((to_m - from_m).abs() / KNOT_M).ceil().max(1.0) as usize;
        let stops = (0..=steps).map(|step| from_m + (to_m - from_m) * step as f64 / steps as f64);
        let stops: Vec<f64> = stops.collect();
        let poses = stops.iter().map(|&s| self.left_edge(s, direction));
        let curves = path(&poses.collect::<Vec<_>>());
        let records = (0..steps).map(|step| {
            let (a, b) = (stops[step], stops[step + 1]);
            let length = curves[step].length_m;
            // Slopes per metre of the ring, in driving direction, onto the longer or shorter carriageway.
            let scale = (b - a) / length;
            let ends = [a, b].map(|s| [self.ring.height_m(s), self.ring.slope(s) * scale]);
            Profile::hermite(curves[step].s_m, length, ends[0], ends[1])
        });
        let records = records.collect();
        let elevation = Profile { records };
        let mut right = vec![(LaneKind::Driving, LANE_M); self.lanes];
        right.push((LaneKind::Shoulder, 2.5));
        let lanes = section(&[(LaneKind::Shoulder, 0.75)], &right);
        builder.road(curves, elevation, lanes, LIMIT_MPS)
    }

    /// Carriageways one after the other through `stops_m`, linked; returns the first and the last.
    pub(super) fn carriageways(
        &self,
        builder: &mut Builder,
        stops_m: &[f64],
        direction: Direction,
    ) -> [usize; 2] {
        let pairs = stops_m.windows(2);
        let roads: Vec<usize> = pairs
            .map(|pair| self.carriageway(builder, pair[0], pair[1], direction))
            .collect();
        for pair in roads.windows(2) {
            builder.follow(pair[0], pair[1]);
        }
        [roads[0], roads[roads.len() - 1]]
    }

    /// Lets all lanes of a carriageway continue into the next one; between them a ramp leaves the outermost lane, if its
    /// start is given, or joins it, if its end is.
    pub(super) fn join(&self, builder: &mut Builder, before: usize, after: usize, ramp: RoadEnd) {
        let (junction, outermost) = (builder.junction(), self.lanes as i32);
        let (from, to) = (RoadEnd::end(before), RoadEnd::start(after));
        for lane in 1..=outermost {
            builder.connect(junction, from.lane(-lane), to.lane(-lane), LIMIT_MPS);
        }
        let (from, to) = match ramp.contact {
            Contact::Start => (from.lane(-outermost), ramp.lane(-1)),
            Contact::End => (ramp.lane(-1), to.lane(-outermost)),
        };
        builder.connect(junction, from, to, LIMIT_MPS);
    }

    /// The end of a ramp at `s_m`, where it leaves (`turn` -1) or joins (1).
    pub(super) fn ramp_end(&self, s_m: f64, direction: Direction, turn: f64) -> RampEnd {
        let outer = (self.lanes as f64 - 1.0) * LANE_M;
        let edge = self.left_edge(s_m, direction);
        let pose = edge.moved(0.0, -outer - RAMP_OFFSET_M, turn * RAMP_ANGLE_RAD);
        let slope = direction * self.ring.slope(s_m);
        (pose, [self.ring.height_m(s_m), slope])
    }

    /// A ramp from one end to the other.
    pub(super) fn ramp(builder: &mut Builder, from: RampEnd, to: RampEnd) -> usize {
        let curves = path(&[from.0, to.0]);
        let elevation = Profile::between(curves[0].length_m, from.1, to.1);
        let right = [(LaneKind::Driving, 4.0), (LaneKind::Shoulder, 1.0)];
        let lanes = section(&[(LaneKind::Shoulder, 0.4)], &right);
        builder.road(curves, elevation, lanes, RAMP_LIMIT_MPS)
    }

    /// Left edge of the first lane, in driving direction.
    fn left_edge(&self, s_m: f64, direction: Direction) -> Pose2 {
        let middle = self.ring.pose(s_m);
        if direction > 0.0 {
            middle.moved(0.0, -self.median_m, 0.0)
        } else {
            middle.moved(0.0, self.median_m, PI)
        }
    }
}
