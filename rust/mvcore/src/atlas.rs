//! The texture atlas: charts cut from the images, packed side by side, levelled across their seams.
//!
//! ```text
//!   faces of one view that hang together ──► chart = the image's rectangle around them ──► skyline packing       plan
//!   one image at a time: its charts' rectangles are copied                                                       add_view
//!   colour jumps along seams ──► smooth corrections inside the charts (level) ──► corrected, put into the atlas  finish
//! ```
//!
//! A chart keeps the image's pixels, without resampling, so all that is held of the images is what the atlas shows. Faces that no view sees
//! take the colours of their neighbours from a [`palette`](crate::palette).

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::level::level;
use crate::mesh::{Mesh, NOTHING, components, neighbours, project};
use crate::pack::pack;
use crate::palette::{CELL, Palette};
use crate::raster::Raster;
use rayon::prelude::*;

/// Pixels around a chart's faces that are copied along, for filtering and mip-maps.
const PADDING: i64 = 3;
/// Pixels along a chart's side that no image reaches.
const LARGEST: f64 = 65_536.0;

/// The rectangle that a chart copies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Chart {
    view: usize,
    from: (i64, i64),
    size: (usize, usize),
    to: (usize, usize),
}

impl Chart {
    /// Around positions from `low` to `high` in an image.
    fn around(view: usize, low: [f64; 2], high: [f64; 2], in_front: bool) -> Result<Self> {
        let fits = in_front && (0..2).all(|k| low[k].abs() < LARGEST && high[k].abs() < LARGEST && low[k] <= high[k]);
        require(fits, "labels", "views in front of which their faces lie", format!("view {view}, which does not"))?;
        let from = low.map(|v| v.floor() as i64 - PADDING);
        let size: [usize; 2] = std::array::from_fn(|k| (high[k].ceil() as i64 + PADDING + 1 - from[k]) as usize);
        Ok(Self { view, from: (from[0], from[1]), size: (size[0], size[1]), to: (0, 0) })
    }

    /// A position in the image, seen from the chart's corner.
    fn inside(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [x - self.from.0 as f64, y - self.from.1 as f64]
    }

    /// The rectangle's pixels; beyond the image those at its border.
    fn crop(&self, rgb: &Raster<u8>) -> Vec<u8> {
        let (w, h) = ((rgb.width / 3) as i64, rgb.height as i64);
        let mut out = Vec::with_capacity(self.size.0 * self.size.1 * 3);
        for y in 0..self.size.1 as i64 {
            let row = rgb.row((self.from.1 + y).clamp(0, h - 1) as usize);
            for x in 0..self.size.0 as i64 {
                let at = 3 * (self.from.0 + x).clamp(0, w - 1) as usize;
                out.extend_from_slice(&row[at..at + 3]);
            }
        }
        out
    }
}

/// A textured mesh: vertices are split where charts meet.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Textured {
    /// For each new vertex the number of the one it was split from.
    pub origin: Vec<u32>,
    /// Texture position of each new vertex in texels, (0, 0) the centre of the top-left one.
    pub texel: Vec<[f32; 2]>,
    /// The faces, in their old order, over the new vertices.
    pub faces: Vec<[u32; 3]>,
    /// Interleaved RGB.
    pub atlas: Vec<u8>,
    /// Atlas width in texels.
    pub width: usize,
    /// Atlas height in texels.
    pub height: usize,
}

/// An atlas in the making: planned from the labels, filled view by view, finished with the colour gains.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Atlas {
    /// Atlas width in texels.
    pub width: usize,
    /// Most rows of texels that it can have.
    pub most_rows: usize,
    /// Rows below which the palette begins.
    rows: usize,
    views: usize,
    /// Vertices of the mesh.
    vertices: usize,
    charts: Vec<Chart>,
    /// RGB of each chart, empty until its view came.
    pixels: Vec<Vec<u8>>,
    /// The faces of each chart.
    members: Vec<Vec<u32>>,
    unseen: Vec<u32>,
    /// Over the new vertices; those of unseen faces over the mesh's, until there is a palette.
    faces: Vec<[u32; 3]>,
    /// Of each new vertex: the one it was split from, its chart, its position in the chart's image.
    origin: Vec<u32>,
    part: Vec<u32>,
    pixel: Vec<[f64; 2]>,
}

