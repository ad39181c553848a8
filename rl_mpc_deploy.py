# /// script
# requires-python = ">=3.11"
# dependencies = ["torch==2.13.0", "gymnasium==1.4.0", "casadi==3.8.2", "numpy", "scipy", "tyro", "matplotlib", "tqdm"]
# ///
"""The deployed controller: short-horizon scenario MPC whose terminal cost is a learned goal-conditioned critic (eq:QMPC).

    minimise over u   sum_i w_i { sum_{t=1}^{N} [ p'|eps_t^i| - exp(-|g - x_t^i|^2 / (2 sigma^2)) ] - V(x_N^i, g) }
    subject to        x_{t+1}^i = f(x_t^i, u_t^i, psi^i),   x_t^i - eps_t^i in X,   u_t^i in U,   u_0^i = u_0^j

with V(x, g) = Q(x, mu(x, g), g) from a checkpoint of sac_her_branching.py, rebuilt in CasADi. The sums start at
x_1: x_0 is measured, its reward is a constant, and V(x_N) counts rewards from x_{N+1} on. The plan is improved
step by step and may be stopped at any time (`ScenarioMPC`). The controller is compared, on paired draws of start
state and plant, with the actor alone and with nominal and robust MPC.

    python rl_mpc_deploy.py --horizon 5                                      # the critic that the repository ships
    python rl_mpc_deploy.py --critic experiments/pretrained/cstr_robust.pt   # the paper's, blind to constraints
    python rl_mpc_deploy.py --horizon 5 --critic runs/NAME/checkpoint.pt     # your own
    python rl_mpc_deploy.py --offset-free                                    # an estimate takes the steady-state offset
    python rl_mpc_deploy.py --horizon 0 --episodes 20 --goal 0.7 --jobs 2    # no prediction: the critic's best action

It writes `runs/{env}__rl_mpc_deploy__{seed}__{time}/`: results.csv (a row per controller and episode),
trajectories.npz and episode.png. Only the folder `envs/` is needed beside this file, and a checkpoint.
"""

import csv
import json
import multiprocessing
import signal
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, get_args

import casadi as ca
import numpy as np
import torch
import tyro
from scipy.optimize import minimize
from tqdm import tqdm

import envs
from envs.tools.compiled import OnArrays, compiled_functions
from envs.tools.expansion import expansion
from envs.tools.figure import draw_episode
from envs.tools.model import prediction_model, scaling
from envs.tools.tree_qp import ScenarioTree, tree_qp

# arguments that results.csv has columns for, or that change no result
ELSEWHERE = {"env", "horizon", "critic", "goal", "seed", "episodes", "jobs", "controllers", "compile", "out"}
MAX_CHECKPOINT_BYTES = 10**9
HARD_PRICE = 1e3  # of a hard bound, per physical unit: above the multipliers, so violated only where it must be
HARDLY_MOVED = 0.03  # half-widths of the box of initial states
STATIONARY = 1e-4  # predicted decrease, share of the cost, of the step after which a plan is left as it is
METRIC_SIGMA2 = 0.01  # of time near goal and time outside constraints
Name = Literal["actor", "nominal_mpc", "robust_mpc", "goal_mpc", "rl_mpc"]
LABELS = dict(zip(get_args(Name), ("RL (actor alone)", "nominal MPC", "robust MPC", "RL+MPC, no value", "RL+MPC")))
STYLES = {
    "actor": {"color": "#D55E00", "ls": "--"},
    "nominal_mpc": {"color": "#999999", "ls": ":"},
    "robust_mpc": {"color": "#0072B2", "ls": "-."},
    "goal_mpc": {"color": "#E69F00", "ls": (0, (4, 1, 1, 1, 1, 1))},
    "rl_mpc": {"color": "#009E73"},
}


@dataclass(frozen=True)
class Args:
    env: str = "cstr"
    """the plant: NAME of a module envs/NAME.py, the one that the critic was trained on; its checkpoint names its size"""
    horizon: int = 5
    """prediction steps N of RL+MPC; 0: the action that maximises the critic, no prediction"""
    critic: Path | None = None
    """a checkpoint.pt of sac_her_branching.py; default: experiments/pretrained/{env}_constrained.pt, where there is none
    {env}_robust.pt (cstr: the first knows the price of constraints, the second is the paper's)"""
    goal: tuple[float, ...] | None = None
    """what to hold (cstr: c_B in mol/l); default: the plant's evaluation goal"""
    episodes: int = 16
    """paired draws of start state and plant parameters"""
    steps: int = 100
    """sampling times per episode"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes; the results do not depend on it, but for the times"""

    robust_horizon: int = 1
    """RL+MPC: stages at which the scenario tree branches; 0: the nominal model alone"""
    sigma: float | None = None
    """RL+MPC: width of the Gaussian stage cost, units of the goal; default: the plant's
    (cstr: 0.1 as in the paper's script; its text says 0.25)"""
    slack_weight: float | None = None
    """RL+MPC: price of a constraint violation, per physical unit (mol/l, degC) and step; default: 2 with a critic that
    was trained with --constraint-weight, 1 with one that was not, as in the paper"""
    constraints: Literal["soft", "hard"] = "soft"
    """RL+MPC: hard bounds are violated only where every plan violates them"""
    change_weight: tuple[float, ...] | None = None
    """RL+MPC: price of the squared change of each action; default: none. It decides where several actions hold a goal"""
    combine: Literal["min", "first", "mean"] = "first"
    """which of the twin critics V takes; --horizon 0 takes their minimum"""
    iterations: int = 5
    """every planner: the most per step; each lowers the plan's cost"""
    deadline_ms: float | None = None
    """every planner: no iteration begins later than this after its step began; default: none, since results then
    depend on the machine"""
    offset_free: bool = False
    """every planner: estimate from the last transitions how the plant differs from the model (`envs.Estimator`)"""
    estimate: Literal["disturbance", "parameters"] = "disturbance"
    """what --offset-free estimates: what to add to every prediction, or the parameters to centre the scenarios on"""
    filter_gain: float = 1.0
    """how far the estimate, or the mismatch that a critic observes, follows the last transition, 1: wholly"""
    spread: float | None = None
    """size of the scenario set about its centre; default: 1, the plant's, with --offset-free 0.5"""
    controllers: tuple[Name, ...] = ("actor", "nominal_mpc", "robust_mpc", "rl_mpc")
    """which controllers to compare; goal_mpc: RL+MPC's problem without the learned value"""
    compile: bool = True
    """translate the planners' functions to C and compile them once (kept in $XDG_CACHE_HOME/rlmpc, or ~/.cache/rlmpc)"""
    out: Path | None = None
    """folder of the results; default: runs/{env}__rl_mpc_deploy__{seed}__{time}"""


