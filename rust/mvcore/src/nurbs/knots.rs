//! Knot vectors: spans (A2.1), basis functions (A2.2) and their derivatives (A2.3).

use crate::error::{Result, require};

/// Largest degree; scratch arrays are this long.
pub const MAX_DEGREE: usize = 15;
/// Degrees up to here are evaluated from a table of polynomials, four at a time.
pub(super) const TABLED: usize = LANES - 1;
/// Values in a SIMD row.
pub(super) const LANES: usize = 4;
const CELLS_A_SPAN: usize = 4;

/// A checked knot vector of `count + degree + 1` values; the domain is `[t_degree, t_count]`, closed at both ends.
#[derive(Debug, Clone)]
pub struct Knots {
    degree: usize,
    count: usize,
    values: Vec<f64>,
    /// Span at the start of each of many equal cells of the domain.
    cells: Vec<u32>,
    /// Cells a unit of the parameter.
    scale: f64,
    /// For each span its middle, the inverse of its width, and the basis as a polynomial around the middle.
    table: Vec<Polynomials>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Polynomials {
    middle: f64,
    inverse: f64,
    /// `[power][function]` of the local coordinate (u - middle) / width.
    terms: [[f64; LANES]; LANES],
}

impl Knots {
    /// Checks that `values` are finite, ascending, of the right number for `count` control points, with a domain and with no knot
    /// repeated more than `degree + 1` times. `argument` names them in errors.
    pub fn new(argument: &'static str, values: &[f64], count: usize) -> Result<Self> {
        require(
            values.len() >= count.saturating_add(2) && count >= 2,
            argument,
            format!("at least {} values for {count} control points", count.saturating_add(2)),
            values.len(),
        )?;
        let degree = values.len() - count - 1;
        require(degree <= MAX_DEGREE, argument, format!("a degree of at most {MAX_DEGREE}"), degree)?;
        require(
            degree < count,
            argument,
            format!("more control points than the degree {degree} = knots - control points - 1"),
            count,
        )?;
        require(values.iter().all(|t| t.is_finite()), argument, "finite values", "NaN or infinity")?;
        let bad = values.windows(2).position(|t| t[1] < t[0]);
        require(
            bad.is_none(),
            argument,
            "ascending values",
            bad.map_or(String::new(), |i| format!("{} after {}", values[i + 1], values[i])),
        )?;
        let repeated = values.windows(degree + 2).find(|t| t[0] == t[degree + 1]);
        require(
            repeated.is_none(),
            argument,
            format!("no knot repeated more than {} times", degree + 1),
            repeated.map_or(0.0, |t| t[0]),
        )?;
        let domain = (values[degree], values[count]);
        require(domain.0 < domain.1, argument, "a domain of some length", format!("{:?} to {:?}", domain.0, domain.1))?;
        let mut knots =
            Self { degree, count, values: values.to_vec(), cells: Vec::new(), scale: 0.0, table: Vec::new() };
        knots.index();
        if degree <= TABLED {
            knots.table = (0..count).map(|span| knots.polynomials(span)).collect();
        }
        Ok(knots)
    }

    /// Polynomial degree.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Number of control points.
    pub fn count(&self) -> usize {
        self.count
    }

    /// First and last parameter.
    pub fn domain(&self) -> (f64, f64) {
        (self.values[self.degree], self.values[self.count])
    }

    /// Fails unless all parameters lie in the domain.
    pub fn check(&self, argument: &'static str, parameters: &[f64]) -> Result<()> {
        let (low, high) = self.domain();
        let outside = parameters.iter().find(|&&u| !(low <= u && u <= high));
        require(
            outside.is_none(),
            argument,
            format!("values within {low:?} .. {high:?}"),
            outside.copied().unwrap_or(0.0),
        )
    }

