//! Photo-consistency carving: a voxel that its unhidden views see in different colours is not part of the surface.
//!
//! ```text
//!    cameras in front ──►│▒▒▒│plane k          six sweeps, along and against each axis; a plane is judged by the cameras before it,
//!         ◄── claimed ──┤ ░ │                  on pixels that no kept voxel of an earlier plane has claimed
//! ```
//!
//! Kutulakos and Seitz, A theory of shape by space carving, IJCV 2000: the sweeps are repeated until none removes a voxel. A view's colours
//! of a voxel are an interval, the least and the greatest value a channel within the voxel's footprint, so that texture finer than a voxel
//! and colour edges do not carve: colours differ where two intervals lie further apart than the threshold. Voxels of one plane are
//! judged side by side and claim their pixels afterwards: the same bytes for any number of threads.

use crate::error::{Result, require};
use crate::grid::Grid;
use crate::interrupt::Interrupt;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// One photograph.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    /// Least value of each channel around each pixel, row-major (h, w, 3).
    pub low: &'a [u8],
    /// Greatest value.
    pub high: &'a [u8],
    /// Pixels a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// P = K [R | t], row-major 3x4.
    pub projection: [f64; 12],
    /// The camera's centre in the world.
    pub center: [f64; 3],
}

/// When colours agree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotoParams {
    /// Grey levels between two views' intervals beyond which they contradict each other.
    pub threshold: u8,
    /// Fewest views that must judge a voxel.
    pub least_views: usize,
    /// Most rounds of six sweeps.
    pub rounds: usize,
}

/// Clears the voxels (C order) that the photographs contradict; the number of those cleared.
pub fn photo_carve(grid: Grid, occupied: &mut [bool], photos: &[Photo], params: &PhotoParams) -> Result<usize> {
    let count: usize = grid.shape.iter().product();
    require(occupied.len() == count, "occupied", format!("{count} voxels"), occupied.len())?;
    require(params.least_views >= 2, "least_views", "at least 2", params.least_views)?;
    for photo in photos {
        let values = photo.width * photo.height * 3;
        let fits = photo.low.len() == values && photo.high.len() == values && values > 0;
        require(fits, "low, high", format!("{values} values, three a pixel"), photo.low.len())?;
    }
    let mut cleared = 0;
    for _ in 0..params.rounds {
        let before = cleared;
        for axis in 0..3 {
            for ascending in [true, false] {
                cleared += sweep(&grid, occupied, photos, params, axis, ascending);
            }
        }
        if cleared == before {
            break;
        }
    }
    Ok(cleared)
}

/// Pixels that the planes behind may not use, a bit each.
struct Claims {
    bits: Vec<AtomicU64>,
    width: usize,
}

impl Claims {
    fn of(photo: &Photo) -> Self {
        let words = (photo.width * photo.height).div_ceil(64);
        Self { bits: (0..words).map(|_| AtomicU64::new(0)).collect(), width: photo.width }
    }

    fn has(&self, x: usize, y: usize) -> bool {
        let n = y * self.width + x;
        self.bits[n / 64].load(Ordering::Relaxed) >> (n % 64) & 1 != 0
    }

    fn set(&self, x: usize, y: usize) {
        let n = y * self.width + x;
        self.bits[n / 64].fetch_or(1 << (n % 64), Ordering::Relaxed);
    }
}

/// Where a voxel lies in a photograph: its pixel and half the side of its footprint.
fn seen(photo: &Photo, x: [f64; 3], voxel: f64) -> Option<([usize; 2], f64)> {
    let p = &photo.projection;
    let q: [f64; 3] =
        std::array::from_fn(|r| p[4 * r] * x[0] + p[4 * r + 1] * x[1] + p[4 * r + 2] * x[2] + p[4 * r + 3]);
    if q[2] <= 0.0 {
        return None;
    }
    let (u, v) = ((q[0] / q[2]).round(), (q[1] / q[2]).round());
    let inside = u >= 0.0 && v >= 0.0 && u < photo.width as f64 && v < photo.height as f64;
    let focal = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
    inside.then(|| ([u as usize, v as usize], 0.5 * focal * voxel / q[2]))
}

