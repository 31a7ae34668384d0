//! NURBS curves and surfaces (paper section 2.2, eqs 13-31; Piegl and Tiller, The NURBS Book).
//!
//! ```text
//!   knots ──span, basis (A2.1-A2.3)──► points and derivatives (A3.2, A3.6) ──rational recursion (A4.2, A4.4)──► out
//!                                  └─► the same transposed: gradients to control points, knots
//! ```
//!
//! Control nets are rows of `dim` values; a rational shape comes with homogeneous ones, (w·P, w). The sum over an order-`d`
//! derivative table covers `k + l <= d`.

mod adjoint;
mod knots;
mod net;
mod points;
mod rational;

pub use adjoint::{control_gradient, curve_control_gradient, curve_knot_gradient, knot_gradient};
pub use knots::{Knots, MAX_DEGREE};
pub use net::Net;
pub use points::{Derivative, MAX_ORDER, curve_points, surface_grid, surface_points, triangle};
