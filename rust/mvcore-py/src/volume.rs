//! Bindings of the consistency, fusion and surface kernels.

use crate::checks::{check, finite, room, rows, shaped, within};
use crate::convert::{array, map_of, raster, rasters, run, slice, unfit};
use mvcore::carve::{CarveParams, Silhouette};
use mvcore::consistency::{ConsistencyParams, OtherView};
use mvcore::fuse::{FusionParams, FusionView, Hint};
use mvcore::grid::{BlockMap, Grid, SIDE, Tile};
use mvcore::isosurface::Surface;
use mvcore::photo_carve::{Photo, PhotoParams};
use mvcore::raster::Cut;
use numpy::{
    PyArray2, PyArray3, PyArray4, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArray4, PyUntypedArrayMethods,
};
use pyo3::prelude::*;

/// Voxels of a truncation distance; four or so are common.
const MOST_TRUNCATION: f64 = 1000.0;
/// Voxels of a standard deviation of smoothing: its window is that of one block around another.
const MOST_SMOOTHING: f64 = 8.0;
/// Of photo-carving; it ends before where nothing changes.
const MOST_ROUNDS: f64 = 1000.0;

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
    finite(py, "pixel_unit, depth_unit", [pixel_unit, depth_unit].map(f64::from).into_iter())?;
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
#[pyo3(signature = (origin, voxel, shape, depths, weights, silhouettes, windows, projections, *, tile = None, cuts = None, hints = None, truncation, free_weight, min_weight, solid_weight, smoothing, measured_smoothing, hull_tolerance, complete = false, hollow = false, max_memory))]
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
    cuts: Option<Vec<[usize; 4]>>,
    hints: Option<PyReadonlyArray3<'py, i8>>,
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
    finite(py, "origin, voxel, truncation", origin.into_iter().chain([voxel, truncation]))?;
    finite(py, "windows", windows.iter().flatten().copied())?;
    // Rays are walked in thirds of a block over twice this distance.
    check(py, truncation <= MOST_TRUNCATION * voxel, "truncation", "at most 1000 voxels", truncation)?;
    within(py, "smoothing", f64::from(smoothing), 0.0, MOST_SMOOTHING)?;
    within(py, "measured_smoothing", f64::from(measured_smoothing), 0.0, MOST_SMOOTHING)?;
    finite(
        py,
        "free_weight, min_weight, solid_weight, hull_tolerance",
        [free_weight, min_weight, solid_weight, hull_tolerance].map(f64::from).into_iter(),
    )?;
    let (depths, weights) = (rasters(&depths, "depths")?, rasters(&weights, "weights")?);
    let silhouettes = silhouettes.as_ref().map(|s| rasters(s, "silhouettes")).transpose()?;
    let n = depths.len();
    let p = projections_of(&projections, n)?;
    if weights.len() != n || windows.len() != n || silhouettes.as_ref().is_some_and(|s| s.len() != n) {
        return Err(unfit(py, "weights, silhouettes, windows", &format!("{n} of each, as many as depths"), "others"));
    }
    let whole = |v: usize| [0, 0, depths[v].width, depths[v].height];
    let cuts = cuts.unwrap_or_else(|| (0..n).map(whole).collect());
    check(py, cuts.len() == n, "cuts", &format!("{n}, as many as depths"), cuts.len())?;
    let cut = |raster, v: usize| {
        let [left, top, width, height] = cuts[v];
        Cut::new(raster, [left, top], [width, height], "cuts")
    };
    let view = |v: usize| {
        Ok(FusionView {
            depth: cut(depths[v], v)?,
            weight: cut(weights[v], v)?,
            silhouette: silhouettes.as_ref().map(|s| cut(s[v], v)).transpose()?,
            window: windows[v],
            projection: p[v],
            focal: (p[v][0].powi(2) + p[v][1].powi(2) + p[v][2].powi(2)).sqrt().max(1e-9),
        })
    };
    let views = run(py, || (0..n).map(view).collect::<mvcore::Result<Vec<FusionView>>>())?;
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
    let hints = hints.as_ref().map_or(Ok(&[][..]), |codes| slice(codes, "hints"))?;
    let hints: Vec<Hint> = hints.iter().map(|&code| Hint::of(code)).collect();
    let volume = run(py, || {
        let grid = Grid::new(origin, voxel, shape)?;
        let tile = tile.map_or(Tile::whole(&grid), |[low, high]| Tile { low, high });
        mvcore::fuse::fuse_tile(grid, tile, &views, &params, &hints)
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
    room(py, "voxels", &[shape[0], shape[1], shape[2], 2])?;
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
        return Err(unfit(py, "high, centers", &format!("{} of each, as many as low", low.len()), "others"));
    }
    let photo = |n: usize| {
        let (height, width, _) = low[n].as_array().dim();
        shaped(py, "low", low[n].shape(), &[height, width, 3])?;
        shaped(py, "high", high[n].shape(), &[height, width, 3])?;
        let (low, high) = (slice(&low[n], "low")?, slice(&high[n], "high")?);
        PyResult::Ok(Photo { low, high, width, height, projection: projections[n], center: centers[n] })
    };
    let photos = (0..low.len()).map(photo).collect::<PyResult<Vec<_>>>()?;
    within(py, "rounds", rounds as f64, 0.0, MOST_ROUNDS)?;
    finite(py, "centers", centers.iter().flatten().copied())?;
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
        let expected = format!("shape ({n}, 3, 4), one a view");
        return Err(unfit(projections.py(), "projections", &expected, format!("{:?}", p.dim())));
    }
    finite(projections.py(), "projections", p.iter().copied())?;
    Ok((0..n).map(|v| std::array::from_fn(|k| p[(v, k / 4, k % 4)])).collect())
}

