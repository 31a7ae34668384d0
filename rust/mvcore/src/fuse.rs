//! Depth maps and silhouettes into a block-sparse truncated signed distance field (eqs 39-41 of the paper, for any pose).
//!
//! ```text
//!   camera ───── free ─────┤+τ ... 0 ... -τ├── unknown ──►      per voxel: mean of clamp(depth - z, -τ, τ), weighted
//! ```
//!
//! Voxels farther than τ in front of a surface get +τ from that view: free space carves what other views put there by mistake.
//! With silhouettes the field is cut by the visual hull and what no depth map reaches inside the hull is solid; or they only
//! complete it: what was observed stays, elsewhere the hull's distance stands in, near the hull and within it. Of a hull that cuts, blocks
//! amid others that are free throughout, or solid throughout, hold no surface and may be left out. Curless and Levoy, SIGGRAPH 1996; blocks
//! after Nießner et al., SIGGRAPH Asia 2013. Each block is computed by one task from all views in order: the same bytes for any
//! thread count.

use crate::error::{Error, Result, require};
use crate::grid::{BLOCK, BlockMap, Grid, SIDE, Tile};
use crate::hull::{SoftSilhouette, cut_block, deep_inside, mark_hull, restrict_to_hull};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
use crate::raster::Cut;
use crate::smooth::{Beyond, Bits, Measured, smooth};
use multiversion::multiversion;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};

/// One view's contribution.
#[derive(Debug, Clone, Copy)]
pub struct FusionView<'a> {
    /// z-depth, 0 means none.
    pub depth: Cut<'a, f32>,
    /// Weight of each pixel's depth.
    pub weight: Cut<'a, f32>,
    /// Signed distance to the silhouette in pixels, positive outside it.
    pub silhouette: Option<Cut<'a, f32>>,
    /// What the camera saw, in pixels of the rasters: x0, y0, x1, y1. Larger than these where they are cut from a picture that shows
    /// only background around them.
    pub window: [f64; 4],
    /// P = K [R | t], row-major 3x4.
    pub projection: [f64; 12],
    /// Focal length in pixels, turns silhouette distances into world units.
    pub focal: f64,
}

impl<'a> FusionView<'a> {
    fn soft_silhouette(&self) -> Option<SoftSilhouette<'a>> {
        let Self { window, projection, focal, .. } = *self;
        self.silhouette.map(|distance| SoftSilhouette { distance, window, projection, focal })
    }
}

/// How views become a field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusionParams {
    /// Truncation τ in world units.
    pub truncation: f64,
    /// Weight of a free-space observation relative to a surface one.
    pub free_weight: f32,
    /// Weight of surface observations below which a voxel is not inside; free space needs none.
    pub min_weight: f32,
    /// Standard deviation of the field's smoothing in voxels, 0 for none.
    pub smoothing: f32,
    /// The same where silhouettes cut the field and what a Gaussian covers was measured nevertheless.
    pub measured_smoothing: f32,
    /// With silhouettes: weight of observations that overrules the solid inside of the hull.
    pub solid_weight: f32,
    /// Share of the silhouettes that see a voxel and may disagree with its being inside.
    pub hull_tolerance: f32,
    /// Silhouettes complete what the depth maps leave open; they cut nothing.
    pub complete: bool,
    /// Blocks of a hull that cuts are left out where they and all around them are free, or solid, throughout.
    pub hollow: bool,
    /// Most bytes of the volume.
    pub max_memory: usize,
}

/// Distances in units of τ (NaN where unobserved) of each block of the map.
#[derive(Debug, Clone)]
pub struct Volume {
    /// Which blocks exist.
    pub map: BlockMap,
    /// `BLOCK` values a block, -1 (inside) ..= 1.
    pub values: Vec<f32>,
}

/// Bytes a voxel takes while it is fused: its distance, and the smoothed one.
const VOXEL_BYTES: usize = 8;

/// Fuses the views into the blocks near their surfaces (with silhouettes: also all blocks inside the hull).
pub fn fuse(grid: Grid, views: &[FusionView], params: &FusionParams) -> Result<Volume> {
    fuse_tile(grid, Tile::whole(&grid), views, params, &[])
}

