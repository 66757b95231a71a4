//! Average precision of arrays of boxes: the numbers of `v2vloc eval`.

use dataset::average_precision::{Ordering, Scorer};
use dataset::ground_truth::GroundTruth;
use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use protocol::{Box3d, Detection};
use pyo3::types::{IntoPyDict, PyAnyMethods};
use pyo3::{Bound, IntoPyObject, PyAny, PyResult, Python, pyfunction};

use crate::error::error;
use crate::payload::{Objects, PyDetections};

/// Average precision of detections over frames; `None` without objects.
#[pyfunction]
#[pyo3(signature = (detections, truth, iou=None, *, ordering="global"))]
pub(crate) fn average_precision<'py>(
    py: Python<'py>,
    detections: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
    iou: Option<&Bound<'py, PyAny>>,
    ordering: &str,
) -> PyResult<Bound<'py, PyAny>> {
    let ordering: Ordering = serde_json::from_value(ordering.into()).map_err(|_| {
        error(format!(
            "ordering: {ordering:?}, expected \"global\" or \"frame\""
        ))
    })?;
    let frames = frames(detections, truth)?;
    let single = iou.map_or(Some(0.5), |iou| iou.extract::<f64>().ok());
    let thresholds: Vec<f64> = match (single, iou) {
        (None, Some(iou)) => iou.extract()?,
        (single, _) => single.into_iter().collect(),
    };
    if let Some(bad) = thresholds.iter().find(|iou| !(**iou > 0.0 && **iou <= 1.0)) {
        return Err(error(format!(
            "iou: {bad}, expected more than 0, at most 1"
        )));
    }
    // Without the lock of Python: nothing here is a Python object, and the matching takes time.
    let found = py.detach(|| {
        let mut scorer = Scorer::new(&thresholds);
        for (detections, truth) in &frames {
            scorer.add(detections, truth);
        }
        scorer.average_precisions(ordering)
    });
    match (single, found.first()) {
        (Some(_), Some(found)) => Ok(found.into_pyobject(py)?.into_any()),
        _ => Ok(thresholds.iter().zip(found).into_py_dict(py)?.into_any()),
    }
}

type ScoredFrame = (Vec<Detection>, GroundTruth);

/// Detections and ground truth of each frame.
fn frames(detections: &Bound<'_, PyAny>, truth: &Bound<'_, PyAny>) -> PyResult<Vec<ScoredFrame>> {
    let (detections, truth) = (entries("detections", detections)?, entries("truth", truth)?);
    if detections.len() != truth.len() {
        let (found, expected) = (detections.len(), truth.len());
        return Err(error(format!(
            "detections of {found} frames, truth of {expected}"
        )));
    }
    let frames = detections.iter().zip(&truth).enumerate();
    let scored = frames.map(|(index, (found, objects))| {
        Ok((scored_boxes(index, found)?, ground_truth(index, objects)?))
    });
    scored.collect()
}

fn entries<'py>(name: &str, frames: &Bound<'py, PyAny>) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let frames = frames
        .try_iter()
        .map_err(|_| error(format!("{name}: expected one entry per frame")))?;
    frames.collect()
}

fn scored_boxes(frame: usize, found: &Bound<'_, PyAny>) -> PyResult<Vec<Detection>> {
    let py = found.py();
    let (boxes, scores) = match found.cast::<PyDetections>() {
        Ok(found) => {
            let found = found.get();
            (
                found.boxes.bind(py).clone().into_any(),
                found.scores.bind(py).clone().into_any(),
            )
        }
        Err(_) => found.extract().map_err(|_| {
            let kind = found.get_type();
            error(format!(
                "detections of frame {frame}: {kind}, expected Detections or (boxes, scores)"
            ))
        })?,
    };
    let boxes = boxes_of("detections", frame, &boxes)?;
    let scores = as_array::<f32>(&scores)?;
    let scores: Vec<f32> = scores.as_array().iter().copied().collect();
    if scores.len() != boxes.len() {
        let (found, expected) = (scores.len(), boxes.len());
        return Err(error(format!(
            "detections of frame {frame}: {found} scores for {expected} boxes"
        )));
    }
    if let Some(bad) = scores.iter().find(|score| !score.is_finite()) {
        return Err(error(format!("detections of frame {frame}: score {bad}")));
    }
    let scored = boxes.into_iter().zip(scores);
    let detections = scored.map(|(box3d, score)| Detection {
        box3d,
        score,
        source: None,
    });
    Ok(detections.collect())
}

/// Ground truth of a frame; of arrays and annotations all boxes count, and all detections.
fn ground_truth(frame: usize, objects: &Bound<'_, PyAny>) -> PyResult<GroundTruth> {
    let Ok(objects) = objects.cast::<Objects>() else {
        return Ok(GroundTruth::of_boxes(boxes_of("truth", frame, objects)?));
    };
    if let Some(truth) = &objects.get().truth {
        return Ok(truth.clone());
    }
    let boxes = objects.get().boxes.as_ref().ok_or_else(|| {
        error(format!(
            "truth of frame {frame}: objects without boxes, as the pose of the LiDAR is unknown"
        ))
    })?;
    let boxes = boxes_of("truth", frame, boxes.bind(objects.py()).as_any())?;
    Ok(GroundTruth::of_boxes(boxes))
}

/// Rows of an array `[N, 7]`; an empty list is none.
fn boxes_of(what: &str, frame: usize, boxes: &Bound<'_, PyAny>) -> PyResult<Vec<Box3d>> {
    let boxes = as_array::<f64>(boxes)?;
    let shape = boxes.shape().to_vec();
    if shape != [boxes.len() / 7, 7] && !boxes.is_empty() {
        return Err(error(format!(
            "{what} of frame {frame}: boxes of shape {shape:?}, expected (N, 7)"
        )));
    }
    // In logical order: the array may be a transposed or strided view.
    let values: Vec<f64> = boxes.as_array().iter().copied().collect();
    if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
        return Err(error(format!("{what} of frame {frame}: a box with {bad}")));
    }
    let rows = values.as_chunks::<7>().0.iter();
    let boxes = rows.map(|&[x, y, z, dx, dy, dz, heading_rad]| Box3d {
        center_m: [x, y, z],
        size_m: [dx, dy, dz],
        heading_rad,
    });
    Ok(boxes.collect())
}

/// The array that NumPy makes of a list, or of an array of another type.
fn as_array<'py, T: numpy::Element>(
    value: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let py = value.py();
    let made = py
        .import("numpy")?
        .call_method1("asarray", (value, T::get_dtype(py)))?;
    let array = made
        .cast_into::<PyArrayDyn<T>>()
        .map_err(|cause| error(cause.to_string()))?;
    Ok(numpy::PyArrayMethods::readonly(&array))
}