fn sweep(
    grid: &Grid,
    occupied: &mut [bool],
    photos: &[Photo],
    params: &PhotoParams,
    axis: usize,
    ascending: bool,
) -> usize {
    let claims: Vec<Claims> = photos.iter().map(Claims::of).collect();
    let [nx, ny, nz] = grid.shape;
    let strides = [ny * nz, nz, 1];
    let others = [[1, 2], [0, 2], [0, 1]][axis];
    let across = [grid.shape[others[0]], grid.shape[others[1]]];
    let depth = [nx, ny, nz][axis];
    let mut cleared = 0;
    let interrupt = Interrupt::current();
    for step in 0..depth {
        interrupt.poll();
        let plane = if ascending { step } else { depth - 1 - step };
        let at = grid.origin[axis] + grid.voxel * plane as f64;
        let before: Vec<usize> = (0..photos.len())
            .filter(|&n| if ascending { photos[n].center[axis] < at } else { photos[n].center[axis] > at })
            .collect();
        if before.is_empty() {
            continue;
        }
        let cells: &[bool] = occupied;
        let shown: Vec<[usize; 2]> = (0..across[0])
            .into_par_iter()
            .flat_map_iter(|a| (0..across[1]).map(move |b| [a, b]))
            .filter(|&[a, b]| {
                let n = plane * strides[axis] + a * strides[others[0]] + b * strides[others[1]];
                cells[n] && on_surface(cells, grid.shape, n)
            })
            .collect();
        let position = |[a, b]: [usize; 2]| {
            let mut index = [0; 3];
            (index[axis], index[others[0]], index[others[1]]) = (plane, a, b);
            std::array::from_fn(|k| grid.origin[k] + grid.voxel * index[k] as f64)
        };
        let kept: Vec<bool> = shown
            .par_iter()
            .map(|&cell| agrees(position(cell), grid.voxel, photos, &before, &claims, params))
            .collect();
        shown.par_iter().zip(&kept).filter(|(_, kept)| **kept).for_each(|(&cell, _)| {
            for &n in &before {
                claim(position(cell), grid.voxel, &photos[n], &claims[n]);
            }
        });
        for (&[a, b], _) in shown.iter().zip(&kept).filter(|(_, kept)| !**kept) {
            occupied[plane * strides[axis] + a * strides[others[0]] + b * strides[others[1]]] = false;
            cleared += 1;
        }
    }
    cleared
}

/// Whether one of the six neighbours is empty or outside the volume.
fn on_surface(occupied: &[bool], shape: [usize; 3], n: usize) -> bool {
    let at = [n / (shape[1] * shape[2]), n / shape[2] % shape[1], n % shape[2]];
    let strides = [shape[1] * shape[2], shape[2], 1];
    (0..3).any(|a| at[a] == 0 || at[a] + 1 == shape[a] || !occupied[n - strides[a]] || !occupied[n + strides[a]])
}

/// Whether the views that see a voxel unhidden show it in colours that some one colour could explain.
fn agrees(
    x: [f64; 3],
    voxel: f64,
    photos: &[Photo],
    before: &[usize],
    claims: &[Claims],
    params: &PhotoParams,
) -> bool {
    let (mut least, mut greatest, mut judges) = ([u8::MAX; 3], [0u8; 3], 0);
    for &n in before {
        let photo = &photos[n];
        let Some(([u, v], _)) = seen(photo, x, voxel) else { continue };
        if claims[n].has(u, v) {
            continue;
        }
        judges += 1;
        let at = 3 * (v * photo.width + u);
        for c in 0..3 {
            least[c] = least[c].min(photo.high[at + c]);
            greatest[c] = greatest[c].max(photo.low[at + c]);
        }
    }
    judges < params.least_views || (0..3).all(|c| greatest[c] <= least[c].saturating_add(params.threshold))
}

