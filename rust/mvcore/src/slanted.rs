//! Slanted-window refinement: every pixel carries a plane, takes better ones over from its neighbours and improves it.
//!
//! ```text
//!   inverse depth over the window: w + a dx + b dy          ● ○ ● ○    all ● test the planes of ○ around them,
//!   so the window lands in a source as an affine patch      ○ ● ○ ●    then all ○ those of ●
//! ```
//!
//! The cost of a plane is 1 - ZNCC with bilateral weights, averaged over the best half of the sources, plus a bounded pull
//! towards a prior (the semi-global solution) that decides where the photographs do not. Where the sources' own depth maps are
//! known, a source's cost grows with the distance by which the point, carried to that source's surface and back, misses its
//! pixel. PatchMatch stereo: Bleyer, Rhemann and Rother, BMVC 2011; the checkerboard: Galliani, Lasinger and Schindler, ICCV
//! 2015; geometric consistency: Schönberger et al., ECCV 2016. Random numbers are a hash of pixel and iteration: the same bytes
//! for any thread count.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::patch::{Affine, GREY_ZERO, OFFSETS, Quads, SAMPLES, SumsOf, Window, sums_for_this_cpu};
use crate::raster::{Epipolar, Raster};
use rayon::prelude::*;

/// A pixel's plane: inverse depth, its slope along x and y per pixel, and the cost.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Hypothesis {
    /// Inverse depth at the pixel's centre; 0 means none.
    pub w: f32,
    /// d w / d x.
    pub a: f32,
    /// d w / d y.
    pub b: f32,
    /// Matching cost with the prior's share, 0 (perfect) to about 1 (unrelated) or more.
    pub cost: f32,
}

/// A source's own surface.
#[derive(Debug, Clone, Copy)]
pub struct SourceSurface<'a> {
    /// z-depth in the source view, 0 means none; the size of its image.
    pub depth: Raster<'a, f32>,
    /// Source pixel and inverse depth to the reference.
    pub back: Epipolar,
}

/// What [`refine`] may do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineParams {
    /// Rounds of propagation and perturbation.
    pub iterations: usize,
    /// Inverse depths allowed: (least, greatest).
    pub range: (f32, f32),
    /// Inverse depth that moves a source pixel by about one pixel.
    pub step: f32,
    /// Largest |slope| relative to the inverse depth, per pixel (tan of the largest slant over the focal length).
    pub max_slope: f32,
    /// Greatest cost that the prior adds, at `prior_reach` steps.
    pub prior_weight: f32,
    /// Distance in steps at which the prior's pull is at its bound.
    pub prior_reach: f32,
    /// Cost of missing the sources' surfaces by [`GEOMETRY_REACH`] pixels or more.
    pub geometry_weight: f32,
    /// Whether adjacent pixels' planes are tried as well: a solution carried up from half the size has the same ones there.
    pub adjacent: bool,
}

/// Pixels of reprojection error at which the geometric cost is at its bound.
const GEOMETRY_REACH: f32 = 3.0;

/// Variance of sensor noise in squared grey levels, as in the sweep.
const NOISE_VARIANCE: f32 = 2.0;
/// Grey levels over which a window sample's weight falls by e.
const COLOUR_SIGMA: f32 = 16.0;
/// Pixels over which it falls by e^(1/2).
const SPACE_SIGMA: f32 = 4.0;
/// A source's cost is cut here: an occluded one must not outweigh the others.
const COST_LIMIT: f32 = 1.2;
/// Cost of a plane that no source sees.
const UNSEEN: f32 = 1.0;
/// Steps from a plane at which its cost is measured for the parabola: where it still curves upwards.
const ASIDE: f32 = 0.4;
/// Steps a pixel by which slopes are varied.
const SLOPE_CHANGE: f32 = 0.1;
/// Most source views; more than enough, and it keeps the costs on the stack.
const MAX_SOURCES: usize = 16;

