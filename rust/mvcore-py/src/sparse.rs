//! Binding of the guided matcher.

use crate::convert::{array, run, slice};
use mvcore::match_epipolar::{DESCRIPTOR, Features};
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

#[pyfunction]
pub fn match_epipolar<'py>(
    py: Python<'py>,
    positions_a: PyReadonlyArray2<'py, f32>,
    descriptors_a: PyReadonlyArray2<'py, u8>,
    positions_b: PyReadonlyArray2<'py, f32>,
    descriptors_b: PyReadonlyArray2<'py, u8>,
    fundamental: PyReadonlyArray2<'py, f64>,
    band: f32,
    ratio: f32,
) -> PyResult<Bound<'py, PyArray2<u32>>> {
    let a = features(&positions_a, &descriptors_a)?;
    let b = features(&positions_b, &descriptors_b)?;
    let f: [f64; 9] = slice(&fundamental, "fundamental")?
        .try_into()
        .map_err(|_| PyValueError::new_err("fundamental: expected shape (3, 3)"))?;
    let pairs = run(py, || mvcore::match_epipolar::match_epipolar(a, b, &f, band, ratio))?;
    let n = pairs.len();
    array(py, pairs.into_flattened(), [n, 2])
}

fn features<'a>(
    positions: &'a PyReadonlyArray2<'_, f32>,
    descriptors: &'a PyReadonlyArray2<'_, u8>,
) -> PyResult<Features<'a>> {
    if positions.as_array().dim().1 != 2 || descriptors.as_array().dim().1 != DESCRIPTOR {
        return Err(PyValueError::new_err("positions, descriptors: expected shapes (n, 2) and (n, 128)"));
    }
    Ok(Features {
        positions: slice(positions, "positions")?.as_chunks::<2>().0,
        descriptors: slice(descriptors, "descriptors")?.as_chunks::<DESCRIPTOR>().0,
    })
}
