# /// script
# requires-python = ">=3.11"
# dependencies = ["torch==2.13.0", "gymnasium==1.4.0", "casadi==3.8.2", "numpy", "scipy", "tyro", "matplotlib", "tqdm"]
# ///
"""The deployed controller: short-horizon scenario MPC whose terminal cost is a learned goal-conditioned critic (eq:QMPC).

    minimise over u   1/S sum_i { sum_{t=1}^{N} [ w' |eps_t^i| - exp(-|g - x_t^i|^2 / (2 sigma^2)) ] - V(x_N^i, g) }
    subject to        x_{t+1}^i = f(x_t^i, u_t^i, psi^i),   x_0^i = s,   u_0^i = u_0^j,   x_t^i - eps_t^i in X,   u_t^i in U

with V(x, g) = Q(x, mu(x, g), g) from a checkpoint of sac_her_branching.py, rebuilt in CasADi. The sums start at x_1: x_0 is
measured, its reward is a constant, and V(x_N) counts rewards from x_{N+1} on. The controller is compared, on paired draws of
start state and plant, with the actor alone and with nominal and robust MPC.

    python rl_mpc_deploy.py --horizon 5                                            # with the critic that the repository ships
    python rl_mpc_deploy.py --critic experiments/pretrained/cstr_robust.pt         # as in the paper: a critic blind to constraints
    python rl_mpc_deploy.py --horizon 5 --critic runs/NAME/checkpoint.pt           # with your own
    python rl_mpc_deploy.py --offset-free                                          # an estimate of the plant takes the steady-state offset
    python rl_mpc_deploy.py --horizon 0 --episodes 20 --goal 0.7 --jobs 2          # no prediction: the critic's best action

It writes `runs/{env}__rl_mpc_deploy__{seed}__{time}/`: results.csv (a row per controller and episode), trajectories.npz and
episode.png. Only the folder `envs/` is needed beside this file, and a checkpoint.
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
from typing import Literal

import casadi as ca
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from scipy.optimize import minimize
from tqdm import tqdm

import envs
from envs.tools.compiled import compiled_solver
from envs.tools.expansion import Expansion, TaylorValue, with_derivatives
from envs.tools.figure import draw_episode

# arguments that results.csv has columns for, or that change no result
ELSEWHERE = {"env", "horizon", "critic", "goal", "seed", "episodes", "jobs", "controllers", "compile", "out"}
MAX_CHECKPOINT_BYTES = 10**9
METRIC_SIGMA2 = 0.01  # of time near goal and time outside constraints
DEFAULT_CONTROLLERS = ("actor", "nominal_mpc", "robust_mpc", "rl_mpc")


@dataclass(frozen=True)
class Args:
    env: str = "cstr"
    """the plant: NAME of a module envs/NAME.py; must be the one that the critic was trained on, whose checkpoint also names its size"""
    horizon: int = 5
    """prediction steps N of RL+MPC; 0: the action that maximises the critic, no prediction"""
    critic: Path | None = None
    """a checkpoint.pt of sac_her_branching.py; default: experiments/pretrained/{env}_constrained.pt, where there is none {env}_robust.pt
    (cstr: the first knows the price of constraints, the second is the paper's)"""
    goal: tuple[float, ...] | None = None
    """what to hold (cstr: c_B in mol/l); default: the plant's evaluation goal"""
    episodes: int = 4
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
    """RL+MPC: price of a constraint violation, per physical unit (mol/l, degC) and step; default: 2 with a critic
    that was trained with --constraint-weight, 1 with one that was not, as in the paper"""
    constraints: Literal["soft", "hard"] = "soft"
    """RL+MPC: hard forbids every violation, as in the paper's variant, whose problem may have no solution or none that moves on"""
    value: Literal["exact", "taylor", "taylor-local"] = "exact"
    """RL+MPC: V itself, or its concave second-order expansion about the goal, or about where each scenario's first guess ends"""
    combine: Literal["min", "first", "mean"] = "first"
    """which of the twin critics V takes; their minimum has kinks, where the solver stalls"""
    offset_free: bool = False
    """every controller that predicts: estimate from the last transitions how the plant differs from the model (see `envs.Estimator`)"""
    estimate: Literal["disturbance", "parameters"] = "disturbance"
    """what --offset-free estimates: what to add to every prediction, or the uncertain parameters, on which the scenarios are centred"""
    filter_gain: float = 1.0
    """how far the estimate, or the mismatch that a critic observes, follows the last transition, 1: wholly; less in noise"""
    spread: float | None = None
    """size of the scenario set about its centre; default: 1, the plant's, with --offset-free 0.5, since the estimate explains part of it"""
    controllers: tuple[Literal["actor", "nominal_mpc", "robust_mpc", "goal_mpc", "rl_mpc"], ...] = DEFAULT_CONTROLLERS
    """which controllers to compare; goal_mpc: RL+MPC's problem without the learned value"""
    compile: bool = True
    """translate the optimal control problems to C and compile them, once per problem and critic (kept in $XDG_CACHE_HOME/rlmpc, or
    ~/.cache/rlmpc); linear plants are never compiled, since matrix products gain nothing"""
    out: Path | None = None
    """folder of the results; default: runs/{env}__rl_mpc_deploy__{seed}__{time}"""


# Networks, as in sac_her_branching.py: a checkpoint loads into them with strict=True


class Actor(nn.Module):
    """Mean of the tanh-Gaussian policy, features (B, n_in) -> action in [-1, 1]^n_u."""

    def __init__(self, n_in, n_u, hidden):
        super().__init__()
        widths = [n_in, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:]))
        self.head = nn.Linear(widths[-1], 2 * n_u)  # mean and log standard deviation; deployment needs the mean

    def act(self, z):
        for layer in self.layers:
            z = F.silu(layer(z))
        return torch.tanh(self.head(z).chunk(2, dim=-1)[0])


class TwinCritic(nn.Module):
    """Two Q networks evaluated as one batched product: features (B, n_in) and action (B, n_u) -> (2, B)."""

    def __init__(self, n_in, n_u, hidden):
        super().__init__()
        widths = [n_in + n_u, *hidden, 1]
        self.weight = nn.ParameterList(torch.empty(2, a, b) for a, b in zip(widths, widths[1:]))
        self.bias = nn.ParameterList(torch.empty(2, 1, b) for b in widths[1:])

    def forward(self, z, a):
        h = torch.cat([z, a], dim=-1).expand(2, -1, -1)
        *hidden, (w_out, b_out) = zip(self.weight, self.bias)  # a slice of a ParameterList would make a new module each time
        for w, b in hidden:
            h = F.silu(torch.baddbmm(b, h, w))
        return torch.baddbmm(b_out, h, w_out).squeeze(-1)


