//! An expected depth as a term of a cost volume: planes far from it cost more, by how sure the expectation is.
//!
//! ```text
//!   C(p, d) += weight · confidence(p) · min(|d - expected(p)| / reach, 1)
//! ```
//!
//! The term is bounded, so that photographs that speak for another depth still win. A pixel that expects nothing
//! (confidence 0, or NaN) is left as it is.

use crate::error::{Result, require};
use multiversion::multiversion;
use rayon::prelude::*;

/// The largest cost that [`crate::aggregate::aggregate`] takes.
const LARGEST: u8 = 127;

/// Adds the term above to `costs` (h·w, `planes`); `expected` is in planes, `weight` in cost units, `reach` in planes.
pub fn expect(
    costs: &mut [u8],
    planes: usize,
    expected: &[f32],
    confidence: &[f32],
    weight: f32,
    reach: f32,
) -> Result<()> {
    require(planes >= 1, "planes", "at least one", planes)?;
    let pixels = costs.len() / planes;
    require(expected.len() == pixels, "expected", format!("{pixels} values"), expected.len())?;
    require(confidence.len() == pixels, "confidence", format!("{pixels} values"), confidence.len())?;
    require((0.0..=63.0).contains(&weight), "weight", "0 to 63", weight)?;
    require(reach > 0.0, "reach", "a positive number of planes", reach)?;
    const ROWS: usize = 1024;
    costs.par_chunks_mut(ROWS * planes).enumerate().for_each(|(n, some)| {
        let range = n * ROWS..n * ROWS + some.len() / planes;
        add(some, planes, &expected[range.clone()], &confidence[range], weight, reach);
    });
    Ok(())
}

#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma+bmi2",
    "x86_64+avx2+fma+bmi2",
    "aarch64+neon"
))]
fn add(costs: &mut [u8], planes: usize, expected: &[f32], confidence: &[f32], weight: f32, reach: f32) {
    let pixels = costs.chunks_exact_mut(planes).zip(expected).zip(confidence);
    for ((row, &middle), &sure) in pixels {
        let most = weight * sure.clamp(0.0, 1.0);
        if !(most > 0.0 && middle.is_finite()) {
            continue;
        }
        let slope = most / reach;
        for (d, cost) in row.iter_mut().enumerate() {
            let more = (slope * (d as f32 - middle).abs()).min(most) + 0.5;
            *cost = cost.saturating_add(more as u8).min(LARGEST);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_near_the_expected_one_stay_cheap() {
        let mut costs = vec![10u8; 3 * 16];
        expect(&mut costs, 16, &[5.0, 5.0, f32::NAN], &[1.0, 0.5, 1.0], 20.0, 4.0).unwrap();
        assert_eq!(costs[..16], [30, 30, 25, 20, 15, 10, 15, 20, 25, 30, 30, 30, 30, 30, 30, 30].map(|c: u8| c));
        assert_eq!((costs[16 + 5], costs[16 + 15]), (10, 20));
        assert!(costs[32..].iter().all(|&c| c == 10));
    }

    #[test]
    fn costs_stay_within_what_the_aggregation_takes() {
        let mut costs = vec![120u8; 2 * 8];
        expect(&mut costs, 8, &[0.0, f32::INFINITY], &[9.0, f32::NAN], 60.0, 1.0).unwrap();
        assert!(costs.iter().all(|&c| c <= 127) && costs[0] == 120 && costs[7] == 127 && costs[8] == 120);
    }

    #[test]
    fn wrong_input_is_named() {
        let mut costs = vec![0u8; 8];
        let mut said =
            |e: &[f32], c: &[f32], weight, reach| expect(&mut costs, 4, e, c, weight, reach).unwrap_err().to_string();
        assert!(said(&[1.0], &[1.0, 1.0], 1.0, 1.0).starts_with("expected:"));
        assert!(said(&[1.0; 2], &[1.0], 1.0, 1.0).starts_with("confidence:"));
        assert!(said(&[1.0; 2], &[1.0; 2], 64.0, 1.0).starts_with("weight:"));
        assert!(said(&[1.0; 2], &[1.0; 2], 1.0, f32::NAN).starts_with("reach:"));
    }
}
