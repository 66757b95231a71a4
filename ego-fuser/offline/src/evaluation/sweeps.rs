//! Sweeps of one tick: the frames of all agents that take part, with their kept feature maps.

use dataset::frame::Frame;
use dataset::{LeftOut, LoadOptions, Problem, ReadError, Scenario};
use protocol::CavId;
use tch::Tensor;

use super::{EvaluateError, Evaluator};
use training::Error;

/// The sweep of one agent.
#[derive(Debug)]
pub(super) struct AgentSweep {
    /// Index of the agent in the scenario.
    pub(super) place: usize,
    /// Pose, annotations and, where needed, points.
    pub(super) frame: Frame,
    /// The map `[1, C, H, W]` that its encoder computed before; absent where none are stored.
    pub(super) map: Option<Tensor>,
}

impl Evaluator {
    /// Reads the frames of the agents at `places` at a tick. Absent agents and frames that cannot be read are left out
    /// and counted; the first of them is the ego; `with_maps` selects the agents whose maps are needed.
    pub(super) fn sweeps(
        &mut self,
        scenario: &Scenario,
        tick: usize,
        places: &[usize],
        load: &LoadOptions,
        with_maps: impl Fn(usize) -> bool,
    ) -> Result<Vec<AgentSweep>, EvaluateError> {
        let mut loaded = scenario.load_tick(tick, places.iter().copied(), load);
        // The account takes the first as the ego, which may be any agent of the recording.
        for (agent, _) in &mut loaded.unreadable {
            *agent = rank(*agent, places);
        }
        self.left_out.add_tick(&loaded);
        let mut sweeps = Vec::with_capacity(loaded.frames.len());
        for (place, frame) in loaded.frames {
            let mut map = Ok(None);
            if with_maps(place)
                && let Some(maps) = &mut self.maps
                && let Some(index) = maps.index_of(&scenario.name)
            {
                map = maps.map(index, scenario, place, tick).map(Some);
            }
            let map = match map {
                // It fails again where the vehicle perceives it, and is counted there.
                Err(Error::Detector(error)) if error.is_of_frame() => None,
                Err(Error::Read(error)) => {
                    let problem = Problem::from(&error);
                    self.left_out.add_unreadable(rank(place, places), problem);
                    continue;
                }
                map => map.map_err(Box::new)?,
            };
            sweeps.push(AgentSweep { place, frame, map });
        }
        Ok(sweeps)
    }

    /// Counts a frame of an agent that could not be computed, with its reason.
    pub(super) fn count_failure(
        &mut self,
        scenario: &Scenario,
        tick: usize,
        cav: &CavId,
        reason: &str,
    ) {
        let stem = scenario.ticks.get(tick).map_or("", |tick| &tick.stem);
        let frame = format!("scenario {}, tick {stem}, agent {cav}", scenario.name);
        self.left_out.add_failed(&frame, reason);
    }
}

/// Counts a tick at which a live run had no true pose of the ego: its frame is absent, cannot be read, or lacks the pose.
pub fn add_unplaced_tick(
    left_out: &mut LeftOut,
    scenario: &Scenario,
    (tick, ego): (usize, &CavId),
    variant: Option<&str>,
) {
    let place = scenario.agents.iter().position(|agent| agent == ego);
    let place = place.unwrap_or(usize::MAX);
    let options = LoadOptions {
        // With a pose its sweep is at fault.
        points: scenario.has_poses(place, tick),
        lidar_variant: variant.map(str::to_owned),
        ..LoadOptions::default()
    };
    match scenario.load(place, tick, &options) {
        Ok(_) => left_out.add_unreadable(0, without_true_pose(scenario, tick, ego)),
        Err(error) if error.is_absent() => left_out.absent_frames += 1,
        Err(error) => left_out.add_unreadable(0, Problem::from(&error)),
    }
}

/// The finding that the recording has no true pose of the ego at a tick: nothing tells where the true boxes are.
pub fn without_true_pose(scenario: &Scenario, tick: usize, ego: &CavId) -> Problem {
    let place = scenario.agents.iter().position(|agent| agent == ego);
    let sweep = place.and_then(|place| scenario.points_path(place, tick, None).ok());
    Problem::from(&ReadError::Malformed {
        path: sweep.unwrap_or_default(),
        line: None,
        field: Some("lidar_pose".to_owned()),
        reason: format!("no true pose of the ego {ego}, so its result is not evaluated"),
    })
}

/// Index of an agent among those that take part.
fn rank(agent: usize, places: &[usize]) -> usize {
    let rank = places.iter().position(|&place| place == agent);
    rank.unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const PCD: &str = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 1\n\
                       HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3 0.5\n";

    #[test]
    fn a_tick_without_the_ego_is_counted_for_its_reason() {
        let folder = tempfile::tempdir().unwrap();
        // The ego has no frame at tick 1, no pose at tick 2, and half a sweep at tick 3.
        for (agent, ticks) in [("1", [0, 1, 2, 3].as_slice()), ("2", &[0, 2, 3])] {
            let of_agent = folder.path().join(agent);
            fs::create_dir(&of_agent).unwrap();
            for &tick in ticks {
                let is_ego = agent == "2";
                let yamls = ["lidar_pose: [0, 0, 2, 0, 0, 0]\n", "ego_speed: 36\n"];
                let yaml = yamls[usize::from(is_ego && tick == 2)];
                let pcd = &PCD[..PCD.len() - if is_ego && tick == 3 { 6 } else { 0 }];
                fs::write(of_agent.join(format!("{tick:06}.yaml")), yaml).unwrap();
                fs::write(of_agent.join(format!("{tick:06}.pcd")), pcd).unwrap();
            }
        }
        let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
        let ego = CavId::new("2").unwrap();
        let counted = [1, 2, 3].map(|tick| {
            let mut left_out = LeftOut::default();
            add_unplaced_tick(&mut left_out, &scenario, (tick, &ego), None);
            (left_out.absent_frames, left_out.ticks, left_out.reasons())
        });
        let [absent, unposed, unreadable] = &counted;
        assert_eq!(*absent, (1, 0, String::new()));
        assert!(
            unposed.1 == 1 && unposed.2.contains("no true pose of the ego 2"),
            "{unposed:?}"
        );
        assert!(
            unreadable.1 == 1 && unreadable.2.contains("000003.pcd"),
            "{unreadable:?}"
        );
    }
}