class Critic:
    """Actor and twin critics of a checkpoint in float64: float32 noise (1e-6 at |V| = 40) is above the solver's tolerance."""

    def __init__(self, data, combine):
        options = dict(data.get("plant_options", {}))
        self.mismatch_scale = options.pop("observe_mismatch", None)  # of a critic that observes the mismatch
        self.plant = envs.load(data["env"], **options)
        self.network, self.goal_input, self.combine = data["network"], data["goal_input"], combine
        self.slack_weight = 2.0 if data["args"].get("constraint_weight") else 1.0  # the default price in a plan that ends in this value
        with torch.device("meta"):  # sizes take no memory until the file's own weights are put in, if they fit
            self.actor, self.critic = Actor(**self.network), TwinCritic(**self.network)
        self.actor.load_state_dict(data["actor"], assign=True)
        self.critic.load_state_dict(data["critic"], assign=True)
        self.actor, self.critic = self.actor.double(), self.critic.double()
        # affine maps between physical and network units
        self.scaling = {k: np.array(v, dtype=int if k.endswith("index") else float) for k, v in data["scaling"].items()}

    def features(self, x, goal, xp):
        """Network input, components along the first axis, xp torch or casadi: x (n_x, B), goal (n_goal, B) -> (n_in, B).

        x of a critic that observes the mismatch has it below the state.
        """
        concat = torch.cat if xp is torch else lambda parts: ca.vertcat(*parts)
        s = {k: v.tolist() if v.dtype == int else v if xp is ca else torch.from_numpy(v)[:, None] for k, v in self.scaling.items()}
        if self.goal_input == "error":
            goal = goal - x[s["goal_index"], :]
            g = goal / s["error_scale"]
        else:
            g = (goal - s["goal_center"]) / s["goal_scale"]
        angles = concat([x, goal])[s["angle_index"], :]
        return concat([concat([(x - s["x_center"]) / s["x_scale"], g])[s["other_index"], :], xp.sin(angles), xp.cos(angles)])

    def layers(self):
        """(W, b) of every layer, b a column: of the actor, whose last gives the mean alone, and of the twin critics."""
        n_u, actor = self.network["n_u"], [*self.actor.layers, self.actor.head]
        actor = [(layer.weight.detach().numpy(), layer.bias.detach().numpy()[:, None]) for layer in actor]
        actor[-1] = tuple(v[:n_u] for v in actor[-1])
        pairs = list(zip(self.critic.weight, self.critic.bias))
        return actor, [[(w[j].T.detach().numpy(), b[j].T.detach().numpy()) for w, b in pairs] for j in range(2)]

    def example(self):
        """A network input in physical units: the plant's start state, below it a mismatch of zero if that is observed, and a goal."""
        start = np.asarray(self.plant.START, dtype=float)
        return np.append(start, np.zeros_like(start)) if self.mismatch_scale else start, np.asarray(self.plant.EVAL_GOAL, dtype=float)

    def value(self, x, goal):
        """V(x, g) = Q(x, mu(x, g), g) in torch, (B, n_x) and (B, n_goal) -> (B,)."""
        z = self.features(x.T, goal.T, torch).T
        q = self.critic(z, self.actor.act(z))
        return {"min": q.amin(0), "first": q[0], "mean": q.mean(0)}[self.combine]


def load_critic(path, env, combine="first"):
    """The actor and critic stored in a checkpoint.pt, which is data, never code. Raises ValueError, one sentence, for anything else."""
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
            if not all(p.isfinite().all() for p in [*critic.actor.parameters(), *critic.critic.parameters()]):
                raise ValueError("weights that are not finite")
            if not all((v > 0).all() for name, v in critic.scaling.items() if name.endswith("scale")):
                raise ValueError("scales that are not positive")
            if not critic.value(*(torch.from_numpy(v)[None] for v in critic.example())).isfinite().all():
                raise ValueError("values that are not finite")
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; it must be a checkpoint.pt written by sac_her_branching.py") from None
    except Exception as error:  # text, a truncated file, a folder, a pickle of code, weights that do not fit: torch raises many types
        reason = str(error) if type(error) is ValueError and "\n" not in str(error) else type(error).__name__
        raise ValueError(f"{path} is not a checkpoint.pt of sac_her_branching.py ({reason})") from None
    if found != env:
        raise ValueError(f"{path} was trained on {found!r}, not on {env!r}; --env and --critic must match")
    return critic


# CasADi export


def export(critic):
    """CasADi functions mu(x, goal) -> u, Q(x, u, goal) -> (min or first or mean) and V(x, goal), physical units, float64.

    Of a critic that observes the mismatch each takes it, (n_x,), as one more argument.
    """

    def mlp(layers, h):
        for w, b in layers[:-1]:
            h = w @ h + b
            h = h * (1 + ca.tanh(h / 2)) / 2  # SiLU; exp(-h) would overflow in its derivatives
        return layers[-1][0] @ h + layers[-1][1]

    s, (actor, twins) = critic.scaling, critic.layers()
    n_x = len(critic.plant.X_LOW)
    x, goal, u = (ca.MX.sym(name, n) for name, n in (("x", n_x), ("goal", s["goal_center"].size), ("u", s["u_center"].size)))
    seen = [ca.MX.sym("mismatch", n_x)] if critic.mismatch_scale else []
    z = critic.features(ca.vertcat(x, *seen), goal, ca)
    mu = ca.Function("mu", [x, goal, *seen], [ca.tanh(mlp(actor, z)) * s["u_scale"] + s["u_center"]])
    q = [mlp(twin, ca.vertcat(z, (u - s["u_center"]) / s["u_scale"])) for twin in twins]
    combined = {"min": ca.fmin(*q), "first": q[0], "mean": (q[0] + q[1]) / 2}[critic.combine]
    Q = ca.Function("Q", [x, u, goal, *seen], [combined])
    V = ca.Function("V", [x, goal, *seen], [Q(x, mu(x, goal, *seen), goal, *seen)], ["x", "goal", "mismatch"][: 2 + len(seen)], ["V"])
    return mu, Q, V


def check_export(critic, V, points=64, tolerance=1e-8):
    """Compare value and gradient with torch at random states; returns the largest scaled difference, raises if it is too large."""
    plant, rng = critic.plant, np.random.default_rng(0)
    x = torch.tensor(envs.sample_states(plant, rng, points), requires_grad=True)
    goal = torch.tensor(rng.uniform(plant.GOAL_LOW, plant.GOAL_HIGH, size=(points, len(plant.GOAL_LOW))))
    seen = [torch.tensor(rng.uniform(-1, 1, size=x.shape))] if critic.mismatch_scale else []
    value, x_scale = critic.value(torch.cat([x, *seen], dim=1), goal), critic.scaling["x_scale"][: x.shape[1]]
    (gradient,) = torch.autograd.grad(value.sum(), x)
    gradient = gradient.numpy() * x_scale  # per unit of the network's input, as the value is
    inputs = [ca.MX.sym(V.name_in(i), V.size1_in(i)) for i in range(V.n_in())]
    both = ca.Function("both", inputs, [V(*inputs), ca.gradient(V(*inputs), inputs[0])]).map(points)
    v, dv = (np.array(a) for a in both(*(value.detach().numpy().T for value in (x, goal, *seen))))
    dv = dv.T * x_scale
    value = value.detach().numpy()
    worst = max(np.abs(v[0] - value).max(), np.abs(dv - gradient).max()) / (1 + np.abs(value).max())
    if not worst < tolerance:
        raise RuntimeError(f"the CasADi export differs from torch by {worst:.1e} (allowed: {tolerance:.0e}); nothing was run")
    return worst


