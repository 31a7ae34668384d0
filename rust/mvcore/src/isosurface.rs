//! Marching Cubes over dense and block-sparse volumes: the surface between negative (inside) and other samples.
//!
//! ```text
//!   a block's samples as bits, one word a slice:   signs  ──shift, xor──► crossed edges ──popcount──► vertex numbers
//!                                                  valid  ──shift, and──► cells with eight known corners
//! ```
//!
//! The word logic decides where work is (after Schroeder et al., Flying Edges, LDAV 2015); only crossed edges and cut cells are
//! touched one by one. Each vertex is made once, by the block that owns the lower end of its edge; its number is a prefix
//! sum, so the same bytes come out for any thread count, and blocks share vertices without a crack. NaN samples are unknown:
//! a cell with one has no surface. A vertex keeps a thousandth of a voxel from its edge's ends, so that a field of exact
//! zeros on samples makes no triangle of zero area.

use crate::cube::{EDGES, TRIANGLES};
use crate::error::Result;
use crate::grid::{BLOCK, BlockMap, Grid, NONE, SIDE};
use multiversion::multiversion;
use rayon::prelude::*;

/// Vertices (sample coordinates: multiply by the voxel and add the origin) and counter-clockwise triangles.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// Positions in units of samples.
    pub vertices: Vec<[f32; 3]>,
    /// Triples of vertex numbers, counter-clockwise from outside (the non-negative side).
    pub faces: Vec<[u32; 3]>,
}

/// How near a vertex may come to a sample, in voxels.
const MARGIN: f32 = 1.0 / 1024.0;
/// Blocks a task takes at a time.
const TASK: usize = 64;

/// The isosurface at 0 of a dense volume `values[(i * ny + j) * nz + k]`.
pub fn isosurface_dense(values: &[f32], shape: [usize; 3]) -> Result<Surface> {
    let grid = Grid::new([0.0; 3], 1.0, shape)?;
    crate::error::require(
        values.len() == shape.iter().product::<usize>(),
        "values",
        format!("{} samples", shape.iter().product::<usize>()),
        values.len(),
    )?;
    let dims = grid.blocks();
    let map = BlockMap::from_flags(dims, std::iter::repeat_n(true, dims.iter().product()));
    Ok(extract(&map, &Dense { values, shape }))
}

/// The isosurface at 0 of a block-sparse volume of `BLOCK` samples a block.
pub fn isosurface_sparse(map: &BlockMap, values: &[f32]) -> Result<Surface> {
    let expected = map.coords.len() * BLOCK;
    crate::error::require(values.len() == expected, "values", format!("{expected} samples"), values.len())?;
    Ok(extract(map, &Sparse { values }))
}

/// Where a block's samples come from.
trait Samples: Sync {
    /// Sample (i, j, k) of the block, all below [`SIDE`].
    fn get(&self, slot: usize, at: [u32; 3], local: [usize; 3]) -> f32;
    /// Signs (1: negative) and validity (1: not NaN), one word a slice, bit j·8 + k.
    fn words(&self, slot: usize, at: [u32; 3]) -> ([u64; SIDE], [u64; SIDE]);
}

struct Sparse<'a> {
    values: &'a [f32],
}

impl Samples for Sparse<'_> {
    #[inline(always)]
    fn get(&self, slot: usize, _: [u32; 3], l: [usize; 3]) -> f32 {
        self.values[slot * BLOCK + (l[0] * SIDE + l[1]) * SIDE + l[2]]
    }

    fn words(&self, slot: usize, _: [u32; 3]) -> ([u64; SIDE], [u64; SIDE]) {
        let (mut sign, mut valid) = ([0; SIDE], [0; SIDE]);
        for (row, v) in self.values[slot * BLOCK..][..BLOCK].as_chunks::<SIDE>().0.iter().enumerate() {
            let (s, ok) = row_bits(v);
            sign[row / SIDE] |= s << (row % SIDE * SIDE);
            valid[row / SIDE] |= ok << (row % SIDE * SIDE);
        }
        (sign, valid)
    }
}

struct Dense<'a> {
    values: &'a [f32],
    shape: [usize; 3],
}