/// Improves the planes of `init` (h·w, row-major) in place of a copy; `prior` holds inverse depths, 0 where there is none. A pixel
/// without a plane starts from its prior; with neither it is left alone.
pub fn refine(
    reference: Raster<u8>,
    sources: &[(Raster<u8>, Epipolar)],
    surfaces: &[SourceSurface],
    init: &[Hypothesis],
    prior: &[f32],
    params: &RefineParams,
) -> Result<Vec<Hypothesis>> {
    let n = reference.width * reference.height;
    require(!sources.is_empty() && sources.len() <= MAX_SOURCES, "sources", "1 to 16 source views", sources.len())?;
    require(init.len() == n, "init", format!("{n} planes"), init.len())?;
    require(prior.len() == n, "prior", format!("{n} values"), prior.len())?;
    require(params.step > 0.0 && params.step.is_finite(), "step", "a positive number", params.step)?;
    let (low, high) = params.range;
    require(low < high && high.is_finite(), "range", "least below greatest", format!("{low} .. {high}"))?;
    let fits = surfaces.is_empty() || surfaces.len() == sources.len();
    require(fits, "surfaces", format!("none or {}, one a source", sources.len()), surfaces.len())?;
    for (surface, (image, _)) in surfaces.iter().zip(sources) {
        let same = surface.depth.width == image.width && surface.depth.height == image.height;
        require(same, "surfaces", "depth maps of the sources' sizes", "another size")?;
    }
    let quads: Vec<_> = sources.iter().map(|(image, map)| (Quads::new(*image), *map)).collect();
    let scene = Scene { reference, sources: &quads, surfaces, prior, params, sums: sums_for_this_cpu() };
    let mut now = init.to_vec();
    if params.iterations == 0 {
        scene.each_pixel(&mut now, |_| true, |_, view, h| Hypothesis { cost: scene.shortlist(view, h).1, ..h });
    }
    for iteration in 0..params.iterations {
        for colour in 0..2 {
            let before = now.clone();
            let mine = |(x, y): (usize, usize)| (x + y) % 2 == colour;
            scene.each_pixel(&mut now, mine, |pixel, view, h| scene.improve(&before, pixel, view, h, iteration));
        }
    }
    Ok(now)
}

struct Scene<'a> {
    reference: Raster<'a, u8>,
    sources: &'a [(Quads, Epipolar)],
    surfaces: &'a [SourceSurface<'a>],
    prior: &'a [f32],
    params: &'a RefineParams,
    sums: SumsOf,
}

/// What a window of the reference view looks like, ready to be compared.
struct View {
    window: Window,
    x: f32,
    y: f32,
    mean: f32,
    variance: f32,
    prior: f32,
    /// The sources asked: the first `asked.1` of `asked.0`.
    asked: ([u8; MAX_SOURCES], usize),
}

/// Neighbours whose planes are tried, the adjacent ones last; all of the other colour of the checkerboard.
const NEIGHBOURS: [(i32, i32); 8] = [(-5, 0), (5, 0), (0, -5), (0, 5), (-1, 0), (1, 0), (0, -1), (0, 1)];

