"""NURBS: exact shapes, derivatives, equality with SciPy, geomdl and splinepy, edits, fits, files, gradients, bad input."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mvcore import InvalidInputError, nurbs
from mvcore.errors import FormatError
from mvcore.evaluation.metrics import nearest_distance
from mvcore.nurbs.fit import collocation

GRID = np.linspace(0, 1, 83)


def random_knots(random, degree, count):
    """Clamped or not, with some repeated inner knots."""
    inner = np.sort(random.choice(np.linspace(0.05, 0.95, 2 * count), count - degree - 1))
    for i in range(degree, len(inner)):
        if inner[i] == inner[i - degree]:
            inner[i:] += 1e-3
    if random.random() < 0.5:
        return np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])
    return np.concatenate([-np.arange(degree, -1, -1) * 0.1, inner, 1 + np.arange(degree + 1) * 0.2])


def random_surface(random, degree=(3, 2), counts=(7, 6), dim=3, rational=True):
    control = random.normal(size=(*counts, dim))
    weights = random.uniform(0.5, 2, counts) if rational else None
    return nurbs.Surface(control, random_knots(random, degree[0], counts[0]), random_knots(random, degree[1], counts[1]), weights)


def pairs(surface, count=60, seed=0):
    random = np.random.default_rng(seed)
    return [low + (high - low) * random.random(count) for low, high in surface.domain]


def test_conics_and_quadrics_are_exact():
    circle = nurbs.circle(3.0, center=(1, 2, 3))
    assert np.abs(np.linalg.norm(circle.evaluate(GRID) - [1, 2, 3], axis=1) - 3).max() < 1e-13
    assert np.abs(circle.curvature(GRID) - 1 / 3).max() < 1e-12
    assert abs(circle.arc_length() - 6 * np.pi) < 1e-11
    sphere = nurbs.sphere(2.0, center=(1, 2, 3))
    assert np.abs(np.linalg.norm(sphere.evaluate_grid(GRID, GRID) - [1, 2, 3], axis=2) - 2).max() < 1e-13
    p = nurbs.torus(3, 1).evaluate_grid(GRID, GRID)
    assert np.abs((np.hypot(p[..., 0], p[..., 1]) - 3) ** 2 + p[..., 2] ** 2 - 1).max() < 1e-13
    p = nurbs.ellipse(3, 2).evaluate(GRID)
    assert np.abs((p[:, 0] / 3) ** 2 + (p[:, 1] / 2) ** 2 - 1).max() < 1e-13
    p = nurbs.cylinder(2, 5, center=(0, 0, 1)).evaluate_grid(GRID, GRID)
    assert np.abs(np.hypot(p[..., 0], p[..., 1]) - 2).max() < 1e-13
    assert p[0, -1, 2] == 6
    half = nurbs.arc(0.2, 1.1, 2.0)
    assert abs(half.arc_length() - 2 * 0.9) < 1e-12


def test_normals_and_curvatures_of_a_sphere_and_a_torus():
    sphere, inner = nurbs.sphere(2.0), GRID[1:-1]
    u, v = (x.ravel() for x in np.meshgrid(inner, inner))
    gauss, mean = sphere.curvature(u, v)
    assert np.abs(gauss - 0.25).max() < 1e-11
    assert np.abs(np.abs(mean) - 0.5).max() < 1e-11
    assert np.abs(sphere.normal(u, v) - sphere.evaluate(u, v) / 2).max() < 1e-12
    assert np.abs(sphere.normal([0.3, 0.3], [0.0, 1.0]) - [[0, 0, -1], [0, 0, 1]]).max() < 1e-3
    torus = nurbs.torus(3, 1)
    p = torus.evaluate(u, v)
    cosine = np.hypot(p[:, 0], p[:, 1]) - 3
    assert np.abs(torus.curvature(u, v)[0] - cosine / (3 + cosine)).max() < 1e-9
    assert (np.einsum("ni,ni->n", torus.normal(u, v), p - p * [1, 1, 0] * (3 / np.hypot(p[:, :1], p[:, 1:2]))) > 0.99).all()


@pytest.mark.parametrize("degree", [1, 2, 3, 5, 9])
def test_partition_of_unity_at_both_ends_and_between(degree):
    random = np.random.default_rng(degree)
    for _ in range(5):
        knots = random_knots(random, degree, degree + 6)
        low, high = knots[degree], knots[degree + 6]
        basis = collocation(knots, degree + 6, np.append(np.linspace(low, high, 50), [low, high]).clip(low, high))
        assert np.abs(basis.sum(1) - 1).max() < 1e-14


@pytest.mark.parametrize(("degree", "rational"), [((3, 2), True), ((3, 3), False), ((5, 1), True), ((1, 4), False)])
def test_derivatives_to_order_4_against_central_differences(degree, rational):
    """Each derivative is the central difference of the one before it; the points are checked against SciPy elsewhere."""
    surface = random_surface(np.random.default_rng(1), degree, (degree[0] + 4, degree[1] + 4), rational=rational)
    h = 1e-6
    inside = [np.concatenate([b[:-1] + f * np.diff(b) for f in (0.2, 0.7)]) for b in surface.breaks]
    u, v = (x.ravel() for x in np.meshgrid(*inside))
    d = surface.derivatives(u, v, 4)
    up, down = surface.derivatives(u + h, v, 3), surface.derivatives(u - h, v, 3)
    right, left = surface.derivatives(u, v + h, 3), surface.derivatives(u, v - h, 3)
    for k in range(4):
        for j in range(4 - k):
            for got, wanted in ((d[k + 1, j], (up - down)[k, j] / (2 * h)), (d[k, j + 1], (right - left)[k, j] / (2 * h))):
                scale = np.abs(got).max() + np.abs(d[k, j]).max() + 1e-9
                assert np.abs(got - wanted).max() < 2e-5 * scale, (k, j)
    assert all((d[k, j] == 0).all() for k in range(5) for j in range(5) if k + j > 4)


def test_rational_derivatives_against_sympy():
    import sympy

    t = sympy.symbols("t")
    control, weights = [[0, 1], [1, 3], [2, -1], [4, 2]], [1, 2, sympy.Rational(1, 2), 3]
    basis = [sympy.binomial(3, i) * t**i * (1 - t) ** (3 - i) for i in range(4)]
    below = sum(w * b for w, b in zip(weights, basis, strict=True))
    curve = nurbs.Curve(control, [0, 0, 0, 0, 1, 1, 1, 1], weights=[float(w) for w in weights])
    got = curve.derivatives([0.3], 4)[:, 0]
    for axis in (0, 1):
        exact = sum(w * b * p[axis] for w, b, p in zip(weights, basis, control, strict=True)) / below
        for order in range(5):
            wanted = float(sympy.diff(exact, t, order).subs(t, sympy.Rational(3, 10)))
            assert abs(got[order, axis] - wanted) < 1e-11 * max(1, abs(wanted))


@given(seed=st.integers(0, 10_000), p=st.integers(1, 9), q=st.integers(1, 9), dim=st.integers(1, 6))
@settings(max_examples=40, deadline=None)
def test_equals_scipy(seed, p, q, dim):
    from scipy.interpolate import BSpline, NdBSpline

    random = np.random.default_rng(seed)
    surface = random_surface(random, (p, q), (p + 1 + seed % 5, q + 1 + seed % 4), dim, rational=False)
    u, v = pairs(surface, seed=seed)
    theirs = NdBSpline(surface.knots, surface.control_points, (p, q))
    ours = surface.derivatives(u, v, 2)
    for k in range(3):
        for j in range(3 - k):
            if k <= p and j <= q:
                wanted = theirs(np.stack([u, v], 1), nu=(k, j))
                assert np.abs(ours[k, j] - wanted).max() <= 1e-10 * (1 + np.abs(wanted).max()), (k, j)
    grid = surface.derivatives_grid(u[:7], v[:5], 2)
    uu, vv = (x.ravel() for x in np.meshgrid(u[:7], v[:5], indexing="ij"))
    assert np.abs(grid.reshape(3, 3, 35, dim) - surface.derivatives(uu, vv, 2)).max() <= 1e-10 * (1 + np.abs(grid).max())
    curve = nurbs.Curve(surface.control_points[:, 0], surface.knots_u)
    for order in range(min(p, 4) + 1):
        wanted = BSpline(curve.knots, curve.control_points, p)(u, nu=order)
        assert np.abs(curve.derivatives(u, 4)[order] - wanted).max() <= 1e-9 * (1 + np.abs(wanted).max())


def test_equals_geomdl_and_splinepy():
    import splinepy
    from geomdl import NURBS

    surface = random_surface(np.random.default_rng(5), (3, 2), (6, 5)).clamped()
    m, n = surface.control_points.shape[:2]
    theirs = NURBS.Surface(normalize_kv=False)
    theirs.degree_u, theirs.degree_v = surface.degree
    theirs.set_ctrlpts(surface.homogeneous.reshape(-1, 4).tolist(), m, n)
    theirs.knotvector_u, theirs.knotvector_v = (k.tolist() for k in surface.knots)
    u, v = pairs(surface, 20)
    ours = surface.derivatives(u, v, 2)
    for i in range(len(u)):
        wanted = theirs.derivatives(u[i], v[i], order=2)
        for k in range(3):
            for j in range(3 - k):
                assert np.abs(ours[k, j, i] - wanted[k][j]).max() < 1e-9 * (1 + np.abs(wanted[k][j]).max())
    # splinepy counts the first direction fastest.
    other = splinepy.NURBS(
        list(surface.degree),
        [k.tolist() for k in surface.knots],
        surface.control_points.transpose(1, 0, 2).reshape(-1, 3),
        surface.weights.T.reshape(-1, 1),
    )
    assert np.abs(other.evaluate(np.stack([u, v], 1)) - ours[0, 0]).max() < 1e-12
    assert np.abs(other.derivative(np.stack([u, v], 1), [1, 1]) - ours[1, 1]).max() < 1e-8


@given(seed=st.integers(0, 10_000), p=st.integers(1, 6), rational=st.booleans())
@settings(max_examples=30, deadline=None)
def test_edits_leave_the_shape_unchanged(seed, p, rational):
    random = np.random.default_rng(seed)
    surface = random_surface(random, (p, 2), (p + 4, 5), rational=rational)
    u, v = pairs(surface, seed=seed)
    points = surface.evaluate(u, v)
    low, high = surface.domain[0]
    middle = low + (high - low) * random.uniform(0.1, 0.9)
    new = list(random.uniform(low, high, 3))
    near = 1e-12 * (1 + np.abs(surface.control_points).max()) * 4
    for same in (
        surface.insert_knots("u", new),
        surface.refine(2),
        surface.elevate_degree("u"),
        surface.elevate_degree("v", 2),
        surface.clamped(),
    ):
        assert np.abs(same.evaluate(u, v) - points).max() < near
    assert np.abs(surface.swap().evaluate(v, u) - points).max() < near
    assert np.abs(surface.reverse("u").evaluate(low + high - u, v, outside="clamp") - points).max() < 1e-9
    first, second = surface.split("u", middle)
    left = u <= middle
    assert np.abs(first.evaluate(u[left], v[left]) - points[left]).max(initial=0) < near
    assert np.abs(second.evaluate(u[~left], v[~left]) - points[~left]).max(initial=0) < near
    isoline = surface.curve("v", middle)
    assert np.abs(isoline.evaluate(v) - surface.evaluate(middle, v)).max() < near
    curve = nurbs.Curve(surface.control_points[:, 0], surface.knots_u, None if surface.weights is None else surface.weights[:, 0])
    for same in (curve.insert_knots(new), curve.elevate_degree(2), curve.clamped(), curve.refine(3)):
        assert np.abs(same.evaluate(u) - curve.evaluate(u)).max() < near


def test_knots_inserted_are_removed_again_and_a_tolerance_holds():
    sphere = nurbs.sphere()
    u, v = pairs(sphere, 500)
    fine = sphere.refine(4)
    back = fine.remove_knots("u", 1e-9).remove_knots("v", 1e-9)
    assert back.control_points.shape == sphere.control_points.shape
    assert np.abs(back.evaluate(u, v) - sphere.evaluate(u, v)).max() < 1e-9
    t = np.linspace(0, 1, 200)
    curve = nurbs.interpolate_curve(np.stack([t, np.sin(9 * t), np.cos(7 * t)], 1))
    fewer = curve.remove_knots(1e-3)
    assert len(fewer.knots) < len(curve.knots) / 2
    assert np.linalg.norm(fewer.evaluate(t) - curve.evaluate(t), axis=1).max() <= 1e-3


def test_periodic_curve_joins_smoothly():
    curve = nurbs.Curve.closed(np.random.default_rng(0).random((7, 2)))
    ends = curve.derivatives([0, 7], 2)
    assert np.abs(ends[:, 0] - ends[:, 1]).max() < 1e-12
    assert curve.is_closed


def test_closest_points_of_a_sphere_a_circle_and_beyond_the_seam():
    points = np.random.default_rng(1).normal(size=(400, 3)) * 2
    radius = np.linalg.norm(points, axis=1)
    u, v, found, distance = nurbs.sphere(2.0).closest_point(points)
    assert np.abs(distance - np.abs(radius - 2)).max() < 1e-9
    assert np.abs(nurbs.sphere(2.0).evaluate(u, v) - found).max() == 0
    _u, _p, distance = nurbs.circle(3.0).closest_point(points)
    assert np.abs(distance - np.hypot(np.hypot(*points[:, :2].T) - 3, points[:, 2])).max() < 1e-9


def test_closest_points_across_creases_are_not_farther_than_dense_samples():
    random = np.random.default_rng(3)
    bumps = random.normal(0, 0.1, (7, 5))
    net = np.stack([*np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 5), indexing="ij"), bumps], -1)
    surface = nurbs.Surface(net, [0, 0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1, 1], [0, 0, 0.25, 0.5, 0.75, 1, 1])
    points = surface.evaluate(random.random(500), random.random(500)) + random.normal(0, 0.02, (500, 3))
    distance = surface.closest_point(points)[3]
    dense = surface.evaluate_grid(np.linspace(0, 1, 400), np.linspace(0, 1, 400)).reshape(-1, 3)
    assert (distance <= nearest_distance(points, dense) + 1e-12).mean() > 0.995


def test_a_jump_is_not_removed():
    curve = nurbs.Curve([[0, 0], [1, 0], [1, 1], [2, 1]], [0, 0, 0.5, 0.5, 1, 1])
    assert len(curve.remove_knots(0.5).knots) == 6
    joined = nurbs.Curve([[0, 0], [1, 0], [1, 0], [2, 1]], [0, 0, 0.5, 0.5, 1, 1])
    assert len(joined.remove_knots(1e-9).knots) == 5


def test_bounding_box_is_tight():
    assert np.abs(nurbs.sphere(2.0, center=(1, 2, 3)).bounding_box() - [[-1, 0, 1], [3, 4, 5]]).max() < 1e-9
    assert np.abs(nurbs.circle(2.0).bounding_box() - [[-2, -2, 0], [2, 2, 0]]).max() < 1e-9


def test_fits_meet_their_points():
    t = np.linspace(0, 2, 60)
    points = np.stack([np.cos(3 * t), np.sin(3 * t), t], 1)
    for degree in (1, 3, 5):
        curve = nurbs.interpolate_curve(points, degree)
        assert np.abs(curve.evaluate(nurbs.spread_parameters(points)) - points).max() < 1e-10
    few = nurbs.approximate_curve(points, 15)
    assert few.closest_point(points)[2].max() < 1e-3
    assert np.abs(few.evaluate([0, 1]) - points[[0, -1]]).max() < 1e-12
    smooth = nurbs.approximate_curve(points + np.random.default_rng(0).normal(0, 0.05, points.shape), 40, smoothing=1e-5)
    assert smooth.closest_point(points)[2].mean() < 0.035
    weights = np.ones(60)
    weights[30] = 1e6
    moved = points.copy()
    moved[30, 2] += 0.3
    assert abs(nurbs.approximate_curve(moved, 12, weights=weights).closest_point(moved[30:31])[2][0]) < 1e-3
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    loop = nurbs.approximate_curve(np.stack([np.cos(angle), np.sin(angle)], 1), 16, closed=True)
    assert loop.is_closed
    assert np.abs(np.linalg.norm(loop.evaluate(GRID), axis=1) - 1).max() < 1e-3
    grid = nurbs.torus(3, 1).evaluate_grid(np.linspace(0, 0.6, 30), np.linspace(0, 0.8, 25))
    through = nurbs.interpolate_surface(grid)
    assert through.closest_point(grid.reshape(-1, 3))[3].max() < 1e-9
    near = nurbs.approximate_surface(grid, (18, 16))
    assert near.closest_point(grid.reshape(-1, 3))[3].max() < 5e-3
    weighted = nurbs.approximate_surface(grid, (18, 16), weights=np.ones(grid.shape[:2]))
    assert weighted.closest_point(grid.reshape(-1, 3))[3].max() < 2e-2


def test_scattered_fit_equals_the_dense_solution():
    random = np.random.default_rng(3)
    uv = random.random((900, 2))
    points = np.column_stack([uv, np.sin(5 * uv[:, 0]) * uv[:, 1]])
    surface = nurbs.fit_scattered(points, uv[:, 0], uv[:, 1], (8, 7), smoothing=0)
    ku, kv = surface.knots
    a = np.einsum("ni,nj->nij", collocation(ku, 8, uv[:, 0].copy()), collocation(kv, 7, uv[:, 1].copy())).reshape(len(uv), -1)
    dense = np.linalg.lstsq(a, points, rcond=None)[0].reshape(8, 7, 3)
    assert np.abs(surface.control_points - dense).max() < 1e-6


def test_skinned_surface_holds_its_sections():
    sections = [nurbs.circle(1 + 0.2 * np.sin(z), center=(0, 0, z)) for z in range(5)]
    sections[2] = sections[2].elevate_degree()
    surface = nurbs.loft(sections)
    for section in sections:
        assert surface.closest_point(section.evaluate(GRID))[3].max() < 1e-9
    ruled = nurbs.ruled(sections[0], sections[4])
    assert np.abs(ruled.evaluate(0.25, 0.5) - (sections[0].evaluate(0.25) + sections[4].evaluate(0.25)) / 2).max() < 1e-12


def test_target_fit_reaches_its_tolerance_and_tells_when_it_cannot():
    ball = trimesh.creation.icosphere(subdivisions=4)
    fit = nurbs.fit_target(ball, 0.01)
    assert fit.converged
    assert fit.max_deviation <= 0.01
    assert fit.rms_deviation < 0.005
    assert fit.ignored == 0
    assert fit.control_points == fit.surface.control_points.shape[0] * fit.surface.control_points.shape[1]
    checked = np.linalg.norm(fit.surface.evaluate_grid(GRID, GRID), axis=2)
    assert np.abs(checked - 1).max() < 0.02
    cloud = nurbs.fit_target(trimesh.creation.capsule(2, 1).sample(8000, seed=0), 0.06)
    assert cloud.converged
    two = trimesh.util.concatenate([ball, ball.copy().apply_translation([4, 0, 0])])
    cannot = nurbs.fit_target(two, 0.01, axis=(0, 0, 1), max_control_points=400)
    assert not cannot.converged
    assert cannot.ignored > 0.4
    assert cannot.max_deviation > 0.2


def test_mesh_keeps_the_tolerance_and_closes():
    sphere = nurbs.sphere(2.0)
    for tolerance in (0.05, 0.002):
        mesh = nurbs.to_mesh(sphere, tolerance)
        random = np.random.default_rng(0)
        share = random.dirichlet(np.ones(3), len(mesh.faces))
        inside = np.einsum("nk,nkd->nd", share, mesh.triangles)
        assert np.abs(np.linalg.norm(inside, axis=1) - 2).max() <= tolerance
        assert mesh.is_watertight
        assert mesh.volume > 0
    assert nurbs.to_mesh(nurbs.torus(3, 1), 0.02).is_watertight
    assert len(nurbs.to_mesh(nurbs.sphere(2.0), 0.05).faces) < len(mesh.faces) / 5


def test_obj_round_trip_is_exact(tmp_path):
    random = np.random.default_rng(0)
    shapes = [nurbs.sphere(), nurbs.circle(), random_surface(random, rational=False), nurbs.Curve.closed(random.random((5, 3)))]
    nurbs.save_obj(tmp_path / "a.obj", shapes)
    for ours, back in zip(shapes, nurbs.load_obj(tmp_path / "a.obj"), strict=True):
        assert type(ours) is type(back)
        assert np.array_equal(ours.control_points, back.control_points)
        assert (ours.weights is None) == (back.weights is None)
        assert ours.weights is None or np.array_equal(ours.weights, back.weights)
    (tmp_path / "b.obj").write_text("v 0 0 0\ncstype bspline\ndeg 3\ncurv 0 1 1 2 9\nparm u 0 1\nend\n")
    with pytest.raises(FormatError, match=r"b\.obj:4"):
        nurbs.load_obj(tmp_path / "b.obj")


def test_step_file_opens_in_opencascade_with_the_right_area(tmp_path):
    pytest.importorskip("OCP")
    from OCP.BRepCheck import BRepCheck_Analyzer
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps
    from OCP.IFSelect import IFSelect_ReturnStatus
    from OCP.STEPControl import STEPControl_Reader

    flat = nurbs.interpolate_surface(np.stack([*np.meshgrid(np.arange(5.0), np.arange(5.0), indexing="ij"), np.zeros((5, 5))], -1))
    nurbs.save_step(tmp_path / "a.step", [nurbs.sphere(2), nurbs.torus(3, 1), nurbs.cylinder(1, 2), flat], unit="m", name="it's")
    reader = STEPControl_Reader()
    assert reader.ReadFile(str(tmp_path / "a.step")) == IFSelect_ReturnStatus.IFSelect_RetDone
    reader.TransferRoots()
    shape = reader.OneShape()
    assert BRepCheck_Analyzer(shape).IsValid()
    properties = GProp_GProps()
    BRepGProp.SurfaceProperties_s(shape, properties, 1e-6)
    assert abs(properties.Mass() / 1e6 - (16 * np.pi + 12 * np.pi**2 + 4 * np.pi + 16)) < 1e-3


def test_gradients_of_every_input():
    import torch
    from mvcore.nurbs import torch as differentiable

    torch.manual_seed(0)
    double = {"dtype": torch.float64, "requires_grad": True}
    control, weights = torch.rand(6, 7, 3, **double), torch.rand(6, 7, dtype=torch.float64).add(0.5).requires_grad_()
    spans = torch.randn(3, **double), torch.randn(5, **double)
    u, v = (torch.rand(9, dtype=torch.float64).mul(0.9).add(0.05).requires_grad_() for _ in range(2))

    def points(control, weights, a, b, u, v):
        knots = differentiable.monotone_knots(a, 3), differentiable.monotone_knots(b, 2)
        return differentiable.evaluate_surface(control, *knots, u, v, weights=weights)

    assert torch.autograd.gradcheck(points, (control, weights, *spans, u, v))
    fixed = [s.detach() for s in spans]
    assert torch.autograd.gradgradcheck(lambda c, w, u, v: points(c, w, *fixed, u, v), (control, weights, u, v))
    line = control[:, 0].detach().requires_grad_()

    def places(c, s, u):
        return differentiable.evaluate_curve(c, differentiable.monotone_knots(s, 3), u, weights=weights[:, 0])

    assert torch.autograd.gradcheck(places, (line, spans[0], u))
    with pytest.raises(InvalidInputError, match="control_points: expected float64"):
        differentiable.evaluate_curve(line.float(), torch.zeros(10).double(), u)


def test_descent_fits_a_surface_to_points():
    import torch
    from mvcore.nurbs import torch as differentiable

    random = np.random.default_rng(0)
    uv = torch.from_numpy(random.random((2000, 2)))
    wanted = torch.stack([uv[:, 0], uv[:, 1], torch.sin(5 * uv[:, 0]) * uv[:, 1]], 1)
    knots = differentiable.monotone_knots(torch.zeros(4), 3)
    control = torch.zeros(7, 7, 3, dtype=torch.float64, requires_grad=True)
    descent = torch.optim.LBFGS([control], max_iter=60)

    def closure():
        descent.zero_grad()
        loss = (
            (differentiable.evaluate_surface(control, knots, knots, uv[:, 0].contiguous(), uv[:, 1].contiguous()) - wanted).square().mean()
        )
        loss.backward()
        return loss

    first = float(closure())
    descent.step(closure)
    assert float(closure()) < 1e-4 * first


CONTROL, KNOTS = np.random.default_rng(0).random((5, 3)), [0, 0, 0, 0, 0.5, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"knots": [0, 0, 0, 0, 2, 1, 1, 1, 1]}, "knots"),
        ({"knots": [0, 0, 0, 0, np.nan, 1, 1, 1, 1]}, "knots"),
        ({"knots": [0, 1]}, "knots"),
        ({"knots": [0.5] * 9}, "knots"),
        ({"knots": "no"}, "knots"),
        ({"control_points": CONTROL[0]}, "control_points"),
        ({"control_points": CONTROL * np.inf}, "control_points"),
        ({"weights": [1, 1, 0, 1, 1]}, "weights"),
        ({"weights": [1, 1, -1, 1, 1]}, "weights"),
        ({"weights": [1, 1, 1, 1]}, "weights"),
        ({"weights": [1, 1, np.nan, 1, 1]}, "weights"),
    ],
)
def test_bad_curves_are_named(change, name):
    with pytest.raises(InvalidInputError, match=f"^{name}: expected"):
        nurbs.Curve(**({"control_points": CONTROL, "knots": KNOTS} | change))


def test_bad_parameters_are_named_and_clamped_only_when_asked():
    curve, sphere = nurbs.Curve(CONTROL, KNOTS), nurbs.sphere()
    for bad in (-0.1, 1.1, np.nan):
        with pytest.raises(InvalidInputError, match=r"^u: expected"):
            curve.evaluate(bad)
        with pytest.raises(InvalidInputError, match=r"^v: expected"):
            sphere.evaluate(0.5, bad)
    assert np.array_equal(curve.evaluate([-1, 2], outside="clamp"), curve.evaluate([0, 1]))
    for call, name in (
        (lambda: curve.derivatives(0.5, -1), "order"),
        (lambda: curve.derivatives(0.5, 10**9), "order"),
        (lambda: sphere.derivatives(0.5, 0.5, 10**9), "order"),
        (lambda: curve.split(0), "u"),
        (lambda: curve.insert_knots([0.5, 0.5, 0.5]), "new"),
        (lambda: sphere.evaluate([0.1, 0.2], [0.1, 0.2, 0.3]), "v"),
        (lambda: sphere.insert_knots("w", [0.5]), "direction"),
        (lambda: nurbs.Surface(CONTROL[None], KNOTS, KNOTS), "knots_u"),
        (lambda: nurbs.fit_target(np.zeros((4, 3)), 0.1), "target"),
        (lambda: nurbs.fit_target(trimesh.creation.icosphere(), -1), "tolerance"),
        (lambda: nurbs.approximate_curve(CONTROL, 9), "count"),
        (lambda: nurbs.interpolate_curve(CONTROL[[0, 0, 1, 2]]), "points"),
        (lambda: nurbs.to_mesh(sphere, 0), "tolerance"),
        (lambda: nurbs.torus(1, 2), "minor"),
    ):
        with pytest.raises(InvalidInputError, match=f"^{name}: expected"):
            call()
    assert sphere.evaluate([], []).shape == (0, 3)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=12), st.integers(0, 6))
@settings(max_examples=200, deadline=None)
def test_any_knots_give_a_curve_or_an_error(knots, count):
    try:
        curve = nurbs.Curve(np.ones((count, 2)), knots)
    except InvalidInputError:
        return
    low, high = curve.domain
    assert np.abs(curve.evaluate([low, (low + high) / 2, high], outside="clamp") - 1).max() < 1e-9
