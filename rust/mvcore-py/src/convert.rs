//! Between Python and the kernels: borrowed arrays, returned arrays, the one mapping of errors.

use crate::interrupt::place_of_panic;
pub use crate::interrupt::{run, run_briefly};
use mvcore::Error;
use mvcore::raster::{Epipolar, Raster};
use ndarray::{Array, Dimension, IntoDimension};
use numpy::{
    Element, IntoPyArray, PyArray, PyReadonlyArray, PyReadonlyArray2, PyReadonlyArray3, PyReadwriteArray,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyMemoryError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyAnyMethods;

/// The Python exception of a kernel's error.
pub fn to_python(py: Python<'_>, error: &Error) -> PyErr {
    let class = match error {
        Error::InvalidInput { .. } => "InvalidInputError",
        Error::File { .. } => "FormatError",
        Error::Interrupted => "Interrupted",
        Error::Internal { .. } => "InternalError",
        Error::OutOfMemory { .. } => return PyMemoryError::new_err(error.to_string()),
    };
    let mut text = error.to_string();
    if let Error::Internal { message } = error
        && let Some(place) = place_of_panic(message)
    {
        text = format!("{text} ({place})");
    }
    let raised = py.import("mvcore.errors").and_then(|m| m.getattr(class)).and_then(|c| c.call1((&text,)));
    raised.map_or_else(|_| PyValueError::new_err(text), PyErr::from_value)
}

/// The error of an argument that does not fit its contract.
pub fn unfit(py: Python<'_>, argument: &'static str, expected: &str, got: impl std::fmt::Display) -> PyErr {
    to_python(py, &Error::InvalidInput { argument, expected: expected.to_owned(), got: got.to_string() })
}

/// A contiguous array's values, or an error naming the argument.
pub fn slice<'a, T: Element, D: Dimension>(
    array: &'a PyReadonlyArray<'_, T, D>,
    argument: &'static str,
) -> PyResult<&'a [T]> {
    let values = array.as_slice().ok().filter(|_| array.is_c_contiguous());
    values.ok_or_else(|| unfit(array.py(), argument, "a C-contiguous array", "another"))
}

/// A contiguous array's values to be changed, or an error naming the argument.
pub fn slice_mut<'a, T: Element, D: Dimension>(
    array: &'a mut PyReadwriteArray<'_, T, D>,
    argument: &'static str,
) -> PyResult<&'a mut [T]> {
    let py = array.py();
    let error = || unfit(py, argument, "a C-contiguous array", "another");
    if !array.is_c_contiguous() {
        return Err(error());
    }
    array.as_slice_mut().map_err(|_| error())
}

/// A picture (h, w, 3) as a raster of its bytes, 3 w a row.
pub fn picture<'a>(array: &'a PyReadonlyArray3<'_, u8>, argument: &'static str) -> PyResult<Raster<'a, u8>> {
    let [h, w, 3] = *array.shape() else {
        return Err(unfit(array.py(), argument, "shape (h, w, 3)", format!("{:?}", array.shape())));
    };
    Raster::new(slice(array, argument)?, 3 * w, h, argument).map_err(|error| to_python(array.py(), &error))
}

/// A 2-D array as a raster.
pub fn raster<'a, T: Element>(array: &'a PyReadonlyArray2<'_, T>, argument: &'static str) -> PyResult<Raster<'a, T>> {
    let shape = array.as_array().dim();
    Raster::new(slice(array, argument)?, shape.1, shape.0, argument).map_err(|error| to_python(array.py(), &error))
}

/// A list of 2-D arrays as rasters.
pub fn rasters<'a, T: Element>(
    arrays: &'a [PyReadonlyArray2<'_, T>],
    argument: &'static str,
) -> PyResult<Vec<Raster<'a, T>>> {
    arrays.iter().map(|a| raster(a, argument)).collect()
}

/// An (n, 12) array as maps between views: nine values of the matrix, three of the offset.
pub fn map_of(maps: &PyReadonlyArray2<'_, f32>, n: usize, argument: &'static str) -> PyResult<Vec<Epipolar>> {
    let py = maps.py();
    let maps = maps.as_array();
    if maps.dim() != (n, 12) {
        return Err(unfit(py, argument, &format!("shape ({n}, 12)"), format!("{:?}", maps.dim())));
    }
    let map = |i: usize| Epipolar {
        matrix: std::array::from_fn(|k| maps[(i, k)]),
        offset: std::array::from_fn(|k| maps[(i, 9 + k)]),
    };
    Ok((0..n).map(map).collect())
}

/// Source images and their maps.
pub fn sources<'a>(
    images: &'a [PyReadonlyArray2<'_, u8>],
    maps: &PyReadonlyArray2<'_, f32>,
) -> PyResult<Vec<(Raster<'a, u8>, Epipolar)>> {
    Ok(rasters(images, "images")?.into_iter().zip(map_of(maps, images.len(), "maps")?).collect())
}

/// A kernel's vector as an array of the given shape, without a copy.
pub fn array<T: Element, D: Dimension>(
    py: Python<'_>,
    values: Vec<T>,
    shape: impl IntoDimension<Dim = D>,
) -> PyResult<Bound<'_, PyArray<T, D>>> {
    let array = Array::from_shape_vec(shape.into_dimension(), values)
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(array.into_pyarray(py))
}
