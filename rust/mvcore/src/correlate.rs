//! The network's cost space: group-wise correlation of the reference's features with those of the sources warped to planes.
//!
//! ```text
//!   for each pixel │ for each source: plane ──► place in the source ──► bilinear features ──► Σ of products a group
//!                  │ visibility = sigmoid(max over planes of gain · correlation + bias)
//!                  └► Σ visibility · correlation / Σ visibility            (Σ over sources), layout (D, h, w, G)
//! ```
//!
//! A pixel's planes and sources stay in cache: no volume of warped features is ever stored. Group-wise correlation after Guo et al.
//! (CVPR 2019); the torch form that this equals is `mvcore.network.cost.correlate`.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::memory::zeroed;
use crate::raster::Epipolar;
use multiversion::multiversion;
use rayon::prelude::*;

/// Weight of a source that sees nothing: the sum of weights never vanishes.
const LEAST: f32 = 1e-3;
/// Least third coordinate of a pixel's image before division.
const NEAREST: f32 = 1e-6;

/// A feature map, (height, width, channels).
#[derive(Debug, Clone, Copy)]
pub struct Features<'a> {
    /// Values, channels fastest.
    pub data: &'a [f32],
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values a pixel.
    pub channels: usize,
}

/// Inverse depths of the planes.
#[derive(Debug, Clone, Copy)]
pub enum Planes<'a> {
    /// (D,): the same at every pixel.
    Common(&'a [f32]),
    /// (D, h, w): each pixel's own.
    Own(&'a [f32], usize),
}

impl Planes<'_> {
    fn count(&self) -> usize {
        match self {
            Planes::Common(values) => values.len(),
            Planes::Own(_, count) => *count,
        }
    }
}

/// What a source's visibility is made from.
#[derive(Debug, Clone, Copy)]
pub struct Visibility<'a> {
    /// Weight of each group's correlation, (G,).
    pub gain: &'a [f32],
    /// Added before the sigmoid.
    pub bias: f32,
}

