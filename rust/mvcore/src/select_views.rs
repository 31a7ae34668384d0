//! Which image textures which face: a labelling with few seams.
//!
//! ```text
//!   per face: colours that disagree with the other views (an occluder, a highlight) are rejected
//!   quality spread over neighbouring faces ──► first labels ──► Potts energy lowered ──► small patches merged
//! ```
//!
//! After Waechter, Moehrle and Goesele, ECCV 2014; their solver is replaced by iterated conditional modes from a smoothed start. All of
//! it works on the faces' short lists of views ([`crate::candidates`]); spreading takes one view at a time.

use crate::candidates::Candidates;
use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::mesh::{Mesh, NOTHING, components, neighbours};
use rayon::prelude::*;

/// How to label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SelectParams {
    /// Cost of a seam, a `unit` of its length, relative to the span of data costs of a square unit (1).
    pub seam: f32,
    /// Length by which seams and areas are measured, world units: energies do not depend on how the surface is cut into faces.
    pub unit: f64,
    /// Grey levels by which a view's colour may differ from the median of the list; 0 turns the check off.
    pub outlier: f32,
    /// Patches of less area (square units) take a neighbouring patch's view where that one sees them.
    pub least_patch: f64,
}

/// Rounds of spreading quality before the first labels are taken.
const SPREAD: usize = 8;
/// Most rounds of iterated conditional modes.
const SWEEPS: usize = 20;
/// Most rounds of merging small patches.
const MERGES: usize = 4;
/// Faces that the scale of qualities is taken from.
const SCALE_SAMPLE: usize = 200_000;

/// A view a face, [`NOTHING`] for faces that no view sees. Rejected views stay in their lists with quality 0.
///
/// `gains` are the factors a channel that bring each view's colours to common ones.
pub fn select_views(mesh: Mesh, lists: &mut Candidates, gains: &[[f32; 3]], params: &SelectParams) -> Result<Vec<i32>> {
    let n = mesh.faces.len();
    require(lists.len() == n, "views", format!("lists of {n} faces"), lists.len())?;
    lists.check(gains.len())?;
    require(params.unit > 0.0, "unit", "more than 0", params.unit)?;
    let around = neighbours(mesh.faces);
    if params.outlier > 0.0 {
        reject_outliers(lists, gains, params.outlier);
    }
    let scale = 1.0 / percentile_95(lists).max(1e-12);
    let mut labels = start(lists, &around, gains.len());
    let interrupt = Interrupt::current();
    for _ in 0..SWEEPS {
        interrupt.poll();
        if !sweep(mesh, lists, &around, scale, params, &mut labels) {
            break;
        }
    }
    for _ in 0..MERGES {
        interrupt.poll();
        if !merge_small(mesh, lists, &around, params, &mut labels) {
            break;
        }
    }
    Ok(labels)
}

/// Sets the quality of views to 0 whose colour is out of line with the median of at least three.
fn reject_outliers(lists: &mut Candidates, gains: &[[f32; 3]], outlier: f32) {
    let slots = lists.slots;
    let faces = lists.views.par_chunks_exact(slots).zip(lists.colours.par_chunks_exact(slots));
    faces.zip(lists.qualities.par_chunks_exact_mut(slots)).for_each_init(
        || (Vec::new(), Vec::new()),
        |(seen, values), ((views, colours), qualities)| {
            seen.clear();
            seen.extend((0..slots).filter(|&s| qualities[s] > 0.0));
            if seen.len() < 3 {
                return;
            }
            let level = |s: usize, k: usize| f32::from(colours[s][k]) * gains[views[s] as usize][k];
            let median: [f32; 3] = std::array::from_fn(|k| {
                values.clear();
                values.extend(seen.iter().map(|&s| level(s, k)));
                values.sort_unstable_by(f32::total_cmp);
                values[values.len() / 2]
            });
            for &s in seen.iter() {
                if (0..3).any(|k| (level(s, k) - median[k]).abs() > outlier) {
                    qualities[s] = 0.0;
                }
            }
        },
    );
}

