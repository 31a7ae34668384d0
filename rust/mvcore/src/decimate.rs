//! Fewer faces within an error bound: edges collapse by quadric errors, in meshoptimizer.
//!
//! ```text
//!   cells of CELL times the error, in parallel        ┌───┬───┐      the same, half a cell aside        · ┌───┐ ·
//!   what two cells share is locked                    │ ▒ │ ▒ │      all but what was locked before     │ ─┼─ │
//!                                                     └───┴───┘      and is inside a cell now is locked  · └───┘ ·
//! ```
//!
//! After Garland and Heckbert, SIGGRAPH 1997: a vertex that stands for several lies where their planes' squared distances are least.
//! meshoptimizer sums squared distances in single precision: errors below some 3e-4 of what it is given are lost, so it is given cells.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::mesh::{Mesh, NOTHING, neighbours};
use meshopt::{SimplifyOptions, SimplifyVertex, simplify_with_update};
use rayon::prelude::*;

/// A cell's side, in errors and, at least, in edges.
const CELL: f64 = 256.0;
const LEAST_CELL: f64 = 32.0;
/// Cells along an axis.
const MOST_CELLS: f64 = 1000.0;

/// A mesh with fewer faces; its vertices are numbered as before, some have no face.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Decimated {
    /// Positions in world units.
    pub vertices: Vec<[f64; 3]>,
    /// Triples of vertex numbers.
    pub faces: Vec<[u32; 3]>,
}

/// Collapses edges while the surface moves by no more than `error` (world units, root mean square over the faces that meet), and then
/// until there are no more than about `most_faces`. With `keep_borders` the vertices at borders stay while the error decides.
pub fn decimate(mesh: Mesh, error: f64, most_faces: usize, keep_borders: bool) -> Result<Decimated> {
    require(error.is_finite() && error >= 0.0, "error", "0 or more", error)?;
    let mut out = Decimated { vertices: mesh.vertices.to_vec(), faces: mesh.faces.to_vec() };
    if error > 0.0 {
        let kept = if keep_borders { at_border(mesh) } else { vec![false; mesh.vertices.len()] };
        let shared = out.collapse_cells(error, 0.0, |v| !kept[v as usize]);
        out.collapse_cells(error, 0.5, |v| shared[v as usize] && !kept[v as usize]);
    }
    if out.faces.len() > most_faces {
        Interrupt::current().poll();
        let rest = Part::of(&out.vertices, &out.faces).collapsed(f64::MAX, most_faces, |_| true);
        out.faces.clear();
        out.take(rest);
    }
    Ok(out)
}

/// Vertices of edges that only one face has.
fn at_border(mesh: Mesh) -> Vec<bool> {
    let mut out = vec![false; mesh.vertices.len()];
    for (face, around) in mesh.faces.iter().zip(neighbours(mesh.faces)) {
        for e in (0..3).filter(|&e| around[e] == NOTHING) {
            out[face[e] as usize] = true;
            out[face[(e + 1) % 3] as usize] = true;
        }
    }
    out
}

impl Decimated {
    /// Collapses what is `free` and lies within one cell of a grid, `shift` cells aside; which vertices several cells share.
    fn collapse_cells(&mut self, error: f64, shift: f64, free: impl Fn(u32) -> bool + Sync) -> Vec<bool> {
        let cells = self.cells((CELL * error).max(LEAST_CELL * self.mean_edge()), shift);
        let mut shared = vec![false; self.vertices.len()];
        let mut owner = vec![u32::MAX; self.vertices.len()];
        for &(cell, face) in &cells {
            for v in self.faces[face as usize].map(|v| v as usize) {
                shared[v] |= owner[v] != u32::MAX && owner[v] != cell;
                owner[v] = cell;
            }
        }
        drop(owner);
        let interrupt = Interrupt::current();
        let groups: Vec<&[(u32, u32)]> = cells.chunk_by(|a, b| a.0 == b.0).collect();
        let collapsed = |group: &&[(u32, u32)]| {
            interrupt.poll();
            let faces: Vec<[u32; 3]> = group.iter().map(|&(_, face)| self.faces[face as usize]).collect();
            Part::of(&self.vertices, &faces).collapsed(error, 0, |v| free(v) && !shared[v as usize])
        };
        let parts: Vec<Collapsed> = groups.par_iter().map(collapsed).collect();
        self.faces.clear();
        parts.into_iter().for_each(|part| self.take(part));
        shared
    }

