//! Plane sweep: how well does every pixel of the reference view fit the source views at each of D depths?
//!
//! ```text
//!   for each band of rows │ for each plane │ for each source:
//!     warp the source onto the plane ──► census 9×9 (40 comparisons) + ZNCC 7×7 ──► cost of this source
//!   the best half of the sources is averaged (an occluded source is not asked) ──► cost[y][x][plane]
//! ```
//!
//! Costs are `0 ..= MAX_COST`, layout (h, w, D) so that the aggregation reads a pixel's planes in one go; a pixel that no
//! source sees at a plane gets the neutral [`UNSEEN`]. Census after Zabih and Woodfill (ECCV 1994), plane sweep after
//! Collins (CVPR 1996), best half after Kang, Szeliski and Chai (CVPR 2001).

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::patch::Quads;
use crate::raster::{Epipolar, Raster};
use multiversion::multiversion;
use rayon::prelude::*;

/// The largest cost of a plane.
pub const MAX_COST: u8 = 64;
/// The cost of a plane at which no source sees the pixel: that of an unrelated patch.
pub const UNSEEN: u8 = 48;

const CENSUS_RADIUS: usize = 4;
const ZNCC_RADIUS: usize = 3;
const HALO: usize = CENSUS_RADIUS;
const BAND: usize = 16;
/// Hamming distances beyond this say no more than "different".
const CENSUS_LIMIT: u8 = 24;
/// Weight of (1 - ZNCC) in cost units; 1 is the cost of uncorrelated patches.
const ZNCC_SCALE: f32 = 40.0;
/// Variance of sensor noise in squared grey levels: patches flatter than this do not correlate.
const NOISE_VARIANCE: f32 = 2.0;
const INVALID: u8 = 255;

/// Matching costs of `reference` (h, w) against `sources` over `planes` (inverse depths): (h, w, D) bytes.
///
/// `best` sources are averaged; `0` means half of them, rounded up.
pub fn sweep(
    reference: Raster<u8>,
    sources: &[(Raster<u8>, Epipolar)],
    planes: &[f32],
    best: usize,
) -> Result<Vec<u8>> {
    require(!sources.is_empty(), "sources", "at least one source view", "none")?;
    require(!planes.is_empty(), "planes", "at least one plane", "none")?;
    require(planes.iter().all(|w| w.is_finite()), "planes", "finite inverse depths", "NaN or infinity")?;
    let best = if best == 0 { sources.len().div_ceil(2) } else { best.min(sources.len()) };
    let (w, h, d) = (reference.width, reference.height, planes.len());
    let sources: Vec<_> = sources.iter().map(|(image, map)| (Quads::new(*image), *map)).collect();
    let mut costs = vec![0u8; w * h * d];
    let interrupt = Interrupt::current();
    costs.par_chunks_mut(BAND * w * d).enumerate().for_each(|(i, out)| {
        sweep_band(reference, &sources, planes, best, i * BAND, &interrupt, out);
    });
    Ok(costs)
}

/// A patch of rows with a halo on all sides, clamped at the borders of the raster it was taken from.
struct Strip {
    data: Vec<u8>,
    stride: usize,
}

impl Strip {
    fn new(width: usize, rows: usize) -> Self {
        let stride = width + 2 * HALO;
        Self { data: vec![0; stride * (rows + 2 * HALO)], stride }
    }

    #[inline(always)]
    fn row(&self, y: usize) -> &[u8] {
        &self.data[y * self.stride..(y + 1) * self.stride]
    }
}

