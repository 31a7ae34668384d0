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

/// A box of blocks, ends excluded: the whole of a grid, or a tile of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tile {
    /// First block along each axis.
    pub low: [usize; 3],
    /// Block after the last.
    pub high: [usize; 3],
}

impl Tile {
    /// All blocks of a grid.
    pub fn whole(grid: &Grid) -> Self {
        Self { low: [0; 3], high: grid.blocks() }
    }

    /// Blocks along each axis.
    pub fn dims(&self) -> [usize; 3] {
        std::array::from_fn(|a| self.high[a] - self.low[a])
    }

    /// Blocks in it.
    pub fn count(&self) -> usize {
        self.dims().iter().product()
    }

    /// Coordinates of a block by its number, C order.
    pub fn block(&self, index: usize) -> [usize; 3] {
        let [_, y, z] = self.dims();
        [self.low[0] + index / (y * z), self.low[1] + index / z % y, self.low[2] + index % z]
    }

    /// Number of a block, none outside.
    #[inline(always)]
    pub fn index(&self, block: [usize; 3]) -> Option<usize> {
        let inside = (0..3).all(|a| block[a] >= self.low[a] && block[a] < self.high[a]);
        let [_, y, z] = self.dims();
        inside.then(|| ((block[0] - self.low[0]) * y + block[1] - self.low[1]) * z + block[2] - self.low[2])
    }
}

/// Which blocks of a tile exist, in ascending order of their coordinates in the grid, and where each one's samples lie.
#[derive(Debug, Clone)]
pub struct BlockMap {
    /// The blocks that may exist.
    pub tile: Tile,
    /// Slot of each block of the tile, or [`NONE`].
    pub slot: Vec<u32>,
    /// Block coordinates of each slot.
    pub coords: Vec<[u32; 3]>,
}

impl BlockMap {
    /// From one flag a block (C order).
    pub fn from_flags(tile: Tile, flags: impl Iterator<Item = bool>) -> Self {
        let mut slot = vec![NONE; tile.count()];
        let mut coords = Vec::new();
        for (index, _) in flags.enumerate().filter(|(_, on)| *on) {
            slot[index] = coords.len() as u32;
            coords.push(tile.block(index).map(|v| v as u32));
        }
        Self { tile, slot, coords }
    }

    /// From block coordinates in ascending order.
    pub fn from_coords(coords: Vec<[u32; 3]>) -> Result<Self> {
        let ascending = coords.windows(2).all(|pair| pair[0] < pair[1]);
        require(ascending, "coords", "ascending and distinct block coordinates", "others")?;
        let end = |pick: fn(u32, u32) -> u32, a: usize| coords.iter().map(|c| c[a]).reduce(pick);
        let tile = Tile {
            low: std::array::from_fn(|a| end(u32::min, a).map_or(0, |v| v as usize)),
            high: std::array::from_fn(|a| end(u32::max, a).map_or(0, |v| v as usize + 1)),
        };
        let count = tile.dims().iter().map(|&n| n as u128).product::<u128>();
        require(count < 1 << 34, "coords", "a box of fewer than 2^34 blocks", count)?;
        let mut slot = vec![NONE; tile.count()];
        for (n, c) in coords.iter().enumerate() {
            if let Some(index) = tile.index(c.map(|v| v as usize)) {
                slot[index] = n as u32;
            }
        }
        Ok(Self { tile, slot, coords })
    }

    /// Slot of the block at (i, j, k) of the grid, [`NONE`] outside the tile.
    #[inline(always)]
    pub fn at(&self, i: usize, j: usize, k: usize) -> u32 {
        self.tile.index([i, j, k]).map_or(NONE, |index| self.slot[index])
    }
}
