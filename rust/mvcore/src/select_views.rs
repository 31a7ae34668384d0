//! Which photograph textures which face: a labelling with few seams.
//!
//! ```text
//!   per view and face: visible? angle < 75°?  quality = Σ gradient over its pixels, mean colour      rate
//!   per face: colours that disagree with the other views (an occluder, a highlight) are dropped      select
//!   quality spread over neighbouring faces ──► first labels ──► Potts energy lowered ──► crumbs merged
//! ```
//!
//! After Waechter, Moehrle and Goesele, ECCV 2014; their solver is replaced by iterated conditional modes from a smoothed start.

use crate::error::{Result, require};
use crate::mesh::{Mesh, NOTHING, components, neighbours, project};
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

/// What a photograph knows of a face.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Rating {
    /// 0 where the face cannot be textured from this view.
    pub quality: f32,
    /// Mean colour.
    pub colour: [u8; 3],
}

/// cos 75°: views that see a face flatter than this smear it.
const LEAST_COSINE: f64 = 0.26;
/// Grey levels of gradient that an even surface counts as having: resolution matters there too.
const BASE_DETAIL: f32 = 4.0;

/// Rates every face in a photograph; `tolerance` is the depth by which a vertex may lie behind the z-buffer.
pub fn rate(mesh: Mesh, photo: &Photo, tolerance: f64) -> Result<Vec<Rating>> {
    let (w, h) = (photo.depth.width, photo.depth.height);
    require(photo.rgb.width == 3 * w && photo.rgb.height == h, "rgb", format!("{h} x {w} x 3"), "another size")?;
    require(photo.detail.width == w && photo.detail.height == h, "detail", format!("{h} x {w}"), "another size")?;
    Ok((0..mesh.faces.len()).into_par_iter().map(|f| rate_face(mesh, f, photo, tolerance)).collect())
}

fn rate_face(mesh: Mesh, face: usize, photo: &Photo, tolerance: f64) -> Rating {
    let corners = mesh.corners(face);
    let normal = mesh.normal(face);
    let middle: [f64; 3] = std::array::from_fn(|k| (corners[0][k] + corners[1][k] + corners[2][k]) / 3.0);
    let ray: [f64; 3] = std::array::from_fn(|k| photo.center[k] - middle[k]);
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let cosine = dot(normal, ray) / (dot(normal, normal) * dot(ray, ray)).sqrt().max(1e-300);
    if cosine < LEAST_COSINE {
        return Rating::default();
    }
    let (mut detail, mut colour) = (0.0, [0u32; 3]);
    let points = [corners[0], corners[1], corners[2], middle].map(|p| project(&photo.projection, p));
    for q in points {
        let Some(at) = visible(photo, q, tolerance / cosine) else { return Rating::default() };
        detail += photo.detail.data[at];
        for k in 0..3 {
            colour[k] += u32::from(photo.rgb.data[3 * at + k]);
        }
    }
    let [a, b, c, _] = points;
    let pixels = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
    Rating { quality: (detail / 4.0 + BASE_DETAIL) * pixels as f32, colour: colour.map(|c| (c / 4) as u8) }
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

/// How to label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelectParams {
    /// Cost of a seam along one edge, relative to the span of data costs (1).
    pub seam: f32,
    /// Grey levels by which a view's colour may differ from the median of all views; 0 turns the check off.
    pub outlier: f32,
    /// Patches of fewer faces take a neighbouring patch's view where that one sees them.
    pub least_patch: usize,
}

/// Rounds of spreading quality before the first labels are taken.
const SPREAD: usize = 8;
const SWEEPS: usize = 20;