/// Claims the pixels of a voxel's footprint.
fn claim(x: [f64; 3], voxel: f64, photo: &Photo, claims: &Claims) {
    let Some(([u, v], half)) = seen(photo, x, voxel) else { return };
    // A cube seen from a corner is wider than from a side; neighbours overlap, so that nothing shines through.
    let half = (half * 1.2).ceil() as usize;
    for y in v.saturating_sub(half)..=(v + half).min(photo.height - 1) {
        for x in u.saturating_sub(half)..=(u + half).min(photo.width - 1) {
            claims.set(x, y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Looks along -z from (x, 0, 6), 64 x 64, focal length 100.
    fn camera(x: f64) -> ([f64; 12], [f64; 3]) {
        let forward = [0.0, 0.0, -1.0, 6.0];
        let (right, down) = ([1.0, 0.0, 0.0, -x], [0.0, -1.0, 0.0, 0.0]);
        let p = std::array::from_fn(|n| match n / 4 {
            0 => 100.0 * right[n % 4] + 31.5 * forward[n % 4],
            1 => 100.0 * down[n % 4] + 31.5 * forward[n % 4],
            _ => forward[n % 4],
        });
        (p, [x, 0.0, 6.0])
    }

    /// Colours of a surface at height z, a smooth pattern of one period a unit.
    fn picture(center: f64, height: f64) -> Vec<u8> {
        let shade = |n: usize| {
            let (u, v) = ((n % 64) as f64, (n / 64) as f64);
            let depth = 6.0 - height;
            let (x, y) = ((u - 31.5) / 100.0 * depth + center, -(v - 31.5) / 100.0 * depth);
            (127.0 + 60.0 * (5.0 * x).sin() + 50.0 * (4.0 * y).sin()) as u8
        };
        (0..64 * 64).flat_map(|n| [shade(n); 3]).collect()
    }

    #[test]
    fn a_block_is_carved_down_to_the_surface_it_shows() {
        let centers = [-1.2, -0.6, 0.0, 0.6, 1.2];
        let pictures: Vec<Vec<u8>> = centers.iter().map(|&c| picture(c, 0.0)).collect();
        let photos: Vec<Photo> = centers
            .iter()
            .zip(&pictures)
            .map(|(&c, p)| {
                let (projection, center) = camera(c);
                Photo { low: p, high: p, width: 64, height: 64, projection, center }
            })
            .collect();
        // z from -0.5 to 1: the surface lies at 0, the block reaches up to 1.
        let grid = Grid::new([-0.5, -0.5, -0.5], 0.05, [21, 21, 31]).unwrap();
        let mut occupied = vec![true; 21 * 21 * 31];
        let params = PhotoParams { threshold: 10, least_views: 2, rounds: 10 };
        let cleared = photo_carve(grid, &mut occupied, &photos, &params).unwrap();
        assert_eq!(cleared, occupied.iter().filter(|o| !**o).count());
        let column = |i: usize, j: usize| (0..31).rev().find(|k| occupied[(i * 21 + j) * 31 + k]);
        let tops: Vec<f64> = (4..17)
            .flat_map(|i| (4..17).map(move |j| (i, j)))
            .map(|(i, j)| column(i, j).map_or(-9.0, |k| -0.5 + 0.05 * k as f64))
            .collect();
        let mean = tops.iter().sum::<f64>() / tops.len() as f64;
        assert!(mean > -0.06 && mean < 0.3, "mean height {mean}");
        assert!(tops.iter().all(|&t| t > -0.11), "carved through the surface");
    }

    #[test]
    fn one_view_alone_carves_nothing() {
        let p = picture(0.0, 0.0);
        let (projection, center) = camera(0.0);
        let photo = Photo { low: &p, high: &p, width: 64, height: 64, projection, center };
        let grid = Grid::new([-0.5; 3], 0.1, [11; 3]).unwrap();
        let mut occupied = vec![true; 1331];
        let params = PhotoParams { threshold: 10, least_views: 2, rounds: 3 };
        assert_eq!(photo_carve(grid, &mut occupied, &[photo], &params).unwrap(), 0);
        assert!(photo_carve(grid, &mut occupied[1..], &[photo], &params).is_err());
    }
}
