//! The visual hull as a signed distance: the vote of soft silhouettes, to first order near its surface.
//!
//! ```text
//!   block ──its corners on every image──► farther than τ inside: for │ farther than τ outside: against │ near the border: asked
//!                                                                                                      of every voxel
//! ```
//!
//! A silhouette's distance changes by a pixel a pixel, so its value at the middle of the rectangle that a block projects to bounds all
//! of it: voxels ask only the views whose border may matter to them, and get what asking all views would give.

use crate::grid::{Grid, SIDE, Tile};
use crate::interrupt::Interrupt;
use crate::raster::Cut;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// One camera's soft silhouette.
#[derive(Debug, Clone, Copy)]
pub struct SoftSilhouette<'a> {
    /// Signed distance to its border in pixels, positive outside.
    pub distance: Cut<'a, f32>,
    /// What the camera saw, in pixels of the raster: x0, y0, x1, y1.
    pub window: [f64; 4],
    /// P = K [R | t], row-major 3x4.
    pub projection: [f64; 12],
    /// Focal length in pixels, turns distances into world units.
    pub focal: f64,
}

/// Unmarks blocks outside the hull and marks all those inside it; `tolerance` is the share of the silhouettes that may disagree.
pub fn restrict_to_hull(grid: &Grid, tile: &Tile, views: &[SoftSilhouette], tolerance: f32, flags: &[AtomicBool]) {
    for_each_block(grid, tile, views, tolerance, flags, |away, radius, flag| {
        flag.store(away < radius, Ordering::Relaxed);
    });
}

/// Marks the blocks inside the hull and those less than `reach` in world units outside it, and unmarks none.
pub fn mark_hull(grid: &Grid, tile: &Tile, views: &[SoftSilhouette], tolerance: f32, reach: f64, flags: &[AtomicBool]) {
    for_each_block(grid, tile, views, tolerance, flags, |away, radius, flag| {
        if away < radius + reach as f32 {
            flag.store(true, Ordering::Relaxed);
        }
    });
}

/// Tells of each block its middle's distance from the hull, and the distance at which none of it lies on the hull.
fn for_each_block(
    grid: &Grid,
    tile: &Tile,
    views: &[SoftSilhouette],
    tolerance: f32,
    flags: &[AtomicBool],
    tell: impl Fn(f32, f32, &AtomicBool) + Sync,
) {
    let half = 0.5 * SIDE as f64;
    let radius = (half * grid.voxel * 3f64.sqrt()) as f32;
    let interrupt = Interrupt::current();
    flags.par_iter().enumerate().for_each_init(
        || Vec::with_capacity(views.len()),
        |outside, (index, flag)| {
            if interrupt.is_set() {
                return;
            }
            let corner = tile.block(index);
            let p = std::array::from_fn(|a| grid.origin[a] + grid.voxel * (corner[a] as f64 * SIDE as f64 + half));
            outside.clear();
            outside.extend(views.iter().filter_map(|v| distance(v, p)));
            let vote = Vote { silhouettes: views.len(), seen: outside.len(), above: 0 };
            tell(vote.distance(outside, tolerance), radius * 1.2, flag);
        },
    );
    interrupt.poll();
}

/// What the silhouettes say of a whole block, and those of them that must be asked of each of its voxels.
fn asked<'a, 'b>(
    grid: &Grid,
    at: [u32; 3],
    views: &'b [SoftSilhouette<'a>],
    truncation: f64,
) -> (Vote, Vec<&'b SoftSilhouette<'a>>) {
    let mut vote = Vote { silhouettes: views.len(), ..Vote::default() };
    let mut open = Vec::with_capacity(views.len());
    for view in views {
        match answer(grid, at, view, truncation) {
            Answer::Unseen => {}
            Answer::Inside => vote.seen += 1,
            Answer::Outside => {
                vote.seen += 1;
                vote.above += 1;
            }
            Answer::Near => open.push(view),
        }
    }
    (vote, open)
}

/// Whether a block lies so far inside the hull that [`cut_block`] would leave all of it as it is.
pub fn deep_inside(grid: &Grid, at: [u32; 3], views: &[SoftSilhouette], tolerance: f32, truncation: f64) -> bool {
    let (vote, open) = asked(grid, at, views, truncation);
    open.is_empty() && vote.above <= vote.allowed(vote.seen, tolerance) && vote.enough(vote.seen)
}