/// A view a face, [`NOTHING`] for faces that no view sees; `ratings` holds one rating a face for each view.
pub fn select_views(mesh: Mesh, ratings: &[Vec<Rating>], params: &SelectParams) -> Result<Vec<i32>> {
    let (n, views) = (mesh.faces.len(), ratings.len());
    require(ratings.iter().all(|r| r.len() == n), "ratings", format!("{n} values a view"), "another number")?;
    let around = neighbours(mesh.faces);
    let quality = usable(ratings, views, n, params.outlier);
    let scale = 1.0 / percentile_95(&quality).max(1e-12);
    let mut labels = start(&quality, &around, views);
    for _ in 0..SWEEPS {
        if !sweep(&quality, &around, views, scale, params.seam, &mut labels) {
            break;
        }
    }
    for _ in 0..4 {
        merge_crumbs(&quality, &around, views, params.least_patch, &mut labels);
    }
    Ok(labels)
}

/// Quality by face and view, 0 where a view is out of line with the colours of the others.
fn usable(ratings: &[Vec<Rating>], views: usize, n: usize, outlier: f32) -> Vec<f32> {
    let mut quality = vec![0.0; n * views];
    quality.par_chunks_exact_mut(views.max(1)).enumerate().for_each(|(f, out)| {
        let rating = |v: usize| &ratings[v][f];
        for v in 0..views {
            out[v] = rating(v).quality;
        }
        let seen: Vec<usize> = (0..views).filter(|&v| out[v] > 0.0).collect();
        if outlier > 0.0 && seen.len() >= 3 {
            let median: [f32; 3] = std::array::from_fn(|k| {
                let mut values: Vec<u8> = seen.iter().map(|&v| rating(v).colour[k]).collect();
                values.sort_unstable();
                f32::from(values[values.len() / 2])
            });
            for &v in &seen {
                let far = (0..3).any(|k| (f32::from(rating(v).colour[k]) - median[k]).abs() > outlier);
                if far {
                    out[v] = 0.0;
                }
            }
        }
    });
    quality
}

fn percentile_95(quality: &[f32]) -> f32 {
    let mut seen: Vec<f32> = quality.iter().copied().filter(|&q| q > 0.0).collect();
    if seen.is_empty() {
        return 1.0;
    }
    let at = (seen.len() - 1) * 95 / 100;
    *seen.select_nth_unstable_by(at, f32::total_cmp).1
}

/// Best view of each face by the quality of its surroundings: large patches from the outset.
fn start(quality: &[f32], around: &[[i32; 3]], views: usize) -> Vec<i32> {
    let (mut now, mut next) = (quality.to_vec(), vec![0.0; quality.len()]);
    for _ in 0..SPREAD {
        next.par_chunks_exact_mut(views.max(1)).enumerate().for_each(|(f, out)| {
            out.copy_from_slice(&now[f * views..][..views]);
            for &g in around[f].iter().filter(|&&g| g != NOTHING) {
                for (o, q) in out.iter_mut().zip(&now[g as usize * views..][..views]) {
                    *o += q;
                }
            }
            out.iter_mut().for_each(|o| *o *= 0.25);
        });
        std::mem::swap(&mut now, &mut next);
    }
    (0..around.len())
        .into_par_iter()
        .map(|f| {
            let own = &quality[f * views..][..views];
            let spread = &now[f * views..][..views];
            (0..views)
                .filter(|&v| own[v] > 0.0)
                .max_by(|&a, &b| spread[a].total_cmp(&spread[b]).then(b.cmp(&a)))
                .map_or(NOTHING, |v| v as i32)
        })
        .collect()
}

/// One round of iterated conditional modes; whether a label changed.
fn sweep(quality: &[f32], around: &[[i32; 3]], views: usize, scale: f32, seam: f32, labels: &mut [i32]) -> bool {
    let mut changed = false;
    for f in 0..around.len() {
        if labels[f] == NOTHING {
            continue;
        }
        let own = &quality[f * views..][..views];
        let others = around[f].map(|g| if g == NOTHING { NOTHING } else { labels[g as usize] });
        let cost = |v: i32| {
            let seams = others.iter().filter(|&&o| o != NOTHING && o != v).count() as f32;
            1.0 - (own[v as usize] * scale).min(1.0) + seam * seams
        };
        let mut best = (labels[f], cost(labels[f]));
        for v in others.into_iter().filter(|&v| v != NOTHING && own[v as usize] > 0.0) {
            let c = cost(v);
            if c < best.1 {
                best = (v, c);
            }
        }
        changed |= best.0 != labels[f];
        labels[f] = best.0;
    }
    changed
}

