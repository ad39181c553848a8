# /// script
# requires-python = ">=3.11"
# dependencies = ["torch==2.13.0", "casadi==3.8.2", "gymnasium==1.4.0", "scipy", "tyro", "matplotlib", "tqdm"]
# ///
"""The deployed controller: short-horizon scenario MPC whose terminal cost is a learned critic (eq:QMPC).

    minimise over u   sum_i w_i { sum_{t=1}^N [ p'|eps_t^i| - exp(-|g - x_t^i|^2 / (2 sigma^2)) ] - V(x_N^i, g) }
    subject to        x_{t+1}^i = f(x_t^i, u_t^i, psi^i),  x_t^i - eps_t^i in X,  u_t^i in U,  u_0^i = u_0^j

with V(x, g) = Q(x, mu(x, g), g) from a checkpoint of sac_her_branching.py, rebuilt in CasADi. The sums start at
x_1: what x_0 earns is a constant, and V(x_N) counts rewards from x_{N+1} on. (x_0^i, psi^i) and the weights w_i are
the measured state with the plant's scenarios, or what an estimator does not know. A price of changes of the actions
and an economic cost of the plant may be added. `ScenarioMPC` improves its plan step by step and may be stopped at
any time. The controller is compared, on paired draws of start state and plant, with the actor alone and with nominal
and robust MPC.

    python rl_mpc_deploy.py --horizon 5                                     # the critic that the repository ships
    python rl_mpc_deploy.py --critic experiments/pretrained/cstr_robust.pt  # the paper's, blind to constraints
    python rl_mpc_deploy.py --horizon 5 --critic runs/NAME/checkpoint.pt    # your own
    python rl_mpc_deploy.py --offset-free                                   # an estimate takes the offset
    python rl_mpc_deploy.py --horizon 0 --episodes 20 --goal 0.7            # the critic's best action
    python rl_mpc_deploy.py --horizon 5 --export-c controller               # the controller in C

It writes `runs/{env}__rl_mpc_deploy__{seed}__{time}/`: results.csv (a row per controller and episode),
trajectories.npz and episode.png. Only the folder `envs/` is needed beside this file, and a checkpoint.
"""

import json
import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import torch
import tyro

import envs
from envs.agents.checkpoint import read_checkpoint
from envs.control.compiled import OnArrays, compiled_functions
from envs.control.controllers import ActorController, Controller, GreedyController, call, checked_problem
from envs.control.estimation import build_estimator
from envs.control.expansion import check_export, expansion
from envs.control.export import export_c
from envs.control.model import prediction_model, scaling
from envs.control.tree_qp import ScenarioTree, tree_qp
from envs.script.arguments import as_annotated, check_effects, check_ranges, check_weights
from envs.script.comparison import draws, output_folder, parallel, run_episode, table, write_csv
from envs.script.figure import draw_episode

# arguments that results.csv has columns for, or that change no result
ELSEWHERE = {"env", "horizon", "critic", "goal", "seed", "episodes", "jobs", "controllers", "compile", "out"}
HARD_PRICE = 1e3  # of a hard bound per physical unit: above the multipliers, so that it is an exact penalty
Name = Literal["actor", "nominal_mpc", "robust_mpc", "goal_mpc", "rl_mpc"]
LABELS = {"actor": "RL (actor alone)", "nominal_mpc": "nominal MPC", "robust_mpc": "robust MPC"}
LABELS |= {"goal_mpc": "RL+MPC, no value", "rl_mpc": "RL+MPC"}
COLOURS, DASHES = "#D55E00 #999999 #0072B2 #E69F00 #009E73".split(), ("--", ":", "-.", (0, (4, 1, 1, 1)), "-")
STYLES = {name: {"color": colour, "ls": dashes} for name, colour, dashes in zip(LABELS, COLOURS, DASHES)}