/// Raises a block's values, in units of the truncation, to the hull's distance.
pub fn cut_block(
    grid: &Grid,
    at: [u32; 3],
    views: &[SoftSilhouette],
    tolerance: f32,
    truncation: f64,
    out: &mut [f32],
) {
    let (vote, open) = asked(grid, at, views, truncation);
    // More of them may see it, which allows more to disagree.
    if vote.above > vote.allowed(vote.seen + open.len(), tolerance) {
        out.fill(1.0);
        return;
    }
    if open.is_empty() && vote.enough(vote.seen) {
        return;
    }
    let inverse = (1.0 / truncation) as f32;
    let mut outside = Vec::with_capacity(open.len());
    for (n, v) in out.iter_mut().enumerate() {
        let local = [n / (SIDE * SIDE), n / SIDE % SIDE, n % SIDE];
        let p =
            std::array::from_fn(|a| grid.origin[a] + grid.voxel * (f64::from(at[a]) * SIDE as f64 + local[a] as f64));
        outside.clear();
        outside.extend(open.iter().filter_map(|view| distance(view, p)));
        let here = Vote { seen: vote.seen + outside.len(), ..vote };
        *v = v.max((here.distance(&mut outside, tolerance) * inverse).clamp(-1.0, 1.0));
    }
}

/// Silhouettes that must see a place of the hull where half of them are more.
const ENOUGH: usize = 5;

/// What is known before the open silhouettes are asked.
#[derive(Debug, Clone, Copy, Default)]
struct Vote {
    /// Silhouettes there are.
    silhouettes: usize,
    /// Those that see the place.
    seen: usize,
    /// Those that see it farther than τ outside.
    above: usize,
}

impl Vote {
    /// What few views see, few silhouettes can cut: it does not belong to a target that the rig looks at.
    fn enough(&self, seen: usize) -> bool {
        seen > 0 && seen >= self.silhouettes.div_ceil(2).min(ENOUGH)
    }

    /// Silhouettes that may disagree with a place's being inside.
    fn allowed(&self, seen: usize, tolerance: f32) -> usize {
        ((seen as f32 * tolerance) as usize).min(seen.saturating_sub(1))
    }

    /// Signed distance, positive outside, of the silhouettes near the place; `f32::MIN` where only far ones decide.
    fn distance(&self, near: &mut [f32], tolerance: f32) -> f32 {
        if !self.enough(self.seen) {
            return f32::MAX;
        }
        match self.allowed(self.seen, tolerance).checked_sub(self.above) {
            None => f32::MAX,
            Some(nth) if nth >= near.len() => f32::MIN,
            Some(nth) => *near.select_nth_unstable_by(nth, |a, b| b.total_cmp(a)).1,
        }
    }
}

/// What a silhouette says of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Answer {
    Unseen,
    Inside,
    Outside,
    Near,
}

/// Pixels by which interpolated distances may differ more than their places do: two cells' diagonals and the step at the border.
const SLACK: f64 = 4.0;

fn answer(grid: &Grid, at: [u32; 3], view: &SoftSilhouette, truncation: f64) -> Answer {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for corner in 0..8usize {
        let q = project(
            view,
            std::array::from_fn(|a| {
                let end = if corner >> a & 1 == 1 { SIDE - 1 } else { 0 };
                grid.origin[a] + grid.voxel * (f64::from(at[a]) * SIDE as f64 + end as f64)
            }),
        );
        if q[2] <= 0.0 {
            return Answer::Near;
        }
        for (a, v) in [q[0] / q[2], q[1] / q[2], q[2]].into_iter().enumerate() {
            low[a] = low[a].min(v);
            high[a] = high[a].max(v);
        }
    }
    let [x0, y0, x1, y1] = view.window;
    if high[0] < x0 || high[1] < y0 || low[0] > x1 || low[1] > y1 {
        return Answer::Unseen;
    }
    if low[0] < x0 || low[1] < y0 || high[0] > x1 || high[1] > y1 {
        return Answer::Near;
    }
    let radius = 0.5 * (high[0] - low[0]).hypot(high[1] - low[1]);
    let middle = pixels(&view.distance, 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]));
    // Beyond the raster's ends the way to it adds to the distance there.
    let (width, height) = (view.distance.width as f64 - 1.0, view.distance.height as f64 - 1.0);
    let cut = low[0] < 0.0 || low[1] < 0.0 || high[0] > width || high[1] > height;
    let reach = if cut { 2.0 * radius } else { radius } + SLACK;
    let least = truncation * view.focal / low[2];
    if f64::from(middle) - reach >= least {
        Answer::Outside
    } else if f64::from(middle) + reach <= -least {
        Answer::Inside
    } else {
        Answer::Near
    }
}

