//! Checks of arguments before a kernel sees them; each error names the argument as the caller wrote it.

use crate::convert::{run, slice, unfit};
use mvcore::memory;
use numpy::{Element, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use std::fmt::Display;

/// Fails unless `holds`.
pub fn check(py: Python<'_>, holds: bool, argument: &'static str, expected: &str, got: impl Display) -> PyResult<()> {
    if holds { Ok(()) } else { Err(unfit(py, argument, expected, got)) }
}

/// Fails unless `low <= value <= high`; NaN fails.
pub fn within(py: Python<'_>, argument: &'static str, value: f64, low: f64, high: f64) -> PyResult<()> {
    let holds = (low..=high).contains(&value);
    if holds { Ok(()) } else { check(py, false, argument, &format!("a number from {low} to {high}"), value) }
}

/// Fails unless all values are finite.
pub fn finite(py: Python<'_>, argument: &'static str, mut values: impl Iterator<Item = f64>) -> PyResult<()> {
    check(py, values.all(f64::is_finite), argument, "finite numbers", "NaN or infinity")
}

/// Fails unless an array has the shape.
pub fn shaped(py: Python<'_>, argument: &'static str, shape: &[usize], expected: &[usize]) -> PyResult<()> {
    let holds = shape == expected;
    if holds { Ok(()) } else { check(py, false, argument, &format!("shape {expected:?}"), format!("{shape:?}")) }
}

/// The rows of an (n, N) array.
pub fn rows<'a, const N: usize, T: Element>(
    array: &'a PyReadonlyArray2<'_, T>,
    argument: &'static str,
) -> PyResult<&'a [[T; N]]> {
    let shape = array.shape();
    if shape[1] != N {
        check(array.py(), false, argument, &format!("shape (n, {N})"), format!("{shape:?}"))?;
    }
    Ok(slice(array, argument)?.as_chunks::<N>().0)
}

/// Fails unless the product of `factors`, in bytes, can be allocated for `what`.
pub fn room(py: Python<'_>, what: &'static str, factors: &[usize]) -> PyResult<()> {
    run(py, || memory::room(what, factors))
}