/// Census neighbours: every other pixel of the 9×9 window, centre left out.
const OFFSETS: [(i32, i32); 40] = {
    let (mut out, mut n, mut dy) = ([(0, 0); 40], 0, -4i32);
    while dy <= 4 {
        let mut dx = -4i32;
        while dx <= 4 {
            if (dx + dy) % 2 == 0 && (dx != 0 || dy != 0) {
                out[n] = (dx, dy);
                n += 1;
            }
            dx += 1;
        }
        dy += 1;
    }
    out
};

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn sweep_band(
    reference: Raster<u8>,
    sources: &[(Quads, Epipolar)],
    planes: &[f32],
    best: usize,
    y0: usize,
    interrupt: &Interrupt,
    out: &mut [u8],
) {
    let (w, d) = (reference.width, planes.len());
    let rows = out.len() / (w * d);
    let strip = clamped_strip(reference, y0, rows);
    let signs = census_signs(&strip, w, rows);
    let moments = Moments::of(&strip, w, rows);
    let mut warped = Strip::new(w, rows);
    let mut valid = vec![0u8; w * rows];
    let mut cost = vec![0u8; w * rows];
    let mut lowest = vec![INVALID; best * w * rows];
    let mut scratch = Sums::new(w);
    let mut taps = Taps::new(warped.stride);
    for (plane, &inverse_depth) in planes.iter().enumerate() {
        interrupt.poll();
        lowest.fill(INVALID);
        for (source, map) in sources {
            warp(source, map, inverse_depth, y0 as f32, w, rows, &mut taps, &mut warped, &mut valid);
            census_cost(&warped, &signs, w, rows, &mut cost);
            add_zncc(&strip, &warped, &moments, w, rows, &mut scratch, &mut cost);
            for (c, &v) in cost.iter_mut().zip(&valid) {
                *c |= v; // 255 where the source does not see the plane
            }
            keep_lowest(&mut cost, &mut lowest);
        }
        mean_of_kept(&lowest, &mut cost);
        for (line, &c) in out.chunks_exact_mut(d).zip(&cost) {
            line[plane] = c;
        }
    }
}

#[inline(always)]
fn clamped_strip(image: Raster<u8>, y0: usize, rows: usize) -> Strip {
    let mut strip = Strip::new(image.width, rows);
    let stride = strip.stride;
    for (r, line) in strip.data.chunks_exact_mut(stride).enumerate() {
        let y = (y0 + r).saturating_sub(HALO).min(image.height - 1);
        let from = image.row(y);
        line[..HALO].fill(from[0]);
        line[HALO..HALO + image.width].copy_from_slice(from);
        line[HALO + image.width..].fill(from[image.width - 1]);
    }
    strip
}

/// For every neighbour and pixel: 1 where the neighbour is brighter than the centre.
#[inline(always)]
fn census_signs(strip: &Strip, w: usize, rows: usize) -> Vec<u8> {
    let mut signs = vec![0u8; OFFSETS.len() * w * rows];
    for (k, &(dx, dy)) in OFFSETS.iter().enumerate() {
        for y in 0..rows {
            let centre = &strip.row(y + HALO)[HALO..HALO + w];
            let x0 = (HALO as i32 + dx) as usize;
            let other = &strip.row((y as i32 + HALO as i32 + dy) as usize)[x0..x0 + w];
            let line = &mut signs[(k * rows + y) * w..][..w];
            for x in 0..w {
                line[x] = u8::from(other[x] > centre[x]);
            }
        }
    }
    signs
}

#[inline(always)]
fn census_cost(warped: &Strip, signs: &[u8], w: usize, rows: usize, cost: &mut [u8]) {
    cost.fill(0);
    for y in 0..rows {
        let centre = &warped.row(y + HALO)[HALO..HALO + w];
        let line = &mut cost[y * w..][..w];
        for (k, &(dx, dy)) in OFFSETS.iter().enumerate() {
            let x0 = (HALO as i32 + dx) as usize;
            let other = &warped.row((y as i32 + HALO as i32 + dy) as usize)[x0..x0 + w];
            let sign = &signs[(k * rows + y) * w..][..w];
            for x in 0..w {
                line[x] += u8::from(other[x] > centre[x]) ^ sign[x];
            }
        }
        for c in line {
            *c = (*c).min(CENSUS_LIMIT);
        }
    }
}

/// Mean and inverse deviation of the reference patch around every pixel.
struct Moments {
    mean: Vec<f32>,
    inverse_deviation: Vec<f32>,
}

