//! Smoothing of a block-sparse signed distance field: where views contradict each other voxel by voxel the surface is crumbs.
//!
//! ```text
//!   (v·w, w) of a block and 4 voxels around it ──Gaussian along x, y, z──► Σ v·w / Σ w       (normalised convolution)
//! ```
//!
//! With silhouettes a field is part measured, part the hull's guess. Where most of what a Gaussian covers was measured, a narrow one
//! does: the wide one, which the seams between the two need, would round off what the photographs show.
//!
//! Unknown voxels count nothing and stay unknown. Knutsson and Westin, CVPR 1993. Each block is one task: the same bytes for any
//! number of threads.

use crate::grid::{BLOCK, BlockMap, NONE, SIDE};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
use multiversion::multiversion;
use rayon::prelude::*;
use std::ops::Range;

/// Voxels beyond a block's sides that its smoothing reads; the kernel ends there.
const HALO: usize = 4;
/// Weight of truncated values in the smoothing of an open surface.
const FAR_WEIGHT: f32 = 0.1;
const WIDE: usize = SIDE + 2 * HALO;

/// What blocks that the map lacks hold.
#[derive(Debug, Clone, Copy)]
pub enum Beyond<'a> {
    /// Nothing is known of them: the surface is open.
    Unknown,
    /// For each block of the tile 1, outside, -1, inside, or 0, not known; outside beyond the tile.
    Held(&'a [i8]),
}

/// A block's voxels, a bit each.
pub type Bits = [u64; BLOCK / 64];

/// What was measured of a field whose rest is the hull's, and the standard deviation that does there.
#[derive(Debug, Clone, Copy)]
pub struct Measured<'a> {
    /// One a block of the map.
    pub bits: &'a [Bits],
    /// Voxels.
    pub sigma: f32,
}

/// Shares of measured voxels between which the narrow Gaussian takes the wide one's place.
const MIXED: (f32, f32) = (0.6, 0.95);

type Taps = [f32; 2 * HALO + 1];

fn taps(sigma: f32) -> Taps {
    std::array::from_fn(|k| (-0.5 * ((k as f32 - HALO as f32) / sigma).powi(2)).exp())
}

/// A Gaussian mean of the known voxels around each known one: normalised convolution, axis by axis.
pub fn smooth(values: &[f32], map: &BlockMap, sigma: f32, beyond: Beyond, measured: Option<Measured>) -> Vec<f32> {
    let wide_taps = taps(sigma);
    // Open surfaces have free space on one side and nothing behind: far values must not outweigh the surface's own.
    let least = if matches!(beyond, Beyond::Held(_)) { 1.0 } else { FAR_WEIGHT };
    let mut out = zeroed::<f32>(values.len());
    let interrupt = Interrupt::current();
    out.par_chunks_exact_mut(BLOCK).zip(map.coords.par_iter()).enumerate().for_each_init(
        || (vec![[0.0f32; 2]; WIDE * WIDE * WIDE], vec![[0.0f32; 2]; WIDE * WIDE * WIDE]),
        |(wide, share), (slot, (out, at))| {
            if interrupt.is_set() {
                return;
            }
            wide.fill(if matches!(beyond, Beyond::Held(_)) { [1.0, 1.0] } else { [0.0; 2] });
            gather(values, map, *at, least, beyond, wide);
            let values = &values[slot * BLOCK..][..BLOCK];
            // How much of each voxel's surroundings was measured decides which of the two Gaussians a block needs.
            let mut part = [0.0; BLOCK];
            if let Some(Measured { bits, .. }) = measured
                && gather_measured(bits, map, *at, share) > 0
            {
                smooth_block(share, &wide_taps, values, &mut part);
                part = part.map(|p| ((p - MIXED.0) / (MIXED.1 - MIXED.0)).clamp(0.0, 1.0));
            }
            if part.iter().any(|&p| p < 1.0) {
                smooth_block(wide, &wide_taps, values, out);
            }
            if let Some(Measured { sigma, .. }) = measured
                && part.iter().any(|&p| p > 0.0)
            {
                let mut narrow = [0.0; BLOCK];
                smooth_block(wide, &taps(sigma), values, &mut narrow);
                for n in 0..BLOCK {
                    out[n] = part[n] * narrow[n] + (1.0 - part[n]) * out[n];
                }
            }
        },
    );
    interrupt.poll();
    out
}

/// Puts a block with its surroundings into a wide one as (value, 1), and (0, 0) where nothing is known.
fn gather(values: &[f32], map: &BlockMap, at: [u32; 3], least: f32, beyond: Beyond, wide: &mut [[f32; 2]]) {
    rows_around(map, at, |index, slot, to, from| {
        let from = match (slot, beyond) {
            (NONE, Beyond::Held(held)) => {
                let value = f32::from(held[index]);
                wide[to..][..from.len()].fill([value, value.abs()]);
                return;
            }
            (NONE, Beyond::Unknown) => return,
            _ => &values[slot as usize * BLOCK..][from],
        };
        for (out, &v) in wide[to..].iter_mut().zip(from) {
            let weight = if v.is_nan() { 0.0 } else { (1.0 - v * v).max(least) };
            *out = [weight * v.max(-1.0), weight];
        }
    });
}

/// The same as (1 where measured, else 0; 1); how many are measured.
fn gather_measured(bits: &[Bits], map: &BlockMap, at: [u32; 3], wide: &mut [[f32; 2]]) -> usize {
    wide.fill([0.0, 1.0]);
    let mut count = 0;
    rows_around(map, at, |_, slot, to, from| {
        let Some(bits) = bits.get(slot as usize) else { return };
        for (out, n) in wide[to..].iter_mut().zip(from) {
            let bit = bits[n / 64] >> (n % 64) & 1;
            out[0] = bit as f32;
            count += bit as usize;
        }
    });
    count
}

