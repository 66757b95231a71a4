//! Messages of the wire format, one at a time.

use dataset::frame::Frame;
use protocol::{CavId, Header, Key, Kind, Limits, Message, Topic, wire};
use pyo3::types::{PyAnyMethods, PyDict, PyDictMethods};
use pyo3::{Py, PyAny, PyErr, PyResult, Python, pyclass, pyfunction, pymethods};

use crate::error::error;
use crate::frame::PyAgent;
use crate::frame_parts::{AgentParts, decode_stream};
use crate::payload::{DecodedBev, PyBev, PyCamera, PyDetections, PyPoseEstimate, PyTracks};
use crate::{arrays, json};

/// One message: header and payload.
#[pyclass(frozen, get_all, name = "Message", module = "v2vloc")]
pub(crate) struct PyMessage {
    key: Option<String>,
    kind: String,
    cav: String,
    epoch: u64,
    sequence: u64,
    capture_time_ns: u64,
    publish_time_ns: u64,
    wire_bytes: usize,
    payload: Py<PyAny>,
}

/// A decoded message before Python sees it.
pub(crate) struct DecodedMessage {
    header: Header,
    content: DecodedContent,
    wire_bytes: usize,
}

enum DecodedContent {
    Bev(DecodedBev),
    Other(Message),
}

impl DecodedMessage {
    /// Decodes a message of a kind.
    fn of_kind(kind: Kind, bytes: &[u8]) -> Result<Self, protocol::WireError> {
        // Before the payload: a message of another kind is refused without being decoded.
        wire::decode_header([bytes])?.check_kind(kind)?;
        let (header, message) = wire::decode_any([bytes], &Limits::DEFAULT)?;
        Self::new(header, message, bytes.len())
    }

    /// Decodes a message that was published on a key.
    pub(crate) fn of_key(key: &Key, bytes: &[u8]) -> Result<Self, protocol::WireError> {
        if let Topic::Stream { cav, stream } | Topic::Received { cav, stream, .. } = &key.topic {
            let (header, message) = decode_stream(cav, *stream, [bytes])?;
            return Self::new(header, message, bytes.len());
        }
        // Only a liveliness token has no kind here, and it carries no message.
        Self::of_kind(key.topic.kind().unwrap_or(Kind::Control), bytes)
    }

    fn new(
        header: Header,
        message: Message,
        wire_bytes: usize,
    ) -> Result<Self, protocol::WireError> {
        let content = match message {
            Message::Bev(bev) => DecodedContent::Bev(DecodedBev::decode(bev)?),
            message => DecodedContent::Other(message),
        };
        Ok(Self {
            header,
            content,
            wire_bytes,
        })
    }
}

impl PyMessage {
    pub(crate) fn new(
        py: Python<'_>,
        key: Option<String>,
        decoded: DecodedMessage,
    ) -> PyResult<Self> {
        let Header { kind, stamp, .. } = decoded.header;
        let payload = match decoded.content {
            DecodedContent::Bev(bev) => PyBev::new(py, bev)?.into_any(),
            DecodedContent::Other(message) => payload(py, &stamp.cav, message)?,
        };
        Ok(Self {
            key,
            kind: kind.to_string(),
            cav: stamp.cav.to_string(),
            epoch: stamp.epoch,
            sequence: stamp.sequence,
            capture_time_ns: stamp.capture_nanos,
            publish_time_ns: stamp.publish_nanos,
            wire_bytes: decoded.wire_bytes,
            payload,
        })
    }
}

fn payload(py: Python<'_>, cav: &CavId, message: Message) -> PyResult<Py<PyAny>> {
    Ok(match message {
        Message::Lidar(sweep) => arrays::rows(py, sweep.points.xyzi)?.into_any(),
        Message::Radar(sweep) => arrays::rows(py, sweep.points.xyzi)?.into_any(),
        Message::Pose(pose) => PyPoseEstimate::new(py, &pose)?.into_any(),
        Message::Boxes(boxes) => PyDetections::of_agent(py, cav.as_str(), &boxes)?.into_any(),
        Message::Detections(found) => PyDetections::of_ego(py, &found)?.into_any(),
        Message::Tracks(tracks) => PyTracks::new(py, &tracks)?.into_any(),
        Message::Camera(camera) => PyCamera::new(py, &camera)?.into_any(),
        Message::Points(points) => PyAgent::new(py, AgentParts::of_points(cav, points))?
            .0
            .into_any(),
        Message::Truth(truth) => {
            let agents = PyDict::new(py);
            for agent in &truth.agents {
                let (agent, recorded) =
                    PyAgent::new(py, AgentParts::recorded(Frame::of_truth(agent), false))?;
                agents.set_item(recorded.cav.as_str(), agent)?;
            }
            let made = PyDict::new(py);
            made.set_item("tick", truth.tick)?;
            made.set_item("agents", agents)?;
            made.into_any().unbind()
        }
        Message::Gnss(gnss) => {
            let made = json::to_python(py, &gnss)?;
            let pose = arrays::pose(py, &gnss.world_from_lidar)?;
            made.bind(py).set_item("world_from_lidar", pose)?;
            made
        }
        Message::Imu(motion) => json::to_python(py, &motion)?,
        Message::Pace(pace) => json::to_python(py, &pace)?,
        Message::Descriptor(descriptor) => json::to_python(py, &descriptor)?,
        Message::Control(control) => json::to_python(py, &control)?,
        Message::Stats(stats) => json::to_python(py, &stats)?,
        // Decoded before, outside of Python's lock.
        Message::Bev(bev) => PyBev::new(py, DecodedBev::decode(bev).map_err(error)?)?.into_any(),
    })
}

#[pymethods]
impl PyMessage {
    fn __repr__(&self) -> String {
        let seconds = self.capture_time_ns as f64 * 1e-9;
        let place = self.key.as_deref().unwrap_or(&self.cav);
        format!(
            "Message({}, {place:?}, t={seconds:.3} s, {} bytes)",
            self.kind, self.wire_bytes
        )
    }
}

/// Decodes one message of the wire format.
#[pyfunction]
pub(crate) fn decode(py: Python<'_>, kind_or_key: &str, data: &[u8]) -> PyResult<PyMessage> {
    // Every key has slashes, and no kind has one.
    let is_key = kind_or_key.contains('/');
    let decoded = if is_key {
        let key = kind_or_key.parse::<Key>();
        let key = key.map_err(|cause| error_of(kind_or_key, cause))?;
        if key.topic.is_json() {
            let problem = "messages of this key are JSON: use json.loads";
            return Err(error_of(kind_or_key, problem));
        }
        py.detach(|| DecodedMessage::of_key(&key, data))
    } else {
        let kind = kind_or_key.parse::<Kind>().map_err(|_| {
            let known = Kind::ALL.map(|kind| kind.to_string()).join(", ");
            error(format!(
                "{kind_or_key:?} is no kind of message; there are {known}"
            ))
        })?;
        py.detach(|| DecodedMessage::of_kind(kind, data))
    };
    let decoded = decoded.map_err(|cause| error_of(kind_or_key, cause))?;
    PyMessage::new(py, is_key.then(|| kind_or_key.to_owned()), decoded)
}

fn error_of(kind_or_key: &str, cause: impl std::fmt::Display) -> PyErr {
    error(format!("{kind_or_key}: {cause}"))
}
