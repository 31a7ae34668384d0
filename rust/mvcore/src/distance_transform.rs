//! Exact Euclidean distance transform: each pixel's squared distance to the nearest site, and which site that is.
//!
//! ```text
//!   row:     . . S . . . S .   ──two scans──►  2 1 0 1 2 1 0 1      g(x, y), distance to a site of the same row
//!   column:  lower envelope over y' of g(x, y')² + (y - y')²         squared distance to a site anywhere
//! ```
//!
//! Felzenszwalb and Huttenlocher, Distance Transforms of Sampled Functions, Theory of Computing 2012; the crossings of the parabolas
//! by whole-number division after Meijster, Roerdink and Hesselink, 2000. All of it is whole numbers: the result is exact, and the same
//! for any number of threads.

use crate::error::{Result, require};
use crate::memory::zeroed;
use crate::raster::Raster;
use rayon::prelude::*;

/// Pixels a side at most: squared distances then fit 32 bits.
pub const MAX_SIDE: usize = 32_768;

/// What [`distance_transform`] says of each pixel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distances {
    /// Squared distance to the nearest site in pixels, `u32::MAX` where there is none.
    pub squared: Vec<u32>,
    /// Row-major index of that site, `u32::MAX` where there is none; the same one of several for any number of threads.
    pub nearest: Vec<u32>,
}

/// Squared distance of each pixel to the nearest site, a pixel of `sites` that is not zero, and that site.
pub fn distance_transform(sites: Raster<u8>) -> Result<Distances> {
    let (w, h) = (sites.width, sites.height);
    let size = format!("at most {MAX_SIDE} pixels a side");
    require(w <= MAX_SIDE && h <= MAX_SIDE, "sites", size, format!("{h} x {w}"))?;
    let mut in_row = zeroed::<u32>(w * h);
    in_row.par_chunks_exact_mut(w).enumerate().for_each(|(y, out)| nearest_in_row(sites.row(y), out));
    // Columns are contiguous in the transposed result: each task writes one of its rows.
    let mut columns = zeroed::<(u32, u32)>(w * h);
    columns.par_chunks_exact_mut(h).enumerate().for_each_init(Vec::new, |envelope, (x, out)| {
        nearest_in_column(&in_row, w, x, envelope, out);
    });
    let (mut squared, mut nearest) = (zeroed::<u32>(w * h), in_row);
    squared.par_chunks_exact_mut(w).zip(nearest.par_chunks_exact_mut(w)).enumerate().for_each(|(y, (d, s))| {
        for x in 0..w {
            (d[x], s[x]) = columns[x * h + y];
        }
    });
    Ok(Distances { squared, nearest })
}

/// No site.
const NONE: u32 = u32::MAX;

/// Column of the nearest site in the same row, the left one of two.
fn nearest_in_row(sites: &[u8], out: &mut [u32]) {
    let mut last = NONE;
    for x in 0..sites.len() {
        if sites[x] != 0 {
            last = x as u32;
        }
        out[x] = last;
    }
    let mut next = NONE;
    for x in (0..sites.len()).rev() {
        if sites[x] != 0 {
            next = x as u32;
        }
        let (left, right) = (out[x], next);
        if left == NONE || (right != NONE && right - (x as u32) < x as u32 - left) {
            out[x] = right;
        }
    }
}

/// A parabola of the lower envelope: its row, its least value there, and the first row at which it is the lowest.
type Parabola = (i64, i64, i64);

fn nearest_in_column(in_row: &[u32], w: usize, x: usize, envelope: &mut Vec<Parabola>, out: &mut [(u32, u32)]) {
    envelope.clear();
    let rows = out.len();
    for y in 0..rows {
        let site = in_row[y * w + x];
        if site == NONE {
            continue;
        }
        let (row, least) = (y as i64, i64::from(site.abs_diff(x as u32)).pow(2));
        let mut first = 0;
        while let Some(&(before, its_least, from)) = envelope.last() {
            // Up to this row, it included, the earlier parabola is the lower one or equal.
            let until = (row * row - before * before + least - its_least).div_euclid(2 * (row - before));
            if until >= from {
                first = until + 1;
                break;
            }
            envelope.pop();
        }
        if first < rows as i64 {
            envelope.push((row, least, first));
        }
    }
    if envelope.is_empty() {
        out.fill((NONE, NONE));
        return;
    }
    let mut n = 0;
    for (y, out) in out.iter_mut().enumerate() {
        while envelope.get(n + 1).is_some_and(|next| next.2 <= y as i64) {
            n += 1;
        }
        let (row, least, _) = envelope[n];
        let squared = least + (y as i64 - row).pow(2);
        *out = (squared as u32, row as u32 * w as u32 + in_row[row as usize * w + x]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brute(sites: &[u8], w: usize) -> Vec<u32> {
        let apart = |a: usize, b: usize| (a % w).abs_diff(b % w).pow(2) + (a / w).abs_diff(b / w).pow(2);
        let nearest = |n| (0..sites.len()).filter(|&s| sites[s] != 0).map(|s| apart(n, s) as u32).min();
        (0..sites.len()).map(|n| nearest(n).unwrap_or(NONE)).collect()
    }

    proptest! {
        #[test]
        fn each_pixel_has_its_nearest_site(w in 1usize..24, h in 1usize..24, seed in any::<u64>(), share in 0u64..100) {
            let mut state = seed | 1;
            let mut random = || { state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407); state >> 33 };
            let sites: Vec<u8> = (0..w * h).map(|_| u8::from(random() % 100 < share)).collect();
            let found = distance_transform(Raster::new(&sites, w, h, "sites").unwrap()).unwrap();
            prop_assert_eq!(&found.squared, &brute(&sites, w));
            for (n, (&d, &s)) in found.squared.iter().zip(&found.nearest).enumerate() {
                if d != NONE {
                    let s = s as usize;
                    prop_assert!(sites[s] != 0);
                    prop_assert_eq!((n % w).abs_diff(s % w).pow(2) + (n / w).abs_diff(s / w).pow(2), d as usize);
                }
            }
        }
    }

    #[test]
    fn the_farthest_corners_of_the_largest_raster_fit() {
        let mut sites = vec![0u8; MAX_SIDE];
        sites[0] = 1;
        let found = distance_transform(Raster::new(&sites, MAX_SIDE, 1, "sites").unwrap()).unwrap();
        assert_eq!(found.squared[MAX_SIDE - 1], (MAX_SIDE as u32 - 1).pow(2));
        let wide = vec![0u8; MAX_SIDE + 1];
        let error = distance_transform(Raster::new(&wide, MAX_SIDE + 1, 1, "sites").unwrap()).unwrap_err();
        assert!(error.to_string().starts_with("sites: expected at most 32768"));
    }
}
