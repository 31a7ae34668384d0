//! Bindings of the consistency, fusion and surface kernels.

use crate::convert::{array, map_of, raster, rasters, run, slice};
use mvcore::carve::{CarveParams, Silhouette};
use mvcore::consistency::{ConsistencyParams, OtherView};
use mvcore::fuse::{FusionParams, FusionView};
use mvcore::grid::{BlockMap, Grid, SIDE, Tile};
use mvcore::isosurface::Surface;
use mvcore::photo_carve::{Photo, PhotoParams};
use numpy::{PyArray2, PyArray3, PyArray4, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArray4};
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

/// Squared distance of each pixel to the nearest site and that site's row-major index; u32::MAX where there is none.
#[pyfunction]
pub fn distance_transform<'py>(
    py: Python<'py>,
    sites: PyReadonlyArray2<'py, u8>,
) -> PyResult<(Bound<'py, PyArray2<u32>>, Bound<'py, PyArray2<u32>>)> {
    let sites = raster(&sites, "sites")?;
    let found = run(py, || mvcore::distance_transform::distance_transform(sites))?;
    let shape = [sites.height, sites.width];
    Ok((array(py, found.squared, shape)?, array(py, found.nearest, shape)?))
}

#[pyfunction]
#[pyo3(signature = (origin, voxel, shape, depths, weights, silhouettes, windows, projections, *, tile = None, truncation, free_weight, min_weight, solid_weight, smoothing, measured_smoothing, hull_tolerance, complete = false, hollow = false, max_memory))]
pub fn fuse<'py>(
    py: Python<'py>,
    origin: [f64; 3],
    voxel: f64,
    shape: [usize; 3],
    depths: Vec<PyReadonlyArray2<'py, f32>>,
    weights: Vec<PyReadonlyArray2<'py, f32>>,
    silhouettes: Option<Vec<PyReadonlyArray2<'py, f32>>>,
    windows: Vec<[f64; 4]>,
    projections: PyReadonlyArray3<'py, f64>,
    tile: Option<[[usize; 3]; 2]>,
    truncation: f64,
    free_weight: f32,
    min_weight: f32,
    solid_weight: f32,
    smoothing: f32,
    measured_smoothing: f32,
    hull_tolerance: f32,
    complete: bool,
    hollow: bool,
    max_memory: usize,
) -> PyResult<(Bound<'py, PyArray2<u32>>, Bound<'py, PyArray4<f32>>)> {
    let (depths, weights) = (rasters(&depths, "depths")?, rasters(&weights, "weights")?);
    let silhouettes = silhouettes.as_ref().map(|s| rasters(s, "silhouettes")).transpose()?;
    let n = depths.len();
    let p = projections_of(&projections, n)?;
    if weights.len() != n || windows.len() != n || silhouettes.as_ref().is_some_and(|s| s.len() != n) {
        let text = format!("weights, silhouettes, windows: expected {n} of each, as many as depths");
        return Err(pyo3::exceptions::PyValueError::new_err(text));
    }
    let views: Vec<FusionView> = (0..n)
        .map(|v| FusionView {
            depth: depths[v],
            weight: weights[v],
            silhouette: silhouettes.as_ref().map(|s| s[v]),
            window: windows[v],
            projection: p[v],
            focal: (p[v][0].powi(2) + p[v][1].powi(2) + p[v][2].powi(2)).sqrt().max(1e-9),
        })
        .collect();
    let params = FusionParams {
        truncation,
        free_weight,
        min_weight,
        solid_weight,
        smoothing,
        measured_smoothing,
        hull_tolerance,
        complete,
        hollow,
        max_memory,
    };
    let volume = run(py, || {
        let grid = Grid::new(origin, voxel, shape)?;
        let tile = tile.map_or(Tile::whole(&grid), |[low, high]| Tile { low, high });
        mvcore::fuse::fuse_tile(grid, tile, &views, &params)
    })?;
    let count = volume.map.coords.len();
    Ok((
        array(py, volume.map.coords.into_flattened(), [count, 3])?,
        array(py, volume.values, [count, SIDE, SIDE, SIDE])?,
    ))
}