# Scenario MPC


class ScenarioMPC:
    """eq:QMPC (with a learned value) or eq:multiMPCobj (without), by multiple shooting over a scenario tree.

    stage_cost, terminal_cost: CasADi functions (x, goal) -> scalar, to be minimised; terminal_cost may be None.
    scenarios: (S, n_psi); the first is the nominal one. robust_horizon: stages at which the tree branches, 0 = nominal.
    slack_price: (2, n_x), price per physical unit below X_LOW and above X_HIGH; inf makes a bound hard, 0 ignores it.
    relaxed_price: if given, an unsuccessful solve is repeated with every bound soft at this price.
    change_weight: (n_u,), price of the squared change of each action, summed over scenarios.
    actor: CasADi function (x, goal) -> u that supplies cold guesses and the last rung of the failure ladder, or None.
    taylor: a TaylorValue whose expansion is the terminal cost, instead of terminal_cost. expand_at: a function goal -> state (n_x,) to
    expand at, or None for where each scenario's guess ends.
    estimator: an `envs.Estimator`, whose disturbance predictions add and whose shift of the parameters centres the scenarios; default:
    of the kind that estimates nothing. terminal_cost and actor may take its mismatch, (n_x,), as a third argument.
    barrier: IPOPT's barrier parameter at the start of a warm solve, or "adaptive" (mu_strategy, of every solve). A smaller one saves
    iterations and leaves fewer local optima: at 1e-7 the benchmarks are twice as fast and stuck more often.
    """

    def __init__(self, plant, horizon, scenarios, stage_cost, terminal_cost=None, *, goal, robust_horizon=1, slack_price=1.0,
                 relaxed_price=None, change_weight=None, actor=None, taylor=None, expand_at=None, estimator=None, barrier=1e-4,
                 tol=1e-6, max_iter=200, compile=True):  # fmt: skip
        if horizon < 1:
            raise ValueError(f"horizon is {horizon}; it must be at least 1")
        self.plant, self.horizon, self.robust_horizon, self.actor = plant, horizon, robust_horizon, actor
        self.scenarios = np.asarray(scenarios if robust_horizon else scenarios[:1])
        self.stage_cost, self.terminal_cost, self.taylor, self.expand_at = stage_cost, terminal_cost, taylor, expand_at
        self.goal = envs.checked_goal(plant, goal)
        self.n_x, self.n_u = len(plant.X_LOW), len(plant.U_LOW)
        self.slack_price = np.broadcast_to(np.asarray(slack_price, dtype=float), (2, self.n_x))
        self.relaxed_price, self.barrier = relaxed_price, barrier
        self.change_weight = np.zeros(self.n_u) if change_weight is None else np.asarray(change_weight)
        self.x_center, self.x_scale = (plant.INIT_LOW + plant.INIT_HIGH) / 2, (plant.INIT_HIGH - plant.INIT_LOW) / 2
        self.box = (plant.X_LOW - self.x_center) / self.x_scale, (plant.X_HIGH - self.x_center) / self.x_scale
        self.u_center, self.u_scale = (plant.U_LOW + plant.U_HIGH) / 2, (plant.U_HIGH - plant.U_LOW) / 2
        self._build_tree()
        self.theta = np.empty((0, self.nodes[-1])) if taylor is None else taylor.parameters(np.zeros((self.n_x, self.nodes[-1])))
        self.estimator = estimator or envs.Estimator(plant)
        self._build_problem()
        self._build_solvers(compile, tol, max_iter)
        self.set_goal(goal)
        self.reset()

    def _build_tree(self):
        """nodes[t]: how many; parent[t], psi[t]: where node j of stage t comes from and under which scenario."""
        S, R = len(self.scenarios), self.robust_horizon
        self.nodes = [S ** min(t, R) for t in range(self.horizon + 1)]
        self.parent = [None] + [np.arange(n) // S if t < R else np.arange(n) for t, n in enumerate(self.nodes[1:])]
        self.psi = [None] + [self.scenarios[np.arange(n) % S].T for n in self.nodes[1:]]  # (n_psi, nodes)

    def _build_problem(self):
        """Variables, constraints and objective of eq:QMPC, stage by stage, in units of the box of initial states."""
        n_x, n_u = self.n_x, self.n_u
        x_now, goal, u_before = ca.MX.sym("x_now", n_x), ca.MX.sym("goal", len(self.goal)), ca.MX.sym("u_before", n_u)
        price = ca.MX.sym("price", n_x, 2)  # of slack below and above
        theta = ca.MX.sym("theta", *self.theta.shape)  # of the terminal value's expansion at every leaf
        w, lbw, ubw, J, g, lbg, ubg = [], [], [], 0, [], [], []
        self.layout = {}  # (name, stage): first index into w or g, rows, nodes
        self.step = self._model_step()
        memory = [ca.MX.sym(name, len(value)) for name, value in self.estimator.memory().items()]  # held over the horizon

        def variable(name, t, rows, nodes, low, high):
            self.layout[name, t] = sum(v.numel() for v in w), rows, nodes
            w.append(ca.MX.sym(f"{name}_{t}", rows, nodes))
            lbw.append(np.full(rows * nodes, low))
            ubw.append(np.full(rows * nodes, high))
            return w[-1]

        def constrain(name, t, expression, low, high):
            self.layout[name, t] = sum(v.numel() for v in g), *expression.shape
            g.append(expression)
            lbg.append(np.broadcast_to(np.transpose([low]), expression.shape).ravel("F"))
            ubg.append(np.broadcast_to(np.transpose([high]), expression.shape).ravel("F"))

        x, u_parent = x_now, u_before  # physical units, one column per node
        for t in range(self.horizon):
            n, n_next = self.nodes[t], self.nodes[t + 1]
            # u_t at every node: before the tree branches, scenarios share it
            u = variable("u", t, n_u, n, -1.0, 1.0) * self.u_scale + self.u_center
            # x_{t+1} = f(x_t, u_t, psi)
            x_next = variable("x", t + 1, n_x, n_next, -np.inf, np.inf) * self.x_scale + self.x_center
            parent = self.parent[t + 1].tolist()
            predicted = self.predict(x[:, parent], u[:, parent], t + 1, *memory[:2])
            constrain("dynamics", t + 1, (predicted - x_next) / self.x_scale, 0.0, 0.0)
            # X_LOW <= x_{t+1} + below - above <= X_HIGH, slack >= 0; a hard bound is a slack fixed at zero
            below = variable("below", t + 1, n_x, n_next, 0.0, np.inf)
            above = variable("above", t + 1, n_x, n_next, 0.0, np.inf)
            constrain("box", t + 1, (x_next - self.x_center) / self.x_scale + below - above, *self.box)
            slack_cost = (price[:, 0] * self.x_scale).T @ below + (price[:, 1] * self.x_scale).T @ above  # (1, nodes)
            J += self.node_cost(t + 1, x_next, ca.repmat(goal, 1, n_next), slack_cost, *memory[2:])
            change = u - (u_parent if t == 0 else u_parent[:, self.parent[t].tolist()])
            # not averaged, as in the reference: every action's change counts once for each scenario that passes through its node
            J += self.nodes[-1] / n * ca.sum2(ca.DM(self.change_weight).T @ change**2)
            x, u_parent = x_next, u
        if self.taylor is not None:
            J += ca.sum2(self.taylor.cost.map(self.nodes[-1])(x, theta)) / self.nodes[-1]
        self.nlp = {"x": ca.veccat(*w), "p": ca.veccat(x_now, goal, u_before, price, theta, *memory), "f": J, "g": ca.veccat(*g)}
        self.bounds = {"lbx": np.concatenate(lbw), "ubx": np.concatenate(ubw), "lbg": np.concatenate(lbg), "ubg": np.concatenate(ubg)}
        self.known_bounds = {}  # of `_bounds`, by slack price
        self.objective = ca.Function("objective", [self.nlp["x"], self.nlp["p"]], [J])

    def predict(self, x, u, t, disturbance=None, shift=None):
        """The nodes of stage t, (n_x, nodes), from their parents' states and actions and what is estimated."""
        n = x.shape[1]
        if shift is None:
            return self.step.map(n)(x, u, self.psi[t])
        return self.step.map(n)(x, u, self.psi[t] + ca.repmat(shift, 1, n)) + ca.repmat(disturbance, 1, n)

    def policy(self, x):
        """The actor's actions at the states x (n_x, points)."""
        return np.array(self.actor(x, self.goal, *([self.estimator.mismatch] if self.actor.n_in() == 3 else [])))

    def node_cost(self, t, x, goal, slack_cost, mismatch=None):
        """Cost of stage t, averaged over its nodes: x (n_x, nodes), goal (n_goal, nodes), slack_cost (1, nodes), mismatch (n_x,)."""
        cost = slack_cost + self.stage_cost.map(x.shape[1])(x, goal)
        if t == self.horizon and self.terminal_cost is not None:
            seen = [ca.repmat(mismatch, 1, x.shape[1])] if self.terminal_cost.n_in() == 3 else []
            cost += self.terminal_cost.map(x.shape[1])(x, goal, *seen)  # at every leaf
        return ca.sum2(cost) / x.shape[1]

    def _model_step(self):
        """Prediction model (x, u, psi) -> x one sampling time later."""
        if hasattr(self.plant, "next_state"):  # a discrete-time plant
            x, u, psi = ca.MX.sym("x", self.n_x), ca.MX.sym("u", self.n_u), ca.MX.sym("psi", self.scenarios.shape[1])
            return ca.Function("step", [x, u, psi], [self.plant.next_state(x, u, psi, ca)])
        x, u, psi = ca.SX.sym("x", self.n_x), ca.SX.sym("u", self.n_u), ca.SX.sym("psi", self.scenarios.shape[1])
        dt, plant = self.plant.DT / self.plant.MODEL_SUBSTEPS, self.plant
        # one substep is the unit that is differentiated and compiled: unrolled, the four take three times as long to compile
        substep = ca.Function("substep", [x, u, psi], [envs.rk4(plant.ode, x, u, psi, dt, 1, ca)], {"never_inline": True})
        x, u, psi = ca.MX.sym("x", self.n_x), ca.MX.sym("u", self.n_u), ca.MX.sym("psi", self.scenarios.shape[1])
        x_next = x
        for _ in range(plant.MODEL_SUBSTEPS):
            x_next = substep(x_next, u, psi)
        return ca.Function("step", [x, u, psi], [x_next], {"never_inline": True})

    def _build_solvers(self, compile, tol, max_iter):
        """IPOPT twice on the same functions: from scratch, and from a nearby solution with its multipliers."""
        # IPOPT would widen every bound by 1e-8; times a slack price of 4,500 (100 per degC, scaled) and 20 stages that is 1 % of the cost
        common = {"print_level": 0, "sb": "yes", "tol": tol, "max_iter": max_iter, "bound_relax_factor": 0.0}
        # variables are scaled already: MUMPS need not, nor refine every solution (a tenth of the time)
        common |= {"mumps_permuting_scaling": 0, "mumps_scaling": 0, "min_refinement_steps": 0}
        warm = {"warm_start_init_point": "yes", "warm_start_bound_push": 1e-6, "warm_start_mult_bound_push": 1e-6,
                "warm_start_slack_bound_push": 1e-6, "warm_start_bound_frac": 1e-6, "warm_start_slack_bound_frac": 1e-6}  # fmt: skip
        if self.barrier == "adaptive":
            common["mu_strategy"] = "adaptive"
        else:
            warm["mu_init"] = self.barrier

        def options(name):
            return {"ipopt": common | (warm if name == "warm" else {}), "print_time": False, "show_eval_warnings": False}

        self.solvers = compiled_solver("ipopt", self.nlp, options) if compile else None
        self.compiled = self.solvers is not None
        if not self.compiled:
            self.solvers = {name: ca.nlpsol(name, "ipopt", self.nlp, options(name)) for name in ("cold", "warm")}
        self.shift_w, self.shift_g = np.arange(self.nlp["x"].numel()), np.arange(self.nlp["g"].numel())
        for (name, t), (start, rows, nodes) in self.layout.items():
            if (name, t + 1) in self.layout:  # one stage later; under the first scenario, where the tree branches
                shift = self.shift_g if name in ("dynamics", "box") else self.shift_w
                shift[start : start + rows * nodes] = self.layout[name, t + 1][0] + np.arange(rows * nodes)

    def reset(self):
        """Forget the previous plan, the last action and the counts, as at the start of an episode."""
        self.u_before = np.zeros(self.n_u)  # the reference's convention for the input-change penalty
        self.plan = None  # (w, lam_x, lam_g) of the last successful solve, shifted by one step after each use
        self.plan_left = 0  # actions that it still holds
        self.last = None  # the solution of the previous step, if it succeeded
        self.infeasible = False  # whether the previous step needed the relaxed bounds
        self.x_before = self.x_compared = None  # the state of the previous step, and that at which guesses were last compared
        self.last_w = None
        self.stats = {}
        self.estimator.reset()

    def set_goal(self, goal):
        """The goal from now on, (n_goal,). Raises ValueError for one of another shape or with an entry that is not finite."""
        self.goal, self.last = envs.checked_goal(self.plant, goal), None
        if self.taylor is not None:
            self.taylor.goal = self.goal
            if self.expand_at is not None:
                self.theta[:] = self.taylor.parameters(self.expand_at(self.goal)[:, None])

    def block(self, w, name, t):
        """A view (rows, nodes) of the variables or constraints `name` of stage t in a vector like w or g, scaled units."""
        start, rows, nodes = self.layout[name, t]
        return w[start : start + rows * nodes].reshape(nodes, rows).T

    def physical(self, w, name, t):
        """States ("x") or actions ("u") of stage t in w, physical units, (rows, nodes)."""
        center, scale = (self.x_center, self.x_scale) if name == "x" else (self.u_center, self.u_scale)
        return self.block(w, name, t) * scale[:, None] + center[:, None]

    def _rollout(self, x0, action):
        """w of the plan whose actions are `action(t, x)`, (n_x, nodes) -> (n_u, nodes): predicted states, slack as needed."""
        w = np.zeros(self.nlp["x"].numel())
        x, memory = np.asarray(x0, dtype=float)[:, None], list(self.estimator.memory().values())[:2]
        for t in range(self.horizon):
            u = np.clip(action(t, x), self.plant.U_LOW[:, None], self.plant.U_HIGH[:, None])
            parent = self.parent[t + 1]
            x = np.array(self.predict(x[:, parent], u[:, parent], t + 1, *memory))
            scaled = (x - self.x_center[:, None]) / self.x_scale[:, None]
            self.block(w, "u", t)[:] = (u - self.u_center[:, None]) / self.u_scale[:, None]
            self.block(w, "x", t + 1)[:] = scaled
            self.block(w, "below", t + 1)[:] = np.maximum(self.box[0][:, None] - scaled, 0)
            self.block(w, "above", t + 1)[:] = np.maximum(scaled - self.box[1][:, None], 0)
        return w

    def hold_guess(self, x0):
        """The start state held at every node, with the middle action."""
        w = np.zeros(self.nlp["x"].numel())
        for t in range(1, self.horizon + 1):
            self.block(w, "x", t)[:] = ((x0 - self.x_center) / self.x_scale)[:, None]
        return w

    def cold_guess(self, x0):
        """A plan from nothing: the rollout through the scenarios of the actor, or of the plant's own feedback, or `hold_guess`."""
        if self.actor is not None:
            return self._rollout(x0, lambda t, x: self.policy(x))
        if hasattr(self.plant, "baseline"):
            return self._rollout(x0, lambda t, x: self.plant.baseline(x, self.goal[:, None]))
        return self.hold_guess(x0)

    def other_guess(self, x0):
        """One that differs from `cold_guess`: `hold_guess`, or where that was the first the rollout of the last action."""
        if self.actor is not None or hasattr(self.plant, "baseline"):
            return self.hold_guess(x0)
        return self._rollout(x0, lambda t, x: np.tile(self.u_before[:, None], x.shape[1]))

    def set_initial_guess(self, x0):
        """Forget the previous plan: the next solve starts from `cold_guess`."""
        envs.checked_state(self.plant, x0)
        self.plan, self.plan_left, self.last, self.estimator.before = None, 0, None, None

    def _parameters(self, x0, price):
        price = np.where(np.isinf(price), 0.0, price).ravel()
        return np.concatenate([x0, self.goal, self.u_before, price, self.theta.ravel("F"), *self.estimator.memory().values()])

    def _bounds(self, price):
        """Bounds of the problem under a slack price: slack is fixed at zero where a bound is hard (inf) or ignored (0)."""
        bounds = {key: value.copy() for key, value in self.bounds.items()}
        price = np.where(np.isinf(self.box), 0.0, price)
        for t in range(1, self.horizon + 1):
            for name, bound, no_bound, p in (("below", "lbg", -np.inf, price[0]), ("above", "ubg", np.inf, price[1])):
                self.block(bounds["ubx"], name, t)[(p == 0) | np.isinf(p)] = 0.0
                self.block(bounds[bound], "box", t)[p == 0] = no_bound
        return bounds

    def _hard_slack(self, w):
        """The largest violation of a hard bound in w, units of the box's half-widths: not zero only in the relaxed problem."""
        slack = [np.stack([self.block(w, name, t).max(1) for name in ("below", "above")]) for t in range(1, self.horizon + 1)]
        return np.max(slack, axis=0)[np.isinf(self.slack_price)].max(initial=0)

    def _expand(self, w, order=2):
        """With a Taylor value and no fixed point to expand at: expand where each scenario of w ends."""
        if self.taylor is not None and self.expand_at is None:
            self.theta = self.taylor.parameters(self.physical(w, "x", self.horizon), order)

    def _cost(self, x0, w):
        """Objective of a plan with its dynamics satisfied; a hard bound is dear in this comparison."""
        self._expand(w, order=0)
        return self.objective(w, self._parameters(x0, np.minimum(self.slack_price, 1e3)))

    def _solve(self, which, x0, price, guess, lam_x=0, lam_g=0):
        """One call of IPOPT: (w, lam_x, lam_g) if it succeeded, else None. An unsuccessful iterate is not returned."""
        solver = self.solvers[which]
        if price.tobytes() not in self.known_bounds:
            self.known_bounds[price.tobytes()] = self._bounds(price)
        bounds = self.known_bounds[price.tobytes()]
        result = solver(x0=guess, p=self._parameters(x0, price), lam_x0=lam_x, lam_g0=lam_g, **bounds)
        self.last_objective = float(result["f"])
        stats = solver.stats()
        self.stats["status"] = stats["return_status"]
        self.stats["iterations"] += stats["iter_count"]
        if not stats["success"] or not np.isfinite(self.last_objective):
            return None
        return tuple(np.array(result[key]).ravel() for key in ("x", "lam_x", "lam_g"))

    def make_step(self, x0):
        """The action (n_u,) for the measured state x0 (n_x,), physical units. Raises ValueError for a state that is not one.

        Ladder: a solve, from the previous plan shifted by one sampling time (where the state moves slowly also unshifted) or from the
        actor's rollout, whichever costs less; if it does not succeed, one more from a cold guess that was not tried yet (with relaxed
        bounds, if relaxed_price is given; after a step that needed them they are tried first, and the hard bounds if no slack is
        left); then the next action of the last successful plan, while it lasts; then the actor ("actor"); without one, or where its action
        is not finite, the last action ("hold"). `stats` says which.
        """
        x0, tick = envs.checked_state(self.plant, x0), time.perf_counter()
        self.stats = {"success": True, "rung": "solved", "status": "", "iterations": 0}
        self.estimator.update(x0)
        start, guess, moved = "warm", self.last, np.inf if self.last is None else np.abs((x0 - self.x_before) / self.x_scale).max()
        # where the plant has hardly moved since the guesses were last compared, the last plan itself is the best one
        if self.last is None or (np.abs(x0 - self.x_compared) > 1e-3 * self.x_scale).any():
            start, guess, self.x_compared = "cold", (self.cold_guess(x0),), x0
            if self.plan is not None:
                no_rival = self.actor is None and not hasattr(self.plant, "baseline")
                # a plan that is not shifted fits a plant that drifts slowly; where things move, it would put the same action off for ever
                plans = [self.plan, self.last] if moved < 0.03 and not no_rival else [self.plan]
                plans = [(self._rollout(x0, lambda t, x, w=w: self.physical(w, "u", t)), *multipliers) for w, *multipliers in plans]
                costs = [self._cost(x0, w) for w, *_ in plans]
                if no_rival or self._cost(x0, guess[0]) >= min(costs):
                    start, guess = "warm", plans[int(np.argmin(costs))]
        self._expand(guess[0])
        solution, relaxed = None, None if self.relaxed_price is None else np.full((2, self.n_x), self.relaxed_price)
        if self.infeasible and start == "warm":  # and probably still, which the relaxed problem tells far sooner than the hard one
            easy = self._solve("warm", x0, relaxed, *guess)
            if easy is not None and self._hard_slack(easy[0]) > 1e-6:
                solution = easy
                self.stats |= {"success": False, "rung": "retry"}
            guess = easy or guess
        if solution is None:
            solution = self._solve(start, x0, self.slack_price, *guess)
        if solution is None:
            self.stats |= {"success": False, "rung": "retry"}
            other = self.cold_guess(x0) if start == "warm" or relaxed is not None else self.other_guess(x0)
            self._expand(other)
            solution = self._solve("cold", x0, self.slack_price if relaxed is None else relaxed, other)
        self.infeasible = relaxed is not None and not self.stats["success"]
        self.last, self.x_before = solution, x0
        if solution is not None:
            self.last_w, self.plan_left = solution[0], self.horizon
        elif self.plan_left > 0 and np.isfinite(self.plan[0]).all():
            self.stats["rung"], solution = "plan", self.plan
        if solution is not None:
            u = self.physical(solution[0], "u", 0)[:, 0]
            self.plan = solution[0][self.shift_w], solution[1][self.shift_w], solution[2][self.shift_g]
            self.plan_left -= 1
        else:
            self.stats["rung"], self.plan = "actor" if self.actor is not None else "hold", None
            u = self.policy(x0).ravel() if self.actor is not None else self.u_before
        if not np.isfinite(u).all():  # of networks far from where they were trained
            self.stats["rung"], u = "hold", self.u_before
        self.u_before = np.clip(u, self.plant.U_LOW, self.plant.U_HIGH)
        self.estimator.before = x0, self.u_before
        self.stats["wall_ms"] = 1e3 * (time.perf_counter() - tick)
        return self.u_before.copy()

    def prediction(self):
        """The last successful plan, physical units: lists over stages of states (n_x, nodes) from x_1 on and of actions (n_u, nodes)."""
        if self.last_w is None:
            raise ValueError("there is no prediction before the first successful make_step")
        stages = range(self.horizon)
        return {"x": [self.physical(self.last_w, "x", t + 1) for t in stages], "u": [self.physical(self.last_w, "u", t) for t in stages]}


class ActorController:
    """The learned policy alone, with the interface of ScenarioMPC."""

    def __init__(self, plant, actor, goal, estimator=None):
        self.plant, self.actor, self.estimator = plant, actor, estimator or envs.Estimator(plant)
        self.set_goal(goal)
        self.reset()

    def reset(self):
        self.stats, self.u_before = {}, np.zeros(len(self.plant.U_LOW))
        self.estimator.reset()

    def set_goal(self, goal):
        self.goal = envs.checked_goal(self.plant, goal)

    def set_initial_guess(self, x0):
        """Nothing to guess."""

    def make_step(self, x0):
        x0, tick = envs.checked_state(self.plant, x0), time.perf_counter()
        self.estimator.update(x0)
        u = self.act(x0, *([self.estimator.mismatch] if self.actor.n_in() == 3 else []))
        success = bool(np.isfinite(u).all())  # not so far from where networks were trained; then the last action stays
        self.u_before = np.clip(u if success else self.u_before, self.plant.U_LOW, self.plant.U_HIGH)
        self.estimator.before = x0, self.u_before
        self.stats = {"success": success, "rung": "solved" if success else "hold", "status": "", "iterations": 0,
                      "wall_ms": 1e3 * (time.perf_counter() - tick)}  # fmt: skip
        return self.u_before.copy()

    def act(self, x0, *seen):
        """The action before it is clipped, (n_u,); seen: the mismatch (n_x,), if the networks take it."""
        return np.array(self.actor(x0, self.goal, *seen)).ravel()


class GreedyController(ActorController):
    """Horizon 0: argmax over u in U of Q(x, u, goal), by L-BFGS-B from the actor's action and the best of some points of U.

    The points are a grid for one or two actions, random for more.
    """

    def __init__(self, plant, actor, Q, goal, estimator=None, points=9):
        super().__init__(plant, actor, goal, estimator)
        sizes = (("x", len(plant.X_LOW)), ("v", len(plant.U_LOW)), ("goal", len(self.goal)))
        x, v, g = (ca.MX.sym(name, n) for name, n in sizes)  # v: action scaled to [0, 1]
        seen = [ca.MX.sym("mismatch", len(plant.X_LOW))] if actor.n_in() == 3 else []
        q = Q(x, plant.U_LOW + v * (plant.U_HIGH - plant.U_LOW), g, *seen)
        self.negative_q = ca.Function("negative_q", [v, x, g, *seen], [-q, -ca.gradient(q, v)])
        if v.numel() <= 2:
            self.points = np.stack([a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, points)] * v.numel())])  # (n_u, points^n_u)
        else:
            self.points = np.random.default_rng(0).uniform(size=(v.numel(), points**2))

    def act(self, x0, *seen):
        span = self.plant.U_HIGH - self.plant.U_LOW
        at_points = np.array(self.negative_q(self.points, x0, self.goal, *seen)[0]).ravel()
        starts = [(super().act(x0, *seen) - self.plant.U_LOW) / span, self.points[:, at_points.argmin()]]

        def objective(v):
            value, gradient = self.negative_q(v, x0, self.goal, *seen)
            return float(value), np.array(gradient).ravel()

        results = [minimize(objective, start, jac=True, method="L-BFGS-B", bounds=[(0, 1)] * len(span)) for start in starts]
        best = min(results, key=lambda result: result.fun)
        return self.plant.U_LOW + np.clip(best.x, 0, 1) * span


