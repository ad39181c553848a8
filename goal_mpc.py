# /// script
# requires-python = ">=3.11"
# dependencies = ["gymnasium==1.4.0", "casadi==3.8.2", "numpy", "scipy", "tyro", "matplotlib", "tqdm"]
# ///
"""Goal-conditioned scenario MPC written out in CasADi: scenario tree, soft constraints, Gaussian objective (eq:multiMPCobj).

    minimise over u   1/S sum_i { sum_{t=1}^{N} [ l(x_t^i, g_t) + w'|eps_t^i| + w2'(eps_t^i)^2 + |u_{t-1}^i - u_{t-2}^i|_W^2 ] + m(x_N^i) }
    subject to        x_{t+1}^i = f(x_t^i, u_t^i, psi_t^i),   x_0^i = s,   x_t^i - eps_t^i in X,   u_t^i in U,   u_t^i = u_t^j while i and j
                      share their history; over the robust horizon the paths i take every sequence of scenarios, then each keeps its last;
                      with a discount what stands at stage t counts gamma^t

with the stage cost l chosen by `--objective` (the paper's Example 1) from the plant's goal error e, for the pendulum 1 - cos(theta - g):
goal -exp(-|e|^2 / (2 sigma^2)) (eq:smoothreward), quadratic |e|^2 / 2, expert the kinetic minus the potential energy. A linear plant has
l(x_t, u_t) = |x_t|^2 + |u_t|^2 at t = 0 ... N-1 and m(x_N) = x_N'Px_N (eq:nominalMPCobj), goal takes -exp of both (eq:jensen).

    python goal_mpc.py --env double_pendulum --objective goal --horizon 75          # swing both rods up and hold them
    python goal_mpc.py --goal up-down down-up@120 --steps 240 --horizon 35 --sigma2 0.5 --animate    # visit two other equilibria
    python goal_mpc.py --env cstr --horizon 20 --robust-horizon 1                   # another plant, a tree of nine scenarios

It writes `runs/{env}__goal_mpc__{seed}__{time}/`: results.csv (a row per seed), trajectories.npz, episode.png and, if asked to,
episode.gif. Only the folder `envs/` is needed beside this file.
"""

import csv
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import tyro
from tqdm import tqdm

import envs
from envs.tools.compiled import compiled_solver
from envs.tools.figure import draw_episode

RADAU_DEGREE = 3
METRIC_SIGMA2 = 0.01  # of time near goal, squared units of the plant's goal error


@dataclass(frozen=True)
class Args:
    env: str = "double_pendulum"
    """the plant: NAME of a module envs/NAME.py"""
    dim: int | None = None
    """number of states, for a plant that comes in sizes (linear: 2)"""
    system: int | None = None
    """which one, for a plant that comes in several (linear: the seed of its matrix, 0)"""
    objective: Literal["expert", "quadratic", "goal"] = "goal"
    """stage cost; expert: what the plant module defines (double_pendulum: kinetic minus potential energy)"""
    horizon: int = 75
    """prediction steps N"""
    control_horizon: int | None = None
    """N_c, from which stage on the actions follow the plant's linear feedback (linear: the LQR's); default: never"""
    gamma: float = 1.0
    """discount inside the plan, and of the linear-quadratic value and feedback"""
    sigma2: float | None = None
    """sigma^2 of the Gaussian of --objective goal, squared units of the goal error; default: the plant's (double_pendulum 1, cstr 0.01,
    linear 0.5)"""
    goal: tuple[str, ...] = ()
    """a name (double_pendulum: up-up, up-down, down-up) or numbers joined by commas; @STEP after it: from that step on.
    Default: the plant's evaluation goal"""
    preview: bool = False
    """tell the controller of goal changes that lie within its horizon; otherwise it learns of each when it happens"""
    steps: int = 100
    """sampling times per episode"""
    episodes: int = 1
    """episodes; their seeds are seed, seed + 1, ..."""
    seed: int = 0
    """seed of the first episode: it perturbs the start state and, with --plant random, draws the plant's parameters"""
    plant: Literal["nominal", "random"] = "nominal"
    """parameters of the simulated plant: the model's, or drawn per episode from the plant's evaluation set"""

    robust_horizon: int = 0
    """stages at which the scenario tree branches; 0: the nominal model alone"""
    scenarios: str = "mpc"
    """name of the plant's scenario set that the tree branches over; the nominal plant comes first, added if the set lacks it"""
    discretization: Literal["rk4", "radau"] = "rk4"
    """prediction model: explicit Runge-Kutta steps, or Radau collocation of degree 3"""
    constraints: Literal["soft", "hard"] = "soft"
    """whether the state bounds may be violated at a price"""
    slack_weight: float = 10.0
    """L1 price of a violation, per physical unit and step (10: a metre off the track costs what ten steps at the goal earn)"""
    slack_weight_l2: float = 0.0
    """price of its square"""
    change_weight: tuple[float, ...] | None = None
    """price of the squared change of each action; default: 0, or with --objective expert the plant's (double_pendulum: 0.1)"""

    solver: Literal["ipopt", "fatrop"] = "ipopt"
    """fatrop: faster on long horizons, fails more often; nominal problems (--robust-horizon 0) only"""
    guide_horizon: int = 0
    """horizon of a controller whose simulated closed loop is the first guess; 0: the start state held (linear: the regulator's
    closed loop). The pendulum gains from N = 100 on"""
    compile: bool = True
    """translate the optimal control problem to C and compile it once (kept in $XDG_CACHE_HOME/rlmpc, or ~/.cache/rlmpc); linear plants
    are never compiled, since matrix products gain nothing"""
    animate: bool = False
    """write episode.gif of the first episode, with the predicted motion drawn faintly"""
    out: Path | None = None
    """folder of the results; default: runs/{env}__goal_mpc__{seed}__{time}"""


