//! NumPy arrays of poses, boxes and points.

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use protocol::{Box3d, PlanarCovariance, Pose};
use pyo3::{Py, PyResult, Python};

/// A matrix of `float64`.
pub(crate) type Matrix = Py<PyArray2<f64>>;

/// An optional value, converted.
pub(crate) fn optional<T, U>(
    value: Option<T>,
    make: impl FnOnce(T) -> PyResult<U>,
) -> PyResult<Option<U>> {
    value.map(make).transpose()
}

/// `[rows, COLUMNS]` from its rows.
pub(crate) fn rows<T: numpy::Element, const COLUMNS: usize>(
    py: Python<'_>,
    rows: Vec<[T; COLUMNS]>,
) -> PyResult<Py<PyArray2<T>>> {
    let shape = [rows.len(), COLUMNS];
    Ok(PyArray1::from_vec(py, rows.into_flattened())
        .reshape(shape)?
        .unbind())
}

/// A transform as `[4, 4]`.
pub(crate) fn pose(py: Python<'_>, pose: &Pose) -> PyResult<Matrix> {
    rows(py, pose.matrix_rows().into())
}

/// Matrices as `[N, 4, 4]`.
pub(crate) fn matrices<T: numpy::Element>(
    py: Python<'_>,
    matrices: impl ExactSizeIterator<Item = [[T; 4]; 4]>,
) -> PyResult<Py<PyArray3<T>>> {
    let shape = [matrices.len(), 4, 4];
    let values: Vec<[T; 4]> = matrices.flatten().collect();
    Ok(PyArray1::from_vec(py, values.into_flattened())
        .reshape(shape)?
        .unbind())
}

/// Boxes as `[N, 7]`: centre, full sizes, heading.
pub(crate) fn boxes<'a>(
    py: Python<'_>,
    boxes: impl Iterator<Item = &'a Box3d>,
) -> PyResult<Matrix> {
    let values = boxes.map(|box3d| {
        let ([x, y, z], [dx, dy, dz]) = (box3d.center_m, box3d.size_m);
        [x, y, z, dx, dy, dz, box3d.heading_rad]
    });
    rows(py, values.collect())
}

/// Covariance of x, y (square metres) and yaw (square radians) as `[3, 3]`.
pub(crate) fn covariance(py: Python<'_>, found: &PlanarCovariance) -> PyResult<Matrix> {
    let [xx, xy, yy] = [found.xx_m2, found.xy_m2, found.yy_m2].map(f64::from);
    let yaw = found.yaw_rad2.into();
    rows(py, vec![[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, yaw]])
}