/// A silhouette's distance in world units at a place, positive outside; none where the camera does not see it.
fn distance(view: &SoftSilhouette, p: [f64; 3]) -> Option<f32> {
    let q = project(view, p);
    if q[2] <= 0.0 {
        return None;
    }
    let (u, v) = (q[0] / q[2], q[1] / q[2]);
    let [x0, y0, x1, y1] = view.window;
    let seen = !(u < x0 || v < y0 || u > x1 || v > y1);
    seen.then(|| pixels(&view.distance, u, v) * (q[2] / view.focal) as f32)
}

/// A silhouette's distance in pixels; beyond the raster it is at least as far as the way to it.
fn pixels(silhouette: &Cut<f32>, u: f64, v: f64) -> f32 {
    let inside = (u.clamp(0.0, silhouette.width as f64 - 1.0), v.clamp(0.0, silhouette.height as f64 - 1.0));
    let beyond = (u - inside.0).hypot(v - inside.1) as f32;
    let (u, v) = inside;
    let (x, y) = (u as usize, v as usize);
    let (x1, y1) = ((x + 1).min(silhouette.width - 1), (y + 1).min(silhouette.height - 1));
    let (a, b) = ((u - x as f64) as f32, (v - y as f64) as f32);
    let at = |x: usize, y: usize| silhouette.at(x, y);
    (1.0 - b) * ((1.0 - a) * at(x, y) + a * at(x1, y)) + b * ((1.0 - a) * at(x, y1) + a * at(x1, y1)) + beyond
}

#[inline(always)]
fn project(view: &SoftSilhouette, p: [f64; 3]) -> [f64; 3] {
    let m = &view.projection;
    std::array::from_fn(|r| m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::BLOCK;
    use crate::raster::Raster;
    use crate::testing::camera;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 60, ..Default::default() })]
        #[test]
        fn a_block_is_cut_as_if_every_voxel_asked_every_view(
            seed in 0u64..1000, count in 1usize..9, tolerance in 0.0f32..0.6, reach in 0.5f64..5.0, truncation in 0.02f64..0.6, cropped in any::<bool>(),
        ) {
            let (w, h) = (48usize, 40usize);
            let mut state = seed + 1;
            let mut random = || { state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407); (state >> 33) as f64 / 2f64.powi(31) };
            let discs: Vec<[f64; 3]> = (0..count).map(|_| [random() * 48.0, random() * 40.0, 4.0 + random() * 16.0]).collect();
            let rasters: Vec<Vec<f32>> = discs.iter().map(|[x, y, r]| {
                (0..w * h).map(|n| (((n % w) as f64 - x).hypot((n / w) as f64 - y) - r) as f32).collect()
            }).collect();
            let raster = |d| Raster::new(d, w, h, "raster").unwrap();
            let border = if cropped { 20.0 } else { 0.0 };
            let views: Vec<SoftSilhouette> = rasters.iter().enumerate().map(|(n, d)| SoftSilhouette {
                distance: raster(d).into(),
                window: [-border, -border, 47.0 + border, 39.0 + border],
                projection: camera(n as f64 * 0.7 + seed as f64, w, h), focal: 60.0,
            }).collect();
            let grid = Grid::new([-reach; 3], reach / 16.0, [33; 3]).unwrap();
            for at in (0..64u32).map(|n| [n / 16, n / 4 % 4, n % 4]) {
                let mut found = [-1.0f32; BLOCK];
                cut_block(&grid, at, &views, tolerance, truncation, &mut found);
                for (n, &v) in found.iter().enumerate() {
                    let local = [n / 64, n / 8 % 8, n % 8];
                    let p = std::array::from_fn(|a| grid.origin[a] + grid.voxel * f64::from(at[a] * 8 + local[a] as u32));
                    let mut every: Vec<f32> = views.iter().filter_map(|v| distance(v, p)).collect();
                    let vote = Vote { silhouettes: count, seen: every.len(), above: 0 };
                    let expected = (vote.distance(&mut every, tolerance) / truncation as f32).clamp(-1.0, 1.0);
                    prop_assert!((v - expected).abs() < 1e-4, "block {at:?} voxel {n}: {v} {expected}");
                }
            }
        }
    }
}