const PATCH: f32 = ((2 * ZNCC_RADIUS + 1) * (2 * ZNCC_RADIUS + 1)) as f32;

impl Moments {
    #[inline(always)]
    fn of(strip: &Strip, w: usize, rows: usize) -> Self {
        let mut sums = Sums::new(w);
        let mut out = Self { mean: vec![0.0; w * rows], inverse_deviation: vec![0.0; w * rows] };
        for y in 0..rows {
            sums.advance(strip, strip, y);
            for x in 0..w {
                let (s, ss, _) = sums.window(x);
                let mean = s as f32 / PATCH;
                let variance = (ss as f32 / PATCH - mean * mean).max(0.0) + NOISE_VARIANCE;
                out.mean[y * w + x] = mean;
                out.inverse_deviation[y * w + x] = 1.0 / variance.sqrt();
            }
        }
        out
    }
}

/// Running column sums of s, s² and r·s over the rows of the patch.
struct Sums {
    s: Vec<i32>,
    ss: Vec<i32>,
    rs: Vec<i32>,
}

impl Sums {
    fn new(w: usize) -> Self {
        let n = w + 2 * ZNCC_RADIUS;
        Self { s: vec![0; n], ss: vec![0; n], rs: vec![0; n] }
    }

    /// Moves the column sums to band row `y`; row 0 starts anew.
    #[inline(always)]
    fn advance(&mut self, r: &Strip, s: &Strip, y: usize) {
        if y == 0 {
            self.s.fill(0);
            self.ss.fill(0);
            self.rs.fill(0);
            for k in 0..2 * ZNCC_RADIUS {
                self.add::<1>(r, s, k + HALO - ZNCC_RADIUS);
            }
        } else {
            self.add::<-1>(r, s, y - 1 + HALO - ZNCC_RADIUS);
        }
        self.add::<1>(r, s, y + HALO + ZNCC_RADIUS);
    }

    #[inline(always)]
    fn add<const SIGN: i32>(&mut self, r: &Strip, s: &Strip, row: usize) {
        let n = self.s.len();
        let r = &r.row(row)[HALO - ZNCC_RADIUS..][..n];
        let s = &s.row(row)[HALO - ZNCC_RADIUS..][..n];
        let (a, b, c) = (&mut self.s[..n], &mut self.ss[..n], &mut self.rs[..n]);
        for x in 0..n {
            let (p, q) = (i32::from(r[x]), i32::from(s[x]));
            a[x] += SIGN * q;
            b[x] += SIGN * q * q;
            c[x] += SIGN * p * q;
        }
    }

    #[inline(always)]
    fn window(&self, x: usize) -> (i32, i32, i32) {
        let n = 2 * ZNCC_RADIUS + 1;
        let sum = |v: &[i32]| v[x..x + n].iter().sum::<i32>();
        (sum(&self.s), sum(&self.ss), sum(&self.rs))
    }
}

#[inline(always)]
fn add_zncc(
    reference: &Strip,
    warped: &Strip,
    moments: &Moments,
    w: usize,
    rows: usize,
    sums: &mut Sums,
    cost: &mut [u8],
) {
    const N: usize = 2 * ZNCC_RADIUS + 1;
    for y in 0..rows {
        sums.advance(reference, warped, y);
        let line = &mut cost[y * w..][..w];
        let mean = &moments.mean[y * w..][..w];
        let inverse = &moments.inverse_deviation[y * w..][..w];
        let (a, b, c) = (&sums.s[..w + N - 1], &sums.ss[..w + N - 1], &sums.rs[..w + N - 1]);
        for x in 0..w {
            let (mut s, mut ss, mut rs) = (0, 0, 0);
            for k in 0..N {
                s += a[x + k];
                ss += b[x + k];
                rs += c[x + k];
            }
            let m = s as f32 * (1.0 / PATCH);
            let variance = (ss as f32 * (1.0 / PATCH) - m * m).max(0.0) + NOISE_VARIANCE;
            let covariance = rs as f32 * (1.0 / PATCH) - m * mean[x];
            let zncc = covariance * inverse[x] / variance.sqrt();
            line[x] += whole(((1.0 - zncc).min(1.0) * ZNCC_SCALE).max(0.0)) as u8;
        }
    }
}

