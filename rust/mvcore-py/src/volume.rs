//! Bindings of the consistency, fusion and surface kernels.

use crate::convert::{array, map_of, raster, rasters, run, slice};
use mvcore::consistency::{ConsistencyParams, OtherView};
use mvcore::fuse::{FusionParams, FusionView};
use mvcore::grid::{BlockMap, Grid, SIDE};
use mvcore::isosurface::Surface;
use numpy::{PyArray2, PyArray4, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArray4};
use pyo3::prelude::*;

type Filtered<'py> = (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<u8>>);
type Triangles<'py> = (Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<u32>>);

#[pyfunction]
pub fn consistency<'py>(
    py: Python<'py>,
    depth: PyReadonlyArray2<'py, f32>,
    others: Vec<PyReadonlyArray2<'py, f32>>,
    there: PyReadonlyArray2<'py, f32>,
    back: PyReadonlyArray2<'py, f32>,
    min_views: usize,
    pixel_unit: f32,
    depth_unit: f32,
) -> PyResult<Filtered<'py>> {
    let depth = raster(&depth, "depth")?;
    let (there, back) = (map_of(&there, others.len(), "there")?, map_of(&back, others.len(), "back")?);
    let views: Vec<OtherView> = rasters(&others, "others")?
        .into_iter()
        .zip(there.into_iter().zip(back))
        .map(|(depth, (there, back))| OtherView { depth, there, back })
        .collect();
    let params = ConsistencyParams { min_views, pixel_unit, depth_unit };
    let (kept, support) = run(py, || mvcore::consistency::consistency(depth, &views, &params))?;
    let shape = [depth.height, depth.width];
    Ok((array(py, kept, shape)?, array(py, support, shape)?))
}

#[pyfunction]
#[pyo3(signature = (origin, voxel, shape, depths, weights, silhouettes, projections, *, truncation, free_weight, min_weight, solid_weight, smoothing, hull_tolerance, max_memory))]
pub fn fuse<'py>(
    py: Python<'py>,
    origin: [f64; 3],
    voxel: f64,
    shape: [usize; 3],
    depths: Vec<PyReadonlyArray2<'py, f32>>,
    weights: Vec<PyReadonlyArray2<'py, f32>>,
    silhouettes: Option<Vec<PyReadonlyArray2<'py, f32>>>,
    projections: PyReadonlyArray3<'py, f64>,
    truncation: f64,
    free_weight: f32,
    min_weight: f32,
    solid_weight: f32,
    smoothing: f32,
    hull_tolerance: f32,
    max_memory: usize,
) -> PyResult<(Bound<'py, PyArray2<u32>>, Bound<'py, PyArray4<f32>>)> {
    let (depths, weights) = (rasters(&depths, "depths")?, rasters(&weights, "weights")?);
    let silhouettes = silhouettes.as_ref().map(|s| rasters(s, "silhouettes")).transpose()?;
    let n = depths.len();
    let p = projections.as_array();
    let fits = p.dim() == (n, 3, 4) && weights.len() == n && silhouettes.as_ref().is_none_or(|s| s.len() == n);
    if !fits {
        let text = format!("projections, weights, silhouettes: expected {n} of each, as many as depths");
        return Err(pyo3::exceptions::PyValueError::new_err(text));
    }
    let views: Vec<FusionView> = (0..n)
        .map(|v| FusionView {
            depth: depths[v],
            weight: weights[v],
            silhouette: silhouettes.as_ref().map(|s| s[v]),
            projection: std::array::from_fn(|k| p[(v, k / 4, k % 4)]),
            focal: (p[(v, 0, 0)].powi(2) + p[(v, 0, 1)].powi(2) + p[(v, 0, 2)].powi(2)).sqrt().max(1e-9),
        })
        .collect();
    let params =
        FusionParams { truncation, free_weight, min_weight, solid_weight, smoothing, hull_tolerance, max_memory };
    let volume = run(py, || mvcore::fuse::fuse(Grid::new(origin, voxel, shape)?, &views, &params))?;
    let count = volume.map.coords.len();
    Ok((
        array(py, volume.map.coords.into_flattened(), [count, 3])?,
        array(py, volume.values, [count, SIDE, SIDE, SIDE])?,
    ))
}

#[pyfunction]
pub fn isosurface_dense<'py>(py: Python<'py>, values: PyReadonlyArray3<'py, f32>) -> PyResult<Triangles<'py>> {
    let (a, b, c) = values.as_array().dim();
    let samples = slice(&values, "values")?;
    triangles(py, run(py, || mvcore::isosurface::isosurface_dense(samples, [a, b, c]))?)
}

#[pyfunction]
pub fn isosurface_sparse<'py>(
    py: Python<'py>,
    blocks: [usize; 3],
    coords: PyReadonlyArray2<'py, u32>,
    values: PyReadonlyArray4<'py, f32>,
) -> PyResult<Triangles<'py>> {
    let samples = slice(&values, "values")?;
    let coords = slice(&coords, "coords")?.as_chunks::<3>().0.to_vec();
    let kernel = || mvcore::isosurface::isosurface_sparse(&BlockMap::from_coords(blocks, coords)?, samples);
    triangles(py, run(py, kernel)?)
}

fn triangles(py: Python<'_>, surface: Surface) -> PyResult<Triangles<'_>> {
    let (v, f) = (surface.vertices.len(), surface.faces.len());
    Ok((array(py, surface.vertices.into_flattened(), [v, 3])?, array(py, surface.faces.into_flattened(), [f, 3])?))
}

/// Number of the connected part (over shared edges) of each face.
#[pyfunction]
pub fn components<'py>(
    py: Python<'py>,
    faces: PyReadonlyArray2<'py, u32>,
) -> PyResult<Bound<'py, numpy::PyArray1<u32>>> {
    let faces = slice(&faces, "faces")?.as_chunks::<3>().0;
    let part = run(py, || Ok(mvcore::mesh::components(&mvcore::mesh::neighbours(faces), |_, _| true).0))?;
    let n = part.len();
    array(py, part, [n])
}

#[pyfunction]
pub fn nearest<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    others: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Bound<'py, numpy::PyArray1<f64>>, Bound<'py, numpy::PyArray1<i64>>)> {
    let p = slice(&points, "points")?.as_chunks::<3>().0;
    let q = slice(&others, "others")?.as_chunks::<3>().0;
    let (distances, numbers) = run(py, || mvcore::nearest::nearest(p, q))?;
    let n = distances.len();
    Ok((array(py, distances, [n])?, array(py, numbers, [n])?))
}