    fn index(&mut self) {
        let (low, high) = self.domain();
        let cells = CELLS_A_SPAN * (self.count - self.degree);
        self.scale = cells as f64 / (high - low);
        let mut span = self.degree;
        self.cells = (0..cells)
            .map(|cell| {
                // A cell may begin a rounding error later than computed: start one step earlier.
                let start = low + (cell as f64 - 0.01) / self.scale;
                while span + 1 < self.count && self.values[span + 1] <= start {
                    span += 1;
                }
                span as u32
            })
            .collect();
        // A span of no width before the end is never the last one.
        let last = self.last();
        for cell in &mut self.cells {
            *cell = (*cell).min(last as u32);
        }
    }

    /// The last span of some width.
    fn last(&self) -> usize {
        let high = self.values[self.count];
        let mut span = self.count - 1;
        while self.values[span] == high {
            span -= 1;
        }
        span
    }

    /// Span `i` with `t_i <= u < t_(i+1)`; the last knot belongs to the last span (A2.1). `u` must lie in the domain.
    #[inline(always)]
    pub fn span(&self, u: f64) -> usize {
        let cell = ((u - self.values[self.degree]) * self.scale) as usize;
        let mut span = self.cells[cell.min(self.cells.len() - 1)] as usize;
        while span + 1 < self.count && self.values[span + 1] <= u {
            span += 1;
        }
        // At the right end, or where the last knots fall together inside the domain, step back to a span of some width.
        while self.values[span] >= self.values[span + 1] {
            span -= 1;
        }
        span
    }

    fn polynomials(&self, span: usize) -> Polynomials {
        let (a, b) = (self.values[span], self.values[span + 1]);
        if span < self.degree || b <= a {
            return Polynomials::default();
        }
        let middle = 0.5 * (a + b);
        let mut derivatives = [0.0; LANES * LANES];
        self.basis(span, middle, self.degree, &mut derivatives);
        let mut terms = [[0.0; LANES]; LANES];
        let (mut factorial, mut width) = (1.0, 1.0);
        for (power, row) in terms.iter_mut().enumerate().take(self.degree + 1) {
            for (function, term) in row.iter_mut().enumerate().take(self.degree + 1) {
                *term = derivatives[power * (self.degree + 1) + function] * width / factorial;
            }
            factorial *= (power + 1) as f64;
            width *= b - a;
        }
        Polynomials { middle, inverse: 1.0 / (b - a), terms }
    }

    /// Values and the first `ORDER` derivatives of the `degree + 1` non-zero functions, padded with zeros: degrees up to [`TABLED`].
    #[inline(always)]
    pub(super) fn tabled<const ORDER: usize>(&self, u: f64) -> (usize, [[f64; LANES]; 3]) {
        let span = self.span(u);
        let p = &self.table[span];
        let x = (u - p.middle) * p.inverse;
        let [c0, c1, c2, c3] = &p.terms;
        let mut out = [[0.0; LANES]; 3];
        for i in 0..LANES {
            out[0][i] = c3[i].mul_add(x, c2[i]).mul_add(x, c1[i]).mul_add(x, c0[i]);
            if ORDER >= 1 {
                out[1][i] = (3.0 * c3[i]).mul_add(x, 2.0 * c2[i]).mul_add(x, c1[i]) * p.inverse;
            }
            if ORDER >= 2 {
                out[2][i] = (6.0 * c3[i]).mul_add(x, 2.0 * c2[i]) * (p.inverse * p.inverse);
            }
        }
        (span - self.degree, out)
    }