/// Rows of the 27 blocks around one: index in the tile, slot, where the row starts in the wide block, which voxels of its own it is.
fn rows_around(map: &BlockMap, at: [u32; 3], mut each: impl FnMut(usize, u32, usize, Range<usize>)) {
    for n in 0..27 {
        let step = [n / 9, n / 3 % 3, n % 3];
        let block = [0, 1, 2].map(|a| (at[a] as usize + step[a]).wrapping_sub(1));
        let Some(index) = map.tile.index(block) else { continue };
        // In the wide block this neighbour starts at HALO + (step - 1)·SIDE; only what lies inside is copied.
        let range = |a: usize| {
            let start = (HALO + step[a] * SIDE) as i32 - SIDE as i32;
            ((-start).max(0) as usize..(WIDE as i32 - start).min(SIDE as i32) as usize, start)
        };
        let ((ri, si), (rj, sj), (rk, sk)) = (range(0), range(1), range(2));
        for i in ri {
            for j in rj.clone() {
                let row = ((i as i32 + si) as usize * WIDE + (j as i32 + sj) as usize) * WIDE;
                let own = (i * SIDE + j) * SIDE;
                each(index, map.slot[index], row + (rk.start as i32 + sk) as usize, own + rk.start..own + rk.end);
            }
        }
    }
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn smooth_block(wide: &[[f32; 2]], taps: &[f32; 2 * HALO + 1], values: &[f32], out: &mut [f32]) {
    const SLAB: usize = WIDE * WIDE;
    let mut x = [[0.0f32; 2]; SIDE * SLAB];
    for i in 0..SIDE {
        let to = &mut x[i * SLAB..][..SLAB];
        for (tap, &weight) in taps.iter().enumerate() {
            for (o, v) in to.iter_mut().zip(&wide[(i + tap) * SLAB..][..SLAB]) {
                o[0] += weight * v[0];
                o[1] += weight * v[1];
            }
        }
    }
    let mut y = [[0.0f32; 2]; SIDE * SIDE * WIDE];
    for row in 0..SIDE * SIDE {
        let (i, j) = (row / SIDE, row % SIDE);
        let to = &mut y[row * WIDE..][..WIDE];
        for (tap, &weight) in taps.iter().enumerate() {
            for (o, v) in to.iter_mut().zip(&x[i * SLAB + (j + tap) * WIDE..][..WIDE]) {
                o[0] += weight * v[0];
                o[1] += weight * v[1];
            }
        }
    }
    for n in 0..BLOCK {
        let line = &y[n / SIDE * WIDE + n % SIDE..][..2 * HALO + 1];
        let (mut sum, mut total) = (0.0, 0.0);
        for (v, &weight) in line.iter().zip(taps) {
            sum += weight * v[0];
            total += weight * v[1];
        }
        out[n] = if values[n].is_nan() { f32::NAN } else { sum / total };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Tile;

    #[test]
    fn smoothing_keeps_a_slope_and_mends_a_speck() {
        let map = BlockMap::from_flags(Tile { low: [0; 3], high: [2; 3] }, std::iter::repeat_n(true, 8));
        let ramp = |slot: usize, n: usize| ((map.coords[slot][0] as usize * SIDE + n / 64) as f32 - 7.5) / 16.0;
        let mut values: Vec<f32> = (0..8 * BLOCK).map(|n| ramp(n / BLOCK, n % BLOCK)).collect();
        let speck = 7 * BLOCK + 3 * 64 + 3 * 8 + 3;
        let unknown = BLOCK + 5;
        (values[speck], values[unknown]) = (-0.9, f32::NAN);
        let found = smooth(&values, &map, 1.0, Beyond::Unknown, None);
        assert!(found[unknown].is_nan());
        assert!((found[speck] - 3.5 / 16.0).abs() < 0.15, "{}", found[speck]);
        // Away from the speck and the ends of the ramp the slope is kept.
        let away = 4 * 64; // slot 0, i = 4
        assert!((found[away] - values[away]).abs() < 1e-2);
    }

    #[test]
    fn what_was_measured_is_smoothed_by_the_narrow_gaussian() {
        let map = BlockMap::from_flags(Tile { low: [0; 3], high: [3; 3] }, std::iter::repeat_n(true, 27));
        let values: Vec<f32> =
            (0..27 * BLOCK as u32).map(|n| (n.wrapping_mul(2654435761) >> 24) as f32 / 255.0 - 0.5).collect();
        let outside = vec![1; 27];
        let run = |sigma, measured| smooth(&values, &map, sigma, Beyond::Held(&outside), measured);
        let (all, none) = (vec![[u64::MAX; BLOCK / 64]; 27], vec![Bits::default(); 27]);
        let mixed = |bits| run(2.0, Some(Measured { bits, sigma: 0.7 }));
        let (wide, narrow) = (run(2.0, None), run(0.7, None));
        let middle = 13 * BLOCK..14 * BLOCK;
        assert_eq!(mixed(&none), wide);
        assert_eq!(mixed(&all)[middle.clone()], narrow[middle]);
        // Half measured: by the narrow one far on that side of the border, by the wide one on the other.
        let half: Vec<Bits> = map.coords.iter().map(|at| if at[0] == 0 { all[0] } else { none[0] }).collect();
        let found = mixed(&half);
        let at = |i: usize| (9 * (i / SIDE) + 4) * BLOCK + (i % SIDE * SIDE + 4) * SIDE + 4;
        assert_eq!(found[at(4)], narrow[at(4)]);
        assert_eq!(found[at(9)], wide[at(9)]);
    }
}