@dataclass(frozen=True)
class Args:
    env: str = "cstr"
    """the plant that the critic was trained on: NAME of a module envs/NAME.py; the checkpoint names its size"""
    horizon: int = 5
    """prediction steps N of RL+MPC; 0: the action that maximises the critic, no prediction"""
    critic: Path | None = None
    """a checkpoint.pt of a script that trains, or latest: the newest of this plant in runs/. Default: what
    experiments/pretrained/ has of {env}_constrained.pt, {env}_robust.pt and {env}_planner.pt, in this order (cstr: the
    first knows the price of constraints, the second is the paper's)"""
    goal: tuple[float, ...] | None = None
    """what to hold (cstr: c_B in mol/l); default: the plant's evaluation goal"""
    episodes: int = 16
    """paired draws of start state and plant parameters"""
    steps: int = 100
    """sampling times per episode"""
    starts: Literal["box", "start"] = "box"
    """where the draws begin: anywhere in the plant's box of initial states, or near its start state"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes; the results do not depend on it, but for the times"""

    robust_horizon: int | None = None
    """RL+MPC: stages at which the scenario tree branches, 0: one model, the nominal or the estimated one; default: 1,
    or what the checkpoint says"""
    sigma: float | None = None
    """RL+MPC: width of the Gaussian stage cost, units of the goal; default: the plant's, or what the checkpoint says
    (cstr: 0.1 as in the paper's script; its text says 0.25)"""
    slack_weight: float | None = None
    """RL+MPC: price of a constraint violation, per physical unit (mol/l, degC) and step; default: 2 with a critic
    that was trained with --constraint-weight, 1 with one that was not, as in the paper, or what it says"""
    constraints: Literal["soft", "hard"] = "soft"
    """RL+MPC: hard bounds are violated only where every plan violates them"""
    change_weight: tuple[float, ...] | None = None
    """RL+MPC: price of the squared change of each action; default: 0. It decides where several ones hold a goal"""
    combine: Literal["min", "first", "mean"] | None = None
    """which of the twin critics V takes; default: the first, or what the checkpoint says; --horizon 0: the minimum"""
    iterations: int = 5
    """every planner: the most per step; each lowers the plan's cost"""
    deadline_ms: float | None = None
    """every planner: no iteration begins later than this after its step began; default: none, since it makes
    results depend on the machine"""
    measure: tuple[str, ...] | None = None
    """which states are measured, by name, or "sensors": the plant's MEASURED; default: all. What is not needs an estimator"""
    noise: float = 0.0
    """standard deviation of the simulated sensors, a share of each state's range; the estimators know it"""
    estimator: Literal["none", "ekf", "particles"] = "none"
    """what tells state and plant from measurements: an extended Kalman filter, or particles"""
    offset_free: bool = False
    """no steady-state offset: short for --estimator ekf --spread 0.5"""
    spread: float | None = None
    """size of the scenario set about its centre; default: the plant's, 1; with --estimator what that does not know"""
    controllers: tuple[Name, ...] = ("actor", "nominal_mpc", "robust_mpc", "rl_mpc")
    """which controllers to compare; goal_mpc: RL+MPC's problem without the learned value"""
    compile: bool = True
    """translate the planners to C and compile them once (kept in $XDG_CACHE_HOME/rlmpc, or ~/.cache/rlmpc)"""
    out: Path | None = None
    """folder of the results; default: runs/{env}__rl_mpc_deploy__{seed}__{time}"""
    export_c: Path | None = None
    """a folder: write RL+MPC into it as C code, and compare nothing"""

    __post_init__ = as_annotated


# The learned value


class Critic:
    """Actor and twin critics of a checkpoint, in float64: a solver needs less noise than float32 has at |V| = 40.

    actor, twins: (W, b) of every layer, b a column, of the policy's mean and of both critics.
    """

    def __init__(self, data, combine=None):
        options = dict(data.get("plant_options", {}))
        self.mismatch_scale = options.pop("observe_mismatch", None)  # of a critic that observes the mismatch
        self.plant = envs.load(data["env"], **options)
        self.goal_input, self.combine = data["goal_input"], combine or data.get("combine", "first")
        # what a plan that ends in this value does unless told otherwise
        self.plan = dict(robust_horizon=1, sigma2=self.plant.MPC_SIGMA2, discount=1.0)
        self.plan |= dict(slack_weight=2.0 if data["args"].get("constraint_weight") else 1.0)
        self.plan |= data.get("plan", {})
        items = data["scaling"].items()  # affine maps between physical and network units
        self.scaling = {k: np.array(v, dtype=int if k.endswith("index") else float) for k, v in items}
        n_u, sizes = data["network"]["n_u"], [data["network"]["n_in"], *data["network"]["hidden"]]
        actor, critic = ({k: v.double().numpy() for k, v in data[net].items()} for net in ("actor", "critic"))
        names = [*(f"layers.{i}" for i in range(len(sizes) - 1)), "head"]
        actor = [(actor[f"{name}.weight"], actor[f"{name}.bias"][:, None]) for name in names]
        self.actor = [*actor[:-1], tuple(part[:n_u] for part in actor[-1])]  # the rest: standard deviations
        pairs = [(critic[f"weight.{i}"], critic[f"bias.{i}"]) for i in range(len(sizes))]
        self.twins = [[(w[j].T, b[j].T) for w, b in pairs] for j in range(2)]
        # what torch would refuse, and what is no use
        shapes = [(w.shape, b.shape) for layers in (actor, *self.twins) for w, b in layers]
        wanted = [[*sizes, 2 * n_u], *[[sizes[0] + n_u, *sizes[1:], 1]] * 2]
        fit = shapes == [((m, n), (m, 1)) for widths in wanted for n, m in zip(widths, widths[1:])]
        if not fit:
            raise ValueError("networks that do not fit")
        value = call(export(self)[2], self.plant.START, self.plant.EVAL_GOAL, np.zeros_like(self.plant.START))
        if not (np.isfinite(float(value)) and np.isfinite(list(self.plan.values())).all()):
            raise ValueError("values that are not finite")

    def features(self, x, goal):
        """Network input in CasADi: x (n_x,), below it the mismatch if that is observed, goal (n_goal,)."""
        s = self.scaling
        error = goal - x[s["goal_index"].tolist()]
        by_error = self.goal_input == "error"
        g = error / s["error_scale"] if by_error else (goal - s["goal_center"]) / s["goal_scale"]
        angles = ca.vertcat(x, error if by_error else goal)[s["angle_index"].tolist()]
        scaled = ca.vertcat((x - s["x_center"]) / s["x_scale"], g)[s["other_index"].tolist()]
        return ca.vertcat(scaled, ca.sin(angles), ca.cos(angles))


