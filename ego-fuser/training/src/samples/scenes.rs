//! Datasets as one list of ticks, with poses and annotations kept in memory.

use std::collections::{BTreeSet, HashMap};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};

use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::frame::Frame;
use dataset::{self, LoadOptions, OpenOptions, Scenario, findings};
use perception::train::DataListing;
use protocol::PointCloud;
use support::file_digests::FileDigests;
use support::sync::lock;

use crate::Error;

/// A tick of a [`SceneSet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TickRef {
    /// Index of the scenario.
    pub scenario: usize,
    /// Index of the tick in it.
    pub tick: usize,
}

/// Scenes of one or more datasets.
///
/// Poses and annotations of a tick are read once and kept (some kilobytes each); points are read whenever they are
/// needed, and the operating system's page cache keeps them.
#[derive(Debug, Default)]
pub struct SceneSet {
    /// All scenarios.
    pub(crate) scenarios: Vec<Scenario>,
    /// All ticks, scenario after scenario.
    pub(crate) ticks: Vec<TickRef>,
    /// Problems of the datasets that could be left out.
    problems: Vec<String>,
    known: Mutex<HashMap<TickRef, Arc<Vec<Option<Frame>>>>>,
    /// Frames that could not be read, in order of occurrence.
    unreadable: Mutex<BTreeSet<String>>,
    /// Hash of the contents, computed on first use: it reads a little of every file.
    sha256: OnceLock<String>,
}

impl SceneSet {
    /// Opens datasets, splits or scenarios, with all agents of the protocol.
    ///
    /// # Errors
    /// [`Error::Read`] when a folder cannot be read, [`Error::Data`] when the protocol contradicts itself, or there is no
    /// tick in any of them.
    pub fn open(
        folders: &[PathBuf],
        options: &OpenOptions,
        protocol: &ProtocolConfig,
    ) -> Result<Self, Error> {
        let (mut scenarios, mut problems) = (Vec::new(), Vec::new());
        for folder in folders {
            let dataset = dataset::open_with(folder, options)?;
            let protocol = protocol.resolve(dataset.layout);
            // Samples have a limit of their own, counted from an ego that is drawn.
            let protocol = EvaluationProtocol {
                max_agents: usize::MAX,
                ..protocol.map_err(|error| Error::Data(format!("evaluation protocol: {error}")))?
            };
            let (scale, rule) = (options.intensity_scale, &protocol.ground_truth);
            findings::note(&findings::sampled(&dataset.scenarios, scale, Some(rule)));
            let found = dataset.scenarios.iter();
            scenarios.extend(found.filter_map(|scenario| protocol.arrange(scenario)));
            problems.extend(dataset.problems.iter().map(ToString::to_string));
        }
        let mut set = Self::new(scenarios);
        set.problems = problems;
        if set.ticks.is_empty() {
            let problem = format!("no tick of any scenario in {folders:?}");
            return Err(Error::Data(problem));
        }
        Ok(set)
    }

    /// A set of scenarios that are open already.
    pub fn new(scenarios: Vec<Scenario>) -> Self {
        let mut ticks = Vec::new();
        for (scenario, found) in scenarios.iter().enumerate() {
            ticks.extend((0..found.ticks.len()).map(|tick| TickRef { scenario, tick }));
        }
        Self {
            scenarios,
            ticks,
            ..Self::default()
        }
    }

    /// The scenario of a tick.
    pub fn scenario(&self, tick: TickRef) -> &Scenario {
        &self.scenarios[tick.scenario]
    }

    /// Poses and annotations of all agents at a tick, without points, in the order of the scenario's agents; `None` for
    /// those that are absent or whose file cannot be read.
    pub fn annotations(&self, tick: TickRef) -> Arc<Vec<Option<Frame>>> {
        // The lock is not held while files are read: two threads may read the same tick.
        let known = lock(&self.known).get(&tick).cloned();
        if let Some(frames) = known {
            return frames;
        }
        let options = LoadOptions {
            points: false,
            ..LoadOptions::default()
        };
        let scenario = self.scenario(tick);
        let loaded = scenario.load_tick(tick.tick, 0..scenario.agents.len(), &options);
        let mut frames: Vec<Option<Frame>> = scenario.agents.iter().map(|_| None).collect();
        for (agent, frame) in loaded.frames {
            let problems = frame.problems.iter().map(|problem| problem.message.clone());
            lock(&self.unreadable).extend(problems);
            frames[agent] = Some(frame);
        }
        let problems = loaded.unreadable.into_iter();
        lock(&self.unreadable).extend(problems.map(|(_, problem)| problem.message));
        let frames = Arc::new(frames);
        lock(&self.known).insert(tick, Arc::clone(&frames));
        frames
    }

    /// The sweep of one agent.
    ///
    /// # Errors
    /// [`Error::Read`] when a file is missing or malformed.
    pub fn points(&self, tick: TickRef, agent: usize) -> Result<PointCloud, Error> {
        let options = LoadOptions::default();
        Ok(self.scenario(tick).load(agent, tick.tick, &options)?.points)
    }

    /// Identification of the data, and their problems.
    pub fn data(&self) -> DataListing {
        let sha256 = self.sha256.get_or_init(|| {
            dataset::content_sha256(&self.scenarios, None, &FileDigests::default())
        });
        let unreadable = lock(&self.unreadable);
        DataListing {
            sha256: sha256.clone(),
            problems: self.problems.iter().chain(&*unreadable).cloned().collect(),
            without_pose: 0,
        }
    }
}