/// The same for the blocks of a tile; those on its sides lack what smoothing takes from beyond them. Where `params.hollow` holds, `hints`
/// say what a coarser field knows of each block, one a block of the tile or none at all.
pub fn fuse_tile(
    grid: Grid,
    tile: Tile,
    views: &[FusionView],
    params: &FusionParams,
    hints: &[Hint],
) -> Result<Volume> {
    let dims = grid.blocks();
    let fits = (0..3).all(|a| tile.low[a] < tile.high[a] && tile.high[a] <= dims[a]);
    require(fits, "tile", format!("a box of blocks within {dims:?}"), format!("{:?} to {:?}", tile.low, tile.high))?;
    require(!views.is_empty(), "views", "at least one view", "none")?;
    require(params.truncation > 0.0, "truncation", "a positive distance", params.truncation)?;
    for view in views {
        let (depth, weight) = (view.depth.part, view.weight.part);
        let same =
            weight.width == depth.width && weight.height == depth.height && view.weight.corner == view.depth.corner;
        require(same, "weight", "the size of the depth map", format!("{} x {}", weight.height, weight.width))?;
    }
    let count = tile.count();
    require(hints.is_empty() || hints.len() == count, "hints", format!("{count} or none"), hints.len())?;
    // A slot and three flags a block.
    let table = count.saturating_mul(7);
    if table > params.max_memory {
        return Err(Error::OutOfMemory { what: "block table", needed: table, allowed: params.max_memory });
    }
    let flags: Vec<AtomicBool> = (0..count).map(|_| AtomicBool::new(false)).collect();
    for view in views {
        mark_surface(&grid, &tile, view, params.truncation, &flags);
    }
    let silhouettes: Vec<SoftSilhouette> = views.iter().filter_map(FusionView::soft_silhouette).collect();
    let hull = match (silhouettes.is_empty(), params.complete) {
        (true, _) => Hull::Unknown,
        (false, false) => Hull::Cuts,
        (false, true) => Hull::Completes,
    };
    match hull {
        Hull::Unknown => {}
        Hull::Cuts => restrict_to_hull(&grid, &tile, &silhouettes, params.hull_tolerance, &flags),
        Hull::Completes => mark_hull(&grid, &tile, &silhouettes, params.hull_tolerance, params.truncation, &flags),
    }
    let tiles: Vec<Tiles> = views.par_iter().map(Tiles::of).collect();
    let mut flags: Vec<bool> = flags.into_iter().map(AtomicBool::into_inner).collect();
    let mut held = vec![1i8; count];
    if hull == Hull::Cuts && params.hollow {
        let contents = contents(&grid, &tile, views, &tiles, &silhouettes, params, &flags, hints);
        let left_out = |n: usize| hints.get(n) == Some(&Hint::Unseen) && contents[n] != Content::Measured;
        let holds = |n: usize| match contents[n] {
            Content::Solid => -1,
            _ if flags[n] && left_out(n) => 0,
            _ => 1,
        };
        held = (0..count).map(holds).collect();
        flags = (0..count).into_par_iter().map(|n| flags[n] && !left_out(n) && !amid(&tile, n, &contents)).collect();
    }
    let map = BlockMap::from_flags(tile, flags.into_iter());
    let needed = map.coords.len() * (BLOCK * VOXEL_BYTES + size_of::<Bits>()) + table;
    if needed > params.max_memory {
        return Err(Error::OutOfMemory { what: "volume", needed, allowed: params.max_memory });
    }
    let mut values = zeroed::<f32>(map.coords.len() * BLOCK);
    let mut bits = vec![Bits::default(); map.coords.len()];
    let interrupt = Interrupt::current();
    values.par_chunks_exact_mut(BLOCK).zip(&mut bits).zip(map.coords.par_iter()).for_each(|((out, bits), at)| {
        if interrupt.is_set() {
            return;
        }
        let cut = |out: &mut [f32]| {
            cut_block(&grid, *at, &silhouettes, params.hull_tolerance, params.truncation, out);
        };
        match hull {
            Hull::Unknown => integrate(&grid, *at, views, &tiles, params, &[f32::NAN; BLOCK], out, bits),
            Hull::Cuts => {
                integrate(&grid, *at, views, &tiles, params, &[-1.0; BLOCK], out, bits);
                cut(out);
            }
            Hull::Completes => {
                let mut distance = [-1.0; BLOCK];
                cut(&mut distance);
                // Farther outside than τ nothing is known of a voxel that no depth map reaches.
                let open = distance.map(|d| if d < 1.0 { d } else { f32::NAN });
                integrate(&grid, *at, views, &tiles, params, &open, out, bits);
            }
        }
    });
    interrupt.poll();
    if params.smoothing > 0.0 {
        // With silhouettes what no block covers is outside the hull.
        let beyond = if hull == Hull::Cuts { Beyond::Held(&held) } else { Beyond::Unknown };
        let measured = (hull == Hull::Cuts && params.measured_smoothing > 0.0)
            .then_some(Measured { bits: &bits, sigma: params.measured_smoothing });
        values = smooth(&values, &map, params.smoothing, beyond, measured);
    }
    Ok(Volume { map, values })
}

