//! Recorded speed and yaw rate against recorded poses: motion that the poses contradict is not used.

use std::ops::RangeInclusive;

use nalgebra::Vector3;
use protocol::Pose;
use rayon::prelude::*;
use support::statistics;

use super::frame::Frame;
use super::{Dataset, LoadOptions, ReadError, Scenario};

/// Stretches of each agent that are compared, evenly spread.
const STRETCHES: usize = 8;
/// Length of a stretch, and the shortest and longest where frames are few or rare, nanoseconds.
const STRETCH_NANOS: u64 = 2_000_000_000;
const LENGTHS_NANOS: RangeInclusive<u64> = 300_000_000..=4_000_000_000;
/// Share of the distance that leads against the vehicle's x axis where it reverses; less may be a turn.
const BACKWARD: f64 = 0.7;

/// Smallest value that is compared (below it, noise of poses counts), smallest difference that counts, and largest ratio
/// of two values that agree. Speeds, m/s: miles and kilometres per hour differ by 1.6. Yaw rates, degrees/s, change more
/// within a stretch, so that one stretch alone decides nothing.
const SPEED_LIMITS: [f64; 3] = [1.5, 1.0, 1.5];
const YAW_RATE_LIMITS: [f64; 3] = [2.0, 2.0, 2.5];
const LEAST_STRETCHES: [usize; 2] = [1, 2];

/// Means of speed or yaw rate over a stretch, m/s or degrees/s.
#[derive(Clone, Copy)]
struct Means {
    recorded: f64,
    of_poses: f64,
}

/// Compares all agents. A recorded speed or yaw rate of an agent whose poses contradict it is not used from here on, and
/// a problem of the data set names both values.
pub(super) fn check(dataset: &mut Dataset) {
    let scenarios = dataset.scenarios.par_iter_mut();
    let problems: Vec<ReadError> = scenarios.flat_map_iter(check_scenario).collect();
    dataset.problems.extend(problems);
}

fn check_scenario(scenario: &mut Scenario) -> Vec<ReadError> {
    let mut problems = Vec::new();
    for (agent, id) in scenario.agents.clone().into_iter().enumerate() {
        let (speeds, yaw_rates): (Vec<_>, Vec<_>) = stretches(scenario, agent)
            .into_iter()
            .filter_map(|ticks| means(scenario, agent, ticks))
            .unzip();
        let path = scenario.points_path(agent, 0, None).unwrap_or_default();
        let quantities = [
            ("speed", "m/s", SPEED_LIMITS, speeds),
            ("yaw rate", "degrees/s", YAW_RATE_LIMITS, yaw_rates),
        ]
        .into_iter()
        .zip(LEAST_STRETCHES)
        .zip(&mut scenario.contradicted);
        for (((quantity, unit, limits, means), least), contradicted) in quantities {
            let means: Vec<Means> = means.into_iter().flatten().collect();
            if let Some(Means { recorded, of_poses }) = contradiction(&means, limits, least) {
                let reason = format!(
                    "agent {id}: the recorded {quantity} is {recorded:.2} {unit} where the recorded poses give \
                     {of_poses:.2} {unit}: the recorded {quantity} is not used"
                );
                problems.push(ReadError::malformed(path.parent().unwrap_or(&path), reason));
                contradicted.insert(id.clone());
            }
        }
    }
    problems
}

/// Medians of the means that disagree, if those are most of the stretches in which the agent moves, and `least_count` at
/// least.
fn contradiction(stretches: &[Means], limits: [f64; 3], least_count: usize) -> Option<Means> {
    let [least, least_difference, most_ratio] = limits;
    let moving = stretches
        .iter()
        .filter(|means| means.recorded.abs().max(means.of_poses.abs()) >= least);
    let (recorded, of_poses): (Vec<f64>, Vec<f64>) = (moving.clone())
        .filter(|means| !means.agree(least_difference, most_ratio))
        .map(|means| (means.recorded, means.of_poses))
        .unzip();
    // A quarter of all stretches as well: an agent that hardly moves is not judged by a single one.
    let is_most = 2 * recorded.len() > moving.count() && 4 * recorded.len() >= stretches.len();
    (is_most && recorded.len() >= least_count).then_some(Means {
        recorded: statistics::median(&recorded)?,
        of_poses: statistics::median(&of_poses)?,
    })
}

