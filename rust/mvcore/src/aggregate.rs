//! Semi-global aggregation of a cost volume along eight directions, and the winner of every pixel.
//!
//! ```text
//!   L_r(p, d) = C(p, d) + min( L_r(p-r, d), L_r(p-r, d±1) + P1, min_k L_r(p-r, k) + P2 ) - min_k L_r(p-r, k)
//!
//!   forward ─►  top half: store Σ of 4 directions │ bottom half: add the stored Σ, take the winner
//!   backward ─► bottom half: store Σ              │ top half: add the stored Σ, take the winner
//! ```
//!
//! The two passes run side by side, each going first through the half of the image that the other needs last, so that the
//! sum over directions is written once, read once and never kept for both. Hirschmüller, PAMI 2008; P2 falls with the
//! intensity step (his eq 13). The order of operations is fixed: the same bytes for any thread count.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
use crate::raster::Raster;
use multiversion::multiversion;

/// Penalties of [`aggregate`] in cost units.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Penalties {
    /// For a step of one plane between neighbours (slanted surfaces).
    pub p1: u8,
    /// For a larger step where the image is flat.
    pub p2: u8,
    /// Grey levels at which P2 has fallen to half.
    pub p2_falloff: u8,
}

/// The winners of [`aggregate`], one per pixel.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Winners {
    /// Index of the cheapest plane with a parabolic sub-plane offset.
    pub plane: Vec<f32>,
    /// 0 ..= 1: how far the best plane's cost lies below the best one that is not its neighbour.
    pub margin: Vec<f32>,
}

/// Aggregates `costs` (h, w, `planes`), each at most 127, along eight directions and takes the winner.
pub fn aggregate(costs: &[u8], planes: usize, guide: Raster<u8>, penalties: Penalties) -> Result<Winners> {
    let (w, h) = (guide.width, guide.height);
    require(planes >= 2 && planes <= u16::MAX as usize, "planes", "2 to 65535", planes)?;
    require(
        costs.len() == w * h * planes,
        "costs",
        format!("{} values ({h} x {w} x {planes})", w * h * planes),
        costs.len(),
    )?;
    let Penalties { p1, p2, .. } = penalties;
    require(p1 <= p2 && p2 <= 120, "penalties", "p1 <= p2 <= 120", format!("p1 {p1}, p2 {p2}"))?;
    let mut winners = Winners { plane: zeroed(w * h), margin: zeroed(w * h) };
    let mut sums = zeroed::<u16>(w * h * planes); // first touched by the pass that writes them
    let top = h / 2;
    let (sums_top, sums_bottom) = sums.split_at_mut(top * w * planes);
    let (plane_top, plane_bottom) = winners.plane.split_at_mut(top * w);
    let (margin_top, margin_bottom) = winners.margin.split_at_mut(top * w);
    let volume = Volume { costs, planes, guide, p1, p2: p2_table(penalties), interrupt: Interrupt::current() };
    let (mut forward, mut backward) = (Pass::new(&volume, false), Pass::new(&volume, true));
    rayon::join(
        || store(&volume, &mut forward, 0..top, sums_top),
        || store(&volume, &mut backward, top..h, sums_bottom),
    );
    rayon::join(
        || finish(&volume, &mut forward, top..h, sums_bottom, plane_bottom, margin_bottom),
        || finish(&volume, &mut backward, 0..top, sums_top, plane_top, margin_top),
    );
    Ok(winners)
}

fn p2_table(p: Penalties) -> [u8; 256] {
    let falloff = f32::from(p.p2_falloff.max(1));
    std::array::from_fn(|step| {
        let fallen = f32::from(p.p2) / (1.0 + step as f32 / falloff);
        (fallen as u8).max(p.p1.saturating_add(1)).min(p.p2.max(p.p1))
    })
}

struct Volume<'a> {
    costs: &'a [u8],
    planes: usize,
    guide: Raster<'a, u8>,
    p1: u8,
    p2: [u8; 256],
    interrupt: Interrupt,
}

/// Bytes before and after a pixel's path costs, so that d-1 and d+1 exist; they hold 255.
const PAD: usize = 64;
const FAR: u8 = 255;

/// One direction's path costs over a row: (w, PAD + D + PAD), and the minimum of each pixel.
struct Paths {
    cost: Vec<u8>,
    min: Vec<u8>,
}