/// The quality that 95 % of the views of a sample of the faces have at most.
fn percentile_95(lists: &Candidates) -> f32 {
    let faces = (0..lists.len()).step_by((lists.len() / SCALE_SAMPLE).max(1));
    let mut seen: Vec<f32> = faces.flat_map(|f| &lists.qualities[lists.of(f)]).copied().filter(|&q| q > 0.0).collect();
    if seen.is_empty() {
        return 1.0;
    }
    let at = (seen.len() - 1) * 95 / 100;
    *seen.select_nth_unstable_by(at, f32::total_cmp).1
}

/// No entry.
const NONE: u32 = u32::MAX;

/// Best view of each face by the quality of its surroundings: large patches from the outset. Of equals the lowest number wins.
fn start(lists: &Candidates, around: &[[i32; 3]], views: usize) -> Vec<i32> {
    let n = lists.len();
    let (mut labels, mut best) = (vec![NOTHING; n], vec![0.0f32; n]);
    // Where a face stands among those that have the view.
    let mut place = vec![NONE; n];
    let interrupt = Interrupt::current();
    for view in 0..views as i32 {
        interrupt.poll();
        let members: Vec<u32> =
            (0..n as u32).into_par_iter().filter(|&f| lists.quality(f as usize, view) > 0.0).collect();
        members.iter().zip(0..).for_each(|(&f, i)| place[f as usize] = i);
        let spread = spread(lists, around, view, &members, &place);
        for (&f, &quality) in members.iter().zip(&spread) {
            let f = f as usize;
            place[f] = NONE;
            if labels[f] == NOTHING || quality > best[f] {
                (labels[f], best[f]) = (view, quality);
            }
        }
    }
    labels
}

/// Mean quality of a view around each of its faces; 0 counts where a neighbour does not have the view.
fn spread(lists: &Candidates, around: &[[i32; 3]], view: i32, members: &[u32], place: &[u32]) -> Vec<f32> {
    let beside: Vec<[u32; 3]> = members
        .par_iter()
        .map(|&f| around[f as usize].map(|g| if g == NOTHING { NONE } else { place[g as usize] }))
        .collect();
    let mut now: Vec<f32> = members.par_iter().map(|&f| lists.quality(f as usize, view)).collect();
    let mut next = vec![0.0; now.len()];
    for _ in 0..SPREAD {
        next.par_iter_mut().zip(&now).zip(&beside).for_each(|((out, &own), beside)| {
            *out = 0.25 * beside.iter().filter(|&&g| g != NONE).fold(own, |sum, &g| sum + now[g as usize]);
        });
        std::mem::swap(&mut now, &mut next);
    }
    now
}

/// One round of iterated conditional modes; whether a label changed.
fn sweep(
    mesh: Mesh,
    lists: &Candidates,
    around: &[[i32; 3]],
    scale: f32,
    params: &SelectParams,
    labels: &mut [i32],
) -> bool {
    let mut changed = false;
    for f in 0..around.len() {
        let now = labels[f];
        let others = around[f].map(|g| if g == NOTHING { NOTHING } else { labels[g as usize] });
        // Only a neighbour's view can be better than the present one.
        if now == NOTHING || others.iter().all(|&v| v == NOTHING || v == now) {
            continue;
        }
        let area = area(mesh, f, params.unit) as f32;
        let lengths = lengths(mesh.corners(f), params.unit);
        let cost = |v: i32, quality: f32| {
            let seams: f32 = others.iter().zip(lengths).filter(|&(&o, _)| o != NOTHING && o != v).map(|(_, l)| l).sum();
            area * (1.0 - (quality * scale).min(1.0)) + params.seam * seams
        };
        let mut best = (now, cost(now, lists.quality(f, now)));
        for v in others.into_iter().filter(|&v| v != NOTHING && v != now) {
            let quality = lists.quality(f, v);
            let c = cost(v, quality);
            if quality > 0.0 && c < best.1 {
                best = (v, c);
            }
        }
        changed |= best.0 != now;
        labels[f] = best.0;
    }
    changed
}

/// Area of a face in square units.
fn area(mesh: Mesh, face: usize, unit: f64) -> f64 {
    0.5 * mesh.normal(face).iter().map(|x| x * x).sum::<f64>().sqrt() / (unit * unit)
}