# The learned value


def array(tensor):
    return tensor.double().numpy()


def mlp(layers, h, xp):
    """Multilayer perceptron with SiLU, (n_in, B) -> (n_out, B); xp torch or casadi."""
    for i, (w, b) in enumerate(layers):
        w, b = (torch.from_numpy(np.ascontiguousarray(v)) if xp is torch else v for v in (w, b))
        h = w @ h + b
        if i < len(layers) - 1:
            h = torch.nn.functional.silu(h) if xp is torch else h * (1 + ca.tanh(h / 2)) / 2  # exp(-h) could overflow
    return h


class Critic:
    """Actor and twin critics of a checkpoint in float64: float32 noise, 1e-6 at |V| = 40, is too much for a solver."""

    def __init__(self, data, combine="first"):
        options = dict(data.get("plant_options", {}))
        self.mismatch_scale = options.pop("observe_mismatch", None)  # of a critic that observes the mismatch
        self.plant = envs.load(data["env"], **options)
        self.goal_input, self.combine = data["goal_input"], combine
        # the default price of violations in a plan that ends in this value
        self.slack_weight = 2.0 if data["args"].get("constraint_weight") else 1.0
        scaling = data["scaling"].items()  # affine maps between physical and network units
        self.scaling = {k: np.array(v, dtype=int if k.endswith("index") else float) for k, v in scaling}
        # (W, b) of every layer, b a column: of the actor, whose last gives the mean alone, and of the twin critics
        actor, critic, n_hidden = data["actor"], data["critic"], len(data["network"]["hidden"])
        names = [*(f"layers.{i}" for i in range(n_hidden)), "head"]
        actor = [(array(actor[f"{name}.weight"]), array(actor[f"{name}.bias"])[:, None]) for name in names]
        pairs = [(array(critic[f"weight.{i}"]), array(critic[f"bias.{i}"])) for i in range(n_hidden + 1)]
        self.twins = [[(w[j].T, b[j].T) for w, b in pairs] for j in range(2)]
        self.actor = [*actor[:-1], tuple(part[: data["network"]["n_u"]] for part in actor[-1])]
        for layers, n_in in ((actor, data["network"]["n_in"]), (self.twins[0], pairs[0][0].shape[1])):
            if [w.shape[1] for w, _ in layers] != [n_in, *data["network"]["hidden"]]:
                raise ValueError("weights that do not fit")

    def features(self, x, goal, xp):
        """Network input, components along the first axis, xp torch or casadi: x (n_x, B), goal (n_goal, B) -> (n_in, B).

        x of a critic that observes the mismatch has it below the state.
        """
        concat = torch.cat if xp is torch else lambda parts: ca.vertcat(*parts)
        s = {}
        for name, v in self.scaling.items():
            s[name] = v.tolist() if v.dtype == int else v if xp is ca else torch.from_numpy(v)[:, None]
        if self.goal_input == "error":
            goal = goal - x[s["goal_index"], :]
            g = goal / s["error_scale"]
        else:
            g = (goal - s["goal_center"]) / s["goal_scale"]
        angles = concat([x, goal])[s["angle_index"], :]
        others = concat([(x - s["x_center"]) / s["x_scale"], g])[s["other_index"], :]
        return concat([others, xp.sin(angles), xp.cos(angles)])

    def q(self, z, action, xp):
        """The twin critics combined: features (n_in, B), action in [-1, 1] (n_u, B) -> (1, B)."""
        z = torch.cat([z, action]) if xp is torch else ca.vertcat(z, action)
        first, second = (mlp(twin, z, xp) for twin in self.twins)
        if self.combine == "min":
            return xp.fmin(first, second)
        return first if self.combine == "first" else (first + second) / 2

    def value(self, x, goal):
        """V(x, g) = Q(x, mu(x, g), g) in torch, (B, n_x) and (B, n_goal) -> (B,)."""
        z = self.features(x.T, goal.T, torch)
        return self.q(z, torch.tanh(mlp(self.actor, z, torch)), torch)[0]

    def example(self):
        """A network input in physical units: the plant's start state (below it a mismatch of zero) and its goal."""
        start = np.asarray(self.plant.START, dtype=float)
        seen = np.zeros_like(start) if self.mismatch_scale else []
        return np.append(start, seen), np.asarray(self.plant.EVAL_GOAL, dtype=float)


