//! Motion gate: rejects poses that a vehicle cannot have reached from its previous ones.
//!
//! A pose that cannot be reached from the last accepted one is a jump: it is published with a lowered confidence and
//! counted. When several poses in a row can be reached from each other, they are right and the accepted one was wrong
//! (or the vehicle was carried): they become the accepted position.

use std::collections::VecDeque;

use nalgebra::Isometry3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::tracker::seconds;

/// Age up to which accepted poses enter the speed estimate, seconds.
const SPEED_WINDOW_S: f64 = 1.5;
/// Shortest time between two poses that a speed is computed from, seconds: below, their errors weigh too much.
const SPEED_BASE_S: f64 = 0.3;

/// Motion limits of a vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MotionGateConfig {
    /// Largest speed, metres per second.
    pub max_speed_mps: f64,
    /// Largest acceleration or deceleration, metres per second squared.
    pub max_acceleration_mps2: f64,
    /// Largest rate of turn, degrees per second.
    pub max_turn_deg_per_s: f64,
    /// Largest distance between two good poses of the same place, metres.
    pub position_slack_m: f64,
    /// Largest angle between two good poses of the same place, degrees.
    pub rotation_slack_deg: f64,
    /// Time without an accepted pose after which any pose is accepted, seconds.
    pub memory_s: f64,
    /// Number of poses in a row that have to agree on a new position.
    pub agreeing: usize,
    /// Factor on the confidence of a jump.
    pub penalty: f64,
}

