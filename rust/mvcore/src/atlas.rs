//! The texture atlas: charts cut from the photographs, packed side by side, levelled across their seams and painted.
//!
//! ```text
//!   faces of one view that hang together ──► chart = the photograph's rectangle around them ──► skyline packing
//!   colour jumps along seams ──► smooth corrections inside the charts (level) ──► paint
//! ```
//!
//! A chart keeps the photograph's own pixels, so painting copies without resampling. Faces that no view sees take the colours of their neighbours from a palette, a few cells that many of them share.

use crate::error::{Result, require};
use crate::level::level;
use crate::mesh::{Mesh, NOTHING, components, neighbours, project};
use crate::pack::pack;
use crate::raster::Raster;
use rayon::prelude::*;

/// Pixels around a chart's faces that are copied along, for filtering and mip-maps.
const PADDING: i64 = 3;
/// Texels along the side of a cell of the palette.
const CELL: usize = 4;
/// Grey levels from one colour of the palette to the next.
const SHADE: f32 = 8.0;

/// The rectangle that a chart copies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Chart {
    view: usize,
    from: (i64, i64),
    size: (usize, usize),
    to: (usize, usize),
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

/// A photograph to paint from: interleaved RGB (height, width · 3), P = K [R | t], and its colour gains.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// Interleaved RGB, (height, width · 3).
    pub rgb: Raster<'a, u8>,
    /// P, row-major 3x4.
    pub projection: [f64; 12],
    /// Factor a channel.
    pub gain: [f32; 3],
}

/// Builds and paints the atlas for `labels` (a view a face, [`NOTHING`] for unseen faces); at most `max_size` texels wide and high.
pub fn build_atlas(mesh: Mesh, labels: &[i32], sources: &[Source], max_size: usize) -> Result<Textured> {
    let n = mesh.faces.len();
    require(labels.len() == n, "labels", format!("{n} values"), labels.len())?;
    let known = |&l: &i32| l >= NOTHING && l < sources.len() as i32;
    require(labels.iter().all(known), "labels", format!("views below {}", sources.len()), "another")?;
    let around = neighbours(mesh.faces);
    let (part, count) = components(&around, |f, g| labels[f] == labels[g]);
    let split = Split::new(mesh, labels, &part, count, sources);
    let mut charts = split.charts(count);
    let colours = split.colours(sources);
    let corrections = level(&split.part, &split.pixel, &split.seams(&colours));
    let palette = Palette::new(mesh, labels, &split, &colours, &corrections);
    let sizes: Vec<(usize, usize)> = charts.iter().map(|c| c.map_or((0, 0), |c| c.size)).collect();
    let (places, width, used) = pack(&sizes, palette.colours.len() * CELL * CELL, CELL);
    for (chart, to) in charts.iter_mut().zip(places) {
        if let Some(chart) = chart {
            chart.to = to;
        }
    }
    let height = (used + palette.colours.len().div_ceil(width / CELL) * CELL).max(1);
    require(
        width <= max_size && height <= max_size,
        "max_size",
        format!("an atlas of at most {max_size} texels a side"),
        format!("{height} x {width}"),
    )?;
    let mut out = Textured {
        texel: vec![[0.0; 2]; split.origin.len()],
        faces: split.faces.clone(),
        atlas: vec![0; width * height * 3],
        width,
        height,
        origin: split.origin.clone(),
    };
    split.place(&charts, &mut out);
    paint(&charts, &split, &corrections, sources, labels, &part, &mut out);
    palette.paint(mesh, used, &mut out);
    Ok(out)
}

/// Vertices split by chart.
struct Split {
    origin: Vec<u32>,
    faces: Vec<[u32; 3]>,
    /// View of each new vertex.
    view: Vec<i32>,
    /// Chart of each new vertex.
    part: Vec<u32>,
    /// Position in the photograph.
    pixel: Vec<[f64; 2]>,
}