/// Keeps, per pixel, the lowest costs seen so far in ascending order; `lowest` holds one map after the other. `cost` is used up.
#[inline(always)]
fn keep_lowest(cost: &mut [u8], lowest: &mut [u8]) {
    for held in lowest.chunks_exact_mut(cost.len()) {
        for (c, held) in cost.iter_mut().zip(held) {
            (*held, *c) = ((*held).min(*c), (*held).max(*c));
        }
    }
}

/// Mean of the costs kept, rounded; [`UNSEEN`] where there is none.
#[inline(always)]
fn mean_of_kept(lowest: &[u8], mean: &mut [u8]) {
    let pixels = mean.len();
    for (i, mean) in mean.iter_mut().enumerate() {
        let (mut sum, mut n) = (0u16, 0u16);
        for kept in lowest.chunks_exact(pixels) {
            let seen = u16::from(kept[i] != INVALID);
            sum += seen * u16::from(kept[i]);
            n += seen;
        }
        // Exact: a quotient of so small numbers is never rounded up to the next whole one.
        let rounded = f32::from(sum + n / 2) / f32::from(n.max(1));
        *mean = if n == 0 { UNSEEN } else { whole(rounded) as u8 };
    }
}

/// The whole part of a value from 0 to 2^23, at the speed of an addition: a cast that saturates is not vectorised.
#[inline(always)]
fn whole(value: f32) -> u32 {
    const INTEGERS: f32 = (1 << 23) as f32; // the next float is 1 away
    (value.floor() + INTEGERS).to_bits() & ((1 << 23) - 1)
}

/// Where a line's samples fall: the words of their 2x2 pixels and the place between those, in 1/128 pixel steps.
struct Taps {
    index: Vec<u32>,
    right: Vec<u32>,
    down: Vec<u32>,
    words: Vec<u32>,
}

impl Taps {
    fn new(n: usize) -> Self {
        Self { index: vec![0; n], right: vec![0; n], down: vec![0; n], words: vec![0; n] }
    }
}