impl Default for MotionGateConfig {
    /// Limits of a car, for poses with errors of about a metre.
    fn default() -> Self {
        Self {
            max_speed_mps: 50.0,
            max_acceleration_mps2: 12.0,
            max_turn_deg_per_s: 60.0,
            position_slack_m: 2.5,
            rotation_slack_deg: 8.0,
            memory_s: 5.0,
            agreeing: 3,
            penalty: 0.2,
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct TimedPose {
    capture_nanos: u64,
    world_from_lidar: Isometry3<f64>,
}

/// Recent poses of a vehicle.
#[derive(Debug, Clone, Default)]
pub(crate) struct MotionGate {
    config: MotionGateConfig,
    /// Accepted poses of the last seconds, oldest first.
    accepted: VecDeque<TimedPose>,
    /// Jumps in a row that can be reached from each other.
    elsewhere: Vec<TimedPose>,
    /// Number of jumps so far.
    pub(crate) jumps: u64,
}

impl MotionGate {
    /// Gate without any pose.
    pub(crate) fn new(config: MotionGateConfig) -> Self {
        Self {
            config,
            ..Self::default()
        }
    }

    /// Forgets all poses.
    pub(crate) fn clear(&mut self) {
        self.accepted.clear();
        self.elsewhere.clear();
    }

    /// Stores a pose. Returns the factor on its confidence: the penalty of a jump; 1 if it can be reached from the last
    /// accepted one, if there is none, or if it is the last of several jumps that agree, which are accepted now.
    pub(crate) fn judge(&mut self, capture_nanos: u64, world_from_lidar: Isometry3<f64>) -> f64 {
        let pose = TimedPose {
            capture_nanos,
            world_from_lidar,
        };
        let last = self.accepted.back().copied();
        let Some(last) = last.filter(|last| self.remembers(last, &pose)) else {
            // There is no pose yet, or the scene restarted.
            self.accepted.clear();
            self.accept(pose);
            return 1.0;
        };
        // The speed is that of earlier poses, this one not among them: a jump must not explain itself.
        if self.can_reach(&last, &pose, self.speed_mps()) {
            self.accept(pose);
            return 1.0;
        }
        self.jumps += 1;
        // At any speed: the accepted poses, which would give it, are the ones in doubt.
        let follows = self.elsewhere.last().is_some_and(|before| {
            self.remembers(before, &pose) && self.can_reach(before, &pose, None)
        });
        // A jump to yet another place starts a new row: scattered wrong poses never agree.
        if !follows {
            self.elsewhere.clear();
        }
        self.elsewhere.push(pose);
        if self.elsewhere.len() < self.config.agreeing {
            return self.config.penalty;
        }
        // All of the row, so that a speed at the new place can follow from it.
        self.accepted = std::mem::take(&mut self.elsewhere).into();
        1.0
    }

    fn accept(&mut self, pose: TimedPose) {
        self.elsewhere.clear();
        self.accepted.push_back(pose);
        self.accepted
            .retain(|kept| seconds(kept.capture_nanos, pose.capture_nanos) <= SPEED_WINDOW_S);
    }

    /// True if a pose is recent enough to check a later one against.
    fn remembers(&self, earlier: &TimedPose, later: &TimedPose) -> bool {
        let time_s = seconds(earlier.capture_nanos, later.capture_nanos);
        (0.0..=self.config.memory_s).contains(&time_s)
    }

    /// Speed over the last accepted poses, if they suffice.
    fn speed_mps(&self) -> Option<f64> {
        let (first, last) = (self.accepted.front()?, self.accepted.back()?);
        let time_s = seconds(first.capture_nanos, last.capture_nanos);
        (time_s >= SPEED_BASE_S).then(|| distance_m(first, last) / time_s)
    }

    /// True if a vehicle with this speed, or any, can be at `to` after `from`.
    fn can_reach(&self, from: &TimedPose, to: &TimedPose, speed_mps: Option<f64>) -> bool {
        let config = &self.config;
        let time_s = seconds(from.capture_nanos, to.capture_nanos);
        // The speed is computed from poses with errors up to the slack, over a second or so.
        let fastest = speed_mps.map_or(config.max_speed_mps, |speed| {
            speed + config.position_slack_m / SPEED_WINDOW_S + config.max_acceleration_mps2 * time_s
        });
        let reach_m = config.position_slack_m + fastest.min(config.max_speed_mps) * time_s;
        let [before, after] = [from, to].map(|pose| pose.world_from_lidar.rotation);
        let turn_deg = before.angle_to(&after).to_degrees();
        let may_turn_deg = config.rotation_slack_deg + config.max_turn_deg_per_s * time_s;
        distance_m(from, to) <= reach_m && turn_deg <= may_turn_deg
    }
}

fn distance_m(a: &TimedPose, b: &TimedPose) -> f64 {
    (a.world_from_lidar.translation.vector - b.world_from_lidar.translation.vector).norm()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    const TENTH_NANOS: u64 = 100_000_000;
    /// Factors on the confidence.
    const ACCEPTED: f64 = 1.0;
    const JUMP: f64 = 0.2;

    fn at(x: f64, y: f64, yaw_deg: f64) -> Isometry3<f64> {
        Isometry3::new(Vector3::new(x, y, 2.0), Vector3::z() * yaw_deg.to_radians())
    }

    /// Factors on the confidence of poses a tenth of a second apart.
    fn factors(motion_gate: &mut MotionGate, poses: &[Isometry3<f64>]) -> Vec<f64> {
        poses
            .iter()
            .enumerate()
            .map(|(step, pose)| motion_gate.judge(step as u64 * TENTH_NANOS, *pose))
            .collect()
    }

    #[test]
    fn a_drive_through_a_bend_is_no_jump() {
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        // 15 m/s, 30 degrees a second, with errors of half a metre.
        let drive: Vec<_> = (0..80)
            .map(|step| {
                let (time_s, shake) = (
                    f64::from(step) * 0.1,
                    if step % 2 == 0 { 0.5 } else { -0.5 },
                );
                let angle = 30.0_f64.to_radians() * time_s;
                let radius = 15.0 / 30.0_f64.to_radians();
                at(
                    radius * angle.sin() + shake,
                    radius * (1.0 - angle.cos()),
                    angle.to_degrees(),
                )
            })
            .collect();
        assert!(
            factors(&mut motion_gate, &drive)
                .iter()
                .all(|&factor| factor == ACCEPTED)
        );
        assert_eq!(motion_gate.jumps, 0);
    }

    #[test]
    fn a_jump_is_counted_and_not_stored() {
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        let mut drive: Vec<_> = (0..12).map(|step| at(f64::from(step), 0.0, 0.0)).collect();
        drive[6] = at(6.0, 40.0, 0.0);
        drive[9] = at(9.0, 0.0, 180.0);
        let factors = factors(&mut motion_gate, &drive);
        for (step, factor) in factors.into_iter().enumerate() {
            let expected = if step == 6 || step == 9 {
                JUMP
            } else {
                ACCEPTED
            };
            assert_eq!(factor, expected, "step {step}");
        }
        assert_eq!(motion_gate.jumps, 2);
    }

    #[test]
    fn poses_that_agree_on_a_new_place_are_accepted() {
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        let mut drive = vec![at(500.0, 0.0, 0.0)];
        drive.extend((0..5).map(|step| at(f64::from(step), 0.0, 0.0)));
        assert_eq!(
            factors(&mut motion_gate, &drive),
            [ACCEPTED, JUMP, JUMP, ACCEPTED, ACCEPTED, ACCEPTED]
        );
        assert_eq!(motion_gate.jumps, 3, "the third is at the new place");
    }

    #[test]
    fn jumps_that_do_not_agree_are_never_accepted() {
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        let anywhere = (0..20).map(|step| {
            at(
                f64::from((step * 7919) % 400),
                100.0 + f64::from(step * 60),
                0.0,
            )
        });
        let drive: Vec<_> = std::iter::once(at(0.0, 0.0, 0.0)).chain(anywhere).collect();
        assert!(
            factors(&mut motion_gate, &drive)[1..]
                .iter()
                .all(|&factor| factor == JUMP)
        );
        assert_eq!(
            motion_gate.judge(21 * TENTH_NANOS, at(20.0, 0.0, 0.0)),
            ACCEPTED
        );
    }

    #[test]
    fn a_step_is_checked_against_the_speed_before_it() {
        let standing: Vec<_> = (0..10).map(|_| at(0.0, 0.0, 0.0)).collect();
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        factors(&mut motion_gate, &standing);
        // A car at 50 m/s could be there, one that stood a moment ago cannot.
        assert_eq!(motion_gate.judge(10 * TENTH_NANOS, at(5.0, 0.0, 0.0)), JUMP);
    }

    #[test]
    fn a_restarted_scene_or_a_long_gap_resets_the_gate() {
        let mut motion_gate = MotionGate::new(MotionGateConfig::default());
        assert_eq!(
            motion_gate.judge(90_000_000_000, at(0.0, 0.0, 0.0)),
            ACCEPTED
        );
        assert_eq!(motion_gate.judge(0, at(900.0, 0.0, 0.0)), ACCEPTED);
        assert_eq!(
            motion_gate.judge(60_000_000_000, at(0.0, 0.0, 90.0)),
            ACCEPTED
        );
        motion_gate.clear();
        assert_eq!(
            motion_gate.judge(60_100_000_000, at(900.0, 0.0, 0.0)),
            ACCEPTED,
            "another vehicle"
        );
    }
}
