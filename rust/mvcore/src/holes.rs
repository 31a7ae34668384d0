//! Small holes of a mesh closed: the places where a few voxels had no depth.
//!
//! ```text
//!   faces without a neighbour ──walk──► rims of holes ──each──► the triangulation (i, k, j) of least area, if it lies in the surface
//! ```
//!
//! Barequet and Sharir, CAGD 1995. A rim is left open where its patch would turn away from the faces around it, as at a depth edge or around
//! an open piece of surface, or would need an edge that the mesh has already. Rims are independent: the same faces for any number of threads.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::mesh::{Mesh, NOTHING, neighbours, normal};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};

/// Twice the least area of a triangle, of its longest edge squared: thinner ones are none.
const LEAST_AREA: f64 = 1e-6;
/// Least mean cosine between a patch and the faces around it. Laxer, the ragged fringes at depth edges get false skin (measured).
const LEAST_COSINE: f64 = 0.9;
/// Time grows with the cube of a rim's edges, memory with their square.
const MOST_EDGES: usize = 1000;

/// The faces that close every hole of at most `most_edges` (1000 or fewer) edges; the mesh's vertices are theirs.
pub fn close_holes(mesh: Mesh<'_>, most_edges: usize) -> Result<Vec<[u32; 3]>> {
    require(most_edges <= MOST_EDGES, "most_edges", format!("at most {MOST_EDGES}"), most_edges)?;
    let beyond = neighbours(mesh.faces);
    let loops = border_loops(mesh.faces, &beyond, most_edges);
    let mut touched = vec![false; mesh.vertices.len()];
    loops.iter().flatten().for_each(|h| touched[h.from as usize] = true);
    let mut edges: Vec<u64> = mesh
        .faces
        .par_iter()
        .flat_map_iter(|f| (0..3).map(|e| (f[e], f[(e + 1) % 3])))
        .filter(|&(a, b)| touched[a as usize] && touched[b as usize])
        .map(|(a, b)| edge(a, b))
        .collect();
    edges.par_sort_unstable();
    let interrupt = Interrupt::current();
    let closed = |rim: &Vec<Rim>| {
        interrupt.poll();
        patch(mesh, rim, &edges)
    };
    let patches: Vec<Vec<[u32; 3]>> = loops.par_iter().map(closed).collect();
    Ok(without_shared_edges(patches))
}

fn edge(a: u32, b: u32) -> u64 {
    (u64::from(a.min(b)) << 32) | u64::from(a.max(b))
}

/// An edge of a hole's rim, walked with the hole on its left; `face` lies on its right.
#[derive(Debug, Clone, Copy)]
struct Rim {
    from: u32,
    face: u32,
}

/// The rims of holes of 3 to `most_edges` edges. Where a rim comes back to a vertex, holes touch there: each is a rim of its own.
fn border_loops(faces: &[[u32; 3]], beyond: &[[i32; 3]], most_edges: usize) -> Vec<Vec<Rim>> {
    let mut seen = vec![false; 3 * faces.len()];
    let mut loops = Vec::new();
    for start in 0..3 * faces.len() {
        let (mut path, mut place, mut next) = (Vec::<Rim>::new(), HashMap::new(), Some(start));
        while let Some(side) = next.filter(|&s| !seen[s] && beyond[s / 3][s % 3] == NOTHING) {
            seen[side] = true;
            let from = faces[side / 3][(side % 3 + 1) % 3];
            if let Some(&first) = place.get(&from) {
                cut(&mut path, &mut place, first, most_edges, &mut loops);
            }
            place.insert(from, path.len());
            path.push(Rim { from, face: (side / 3) as u32 });
            next = next_side(faces, beyond, side);
        }
        if !path.is_empty() && next == Some(start) {
            cut(&mut path, &mut place, 0, most_edges, &mut loops);
        }
    }
    loops
}

/// Takes the end of a path, from `first` on, for a hole's rim.
fn cut(path: &mut Vec<Rim>, place: &mut HashMap<u32, usize>, first: usize, most: usize, loops: &mut Vec<Vec<Rim>>) {
    let rim = path.split_off(first);
    for h in &rim {
        place.remove(&h.from);
    }
    if (3..=most).contains(&rim.len()) {
        loops.push(rim);
    }
}