impl Means {
    fn agree(self, least_difference: f64, most_ratio: f64) -> bool {
        // Infinite or NaN where the poses stand still: then the difference alone decides. Negative for other signs.
        let ratio = self.recorded / self.of_poses;
        (self.recorded - self.of_poses).abs() < least_difference
            || (1.0 / most_ratio..=most_ratio).contains(&ratio)
    }
}

/// First, middle and last tick of each stretch; a shorter one where the agent has no more frames.
fn stretches(scenario: &Scenario, agent: usize) -> Vec<[usize; 3]> {
    let times: Vec<(usize, u64)> = (0..)
        .zip(&scenario.ticks)
        .filter(|(tick, _)| scenario.is_present(agent, *tick))
        .map(|(tick, about)| (tick, about.capture_nanos))
        .collect();
    let mut found: Vec<[usize; 3]> = Vec::new();
    for first in (0..times.len()).step_by((times.len() / STRETCHES).max(1)) {
        let Some((start, nanos)) = times.get(first) else {
            continue;
        };
        let end = times.partition_point(|(_, time)| *time < nanos + STRETCH_NANOS);
        let end = end.min(times.len() - 1);
        if let (Some((middle, _)), Some((last, until))) =
            (times.get(first.midpoint(end)), times.get(end))
            && LENGTHS_NANOS.contains(&(until - nanos))
            // Of the last frames of a short scene one stretch suffices.
            && found.last().is_none_or(|[_, _, previous]| previous != last)
        {
            found.push([*start, *middle, *last]);
        }
    }
    found
}