impl Samples for Dense<'_> {
    #[inline(always)]
    fn get(&self, _: usize, at: [u32; 3], l: [usize; 3]) -> f32 {
        let p: [usize; 3] = std::array::from_fn(|a| at[a] as usize * SIDE + l[a]);
        self.values[(p[0] * self.shape[1] + p[1]) * self.shape[2] + p[2]]
    }

    fn words(&self, _: usize, at: [u32; 3]) -> ([u64; SIDE], [u64; SIDE]) {
        let (mut sign, mut valid) = ([0; SIDE], [0; SIDE]);
        let base = at.map(|a| a as usize * SIDE);
        let n = SIDE.min(self.shape[2] - base[2]);
        for i in 0..SIDE.min(self.shape[0] - base[0]) {
            for j in 0..SIDE.min(self.shape[1] - base[1]) {
                let start = ((base[0] + i) * self.shape[1] + base[1] + j) * self.shape[2] + base[2];
                let mut row = [f32::NAN; SIDE];
                row[..n].copy_from_slice(&self.values[start..start + n]);
                let (s, ok) = row_bits(&row);
                sign[i] |= s << (j * SIDE);
                valid[i] |= ok << (j * SIDE);
            }
        }
        (sign, valid)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2", "x86_64+avx2", "aarch64+neon"))]
fn row_bits(v: &[f32; SIDE]) -> (u64, u64) {
    let (mut sign, mut valid) = (0u8, 0u8);
    for k in 0..SIDE {
        sign |= u8::from(v[k] < 0.0) << k;
        valid |= u8::from(!v[k].is_nan()) << k;
    }
    (u64::from(sign), u64::from(valid))
}

/// The bits of a block and the numbers of its vertices.
#[derive(Clone, Copy, Default)]
struct Block {
    sign: [u64; SIDE],
    valid: [u64; SIDE],
    /// Crossed edges along x, y, z that start in this block, one word a slice.
    crossed: [[u64; SIDE]; 3],
    /// Vertices of this block before each axis and slice.
    rank: [[u16; SIDE]; 3],
    /// Number of the block's first vertex, and of its first face.
    vertex: u32,
    face: u32,
}

const LAST_K: u64 = 0x8080_8080_8080_8080;

/// The word whose bit (j, k) is bit (j, k+1); `over` is the block beyond.
fn shift_k(word: u64, over: u64) -> u64 {
    ((word >> 1) & !LAST_K) | ((over << 7) & LAST_K)
}

/// The word whose bit (j, k) is bit (j+1, k).
fn shift_j(word: u64, over: u64) -> u64 {
    (word >> 8) | (over << 56)
}

/// One kind of bits (signs or validity) of slice i of the 2x2x2 blocks from a block on.
struct Corners([u64; 8]);

impl Corners {
    fn new(around: &[Option<&Block>; 8], i: usize, pick: impl Fn(&Block) -> &[u64; SIDE]) -> Self {
        let word = |block: usize, slice: usize| {
            let (block, slice) = if slice == SIDE { (block | 4, 0) } else { (block, slice) };
            around[block].map_or(0, |b| pick(b)[slice])
        };
        let mut out = [0; 8];
        for di in 0..2 {
            let (here, k, j, jk) = (word(0, i + di), word(1, i + di), word(2, i + di), word(3, i + di));
            let next_k = shift_k(here, k);
            out[4 * di] = here;
            out[4 * di + 1] = next_k;
            out[4 * di + 2] = shift_j(here, j);
            out[4 * di + 3] = shift_j(next_k, shift_k(j, jk));
        }
        Self(out)
    }

    fn all(&self) -> u64 {
        self.0.iter().fold(!0, |a, b| a & b)
    }

    fn any(&self) -> u64 {
        self.0.iter().fold(0, |a, b| a | b)
    }
}

fn extract<S: Samples>(map: &BlockMap, samples: &S) -> Surface {
    let mut blocks: Vec<Block> = map
        .coords
        .par_iter()
        .enumerate()
        .map(|(slot, &at)| {
            let (sign, valid) = samples.words(slot, at);
            Block { sign, valid, ..Block::default() }
        })
        .collect();
    let counted: Vec<(Block, u32, u32)> = map.coords.par_iter().map(|&at| count(&around(map, &blocks, at))).collect();
    let (mut vertices, mut faces, mut partial) = (0u32, 0u32, false);
    for (block, (mut found, v, f)) in blocks.iter_mut().zip(counted) {
        (found.vertex, found.face) = (vertices, faces);
        partial |= found.valid.iter().any(|&w| w != !0);
        vertices += v;
        faces += f;
        *block = found;
    }
    let mut out = Surface { vertices: vec![[0.0; 3]; vertices as usize], faces: vec![[0; 3]; faces as usize] };
    emit(map, &blocks, samples, &mut out);
    if partial { without_orphans(out) } else { out }
}

/// The 2x2x2 blocks from `at` on: index 4·di + 2·dj + dk.
fn around<'a>(map: &BlockMap, blocks: &'a [Block], at: [u32; 3]) -> [Option<&'a Block>; 8] {
    std::array::from_fn(|n| {
        let slot = map.at(at[0] as usize + (n >> 2), at[1] as usize + (n >> 1 & 1), at[2] as usize + (n & 1));
        (slot != NONE).then(|| &blocks[slot as usize])
    })
}