/// Weight of observations, a confident depth has 1, that need no smoothing against their own noise.
const MEASURED: f32 = 2.0;

/// What the visual hull does to the field.
#[derive(Clone, Copy, PartialEq)]
enum Hull {
    Unknown,
    Cuts,
    Completes,
}

/// What a coarser field knows of a block: it decides where no view has a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hint {
    /// Nothing: its voxels must be asked.
    Ask,
    /// Free throughout.
    Free,
    /// Solid throughout.
    Solid,
    /// There is a surface, and no camera sees it.
    Unseen,
}

impl Hint {
    /// From 0, 1, -1 or 2, in the order of the variants; [`Hint::Ask`] from any other.
    #[must_use]
    pub fn of(code: i8) -> Self {
        match code {
            1 => Self::Free,
            -1 => Self::Solid,
            2 => Self::Unseen,
            _ => Self::Ask,
        }
    }
}

/// What all of a block's voxels hold.
#[derive(Clone, Copy, PartialEq)]
enum Content {
    /// 1: the hull leaves it out.
    Outside,
    /// 1: views enough to overrule the solid hull see through it, and none sees a surface in it.
    Free,
    /// -1: deep inside the hull, and what sees through it is too little to overrule that.
    Solid,
    /// A view has a surface in it.
    Measured,
    /// Different values, or nobody knows without asking each voxel.
    Mixed,
}

/// What each block of the tile holds, where silhouettes cut the field.
fn contents(
    grid: &Grid,
    tile: &Tile,
    views: &[FusionView],
    tiles: &[Tiles],
    silhouettes: &[SoftSilhouette],
    params: &FusionParams,
    flags: &[bool],
    hints: &[Hint],
) -> Vec<Content> {
    let interrupt = Interrupt::current();
    let content = |(n, &flag): (usize, &bool)| {
        if !flag || interrupt.is_set() {
            return Content::Outside;
        }
        let at = tile.block(n).map(|v| v as u32);
        let (mut least, mut most) = (0.0f32, 0.0f32);
        for (view, tiles) in views.iter().zip(tiles) {
            match Stepper::new(grid, at, &view.projection).says_exactly(view, tiles, params.truncation as f32) {
                Says::Nothing => {}
                Says::Free(weights) => {
                    least += params.free_weight * weights[0];
                    most += params.free_weight * weights[1];
                }
                Says::Surface => return Content::Measured,
            }
        }
        let deep = || deep_inside(grid, at, silhouettes, params.hull_tolerance, params.truncation);
        // Sums in another order differ in their last digits.
        let (solid, free) = (most == 0.0 || most < params.solid_weight * 0.999, least > params.solid_weight * 1.001);
        match hints.get(n) {
            // A slit between the coarse field's samples may close, a part thinner than that stays.
            Some(Hint::Solid) => Content::Solid,
            Some(Hint::Free) if deep() => Content::Free,
            _ if solid && deep() => Content::Solid,
            _ if free && !solid => Content::Free,
            _ => Content::Mixed,
        }
    };
    let contents = flags.par_iter().enumerate().map(content).collect();
    interrupt.poll();
    contents
}

/// Whether a block and all 26 around it hold the same: no cell of any holds a surface, nor does smoothing reach one.
fn amid(tile: &Tile, n: usize, contents: &[Content]) -> bool {
    let same = |content: Content| match contents[n] {
        Content::Solid => content == Content::Solid,
        Content::Free => matches!(content, Content::Free | Content::Outside),
        Content::Outside | Content::Measured | Content::Mixed => false,
    };
    let at = tile.block(n);
    (0..27).all(|k| {
        let step = [k / 9, k / 3 % 3, k % 3];
        let near = [0, 1, 2].map(|a| (at[a] + step[a]).wrapping_sub(1));
        tile.index(near).is_some_and(|m| same(contents[m]))
    })
}

