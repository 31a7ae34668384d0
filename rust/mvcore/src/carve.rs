//! Space carving from silhouettes: which voxels lie in the visual hull, by the vote of the cameras that see them.
//!
//! ```text
//!   box 8 x 32 x 32 ──its corners on every image──► all background: against │ all target: for │ mixed: asked again of its parts
//!        └─ box 8³ ── the undecided views only ──► ...
//!              └─ voxel ── nearest pixel ──► inside where (against <= tolerance * seen) and seen >= least
//! ```
//!
//! A box projects into the rectangle around its corners, and a summed-area table says what the rectangle holds, so that single voxels are
//! asked only of views whose silhouette's border crosses their box: the result is that of asking every voxel of every view. Laurentini,
//! PAMI 1994; the descent after Szeliski, CVGIP 1993.

use crate::error::{Result, require};
use crate::grid::{Grid, SIDE};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
use crate::raster::Raster;
use multiversion::multiversion;
use rayon::prelude::*;

/// One camera's silhouette.
#[derive(Debug, Clone, Copy)]
pub struct Silhouette<'a> {
    /// Non-zero on the target.
    pub mask: Raster<'a, u8>,
    /// P = K [R | t], row-major 3x4.
    pub projection: [f64; 12],
}

/// How the views vote.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarveParams {
    /// Share of the views that see a voxel and may call it background.
    pub tolerance: f64,
    /// Fewest views that must see a voxel.
    pub least_views: u32,
}

/// Views beyond this many are refused: votes are counted in a byte each.
pub const MAX_VIEWS: usize = 255;

/// Whether each voxel (C order) is inside the visual hull.
pub fn carve(grid: Grid, views: &[Silhouette], params: &CarveParams) -> Result<Vec<bool>> {
    require(!views.is_empty(), "masks", "at least one view", "none")?;
    require(views.len() <= MAX_VIEWS, "masks", format!("at most {MAX_VIEWS} views"), views.len())?;
    require((0.0..1.0).contains(&params.tolerance), "tolerance", "a share of 0 or more, below 1", params.tolerance)?;
    let finite = views.iter().all(|v| v.projection.iter().all(|p| p.is_finite()));
    require(finite, "projections", "finite numbers", "NaN or infinity")?;
    let count = grid.shape.iter().try_fold(1usize, |n, &m| n.checked_mul(m)).filter(|&n| n <= 1 << 33);
    require(count.is_some(), "shape", "at most 2^33 voxels", format!("{:?}", grid.shape))?;
    let tables: Vec<Table> = views.par_iter().map(|v| Table::of(v.mask)).collect();
    let [nx, ny, nz] = grid.shape;
    let all: Vec<u8> = (0..views.len()).map(|v| v as u8).collect();
    let mut out = zeroed::<bool>(nx * ny * nz);
    let interrupt = Interrupt::current();
    out.par_chunks_mut(SIDE * ny * nz).enumerate().for_each(|(slab, out)| {
        let mut task = Task { grid: &grid, views, tables: &tables, params, first: slab * SIDE, out };
        for j in (0..ny).step_by(PARENT) {
            for k in (0..nz).step_by(PARENT) {
                interrupt.poll();
                let parent = Cells::new([slab * SIDE, j, k], [SIDE, PARENT, PARENT], grid.shape);
                if let Some((open, votes)) = task.settle(&parent, &all, Votes::default()) {
                    task.descend(&parent, &open, votes);
                }
            }
        }
    });
    Ok(out)
}

/// Voxels along y and z of the boxes that are asked first.
const PARENT: usize = 4 * SIDE;

/// A box of voxels, ends excluded.
struct Cells {
    low: [usize; 3],
    high: [usize; 3],
}

impl Cells {
    fn new(low: [usize; 3], size: [usize; 3], shape: [usize; 3]) -> Self {
        Self { low, high: std::array::from_fn(|a| (low[a] + size[a]).min(shape[a])) }
    }
}