    /// Values and derivatives up to `order` of the functions `span - degree ..= span` at `u`, row by row (A2.2, A2.3).
    pub fn basis(&self, span: usize, u: f64, order: usize, out: &mut [f64]) {
        let p = self.degree;
        let t = &self.values;
        const N: usize = MAX_DEGREE + 1;
        let mut ndu = [[0.0; N]; N];
        let (mut left, mut right) = ([0.0; N], [0.0; N]);
        ndu[0][0] = 1.0;
        for j in 1..=p {
            left[j] = u - t[span + 1 - j];
            right[j] = t[span + j] - u;
            let mut saved = 0.0;
            for r in 0..j {
                ndu[j][r] = right[r + 1] + left[j - r];
                let term = ndu[r][j - 1] / ndu[j][r];
                ndu[r][j] = saved + right[r + 1] * term;
                saved = left[j - r] * term;
            }
            ndu[j][j] = saved;
        }
        out[..(order + 1) * (p + 1)].fill(0.0);
        for j in 0..=p {
            out[j] = ndu[j][p];
        }
        for r in 0..=p {
            let mut a = [[0.0; N]; 2];
            let (mut now, mut next) = (0, 1);
            a[0][0] = 1.0;
            let mut factor = p as f64;
            for k in 1..=order.min(p) {
                let mut d = 0.0;
                let low = p - k;
                if r >= k {
                    a[next][0] = a[now][0] / ndu[low + 1][r - k];
                    d = a[next][0] * ndu[r - k][low];
                }
                let first = if r + 1 >= k { 1 } else { k - r };
                let last = if r <= low + 1 { k - 1 } else { p - r };
                for j in first..=last {
                    a[next][j] = (a[now][j] - a[now][j - 1]) / ndu[low + 1][r + j - k];
                    d += a[next][j] * ndu[r + j - k][low];
                }
                if r <= low {
                    a[next][k] = -a[now][k - 1] / ndu[low + 1][r];
                    d += a[next][k] * ndu[r][low];
                }
                out[k * (p + 1) + r] = d * factor;
                factor *= low as f64;
                std::mem::swap(&mut now, &mut next);
            }
        }
    }

