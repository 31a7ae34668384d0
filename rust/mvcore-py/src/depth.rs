//! Bindings of the depth kernels.

use crate::checks::{check, finite, room, shaped, within};
use crate::convert::{array, map_of, picture, raster, rasters, run, slice, sources, unfit};
use mvcore::aggregate::Penalties;
use mvcore::correlate::{Features, Planes, Visibility};
use mvcore::median::MedianParams;
use mvcore::slanted::{Hypothesis, RefineParams, SourceSurface};
use numpy::{
    PyArray2, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArrayDyn,
    PyReadwriteArray3, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

/// Of `refine`; a dozen are common.
const MOST_ITERATIONS: f64 = 1000.0;

#[pyfunction]
#[pyo3(signature = (reference, images, maps, planes, best = 0))]
pub fn sweep<'py>(
    py: Python<'py>,
    reference: PyReadonlyArray2<'py, u8>,
    images: Vec<PyReadonlyArray2<'py, u8>>,
    maps: PyReadonlyArray2<'py, f32>,
    planes: PyReadonlyArray1<'py, f32>,
    best: usize,
) -> PyResult<Bound<'py, PyArray3<u8>>> {
    let (reference, views) = (raster(&reference, "reference")?, sources(&images, &maps)?);
    let planes = slice(&planes, "planes")?;
    room(py, "costs", &[reference.height, reference.width, planes.len()])?;
    let costs = run(py, || mvcore::sweep::sweep(reference, &views, planes, best))?;
    array(py, costs, [reference.height, reference.width, planes.len()])
}

#[pyfunction]
pub fn aggregate<'py>(
    py: Python<'py>,
    costs: PyReadonlyArray3<'py, u8>,
    guide: PyReadonlyArray2<'py, u8>,
    p1: u8,
    p2: u8,
    p2_falloff: u8,
) -> PyResult<(Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>)> {
    let guide = raster(&guide, "guide")?;
    shaped(py, "costs", &costs.shape()[..2], &[guide.height, guide.width])?;
    // The paths' sums of two bytes, and what each direction keeps.
    room(py, "path costs", &[guide.height, guide.width, costs.shape()[2], 4])?;
    let (planes, values) = (costs.shape()[2], slice(&costs, "costs")?);
    let penalties = Penalties { p1, p2, p2_falloff };
    let winners = run(py, || mvcore::aggregate::aggregate(values, planes, guide, penalties))?;
    let shape = [guide.height, guide.width];
    Ok((array(py, winners.plane, shape)?, array(py, winners.margin, shape)?))
}

/// Adds to `costs` (h, w, D) in place what planes far from the expected one cost more.
#[pyfunction]
pub fn expect<'py>(
    py: Python<'py>,
    mut costs: PyReadwriteArray3<'py, u8>,
    expected: PyReadonlyArray2<'py, f32>,
    confidence: PyReadonlyArray2<'py, f32>,
    weight: f32,
    reach: f32,
) -> PyResult<()> {
    let planes = costs.shape()[2];
    shaped(py, "expected", expected.shape(), &costs.shape()[..2])?;
    shaped(py, "confidence", confidence.shape(), &costs.shape()[..2])?;
    let (expected, confidence) = (slice(&expected, "expected")?, slice(&confidence, "confidence")?);
    let values = costs.as_slice_mut().map_err(|_| unfit(py, "costs", "a C-contiguous array", "another"))?;
    run(py, || mvcore::expect::expect(values, planes, expected, confidence, weight, reach))
}

/// Values (h, w) replaced by their weighted median under a guide (h, w, 3), where they differ by more than the slack or are doubtful.
#[pyfunction]
#[pyo3(signature = (values, guide, doubtful, *, radius, step, colour, distance, slack))]
pub fn weighted_median<'py>(
    py: Python<'py>,
    values: PyReadonlyArray2<'py, f32>,
    guide: PyReadonlyArray3<'py, u8>,
    doubtful: PyReadonlyArray2<'py, u8>,
    radius: usize,
    step: usize,
    colour: f32,
    distance: f32,
    slack: f32,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (values, doubtful) = (raster(&values, "values")?, raster(&doubtful, "doubtful")?);
    let guide = picture(&guide, "guide")?;
    finite(py, "colour, distance, slack", [colour, distance, slack].map(f64::from).into_iter())?;
    let params = MedianParams { radius, step, colour, distance, slack };
    let found = run(py, || mvcore::median::weighted_median(values, guide, doubtful, &params))?;
    array(py, found, [values.height, values.width])
}

