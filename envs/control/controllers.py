"""What controllers share around their action, and those that do not plan: the learned policy, and the critic's best action."""

import time

import casadi as ca
import numpy as np
from scipy.optimize import minimize

import envs
from envs.control.estimation import Measured


def call(function, *arguments):
    """A function of (x, goal), or of (x, goal, mismatch)."""
    return function(*arguments[: function.n_in()])


def checked_problem(plant, scenarios, slack_price, change_weight):
    """What a planner is given, as new arrays: scenarios (S, n_psi), prices (2, n_x) of violations below and above, (n_u,) of changes.

    A price may be a number, or (n_x,) for both sides. Raises ValueError for other shapes, and what is negative or not finite; only
    slack_price may be infinite, a hard bound.
    """
    n_psi, n_x, n_u = len(plant.PSI_NOMINAL), len(plant.X_LOW), len(plant.U_LOW)
    scenarios = np.array(scenarios, dtype=float)
    if scenarios.shape[1:] != (n_psi,) or not len(scenarios) or not np.isfinite(scenarios).all():
        raise ValueError(f"scenarios have shape {scenarios.shape}; they must be finite, (S, {n_psi})")
    prices = []
    for name, price, shape, most in (
        ("slack_price", slack_price, (2, n_x), np.inf),
        ("change_weight", change_weight, (n_u,), 1e300),
    ):
        price = np.array(price, dtype=float)
        if (
            price.shape not in ((), shape[-1:], shape) or not ((price >= 0) & (price <= most)).all()
        ):  # nor is nan
            finite = "finite and " * (most < np.inf)
            raise ValueError(
                f"{name} is {price.tolist()}; it must be a number or {shape}, {finite}not negative"
            )
        prices.append(np.broadcast_to(price, shape).copy())
    return scenarios, *prices


class Controller:
    """What every controller does around its action: `u = make_step(y)`, `set_goal(goal)`, `reset()`, `stats`.

    A subclass defines `action(x, tick)`: the action (n_u,) for the state x (n_x,), physical units, of a step that
    began at tick. Where that is not finite the last action is applied again. estimator: an `envs.control.estimation.Measured`,
    which makes x of the measurement y; default: y is the state.
    """

    horizon = None

    def __init__(self, plant, goal, estimator=None):
        self.plant, self.estimator = plant, estimator or Measured(plant)
        self.angles = np.flatnonzero(
            np.isin(self.estimator.measured, plant.ANGLES)
        )  # which of what is measured
        self.set_goal(goal)
        self.reset()

    def reset(self, u=None):
        """Forget everything, as at the start of an episode; u: the action (n_u,) that the plant gets now, default 0."""
        u = np.zeros(len(self.plant.U_LOW)) if u is None else np.atleast_1d(np.array(u, dtype=float))
        if u.shape != self.plant.U_LOW.shape or not np.isfinite(u).all():
            raise ValueError(
                f"u is {u}; it must be {len(self.plant.U_LOW)} finite number(s): {', '.join(self.plant.ACTION_NAMES)}"
            )
        self.x_before, self.u_before = None, u
        self.stats = {}
        self.estimator.reset()

    def set_goal(self, goal):
        """The goal from now on: a number or (n_goal,); of a planner also (n_goal, N), a goal per stage x_1 ... x_N.

        Raises ValueError for another shape or a goal outside the plant's range.
        """
        self.goal = envs.checked_goal(self.plant, goal, self.horizon)

    @property
    def goals(self):
        """A column per stage, (n_goal, N)."""
        return np.broadcast_to(self.goal.reshape(len(self.goal), -1), (len(self.goal), self.horizon or 1))

    def make_step(self, y):
        """The action (n_u,), finite and within its limits, for the measurement y (n_y,), physical units: by default the state.

        Raises ValueError for another shape, and without a filter for what is not finite, and stays as it was. Angles are taken to the turn
        nearest to the last.
        """
        y, tick = self.estimator.checked(y), time.perf_counter()
        angles, turn = self.angles, 2 * np.pi
        y[angles] = np.fmod(y[angles], turn)  # turns would take the digits of what is far away
        if self.x_before is not None:
            y[angles] += turn * np.round((self.x_before[self.estimator.measured] - y)[angles] / turn)
        x = self.estimator.update(y, self.u_before)
        self.stats = {"rung": "actor", "fell_back": False, "iterations": 0, "late": False}
        u = self.action(x, tick)
        if not np.isfinite(u).all():
            self.stats |= {"rung": "hold", "fell_back": True}
            u = self.u_before
        self.x_before, self.u_before = x, np.clip(u, self.plant.U_LOW, self.plant.U_HIGH)
        self.stats |= self.estimator.report
        self.stats["wall_ms"] = 1e3 * (time.perf_counter() - tick)
        return self.u_before.copy()


class ActorController(Controller):
    """The learned policy alone; actor: CasADi function (x, goal) or (x, goal, mismatch) -> u."""

    def __init__(self, plant, actor, goal, estimator=None):
        super().__init__(plant, goal, estimator)
        self.actor = actor

    def action(self, x, tick=None):
        return np.array(call(self.actor, x, self.goal, self.estimator.mismatch)).ravel()


class GreedyController(ActorController):
    """Horizon 0: argmax over u in U of Q(x, u, goal), by L-BFGS-B from the actor's action and the best of some points.

    The points are a grid for one or two actions, random for more.
    """

    def __init__(self, plant, actor, Q, goal, estimator=None, points=9):
        super().__init__(plant, actor, goal, estimator)
        n_u = len(plant.U_LOW)
        v = ca.MX.sym("v", n_u)  # action scaled to [0, 1]
        sizes = {"x": len(plant.X_LOW), "goal": len(self.goal), "mismatch": len(plant.X_LOW)}
        given = [ca.MX.sym(*size) for size in sizes.items()]
        q = call(Q, given[0], plant.U_LOW + v * (plant.U_HIGH - plant.U_LOW), *given[1:])
        self.negative_q = ca.Function("negative_q", [v, *given], [-q, -ca.gradient(q, v)])
        grid = np.meshgrid(*[np.linspace(0, 1, points)] * min(n_u, 2))
        self.points = np.stack([a.ravel() for a in grid])  # (n_u, points^n_u)
        if n_u > 2:
            self.points = np.random.default_rng(0).uniform(size=(n_u, points**2))

    def action(self, x, tick=None):
        given, span = (x, self.goal, self.estimator.mismatch), self.plant.U_HIGH - self.plant.U_LOW
        at_points = np.array(self.negative_q(self.points, *given)[0]).ravel()
        starts = [(super().action(x) - self.plant.U_LOW) / span, self.points[:, at_points.argmin()]]

        def objective(v):
            return tuple(np.array(part).ravel() for part in self.negative_q(v, *given))

        bounds = [(0, 1)] * len(span)
        found = [minimize(objective, v, jac=True, method="L-BFGS-B", bounds=bounds) for v in starts]
        return self.plant.U_LOW + np.clip(min(found, key=lambda result: result.fun).x, 0, 1) * span