def build_controller(name, args):
    """One of the compared controllers: "actor", "nominal_mpc", "robust_mpc", "goal_mpc" or "rl_mpc". Raises ValueError for another name."""
    if name not in LABELS:
        raise ValueError(f"{name!r} is not a controller; choose one of {', '.join(LABELS)}")
    greedy = name == "rl_mpc" and args.horizon == 0
    critic = load_critic(critic_path(args), args.env, combine(args))
    plant = critic.plant
    compile = args.compile and not hasattr(plant, "next_state")
    mu, Q, V = export(critic)
    goal = envs.checked_goal(plant, plant.EVAL_GOAL if args.goal is None else args.goal)
    observed = "mismatch" if critic.mismatch_scale else None
    estimators = [envs.Estimator(plant, kind, args.filter_gain, critic.mismatch_scale)
                  for kind in (observed, args.estimate if args.offset_free else observed)]  # fmt: skip
    if name == "actor":
        return ActorController(plant, mu, goal, estimators[0])
    if greedy:
        return GreedyController(plant, mu, Q, goal, estimators[0])
    spread = (0.5 if args.offset_free else 1.0) if args.spread is None else args.spread
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(goal))
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))
    scenarios = plant.PSI_NOMINAL + spread * (plant.SCENARIOS["mpc"] - plant.PSI_NOMINAL)
    if name in ("rl_mpc", "goal_mpc"):
        sigma2 = plant.MPC_SIGMA2 if args.sigma is None else args.sigma**2
        stage = ca.Function("stage", [x, g], [-ca.exp(-squared_error / (2 * sigma2))])
        learned, expansion = {}, None if critic.mismatch_scale or compile and args.value == "exact" else Expansion(critic)
        if name == "rl_mpc" and args.value == "exact":
            V = V if compile or expansion is None else with_derivatives(V, expansion)
            seen = [ca.MX.sym("mismatch", len(plant.X_LOW))] if critic.mismatch_scale else []
            learned = dict(actor=mu, terminal_cost=ca.Function("terminal", [x, g, *seen], [-V(x, g, *seen)]))
        elif name == "rl_mpc":
            point = (lambda goal: settled_state(plant, mu, goal)) if args.value == "taylor" else None
            learned = dict(actor=mu, taylor=TaylorValue(V, expansion, goal, critic.scaling["x_scale"]), expand_at=point)
        # a shifted plan is often far from optimal under a learned value: the adaptive barrier takes fewer iterations there
        barrier = "adaptive" if learned else 1e-4
        slack_weight = critic.slack_weight if args.slack_weight is None else args.slack_weight
        mpc = ScenarioMPC(plant, args.horizon, scenarios, stage, goal=goal, robust_horizon=args.robust_horizon, compile=compile,
                          barrier=barrier, slack_price=slack_weight if args.constraints == "soft" else np.inf, estimator=estimators[1],
                          **learned)  # fmt: skip
        mpc.expansion = expansion
        return mpc
    robust, benchmark = name == "robust_mpc", plant.BENCHMARK
    price = benchmark["slack_price"] * (len(scenarios) if robust else 1)  # the reference sums slack over scenarios
    return ScenarioMPC(plant, benchmark["horizon"], scenarios, ca.Function("stage", [x, g], [squared_error]), goal=goal,
                       robust_horizon=int(robust), slack_price=price, relaxed_price=1e3, change_weight=benchmark["change_weight"],
                       compile=compile, estimator=estimators[1])  # fmt: skip


