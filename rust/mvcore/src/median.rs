//! Weighted median of a map, guided by an image: at each pixel the middle of the values around it, where what is near and of
//! the same colour weighs most. It brings a map's edges onto the image's, and fills what is unknown from its own surface.
//!
//! ```text
//!   w(p, q) = exp(-|I_p - I_q| / colour) · exp(-|p - q| / distance)
//! ```
//!
//! Ma, He, Wei, Sun & Wu, "Constant Time Weighted Median Filtering for Stereo Matching and Beyond", ICCV 2013; here each median
//! is selected directly, and pixels in whose window nothing differs are passed over.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::raster::Raster;
use rayon::prelude::*;

/// What [`weighted_median`] looks at, and what counts there.
#[derive(Debug, Clone, Copy)]
pub struct MedianParams {
    /// Pixels from the middle of the window to its side.
    pub radius: usize,
    /// Pixels between the window's samples.
    pub step: usize,
    /// Grey levels, of the mean over the channels, at which a sample's weight has fallen to 1 / e.
    pub colour: f32,
    /// Pixels at which a sample's weight has fallen to 1 / e.
    pub distance: f32,
    /// A value that differs from its median by no more than this stays.
    pub slack: f32,
}

/// The map with each value replaced by its weighted median where they differ by more than the slack, or where `doubtful` is not 0.
///
/// `guide` has `3 * width` bytes a row; NaN is unknown: it counts for nothing and is replaced where anything around is known.
pub fn weighted_median(
    values: Raster<f32>,
    guide: Raster<u8>,
    doubtful: Raster<u8>,
    params: &MedianParams,
) -> Result<Vec<f32>> {
    let (w, h) = (values.width, values.height);
    require((guide.width, guide.height) == (3 * w, h), "guide", format!("{h} rows of {w} RGB pixels"), guide.width)?;
    require((doubtful.width, doubtful.height) == (w, h), "doubtful", format!("{h} x {w}"), doubtful.width)?;
    require((1..=64).contains(&params.radius), "radius", "1 to 64 pixels", params.radius)?;
    require((1..=params.radius).contains(&params.step), "step", "1 to the radius", params.step)?;
    require(params.colour > 0.0, "colour", "a positive number of grey levels", params.colour)?;
    require(params.distance > 0.0, "distance", "a positive number of pixels", params.distance)?;
    require(params.slack >= 0.0, "slack", "0 or more", params.slack)?;
    let near = Weights::new(params);
    let mut out = vec![0.0f32; w * h];
    let interrupt = Interrupt::current();
    out.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
        interrupt.poll();
        let mut samples = Vec::with_capacity(near.offsets.len());
        for (x, value) in row.iter_mut().enumerate() {
            let mine = values.row(y)[x];
            let slack = if doubtful.row(y)[x] != 0 || mine.is_nan() { None } else { Some(params.slack) };
            *value = median_at(values, guide, x, y, &near, slack, &mut samples);
        }
    });
    Ok(out)
}

/// Samples of the window with their weights by distance, and weights by colour.
struct Weights {
    offsets: Vec<(isize, isize, f32)>,
    /// By the sum of the three channels' differences.
    colour: Vec<f32>,
    radius: usize,
}

impl Weights {
    fn new(params: &MedianParams) -> Self {
        let steps = (params.radius / params.step) as isize;
        let step = params.step as isize;
        let offsets = (-steps..=steps)
            .flat_map(|j| (-steps..=steps).map(move |i| (i * step, j * step)))
            .map(|(i, j)| (i, j, (-((i * i + j * j) as f32).sqrt() / params.distance).exp()))
            .collect();
        let colour = (0..=3 * 255).map(|d| (-(d as f32) / (3.0 * params.colour)).exp()).collect();
        Self { offsets, colour, radius: params.radius }
    }
}