def load_critic(path, env, combine="first"):
    """The `Critic` of a checkpoint.pt, which is data, never code. Raises ValueError, one sentence, for anything else."""
    path, found = Path(path), None
    try:
        if path.stat().st_size > MAX_CHECKPOINT_BYTES:
            raise ValueError(f"larger than {MAX_CHECKPOINT_BYTES / 1e9:g} gigabytes")
        if zipfile.ZipFile(path).testzip():
            raise ValueError("damaged")
        data = torch.load(path, map_location="cpu", weights_only=True)
        if data["format"] != "rlmpc-sac-her-branching-1":
            raise ValueError("of another format")
        found = data["env"]
        if found == env:
            critic = Critic(data, combine)
            if critic.goal_input not in ("error", "goal"):
                raise ValueError(f"unknown goal_input {critic.goal_input!r}")
            if not all(np.isfinite(part).all() for net in (critic.actor, *critic.twins) for layer in net for part in layer):
                raise ValueError("weights that are not finite")
            if not all((v > 0).all() for name, v in critic.scaling.items() if name.endswith("scale")):
                raise ValueError("scales that are not positive")
            if not critic.value(*(torch.from_numpy(v)[None] for v in critic.example())).isfinite().all():
                raise ValueError("values that are not finite")
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; it must be a checkpoint.pt of sac_her_branching.py") from None
    except Exception as error:  # text, a folder, a pickle of code, weights that do not fit: torch raises many types
        reason = str(error) if type(error) is ValueError and "\n" not in str(error) else type(error).__name__
        raise ValueError(f"{path} is not a checkpoint.pt of sac_her_branching.py ({reason})") from None
    if found != env:
        raise ValueError(f"{path} was trained on {found!r}, not on {env!r}; --env and --critic must match")
    return critic


def export(critic):
    """CasADi functions mu(x, goal) -> u, Q(x, u, goal) and V(x, goal), physical units, float64.

    Of a critic that observes the mismatch each takes it, (n_x,), as one more argument.
    """
    s, n_x = critic.scaling, len(critic.plant.X_LOW)
    sizes = (("x", n_x), ("goal", s["goal_center"].size), ("u", s["u_center"].size), ("mismatch", n_x))
    x, goal, u, mismatch = (ca.MX.sym(*size) for size in sizes)
    seen = [mismatch] if critic.mismatch_scale else []
    z = critic.features(ca.vertcat(x, *seen), goal, ca)
    action = ca.tanh(mlp(critic.actor, z, ca)) * s["u_scale"] + s["u_center"]
    mu = ca.Function("mu", [x, goal, *seen], [action])
    Q = ca.Function("Q", [x, u, goal, *seen], [critic.q(z, (u - s["u_center"]) / s["u_scale"], ca)])
    return mu, Q, ca.Function("V", [x, goal, *seen], [Q(x, action, goal, *seen)])


def check_export(critic, points=64, tolerance=1e-8):
    """Compare V and the gradient that plans use with torch at random states: the largest scaled difference.

    Raises RuntimeError if it is above the tolerance.
    """
    plant, rng = critic.plant, np.random.default_rng(0)
    x = torch.tensor(envs.sample_states(plant, rng, points), requires_grad=True)
    n_x, goals = len(plant.X_LOW), rng.uniform(plant.GOAL_LOW, plant.GOAL_HIGH, size=(points, len(plant.GOAL_LOW)))
    mismatch = rng.uniform(-1, 1, size=(points, n_x))
    seen = [torch.from_numpy(mismatch)] if critic.mismatch_scale else []
    value = critic.value(torch.cat([x, *seen], dim=1), torch.from_numpy(goals))
    (gradient,) = torch.autograd.grad(value.sum(), x)
    inputs = x.detach().numpy().T, goals.T, mismatch.T
    v, slope, _ = (np.array(part) for part in expansion(critic).map(points)(*inputs))
    plain = np.array(call(export(critic)[2].map(points), *inputs))
    value, x_scale = value.detach().numpy(), critic.scaling["x_scale"][:n_x]  # slopes per unit of the network's input
    differences = v - value, plain - value, (slope.T - gradient.numpy()) * x_scale
    worst = max(np.abs(difference).max() for difference in differences) / (1 + np.abs(value).max())
    if not worst < tolerance:
        raise RuntimeError(f"the CasADi export differs from torch by {worst:.1e} (allowed: {tolerance:.0e}); nothing was run")
    return worst


def call(function, *arguments):
    """A function of (x, goal), or of (x, goal, mismatch)."""
    return function(*arguments[: function.n_in()])


# Controllers


class Controller:
    """What every controller does around its action: `u = make_step(x0)`, `set_goal(goal)`, `reset()`, `stats`.

    A subclass defines `action(x, tick)`: the action (n_u,) for the state x (n_x,), physical units, of a step that
    began at tick. Where that is not finite the last action is applied again.
    """

    horizon = None

    def __init__(self, plant, goal, estimator=None):
        self.plant, self.estimator = plant, estimator or envs.Estimator(plant)
        self.set_goal(goal)
        self.reset()

    def reset(self):
        """Forget everything, as at the start of an episode."""
        self.x_before, self.u_before = None, np.zeros(len(self.plant.U_LOW))
        self.stats = {}
        self.estimator.reset()

    def set_goal(self, goal):
        """The goal from now on: a number or (n_goal,); of a planner also (n_goal, N), a goal per stage x_1 ... x_N.

        Raises ValueError for another shape or a goal outside the plant's range.
        """
        self.goal = envs.checked_goal(self.plant, goal, self.horizon)

    def make_step(self, x0):
        """The action (n_u,), finite and within its limits, for the measured state x0 (n_x,), physical units.

        Raises ValueError for a state that is not one and stays as it was. Angles are taken to the turn nearest to the last.
        """
        x, tick = envs.checked_state(self.plant, x0), time.perf_counter()
        if self.x_before is not None:
            turns = np.round((self.x_before - x) / (2 * np.pi))
            x[self.plant.ANGLES] += 2 * np.pi * turns[self.plant.ANGLES]
        self.estimator.update(x)
        self.stats = {"rung": "actor", "fell_back": False, "iterations": 0, "late": False}
        u = self.action(x, tick)
        if not np.isfinite(u).all():
            self.stats |= {"rung": "hold", "fell_back": True}
            u = self.u_before
        self.x_before, self.u_before = x, np.clip(u, self.plant.U_LOW, self.plant.U_HIGH)
        self.estimator.before = self.x_before, self.u_before
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
        sizes = (("v", n_u), ("x", len(plant.X_LOW)), ("goal", len(self.goal)), ("mismatch", len(plant.X_LOW)))
        v, *given = (ca.MX.sym(*size) for size in sizes)  # v: action scaled to [0, 1]
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