def settled_state(plant, mu, goal, steps=1000):
    """The state that a goal stands for: the goal itself if it names every state, else where the nominal loop under the actor settles."""
    x = np.array(plant.START)
    if len(plant.GOAL_INDEX) == len(x):
        x[plant.GOAL_INDEX] = goal
        return x
    for _ in range(steps):
        x = plant.step(x, np.array(mu(x, goal)).ravel(), plant.PSI_NOMINAL)
    return x


def combine(args):
    """Which of the twin critics V takes: without a solver, whom kinks would stall, their minimum."""
    return "min" if args.horizon == 0 else args.combine


def critic_path(args):
    shipped = [Path(__file__).parent / f"experiments/pretrained/{args.env}_{kind}.pt" for kind in ("constrained", "robust")]
    return args.critic or next((path for path in shipped if path.exists()), shipped[0])


# Closed loop


def draws(plant, episodes, seed):
    """Start states (episodes, n_x) uniform in their box and plants (episodes, n_psi) from the evaluation set."""
    rngs = [np.random.default_rng([seed, 3, i + 1]) for i in range(episodes)]  # episode i does not depend on how many there are
    return np.concatenate([envs.sample_states(plant, rng, 1) for rng in rngs]), np.stack([rng.choice(plant.EVAL_PSI) for rng in rngs])