/// Samples `source` at the plane `inverse_depth` for every pixel of the strip; `valid` is 255 where it does not see it.
#[inline(always)]
fn warp(
    source: &Quads,
    map: &Epipolar,
    inverse_depth: f32,
    y0: f32,
    w: usize,
    rows: usize,
    taps: &mut Taps,
    out: &mut Strip,
    valid: &mut [u8],
) {
    let m = &map.matrix;
    let o = map.offset.map(|v| v * inverse_depth);
    let (width, height) = source.size();
    let (x_max, y_max) = ((width - 1) as f32, (height - 1) as f32);
    let (stride, width) = (out.stride, width as u32);
    let (index, right, down) = (&mut taps.index[..stride], &mut taps.right[..stride], &mut taps.down[..stride]);
    let words = &mut taps.words[..stride];
    for r in 0..rows + 2 * HALO {
        let y = y0 + r as f32 - HALO as f32;
        let base = [m[1] * y + m[2] + o[0], m[4] * y + m[5] + o[1], m[7] * y + m[8] + o[2]];
        let at = |i: usize| {
            let x = i as f32 - HALO as f32;
            let z = m[6] * x + base[2];
            let scale = 1.0 / z.max(1e-12);
            (z, (m[0] * x + base[0]) * scale, (m[3] * x + base[1]) * scale)
        };
        for i in 0..stride {
            let (_, u, t) = at(i);
            let (u, t) = (u.max(0.0).min(x_max), t.max(0.0).min(y_max)); // 0 for NaN
            let (x, y) = (u.floor(), t.floor());
            index[i] = whole(y) * width + whole(x);
            right[i] = whole((u - x) * 128.0);
            down[i] = whole((t - y) * 128.0);
        }
        if r >= HALO && r < HALO + rows {
            for (i, v) in valid[(r - HALO) * w..][..w].iter_mut().enumerate() {
                let (z, u, t) = at(i + HALO);
                let seen = (z > 0.0) & (u >= -0.5) & (t >= -0.5) & (u <= x_max + 0.5) & (t <= y_max + 0.5);
                *v = if seen { 0 } else { INVALID };
            }
        }
        for (word, &i) in words.iter_mut().zip(&*index) {
            *word = source.words()[i as usize];
        }
        let line = &mut out.data[r * stride..(r + 1) * stride];
        for i in 0..stride {
            let (a, b, q) = (right[i], down[i], words[i]);
            let top = (q & 255) * (128 - a) + (q >> 8 & 255) * a;
            let bottom = (q >> 16 & 255) * (128 - a) + (q >> 24) * a;
            line[i] = ((top * (128 - b) + bottom * b + (1 << 13)) >> 14) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(w: usize, h: usize, shift: usize) -> Vec<u8> {
        let hash = |x: usize, y: usize| ((x.wrapping_mul(2654435761) ^ y.wrapping_mul(40503)) >> 7) as u8;
        (0..w * h).map(|i| hash(i % w + shift, i / w)).collect()
    }

    const PAIR: Epipolar = Epipolar { matrix: [1., 0., 0., 0., 1., 0., 0., 0., 1.], offset: [-1., 0., 0.] };

    #[test]
    fn a_shifted_texture_is_found_at_its_shift() {
        let (w, h) = (64, 40);
        let (left, right) = (texture(w, h, 0), texture(w, h, 5));
        let left = Raster::new(&left, w, h, "reference").unwrap();
        let right = Raster::new(&right, w, h, "source").unwrap();
        let planes: Vec<f32> = (0..12).map(|d| d as f32).collect();
        let costs = sweep(left, &[(right, PAIR)], &planes, 0).unwrap();
        for y in 6..h - 6 {
            for x in 20..w - 6 {
                let at = &costs[(y * w + x) * 12..][..12];
                let winner = (0..12).min_by_key(|&d| at[d]).unwrap();
                assert_eq!(winner, 5, "at {x}, {y}: {at:?}");
                assert_eq!(at[5], 0);
            }
        }
    }

    #[test]
    fn an_occluded_source_is_not_asked() {
        let (w, h) = (48, 32);
        let (left, good, bad) = (texture(w, h, 0), texture(w, h, 3), texture(w, h, 3000));
        let raster = |d| Raster::new(d, w, h, "image").unwrap();
        let planes: Vec<f32> = (0..8).map(|d| d as f32).collect();
        let sources = [(raster(&bad), PAIR), (raster(&good), PAIR)];
        let costs = sweep(raster(&left), &sources, &planes, 0).unwrap();
        assert_eq!(costs[(16 * w + 24) * 8 + 3], 0);
    }

    #[test]
    fn costs_stay_in_range_and_unseen_planes_are_neutral() {
        let (w, h) = (32, 20);
        let image = texture(w, h, 0);
        let raster = Raster::new(&image, w, h, "image").unwrap();
        let costs = sweep(raster, &[(raster, PAIR)], &[0.0, 1000.0], 0).unwrap();
        assert!(costs.iter().all(|&c| c <= MAX_COST));
        assert!(costs.chunks_exact(2).all(|c| c[0] == 0 && c[1] == UNSEEN));
    }

    #[test]
    fn wrong_input_is_named() {
        let image = texture(8, 8, 0);
        let raster = Raster::new(&image, 8, 8, "reference").unwrap();
        assert!(sweep(raster, &[], &[1.0], 0).unwrap_err().to_string().starts_with("sources:"));
        assert!(sweep(raster, &[(raster, PAIR)], &[f32::NAN], 0).unwrap_err().to_string().starts_with("planes:"));
        assert!(Raster::new(&image, 9, 8, "reference").unwrap_err().to_string().contains("72 samples"));
    }
}