def load_critic(path, env, combine=None):
    """The `Critic` of a checkpoint.pt, which is data, never code. Raises ValueError for anything else."""
    return read_checkpoint(path, env, lambda data: Critic(data, combine))


def mlp(layers, h):
    """Multilayer perceptron with SiLU in CasADi."""
    for w, b in layers[:-1]:
        h = w @ h + b
        h = h * (1 + ca.tanh(h / 2)) / 2  # exp(-h) would overflow in the derivatives
    return layers[-1][0] @ h + layers[-1][1]


def export(critic):
    """CasADi functions mu(x, goal) -> u, Q(x, u, goal) and V(x, goal), physical units, float64.

    Of a critic that observes the mismatch each takes it, (n_x,), as one more argument.
    """
    s, n_x = critic.scaling, len(critic.plant.X_LOW)
    sizes = (("x", n_x), ("goal", s["goal_center"].size), ("u", s["u_center"].size), ("mismatch", n_x))
    x, goal, u, mismatch = (ca.MX.sym(*size) for size in sizes)
    seen = [mismatch] if critic.mismatch_scale else []
    z = critic.features(ca.vertcat(x, *seen), goal)
    action = ca.tanh(mlp(critic.actor, z)) * s["u_scale"] + s["u_center"]
    first, second = (mlp(twin, ca.vertcat(z, (u - s["u_center"]) / s["u_scale"])) for twin in critic.twins)
    q = {"min": ca.fmin(first, second), "first": first, "mean": (first + second) / 2}[critic.combine]
    Q = ca.Function("Q", [x, u, goal, *seen], [q])
    mu = ca.Function("mu", [x, goal, *seen], [action])
    return mu, Q, ca.Function("V", [x, goal, *seen], [Q(x, action, goal, *seen)])


# Scenario MPC