class ScenarioMPC(Controller):
    """eq:QMPC (with a learned value) or eq:multiMPCobj (without) over a scenario tree, by an iteration that may be
    stopped at any time.

    A plan is its actions, one per node that has children; the states follow by rolling the tree out. An iteration
    linearises the dynamics about the plan, replaces the Hessian of every node's cost by its positive part, solves the
    tree's quadratic program (envs/tools/tree_qp.c), and takes the largest share 1, 1/2, 1/4 ... of its step that lowers
    the true cost as promised, which the rollout of the new plan tells. So whenever it stops,

    - the plan satisfies the dynamics and the limits of the actions,
    - and costs no more than the cheapest finite first guess: the last plan shifted by a sampling time, where the state
      has hardly moved also the last plan itself, and the policy's rollout (without a policy, at first, middle actions).

    Where no guess has a finite cost the policy's action is applied, and where that is not finite the last action.

    stage_cost, value: CasADi functions (x, goal) -> scalar, physical units: a plan costs the mean over scenarios of the
    stage costs at x_1 ... x_N, less value at x_N. value may take the mismatch (n_x,) as a third argument, or be None.
    scenarios: (S, n_psi), the first one nominal. robust_horizon: stages at which the tree branches; 0: the nominal model.
    slack_price: scalar or (2, n_x), price per physical unit below X_LOW and above X_HIGH; inf: `HARD_PRICE`; 0: no bound.
    change_weight: scalar or (n_u,), price of the squared change of each action, physical units.
    policy: CasADi function like value -> u (n_u,), or None. expansion: CasADi function (x, goal, mismatch) -> value, its
    gradient, its Hessian; default: CasADi's own derivatives. estimator: an `envs.Estimator`.
    iterations: the most per step. deadline_ms: none begins later than this after its step began.

    `stats` of the last step: rung (plan, actor, hold), guess, guess_cost, cost, iterations, stop (stationary, limit,
    late, unsolved: the quadratic program, stalled: no share of a step helps), predicted: the last predicted decrease.
    """

    def __init__(
        self, plant, horizon, scenarios, stage_cost, value=None, *, goal, robust_horizon=1, slack_price=1.0,
        change_weight=0.0, policy=None, expansion=None, estimator=None, iterations=5, deadline_ms=None, compile=True,
    ):  # fmt: skip
        if iterations < 0 or not (deadline_ms is None or deadline_ms > 0):
            raise ValueError(f"iterations is {iterations}, deadline_ms {deadline_ms}; they must be at least 0 and above 0")
        self.iterations, self.deadline_ms = iterations, deadline_ms
        self.scenarios = np.array(scenarios if robust_horizon else scenarios[:1], dtype=float)
        self.horizon, self.tree = horizon, ScenarioTree(len(self.scenarios), horizon, robust_horizon)
        self.x_center, self.x_scale, self.u_center, self.u_scale = scaling(plant)
        self.policy, n_x, n_u = policy, len(plant.X_LOW), len(plant.U_LOW)
        # prices per scaled unit; states without a bound or a price are left out
        price = np.broadcast_to(np.asarray(slack_price, dtype=float), (2, n_x))
        change_weight = np.broadcast_to(np.asarray(change_weight, dtype=float), n_u)
        if not ((price >= 0).all() and (change_weight >= 0).all()):  # nor nan
            raise ValueError(f"slack_price is {slack_price}, change_weight {change_weight}; they must not be negative")
        bounds = (np.array([plant.X_LOW, plant.X_HIGH]) - self.x_center) / self.x_scale
        active = np.isfinite(bounds) & (price > 0)
        self.rows = np.flatnonzero(active.any(axis=0))
        self.slack_price = (np.where(active, np.minimum(price, HARD_PRICE), 0) * self.x_scale)[:, self.rows]
        self.low, self.high = np.where(active, bounds, [[-1e9], [1e9]])[:, self.rows]
        self.change_weight = change_weight * self.u_scale**2
        self.qp = tree_qp(self.tree, n_x, n_u, active, self.change_weight.any(), compile)
        super().__init__(plant, goal, estimator)
        functions = self._functions(stage_cost, value, expansion)
        functions = compiled_functions(functions) if compile else functions
        self.rollout, self.linearise, *self.follow = map(OnArrays, functions)

    def _functions(self, stage_cost, value, expansion):
        """CasADi functions of what `_problem` gives, scaled, a column per node: rollout (..., u) -> cost, states;
        linearise (..., u) -> cost of slack, A, B, slopes, Hessians, states; follow (...) -> the policy's actions."""
        tree, N, S, rows = self.tree, self.horizon, len(self.scenarios), self.rows.tolist()
        n_x, n_u, n_goal = len(self.x_scale), len(self.u_scale), len(self.plant.GOAL_INDEX)
        named = {"never_inline": True}
        # parameters and variables
        sizes = {
            "start": (n_x, S), "psi": (self.scenarios.shape[1], S), "weight": (1, len(tree.stage)), "goal": (n_goal, N),
            "disturbance": (n_x, 1), "mismatch": (n_x, 1), "price": (len(rows), 2), "change": (n_u, 1), "u_before": (n_u, 1),
        }  # fmt: skip
        problem = [ca.MX.sym(name, *size) for name, size in sizes.items()]
        start, psi, weight, goal, disturbance, mismatch, price, change, u_before = problem
        u = ca.MX.sym("u", n_u, tree.inner)
        # cost of a node, with its slope and Hessian; at the leaves less the value; and what its slack costs
        x, g, m = ca.MX.sym("x", n_x), ca.MX.sym("goal", n_goal), ca.MX.sym("mismatch", n_x)
        state = x * self.x_scale + self.x_center
        cost = stage_cost(state, g)
        hessian, slope = ca.hessian(cost, x)
        node = [cost, slope, ca.densify(hessian)]
        leaf = node
        if value is not None:
            v = call(value, state, g, m)
            v_hessian, v_slope = ca.hessian(v, x) if expansion is None else expansion(state, g, m)[:0:-1]
            if expansion is not None:
                v_slope *= self.x_scale
                v_hessian *= np.outer(self.x_scale, self.x_scale)
            leaf = [cost - v, slope - v_slope, ca.densify(hessian - v_hessian)]
        costs, models = (
            [ca.Function(name, [x, g, m], outputs[part], named) for name, outputs in (("node", node), ("leaf", leaf))]
            for part in (slice(1), slice(1, 3))
        )
        violation = ca.horzcat(ca.fmax(self.low - x[rows], 0), ca.fmax(x[rows] - self.high, 0))
        slack = ca.Function("slack", [x, price], [ca.dot(price, violation)], named)

        def stages(model, action):
            """Stage by stage: numbers of its nodes, their states, what else the model gives, goals and mismatches."""
            x = start
            for t in range(N):
                here, n = slice(tree.first[t + 1], tree.first[t + 2]), tree.nodes[t + 1]
                before, which = (tree.parent[here] - tree.first[t]).tolist(), tree.scenario[here].tolist()
                x, *more = model.map(n).call([x[:, before if t else which], action(t, x)[:, before], psi[:, which]])
                x += ca.repmat(disturbance / self.x_scale, 1, n)
                yield here, x, more, ca.repmat(goal[:, t], 1, n), ca.repmat(mismatch, 1, n)

        def planned(t, x):
            return u[:, tree.first[t] : tree.first[t + 1]]

        step, step_jacobian = prediction_model(self.plant)
        before = ca.horzcat(u_before, u[:, tree.parent[1 : tree.inner].tolist()])
        J, states = weight[: tree.inner] @ (change.T @ (u - before) ** 2).T, []
        for t, (here, x, _, *given) in enumerate(stages(step, planned)):
            n = x.shape[1]
            J += weight[here] @ (costs[t == N - 1].map(n)(x, *given) + slack.map(n)(x, ca.repmat(price, 1, n))).T
            states.append(x)
        rollout = ca.Function("rollout", [*problem, u], [J, ca.horzcat(*states)])

        slacks, blocks = 0, [[] for _ in range(5)]
        for t, (here, x, (A, B), *given) in enumerate(stages(step_jacobian, planned)):
            n = x.shape[1]
            slacks += weight[here] @ slack.map(n)(x, ca.repmat(price, 1, n)).T
            slope, hessian = models[t == N - 1].map(n)(x, *given)
            slope *= ca.repmat(weight[here], n_x, 1)
            hessian *= ca.repmat(ca.kron(weight[here], ca.DM.ones(1, n_x)), n_x, 1)
            for block, part in zip(blocks, (A, B, slope, hessian, x)):
                block.append(part)
        blocks = [ca.densify(ca.horzcat(*block)) for block in blocks]
        functions = [rollout, ca.Function("linearise", [*problem, u], [slacks, *blocks])]
        if self.policy is None:
            return functions

        x, actions = ca.MX.sym("x", n_x), []
        found = call(self.policy, x * self.x_scale + self.x_center, g, m)
        policy = ca.Function("policy", [x, g, m], [ca.fmax(ca.fmin((found - self.u_center) / self.u_scale, 1), -1)], named)

        def follow(t, x):
            x = x if t else x @ weight[1 : S + 1].T  # scenarios share the first action: that of their mean
            n = x.shape[1]
            actions.append(policy.map(n)(x, ca.repmat(goal[:, t], 1, n), ca.repmat(mismatch, 1, n)))
            return actions[-1]

        list(stages(step, follow))
        return [*functions, ca.Function("follow", problem, [ca.horzcat(*actions)])]

    def reset(self):
        super().reset()
        self.plan = self.problem = None  # scaled actions (inner, n_u), and what they were planned from

    def belief(self, x):
        """Of every scenario the state to start from, (S, n_x), the parameters, (S, n_psi), and the weight, (S,)."""
        S = len(self.scenarios)
        return np.tile(x, (S, 1)), self.scenarios + self.estimator.shift, np.full(S, 1 / S)

    def _problem(self, x):
        """Parameters of the compiled functions, a row per column of theirs."""
        starts, psi, weight = self.belief(x)
        goal = np.broadcast_to(self.goal.reshape(len(self.goal), -1), (len(self.goal), self.horizon)).T
        u_before = (self.u_before - self.u_center) / self.u_scale
        return ((starts - self.x_center) / self.x_scale, psi, self.tree.weights(weight)[:, None], goal,
                self.estimator.disturbance, self.estimator.mismatch, self.slack_price, self.change_weight, u_before)  # fmt: skip

    def _guesses(self, x):
        """First guesses by name, (inner, n_u)."""
        found = {}
        if self.plan is not None:
            found["shifted"] = self.plan[self.tree.later]
            if np.abs((x - self.x_before) / self.x_scale).max() < HARDLY_MOVED:  # else an action could be put off for ever
                found["last"] = self.plan
        for follow in self.follow:
            found["policy"] = follow(*self.problem)[0].copy()
        return found or {"middle": np.zeros((self.tree.inner, len(self.u_scale)))}

    def _cost(self, u):
        """Cost of a plan; not a number if a state of it is not finite."""
        J, states = self.rollout(*self.problem, u)
        return J.item() if np.isfinite(states).all() else np.nan

    def _improve(self, u, cost, tick):
        """The plan u after as many iterations as it may have, and its cost."""
        weight, change, u_before = self.problem[2], self.problem[7], self.problem[8]
        change = weight[: self.tree.inner] * change
        price = weight[1:, :, None] * np.where(self.slack_price > 0, self.slack_price, 1)  # 1: there is no such bound
        barrier = max(price.max(initial=0), 1.0)
        for _ in range(self.iterations):
            if self.deadline_ms is not None and 1e3 * (time.perf_counter() - tick) > self.deadline_ms:
                self.stats |= {"stop": "late", "late": True}
                break
            self.stats["iterations"] += 1
            slack, *model, states = self.linearise(*self.problem, u)
            x, moved = states[:, self.rows], u - np.vstack([u_before, u[self.tree.parent[1 : self.tree.inner]]])
            step, found = self.qp.solve(*model, -1 - u, 1 - u, self.low - x, self.high - x, price, change, moved, barrier)
            if step is None:
                self.stats["stop"] = "unsolved"
                break
            self.stats["predicted"] = predicted = slack.item() - found
            small, better = not predicted > STATIONARY * (1 + abs(cost)), False
            for share in 0.5 ** np.arange(6):
                new = np.clip(u + share * step, -1, 1)
                new_cost = self._cost(new)
                better = new_cost < cost and not cost - new_cost < 0.1 * share * predicted
                if better:
                    u, cost = new, new_cost
                    break
            if small or not better:
                self.stats["stop"] = "stationary" if small else "stalled"
                break
        return u, cost

    def action(self, x, tick):
        self.problem = self._problem(x)
        guesses = self._guesses(x)
        costs = {name: cost for name, u in guesses.items() if np.isfinite(cost := self._cost(u))}
        if not costs:
            self.plan, self.stats["fell_back"] = None, True
            goal = self.goal.reshape(len(self.goal), -1)[:, 0]
            return np.array(call(self.policy, x, goal, self.estimator.mismatch)).ravel() if self.follow else [np.nan]
        best = min(costs, key=costs.get)
        self.stats |= {"rung": "plan", "guess": best, "guess_cost": costs[best], "stop": "limit", "predicted": np.nan}
        self.plan, self.stats["cost"] = self._improve(guesses[best], costs[best], tick)
        return self.plan[0] * self.u_scale + self.u_center

    def prediction(self):
        """The last plan, physical units: lists over stages of states (n_x, nodes) from x_1 on and actions (n_u, nodes)."""
        if self.plan is None:
            raise ValueError("there is no prediction before the first make_step, nor where it fell back")
        states = self.rollout(*self.problem, self.plan)[1] * self.x_scale + self.x_center
        actions = self.plan * self.u_scale + self.u_center
        inner, edges = self.tree.first[1:-1], self.tree.first[2:-1] - 1
        return {"x": [x.T for x in np.split(states, edges)], "u": [u.T for u in np.split(actions, inner[:-1])]}


