//! Payloads of messages and parts of frames: pose estimate, feature map, detections, tracks, objects, image.

use dataset::frame::{Frame, Object};
use dataset::ground_truth::{GroundTruth, upright_box};
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use protocol::{Box3d, Codec, DecodedFeatures, Detection, Pose};
use pyo3::types::{IntoPyDict, PyBytes, PyDict, PyList};
use pyo3::{Py, PyAny, PyResult, Python, pyclass, pymethods};

use crate::arrays::{self, Matrix, optional};
use crate::json;

/// Pose estimate of an agent, or the reason why it has none.
#[derive(Default)]
#[pyclass(frozen, get_all, name = "PoseEstimate", module = "v2vloc")]
pub(crate) struct PyPoseEstimate {
    world_from_cav: Option<Matrix>,
    confidence: Option<f32>,
    covariance: Option<Matrix>,
    no_pose_reason: Option<String>,
    inlier_count: Option<u32>,
}

impl PyPoseEstimate {
    pub(crate) fn new(py: Python<'_>, estimate: &protocol::PoseEstimate) -> PyResult<Py<Self>> {
        let made = match estimate {
            protocol::PoseEstimate::Pose {
                world_from_cav,
                confidence,
                covariance,
            } => Self {
                world_from_cav: Some(arrays::pose(py, world_from_cav)?),
                confidence: Some(*confidence),
                covariance: optional(covariance.as_ref(), |one| arrays::covariance(py, one))?,
                ..Self::default()
            },
            protocol::PoseEstimate::NoPose {
                reason,
                inlier_count,
            } => Self {
                no_pose_reason: Some(json::name(reason)?),
                inlier_count: Some(*inlier_count),
                ..Self::default()
            },
        };
        Py::new(py, made)
    }
}

#[pymethods]
impl PyPoseEstimate {
    fn __repr__(&self, py: Python<'_>) -> String {
        let (Some(matrix), Some(confidence)) = (&self.world_from_cav, self.confidence) else {
            return format!(
                "PoseEstimate(no pose: {})",
                self.no_pose_reason.as_deref().unwrap_or_default()
            );
        };
        let matrix = matrix.bind(py).readonly();
        let [cos, sin, x, y, z] = [[0_usize, 0], [1, 0], [0, 3], [1, 3], [2, 3]]
            .map(|place| matrix.get(place).copied().unwrap_or(f64::NAN));
        let yaw_deg = sin.atan2(cos).to_degrees();
        let covariance = self.covariance.as_ref().map_or("", |_| ", covariance");
        format!(
            "PoseEstimate(x={x:.2}, y={y:.2}, z={z:.2} m, yaw={yaw_deg:.1} deg, confidence={confidence:.3}{covariance})"
        )
    }
}

/// BEV feature map of an agent.
#[pyclass(frozen, get_all, name = "Bev", module = "v2vloc")]
pub(crate) struct PyBev {
    features: Py<PyArray3<f32>>,
    mask: Option<Py<PyArray2<bool>>>,
    x_min_m: f64,
    y_min_m: f64,
    cell_m: f64,
    code_of: Option<u32>,
    dtype: String,
    payload_bytes: usize,
    pose: Py<PyPoseEstimate>,
}

/// A decoded feature map with its format and size on the wire.
pub(crate) struct DecodedBev {
    pub(crate) pose: protocol::PoseEstimate,
    pub(crate) decoded: DecodedFeatures,
    pub(crate) codec: Codec,
    /// Bytes of the body.
    pub(crate) payload_bytes: usize,
}

impl DecodedBev {
    pub(crate) fn decode(bev: protocol::Bev) -> Result<Self, protocol::WireError> {
        let protocol::Bev { pose, features } = bev;
        let (codec, payload_bytes) = (features.codec, features.body.len());
        Ok(Self {
            pose,
            decoded: features.decode(&protocol::Limits::DEFAULT)?,
            codec,
            payload_bytes,
        })
    }
}

