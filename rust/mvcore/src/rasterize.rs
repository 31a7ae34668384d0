//! The z-buffer of a mesh in a view: which face each pixel sees, and how far away.
//!
//! Triangles are sorted into bands of rows, bands are drawn side by side; within a band the order of faces is kept, so the
//! same bytes come out for any thread count. 1/z is linear on the image, depth is z along the optical axis.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::mesh::{Mesh, NOTHING, project};
use rayon::prelude::*;

const BAND: usize = 32;
/// Rounding of barycentric coordinates: pixels on a shared edge belong to a triangle.
const EDGE: f64 = 1e-9;

/// z-depth (0 where nothing is hit) and face number ([`NOTHING`] where nothing is hit), each (height, width).
pub fn rasterize(mesh: Mesh, projection: &[f64; 12], width: usize, height: usize) -> Result<(Vec<f32>, Vec<i32>)> {
    require(width > 0 && height > 0, "size", "a non-empty image", format!("{height} x {width}"))?;
    let points: Vec<[f64; 3]> = mesh.vertices.par_iter().map(|&p| project(projection, p)).collect();
    let bands = height.div_ceil(BAND);
    let mut lists: Vec<Vec<u32>> = vec![Vec::new(); bands];
    for (n, face) in mesh.faces.iter().enumerate() {
        let p = face.map(|v| points[v as usize]);
        if p.iter().any(|q| q[2] <= 0.0) {
            continue;
        }
        let low = p.iter().map(|q| q[1]).fold(f64::MAX, f64::min).ceil().max(0.0);
        let high = p.iter().map(|q| q[1]).fold(f64::MIN, f64::max).floor().min(height as f64 - 1.0);
        if low <= high {
            for list in &mut lists[low as usize / BAND..=high as usize / BAND] {
                list.push(n as u32);
            }
        }
    }
    let (mut depth, mut hit) = (vec![0.0f32; width * height], vec![NOTHING; width * height]);
    let interrupt = Interrupt::current();
    depth.par_chunks_mut(BAND * width).zip(hit.par_chunks_mut(BAND * width)).zip(&lists).enumerate().for_each(
        |(band, ((depth, hit), list))| {
            interrupt.poll();
            for &n in list {
                let p = mesh.faces[n as usize].map(|v| points[v as usize]);
                draw(p, width, band * BAND, depth.len() / width, |at, z| {
                    if depth[at] == 0.0 || z < depth[at] {
                        depth[at] = z;
                        hit[at] = n as i32;
                    }
                });
            }
        },
    );
    Ok((depth, hit))
}

/// Calls `paint(index, z)` for each pixel centre of a band of rows inside the triangle.
fn draw(p: [[f64; 3]; 3], width: usize, y0: usize, rows: usize, mut paint: impl FnMut(usize, f32)) {
    let [a, b, c] = p;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let inverse = 1.0 / area;
    let bound = |k: usize, most: f64| {
        let low = a[k].min(b[k]).min(c[k]).ceil().max(0.0);
        (low as usize, a[k].max(b[k]).max(c[k]).floor().min(most))
    };
    let ((x_low, x_high), (y_low, y_high)) = (bound(0, width as f64 - 1.0), bound(1, (y0 + rows) as f64 - 1.0));
    if x_high < 0.0 || y_high < 0.0 {
        return;
    }
    for y in y_low.max(y0)..=y_high as usize {
        for x in x_low..=x_high as usize {
            let (px, py) = (x as f64, y as f64);
            let v = ((px - a[0]) * (c[1] - a[1]) - (py - a[1]) * (c[0] - a[0])) * inverse;
            let w = ((b[0] - a[0]) * (py - a[1]) - (b[1] - a[1]) * (px - a[0])) * inverse;
            let u = 1.0 - v - w;
            if u >= -EDGE && v >= -EDGE && w >= -EDGE {
                let z = 1.0 / (u / a[2] + v / b[2] + w / c[2]);
                paint((y - y0) * width + x, z as f32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: [f64; 12] = [10., 0., 10., 0., 0., 10., 10., 0., 0., 0., 1., 0.];

    #[test]
    fn the_nearer_of_two_squares_is_seen() {
        let square = |z: f64, r: f64| [[-r, -r, z], [r, -r, z], [r, r, z], [-r, r, z]];
        let vertices = [square(4.0, 8.0), square(2.0, 1.0)].concat();
        let faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let (depth, face) = rasterize(mesh, &CAMERA, 21, 41).unwrap();
        for (i, (&z, &f)) in depth.iter().zip(&face).enumerate() {
            let (x, y) = ((i % 21) as f64 - 10.0, (i / 21) as f64 - 10.0);
            let near = x.abs() <= 5.0 && y.abs() <= 5.0;
            let far = y <= 20.0;
            assert_eq!(
                z,
                if near {
                    2.0
                } else if far {
                    4.0
                } else {
                    0.0
                }
            );
            assert_eq!(f >= 2, near);
        }
    }

    #[test]
    fn a_slanted_plane_has_its_exact_depth() {
        let vertices = [[-9., -9., 1.], [9., -9., 5.5], [0., 30., 3.25]].map(|p: [f64; 3]| p);
        let mesh = Mesh::new(&vertices, &[[0, 1, 2]]).unwrap();
        let (depth, _) = rasterize(mesh, &CAMERA, 21, 21).unwrap();
        for (i, &z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0) {
            let x = ((i % 21) as f64 - 10.0) / 10.0;
            // z = 3.25 + x_world / 4, x_world = x z
            assert!((f64::from(z) - 3.25 / (1.0 - x / 4.0)).abs() < 1e-5);
        }
    }
}