/// Marks the blocks within τ of a view's surface, walking each pixel's ray.
fn mark_surface(grid: &Grid, tile: &Tile, view: &FusionView, truncation: f64, flags: &[AtomicBool]) {
    let block = grid.voxel * SIDE as f64;
    let rays = Rays::of(&view.projection);
    let interrupt = Interrupt::current();
    let Cut { part, corner: [left, top], .. } = view.depth;
    (0..part.height).into_par_iter().for_each(|row| {
        interrupt.poll();
        for (column, &z) in part.row(row).iter().enumerate() {
            if z <= 0.0 {
                continue;
            }
            let (x, y) = (left + column, top + row);
            let direction = rays.direction(x as f64, y as f64);
            let stride = ((block / 3.0 * view.focal / f64::from(z)) as usize).max(1);
            if x % stride != 0 || y % stride != 0 {
                continue;
            }
            let reach = truncation + 0.5 * block / 3.0;
            let steps = (2.0 * reach / (block / 3.0)).ceil() as i32;
            for s in 0..=steps {
                let along = f64::from(z) - reach + 2.0 * reach * f64::from(s) / f64::from(steps);
                let p: [f64; 3] = std::array::from_fn(|a| rays.center[a] + direction[a] * along - grid.origin[a]);
                let b = p.map(|v| (v / block).floor());
                if b.iter().all(|&v| v >= 0.0)
                    && let Some(index) = tile.index(b.map(|v| v as usize))
                {
                    flags[index].store(true, Ordering::Relaxed);
                }
            }
        }
    });
}

/// Back-projection of pixels: direction with z-depth 1.
struct Rays {
    center: [f64; 3],
    inverse: nalgebra::Matrix3<f64>,
}

impl Rays {
    fn of(p: &[f64; 12]) -> Self {
        let m = nalgebra::Matrix3::from_fn(|r, c| p[4 * r + c]);
        let inverse = m.try_inverse().unwrap_or_else(nalgebra::Matrix3::identity);
        let center = -(inverse * nalgebra::Vector3::new(p[3], p[7], p[11]));
        Self { center: center.into(), inverse }
    }

    fn direction(&self, x: f64, y: f64) -> [f64; 3] {
        (self.inverse * nalgebra::Vector3::new(x, y, 1.0)).into()
    }
}

/// One view as f32 increments over a block: homogeneous pixel of voxel (i, j, k) = base + i·di + j·dj + k·dk.
struct Stepper {
    base: [f32; 3],
    di: [f32; 3],
    dj: [f32; 3],
    dk: [f32; 3],
}

impl Stepper {
    fn new(grid: &Grid, at: [u32; 3], m: &[f64; 12]) -> Self {
        let p: [f64; 3] = std::array::from_fn(|a| grid.origin[a] + grid.voxel * f64::from(at[a]) * SIDE as f64);
        let row = |r: usize| m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3];
        let column = |c: usize| std::array::from_fn(|r| (m[4 * r + c] * grid.voxel) as f32);
        Self { base: std::array::from_fn(|r| row(r) as f32), di: column(0), dj: column(1), dk: column(2) }
    }

    /// Least and greatest column, row and depth of the block's corners.
    fn extent(&self) -> [[f32; 3]; 2] {
        let corner = |c: usize| -> [f32; 3] {
            let f = |bit: usize| if c >> bit & 1 == 1 { (SIDE - 1) as f32 } else { 0.0 };
            std::array::from_fn(|r| self.base[r] + f(0) * self.di[r] + f(1) * self.dj[r] + f(2) * self.dk[r])
        };
        let (mut low, mut high) = ([f32::MAX; 3], [f32::MIN; 3]);
        for [x, y, z] in std::array::from_fn::<_, 8, _>(corner) {
            // A corner behind the camera has no pixel: only a block wholly behind it is known to miss.
            let p = if z > 0.0 { [x / z, y / z, z] } else { [f32::NAN, f32::NAN, z] };
            for a in 0..3 {
                low[a] = if p[a] >= low[a] { low[a] } else { p[a] };
                high[a] = if p[a] <= high[a] { high[a] } else { p[a] };
            }
        }
        [low, high]
    }

    /// What the view says of the block as a whole.
    fn says(&self, tiles: &Tiles, truncation: f32) -> Says {
        let [low, high] = self.extent();
        if high[2] <= 0.0 {
            return Says::Nothing;
        }
        if low[2] <= 0.0 {
            return Says::Surface;
        }
        let (width, height) = (tiles.width as f32, tiles.height as f32);
        if low[0] > width - 0.5 || high[0] < -0.5 || low[1] > height - 0.5 || high[1] < -0.5 {
            return Says::Nothing;
        }
        let seen = tiles.under([low[0], low[1]], [high[0], high[1]]);
        if low[2] - truncation > seen.depth[1] {
            return Says::Nothing;
        }
        if high[2] + 1.01 * truncation >= seen.depth[0] {
            return Says::Surface;
        }
        let whole = low[0] >= 0.0 && low[1] >= 0.0 && high[0] <= width - 1.0 && high[1] <= height - 1.0;
        Says::Free([if whole { seen.weight[0] } else { 0.0 }, seen.weight[1]])
    }

    /// The same from the pixels under the block where their tiles do not tell.
    fn says_exactly(&self, view: &FusionView, tiles: &Tiles, truncation: f32) -> Says {
        let rough = self.says(tiles, truncation);
        let [low, high] = self.extent();
        if !matches!(rough, Says::Surface) || low[2] <= 0.0 {
            return rough;
        }
        let range = |a: usize, size: usize| {
            let pixel = |p: f32| (p.max(0.0) as usize).min(size - 1);
            pixel(low[a] - 1.0)..=pixel(high[a] + 1.5)
        };
        let mut weights = [f32::INFINITY, 0.0f32];
        for y in range(1, view.depth.height) {
            for x in range(0, view.depth.width) {
                let (depth, weight) = (view.depth.at(x, y), view.weight.at(x, y));
                let free = depth > high[2] + 1.01 * truncation;
                if !free && depth >= low[2] - truncation {
                    return Says::Surface;
                }
                let weight = if free { weight } else { 0.0 };
                weights = [weights[0].min(weight), weights[1].max(weight)];
            }
        }
        if weights[1] > 0.0 { Says::Free([0.0, weights[1]]) } else { Says::Nothing }
    }
}