def build_controller(name, args):
    """One of the compared controllers, a key of LABELS. Raises ValueError for what cannot work."""
    if name not in LABELS:
        raise ValueError(f"{name!r} is not a controller; choose one of {', '.join(LABELS)}")
    plant, goal, critic = check(args)
    mu, Q, V = export(critic)
    observed = "mismatch" if critic.mismatch_scale else None

    def estimator(kind):
        return envs.Estimator(plant, kind, args.filter_gain, critic.mismatch_scale)

    if name == "actor":
        return ActorController(plant, mu, goal, estimator(observed))
    if name == "rl_mpc" and args.horizon == 0:
        return GreedyController(plant, mu, Q, goal, estimator(observed))
    spread = (0.5 if args.offset_free else 1.0) if args.spread is None else args.spread
    scenarios = plant.PSI_NOMINAL + spread * (plant.SCENARIOS["mpc"] - plant.PSI_NOMINAL)
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(goal))
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))
    options = dict(goal=goal, estimator=estimator(args.estimate if args.offset_free else observed), compile=args.compile)
    options |= dict(iterations=args.iterations, deadline_ms=args.deadline_ms)
    if name in ("nominal_mpc", "robust_mpc"):  # no value: a quadratic cost, every bound of the plant's benchmark
        robust, benchmark = name == "robust_mpc", plant.BENCHMARK
        price = benchmark["slack_price"] * (len(scenarios) if robust else 1)  # the reference sums slack over scenarios
        options |= dict(robust_horizon=int(robust), slack_price=price, change_weight=benchmark["change_weight"])
        stage = ca.Function("stage", [x, g], [squared_error])
        return ScenarioMPC(plant, benchmark["horizon"], scenarios, stage, **options)
    sigma2 = plant.MPC_SIGMA2 if args.sigma is None else args.sigma**2
    stage = ca.Function("stage", [x, g], [-ca.exp(-squared_error / (2 * sigma2))])
    slack_weight = critic.slack_weight if args.slack_weight is None else args.slack_weight
    options |= dict(
        robust_horizon=args.robust_horizon,
        slack_price=slack_weight if args.constraints == "soft" else np.inf,
        change_weight=args.change_weight or 0.0,
    )
    if name == "rl_mpc":
        options |= dict(value=V, policy=mu, expansion=expansion(critic))
    return ScenarioMPC(plant, args.horizon, scenarios, stage, **options)


