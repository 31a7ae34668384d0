//! Sums over a slanted window: the inner loop of [`crate::slanted`], eight samples at a time with AVX2, sixteen with AVX-512.
//!
//! A source image is stored as [`Quads`]: each pixel with its right, lower and lower-right neighbour in one 32-bit word, so
//! that one load fetches all four taps of a bilinear sample, which two integer instructions then blend. The only `unsafe`
//! code of the crate lives here.

use crate::raster::Raster;

/// Window samples, padded to a multiple of sixteen with zero weights.
pub const SAMPLES: usize = 32;

/// Offsets of the samples from the window's centre: the checkerboard inside a disc, 29 of them: two registers of AVX-512.
pub static OFFSETS: ([f32; SAMPLES], [f32; SAMPLES], usize) = {
    let (mut dx, mut dy, mut n) = ([0.0; SAMPLES], [0.0; SAMPLES], 0);
    let mut y = -4i32;
    while y <= 4 {
        let mut x = -4i32;
        while x <= 4 {
            if (x + y) % 2 == 0 && x * x + y * y <= 18 {
                dx[n] = x as f32;
                dy[n] = y as f32;
                n += 1;
            }
            x += 1;
        }
        y += 1;
    }
    (dx, dy, n)
};

/// An image whose every word holds the 2x2 pixels from it on: `p(x, y) | p(x+1, y) << 8 | p(x, y+1) << 16 | ..`.
pub struct Quads {
    words: Vec<u32>,
    width: usize,
    height: usize,
}

impl Quads {
    /// Packs an image; the last row and column repeat.
    pub fn new(image: Raster<u8>) -> Self {
        let (w, h) = (image.width, image.height);
        let mut words = Vec::with_capacity(w * h);
        for y in 0..h {
            let (a, b) = (image.row(y), image.row((y + 1).min(h - 1)));
            for x in 0..w {
                let r = (x + 1).min(w - 1);
                words.push(u32::from_le_bytes([a[x], a[r], b[x], b[r]]));
            }
        }
        Self { words, width: w, height: h }
    }

    /// The words, row-major, one a pixel.
    #[inline(always)]
    pub fn words(&self) -> &[u32] {
        &self.words
    }

    /// Columns and rows.
    #[inline(always)]
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Whether the position lies on the image.
    #[inline(always)]
    pub fn sees(&self, u: f32, v: f32) -> bool {
        u >= 0.0 && v >= 0.0 && u <= (self.width - 1) as f32 && v <= (self.height - 1) as f32
    }
}

/// The reference side of a window: weights and weighted values of its samples.
#[derive(Clone)]
pub struct Window {
    /// Sample weights, summing to 1.
    pub weight: [f32; SAMPLES],
    /// Weight times grey value above [`GREY_ZERO`].
    pub weighted: [f32; SAMPLES],
}

/// Where the window's samples fall in the source: `(u, v) + dx (ux, vx) + dy (uy, vy)`.
#[derive(Debug, Clone, Copy)]
pub struct Affine {
    /// Column of the centre.
    pub u: f32,
    /// Row of the centre.
    pub v: f32,
    /// d u / d x, d v / d x, d u / d y, d v / d y.
    pub jacobian: [f32; 4],
}

/// `(Σ w s, Σ w s², Σ w r s)` of source samples s and reference samples r, grey levels above [`GREY_ZERO`].
pub type SumsOf = fn(&Quads, &Window, Affine) -> [f32; 3];

/// The fastest [`SumsOf`] this CPU can run.
pub fn sums_for_this_cpu() -> SumsOf {
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx512bw") {
        // SAFETY: the CPU has the feature that the function is compiled for, checked just above.
        return |q, w, a| unsafe { sums_avx512(q, w, a) };
    }
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
        // SAFETY: the CPU has the features that the function is compiled for, checked just above.
        return |q, w, a| unsafe { sums_avx2(q, w, a) };
    }
    sums_portable
}

