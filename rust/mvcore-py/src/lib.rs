//! The Python module `mvcore._core`: check, borrow, detach, call, convert. Nothing is computed here.

mod checks;
mod convert;
mod depth;
mod files;
mod interrupt;
mod nurbs;
mod sparse;
mod texture;
mod volume;

use pyo3::prelude::*;

#[pymodule]
mod _core {
    #[pymodule_export]
    use crate::depth::{aggregate, correlate, expect, refine, sweep, weighted_median};
    #[pymodule_export]
    use crate::files::{encode_png, read_obj};
    #[pymodule_export]
    use crate::interrupt::Interrupt;
    #[pymodule_export]
    use crate::nurbs::{
        nurbs_basis, nurbs_control_gradient, nurbs_curve, nurbs_curve_control_gradient, nurbs_curve_knot_gradient,
        nurbs_knot_gradient, nurbs_surface, nurbs_surface_grid, nurbs_surface_partials,
    };
    #[pymodule_export]
    use crate::sparse::match_epipolar;
    #[pymodule_export]
    use crate::texture::{Atlas, compare_views, keep_best, rasterize, rate_faces, select_views, shade};
    #[pymodule_export]
    use crate::volume::{
        carve, close_holes, components, consistency, decimate, distance_transform, fuse, isosurface_dense,
        isosurface_sparse, nearest, photo_carve,
    };

    #[pymodule_init]
    fn init(_module: &pyo3::Bound<'_, pyo3::types::PyModule>) -> pyo3::PyResult<()> {
        crate::interrupt::keep_panics();
        Ok(())
    }
}