def critic_path(args):
    folder = Path(__file__).parent / "experiments/pretrained"
    shipped = [folder / f"{args.env}_{kind}.pt" for kind in ("constrained", "robust")]
    return args.critic or next((path for path in shipped if path.exists()), shipped[0])


# Closed loop


def draws(plant, episodes, seed):
    """Start states (episodes, n_x) uniform in their box and plants (episodes, n_psi) from the evaluation set."""
    rngs = [np.random.default_rng([seed, 3, i + 1]) for i in range(episodes)]  # of any number, the first are the same
    starts = np.concatenate([envs.sample_states(plant, rng, 1) for rng in rngs])
    return starts, np.stack([rng.choice(plant.EVAL_PSI) for rng in rngs])


def run_episode(controller, plant, x0, psi, goal, steps):
    """Closed loop on a plant with fixed parameters: x (steps + 1, n_x), u (steps, n_u) and the row of results.csv."""
    controller.reset()
    x, u, log = [np.array(x0, dtype=float)], [], []
    for _ in range(steps):
        u.append(controller.make_step(x[-1]))
        x.append(plant.step(x[-1], u[-1], psi))
        log.append(controller.stats)
    x, u = np.array(x), np.array(u)
    milliseconds = [stats["wall_ms"] for stats in log]
    achieved = x[1:, plant.GOAL_INDEX]
    row = {
        "time_near_goal": envs.goal_reward(plant, achieved, goal, sigma2=METRIC_SIGMA2).sum(),
        "time_outside_constraints": envs.outside_constraints(plant, x[1:], METRIC_SIGMA2).sum(),
        "ape_tail": plant.percentage_error(achieved, np.asarray(goal))[-25:].mean(),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "iterations": np.mean([stats["iterations"] for stats in log]),
        "late": sum(stats["late"] for stats in log),
        "fell_back": sum(stats["fell_back"] for stats in log),
    }
    return x, u, row


