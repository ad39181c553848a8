# /// script
# requires-python = ">=3.11"
# dependencies = ["gymnasium==1.4.0", "casadi==3.8.2", "numpy", "scipy", "tyro", "matplotlib", "tqdm"]
# ///
"""Goal-conditioned scenario MPC written out in CasADi: scenario tree, soft constraints, Gaussian objective (eq:multiMPCobj).

    minimise over u   1/P sum_i { sum_{t=1}^N [ l(x_t^i, g_t) + p'|eps_t^i| + |u_{t-1}^i - u_{t-2}^i|_W^2 ] + m(x_N^i) }
    subject to        x_0^i = s,  x_{t+1}^i = f(x_t^i, u_t^i, psi_t^i),  x_t^i - eps_t^i in X,  u_t^i in U,
                      u_t^i = u_t^j while i and j share their history

Over the robust horizon the P paths i take every sequence of scenarios, then each keeps its last; u_{-1} is the last
applied action. `--objective` chooses the stage cost l (Example 1) from the plant's goal error e, for the pendulum
1 - cos(theta - g): goal is -exp(-|e|^2 / (2 sigma^2)) (eq:smoothreward), quadratic |e|^2 / 2, expert the kinetic minus
the potential energy. A linear plant has l(x_t, u_t) = |x_t|^2 + |u_t|^2 at t = 0 ... N-1 and m(x_N) = x_N'Px_N, both
about the goal and the action that holds it (eq:nominalMPCobj with gamma = 1); goal takes -exp of both (eq:jensen).

    python goal_mpc.py --env double_pendulum --objective goal --horizon 75   # swing both rods up and hold them
    python goal_mpc.py --goal up-down down-up@120 --steps 240 --horizon 35 --sigma2 0.5 --animate   # other equilibria
    python goal_mpc.py --env cstr --horizon 20 --robust-horizon 1            # another plant, a tree of nine scenarios

It writes `runs/{env}__goal_mpc__{seed}__{time}/`: results.csv (a row per seed), trajectories.npz, episode.png and, if
asked to, episode.gif. Only the folder `envs/` is needed beside this file.
"""

import json
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import tyro
from tqdm import tqdm

import envs
from envs.control.compiled import compiled_solver
from envs.control.controllers import Controller, checked_problem
from envs.control.model import prediction_model, scaling
from envs.control.tree_qp import ScenarioTree
from envs.script.arguments import as_annotated, check_effects, check_ranges, check_weights, goal_schedule
from envs.script.comparison import output_folder, write_csv
from envs.script.figure import draw_episode


@dataclass(frozen=True)
class Args:
    env: str = "double_pendulum"
    """the plant: NAME of a module envs/NAME.py"""
    dim: int | None = None
    """number of states, for a plant that comes in sizes (linear: 2)"""
    system: int | None = None
    """which one, for a plant that comes in several (linear: the seed of its matrix, 0)"""
    goal: tuple[str, ...] = ()
    """a name (double_pendulum: up-up, up-down, down-up) or numbers joined by commas; @STEP after it: from that step on.
    Default: the plant's evaluation goal"""
    preview: bool = False
    """tell the controller of goal changes within its horizon; otherwise it learns of each when it happens"""
    steps: int = 100
    """sampling times per episode"""
    episodes: int = 1
    """episodes; their seeds are seed, seed + 1, ..."""
    seed: int = 0
    """seed of the first episode: it moves the start state and, with --plant random, draws the plant's parameters"""
    plant: Literal["nominal", "random"] = "nominal"
    """parameters of the simulated plant: the model's, or drawn per episode from the plant's evaluation set"""

    objective: Literal["expert", "quadratic", "goal"] = "goal"
    """stage cost; expert: what the plant module defines (double_pendulum: kinetic minus potential energy)"""
    sigma2: float | None = None
    """sigma^2 of the Gaussian of --objective goal, squared units of the goal error; default: the plant's
    (double_pendulum 1, cstr 0.01, linear 0.5)"""
    horizon: int = 75
    """prediction steps N"""
    robust_horizon: int = 0
    """stages at which the scenario tree branches; 0: the nominal model alone"""
    scenarios: str = "mpc"
    """the plant's scenario set that the tree branches over; the nominal plant comes first, added if the set lacks it"""
    constraints: Literal["soft", "hard"] = "soft"
    """whether the state bounds may be violated at a price"""
    slack_weight: float = 10.0
    """price p of a violation, per physical unit and step (10: a metre off the track costs ten steps at the goal)"""
    change_weight: tuple[float, ...] | None = None
    """price of the squared change of each action; default: 0, with --objective expert the plant's (pendulum: 0.1)"""
    compile: bool = True
    """translate the optimal control problem to C and compile it once (kept in $XDG_CACHE_HOME/rlmpc, or
    ~/.cache/rlmpc); linear plants are never compiled, since matrix products gain nothing"""
    animate: bool = False
    """write episode.gif of the first episode, with the predicted motion drawn faintly"""
    out: Path | None = None
    """folder of the results; default: runs/{env}__goal_mpc__{seed}__{time}"""

    __post_init__ = as_annotated