/// What the settled views said.
#[derive(Clone, Copy, Default)]
struct Votes {
    seen: u32,
    against: u32,
}

impl CarveParams {
    fn allows(&self, votes: Votes) -> bool {
        votes.seen >= self.least_views && f64::from(votes.against) <= self.tolerance * f64::from(votes.seen)
    }
}

/// Foreground pixels of each rectangle that starts at the image's corner, (h + 1) x (w + 1).
struct Table {
    sums: Vec<u32>,
    width: usize,
    height: usize,
}

/// What a view says of a box.
#[derive(PartialEq)]
enum Answer {
    Unseen,
    Background,
    Target,
    Mixed,
}

impl Table {
    fn of(mask: Raster<u8>) -> Self {
        let (width, height) = (mask.width, mask.height);
        let mut sums = vec![0u32; (width + 1) * (height + 1)];
        for y in 0..height {
            let (above, below) = sums[y * (width + 1)..].split_at_mut(width + 1);
            let mut row = 0;
            for ((&m, &a), b) in mask.row(y).iter().zip(&above[1..]).zip(&mut below[1..]) {
                row += u32::from(m != 0);
                *b = a + row;
            }
        }
        Self { sums, width, height }
    }

    /// What the pixels nearest to the positions in [low, high] hold.
    fn answer(&self, low: [f64; 2], high: [f64; 2]) -> Answer {
        let (w, h) = (self.width as f64, self.height as f64);
        // A little wider than the corners say, as they are rounded numbers; pixels meet half-way between their centres.
        let [x0, y0] = low.map(|v| (v + 0.5 - SLACK).floor());
        let [x1, y1] = high.map(|v| (v + 0.5 + SLACK).floor());
        if x1 < 0.0 || y1 < 0.0 || x0 >= w || y0 >= h {
            return Answer::Unseen;
        }
        if !(x0 >= 0.0 && y0 >= 0.0 && x1 < w && y1 < h) {
            return Answer::Mixed;
        }
        let (x0, y0, x1, y1) = (x0 as usize, y0 as usize, x1 as usize + 1, y1 as usize + 1);
        let at = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        let count = at(x1, y1) + at(x0, y0) - at(x0, y1) - at(x1, y0);
        if count == 0 {
            Answer::Background
        } else if count as usize == (x1 - x0) * (y1 - y0) {
            Answer::Target
        } else {
            Answer::Mixed
        }
    }
}

/// Pixels.
const SLACK: f64 = 1e-6;

/// A slab of the volume, SIDE voxels along x.
struct Task<'a> {
    grid: &'a Grid,
    views: &'a [Silhouette<'a>],
    tables: &'a [Table],
    params: &'a CarveParams,
    first: usize,
    out: &'a mut [bool],
}

