//! Colour levelling: smooth corrections inside charts that make them meet along their seams.
//!
//! ```text
//!   chart a │ chart b        minimise  Σ_seam (x_a - x_b - jump)²  +  smoothness · Σ_lattice (x_i - x_j)²  +  anchor · Σ x²
//!     ┼──┼──│──┼──┼          a correction is bilinear between the nodes of a lattice of STEP pixels on each chart
//! ```
//!
//! Corrections vary slowly, so a lattice far coarser than the mesh carries them: a hundredth of the unknowns of one a vertex. Lempitsky and
//! Ivanov, CVPR 2007. Sums run in a fixed order: the same bytes for any number of threads.

use crate::interrupt::Interrupt;
use rayon::prelude::*;

/// Pixels between the nodes.
const STEP: f64 = 8.0;
/// Pull of neighbouring nodes towards each other, relative to a seam vertex's pull.
const SMOOTHNESS: f64 = 0.1;
/// Pull of corrections towards zero, a node: fixes the overall brightness.
const ANCHOR: f64 = 0.03;
const MOST_ITERATIONS: usize = 100;

/// Corrections at vertices: `part` is each vertex's chart, `pixel` its place in the chart's image; a seam (a, b, jump) asks that correction
/// a minus correction b be the jump.
pub fn level(part: &[u32], pixel: &[[f64; 2]], seams: &[(u32, u32, [f32; 3])]) -> Vec<[f32; 3]> {
    let lattice = Lattice::new(part, pixel);
    let place = |v: u32| lattice.place(part[v as usize], pixel[v as usize]);
    let seams: Vec<Seam> = seams.iter().map(|&(a, b, jump)| (place(a), place(b), jump.map(f64::from))).collect();
    let x = lattice.solve(&seams);
    let value = |(&part, &pixel): (&u32, &[f64; 2])| lattice.place(part, pixel).value(&x).map(|c| c as f32);
    part.par_iter().zip(pixel).map(value).collect()
}

/// Two places of a vertex and the jump between them.
type Seam = (Place, Place, [f64; 3]);

/// A vertex between four nodes.
struct Place {
    node: [u32; 4],
    weight: [f64; 4],
}

impl Place {
    fn value(&self, x: &[[f64; 3]]) -> [f64; 3] {
        std::array::from_fn(|c| (0..4).map(|n| self.weight[n] * x[self.node[n] as usize][c]).sum())
    }
}

/// Chart, column and row.
type Cell = (u32, i32, i32);

struct Lattice {
    /// Ascending.
    cells: Vec<Cell>,
    /// The nodes at the corners of each cell.
    corners: Vec<[u32; 4]>,
    /// Neighbouring nodes, each pair once.
    links: Vec<(u32, u32)>,
    count: usize,
}

impl Lattice {
    fn new(part: &[u32], pixel: &[[f64; 2]]) -> Self {
        let around = |(p, x, y): Cell| [(p, x, y), (p, x + 1, y), (p, x, y + 1), (p, x + 1, y + 1)];
        let mut cells: Vec<Cell> = part.par_iter().zip(pixel).map(|(&p, &q)| cell(p, q)).collect();
        cells.par_sort_unstable();
        cells.dedup();
        let mut nodes: Vec<Cell> = cells.iter().flat_map(|&c| around(c)).collect();
        nodes.par_sort_unstable();
        nodes.dedup();
        let number = |node: &Cell| nodes.binary_search(node).map_or(0, |n| n as u32);
        let corners: Vec<[u32; 4]> = cells.par_iter().map(|&c| around(c).each_ref().map(number)).collect();
        let mut links: Vec<(u32, u32)> =
            corners.iter().flat_map(|n| [(n[0], n[1]), (n[2], n[3]), (n[0], n[2]), (n[1], n[3])]).collect();
        links.par_sort_unstable();
        links.dedup();
        Self { cells, corners, links, count: nodes.len() }
    }

    fn place(&self, part: u32, pixel: [f64; 2]) -> Place {
        let cell = cell(part, pixel);
        let node = self.cells.binary_search(&cell).map_or([0; 4], |n| self.corners[n]);
        let (a, b) = (pixel[0] / STEP - f64::from(cell.1), pixel[1] / STEP - f64::from(cell.2));
        Place { node, weight: [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b] }
    }

