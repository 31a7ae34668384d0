//! NURBS kernels: control nets, knots and parameters in; points, derivatives and gradients out.

use crate::checks::check;
use crate::convert::{array, run_briefly, slice};
use mvcore::error::require;
use mvcore::memory;
use mvcore::nurbs::{self, Derivative, Knots, Net};
use numpy::{
    PyArray1, PyArray2, PyArray3, PyArray4, PyArray5, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

type Floats<'py> = PyReadonlyArray1<'py, f64>;

/// First non-zero function and the (order + 1, degree + 1) basis table at each parameter.
#[pyfunction]
pub fn nurbs_basis<'py>(
    py: Python<'py>,
    knots: Floats<'py>,
    count: usize,
    u: Floats<'py>,
    order: usize,
) -> PyResult<(Bound<'py, PyArray1<i64>>, Bound<'py, PyArray3<f64>>)> {
    let (knots, u) = (slice(&knots, "knots")?, slice(&u, "u")?);
    let (first, values, columns) = run_briefly(py, || {
        let knots = Knots::new("knots", knots, count)?;
        knots.check("u", u)?;
        require(order <= nurbs::MAX_ORDER, "order", format!("at most {}", nurbs::MAX_ORDER), order)?;
        let columns = knots.degree() + 1;
        let mut values = vec![0.0; u.len() * (order + 1) * columns];
        let first: Vec<i64> = (u.iter().zip(values.chunks_exact_mut((order + 1) * columns)))
            .map(|(&u, out)| {
                let span = knots.span(u);
                knots.basis(span, u, order, out);
                (span - knots.degree()) as i64
            })
            .collect();
        Ok((first, values, columns))
    })?;
    let n = first.len();
    Ok((array(py, first, n)?, array(py, values, (n, order + 1, columns))?))
}

/// (order + 1, n, dim) points and derivatives of a curve.
#[pyfunction]
pub fn nurbs_curve<'py>(
    py: Python<'py>,
    control: PyReadonlyArray2<'py, f64>,
    knots: Floats<'py>,
    u: Floats<'py>,
    order: usize,
    rational: bool,
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let [n, dim] = [control.shape()[0], control.shape()[1]];
    let (control, knots, u) = (slice(&control, "control_points")?, slice(&knots, "knots")?, slice(&u, "u")?);
    let (out, dim) = run_briefly(py, || {
        let net = Net::new("control_points", control, n, 1, dim, rational)?;
        Ok((nurbs::curve_points(&net, &Knots::new("knots", knots, n)?, u, order)?, net.dim_out()))
    })?;
    array(py, out, (order + 1, u.len(), dim))
}

/// (order + 1, order + 1, n, dim) points and derivatives of a surface, zero where the orders sum to more than `order`.
#[pyfunction]
pub fn nurbs_surface<'py>(
    py: Python<'py>,
    control: PyReadonlyArray3<'py, f64>,
    knots: (Floats<'py>, Floats<'py>),
    u: Floats<'py>,
    v: Floats<'py>,
    order: usize,
    rational: bool,
) -> PyResult<Bound<'py, PyArray4<f64>>> {
    let [m, n, dim] = [control.shape()[0], control.shape()[1], control.shape()[2]];
    let (control, ku, kv) =
        (slice(&control, "control_points")?, slice(&knots.0, "knots_u")?, slice(&knots.1, "knots_v")?);
    let (u, v) = (slice(&u, "u")?, slice(&v, "v")?);
    let (out, dim) = run_briefly(py, || {
        let net = Net::new("control_points", control, m, n, dim, rational)?;
        let knots = [&Knots::new("knots_u", ku, m)?, &Knots::new("knots_v", kv, n)?];
        let wanted = nurbs::triangle(order)?;
        memory::room("points", &[wanted.len() * 2, u.len(), net.dim_out(), size_of::<f64>()])?;
        Ok((nurbs::surface_points(&net, knots, u, v, &wanted, (order + 1) * (order + 1))?, net.dim_out()))
    })?;
    array(py, out, (order + 1, order + 1, u.len(), dim))
}

/// (orders, n, dim): the derivatives asked for by their orders along u and v, of plain control points.
#[pyfunction]
pub fn nurbs_surface_partials<'py>(
    py: Python<'py>,
    control: PyReadonlyArray3<'py, f64>,
    knots: (Floats<'py>, Floats<'py>),
    u: Floats<'py>,
    v: Floats<'py>,
    orders: Vec<(usize, usize)>,
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let [m, n, dim] = [control.shape()[0], control.shape()[1], control.shape()[2]];
    let (control, ku, kv) =
        (slice(&control, "control_points")?, slice(&knots.0, "knots_u")?, slice(&knots.1, "knots_v")?);
    let (u, v) = (slice(&u, "u")?, slice(&v, "v")?);
    let wanted: Vec<Derivative> = orders.iter().enumerate().map(|(slot, &(u, v))| Derivative { u, v, slot }).collect();
    let out = run_briefly(py, || {
        let net = Net::new("control_points", control, m, n, dim, false)?;
        let knots = [&Knots::new("knots_u", ku, m)?, &Knots::new("knots_v", kv, n)?];
        nurbs::surface_points(&net, knots, u, v, &wanted, wanted.len())
    })?;
    array(py, out, (orders.len(), u.len(), dim))
}