# Scenario MPC


class ScenarioMPC:
    """eq:multiMPCobj by multiple shooting over a scenario tree, with soft constraints and a goal that may change over the horizon.

    stage_cost, terminal_cost: CasADi functions (x, goal) -> scalar, to be minimised; terminal_cost may be None. A stage_cost of
    (x, u, goal) is summed over (x_0, u_0) ... (x_{N-1}, u_{N-1}) instead of x_1 ... x_N, as in eq:nominalMPCobj.
    gamma: what stands at stage t, slack included, counts gamma^t.
    scenarios: (S, n_psi); the first is the nominal one. robust_horizon: stages at which the tree branches, 0 = nominal.
    slack_price, slack_price_l2: (2, n_x) or scalars, of a violation of X_LOW (first row) and X_HIGH and of its square, per physical
    unit; an infinite slack_price makes a bound hard, 0 for both ignores it.
    change_weight: (n_u,), price of the squared change of each action.
    solver: "ipopt", or "fatrop" for robust_horizon = 0.
    law, control_horizon: CasADi function (x, goal) -> u that the actions follow from that stage on, or None.
    guide: another controller for the same plant, of a shorter horizon: its simulated closed loop is the first guess, or None.
    """

    def __init__(self, plant, horizon, scenarios, stage_cost, terminal_cost=None, *, goal, robust_horizon=0, discretization="rk4",
                 slack_price=1.0, slack_price_l2=0.0, change_weight=None, gamma=1.0, law=None, control_horizon=None, solver="ipopt",
                 guide=None, tol=1e-6, max_iter=500, compile=True):  # fmt: skip
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}; it must be at least 1")
        if control_horizon is not None and control_horizon < horizon and law is None:
            raise ValueError(f"control_horizon is {control_horizon}, but there is no law that the actions follow from there on")
        if solver == "fatrop" and robust_horizon:
            raise ValueError("solver fatrop needs robust_horizon 0: its stages must have one node each")
        self.plant, self.horizon, self.robust_horizon, self.discretization = plant, horizon, robust_horizon, discretization
        self.scenarios = np.asarray(scenarios if robust_horizon else scenarios[:1])
        self.stage_cost, self.terminal_cost = stage_cost, terminal_cost
        self.n_x, self.n_u, self.n_goal = len(plant.X_LOW), len(plant.U_LOW), len(plant.GOAL_INDEX)
        self.x_center, self.x_scale = (plant.INIT_LOW + plant.INIT_HIGH) / 2, (plant.INIT_HIGH - plant.INIT_LOW) / 2
        self.u_center, self.u_scale = (plant.U_LOW + plant.U_HIGH) / 2, (plant.U_HIGH - plant.U_LOW) / 2
        bounds = np.array([plant.X_LOW, plant.X_HIGH])
        self.slack_price = np.where(np.isinf(bounds), 0.0, np.broadcast_to(slack_price, bounds.shape))
        self.slack_price_l2 = np.where(np.isinf(bounds), 0.0, np.broadcast_to(slack_price_l2, bounds.shape))
        self.hard_bounds = np.where(np.isinf(self.slack_price), bounds, [[-np.inf], [np.inf]])
        self.change_weight = np.zeros(self.n_u) if change_weight is None else np.asarray(change_weight, dtype=float)
        self.solver, self.guide, self.gamma = solver, guide, gamma
        self.law, self.control_horizon = law, horizon if control_horizon is None else control_horizon
        self.lifted = solver == "fatrop" and self.change_weight.any()  # fatrop's stages must not reach back: carry u_{t-1} as a state
        self._build_tree()
        self._build_layout()
        self._build_problem()
        self._build_solvers(compile, tol, max_iter)
        self.set_goal(goal)
        self.reset()

    def _build_tree(self):
        """nodes[t]: how many. Over all nodes, stage by stage: stage, weight; over all but the root: parent (among all nodes), psi."""
        S, R = len(self.scenarios), self.robust_horizon
        self.nodes = [S ** min(t, R) for t in range(self.horizon + 1)]
        first = np.concatenate([[0], np.cumsum(self.nodes)])
        order = [np.arange(n) for n in self.nodes]
        self.parent = np.concatenate([first[t] + (order[t + 1] // S if t < R else order[t + 1]) for t in range(self.horizon)])
        self.stage = np.repeat(np.arange(self.horizon + 1), self.nodes)  # of every node, the root included
        self.psi = self.scenarios[np.concatenate(order[1:]) % S].T  # (n_psi, nodes)
        self.weight = self.gamma**self.stage / np.array(self.nodes)[self.stage]

    def _build_layout(self):
        """Where each block (name, stage) lies in w or g: stage after stage, as fatrop needs it and IPOPT does not mind."""
        priced = np.isfinite(self.slack_price) & (self.slack_price + self.slack_price_l2 > 0)
        self.soft = [np.flatnonzero(p) for p in priced]  # states with slack below, above
        self.index, self.size, slacks = {}, {"w": 0, "g": 0}, sum(map(len, self.soft))

        def block(vector, name, t, rows, nodes):
            """index[name][t]: (rows, nodes) positions."""
            self.index.setdefault(name, {})[t] = self.size[vector] + np.arange(rows * nodes).reshape(nodes, rows).T
            self.size[vector] += rows * nodes

        for t, n in enumerate(self.nodes):
            inner, n_next = t < self.horizon, self.nodes[min(t + 1, self.horizon)]
            block("w", "x", t, self.n_x, n)
            if self.lifted:
                block("w", "u_before", t, self.n_u, n)
            if inner:
                block("w", "u", t, self.n_u, n)
                block("g", "dynamics", t, self.n_x, n_next)
                if self.lifted:
                    block("g", "carried", t, self.n_u, n_next)
                if t >= self.control_horizon:
                    block("g", "law", t, self.n_u, n)
                if self.discretization == "radau":
                    block("w", "inside", t, self.n_x * RADAU_DEGREE, n_next)
                    block("g", "collocation", t, self.n_x * RADAU_DEGREE, n_next)
            if t == 0:
                block("g", "start", t, self.n_x + (self.n_u if self.lifted else 0), 1)
            else:
                block("w", "slack", t, slacks, n)
                block("g", "box", t, slacks, n)

    def positions(self, name):
        """Positions of the block `name` of all stages, (rows, nodes of all stages)."""
        return np.hstack(list(self.index[name].values()))

    def _build_problem(self):
        """Variables, constraints and objective of the problem in the docstring, all nodes of the tree at once.

        Everything is in units of the boxes of initial states and actions, but for what the cost and model functions see.
        """
        w, x_now, u_now = ca.MX.sym("w", self.size["w"]), ca.MX.sym("x_now", self.n_x), ca.MX.sym("u_now", self.n_u)
        goal = ca.MX.sym("goal", self.n_goal, self.horizon)  # a column per stage 1 ... N
        lbw, ubw = np.full(self.size["w"], -np.inf), np.full(self.size["w"], np.inf)
        g, J, children, stage = [], 0, slice(1, None), self.stage[1:]

        def variable(name, low=-np.inf, high=np.inf):
            at = self.positions(name)
            lbw[at], ubw[at] = np.transpose([low]), np.transpose([high])
            return ca.reshape(w[at.ravel("F").tolist()], *at.shape)

        # u_t at every node that has children, and x_t at every node; hard bounds from x_1 on: x_0 is measured
        u = variable("u", -np.ones(self.n_u), np.ones(self.n_u)) * self.u_scale + self.u_center
        x_scaled = variable("x", *((self.hard_bounds - self.x_center) / self.x_scale))
        lbw[self.index["x"][0]], ubw[self.index["x"][0]] = -np.inf, np.inf
        x = x_scaled * self.x_scale + self.x_center
        parents = self.parent.tolist()
        # x_0 = s, x_{t+1} = f(x_t, u_t, psi)
        start = [(x[:, 0] - x_now) / self.x_scale]
        model, n = self._model(), len(parents)
        if self.discretization == "radau":
            inside = variable("inside")
            x_next, residual = model.map(n)(x[:, parents], u[:, parents], self.psi, inside)
            g.append(("collocation", residual))
        else:
            x_next = model.map(n)(x[:, parents], u[:, parents], self.psi)
        g.append(("dynamics", x_scaled[:, children] - (x_next - self.x_center) / self.x_scale))
        # X_LOW <= x + below, x - above <= X_HIGH, slack >= 0, with its price
        weight = ca.DM(self.weight[children]).T
        if self.positions("slack").size:
            slack, (below, above) = variable("slack", 0.0), self.soft
            scale = np.concatenate([self.x_scale[below], self.x_scale[above]])
            edges = [(self.plant.X_LOW - self.x_center) / self.x_scale, (self.x_center - self.plant.X_HIGH) / self.x_scale]
            distance = ca.vertcat(x_scaled[below.tolist(), children], -x_scaled[above.tolist(), children])
            g.append(("box", distance + slack - np.concatenate([edges[0][below], edges[1][above]])))
            price, price_l2 = (np.concatenate([p[0][below], p[1][above]]) for p in (self.slack_price, self.slack_price_l2))
            J += weight @ (ca.DM(price * scale).T @ slack + ca.DM(price_l2 * scale**2).T @ slack**2).T
        # stage cost at x_1 ... x_N, or at (x_0, u_0) ... (x_{N-1}, u_{N-1}); terminal cost at every leaf
        inner = u.shape[1]  # nodes with children; x_0 has the goal of x_1
        goal_inner = goal[:, np.maximum(self.stage[:inner] - 1, 0).tolist()]
        if self.stage_cost.n_in() == 2:
            J += weight @ self.stage_cost.map(n)(x[:, children], goal[:, (stage - 1).tolist()]).T
        else:
            J += ca.DM(self.weight[:inner]).T @ self.stage_cost.map(inner)(x[:, :inner], u, goal_inner).T
        if self.terminal_cost is not None:
            leaves = np.flatnonzero(self.stage == self.horizon).tolist()
            terminal = self.terminal_cost.map(len(leaves))(x[:, leaves], ca.repmat(goal[:, -1], 1, len(leaves)))
            J += ca.DM(self.weight[leaves]).T @ terminal.T
        # u_t = law(x_t), N_c <= t
        if self.control_horizon < self.horizon:
            late = np.flatnonzero(self.stage[:inner] >= self.control_horizon).tolist()
            g.append(("law", (u[:, late] - self.law.map(len(late))(x[:, late], goal_inner[:, late])) / self.u_scale))
        # change of the actions
        if self.change_weight.any():
            before = self.parent[: inner - 1].tolist()  # the parent of every node with children, but for the root
            u_before = ca.horzcat(u_now, u[:, before])
            if self.lifted:
                carried = variable("u_before") * self.u_scale + self.u_center
                g.append(("carried", (carried[:, children] - u[:, parents]) / self.u_scale))
                start.append((carried[:, 0] - u_now) / self.u_scale)
                u_before = carried[:, :inner]
            J += ca.DM(self.weight[:inner]).T @ (ca.DM(self.change_weight).T @ (u - u_before) ** 2).T
        g.append(("start", ca.vertcat(*start)))
        order = np.argsort(np.concatenate([self.positions(name).ravel("F") for name, _ in g]))
        self.nlp = {"x": w, "p": ca.veccat(x_now, u_now, goal), "f": J, "g": ca.veccat(*(value for _, value in g))[order.tolist()]}
        ubg = np.zeros(self.size["g"])
        ubg[self.positions("box")] = np.inf
        self.bounds = {"lbx": lbw, "ubx": ubw, "lbg": np.zeros_like(ubg), "ubg": ubg}

    def _model(self):
        """Prediction over one sampling time: (x, u, psi) -> x_next, or by collocation (x, u, psi, inside) -> x_next, residual."""
        plant, dt = self.plant, self.plant.DT
        x, u, psi = (ca.MX.sym(name, rows) for name, rows in (("x", self.n_x), ("u", self.n_u), ("psi", self.scenarios.shape[1])))
        if hasattr(plant, "next_state"):  # a discrete-time plant
            return ca.Function("step", [x, u, psi], [plant.next_state(x, u, psi, ca)])
        xs, us, psis = (ca.SX.sym(v.name(), v.numel()) for v in (x, u, psi))
        if self.discretization == "rk4":
            # one substep is the unit that is differentiated and compiled: unrolled, several take several times as long to compile
            h = dt / plant.MODEL_SUBSTEPS
            substep = ca.Function("substep", [xs, us, psis], [envs.rk4(plant.ode, xs, us, psis, h, 1, ca)], {"never_inline": True})
            x_next = x
            for _ in range(plant.MODEL_SUBSTEPS):
                x_next = substep(x_next, u, psi)
            return ca.Function("step", [x, u, psi], [x_next], {"never_inline": True})
        # states at the collocation points 0 < tau_1 < ... < tau_d = 1 interpolate a polynomial that satisfies the ODE there
        derivative = ca.collocation_coeff(ca.collocation_points(RADAU_DEGREE, "radau"))[0]  # (d + 1, d)
        inside = ca.SX.sym("inside", self.n_x * RADAU_DEGREE)
        points = ca.reshape(inside, self.n_x, RADAU_DEGREE) * self.x_scale + self.x_center
        slopes = ca.horzcat(xs, points) @ derivative
        field = ca.horzcat(*(plant.ode(points[:, j], us, psis, ca) for j in range(RADAU_DEGREE)))
        residual = ca.vec((slopes - dt * field) / self.x_scale)
        return ca.Function("collocation", [xs, us, psis, inside], [points[:, -1], residual], {"never_inline": True})

    def _build_solvers(self, compile, tol, max_iter):
        """The solver twice on the same functions: from scratch, and (IPOPT) from a nearby solution with its multipliers."""
        cold = {"print_level": 0, "sb": "yes", "tol": tol, "max_iter": max_iter, "bound_relax_factor": 0.0}
        warm = cold | {"warm_start_init_point": "yes", "mu_init": 1e-7, "warm_start_bound_push": 1e-6, "warm_start_mult_bound_push": 1e-6,
                       "warm_start_slack_bound_push": 1e-6, "warm_start_bound_frac": 1e-6, "warm_start_slack_bound_frac": 1e-6}  # fmt: skip

        def options(name):
            common = {"print_time": False, "show_eval_warnings": False}
            if self.solver == "ipopt":
                return common | {"ipopt": warm if name == "warm" else cold}
            structure = {"structure_detection": "auto", "equality": (self.bounds["ubg"] == 0).tolist()}
            return common | structure | {"fatrop": {"print_level": 0, "tol": tol, "max_iter": max_iter}}

        self.solvers = compiled_solver(self.solver, self.nlp, options) if compile else None
        self.compiled = self.solvers is not None
        if not self.compiled:
            self.solvers = {name: ca.nlpsol(name, self.solver, self.nlp, options(name)) for name in ("cold", "warm")}
        # shifting by one sampling time: block (name, t) takes what stands at (name, t + 1), channel by channel
        self.shift = {"w": np.arange(self.size["w"]), "g": np.arange(self.size["g"])}
        for name, stages in self.index.items():
            shift = self.shift["g" if name in ("dynamics", "carried", "law", "collocation", "box") else "w"]
            for t, here in stages.items():
                if t + 1 in stages and name != "start":
                    shift[here] = stages[t + 1][:, : here.shape[1]]  # under the first scenarios, where the tree branches

    def reset(self):
        """Forget the previous plan and the last action, as at the start of an episode."""
        self.u_before = np.zeros(self.n_u)  # do-mpc's convention for the input-change penalty
        self.plan = None  # (w, lam_x, lam_g) of the last successful solve, shifted by one step after each use
        self.plan_left = 0  # actions that it still holds
        self.last_w = None
        self.stats = {}

    def set_goal(self, goal):
        """The goal from now on: (n_goal,), or (n_goal, N) for one that changes over the horizon, a column per stage 1 ... N."""
        goal = np.asarray(goal, dtype=float)
        if goal.shape not in ((self.n_goal,), (self.n_goal, self.horizon)) or not np.isfinite(goal).all():
            raise ValueError(f"goal is {goal}; it must be finite, of shape ({self.n_goal},) or ({self.n_goal}, {self.horizon})")
        self.goal = np.broadcast_to(goal.reshape(self.n_goal, -1), (self.n_goal, self.horizon))

    def set_initial_guess(self, x0):
        """Forget the previous plan: the next solve starts from the first of `cold_guesses`."""
        envs.checked_state(self.plant, x0)
        self.plan, self.plan_left = None, 0

    def hold_guess(self, x0):
        """w with the start state held at every node and the middle action."""
        w = np.zeros(self.size["w"])
        scaled = (x0 - self.x_center) / self.x_scale
        w[self.positions("x")] = scaled[:, None]
        if self.discretization == "radau":
            w[self.positions("inside")] = np.tile(scaled, RADAU_DEGREE)[:, None]
        return w

    def rollout_guess(self, x0, action):
        """w with the actions `action(t, x)` and the motion of the nominal plant under them, the same under every scenario."""
        w, x = self.hold_guess(x0), np.asarray(x0)
        for t in range(self.horizon):
            u = action(t, x)
            x = self.plant.step(x, u, self.scenarios[0])
            scaled = (x - self.x_center) / self.x_scale
            w[self.index["u"][t]] = ((u - self.u_center) / self.u_scale)[:, None]
            w[self.index["x"][t + 1]] = scaled[:, None]
            if self.discretization == "radau":
                w[self.index["inside"][t]] = np.tile(scaled, RADAU_DEGREE)[:, None]
        return w

    def drift_guess(self, x0):
        """w with the last action held."""
        return self.rollout_guess(x0, lambda t, x: self.u_before)

    def guided_guess(self, x0):
        """w with the closed loop of the guide: a long problem left to itself often ends in a plan that puts its task off."""

        def action(t, x):
            self.guide.set_goal(self.goal[:, t])
            return self.guide.make_step(x)

        self.guide.reset()
        self.guide.u_before = self.u_before
        return self.rollout_guess(x0, action)

    def baseline_guess(self, x0):
        """w with the closed loop under the plant's own feedback, which saves iterations."""
        return self.rollout_guess(x0, lambda t, x: self.plant.baseline(x, self.goal[:, t]))

    def cold_guesses(self):
        """The guess that an episode starts from, and another one for when that fails."""
        if self.guide is not None:
            return self.guided_guess, self.hold_guess
        return (self.baseline_guess, self.hold_guess) if hasattr(self.plant, "baseline") else (self.hold_guess, self.drift_guess)

    def physical(self, w, name, t):
        """States ("x") or actions ("u") of stage t in w, physical units, (rows, nodes)."""
        center, scale = (self.x_center, self.x_scale) if name == "x" else (self.u_center, self.u_scale)
        return w[self.index[name][t]] * scale[:, None] + center[:, None]

    def _solve(self, which, x0, guess, lam_x=0, lam_g=0):
        """One call of the solver: (w, lam_x, lam_g) if it succeeded, else None. An unsuccessful iterate is not returned."""
        guess = guess.copy()
        guess[self.index["x"][0][:, 0]] = (x0 - self.x_center) / self.x_scale
        parameters = np.concatenate([x0, self.u_before, self.goal.ravel("F")])
        result = self.solvers[which](x0=guess, p=parameters, lam_x0=lam_x, lam_g0=lam_g, **self.bounds)
        self.last_objective = float(result["f"])
        stats = self.solvers[which].stats()
        self.stats["status"] = str(stats["return_status"])
        self.stats["iterations"] += stats["iter_count"]
        if not stats["success"] or not np.isfinite(self.last_objective):
            return None
        return tuple(np.array(result[key]).ravel() for key in ("x", "lam_x", "lam_g"))

    def make_step(self, x0):
        """The action (n_u,) for the measured state x0 (n_x,), physical units. Raises ValueError for a state that is not one.

        Ladder: a solve from the shifted previous plan, or at first from a cold guess; if it does not succeed, one more from a guess
        that was not tried yet; then the next action of the last successful plan, while it lasts; then the last action. `stats` says which.
        """
        x0, tick = envs.checked_state(self.plant, x0), time.perf_counter()
        self.stats = {"success": True, "rung": "solved", "status": "", "iterations": 0}
        first, other = self.cold_guesses()
        if self.plan is None:
            solution = self._solve("cold", x0, first(x0))
        else:
            solution, other = self._solve("warm", x0, *self.plan), self.hold_guess if first == self.guided_guess else first
        if solution is None:
            self.stats |= {"success": False, "rung": "retry"}
            solution = self._solve("cold", x0, other(x0))
        if solution is not None:
            self.last_w, self.plan_left = solution[0], self.horizon
        elif self.plan_left > 0 and np.isfinite(self.plan[0]).all():
            self.stats["rung"], solution = "plan", self.plan
        if solution is not None:
            self.u_before = np.clip(self.physical(solution[0], "u", 0)[:, 0], self.plant.U_LOW, self.plant.U_HIGH)
            self.plan = tuple(v[self.shift[vector]] for v, vector in zip(solution, ("w", "w", "g")))
            self.plan_left -= 1
        else:
            self.stats["rung"], self.plan = "hold", None
            self.u_before = np.clip(self.u_before, self.plant.U_LOW, self.plant.U_HIGH)
        self.stats["wall_ms"] = 1e3 * (time.perf_counter() - tick)
        return self.u_before.copy()

    def prediction(self):
        """The last successful plan, physical units: lists over stages of states (n_x, nodes) from x_1 on and of actions (n_u, nodes)."""
        if self.last_w is None:
            raise ValueError("there is no prediction before the first successful make_step")
        stages = range(self.horizon)
        return {"x": [self.physical(self.last_w, "x", t + 1) for t in stages], "u": [self.physical(self.last_w, "u", t) for t in stages]}


# Goals and objective


def goal_schedule(plant, texts, steps):
    """The goal at each of x_1 ... x_steps, (steps, n_goal), from texts such as ("up-up", "0,3.14@100"). Raises ValueError, one sentence."""
    named, first, goals = getattr(plant, "GOALS", {}), -1, np.empty((steps, len(plant.GOAL_INDEX)))
    for text in texts or [",".join(map(str, plant.EVAL_GOAL))]:
        value, _, when = text.partition("@")
        try:
            goal = np.array(named[value] if value in named else [float(number) for number in value.split(",")])
            start = int(when) if when else -1
        except ValueError:
            goal, start = np.empty(0), -1
        if goal.shape != plant.EVAL_GOAL.shape:
            allowed = ", ".join(named) + " or " * bool(named) + f"{len(plant.EVAL_GOAL)} number(s) joined by commas"
            raise ValueError(f"--goal {text} is not a goal of {plant.ENV_ID}; it must be {allowed}")
        if not ((plant.GOAL_LOW <= goal) & (goal <= plant.GOAL_HIGH)).all():
            low, high = (np.array2string(bound, threshold=4, edgeitems=1) for bound in (plant.GOAL_LOW, plant.GOAL_HIGH))
            raise ValueError(f"--goal {text} is out of range; it must lie in {low} to {high}")
        if first < 0 and not when:
            start = 0
        if not (first < start < steps and (first >= 0 or start == 0)):
            raise ValueError(f"--goal {text} needs @STEP, increasing from goal to goal and below {steps}; the first goal starts at 0")
        goals[start:], first = goal, start
    return goals


def costs(plant, objective, sigma2=None, gamma=1.0):
    """Stage and terminal cost (or None) of `--objective`, for ScenarioMPC. Raises ValueError if the plant does not define it.

    A plant with a linear-quadratic regulator has costs l(x, u) and V(x) = x'Px; its objective goal is that of eq:jensen, -exp(-l) and
    -exp(-V) at the default sigma^2 = 1/2.
    """
    sym = ca.MX.sym if hasattr(plant, "lqr") else ca.SX.sym  # matrix products stay matrix products
    x, u, goal = (sym(name, n) for name, n in (("x", len(plant.X_LOW)), ("u", len(plant.U_LOW)), ("goal", len(plant.GOAL_INDEX))))
    sigma2 = plant.MPC_SIGMA2 if sigma2 is None else sigma2

    def shaped(cost):
        return -ca.exp(-cost / (2 * sigma2)) if objective == "goal" else cost

    if objective == "expert":
        if not hasattr(plant, "expert_cost"):
            raise ValueError(f"--objective expert is not defined for {plant.ENV_ID}; choose quadratic or goal")
        return ca.Function("stage", [x, goal], [plant.expert_cost(x, ca)], {"never_inline": True}), None
    if hasattr(plant, "lqr"):
        stage = ca.Function("stage", [x, u, goal], [shaped(plant.lq_cost(x, u, goal))], {"never_inline": True})
        return stage, ca.Function("terminal", [x, goal], [shaped(plant.lq_value(x, goal, gamma))], {"never_inline": True})
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], goal, ca))
    cost = shaped(squared_error) if objective == "goal" else squared_error / 2
    return ca.Function("stage", [x, goal], [cost], {"never_inline": True}), None