impl Split {
    fn new(mesh: Mesh, labels: &[i32], part: &[u32], count: usize, sources: &[Source]) -> Self {
        let mut by_part: Vec<u32> = (0..mesh.faces.len() as u32).collect();
        by_part.sort_by_key(|&f| part[f as usize]);
        let mut last = vec![(u32::MAX, 0u32); mesh.vertices.len()];
        let mut out = Self {
            origin: Vec::with_capacity(mesh.vertices.len() + count),
            faces: vec![[0; 3]; mesh.faces.len()],
            view: Vec::new(),
            part: Vec::new(),
            pixel: Vec::new(),
        };
        for f in by_part {
            let (p, label) = (part[f as usize], labels[f as usize]);
            // What no view sees is split by colour, later.
            let Some(source) = sources.get(label as usize) else { continue };
            for (k, &v) in mesh.faces[f as usize].iter().enumerate() {
                if last[v as usize].0 != p {
                    last[v as usize] = (p, out.origin.len() as u32);
                    out.origin.push(v);
                    out.view.push(label);
                    out.part.push(p);
                    let q = project(&source.projection, mesh.vertices[v as usize]);
                    out.pixel.push([q[0], q[1]]);
                }
                out.faces[f as usize][k] = last[v as usize].1;
            }
        }
        out
    }

    fn charts(&self, count: usize) -> Vec<Option<Chart>> {
        let mut bounds = vec![([f64::MAX; 2], [f64::MIN; 2], NOTHING); count];
        for (v, q) in self.pixel.iter().enumerate() {
            let (low, high, view) = &mut bounds[self.part[v] as usize];
            *view = self.view[v];
            for k in 0..2 {
                low[k] = low[k].min(q[k]);
                high[k] = high[k].max(q[k]);
            }
        }
        let chart = |&(low, high, view): &([f64; 2], [f64; 2], i32)| {
            (view != NOTHING).then(|| {
                let from = low.map(|v| v.floor() as i64 - PADDING);
                let size: [usize; 2] =
                    std::array::from_fn(|k| (high[k].ceil() as i64 + PADDING + 1 - from[k]) as usize);
                Chart { view: view as usize, from: (from[0], from[1]), size: (size[0], size[1]), to: (0, 0) }
            })
        };
        bounds.iter().map(chart).collect()
    }

    fn place(&self, charts: &[Option<Chart>], out: &mut Textured) {
        for (v, texel) in out.texel.iter_mut().enumerate() {
            if let Some(c) = charts[self.part[v] as usize] {
                let [x, y] = self.pixel[v];
                *texel = [(x - c.from.0 as f64 + c.to.0 as f64) as f32, (y - c.from.1 as f64 + c.to.1 as f64) as f32];
            }
        }
    }

    /// The photographs' colours at the vertices, gains applied.
    fn colours(&self, sources: &[Source]) -> Vec<[f64; 3]> {
        self.pixel
            .par_iter()
            .zip(&self.view)
            .map(|(&[x, y], &view)| {
                sources.get(view as usize).map_or([0.0; 3], |s| {
                    let around = [(0., 0.), (1., 0.), (-1., 0.), (0., 1.), (0., -1.)];
                    let mut sum = [0.0; 3];
                    for (dx, dy) in around {
                        let c = bilinear(&s.rgb, x + dx, y + dy);
                        (0..3).for_each(|k| sum[k] += c[k] / 5.0);
                    }
                    std::array::from_fn(|k| sum[k] * f64::from(s.gain[k]))
                })
            })
            .collect()
    }

    /// Colour jumps between the copies of split vertices.
    fn seams(&self, colours: &[[f64; 3]]) -> Vec<(u32, u32, [f64; 3])> {
        let mut copies: Vec<(u32, u32)> = self.origin.iter().zip(0..).map(|(&o, v)| (o, v)).collect();
        copies.sort_unstable();
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
}

fn bilinear(rgb: &Raster<u8>, x: f64, y: f64) -> [f64; 3] {
    let (w, h) = (rgb.width / 3, rgb.height);
    let (x, y) = (x.clamp(0.0, (w - 1) as f64), y.clamp(0.0, (h - 1) as f64));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (a, b) = (x - x0 as f64, y - y0 as f64);
    std::array::from_fn(|k| {
        let at = |x: usize, y: usize| f64::from(rgb.data[(y * w + x) * 3 + k]);
        (1.0 - b) * ((1.0 - a) * at(x0, y0) + a * at(x1, y0)) + b * ((1.0 - a) * at(x0, y1) + a * at(x1, y1))
    })
}

fn paint(
    charts: &[Option<Chart>],
    split: &Split,
    corrections: &[[f64; 3]],
    sources: &[Source],
    labels: &[i32],
    part: &[u32],
    out: &mut Textured,
) {
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); charts.len()];
    for (f, &p) in part.iter().enumerate().filter(|(f, _)| labels[*f] != NOTHING) {
        members[p as usize].push(f as u32);
    }
    let texel = &out.texel;
    let painted: Vec<Vec<u8>> = charts
        .par_iter()
        .zip(&members)
        .map(|(chart, faces)| {
            chart.map_or_else(Vec::new, |c| paint_chart(&c, faces, split, texel, corrections, sources))
        })
        .collect();
    for (chart, pixels) in charts.iter().zip(&painted).filter_map(|(c, p)| c.as_ref().map(|c| (c, p))) {
        for y in 0..chart.size.1 {
            let to = ((chart.to.1 + y) * out.width + chart.to.0) * 3;
            let n = chart.size.0 * 3;
            out.atlas[to..to + n].copy_from_slice(&pixels[y * n..][..n]);
        }
    }
}