impl PyBev {
    pub(crate) fn new(py: Python<'_>, bev: DecodedBev) -> PyResult<Py<Self>> {
        let DecodedFeatures { features, sent } = bev.decoded;
        let grid = features.grid;
        let shape = [features.channels, grid.height, grid.width];
        let [channels, height, width] = shape.map(|size| size as usize);
        let mask = optional(sent, |sent| {
            PyArray1::from_vec(py, sent).reshape([height, width])
        })?;
        let made = Self {
            features: PyArray1::from_vec(py, features.values)
                .reshape([channels, height, width])?
                .unbind(),
            mask: mask.map(pyo3::Bound::unbind),
            x_min_m: grid.x_min_m,
            y_min_m: grid.y_min_m,
            cell_m: grid.cell_m,
            code_of: features.code_of,
            dtype: json::name(&bev.codec.dtype)?,
            payload_bytes: bev.payload_bytes,
            pose: PyPoseEstimate::new(py, &bev.pose)?,
        };
        Py::new(py, made)
    }
}

#[pymethods]
impl PyBev {
    fn __repr__(&self, py: Python<'_>) -> String {
        let features = self.features.bind(py).readonly();
        let shape = features.as_array().shape().to_vec();
        let part = if self.mask.is_some() { ", masked" } else { "" };
        format!(
            "Bev({shape:?}, cells of {} m, {} bytes of {}{part})",
            self.cell_m, self.payload_bytes, self.dtype
        )
    }
}

/// Detections of an ego, or of one agent from its own sensors.
#[pyclass(frozen, get_all, name = "Detections", module = "v2vloc")]
pub(crate) struct PyDetections {
    cav: String,
    pub(crate) boxes: Matrix,
    pub(crate) scores: Py<PyArray1<f32>>,
    sources: Py<PyList>,
    tracks: Py<PyAny>,
    pose: Py<PyPoseEstimate>,
    method: Option<String>,
    agent_frame: Option<u64>,
    fused: Py<PyAny>,
    skipped: Py<PyAny>,
    neighbours: Py<PyAny>,
    stages_ms: Py<PyDict>,
}

impl PyDetections {
    /// The result of an ego.
    pub(crate) fn of_ego(py: Python<'_>, found: &protocol::Detections) -> PyResult<Py<Self>> {
        let stages = found.stages.iter();
        let stages_ms = stages.map(|timing| (&timing.stage, timing.nanos as f64 * 1e-6));
        let made = Self {
            method: Some(found.method.clone()),
            agent_frame: Some(found.agent_frame),
            fused: json::to_python(py, &found.fused)?,
            skipped: json::to_python(py, &found.skipped)?,
            neighbours: json::to_python(py, &found.neighbours)?,
            stages_ms: stages_ms.into_py_dict(py)?.unbind(),
            ..Self::of_list(py, found.ego.as_str(), &found.pose, &found.detections)?
        };
        Py::new(py, made)
    }

    /// Detections of one agent in its own sensor data.
    pub(crate) fn of_agent(
        py: Python<'_>,
        cav: &str,
        boxes: &protocol::Boxes,
    ) -> PyResult<Py<Self>> {
        let found: Vec<Detection> = boxes.detections().cloned().collect();
        let tracks: Vec<_> = boxes.objects().iter().map(|object| object.track).collect();
        let made = Self {
            tracks: json::to_python(py, &tracks)?,
            ..Self::of_list(py, cav, &boxes.pose, &found)?
        };
        Py::new(py, made)
    }