impl Task<'_> {
    /// Asks the open views of a box; the views still open and the votes so far, unless the box is decided.
    fn settle(&mut self, cells: &Cells, open: &[u8], mut votes: Votes) -> Option<(Vec<u8>, Votes)> {
        let mut mixed = Vec::with_capacity(open.len());
        for (n, &v) in open.iter().enumerate() {
            match self.ask(cells, v) {
                Answer::Unseen => {}
                Answer::Background => {
                    votes.seen += 1;
                    votes.against += 1;
                }
                Answer::Target => votes.seen += 1,
                Answer::Mixed => mixed.push(v),
            }
            // Even if all others saw it and called it target.
            let most = (votes.seen as usize + mixed.len() + open.len() - n - 1) as f64;
            if f64::from(votes.against) > self.params.tolerance * most {
                return None;
            }
        }
        // Even if all open views see it and call it background, or none of them sees it: the bound is hardest in the former.
        let worst = Votes { seen: votes.seen + mixed.len() as u32, against: votes.against + mixed.len() as u32 };
        if votes.seen >= self.params.least_views && self.params.allows(worst) {
            self.fill(cells);
            return None;
        }
        if mixed.is_empty() { None } else { Some((mixed, votes)) }
    }

    fn ask(&self, cells: &Cells, view: u8) -> Answer {
        let p = &self.views[view as usize].projection;
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let end = |a: usize, last: bool| {
            let n = if last { cells.high[a] - 1 } else { cells.low[a] };
            self.grid.origin[a] + self.grid.voxel * n as f64
        };
        let ends: [[f64; 2]; 3] = std::array::from_fn(|a| [end(a, false), end(a, true)]);
        let mut behind = 0;
        for corner in 0..8 {
            let q = project(p, std::array::from_fn(|a| ends[a][corner >> a & 1]));
            if q[2] <= 0.0 {
                behind += 1;
                continue;
            }
            for a in 0..2 {
                let v = q[a] / q[2];
                low[a] = low[a].min(v);
                high[a] = high[a].max(v);
            }
        }
        match behind {
            0 => self.tables[view as usize].answer(low, high),
            8 => Answer::Unseen,
            _ => Answer::Mixed,
        }
    }

    fn descend(&mut self, parent: &Cells, open: &[u8], votes: Votes) {
        for j in (parent.low[1]..parent.high[1]).step_by(SIDE) {
            for k in (parent.low[2]..parent.high[2]).step_by(SIDE) {
                let cells = Cells::new([parent.low[0], j, k], [SIDE; 3], self.grid.shape);
                if let Some((open, votes)) = self.settle(&cells, open, votes) {
                    self.voxels(&cells, &open, votes);
                }
            }
        }
    }

    fn row(&mut self, i: usize, j: usize, k: [usize; 2]) -> &mut [bool] {
        let [_, ny, nz] = self.grid.shape;
        let start = ((i - self.first) * ny + j) * nz;
        &mut self.out[start + k[0]..start + k[1]]
    }

    fn fill(&mut self, cells: &Cells) {
        for i in cells.low[0]..cells.high[0] {
            for j in cells.low[1]..cells.high[1] {
                self.row(i, j, [cells.low[2], cells.high[2]]).fill(true);
            }
        }
    }

    fn voxels(&mut self, cells: &Cells, open: &[u8], votes: Votes) {
        let (grid, params) = (self.grid, self.params);
        let least = params.least_views;
        // Against a share of the seen is a comparison of integers: a table, one entry a count of seen views.
        let allowed: [u8; MAX_VIEWS + 1] = std::array::from_fn(|seen| {
            let most = (params.tolerance * seen as f64).floor();
            if seen as u32 >= least { most as u8 } else { u8::MAX }
        });
        for i in cells.low[0]..cells.high[0] {
            for j in cells.low[1]..cells.high[1] {
                let (mut seen, mut against) = ([votes.seen as u8; SIDE], [votes.against as u8; SIDE]);
                let at = [0, 1].map(|a| grid.origin[a] + grid.voxel * [i, j][a] as f64);
                let z: [f64; SIDE] = std::array::from_fn(|n| grid.origin[2] + grid.voxel * (cells.low[2] + n) as f64);
                for &v in open {
                    vote(&self.views[v as usize], at, &z, &mut seen, &mut against);
                }
                for (n, out) in self.row(i, j, [cells.low[2], cells.high[2]]).iter_mut().enumerate() {
                    *out = u32::from(seen[n]) >= least && against[n] <= allowed[seen[n] as usize];
                }
            }
        }
    }
}

#[inline(always)]
fn project(p: &[f64; 12], x: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|r| p[4 * r] * x[0] + p[4 * r + 1] * x[1] + p[4 * r + 2] * x[2] + p[4 * r + 3])
}

