//! Points and derivatives of curves and surfaces, scattered (A3.2, A3.6) and on a tensor grid.

use super::knots::{Knots, LANES, TABLED};
use super::net::Net;
use super::rational::{binomials, dehomogenise};
use crate::error::{Result, require};
use crate::memory::zeroed;
use multiversion::multiversion;
use rayon::prelude::*;

/// Points a task.
const CHUNK: usize = 2048;

/// A wanted derivative: its orders along u and v, and its place among the results.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Derivative {
    /// Order along u.
    pub u: usize,
    /// Order along v.
    pub v: usize,
    /// Which of the results it becomes.
    pub slot: usize,
}

/// Highest sum of orders of a derivative.
pub const MAX_ORDER: usize = 64;

fn check_order(order: usize) -> Result<()> {
    require(order <= MAX_ORDER, "order", format!("at most {MAX_ORDER}"), order)
}

/// All derivatives with `u + v <= order`, in slots of an (order + 1)² table.
pub fn triangle(order: usize) -> Result<Vec<Derivative>> {
    check_order(order)?;
    let row = |u: usize| (0..=order - u).map(move |v| Derivative { u, v, slot: u * (order + 1) + v });
    Ok((0..=order).flat_map(row).collect())
}

/// The slots' rows for each chunk of points: `parts[chunk][n]` belongs to `wanted[n]`.
fn split<'a>(out: &'a mut [f64], wanted: &[Derivative], slot: usize, chunk: usize) -> Vec<Vec<&'a mut [f64]>> {
    if slot == 0 {
        return Vec::new();
    }
    let mut slots: Vec<Option<&mut [f64]>> = out.chunks_mut(slot).map(Some).collect();
    let mut parts: Vec<Vec<&mut [f64]>> = Vec::new();
    for d in wanted {
        for (n, part) in slots[d.slot].take().unwrap_or_default().chunks_mut(chunk).enumerate() {
            if parts.len() <= n {
                parts.push(Vec::with_capacity(wanted.len()));
            }
            parts[n].push(part);
        }
    }
    parts
}

fn checked(wanted: &[Derivative]) -> Result<(usize, usize)> {
    let slots = wanted.iter().map(|d| d.slot + 1).max().unwrap_or(0);
    let mut slot: Vec<usize> = wanted.iter().map(|d| d.slot).collect();
    slot.sort_unstable();
    slot.dedup();
    require(slot.len() == wanted.len(), "wanted", "a slot for each derivative", "one slot twice")?;
    let order = wanted.iter().map(|d| d.u.saturating_add(d.v)).max().unwrap_or(0);
    check_order(order)?;
    Ok((order, slots))
}

/// Derivatives of a surface at scattered parameters; `slots` results of (n, dim), those not wanted zero.
pub fn surface_points(
    net: &Net,
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    wanted: &[Derivative],
    slots: usize,
) -> Result<Vec<f64>> {
    require(u.len() == v.len(), "v", format!("as many values as u, {}", u.len()), v.len())?;
    knots[0].check("u", u)?;
    knots[1].check("v", v)?;
    let (order, used) = checked(wanted)?;
    let dim = net.dim_out();
    let size = u.len() * dim;
    let mut out = zeroed::<f64>(slots.max(used) * size);
    let c = binomials(order);
    let simple = knots.iter().all(|k| k.degree() <= TABLED) && order <= 2;
    let parts = split(&mut out, wanted, size, CHUNK * dim);
    parts.into_par_iter().zip(u.par_chunks(CHUNK).zip(v.par_chunks(CHUNK))).for_each(|(mut part, (u, v))| {
        if simple {
            scattered_tabled(net, knots, u, v, order, wanted, &mut part, &c);
        } else {
            scattered(net, knots, u, v, order, wanted, &mut part, &c);
        }
    });
    Ok(out)
}