    fn mean_edge(&self) -> f64 {
        let edge = |f: &[u32; 3]| {
            let [a, b] = [f[0], f[1]].map(|v| self.vertices[v as usize]);
            (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
        };
        self.faces.iter().map(edge).sum::<f64>() / self.faces.len().max(1) as f64
    }

    /// The cell of each face's first corner and the face's number, ascending.
    fn cells(&self, side: f64, shift: f64) -> Vec<(u32, u32)> {
        let corner = |f: &[u32; 3]| self.vertices[f[0] as usize];
        let limits = |pick: fn(f64, f64) -> f64, from: f64| {
            self.faces.iter().map(corner).fold([from; 3], |m, p| std::array::from_fn(|k| pick(m[k], p[k])))
        };
        let (low, high) = (limits(f64::min, f64::INFINITY), limits(f64::max, f64::NEG_INFINITY));
        let extent = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max);
        let side = side.max(extent / MOST_CELLS).max(f64::MIN_POSITIVE);
        let cell = |f: &[u32; 3]| {
            let p = corner(f);
            (0..3).fold(0, |at, k| (at << 10) | ((p[k] - low[k]) / side + shift) as u32)
        };
        let mut cells: Vec<(u32, u32)> = self.faces.par_iter().enumerate().map(|(n, f)| (cell(f), n as u32)).collect();
        cells.par_sort_unstable();
        cells
    }

    fn take(&mut self, part: Collapsed) {
        for (v, position) in part.moved {
            self.vertices[v as usize] = position;
        }
        self.faces.extend(part.faces);
    }
}

/// What is left of a part, in the mesh's numbers, and the vertices that moved.
struct Collapsed {
    faces: Vec<[u32; 3]>,
    moved: Vec<(u32, [f64; 3])>,
}

/// Faces with vertices of their own, about their middle.
struct Part {
    points: Vec<[f32; 3]>,
    corners: Vec<u32>,
    /// The mesh's number of each vertex.
    number: Vec<u32>,
    middle: [f64; 3],
}