/// Fills in a block's crossed edges and ranks; returns it with its numbers of vertices and faces.
fn count(around: &[Option<&Block>; 8]) -> (Block, u32, u32) {
    let mut block = around[0].copied().unwrap_or_default();
    let mut faces = 0;
    let quiet = around.iter().flatten().all(|b| b.sign.iter().all(|&w| w == 0))
        || around.iter().flatten().all(|b| (0..SIDE).all(|i| b.sign[i] == b.valid[i]));
    if quiet {
        return (block, 0, 0);
    }
    for i in 0..SIDE {
        let (sign, valid) = (Corners::new(around, i, |b| &b.sign), Corners::new(around, i, |b| &b.valid));
        for (axis, corner) in [(0, 4), (1, 2), (2, 1)] {
            block.crossed[axis][i] = (sign.0[0] ^ sign.0[corner]) & valid.0[0] & valid.0[corner];
        }
        let mut cells = cut_cells(&sign, &valid);
        while cells != 0 {
            faces += TRIANGLES[case_of(&sign, cells.trailing_zeros())].len() as u32;
            cells &= cells - 1;
        }
    }
    let mut rank = 0u16;
    for axis in 0..3 {
        for i in 0..SIDE {
            block.rank[axis][i] = rank;
            rank += block.crossed[axis][i].count_ones() as u16;
        }
    }
    (block, u32::from(rank), faces)
}

fn cut_cells(sign: &Corners, valid: &Corners) -> u64 {
    valid.all() & sign.any() & !sign.all()
}

fn case_of(sign: &Corners, bit: u32) -> usize {
    (0..8).map(|c| ((sign.0[c] >> bit & 1) as usize) << c).sum()
}

fn emit<S: Samples>(map: &BlockMap, blocks: &[Block], samples: &S, out: &mut Surface) {
    let (mut vertices, mut faces) = (&mut out.vertices[..], &mut out.faces[..]);
    let (all_vertices, all_faces) = (vertices.len(), faces.len());
    let mut tasks = Vec::new();
    for first in (0..blocks.len()).step_by(TASK) {
        let end = (first + TASK).min(blocks.len());
        let last = |of: fn(&Block) -> u32, all| if end < blocks.len() { of(&blocks[end]) as usize } else { all };
        let (nv, nf) = (
            last(|b| b.vertex, all_vertices) - blocks[first].vertex as usize,
            last(|b| b.face, all_faces) - blocks[first].face as usize,
        );
        let (v, f);
        (v, vertices) = vertices.split_at_mut(nv);
        (f, faces) = faces.split_at_mut(nf);
        if nv + nf > 0 {
            tasks.push((first..end, v, f));
        }
    }
    tasks.into_par_iter().for_each(|(range, v, f)| {
        let (mut v, mut f) = (v.iter_mut(), f.iter_mut());
        for slot in range {
            let at = map.coords[slot];
            emit_vertices(map, &blocks[slot], samples, slot, at, &mut v);
            emit_faces(&around(map, blocks, at), &mut f);
        }
    });
}