def feedback_law(plant, gamma=1.0):
    """CasADi function (x, goal) -> u of the plant's linear-quadratic regulator, without limits."""
    x, goal = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
    return ca.Function("law", [x, goal], [plant.feedback(x, goal, gamma)])


def scenario_set(plant, name):
    """Parameters (S, n_psi) of the plant's scenario set, the nominal ones first, whether the set has them or not."""
    scenarios = plant.SCENARIOS[name]
    return np.concatenate([plant.PSI_NOMINAL[None], scenarios[(scenarios != plant.PSI_NOMINAL).any(axis=1)]])


def build_controller(args):
    """The controller that the arguments describe, for the plant's evaluation goal."""
    plant = envs.load(args.env, dim=args.dim, system=args.system)
    guide = build_controller(replace(args, horizon=args.guide_horizon, guide_horizon=0)) if args.guide_horizon else None
    change_weight = plant.EXPERT_CHANGE_WEIGHT if args.change_weight is None and args.objective == "expert" else args.change_weight
    law = feedback_law(plant, args.gamma) if args.control_horizon is not None else None
    return ScenarioMPC(plant, args.horizon, scenario_set(plant, args.scenarios),
                       *costs(plant, args.objective, args.sigma2, args.gamma), goal=plant.EVAL_GOAL, gamma=args.gamma, law=law,
                       control_horizon=args.control_horizon, robust_horizon=args.robust_horizon, discretization=args.discretization,
                       slack_price=np.inf if args.constraints == "hard" else args.slack_weight, slack_price_l2=args.slack_weight_l2,
                       change_weight=change_weight, solver=args.solver, guide=guide,
                       compile=args.compile and not hasattr(plant, "next_state"))  # fmt: skip


