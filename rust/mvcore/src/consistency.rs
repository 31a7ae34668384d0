//! Geometric consistency: a depth is kept when enough other views, going there and back, agree with it.
//!
//! ```text
//!   p ──depth──► X ──► q in the other view ──its depth──► X' ──► p'     |p - p'| < n·a px  and  |z - z'| < n·b z
//! ```
//!
//! The dynamic rule of D2HC-RMVSNet (Yan et al., ECCV 2020): keep if for some n at least n views agree within n times the unit
//! tolerances; the depth becomes the mean over the agreeing views. Sparse rigs have few witnesses to a point: there it is also
//! kept if at least half of the views that could see it agree within three times the unit tolerances. A view whose surface stands
//! before the point could not see it; one that looks through the point to something farther could, and disagrees.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::raster::{Epipolar, Raster};
use rayon::prelude::*;

/// Another view: its depth map and the ways there and back.
#[derive(Debug, Clone, Copy)]
pub struct OtherView<'a> {
    /// z-depth, 0 means none.
    pub depth: Raster<'a, f32>,
    /// Reference pixel and inverse depth to this view.
    pub there: Epipolar,
    /// This view's pixel and inverse depth to the reference.
    pub back: Epipolar,
}

/// Tolerances of [`consistency`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConsistencyParams {
    /// Fewest agreeing views.
    pub min_views: usize,
    /// Pixels of reprojection error allowed per agreeing view.
    pub pixel_unit: f32,
    /// Relative depth error allowed per agreeing view.
    pub depth_unit: f32,
}

const MAX_VIEWS: usize = 32;
/// Units of tolerance within which a majority of the witnesses must agree.
const MAJORITY: f32 = 3.0;
/// Relative depth by which a surface must stand before a point to hide it.
const HIDING: f32 = 0.01;
const LARGEST_N: usize = 10;

/// Filtered depth (0 where inconsistent) and the number of agreeing views, each (h, w).
pub fn consistency(
    depth: Raster<f32>,
    others: &[OtherView],
    params: &ConsistencyParams,
) -> Result<(Vec<f32>, Vec<u8>)> {
    require(others.len() <= MAX_VIEWS, "others", "at most 32 views", others.len())?;
    require(params.min_views >= 1, "min_views", "at least 1", params.min_views)?;
    let (w, n) = (depth.width, depth.width * depth.height);
    let (mut kept, mut support) = (vec![0.0f32; n], vec![0u8; n]);
    let interrupt = Interrupt::current();
    kept.par_chunks_mut(w).zip(support.par_chunks_mut(w)).enumerate().for_each(|(y, (kept, support))| {
        interrupt.poll();
        for x in 0..w {
            let z = depth.data[y * w + x];
            if z > 0.0 {
                (kept[x], support[x]) = judge(x as f32, y as f32, z, others, params);
            }
        }
    });
    Ok((kept, support))
}

fn judge(x: f32, y: f32, z: f32, others: &[OtherView], params: &ConsistencyParams) -> (f32, u8) {
    let mut votes = [(f32::MAX, 0.0f32); MAX_VIEWS];
    let mut witnesses = 0;
    for other in others {
        if let Some(trip) = round_trip(x, y, z, other).filter(|trip| !trip.hidden) {
            let strictness = (trip.pixels / params.pixel_unit).max((trip.depth - z).abs() / (z * params.depth_unit));
            votes[witnesses] = (strictness, trip.depth);
            witnesses += 1;
        }
    }
    let agreeing = |n: f32| votes[..witnesses].iter().filter(|v| v.0 < n).count();
    let most = LARGEST_N.max(params.min_views);
    let by_rule = (params.min_views..=most).rev().find(|&n| agreeing(n as f32) >= n).map(|n| n as f32);
    let majority = agreeing(MAJORITY) >= params.min_views && 2 * agreeing(MAJORITY) >= witnesses;
    let Some(n) = by_rule.or(majority.then_some(MAJORITY)) else { return (0.0, 0) };
    let (mut sum, mut count) = (z, 1.0);
    for (_, back) in votes[..witnesses].iter().filter(|v| v.0 < n) {
        sum += back;
        count += 1.0;
    }
    (sum / count, (count - 1.0) as u8)
}

/// What comes back from another view.
struct Trip {
    /// Reprojection error.
    pixels: f32,
    /// Depth in the reference view.
    depth: f32,
    /// The other view's surface stands before the point.
    hidden: bool,
}