class ScenarioMPC(Controller):
    """eq:QMPC (with a learned value) or eq:multiMPCobj (without) over a scenario tree, solved anytime.

    A plan is its actions, one per node that has children; the states follow by rolling the tree out. An iteration
    linearises the dynamics about the plan, replaces the Hessian of every node's cost by its positive part, solves
    the tree's quadratic program (envs/control/c/tree_qp.c), and takes the largest share 1, 1/2, 1/4 ... of its step
    that lowers the true cost by a tenth of what the program promised. So whenever it stops,

    - the plan satisfies the dynamics and the limits of the actions,
    - and costs no more than the cheapest finite first guess: the last plan shifted by a sampling time, where the
      state has hardly moved also the last plan itself, and the policy's rollout (without one every action's middle).

    Where no guess has a finite cost the policy acts, and where that is not finite the last action stays.

    stage_cost, value: CasADi functions (x, goal) -> scalar, physical units. A plan costs the mean over scenarios of
    the stage costs at x_1 ... x_N, less the value at x_N. value may take a mismatch (n_x,) as well, or be None.
    scenarios: (S, n_psi), the first nominal. robust_horizon: stages at which the tree branches; 0: nominal.
    slack_price: scalar or (2, n_x), per physical unit below X_LOW and above X_HIGH; inf: `HARD_PRICE`; 0: no bound.
    change_weight: scalar or (n_u,), price of the squared change of each action, physical units.
    discount: what a stage's cost counts less than the one before.
    policy: CasADi function like value, -> u (n_u,), or None. expansion: CasADi function (x, goal, mismatch) ->
    value, gradient, Hessian; default: CasADi's own derivatives. estimator: see `Controller`; its `belief` says
    where every scenario starts, with which parameters, and its weight.
    iterations: the most per step. deadline_ms: none begins later than this after its step began.

    `stats` of the last step: rung (plan, actor, hold), guess, guess_cost, cost, iterations, stop (stationary,
    limit, late, unsolved: the quadratic program, stalled: no share of a step helps), predicted (last decrease).
    """

    HARDLY_MOVED = 0.03  # half-widths of the box of initial states
    SHARES = 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32  # of a step, the first that keeps a tenth of its promise
    STATIONARY = 1e-4  # share of the cost: a plan that came this close to the predicted cost is left as it is

    def __init__(
        self,
        plant,
        horizon,
        scenarios,
        stage_cost,
        value=None,
        *,
        goal,
        robust_horizon=1,
        slack_price=1.0,
        change_weight=0.0,
        discount=1.0,
        policy=None,
        expansion=None,
        estimator=None,
        iterations=5,
        deadline_ms=None,
        compile=True,
    ):
        if not (isinstance(iterations, (int, np.integer)) and iterations >= 0):
            raise ValueError(f"iterations is {iterations!r}; it must be a whole number of at least 0")
        if not (deadline_ms is None or isinstance(deadline_ms, (int, float, np.number)) and deadline_ms > 0):
            raise ValueError(f"deadline_ms is {deadline_ms!r}; it must be a positive number, or None")
        if not 0 <= discount <= 1:  # nor is nan
            raise ValueError(f"discount is {discount}; it must lie in [0, 1]")
        self.iterations, self.deadline_ms = iterations, deadline_ms
        scenarios, price, change_weight = checked_problem(plant, scenarios, slack_price, change_weight)
        self.scenarios = scenarios if robust_horizon else scenarios[:1]
        self.horizon, self.tree = horizon, ScenarioTree(len(self.scenarios), horizon, robust_horizon)
        self.x_center, self.x_scale, self.u_center, self.u_scale = scaling(plant)
        self.policy, self.discount = policy, discount
        # prices per scaled unit; states without a bound or a price are left out
        bounds = (np.array([plant.X_LOW, plant.X_HIGH]) - self.x_center) / self.x_scale
        active = np.isfinite(bounds) & (price > 0)
        self.rows = np.flatnonzero(active.any(axis=0))
        self.slack_price = (np.where(active, np.where(np.isinf(price), HARD_PRICE, price), 0) * self.x_scale)[
            :, self.rows
        ]
        self.low, self.high = np.where(active, bounds, [[-1e9], [1e9]])[:, self.rows]
        self.change_weight = change_weight * self.u_scale**2
        self.qp = tree_qp(self.tree, len(plant.X_LOW), len(plant.U_LOW), active, change_weight.any(), compile)
        super().__init__(plant, goal, estimator)
        self.functions = self._functions(stage_cost, value, expansion)
        functions = compiled_functions(self.functions) if compile else self.functions
        self.rollout, self.linearise, *policy = map(OnArrays, functions)
        self.follow, self.mu = policy or (None, None)

    def _functions(self, stage_cost, value, expansion):
        """CasADi functions of what `parameters` gives, scaled, a column per node but the root.

        rollout (..., u) -> cost, states; linearise (..., u) -> states, A, B, slopes and Hessians of the costs;
        follow (...) -> the policy's actions; mu (x, goal, mismatch) -> its action, physical units.
        """
        tree, N, S, rows = self.tree, self.horizon, len(self.scenarios), self.rows.tolist()
        n_x, n_u, n_goal = len(self.x_scale), len(self.u_scale), len(self.plant.GOAL_INDEX)
        n = len(tree.stage) - 1
        # parameters and variables
        start, psi = ca.MX.sym("start", n_x, S), ca.MX.sym("psi", self.scenarios.shape[1], S)
        weight, goal = ca.MX.sym("weight", 1, n + 1), ca.MX.sym("goal", n_goal, N)
        disturbance, mismatch = ca.MX.sym("disturbance", n_x), ca.MX.sym("mismatch", n_x)
        price, change = ca.MX.sym("price", len(rows), 2), ca.MX.sym("change", n_u)
        u, u_before = ca.MX.sym("u", n_u, tree.inner), ca.MX.sym("u_before", n_u)
        problem = [start, psi, weight, goal, disturbance, mismatch, price, change, u_before]

        # dynamics
        def rolled_out(model, action):
            """States, and what else the model gives, of all nodes."""
            x, found = start, []
            for t in range(N):
                here = slice(tree.first[t + 1], tree.first[t + 2])
                before, scenario = (tree.parent[here] - tree.first[t]).tolist(), tree.scenario[here].tolist()
                given = x[:, before if t else scenario], action(t, x)[:, before], psi[:, scenario]
                found.append(model.map(len(before)).call(given))
                x = found[-1][0] = found[-1][0] + ca.repmat(disturbance / self.x_scale, 1, len(before))
            return [ca.horzcat(*parts) for parts in zip(*found)]

        # costs: of a node, of its slack, and the value at the leaves
        x, g, m = ca.MX.sym("x", n_x), ca.MX.sym("goal", n_goal), ca.MX.sym("mismatch", n_x)
        state, named = x * self.x_scale + self.x_center, {"never_inline": True}
        cost = stage_cost(state, g)
        stage = ca.Function("stage", [x, g], [cost], named)
        slope, hessian = ca.gradient(cost, x), ca.densify(ca.hessian(cost, x)[0])
        stage_model = ca.Function("stage_model", [x, g], [slope, hessian], named)
        violation = ca.horzcat(ca.fmax(self.low - x[rows], 0), ca.fmax(x[rows] - self.high, 0))
        slack = ca.Function("slack", [x, price], [ca.dot(price, violation)], named)
        v = ca.MX(1, 1) if value is None else self.discount * call(value, state, g, m)
        slope, hessian = ca.gradient(v, x), ca.hessian(v, x)[0]
        if expansion is not None:
            _, slope, hessian = (self.discount * part for part in expansion(state, g, m))
            slope, hessian = slope * self.x_scale, hessian * np.outer(self.x_scale, self.x_scale)
        final = ca.Function("final", [x, g, m], [v], named)
        final_model = ca.Function("final_model", [x, g, m], [ca.densify(slope), ca.densify(hessian)], named)

        def planned(t, x):
            return u[:, tree.first[t] : tree.first[t + 1]]

        step, step_jacobian = prediction_model(self.plant)
        goals, prices, leaves = goal[:, (tree.stage[1:] - 1).tolist()], ca.repmat(price, 1, n), tree.nodes[-1]
        last = ca.repmat(goal[:, -1], 1, leaves), ca.repmat(mismatch, 1, leaves)
        moved = u - ca.horzcat(u_before, u[:, tree.parent[1 : tree.inner].tolist()])
        (X,) = rolled_out(step, planned)
        J = weight[1:] @ (stage.map(n)(X, goals) + (slack.map(n)(X, prices) if rows else 0)).T
        J += weight[: tree.inner] @ (change.T @ moved**2).T
        J -= weight[-leaves:] @ final.map(leaves)(X[:, -leaves:], *last).T
        rollout = ca.Function("rollout", [*problem, u], [J, X])
        X, A, B = rolled_out(step_jacobian, planned)
        slopes, hessians = stage_model.map(n)(X, goals)
        slope, hessian = final_model.map(leaves)(X[:, -leaves:], *last)
        slopes[:, -leaves:] -= slope
        hessians[:, -leaves * n_x :] -= hessian
        linearise = ca.Function("linearise", [*problem, u], [X, *map(ca.densify, (A, B, slopes, hessians))])
        if self.policy is None:
            return [rollout, linearise]

        found, actions = (call(self.policy, state, g, m) - self.u_center) / self.u_scale, []
        policy = ca.Function("policy", [x, g, m], [ca.fmax(ca.fmin(found, 1), -1)], named)

        def policy_action(t, x):
            x = x if t else x @ weight[1 : S + 1].T  # scenarios share the first action: that of their mean
            given = ca.repmat(goal[:, t], 1, x.shape[1]), ca.repmat(mismatch, 1, x.shape[1])
            actions.append(policy.map(x.shape[1])(x, *given))
            return actions[-1]

        rolled_out(step, policy_action)
        mu = ca.Function("mu", [x, g, m], [call(self.policy, x, g, m)])
        return [rollout, linearise, ca.Function("follow", problem, [ca.horzcat(*actions)]), mu]

    def reset(self, u=None):
        super().reset(u)
        self.plan = self.problem = None  # scaled actions (inner, n_u), and what they were planned from

    def weights(self, weight):
        """What the cost of every node counts, from the weights of the scenarios (S,)."""
        return self.tree.weights(weight) * self.discount ** np.maximum(self.tree.stage - 1, 0)

    def parameters(self, x):
        """Parameters of the compiled functions, a row per column of theirs."""
        starts, psi, weight = self.estimator.belief(self.scenarios)
        u_before = (self.u_before - self.u_center) / self.u_scale
        known = (starts - self.x_center) / self.x_scale, psi, self.weights(weight)[:, None], self.goals.T
        known += self.estimator.disturbance, self.estimator.mismatch
        return *known, self.slack_price, self.change_weight, u_before

    def first_guesses(self, x):
        """First guesses by name, (inner, n_u)."""
        found = {}
        if self.plan is not None:
            found["shifted"] = self.plan[self.tree.later]
            # where things move, an action that is planned for later would be put off for ever
            if np.abs((x - self.x_before) / self.x_scale).max() < self.HARDLY_MOVED:
                found["last"] = self.plan
        if self.policy is None:
            found["middle"] = np.zeros((self.tree.inner, len(self.u_scale)))
        if self.follow:
            found["policy"] = self.follow(*self.problem)[0].copy()
        return found

    def cost(self, u):
        """Cost of a plan; not a number if a state of it is not finite."""
        J, states = self.rollout(*self.problem, u)
        return J.item() if np.isfinite(states).all() else np.nan

    def program(self, u):
        """The tree's quadratic program about the plan u: the arguments of `qp.solve`."""
        weight, u_before = self.problem[2], self.problem[-1]
        change, price = weight[: self.tree.inner] * self.change_weight, weight[1:, :, None] * self.slack_price
        states, A, B, slope, hessian = self.linearise(*self.problem, u)
        low, high = self.low - states[:, self.rows], self.high - states[:, self.rows]
        slope, hessian = slope * weight[1:], hessian.reshape(len(price), -1) * weight[1:]
        moved = u - np.concatenate([u_before[None], u[self.tree.parent[1 : self.tree.inner]]])
        barrier = max(price.max(initial=0), 1.0)
        return A, B, slope, hessian, -1 - u, 1 - u, low, high, price, change, moved, barrier

    def improve(self, u, cost, tick):
        """The plan u after as many iterations as it may have, and its cost."""
        for _ in range(self.iterations):
            if self.deadline_ms is not None and 1e3 * (time.perf_counter() - tick) > self.deadline_ms:
                self.stats |= {"stop": "late", "late": True}
                break
            self.stats["iterations"] += 1
            program = self.program(u)
            low, high, price = program[6:9]
            step, found = self.qp.solve(*program)
            if step is None:
                self.stats["stop"] = "unsolved"
                break
            slack = np.vdot(price[:, 0], np.maximum(low, 0)) + np.vdot(price[:, 1], np.maximum(-high, 0))
            self.stats["predicted"] = predicted = slack - found
            tolerance, before = self.STATIONARY * abs(cost), cost
            for share in self.SHARES if predicted > tolerance else self.SHARES[:1]:
                new = np.clip(u + share * step, -1, 1)
                new_cost = self.cost(new)
                if new_cost < before and not before - new_cost < 0.1 * share * predicted:
                    u, cost = new, new_cost
                    break
            as_predicted = abs(before - cost - predicted) <= tolerance
            if as_predicted or cost == before:
                self.stats["stop"] = "stationary" if as_predicted else "stalled"
                break
        return u, cost

    def action(self, x, tick):
        self.problem = self.parameters(x)
        guesses = self.first_guesses(x)
        costs = {name: cost for name, u in guesses.items() if np.isfinite(cost := self.cost(u))}
        if not costs:
            self.plan, self.stats["fell_back"] = None, True
            known = x, self.goals[:, 0], self.estimator.mismatch
            return self.mu(*known)[0][0] if self.mu else np.full(1, np.nan)
        best = min(costs, key=costs.get)
        self.stats |= dict(rung="plan", guess=best, guess_cost=costs[best], stop="limit", predicted=0.0)
        self.plan, self.stats["cost"] = self.improve(guesses[best], costs[best], tick)
        return self.plan[0] * self.u_scale + self.u_center

    def prediction(self):
        """The last plan, physical units: lists over stages of states x_1 ... (n_x, nodes), actions (n_u, nodes)."""
        if self.plan is None:
            raise ValueError("there is no prediction before the first make_step, nor where it fell back")
        states = self.rollout(*self.problem, self.plan)[1] * self.x_scale + self.x_center
        actions = self.plan * self.u_scale + self.u_center
        return self.tree.by_stage(states, actions)