def run_episode(controller, plant, x0, psi, goal, steps):
    """Closed loop on a plant with fixed parameters: trajectories x (steps + 1, n_x), u (steps, n_u) and the row of results.csv."""
    controller.reset()
    controller.set_initial_guess(x0)
    x, u, log = [np.asarray(x0, dtype=float)], [], []
    for _ in range(steps):
        u.append(controller.make_step(x[-1]))
        x.append(plant.step(x[-1], u[-1], psi))
        log.append(controller.stats)
    x, u = np.array(x), np.array(u)
    rungs = [s["rung"] for s in log]
    milliseconds = [s["wall_ms"] for s in log]
    achieved = x[1:, plant.GOAL_INDEX]
    row = {
        "time_near_goal": envs.goal_reward(plant, achieved, goal, sigma2=METRIC_SIGMA2).sum(),
        "time_outside_constraints": envs.outside_constraints(plant, x[1:], METRIC_SIGMA2).sum(),
        "ape_tail": plant.percentage_error(achieved, np.asarray(goal))[-25:].mean(),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "solver_failures": sum(not s["success"] for s in log),
        "retries": rungs.count("retry"),
        "fallback_plan": rungs.count("plan"),
        "fallback_actor": rungs.count("actor") + rungs.count("hold"),
    }
    return x, u, row


