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
use crate::grid::{BLOCK, BlockMap, Grid, NONE, SIDE, Tile};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
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
    let tile = Tile::whole(&grid);
    let map = BlockMap::from_flags(tile, std::iter::repeat_n(true, tile.count()));
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
    /// The bits of all blocks of the map.
    fn bits(&self, map: &BlockMap) -> Vec<Bits>;
}

struct Sparse<'a> {
    values: &'a [f32],
}

impl Samples for Sparse<'_> {
    #[inline(always)]
    fn get(&self, slot: usize, _: [u32; 3], l: [usize; 3]) -> f32 {
        self.values[slot * BLOCK + (l[0] * SIDE + l[1]) * SIDE + l[2]]
    }

    fn bits(&self, map: &BlockMap) -> Vec<Bits> {
        let mut bits = zeroed::<Bits>(map.coords.len());
        bits.par_iter_mut().zip(self.values.par_chunks_exact(BLOCK)).for_each(|(out, values)| {
            for (row, v) in values.chunks_exact(SIDE).enumerate() {
                row_bits(v, row, std::slice::from_mut(out));
            }
        });
        bits
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

    /// A task reads the 8 x 8 whole rows of a line of blocks: memory is read in order.
    fn bits(&self, map: &BlockMap) -> Vec<Bits> {
        let [nx, ny, nz] = self.shape;
        let mut bits = zeroed::<Bits>(map.coords.len());
        let [_, y, z] = map.tile.dims();
        let interrupt = Interrupt::current();
        bits.par_chunks_exact_mut(z).enumerate().for_each(|(line, out)| {
            interrupt.poll();
            let (i0, j0) = (line / y * SIDE, line % y * SIDE);
            for i in i0..nx.min(i0 + SIDE) {
                for j in j0..ny.min(j0 + SIDE) {
                    row_bits(&self.values[(i * ny + j) * nz..][..nz], (i - i0) * SIDE + j - j0, out);
                }
            }
        });
        bits
    }
}

/// Puts the signs and validity of row (i, j) = `row` into the line of blocks it runs through.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2", "x86_64+avx2", "aarch64+neon"))]
fn row_bits(values: &[f32], row: usize, blocks: &mut [Bits]) {
    let (slice, shift) = (row / SIDE, row % SIDE * SIDE);
    let (whole, rest) = values.as_chunks::<SIDE>();
    for (v, block) in whole.iter().zip(&mut *blocks) {
        let (mut sign, mut valid) = (0u8, 0u8);
        for k in 0..SIDE {
            sign |= u8::from(v[k] < 0.0) << k;
            valid |= u8::from(!v[k].is_nan()) << k;
        }
        block.add(slice, shift, sign, valid);
    }
    if !rest.is_empty() {
        let bits = |test: fn(f32) -> bool| rest.iter().enumerate().map(|(k, &v)| u8::from(test(v)) << k).sum::<u8>();
        blocks[whole.len()].add(slice, shift, bits(|v| v < 0.0), bits(|v| !v.is_nan()));
    }
}

/// The samples of a block as bits, one word a slice.
#[derive(Clone, Copy, Default)]
struct Bits {
    sign: [u64; SIDE],
    valid: [u64; SIDE],
}

impl Bits {
    #[inline(always)]
    fn add(&mut self, slice: usize, shift: usize, sign: u8, valid: u8) {
        self.sign[slice] |= u64::from(sign) << shift;
        self.valid[slice] |= u64::from(valid) << shift;
    }

    /// Bit 0: a negative sample; bit 1: another known one.
    fn kinds(&self) -> u8 {
        let negative = self.sign.iter().any(|&w| w != 0);
        let other = self.sign.iter().zip(&self.valid).any(|(s, v)| s != v);
        u8::from(negative) | u8::from(other) << 1
    }
}

/// The crossed edges of a block near the surface, and the numbers of its vertices and faces.
#[derive(Clone, Copy, Default)]
struct Crossings {
    slot: u32,
    /// Crossed edges along x, y, z that start in this block, one word a slice.
    crossed: [[u64; SIDE]; 3],
    /// Vertices of this block before each axis and slice.
    rank: [[u16; SIDE]; 3],
    /// Number of the block's first vertex, and of its first face; while counting, how many there are.
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
    fn new(around: &[Option<&Bits>; 8], i: usize, pick: impl Fn(&Bits) -> &[u64; SIDE]) -> Self {
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

/// The volume's blocks as bits, and those near the surface with their crossings.
struct Field<'a> {
    map: &'a BlockMap,
    bits: Vec<Bits>,
    active: Vec<Crossings>,
    /// Place in `active` of each slot, or [`NONE`].
    number: Vec<u32>,
}

impl Field<'_> {
    /// Slots of the 2x2x2 blocks from `at` on: index 4·di + 2·dj + dk.
    fn around(&self, at: [u32; 3]) -> [u32; 8] {
        std::array::from_fn(|n| {
            self.map.at(at[0] as usize + (n >> 2), at[1] as usize + (n >> 1 & 1), at[2] as usize + (n & 1))
        })
    }

    fn bits(&self, slots: [u32; 8]) -> [Option<&Bits>; 8] {
        slots.map(|s| self.bits.get(s as usize))
    }