@cache
def worker_controller(name, args):
    """A controller built once in each worker process."""
    torch.set_num_threads(1)
    return build_controller(name, args)


def prepare(name, args):
    """Have a controller's functions compiled before the workers need them."""
    worker_controller(name, args)


def run_job(name, args, episode):
    """A controller on one of the paired draws, or (episode None) from the plant's start: x, u and a row of results.csv."""
    controller, critic = worker_controller(name, args), critic_path(args)
    plant, given = controller.plant, {k: v for k, v in vars(args).items() if k not in ELSEWHERE and v != getattr(Args, k)}
    starts, psis = draws(plant, (episode or 0) + 1, args.seed)
    start, psi = (plant.START, plant.PSI_NOMINAL) if episode is None else (starts[episode], psis[episode])
    x, u, row = run_episode(controller, plant, start, psi, controller.goal, args.steps)
    head = {
        "env": args.env,
        "controller": name,
        "horizon": controller.horizon or 0,
        "critic": f"{critic.absolute().parent.name}/{critic.name}",
        "goal": " ".join(f"{g:g}" for g in controller.goal),
        "episode": episode,
        "seed": args.seed,
        "psi": json.dumps(psi.tolist()),
        "arguments": json.dumps(given),
    }
    return x, u, head | {k: round(float(v), 6) if isinstance(v, float) else int(v) for k, v in row.items()}


def compare(args, names):
    """Every controller on every draw and from the plant's start: {(name, episode or None): (x, u, row)}."""
    # else CasADi would take Ctrl-C for a failed evaluation, and torch does not survive a fork
    quit_at_once = dict(initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_DFL))
    pool = ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn"), **quit_at_once)
    try:
        list(pool.map(prepare, names, [args] * len(names)))
        jobs = {pool.submit(run_job, name, args, i): (name, i) for name in names for i in (None, *range(args.episodes))}
        for future in tqdm(as_completed(jobs), total=len(jobs), unit="episode", disable=None):
            future.result()
    finally:
        pool.shutdown(cancel_futures=True)
    return {key: future.result() for future, key in jobs.items()}


def label(row):
    return LABELS[row["controller"]] + (f", N = {row['horizon']}" if row["controller"] != "actor" else "")


def table(rows):
    """The comparison as text: median [worst] over episodes."""
    lines = [
        "                        time near goal    time outside    offset      step, ms     iterations   late  steps that",
        "controller              median [worst]  median [worst]       %  median     p95     per step  steps   fell back",
    ]
    for name in dict.fromkeys(row["controller"] for row in rows):
        mine = {key: np.array([row[key] for row in rows if row["controller"] == name]) for key in list(rows[0])[9:]}
        near, outside, offset, median, p95, iterations, late, fell_back = mine.values()
        title = label(next(row for row in rows if row["controller"] == name))
        lines.append(
            f"{title:22s}  {np.median(near):6.1f} [{near.min():5.1f}]  {np.median(outside):6.1f} [{outside.min():5.1f}]"
            f"  {np.median(offset):6.2f}  {np.median(median):6.1f}  {np.median(p95):6.1f}  {iterations.mean():11.1f}"
            f"  {late.sum():5d}  {fell_back.sum():10d}"
        )
    steps = "Near the goal: more is better. Outside the constraints: 0 is best, and no controller reaches it from a start"
    return "\n".join([*lines, steps, "that must leave them. Offset: mean error of the last 25 steps. A step that fell back had no plan."])


