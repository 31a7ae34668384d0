//! Bindings of the mesh and texture kernels.

use crate::checks::{finite, room, rows, shaped, within};
use crate::convert::{array, picture, raster, run, slice, unfit};
use mvcore::atlas::Source;
use mvcore::mesh::Mesh;
use mvcore::select_views::{Photo, Rating, SelectParams};
use mvcore::shade::{Shots, Surface};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArray4,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

fn mesh<'a>(
    vertices: &'a PyReadonlyArray2<'_, f64>,
    faces: &'a PyReadonlyArray2<'_, u32>,
) -> PyResult<(&'a [[f64; 3]], &'a [[u32; 3]])> {
    Ok((rows::<3, _>(vertices, "vertices")?, rows::<3, _>(faces, "faces")?))
}

fn projection(p: &PyReadonlyArray2<'_, f64>) -> PyResult<[f64; 12]> {
    shaped(p.py(), "projection", p.shape(), &[3, 4])?;
    let mut out = [0.0; 12];
    out.copy_from_slice(slice(p, "projection")?);
    finite(p.py(), "projection", out.iter().copied())?;
    Ok(out)
}

#[pyfunction]
pub fn rasterize<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    matrix: PyReadonlyArray2<'py, f64>,
    width: usize,
    height: usize,
) -> PyResult<(Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<i32>>)> {
    let ((v, f), p) = (mesh(&vertices, &faces)?, projection(&matrix)?);
    room(py, "depth and faces", &[height, width, 8])?;
    let (depth, face) = run(py, || mvcore::rasterize::rasterize(Mesh::new(v, f)?, &p, width, height))?;
    Ok((array(py, depth, [height, width])?, array(py, face, [height, width])?))
}

#[pyfunction]
pub fn rate_faces<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    image: PyReadonlyArray3<'py, u8>,
    detail: PyReadonlyArray2<'py, f32>,
    depth: PyReadonlyArray2<'py, f32>,
    matrix: PyReadonlyArray2<'py, f64>,
    center: [f64; 3],
    tolerance: f64,
) -> PyResult<(Bound<'py, PyArray1<f32>>, Bound<'py, PyArray2<u8>>)> {
    let ((v, f), projection) = (mesh(&vertices, &faces)?, projection(&matrix)?);
    let (rgb, detail, depth) = (picture(&image, "rgb")?, raster(&detail, "detail")?, raster(&depth, "depth")?);
    let photo = Photo { rgb, detail, depth, projection, center };
    let ratings = run(py, || mvcore::select_views::rate(Mesh::new(v, f)?, &photo, tolerance))?;
    let n = ratings.len();
    let quality = ratings.iter().map(|r| r.quality).collect();
    let colours: Vec<u8> = ratings.iter().flat_map(|r| r.colour).collect();
    Ok((array(py, quality, [n])?, array(py, colours, [n, 3])?))
}

#[pyfunction]
pub fn select_views<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    qualities: Vec<PyReadonlyArray1<'py, f32>>,
    colours: Vec<PyReadonlyArray2<'py, u8>>,
    seam: f32,
    outlier: f32,
    least_patch: usize,
) -> PyResult<Bound<'py, PyArray1<i32>>> {
    let (v, f) = mesh(&vertices, &faces)?;
    let rating = |(q, c): (&PyReadonlyArray1<'py, f32>, &PyReadonlyArray2<'py, u8>)| -> PyResult<Vec<Rating>> {
        let colours = slice(c, "colours")?.as_chunks::<3>().0;
        Ok(slice(q, "qualities")?.iter().zip(colours).map(|(&quality, &colour)| Rating { quality, colour }).collect())
    };
    let ratings = qualities.iter().zip(&colours).map(rating).collect::<PyResult<Vec<_>>>()?;
    let params = SelectParams { seam, outlier, least_patch };
    let labels = run(py, || mvcore::select_views::select_views(Mesh::new(v, f)?, &ratings, &params))?;
    let n = labels.len();
    array(py, labels, [n])
}

#[pyfunction]
pub fn build_atlas<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    labels: PyReadonlyArray1<'py, i32>,
    images: Vec<PyReadonlyArray3<'py, u8>>,
    matrices: Vec<PyReadonlyArray2<'py, f64>>,
    gains: Vec<[f32; 3]>,
    max_size: usize,
) -> PyResult<(Bound<'py, PyArray1<u32>>, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<u32>>, Bound<'py, PyArray3<u8>>)>
{
    let ((v, f), labels) = (mesh(&vertices, &faces)?, slice(&labels, "labels")?);
    if matrices.len() != images.len() || gains.len() != images.len() {
        return Err(unfit(py, "matrices, gains", &format!("{} of each", images.len()), "others"));
    }
    let source = |n: usize| -> PyResult<Source> {
        Ok(Source { rgb: picture(&images[n], "rgb")?, projection: projection(&matrices[n])?, gain: gains[n] })
    };
    let sources = (0..images.len()).map(source).collect::<PyResult<Vec<_>>>()?;
    let t = run(py, || mvcore::atlas::build_atlas(Mesh::new(v, f)?, labels, &sources, max_size))?;
    let (n, count) = (t.origin.len(), t.faces.len());
    Ok((
        array(py, t.origin, [n])?,
        array(py, t.texel.into_flattened(), [n, 2])?,
        array(py, t.faces.into_flattened(), [count, 3])?,
        array(py, t.atlas, [t.height, t.width, 3])?,
    ))
}

#[pyfunction]
#[pyo3(signature = (vertices, faces, uv, normals, materials, textures, gloss, matrices, lamp, width, height, samples = 2))]
pub fn shade<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    uv: PyReadonlyArray2<'py, f32>,
    normals: PyReadonlyArray2<'py, f32>,
    materials: PyReadonlyArray1<'py, u16>,
    textures: PyReadonlyArray4<'py, u8>,
    gloss: PyReadonlyArray2<'py, f32>,
    matrices: PyReadonlyArray3<'py, f64>,
    lamp: [f64; 3],
    width: usize,
    height: usize,
    samples: usize,
) -> PyResult<Bound<'py, PyArray4<u8>>> {
    let (v, f) = mesh(&vertices, &faces)?;
    let size = textures.shape()[1];
    if uv.shape()[1] != 2
        || normals.shape()[1] != 3
        || gloss.shape()[1] != 5
        || matrices.shape()[1..] != [3, 4]
        || textures.shape()[1..] != [size, size, 3]
    {
        let expected = "shapes (n, 2), (n, 3), (m, 5), (m + 1, s, s, 3), (v, 3, 4)";
        return Err(unfit(py, "uv, normals, gloss, textures, matrices", expected, "others"));
    }
    let surface = Surface {
        uv: slice(&uv, "uv")?.as_chunks::<2>().0,
        normals: slice(&normals, "normals")?.as_chunks::<3>().0,
        materials: slice(&materials, "materials")?,
        textures: slice(&textures, "textures")?,
        size,
        gloss: slice(&gloss, "gloss")?.as_chunks::<5>().0,
    };
    let projections = slice(&matrices, "matrices")?.as_chunks::<12>().0;
    let shots = Shots { projections, lamp, width, height, samples };
    room(py, "images", &[projections.len(), height, width, 3])?;
    within(py, "samples", samples as f64, 1.0, 8.0)?;
    let images = run(py, || mvcore::shade::shade(Mesh::new(v, f)?, surface, &shots))?;
    array(py, images, [projections.len(), height, width, 3])
}