# Scenario MPC


def positions(**shapes):
    """Where matrices of these shapes lie, column by column, in the vector of all of them."""
    found, start = {}, 0
    for name, (rows, columns) in shapes.items():
        found[name] = start + np.arange(rows * columns).reshape(columns, rows).T
        start += rows * columns
    return found


class ScenarioMPC(Controller):
    """eq:multiMPCobj by multiple shooting over a scenario tree, with soft constraints and a goal per stage, by IPOPT.

    stage_cost, terminal_cost: CasADi functions (x, goal) -> scalar, to be minimised; terminal_cost may be None. A
    stage_cost of (x, u, goal) is summed over (x_0, u_0) ... (x_{N-1}, u_{N-1}) instead of x_1 ... x_N (eq:nominalMPCobj).
    scenarios: (S, n_psi), the first nominal. robust_horizon: stages at which the tree branches; 0: nominal.
    slack_price: scalar or (2, n_x), per physical unit below X_LOW and above X_HIGH; inf: a hard bound; 0: no bound.
    change_weight: scalar or (n_u,), price of the squared change of each action, physical units.
    ipopt: options of IPOPT beside the class's own.

    `stats` of the last step: rung (solved, retry, plan, hold), success (of the first solve), status (IPOPT's, of the
    last), iterations. `objective`: of the last solve.
    """

    cold = {"print_level": 0, "sb": "yes", "tol": 1e-6, "max_iter": 500, "bound_relax_factor": 0.0}
    warm = {"warm_start_init_point": "yes", "mu_init": 1e-7}  # from a nearby solution with its multipliers
    pushes = "bound_push", "mult_bound_push", "slack_bound_push", "bound_frac", "slack_bound_frac"
    warm |= {f"warm_start_{name}": 1e-6 for name in pushes}

    def __init__(
        self,
        plant,
        horizon,
        scenarios,
        stage_cost,
        terminal_cost=None,
        *,
        goal,
        robust_horizon=0,
        slack_price=1.0,
        change_weight=0.0,
        ipopt=None,
        compile=True,
    ):
        scenarios, price, self.change_weight = checked_problem(plant, scenarios, slack_price, change_weight)
        self.scenarios = scenarios if robust_horizon else scenarios[:1]
        self.horizon, self.tree = horizon, ScenarioTree(len(self.scenarios), horizon, robust_horizon)
        self.x_center, self.x_scale, self.u_center, self.u_scale = scaling(plant)
        self.bounds = np.array([plant.X_LOW, plant.X_HIGH])
        self.slack_price = np.where(np.isinf(self.bounds), 0.0, price)
        # states with slack below and above
        self.priced = [np.flatnonzero(np.isfinite(side) & (side > 0)) for side in self.slack_price]
        super().__init__(plant, goal)
        self.problem, self.limits = self.build_problem(stage_cost, terminal_cost)
        self.solvers = self.build_solvers(compile, ipopt or {})
        self.later = self.build_shift()

    def model(self):
        """The prediction over one sampling time: CasADi function (x, u, psi) -> x, scaled."""
        return prediction_model(self.plant)[0]

    def weights(self):
        """Of each node's terms in the objective: one over the number of nodes of its stage, (nodes,)."""
        return 1 / np.array(self.tree.nodes)[self.tree.stage]

    def build_problem(self, stage_cost, terminal_cost):
        """The problem of the docstring, all nodes of the tree at once, as CasADi's nlpsol takes it, and its limits.

        States and actions are scaled to the boxes of initial states and of actions; costs see physical units.
        """
        tree, n_x, n_u = self.tree, len(self.x_scale), len(self.u_scale)
        edges, inner, stage = len(tree.stage) - 1, tree.inner, tree.stage

        # parameters: the measured state, the last action, a goal per stage
        x_now, u_now = ca.MX.sym("x_now", n_x), ca.MX.sym("u_now", n_u)
        goal = ca.MX.sym("goal", len(self.plant.GOAL_INDEX), self.horizon)

        # variables: states of all nodes but the root, actions of those with children, slack of the priced bounds
        below, above = self.priced
        x, u = ca.MX.sym("x", n_x, edges), ca.MX.sym("u", n_u, inner)
        slack = ca.MX.sym("slack", len(below) + len(above), edges)

        # dynamics: x_0 = s, x_{t+1} = f(x_t, u_t, psi_t)
        scaled = ca.horzcat((x_now - self.x_center) / self.x_scale, x)
        parent, psi = tree.parent[1:].tolist(), self.scenarios[tree.scenario[1:]].T
        dynamics = x - self.model().map(edges)(scaled[:, parent], u[:, parent], psi)

        # constraints: X_LOW <= x + slack, x - slack <= X_HIGH; a hard bound limits the variable itself
        low, high = bounds = (self.bounds - self.x_center) / self.x_scale
        box = ca.vertcat(x[below.tolist(), :] - low[below], high[above] - x[above.tolist(), :]) + slack
        hard = np.where(np.isinf(self.slack_price), bounds, [[-np.inf], [np.inf]])
        states, actions = scaled * self.x_scale + self.x_center, u * self.u_scale + self.u_center

        # objective: stage costs, terminal cost at the leaves, slack, changes of the actions
        weight, leaves = ca.DM(self.weights()), np.flatnonzero(stage == self.horizon).tolist()
        if stage_cost.n_in() == 2:
            cost = stage_cost.map(edges)(states[:, 1:], goal[:, (stage[1:] - 1).tolist()])
            J = ca.dot(weight[1:], cost.T)
        else:  # x_0 has the goal of x_1
            goals = goal[:, np.maximum(stage[:inner] - 1, 0).tolist()]
            J = ca.dot(weight[:inner], stage_cost.map(inner)(states[:, :inner], actions, goals).T)
        if terminal_cost is not None:
            last = ca.repmat(goal[:, -1], 1, len(leaves))
            J += ca.dot(weight[leaves], terminal_cost.map(len(leaves))(states[:, leaves], last).T)
        price = self.slack_price * self.x_scale
        J += ca.dot(weight[1:], (ca.DM(np.append(price[0, below], price[1, above])).T @ slack).T)
        change = actions - ca.horzcat(u_now, actions[:, tree.parent[1:inner].tolist()])
        J += ca.dot(weight[:inner], (ca.DM(self.change_weight).T @ change**2).T)

        # vectors for the solver, and where in them everything lies
        self.at = positions(x=x.shape, slack=slack.shape, u=u.shape)  # dynamics and box lie as x and slack do
        one, zero, free = np.ones(u.numel()), np.zeros(slack.numel()), np.full(slack.numel(), np.inf)
        (low, high), equal = np.tile(hard, edges), np.zeros(x.numel())
        limits = {"lbx": np.concatenate([low, zero, -one]), "ubx": np.concatenate([high, free, one])}
        limits |= {"lbg": np.append(equal, zero), "ubg": np.append(equal, free)}
        problem = {"x": ca.veccat(x, slack, u), "p": ca.veccat(x_now, u_now, goal), "f": J}
        return problem | {"g": ca.veccat(dynamics, box)}, limits

    def build_solvers(self, compile, options):
        """IPOPT twice on the same functions: from scratch, and from a nearby solution with its multipliers."""

        def given(name):
            ipopt = self.cold | options | (self.warm if name == "warm" else {})
            return {"print_time": False, "show_eval_warnings": False, "ipopt": ipopt}

        solvers = compiled_solver("ipopt", self.problem, given) if compile else None
        return solvers or {k: ca.nlpsol(k, "ipopt", self.problem, given(k)) for k in ("cold", "warm")}

    def build_shift(self):
        """Of w, its multipliers and those of g: which entry each takes over one sampling time later."""
        w = np.arange(len(self.limits["lbx"]))
        for name, at in self.at.items():
            w[at] = at[:, self.tree.later if name == "u" else self.tree.child[1:] - 1]
        return w, w, w[: len(self.limits["lbg"])]

    def reset(self, u=None):
        super().reset(u)
        self.plan = None  # (w, lam_x, lam_g) that a solve found, shifted by a sampling time per step
        self.solution = None  # its w, not shifted

    def vector(self, x, u):
        """w of a plan in physical units: states (nodes - 1, n_x), actions (inner, n_u), slack as needed."""
        w, (below, above) = np.zeros(len(self.limits["lbx"])), self.priced
        w[self.at["x"]] = ((x - self.x_center) / self.x_scale).T
        w[self.at["u"]] = ((u - self.u_center) / self.u_scale).T
        outside = np.maximum([self.bounds[0] - x, x - self.bounds[1]], 0) / self.x_scale
        w[self.at["slack"]] = np.hstack([outside[0][:, below], outside[1][:, above]]).T
        return w

    def planned(self, w):
        """The inverse: states (nodes - 1, n_x) and actions (inner, n_u)."""
        x, u = (w[self.at[name]].T for name in ("x", "u"))
        return x * self.x_scale + self.x_center, u * self.u_scale + self.u_center

    def held(self, x0):
        """w with the start state held and every action's middle."""
        x, u = (np.ones((self.at[name].shape[1], 1)) for name in ("x", "u"))
        return self.vector(x * x0, u * self.u_center)

    def rolled_out(self, x0, action):
        """w with the actions `action(t, x)` and the nominal plant's motion, the same under every scenario."""
        x, u, stage = [x0], [], self.tree.stage
        for t in range(self.horizon):
            u.append(action(t, x[-1]))
            x.append(self.plant.step(x[-1], u[-1], self.scenarios[0]))
        return self.vector(np.array(x)[stage[1:]], np.array(u)[stage[: self.tree.inner]])

    def first_guesses(self, x0):
        """For a start from nothing, in order of preference; `action` takes two at most."""
        if hasattr(self.plant, "baseline"):  # the plant's own feedback saves iterations
            yield self.rolled_out(x0, lambda t, x: self.plant.baseline(x, self.goals[:, t]))
        yield self.held(x0)
        yield self.rolled_out(x0, lambda t, x: self.u_before)

    def solve(self, which, x0, guess, lam_x=0, lam_g=0):
        """One call of the solver: (w, lam_x, lam_g), or None if it does not succeed."""
        parameters = np.concatenate([x0, self.u_before, self.goals.ravel("F")])
        result = self.solvers[which](x0=guess, p=parameters, lam_x0=lam_x, lam_g0=lam_g, **self.limits)
        stats, self.objective = self.solvers[which].stats(), float(result["f"])
        self.stats["status"] = str(stats["return_status"])
        self.stats["iterations"] += stats["iter_count"]
        if not stats["success"] or not np.isfinite(self.objective):
            return None
        return tuple(np.array(result[key]).ravel() for key in ("x", "lam_x", "lam_g"))

    def action(self, x, tick):
        """Ladder: a solve from the shifted last plan, or from a first guess; if it fails, one from a guess not tried
        yet; then the next action of the last plan; then the last action. `stats` says which."""
        guesses = self.first_guesses(x)
        self.stats |= {"rung": "solved", "success": True}
        solution = self.solve("warm", x, *self.plan) if self.plan else self.solve("cold", x, next(guesses))
        if solution is None:
            self.stats |= {"rung": "retry", "success": False}
            solution = self.solve("cold", x, next(guesses))
        if solution is not None:
            self.solution = solution[0]
        elif self.plan and np.isfinite(self.plan[0]).all():
            self.stats |= {"rung": "plan", "fell_back": True}
            solution = self.plan
        else:
            self.plan = None
            return np.full(len(self.u_scale), np.nan)
        self.plan = tuple(part[later] for part, later in zip(solution, self.later))
        return self.planned(solution[0])[1][0]

    def prediction(self):
        """The last plan that was solved, physical units: lists over stages of states x_1 ... and of actions."""
        if self.solution is None:
            raise ValueError("there is no prediction before the first successful make_step")
        return self.tree.by_stage(*self.planned(self.solution))