impl Atlas {
    /// The charts of `labels` (a view a face, [`NOTHING`] for unseen faces) and their places, for images with these P = K [R | t].
    pub fn plan(mesh: Mesh, labels: &[i32], projections: &[[f64; 12]]) -> Result<Self> {
        let n = mesh.faces.len();
        require(labels.len() == n, "labels", format!("{n} values"), labels.len())?;
        let known = |&l: &i32| l >= NOTHING && i64::from(l) < projections.len() as i64;
        require(labels.iter().all(known), "labels", format!("views below {}", projections.len()), "another")?;
        let mut out = Self {
            views: projections.len(),
            vertices: mesh.vertices.len(),
            unseen: (0..n as u32).filter(|&f| labels[f as usize] == NOTHING).collect(),
            faces: mesh.faces.to_vec(),
            ..Self::default()
        };
        out.split(mesh, labels, projections)?;
        out.pixels = vec![Vec::new(); out.charts.len()];
        let sizes: Vec<(usize, usize)> = out.charts.iter().map(|c| c.size).collect();
        let (places, width, rows) = pack(&sizes, CELL);
        out.charts.iter_mut().zip(places).for_each(|(chart, to)| chart.to = to);
        (out.width, out.rows) = (width, rows);
        out.most_rows = (rows + Palette::most_rows(out.unseen.len(), width)).max(1);
        Ok(out)
    }

    /// The views that have charts, ascending.
    pub fn views(&self) -> Vec<usize> {
        let mut used = vec![false; self.views];
        self.charts.iter().for_each(|c| used[c.view] = true);
        (0..self.views).filter(|&v| used[v]).collect()
    }

    /// Splits the vertices where charts meet.
    fn split(&mut self, mesh: Mesh, labels: &[i32], projections: &[[f64; 12]]) -> Result<()> {
        let (part, _) = components(&neighbours(mesh.faces), |f, g| labels[f] == labels[g]);
        let mut seen: Vec<u32> = (0..labels.len() as u32).filter(|&f| labels[f as usize] != NOTHING).collect();
        seen.par_sort_unstable_by_key(|&f| (part[f as usize], f));
        let mut last = vec![(u32::MAX, 0u32); mesh.vertices.len()];
        for members in seen.chunk_by(|&f, &g| part[f as usize] == part[g as usize]) {
            let (chart, view) = (self.charts.len() as u32, labels[members[0] as usize] as usize);
            let (mut low, mut high, mut in_front) = ([f64::MAX; 2], [f64::MIN; 2], true);
            for &f in members {
                for corner in &mut self.faces[f as usize] {
                    let v = *corner as usize;
                    if last[v].0 != chart {
                        last[v] = (chart, self.origin.len() as u32);
                        let [x, y, z] = project(&projections[view], mesh.vertices[v]);
                        in_front &= z > 0.0;
                        low = [low[0].min(x), low[1].min(y)];
                        high = [high[0].max(x), high[1].max(y)];
                        self.origin.push(*corner);
                        self.part.push(chart);
                        self.pixel.push([x, y]);
                    }
                    *corner = last[v].1;
                }
            }
            self.charts.push(Chart::around(view, low, high, in_front)?);
            self.members.push(members.to_vec());
        }
        Ok(())
    }

    /// Copies what the charts show of an image.
    pub fn add_view(&mut self, view: usize, rgb: &Raster<u8>) -> Result<()> {
        require(view < self.views, "view", format!("a number below {}", self.views), view)?;
        require(rgb.width.is_multiple_of(3), "rgb", "three values a pixel", rgb.width)?;
        self.pixels.par_iter_mut().zip(&self.charts).filter(|(_, chart)| chart.view == view).for_each(
            |(pixels, chart)| {
                *pixels = chart.crop(rgb);
            },
        );
        Ok(())
    }

