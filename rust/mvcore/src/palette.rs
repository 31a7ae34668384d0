//! Colours for the faces that no view sees: a smooth continuation of their surroundings, in a few cells that many faces share.
//!
//! ```text
//!   seen │ unseen                   colours of the seen vertices spread face by face, then smoothed;
//!   ● ── ● ── ○ ── ○ ── ● seen      a face takes the nearest of the palette's colours, a cell of CELL² texels each
//! ```

/// Texels along the side of a cell of the palette.
pub const CELL: usize = 4;
/// Grey levels from one colour of the palette to the next.
const SHADE: f32 = 8.0;
/// Colours that there can be.
const MOST: usize = 32 * 32 * 32;
/// Where nothing around is seen.
const GREY: f32 = 127.0;
/// Rounds of smoothing.
const SMOOTHING: usize = 50;

/// The colours, and which of them each unseen face has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Palette {
    /// Number of the colour of each unseen face.
    pub number: Vec<u32>,
    /// In steps of [`SHADE`].
    colours: Vec<[u8; 3]>,
}

impl Palette {
    /// Colours for `faces` of a mesh of so many vertices; of the seen ones, `origin` has the number and `colour` the colour.
    pub fn new(vertices: usize, faces: &[[u32; 3]], origin: &[u32], colour: impl Fn(usize) -> [f32; 3]) -> Self {
        if faces.is_empty() {
            return Self { number: Vec::new(), colours: Vec::new() };
        }
        // Numbers of the unseen faces' vertices among themselves.
        let (mut place, mut count) = (vec![u32::MAX; vertices], 0);
        let mut faces = faces.to_vec();
        for corner in faces.as_flattened_mut() {
            let p = &mut place[*corner as usize];
            if *p == u32::MAX {
                *p = count;
                count += 1;
            }
            *corner = *p;
        }
        let (mut colours, mut known) = (vec![[0.0f32; 3]; count as usize], vec![0u32; count as usize]);
        for (v, &o) in origin.iter().enumerate() {
            let p = place[o as usize] as usize;
            if p < known.len() {
                let c = colour(v);
                (0..3).for_each(|k| colours[p][k] += c[k]);
                known[p] += 1;
            }
        }
        for (c, &n) in colours.iter_mut().zip(&known) {
            *c = if n > 0 { c.map(|v| v / n as f32) } else { [f32::NAN; 3] };
        }
        continue_colours(&faces, &mut colours);
        smooth(&faces, &known, &mut colours);
        Self::of(&faces, &colours)
    }

    fn of(faces: &[[u32; 3]], colours: &[[f32; 3]]) -> Self {
        let shade = |face: &[u32; 3]| -> [u8; 3] {
            let c = face.map(|v| colours[v as usize]);
            std::array::from_fn(|k| {
                let mean = (c[0][k] + c[1][k] + c[2][k]) / 3.0;
                (if mean.is_nan() { GREY } else { mean } / SHADE).clamp(0.0, 255.0 / SHADE) as u8
            })
        };
        let shades: Vec<[u8; 3]> = faces.iter().map(shade).collect();
        let mut distinct = shades.clone();
        distinct.sort_unstable();
        distinct.dedup();
        let number = shades.iter().map(|s| distinct.partition_point(|d| d < s) as u32).collect();
        Self { number, colours: distinct }
    }

    /// Rows of texels that a palette of so many faces has at most.
    pub fn most_rows(faces: usize, width: usize) -> usize {
        faces.min(MOST).div_ceil((width / CELL).max(1)) * CELL
    }

    /// Rows of texels that the palette has.
    pub fn rows(&self, width: usize) -> usize {
        self.colours.len().div_ceil((width / CELL).max(1)) * CELL
    }

    /// Middle of a colour's cell where the palette begins at row `first`.
    pub fn middle(&self, number: u32, first: usize, width: usize) -> [f32; 2] {
        let (x, y) = corner(number as usize, first, width);
        [x, y].map(|v| v as f32 + (CELL - 1) as f32 / 2.0)
    }