impl Scene<'_> {
    fn each_pixel(
        &self,
        planes: &mut [Hypothesis],
        chosen: impl Fn((usize, usize)) -> bool + Sync,
        f: impl Fn((usize, usize), &mut View, Hypothesis) -> Hypothesis + Sync,
    ) {
        let width = self.reference.width;
        let interrupt = Interrupt::current();
        planes.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            interrupt.poll();
            for (x, h) in row.iter_mut().enumerate().filter(|(x, _)| chosen((*x, y))) {
                if h.w == 0.0 {
                    *h = Hypothesis { w: self.prior[y * width + x], ..Default::default() };
                }
                if h.w == 0.0 {
                    continue;
                }
                let mut view = self.view(x, y);
                *h = f((x, y), &mut view, *h);
            }
        });
    }

    fn view(&self, x: usize, y: usize) -> View {
        let image = self.reference;
        let centre = image.data[y * image.width + x];
        let (colour, space) = (&*COLOUR_WEIGHT, &*SPACE_WEIGHT);
        let mut window = Window { weight: [0.0; SAMPLES], weighted: [0.0; SAMPLES] };
        let (dx, dy, n) = (&OFFSETS.0, &OFFSETS.1, OFFSETS.2);
        let mut total = 0.0;
        for i in 0..n {
            let u = (x as i32 + dx[i] as i32).clamp(0, image.width as i32 - 1) as usize;
            let v = (y as i32 + dy[i] as i32).clamp(0, image.height as i32 - 1) as usize;
            let grey = image.data[v * image.width + u];
            let weight = colour[grey.abs_diff(centre) as usize] * space[i];
            window.weight[i] = weight;
            window.weighted[i] = f32::from(grey) - GREY_ZERO;
            total += weight;
        }
        let (mut mean, mut square) = (0.0, 0.0);
        for i in 0..n {
            window.weight[i] /= total;
            let grey = window.weighted[i];
            window.weighted[i] *= window.weight[i];
            mean += window.weighted[i];
            square += window.weighted[i] * grey;
        }
        let variance = (square - mean * mean).max(0.0) + NOISE_VARIANCE;
        View {
            window,
            x: x as f32,
            y: y as f32,
            mean,
            variance,
            prior: self.prior[y * image.width + x],
            asked: ([0; MAX_SOURCES], 0),
        }
    }

    /// Tries the neighbours' planes, then a small change of the best one.
    fn improve(
        &self,
        before: &[Hypothesis],
        (x, y): (usize, usize),
        view: &mut View,
        mut best: Hypothesis,
        iteration: usize,
    ) -> Hypothesis {
        (view.asked, best.cost) = self.shortlist(view, best);
        let view = &*view;
        let (w, h) = (self.reference.width as i32, self.reference.height as i32);
        let tried = if self.params.adjacent { &NEIGHBOURS[..] } else { &NEIGHBOURS[..4] };
        for &(dx, dy) in tried {
            let (u, v) = (x as i32 + dx, y as i32 + dy);
            if u < 0 || v < 0 || u >= w || v >= h {
                continue;
            }
            let n = before[(v * w + u) as usize];
            if n.w == 0.0 {
                continue;
            }
            self.try_plane(view, &mut best, Hypothesis { w: n.w - n.a * dx as f32 - n.b * dy as f32, ..n });
        }
        let mut random = Random::at(x, y, iteration);
        let step = self.params.step;
        let (w, a, b) = (self.vertex(view, best), best.a, best.b);
        let [a, b] = [a, b].map(|slope| slope + SLOPE_CHANGE * step * random.signed());
        self.try_plane(view, &mut best, Hypothesis { w, a, b, cost: 0.0 });
        best
    }

    /// Inverse depth at the vertex of the parabola through a plane's cost and those on either side of it.
    fn vertex(&self, view: &View, plane: Hypothesis) -> f32 {
        let aside = ASIDE * self.params.step;
        let [below, above] = [-aside, aside].map(|d| self.cost(view, Hypothesis { w: plane.w + d, ..plane }));
        let curvature = below - 2.0 * plane.cost + above;
        let shift = if curvature > 1e-6 { 0.5 * (below - above) / curvature } else { (below - above).signum() };
        plane.w + aside * shift.clamp(-1.5, 1.5)
    }

    fn try_plane(&self, view: &View, best: &mut Hypothesis, mut plane: Hypothesis) {
        let (low, high) = self.params.range;
        let step = self.params.step;
        let same = (plane.w - best.w).abs() < 0.03 * step
            && (plane.a - best.a).abs() < 0.01 * step
            && (plane.b - best.b).abs() < 0.01 * step;
        let limit = self.params.max_slope * plane.w.abs().max(step);
        if same || plane.w < low || plane.w > high || plane.a.abs() > limit || plane.b.abs() > limit {
            return;
        }
        plane.cost = self.cost_below(best.cost, view, plane);
        if plane.cost < best.cost {
            *best = plane;
        }
    }

    fn cost(&self, view: &View, plane: Hypothesis) -> f32 {
        self.cost_below(f32::INFINITY, view, plane)
    }

    /// A plane's cost; infinity where it is found not to lie below `limit` before the last source is asked.
    fn cost_below(&self, limit: f32, view: &View, plane: Hypothesis) -> f32 {
        let pull = self.pull(view, plane);
        let Some((&last, first)) = view.asked.0[..view.asked.1].split_last() else { return UNSEEN + pull };
        let mut kept = Lowest { wanted: self.wanted(), ..Default::default() };
        for &n in first {
            kept.add(self.cost_in(n.into(), view, plane));
        }
        // At best the last one costs nothing and takes the place of the greatest.
        let least = Lowest { seen: kept.seen + 1, ..kept };
        if least.mean() + pull >= limit {
            return f32::INFINITY;
        }
        kept.add(self.cost_in(last.into(), view, plane));
        kept.mean() + pull
    }

    /// Sources of which the mean is taken.
    fn wanted(&self) -> usize {
        self.sources.len().div_ceil(2)
    }

    /// What the prior adds.
    fn pull(&self, view: &View, plane: Hypothesis) -> f32 {
        if view.prior == 0.0 {
            return 0.0;
        }
        let distance = (plane.w - view.prior).abs() / (self.params.step * self.params.prior_reach);
        self.params.prior_weight * distance.min(1.0)
    }

    /// Cost of a plane in one source; `None` where that does not see it.
    #[inline(always)]
    fn cost_in(&self, n: usize, view: &View, plane: Hypothesis) -> Option<f32> {
        let (source, map) = &self.sources[n];
        let at = land(map, view.x, view.y, plane).filter(|at| source.sees(at.u, at.v))?;
        let [s, ss, rs] = (self.sums)(source, &view.window, at);
        let variance = (ss - s * s).max(0.0) + NOISE_VARIANCE;
        let zncc = (rs - view.mean * s) / (view.variance * variance).sqrt();
        let photo = (1.0 - zncc).min(COST_LIMIT);
        let missed = self.surfaces.get(n).map_or(0.0, |surface| miss(surface, view, at).min(GEOMETRY_REACH));
        Some(photo + self.params.geometry_weight * missed / GEOMETRY_REACH)
    }

    /// The sources that see the pixel's present plane best, half of them and one more, and the plane's cost.
    fn shortlist(&self, view: &View, plane: Hypothesis) -> (([u8; MAX_SOURCES], usize), f32) {
        let mut ranked = [(f32::MAX, 0); MAX_SOURCES];
        let count = self.sources.len();
        for (n, slot) in ranked[..count].iter_mut().enumerate() {
            *slot = (self.cost_in(n, view, plane).unwrap_or(f32::MAX), n as u8);
        }
        ranked[..count].sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut kept = Lowest { wanted: self.wanted(), ..Default::default() };
        for (cost, _) in &ranked[..kept.wanted] {
            kept.add((*cost < f32::MAX).then_some(*cost));
        }
        ((ranked.map(|(_, n)| n), count.min(kept.wanted + 1)), kept.mean() + self.pull(view, plane))
    }
}

