//! Bindings of the mesh and texture kernels.

use crate::checks::{finite, room, rows, shaped, within};
use crate::convert::{array, picture, raster, run, slice, slice_mut, unfit};
use mvcore::candidates::Candidates;
use mvcore::mesh::Mesh;
use mvcore::rate_faces::Photo;
use mvcore::select_views::SelectParams;
use mvcore::shade::{Shots, Surface};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3, PyReadonlyArray4,
    PyReadwriteArray2, PyReadwriteArray3, PyUntypedArrayMethods,
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
    let ratings = run(py, || mvcore::rate_faces::rate_faces(Mesh::new(v, f)?, &photo, tolerance))?;
    let n = ratings.quality.len();
    Ok((array(py, ratings.quality, [n])?, array(py, ratings.colour.into_flattened(), [n, 3])?))
}

/// Short lists of views as Python holds them, borrowed to be changed.
struct Lists<'py>(PyReadwriteArray2<'py, i16>, PyReadwriteArray2<'py, f32>, PyReadwriteArray3<'py, u8>);

impl Lists<'_> {
    fn borrow(&mut self, py: Python<'_>) -> PyResult<Candidates<'_>> {
        let &[n, slots] = self.0.shape() else {
            return Err(unfit(py, "views", "shape (faces, slots)", "another"));
        };
        if self.1.shape() != [n, slots] || self.2.shape() != [n, slots, 3] {
            let expected = format!("shapes ({n}, {slots}), ({n}, {slots}, 3)");
            return Err(unfit(
                py,
                "qualities, colours",
                &expected,
                format!("{:?}, {:?}", self.1.shape(), self.2.shape()),
            ));
        }
        let views = slice_mut(&mut self.0, "views")?;
        let (qualities, colours) = (slice_mut(&mut self.1, "qualities")?, slice_mut(&mut self.2, "colours")?);
        run(py, move || Candidates::new(slots, views, qualities, colours.as_chunks_mut::<3>().0))
    }
}

#[pyfunction]
pub fn keep_best<'py>(
    py: Python<'py>,
    view: i16,
    quality: PyReadonlyArray1<'py, f32>,
    colour: PyReadonlyArray2<'py, u8>,
    views: PyReadwriteArray2<'py, i16>,
    qualities: PyReadwriteArray2<'py, f32>,
    colours: PyReadwriteArray3<'py, u8>,
) -> PyResult<()> {
    let (quality, colour) = (slice(&quality, "quality")?, rows::<3, _>(&colour, "colour")?);
    let mut lists = Lists(views, qualities, colours);
    let mut lists = lists.borrow(py)?;
    run(py, || lists.keep_best(view, quality, colour))
}

#[pyfunction]
pub fn compare_views<'py>(
    py: Python<'py>,
    views: PyReadwriteArray2<'py, i16>,
    qualities: PyReadwriteArray2<'py, f32>,
    colours: PyReadwriteArray3<'py, u8>,
    count: usize,
    sample: usize,
) -> PyResult<(Bound<'py, PyArray2<i32>>, Bound<'py, PyArray1<u32>>, Bound<'py, PyArray2<f32>>)> {
    let mut lists = Lists(views, qualities, colours);
    let lists = lists.borrow(py)?;
    let all = run(py, || mvcore::compare_views::compare_views(&lists, count, sample))?;
    let n = all.len();
    Ok((
        array(py, all.iter().flat_map(|c| c.pair).collect(), [n, 2])?,
        array(py, all.iter().map(|c| c.count).collect(), [n])?,
        array(py, all.iter().flat_map(|c| c.ratio).collect(), [n, 3])?,
    ))
}

#[pyfunction]
pub fn select_views<'py>(
    py: Python<'py>,
    vertices: PyReadonlyArray2<'py, f64>,
    faces: PyReadonlyArray2<'py, u32>,
    views: PyReadwriteArray2<'py, i16>,
    qualities: PyReadwriteArray2<'py, f32>,
    colours: PyReadwriteArray3<'py, u8>,
    gains: PyReadonlyArray2<'py, f32>,
    unit: f64,
    seam: f32,
    outlier: f32,
    least_patch: f64,
) -> PyResult<Bound<'py, PyArray1<i32>>> {
    let ((v, f), gains) = (mesh(&vertices, &faces)?, rows::<3, _>(&gains, "gains")?);
    let mut lists = Lists(views, qualities, colours);
    let mut lists = lists.borrow(py)?;
    let params = SelectParams { seam, unit, outlier, least_patch };
    let labels = run(py, || mvcore::select_views::select_views(Mesh::new(v, f)?, &mut lists, gains, &params))?;
    let n = labels.len();
    array(py, labels, [n])
}

/// A texture atlas in the making; once finished it is empty.
#[pyclass(module = "mvcore._core")]
pub struct Atlas(mvcore::atlas::Atlas);

#[pymethods]
impl Atlas {
    #[new]
    fn new<'py>(
        py: Python<'py>,
        vertices: PyReadonlyArray2<'py, f64>,
        faces: PyReadonlyArray2<'py, u32>,
        labels: PyReadonlyArray1<'py, i32>,
        matrices: PyReadonlyArray3<'py, f64>,
    ) -> PyResult<Self> {
        let ((v, f), labels) = (mesh(&vertices, &faces)?, slice(&labels, "labels")?);
        shaped(py, "matrices", matrices.shape(), &[matrices.shape()[0], 3, 4])?;
        finite(py, "matrices", slice(&matrices, "matrices")?.iter().copied())?;
        let projections = slice(&matrices, "matrices")?.as_chunks::<12>().0;
        Ok(Self(run(py, || mvcore::atlas::Atlas::plan(Mesh::new(v, f)?, labels, projections))?))
    }

    /// Most texels (height, width) that it can have.
    #[getter]
    fn size(&self) -> (usize, usize) {
        (self.0.most_rows, self.0.width)
    }

    /// The views that have charts, ascending.
    #[getter]
    fn views(&self) -> Vec<usize> {
        self.0.views()
    }

    fn add_view(&mut self, py: Python<'_>, view: usize, image: PyReadonlyArray3<'_, u8>) -> PyResult<()> {
        let rgb = picture(&image, "image")?;
        run(py, || self.0.add_view(view, &rgb))
    }

    fn finish<'py>(
        &mut self,
        py: Python<'py>,
        gains: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<(
        Bound<'py, PyArray1<u32>>,
        Bound<'py, PyArray2<f32>>,
        Bound<'py, PyArray2<u32>>,
        Bound<'py, PyArray3<u8>>,
    )> {
        let gains = rows::<3, _>(&gains, "gains")?;
        let atlas = std::mem::take(&mut self.0);
        let t = run(py, || atlas.finish(gains))?;
        let (n, count) = (t.origin.len(), t.faces.len());
        Ok((
            array(py, t.origin, [n])?,
            array(py, t.texel.into_flattened(), [n, 2])?,
            array(py, t.faces.into_flattened(), [count, 3])?,
            array(py, t.atlas, [t.height, t.width, 3])?,
        ))
    }
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