impl Paths {
    fn new(pixels: usize, planes: usize) -> Self {
        Self { cost: vec![FAR; pixels * (planes + 2 * PAD)], min: vec![0; pixels] }
    }
}

/// The four directions of one pass: along the row, and from the row before (behind, straight, ahead).
struct Pass {
    backward: bool,
    along: [Paths; 2],
    before: [Paths; 3],
    now: [Paths; 3],
    zero: Vec<u8>,
}

impl Pass {
    fn new(volume: &Volume, backward: bool) -> Self {
        let (w, d) = (volume.guide.width, volume.planes);
        let row = || std::array::from_fn(|_| Paths::new(w, d));
        let mut zero = vec![FAR; d + 2 * PAD];
        zero[PAD..PAD + d].fill(0);
        Self { backward, along: std::array::from_fn(|_| Paths::new(1, d)), before: row(), now: row(), zero }
    }
}

fn store(volume: &Volume, pass: &mut Pass, rows: std::ops::Range<usize>, sums: &mut [u16]) {
    let (first, n) = (rows.start, volume.guide.width * volume.planes);
    for y in ordered(rows, pass.backward) {
        volume.interrupt.poll();
        row_pass::<false>(volume, pass, y, &mut sums[(y - first) * n..][..n]);
    }
}

fn finish(
    volume: &Volume,
    pass: &mut Pass,
    rows: std::ops::Range<usize>,
    sums: &mut [u16],
    plane: &mut [f32],
    margin: &mut [f32],
) {
    let (first, w) = (rows.start, volume.guide.width);
    let n = w * volume.planes;
    for y in ordered(rows, pass.backward) {
        volume.interrupt.poll();
        let (line, at) = (&mut sums[(y - first) * n..][..n], (y - first) * w);
        row_pass::<true>(volume, pass, y, line);
        winners_of_row(line, volume.planes, &mut plane[at..at + w], &mut margin[at..at + w]);
    }
}