/// The lowest `wanted` costs among no more than one more than these.
#[derive(Debug, Clone, Copy, Default)]
struct Lowest {
    wanted: usize,
    seen: usize,
    sum: f32,
    greatest: f32,
}

impl Lowest {
    #[inline(always)]
    fn add(&mut self, cost: Option<f32>) {
        let Some(cost) = cost else { return };
        self.seen += 1;
        self.sum += cost;
        self.greatest = self.greatest.max(cost);
    }

    #[inline(always)]
    fn mean(&self) -> f32 {
        match self.seen {
            0 => UNSEEN,
            n if n <= self.wanted => self.sum / n as f32,
            _ => (self.sum - self.greatest) / self.wanted as f32,
        }
    }
}

/// The window of a pixel with `plane` in a source view, to first order; `None` behind the camera.
#[inline(always)]
fn land(map: &Epipolar, x: f32, y: f32, plane: Hypothesis) -> Option<Affine> {
    let (m, o) = (&map.matrix, &map.offset);
    let q: [f32; 3] = std::array::from_fn(|i| m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] + plane.w * o[i]);
    if q[2] <= 1e-9 {
        return None;
    }
    let inverse = 1.0 / q[2];
    let (u, v) = (q[0] * inverse, q[1] * inverse);
    let d = |i: usize, slope: f32, axis: usize| m[3 * i + axis] + slope * o[i];
    let along = |slope: f32, axis: usize| {
        let z = d(2, slope, axis);
        ((d(0, slope, axis) - u * z) * inverse, (d(1, slope, axis) - v * z) * inverse)
    };
    let ((ux, vx), (uy, vy)) = (along(plane.a, 0), along(plane.b, 1));
    Some(Affine { u, v, jacobian: [ux, vx, uy, vy] })
}

