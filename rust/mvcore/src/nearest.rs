//! The nearest of a set of points to each of another, and its distance, exactly, by a grid of cells.
//!
//! Cells hold a few points each; rings of cells around a query are searched until the next ring is farther than the best found.

use crate::error::{Result, require};
use rayon::prelude::*;

/// Points a cell holds on average.
const PER_CELL: f64 = 2.0;

/// For each of `points` the distance to the nearest of `others` (not empty), and its number; of several the lowest.
pub fn nearest(points: &[[f64; 3]], others: &[[f64; 3]]) -> Result<(Vec<f64>, Vec<i64>)> {
    require(!others.is_empty(), "others", "at least one point", "none")?;
    let finite = |p: &[[f64; 3]]| p.iter().flatten().all(|v| v.is_finite());
    require(finite(points) && finite(others), "points", "finite coordinates", "NaN or infinity")?;
    let cells = Cells::new(others);
    Ok(points.par_iter().map(|p| cells.nearest(p)).map(|(square, n)| (square.sqrt(), i64::from(n))).unzip())
}

struct Cells<'a> {
    points: &'a [[f64; 3]],
    low: [f64; 3],
    size: f64,
    dims: [i64; 3],
    /// Point numbers sorted by cell, and where each cell begins.
    order: Vec<u32>,
    start: Vec<u32>,
}

impl<'a> Cells<'a> {
    fn new(points: &'a [[f64; 3]]) -> Self {
        let (mut low, mut high) = ([f64::MAX; 3], [f64::MIN; 3]);
        for p in points {
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let extent: [f64; 3] = std::array::from_fn(|k| high[k] - low[k]);
        let longest = extent.iter().copied().fold(0.0, f64::max).max(1e-300);
        // Points lie on surfaces: cells of the size that a surface of this extent would need.
        let cells = (points.len() as f64 / PER_CELL).max(1.0);
        let size = (longest / cells.sqrt()).max(longest / 512.0);
        let dims = extent.map(|e| (e / size) as i64 + 1);
        let mut out = Self { points, low, size, dims, order: Vec::new(), start: Vec::new() };
        let total = dims.iter().product::<i64>() as usize;
        let cell: Vec<u32> = points.iter().map(|p| out.index(out.cell(p)) as u32).collect();
        let mut start = vec![0u32; total + 1];
        for &c in &cell {
            start[c as usize + 1] += 1;
        }
        for c in 0..total {
            start[c + 1] += start[c];
        }
        let (mut fill, mut order) = (start.clone(), vec![0u32; points.len()]);
        for (n, &c) in cell.iter().enumerate() {
            order[fill[c as usize] as usize] = n as u32;
            fill[c as usize] += 1;
        }
        (out.order, out.start) = (order, start);
        out
    }

    fn cell(&self, p: &[f64; 3]) -> [i64; 3] {
        std::array::from_fn(|k| (((p[k] - self.low[k]) / self.size).floor() as i64).clamp(0, self.dims[k] - 1))
    }

    fn index(&self, c: [i64; 3]) -> usize {
        ((c[0] * self.dims[1] + c[1]) * self.dims[2] + c[2]) as usize
    }

    /// Squared distance to the nearest point, and its number.
    fn nearest(&self, p: &[f64; 3]) -> (f64, u32) {
        let home = self.cell(p);
        let high = |k: usize| self.low[k] + self.dims[k] as f64 * self.size;
        let foot: [f64; 3] = std::array::from_fn(|k| p[k].clamp(self.low[k], high(k)));
        let outside: f64 = (0..3).map(|k| (p[k] - foot[k]).powi(2)).sum();
        let mut best = (f64::MAX, 0);
        let reach = self.dims.iter().copied().max().unwrap_or(1);
        for ring in 0..=reach {
            self.search_ring(p, home, ring, &mut best);
            // Everything beyond this ring is at least this far from the cell, and so from the point's foot on the box. A point
            // outside is farther still: its square distance is at least the sum of those to the foot and from there.
            let inside: f64 = (0..3)
                .map(|k| {
                    let at = foot[k] - self.low[k] - home[k] as f64 * self.size;
                    at.min(self.size - at).max(0.0)
                })
                .fold(f64::MAX, f64::min);
            let next = ring as f64 * self.size + inside;
            if best.0 <= outside + next * next {
                break;
            }
        }
        best
    }

    fn search_ring(&self, p: &[f64; 3], home: [i64; 3], ring: i64, best: &mut (f64, u32)) {
        let span = |k: usize| (home[k] - ring).max(0)..=(home[k] + ring).min(self.dims[k] - 1);
        for i in span(0) {
            for j in span(1) {
                let shell = (i - home[0]).abs() == ring || (j - home[1]).abs() == ring;
                let ends = [home[2] - ring, home[2] + ring];
                let mut visit = |k: i64| {
                    let c = self.index([i, j, k]);
                    for &n in &self.order[self.start[c] as usize..self.start[c + 1] as usize] {
                        let q = &self.points[n as usize];
                        let d = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>();
                        if d < best.0 || (d == best.0 && n < best.1) {
                            *best = (d, n);
                        }
                    }
                };
                if shell {
                    span(2).for_each(visit);
                } else {
                    ends.into_iter().filter(|k| (0..self.dims[2]).contains(k)).for_each(&mut visit);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-3.0f64..3.0), 1..40),
            others in prop::collection::vec(prop::array::uniform3(-1.0f64..1.0), 1..200),
            flat in any::<bool>(),
        ) {
            let others: Vec<[f64; 3]> = others.into_iter().map(|p| if flat { [p[0], p[1], 0.5] } else { p }).collect();
            let (distances, numbers) = nearest(&points, &others).unwrap();
            for ((p, d), n) in points.iter().zip(distances).zip(numbers) {
                let own = (0..3).map(|k| (p[k] - others[n as usize][k]).powi(2)).sum::<f64>().sqrt();
                prop_assert!((d - own).abs() < 1e-12);
                let brute = others.iter().map(|q| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>().sqrt());
                prop_assert!((d - brute.fold(f64::MAX, f64::min)).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn nothing_to_be_near_to_is_an_error() {
        assert!(nearest(&[[0.0; 3]], &[]).is_err());
        assert!(nearest(&[], &[[0.0; 3]]).unwrap().0.is_empty());
    }
}