# Objective


def costs(plant, objective, sigma2=None):
    """Stage and terminal cost (or None) of `--objective`, for ScenarioMPC. Raises ValueError if the plant has it not.

    A plant with a linear-quadratic regulator has costs l(x, u) and V(x) = x'Px; its objective goal is that of eq:jensen,
    -exp(-l) and -exp(-V) at the default sigma^2 = 1/2.
    """
    linear, once = hasattr(plant, "lqr"), {"never_inline": True}
    sizes = (("x", len(plant.X_LOW)), ("u", len(plant.U_LOW)), ("goal", len(plant.GOAL_INDEX)))
    kind = ca.MX if linear else ca.SX  # matrix products stay what they are
    x, u, goal = (kind.sym(*size) for size in sizes)
    sigma2 = plant.MPC_SIGMA2 if sigma2 is None else sigma2

    def shaped(cost):
        return -ca.exp(-cost / (2 * sigma2)) if objective == "goal" else cost

    defined = "quadratic", "goal", *(["expert"] if hasattr(plant, "expert_cost") else [])
    if objective not in defined or objective == "goal" and not sigma2 > 0:
        what = f"--objective {objective}" if objective not in defined else f"--sigma2 {sigma2}"
        raise ValueError(f"{what} is not defined for {plant.ENV_ID}; choose {', '.join(defined)}, sigma2 > 0")
    if objective == "expert":
        return ca.Function("stage", [x, goal], [plant.expert_cost(x, ca)], once), None
    if linear:
        stage = ca.Function("stage", [x, u, goal], [shaped(plant.lq_cost(x, u, goal))], once)
        return stage, ca.Function("terminal", [x, goal], [shaped(plant.lq_value(x, goal))], once)
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], goal, ca))
    cost = shaped(squared_error) if objective == "goal" else squared_error / 2
    return ca.Function("stage", [x, goal], [cost], once), None