/// What a view says of a block.
enum Says {
    /// It falls off the image, or lies more than τ behind all that is seen there.
    Nothing,
    /// It lies more than τ before all that is seen there; least and greatest weight of that.
    Free([f32; 2]),
    /// A surface may be near.
    Surface,
}

/// Least and greatest depth, of the pixels that have any, and weight, 0 without depth, of a part of a depth map.
#[derive(Clone, Copy)]
struct Extremes {
    depth: [f32; 2],
    weight: [f32; 2],
}

impl Extremes {
    const NONE: Self = Self { depth: [f32::INFINITY, 0.0], weight: [f32::INFINITY, 0.0] };

    fn and(self, other: Self) -> Self {
        let join = |a: [f32; 2], b: [f32; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        Self { depth: join(self.depth, other.depth), weight: join(self.weight, other.weight) }
    }

    fn of(depth: f32, weight: f32) -> Self {
        if depth > 0.0 {
            Self { depth: [depth; 2], weight: [weight; 2] }
        } else {
            Self { weight: [0.0; 2], ..Self::NONE }
        }
    }
}

/// The extremes of each tile of a depth map.
struct Tiles {
    width: usize,
    height: usize,
    across: usize,
    extremes: Vec<Extremes>,
}

/// Pixels along a tile's side.
const TILE: usize = 16;

impl Tiles {
    fn of(view: &FusionView) -> Self {
        let (width, height) = (view.depth.width, view.depth.height);
        let across = width.div_ceil(TILE);
        let mut extremes = vec![Extremes::NONE; across * height.div_ceil(TILE)];
        let Cut { part, corner: [left, top], .. } = view.depth;
        for row in 0..part.height {
            let above = (top + row) / TILE * across;
            for (column, (&depth, &weight)) in part.row(row).iter().zip(view.weight.part.row(row)).enumerate() {
                let tile = &mut extremes[above + (left + column) / TILE];
                *tile = tile.and(Extremes::of(depth, weight));
            }
        }
        Self { width, height, across, extremes }
    }