/// Correlations (D, h, w, G) averaged over the sources by visibility; zero where a plane falls outside a source.
pub fn correlate(
    reference: Features,
    sources: &[(Features, Epipolar)],
    planes: Planes,
    visibility: Visibility,
) -> Result<Vec<f32>> {
    let (w, h, c, groups, d) =
        (reference.width, reference.height, reference.channels, visibility.gain.len(), planes.count());
    require(!sources.is_empty(), "sources", "at least one source view", "none")?;
    require(d > 0, "planes", "at least one plane", d)?;
    require(
        groups > 0 && c.is_multiple_of(groups),
        "gain",
        format!("a number of groups that divides {c} channels"),
        groups,
    )?;
    require(reference.data.len() == w * h * c, "reference", format!("{h} x {w} x {c} values"), reference.data.len())?;
    for (source, _) in sources {
        require(source.channels == c, "sources", format!("{c} channels, as the reference"), source.channels)?;
        require(
            source.data.len() == source.width * source.height * c && source.width > 0 && source.height > 0,
            "sources",
            "as many values as pixels and channels",
            source.data.len(),
        )?;
    }
    if let Planes::Own(values, _) = planes {
        require(values.len() == d * h * w, "planes", format!("{d} x {h} x {w} values"), values.len())?;
    }
    let mut out = zeroed::<f32>(d * h * w * groups);
    if w * h == 0 {
        return Ok(out);
    }
    // Rows of all planes, gathered by their row.
    let mut rows: Vec<Vec<&mut [f32]>> = (0..h).map(|_| Vec::with_capacity(d)).collect();
    for (n, row) in out.chunks_exact_mut(w * groups).enumerate() {
        rows[n % h].push(row);
    }
    let interrupt = Interrupt::current();
    rows.into_par_iter().enumerate().for_each_init(
        || vec![0.0f32; sources.len() * d * groups],
        |own, (y, mut rows)| {
            interrupt.poll();
            row(reference, sources, planes, visibility, y, own, &mut rows);
        },
    );
    Ok(out)
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn row(
    reference: Features,
    sources: &[(Features, Epipolar)],
    planes: Planes,
    visibility: Visibility,
    y: usize,
    own: &mut [f32],
    rows: &mut [&mut [f32]],
) {
    let (w, c, groups, d) = (reference.width, reference.channels, visibility.gain.len(), planes.count());
    for x in 0..w {
        let f = &reference.data[(y * w + x) * c..][..c];
        let mut total = 0.0;
        for (n, (source, map)) in sources.iter().enumerate() {
            let own = &mut own[n * d * groups..][..d * groups];
            let m = &map.matrix;
            let (px, py) = (x as f32, y as f32);
            let ray: [f32; 3] = std::array::from_fn(|k| m[3 * k] * px + m[3 * k + 1] * py + m[3 * k + 2]);
            let mut best = f32::NEG_INFINITY;
            for (k, out) in own.chunks_exact_mut(groups).enumerate() {
                let inverse = match planes {
                    Planes::Common(values) => values[k],
                    Planes::Own(values, _) => values[(k * reference.height + y) * w + x],
                };
                let q: [f32; 3] = std::array::from_fn(|k| map.offset[k].mul_add(inverse, ray[k]));
                let (u, v) = (q[0] / q[2], q[1] / q[2]);
                let inside =
                    q[2] > NEAREST && u > -1.0 && v > -1.0 && u < source.width as f32 && v < source.height as f32;
                if inside {
                    match (c, groups) {
                        (32, 8) => products::<32, 8>(f, *source, u, v, out),
                        (16, 8) => products::<16, 8>(f, *source, u, v, out),
                        _ => any_products(f, *source, u, v, out),
                    }
                } else {
                    out.fill(0.0);
                }
                let score: f32 = out.iter().zip(visibility.gain).map(|(a, b)| a * b).sum();
                best = best.max(score);
            }
            let weight = 1.0 / (1.0 + (-(best + visibility.bias)).exp()) + LEAST;
            total += weight;
            own.iter_mut().for_each(|v| *v *= weight);
        }
        let (first, others) = own.split_at_mut(d * groups);
        for other in others.chunks_exact(d * groups) {
            first.iter_mut().zip(other).for_each(|(a, b)| *a += b);
        }
        let share = 1.0 / total;
        for (row, values) in rows.iter_mut().zip(first.chunks_exact(groups)) {
            row[x * groups..(x + 1) * groups].iter_mut().zip(values).for_each(|(o, v)| *o = v * share);
        }
    }
}

/// The four pixels around a place with their weights; those outside weigh nothing.
#[inline(always)]
fn corners(source: &Features, u: f32, v: f32) -> [(usize, f32); 4] {
    let (fu, fv) = (u.floor(), v.floor());
    let (a, b) = (u - fu, v - fv);
    let (i, j) = (fu as i32, fv as i32);
    let corner = |di: i32, dj: i32, weight: f32| {
        let (i, j) = (i + di, j + dj);
        if i >= 0 && j >= 0 && i < source.width as i32 && j < source.height as i32 {
            ((j as usize * source.width + i as usize) * source.channels, weight)
        } else {
            (0, 0.0)
        }
    };
    [corner(0, 0, (1.0 - a) * (1.0 - b)), corner(1, 0, a * (1.0 - b)), corner(0, 1, (1.0 - a) * b), corner(1, 1, a * b)]
}

#[inline(always)]
fn products<const C: usize, const G: usize>(f: &[f32], source: Features, u: f32, v: f32, out: &mut [f32]) {
    let mut sum = [0.0f32; C];
    for (at, weight) in corners(&source, u, v) {
        let values: &[f32; C] = source.data[at..].first_chunk().unwrap_or(&[0.0; C]);
        for k in 0..C {
            sum[k] = values[k].mul_add(weight, sum[k]);
        }
    }
    for k in 0..C {
        sum[k] *= f[k];
    }
    for g in 0..G {
        out[g] = sum[g * (C / G)..(g + 1) * (C / G)].iter().sum();
    }
}

fn any_products(f: &[f32], source: Features, u: f32, v: f32, out: &mut [f32]) {
    let size = f.len() / out.len();
    out.fill(0.0);
    for (at, weight) in corners(&source, u, v) {
        for (k, value) in f.iter().enumerate() {
            out[k / size] += value * weight * source.data[at + k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SHIFT: Epipolar = Epipolar { matrix: [1., 0., 0., 0., 1., 0., 0., 0., 1.], offset: [-1., 0., 0.] };

    fn features(seed: u32, len: usize) -> Vec<f32> {
        let mut state = seed.wrapping_mul(2_654_435_761).max(1);
        let next = |_| {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            (state >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        (0..len).map(next).collect()
    }

    proptest! {
        #[test]
        fn a_shifted_copy_correlates_with_itself_at_its_shift(seed in 1u32..1000, shift in 0usize..4, wide in any::<bool>()) {
            let (w, h, c) = (9, 3, if wide { 32 } else { 12 });
            let right = features(seed, w * h * c);
            let mut left = vec![0.0; w * h * c];
            for y in 0..h {
                for x in shift..w {
                    let to = (y * w + x) * c;
                    left[to..to + c].copy_from_slice(&right[(y * w + x - shift) * c..][..c]);
                }
            }
            let view = |data| Features { data, width: w, height: h, channels: c };
            let planes = [0.0f32, 1.0, 2.0, 3.0, 3.5];
            let groups = if wide { 8 } else { 4 };
            let gain = vec![1.0; groups];
            let seen = Visibility { gain: &gain, bias: 0.0 };
            let one = correlate(view(&left), &[(view(&right), SHIFT)], Planes::Common(&planes), seen).unwrap();
            for y in 0..h {
                for x in shift..w {
                    for g in 0..groups {
                        let f = &left[(y * w + x) * c + g * (c / groups)..][..c / groups];
                        let own: f32 = f.iter().map(|v| v * v).sum();
                        prop_assert!((one[((shift * h + y) * w + x) * groups + g] - own).abs() < 1e-5);
                    }
                }
            }
            // The same source twice is the same as once; planes given pixel by pixel are the same as common ones.
            let twice = correlate(view(&left), &[(view(&right), SHIFT); 2], Planes::Common(&planes), seen).unwrap();
            let spread: Vec<f32> = planes.iter().flat_map(|&p| std::iter::repeat_n(p, w * h)).collect();
            let own = correlate(view(&left), &[(view(&right), SHIFT)], Planes::Own(&spread, 5), seen).unwrap();
            prop_assert!(one.iter().zip(&twice).all(|(a, b)| (a - b).abs() < 1e-6));
            prop_assert_eq!(one, own);
        }
    }

    #[test]
    fn wrong_shapes_are_named() {
        let data = vec![0.0; 24];
        let view = Features { data: &data, width: 3, height: 2, channels: 4 };
        let gain = [1.0; 2];
        let seen = Visibility { gain: &gain, bias: 0.0 };
        let name = |r: Result<Vec<f32>>| r.unwrap_err().to_string();
        assert!(name(correlate(view, &[], Planes::Common(&[1.0]), seen)).starts_with("sources"));
        assert!(name(correlate(view, &[(view, SHIFT)], Planes::Common(&[]), seen)).starts_with("planes"));
        assert!(name(correlate(view, &[(view, SHIFT)], Planes::Own(&[1.0], 1), seen)).starts_with("planes"));
        let odd = Visibility { gain: &[1.0; 3], bias: 0.0 };
        assert!(name(correlate(view, &[(view, SHIFT)], Planes::Common(&[1.0]), odd)).starts_with("gain"));
    }
}