/// Copies the wanted entries of a point's derivative table to place `n` of their rows.
#[inline(always)]
fn store(
    table: &[f64],
    order: usize,
    width: usize,
    dim: usize,
    wanted: &[Derivative],
    part: &mut [&mut [f64]],
    n: usize,
) {
    for (d, row) in wanted.iter().zip(part) {
        let from = (d.u * (order + 1) + d.v) * width;
        row[n * dim..(n + 1) * dim].copy_from_slice(&table[from..from + dim]);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn scattered_tabled(
    net: &Net,
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    order: usize,
    wanted: &[Derivative],
    part: &mut [&mut [f64]],
    c: &[Vec<f64>],
) {
    let width = net.blocks * LANES;
    if order == 2 && !net.rational && net.dim == 3 && wanted.len() == 6 {
        // The commonest case, straight from registers to its six rows.
        if let [s, sv, svv, su, suv, suu] = part {
            for n in 0..u.len() {
                let (i, nu) = knots[0].tabled::<2>(u[n]);
                let (j, nv) = knots[1].tabled::<2>(v[n]);
                let d = block::<2>(net, i, j, 0, &nu, &nv);
                for (row, value) in [(&mut *s, d[0]), (sv, d[1]), (svv, d[2]), (su, d[3]), (suv, d[4]), (suu, d[6])] {
                    row[3 * n..3 * n + 3].copy_from_slice(&value[..3]);
                }
            }
            return;
        }
    }
    let mut table = vec![0.0; (order + 1) * (order + 1) * width];
    for n in 0..u.len() {
        for b in 0..net.blocks {
            match order {
                0 => {
                    let ((i, nu), (j, nv)) = (knots[0].tabled::<0>(u[n]), knots[1].tabled::<0>(v[n]));
                    spread::<0>(&block::<0>(net, i, j, b, &nu, &nv), b, width, &mut table);
                }
                1 => {
                    let ((i, nu), (j, nv)) = (knots[0].tabled::<1>(u[n]), knots[1].tabled::<1>(v[n]));
                    spread::<1>(&block::<1>(net, i, j, b, &nu, &nv), b, width, &mut table);
                }
                _ => {
                    let ((i, nu), (j, nv)) = (knots[0].tabled::<2>(u[n]), knots[1].tabled::<2>(v[n]));
                    spread::<2>(&block::<2>(net, i, j, b, &nu, &nv), b, width, &mut table);
                }
            }
        }
        if net.rational {
            dehomogenise(&mut table, order, order, width, net.dim, c);
        }
        store(&table, order, width, net.dim_out(), wanted, part, n);
    }
}

/// The sum over four by four control points of one SIMD row of theirs, entry `3 k + l` for derivative (k, l).
#[inline(always)]
fn block<const ORDER: usize>(
    net: &Net,
    i: usize,
    j: usize,
    b: usize,
    nu: &[[f64; LANES]; 3],
    nv: &[[f64; LANES]; 3],
) -> [[f64; LANES]; 9] {
    let mut out = [[0.0; LANES]; 9];
    for r in 0..LANES {
        let row = &net.values[(i + r) * net.stride + j * net.blocks + b..];
        let mut along = [[0.0; LANES]; 3];
        for s in 0..LANES {
            let p = &row[s * net.blocks];
            for l in 0..=ORDER {
                for x in 0..LANES {
                    along[l][x] = p[x].mul_add(nv[l][s], along[l][x]);
                }
            }
        }
        for k in 0..=ORDER {
            for l in 0..=ORDER - k {
                for x in 0..LANES {
                    out[3 * k + l][x] = along[l][x].mul_add(nu[k][r], out[3 * k + l][x]);
                }
            }
        }
    }
    out
}

#[inline(always)]
fn spread<const ORDER: usize>(sums: &[[f64; LANES]; 9], b: usize, width: usize, table: &mut [f64]) {
    for k in 0..=ORDER {
        for l in 0..=ORDER - k {
            table[(k * (ORDER + 1) + l) * width + b * LANES..][..LANES].copy_from_slice(&sums[3 * k + l]);
        }
    }
}

/// Any degrees and order.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn scattered(
    net: &Net,
    knots: [&Knots; 2],
    u: &[f64],
    v: &[f64],
    order: usize,
    wanted: &[Derivative],
    part: &mut [&mut [f64]],
    c: &[Vec<f64>],
) {
    let (p, q) = (knots[0].degree(), knots[1].degree());
    let width = net.blocks * LANES;
    let (mut nu, mut nv) = (vec![0.0; (order + 1) * (p + 1)], vec![0.0; (order + 1) * (q + 1)]);
    let mut along = vec![[0.0; LANES]; order + 1];
    let mut table = vec![0.0; (order + 1) * (order + 1) * width];
    for n in 0..u.len() {
        let (su, sv) = (knots[0].span(u[n]), knots[1].span(v[n]));
        knots[0].basis(su, u[n], order, &mut nu);
        knots[1].basis(sv, v[n], order, &mut nv);
        table.fill(0.0);
        for b in 0..net.blocks {
            for r in 0..=p {
                let row = &net.values[(su - p + r) * net.stride + (sv - q) * net.blocks + b..];
                along.fill([0.0; LANES]);
                for s in 0..=q {
                    let point = &row[s * net.blocks];
                    for (l, sum) in along.iter_mut().enumerate() {
                        for x in 0..LANES {
                            sum[x] = point[x].mul_add(nv[l * (q + 1) + s], sum[x]);
                        }
                    }
                }
                for k in 0..=order {
                    let factor = nu[k * (p + 1) + r];
                    for (l, sum) in along.iter().enumerate().take(order + 1 - k) {
                        let to = &mut table[(k * (order + 1) + l) * width + b * LANES..][..LANES];
                        for x in 0..LANES {
                            to[x] = sum[x].mul_add(factor, to[x]);
                        }
                    }
                }
            }
        }
        if net.rational {
            dehomogenise(&mut table, order, order, width, net.dim, c);
        }
        store(&table, order, width, net.dim_out(), wanted, part, n);
    }
}

/// Derivatives of a curve, a net of one column, at scattered parameters: (order + 1, n, dim).
pub fn curve_points(net: &Net, knots: &Knots, u: &[f64], order: usize) -> Result<Vec<f64>> {
    knots.check("u", u)?;
    check_order(order)?;
    let dim = net.dim_out();
    let mut out = zeroed::<f64>((order + 1) * u.len() * dim);
    let wanted: Vec<Derivative> = (0..=order).map(|k| Derivative { u: k, v: 0, slot: k }).collect();
    let c = binomials(order);
    let parts = split(&mut out, &wanted, u.len() * dim, CHUNK * dim);
    parts
        .into_par_iter()
        .zip(u.par_chunks(CHUNK))
        .for_each(|(mut part, u)| curve_chunk(net, knots, u, order, &mut part, &c));
    Ok(out)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn curve_chunk(net: &Net, knots: &Knots, u: &[f64], order: usize, part: &mut [&mut [f64]], c: &[Vec<f64>]) {
    let p = knots.degree();
    let (width, dim) = (net.blocks * LANES, net.dim_out());
    let mut basis = vec![0.0; (order + 1) * (p + 1)];
    let mut table = vec![0.0; (order + 1) * width];
    // A curve's table has one column: rows of `order + 1` entries would be those of a surface.
    let mut square = vec![0.0; (order + 1) * (order + 1) * width];
    for n in 0..u.len() {
        let span = knots.span(u[n]);
        if p <= TABLED && order <= 2 {
            let (_first, rows) = knots.tabled::<2>(u[n]);
            for k in 0..=order {
                basis[k * (p + 1)..][..p + 1].copy_from_slice(&rows[k][..p + 1]);
            }
        } else {
            knots.basis(span, u[n], order, &mut basis);
        }
        table.fill(0.0);
        for k in 0..=order {
            for r in 0..=p {
                let factor = basis[k * (p + 1) + r];
                for b in 0..net.blocks {
                    let point = &net.values[(span - p + r) * net.stride + b];
                    let to = &mut table[k * width + b * LANES..][..LANES];
                    for x in 0..LANES {
                        to[x] = point[x].mul_add(factor, to[x]);
                    }
                }
            }
        }
        if net.rational {
            for k in 0..=order {
                square[k * (order + 1) * width..][..width].copy_from_slice(&table[k * width..][..width]);
            }
            dehomogenise(&mut square, order, 0, width, net.dim, c);
            for k in 0..=order {
                table[k * width..][..width].copy_from_slice(&square[k * (order + 1) * width..][..width]);
            }
        }
        for (k, row) in part.iter_mut().enumerate() {
            row[n * dim..(n + 1) * dim].copy_from_slice(&table[k * width..][..dim]);
        }
    }
}

/// Derivatives on the grid of all pairs: (order + 1, order + 1, nu, nv, dim). Each direction's basis is computed once.
pub fn surface_grid(net: &Net, knots: [&Knots; 2], u: &[f64], v: &[f64], order: usize) -> Result<Vec<f64>> {
    knots[0].check("u", u)?;
    knots[1].check("v", v)?;
    let dim = net.dim_out();
    let wanted = triangle(order)?;
    let size = u.len() * v.len() * dim;
    let mut out = zeroed::<f64>((order + 1) * (order + 1) * size);
    if size == 0 {
        return Ok(out);
    }
    let c = binomials(order);
    let rows = Rows::new(knots[0], u, order);
    let columns = Rows::new(knots[1], v, order);
    let parts = split(&mut out, &wanted, size, v.len() * dim);
    parts.into_par_iter().enumerate().for_each_init(
        || (Vec::new(), Vec::new()),
        |(lines, table), (n, mut part)| grid_row(net, &rows, &columns, n, order, &wanted, &mut part, lines, table, &c),
    );
    Ok(out)
}

/// First function and basis table, padded to at least [`LANES`] columns, for each parameter of an axis.
struct Rows {
    count: usize,
    columns: usize,
    first: Vec<usize>,
    basis: Vec<f64>,
}

impl Rows {
    fn new(knots: &Knots, at: &[f64], order: usize) -> Self {
        let functions = knots.degree() + 1;
        let columns = functions.max(LANES);
        let mut basis = vec![0.0; at.len() * (order + 1) * columns];
        let mut own = vec![0.0; (order + 1) * functions];
        let mut first = Vec::with_capacity(at.len());
        for (&u, rows) in at.iter().zip(basis.chunks_exact_mut((order + 1) * columns)) {
            let span = knots.span(u);
            knots.basis(span, u, order, &mut own);
            for (row, own) in rows.chunks_exact_mut(columns).zip(own.chunks_exact(functions)) {
                row[..functions].copy_from_slice(own);
            }
            first.push(span - knots.degree());
        }
        Self { count: knots.count(), columns, first, basis }
    }

    #[inline(always)]
    fn basis(&self, n: usize, order: usize) -> &[f64] {
        let size = (order + 1) * self.columns;
        &self.basis[n * size..][..size]
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx2+fma+bmi2", "x86_64+avx2+fma+bmi2", "aarch64+neon"))]
fn grid_row(
    net: &Net,
    rows: &Rows,
    columns: &Rows,
    n: usize,
    order: usize,
    wanted: &[Derivative],
    part: &mut [&mut [f64]],
    lines: &mut Vec<[f64; LANES]>,
    table: &mut Vec<f64>,
    c: &[Vec<f64>],
) {
    let (width, dim) = (net.blocks * LANES, net.dim_out());
    // Curves along v: one for each order along u, with room for a padded last block.
    let length = (columns.count + TABLED) * net.blocks;
    lines.clear();
    lines.resize((order + 1) * length, [0.0; LANES]);
    let nu = rows.basis(n, order);
    let functions = rows.columns.min(rows.count + TABLED - rows.first[n]);
    for k in 0..=order {
        let line = &mut lines[k * length..][..length];
        for r in 0..functions {
            let factor = nu[k * rows.columns + r];
            if factor != 0.0 {
                for (to, p) in line.iter_mut().zip(&net.values[(rows.first[n] + r) * net.stride..][..length]) {
                    for x in 0..LANES {
                        to[x] = p[x].mul_add(factor, to[x]);
                    }
                }
            }
        }
    }
    if net.blocks == 1 && columns.columns == LANES && !net.rational {
        for (d, row) in wanted.iter().zip(part) {
            let line = &lines[d.u * length..][..length];
            for (m, out) in row.chunks_exact_mut(dim).enumerate() {
                let points = &line[columns.first[m]..][..LANES];
                let nv = &columns.basis(m, order)[d.v * LANES..][..LANES];
                let mut sum = [0.0; LANES];
                for s in 0..LANES {
                    for x in 0..LANES {
                        sum[x] = points[s][x].mul_add(nv[s], sum[x]);
                    }
                }
                out.copy_from_slice(&sum[..dim]);
            }
        }
        return;
    }
    table.clear();
    table.resize((order + 1) * (order + 1) * width, 0.0);
    for m in 0..columns.first.len() {
        let nv = columns.basis(m, order);
        table.fill(0.0);
        for d in triangle_of(order) {
            for b in 0..net.blocks {
                let to = &mut table[(d.0 * (order + 1) + d.1) * width + b * LANES..][..LANES];
                for s in 0..columns.columns.min(columns.count + TABLED - columns.first[m]) {
                    let p = &lines[d.0 * length + (columns.first[m] + s) * net.blocks + b];
                    for x in 0..LANES {
                        to[x] = p[x].mul_add(nv[d.1 * columns.columns + s], to[x]);
                    }
                }
            }
        }
        if net.rational {
            dehomogenise(table, order, order, width, net.dim, c);
        }
        store(table, order, width, dim, wanted, part, m);
    }
}

fn triangle_of(order: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..=order).flat_map(move |k| (0..=order - k).map(move |l| (k, l)))
}