    /// Levels the colours, `gains` (a factor a view and channel) applied, and puts the charts together.
    pub fn finish(mut self, gains: &[[f32; 3]]) -> Result<Textured> {
        require(gains.len() == self.views, "gains", format!("{} views", self.views), gains.len())?;
        let missing = self.charts.iter().zip(&self.pixels).find(|(_, p)| p.is_empty()).map(|(c, _)| c.view);
        require(missing.is_none(), "view", "all that have charts", format!("no view {}", missing.unwrap_or(0)))?;
        let colours = self.colours(gains);
        let corrections = level(&self.part, &self.pixel, &self.seams(&colours));
        let palette = self.palette(&colours, &corrections);
        self.correct(&corrections, gains);
        drop((colours, corrections));
        let height = (self.rows + palette.rows(self.width)).max(1);
        let mut atlas = vec![0; self.width * height * 3];
        for (chart, pixels) in self.charts.iter().zip(std::mem::take(&mut self.pixels)) {
            let n = chart.size.0 * 3;
            for (y, row) in pixels.chunks_exact(n).enumerate() {
                atlas[((chart.to.1 + y) * self.width + chart.to.0) * 3..][..n].copy_from_slice(row);
            }
        }
        palette.paint(self.rows, self.width, &mut atlas);
        let texel = self.texels(&palette);
        Ok(Textured { origin: self.origin, texel, faces: self.faces, atlas, width: self.width, height })
    }

    /// The images' colours at the vertices, gains applied.
    fn colours(&self, gains: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let colour = |(&pixel, &part): (&[f64; 2], &u32)| {
            let (chart, pixels) = (&self.charts[part as usize], &self.pixels[part as usize]);
            let [x, y] = chart.inside(pixel);
            let mut sum = [0.0; 3];
            for (dx, dy) in [(0., 0.), (1., 0.), (-1., 0.), (0., 1.), (0., -1.)] {
                let c = bilinear(pixels, chart.size, x + dx, y + dy);
                (0..3).for_each(|k| sum[k] += c[k] / 5.0);
            }
            std::array::from_fn(|k| sum[k] as f32 * gains[chart.view][k])
        };
        self.pixel.par_iter().zip(&self.part).map(colour).collect()
    }

    /// Colour jumps between the copies of split vertices.
    fn seams(&self, colours: &[[f32; 3]]) -> Vec<(u32, u32, [f32; 3])> {
        let mut copies: Vec<(u32, u32)> = self.origin.iter().copied().zip(0..).collect();
        copies.par_sort_unstable();
        let mut seams = Vec::new();
        for group in copies.chunk_by(|a, b| a.0 == b.0) {
            for (i, &(_, a)) in group.iter().enumerate() {
                for &(_, b) in &group[i + 1..] {
                    let (from, to) = (colours[a as usize], colours[b as usize]);
                    seams.push((a, b, std::array::from_fn(|c| to[c] - from[c])));
                }
            }
        }
        seams
    }

    fn palette(&self, colours: &[[f32; 3]], corrections: &[[f32; 3]]) -> Palette {
        let faces: Vec<[u32; 3]> = self.unseen.iter().map(|&f| self.faces[f as usize]).collect();
        let levelled = |v: usize| std::array::from_fn(|k| colours[v][k] + corrections[v][k]);
        Palette::new(self.vertices, &faces, &self.origin, levelled)
    }

