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
