//! Recorded speed against recorded poses: motion that the poses contradict is not used.

use std::ops::RangeInclusive;

use rayon::prelude::*;
use support::statistics;

use super::{Dataset, LoadOptions, ReadError, Scenario};

/// Stretches of each agent that are compared, evenly spread.
const STRETCHES: usize = 8;
/// Length of a stretch, and the shortest and longest where frames are few or rare, nanoseconds.
const STRETCH_NANOS: u64 = 2_000_000_000;
const LENGTHS_NANOS: RangeInclusive<u64> = 300_000_000..=4_000_000_000;
/// Smallest speed that is compared, m/s: below it, noise of poses counts.
const LEAST_MPS: f64 = 1.5;
/// Smallest difference that counts, m/s.
const LEAST_DIFFERENCE_MPS: f64 = 1.0;
/// Largest ratio of two speeds that agree. Miles and kilometres per hour differ by 1.6.
const MOST_RATIO: f64 = 1.5;

/// Mean speeds over a stretch, m/s.
#[derive(Clone, Copy)]
struct Speeds {
    recorded: f64,
    of_poses: f64,
}

/// Compares all agents. The recorded motion of an agent whose poses contradict it is not used from here on, and a
/// problem of the data set names both speeds.
pub(super) fn check(dataset: &mut Dataset) {
    let scenarios = dataset.scenarios.par_iter_mut();
    let problems: Vec<ReadError> = scenarios.flat_map_iter(check_scenario).collect();
    dataset.problems.extend(problems);
}

fn check_scenario(scenario: &mut Scenario) -> Vec<ReadError> {
    let mut problems = Vec::new();
    for (agent, id) in scenario.agents.clone().into_iter().enumerate() {
        let stretches: Vec<Speeds> = stretches(scenario, agent)
            .into_iter()
            .filter_map(|ticks| speeds(scenario, agent, ticks))
            .collect();
        let Some(Speeds { recorded, of_poses }) = contradiction(&stretches) else {
            continue;
        };
        let path = scenario.points_path(agent, 0, None).unwrap_or_default();
        let reason = format!(
            "agent {id}: the recorded speed is {recorded:.2} m/s where the recorded poses give {of_poses:.2} m/s: the \
             recorded motion is not used"
        );
        problems.push(ReadError::malformed(path.parent().unwrap_or(&path), reason));
        scenario.contradicted.insert(id);
    }
    problems
}

/// Medians of the speeds that disagree, if those are most of the stretches in which the agent moves.
fn contradiction(stretches: &[Speeds]) -> Option<Speeds> {
    let moving = stretches
        .iter()
        .filter(|speeds| speeds.recorded.max(speeds.of_poses) >= LEAST_MPS);
    let (recorded, of_poses): (Vec<f64>, Vec<f64>) = (moving.clone())
        .filter(|speeds| !speeds.agree())
        .map(|speeds| (speeds.recorded, speeds.of_poses))
        .unzip();
    // A quarter of all stretches as well: an agent that hardly moves is not judged by a single one.
    let is_most = 2 * recorded.len() > moving.count() && 4 * recorded.len() >= stretches.len();
    is_most.then_some(Speeds {
        recorded: statistics::median(&recorded)?,
        of_poses: statistics::median(&of_poses)?,
    })
}

impl Speeds {
    fn agree(self) -> bool {
        // Infinite or NaN where the poses stand still: then the difference alone decides.
        let ratio = self.recorded / self.of_poses;
        (self.recorded - self.of_poses).abs() < LEAST_DIFFERENCE_MPS
            || (1.0 / MOST_RATIO..=MOST_RATIO).contains(&ratio)
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

/// `None` if a frame cannot be read, or has no pose or no speed.
fn speeds(scenario: &Scenario, agent: usize, ticks: [usize; 3]) -> Option<Speeds> {
    let options = LoadOptions::without_points();
    let mut frames = Vec::with_capacity(ticks.len());
    for tick in ticks {
        let frame = scenario.load(agent, tick, &options).ok()?;
        frames.push((
            // The distance between poses has no sign: reversing is motion too.
            frame.speed_mps?.abs(),
            frame.world_from_lidar?.isometry().translation.vector,
            frame.capture_nanos,
        ));
    }
    let [(first, start, from), (middle, ..), (last, end, to)] = frames[..] else {
        return None;
    };
    let seconds = to.checked_sub(from).filter(|nanos| *nanos > 0)? as f64 * 1e-9;
    // Simpson's rule, or the trapezoidal one for two frames.
    let recorded = match ticks[0] == ticks[1] {
        true => f64::midpoint(first, last),
        false => (first + 4.0 * middle + last) / 6.0,
    };
    Some(Speeds {
        recorded,
        // The straight distance, which is shorter than the path of a turn.
        of_poses: (end - start).norm() / seconds,
    })
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
                 motion is not used"
            );
            assert!(message.ends_with(&expected), "{message}");
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