    /// Paints the cells from row `first` on.
    pub fn paint(&self, first: usize, width: usize, atlas: &mut [u8]) {
        for (n, shade) in self.colours.iter().enumerate() {
            let (x0, y0) = corner(n, first, width);
            let value = shade.map(|s| ((f32::from(s) + 0.5) * SHADE).min(255.0) as u8);
            for y in y0..y0 + CELL {
                for x in x0..x0 + CELL {
                    atlas[(y * width + x) * 3..][..3].copy_from_slice(&value);
                }
            }
        }
    }
}

fn corner(n: usize, first: usize, width: usize) -> (usize, usize) {
    let columns = width / CELL;
    (n % columns * CELL, first + n / columns * CELL)
}

/// Breadth first from the known vertices to those whose colour is NaN.
fn continue_colours(faces: &[[u32; 3]], colours: &mut [[f32; 3]]) {
    let mut left: Vec<[u32; 3]> = faces.to_vec();
    loop {
        let mut next: Vec<(u32, [f32; 3])> = Vec::new();
        for face in &left {
            let from: Vec<[f32; 3]> = face.iter().map(|&v| colours[v as usize]).filter(|c| !c[0].is_nan()).collect();
            if from.is_empty() {
                continue;
            }
            let mean = std::array::from_fn(|k| from.iter().map(|c| c[k]).sum::<f32>() / from.len() as f32);
            next.extend(face.iter().filter(|&&v| colours[v as usize][0].is_nan()).map(|&v| (v, mean)));
        }
        if next.is_empty() {
            return;
        }
        // Of the faces around a vertex the last counts.
        next.into_iter().for_each(|(v, c)| colours[v as usize] = c);
        left.retain(|face| face.iter().any(|&v| colours[v as usize][0].is_nan()));
    }
}

/// Vertices that are not known take the mean of those beside them, again and again.
fn smooth(faces: &[[u32; 3]], known: &[u32], colours: &mut [[f32; 3]]) {
    for _ in 0..SMOOTHING {
        let (mut sum, mut count) = (vec![[0.0f32; 3]; known.len()], vec![0u32; known.len()]);
        for face in faces {
            for e in 0..3 {
                for (a, b) in [(face[e], face[(e + 1) % 3]), (face[(e + 1) % 3], face[e])] {
                    if known[a as usize] == 0 {
                        (0..3).for_each(|k| sum[a as usize][k] += colours[b as usize][k]);
                        count[a as usize] += 1;
                    }
                }
            }
        }
        for v in (0..known.len()).filter(|&v| count[v] > 0) {
            colours[v] = sum[v].map(|s| s / count[v] as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strip(n: u32) -> Vec<[u32; 3]> {
        (0..n).flat_map(|i| [[2 * i, 2 * i + 1, 2 * i + 2], [2 * i + 2, 2 * i + 1, 2 * i + 3]]).collect()
    }

    #[test]
    fn colours_go_over_from_one_end_to_the_other() {
        let faces = strip(6);
        let ends = [0, 1, 12, 13];
        let palette = Palette::new(20, &faces, &ends, |v| if v < 2 { [40.0; 3] } else { [200.0; 3] });
        let grey: Vec<u8> = palette.number.iter().map(|&n| palette.colours[n as usize][0]).collect();
        assert!(grey.is_sorted() && grey[0] < 8 && grey[11] > 22, "{grey:?}");
        let mut atlas = vec![0; 8 * 64 * 3];
        palette.paint(0, 64, &mut atlas);
        let [x, y] = palette.middle(palette.number[11], 0, 64).map(|v| v as usize);
        assert!(atlas[(y * 64 + x) * 3].abs_diff(200) < 12);
    }

    #[test]
    fn where_nothing_is_seen_all_is_grey() {
        let palette = Palette::new(6, &strip(2), &[], |_| [0.0; 3]);
        assert_eq!((palette.number.clone(), palette.rows(64)), (vec![0; 4], CELL));
        assert!((f32::from(palette.colours[0][0]) * SHADE - GREY).abs() < SHADE);
        assert_eq!(Palette::new(6, &[], &[], |_| [0.0; 3]).rows(64), 0);
    }
}