# Closed loop


def simulate(mpc, x0, psi, goals, preview=False, progress=None):
    """One episode on a plant with fixed parameters psi under goals (steps, n_goal).

    Returns x (steps + 1, n_x), u (steps, n_u), the predictions under the nominal scenario (steps, N + 1, n_x) and the controller's stats.
    """
    mpc.reset()
    mpc.set_initial_guess(x0)
    x, u, predicted, log = [np.asarray(x0, dtype=float)], [], [], []
    for t in range(len(goals)):
        ahead = np.minimum(t + np.arange(mpc.horizon), len(goals) - 1) if preview else np.full(mpc.horizon, t)
        mpc.set_goal(goals[ahead].T)
        u.append(mpc.make_step(x[-1]))
        log.append(mpc.stats)
        tail = [s[:, 0] for s in mpc.prediction()["x"]] if mpc.stats["rung"] in ("solved", "retry") else [x[-1]] * mpc.horizon
        predicted.append([x[-1], *tail])
        x.append(mpc.plant.step(x[-1], u[-1], psi))
        if progress is not None:
            progress.update()
    return np.array(x), np.array(u), np.array(predicted), log


def summary(plant, x, u, goals, log):
    """The measures of an episode: time near goal over x_1 ..., sum of absolute changes of the actions from 0 on, solve times, failures.

    The changes are in the physical unit of a single action; of several, each is counted in units of its range.
    """
    unit = 1.0 if len(plant.U_LOW) == 1 else plant.U_HIGH - plant.U_LOW
    milliseconds = np.array([s["wall_ms"] for s in log])
    row = {
        "time_near_goal": envs.goal_reward(plant, x[1:, plant.GOAL_INDEX], goals, sigma2=METRIC_SIGMA2).sum(),
        "action_total_variation": np.abs(np.diff(u / unit, axis=0, prepend=0.0)).sum(),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "solve_ms_max": milliseconds.max(),
    }
    return {name: round(float(value), 6) for name, value in row.items()} | {"solver_failures": sum(not s["success"] for s in log)}


