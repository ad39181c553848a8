"""A plant as a prediction model: one sampling time in CasADi, in units of the boxes of initial states and actions."""

import casadi as ca

import envs


def scaling(plant):
    """Centre and half-width (1 where it has none) of the box of initial states, then of the actions: x = x_center + x_scale * scaled."""
    return (
        (plant.INIT_LOW + plant.INIT_HIGH) / 2,
        envs.half_width(plant),
        (plant.U_LOW + plant.U_HIGH) / 2,
        (plant.U_HIGH - plant.U_LOW) / 2,
    )


def prediction_model(plant, second="u"):
    """CasADi functions (x, u, psi) -> x one sampling time later, and -> that with its Jacobians by x and by `second`, u or psi.

    x and u are scaled, psi is as it is.
    """
    x_center, x_scale, u_center, u_scale = scaling(plant)
    sizes, discrete = (len(x_scale), len(u_scale), len(plant.PSI_NOMINAL)), hasattr(plant, "next_state")
    x, u, psi = ((ca.MX if discrete else ca.SX).sym(name, n) for name, n in zip(("x", "u", "psi"), sizes))
    state, action = x * x_scale + x_center, u * u_scale + u_center
    if discrete:
        after = plant.next_state(state, action, psi, ca)
    else:
        after = envs.rk4(plant.ode, state, action, psi, plant.DT / plant.MODEL_SUBSTEPS, 1, ca)
    after = (after - x_center) / x_scale
    # one substep is the unit that is differentiated and compiled: unrolled, several take several times as long to compile
    named = {"never_inline": True}
    substep = ca.Function("substep", [x, u, psi], [after], named)
    by = {"u": u, "psi": psi}[second]
    jacobians = [ca.densify(ca.jacobian(after, v)) for v in (x, by)]
    sensitive = ca.Function("substep_jacobian", [x, u, psi], [after, *jacobians], named)
    x, u, psi = (ca.MX.sym(name, n) for name, n in zip(("x", "u", "psi"), sizes))
    plain, after, A, B = x, x, ca.MX.eye(sizes[0]), ca.MX.zeros(sizes[0], by.numel())
    for _ in range(plant.MODEL_SUBSTEPS):
        plain = substep(plain, u, psi)
        after, a, b = sensitive(after, u, psi)
        A, B = a @ A, a @ B + b
    return ca.Function("step", [x, u, psi], [plain], named), ca.Function(
        "step_jacobian", [x, u, psi], [after, A, B], named
    )