/// (D, h, w, G) correlations; planes (D,) or (D, h, w).
#[pyfunction]
pub fn correlate<'py>(
    py: Python<'py>,
    reference: PyReadonlyArray3<'py, f32>,
    sources: Vec<PyReadonlyArray3<'py, f32>>,
    maps: PyReadonlyArray2<'py, f32>,
    planes: PyReadonlyArrayDyn<'py, f32>,
    gain: PyReadonlyArray1<'py, f32>,
    bias: f32,
) -> PyResult<Bound<'py, PyArray4<f32>>> {
    let of = |a: &PyReadonlyArray3<'py, f32>| (a.shape()[0], a.shape()[1], a.shape()[2]);
    let (height, width, channels) = of(&reference);
    let first = Features { data: slice(&reference, "reference")?, width, height, channels };
    let maps = map_of(&maps, sources.len(), "maps")?;
    let views: Vec<_> = (sources.iter().zip(maps))
        .map(|(a, map)| {
            let (height, width, channels) = of(a);
            Ok((Features { data: slice(a, "sources")?, width, height, channels }, map))
        })
        .collect::<PyResult<_>>()?;
    let values = slice(&planes, "planes")?;
    let count = planes.shape().first().copied().unwrap_or(0);
    let whole = planes.shape() == [count] || planes.shape() == [count, height, width];
    let expected = format!("shape (D,) or (D, {height}, {width})");
    check(py, whole, "planes", &expected, format!("{:?}", planes.shape()))?;
    check(py, height > 0 && width > 0, "reference", "a non-empty array", format!("{height} x {width}"))?;
    room(py, "correlations", &[count, height, width, gain.shape()[0], size_of::<f32>()])?;
    let swept = if planes.shape().len() == 1 { Planes::Common(values) } else { Planes::Own(values, count) };
    let gain = slice(&gain, "gain")?;
    let out = run(py, || mvcore::correlate::correlate(first, &views, swept, Visibility { gain, bias }))?;
    array(py, out, (count, height, width, gain.len()))
}

#[pyfunction]
#[pyo3(signature = (reference, images, maps, depths, backs, init, prior, *, iterations, low, high, step, max_slope, prior_weight, prior_reach, geometry_weight, adjacent))]
pub fn refine<'py>(
    py: Python<'py>,
    reference: PyReadonlyArray2<'py, u8>,
    images: Vec<PyReadonlyArray2<'py, u8>>,
    maps: PyReadonlyArray2<'py, f32>,
    depths: Vec<PyReadonlyArray2<'py, f32>>,
    backs: PyReadonlyArray2<'py, f32>,
    init: PyReadonlyArray3<'py, f32>,
    prior: PyReadonlyArray2<'py, f32>,
    iterations: usize,
    low: f32,
    high: f32,
    step: f32,
    max_slope: f32,
    prior_weight: f32,
    prior_reach: f32,
    geometry_weight: f32,
    adjacent: bool,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let (reference, views) = (raster(&reference, "reference")?, sources(&images, &maps)?);
    let surfaces: Vec<SourceSurface> = rasters(&depths, "depths")?
        .into_iter()
        .zip(map_of(&backs, depths.len(), "backs")?)
        .map(|(depth, back)| SourceSurface { depth, back })
        .collect();
    let init_shape = init.shape().to_vec();
    let init: Vec<Hypothesis> =
        slice(&init, "init")?.chunks_exact(4).map(|h| Hypothesis { w: h[0], a: h[1], b: h[2], cost: h[3] }).collect();
    shaped(py, "init", &init_shape, &[reference.height, reference.width, 4])?;
    shaped(py, "prior", prior.shape(), &[reference.height, reference.width])?;
    within(py, "iterations", iterations as f64, 0.0, MOST_ITERATIONS)?;
    let numbers = [low, high, step, max_slope, prior_weight, prior_reach, geometry_weight];
    finite(
        py,
        "low, high, step, max_slope, prior_weight, prior_reach, geometry_weight",
        numbers.map(f64::from).into_iter(),
    )?;
    let prior = slice(&prior, "prior")?;
    let params = RefineParams {
        iterations,
        range: (low, high),
        step,
        max_slope,
        prior_weight,
        prior_reach,
        geometry_weight,
        adjacent,
    };
    let planes = run(py, || mvcore::slanted::refine(reference, &views, &surfaces, &init, prior, &params))?;
    let flat = planes.into_iter().flat_map(|h| [h.w, h.a, h.b, h.cost]).collect();
    array(py, flat, [reference.height, reference.width, 4])
}
