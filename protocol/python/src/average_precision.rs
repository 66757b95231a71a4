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
    let (is_single, thresholds): (bool, Vec<f64>) = match iou {
        None => (true, vec![0.5]),
        // Also of one threshold, which NumPy would take for a number.
        Some(several) if several.len().is_ok() => (false, several.extract()?),
        Some(single) => (true, vec![single.extract()?]),
    };
    if let Some(bad) = thresholds.iter().find(|iou| !(**iou > 0.0 && **iou <= 1.0)) {
        return Err(error(format!(
            "iou: {bad}, expected more than 0, at most 1"
        )));
    }
    // Without the lock of Python: nothing here is a Python object, and the matching takes time.
    let found = py.detach(|| {
        let mut scorer = Scorer::new(&thresholds);
        for (detections, truth) in ranked(frames) {
            scorer.add(&detections, &truth);
        }
        scorer.average_precisions(ordering)
    });
    match (is_single, found.first()) {
        (true, Some(found)) => Ok(found.into_pyobject(py)?.into_any()),
        _ => Ok(thresholds.iter().zip(found).into_py_dict(py)?.into_any()),
    }
}

type ScoredFrame = (Vec<(Box3d, f64)>, GroundTruth);

/// The frames with the ranks of the scores in their place: average precision depends on the order alone, and single
/// precision would take close scores for equal ones.
fn ranked(frames: Vec<ScoredFrame>) -> impl Iterator<Item = (Vec<Detection>, GroundTruth)> {
    let scores = frames.iter().flat_map(|(found, _)| found);
    let mut scores: Vec<f64> = scores.map(|(_, score)| *score).collect();
    scores.sort_by(f64::total_cmp);
    scores.dedup();
    let detection = move |(box3d, score): (Box3d, f64)| Detection {
        box3d,
        score: scores.partition_point(|known| *known < score) as f32,
        source: None,
    };
    frames
        .into_iter()
        .map(move |(found, truth)| (found.into_iter().map(&detection).collect(), truth))
}

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

fn scored_boxes(frame: usize, found: &Bound<'_, PyAny>) -> PyResult<Vec<(Box3d, f64)>> {
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
    let scores = as_array(&scores)?;
    let scores: Vec<f64> = scores.as_array().iter().copied().collect();
    if scores.len() != boxes.len() {
        let (found, expected) = (scores.len(), boxes.len());
        return Err(error(format!(
            "detections of frame {frame}: {found} scores for {expected} boxes"
        )));
    }
    if let Some(bad) = scores.iter().find(|score| !score.is_finite()) {
        return Err(error(format!("detections of frame {frame}: score {bad}")));
    }
    Ok(boxes.into_iter().zip(scores).collect())
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
    let boxes = as_array(boxes)?;
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
    let rows = values.as_chunks::<7>().0.iter().enumerate();
    let boxes = rows.map(|(index, &[x, y, z, dx, dy, dz, heading_rad])| {
        let size_m = [dx, dy, dz];
        if size_m.iter().any(|size| *size < 0.0) {
            return Err(error(format!(
                "{what} of frame {frame}: box {index} of size {size_m:?} m, expected 0 or more"
            )));
        }
        Ok(Box3d {
            center_m: [x, y, z],
            size_m,
            heading_rad,
        })
    });
    boxes.collect()
}

/// The array of numbers that NumPy makes of a list, or of an array of another type.
fn as_array<'py>(value: &Bound<'py, PyAny>) -> PyResult<PyReadonlyArrayDyn<'py, f64>> {
    let py = value.py();
    let made = py
        .import("numpy")?
        .call_method1("asarray", (value, numpy::dtype::<f64>(py)))?;
    let array = made
        .cast_into::<PyArrayDyn<f64>>()
        .map_err(|cause| error(cause.to_string()))?;
    Ok(numpy::PyArrayMethods::readonly(&array))
}