/// Pixels by which the source's surface at `at`, seen from the reference view, misses the view's pixel.
#[inline(always)]
fn miss(surface: &SourceSurface, view: &View, at: Affine) -> f32 {
    let depth = surface.depth.data[(at.v + 0.5) as usize * surface.depth.width + (at.u + 0.5) as usize];
    if depth <= 0.0 {
        return GEOMETRY_REACH;
    }
    let (m, o) = (&surface.back.matrix, &surface.back.offset);
    let q: [f32; 3] = std::array::from_fn(|i| m[3 * i] * at.u + m[3 * i + 1] * at.v + m[3 * i + 2] + o[i] / depth);
    if q[2] <= 1e-9 {
        return GEOMETRY_REACH;
    }
    let (dx, dy) = (q[0] / q[2] - view.x, q[1] / q[2] - view.y);
    (dx * dx + dy * dy).sqrt()
}

/// SplitMix64 of pixel and iteration.
struct Random(u64);

impl Random {
    fn at(x: usize, y: usize, iteration: usize) -> Self {
        Self(((x as u64) << 40) ^ ((y as u64) << 16) ^ iteration as u64)
    }

    /// Uniform in -1 .. 1.
    fn signed(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z >> 40) as f32) / (1u64 << 23) as f32 - 1.0
    }
}

static COLOUR_WEIGHT: std::sync::LazyLock<[f32; 256]> =
    std::sync::LazyLock::new(|| std::array::from_fn(|step| (-(step as f32) / COLOUR_SIGMA).exp()));

static SPACE_WEIGHT: std::sync::LazyLock<[f32; SAMPLES]> = std::sync::LazyLock::new(|| {
    std::array::from_fn(|i| {
        let square = OFFSETS.0[i] * OFFSETS.0[i] + OFFSETS.1[i] * OFFSETS.1[i];
        (-square / (2.0 * SPACE_SIGMA * SPACE_SIGMA)).exp()
    })
});

#[cfg(test)]
mod tests {
    use super::*;

    const PAIR: Epipolar = Epipolar { matrix: [1., 0., 0., 0., 1., 0., 0., 0., 1.], offset: [-1., 0., 0.] };
    const PARAMS: RefineParams = RefineParams {
        iterations: 4,
        range: (0.5, 20.0),
        step: 1.0,
        max_slope: 0.5,
        prior_weight: 0.0,
        prior_reach: 2.0,
        geometry_weight: 0.0,
        adjacent: true,
    };

    /// Smooth texture that can be sampled anywhere.
    fn shade(x: f32, y: f32) -> u8 {
        let v = (x * 0.71).sin() + (y * 0.53 + x * 0.31).sin() + (x * 0.23 - y * 0.87).sin();
        (127.0 + 40.0 * v) as u8
    }