/// Bits of a sample's place between pixels.
const BITS: u32 = 7;
/// Steps from one pixel to the next.
const UNIT: f32 = (1 << BITS) as f32;
/// Turns a word's grey levels into signed ones: g - [`GREY_ZERO`].
const CENTRED: i32 = i32::from_ne_bytes([0x80; 4]);
/// A step n along x times the first plus the second: the byte pairs (128 - n, n) for the upper and the lower pixels.
const ACROSS: (i32, i32) = (0x00ff_00ff, 0x0080_0080);
/// The grey level that counts as 0 in all sums.
pub const GREY_ZERO: f32 = 128.0;

/// The readable twin. It finds the samples with the same fused steps, or a place halfway between two steps would round the other way.
pub fn sums_portable(source: &Quads, window: &Window, at: Affine) -> [f32; 3] {
    let (dx, dy, n) = (&OFFSETS.0, &OFFSETS.1, OFFSETS.2);
    let [ux, vx, uy, vy] = at.jacobian.map(|j| UNIT * j);
    let (x_max, y_max) = (UNIT * (source.width - 1) as f32, UNIT * (source.height - 1) as f32);
    let mut sums = [0.0; 3];
    for i in 0..n {
        let u = dx[i].mul_add(ux, dy[i].mul_add(uy, UNIT * at.u)).clamp(0.0, x_max);
        let v = dx[i].mul_add(vx, dy[i].mul_add(vy, UNIT * at.v)).clamp(0.0, y_max);
        let (u, v) = (u.round_ties_even() as usize, v.round_ties_even() as usize);
        let (x, y) = (u >> BITS, v >> BITS);
        let (fx, fy) = ((u as f32 / UNIT).fract(), (v as f32 / UNIT).fract());
        let [a, b, c, d] = source.words[y * source.width + x].to_le_bytes().map(|g| f32::from(g) - GREY_ZERO);
        let (top, bottom) = (a + fx * (b - a), c + fx * (d - c));
        let s = top + fy * (bottom - top);
        sums[0] += window.weight[i] * s;
        sums[1] += window.weight[i] * s * s;
        sums[2] += window.weighted[i] * s;
    }
    sums
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw")]
fn sums_avx512(source: &Quads, window: &Window, at: Affine) -> [f32; 3] {
    use std::arch::x86_64::*;
    let zero = _mm512_setzero_ps();
    let x_max = _mm512_set1_ps(UNIT * (source.width - 1) as f32);
    let y_max = _mm512_set1_ps(UNIT * (source.height - 1) as f32);
    let [ux, vx, uy, vy] = at.jacobian.map(|j| _mm512_set1_ps(UNIT * j));
    let (u0, v0) = (_mm512_set1_ps(UNIT * at.u), _mm512_set1_ps(UNIT * at.v));
    let (stride, between) = (_mm512_set1_epi32(source.width as i32), _mm512_set1_epi32(UNIT as i32 - 1));
    let (mut s1, mut s2, mut rs) = (zero, zero, zero);
    for i in (0..SAMPLES).step_by(16) {
        // SAFETY: i + 16 <= SAMPLES, the length of all four arrays.
        let (dx, dy, weight, weighted) = unsafe {
            (
                _mm512_loadu_ps(OFFSETS.0.as_ptr().add(i)),
                _mm512_loadu_ps(OFFSETS.1.as_ptr().add(i)),
                _mm512_loadu_ps(window.weight.as_ptr().add(i)),
                _mm512_loadu_ps(window.weighted.as_ptr().add(i)),
            )
        };
        let u = _mm512_fmadd_ps(dx, ux, _mm512_fmadd_ps(dy, uy, u0));
        let v = _mm512_fmadd_ps(dx, vx, _mm512_fmadd_ps(dy, vy, v0));
        // max first: it returns its second operand for NaN, so that the index below is always inside.
        let u = _mm512_cvtps_epi32(_mm512_min_ps(_mm512_max_ps(u, zero), x_max));
        let v = _mm512_cvtps_epi32(_mm512_min_ps(_mm512_max_ps(v, zero), y_max));
        let (x, y) = (_mm512_srli_epi32::<BITS>(u), _mm512_srli_epi32::<BITS>(v));
        let (fx, fy) = (_mm512_and_si512(u, between), _mm512_and_si512(v, between));
        let index = _mm512_add_epi32(_mm512_mullo_epi32(y, stride), x);
        // SAFETY: 0 <= x < width and 0 <= y < height by the clamps, and `words` holds width * height words.
        let four = |index: __m128i| unsafe { four_words(source.words.as_ptr(), index) };
        let quad = _mm512_castsi128_si512(four(_mm512_castsi512_si128(index)));
        let quad = _mm512_inserti32x4::<1>(quad, four(_mm512_extracti32x4_epi32::<1>(index)));
        let quad = _mm512_inserti32x4::<2>(quad, four(_mm512_extracti32x4_epi32::<2>(index)));
        let quad = _mm512_inserti32x4::<3>(quad, four(_mm512_extracti32x4_epi32::<3>(index)));
        let grey = _mm512_xor_si512(quad, _mm512_set1_epi32(CENTRED));
        let across = _mm512_add_epi32(_mm512_mullo_epi32(fx, _mm512_set1_epi32(ACROSS.0)), _mm512_set1_epi32(ACROSS.1));
        let down = _mm512_add_epi32(_mm512_sub_epi32(_mm512_slli_epi32::<16>(fy), fy), _mm512_set1_epi32(UNIT as i32));
        let s = _mm512_cvtepi32_ps(_mm512_madd_epi16(_mm512_maddubs_epi16(across, grey), down));
        let ws = _mm512_mul_ps(weight, s);
        s1 = _mm512_add_ps(s1, ws);
        s2 = _mm512_fmadd_ps(ws, s, s2);
        rs = _mm512_fmadd_ps(weighted, s, rs);
    }
    scaled([s1, s2, rs].map(|lanes| _mm512_reduce_add_ps(lanes)))
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn sums_avx2(source: &Quads, window: &Window, at: Affine) -> [f32; 3] {
    use std::arch::x86_64::*;
    let zero = _mm256_setzero_ps();
    let x_max = _mm256_set1_ps(UNIT * (source.width - 1) as f32);
    let y_max = _mm256_set1_ps(UNIT * (source.height - 1) as f32);
    let [ux, vx, uy, vy] = at.jacobian.map(|j| _mm256_set1_ps(UNIT * j));
    let (u0, v0) = (_mm256_set1_ps(UNIT * at.u), _mm256_set1_ps(UNIT * at.v));
    let (stride, between) = (_mm256_set1_epi32(source.width as i32), _mm256_set1_epi32(UNIT as i32 - 1));
    let (mut s1, mut s2, mut rs) = (zero, zero, zero);
    for i in (0..OFFSETS.2).step_by(8) {
        // SAFETY: i + 8 <= SAMPLES, the length of all four arrays.
        let (dx, dy, weight, weighted) = unsafe {
            (
                _mm256_loadu_ps(OFFSETS.0.as_ptr().add(i)),
                _mm256_loadu_ps(OFFSETS.1.as_ptr().add(i)),
                _mm256_loadu_ps(window.weight.as_ptr().add(i)),
                _mm256_loadu_ps(window.weighted.as_ptr().add(i)),
            )
        };
        let u = _mm256_fmadd_ps(dx, ux, _mm256_fmadd_ps(dy, uy, u0));
        let v = _mm256_fmadd_ps(dx, vx, _mm256_fmadd_ps(dy, vy, v0));
        // max first: it returns its second operand for NaN, so that the index below is always inside.
        let u = _mm256_cvtps_epi32(_mm256_min_ps(_mm256_max_ps(u, zero), x_max));
        let v = _mm256_cvtps_epi32(_mm256_min_ps(_mm256_max_ps(v, zero), y_max));
        let (x, y) = (_mm256_srli_epi32::<{ BITS as i32 }>(u), _mm256_srli_epi32::<{ BITS as i32 }>(v));
        let (fx, fy) = (_mm256_and_si256(u, between), _mm256_and_si256(v, between));
        let index = _mm256_add_epi32(_mm256_mullo_epi32(y, stride), x);
        // SAFETY: 0 <= x < width and 0 <= y < height by the clamps, and `words` holds width * height words.
        let four = |index: __m128i| unsafe { four_words(source.words.as_ptr(), index) };
        let quad = _mm256_castsi128_si256(four(_mm256_castsi256_si128(index)));
        let quad = _mm256_inserti128_si256::<1>(quad, four(_mm256_extracti128_si256::<1>(index)));
        let grey = _mm256_xor_si256(quad, _mm256_set1_epi32(CENTRED));
        let across = _mm256_add_epi32(_mm256_mullo_epi32(fx, _mm256_set1_epi32(ACROSS.0)), _mm256_set1_epi32(ACROSS.1));
        let down = _mm256_add_epi32(_mm256_sub_epi32(_mm256_slli_epi32::<16>(fy), fy), _mm256_set1_epi32(UNIT as i32));
        let s = _mm256_cvtepi32_ps(_mm256_madd_epi16(_mm256_maddubs_epi16(across, grey), down));
        let ws = _mm256_mul_ps(weight, s);
        s1 = _mm256_add_ps(s1, ws);
        s2 = _mm256_fmadd_ps(ws, s, s2);
        rs = _mm256_fmadd_ps(weighted, s, rs);
    }
    scaled([s1, s2, rs].map(|lanes| {
        let half = _mm_add_ps(_mm256_castps256_ps128(lanes), _mm256_extractf128_ps::<1>(lanes));
        let pair = _mm_add_ps(half, _mm_movehl_ps(half, half));
        _mm_cvtss_f32(_mm_add_ss(pair, _mm_shuffle_ps::<1>(pair, pair)))
    }))
}

/// Words of four indices. Single loads: the gather instruction is slower on AMD's cores and on Intel's patched ones.
///
/// # Safety
/// All four indices lie inside `words`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "sse4.1")]
#[inline]
unsafe fn four_words(words: *const u32, index: std::arch::x86_64::__m128i) -> std::arch::x86_64::__m128i {
    use std::arch::x86_64::*;
    let (low, high) = (_mm_cvtsi128_si64(index) as u64, _mm_extract_epi64::<1>(index) as u64);
    // SAFETY: the caller's word.
    let word = |n: u64| unsafe { *words.add(n as u32 as usize) } as i32;
    let found = _mm_cvtsi32_si128(word(low));
    let found = _mm_insert_epi32::<1>(found, word(low >> 32));
    let found = _mm_insert_epi32::<2>(found, word(high));
    _mm_insert_epi32::<3>(found, word(high >> 32))
}

/// Sums of samples in fixed point brought back to grey levels.
#[inline(always)]
fn scaled([s1, s2, rs]: [f32; 3]) -> [f32; 3] {
    const GREY: f32 = 1.0 / (UNIT * UNIT);
    [s1 * GREY, s2 * (GREY * GREY), rs * GREY]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn this_cpus_sums_equal_the_portable_ones(
            u in -20.0f32..60.0, v in -20.0f32..50.0, jacobian in prop::array::uniform4(-2.0f32..2.0), seed in any::<u32>(),
        ) {
            let hash = |i: u32| (i.wrapping_mul(2654435761).wrapping_add(seed) >> 13) as u8;
            let pixels: Vec<u8> = (0..40 * 30).map(hash).collect();
            let quads = Quads::new(Raster::new(&pixels, 40, 30, "source").unwrap());
            let mut window = Window { weight: [0.0; SAMPLES], weighted: [0.0; SAMPLES] };
            for i in 0..OFFSETS.2 {
                window.weight[i] = 1.0 / OFFSETS.2 as f32;
                window.weighted[i] = window.weight[i] * f32::from(hash(i as u32 + 9000));
            }
            let at = Affine { u, v, jacobian };
            let slow = sums_portable(&quads, &window, at);
            let mut kinds: Vec<SumsOf> = vec![sums_for_this_cpu()];
            #[cfg(target_arch = "x86_64")]
            if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
                // SAFETY: checked just above.
                kinds.push(|q, w, a| unsafe { sums_avx2(q, w, a) });
            }
            // Rounding goes with the terms, not with a sum in which they cancel: the weights add up to 1, so that (Cauchy-Schwarz)
            // no sum of samples exceeds √Σws², nor that with the reference 255 times it.
            let root = slow[1].max(1.0).sqrt();
            let bound = [root, slow[1].max(1.0), 255.0 * root];
            for kind in kinds {
                let fast = kind(&quads, &window, at);
                for k in 0..3 {
                    prop_assert!((fast[k] - slow[k]).abs() <= 1e-5 * bound[k], "{fast:?} {slow:?}");
                }
            }
        }
    }
}