    /// The extremes of the tiles under a box of pixels, one pixel wider for interpolation.
    fn under(&self, low: [f32; 2], high: [f32; 2]) -> Extremes {
        let tile = |p: f32, size: usize| (p.max(0.0) as usize).min(size - 1) / TILE;
        let (x0, x1) = (tile(low[0] - 1.0, self.width), tile(high[0] + 1.5, self.width));
        let (y0, y1) = (tile(low[1] - 1.0, self.height), tile(high[1] + 1.5, self.height));
        let rows = (y0..=y1).flat_map(|y| &self.extremes[y * self.across + x0..=y * self.across + x1]);
        rows.copied().fold(Extremes::NONE, Extremes::and)
    }
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn integrate(
    grid: &Grid,
    at: [u32; 3],
    views: &[FusionView],
    tiles: &[Tiles],
    params: &FusionParams,
    otherwise: &[f32; BLOCK],
    out: &mut [f32],
    bits: &mut Bits,
) {
    let inverse_truncation = (1.0 / params.truncation) as f32;
    let mut sum = [0.0f32; BLOCK];
    let mut total = [0.0f32; BLOCK];
    let mut near = [0.0f32; BLOCK];
    for (view, tiles) in views.iter().zip(tiles) {
        let stepper = Stepper::new(grid, at, &view.projection);
        if matches!(stepper.says(tiles, params.truncation as f32), Says::Nothing) {
            continue;
        }
        let rows = sum.as_chunks_mut::<SIDE>().0.iter_mut();
        let rows = rows.zip(total.as_chunks_mut::<SIDE>().0).zip(near.as_chunks_mut::<SIDE>().0);
        for (row, ((sum, total), near)) in rows.enumerate() {
            let (i, j) = ((row / SIDE) as f32, (row % SIDE) as f32);
            add_row(view, &stepper, i, j, inverse_truncation, params.free_weight, sum, total, near);
        }
    }
    // The inside of the hull is solid until enough observations, of surface or of free space, overrule it.
    for n in 0..BLOCK {
        let (least_near, least_free) =
            if otherwise[n] < 0.0 { (params.solid_weight, params.solid_weight) } else { (params.min_weight, 0.0) };
        let mean = sum[n] / total[n].max(1e-12);
        let known = total[n] > 0.0 && (near[n] >= least_near || (mean >= 0.0 && total[n] > least_free));
        out[n] = if known { mean } else { otherwise[n] };
        bits[n / 64] |= u64::from(known && total[n] >= MEASURED) << (n % 64);
    }
}

#[inline(always)]
fn add_row(
    view: &FusionView,
    stepper: &Stepper,
    i: f32,
    j: f32,
    inverse_truncation: f32,
    free_weight: f32,
    sum: &mut [f32; SIDE],
    total: &mut [f32; SIDE],
    near: &mut [f32; SIDE],
) {
    let base: [f32; 3] = std::array::from_fn(|r| stepper.base[r] + i * stepper.di[r] + j * stepper.dj[r]);
    let (mut u, mut v, mut z) = ([0.0f32; SIDE], [0.0f32; SIDE], [0.0f32; SIDE]);
    for k in 0..SIDE {
        let f = k as f32;
        z[k] = base[2] + f * stepper.dk[2];
        let inverse = 1.0 / z[k].max(1e-20);
        u[k] = (base[0] + f * stepper.dk[0]) * inverse;
        v[k] = (base[1] + f * stepper.dk[1]) * inverse;
    }
    let (mut depth, mut weight) = ([0.0f32; SIDE], [0.0f32; SIDE]);
    for k in 0..SIDE {
        if z[k] > 0.0 {
            (depth[k], weight[k]) = sample(view, u[k], v[k], z[k], inverse_truncation);
        }
    }
    for k in 0..SIDE {
        let distance = (depth[k] - z[k]) * inverse_truncation;
        let w = if distance < -1.0 {
            0.0
        } else if distance > 1.0 {
            weight[k] * free_weight
        } else {
            weight[k]
        };
        sum[k] += w * distance.clamp(-1.0, 1.0);
        total[k] += w;
        near[k] += if distance <= 1.0 { w } else { 0.0 };
    }
}

/// Depth and weight at a pixel position; weight 0 outside the image and where there is no depth. Between four pixels of
/// one surface the depth is interpolated, at a depth edge the nearest pixel counts.
#[inline(always)]
fn sample(view: &FusionView, u: f32, v: f32, z: f32, inverse_truncation: f32) -> (f32, f32) {
    let (w, h) = (view.depth.width, view.depth.height);
    if !(u >= -0.5 && v >= -0.5 && u < w as f32 - 0.5 && v < h as f32 - 0.5) {
        return (0.0, 0.0);
    }
    let (x, y) = ((u + 0.5) as usize, (v + 0.5) as usize);
    let (nearest, weight) = (view.depth.at(x, y), view.weight.at(x, y));
    if nearest <= 0.0 || (nearest - z) * inverse_truncation < -1.5 {
        return (nearest, if nearest > 0.0 { weight } else { 0.0 });
    }
    let (x0, y0) = (u.max(0.0) as usize, v.max(0.0) as usize);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let d = &view.depth;
    let (p, q, r, s) = (d.at(x0, y0), d.at(x1, y0), d.at(x0, y1), d.at(x1, y1));
    let low = p.min(q).min(r).min(s);
    let high = p.max(q).max(r).max(s);
    if low <= 0.0 || (high - low) * inverse_truncation > 1.0 {
        return (nearest, weight);
    }
    let (a, b) = (u.max(0.0) - x0 as f32, v.max(0.0) - y0 as f32);
    let top = p + a * (q - p);
    (top + b * (r + a * (s - r) - top), weight)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::Raster;

    /// A camera at (0, 0, -4) looking along +z, focal length 60, 64x64; a plane at z = 0 (depth 4).
    fn projection() -> [f64; 12] {
        [60., 0., 31.5, 126., 0., 60., 31.5, 126., 0., 0., 1., 4.]
    }

    const PARAMS: FusionParams = FusionParams {
        truncation: 0.2,
        free_weight: 1.0,
        min_weight: 0.0,
        solid_weight: 0.5,
        smoothing: 0.0,
        measured_smoothing: 0.0,
        hull_tolerance: 0.0,
        complete: false,
        hollow: false,
        max_memory: 1 << 30,
    };

    fn view<'a>(depth: &'a [f32], weight: &'a [f32], silhouette: Option<&'a [f32]>) -> FusionView<'a> {
        let raster = |d| Raster::new(d, 64, 64, "raster").unwrap().into();
        FusionView {
            depth: raster(depth),
            weight: raster(weight),
            silhouette: silhouette.map(raster),
            window: [0.0, 0.0, 63.0, 63.0],
            projection: projection(),
            focal: 60.0,
        }
    }