def scenario_set(plant, args):
    """The planners' scenarios (S, n_psi): the plant's, of the size that the arguments say."""
    spread = (0.5 if args.offset_free else 1.0) if args.spread is None else args.spread
    return plant.PSI_NOMINAL + spread * (envs.scenario_set(plant, "mpc") - plant.PSI_NOMINAL)


def build_controller(name, args):
    """One of the compared controllers, a key of LABELS. Raises ValueError for what cannot work."""
    if name not in LABELS:
        raise ValueError(f"{name!r} is not a controller; choose one of {', '.join(LABELS)}")
    plant, goal, critic, estimator = check(args)
    mu, Q, V = export(critic)
    if name == "actor":
        return ActorController(plant, mu, goal, estimator)
    if name == "rl_mpc" and args.horizon == 0:
        return GreedyController(plant, mu, Q, goal, estimator)
    scenarios = scenario_set(plant, args)
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(goal))
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))
    options = dict(goal=goal, estimator=estimator, compile=args.compile)
    options |= dict(iterations=args.iterations, deadline_ms=args.deadline_ms)
    if name in ("nominal_mpc", "robust_mpc"):  # the plant's benchmark: its prices count once per scenario
        robust, benchmark = name == "robust_mpc", plant.BENCHMARK
        counted = len(scenarios) if robust else 1
        options |= {key: counted * benchmark[key] for key in ("slack_price", "change_weight")}
        options |= dict(robust_horizon=int(robust))
        stage = ca.Function("stage", [x, g], [squared_error])
        return ScenarioMPC(plant, benchmark["horizon"], scenarios, stage, **options)
    plan = critic.plan
    sigma2 = plan["sigma2"] if args.sigma is None else args.sigma**2
    stage = ca.Function("stage", [x, g], [plant.economic_cost(x, ca) - ca.exp(-squared_error / (2 * sigma2))])
    slack_weight = plan["slack_weight"] if args.slack_weight is None else args.slack_weight
    price = slack_weight if args.constraints == "soft" else np.inf
    change = args.change_weight or 0.0
    robust_horizon = plan["robust_horizon"] if args.robust_horizon is None else args.robust_horizon
    options |= dict(robust_horizon=robust_horizon, slack_price=price, change_weight=change)
    options |= dict(discount=plan["discount"])
    if name == "rl_mpc":
        options |= dict(value=V, policy=mu, expansion=expansion(critic))
    return ScenarioMPC(plant, args.horizon, scenarios, stage, **options)