    /// Applies gains and corrections to the charts' pixels.
    fn correct(&mut self, corrections: &[[f32; 3]], gains: &[[f32; 3]]) {
        let mut pixels = std::mem::take(&mut self.pixels);
        let interrupt = Interrupt::current();
        pixels.par_iter_mut().zip(&self.charts).zip(&self.members).for_each(|((pixels, chart), members)| {
            interrupt.poll();
            let shift = self.shifts(chart, members, corrections);
            for (rgb, shift) in pixels.as_chunks_mut::<3>().0.iter_mut().zip(shift) {
                for k in 0..3 {
                    let s = if shift[k].is_nan() { 0.0 } else { shift[k] };
                    rgb[k] = (f32::from(rgb[k]) * gains[chart.view][k] + s + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        });
        self.pixels = pixels;
    }

    /// A chart's corrections at its texels, NaN far from its faces.
    fn shifts(&self, chart: &Chart, members: &[u32], corrections: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let (w, h) = chart.size;
        let mut shift = vec![[f32::NAN; 3]; w * h];
        for &f in members {
            let corners = self.faces[f as usize];
            let p = corners.map(|v| chart.inside(self.pixel[v as usize]));
            let c = corners.map(|v| corrections[v as usize].map(f64::from));
            fill(p, w, h, |at, b| {
                shift[at] = std::array::from_fn(|k| (b[0] * c[0][k] + b[1] * c[1][k] + b[2] * c[2][k]) as f32);
            });
        }
        spread(&mut shift, w, h);
        shift
    }

    /// The vertices' texture positions; unseen faces get theirs, one for each vertex of the mesh and colour.
    fn texels(&mut self, palette: &Palette) -> Vec<[f32; 2]> {
        let texel = |(&pixel, &part): (&[f64; 2], &u32)| {
            let chart = &self.charts[part as usize];
            let [x, y] = chart.inside(pixel);
            [(x + chart.to.0 as f64) as f32, (y + chart.to.1 as f64) as f32]
        };
        let mut out: Vec<[f32; 2]> = self.pixel.iter().zip(&self.part).map(texel).collect();
        let mut order: Vec<usize> = (0..self.unseen.len()).collect();
        order.sort_by_key(|&i| palette.number[i]);
        let mut last = vec![(u32::MAX, 0u32); if order.is_empty() { 0 } else { self.vertices }];
        for i in order {
            let number = palette.number[i];
            for corner in &mut self.faces[self.unseen[i] as usize] {
                let v = *corner as usize;
                if last[v].0 != number {
                    last[v] = (number, out.len() as u32);
                    self.origin.push(*corner);
                    out.push(palette.middle(number, self.rows, self.width));
                }
                *corner = last[v].1;
            }
        }
        out
    }
}

/// Colour between the pixels of a chart of `size` (width, height).
fn bilinear(rgb: &[u8], (w, h): (usize, usize), x: f64, y: f64) -> [f64; 3] {
    let (x, y) = (x.clamp(0.0, (w - 1) as f64), y.clamp(0.0, (h - 1) as f64));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (a, b) = (x - x0 as f64, y - y0 as f64);
    std::array::from_fn(|k| {
        let at = |x: usize, y: usize| f64::from(rgb[(y * w + x) * 3 + k]);
        (1.0 - b) * ((1.0 - a) * at(x0, y0) + a * at(x1, y0)) + b * ((1.0 - a) * at(x0, y1) + a * at(x1, y1))
    })
}

/// Texels within half a texel of the triangle, with clamped barycentric coordinates.
fn fill(p: [[f64; 2]; 3], w: usize, h: usize, mut paint: impl FnMut(usize, [f64; 3])) {
    let [a, b, c] = p;
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let range = |k: usize, most: usize| {
        let low = a[k].min(b[k]).min(c[k]).floor().max(0.0) as usize;
        (low, (a[k].max(b[k]).max(c[k]).ceil().max(0.0) as usize).min(most - 1))
    };
    let ((x0, x1), (y0, y1)) = (range(0, w), range(1, h));
    let slack = if area.abs() > 1e-12 { 0.5 / area.abs().sqrt().max(0.5) } else { f64::MAX };
    for y in y0..=y1 {
        for x in x0..=x1 {
            let (px, py) = (x as f64, y as f64);
            let (mut v, mut u) = (1.0 / 3.0, 1.0 / 3.0);
            if area.abs() > 1e-12 {
                v = ((px - a[0]) * (c[1] - a[1]) - (py - a[1]) * (c[0] - a[0])) / area;
                u = ((b[0] - a[0]) * (py - a[1]) - (b[1] - a[1]) * (px - a[0])) / area;
            }
            let t = 1.0 - u - v;
            if t >= -slack && u >= -slack && v >= -slack {
                let clamped = [t.max(0.0), v.max(0.0), u.max(0.0)];
                let sum = clamped[0] + clamped[1] + clamped[2];
                paint(y * w + x, clamped.map(|b| b / sum));
            }
        }
    }
}

/// Carries the corrections over to the padding.
fn spread(shift: &mut [[f32; 3]], w: usize, h: usize) {
    for _ in 0..PADDING {
        let before = shift.to_vec();
        for y in 0..h {
            for x in 0..w {
                if !before[y * w + x][0].is_nan() {
                    continue;
                }
                let around = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
                if let Some(&(u, v)) = around.iter().find(|&&(u, v)| u < w && v < h && !before[v * w + u][0].is_nan()) {
                    shift[y * w + x] = before[v * w + u];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: [f64; 12] = [10., 0., 20., 0., 0., 10., 20., 0., 0., 0., 1., 0.];

    fn sheet() -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
        let n = 9u32;
        let vertices = (0..n * n).map(|i| [f64::from(i % n) - 4.0, f64::from(i / n) - 4.0, 4.0]).collect();
        let faces = (0..(n - 1) * (n - 1))
            .flat_map(|i| {
                let a = i / (n - 1) * n + i % (n - 1);
                [[a, a + n, a + 1], [a + 1, a + n, a + n + 1]]
            })
            .collect();
        (vertices, faces)
    }

    fn build(mesh: Mesh, labels: &[i32], images: &[Vec<u8>], order: impl Iterator<Item = usize>) -> Result<Textured> {
        let mut atlas = Atlas::plan(mesh, labels, &vec![CAMERA; images.len()])?;
        for v in order {
            atlas.add_view(v, &Raster::new(&images[v], 123, 41, "rgb")?)?;
        }
        atlas.finish(&vec![[1.0; 3]; images.len()])
    }

    fn image(value: impl Fn(usize, usize) -> u8) -> Vec<u8> {
        (0..41 * 41).flat_map(|i| [value(i % 41, i / 41); 3]).collect()
    }

    fn at(t: &Textured, v: usize) -> u8 {
        let [x, y] = t.texel[v].map(|c| (c + 0.5) as usize);
        t.atlas[(y * t.width + x) * 3]
    }

    #[test]
    fn one_view_is_copied_exactly() {
        let (vertices, faces) = sheet();
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let rgb = image(|x, y| (5 * x + y / 2) as u8);
        let t = build(mesh, &vec![0; faces.len()], &[rgb], 0..1).unwrap();
        assert_eq!(t.origin.len(), vertices.len());
        for (v, &o) in t.origin.iter().enumerate() {
            let q = project(&CAMERA, vertices[o as usize]);
            assert_eq!(at(&t, v), (5 * q[0].round() as usize + q[1].round() as usize / 2) as u8);
        }
    }

    #[test]
    fn a_seam_between_a_bright_and_a_dark_view_is_levelled() {
        let (vertices, faces) = sheet();
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let images = [image(|_, _| 100), image(|_, _| 130)];
        let labels: Vec<i32> = (0..faces.len() as i32).map(|f| i32::from(f >= 64)).collect();
        let t = build(mesh, &labels, &images, 0..2).unwrap();
        assert_eq!(t, build(mesh, &labels, &images, (0..2).rev()).unwrap());
        let mut copies = std::collections::HashMap::<u32, Vec<u8>>::new();
        for (v, &o) in t.origin.iter().enumerate() {
            copies.entry(o).or_default().push(at(&t, v));
        }
        let seam: Vec<_> = copies.values().filter(|c| c.len() == 2).collect();
        assert_eq!(seam.len(), 9);
        assert!(seam.iter().all(|c| c[0].abs_diff(c[1]) <= 4), "{seam:?}");
    }

    #[test]
    fn unseen_faces_continue_their_neighbours() {
        let (vertices, faces) = sheet();
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let rgb = image(|_, _| 77);
        let labels: Vec<i32> = (0..faces.len()).map(|f| if f % 5 == 0 || f > 90 { NOTHING } else { 0 }).collect();
        let t = build(mesh, &labels, &[rgb], 0..1).unwrap();
        assert!((0..t.origin.len()).all(|v| at(&t, v).abs_diff(77) <= 4));
        // Faces of one colour share their vertices.
        assert!(t.origin.len() < vertices.len() * 2, "{}", t.origin.len());
    }

    #[test]
    fn a_view_that_is_missing_or_does_not_see_its_faces_is_an_error() {
        let (vertices, faces) = sheet();
        let mesh = Mesh::new(&vertices, &faces).unwrap();
        let labels: Vec<i32> = (0..faces.len() as i32).map(|f| f % 2).collect();
        let images = [image(|_, _| 1), image(|_, _| 2)];
        let message = |r: Result<Textured>| r.unwrap_err().to_string();
        assert!(message(build(mesh, &labels, &images, 0..1)).contains("no view 1"));
        assert!(message(build(mesh, &labels, &images[..1], 0..1)).starts_with("labels:"));
        let through: Vec<_> = vertices.iter().map(|v| [v[0], v[1], v[1]]).collect();
        assert!(message(build(Mesh::new(&through, &faces).unwrap(), &labels, &images, 0..2)).starts_with("labels:"));
    }

    #[test]
    fn no_faces_make_an_empty_atlas() {
        let t = build(Mesh::new(&[], &[]).unwrap(), &[], &[image(|_, _| 1)], 0..0).unwrap();
        assert_eq!((t.origin.len(), t.width, t.height), (0, 64, 1));
    }
}