fn round_trip(x: f32, y: f32, z: f32, other: &OtherView) -> Option<Trip> {
    let (u, v, expected) = project(&other.there, x, y, z)?;
    let there = sample(&other.depth, u, v)?;
    let (bx, by, depth) = project(&other.back, u, v, there)?;
    let (dx, dy) = (bx - x, by - y);
    Some(Trip { pixels: (dx * dx + dy * dy).sqrt(), depth, hidden: there < expected * (1.0 - HIDING) })
}

fn project(map: &Epipolar, x: f32, y: f32, z: f32) -> Option<(f32, f32, f32)> {
    let (m, o) = (&map.matrix, &map.offset);
    let q: [f32; 3] = std::array::from_fn(|i| m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] + o[i] / z);
    (q[2] > 1e-9).then(|| (q[0] / q[2], q[1] / q[2], q[2] * z))
}

/// Depth between pixels: bilinear on one surface, the nearest pixel across a depth edge.
fn sample(depth: &Raster<f32>, u: f32, v: f32) -> Option<f32> {
    let inside = u >= 0.0 && v >= 0.0 && u <= (depth.width - 1) as f32 && v <= (depth.height - 1) as f32;
    if !inside {
        return None;
    }
    let (x, y) = (u as usize, v as usize);
    let (x1, y1) = ((x + 1).min(depth.width - 1), (y + 1).min(depth.height - 1));
    let at = |x: usize, y: usize| depth.data[y * depth.width + x];
    let taps = [at(x, y), at(x1, y), at(x, y1), at(x1, y1)];
    let (low, high) = taps.iter().fold((f32::MAX, 0.0f32), |(l, h), &t| (l.min(t), h.max(t)));
    let (a, b) = (u - x as f32, v - y as f32);
    if low > 0.0 && high - low < 0.01 * low {
        return Some((1.0 - b) * ((1.0 - a) * taps[0] + a * taps[1]) + b * ((1.0 - a) * taps[2] + a * taps[3]));
    }
    let nearest = at((u + 0.5) as usize, (v + 0.5) as usize);
    (nearest > 0.0).then_some(nearest)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two cameras one unit apart, focal length 50, looking along z.
    fn views(shift: f32) -> (Epipolar, Epipolar) {
        let matrix = [1., 0., 0., 0., 1., 0., 0., 0., 1.];
        (Epipolar { matrix, offset: [-50.0 * shift, 0., 0.] }, Epipolar { matrix, offset: [50.0 * shift, 0., 0.] })
    }

    const PARAMS: ConsistencyParams = ConsistencyParams { min_views: 2, pixel_unit: 0.25, depth_unit: 1.0 / 1300.0 };

    #[test]
    fn a_plane_seen_alike_is_kept_and_an_outlier_is_not() {
        let (w, h) = (40, 10);
        let mut mine = vec![10.0f32; w * h];
        mine[5 * w + 20] = 12.0;
        let theirs = vec![10.0f32; w * h];
        let raster = |d| Raster::new(d, w, h, "depth").unwrap();
        let other = |s| {
            let (there, back) = views(s);
            OtherView { depth: raster(&theirs), there, back }
        };
        let (kept, support) = consistency(raster(&mine), &[other(1.0), other(-1.0)], &PARAMS).unwrap();
        assert_eq!(kept[5 * w + 20], 0.0);
        assert_eq!((kept[5 * w + 15], support[5 * w + 15]), (10.0, 2));
    }

    #[test]
    fn a_majority_of_few_witnesses_is_enough_and_one_that_looks_through_is_against() {
        let (w, h) = (40, 10);
        let depth = |z: f32| vec![z; w * h];
        let raster = |d| Raster::new(d, w, h, "depth").unwrap();
        let (mine, near, far) = (depth(10.0), depth(10.05), depth(14.0));
        let other = |d, s| {
            let (there, back) = views(s);
            OtherView { depth: raster(d), there, back }
        };
        let params = ConsistencyParams { min_views: 1, pixel_unit: 0.25, depth_unit: 1.0 / 300.0 };
        let kept = |others: &[OtherView]| consistency(raster(&mine), others, &params).unwrap().0[5 * w + 20] > 0.0;
        assert!(kept(&[other(&near, 0.2)]));
        assert!(kept(&[other(&near, 0.2), other(&far, 0.2)]));
        assert!(!kept(&[other(&near, 0.2), other(&far, 0.2), other(&far, -0.2)]));
    }

    #[test]
    fn one_view_is_not_two() {
        let depth = vec![10.0f32; 400];
        let raster = Raster::new(&depth, 40, 10, "depth").unwrap();
        let (there, back) = views(1.0);
        let (kept, _) = consistency(raster, &[OtherView { depth: raster, there, back }], &PARAMS).unwrap();
        assert!(kept.iter().all(|&z| z == 0.0));
    }
}