fn median_at(
    values: Raster<f32>,
    guide: Raster<u8>,
    x: usize,
    y: usize,
    near: &Weights,
    slack: Option<f32>,
    samples: &mut Vec<(f32, f32)>,
) -> f32 {
    let (w, h, mine) = (values.width, values.height, values.row(y)[x]);
    let inside = x >= near.radius && y >= near.radius && x + near.radius < w && y + near.radius < h;
    let place = |&(i, j, weight): &(isize, isize, f32)| {
        let (u, v) = (x.wrapping_add_signed(i), y.wrapping_add_signed(j));
        (inside || (u < w && v < h)).then(|| (v * w + u, weight))
    };
    if let Some(slack) = slack {
        // Where nothing around differs, the median does not either.
        let differs = |at: usize| (values.data[at] - mine).abs() > slack;
        if !near.offsets.iter().filter_map(place).any(|(at, _)| differs(at)) {
            return mine;
        }
    }
    let own = &guide.data[3 * (y * w + x)..][..3];
    samples.clear();
    let (mut total, mut above, mut below) = (0.0, 0.0, 0.0);
    let (least, most) = slack.map_or((mine, mine), |s| (mine - s, mine + s));
    for (at, weight) in near.offsets.iter().filter_map(place) {
        let value = values.data[at];
        if !value.is_nan() {
            let theirs = &guide.data[3 * at..][..3];
            let differ = (0..3).map(|c| usize::from(own[c].abs_diff(theirs[c]))).sum::<usize>();
            let weight = weight * near.colour[differ];
            total += weight;
            above += if value > most { weight } else { 0.0 };
            below += if value < least { weight } else { 0.0 };
            samples.push((value, weight));
        }
    }
    // The median is beyond the slack where half of the weight is: elsewhere nobody asks what it is.
    if samples.is_empty() || (slack.is_some() && 2.0 * above <= total && 2.0 * below < total) {
        return mine;
    }
    let found = select(samples, 0.5 * total);
    match slack {
        Some(slack) if (found - mine).abs() <= slack => mine,
        _ => found,
    }
}