/// A view's votes on a row of voxels along z.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+bmi2", "x86_64+avx2+bmi2", "aarch64+neon"))]
fn vote(view: &Silhouette, at: [f64; 2], z: &[f64; SIDE], seen: &mut [u8; SIDE], against: &mut [u8; SIDE]) {
    let p = &view.projection;
    let mut q = [[0.0f64; SIDE]; 3];
    for (r, q) in q.iter_mut().enumerate() {
        let (x, y) = (p[4 * r] * at[0], p[4 * r + 1] * at[1]);
        for n in 0..SIDE {
            q[n] = x + y + p[4 * r + 2] * z[n] + p[4 * r + 3];
        }
    }
    let (mut u, mut v) = ([0.0f64; SIDE], [0.0f64; SIDE]);
    for n in 0..SIDE {
        u[n] = (q[0][n] / q[2][n]).round_ties_even();
        v[n] = (q[1][n] / q[2][n]).round_ties_even();
    }
    let (w, h) = (view.mask.width as f64, view.mask.height as f64);
    for n in 0..SIDE {
        let inside = q[2][n] > 0.0 && u[n] >= 0.0 && v[n] >= 0.0 && u[n] < w && v[n] < h;
        if inside {
            seen[n] += 1;
            against[n] += u8::from(view.mask.data[v[n] as usize * view.mask.width + u[n] as usize] == 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::camera;
    use proptest::prelude::*;

    fn brute(grid: &Grid, views: &[Silhouette], params: &CarveParams) -> Vec<bool> {
        let [nx, ny, nz] = grid.shape;
        let inside = |n: usize| {
            let at = [n / (ny * nz), n / nz % ny, n % nz];
            let mut votes = Votes::default();
            for view in views {
                let q = project(&view.projection, std::array::from_fn(|a| grid.origin[a] + grid.voxel * at[a] as f64));
                let (u, v) = ((q[0] / q[2]).round_ties_even(), (q[1] / q[2]).round_ties_even());
                let (w, h) = (view.mask.width as f64, view.mask.height as f64);
                if q[2] > 0.0 && u >= 0.0 && v >= 0.0 && u < w && v < h {
                    votes.seen += 1;
                    votes.against += u32::from(view.mask.row(v as usize)[u as usize] == 0);
                }
            }
            params.allows(votes)
        };
        (0..nx * ny * nz).map(inside).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 40, ..Default::default() })]
        #[test]
        fn the_descent_asks_as_if_it_asked_every_voxel(
            seed in 0u64..1000, views in 1usize..9, tolerance in 0.0f64..0.6, least_views in 0u32..4, reach in 0.5f64..6.0,
        ) {
            let (w, h) = (48, 40);
            let mut state = seed + 1;
            let mut random = || { state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407); (state >> 33) as f64 / 2f64.powi(31) };
            let masks: Vec<Vec<u8>> = (0..views).map(|_| {
                let (cx, cy, r) = (random() * 48.0, random() * 40.0, 4.0 + random() * 22.0);
                let flip = random() < 0.2;
                (0..w * h).map(|n| u8::from(((n % w) as f64 - cx).hypot((n / w) as f64 - cy) < r) ^ u8::from(flip)).collect()
            }).collect();
            let views: Vec<Silhouette> = masks.iter().enumerate().map(|(n, m)| Silhouette {
                mask: Raster::new(m, w, h, "mask").unwrap(), projection: camera(n as f64 * 0.9 + seed as f64, w, h),
            }).collect();
            // With a reach beyond 4 some voxels lie behind cameras.
            let grid = Grid::new([-reach; 3], reach / 18.0, [37, 41, 35]).unwrap();
            let params = CarveParams { tolerance, least_views };
            prop_assert_eq!(carve(grid, &views, &params).unwrap(), brute(&grid, &views, &params));
        }
    }

    #[test]
    fn wrong_arguments_are_named() {
        let grid = Grid::new([0.0; 3], 1.0, [4; 3]).unwrap();
        let params = CarveParams { tolerance: 0.0, least_views: 1 };
        assert!(carve(grid, &[], &params).unwrap_err().to_string().starts_with("masks"));
        let view = Silhouette { mask: Raster::new(&[1u8], 1, 1, "m").unwrap(), projection: [0.0; 12] };
        let wrong = CarveParams { tolerance: 1.0, ..params };
        assert!(carve(grid, &[view], &wrong).unwrap_err().to_string().starts_with("tolerance"));
    }
}