@cache
def worker_controller(name, args):
    """A controller built once in each worker process; a run resets it before every episode."""
    torch.set_num_threads(1)
    return build_controller(name, args)


def prepare(name, args):
    """Have a controller's problem compiled before the workers need it."""
    worker_controller(name, args)


def run_job(name, args, episode):
    """One controller on one of the paired draws, in a worker process: name, episode, x, u and the row of results.csv."""
    controller, critic = worker_controller(name, args), critic_path(args)
    starts, psi = draws(controller.plant, episode + 1, args.seed)
    x, u, row = run_episode(controller, controller.plant, starts[episode], psi[episode], controller.goal, args.steps)
    head = {"env": args.env, "controller": name, "horizon": getattr(controller, "horizon", 0),
            "critic": f"{critic.absolute().parent.name}/{critic.name}", "goal": " ".join(f"{g:g}" for g in controller.goal),
            "episode": episode, "seed": args.seed, "psi": json.dumps(psi[episode].tolist()),
            "arguments": json.dumps({k: v for k, v in vars(args).items() if k not in ELSEWHERE and v != getattr(Args, k)})}  # fmt: skip
    return name, episode, x, u, head | {k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()}


def compare(args):
    """Every controller on every draw, over `--jobs` processes. Returns rows and trajectories {controller: (x, u)}, in order."""
    names, found = list(dict.fromkeys(args.controllers)), {}
    if len(load_critic(critic_path(args), args.env).plant.SCENARIOS["mpc"]) == 1 and {"nominal_mpc", "robust_mpc"} <= set(names):
        names.remove("robust_mpc")
        print("notice: robust MPC is left out, since with a single scenario it is nominal MPC", file=sys.stderr)
    quit_at_once = dict(initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_DFL))  # CasADi would take Ctrl-C for a failed solve
    pool = ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn"), **quit_at_once)  # torch does not survive a fork
    try:
        list(pool.map(prepare, names, [args] * len(names)))
        slow_first = sorted(names, key=("robust_mpc", "nominal_mpc", "rl_mpc", "goal_mpc", "actor").index)
        futures = [pool.submit(run_job, name, args, i) for name in slow_first for i in range(args.episodes)]
        for future in tqdm(as_completed(futures), total=len(futures), unit="episode", disable=None):
            name, episode, *result = future.result()
            found[name, episode] = result
    finally:
        pool.shutdown(cancel_futures=True)
    rows = [found[name, i][2] for name in names for i in range(args.episodes)]
    paths = {name: [np.stack([found[name, i][k] for i in range(args.episodes)]) for k in range(2)] for name in names}
    return rows, paths


# Table and figure


LABELS = {"actor": "RL (actor alone)", "nominal_mpc": "nominal MPC", "robust_mpc": "robust MPC", "goal_mpc": "RL+MPC, no value",
          "rl_mpc": "RL+MPC"}  # fmt: skip