/// Speed, m/s, and yaw rate, degrees/s, where they are recorded. `None` if a frame cannot be read, or has no pose.
fn means(
    scenario: &Scenario,
    agent: usize,
    ticks: [usize; 3],
) -> Option<(Option<Means>, Option<Means>)> {
    let options = LoadOptions::without_points();
    let frames = ticks.map(|tick| scenario.load(agent, tick, &options).ok());
    let [Some(first), Some(middle), Some(last)] = &frames else {
        return None;
    };
    let nanos = last.capture_nanos.checked_sub(first.capture_nanos);
    let seconds = nanos.filter(|nanos| *nanos > 0)? as f64 * 1e-9;
    let mean = |value: fn(&Frame) -> Option<f64>| {
        let (first, middle, last) = (value(first)?, value(middle)?, value(last)?);
        // Simpson's rule, or the trapezoidal one for two frames.
        Some(match ticks[0] == ticks[1] {
            true => f64::midpoint(first, last),
            false => (first + 4.0 * middle + last) / 6.0,
        })
    };
    let [start, end] = [first, last].map(|frame| frame.world_from_lidar);
    let (start, end) = (start?.isometry(), end?.isometry());
    // The straight way, which is shorter than the path of a turn.
    let way = end.translation.vector - start.translation.vector;
    let vehicle = (first.world_from_vehicle).map_or(start, |pose| pose.isometry());
    let ahead = way.dot(&(vehicle * Vector3::x()));
    let distance = match ahead < -BACKWARD * way.norm() {
        true => -way.norm(),
        false => way.norm(),
    };
    let turn_rad = Pose::from(start.inv_mul(&end)).yaw_rad();
    let means = |recorded, of_poses| Means { recorded, of_poses };
    Some((
        mean(|frame| frame.speed_mps).map(|speed| means(speed, distance / seconds)),
        mean(|frame| Some(frame.yaw_rate_rad_s?.to_degrees()))
            .map(|yaw_rate| means(yaw_rate, turn_rad.to_degrees() / seconds)),
    ))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use crate::opv2v::tests::write_frame;
    use crate::{Dataset, LoadOptions};

    /// Thirty frames at 10 m/s (36 km/h) along x with a line about the speed, and the same number of a parked vehicle.
    fn drive(root: &Path, speed: impl Fn(u32) -> String) -> Dataset {
        for frame in 0..30 {
            for (agent, x) in [(1, frame), (2, 0)] {
                let yaml = format!(
                    "lidar_pose: [{x}, 0, 2, 0, 0, 0]\n{}\nvehicles: {{}}\n",
                    speed(frame)
                );
                let name = format!("{agent}/{frame:06}");
                write_frame(root, &name, &yaml, &[[1.0, 2.0, 3.0, 0.5]]);
            }
        }
        crate::open(root).unwrap()
    }

    fn speed_of(dataset: &Dataset, agent: usize) -> Option<f64> {
        let scenario = &dataset.scenarios[0];
        let frame = scenario.load(agent, 7, &LoadOptions::default()).unwrap();
        frame.speed_mps
    }

    #[test]
    fn speeds_that_the_poses_contradict_are_not_used() {
        for (speed, recorded) in [("0.0", "0.00"), ("10.0", "2.78"), ("129.6", "36.00")] {
            let dir = tempfile::tempdir().unwrap();
            let dataset = drive(dir.path(), |_| format!("ego_speed: {speed}"));
            assert_eq!(speed_of(&dataset, 0), None, "{speed}");
            let message = dataset.problems[0].to_string();
            let expected = format!(
                "1: agent 1: the recorded speed is {recorded} m/s where the recorded poses give 10.00 m/s: the recorded \
                 speed is not used"
            );
            assert!(message.ends_with(&expected), "{message}");
        }
    }

    /// Problems of thirty frames at 10 m/s along x that turn to the right by 30 degrees/s, with this recorded motion. The
    /// flags are true if its speed and its yaw rate are used.
    fn problems_of_turn(imu: &str) -> (Vec<String>, [bool; 2]) {
        let dir = tempfile::tempdir().unwrap();
        for frame in 0..30 {
            let yaw = 3 * frame;
            let yaml = format!(
                "lidar_pose: [{frame}, 0, 2, 0, {yaw}, 0]\nimu: {{{imu}}}\nvehicles: {{}}\n"
            );
            let name = format!("1/{frame:06}");
            write_frame(dir.path(), &name, &yaml, &[[1.0, 2.0, 3.0, 0.5]]);
        }
        let dataset = crate::open(dir.path()).unwrap();
        let frame = dataset.scenarios[0].load(0, 7, &LoadOptions::default());
        let frame = frame.unwrap();
        let is_used = [frame.speed_mps.is_some(), frame.yaw_rate_rad_s.is_some()];
        let problems = dataset.problems.iter().map(ToString::to_string);
        (problems.collect(), is_used)
    }

    #[test]
    fn yaw_rates_and_signs_of_speeds_that_the_poses_contradict_are_named() {
        let sound = problems_of_turn("speed_mps: 10, yaw_rate_degps: 30");
        assert_eq!(sound, (Vec::new(), [true; 2]));
        for (imu, expected, is_used) in [
            (
                "speed_mps: 10, yaw_rate_degps: -30",
                "the recorded yaw rate is 30.00 degrees/s where the recorded poses give -30.00 degrees/s",
                [true, false],
            ),
            (
                "speed_mps: -10, yaw_rate_degps: 30",
                "the recorded speed is -10.00 m/s where the recorded poses give 10.00 m/s",
                [false, true],
            ),
        ] {
            let (problems, used) = problems_of_turn(imu);
            assert!(
                problems.len() == 1 && problems[0].contains(expected),
                "{problems:?}"
            );
            assert_eq!(used, is_used, "{imu}: the other is used");
        }
    }

    #[test]
    fn zero_is_the_speed_of_a_parked_vehicle() {
        let dir = tempfile::tempdir().unwrap();
        let dataset = drive(dir.path(), |_| "ego_speed: 0.0".into());
        assert_eq!(
            (speed_of(&dataset, 1), dataset.problems.len()),
            (Some(0.0), 1)
        );
    }

    #[test]
    fn speeds_that_agree_are_used() {
        let dir = tempfile::tempdir().unwrap();
        // Every tenth value is missing.
        let dataset = drive(dir.path(), |frame| match frame % 10 {
            9 => String::new(),
            _ => format!("ego_speed: {}", 34 + frame % 5),
        });
        assert_eq!(speed_of(&dataset, 0), Some(36.0 / 3.6));
        fs::remove_dir_all(dir.path().join("2")).unwrap();
        assert_eq!(crate::open(dir.path()).unwrap().problems.len(), 0);
    }
}
