//! How well a photograph shows each face of a mesh, and in which colour.
//!
//! ```text
//!   points of the face: all visible? angle < 75°?      quality = (mean gradient + base) · pixels a unit of its area, mean colour
//! ```
//!
//! The data term of Waechter, Moehrle and Goesele, ECCV 2014, with the gradient sampled at points, and a unit of area instead of a face, so
//! that it does not depend on how the surface is cut into faces.

use crate::error::{Result, require};
use crate::mesh::{Mesh, project};
use crate::raster::Raster;
use rayon::prelude::*;

/// One photograph with the mesh's z-buffer in it.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    /// Interleaved RGB, (height, width · 3).
    pub rgb: Raster<'a, u8>,
    /// Gradient magnitude; negative where the photograph must not be used.
    pub detail: Raster<'a, f32>,
    /// The mesh's z-depth in this view.
    pub depth: Raster<'a, f32>,
    /// P = K [R | t], row-major.
    pub projection: [f64; 12],
    /// Camera centre.
    pub center: [f64; 3],
}

/// What a photograph knows of each face.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ratings {
    /// 0 where the face cannot be textured from this view.
    pub quality: Vec<f32>,
    /// Mean colour.
    pub colour: Vec<[u8; 3]>,
}

/// cos 75°: views that see a face flatter than this smear it.
const LEAST_COSINE: f64 = 0.26;
/// Grey levels of gradient that an even surface counts as having: resolution matters there too.
const BASE_DETAIL: f32 = 4.0;
/// Pixels between the points at which a face is sampled.
const SPACING: f64 = 4.0;
/// Points along a face's side beyond the first: most faces are smaller.
const MOST_STEPS: u32 = 16;

/// Rates every face in a photograph; `tolerance` is the depth by which a point may lie behind the z-buffer, and the side of the unit of area.
pub fn rate_faces(mesh: Mesh, photo: &Photo, tolerance: f64) -> Result<Ratings> {
    let (w, h) = (photo.depth.width, photo.depth.height);
    require(photo.rgb.width == 3 * w && photo.rgb.height == h, "rgb", format!("{h} x {w} x 3"), "another size")?;
    require(photo.detail.width == w && photo.detail.height == h, "detail", format!("{h} x {w}"), "another size")?;
    let mut out = Ratings::default();
    (0..mesh.faces.len())
        .into_par_iter()
        .map(|f| rate_face(mesh, f, photo, tolerance))
        .unzip_into_vecs(&mut out.quality, &mut out.colour);
    Ok(out)
}

fn rate_face(mesh: Mesh, face: usize, photo: &Photo, tolerance: f64) -> (f32, [u8; 3]) {
    let corners = mesh.corners(face);
    let normal = mesh.normal(face);
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let ray: [f64; 3] =
        std::array::from_fn(|k| photo.center[k] - (corners[0][k] + corners[1][k] + corners[2][k]) / 3.0);
    let area = dot(normal, normal).sqrt();
    let cosine = dot(normal, ray) / (area * dot(ray, ray).sqrt()).max(1e-300);
    let [a, b, c] = corners.map(|p| project(&photo.projection, p));
    if cosine < LEAST_COSINE || a[2] <= 0.0 || b[2] <= 0.0 || c[2] <= 0.0 {
        return Default::default();
    }
    let along = |p: [f64; 3], q: [f64; 3]| (p[0] - q[0]).hypot(p[1] - q[1]);
    let longest = along(a, b).max(along(b, c)).max(along(c, a));
    let (mut detail, mut colour, mut count) = (0.0, [0u32; 3], 0u16);
    for weights in samples(longest) {
        let point = std::array::from_fn(|k| (0..3).map(|n| weights[n] * corners[n][k]).sum());
        let Some(at) = visible(photo, project(&photo.projection, point), tolerance / cosine) else {
            return Default::default();
        };
        detail += photo.detail.data[at];
        for k in 0..3 {
            colour[k] += u32::from(photo.rgb.data[3 * at + k]);
        }
        count += 1;
    }
    let pixels = ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    let density = pixels / area.max(1e-300) * tolerance * tolerance;
    ((detail / f32::from(count) + BASE_DETAIL) * density as f32, colour.map(|c| (c / u32::from(count)) as u8))
}

