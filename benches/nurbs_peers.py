"""NURBS evaluation and its adjoint beside a hand-written numba twin, SciPy, splinepy, geomdl and torch: medians and ratios.

    python benches/nurbs_peers.py

One process, one input: a bicubic 50 x 50 control net of three coordinates. Peers that are not
installed are left out; slow ones get a share of the points and their time is scaled up. Threads: RAYON_NUM_THREADS and NUMBA_NUM_THREADS.
"""

import numpy as np
from mvcore import nurbs
from peers import line, median

COUNT, POINTS, SIDE = 50, 1_000_000, 1000


def numba_twins():
    import numba

    @numba.njit(inline="always")
    def basis(t, u, n, out):
        span = 3
        low, high = 3, n
        if u >= t[n]:
            span = n - 1
        else:
            while high - low > 1:
                middle = (low + high) // 2
                if u < t[middle]:
                    high = middle
                else:
                    low = middle
            span = low
        ndu = np.zeros((4, 4))
        left, right = np.zeros(4), np.zeros(4)
        ndu[0, 0] = 1.0
        for j in range(1, 4):
            left[j] = u - t[span + 1 - j]
            right[j] = t[span + j] - u
            saved = 0.0
            for r in range(j):
                ndu[j, r] = right[r + 1] + left[j - r]
                term = ndu[r, j - 1] / ndu[j, r]
                ndu[r, j] = saved + right[r + 1] * term
                saved = left[j - r] * term
            ndu[j, j] = saved
        for j in range(4):
            out[0, j] = ndu[j, 3]
        # First and second derivatives from the functions of lower degree.
        d2a, d2b = ndu[0, 1] / ndu[2, 0], ndu[1, 1] / ndu[2, 1]
        q0, q1, q2 = ndu[0, 2] / ndu[3, 0], ndu[1, 2] / ndu[3, 1], ndu[2, 2] / ndu[3, 2]
        out[1, 0], out[1, 1], out[1, 2], out[1, 3] = -3 * q0, 3 * (q0 - q1), 3 * (q1 - q2), 3 * q2
        s0, s1, s2 = -2 * d2a / ndu[3, 0], 2 * (d2a - d2b) / ndu[3, 1], 2 * d2b / ndu[3, 2]
        out[2, 0], out[2, 1], out[2, 2], out[2, 3] = -3 * s0, 3 * (s0 - s1), 3 * (s1 - s2), 3 * s2
        return span - 3

    @numba.njit(parallel=True, fastmath=True)
    def scattered(p, t, u, v):
        n = p.shape[0]
        out = np.empty((6, u.shape[0], 3))
        for m in numba.prange(u.shape[0]):
            bu, bv = np.empty((3, 4)), np.empty((3, 4))
            i, j = basis(t, u[m], n, bu), basis(t, v[m], n, bv)
            total = np.zeros((6, 3))
            for r in range(4):
                along = np.zeros((3, 3))
                for s in range(4):
                    for k in range(3):
                        for x in range(3):
                            along[k, x] += bv[k, s] * p[i + r, j + s, x]
                for x in range(3):
                    total[0, x] += bu[0, r] * along[0, x]
                    total[1, x] += bu[0, r] * along[1, x]
                    total[2, x] += bu[0, r] * along[2, x]
                    total[3, x] += bu[1, r] * along[0, x]
                    total[4, x] += bu[1, r] * along[1, x]
                    total[5, x] += bu[2, r] * along[0, x]
            for k in range(6):
                for x in range(3):
                    out[k, m, x] = total[k, x]
        return out

    @numba.njit(parallel=True, fastmath=True)
    def grid(p, t, u, v):
        n = p.shape[0]
        fu, fv = np.empty(u.shape[0], np.int64), np.empty(v.shape[0], np.int64)
        bu, bv = np.empty((u.shape[0], 3, 4)), np.empty((v.shape[0], 3, 4))
        for m in range(u.shape[0]):
            fu[m] = basis(t, u[m], n, bu[m])
        for m in range(v.shape[0]):
            fv[m] = basis(t, v[m], n, bv[m])
        out = np.empty((u.shape[0], v.shape[0], 3))
        for a in numba.prange(u.shape[0]):
            row = np.zeros((n, 3))
            for r in range(4):
                for j in range(n):
                    for x in range(3):
                        row[j, x] += bu[a, 0, r] * p[fu[a] + r, j, x]
            for b in range(v.shape[0]):
                for x in range(3):
                    total = 0.0
                    for s in range(4):
                        total += bv[b, 0, s] * row[fv[b] + s, x]
                    out[a, b, x] = total
        return out

    @numba.njit(parallel=True, fastmath=True)
    def adjoint(g, t, u, v, n):
        threads = numba.get_num_threads()
        nets = np.zeros((threads, n, n, 3))
        size = (u.shape[0] + threads - 1) // threads
        for k in numba.prange(threads):
            bu, bv = np.empty((3, 4)), np.empty((3, 4))
            for m in range(k * size, min(u.shape[0], (k + 1) * size)):
                i, j = basis(t, u[m], n, bu), basis(t, v[m], n, bv)
                for r in range(4):
                    for s in range(4):
                        w = bu[0, r] * bv[0, s]
                        for x in range(3):
                            nets[k, i + r, j + s, x] += w * g[m, x]
        return nets.sum(0)

    return scattered, grid, adjoint