    fn grid() -> Grid {
        Grid::new([-1.0, -1.0, -1.0], 0.05, [41, 41, 41]).unwrap()
    }

    #[test]
    fn a_plane_becomes_its_distance() {
        let (depth, weight) = (vec![4.0f32; 64 * 64], vec![1.0f32; 64 * 64]);
        let view = view(&depth, &weight, None);
        let volume = fuse(grid(), &[view], &PARAMS).unwrap();
        assert!(!volume.map.coords.is_empty());
        for (c, block) in volume.map.coords.iter().zip(volume.values.chunks_exact(BLOCK)) {
            for (n, &v) in block.iter().enumerate() {
                let z = -1.0 + 0.05 * (c[2] as f32 * 8.0 + (n % 8) as f32);
                let expected = (-z / 0.2).min(1.0);
                if z > 0.2001 {
                    assert!(v.is_nan());
                } else if z < 0.1999 {
                    assert!((v - expected).abs() < 1e-4, "z {z}: {v} {expected}");
                }
            }
        }
    }

    #[test]
    fn the_hull_is_solid_where_no_depth_reaches() {
        let (depth, weight) = (vec![0.0f32; 64 * 64], vec![0.0f32; 64 * 64]);
        let outside: Vec<f32> =
            (0..64 * 64).map(|i| (((i % 64) as f32 - 31.5).hypot((i / 64) as f32 - 31.5)) - 6.0).collect();
        let view = view(&depth, &weight, Some(&outside));
        let volume = fuse(grid(), &[view], &PARAMS).unwrap();
        let value = |i: usize, j: usize, k: usize| {
            let slot = volume.map.at(i / 8, j / 8, k / 8) as usize;
            volume.values[slot * BLOCK + (i % 8) * 64 + (j % 8) * 8 + k % 8]
        };
        assert!(value(20, 20, 20) < -0.9);
        assert!(value(20, 29, 20) > 0.0); // 0.45 to the side: 6.75 px
    }

    #[test]
    fn a_hollow_hull_lacks_what_is_free_or_solid_throughout_and_nothing_else() {
        // A slanted plane is seen through a wide silhouette: free before it, solid behind it.
        let depth: Vec<f32> =
            (0..64 * 64).map(|i| if i % 64 < 40 { 3.9 + 0.004 * (i % 64) as f32 } else { 0.0 }).collect();
        let weight = vec![1.0f32; 64 * 64];
        let outside: Vec<f32> =
            (0..64 * 64).map(|i| (((i % 64) as f32 - 31.5).hypot((i / 64) as f32 - 31.5)) - 28.0).collect();
        let view = view(&depth, &weight, Some(&outside));
        let grid = Grid::new([-1.0; 3], 0.02, [101; 3]).unwrap();
        let full = FusionParams { truncation: 0.06, smoothing: 1.5, ..PARAMS };
        let whole = fuse(grid, &[view], &full).unwrap();
        let hollow = fuse(grid, &[view], &FusionParams { hollow: true, ..full }).unwrap();
        let (mut free, mut solid) = (0, 0);
        for (n, c) in whole.map.coords.iter().enumerate() {
            let block = &whole.values[n * BLOCK..][..BLOCK];
            match hollow.map.at(c[0] as usize, c[1] as usize, c[2] as usize) {
                u32::MAX if block[0] > 0.0 => {
                    free += 1;
                    assert!(block.iter().all(|&v| v == 1.0), "{c:?}");
                }
                u32::MAX => {
                    solid += 1;
                    assert!(block.iter().all(|&v| v == -1.0), "{c:?}");
                }
                slot => {
                    let same = &hollow.values[slot as usize * BLOCK..][..BLOCK];
                    assert!(block.iter().zip(same).all(|(a, b)| a.to_bits() == b.to_bits()), "{c:?}");
                }
            }
        }
        assert!(free > 40 && solid > 40, "{free} {solid}");
    }