    fn of_list(
        py: Python<'_>,
        cav: &str,
        pose: &protocol::PoseEstimate,
        found: &[Detection],
    ) -> PyResult<Self> {
        let sources = found
            .iter()
            .map(|one| one.source.as_ref().map(ToString::to_string));
        let [tracks, fused, skipped, neighbours] =
            std::array::from_fn(|_| PyList::empty(py).into_any().unbind());
        Ok(Self {
            cav: cav.to_owned(),
            boxes: arrays::boxes(py, found.iter().map(|one| &one.box3d))?,
            scores: column(py, found, |one| one.score),
            sources: PyList::new(py, sources.collect::<Vec<_>>())?.unbind(),
            tracks,
            pose: PyPoseEstimate::new(py, pose)?,
            method: None,
            agent_frame: None,
            fused,
            skipped,
            neighbours,
            stages_ms: PyDict::new(py).unbind(),
        })
    }
}

#[pymethods]
impl PyDetections {
    fn __repr__(&self, py: Python<'_>) -> String {
        let count = self.__len__(py);
        let method = self.method.as_deref();
        let method = method.map_or(String::new(), |method| format!(", method={method:?}"));
        format!("Detections(cav={:?}, {count} boxes{method})", self.cav)
    }

    fn __len__(&self, py: Python<'_>) -> usize {
        numpy::PyUntypedArrayMethods::len(self.scores.bind(py))
    }
}

/// Tracks of an ego.
#[pyclass(frozen, get_all, name = "Tracks", module = "v2vloc")]
pub(crate) struct PyTracks {
    cav: String,
    agent_frame: u64,
    ids: Py<PyArray1<u64>>,
    boxes: Matrix,
    velocities_mps: Matrix,
    covariances: Py<PyArray3<f32>>,
    scores: Py<PyArray1<f64>>,
    hits: Py<PyArray1<u32>>,
    ages_s: Py<PyArray1<f64>>,
    unseen_s: Py<PyArray1<f64>>,
    pose: Py<PyPoseEstimate>,
    left_out: u32,
}

impl PyTracks {
    pub(crate) fn new(py: Python<'_>, found: &protocol::Tracks) -> PyResult<Py<Self>> {
        let tracks = &found.tracks;
        let covariances = tracks.iter().map(|track| track.covariance);
        let velocities_mps = tracks.iter().map(|track| track.velocity_mps).collect();
        let made = Self {
            cav: found.ego.to_string(),
            agent_frame: found.agent_frame,
            ids: column(py, tracks, |track| track.id),
            boxes: arrays::boxes(py, tracks.iter().map(|track| &track.box3d))?,
            velocities_mps: arrays::rows(py, velocities_mps)?,
            covariances: arrays::matrices(py, covariances)?,
            scores: column(py, tracks, |track| track.score),
            hits: column(py, tracks, |track| track.hits),
            ages_s: column(py, tracks, |track| track.age_s),
            unseen_s: column(py, tracks, |track| track.unseen_s),
            pose: PyPoseEstimate::new(py, &found.pose)?,
            left_out: found.left_out,
        };
        Py::new(py, made)
    }
}

/// One value for each row.
fn column<R, T: numpy::Element>(py: Python<'_>, rows: &[R], value: fn(&R) -> T) -> Py<PyArray1<T>> {
    PyArray1::from_vec(py, rows.iter().map(value).collect()).unbind()
}

#[pymethods]
impl PyTracks {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("Tracks(cav={:?}, {} tracks)", self.cav, self.__len__(py))
    }

    fn __len__(&self, py: Python<'_>) -> usize {
        numpy::PyUntypedArrayMethods::len(self.ids.bind(py))
    }
}

/// Annotated objects.
#[pyclass(frozen, module = "v2vloc")]
pub(crate) struct Objects {
    #[pyo3(get)]
    ids: Py<PyArray1<i64>>,
    #[pyo3(get)]
    classes: Py<PyList>,
    #[pyo3(get)]
    pub(crate) boxes: Option<Matrix>,
    #[pyo3(get)]
    world_from_object: Py<PyArray3<f64>>,
    #[pyo3(get)]
    sizes_m: Matrix,
    #[pyo3(get)]
    speeds_mps: Py<PyArray1<f64>>,
    /// The same objects as ground truth, with the range and the objects that do not count; `None` for an annotation.
    pub(crate) truth: Option<GroundTruth>,
}

