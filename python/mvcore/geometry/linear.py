"""Linear algebra whose last digits depend on no number of threads: LAPACK and BLAS cut large systems and sums as threads come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def solve(matrix: Float, vector: Float) -> Float:
    """x of ``matrix`` x = ``vector``, by Gaussian elimination with row pivots in a fixed order.

    Parameters
    ----------
    matrix : (n, n), not singular; n of up to some thousands. vector : (n,) or (n, m).

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is singular.

    Examples
    --------
    >>> solve(np.array([[2.0, 0], [1, 1]]), np.array([4.0, 5])).tolist()
    [2.0, 3.0]
    """
    a, x = np.array(matrix, np.float64), np.array(vector, np.float64)
    n = len(a)
    for k in range(n):
        pivot = k + int(np.abs(a[k:, k]).argmax())
        if a[pivot, k] == 0:
            raise np.linalg.LinAlgError("singular matrix")
        a[[k, pivot]], x[[k, pivot]] = a[[pivot, k]], x[[pivot, k]]
        factor = a[k + 1 :, k] / a[k, k]
        a[k + 1 :, k:] -= factor[:, None] * a[k, k:]
        x[k + 1 :] -= np.multiply.outer(factor, x[k])
    for k in range(n - 1, -1, -1):
        x[k] /= a[k, k]
        x[:k] -= np.multiply.outer(a[:k, k], x[k])
    return x


def weighted_sum(rows: Float, weights: Float) -> Float:
    """Σ weights[n] rows[n], (m,), of rows (n, m): `rows.T @ weights` in a fixed order."""
    return np.asarray(np.einsum("nm,n->m", rows, weights))
