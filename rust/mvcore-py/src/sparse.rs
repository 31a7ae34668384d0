//! Binding of the guided matcher.

use crate::checks::{check, finite, rows, shaped, within};
use crate::convert::{array, run, slice};
use mvcore::match_epipolar::{DESCRIPTOR, Features};
use numpy::{PyArray2, PyReadonlyArray2, PyUntypedArrayMethods};
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
    shaped(py, "fundamental", fundamental.shape(), &[3, 3])?;
    let mut f = [0.0; 9];
    f.copy_from_slice(slice(&fundamental, "fundamental")?);
    finite(py, "fundamental", f.iter().copied())?;
    within(py, "ratio", f64::from(ratio), 0.0, 1.0)?;
    let pairs = run(py, || mvcore::match_epipolar::match_epipolar(a, b, &f, band, ratio))?;
    let n = pairs.len();
    array(py, pairs.into_flattened(), [n, 2])
}

fn features<'a>(
    positions: &'a PyReadonlyArray2<'_, f32>,
    descriptors: &'a PyReadonlyArray2<'_, u8>,
) -> PyResult<Features<'a>> {
    let features = Features {
        positions: rows::<2, _>(positions, "positions")?,
        descriptors: rows::<DESCRIPTOR, _>(descriptors, "descriptors")?,
    };
    let fits = u32::try_from(features.positions.len()).is_ok();
    check(positions.py(), fits, "positions", "fewer than 2^32", features.positions.len())?;
    Ok(features)
}