fn ordered(rows: std::ops::Range<usize>, backward: bool) -> impl Iterator<Item = usize> {
    let (start, end) = (rows.start, rows.end);
    (start..end).map(move |i| if backward { start + end - 1 - i } else { i })
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn row_pass<const ADD: bool>(volume: &Volume, pass: &mut Pass, y: usize, sums: &mut [u16]) {
    let (w, h, d) = (volume.guide.width, volume.guide.height, volume.planes);
    let stride = d + 2 * PAD;
    std::mem::swap(&mut pass.before, &mut pass.now);
    let (ahead, first_row) = if pass.backward { (-1i64, y + 1 == h) } else { (1i64, y == 0) };
    let grey = volume.guide.row(y);
    let grey_before = if first_row { grey } else { volume.guide.row(if pass.backward { y + 1 } else { y - 1 }) };
    for i in 0..w {
        let x = if pass.backward { w - 1 - i } else { i };
        let here = grey[x];
        let cost = &volume.costs[(y * w + x) * d..][..d];
        let sum = &mut sums[x * d..][..d];
        let (last, current) = pass.along.split_at_mut(1);
        let (last, current) = if i % 2 == 0 { (&last[0], &mut current[0]) } else { (&current[0], &mut last[0]) };
        // Predecessor of each direction: pixel index in `before`, or none outside the image (a path starts there).
        let step = |dx: i64| {
            let q = x as i64 + dx * ahead;
            (!first_row && q >= 0 && q < w as i64).then_some(q as usize)
        };
        let before = &pass.before;
        let previous = |k: usize, q: Option<usize>| match q {
            Some(q) => (&before[k].cost[q * stride..][..stride], before[k].min[q], grey_before[q]),
            None => (&pass.zero[..], 0, here),
        };
        let along = if i == 0 {
            (&pass.zero[..], 0, here)
        } else {
            (&last.cost[..], last.min[0], grey[(x as i64 - ahead) as usize])
        };
        let sources = [along, previous(0, step(-1)), previous(1, step(0)), previous(2, step(1))];
        let p2 = sources.map(|(_, _, g)| volume.p2[g.abs_diff(here) as usize]);
        let [n0, n1, n2] = &mut pass.now;
        let (a, b) = (x * stride, (x + 1) * stride);
        let outs = [&mut current.cost[..], &mut n0.cost[a..b], &mut n1.cost[a..b], &mut n2.cost[a..b]];
        let mins = pixel_step::<ADD>(cost, sources.map(|(c, m, _)| (c, m)), volume.p1, p2, outs, sum);
        (current.min[0], n0.min[x], n1.min[x], n2.min[x]) = (mins[0], mins[1], mins[2], mins[3]);
    }
}

/// Most planes handled at a time: the bytes of the widest vectors.
const CHUNK: usize = 64;

#[inline(always)]
fn pixel_step<const ADD: bool>(
    cost: &[u8],
    previous: [(&[u8], u8); 4],
    p1: u8,
    p2: [u8; 4],
    outs: [&mut [u8]; 4],
    sum: &mut [u16],
) -> [u8; 4] {
    let mut step = Step { cost, previous, p1, p2, outs, sum, low: [[FAR; CHUNK]; 4] };
    let d = cost.len();
    let mut at = 0;
    while at + CHUNK <= d {
        step.planes::<ADD, CHUNK>(at, 0);
        at += CHUNK;
    }
    if at + CHUNK / 2 <= d {
        step.planes::<ADD, { CHUNK / 2 }>(at, 0);
        at += CHUNK / 2;
    }
    if at + CHUNK / 4 <= d {
        step.planes::<ADD, { CHUNK / 4 }>(at, 0);
        at += CHUNK / 4;
    }
    if at < d && d >= CHUNK / 4 {
        // The last planes together with some before them, of which the same comes again.
        let first = d - CHUNK / 4;
        step.planes::<ADD, { CHUNK / 4 }>(first, at - first);
        at = d;
    }
    for at in at..d {
        step.planes::<ADD, 1>(at, 0);
    }
    step.low.map(|l| l.into_iter().fold(FAR, u8::min))
}

/// What a pixel's four path costs are made of and go to; `low` keeps their least values, by their place in a vector.
struct Step<'a> {
    cost: &'a [u8],
    previous: [(&'a [u8], u8); 4],
    p1: u8,
    p2: [u8; 4],
    outs: [&'a mut [u8]; 4],
    sum: &'a mut [u16],
    low: [[u8; CHUNK]; 4],
}

impl Step<'_> {
    /// The N planes from `at` on, along all four directions; the first `summed` of them are in the sum already.
    #[inline(always)]
    fn planes<const ADD: bool, const N: usize>(&mut self, at: usize, summed: usize) {
        let c: &[u8; N] = part(self.cost, at);
        let mut total = [0u16; N];
        for (k, out) in self.outs.iter_mut().enumerate() {
            let (from, min) = self.previous[k];
            let (below, same, above): (&[u8; N], &[u8; N], &[u8; N]) =
                (part(from, PAD + at - 1), part(from, PAD + at), part(from, PAD + at + 1));
            let jump = min.saturating_add(self.p2[k]);
            let to = &mut out[PAD + at..][..N];
            for j in 0..N {
                let near = below[j].min(above[j]).saturating_add(self.p1);
                let l = c[j].saturating_add(near.min(same[j]).min(jump) - min);
                to[j] = l;
                self.low[k][j] = self.low[k][j].min(l);
                total[j] += u16::from(l);
            }
        }
        let s = &mut self.sum[at..][..N];
        for j in 0..N {
            let new = if j < summed { 0 } else { total[j] };
            s[j] = if ADD || j < summed { s[j] + new } else { new };
        }
    }
}

#[inline(always)]
fn part<const N: usize>(v: &[u8], at: usize) -> &[u8; N] {
    match v[at..at + N].try_into() {
        Ok(chunk) => chunk,
        Err(_) => &[FAR; N],
    }
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn winners_of_row(sums: &[u16], planes: usize, plane: &mut [f32], margin: &mut [f32]) {
    for (x, s) in sums.chunks_exact(planes).enumerate() {
        let best = s.iter().copied().fold(u16::MAX, u16::min);
        let d = s.iter().position(|&v| v == best).unwrap_or(0);
        plane[x] = d as f32 + parabola(s, d);
        let lowest = |v: &[u16]| v.iter().copied().fold(u16::MAX, u16::min);
        let other = lowest(&s[..d.saturating_sub(1)]).min(lowest(&s[(d + 2).min(planes)..]));
        margin[x] = if other == u16::MAX { 0.0 } else { f32::from(other - best) / f32::from(other.max(1)) };
    }
}

/// Vertex of the parabola through the costs at d-1, d, d+1, relative to d; 0 at the ends of the range.
#[inline(always)]
fn parabola(s: &[u16], d: usize) -> f32 {
    if d == 0 || d + 1 == s.len() {
        return 0.0;
    }
    let (a, b, c) = (f32::from(s[d - 1]), f32::from(s[d]), f32::from(s[d + 1]));
    let curvature = a - 2.0 * b + c;
    if curvature > 0.0 { (0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FLAT: Penalties = Penalties { p1: 6, p2: 40, p2_falloff: 8 };

    /// The definition, direction by direction, in plain loops.
    fn twin(costs: &[u8], d: usize, guide: Raster<u8>, p: Penalties) -> Vec<u32> {
        let (w, h) = (guide.width as i64, guide.height as i64);
        let table = p2_table(p);
        let mut total = vec![0u32; costs.len()];
        for (dx, dy) in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)] {
            let mut l = vec![0i32; costs.len()];
            for yi in 0..h {
                for xi in 0..w {
                    let (x, y) = (if dx >= 0 { xi } else { w - 1 - xi }, if dy >= 0 { yi } else { h - 1 - yi });
                    let at = ((y * w + x) as usize) * d;
                    let (px, py) = (x - dx, y - dy);
                    let inside = px >= 0 && px < w && py >= 0 && py < h;
                    for k in 0..d {
                        l[at + k] = i32::from(costs[at + k]);
                        if !inside {
                            continue;
                        }
                        let q = (py * w + px) as usize;
                        let before = &l[q * d..q * d + d].to_vec();
                        let min = *before.iter().min().unwrap();
                        let step = guide.data[q].abs_diff(guide.data[(y * w + x) as usize]);
                        let mut best = before[k].min(min + i32::from(table[step as usize]));
                        if k > 0 {
                            best = best.min(before[k - 1] + i32::from(p.p1));
                        }
                        if k + 1 < d {
                            best = best.min(before[k + 1] + i32::from(p.p1));
                        }
                        l[at + k] += best - min;
                    }
                }
            }
            for (t, v) in total.iter_mut().zip(&l) {
                *t += *v as u32;
            }
        }
        total
    }

    proptest! {
        #[test]
        fn equals_the_definition(w in 1usize..9, h in 1usize..9, d in 2usize..150, seed in any::<u64>()) {
            let mut state = seed | 1;
            let mut random = || { state ^= state << 13; state ^= state >> 7; state ^= state << 17; (state >> 32) as u8 };
            let costs: Vec<u8> = (0..w * h * d).map(|_| random() % 65).collect();
            let grey: Vec<u8> = (0..w * h).map(|_| random()).collect();
            let guide = Raster::new(&grey, w, h, "guide").unwrap();
            let sums = twin(&costs, d, guide, FLAT);
            let winners = aggregate(&costs, d, guide, FLAT).unwrap();
            for (i, s) in sums.chunks_exact(d).enumerate() {
                let best = *s.iter().min().unwrap();
                let first = s.iter().position(|&v| v == best).unwrap();
                prop_assert!((winners.plane[i] - first as f32).abs() <= 0.5);
                let far = s.iter().enumerate().filter(|(k, _)| k.abs_diff(first) > 1).map(|(_, &v)| v).min();
                let margin = far.map_or(0.0, |v| (v - best) as f32 / v.max(1) as f32);
                prop_assert!((winners.margin[i] - margin).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn noise_on_a_plane_is_smoothed_away() {
        let (w, h, d) = (40, 30, 16);
        let mut state = 7u32;
        let costs: Vec<u8> = (0..w * h * d)
            .map(|i| {
                state = state.wrapping_mul(1664525).wrapping_add(1013904223);
                let noise = (state >> 29) as u8;
                if i % d == 9 { 10 + noise } else { 16 + noise }
            })
            .collect();
        let grey = vec![100; w * h];
        let winners = aggregate(&costs, d, Raster::new(&grey, w, h, "guide").unwrap(), FLAT).unwrap();
        let right = winners.plane.iter().filter(|&&p| (p - 9.0).abs() < 0.6).count();
        assert!(right > w * h * 99 / 100, "{right} of {}", w * h);
    }

    #[test]
    fn wrong_input_is_named() {
        let grey = [0u8; 4];
        let guide = Raster::new(&grey, 2, 2, "guide").unwrap();
        assert!(aggregate(&[0; 7], 2, guide, FLAT).unwrap_err().to_string().starts_with("costs:"));
        let wrong = Penalties { p1: 50, p2: 10, p2_falloff: 8 };
        assert!(aggregate(&[0; 8], 2, guide, wrong).unwrap_err().to_string().starts_with("penalties:"));
    }
}