def critic_path(args):
    """The checkpoint that the arguments mean. Raises ValueError if it is to be the latest and there is none."""
    if args.critic == Path("latest"):
        runs = Path("runs").glob(f"{args.env}__*/checkpoint.pt")
        latest = max(runs, key=lambda path: path.stat().st_mtime, default=None)
        if latest is None:
            raise ValueError(f"--critic latest: there is no runs/{args.env}__*/checkpoint.pt")
        return latest
    folder = Path(__file__).parent / "experiments/pretrained"
    shipped = [folder / f"{args.env}_{kind}.pt" for kind in ("constrained", "robust", "planner")]
    return args.critic or next((path for path in shipped if path.exists()), shipped[0])


# Closed loop


@cache
def worker_controller(name, args):
    """A controller built once in each worker process."""
    torch.set_num_threads(1)
    return build_controller(name, args)


def run_job(name, args, episode):
    """A controller on a paired draw, or (None) from the plant's start: x, u and its row of results.csv."""
    controller, critic = worker_controller(name, args), critic_path(args)
    plant = controller.plant
    starts, psis = draws(plant, (episode or 0) + 1, args.seed, args.starts)
    start, psi = (plant.START, plant.PSI_NOMINAL) if episode is None else (starts[episode], psis[episode])
    rng = np.random.default_rng([args.seed, 7, (episode or 0) + 1])
    x, u, row = run_episode(controller, plant, start, psi, controller.goal, args.steps, args.noise, rng)
    given = {k: v for k, v in vars(args).items() if k not in ELSEWHERE and v != getattr(Args, k)}
    goal = " ".join(f"{g:g}" for g in controller.goal)
    head = {"env": args.env, "controller": name, "horizon": controller.horizon or 0}
    head |= {"critic": f"{critic.absolute().parent.name}/{critic.name}", "goal": goal, "episode": episode}
    head |= {"seed": args.seed, "psi": json.dumps(psi.tolist()), "arguments": json.dumps(given)}
    return x, u, head | {k: round(float(v), 6) if isinstance(v, float) else int(v) for k, v in row.items()}