/// Gives small patches to the neighbouring view that sees most of them.
fn merge_crumbs(quality: &[f32], around: &[[i32; 3]], views: usize, least: usize, labels: &mut [i32]) {
    let (part, count) = components(around, |f, g| labels[f] == labels[g]);
    let mut size = vec![0usize; count];
    for &p in &part {
        size[p as usize] += 1;
    }
    for f in 0..around.len() {
        if size[part[f] as usize] >= least || labels[f] == NOTHING {
            continue;
        }
        let own = &quality[f * views..][..views];
        let better = around[f]
            .iter()
            .filter(|&&g| g != NOTHING)
            .map(|&g| g as usize)
            .filter(|&g| labels[g] != NOTHING && labels[g] != labels[f] && own[labels[g] as usize] > 0.0)
            .max_by_key(|&g| (size[part[g] as usize], std::cmp::Reverse(g)));
        if let Some(g) = better
            && size[part[g] as usize] > size[part[f] as usize]
        {
            labels[f] = labels[g];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of 2·n triangles.
    fn strip(n: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let vertices = (0..=n).flat_map(|i| [[f64::from(i), 0.0, 5.0], [f64::from(i), 1.0, 5.0]]).collect();
        let faces = (0..n).flat_map(|i| [[2 * i, 2 * i + 1, 2 * i + 2], [2 * i + 2, 2 * i + 1, 2 * i + 3]]).collect();
        (vertices, faces)
    }

    const PARAMS: SelectParams = SelectParams { seam: 0.5, outlier: 40.0, least_patch: 4 };

    fn rating(quality: f32, grey: u8) -> Rating {
        Rating { quality, colour: [grey; 3] }
    }

    #[test]
    fn noise_in_the_quality_makes_no_seams() {
        let (vertices, faces) = strip(40);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let noisy = |f: usize, v: usize| {
            let better = (f < 40) == (v == 0);
            rating(if better { 1.0 } else { 0.8 } + if (f * 7 + v).is_multiple_of(5) { 0.3 } else { 0.0 }, 100)
        };
        let ratings: Vec<Vec<_>> = (0..2).map(|v| (0..80).map(|f| noisy(f, v)).collect()).collect();
        let labels = select_views(mesh, &ratings, &PARAMS).unwrap();
        let seams = labels.windows(2).filter(|p| p[0] != p[1]).count();
        assert_eq!(seams, 1, "{labels:?}");
        assert_eq!((labels[0], labels[79]), (0, 1));
    }

    #[test]
    fn an_occluder_is_outvoted_and_unseen_faces_have_no_view() {
        let (vertices, faces) = strip(3);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let mut ratings: Vec<_> =
            [(9.0, 250), (1.0, 100), (1.2, 104)].into_iter().map(|(q, grey)| vec![rating(q, grey); 6]).collect();
        for view in &mut ratings {
            view[5] = Rating::default();
        }
        let labels = select_views(mesh, &ratings, &PARAMS).unwrap();
        assert_eq!(labels, [2, 2, 2, 2, 2, NOTHING]);
    }

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
            rate(Mesh::new(&vertices, &faces).unwrap(), &photo, 0.01).unwrap()[0].quality
        };
        assert!(rate_with(4.0, [[0, 2, 1]]) > 0.0);
        assert_eq!(rate_with(4.0, [[0, 1, 2]]), 0.0);
        assert_eq!(rate_with(3.0, [[0, 2, 1]]), 0.0);
    }
}
