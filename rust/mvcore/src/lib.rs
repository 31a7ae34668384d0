//! Multi-view stereo kernels in plain Rust: arrays in, arrays out, no Python, no I/O beyond mesh and atlas files.
//!
//! Order of the modules: [`error`] ← nouns ([`interrupt`], [`memory`], [`raster`], [`grid`], [`mesh`], [`candidates`]) ← one file a kernel. Six kernels stand on a part
//! of their own: [`slanted`] and [`sweep`] on [`patch`], [`isosurface`] on [`cube`], [`fuse`] on [`smooth`], [`shade`] on [`rasterize`], [`atlas`] on
//! [`pack`], [`level`] and [`palette`]; no other calls another. [`nurbs`] is a family of its own that uses only [`error`] and [`memory`]. Threads come from rayon's
//! global pool; every kernel gives the same bytes for any number of them.

pub mod aggregate;
pub mod atlas;
pub mod candidates;
pub mod carve;
pub mod compare_views;
pub mod consistency;
pub mod correlate;
pub mod cube;
pub mod decimate;
pub mod distance_transform;
pub mod error;
pub mod expect;
pub mod files;
pub mod fuse;
pub mod grid;
pub mod holes;
pub mod hull;
pub mod interrupt;
pub mod isosurface;
pub mod level;
pub mod match_epipolar;
pub mod median;
pub mod memory;
pub mod mesh;
pub mod nearest;
pub mod nurbs;
pub mod pack;
pub mod palette;
pub mod patch;
pub mod photo_carve;
pub mod raster;
pub mod rasterize;
pub mod rate_faces;
pub mod select_views;
pub mod shade;
pub mod slanted;
pub mod smooth;
pub mod sweep;
#[cfg(test)]
mod testing;

pub use error::{Error, Result};