def compare(args, names):
    """Every controller from the plant's start and on every draw: {(name, episode): (x, u, row)}."""
    jobs = [(name, args, i) for i in (None, *range(args.episodes)) for name in names]
    found = parallel(run_job, jobs, args.jobs, first=len(names))
    return {(name, i): result for (name, _, i), result in zip(jobs, found)}


def label(row):
    return LABELS[row["controller"]] + (f", N = {row['horizon']}" if row["controller"] != "actor" else "")


def check(args):
    """Refuse, by ValueError, what cannot work before anything long starts. Returns plant, goal, critic, estimator."""
    check_ranges(args, horizon=(0, 1000), robust_horizon=(0, 10), episodes=(1, 10**6), steps=(1, 10**6))
    check_ranges(args, jobs=(1, 1024), seed=(0, 10**9), iterations=(0, 1000), deadline_ms=(1e-3, 1e6))
    check_ranges(args, noise=(0, 1), sigma=(1e-6, 1e6), slack_weight=(1e-6, 1e6), spread=(0, 10))
    path = critic_path(args)
    if args.critic is None and args.env in envs.names() and not path.exists():
        train = f"python sac_her_branching.py --env {args.env}"
        raise ValueError(f"--critic is missing: none is shipped for {args.env}; train one with {train}")
    envs.load(args.env)
    critic = load_critic(path, args.env, "min" if args.horizon == 0 else args.combine)
    plant = critic.plant
    planning = ("robust_horizon", "sigma", "slack_weight", "constraints", "change_weight", "combine")
    unused = dict.fromkeys(planning, "at --horizon 0" if args.horizon == 0 else "")
    if args.constraints == "hard":
        unused["slack_weight"] = unused["slack_weight"] or "on hard constraints"
    unused |= {"estimator": "with --offset-free" * args.offset_free}
    comparing = ("episodes", "steps", "seed", "jobs", "controllers", "out")
    unused |= dict.fromkeys(comparing, "with --export-c" if args.export_c else "")
    check_effects(args, unused)
    if args.horizon == 0 and "goal_mpc" in args.controllers:
        raise ValueError("--horizon is 0; --controllers goal_mpc plans, so that it must be at least 1")
    if not args.controllers:
        raise ValueError(f"--controllers is empty; choose from {', '.join(LABELS)}")
    check_weights("change_weight", args.change_weight, len(plant.U_LOW))
    branching = critic.plan["robust_horizon"] if args.robust_horizon is None else args.robust_horizon
    ScenarioTree(len(envs.scenario_set(plant, "mpc")), max(args.horizon, 1), branching)
    goal = envs.checked_goal(plant, plant.EVAL_GOAL if args.goal is None else args.goal)
    kind, certain = "ekf" if args.offset_free else args.estimator, args.offset_free or args.spread is not None
    options = dict(certain=certain, mismatch_scale=critic.mismatch_scale, compile=args.compile)
    return plant, goal, critic, build_estimator(plant, kind, args.measure, args.noise, **options)


