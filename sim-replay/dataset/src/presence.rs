//! Presence of agents: an agent takes part at the ego's ticks at which it has a frame.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use protocol::CavId;

use super::{LoadOptions, MissingFrame, Problem, Scenario, Tick};
use crate::frame::Frame;

/// The frames of one tick that could be read.
#[derive(Debug, Default)]
pub struct LoadedTick {
    /// Frames with the index of their agent, in the requested order. Absent agents and unreadable frames are not
    /// included.
    pub frames: Vec<(usize, Frame)>,
    /// Frames that could not be read: index of the agent, and the reason.
    pub unreadable: Vec<(usize, Problem)>,
    /// Number of absent agents.
    pub absent: usize,
}

impl Scenario {
    /// The scenario with the capture times at which any agent has a frame, and the frames that some of them lack: its
    /// ticks are those of the ego.
    pub(super) fn among(self, moments: Vec<Tick>, missing: Vec<MissingFrame>) -> Self {
        self.with_ticks(Some(Arc::new(moments)), missing)
    }

    /// The same among `moments`, or among its ticks where these are all.
    pub(super) fn with_ticks(
        self,
        moments: Option<Arc<Vec<Tick>>>,
        missing: Vec<MissingFrame>,
    ) -> Self {
        let lacking: HashSet<&str> = (missing.iter())
            .filter(|frame| Some(&frame.agent) == self.agents.first())
            .map(|frame| frame.stem.as_str())
            .collect();
        let all = moments.as_deref().unwrap_or(&self.ticks).iter();
        let ticks = all.filter(|tick| !lacking.contains(tick.stem.as_str()));
        let ticks: Vec<Tick> = ticks.cloned().collect();
        let agents: HashMap<&CavId, usize> = self.agents.iter().zip(0..).collect();
        let stems = ticks.iter().map(|tick| tick.stem.as_str());
        let stems: HashMap<&str, usize> = stems.zip(0..).collect();
        // Frames of other agents and at other times are ignored.
        let pairs = missing.iter().filter_map(|frame| {
            Some((*agents.get(&frame.agent)?, *stems.get(frame.stem.as_str())?))
        });
        let absent_at = Arc::new(pairs.collect());
        Self {
            absent_at,
            moments,
            ticks,
            missing,
            ..self
        }
    }

    /// True if an agent has a frame at a tick, by their indices in [`Self::agents`] and [`Self::ticks`].
    pub fn is_present(&self, agent_index: usize, tick_index: usize) -> bool {
        !self.absent_at.contains(&(agent_index, tick_index))
    }

    /// Indices of the agents that have a frame at a tick, the ego first.
    pub fn present_agents(&self, tick_index: usize) -> impl Iterator<Item = usize> + '_ {
        (0..self.agents.len()).filter(move |&agent| self.is_present(agent, tick_index))
    }

    /// The scenario with some of its agents (indices), the first as the ego: its ticks are those at which that one has
    /// a frame.
    pub(crate) fn arranged(&self, order: &[usize]) -> Self {
        let agents: Vec<CavId> = order
            .iter()
            .filter_map(|&index| self.agents.get(index).cloned())
            .collect();
        let mut missing = self.missing.clone();
        missing.retain(|frame| agents.contains(&frame.agent));
        let mut roadside_units = self.roadside_units.clone();
        roadside_units.retain(|unit| agents.contains(unit));
        // Not only the present ticks: the new ego may have frames where the old one has none.
        let moments = self.moments.clone();
        Self {
            agents,
            roadside_units,
            ..self.clone()
        }
        .with_ticks(moments, missing)
    }

    /// Number of missing frames of agents other than the ego at its ticks.
    pub fn absent_frames(&self) -> usize {
        let pairs = self.absent_at.iter();
        pairs.filter(|(_, tick)| *tick < self.ticks.len()).count()
    }

    /// Reads the frames of `agents` (indices) at a tick, of those present and readable.
    pub fn load_tick(
        &self,
        tick_index: usize,
        agents: impl IntoIterator<Item = usize>,
        options: &LoadOptions,
    ) -> LoadedTick {
        let mut loaded = LoadedTick::default();
        for agent in agents {
            match self.load(agent, tick_index, options) {
                Ok(frame) => loaded.frames.push((agent, frame)),
                Err(error) if error.is_absent() => loaded.absent += 1,
                Err(error) => loaded.unreadable.push((agent, Problem::from(&error))),
            }
        }
        loaded
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use crate::LoadOptions;

    const YAML: &str = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
    const PCD: &str = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 1\nHEIGHT 1\n\
                       VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3 0.5\n";

    fn frame(root: &Path, agent: &str, stem: u32) {
        let dir = root.join(agent);
        fs::create_dir_all(&dir).unwrap();
        fs::write(dir.join(format!("{stem:06}.yaml")), YAML).unwrap();
        fs::write(dir.join(format!("{stem:06}.pcd")), PCD).unwrap();
    }

    #[test]
    fn the_ego_keeps_its_ticks_when_another_vehicle_leaves_or_comes_late() {
        let dir = tempfile::tempdir().unwrap();
        (0..10).for_each(|stem| frame(dir.path(), "1", stem));
        (0..2).for_each(|stem| frame(dir.path(), "2", stem));
        (8..12).for_each(|stem| frame(dir.path(), "3", stem));
        let scenario = crate::open(dir.path()).unwrap().scenarios.remove(0);
        assert_eq!(
            (scenario.ticks.len(), scenario.absent_frames()),
            (10, 8 + 8)
        );
        let present = [1, 2, 9].map(|tick| scenario.present_agents(tick).collect::<Vec<_>>());
        assert_eq!(present, [vec![0, 1], vec![0], vec![0, 2]]);
        let loaded = scenario.load_tick(9, 0..3, &LoadOptions::default());
        assert_eq!(
            loaded
                .frames
                .iter()
                .map(|(agent, _)| *agent)
                .collect::<Vec<_>>(),
            [0, 2]
        );
        assert!(loaded.unreadable.is_empty());
        let error = scenario.load(1, 9, &LoadOptions::default()).unwrap_err();
        assert!(error.is_absent());
        assert!(
            error
                .to_string()
                .ends_with("agent 2 has no frame at tick 000009"),
            "{error}"
        );
        assert_eq!(
            scenario.missing.len(),
            8 + 8 + 2 * 2,
            "and two of agent 3 that neither the ego nor agent 2 has"
        );
    }

    #[test]
    fn a_frame_that_cannot_be_read_is_left_out_of_its_tick() {
        let dir = tempfile::tempdir().unwrap();
        ["1", "2"]
            .iter()
            .for_each(|agent| frame(dir.path(), agent, 0));
        fs::write(dir.path().join("2/000000.pcd"), &PCD[..PCD.len() - 6]).unwrap();
        let scenario = crate::open(dir.path()).unwrap().scenarios.remove(0);
        let loaded = scenario.load_tick(0, 0..2, &LoadOptions::default());
        assert_eq!((loaded.frames.len(), loaded.unreadable.len()), (1, 1));
        assert_eq!(loaded.unreadable[0].0, 1);
        assert!(
            loaded.unreadable[0].1.path.ends_with("2/000000.pcd"),
            "{:?}",
            loaded.unreadable
        );
    }
}
