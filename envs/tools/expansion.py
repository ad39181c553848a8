"""A critic's value with its first and second derivatives."""

import casadi as ca


def expansion(critic):
    """CasADi function (x, goal, mismatch) -> V, gradient (n_x,), Hessian (n_x, n_x) of V(x, g) = Q(x, mu(x, g), g), physical units.

    The Hessian of a chain of linear maps and elementwise functions f is the sum over all of their inputs a of
    (adjoint of f(a)) f''(a) (da/dx)'(da/dx): a few matrix products, where CasADi's own derivatives would send n_x directions through the
    networks one by one. A critic that does not observe the mismatch ignores it.
    """
    s, actor, n_x = critic.scaling, critic.actor, len(critic.plant.X_LOW)
    x, goal, mismatch = (ca.MX.sym(*size) for size in (("x", n_x), ("goal", s["goal_center"].size), ("mismatch", n_x)))
    z = critic.features(ca.vertcat(x, mismatch) if critic.mismatch_scale else x, goal, ca)
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
    return ca.Function("expansion", [x, goal, mismatch], [ca.densify(part) for part in parts], ["x", "goal", "mismatch"], ["V", "gradient", "hessian"])