def build_controller(args, kind=ScenarioMPC):
    """The controller that the arguments describe, for the first goal. Raises ValueError for what cannot work."""
    plant, goals = check(args)
    default = plant.EXPERT_CHANGE_WEIGHT if args.objective == "expert" else 0.0
    change_weight = default if args.change_weight is None else args.change_weight
    slack_price = np.inf if args.constraints == "hard" else args.slack_weight
    options = dict(robust_horizon=args.robust_horizon, slack_price=slack_price, change_weight=change_weight)
    options |= dict(goal=goals[0], compile=args.compile and not hasattr(plant, "next_state"))
    scenarios = envs.scenario_set(plant, args.scenarios)
    return kind(plant, args.horizon, scenarios, *costs(plant, args.objective, args.sigma2), **options)


# Closed loop


def simulate(mpc, x0, psi, goals, preview=False, progress=None):
    """One episode on a plant with fixed parameters psi (n_psi,) under goals (steps, n_goal).

    Returns x (steps + 1, n_x), u (steps, n_u), the predictions under the nominal scenario (steps, N + 1, n_x) and the
    controller's stats.
    """
    mpc.reset()
    x, u, predicted, log = [np.array(x0, dtype=float)], [], [], []
    for t in range(len(goals)):
        ahead = np.minimum(t + np.arange(mpc.horizon), len(goals) - 1) if preview else np.full(mpc.horizon, t)
        mpc.set_goal(goals[ahead].T)
        u.append(mpc.make_step(x[-1]))
        log.append(mpc.stats)
        solved = mpc.stats["rung"] in ("solved", "retry")
        later = [stage[:, 0] for stage in mpc.prediction()["x"]] if solved else [x[-1]] * mpc.horizon
        predicted.append([x[-1], *later])
        x.append(mpc.plant.step(x[-1], u[-1], psi))
        if progress is not None:
            progress.update()
    return np.array(x), np.array(u), np.array(predicted), log


