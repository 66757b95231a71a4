//! Data sets: folders of every layout, and recordings of runs, as sequences of frames.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig, lacking};
use dataset::{Layout, LoadOptions, Scenario};
use pyo3::exceptions::PyIndexError;
use pyo3::types::PyAnyMethods;
use pyo3::{Bound, PyAny, PyResult, Python, pyclass, pyfunction, pymethods};

use crate::error::error;
use crate::frame::FleetFrame;
use crate::frame_parts::{AgentParts, FrameParts};
use crate::recording_frames::RecordingFrames;

/// Frames of a data set or recording.
#[pyclass(frozen, module = "v2vloc")]
pub(crate) struct DataSet {
    #[pyo3(get)]
    path: PathBuf,
    #[pyo3(get)]
    layout: &'static str,
    #[pyo3(get)]
    scenarios: Vec<String>,
    /// Agents of each scenario that take part by the protocol, the ego first; none of a recording.
    #[pyo3(get)]
    agents: BTreeMap<String, Vec<String>>,
    #[pyo3(get)]
    problems: Vec<String>,
    /// Number of frames.
    count: usize,
    options: LoadOptions,
    /// Name of the protocol that was asked for; `None`: that of the layout, or of the recorded run.
    asked: Option<String>,
    protocol: EvaluationProtocol,
    source: FrameSet,
}

enum FrameSet {
    Folder(Vec<Arc<Scenario>>),
    Recording(Box<RecordingFrames>),
}

impl DataSet {
    fn load(&self, index: usize) -> Option<FrameParts> {
        let scenarios = match &self.source {
            FrameSet::Folder(scenarios) => scenarios,
            FrameSet::Recording(recording) => return recording.load(index, &self.protocol),
        };
        let mut tick = index;
        for scenario in scenarios {
            let Some(at) = scenario.ticks.get(tick) else {
                // The index runs over all scenarios, the tick over one.
                tick -= scenario.ticks.len();
                continue;
            };
            let loaded = scenario.load_tick(tick, scenario.present_agents(tick), &self.options);
            let mut parts = FrameParts::empty(&scenario.name, at.capture_nanos, &self.protocol);
            parts.tick = Some(tick as u64);
            let agents = self.agents.get(&scenario.name);
            parts.ego = agents.and_then(|agents| agents.first().cloned());
            parts.scenario = Some(Arc::clone(scenario));
            let problems = &mut parts.problems;
            problems.extend(loaded.unreadable.into_iter().map(|(_, one)| one.message));
            for (_, frame) in loaded.frames {
                problems.extend(frame.problems.iter().map(|one| one.message.clone()));
                let agent = AgentParts::recorded(frame, self.options.points);
                parts.agents.push(agent);
            }
            return Some(parts);
        }
        None
    }
}

#[pymethods]
impl DataSet {
    fn __len__(&self) -> usize {
        self.count
    }

    fn __getitem__(&self, py: Python<'_>, index: isize) -> PyResult<FleetFrame> {
        let count = self.count;
        let counted_from = if index < 0 { count } else { 0 };
        let wanted = counted_from.checked_add_signed(index);
        let parts = wanted.and_then(|index| py.detach(|| self.load(index)));
        let parts =
            parts.ok_or_else(|| PyIndexError::new_err(format!("frame {index} of {count}")))?;
        FleetFrame::new(py, parts)
    }

    fn __iter__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let builtins = slf.py().import("builtins")?;
        let indices = builtins.call_method1("range", (slf.len()?,))?;
        builtins.call_method1("map", (slf.getattr("__getitem__")?, indices))
    }

    /// Copies open the data set again: worker processes of a data loader.
    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, ReadArguments)> {
        let (path, options) = (self.path.clone(), &self.options);
        Ok((
            py.import("v2vloc")?.getattr("read")?,
            (
                path,
                options.points,
                options.radar,
                options.cameras,
                self.asked.clone(),
            ),
        ))
    }

    fn __repr__(&self) -> String {
        format!(
            "DataSet({:?}, {}, {} frames)",
            self.path, self.layout, self.count
        )
    }
}

type ReadArguments = (PathBuf, bool, bool, bool, Option<String>);

/// Opens a data set, or a recording of a run.
#[pyfunction]
#[pyo3(signature = (path, points=true, radar=false, cameras=false, protocol=None))]
pub(crate) fn read(
    py: Python<'_>,
    path: PathBuf,
    points: bool,
    radar: bool,
    cameras: bool,
    protocol: Option<String>,
) -> PyResult<DataSet> {
    // Frames are read later, when the program may be in another folder. An empty path has no absolute one.
    let path = std::path::absolute(&path).unwrap_or(path);
    let options = LoadOptions {
        points,
        radar,
        cameras,
        ..LoadOptions::default()
    };
    py.detach(|| -> PyResult<DataSet> {
        let protocols = ProtocolConfig {
            preset: protocol.clone(),
            ..ProtocolConfig::default()
        };
        let of_recording = protocols.resolve(Layout::RECORDING).map_err(error)?;
        let recording =
            dataset::recording_of(&path).map(|file| RecordingFrames::open(&file, &options));
        if let Some(Ok(recording)) = recording {
            return Ok(DataSet {
                path,
                layout: Layout::RECORDING.name(),
                scenarios: vec![recording.run.clone()],
                agents: BTreeMap::new(),
                problems: recording.problems.clone(),
                count: recording.frames.len(),
                options,
                protocol: { recording.protocol.clone() }
                    .filter(|_| protocol.is_none())
                    .unwrap_or(of_recording),
                asked: protocol,
                source: FrameSet::Recording(Box::new(recording)),
            });
        }
        // A recording that cannot be read gives the same error here.
        let mut dataset = dataset::open(&path).map_err(error)?;
        let asked = protocol;
        let protocol = protocols.resolve(dataset.layout).map_err(error)?;
        let mut problems: Vec<String> = dataset.problems.iter().map(ToString::to_string).collect();
        if asked.is_some() {
            // As in an evaluation, the frames are those of the protocol's ego.
            let arranged = protocols.arrange_all(&path, &dataset, None);
            let (_, arranged) = arranged.map_err(error)?;
            problems.extend(lacking(&dataset.scenarios, &arranged, None, None));
            dataset.scenarios = arranged;
        }
        let scenarios = &dataset.scenarios;
        let arranged = { scenarios.iter() }.filter_map(|scenario| protocol.arrange(scenario));
        let agents = arranged.map(|one| {
            let agents = one.agents.iter().map(ToString::to_string);
            (one.name, agents.collect())
        });
        Ok(DataSet {
            path,
            layout: dataset.layout.name(),
            scenarios: scenarios.iter().map(|one| one.name.clone()).collect(),
            agents: agents.collect(),
            problems,
            count: scenarios.iter().map(|one| one.ticks.len()).sum(),
            options,
            asked,
            protocol,
            source: FrameSet::Folder(dataset.scenarios.into_iter().map(Arc::new).collect()),
        })
    })
}
