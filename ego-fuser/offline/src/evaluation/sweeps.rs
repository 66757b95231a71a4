//! Sweeps of one tick: the frames of all agents that take part, with their kept feature maps.

use dataset::frame::Frame;
use dataset::{LoadOptions, Problem, ReadError, Scenario};
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
