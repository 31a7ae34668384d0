//! Gradients: from those of points (or derivatives) to those of the control points and knots. Parts of fixed size are added in order, so
//! the result does not depend on the number of threads.

use super::knots::{Knots, LANES, TABLED};
use super::net::Net;
use super::points::MAX_ORDER;
use crate::error::{Result, require};
use multiversion::multiversion;
use rayon::prelude::*;

/// Fewest points a part; each part has a net of its own.
const LEAST: usize = 1 << 14;
/// Values that all parts' nets may hold together.
const MOST: usize = 1 << 24;

fn part_size(points: usize, net: usize) -> usize {
    let parts = (MOST / net.max(1)).clamp(1, 16);
    points.div_ceil(parts).max(LEAST)
}

fn added(parts: Vec<Vec<f64>>, len: usize) -> Vec<f64> {
    let mut sum = vec![0.0; len];
    for part in parts {
        sum.iter_mut().zip(part).for_each(|(s, p)| *s += p);
    }
    sum
}

/// Σ over points of basis(u)·basis(v)·gradient: the adjoint of derivative (k, l) of a surface, (m, n, dim).
pub fn control_gradient(
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    gradient: &[f64],
    dim: usize,
    orders: [usize; 2],
) -> Result<Vec<f64>> {
    require(u.len() == v.len(), "v", format!("as many values as u, {}", u.len()), v.len())?;
    require(gradient.len() == u.len() * dim, "gradient", format!("{} x {dim} values", u.len()), gradient.len())?;
    knots[0].check("u", u)?;
    knots[1].check("v", v)?;
    require(
        orders.iter().all(|&k| k <= MAX_ORDER),
        "orders",
        format!("at most {MAX_ORDER}"),
        orders[0].max(orders[1]),
    )?;
    let (m, n) = (knots[0].count(), knots[1].count());
    let blocks = dim.div_ceil(LANES);
    let stride = (n + TABLED) * blocks;
    let size = part_size(u.len(), (m + TABLED) * stride * LANES);
    let part = |((u, v), g): ((&[f64], &[f64]), &[f64])| {
        let mut net = vec![[0.0; LANES]; (m + TABLED) * stride];
        if knots.iter().all(|k| k.degree() <= TABLED) && orders.iter().all(|&k| k <= 2) {
            scatter_tabled(knots, u, v, g, dim, orders, stride, &mut net);
        } else {
            scatter(knots, u, v, g, dim, orders, stride, &mut net);
        }
        let mut out = Vec::with_capacity(m * n * dim);
        for i in 0..m {
            for j in 0..n {
                let point = net[i * stride + j * blocks..][..blocks].as_flattened();
                out.extend_from_slice(&point[..dim]);
            }
        }
        out
    };
    let parts =
        u.par_chunks(size).zip(v.par_chunks(size)).zip(gradient.par_chunks((size * dim).max(1))).map(part).collect();
    Ok(added(parts, m * n * dim))
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn scatter_tabled(
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    gradient: &[f64],
    dim: usize,
    orders: [usize; 2],
    stride: usize,
    net: &mut [[f64; LANES]],
) {
    let blocks = dim.div_ceil(LANES);
    let mut g = vec![[0.0; LANES]; blocks];
    for n in 0..u.len() {
        let (i, nu) = knots[0].tabled::<2>(u[n]);
        let (j, nv) = knots[1].tabled::<2>(v[n]);
        g.as_flattened_mut()[..dim].copy_from_slice(&gradient[n * dim..(n + 1) * dim]);
        for (b, g) in g.iter().enumerate() {
            for r in 0..LANES {
                let row = &mut net[(i + r) * stride + j * blocks + b..];
                let along: [f64; LANES] = std::array::from_fn(|x| g[x] * nu[orders[0]][r]);
                for s in 0..LANES {
                    let to = &mut row[s * blocks];
                    for x in 0..LANES {
                        to[x] = along[x].mul_add(nv[orders[1]][s], to[x]);
                    }
                }
            }
        }
    }
}

fn scatter(
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    gradient: &[f64],
    dim: usize,
    orders: [usize; 2],
    stride: usize,
    net: &mut [[f64; LANES]],
) {
    let (p, q) = (knots[0].degree(), knots[1].degree());
    let blocks = dim.div_ceil(LANES);
    let (mut nu, mut nv) = (vec![0.0; (orders[0] + 1) * (p + 1)], vec![0.0; (orders[1] + 1) * (q + 1)]);
    let mut g = vec![[0.0; LANES]; blocks];
    for n in 0..u.len() {
        let (su, sv) = (knots[0].span(u[n]), knots[1].span(v[n]));
        knots[0].basis(su, u[n], orders[0], &mut nu);
        knots[1].basis(sv, v[n], orders[1], &mut nv);
        g.as_flattened_mut()[..dim].copy_from_slice(&gradient[n * dim..(n + 1) * dim]);
        for r in 0..=p {
            for s in 0..=q {
                let factor = nu[orders[0] * (p + 1) + r] * nv[orders[1] * (q + 1) + s];
                let at = (su - p + r) * stride + (sv - q + s) * blocks;
                for (b, g) in g.iter().enumerate() {
                    for x in 0..LANES {
                        net[at + b][x] += factor * g[x];
                    }
                }
            }
        }
    }
}

/// The adjoint of derivative `order` of a curve, (n, dim).
pub fn curve_control_gradient(
    knots: &Knots,
    u: &[f64],
    gradient: &[f64],
    dim: usize,
    order: usize,
) -> Result<Vec<f64>> {
    require(gradient.len() == u.len() * dim, "gradient", format!("{} x {dim} values", u.len()), gradient.len())?;
    knots.check("u", u)?;
    require(order <= MAX_ORDER, "order", format!("at most {MAX_ORDER}"), order)?;
    let (p, len) = (knots.degree(), knots.count() * dim);
    let size = part_size(u.len(), len);
    let part = |(u, g): (&[f64], &[f64])| {
        let mut out = vec![0.0; len];
        let mut basis = vec![0.0; (order + 1) * (p + 1)];
        for (n, g) in g.chunks_exact(dim).enumerate() {
            let span = knots.span(u[n]);
            knots.basis(span, u[n], order, &mut basis);
            for r in 0..=p {
                let to = &mut out[(span - p + r) * dim..][..dim];
                to.iter_mut().zip(g).for_each(|(t, g)| *t += basis[order * (p + 1) + r] * g);
            }
        }
        out
    };
    let parts = u.par_chunks(size).zip(gradient.par_chunks((size * dim).max(1))).map(part).collect();
    Ok(added(parts, len))
}

/// Gradients with respect to both knot vectors of Σ gradient · S(u, v), from the net's own values: knots of u, then knots of v.
pub fn knot_gradient(net: &Net, knots: [&Knots; 2], u: &[f64], v: &[f64], gradient: &[f64]) -> Result<Vec<f64>> {
    require(u.len() == v.len(), "v", format!("as many values as u, {}", u.len()), v.len())?;
    let dim = net.dim;
    require(gradient.len() == u.len() * dim, "gradient", format!("{} x {dim} values", u.len()), gradient.len())?;
    knots[0].check("u", u)?;
    knots[1].check("v", v)?;
    let (p, q) = (knots[0].degree(), knots[1].degree());
    let lens = [knots[0].count() + p + 1, knots[1].count() + q + 1];
    let size = part_size(u.len(), lens[0] + lens[1]);
    let part = |((u, v), g): ((&[f64], &[f64]), &[f64])| {
        let mut out = vec![0.0; lens[0] + lens[1]];
        let (mut nu, mut nv) = (vec![0.0; p + 1], vec![0.0; q + 1]);
        let (mut to_u, mut to_v) = (vec![0.0; p + 1], vec![0.0; q + 1]);
        for n in 0..u.len() {
            let (su, sv) = (knots[0].span(u[n]), knots[1].span(v[n]));
            knots[0].basis(su, u[n], 0, &mut nu);
            knots[1].basis(sv, v[n], 0, &mut nv);
            to_u.fill(0.0);
            to_v.fill(0.0);
            for r in 0..=p {
                for s in 0..=q {
                    let point = net.values[(su - p + r) * net.stride + (sv - q + s) * net.blocks..].as_flattened();
                    let along: f64 = point[..dim].iter().zip(&g[n * dim..]).map(|(a, b)| a * b).sum();
                    to_u[r] += nv[s] * along;
                    to_v[s] += nu[r] * along;
                }
            }
            let (of_u, of_v) = out.split_at_mut(lens[0]);
            knots[0].basis_adjoint(su, u[n], &to_u, of_u);
            knots[1].basis_adjoint(sv, v[n], &to_v, of_v);
        }
        out
    };
    let parts =
        u.par_chunks(size).zip(v.par_chunks(size)).zip(gradient.par_chunks((size * dim).max(1))).map(part).collect();
    Ok(added(parts, lens[0] + lens[1]))
}

/// Gradients with respect to the knots of Σ gradient · C(u).
pub fn curve_knot_gradient(net: &Net, knots: &Knots, u: &[f64], gradient: &[f64]) -> Result<Vec<f64>> {
    let dim = net.dim;
    require(gradient.len() == u.len() * dim, "gradient", format!("{} x {dim} values", u.len()), gradient.len())?;
    knots.check("u", u)?;
    let p = knots.degree();
    let len = knots.count() + p + 1;
    let size = part_size(u.len(), len);
    let part = |(u, g): (&[f64], &[f64])| {
        let mut out = vec![0.0; len];
        let mut to_u = vec![0.0; p + 1];
        for n in 0..u.len() {
            let span = knots.span(u[n]);
            for (r, to) in to_u.iter_mut().enumerate() {
                let point = net.values[(span - p + r) * net.stride..].as_flattened();
                *to = point[..dim].iter().zip(&g[n * dim..]).map(|(a, b)| a * b).sum();
            }
            knots.basis_adjoint(span, u[n], &to_u, &mut out);
        }
        out
    };
    let parts = u.par_chunks(size).zip(gradient.par_chunks((size * dim).max(1))).map(part).collect();
    Ok(added(parts, len))
}