fn emit_vertices<'a, S: Samples>(
    map: &BlockMap,
    block: &Block,
    samples: &S,
    slot: usize,
    at: [u32; 3],
    out: &mut impl Iterator<Item = &'a mut [f32; 3]>,
) {
    for axis in 0..3 {
        for i in 0..SIDE {
            let mut word = block.crossed[axis][i];
            while word != 0 {
                let bit = word.trailing_zeros() as usize;
                word &= word - 1;
                let local = [i, bit / SIDE, bit % SIDE];
                let from = samples.get(slot, at, local);
                let (mut beyond, mut block_at) = (local, at);
                beyond[axis] += 1;
                if beyond[axis] == SIDE {
                    beyond[axis] = 0;
                    block_at[axis] += 1;
                }
                let next = if block_at == at {
                    slot
                } else {
                    map.at(block_at[0] as usize, block_at[1] as usize, block_at[2] as usize) as usize
                };
                let to = samples.get(next, block_at, beyond);
                let mut p: [f32; 3] = std::array::from_fn(|a| (at[a] as usize * SIDE + local[a]) as f32);
                p[axis] += (from / (from - to)).clamp(MARGIN, 1.0 - MARGIN);
                if let Some(v) = out.next() {
                    *v = p;
                }
            }
        }
    }
}

fn emit_faces<'a>(around: &[Option<&Block>; 8], out: &mut impl Iterator<Item = &'a mut [u32; 3]>) {
    for i in 0..SIDE {
        let (sign, valid) = (Corners::new(around, i, |b| &b.sign), Corners::new(around, i, |b| &b.valid));
        let mut cells = cut_cells(&sign, &valid);
        while cells != 0 {
            let bit = cells.trailing_zeros();
            cells &= cells - 1;
            let local = [i, bit as usize / SIDE, bit as usize % SIDE];
            for triangle in &TRIANGLES[case_of(&sign, bit)] {
                if let Some(f) = out.next() {
                    *f = triangle.map(|edge| vertex_number(around, local, edge as usize));
                }
            }
        }
    }
}

/// Number of the vertex on an edge of a cell, made by the block that owns the edge's lower corner.
#[inline(always)]
fn vertex_number(around: &[Option<&Block>; 8], cell: [usize; 3], edge: usize) -> u32 {
    let corner = EDGES[edge].0;
    let mut owner = 0;
    let mut p = cell;
    for axis in 0..3 {
        p[axis] += corner >> (2 - axis) & 1;
        if p[axis] == SIDE {
            p[axis] = 0;
            owner |= 4 >> axis;
        }
    }
    let axis = edge / 4;
    let below = (1u64 << (p[1] * SIDE + p[2])) - 1;
    around[owner].map_or(0, |block| {
        block.vertex + u32::from(block.rank[axis][p[0]]) + (block.crossed[axis][p[0]] & below).count_ones()
    })
}

