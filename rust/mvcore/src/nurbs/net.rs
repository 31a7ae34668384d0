//! Control nets padded to SIMD rows.

use super::knots::{LANES, TABLED};
use crate::error::{Result, require};

/// A control net of m × n points, each padded with zeros to whole SIMD rows and with [`TABLED`] more rows and columns, so that a block of
/// four by four may start at any point.
#[derive(Debug, Clone)]
pub struct Net {
    pub(super) dim: usize,
    /// SIMD rows a point.
    pub(super) blocks: usize,
    /// SIMD rows from a point to the one below.
    pub(super) stride: usize,
    pub(super) values: Vec<[f64; LANES]>,
    pub(super) rational: bool,
}

impl Net {
    /// From `rows · columns · dim` values. With `rational` the last of the `dim` is the weight, the others are multiplied by it.
    pub fn new(
        argument: &'static str,
        values: &[f64],
        rows: usize,
        columns: usize,
        dim: usize,
        rational: bool,
    ) -> Result<Self> {
        require(dim > usize::from(rational), argument, "at least one coordinate", dim)?;
        require(
            values.len() == rows * columns * dim,
            argument,
            format!("{rows} x {columns} x {dim} values"),
            values.len(),
        )?;
        require(values.iter().all(|v| v.is_finite()), argument, "finite values", "NaN or infinity")?;
        let bad = if rational { values.chunks_exact(dim).map(|p| p[dim - 1]).find(|&w| w <= 0.0) } else { None };
        require(bad.is_none(), "weights", "positive values", bad.unwrap_or(0.0))?;
        let blocks = dim.div_ceil(LANES);
        let stride = (columns + TABLED) * blocks;
        let mut padded = vec![[0.0; LANES]; (rows + TABLED) * stride];
        for (n, point) in values.chunks_exact(dim).enumerate() {
            let at = n / columns * stride + n % columns * blocks;
            for (k, &v) in point.iter().enumerate() {
                padded[at + k / LANES][k % LANES] = v;
            }
        }
        Ok(Self { dim, blocks, stride, values: padded, rational })
    }

    /// Coordinates of a point of the shape.
    pub fn dim_out(&self) -> usize {
        self.dim - usize::from(self.rational)
    }
}