/// (order + 1, order + 1, nu, nv, dim) points and derivatives on the grid of all pairs of parameters.
#[pyfunction]
pub fn nurbs_surface_grid<'py>(
    py: Python<'py>,
    control: PyReadonlyArray3<'py, f64>,
    knots: (Floats<'py>, Floats<'py>),
    u: Floats<'py>,
    v: Floats<'py>,
    order: usize,
    rational: bool,
) -> PyResult<Bound<'py, PyArray5<f64>>> {
    let [m, n, dim] = [control.shape()[0], control.shape()[1], control.shape()[2]];
    let (control, ku, kv) =
        (slice(&control, "control_points")?, slice(&knots.0, "knots_u")?, slice(&knots.1, "knots_v")?);
    let (u, v) = (slice(&u, "u")?, slice(&v, "v")?);
    let (out, dim) = run_briefly(py, || {
        let net = Net::new("control_points", control, m, n, dim, rational)?;
        let knots = [&Knots::new("knots_u", ku, m)?, &Knots::new("knots_v", kv, n)?];
        let orders = order.saturating_add(1).saturating_mul(order.saturating_add(1));
        memory::room("points", &[orders, u.len(), v.len(), net.dim_out(), size_of::<f64>()])?;
        Ok((nurbs::surface_grid(&net, knots, u, v, order)?, net.dim_out()))
    })?;
    array(py, out, (order + 1, order + 1, u.len(), v.len(), dim))
}

/// (m, n, dim) gradient to a surface's control points of derivative `orders` at the parameters.
#[pyfunction]
pub fn nurbs_control_gradient<'py>(
    py: Python<'py>,
    knots: (Floats<'py>, Floats<'py>),
    counts: (usize, usize),
    u: Floats<'py>,
    v: Floats<'py>,
    gradient: PyReadonlyArray2<'py, f64>,
    orders: (usize, usize),
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let dim = gradient.shape()[1];
    check(py, dim > 0, "gradient", "at least one coordinate", dim)?;
    let (ku, kv) = (slice(&knots.0, "knots_u")?, slice(&knots.1, "knots_v")?);
    let (u, v, gradient) = (slice(&u, "u")?, slice(&v, "v")?, slice(&gradient, "gradient")?);
    let out = run_briefly(py, || {
        let knots = [&Knots::new("knots_u", ku, counts.0)?, &Knots::new("knots_v", kv, counts.1)?];
        memory::room("gradient", &[counts.0, counts.1, dim, size_of::<f64>()])?;
        nurbs::control_gradient(knots, u, v, gradient, dim, [orders.0, orders.1])
    })?;
    array(py, out, (counts.0, counts.1, dim))
}

/// (n, dim) gradient to a curve's control points of derivative `order` at the parameters.
#[pyfunction]
pub fn nurbs_curve_control_gradient<'py>(
    py: Python<'py>,
    knots: Floats<'py>,
    count: usize,
    u: Floats<'py>,
    gradient: PyReadonlyArray2<'py, f64>,
    order: usize,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let dim = gradient.shape()[1];
    check(py, dim > 0, "gradient", "at least one coordinate", dim)?;
    let (knots, u, gradient) = (slice(&knots, "knots")?, slice(&u, "u")?, slice(&gradient, "gradient")?);
    let out = run_briefly(py, || {
        nurbs::curve_control_gradient(&Knots::new("knots", knots, count)?, u, gradient, dim, order)
    })?;
    array(py, out, (count, dim))
}

/// Gradients to the knots of u and of v of a surface's points.
#[pyfunction]
pub fn nurbs_knot_gradient<'py>(
    py: Python<'py>,
    control: PyReadonlyArray3<'py, f64>,
    knots: (Floats<'py>, Floats<'py>),
    u: Floats<'py>,
    v: Floats<'py>,
    gradient: PyReadonlyArray2<'py, f64>,
) -> PyResult<(Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>)> {
    let [m, n, dim] = [control.shape()[0], control.shape()[1], control.shape()[2]];
    let (control, ku, kv) =
        (slice(&control, "control_points")?, slice(&knots.0, "knots_u")?, slice(&knots.1, "knots_v")?);
    let (u, v, gradient) = (slice(&u, "u")?, slice(&v, "v")?, slice(&gradient, "gradient")?);
    let mut out = run_briefly(py, || {
        let net = Net::new("control_points", control, m, n, dim, false)?;
        let knots = [&Knots::new("knots_u", ku, m)?, &Knots::new("knots_v", kv, n)?];
        nurbs::knot_gradient(&net, knots, u, v, gradient)
    })?;
    let of_v = out.split_off(ku.len());
    Ok((array(py, out, ku.len())?, array(py, of_v, kv.len())?))
}

/// Gradient to the knots of a curve's points.
#[pyfunction]
pub fn nurbs_curve_knot_gradient<'py>(
    py: Python<'py>,
    control: PyReadonlyArray2<'py, f64>,
    knots: Floats<'py>,
    u: Floats<'py>,
    gradient: PyReadonlyArray2<'py, f64>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let [n, dim] = [control.shape()[0], control.shape()[1]];
    let (control, knots) = (slice(&control, "control_points")?, slice(&knots, "knots")?);
    let (u, gradient) = (slice(&u, "u")?, slice(&gradient, "gradient")?);
    let out = run_briefly(py, || {
        let net = Net::new("control_points", control, n, 1, dim, false)?;
        nurbs::curve_knot_gradient(&net, &Knots::new("knots", knots, n)?, u, gradient)
    })?;
    array(py, out, knots.len())
}