/// The least value up to which the samples (value, weight) weigh `wanted` or more, by partitioning around pivots.
fn select(mut samples: &mut [(f32, f32)], mut wanted: f32) -> f32 {
    const FEW: usize = 12;
    while samples.len() > FEW {
        let (a, b, c) = (samples[0].0, samples[samples.len() / 2].0, samples[samples.len() - 1].0);
        let pivot = a.min(b).max(a.max(b).min(c));
        let (mut below, mut at, mut end) = (0, 0, samples.len());
        let (mut less, mut equal) = (0.0, 0.0);
        while at < end {
            let (value, weight) = samples[at];
            if value < pivot {
                less += weight;
                samples.swap(below, at);
                (below, at) = (below + 1, at + 1);
            } else if value > pivot {
                end -= 1;
                samples.swap(at, end);
            } else {
                equal += weight;
                at += 1;
            }
        }
        if wanted <= less && below > 0 {
            samples = &mut samples[..below];
        } else if wanted <= less + equal || end == samples.len() {
            return pivot;
        } else {
            wanted -= less + equal;
            samples = &mut samples[end..];
        }
    }
    samples.sort_unstable_by(|p, q| p.0.total_cmp(&q.0));
    let mut sum = 0.0;
    for &(value, weight) in samples.iter() {
        sum += weight;
        if sum >= wanted {
            return value;
        }
    }
    samples[samples.len() - 1].0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PARAMS: MedianParams = MedianParams { radius: 4, step: 1, colour: 8.0, distance: 3.0, slack: 0.0 };

    fn run(values: &[f32], guide: &[u8], doubtful: &[u8], width: usize, params: &MedianParams) -> Result<Vec<f32>> {
        let h = values.len() / width;
        weighted_median(
            Raster::new(values, width, h, "values")?,
            Raster::new(guide, 3 * width, h, "guide")?,
            Raster::new(doubtful, width, h, "doubtful")?,
            params,
        )
    }

    /// A picture dark on the left, bright from column `edge` on.
    fn two_halves(width: usize, height: usize, edge: usize) -> Vec<u8> {
        (0..width * height * 3).map(|k| if k / 3 % width < edge { 30 } else { 200 }).collect()
    }

    #[test]
    fn a_fattened_edge_moves_onto_the_pictures() {
        let (w, h) = (20, 12);
        let fat: Vec<f32> = (0..w * h).map(|k| if k % w < 9 { 1.0 } else { 5.0 }).collect();
        let out = run(&fat, &two_halves(w, h, 10), &vec![0; w * h], w, &PARAMS).unwrap();
        assert!(out.iter().enumerate().all(|(k, &v)| v == if k % w < 10 { 1.0 } else { 5.0 }));
    }

    #[test]
    fn unknown_values_come_from_their_own_surface() {
        let (w, h) = (20, 12);
        let mut values: Vec<f32> = (0..w * h).map(|k| if k % w < 10 { 1.0 } else { 5.0 }).collect();
        for y in 4..8 {
            values[y * w + 9..y * w + 12].fill(f32::NAN);
        }
        let out = run(&values, &two_halves(w, h, 10), &vec![0; w * h], w, &PARAMS).unwrap();
        assert!(out.iter().enumerate().all(|(k, &v)| v == if k % w < 10 { 1.0 } else { 5.0 }));
        let nothing = run(&vec![f32::NAN; w * h], &two_halves(w, h, 10), &vec![0; w * h], w, &PARAMS).unwrap();
        assert!(nothing.iter().all(|v| v.is_nan()));
    }

    #[test]
    fn values_within_the_slack_stay_unless_they_are_doubtful() {
        let (w, h) = (9, 9);
        let mut values = vec![2.0f32; w * h];
        (values[40], values[44]) = (2.5, 9.0);
        let mut doubtful = vec![0; w * h];
        let loose = MedianParams { slack: 1.0, ..PARAMS };
        let out = run(&values, &vec![7; 3 * w * h], &doubtful, w, &loose).unwrap();
        assert_eq!((out[40], out[44]), (2.5, 2.0));
        doubtful[40] = 1;
        assert_eq!(run(&values, &vec![7; 3 * w * h], &doubtful, w, &loose).unwrap()[40], 2.0);
    }

    #[test]
    fn wrong_input_is_named() {
        let said = |params: MedianParams| run(&[0.0; 4], &[0; 12], &[0; 4], 2, &params).unwrap_err().to_string();
        assert!(said(MedianParams { radius: 0, ..PARAMS }).starts_with("radius:"));
        assert!(said(MedianParams { step: 5, ..PARAMS }).starts_with("step:"));
        assert!(said(MedianParams { colour: 0.0, ..PARAMS }).starts_with("colour:"));
        assert!(said(MedianParams { distance: f32::NAN, ..PARAMS }).starts_with("distance:"));
        assert!(said(MedianParams { slack: -1.0, ..PARAMS }).starts_with("slack:"));
        let short = weighted_median(
            Raster::new(&[0.0; 4], 2, 2, "values").unwrap(),
            Raster::new(&[0; 4], 2, 2, "guide").unwrap(),
            Raster::new(&[0; 4], 2, 2, "doubtful").unwrap(),
            &PARAMS,
        );
        assert!(short.unwrap_err().to_string().starts_with("guide:"));
    }

    proptest! {
        #[test]
        fn selecting_equals_sorting(
            samples in prop::collection::vec((0u8..9, 1u16..100), 1..80),
            share in 0.01f32..0.99,
        ) {
            let mut samples: Vec<(f32, f32)> = samples.iter().map(|&(v, w)| (f32::from(v), f32::from(w))).collect();
            let wanted = (share * samples.iter().map(|s| s.1).sum::<f32>()).ceil();
            let mut sorted = samples.clone();
            sorted.sort_by(|p, q| p.0.total_cmp(&q.0));
            let mut sum = 0.0;
            let expected = sorted.iter().find(|s| { sum += s.1; sum >= wanted }).unwrap().0;
            prop_assert_eq!(select(&mut samples, wanted), expected);
        }
    }
}
