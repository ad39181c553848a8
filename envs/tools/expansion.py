"""Second derivatives of a critic's value V(x, g) = Q(x, mu(x, g), g), and a terminal cost made of them."""

import casadi as ca
import numpy as np


class Expansion(ca.Callback):
    """CasADi function (x, goal) -> V, its gradient (n_x,), its Hessian (n_x, n_x), physical units, that computes in numpy.

    The Hessian of a chain of linear maps and elementwise functions f is the sum over all of their inputs a of
    (adjoint of f(a)) f''(a) (da/dx)'(da/dx): a few matrix products, where CasADi would send n_x directions through the networks one by one
    (0.6 ms against 14 at n_x = 32, an actor and a critic of 256 x 256). Whoever uses it must keep it: CasADi does not.
    """

    def __init__(self, critic):
        ca.Callback.__init__(self)
        self.combine, (self.actor, twins) = critic.combine, critic.layers()
        self.twins = twins[:1] if self.combine == "first" else twins
        sizes = (("x", critic.scaling["x_center"].size), ("goal", critic.scaling["goal_center"].size), ("adjoint", critic.network["n_in"]))
        x, goal, adjoint = (ca.MX.sym(*size) for size in sizes)
        self.shapes, z = (x.shape, goal.shape, (x.numel(), x.numel())), critic.features(x, goal, ca)
        self.features = ca.Function("features", [x, goal], [z, ca.jacobian(z, x)])
        self.bend = ca.Function("bend", [x, goal, adjoint], [ca.hessian(ca.dot(adjoint, z), x)[0]])  # zero unless there are angles
        self.point, self.result = None, None  # the last: solvers ask for slope and curvature one after the other
        self.construct("expansion")

    def get_n_in(self):
        return 2

    def get_n_out(self):
        return 3

    def get_sparsity_in(self, i):
        return ca.Sparsity.dense(*self.shapes[i])

    def get_sparsity_out(self, i):
        return ca.Sparsity.dense(*((1, 1), self.shapes[0], self.shapes[2])[i])

    def eval(self, arguments):
        point = np.concatenate([np.array(value).ravel() for value in arguments])
        if self.point is None or (point != self.point).any():
            self.point, self.result = point, self._expand(arguments)
        return self.result

    def _expand(self, arguments):
        def forward(layers, h, J):
            """Output, its Jacobian, and what `backward` needs of each hidden layer: W, da/dx, f'(a), f''(a)."""
            tape = []
            for w, b in layers[:-1]:
                a, J = w @ h + b, w @ J
                p = (1 + np.tanh(a / 2)) / 2  # SiLU is a p
                tape.append((w, J, p * (1 + a * (1 - p)), p * (1 - p) * (2 + a * (1 - 2 * p))))
                h, J = a * p, tape[-1][2] * J
            return layers[-1][0] @ h + layers[-1][1], layers[-1][0] @ J, tape

        def backward(layers, tape, adjoint):
            """Adjoint of the input and the share of the Hessian, from the adjoint of the output."""
            adjoint, hessian = layers[-1][0].T @ adjoint, 0
            for w, J, first, second in reversed(tape):
                hessian += J.T @ (adjoint * second * J)
                adjoint = w.T @ (adjoint * first)
            return adjoint, hessian

        z, J = (np.array(value) for value in self.features(*arguments))
        mean, J_mean, actor_tape = forward(self.actor, z, J)
        action = np.tanh(mean)
        slope, results = 1 - action**2, []
        for twin in self.twins:
            q, _, tape = forward(twin, np.vstack([z, action]), np.vstack([J, slope * J_mean]))
            adjoint, hessian = backward(twin, tape, np.ones((1, 1)))
            d_z, d_action = np.vsplit(adjoint, [len(z)])
            through_actor, more = backward(self.actor, actor_tape, d_action * slope)
            d_z += through_actor
            hessian += more + J_mean.T @ (d_action * -2 * action * slope * J_mean) + np.array(self.bend(*arguments, d_z))
            results.append((q, J.T @ d_z, hessian))
        if self.combine == "min":
            return min(results, key=lambda result: result[0])
        return [sum(values) / len(results) for values in zip(*results)]


def with_derivatives(V, expansion):
    """V with the derivatives of its expansion with respect to x, and none with respect to the goal, in place of CasADi's own."""
    x, goal = ca.MX.sym("x", V.numel_in(0)), ca.MX.sym("goal", V.numel_in(1))
    n, m = x.numel(), goal.numel()
    state, by_goal, named = ca.MX.sym("state", n + m), ca.MX(1, m), {"never_inline": True, "enable_forward": False, "enable_reverse": False}
    parts = ca.vertsplit(state, [0, n, n + m])
    _, gradient, hessian = expansion(*parts)
    blocks = [ca.diagcat(hessian, ca.MX(m, m)), ca.MX(n + m, 1)]
    jac_jac = ca.Function("jac_jac_value", [state, ca.MX(1, 1), ca.MX(1, n + m)], blocks,
                          ["state", "out_v", "out_jac_v_state"], ["jac_jac_v_state_state", "jac_jac_v_state_out_v"], named)  # fmt: skip
    jac = ca.Function("jac_value", [state, ca.MX(1, 1)], [ca.horzcat(gradient.T, by_goal)], ["state", "out_v"], ["jac_v_state"],
                      named | {"custom_jacobian": jac_jac})  # fmt: skip
    value = ca.Function("value", [state], [V(*parts)], ["state"], ["v"], named | {"custom_jacobian": jac})
    return ca.Function("V", [x, goal], [value(ca.vertcat(x, goal))], ["x", "goal"], ["V"])


class TaylorValue:
    """V(., goal) replaced by its second-order expansion, for a solver that then needs no derivatives of a network.

    -V need not be convex, and a quadratic terminal cost that is not has its minimum at the end of the world. So its Hessian, in units of
    the box of initial states, is projected: negative eigenvalues become zero.
    """

    def __init__(self, V, expansion, goal, scale):
        self.V, self.expansion, self.goal, self.scale, n = V, expansion, goal, scale, len(scale)
        x, theta = ca.MX.sym("x", n), ca.MX.sym("theta", 1 + 2 * n + n**2)
        # -V at x, from a column (centre, -V there, -gradient, projected -Hessian) of `parameters`
        center, v, slope, curvature = ca.vertsplit(theta, np.cumsum([0, n, 1, n, n**2]).tolist())
        dx = (x - center) / scale
        cost = v + ca.dot(slope, dx) + ca.bilin(ca.reshape(curvature, n, n), dx, dx) / 2
        self.cost = ca.Function("taylor", [x, theta], [cost])

    def parameters(self, x, order=2):
        """Coefficients of the expansions about the states x (n_x, points), (1 + 2 n_x + n_x^2, points); of order 0: V there, held."""
        columns = []
        for point in x.T:
            if order == 0:
                columns.append(np.concatenate([point, [-float(self.V(point, self.goal))], np.zeros(len(point) * (1 + len(point)))]))
                continue
            v, gradient, hessian = (np.array(value) for value in self.expansion(point, self.goal))
            eigenvalues, vectors = np.linalg.eigh(-hessian * np.outer(self.scale, self.scale))
            projected = vectors * np.maximum(eigenvalues, 0) @ vectors.T
            columns.append(np.concatenate([point, -v.ravel(), -gradient.ravel() * self.scale, projected.ravel()]))
        return np.stack(columns, axis=1)