#[pyfunction]
#[pyo3(signature = (origin, voxel, shape, masks, projections, *, tolerance, least_views))]
pub fn carve<'py>(
    py: Python<'py>,
    origin: [f64; 3],
    voxel: f64,
    shape: [usize; 3],
    masks: Vec<PyReadonlyArray2<'py, u8>>,
    projections: PyReadonlyArray3<'py, f64>,
    tolerance: f64,
    least_views: u32,
) -> PyResult<Bound<'py, PyArray3<bool>>> {
    let masks = rasters(&masks, "masks")?;
    let projections = projections_of(&projections, masks.len())?;
    let views: Vec<Silhouette> =
        masks.into_iter().zip(projections).map(|(mask, projection)| Silhouette { mask, projection }).collect();
    let params = CarveParams { tolerance, least_views };
    let inside = run(py, || mvcore::carve::carve(Grid::new(origin, voxel, shape)?, &views, &params))?;
    array(py, inside, shape)
}

/// The volume without the voxels that the photographs contradict.
#[pyfunction]
#[pyo3(signature = (origin, voxel, occupied, low, high, projections, centers, *, threshold, least_views, rounds))]
pub fn photo_carve<'py>(
    py: Python<'py>,
    origin: [f64; 3],
    voxel: f64,
    occupied: PyReadonlyArray3<'py, bool>,
    low: Vec<PyReadonlyArray3<'py, u8>>,
    high: Vec<PyReadonlyArray3<'py, u8>>,
    projections: PyReadonlyArray3<'py, f64>,
    centers: Vec<[f64; 3]>,
    threshold: u8,
    least_views: usize,
    rounds: usize,
) -> PyResult<Bound<'py, PyArray3<bool>>> {
    let projections = projections_of(&projections, low.len())?;
    if high.len() != low.len() || centers.len() != low.len() {
        let text = format!("high, centers: expected {} of each, as many as low", low.len());
        return Err(pyo3::exceptions::PyValueError::new_err(text));
    }
    let photo = |n: usize| {
        let (height, width, _) = low[n].as_array().dim();
        let (low, high) = (slice(&low[n], "low")?, slice(&high[n], "high")?);
        PyResult::Ok(Photo { low, high, width, height, projection: projections[n], center: centers[n] })
    };
    let photos = (0..low.len()).map(photo).collect::<PyResult<Vec<_>>>()?;
    let shape: [usize; 3] = occupied.as_array().dim().into();
    let mut kept = slice(&occupied, "occupied")?.to_vec();
    let params = PhotoParams { threshold, least_views, rounds };
    run(py, || mvcore::photo_carve::photo_carve(Grid::new(origin, voxel, shape)?, &mut kept, &photos, &params))?;
    array(py, kept, shape)
}

/// An (n, 3, 4) array as projections.
fn projections_of(projections: &PyReadonlyArray3<'_, f64>, n: usize) -> PyResult<Vec<[f64; 12]>> {
    let p = projections.as_array();
    if p.dim() != (n, 3, 4) {
        let text = format!("projections: expected shape ({n}, 3, 4), one a view, got {:?}", p.dim());
        return Err(pyo3::exceptions::PyValueError::new_err(text));
    }
    Ok((0..n).map(|v| std::array::from_fn(|k| p[(v, k / 4, k % 4)])).collect())
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
    coords: PyReadonlyArray2<'py, u32>,
    values: PyReadonlyArray4<'py, f32>,
) -> PyResult<Triangles<'py>> {
    let samples = slice(&values, "values")?;
    let coords = slice(&coords, "coords")?.as_chunks::<3>().0.to_vec();
    let kernel = || mvcore::isosurface::isosurface_sparse(&BlockMap::from_coords(coords)?, samples);
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

/// Faces that close the holes of at most `most_edges` edges.
#[pyfunction]
pub fn close_holes<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    most_edges: usize,
) -> PyResult<Bound<'py, numpy::PyArray2<u32>>> {
    let vertices = slice(&vertices, "vertices")?.as_chunks::<3>().0;
    let faces = slice(&faces, "faces")?.as_chunks::<3>().0;
    let kernel = || mvcore::holes::close_holes(mvcore::mesh::Mesh::new(vertices, faces)?, most_edges);
    let added = run(py, kernel)?;
    let n = added.len();
    array(py, added.into_flattened(), [n, 3])
}

#[pyfunction]
#[pyo3(signature = (points, others, reach = f64::INFINITY))]
pub fn nearest<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    others: PyReadonlyArray2<'py, f64>,
    reach: f64,
) -> PyResult<(Bound<'py, numpy::PyArray1<f64>>, Bound<'py, numpy::PyArray1<i64>>)> {
    let p = slice(&points, "points")?.as_chunks::<3>().0;
    let q = slice(&others, "others")?.as_chunks::<3>().0;
    let (distances, numbers) = run(py, || mvcore::nearest::nearest(p, q, reach))?;
    let n = distances.len();
    Ok((array(py, distances, [n])?, array(py, numbers, [n])?))
}