/// Drops vertices that no face uses (crossed edges whose cells all have an unknown corner).
fn without_orphans(surface: Surface) -> Surface {
    let mut number = vec![0u32; surface.vertices.len()];
    for face in &surface.faces {
        for &v in face {
            number[v as usize] = 1;
        }
    }
    let mut vertices = Vec::with_capacity(surface.vertices.len());
    for (n, v) in number.iter_mut().zip(&surface.vertices) {
        if *n == 1 {
            *n = vertices.len() as u32;
            vertices.push(*v);
        }
    }
    let faces = surface.faces.par_iter().map(|f| f.map(|v| number[v as usize])).collect();
    Surface { vertices, faces }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashMap;

    fn sphere(n: usize, radius: f32) -> Vec<f32> {
        let c = (n - 1) as f32 / 2.0;
        (0..n * n * n)
            .map(|p| {
                let d = [p / (n * n), p / n % n, p % n].map(|v| v as f32 - c);
                (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt() - radius
            })
            .collect()
    }

    fn directed_edges(s: &Surface) -> HashMap<(u32, u32), usize> {
        let mut edges = HashMap::new();
        for f in &s.faces {
            for (a, b) in [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])] {
                *edges.entry((a, b)).or_insert(0) += 1;
            }
        }
        edges
    }

    fn closed(s: &Surface) -> bool {
        let edges = directed_edges(s);
        edges.iter().all(|(&(a, b), &n)| edges.get(&(b, a)) == Some(&n))
    }

    fn area_and_volume(s: &Surface) -> (f64, f64, f64) {
        let (mut area, mut volume, mut least) = (0.0, 0.0, f64::MAX);
        for f in &s.faces {
            let [a, b, c] = f.map(|v| s.vertices[v as usize].map(f64::from));
            let (u, v): ([f64; 3], [f64; 3]) =
                (std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
            let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            let twice = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
            area += twice / 2.0;
            least = least.min(twice / 2.0);
            volume += (a[0] * n[0] + a[1] * n[1] + a[2] * n[2]) / 6.0;
        }
        (area, volume, least)
    }

    #[test]
    fn a_sphere_is_closed_oriented_and_of_the_right_size() {
        let s = isosurface_dense(&sphere(45, 17.3), [45; 3]).unwrap();
        assert!(closed(&s));
        let (area, volume, least) = area_and_volume(&s);
        let pi = std::f64::consts::PI;
        assert!((area / (4.0 * pi * 17.3f64.powi(2)) - 1.0).abs() < 0.005);
        assert!((volume / (4.0 / 3.0 * pi * 17.3f64.powi(3)) - 1.0).abs() < 0.005);
        assert!(least > 0.0);
        // Euler: V - E + F = 2
        assert_eq!(s.vertices.len() as i64 - s.faces.len() as i64 / 2, 2);
    }

    #[test]
    fn exact_zeros_on_samples_make_no_empty_triangle() {
        let n = 33;
        let octahedron: Vec<f32> = (0..n * n * n)
            .map(|p: usize| [p / (n * n), p / n % n, p % n].map(|v| (v as f32 - 16.0).abs()).iter().sum::<f32>() - 9.0)
            .collect();
        let s = isosurface_dense(&octahedron, [n; 3]).unwrap();
        assert!(closed(&s));
        assert!(area_and_volume(&s).2 > 0.0);
    }

    #[test]
    fn sparse_equals_dense_and_unknown_cells_have_no_surface() {
        let n = 24;
        let dense = sphere(n, 7.1);
        let all = BlockMap::from_flags([3; 3], std::iter::repeat_n(true, 27));
        let blocked = |map: &BlockMap| -> Vec<f32> {
            map.coords
                .iter()
                .flat_map(|c| {
                    let c = c.map(|v| v as usize * SIDE);
                    let dense = &dense;
                    (0..BLOCK).map(move |m| dense[((c[0] + m / 64) * n + c[1] + m / 8 % 8) * n + c[2] + m % 8])
                })
                .collect()
        };
        let whole = isosurface_sparse(&all, &blocked(&all)).unwrap();
        assert_eq!(whole, isosurface_dense(&dense, [n; 3]).unwrap());
        let some = BlockMap::from_flags([3; 3], (0..27).map(|b| b != 13));
        let open = isosurface_sparse(&some, &blocked(&some)).unwrap();
        assert!(open.faces.len() < whole.faces.len());
        assert!(directed_edges(&open).values().all(|&n| n == 1));
        let used: std::collections::HashSet<u32> = open.faces.iter().flatten().copied().collect();
        assert_eq!(used.len(), open.vertices.len());
    }

    proptest! {
        #[test]
        fn any_field_with_a_positive_border_is_closed(seed in any::<u64>(), n in 4usize..20) {
            let mut state = seed | 1;
            let field: Vec<f32> = (0..n * n * n).map(|p| {
                state ^= state << 13; state ^= state >> 7; state ^= state << 17;
                let border = [p / (n * n), p / n % n, p % n].iter().any(|&v| v == 0 || v == n - 1);
                if border { 1.0 } else { ((state >> 40) as f32 / (1 << 23) as f32 - 1.0).clamp(-0.9, 0.9) }
            }).collect();
            let s = isosurface_dense(&field, [n; 3]).unwrap();
            prop_assert!(closed(&s));
            prop_assert!(directed_edges(&s).values().all(|&c| c == 1));
        }
    }

    #[test]
    fn an_empty_field_is_an_empty_surface() {
        assert_eq!(isosurface_dense(&[1.0; 27], [3; 3]).unwrap(), Surface::default());
        assert!(isosurface_dense(&[1.0; 26], [3; 3]).is_err());
    }
}