/// The border edge that the rim goes on with: around the vertex where `side` begins, face by face.
fn next_side(faces: &[[u32; 3]], beyond: &[[i32; 3]], side: usize) -> Option<usize> {
    let vertex = faces[side / 3][side % 3];
    let (mut face, mut corner) = (side / 3, side % 3);
    for _ in 0..faces.len() {
        let before = (corner + 2) % 3;
        let next = beyond[face][before];
        if next == NOTHING {
            return Some(3 * face + before);
        }
        let shared = faces[face][before];
        face = next as usize;
        corner = faces[face].iter().position(|&v| v == vertex)?;
        // A neighbour of the other orientation has no rim to follow.
        if faces[face][(corner + 1) % 3] != shared {
            return None;
        }
    }
    None
}

/// Triangles over a rim, or none.
fn patch(mesh: Mesh<'_>, rim: &[Rim], edges: &[u64]) -> Vec<[u32; 3]> {
    let n = rim.len();
    let points: Vec<[f64; 3]> = rim.iter().map(|h| mesh.vertices[h.from as usize]).collect();
    let (mut cost, mut split) = (vec![0.0f64; n * n], vec![usize::MAX; n * n]);
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            let mut best = (f64::INFINITY, usize::MAX);
            if span == n - 1 || edges.binary_search(&edge(rim[i].from, rim[j].from)).is_err() {
                for k in i + 1..j {
                    let total = cost[i * n + k] + cost[k * n + j] + area([points[i], points[k], points[j]]);
                    if total < best.0 {
                        best = (total, k);
                    }
                }
            }
            (cost[i * n + j], split[i * n + j]) = best;
        }
    }
    if !cost[n - 1].is_finite() {
        return Vec::new();
    }
    let (mut triangles, mut cosines, mut open) = (Vec::with_capacity(n - 2), 0.0, vec![(0, n - 1)]);
    while let Some((i, j)) = open.pop() {
        let k = split[i * n + j];
        let own = unit(normal([points[i], points[k], points[j]]));
        for (a, b) in [(i, k), (k, j), (j, i)] {
            // The rim's own edges: one step on, or from the last to the first.
            if (a + 1) % n == b {
                let around = unit(mesh.normal(rim[a].face as usize));
                cosines += (0..3).map(|c| own[c] * around[c]).sum::<f64>();
            }
        }
        triangles.push([rim[i].from, rim[k].from, rim[j].from]);
        open.extend([(i, k), (k, j)].into_iter().filter(|(a, b)| b - a > 1));
    }
    if cosines > LEAST_COSINE * n as f64 { triangles } else { Vec::new() }
}

/// Patches in their order, each unless an edge of it is an inner edge of one before.
fn without_shared_edges(patches: Vec<Vec<[u32; 3]>>) -> Vec<[u32; 3]> {
    let mut inner = HashSet::new();
    let mut out = Vec::new();
    for patch in patches {
        let mut sides: Vec<u64> = patch.iter().flat_map(|f| (0..3).map(|e| edge(f[e], f[(e + 1) % 3]))).collect();
        sides.sort_unstable();
        let own: Vec<u64> = sides.chunk_by(|a, b| a == b).filter(|g| g.len() > 1).map(|g| g[0]).collect();
        if own.iter().all(|e| !inner.contains(e)) {
            inner.extend(own);
            out.extend(patch);
        }
    }
    out
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    let l = length(v).max(f64::MIN_POSITIVE);
    v.map(|x| x / l)
}

