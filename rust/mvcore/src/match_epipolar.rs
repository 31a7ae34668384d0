//! Descriptor matching along known epipolar lines.
//!
//! Of the features of the other image only those within `band` pixels of a feature's epipolar line are compared; the best must
//! beat the second best (ratio test, Lowe 2004) and be best in both directions. With cameras known this finds correct matches
//! among repeated structure that an unguided search loses.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use multiversion::multiversion;
use rayon::prelude::*;

/// Bytes of a SIFT descriptor.
pub const DESCRIPTOR: usize = 128;

/// The features of one image.
#[derive(Debug, Clone, Copy)]
pub struct Features<'a> {
    /// Pixel positions.
    pub positions: &'a [[f32; 2]],
    /// Their descriptors.
    pub descriptors: &'a [[u8; DESCRIPTOR]],
}

/// Pairs (index in a, index in b), ascending in a. `fundamental` (row-major) maps a pixel of a to its line in b.
///
/// `band` is in pixels (infinity: everywhere), `ratio` below 1 compares distances, not their squares.
pub fn match_epipolar(
    a: Features,
    b: Features,
    fundamental: &[f64; 9],
    band: f32,
    ratio: f32,
) -> Result<Vec<[u32; 2]>> {
    for f in [&a, &b] {
        require(f.positions.len() == f.descriptors.len(), "descriptors", "one a position", f.descriptors.len())?;
    }
    require(band > 0.0, "band", "a positive width", band)?;
    let f = fundamental;
    let transposed = [f[0], f[3], f[6], f[1], f[4], f[7], f[2], f[5], f[8]];
    let interrupt = &Interrupt::current();
    let best = |from, to, f| best(from, to, f, band, ratio, interrupt);
    let (there, back) = rayon::join(|| best(a, b, fundamental), || best(b, a, &transposed));
    interrupt.poll();
    let mutual =
        |(i, m): (usize, &Option<u32>)| m.filter(|&j| back[j as usize] == Some(i as u32)).map(|j| [i as u32, j]);
    Ok(there.iter().enumerate().filter_map(mutual).collect())
}

fn best(
    a: Features,
    b: Features,
    fundamental: &[f64; 9],
    band: f32,
    ratio: f32,
    interrupt: &Interrupt,
) -> Vec<Option<u32>> {
    let columns: Vec<f32> = b.positions.iter().map(|p| p[0]).collect();
    let rows: Vec<f32> = b.positions.iter().map(|p| p[1]).collect();
    (0..a.positions.len())
        .into_par_iter()
        .map(|i| {
            if interrupt.is_set() {
                return None;
            }
            let line = epipolar_line(fundamental, a.positions[i]);
            best_of_one(&a.descriptors[i], line, (&columns, &rows), b.descriptors, band, ratio)
        })
        .collect()
}

/// The line `p x + q y + r = 0` in b of a pixel of a, scaled so that its left side is the distance in pixels.
fn epipolar_line(f: &[f64; 9], position: [f32; 2]) -> [f32; 3] {
    let (x, y) = (f64::from(position[0]), f64::from(position[1]));
    let line: [f64; 3] = std::array::from_fn(|r| f[3 * r] * x + f[3 * r + 1] * y + f[3 * r + 2]);
    let length = line[0].hypot(line[1]).max(1e-300);
    line.map(|v| (v / length) as f32)
}

/// Features whose distances from a line are found at once: hardly any of them lies on it.
const AT_ONCE: usize = 32;

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn best_of_one(
    descriptor: &[u8; DESCRIPTOR],
    [p, q, r]: [f32; 3],
    (columns, rows): (&[f32], &[f32]),
    descriptors: &[[u8; DESCRIPTOR]],
    band: f32,
    ratio: f32,
) -> Option<u32> {
    let (mut first, mut second, mut winner) = (i32::MAX, i32::MAX, None);
    for (part, (columns, rows)) in columns.chunks(AT_ONCE).zip(rows.chunks(AT_ONCE)).enumerate() {
        let mut beyond = [f32::INFINITY; AT_ONCE];
        for ((d, x), y) in beyond.iter_mut().zip(columns).zip(rows) {
            *d = (p * x + q * y + r).abs();
        }
        let mut any = false;
        for d in &beyond {
            any |= *d <= band;
        }
        if !any {
            continue;
        }
        for k in (0..columns.len()).filter(|&k| beyond[k] <= band) {
            let j = part * AT_ONCE + k;
            let mut distance = 0i32;
            for (s, t) in descriptor.iter().zip(&descriptors[j]) {
                let d = i16::from(*s) - i16::from(*t);
                distance += i32::from(d) * i32::from(d);
            }
            if distance < first {
                (second, first, winner) = (first, distance, Some(j as u32));
            } else if distance < second {
                second = distance;
            }
        }
    }
    let limit = f64::from(ratio).powi(2) * f64::from(second);
    winner.filter(|_| f64::from(first) < limit && first < MOST_DISTANCE)
}

/// Squared distance beyond which two SIFT descriptors (each of length about 512) show different things.
const MOST_DISTANCE: i32 = 300 * 300;

#[cfg(test)]
mod tests {
    use super::*;

    /// Horizontal epipolar lines: F of a rectified pair.
    const RECTIFIED: [f64; 9] = [0., 0., 0., 0., 0., -1., 0., 1., 0.];

    #[test]
    fn the_twin_on_the_line_is_taken_and_the_better_one_off_it_is_not() {
        let describe =
            |seed: u8| std::array::from_fn(|k| seed.wrapping_mul(31).wrapping_add((k as u8).wrapping_mul(3)) / 4);
        let mut near = describe(1);
        near[0] += 20;
        let a = Features { positions: &[[10., 20.]], descriptors: &[describe(1)] };
        let b = Features { positions: &[[5., 20.5], [5., 60.]], descriptors: &[near, describe(1)] };
        assert_eq!(match_epipolar(a, b, &RECTIFIED, 2.0, 0.8).unwrap(), [[0, 0]]);
        assert_eq!(match_epipolar(a, b, &RECTIFIED, f32::INFINITY, 0.8).unwrap(), [[0, 1]]);
    }

    #[test]
    fn ambiguous_matches_are_dropped() {
        let d = [[50u8; DESCRIPTOR]];
        let a = Features { positions: &[[10., 20.]], descriptors: &d };
        let b = Features { positions: &[[5., 20.], [9., 20.]], descriptors: &[d[0], d[0]] };
        assert!(match_epipolar(a, b, &RECTIFIED, 2.0, 0.8).unwrap().is_empty());
        let none = Features { positions: &[], descriptors: &[] };
        assert!(match_epipolar(a, none, &RECTIFIED, 2.0, 0.8).unwrap().is_empty());
    }
}