def main(args):
    plant, goal, critic, _ = check(args)
    args = replace(args, critic=critic_path(args))  # the latest one may change
    names = list(dict.fromkeys(args.controllers))
    if len(envs.scenario_set(plant, "mpc")) == 1 and {"nominal_mpc", "robust_mpc"} <= set(names):
        names.remove("robust_mpc")
        print("notice: robust MPC is left out; with a single scenario it is nominal MPC", file=sys.stderr)
    if not envs.can_hold(plant, goal):
        print(f"warning: --goal {args.goal} is not a goal that every scenario can hold", file=sys.stderr)
    difference = check_export(critic, export(critic)[2])
    print(f"{critic_path(args)}: the CasADi export equals torch to {difference:.0e}", flush=True)
    if args.export_c:
        return export_c(build_controller("rl_mpc", args), args.export_c, noise=args.noise)
    name = f"{args.env}__rl_mpc_deploy__{args.seed}__{int(time.time())}"
    out = output_folder(args.out, Path("runs") / name)
    tick = time.perf_counter()
    found = compare(args, names)
    rows = [found[name, i][2] for name in names for i in range(args.episodes)]
    write_csv(rows, out / "results.csv")
    stacked = {}
    for name in names:
        for k, key in enumerate("xu"):
            stacked[f"{name}_{key}"] = np.stack([found[name, i][k] for i in range(args.episodes)])
    np.savez_compressed(out / "trajectories.npz", **stacked)
    shown = [name for name in names if name != "nominal_mpc"] or names
    lines = {label(found[name, None][2]): (*found[name, None][:2], STYLES[name]) for name in shown}
    draw_episode(plant, lines, np.tile(goal, (args.steps, 1)), out / "episode.png")
    print(table(rows, label))
    print(
        f"{args.episodes} paired draws in {time.perf_counter() - tick:.0f} s; {out}/results.csv, trajectories.npz"
    )
    print("and episode.png, which starts from the plant's own start state and has nominal parameters")
    return rows


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (ValueError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("interrupted; a comparison writes its results at its end", file=sys.stderr)
        raise SystemExit(130) from None