impl Objects {
    /// The annotation of an agent.
    pub(crate) fn annotated(py: Python<'_>, frame: &Frame) -> PyResult<Py<Self>> {
        let objects: Vec<&Object> = frame.objects.iter().collect();
        let boxes = frame.world_from_lidar.map(|pose| {
            let lidar_from_world = pose.isometry().inverse();
            objects
                .iter()
                .map(|object| upright_box(object, &lidar_from_world))
                .collect::<Vec<_>>()
        });
        Self::new(py, &objects, boxes.as_deref(), None)
    }

    /// Objects with their boxes in the frame of a LiDAR, if its true pose is known; `truth` if they are the ground truth
    /// of an ego. Its boxes are read-only then: average precision is of the ground truth.
    pub(crate) fn new(
        py: Python<'_>,
        objects: &[&Object],
        boxes: Option<&[Box3d]>,
        truth: Option<GroundTruth>,
    ) -> PyResult<Py<Self>> {
        let poses = objects.iter().map(|object| &object.world_from_object);
        let boxes = optional(boxes, |boxes| arrays::boxes(py, boxes.iter()))?;
        if let (Some(boxes), Some(_)) = (&boxes, &truth) {
            boxes.bind(py).try_readwrite()?.make_nonwriteable();
        }
        let made = Self {
            ids: column(py, objects, |object| object.id),
            classes: PyList::new(py, objects.iter().map(|object| object.class.name()))?.unbind(),
            boxes,
            world_from_object: arrays::matrices(py, poses.map(Pose::matrix_rows))?,
            sizes_m: arrays::rows(py, objects.iter().map(|object| object.size_m).collect())?,
            // NaN where unknown: an array of numbers has no `None`.
            speeds_mps: column(py, objects, |object| object.speed_mps.unwrap_or(f64::NAN)),
            truth,
        };
        Py::new(py, made)
    }
}

#[pymethods]
impl Objects {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!("Objects({} boxes)", self.__len__(py))
    }

    fn __len__(&self, py: Python<'_>) -> usize {
        numpy::PyUntypedArrayMethods::len(self.ids.bind(py))
    }
}

/// Image of a camera, encoded, with its calibration.
#[pyclass(frozen, get_all, name = "Camera", module = "v2vloc")]
pub(crate) struct PyCamera {
    image: Py<PyBytes>,
    format: String,
    width_px: u32,
    height_px: u32,
    intrinsics: Option<Matrix>,
    lidar_from_camera: Option<Matrix>,
}

impl PyCamera {
    pub(crate) fn new(py: Python<'_>, camera: &protocol::Camera) -> PyResult<Py<Self>> {
        let metadata = &camera.metadata;
        let intrinsics = optional(metadata.pinhole, |pinhole| {
            // Rows of the camera matrix, which maps (x / z, y / z, 1) to column and row.
            let first = [pinhole.fx_px, 0.0, pinhole.cx_px];
            let second = [0.0, pinhole.fy_px, pinhole.cy_px];
            arrays::rows(py, vec![first, second, [0.0, 0.0, 1.0]])
        })?;
        let made = Self {
            image: PyBytes::new(py, &camera.image).unbind(),
            format: metadata.format.name().to_owned(),
            width_px: metadata.width_px,
            height_px: metadata.height_px,
            intrinsics,
            lidar_from_camera: optional(metadata.lidar_from_camera, |pose| {
                arrays::pose(py, &pose)
            })?,
        };
        Py::new(py, made)
    }
}

#[pymethods]
impl PyCamera {
    fn __repr__(&self) -> String {
        format!(
            "Camera({} x {} pixels, {})",
            self.width_px, self.height_px, self.format
        )
    }
}