/// Twice a triangle's area; infinite where it has none.
fn area(corners: [[f64; 3]; 3]) -> f64 {
    let double = length(normal(corners));
    let longest = (0..3)
        .map(|e| {
            let (p, q) = (corners[e], corners[(e + 1) % 3]);
            (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f64>()
        })
        .fold(0.0, f64::max);
    if double > LEAST_AREA * longest { double } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sheet of n x n cells, two triangles each, without those that `missing` names.
    fn sheet(n: u32, missing: impl Fn(u32, u32) -> bool) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let at = |x: u32, y: u32| y * (n + 1) + x;
        let height = |x: u32, y: u32| 0.3 * f64::from(x).sin() + 0.1 * f64::from(y);
        let vertices = (0..=n).flat_map(|y| (0..=n).map(move |x| [f64::from(x), f64::from(y), height(x, y)])).collect();
        let mut faces = Vec::new();
        for y in 0..n {
            for x in (0..n).filter(|&x| !missing(x, y)) {
                faces.push([at(x, y), at(x + 1, y), at(x + 1, y + 1)]);
                faces.push([at(x, y), at(x + 1, y + 1), at(x, y + 1)]);
            }
        }
        (vertices, faces)
    }

    fn closed(n: u32, missing: impl Fn(u32, u32) -> bool, most: usize) -> (usize, usize) {
        let (vertices, mut faces) = sheet(n, missing);
        let added = close_holes(Mesh::new(&vertices, &faces).unwrap(), most).unwrap();
        let count = added.len();
        faces.extend(added);
        let border = neighbours(&faces).iter().flatten().filter(|&&g| g == NOTHING).count();
        // Every edge is used once in each direction.
        let mut directed: Vec<(u32, u32)> = faces.iter().flat_map(|f| (0..3).map(|e| (f[e], f[(e + 1) % 3]))).collect();
        directed.sort_unstable();
        assert!(directed.windows(2).all(|w| w[0] != w[1]));
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        assert!((0..faces.len()).all(|f| mesh.normal(f)[2] > 0.0));
        (count, border)
    }

    #[test]
    fn small_holes_are_closed_and_the_sheets_own_rim_is_not() {
        let square = |x: u32, y: u32| (3..6).contains(&x) && (4..6).contains(&y);
        assert_eq!(closed(10, square, 10), (8, 40));
        assert_eq!(closed(10, square, 9), (0, 50));
        // Even where the rim is short enough to be a hole.
        assert_eq!(closed(2, |_, _| false, 30), (0, 8));
    }

    #[test]
    fn holes_that_touch_at_a_corner_are_two() {
        let touching = |x: u32, y: u32| (x, y) == (3, 3) || (x, y) == (4, 4);
        assert_eq!(closed(8, touching, 8), (4, 32));
    }

    #[test]
    fn an_open_box_keeps_its_mouth() {
        // The box of side 1 without its top: the four faces at its rim stand upright around the patch.
        let vertices: Vec<[f64; 3]> = (0..8).map(|n| [n & 1, n >> 1 & 1, n >> 2].map(|b| f64::from(b as u8))).collect();
        let quads = [[0, 2, 3, 1], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]];
        let faces: Vec<[u32; 3]> = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        // It turns by ninety degrees everywhere: as much out of the surface as on.
        assert!(close_holes(mesh, 8).unwrap().is_empty());
    }

    #[test]
    fn patches_share_no_edge_and_take_none_that_is_there() {
        let (first, second, third) =
            (vec![[0, 1, 2], [0, 2, 3]], vec![[2, 0, 4], [2, 5, 0]], vec![[6, 7, 8], [6, 8, 9]]);
        let kept = without_shared_edges(vec![first.clone(), second, third.clone()]);
        assert_eq!(kept, [first, third].concat());
        // A square whose one diagonal is taken gets the other; with both taken it stays open.
        let (vertices, faces) = sheet(3, |x, y| (x, y) == (1, 1));
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let rim = &border_loops(&faces, &neighbours(&faces), 4)[0];
        let diagonals = [edge(rim[0].from, rim[2].from), edge(rim[1].from, rim[3].from)];
        for taken in diagonals {
            assert!(patch(mesh, rim, &[taken]).iter().all(|f| (0..3).all(|e| edge(f[e], f[(e + 1) % 3]) != taken)));
            assert_eq!(patch(mesh, rim, &[taken]).len(), 2);
        }
        let mut both = diagonals;
        both.sort_unstable();
        assert!(patch(mesh, rim, &both).is_empty());
    }

    #[test]
    fn faces_that_are_turned_over_and_endless_rims_do_no_harm() {
        let (vertices, mut faces) = sheet(6, |x, y| (2..4).contains(&x) && y == 3);
        faces.iter_mut().step_by(5).for_each(|f| f.swap(0, 1));
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        assert!(close_holes(mesh, 1000).is_ok());
        assert!(close_holes(mesh, 1001).unwrap_err().to_string().starts_with("most_edges:"));
    }

    #[test]
    fn nothing_comes_of_nothing() {
        assert!(close_holes(Mesh::new(&[], &[]).unwrap(), 30).unwrap().is_empty());
    }
}
