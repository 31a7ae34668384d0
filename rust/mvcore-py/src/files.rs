//! Bindings of the file kernels.

use crate::checks::{check, shaped};
use crate::convert::{array, run, slice};
use numpy::{PyArray2, PyReadonlyArray3, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyBytes;

#[pyfunction]
pub fn encode_png<'py>(py: Python<'py>, rgb: PyReadonlyArray3<'py, u8>) -> PyResult<Bound<'py, PyBytes>> {
    let (h, w) = (rgb.shape()[0], rgb.shape()[1]);
    shaped(py, "rgb", rgb.shape(), &[h, w, 3])?;
    check(py, h.max(w) < 1 << 24, "rgb", "fewer than 2^24 pixels a side", format!("{h} x {w}"))?;
    let pixels = slice(&rgb, "rgb")?;
    Ok(PyBytes::new(py, &run(py, || mvcore::files::encode_png(pixels, w, h))?))
}

#[pyfunction]
pub fn read_obj(py: Python<'_>, path: String) -> PyResult<(Bound<'_, PyArray2<f64>>, Bound<'_, PyArray2<u32>>)> {
    let (vertices, faces) = run(py, || mvcore::files::read_obj(&path))?;
    let (v, f) = (vertices.len(), faces.len());
    Ok((array(py, vertices.into_flattened(), [v, 3])?, array(py, faces.into_flattened(), [f, 3])?))
}