fn paint_chart(
    chart: &Chart,
    faces: &[u32],
    split: &Split,
    texel: &[[f32; 2]],
    corrections: &[[f64; 3]],
    sources: &[Source],
) -> Vec<u8> {
    let (w, h) = chart.size;
    let source = &sources[chart.view];
    let (sw, sh) = ((source.rgb.width / 3) as i64, source.rgb.height as i64);
    let mut shift = vec![[f32::NAN; 3]; w * h];
    for &f in faces {
        let corners = split.faces[f as usize];
        let p = corners.map(|v| {
            let [x, y] = texel[v as usize];
            [f64::from(x) - chart.to.0 as f64, f64::from(y) - chart.to.1 as f64]
        });
        let c = corners.map(|v| corrections[v as usize]);
        fill(p, w, h, |at, b| {
            shift[at] = std::array::from_fn(|k| (b[0] * c[0][k] + b[1] * c[1][k] + b[2] * c[2][k]) as f32);
        });
    }
    spread(&mut shift, w, h);
    let mut out = Vec::with_capacity(w * h * 3);
    for y in 0..h {
        for x in 0..w {
            let (sx, sy) = ((chart.from.0 + x as i64).clamp(0, sw - 1), (chart.from.1 + y as i64).clamp(0, sh - 1));
            let at = (sy * sw + sx) as usize * 3;
            for k in 0..3 {
                let s = shift[y * w + x][k];
                let v = f32::from(source.rgb.data[at + k]) * source.gain[k] + if s.is_nan() { 0.0 } else { s };
                out.push((v + 0.5).clamp(0.0, 255.0) as u8);
            }
        }
    }
    out
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

/// Colours for the faces that no view sees, each shared by all faces of about that colour.
struct Palette {
    unseen: Vec<u32>,
    /// Number of the colour of each unseen face.
    number: Vec<u32>,
    /// In steps of [`SHADE`].
    colours: Vec<[u8; 3]>,
}

impl Palette {
    fn new(mesh: Mesh, labels: &[i32], split: &Split, colours: &[[f64; 3]], corrections: &[[f64; 3]]) -> Self {
        let unseen: Vec<u32> = (0..labels.len() as u32).filter(|&f| labels[f as usize] == NOTHING).collect();
        if unseen.is_empty() {
            return Self { unseen, number: Vec::new(), colours: Vec::new() };
        }
        let filled = fill_colours(mesh, split, colours, corrections, &unseen);
        let shade = |&f: &u32| -> [u8; 3] {
            let c = mesh.faces[f as usize].map(|v| filled[v as usize]);
            std::array::from_fn(|k| (((c[0][k] + c[1][k] + c[2][k]) / (3.0 * SHADE)).clamp(0.0, 255.0 / SHADE)) as u8)
        };
        let shades: Vec<[u8; 3]> = unseen.iter().map(shade).collect();
        let mut distinct = shades.clone();
        distinct.sort_unstable();
        distinct.dedup();
        let number = shades.iter().map(|s| distinct.partition_point(|d| d < s) as u32).collect();
        Self { unseen, number, colours: distinct }
    }

    /// Paints the cells from row `first` on and gives the unseen faces their vertices: one for each place and colour.
    fn paint(&self, mesh: Mesh, first: usize, out: &mut Textured) {
        let columns = out.width / CELL;
        let corner = |n: usize| (n % columns * CELL, first + n / columns * CELL);
        for (n, shade) in self.colours.iter().enumerate() {
            let (x0, y0) = corner(n);
            let value = shade.map(|s| ((f32::from(s) + 0.5) * SHADE).min(255.0) as u8);
            for y in y0..y0 + CELL {
                for x in x0..x0 + CELL {
                    out.atlas[(y * out.width + x) * 3..][..3].copy_from_slice(&value);
                }
            }
        }
        let mut order: Vec<usize> = (0..self.unseen.len()).collect();
        order.sort_by_key(|&i| self.number[i]);
        let mut last = vec![(u32::MAX, 0u32); mesh.vertices.len()];
        let middle = (CELL - 1) as f32 / 2.0;
        for i in order {
            let (f, n) = (self.unseen[i] as usize, self.number[i]);
            for (k, &v) in mesh.faces[f].iter().enumerate() {
                if last[v as usize].0 != n {
                    last[v as usize] = (n, out.origin.len() as u32);
                    let (x, y) = corner(n as usize);
                    out.origin.push(v);
                    out.texel.push([x as f32 + middle, y as f32 + middle]);
                }
                out.faces[f][k] = last[v as usize].1;
            }
        }
    }
}

const GREY: f32 = 127.0;
const SMOOTHING: usize = 50;

/// A colour a vertex: the levelled photographs where seen, a smooth continuation elsewhere.
fn fill_colours(
    mesh: Mesh,
    split: &Split,
    colours: &[[f64; 3]],
    corrections: &[[f64; 3]],
    unseen: &[u32],
) -> Vec<[f32; 3]> {
    let n = mesh.vertices.len();
    let (mut colour, mut known) = (vec![[0.0f32; 3]; n], vec![0u32; n]);
    for (v, &o) in split.origin.iter().enumerate() {
        for k in 0..3 {
            colour[o as usize][k] += (colours[v][k] + corrections[v][k]) as f32;
        }
        known[o as usize] += 1;
    }
    for (c, &n) in colour.iter_mut().zip(&known) {
        *c = if n > 0 { c.map(|v| v / n as f32) } else { [f32::NAN; 3] };
    }
    // Breadth first from the known vertices, then smoothing of what was filled.
    let mut round = true;
    while round {
        round = false;
        let before = colour.clone();
        for &f in unseen {
            let face = mesh.faces[f as usize];
            let from: Vec<[f32; 3]> = face.iter().map(|&v| before[v as usize]).filter(|c| !c[0].is_nan()).collect();
            for &v in face.iter().filter(|_| !from.is_empty()) {
                if colour[v as usize][0].is_nan() {
                    colour[v as usize] =
                        std::array::from_fn(|k| from.iter().map(|c| c[k]).sum::<f32>() / from.len() as f32);
                    round = true;
                }
            }
        }
    }
    for _ in 0..SMOOTHING {
        let (mut sum, mut count) = (vec![[0.0f32; 3]; n], vec![0u32; n]);
        for &f in unseen {
            let face = mesh.faces[f as usize];
            for e in 0..3 {
                for (a, b) in [(face[e], face[(e + 1) % 3]), (face[(e + 1) % 3], face[e])] {
                    if known[a as usize] == 0 {
                        (0..3).for_each(|k| sum[a as usize][k] += colour[b as usize][k]);
                        count[a as usize] += 1;
                    }
                }
            }
        }
        for v in (0..n).filter(|&v| count[v] > 0) {
            colour[v] = sum[v].map(|s| s / count[v] as f32);
        }
    }
    colour.iter_mut().for_each(|c| *c = c.map(|v| if v.is_nan() { GREY } else { v }));
    colour
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
        let raster = Raster::new(&rgb, 123, 41, "rgb").unwrap();
        let source = Source { rgb: raster, projection: CAMERA, gain: [1.0; 3] };
        let t = build_atlas(mesh, &vec![0; faces.len()], &[source], 4096).unwrap();
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
        let (dark, bright) = (image(|_, _| 100), image(|_, _| 130));
        let source = |d| Source { rgb: Raster::new(d, 123, 41, "rgb").unwrap(), projection: CAMERA, gain: [1.0; 3] };
        let labels: Vec<i32> = (0..faces.len() as i32).map(|f| i32::from(f >= 64)).collect();
        let t = build_atlas(mesh, &labels, &[source(&dark), source(&bright)], 4096).unwrap();
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
        let source = Source { rgb: Raster::new(&rgb, 123, 41, "rgb").unwrap(), projection: CAMERA, gain: [1.0; 3] };
        let labels: Vec<i32> = (0..faces.len()).map(|f| if f % 5 == 0 || f > 90 { NOTHING } else { 0 }).collect();
        let t = build_atlas(mesh, &labels, &[source], 4096).unwrap();
        assert!((0..t.origin.len()).all(|v| f32::from(at(&t, v).abs_diff(77)) <= SHADE / 2.0));
        // Faces of one colour share their vertices.
        assert!(t.origin.len() < vertices.len() * 2, "{}", t.origin.len());
        assert!(build_atlas(mesh, &labels, &[source], 16).is_err());
    }
}