/// Barycentric coordinates of points at most [`SPACING`] pixels apart on a triangle of this longest side: corners and middle at least.
fn samples(longest: f64) -> impl Iterator<Item = [f64; 3]> {
    let n = ((longest / SPACING).ceil() as u32).clamp(1, MOST_STEPS);
    let lattice =
        (0..=n).flat_map(move |i| (0..=n - i).map(move |j| [i, j, n - i - j].map(|k| f64::from(k) / f64::from(n))));
    lattice.chain((n == 1).then_some([1.0 / 3.0; 3]))
}

/// Index of the pixel at which a projected point is seen, if it is.
fn visible(photo: &Photo, [x, y, z]: [f64; 3], tolerance: f64) -> Option<usize> {
    let (w, h) = (photo.depth.width, photo.depth.height);
    if z <= 0.0 || !(x >= 1.0 && y >= 1.0 && x < w as f64 - 2.0 && y < h as f64 - 2.0) {
        return None;
    }
    let at = (y + 0.5) as usize * w + (x + 0.5) as usize;
    let surface = f64::from(photo.depth.data[at]);
    (photo.detail.data[at] >= 0.0 && surface > 0.0 && z <= surface + tolerance).then_some(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_face_seen_from_behind_or_hidden_is_rated_zero() {
        let vertices = [[-1., -1., 4.], [1., -1., 4.], [0., 1., 4.]];
        let (rgb, detail) = (vec![9u8; 40 * 40 * 3], vec![1.0f32; 1600]);
        let rate_with = |depth: f32, faces: [[u32; 3]; 1]| {
            let buffer = vec![depth; 1600];
            let photo = Photo {
                rgb: Raster::new(&rgb, 120, 40, "rgb").unwrap(),
                detail: Raster::new(&detail, 40, 40, "detail").unwrap(),
                depth: Raster::new(&buffer, 40, 40, "depth").unwrap(),
                projection: [40., 0., 20., 0., 0., 40., 20., 0., 0., 0., 1., 0.],
                center: [0.0; 3],
            };
            rate_faces(Mesh::new(&vertices, &faces).unwrap(), &photo, 0.01).unwrap().quality[0]
        };
        assert!(rate_with(4.0, [[0, 2, 1]]) > 0.0);
        assert_eq!(rate_with(4.0, [[0, 1, 2]]), 0.0);
        assert_eq!(rate_with(3.0, [[0, 2, 1]]), 0.0);
    }

    #[test]
    fn what_hides_any_part_of_a_large_face_is_noticed_and_its_size_does_not_count() {
        let vertices = [[-1.5, -1.5, 4.], [1.5, -1.5, 4.], [-1.5, 1.5, 4.], [0., 0., 4.]];
        let (rgb, detail) = (vec![9u8; 40 * 40 * 3], vec![1.0f32; 1600]);
        let rate_with = |buffer: &[f32], face: [u32; 3]| {
            let photo = Photo {
                rgb: Raster::new(&rgb, 120, 40, "rgb").unwrap(),
                detail: Raster::new(&detail, 40, 40, "detail").unwrap(),
                depth: Raster::new(buffer, 40, 40, "depth").unwrap(),
                projection: [40., 0., 20., 0., 0., 40., 20., 0., 0., 0., 1., 0.],
                center: [0.0; 3],
            };
            rate_faces(Mesh::new(&vertices, &[face]).unwrap(), &photo, 0.01).unwrap().quality[0]
        };
        let mut buffer = vec![4.0f32; 1600];
        let (large, small) = (rate_with(&buffer, [0, 2, 1]), rate_with(&buffer, [0, 3, 1]));
        assert!(small > 0.0 && (large / small - 1.0).abs() < 1e-5);
        // A pole of five columns between the corners and the middle.
        (0..40).for_each(|y| buffer[y * 40 + 8..y * 40 + 13].fill(2.0));
        assert_eq!(rate_with(&buffer, [0, 2, 1]), 0.0);
    }
}
