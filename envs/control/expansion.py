"""A critic's value with its first and second derivatives in CasADi, and in torch, which the export is checked against."""

import casadi as ca
import numpy as np
import torch

import envs


def expansion(critic):
    """CasADi function (x, goal, mismatch) -> V, gradient (n_x,), Hessian (n_x, n_x) of V(x, g) = Q(x, mu(x, g), g), physical units.

    The Hessian of a chain of linear maps and elementwise functions f is the sum over all of their inputs a of
    (adjoint of f(a)) f''(a) (da/dx)'(da/dx): a few matrix products, where CasADi's own derivatives would send n_x directions through the
    networks one by one. A critic that does not observe the mismatch ignores it.
    """
    s, actor, n_x = critic.scaling, critic.actor, len(critic.plant.X_LOW)
    sizes = {"x": n_x, "goal": s["goal_center"].size, "mismatch": n_x}
    x, goal, mismatch = (ca.MX.sym(*size) for size in sizes.items())
    z = critic.features(ca.vertcat(x, mismatch) if critic.mismatch_scale else x, goal)
    z_x = ca.densify(ca.jacobian(z, x))

    def scaled_rows(column, matrix):
        return ca.repmat(column, 1, n_x) * matrix

    def forward(layers, h, h_x):
        """Output, its Jacobian, and of each hidden layer W, da/dx, f'(a), f''(a)."""
        tape = []
        for w, b in layers[:-1]:
            a, a_x = w @ h + b, w @ h_x
            p = (1 + ca.tanh(a / 2)) / 2  # SiLU is a p
            tape.append((w, a_x, p * (1 + a * (1 - p)), p * (1 - p) * (2 + a * (1 - 2 * p))))
            h, h_x = a * p, scaled_rows(tape[-1][2], a_x)
        return layers[-1][0] @ h + layers[-1][1], layers[-1][0] @ h_x, tape

    def backward(layers, tape, adjoint):
        """Adjoint of the input and the share of the Hessian, from the adjoint of the output."""
        adjoint, hessian = layers[-1][0].T @ adjoint, 0
        for w, a_x, first, second in reversed(tape):
            hessian += a_x.T @ scaled_rows(adjoint * second, a_x)
            adjoint = w.T @ (adjoint * first)
        return adjoint, hessian

    mean, mean_x, actor_tape = forward(actor, z, z_x)
    action = ca.tanh(mean)
    slope, results = 1 - action**2, []
    for twin in critic.twins[: 1 if critic.combine == "first" else 2]:
        q, _, tape = forward(twin, ca.vertcat(z, action), ca.vertcat(z_x, scaled_rows(slope, mean_x)))
        adjoint, hessian = backward(twin, tape, ca.DM.ones(1, 1))
        by_z, by_action = ca.vertsplit(adjoint, [0, z.numel(), adjoint.numel()])
        through_actor, more = backward(actor, actor_tape, by_action * slope)
        by_z += through_actor
        hessian += more + mean_x.T @ scaled_rows(by_action * -2 * action * slope, mean_x)
        if critic.plant.ANGLES:  # the network's input bends
            fixed = ca.MX.sym("fixed", z.numel())
            bend = ca.Function("bend", [x, goal, mismatch, fixed], [ca.hessian(ca.dot(fixed, z), x)[0]])
            hessian += bend(x, goal, mismatch, by_z)
        results.append((q, z_x.T @ by_z, hessian))
    if critic.combine == "min":
        parts = [ca.if_else(results[0][0] < results[1][0], a, b) for a, b in zip(*results)]
    else:
        parts = [sum(part) / len(results) for part in zip(*results)]
    return ca.Function("expansion", [x, goal, mismatch], [ca.densify(part) for part in parts])


def torch_value(critic, x, goal):
    """V in torch, float64: x (B, n_x), with the mismatch behind it if the critic observes it, goal (B, n_goal) -> (B,)."""
    s = {k: v.tolist() if v.dtype == int else torch.from_numpy(v) for k, v in critic.scaling.items()}
    if critic.goal_input == "error":
        goal = goal - x[:, s["goal_index"]]
        g = goal / s["error_scale"]
    else:
        g = (goal - s["goal_center"]) / s["goal_scale"]
    angles = torch.cat([x, goal], dim=1)[:, s["angle_index"]]
    others = torch.cat([(x - s["x_center"]) / s["x_scale"], g], dim=1)[:, s["other_index"]]
    z = torch.cat([others, angles.sin(), angles.cos()], dim=1)

    def mlp(layers, h):
        for i, (w, b) in enumerate(layers):
            h = torch.nn.functional.linear(h, torch.tensor(w), torch.tensor(b[:, 0]))
            h = torch.nn.functional.silu(h) if i < len(layers) - 1 else h
        return h

    inputs = torch.cat([z, torch.tanh(mlp(critic.actor, z))], dim=1)
    first, second = (mlp(twin, inputs)[:, 0] for twin in critic.twins)
    return {"min": torch.fmin(first, second), "first": first, "mean": (first + second) / 2}[critic.combine]


def check_export(critic, V, points=64, tolerance=1e-8):
    """Compare value and gradient of V(x, goal) with torch at random states: the largest scaled difference.

    Raises RuntimeError if it is above the tolerance.
    """
    plant, rng = critic.plant, np.random.default_rng(0)
    x = torch.tensor(envs.sample_states(plant, rng, points), requires_grad=True)
    goal = rng.uniform(plant.GOAL_LOW, plant.GOAL_HIGH, size=(points, len(plant.GOAL_LOW)))
    seen = [rng.uniform(-1, 1, size=x.shape)] if critic.mismatch_scale else []
    value = torch_value(critic, torch.cat([x, *map(torch.from_numpy, seen)], dim=1), torch.from_numpy(goal))
    (gradient,) = torch.autograd.grad(value.sum(), x)
    value, x_scale = value.detach().numpy(), critic.scaling["x_scale"][: x.shape[1]]
    inputs = [ca.MX.sym(V.name_in(i), V.size1_in(i)) for i in range(V.n_in())]
    both = ca.Function("both", inputs, [V(*inputs), ca.gradient(V(*inputs), inputs[0])]).map(points)
    v, slope = (np.array(part) for part in both(*(array.T for array in (x.detach().numpy(), goal, *seen))))
    errors = v[0] - value, (slope.T - gradient.numpy()) * x_scale  # slopes per unit of the network's input
    worst = max(np.abs(error).max() for error in errors) / (1 + np.abs(value).max())
    if not worst < tolerance:
        raise RuntimeError(
            f"the CasADi export differs from torch by {worst:.1e} (allowed: {tolerance:.0e}); nothing was run"
        )
    return worst
