//! Nouns for pixels: borrowed rasters in row-major order, pixel centres at integer coordinates.

use crate::error::{Result, require};

/// A borrowed single-channel raster, row-major, `data[y * width + x]`.
#[derive(Debug, Clone, Copy)]
pub struct Raster<'a, T> {
    /// The samples, `width * height` of them.
    pub data: &'a [T],
    /// Samples in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl<'a, T> Raster<'a, T> {
    /// Borrows `data` as `height` rows of `width` samples; `argument` names it in the error.
    pub fn new(data: &'a [T], width: usize, height: usize, argument: &'static str) -> Result<Self> {
        require(width > 0 && height > 0, argument, "a non-empty raster", format!("{height} x {width}"))?;
        require(
            data.len() == width * height,
            argument,
            format!("{} samples ({height} x {width})", width * height),
            data.len(),
        )?;
        Ok(Self { data, width, height })
    }

    /// Row `y`.
    #[inline(always)]
    pub fn row(&self, y: usize) -> &'a [T] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}

/// A rectangle cut from a raster, addressed by the whole raster's pixels.
#[derive(Debug, Clone, Copy)]
pub struct Cut<'a, T> {
    /// The rectangle's samples.
    pub part: Raster<'a, T>,
    /// Pixel of the whole raster at which the rectangle begins.
    pub corner: [usize; 2],
    /// Samples in a row of the whole raster.
    pub width: usize,
    /// Rows of the whole raster.
    pub height: usize,
}

impl<'a, T: Copy> Cut<'a, T> {
    /// A rectangle that begins at `corner` (column, row) of a raster of `size` (width, height).
    pub fn new(part: Raster<'a, T>, corner: [usize; 2], size: [usize; 2], argument: &'static str) -> Result<Self> {
        let ends = [corner[0].saturating_add(part.width), corner[1].saturating_add(part.height)];
        require(
            ends[0] <= size[0] && ends[1] <= size[1],
            argument,
            format!("a rectangle within {} x {} pixels", size[1], size[0]),
            format!("one that ends at row {} and column {}", ends[1], ends[0]),
        )?;
        Ok(Self { part, corner, width: size[0], height: size[1] })
    }

    /// Sample of a pixel of the whole raster; beyond the rectangle that of its nearest one.
    #[inline(always)]
    pub fn at(&self, x: usize, y: usize) -> T {
        let column = x.saturating_sub(self.corner[0]).min(self.part.width - 1);
        let row = y.saturating_sub(self.corner[1]).min(self.part.height - 1);
        self.part.data[row * self.part.width + column]
    }
}

impl<'a, T> From<Raster<'a, T>> for Cut<'a, T> {
    fn from(part: Raster<'a, T>) -> Self {
        let (width, height) = (part.width, part.height);
        Self { part, corner: [0; 2], width, height }
    }
}

/// How a reference pixel with inverse depth `w` lands in a source view: `q = matrix (x, y, 1) + w offset`, pixel
/// `(q.x / q.z, q.y / q.z)`. With cameras K, R, t this is `matrix = K_s R K_r^-1`, `offset = K_s t` (eqs 9-12 of the paper
/// for two views); for a rectified pair `matrix = I`, `offset = (-1, 0, 0)` and `w` is the disparity in pixels.
#[derive(Debug, Clone, Copy)]
pub struct Epipolar {
    /// Row-major 3x3.
    pub matrix: [f32; 9],
    /// Homogeneous direction in which the pixel moves with growing inverse depth.
    pub offset: [f32; 3],
}