    #[test]
    fn a_hull_that_completes_stands_in_where_nothing_was_seen() {
        // The left half of a plane at z = 0 is seen; the silhouette is a disc.
        let depth: Vec<f32> = (0..64 * 64).map(|i| if i % 64 < 32 { 4.0 } else { 0.0 }).collect();
        let weight = vec![1.0f32; 64 * 64];
        let outside: Vec<f32> =
            (0..64 * 64).map(|i| (((i % 64) as f32 - 31.5).hypot((i / 64) as f32 - 31.5)) - 6.0).collect();
        let params = FusionParams { complete: true, ..PARAMS };
        let alone = fuse(grid(), &[view(&depth, &weight, None)], &PARAMS).unwrap();
        let volume = fuse(grid(), &[view(&depth, &weight, Some(&outside))], &params).unwrap();
        let value = |volume: &Volume, i: usize, j: usize, k: usize| {
            let slot = volume.map.at(i / 8, j / 8, k / 8);
            if slot == u32::MAX {
                return f32::NAN;
            }
            volume.values[slot as usize * BLOCK + (i % 8) * 64 + (j % 8) * 8 + k % 8]
        };
        // Unseen: solid within the disc, open just beside it, unknown far off.
        assert!(value(&alone, 22, 20, 20).is_nan());
        assert!(value(&volume, 22, 20, 20) < -0.9);
        assert!(value(&volume, 29, 20, 20) > 0.0);
        assert!(value(&volume, 38, 20, 20).is_nan());
        // Seen: the plane stays where the disc is not.
        for k in 14..24 {
            let (a, b) = (value(&alone, 4, 20, k), value(&volume, 4, 20, k));
            assert!(a == b || (a.is_nan() && b.is_nan()), "{k}: {a} {b}");
        }
        // In front of the plane the silhouette does not make it solid, as that was seen to be free.
        assert!(value(&volume, 16, 20, 14) > 0.9);
    }

    #[test]
    fn a_tile_holds_what_the_whole_holds() {
        let depth: Vec<f32> = (0..64 * 64).map(|i| 4.0 + 0.3 * ((i % 64) as f32 * 0.4).sin()).collect();
        let weight = vec![1.0f32; 64 * 64];
        let view = view(&depth, &weight, None);
        let params = FusionParams { smoothing: 1.5, ..PARAMS };
        let grid = Grid::new([-1.0; 3], 0.03, [67; 3]).unwrap();
        let whole = fuse(grid, &[view], &params).unwrap();
        let part = fuse_tile(grid, Tile { low: [2, 1, 0], high: [7, 6, 9] }, &[view], &params, &[]).unwrap();
        let mut inner = 0;
        for (c, block) in part.map.coords.iter().zip(part.values.chunks_exact(BLOCK)) {
            // One block from the tile's sides all that smoothing reads is there.
            if (3..6).contains(&c[0]) && (2..5).contains(&c[1]) && c[2] < 9 {
                let slot = whole.map.at(c[0] as usize, c[1] as usize, c[2] as usize) as usize;
                let same =
                    whole.values[slot * BLOCK..][..BLOCK].iter().zip(block).all(|(a, b)| a.to_bits() == b.to_bits());
                assert!(same, "{c:?}");
                inner += 1;
            }
        }
        assert!(inner > 10);
        let wrong = Tile { low: [0; 3], high: [10, 9, 9] };
        assert!(fuse_tile(grid, wrong, &[view], &params, &[]).unwrap_err().to_string().starts_with("tile"));
    }

    #[test]
    fn too_large_a_volume_is_refused() {
        let (depth, weight) = (vec![4.0f32; 64 * 64], vec![1.0f32; 64 * 64]);
        let view = view(&depth, &weight, None);
        let error = fuse(grid(), &[view], &FusionParams { max_memory: 4000, ..PARAMS }).unwrap_err();
        assert!(matches!(error, Error::OutOfMemory { .. }));
    }
}
