//! Nouns for voxels: a regular grid, and a block-sparse volume on it.
//!
//! Index order [i, j, k] = x, y, z, C order (k runs fastest). Voxel (i, j, k) is the sample at `origin + voxel * (i, j, k)`.

use crate::error::{Result, require};

/// Voxels along a block's side.
pub const SIDE: usize = 8;
/// Voxels in a block.
pub const BLOCK: usize = SIDE * SIDE * SIDE;
/// In [`BlockMap`]: no such block.
pub const NONE: u32 = u32::MAX;

/// Where voxel samples stand in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// World position of sample (0, 0, 0).
    pub origin: [f64; 3],
    /// Distance between samples, world units.
    pub voxel: f64,
    /// Samples along x, y, z.
    pub shape: [usize; 3],
}

impl Grid {
    /// Checks and builds a grid.
    pub fn new(origin: [f64; 3], voxel: f64, shape: [usize; 3]) -> Result<Self> {
        require(origin.iter().all(|v| v.is_finite()), "origin", "finite numbers", format!("{origin:?}"))?;
        require(voxel > 0.0 && voxel.is_finite(), "voxel", "a positive size", voxel)?;
        let fits = shape.iter().all(|&n| n >= 1) && shape.iter().map(|&n| n as u128).product::<u128>() < 1 << 46;
        require(fits, "shape", "1 or more samples along each axis, below 2^46 in all", format!("{shape:?}"))?;
        Ok(Self { origin, voxel, shape })
    }

    /// Blocks along x, y, z.
    pub fn blocks(&self) -> [usize; 3] {
        self.shape.map(|n| n.div_ceil(SIDE))
    }
}

/// Which blocks of a grid exist, in ascending order of their coordinates, and where each one's samples lie.
#[derive(Debug, Clone)]
pub struct BlockMap {
    /// Blocks along each axis.
    pub dims: [usize; 3],
    /// Slot of each block of the grid, or [`NONE`].
    pub slot: Vec<u32>,
    /// Block coordinates of each slot.
    pub coords: Vec<[u32; 3]>,
}

impl BlockMap {
    /// From one flag a block (C order).
    pub fn from_flags(dims: [usize; 3], flags: impl Iterator<Item = bool>) -> Self {
        let mut slot = vec![NONE; dims[0] * dims[1] * dims[2]];
        let mut coords = Vec::new();
        for (index, _) in flags.enumerate().filter(|(_, on)| *on) {
            slot[index] = coords.len() as u32;
            let (i, rest) = (index / (dims[1] * dims[2]), index % (dims[1] * dims[2]));
            coords.push([i as u32, (rest / dims[2]) as u32, (rest % dims[2]) as u32]);
        }
        Self { dims, slot, coords }
    }

    /// From block coordinates in ascending order.
    pub fn from_coords(dims: [usize; 3], coords: Vec<[u32; 3]>) -> Result<Self> {
        let inside = coords.iter().all(|c| (0..3).all(|a| (c[a] as usize) < dims[a]));
        require(inside, "coords", format!("block coordinates below {dims:?}"), "one outside")?;
        let ascending = coords.windows(2).all(|pair| pair[0] < pair[1]);
        require(ascending, "coords", "ascending and distinct block coordinates", "others")?;
        let mut slot = vec![NONE; dims[0] * dims[1] * dims[2]];
        for (n, c) in coords.iter().enumerate() {
            slot[(c[0] as usize * dims[1] + c[1] as usize) * dims[2] + c[2] as usize] = n as u32;
        }
        Ok(Self { dims, slot, coords })
    }

    /// Slot of the block at (i, j, k), [`NONE`] outside the grid.
    #[inline(always)]
    pub fn at(&self, i: usize, j: usize, k: usize) -> u32 {
        if i >= self.dims[0] || j >= self.dims[1] || k >= self.dims[2] {
            return NONE;
        }
        self.slot[(i * self.dims[1] + j) * self.dims[2] + k]
    }
}