STYLES = {"actor": {"color": "#D55E00", "ls": "--"}, "nominal_mpc": {"color": "#999999", "ls": ":"},
          "robust_mpc": {"color": "#0072B2", "ls": "-."}, "goal_mpc": {"color": "#E69F00", "ls": (0, (4, 1, 1, 1, 1, 1))},
          "rl_mpc": {"color": "#009E73"}}  # fmt: skip


def label(row):
    return LABELS[row["controller"]] + (f", N = {row['horizon']}" if row["controller"] != "actor" else "")


def table(rows):
    """The comparison as text: median [worst] over episodes."""
    lines = [
        "                        time near goal    time outside    offset      solve ms        failed  of these solved by",
        "controller              median [worst]  median [worst]       %  median      p95   solves  retry   plan   actor",
    ]
    for name in dict.fromkeys(row["controller"] for row in rows):
        mine = [row for row in rows if row["controller"] == name]
        measures = ("time_near_goal", "time_outside_constraints", "ape_tail", "solve_ms_median", "solve_ms_p95")
        near, outside, offset, median, p95 = (np.array([row[key] for row in mine]) for key in measures)
        counts = ("solver_failures", "retries", "fallback_plan", "fallback_actor")
        failed, *rungs = (sum(row[key] for row in mine) for key in counts)
        lines.append(
            f"{label(mine[0]):22s}  {np.median(near):6.1f} [{near.min():5.1f}]  {np.median(outside):6.1f} [{outside.min():5.1f}]  "
            f"{np.median(offset):6.2f}  {np.median(median):6.1f}  {np.median(p95):7.1f}  {failed:7d}" + "".join(f"{n:7d}" for n in rungs)
        )
    return "\n".join(lines)


def write_csv(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    with open(path.with_suffix(".tmp"), "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    path.with_suffix(".tmp").replace(path)


def fail(message):
    """A user's mistake: one sentence, exit code 2, no traceback."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check(args):
    """Refuse arguments that cannot work, before anything long starts; returns plant, goal and critic."""
    if args.env not in envs.names():
        fail(f"--env {args.env!r} is not a plant of envs/; choose one of {', '.join(envs.names())}")
    ranges = {"horizon": (0, 1000), "robust_horizon": (0, 10), "episodes": (1, 10**6), "steps": (1, 10**6), "jobs": (1, 1024),
              "seed": (0, 10**9), "sigma": (1e-6, 1e6), "slack_weight": (1e-6, 1e6), "filter_gain": (1e-6, 1),
              "spread": (0, 10)}  # fmt: skip
    for name, (least, most) in ranges.items():
        if getattr(args, name) is not None and not least <= getattr(args, name) <= most:  # catches nan too
            fail(f"--{name.replace('_', '-')} is {getattr(args, name)}; it must lie in [{least:g}, {most:g}]")
    if args.horizon == 0 and "goal_mpc" in args.controllers:
        fail("--horizon is 0; --controllers goal_mpc plans, so that it must be at least 1")
    if not args.controllers:
        fail(f"--controllers is empty; choose from {', '.join(LABELS)}")
    if args.critic is None and not critic_path(args).exists():
        fail(f"--critic is missing: none is shipped for {args.env}; train one with python sac_her_branching.py --env {args.env}")
    try:
        critic = load_critic(critic_path(args), args.env, combine(args))
    except ValueError as error:
        fail(f"--critic {error}")
    unused = {
        "estimate": (not args.offset_free, "without --offset-free"),
        "filter_gain": (not args.offset_free and not critic.mismatch_scale, "without --offset-free"),
        "slack_weight": (args.constraints == "hard", "on hard constraints"),
    }
    if args.horizon == 0:
        names = ("robust_horizon", "sigma", "slack_weight", "constraints", "value", "combine")
        unused |= {name: (True, "at --horizon 0") for name in names}
    for name, (is_unused, why) in unused.items():
        if is_unused and getattr(args, name) != getattr(Args, name):
            fail(f"--{name.replace('_', '-')} {getattr(args, name)} has no effect {why}")
    if args.offset_free and args.estimate == "parameters" and not (np.ptp(critic.plant.SCENARIOS["mpc"], axis=0) > 0).any():
        fail(f"--estimate is parameters, but {args.env} has none that are uncertain; choose disturbance")
    if critic.mismatch_scale and args.value != "exact":
        fail(f"--value is {args.value}; a critic that observes the mismatch needs exact")
    plant = critic.plant
    leaves = len(plant.SCENARIOS["mpc"]) ** min(args.robust_horizon, max(args.horizon, 1))
    if leaves * args.horizon > 20_000:
        fail(f"--robust-horizon {args.robust_horizon} gives a tree of {leaves} leaves; leaves times --horizon may be 20000 at most")
    goal = plant.EVAL_GOAL if args.goal is None else np.array(args.goal)
    if goal.shape != plant.EVAL_GOAL.shape or not ((plant.GOAL_LOW <= goal) & (goal <= plant.GOAL_HIGH)).all():
        low, high = (np.array2string(bound, threshold=4, edgeitems=1) for bound in (plant.GOAL_LOW, plant.GOAL_HIGH))
        fail(f"--goal is {args.goal}; it needs {len(plant.GOAL_LOW)} number(s) in {low} to {high}")
    if not envs.can_hold(plant, goal):
        print(f"warning: --goal {args.goal} is not a goal that every scenario can hold", file=sys.stderr)
    return plant, goal, critic


def main(args):
    plant, goal, critic = check(args)
    try:
        out = args.out or envs.new_folder(Path("runs") / f"{args.env}__rl_mpc_deploy__{args.seed}__{int(time.time())}")
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        fail(f"--out {args.out or 'runs'}: cannot write there ({error.strerror})")
    try:
        difference = check_export(critic, export(critic)[2])
    except RuntimeError as error:
        fail(error)
    print(f"{critic_path(args)}: the CasADi export equals torch to {difference:.0e}")
    planners = set(args.controllers) - {"actor"} - ({"rl_mpc"} if args.horizon == 0 else set())
    if args.compile and planners and not hasattr(plant, "next_state"):
        print("building the controllers; new ones are compiled, which takes half a minute", flush=True)
    tick = time.perf_counter()
    rows, paths = compare(args)
    write_csv(rows, out / "results.csv")
    np.savez_compressed(out / "trajectories.npz", **{f"{name}_{k}": v for name, xu in paths.items() for k, v in zip("xu", xu)})
    labels = {row["controller"]: label(row) for row in rows}
    first = {labels[name]: (x[0], u[0], STYLES[name]) for name, (x, u) in paths.items()}
    draw_episode(plant, first, np.tile(goal, (args.steps, 1)), out / "episode.png")
    print(table(rows))
    print(f"{time.perf_counter() - tick:.0f} s with {args.jobs} processes; {out}/results.csv, trajectories.npz, episode.png")
    return rows


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except KeyboardInterrupt:
        print("interrupted; a comparison writes its results at its end", file=sys.stderr)
        raise SystemExit(130) from None