def summary(plant, x, u, goals, log):
    """The measures of an episode: time near goal over x_1 ..., change of the actions from 0 on, solve times, failures.

    Changes are in the physical unit of a single action; of several, each counts in units of its range.
    """
    unit = 1.0 if len(plant.U_LOW) == 1 else plant.U_HIGH - plant.U_LOW
    milliseconds = np.array([stats["wall_ms"] for stats in log])
    row = {
        "time_near_goal": envs.time_near_goal(plant, x[1:, plant.GOAL_INDEX], goals),
        "action_total_variation": np.abs(np.diff(u / unit, axis=0, prepend=0.0)).sum(),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "solve_ms_max": milliseconds.max(),
    }
    row = {name: round(float(value), 6) for name, value in row.items()}
    return row | {"solver_failures": sum(not stats["success"] for stats in log)}


def start_and_plant(plant, seed, random_plant):
    """Start state (n_x,) and plant parameters (n_psi,) of the episode with this seed."""
    rng = np.random.default_rng([seed, 4])
    x0 = plant.START + plant.START_NOISE * rng.uniform(-1, 1, size=len(plant.START))
    return x0, rng.choice(plant.EVAL_PSI) if random_plant else plant.PSI_NOMINAL


TABLE = """\
seed     near goal  action TV   ms median   ms p95   ms max   failed
{}
Near goal: steps of {} at the goal, more is better. Action TV: sum of the actions' changes. Failed: first solves."""


