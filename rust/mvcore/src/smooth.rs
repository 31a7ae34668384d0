//! Smoothing of a block-sparse signed distance field: where views contradict each other voxel by voxel the surface is crumbs.
//!
//! ```text
//!   (v·w, w) of a block and 4 voxels around it ──Gaussian along x, y, z──► Σ v·w / Σ w       (normalised convolution)
//! ```
//!
//! Unknown voxels count nothing and stay unknown. Knutsson and Westin, CVPR 1993. Each block is one task: the same bytes for any
//! number of threads.

use crate::grid::{BLOCK, BlockMap, NONE, SIDE};
use crate::memory::zeroed;
use multiversion::multiversion;
use rayon::prelude::*;

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
    /// 1, outside; but -1, inside, where the flag of the tile's block is set.
    Outside(&'a [bool]),
}

/// A Gaussian mean of the known voxels around each known one: normalised convolution, axis by axis.
pub fn smooth(values: &[f32], map: &BlockMap, sigma: f32, beyond: Beyond) -> Vec<f32> {
    let taps: [f32; 2 * HALO + 1] = std::array::from_fn(|k| (-0.5 * ((k as f32 - HALO as f32) / sigma).powi(2)).exp());
    // Open surfaces have free space on one side and nothing behind: far values must not outweigh the surface's own.
    let least = if matches!(beyond, Beyond::Outside(_)) { 1.0 } else { FAR_WEIGHT };
    let mut out = zeroed::<f32>(values.len());
    out.par_chunks_exact_mut(BLOCK).zip(map.coords.par_iter()).enumerate().for_each_init(
        || vec![[0.0f32; 2]; WIDE * WIDE * WIDE],
        |wide, (slot, (out, at))| {
            wide.fill(if matches!(beyond, Beyond::Outside(_)) { [1.0, 1.0] } else { [0.0; 2] });
            gather(values, map, *at, least, beyond, wide);
            smooth_block(wide, &taps, &values[slot * BLOCK..][..BLOCK], out);
        },
    );
    out
}

/// Puts a block with its surroundings into a wide one as (value, 1), and (0, 0) where nothing is known.
fn gather(values: &[f32], map: &BlockMap, at: [u32; 3], least: f32, beyond: Beyond, wide: &mut [[f32; 2]]) {
    for n in 0..27 {
        let step = [n / 9, n / 3 % 3, n % 3];
        let block = [0, 1, 2].map(|a| (at[a] as usize + step[a]).wrapping_sub(1));
        let Some(index) = map.tile.index(block) else { continue };
        let from = match (map.slot[index], beyond) {
            (NONE, Beyond::Outside(inside)) if inside[index] => &[-1.0; BLOCK],
            (NONE, _) => continue,
            (slot, _) => &values[slot as usize * BLOCK..][..BLOCK],
        };
        // In the wide block this neighbour starts at HALO + (step - 1)·SIDE; only what lies inside is copied.
        let range = |a: usize| {
            let start = (HALO + step[a] * SIDE) as i32 - SIDE as i32;
            ((-start).max(0) as usize..(WIDE as i32 - start).min(SIDE as i32) as usize, start)
        };
        let ((ri, si), (rj, sj), (rk, sk)) = (range(0), range(1), range(2));
        for i in ri {
            for j in rj.clone() {
                let row = ((i as i32 + si) as usize * WIDE + (j as i32 + sj) as usize) * WIDE;
                for k in rk.clone() {
                    let v = from[(i * SIDE + j) * SIDE + k];
                    let weight = if v.is_nan() { 0.0 } else { (1.0 - v * v).max(least) };
                    wide[row + (k as i32 + sk) as usize] = [weight * v.max(-1.0), weight];
                }
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
        let found = smooth(&values, &map, 1.0, Beyond::Unknown);
        assert!(found[unknown].is_nan());
        assert!((found[speck] - 3.5 / 16.0).abs() < 0.15, "{}", found[speck]);
        // Away from the speck and the ends of the ramp the slope is kept.
        let away = 4 * 64; // slot 0, i = 4
        assert!((found[away] - values[away]).abs() < 1e-2);
    }
}