    /// From gradients with respect to the basis values at `u` adds those with respect to the knots: A2.2 run backwards.
    pub(super) fn basis_adjoint(&self, span: usize, u: f64, gradient: &[f64], out: &mut [f64]) {
        let p = self.degree;
        let t = &self.values;
        const N: usize = MAX_DEGREE + 1;
        let (mut left, mut right) = ([0.0; N], [0.0; N]);
        let mut levels = [[0.0; N]; N];
        levels[0][0] = 1.0;
        for j in 1..=p {
            left[j] = u - t[span + 1 - j];
            right[j] = t[span + j] - u;
            let mut saved = 0.0;
            for r in 0..j {
                let term = levels[j - 1][r] / (right[r + 1] + left[j - r]);
                levels[j][r] = saved + right[r + 1] * term;
                saved = left[j - r] * term;
            }
            levels[j][j] = saved;
        }
        let mut above = [0.0; N];
        above[..=p].copy_from_slice(&gradient[..=p]);
        let (mut to_left, mut to_right) = ([0.0; N], [0.0; N]);
        for j in (1..=p).rev() {
            let mut below = [0.0; N];
            for r in 0..j {
                let width = right[r + 1] + left[j - r];
                let term = levels[j - 1][r] / width;
                let to_term = right[r + 1] * above[r] + left[j - r] * above[r + 1];
                let to_width = -to_term * term / width;
                below[r] = to_term / width;
                to_right[r + 1] += term * above[r] + to_width;
                to_left[j - r] += term * above[r + 1] + to_width;
            }
            above = below;
        }
        for j in 1..=p {
            out[span + 1 - j] -= to_left[j];
            out[span + j] += to_right[j];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A knot vector of a degree with some repeated interior knots.
    pub fn knot_vectors() -> impl Strategy<Value = (Vec<f64>, usize)> {
        (1usize..=9, prop::collection::vec((0.01f64..1.0, 1usize..3), 1..8), any::<bool>()).prop_map(
            |(p, steps, clamped)| {
                let mut t = vec![0.0];
                for (step, times) in steps {
                    let next = t[t.len() - 1] + step;
                    t.extend(std::iter::repeat_n(next, times.min(p)));
                }
                let end = t[t.len() - 1] + 0.5;
                let mut all: Vec<f64> =
                    (0..p).map(|i| if clamped { 0.0 } else { (i as f64 - p as f64) * 0.3 }).collect();
                all.extend(&t);
                all.extend((0..=p).map(|i| if clamped { end } else { end + i as f64 * 0.2 }));
                let count = all.len() - p - 1;
                (all, count)
            },
        )
    }

    proptest! {
        #[test]
        fn basis_is_a_partition_of_unity((t, count) in knot_vectors(), at in 0.0f64..=1.0) {
            let knots = Knots::new("knots", &t, count).unwrap();
            let (low, high) = knots.domain();
            for u in [low, low + (high - low) * at, high].map(|u| u.min(high)) {
                let span = knots.span(u);
                prop_assert!(t[span] <= u && u <= t[span + 1] && t[span] < t[span + 1]);
                prop_assert!(u < t[span + 1] || u == high);
                let p = knots.degree();
                let mut out = vec![0.0; 3 * (p + 1)];
                knots.basis(span, u, 2, &mut out);
                prop_assert!((out[..=p].iter().sum::<f64>() - 1.0).abs() < 1e-13);
                prop_assert!(out[..=p].iter().all(|&v| v >= 0.0));
                let scale = out[p + 1..].iter().fold(1.0f64, |m, v| m.max(v.abs()));
                for k in 1..=2 {
                    prop_assert!(out[k * (p + 1)..][..=p].iter().sum::<f64>().abs() < 1e-12 * scale);
                }
                if p <= TABLED {
                    let (first, rows) = knots.tabled::<2>(u);
                    prop_assert_eq!(first, span - p);
                    for k in 0..3 {
                        for i in 0..=p {
                            prop_assert!((rows[k][i] - out[k * (p + 1) + i]).abs() < 1e-12 * scale);
                        }
                    }
                }
            }
        }

        #[test]
        fn basis_adjoint_is_the_derivative((t, count) in knot_vectors(), at in 0.05f64..0.95, which in 0usize..20) {
            let knots = Knots::new("knots", &t, count).unwrap();
            let (low, high) = knots.domain();
            let p = knots.degree();
            let u = low + (high - low) * at;
            let span = knots.span(u);
            let gradient: Vec<f64> = (0..=p).map(|i| ((i * 7 + 3) % 5) as f64 - 2.0).collect();
            let mut got = vec![0.0; t.len()];
            knots.basis_adjoint(span, u, &gradient, &mut got);
            let k = which % t.len();
            let room = (u - t[span]).min(t[span + 1] - u);
            let h = 1e-6;
            prop_assume!(room > 1e-3);
            let value = |d: f64| {
                let mut moved = knots.clone();
                moved.values[k] += d;
                let mut out = vec![0.0; p + 1];
                moved.basis(span, u, 0, &mut out);
                out.iter().zip(&gradient).map(|(a, b)| a * b).sum::<f64>()
            };
            let wanted = (value(h) - value(-h)) / (2.0 * h);
            prop_assert!((got[k] - wanted).abs() < 1e-5 * (1.0 + wanted.abs()), "{} {}", got[k], wanted);
        }
    }

    #[test]
    fn wrong_knots_are_named() {
        for (values, count, word) in [
            (vec![0.0, 0.0, 1.0], 2, "at least"),
            (vec![0.0, 0.0, 2.0, 1.0, 3.0, 3.0], 4, "ascending"),
            (vec![0.0, 0.0, f64::NAN, 1.0], 2, "finite"),
            (vec![0.0, 0.0, 0.0, 0.0, 1.0, 1.0], 4, "repeated"),
            (vec![0.0; 8], 4, "repeated"),
            (vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 2, "more control points"),
        ] {
            let error = Knots::new("knots_u", &values, count).unwrap_err().to_string();
            assert!(error.starts_with("knots_u") && error.contains(word), "{error}");
        }
    }
}