    fn crossings(&self, slots: [u32; 8]) -> [Option<&Crossings>; 8] {
        slots.map(|s| self.number.get(s as usize).and_then(|&n| self.active.get(n as usize)))
    }
}

fn extract<S: Samples>(map: &BlockMap, samples: &S) -> Surface {
    let bits = samples.bits(map);
    let kinds: Vec<u8> = bits.par_iter().map(Bits::kinds).collect();
    let partial = bits.par_iter().any(|b| b.valid != [!0; SIDE]);
    let mut field = Field { map, bits, active: Vec::new(), number: zeroed(map.coords.len()) };
    let interrupt = Interrupt::current();
    let found: Vec<Vec<Crossings>> = map
        .coords
        .par_chunks(TASK)
        .enumerate()
        .map(|(task, coords)| {
            interrupt.poll();
            let near = |(n, &at): (usize, &[u32; 3])| {
                let slots = field.around(at);
                let mixed = slots.iter().filter_map(|&s| kinds.get(s as usize)).fold(0, |a, b| a | b) == 3;
                mixed.then(|| count((task * TASK + n) as u32, &field.bits(slots)))
            };
            coords.iter().enumerate().filter_map(near).collect()
        })
        .collect();
    field.active = found.concat();
    field.number.fill(NONE);
    let (mut vertices, mut faces) = (0u32, 0u32);
    for (n, block) in field.active.iter_mut().enumerate() {
        field.number[block.slot as usize] = n as u32;
        let (v, f) = (block.vertex, block.face);
        (block.vertex, block.face) = (vertices, faces);
        vertices += v;
        faces += f;
    }
    let mut out = Surface { vertices: zeroed(vertices as usize), faces: zeroed(faces as usize) };
    emit(&field, samples, &mut out);
    if partial { without_orphans(out) } else { out }
}

/// The crossed edges and ranks of the block in `slot`, with its numbers of vertices and faces.
fn count(slot: u32, around: &[Option<&Bits>; 8]) -> Crossings {
    let mut block = Crossings { slot, ..Crossings::default() };
    for i in 0..SIDE {
        let (sign, valid) = (Corners::new(around, i, |b| &b.sign), Corners::new(around, i, |b| &b.valid));
        for (axis, corner) in [(0, 4), (1, 2), (2, 1)] {
            block.crossed[axis][i] = (sign.0[0] ^ sign.0[corner]) & valid.0[0] & valid.0[corner];
        }
        let mut cells = cut_cells(&sign, &valid);
        while cells != 0 {
            block.face += TRIANGLES[case_of(&sign, cells.trailing_zeros())].len() as u32;
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
    block.vertex = u32::from(rank);
    block
}

fn cut_cells(sign: &Corners, valid: &Corners) -> u64 {
    valid.all() & sign.any() & !sign.all()
}

fn case_of(sign: &Corners, bit: u32) -> usize {
    (0..8).map(|c| ((sign.0[c] >> bit & 1) as usize) << c).sum()
}

fn emit<S: Samples>(field: &Field, samples: &S, out: &mut Surface) {
    let (mut vertices, mut faces) = (&mut out.vertices[..], &mut out.faces[..]);
    let (all_vertices, all_faces) = (vertices.len(), faces.len());
    let mut tasks = Vec::new();
    for blocks in field.active.chunks(TASK) {
        let first = &blocks[0];
        let next = field.number[first.slot as usize] as usize + blocks.len();
        let (end_v, end_f) =
            field.active.get(next).map_or((all_vertices, all_faces), |b| (b.vertex as usize, b.face as usize));
        let (v, f);
        (v, vertices) = vertices.split_at_mut(end_v - first.vertex as usize);
        (f, faces) = faces.split_at_mut(end_f - first.face as usize);
        tasks.push((blocks, v, f));
    }
    let interrupt = Interrupt::current();
    tasks.into_par_iter().for_each(|(blocks, v, f)| {
        interrupt.poll();
        let (mut v, mut f) = (v.iter_mut(), f.iter_mut());
        for block in blocks {
            let slots = field.around(field.map.coords[block.slot as usize]);
            emit_vertices(field.map, block, samples, &mut v);
            emit_faces(&field.bits(slots), &field.crossings(slots), &mut f);
        }
    });
}

fn emit_vertices<'a, S: Samples>(
    map: &BlockMap,
    block: &Crossings,
    samples: &S,
    out: &mut impl Iterator<Item = &'a mut [f32; 3]>,
) {
    let slot = block.slot as usize;
    let at = map.coords[slot];
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

fn emit_faces<'a>(
    bits: &[Option<&Bits>; 8],
    around: &[Option<&Crossings>; 8],
    out: &mut impl Iterator<Item = &'a mut [u32; 3]>,
) {
    for i in 0..SIDE {
        let (sign, valid) = (Corners::new(bits, i, |b| &b.sign), Corners::new(bits, i, |b| &b.valid));
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
fn vertex_number(around: &[Option<&Crossings>; 8], cell: [usize; 3], edge: usize) -> u32 {
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
        let all = BlockMap::from_flags(Tile { low: [0; 3], high: [3; 3] }, std::iter::repeat_n(true, 27));
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
        let some = BlockMap::from_flags(Tile { low: [0; 3], high: [3; 3] }, (0..27).map(|b| b != 13));
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