    #[test]
    fn a_slanted_plane_is_found_to_a_fraction_of_a_pixel() {
        let (w, h) = (80, 50);
        // disparity 4 + 0.12 x: right(x - d(x)) = left(x), so left is sampled from the right image's texture
        let disparity = |x: f32| 4.0 + 0.12 * x;
        let left: Vec<u8> =
            (0..w * h).map(|i| shade((i % w) as f32 - disparity((i % w) as f32), (i / w) as f32)).collect();
        let right: Vec<u8> = (0..w * h).map(|i| shade((i % w) as f32, (i / w) as f32)).collect();
        let left = Raster::new(&left, w, h, "reference").unwrap();
        let right = Raster::new(&right, w, h, "source").unwrap();
        let init: Vec<_> = (0..w * h)
            .map(|i| Hypothesis {
                w: disparity((i % w) as f32) + if i % 3 == 0 { 0.8 } else { -0.6 },
                ..Default::default()
            })
            .collect();
        let prior = vec![0.0; w * h];
        let planes = refine(left, &[(right, PAIR)], &[], &init, &prior, &PARAMS).unwrap();
        let mut errors: Vec<f32> = (6..h - 6)
            .flat_map(|y| (20..w - 6).map(move |x| (x, y)))
            .map(|(x, y)| (planes[y * w + x].w - disparity(x as f32)).abs())
            .collect();
        errors.sort_unstable_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.05, "median {}", errors[errors.len() / 2]);
        assert!(errors[errors.len() * 95 / 100] < 0.3, "95 % {}", errors[errors.len() * 95 / 100]);
    }

    #[test]
    fn costs_are_exact_below_the_limit_and_no_less_above_it() {
        let (w, h) = (40, 30);
        let images: Vec<Vec<u8>> = (0..5)
            .map(|n| (0..w * h).map(|i| shade((i % w + 2 * n) as f32, (i / w + n * n) as f32)).collect())
            .collect();
        let rasters: Vec<_> = images.iter().map(|i| Raster::new(i, w, h, "image").unwrap()).collect();
        let quads: Vec<_> = rasters[1..].iter().map(|r| (Quads::new(*r), PAIR)).collect();
        let prior = vec![3.0; w * h];
        let params = RefineParams { prior_weight: 0.1, ..PARAMS };
        let sums = sums_for_this_cpu();
        let scene =
            Scene { reference: rasters[0], sources: &quads, surfaces: &[], prior: &prior, params: &params, sums };
        let mut view = scene.view(20, 15);
        view.asked = scene.shortlist(&view, Hypothesis { w: 2.0, ..Default::default() }).0;
        let mut stopped = 0;
        for step in 0..60 {
            let plane = Hypothesis { w: 0.5 + 0.3 * step as f32, ..Default::default() };
            let cost = scene.cost(&view, plane);
            for limit in [0.3, 0.6, 0.9, 1.2] {
                let found = scene.cost_below(limit, &view, plane);
                assert!(found == cost || (found == f32::INFINITY && cost >= limit), "{found} for {cost} below {limit}");
                stopped += usize::from(found == f32::INFINITY);
            }
        }
        assert!(stopped > 20, "{stopped}");
    }

    #[test]
    fn where_the_photographs_say_nothing_the_prior_decides() {
        let (w, h) = (24, 16);
        let grey = vec![90u8; w * h];
        let image = Raster::new(&grey, w, h, "image").unwrap();
        let init = vec![Hypothesis { w: 7.0, ..Default::default() }; w * h];
        let params = RefineParams { prior_weight: 0.1, ..PARAMS };
        let planes = refine(image, &[(image, PAIR)], &[], &init, &vec![6.0; w * h], &params).unwrap();
        let mean = planes.iter().map(|p| p.w).sum::<f32>() / (w * h) as f32;
        assert!((mean - 6.0).abs() < 0.1, "{mean}");
    }

    #[test]
    fn the_sources_own_surface_decides_too() {
        let (w, h) = (24, 16);
        let grey = vec![90u8; w * h];
        let image = Raster::new(&grey, w, h, "image").unwrap();
        let init = vec![Hypothesis { w: 7.0, ..Default::default() }; w * h];
        // The source has the plane at disparity 6; its z-depth is the inverse.
        let depth = vec![1.0 / 6.0f32; w * h];
        let back = Epipolar { matrix: PAIR.matrix, offset: [1., 0., 0.] };
        let surface = SourceSurface { depth: Raster::new(&depth, w, h, "depth").unwrap(), back };
        let params = RefineParams { geometry_weight: 0.2, ..PARAMS };
        let planes = refine(image, &[(image, PAIR)], &[surface], &init, &vec![0.0; w * h], &params).unwrap();
        let inner: Vec<f32> = (0..w * h).filter(|i| i % w > 8).map(|i| planes[i].w).collect();
        let mean = inner.iter().sum::<f32>() / inner.len() as f32;
        assert!((mean - 6.0).abs() < 0.1, "{mean}");
    }

    #[test]
    fn wrong_input_is_named() {
        let grey = [0u8; 16];
        let image = Raster::new(&grey, 4, 4, "image").unwrap();
        let error = refine(image, &[(image, PAIR)], &[], &[], &[0.0; 16], &PARAMS).unwrap_err();
        assert!(error.to_string().starts_with("init:"));
    }
}