def write_csv(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    with open(path.with_suffix(".tmp"), "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    path.with_suffix(".tmp").replace(path)


def check(args):
    """Refuse arguments that cannot work, before anything long starts: ValueError. Returns plant, goal and critic."""
    ranges = {
        "horizon": (0, 1000), "robust_horizon": (0, 10), "episodes": (1, 10**6), "steps": (1, 10**6), "jobs": (1, 1024),
        "seed": (0, 10**9), "sigma": (1e-6, 1e6), "slack_weight": (1e-6, 1e6), "iterations": (0, 1000),
        "deadline_ms": (1e-3, 1e6), "filter_gain": (1e-6, 1), "spread": (0, 10),
    }  # fmt: skip
    for name, (least, most) in ranges.items():
        if getattr(args, name) is not None and not least <= getattr(args, name) <= most:  # catches nan too
            raise ValueError(f"--{name.replace('_', '-')} is {getattr(args, name)}; it must lie in [{least:g}, {most:g}]")
    for name in ("constraints", "combine", "estimate"):
        if getattr(args, name) not in get_args(Args.__annotations__[name]):
            choices = ", ".join(get_args(Args.__annotations__[name]))
            raise ValueError(f"--{name} is {getattr(args, name)!r}; choose one of {choices}")
    path = critic_path(args)
    if args.critic is None and args.env in envs.names() and not path.exists():
        raise ValueError(f"--critic is missing: none is shipped for {args.env}; train one with python sac_her_branching.py --env {args.env}")
    envs.load(args.env)
    critic = load_critic(path, args.env, "min" if args.horizon == 0 else args.combine)
    plant = critic.plant
    # arguments that would do nothing
    unused = {
        "estimate": (not args.offset_free, "without --offset-free"),
        "filter_gain": (not args.offset_free and not critic.mismatch_scale, "without --offset-free"),
        "slack_weight": (args.constraints == "hard", "on hard constraints"),
    }
    if args.horizon == 0:
        names = ("robust_horizon", "sigma", "slack_weight", "constraints", "change_weight", "combine")
        unused |= {name: (True, "at --horizon 0") for name in names}
    for name, (is_unused, why) in unused.items():
        if is_unused and getattr(args, name) != getattr(Args, name):
            raise ValueError(f"--{name.replace('_', '-')} {getattr(args, name)} has no effect {why}")
    if args.horizon == 0 and "goal_mpc" in args.controllers:
        raise ValueError("--horizon is 0; --controllers goal_mpc plans, so that it must be at least 1")
    if not args.controllers:
        raise ValueError(f"--controllers is empty; choose from {', '.join(LABELS)}")
    if args.change_weight is not None and not (len(args.change_weight) == len(plant.U_LOW) and min(args.change_weight) >= 0):
        raise ValueError(f"--change-weight is {args.change_weight}; it needs {len(plant.U_LOW)} numbers that are not negative")
    if args.offset_free and args.estimate == "parameters" and not np.ptp(plant.SCENARIOS["mpc"], axis=0).any():
        raise ValueError(f"--estimate is parameters, but {args.env} has none that are uncertain; choose disturbance")
    ScenarioTree(len(plant.SCENARIOS["mpc"]), max(args.horizon, 1), args.robust_horizon)
    goal = envs.checked_goal(plant, plant.EVAL_GOAL if args.goal is None else args.goal)
    return plant, goal, critic


def main(args):
    plant, goal, critic = check(args)
    names = list(dict.fromkeys(args.controllers))
    if len(plant.SCENARIOS["mpc"]) == 1 and {"nominal_mpc", "robust_mpc"} <= set(names):
        names.remove("robust_mpc")
        print("notice: robust MPC is left out, since with a single scenario it is nominal MPC", file=sys.stderr)
    if not envs.can_hold(plant, goal):
        print(f"warning: --goal {args.goal} is not a goal that every scenario can hold", file=sys.stderr)
    try:
        out = args.out or envs.new_folder(Path("runs") / f"{args.env}__rl_mpc_deploy__{args.seed}__{int(time.time())}")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise ValueError(f"--out {args.out or 'runs'}: cannot write there ({error.strerror})") from None
    print(f"{critic_path(args)}: the CasADi export equals torch to {check_export(critic):.0e}", flush=True)
    tick = time.perf_counter()
    found = compare(args, names)
    rows = [found[name, i][2] for name in names for i in range(args.episodes)]
    write_csv(rows, out / "results.csv")
    paths = {f"{name}_{'xu'[k]}": np.stack([found[name, i][k] for i in range(args.episodes)]) for name in names for k in (0, 1)}
    np.savez_compressed(out / "trajectories.npz", **paths)
    shown = [name for name in names if name != "nominal_mpc"] or names
    lines = {label(found[name, None][2]): (*found[name, None][:2], STYLES[name]) for name in shown}
    draw_episode(plant, lines, np.tile(goal, (args.steps, 1)), out / "episode.png")
    print(table(rows))
    print(f"{args.episodes} paired draws in {time.perf_counter() - tick:.0f} s with {args.jobs} processes; {out}/results.csv, trajectories.npz;")
    print("episode.png: the plant's start state and nominal parameters")
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
