"""Gradient descent moves control points, weights and knots until a surface passes through points.

python examples/04_nurbs_descent.py [SURFACE.obj]
"""

import sys

import numpy as np
import torch
from mvcore import nurbs
from mvcore.nurbs import torch as differentiable


def main(output="descent.obj"):
    random = np.random.default_rng(0)
    u, v = (torch.from_numpy(x) for x in random.random((2, 3000)))
    # A fold, sharper than evenly spaced knots can follow.
    points = torch.stack([u, v, 0.3 * torch.tanh(20 * (u - 0.37)) * torch.cos(2 * v)], 1)

    side = torch.linspace(0, 1, 9, dtype=torch.float64)
    control = torch.stack([*torch.meshgrid(side, side, indexing="ij"), torch.zeros(9, 9, dtype=torch.float64)], -1).requires_grad_()
    log_weights = torch.zeros(9, 9, dtype=torch.float64, requires_grad=True)
    spans = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    even = differentiable.monotone_knots(torch.zeros(6), 3)

    def error():
        knots = differentiable.monotone_knots(spans, 3)
        found = differentiable.evaluate_surface(control, knots, even, u, v, weights=log_weights.exp())
        return (found - points).square().sum(1).mean()

    for name, moving in (("control points", [control]), ("and weights and knots", [control, log_weights, spans])):
        descent = torch.optim.LBFGS(moving, max_iter=200, line_search_fn="strong_wolfe")

        def closure(descent=descent):
            descent.zero_grad()
            value = error()
            value.backward()
            return value

        descent.step(closure)
        print(f"{name}: root mean square distance {float(error().detach().sqrt()):.5f}")
    knots = differentiable.monotone_knots(spans.detach(), 3).numpy()
    surface = nurbs.Surface(control.detach().numpy(), knots, even.numpy(), log_weights.detach().exp().numpy())
    nurbs.save_obj(output, surface)
    print(f"{output}: knots {np.round(knots[4:-4], 2)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
