//! Data sets: folders of every layout, and recordings of runs, as sequences of frames.

use std::path::PathBuf;

use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig};
use dataset::{Dataset, Layout, LoadOptions};
use pyo3::exceptions::PyIndexError;
use pyo3::{Py, PyErr, PyRef, PyResult, Python, pyclass, pyfunction, pymethods};

use crate::error::error;
use crate::frame::FleetFrame;
use crate::frame_parts::{AgentParts, FrameParts};
use crate::recording_frames::RecordingFrames;

/// Frames of a data set or recording.
#[pyclass(frozen, module = "v2vloc")]
pub(crate) struct DataSet {
    path: PathBuf,
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
            FrameSet::Recording(recording) => return recording.load(index),
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
        match &self.source {
            FrameSet::Folder(dataset) => dataset
                .scenarios
                .iter()
                .map(|scenario| scenario.ticks.len())
                .sum(),
            FrameSet::Recording(recording) => recording.frames.len(),
        }
    }

    fn __getitem__(&self, py: Python<'_>, index: isize) -> PyResult<FleetFrame> {
        let count = self.__len__();
        let wanted = if index < 0 {
            count.checked_add_signed(index)
        } else {
            usize::try_from(index).ok()
        };
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

    #[getter]
    fn path(&self) -> &PathBuf {
        &self.path
    }

    #[getter]
    fn layout(&self) -> &'static str {
        match &self.source {
            FrameSet::Folder(dataset) => dataset.layout.name(),
            FrameSet::Recording(_) => Layout::RECORDING.name(),
        }
    }

    #[getter]
    fn scenarios(&self) -> Vec<String> {
        match &self.source {
            FrameSet::Folder(dataset) => dataset
                .scenarios
                .iter()
                .map(|scenario| scenario.name.clone())
                .collect(),
            FrameSet::Recording(recording) => vec![recording.run.clone()],
        }
    }

    #[getter]
    fn problems(&self) -> Vec<String> {
        match &self.source {
            FrameSet::Folder(dataset) => dataset.problems.iter().map(ToString::to_string).collect(),
            FrameSet::Recording(recording) => recording.problems(),
        }
    }

    fn __repr__(&self) -> String {
        format!(
            "DataSet({:?}, {}, {} frames)",
            self.path,
            self.layout(),
            self.__len__()
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
    let opened: Result<_, PyErr> = py.detach(|| {
        let protocols = ProtocolConfig::default();
        let of_recording = protocols.resolve(Layout::RECORDING).map_err(error)?;
        let recording = dataset::recording_of(&path)
            .map(|file| RecordingFrames::open(&file, &options, of_recording.clone()));
        if let Some(Ok(recording)) = recording {
            return Ok((FrameSet::Recording(Box::new(recording)), of_recording));
        }
        // A recording that cannot be read gives the same error here.
        let dataset = dataset::open(&path).map_err(error)?;
        let protocol = protocols.resolve(dataset.layout).map_err(error)?;
        Ok((FrameSet::Folder(dataset), protocol))
    });
    let (source, protocol) = opened?;
    Ok(DataSet {
        path,
        options,
        protocol,
        source,
    })
}