def main():
    random = np.random.default_rng(0)
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, COUNT - 2), np.ones(3)])
    control = random.random((COUNT, COUNT, 3))
    surface = nurbs.Surface(control, knots, knots)
    u, v = random.random((2, POINTS))
    both = np.stack([u, v], 1)
    axis = np.linspace(0, 1, SIDE)

    print(f"{POINTS} scattered points with first and second derivatives")
    ours, found = median(lambda: surface.derivatives(u, v, 2))
    line("mvcore", ours, ours)
    try:
        twin_points, twin_grid, twin_adjoint = numba_twins()
        twin_points(control, knots, u[:10], v[:10])
        seconds, theirs = median(lambda: twin_points(control, knots, u, v))
        line("numba twin", seconds, ours, f"largest difference {np.abs(theirs[4] - found[1, 1]).max() / np.abs(found[1, 1]).max():.1e}")
    except ImportError:
        twin_points = None
    from scipy.interpolate import NdBSpline, bisplev

    scipy = NdBSpline((knots, knots), control, 3)
    orders = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)]
    seconds, theirs = median(lambda: [scipy(both, nu=nu) for nu in orders], 1)
    line("SciPy NdBSpline", seconds, ours, f"largest difference {np.abs(theirs[4] - found[1, 1]).max() / np.abs(found[1, 1]).max():.1e}")
    try:
        import splinepy

        net = control.transpose(1, 0, 2).reshape(-1, 3)
        peer = splinepy.BSpline([3, 3], [knots.tolist()] * 2, net)
        seconds, _ = median(lambda: [peer.evaluate(both, nthreads=2)] + [peer.derivative(both, nu, nthreads=2) for nu in orders[1:]], 1)
        line("splinepy", seconds, ours)
    except ImportError:
        pass
    try:
        from geomdl import BSpline

        slow = BSpline.Surface(normalize_kv=False)
        slow.degree_u = slow.degree_v = 3
        slow.set_ctrlpts(control.reshape(-1, 3).tolist(), COUNT, COUNT)
        slow.knotvector_u = slow.knotvector_v = knots.tolist()
        seconds, _ = median(lambda: [slow.derivatives(a, b, order=2) for a, b in both[:500]], 1)
        line("geomdl (500 points, scaled)", seconds * POINTS / 500, ours)
    except ImportError:
        pass

    print(f"{SIDE} x {SIDE} grid")
    ours, found = median(lambda: surface.evaluate_grid(axis, axis))
    line("mvcore", ours, ours)
    if twin_points is not None:
        twin_grid(control, knots, axis[:3], axis[:3])
        seconds, theirs = median(lambda: twin_grid(control, knots, axis, axis))
        line("numba twin", seconds, ours, f"largest difference {np.abs(theirs - found).max():.1e}")
    from mvcore.nurbs.fit import collocation

    def product():
        rows = collocation(knots, COUNT, axis)
        across = np.tensordot(rows, control, ([1], [0]))
        return rows @ across

    seconds, _ = median(product)
    line("NumPy matrices", seconds, ours)
    seconds, _ = median(lambda: [bisplev(axis, axis, (knots, knots, control[..., k].ravel(), 3, 3)) for k in range(3)])
    line("FITPACK bisplev", seconds, ours)

    print("gradient of a million points to the control points")
    import torch
    from mvcore.nurbs import torch as differentiable

    g = random.random((POINTS, 3))
    tensors = [torch.from_numpy(x) for x in (knots, knots, u, v)]
    net = torch.from_numpy(control).requires_grad_()
    points = differentiable.evaluate_surface(net, *tensors)
    ours, found = median(lambda: torch.autograd.grad(points, net, torch.from_numpy(g), retain_graph=True)[0].numpy())
    line("mvcore", ours, ours)
    if twin_points is not None:
        twin_adjoint(g[:10], knots, u[:10], v[:10], COUNT)
        seconds, theirs = median(lambda: twin_adjoint(g, knots, u, v, COUNT))
        line("numba twin", seconds, ours, f"largest difference {np.abs(theirs - found).max() / np.abs(found).max():.1e}")
    from scipy.interpolate import BSpline as Basis
    from scipy.sparse import csr_array

    a, b = Basis.design_matrix(u, knots, 3), Basis.design_matrix(v, knots, 3)
    wu, wv = a.data.reshape(-1, 4), b.data.reshape(-1, 4)
    columns = (a.indices.reshape(-1, 4)[:, :, None] * COUNT + b.indices.reshape(-1, 4)[:, None]).ravel()
    matrix = csr_array(((wu[:, :, None] * wv[:, None]).ravel(), columns, np.arange(0, 16 * POINTS + 1, 16)), shape=(POINTS, COUNT**2))
    seconds, _ = median(lambda: matrix.T @ g, 3)
    line("SciPy sparse (matrix ready)", seconds, ours)


if __name__ == "__main__":
    main()