    /// Conjugate gradients with a diagonal preconditioner, three channels at once.
    fn solve(&self, seams: &[Seam]) -> Vec<[f64; 3]> {
        let n = self.count;
        let (mut diagonal, mut r) = (vec![ANCHOR; n], vec![[0.0; 3]; n]);
        for &(i, j) in &self.links {
            diagonal[i as usize] += SMOOTHNESS;
            diagonal[j as usize] += SMOOTHNESS;
        }
        for (a, b, jump) in seams {
            for (place, sign) in [(a, 1.0), (b, -1.0)] {
                for (&i, w) in place.node.iter().zip(place.weight) {
                    diagonal[i as usize] += w * w;
                    (0..3).for_each(|c| r[i as usize][c] += sign * w * jump[c]);
                }
            }
        }
        let apply = |x: &[[f64; 3]]| {
            let mut y: Vec<[f64; 3]> = x.iter().map(|x| x.map(|v| ANCHOR * v)).collect();
            for &(i, j) in &self.links {
                let (i, j) = (i as usize, j as usize);
                for c in 0..3 {
                    let pull = SMOOTHNESS * (x[i][c] - x[j][c]);
                    y[i][c] += pull;
                    y[j][c] -= pull;
                }
            }
            for (pa, pb, _) in seams {
                let (va, vb) = (pa.value(x), pb.value(x));
                let gap: [f64; 3] = std::array::from_fn(|c| va[c] - vb[c]);
                for k in 0..4 {
                    for c in 0..3 {
                        y[pa.node[k] as usize][c] += pa.weight[k] * gap[c];
                        y[pb.node[k] as usize][c] -= pb.weight[k] * gap[c];
                    }
                }
            }
            y
        };
        let dot = |a: &[[f64; 3]], b: &[[f64; 3]]| {
            let mut s = [0.0; 3];
            a.iter().zip(b).for_each(|(p, q)| (0..3).for_each(|c| s[c] += p[c] * q[c]));
            s
        };
        let precondition =
            |r: &[[f64; 3]]| -> Vec<[f64; 3]> { r.iter().zip(&diagonal).map(|(r, d)| r.map(|v| v / d)).collect() };
        let mut x = vec![[0.0; 3]; n];
        let mut z = precondition(&r);
        let mut p = z.clone();
        let mut rz = dot(&r, &z);
        let goal = rz.map(|v| v * 1e-6 + 1e-30);
        let interrupt = Interrupt::current();
        for _ in 0..MOST_ITERATIONS {
            interrupt.poll();
            if (0..3).all(|c| rz[c] <= goal[c]) {
                break;
            }
            let q = apply(&p);
            let pq = dot(&p, &q);
            let alpha: [f64; 3] = std::array::from_fn(|c| if pq[c] > 0.0 { rz[c] / pq[c] } else { 0.0 });
            for i in 0..n {
                for c in 0..3 {
                    x[i][c] += alpha[c] * p[i][c];
                    r[i][c] -= alpha[c] * q[i][c];
                }
            }
            z = precondition(&r);
            let next = dot(&r, &z);
            let beta: [f64; 3] = std::array::from_fn(|c| if rz[c] > 0.0 { next[c] / rz[c] } else { 0.0 });
            p.iter_mut().zip(&z).for_each(|(p, z)| (0..3).for_each(|c| p[c] = z[c] + beta[c] * p[c]));
            rz = next;
        }
        x
    }
}

fn cell(part: u32, pixel: [f64; 2]) -> Cell {
    let [x, y] = pixel.map(|p| (p / STEP).floor() as i32);
    (part, x, y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_charts_meet_half_way() {
        // Two charts of 40 x 40 pixels share 40 vertices along an edge; one is 20 grey levels brighter.
        let (mut part, mut pixel, mut seams) = (Vec::new(), Vec::new(), Vec::new());
        for chart in 0..2u32 {
            for n in 0..1600 {
                part.push(chart);
                pixel.push([f64::from(n % 40), f64::from(n / 40)]);
            }
        }
        for y in 0..40u32 {
            seams.push((y * 40 + 39, 1600 + y * 40, [20.0, -8.0, 0.0]));
        }
        let x = level(&part, &pixel, &seams);
        for &(a, b, jump) in &seams {
            for c in 0..3 {
                // The anchor, which keeps photographs near their own brightness, holds back about a tenth of so large a jump.
                let gap = x[a as usize][c] - x[b as usize][c];
                assert!((gap - jump[c]).abs() < 0.2 * jump[c].abs() + 1e-9, "{gap} {}", jump[c]);
            }
            assert!((x[a as usize][0] - 10.0).abs() < 2.0);
        }
        // Far from the seam it is still smooth.
        assert!((x[0][0] - x[39][0]).abs() < 10.5);
    }

    #[test]
    fn without_seams_nothing_changes() {
        assert_eq!(level(&[0, 0], &[[0.0, 0.0], [30.0, 5.0]], &[]), [[0.0; 3]; 2]);
        assert!(level(&[], &[], &[]).is_empty());
    }
}