impl Part {
    fn of(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> Self {
        let mut number = faces.as_flattened().to_vec();
        number.par_sort_unstable();
        number.dedup();
        let find = |v: &u32| number.binary_search(v).unwrap_or_default() as u32;
        let corners = faces.as_flattened().par_iter().map(find).collect();
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for &v in &number {
            for (k, x) in vertices[v as usize].into_iter().enumerate() {
                (low[k], high[k]) = (low[k].min(x), high[k].max(x));
            }
        }
        let middle = std::array::from_fn(|k| 0.5 * (low[k] + high[k]));
        let about = |&v: &u32| std::array::from_fn(|k| (vertices[v as usize][k] - middle[k]) as f32);
        let points = number.par_iter().map(about).collect();
        Self { points, corners, number, middle }
    }

    fn collapsed(mut self, error: f64, most: usize, free: impl Fn(u32) -> bool) -> Collapsed {
        let lock = |&v: &u32| if free(v) { SimplifyVertex::None } else { SimplifyVertex::Lock };
        let locks: Vec<SimplifyVertex> = self.number.iter().map(lock).collect();
        let (before, options) = (self.points.clone(), SimplifyOptions::ErrorAbsolute);
        let bound = error.min(f64::from(f32::MAX)) as f32;
        let (corners, points) = (&mut self.corners, &mut self.points);
        let left = simplify_with_update(corners, points, &mut [], &[], 0, Some(&locks), 3 * most, bound, options, None);
        let faces: Vec<[u32; 3]> = self.corners[..left].as_chunks().0.to_vec();
        let mut used = vec![false; before.len()];
        faces.as_flattened().iter().for_each(|&v| used[v as usize] = true);
        let world = |p: [f32; 3]| std::array::from_fn(|k| self.middle[k] + f64::from(p[k]));
        // What did not move keeps its last digits.
        let moved = (0..before.len()).filter(|&v| used[v] && before[v] != self.points[v]);
        let moved = moved.map(|v| (self.number[v], world(self.points[v]))).collect();
        Collapsed { faces: faces.into_iter().map(|f| f.map(|v| self.number[v as usize])).collect(), moved }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of n x n cells of size 1 with a crease along its middle.
    fn roof(n: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let height = |x: u32| f64::from(x.min(n - x));
        let at = |i: u32| [f64::from(i / (n + 1)), f64::from(i % (n + 1)), height(i / (n + 1))];
        let vertices = (0..(n + 1) * (n + 1)).map(at).collect();
        let corner = |x, y| x * (n + 1) + y;
        let cell = |(x, y): (u32, u32)| {
            let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x + 1, y + 1), corner(x, y + 1)];
            [[a, b, c], [a, c, d]]
        };
        let cells = (0..n).flat_map(|x| (0..n).map(move |y| (x, y)));
        (vertices, cells.flat_map(cell).collect())
    }

    fn area(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> f64 {
        let mesh = Mesh::new(vertices, faces).unwrap();
        (0..faces.len()).map(|f| 0.5 * mesh.normal(f).iter().map(|x| x * x).sum::<f64>().sqrt()).sum()
    }

    #[test]
    fn planes_lose_their_inner_vertices_and_keep_crease_and_corners() {
        let n = 400;
        let (vertices, faces) = roof(n);
        let left = decimate(Mesh::new(&vertices, &faces).unwrap(), 0.3, usize::MAX, false).unwrap();
        assert!(left.faces.len() < 300, "{} faces", left.faces.len());
        let whole = f64::from(n) * f64::from(n) * 2f64.sqrt();
        assert!((area(&left.vertices, &left.faces) / whole - 1.0).abs() < 1e-4);
    }

    #[test]
    fn borders_are_kept_to_be_joined_later() {
        let n = 60;
        let (vertices, faces) = roof(n);
        let left = decimate(Mesh::new(&vertices, &faces).unwrap(), 0.3, usize::MAX, true).unwrap();
        assert!(left.faces.len() < faces.len() / 5);
        let mut used = vec![false; vertices.len()];
        left.faces.as_flattened().iter().for_each(|&v| used[v as usize] = true);
        let end = f64::from(n);
        for (v, p) in
            vertices.iter().enumerate().filter(|(_, p)| [0.0, end].contains(&p[0]) || [0.0, end].contains(&p[1]))
        {
            assert!(used[v] && left.vertices[v] == *p);
        }
    }

    #[test]
    fn a_face_count_is_kept_to_whatever_it_costs() {
        let (vertices, faces) = roof(20);
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        assert_eq!(decimate(mesh, 0.0, usize::MAX, false).unwrap().faces, faces);
        let left = decimate(mesh, 0.0, 100, false).unwrap().faces;
        assert!(left.len() <= 100 && left.len() > 20, "{} faces", left.len());
    }

    #[test]
    fn bad_errors_are_refused_and_nothing_stays_nothing() {
        assert!(decimate(Mesh::new(&[], &[]).unwrap(), 1.0, 10, true).unwrap().faces.is_empty());
        assert!(
            decimate(Mesh::new(&[], &[]).unwrap(), f64::NAN, 10, true).unwrap_err().to_string().starts_with("error:")
        );
    }
}
