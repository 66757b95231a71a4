//! Frames: everything of one capture time, by agent, and the ground truth of an ego.

use std::sync::Arc;

use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig, intervals};
use dataset::frame;
use dataset::ground_truth::{self, GroundTruth};
use dataset::{Layout, Scenario};
use numpy::{PyArray2, PyUntypedArrayMethods};
use protocol::{Box3d, CavId};
use pyo3::types::{PyDict, PyDictMethods};
use pyo3::{Py, PyResult, Python, pyclass, pymethods};

use crate::arrays::{self, Matrix, optional};
use crate::error::error;
use crate::frame_parts::{AgentParts, FrameParts};
use crate::payload::{Objects, PyBev, PyCamera, PyDetections, PyPoseEstimate, PyTracks};

/// One agent at one capture time.
#[pyclass(frozen, get_all, name = "Agent", module = "v2vloc")]
pub(crate) struct PyAgent {
    cav: String,
    points: Option<Py<PyArray2<f32>>>,
    radar: Option<Py<PyArray2<f32>>>,
    cameras: Py<PyDict>,
    world_from_lidar: Option<Matrix>,
    gnss_world_from_lidar: Option<Matrix>,
    speed_mps: Option<f64>,
    yaw_rate_rad_s: Option<f64>,
    objects: Py<Objects>,
    pose: Option<Py<PyPoseEstimate>>,
    bev: Option<Py<PyBev>>,
    boxes: Option<Py<PyDetections>>,
}

impl PyAgent {
    /// Converts all parts but the ground truth, which stays in the frame as well.
    pub(crate) fn new(py: Python<'_>, parts: AgentParts) -> PyResult<(Py<Self>, frame::Frame)> {
        let mut recorded = parts.recorded;
        let cameras = PyDict::new(py);
        for (number, camera) in std::mem::take(&mut recorded.cameras) {
            cameras.set_item(number, PyCamera::new(py, &camera)?)?;
        }
        let cav = recorded.cav.to_string();
        let points = std::mem::take(&mut recorded.points).xyzi;
        let points = Some(points).filter(|_| parts.has_points);
        let radar = recorded.radar.take();
        let made = Self {
            points: optional(points, |points| arrays::rows(py, points))?,
            radar: optional(radar, |sweep| arrays::rows(py, sweep.xyzi))?,
            cameras: cameras.unbind(),
            world_from_lidar: optional(recorded.world_from_lidar, |pose| arrays::pose(py, &pose))?,
            gnss_world_from_lidar: optional(parts.gnss_world_from_lidar, |pose| {
                arrays::pose(py, &pose)
            })?,
            speed_mps: recorded.speed_mps,
            yaw_rate_rad_s: recorded.yaw_rate_rad_s,
            objects: Objects::annotated(py, &recorded)?,
            pose: optional(parts.pose, |pose| PyPoseEstimate::new(py, &pose))?,
            bev: optional(parts.bev, |bev| PyBev::new(py, bev))?,
            boxes: optional(parts.boxes, |sent| PyDetections::of_agent(py, &cav, &sent))?,
            cav,
        };
        Ok((Py::new(py, made)?, recorded))
    }
}

#[pymethods]
impl PyAgent {
    fn __repr__(&self, py: Python<'_>) -> String {
        let mut parts = vec![format!("{:?}", self.cav)];
        for (points, name) in [(&self.points, "points"), (&self.radar, "radar points")] {
            if let Some(points) = points {
                let count = points.bind(py).shape().first().copied().unwrap_or(0);
                parts.push(format!("{count} {name}"));
            }
        }
        let here: [(&str, bool); 5] = [
            ("true pose", self.world_from_lidar.is_some()),
            ("pose", self.pose.is_some()),
            ("bev", self.bev.is_some()),
            ("boxes", self.boxes.is_some()),
            ("cameras", !self.cameras.bind(py).is_empty()),
        ];
        let here = here.iter().filter(|(_, is_here)| *is_here);
        parts.extend(here.map(|(name, _)| (*name).to_owned()));
        format!("Agent({})", parts.join(", "))
    }
}

/// Everything of one capture time.
#[pyclass(frozen, name = "Frame", module = "v2vloc")]
pub(crate) struct FleetFrame {
    #[pyo3(get)]
    source: String,
    #[pyo3(get)]
    tick: Option<u64>,
    #[pyo3(get)]
    capture_time_ns: u64,
    #[pyo3(get)]
    agents: Py<PyDict>,
    #[pyo3(get)]
    detections: Py<PyDict>,
    #[pyo3(get)]
    tracks: Py<PyDict>,
    #[pyo3(get)]
    problems: Vec<String>,
    #[pyo3(get)]
    ego: Option<String>,
    truth: Vec<frame::Frame>,
    scenario: Option<Arc<Scenario>>,
    protocol: EvaluationProtocol,
}

