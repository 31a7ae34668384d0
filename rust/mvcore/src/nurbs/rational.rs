//! From derivatives of homogeneous coordinates to those of the shape (A4.2, A4.4; what eqs 30-31 of the paper mean).

/// Binomial coefficients up to `order`, row by row.
pub(super) fn binomials(order: usize) -> Vec<Vec<f64>> {
    let mut rows: Vec<Vec<f64>> = vec![vec![1.0]];
    for n in 1..=order {
        let above = &rows[n - 1];
        rows.push((0..=n).map(|k| if k == 0 || k == n { 1.0 } else { above[k - 1] + above[k] }).collect());
    }
    rows
}

/// In place: `table` holds `(order + 1)²` entries of `width` values, of which `dim - 1` coordinates and then the weight count.
///
/// S(k,l) = (A(k,l) - Σ C(k,i) C(l,j) w(i,j) S(k-i,l-j)) / w over all (i,j) ≠ (0,0), for k + l <= order (A4.4).
#[inline(always)]
pub(super) fn dehomogenise(table: &mut [f64], order: usize, last: usize, width: usize, dim: usize, c: &[Vec<f64>]) {
    let w = |table: &[f64], i: usize, j: usize| table[(i * (order + 1) + j) * width + dim - 1];
    let inverse = 1.0 / w(table, 0, 0);
    for k in 0..=order {
        for l in 0..=(order - k).min(last) {
            for i in 0..=k {
                for j in 0..=l {
                    if i + j == 0 {
                        continue;
                    }
                    let factor = c[k][i] * c[l][j] * w(table, i, j);
                    let from = ((k - i) * (order + 1) + l - j) * width;
                    let to = (k * (order + 1) + l) * width;
                    for x in 0..dim - 1 {
                        table[to + x] -= factor * table[from + x];
                    }
                }
            }
            for x in 0..dim - 1 {
                table[(k * (order + 1) + l) * width + x] *= inverse;
            }
        }
    }
}
