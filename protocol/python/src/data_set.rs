//! Data sets: folders of every layout, and recordings of runs, as sequences of frames.

use std::path::PathBuf;

use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{Dataset, Layout, LoadOptions};
use pyo3::exceptions::PyIndexError;
use pyo3::{Py, PyRef, PyResult, Python, pyclass, pyfunction, pymethods};

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
    #[pyo3(get)]
    problems: Vec<String>,
    /// Number of frames.
    count: usize,
    options: LoadOptions,
    protocol: EvaluationProtocol,
    source: FrameSet,
}

enum FrameSet {
    Folder(Dataset),
    Recording(Box<RecordingFrames>),
}

impl DataSet {
    fn load(&self, index: usize) -> Option<FrameParts> {
        let dataset = match &self.source {
            FrameSet::Folder(dataset) => dataset,
            FrameSet::Recording(recording) => return recording.load(index, &self.protocol),
        };
        let mut tick = index;
        for scenario in &dataset.scenarios {
            let Some(at) = scenario.ticks.get(tick) else {
                // The index runs over all scenarios, the tick over one.
                tick -= scenario.ticks.len();
                continue;
            };
            let loaded = scenario.load_tick(tick, scenario.present_agents(tick), &self.options);
            let mut parts = FrameParts::empty(&scenario.name, at.capture_nanos, &self.protocol);
            parts.tick = Some(tick as u64);
            let unreadable = loaded.unreadable.into_iter();
            parts
                .problems
                .extend(unreadable.map(|(_, problem)| problem.message));
            for (_, frame) in loaded.frames {
                let problems = frame.problems.iter();
                parts
                    .problems
                    .extend(problems.map(|problem| problem.message.clone()));
                let agent = AgentParts::recorded(frame, self.options.points);
                parts.agents.push(agent);
            }
            return Some(parts);
        }
        None
    }

    fn frame(&self, py: Python<'_>, index: usize) -> PyResult<Option<FleetFrame>> {
        py.detach(|| self.load(index))
            .map(|parts| FleetFrame::new(py, parts))
            .transpose()
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
        let frame = wanted.map(|index| self.frame(py, index)).transpose()?;
        let frame = frame.flatten();
        frame.ok_or_else(|| PyIndexError::new_err(format!("frame {index} of {count}")))
    }

    fn __iter__(slf: Py<Self>) -> DataSetIterator {
        DataSetIterator {
            data_set: slf,
            next: 0,
        }
    }

    /// Copies open the data set again: worker processes of a data loader.
    fn __reduce__<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(pyo3::Bound<'py, pyo3::PyAny>, ReadArguments)> {
        use pyo3::types::PyAnyMethods;
        let (path, options) = (self.path.clone(), &self.options);
        Ok((
            py.import("v2vloc")?.getattr("read")?,
            (path, options.points, options.radar, options.cameras),
        ))
    }

    fn __repr__(&self) -> String {
        format!(
            "DataSet({:?}, {}, {} frames)",
            self.path, self.layout, self.count
        )
    }
}

type ReadArguments = (PathBuf, bool, bool, bool);

/// The frames of a data set in order.
#[pyclass(module = "v2vloc")]
pub(crate) struct DataSetIterator {
    data_set: Py<DataSet>,
    next: usize,
}

#[pymethods]
impl DataSetIterator {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&mut self, py: Python<'_>) -> PyResult<Option<FleetFrame>> {
        self.next += 1;
        self.data_set.get().frame(py, self.next - 1)
    }
}

/// Opens a data set, or a recording of a run.
#[pyfunction]
#[pyo3(signature = (path, points=true, radar=false, cameras=false))]
pub(crate) fn read(
    py: Python<'_>,
    path: PathBuf,
    points: bool,
    radar: bool,
    cameras: bool,
) -> PyResult<DataSet> {
    let options = LoadOptions {
        points,
        radar,
        cameras,
        ..LoadOptions::default()
    };
    py.detach(|| -> PyResult<DataSet> {
        let protocols = ProtocolConfig::default();
        let of_recording = protocols.resolve(Layout::RECORDING).map_err(error)?;
        let recording =
            dataset::recording_of(&path).map(|file| RecordingFrames::open(&file, &options));
        if let Some(Ok(recording)) = recording {
            return Ok(DataSet {
                path,
                layout: Layout::RECORDING.name(),
                scenarios: vec![recording.run.clone()],
                problems: recording.problems(),
                count: recording.frames.len(),
                options,
                protocol: of_recording,
                source: FrameSet::Recording(Box::new(recording)),
            });
        }
        // A recording that cannot be read gives the same error here.
        let dataset = dataset::open(&path).map_err(error)?;
        let scenarios = &dataset.scenarios;
        Ok(DataSet {
            path,
            layout: dataset.layout.name(),
            scenarios: scenarios.iter().map(|one| one.name.clone()).collect(),
            problems: dataset.problems.iter().map(ToString::to_string).collect(),
            count: scenarios.iter().map(|one| one.ticks.len()).sum(),
            options,
            protocol: protocols.resolve(dataset.layout).map_err(error)?,
            source: FrameSet::Folder(dataset),
        })
    })
}