def table(rows, steps):
    """The episodes as text, and their median."""
    columns = list(rows[0])[-6:]
    lines = [(row["seed"], *(row[name] for name in columns)) for row in rows]
    if len(rows) > 1:
        lines.append(("median", *np.median([line[1:] for line in lines], axis=0)))
    layout = "{!s:8s} {:9.1f}  {:9.1f}   {:9.1f}  {:7.1f}  {:7.1f}  {:7.0f}"
    return TABLE.format("\n".join(layout.format(*line) for line in lines), steps)


def check(args):
    """Refuse, by ValueError, what cannot work before anything long starts. Returns plant and goals (steps, n_goal)."""
    check_ranges(args, horizon=(1, 1000), robust_horizon=(0, 10), episodes=(1, 10**6), steps=(1, 10**6))
    check_ranges(args, seed=(0, 10**9), sigma2=(1e-9, 1e9), slack_weight=(0, 1e6))
    plant = envs.load(args.env, dim=args.dim, system=args.system)
    costs(plant, args.objective)
    ScenarioTree(len(envs.scenario_set(plant, args.scenarios)), args.horizon, args.robust_horizon)
    check_weights("change_weight", args.change_weight, len(plant.U_LOW))
    if args.animate and not hasattr(plant, "animate"):
        raise ValueError(f"--animate needs a plant that can be drawn; {args.env} defines no animation")
    unused = {"sigma2": f"with --objective {args.objective}" if args.objective != "goal" else ""}
    unused |= {"slack_weight": "on hard constraints" if args.constraints == "hard" else ""}
    check_effects(args, unused | {"scenarios": "" if args.robust_horizon else "with --robust-horizon 0"})
    goals = goal_schedule(plant, args.goal, args.steps)
    if args.objective == "expert" and (goals != plant.EVAL_GOAL).any():
        raise ValueError(f"--objective expert knows the goal {plant.EVAL_GOAL} only; choose another one")
    return plant, goals


def main(args):
    plant, goals = check(args)
    if not envs.can_hold(plant, goals).all():
        print(f"warning: --goal {' '.join(args.goal)} is none that every scenario can hold", file=sys.stderr)
    out = output_folder(args.out, Path("runs") / f"{args.env}__goal_mpc__{args.seed}__{int(time.time())}")
    tick = time.perf_counter()
    mpc = build_controller(args)
    variables, constraints = mpc.problem["x"].numel(), mpc.problem["g"].numel()
    size = f"{plant.ENV_ID}: {variables} variables, {constraints} constraints"
    print(f"{size}, built in {time.perf_counter() - tick:.1f} s")
    head = {name: getattr(args, name) for name in ("env", "objective", "horizon")}
    given = {k: v for k, v in vars(args).items() if v != getattr(Args, k) and k not in (*head, "seed", "out")}
    head |= {"arguments": json.dumps(given)}
    rows, episodes = [], []
    with tqdm(total=args.episodes * args.steps, unit="step", disable=None) as bar:
        for seed in range(args.seed, args.seed + args.episodes):
            x0, psi = start_and_plant(plant, seed, args.plant == "random")
            x, u, predicted, log = simulate(mpc, x0, psi, goals, args.preview, bar)
            drawn = {"seed": seed, "psi": json.dumps(psi.tolist())}
            rows.append(head | drawn | summary(plant, x, u, goals, log))
            episodes.append((x, u, predicted))
    write_csv(rows, out / "results.csv")
    x, u = (np.stack([episode[k] for episode in episodes]) for k in (0, 1))
    np.savez_compressed(out / "trajectories.npz", goals=goals, x=x, u=u)
    draw_episode(plant, {"closed loop": (x[0], u[0], {"color": "#0072B2"})}, goals, out / "episode.png")
    if args.animate:
        plant.animate(*episodes[0], goals, out / "episode.gif")
    print(table(rows, args.steps))
    print(f"{out}/results.csv, trajectories.npz, episode.png" + ", episode.gif" * args.animate)
    return rows


if __name__ == "__main__":
    # Ctrl-C ends the program at once; CasADi would take it for a failed solve
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