def start_and_plant(plant, seed, random_plant):
    """Start state (n_x,) and plant parameters (n_psi,) of the episode with this seed."""
    rng = np.random.default_rng([seed, 4])
    x0 = plant.START + plant.START_NOISE * rng.uniform(-1, 1, size=len(plant.START))
    return x0, rng.choice(plant.EVAL_PSI) if random_plant else plant.PSI_NOMINAL


# Table and figure


def write_csv(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_suffix(".tmp"), "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    path.with_suffix(".tmp").replace(path)


def table(rows):
    """The episodes as text, and their median."""
    columns = {"time_near_goal": "near goal", "action_total_variation": "action TV", "solve_ms_median": "ms median", "solve_ms_p95": "p95",
               "solve_ms_max": "max", "solver_failures": "failed"}  # fmt: skip
    lines = ["seed    " + "".join(f"{title:>11s}" for title in columns.values())]
    lines += [f"{row['seed']:<8d}" + "".join(f"{row[key]:11.1f}" for key in columns) for row in rows]
    if len(rows) > 1:
        lines.append("median  " + "".join(f"{np.median([row[key] for row in rows]):11.1f}" for key in columns))
    return "\n".join(lines)


def fail(message):
    """A user's mistake: one sentence, exit code 2, no traceback."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check(args):
    """Refuse arguments that cannot work, before anything long starts; returns plant and goals (steps, n_goal)."""
    ranges = {"horizon": (1, 1000), "robust_horizon": (0, 10), "episodes": (1, 10**6), "steps": (1, 10**6), "seed": (0, 10**9),
              "guide_horizon": (0, 1000), "gamma": (1e-3, 1), "sigma2": (1e-9, 1e9), "slack_weight": (0, 1e6),
              "slack_weight_l2": (0, 1e6)}  # fmt: skip
    for name, (least, most) in ranges.items():
        value = getattr(args, name)
        if value is not None and not least <= value <= most:  # catches nan too
            fail(f"--{name.replace('_', '-')} is {value}; it must lie in [{least:g}, {most:g}]")
    try:
        plant = envs.load(args.env, dim=args.dim, system=args.system)
        costs(plant, args.objective)
        goals = goal_schedule(plant, args.goal, args.steps)
    except ValueError as error:
        fail(error)
    if args.control_horizon is not None and not hasattr(plant, "lqr"):
        fail(f"--control-horizon is {args.control_horizon}, but {args.env} has no linear feedback to follow beyond it")
    if args.control_horizon is not None and not 0 <= args.control_horizon <= args.horizon:
        fail(f"--control-horizon is {args.control_horizon}; it must lie in 0 to --horizon {args.horizon}")
    if args.discretization == "radau" and hasattr(plant, "next_state"):
        fail(f"--discretization radau needs a differential equation; {args.env} is a discrete-time plant")
    if args.scenarios not in plant.SCENARIOS:
        fail(f"--scenarios {args.scenarios} is not a scenario set of {args.env}; choose one of {', '.join(plant.SCENARIOS)}")
    leaves = len(scenario_set(plant, args.scenarios)) ** min(args.robust_horizon, args.horizon)
    if leaves * args.horizon > 20_000:
        fail(f"--robust-horizon {args.robust_horizon} gives a tree of {leaves} leaves; leaves times --horizon may be 20000 at most")
    if not args.guide_horizon < args.horizon:
        fail(f"--guide-horizon is {args.guide_horizon}; it must be below --horizon {args.horizon}")
    if args.objective == "expert" and (goals != plant.EVAL_GOAL).any():
        fail(f"--objective expert knows the goal {plant.EVAL_GOAL} only; give --goal to --objective goal or quadratic")
    if not envs.can_hold(plant, goals).all():
        print(f"warning: --goal {' '.join(args.goal)} is not a goal that every scenario can hold", file=sys.stderr)
    if args.solver == "fatrop" and args.robust_horizon:
        fail(f"--solver fatrop solves nominal problems only; --robust-horizon is {args.robust_horizon}, it must be 0")
    weights = args.change_weight
    if weights is not None and not (len(weights) == len(plant.U_LOW) and all(0 <= weight < np.inf for weight in weights)):
        fail(f"--change-weight is {weights}; it needs {len(plant.U_LOW)} number(s), each at least 0")
    without = [("sigma2", args.objective != "goal", f"--objective {args.objective}"),
               ("slack_weight", args.constraints == "hard", "--constraints hard"),
               ("slack_weight_l2", args.constraints == "hard", "--constraints hard"),
               ("scenarios", not args.robust_horizon, "--robust-horizon 0")]  # fmt: skip
    for name, unused, setting in without:
        if unused and getattr(args, name) != getattr(Args, name):
            fail(f"--{name.replace('_', '-')} {getattr(args, name)} has no effect with {setting}")
    if args.animate and not hasattr(plant, "animate"):
        fail(f"--animate needs a plant that can be drawn; {args.env} defines no animation")
    return plant, goals


def main(args):
    plant, goals = check(args)
    try:
        out = args.out or envs.new_folder(Path("runs") / f"{args.env}__goal_mpc__{args.seed}__{int(time.time())}")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        fail(f"--out {args.out or 'runs'}: cannot write there ({error.strerror})")
    tick = time.perf_counter()
    mpc = build_controller(args)
    print(f"{plant.ENV_ID}: {mpc.size['w']} variables, {mpc.size['g']} constraints, built in {time.perf_counter() - tick:.1f} s")
    rows, episodes = [], []
    settings = {name: getattr(args, name) for name in ("env", "objective", "horizon", "robust_horizon", "constraints", "solver", "gamma")}
    settings |= {"sigma2": args.sigma2 or "", "goal": " ".join(args.goal)}  # empty: the plant's
    with tqdm(total=args.episodes * args.steps, unit="step", disable=None) as bar:
        for seed in range(args.seed, args.seed + args.episodes):
            x0, psi = start_and_plant(plant, seed, args.plant == "random")
            x, u, predicted, log = simulate(mpc, x0, psi, goals, args.preview, bar)
            rows.append(settings | {"seed": seed} | summary(plant, x, u, goals, log))
            episodes.append((x, u, predicted))
    write_csv(rows, out / "results.csv")
    np.savez_compressed(out / "trajectories.npz", goals=goals, **{k: np.stack([e[i] for e in episodes]) for i, k in enumerate("xu")})
    x, u, _ = episodes[0]
    draw_episode(plant, {"closed loop": (x, u, {"color": "#0072B2"})}, goals, out / "episode.png")
    if args.animate:
        plant.animate(*episodes[0], goals, out / "episode.gif")
    print(table(rows))
    print(f"{out}/results.csv, trajectories.npz, episode.png" + ", episode.gif" * args.animate)
    return rows


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program at once; CasADi would take it for a failed solve
    main(tyro.cli(Args, description=__doc__))