/// Lengths of the sides 0-1, 1-2, 2-0 of a triangle in units.
fn lengths(corners: [[f64; 3]; 3], unit: f64) -> [f32; 3] {
    std::array::from_fn(|e| {
        let (p, q) = (corners[e], corners[(e + 1) % 3]);
        ((0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>().sqrt() / unit) as f32
    })
}

/// Gives small patches to the neighbouring view that sees most of them; whether a label changed.
fn merge_small(mesh: Mesh, lists: &Candidates, around: &[[i32; 3]], params: &SelectParams, labels: &mut [i32]) -> bool {
    let (part, count) = components(around, |f, g| labels[f] == labels[g]);
    let mut size = vec![0.0; count];
    for (f, &p) in part.iter().enumerate() {
        size[p as usize] += area(mesh, f, params.unit);
    }
    let mut changed = false;
    for f in 0..around.len() {
        if size[part[f] as usize] >= params.least_patch || labels[f] == NOTHING {
            continue;
        }
        let better = around[f]
            .iter()
            .filter(|&&g| g != NOTHING)
            .map(|&g| g as usize)
            .filter(|&g| labels[g] != NOTHING && labels[g] != labels[f] && lists.quality(f, labels[g]) > 0.0)
            .max_by(|&g, &h| size[part[g] as usize].total_cmp(&size[part[h] as usize]).then(h.cmp(&g)));
        if let Some(g) = better
            && size[part[g] as usize] > size[part[f] as usize]
        {
            labels[f] = labels[g];
            changed = true;
        }
    }
    changed
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

    const PARAMS: SelectParams = SelectParams { seam: 0.25, unit: 1.0, outlier: 40.0, least_patch: 2.0 };

    /// Labels from the quality and grey level of each view of each face.
    fn label(mesh: Mesh, count: usize, rating: impl Fn(usize, usize) -> (f32, u8), gains: &[[f32; 3]]) -> Vec<i32> {
        let n = mesh.faces.len();
        let (mut views, mut qualities, mut colours) =
            (vec![-1i16; n * count], vec![0f32; n * count], vec![[0u8; 3]; n * count]);
        let mut lists = Candidates::new(count, &mut views, &mut qualities, &mut colours).unwrap();
        for v in 0..count {
            let (quality, colour): (Vec<f32>, Vec<[u8; 3]>) =
                (0..n).map(|f| rating(f, v)).map(|(q, grey)| (q, [grey; 3])).unzip();
            lists.keep_best(v as i16, &quality, &colour).unwrap();
        }
        select_views(mesh, &mut lists, gains, &PARAMS).unwrap()
    }

    #[test]
    fn noise_in_the_quality_makes_no_seams() {
        let (vertices, faces) = strip(40);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let noisy = |f: usize, v: usize| {
            let better = (f < 40) == (v == 0);
            (if better { 1.0 } else { 0.8 } + if (f * 7 + v).is_multiple_of(5) { 0.3 } else { 0.0 }, 100)
        };
        let labels = label(mesh, 2, noisy, &[[1.0; 3]; 2]);
        let seams = labels.windows(2).filter(|p| p[0] != p[1]).count();
        assert_eq!(seams, 1, "{labels:?}");
        assert_eq!((labels[0], labels[79]), (0, 1));
    }

    #[test]
    fn an_occluder_is_outvoted_and_unseen_faces_have_no_view() {
        let (vertices, faces) = strip(3);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let rating = |f: usize, v: usize| if f == 5 { (0.0, 0) } else { [(9.0, 250), (1.0, 100), (1.2, 104)][v] };
        assert_eq!(label(mesh, 3, rating, &[[1.0; 3]; 3]), [2, 2, 2, 2, 2, NOTHING]);
        // The same levels are no outlier where that view is known to be brighter.
        assert_eq!(label(mesh, 3, rating, &[[0.4; 3], [1.0; 3], [1.0; 3]]), [0, 0, 0, 0, 0, NOTHING]);
    }

    #[test]
    fn lists_of_another_mesh_are_refused() {
        let (vertices, faces) = strip(3);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let (mut views, mut qualities, mut colours) = ([0i16; 5], [1f32; 5], [[0u8; 3]; 5]);
        let mut lists = Candidates::new(1, &mut views, &mut qualities, &mut colours).unwrap();
        assert!(select_views(mesh, &mut lists, &[[1.0; 3]], &PARAMS).is_err());
    }
}