#[pyfunction]
pub fn isosurface_dense<'py>(py: Python<'py>, values: PyReadonlyArray3<'py, f32>) -> PyResult<Triangles<'py>> {
    let (a, b, c) = values.as_array().dim();
    check(py, a > 0 && b > 0 && c > 0, "values", "at least one sample along each axis", format!("{:?}", [a, b, c]))?;
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
    let coords = rows::<3, _>(&coords, "coords")?.to_vec();
    shaped(py, "values", values.shape(), &[coords.len(), SIDE, SIDE, SIDE])?;
    let end = coords.iter().flatten().max().copied().unwrap_or(0);
    check(py, end < 1 << 28, "coords", "block coordinates below 2^28", end)?;
    let extent = |a: usize| {
        let low = coords.iter().map(|c| c[a]).min().unwrap_or(0);
        coords.iter().map(|c| c[a]).max().map_or(0, |high| (high - low) as usize + 1)
    };
    room(py, "block table", &[extent(0), extent(1), extent(2), size_of::<u32>()])?;
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
    let faces = rows::<3, _>(&faces, "faces")?;
    check(py, i32::try_from(3 * faces.len()).is_ok(), "faces", "fewer than 2^29", faces.len())?;
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
    let (vertices, faces) = (rows::<3, _>(&vertices, "vertices")?, rows::<3, _>(&faces, "faces")?);
    let kernel = || mvcore::holes::close_holes(mvcore::mesh::Mesh::new(vertices, faces)?, most_edges);
    let added = run(py, kernel)?;
    let n = added.len();
    array(py, added.into_flattened(), [n, 3])
}

/// Vertices, some moved and some without a face, and the faces that are left within an error bound.
#[pyfunction]
#[pyo3(signature = (vertices, faces, error, most_faces = usize::MAX, keep_borders = false))]
pub fn decimate<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    error: f64,
    most_faces: usize,
    keep_borders: bool,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<u32>>)> {
    let (vertices, faces) = (rows::<3, _>(&vertices, "vertices")?, rows::<3, _>(&faces, "faces")?);
    finite(py, "vertices", vertices.as_flattened().iter().copied())?;
    let kernel =
        || mvcore::decimate::decimate(mvcore::mesh::Mesh::new(vertices, faces)?, error, most_faces, keep_borders);
    let left = run(py, kernel)?;
    let (v, f) = (left.vertices.len(), left.faces.len());
    Ok((array(py, left.vertices.into_flattened(), [v, 3])?, array(py, left.faces.into_flattened(), [f, 3])?))
}

#[pyfunction]
#[pyo3(signature = (points, others, reach = f64::INFINITY))]
pub fn nearest<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f64>,
    others: PyReadonlyArray2<'py, f64>,
    reach: f64,
) -> PyResult<(Bound<'py, numpy::PyArray1<f64>>, Bound<'py, numpy::PyArray1<i64>>)> {
    let (p, q) = (rows::<3, _>(&points, "points")?, rows::<3, _>(&others, "others")?);
    let (distances, numbers) = run(py, || mvcore::nearest::nearest(p, q, reach))?;
    let n = distances.len();
    Ok((array(py, distances, [n])?, array(py, numbers, [n])?))
}
