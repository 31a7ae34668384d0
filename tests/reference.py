"""Slow, readable NumPy twins of the kernels."""

import numpy as np


def project(k, r, t, points):
    q = (points @ r.T + t) @ k.T
    return q[:, :2] / q[:, 2:], q[:, 2]


def tsdf(grid_points, depths, cameras, truncation, free_weight):
    """Mean of clamp(depth - z, -τ, τ) / τ over the views, nearest pixel; NaN where never seen."""
    total, weight = np.zeros(len(grid_points)), np.zeros(len(grid_points))
    for depth, c in zip(depths, cameras):
        x, z = project(c.K, c.R, c.t, grid_points)
        i = np.rint(x).astype(int)
        inside = (i[:, 0] >= 0) & (i[:, 1] >= 0) & (i[:, 0] < c.width) & (i[:, 1] < c.height) & (z > 0)
        d = np.zeros(len(z))
        d[inside] = depth[i[inside, 1], i[inside, 0]]
        distance = (d - z) / truncation
        w = np.where((d > 0) & (distance >= -1), np.where(distance > 1, free_weight, 1.0), 0.0)
        total += w * np.clip(distance, -1, 1)
        weight += w
    with np.errstate(invalid="ignore"):
        return np.where(weight > 0, total / weight, np.nan)


def consistency(depth, others, cameras, pixel_unit, depth_unit, min_views):
    """The dynamic rule and the majority of the witnesses, nearest sampling; ``cameras[0]`` is the reference's."""
    reference = cameras[0]
    kept = np.zeros_like(depth)
    for y, x in zip(*np.nonzero(depth > 0)):
        z = depth[y, x]
        point = reference.unproject([[x, y]], [z])
        votes = []
        for other, c in zip(others, cameras[1:]):
            q = c.project(point)[0]
            i = np.rint(q).astype(int)
            if not (0 <= q[0] <= c.width - 1 and 0 <= q[1] <= c.height - 1) or other[i[1], i[0]] <= 0:
                continue
            there = other[i[1], i[0]]
            if there < 0.99 * c.to_camera(point)[0, 2]:
                continue  # its surface hides the point
            surface = c.unproject([q], [there])
            pixels = np.hypot(*(reference.project(surface)[0] - [x, y]))
            votes.append(max(pixels / pixel_unit, abs(reference.to_camera(surface)[0, 2] - z) / (z * depth_unit)))
        rule = any(sum(v < n for v in votes) >= n for n in range(min_views, 11))
        agreeing = sum(v < 3 for v in votes)
        if rule or (agreeing >= min_views and 2 * agreeing >= len(votes)):
            kept[y, x] = z
    return kept


def carve(origin, voxel, shape, masks, projections, tolerance, least_views):
    """Votes of every view on every voxel, nearest pixel."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    points = np.asarray(origin) + voxel * index
    seen, against = np.zeros(len(points), int), np.zeros(len(points), int)
    for mask, p in zip(masks, projections):
        q = points @ p[:, :3].T + p[:, 3]
        x = np.rint(q[:, :2] / q[:, 2:]).astype(int)
        inside = (q[:, 2] > 0) & (x >= 0).all(1) & (x < mask.shape[::-1]).all(1)
        seen += inside
        against[inside] += mask[x[inside, 1], x[inside, 0]] == 0
    return ((seen >= least_views) & (against <= tolerance * seen)).reshape(shape)


def weighted_median(values, guide, doubtful, radius, step, colour, distance, slack):
    """Each pixel's median of the window under weights by colour and distance; NaN is unknown."""
    h, w = values.shape
    out = values.copy()
    steps = np.arange(-(radius // step), radius // step + 1) * step
    for y in range(h):
        for x in range(w):
            j, i = (a.ravel() for a in np.meshgrid(y + steps, x + steps, indexing="ij"))
            inside = (j >= 0) & (j < h) & (i >= 0) & (i < w)
            j, i = j[inside], i[inside]
            known = ~np.isnan(values[j, i])
            j, i = j[known], i[known]
            if len(j) == 0:
                continue
            differ = np.abs(guide[j, i].astype(float) - guide[y, x]).mean(1)
            weight = np.exp(-differ / colour - np.hypot(j - y, i - x) / distance)
            order = np.argsort(values[j, i], kind="stable")
            sums = np.cumsum(weight[order])
            median = values[j, i][order][np.searchsorted(sums, 0.5 * sums[-1])]
            if doubtful[y, x] or np.isnan(values[y, x]) or abs(median - values[y, x]) > slack:
                out[y, x] = median
    return out


def best_views(qualities, colours, slots):
    """Of (V, F) qualities and (V, F, 3) colours the best ``slots`` views of each face: a list of {view: (quality, colour)}."""
    lists = []
    for f in range(qualities.shape[1]):
        order = sorted(np.flatnonzero(qualities[:, f]), key=lambda v: (-qualities[v, f], v))[:slots]
        lists.append({int(v): (qualities[v, f], tuple(colours[v, f])) for v in order})
    return lists


def compare_views(lists):
    """{(a, b): (faces, median log ratio a / b)} over faces that are neither dark nor saturated in both."""
    ratios = {}
    for views in lists:
        usable = {v: np.log(np.float32(c)) for v, (_, c) in views.items() if min(c) > 12 and max(c) < 245}
        for a in usable:
            for b in usable:
                if a < b:
                    ratios.setdefault((a, b), []).append(usable[a] - usable[b])
    return {pair: (len(r), np.median(r, axis=0)) for pair, r in ratios.items()}


def outliers(views, gains, outlier):
    """Views of one face whose colour, gains applied, is far from the upper median of at least three."""
    if len(views) < 3:
        return set()
    levels = {v: np.float32(c) * gains[v] for v, (_, c) in views.items()}
    median = np.sort(np.array(list(levels.values())), axis=0)[len(levels) // 2]
    return {v for v, level in levels.items() if (np.abs(level - median) > outlier).any()}