impl FleetFrame {
    pub(crate) fn new(py: Python<'_>, parts: FrameParts) -> PyResult<Self> {
        let [agents, detections, tracks] = std::array::from_fn(|_| PyDict::new(py));
        let mut truth = Vec::with_capacity(parts.agents.len());
        for agent in parts.agents {
            let (agent, recorded) = PyAgent::new(py, agent)?;
            agents.set_item(recorded.cav.as_str(), agent)?;
            truth.push(recorded);
        }
        for result in &parts.detections {
            detections.set_item(result.ego.as_str(), PyDetections::of_ego(py, result)?)?;
        }
        for found in &parts.tracks {
            tracks.set_item(found.ego.as_str(), PyTracks::new(py, found)?)?;
        }
        // Without detections the first agent: the ego comes first in the order of a scene.
        let first = parts.detections.first().map(|result| &result.ego);
        let first = first.or(truth.first().map(|agent| &agent.cav));
        let first = first.map(ToString::to_string);
        Ok(Self {
            source: parts.source,
            tick: parts.tick,
            capture_time_ns: parts.capture_nanos,
            agents: agents.unbind(),
            detections: detections.unbind(),
            tracks: tracks.unbind(),
            problems: parts.problems,
            ego: parts.ego.or(first),
            truth,
            scenario: parts.scenario,
            protocol: parts.protocol,
        })
    }

    /// The agents that take part by a protocol, the ego first; of a run all. An ego that is not `named` must have the
    /// frames of the scenario: an evaluation by the protocol is over those of its ego.
    fn participants(&self, protocol: &EvaluationProtocol, named: bool) -> PyResult<Vec<CavId>> {
        let Some(scenario) = self.scenario.as_deref() else {
            return Ok(self.truth.iter().map(|agent| agent.cav.clone()).collect());
        };
        let Some(arranged) = protocol.arrange(scenario) else {
            return Ok(Vec::new());
        };
        if !named && arranged.ticks != scenario.ticks {
            let [ego, other] = [&arranged, scenario].map(|one| one.agents.first());
            let [ego, other] = [ego, other].map(|ego| ego.map_or("", CavId::as_str));
            let (name, scenario) = (&protocol.name, &scenario.name);
            return Err(error(format!(
                "protocol {name}: its ego is {ego} and has other frames than {other} in scenario {scenario}: \
                 read(path, protocol={name:?})"
            )));
        }
        Ok(arranged.agents)
    }

    /// The frames of these agents in their order, then that of an ego that is named and not among them.
    fn frames_of(&self, agents: &[CavId], ego: &str) -> Vec<&frame::Frame> {
        let place = |cav: &CavId| agents.iter().position(|agent| agent == cav);
        let mut frames: Vec<&frame::Frame> = self.truth.iter().collect();
        frames.retain(|agent| agent.cav.as_str() == ego || agents.contains(&agent.cav));
        frames.sort_by_key(|agent| place(&agent.cav).unwrap_or(agents.len()));
        frames
    }
}

#[pymethods]
impl FleetFrame {
    /// Objects that an ego is expected to find.
    #[pyo3(signature = (ego=None, *, protocol=None, area_m=None))]
    fn ground_truth(
        &self,
        py: Python<'_>,
        ego: Option<String>,
        protocol: Option<&str>,
        area_m: Option<[f64; 6]>,
    ) -> PyResult<Py<Objects>> {
        let named = protocol.map(|name| {
            let preset = Some(name.to_owned());
            let (of_all, layout) = (ProtocolConfig::default(), Layout::RECORDING);
            ProtocolConfig { preset, ..of_all }.resolve(layout)
        });
        let named = named.transpose().map_err(error)?;
        let protocol = named.unwrap_or_else(|| self.protocol.clone());
        if let Some(area_m) = &area_m {
            intervals("area_m", area_m).map_err(error)?;
        }
        let rule = area_m.map_or(protocol.ground_truth, |area_m| protocol.rule_within(area_m));
        let agents = self.participants(&protocol, ego.is_some())?;
        let default = match self.scenario {
            // The ego of a data set follows from the protocol.
            Some(_) => agents.first().map(ToString::to_string),
            None => self.ego.clone(),
        };
        let ego = ego.or(default).unwrap_or_default();
        let frames = self.frames_of(&agents, &ego);
        let is_ego = |agent: &frame::Frame| agent.cav.as_str() == ego;
        let mut known = frames.iter();
        let index = known.position(|agent| is_ego(agent) && agent.world_from_lidar.is_some());
        let index = index.ok_or_else(|| {
            let frame = self.__repr__(py);
            error(format!("no true pose of agent {ego:?} in {frame}"))
        })?;
        let (objects, boxes): (Vec<&frame::Object>, Vec<Box3d>) =
            ground_truth::merged_objects(&frames, index, &rule)
                .into_iter()
                .unzip();
        let truth = GroundTruth::of_tick(&frames, index, &rule);
        Objects::new(py, &objects, Some(&boxes), Some(truth))
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        let agents = self.agents.bind(py).keys();
        let tick = self
            .tick
            .map_or(String::new(), |tick| format!(", tick={tick}"));
        let detections = match self.detections.bind(py).len() {
            0 => String::new(),
            count => format!(", detections of {count}"),
        };
        let seconds = self.capture_time_ns as f64 * 1e-9;
        format!(
            "Frame({:?}{tick}, t={seconds:.3} s, agents={agents}{detections})",
            self.source
        )
    }
}
