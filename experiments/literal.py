"""The reactor's problems by IPOPT, on goal_mpc.py's class: the published benchmark, eq:QMPC as it is printed, and the authors' conventions.

rl_mpc_deploy.py's controllers solve the same problems by an iteration of their own; experiments set these beside them.
"""

import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import goal_mpc as gm
import rl_mpc_deploy as deploy

RELAXED_PRICE = 1e3  # per physical unit, of bounds that cannot be kept
FEASIBLE = 1e-6  # slack of a hard bound, half-widths of the box
AT_REST = 1e-3  # movement of a state, half-widths of the box


class IpoptMPC(gm.ScenarioMPC):
    """goal_mpc.py's controller in the closed loops of rl_mpc_deploy.py: the statistics and the first guesses are those of its controllers.

    policy: CasADi function (x, goal) -> u (n_u,), or None. Its rollout through the tree is a first guess, and it acts where no solve
    succeeds. Guesses are chosen as by rl_mpc_deploy.py's planner, but that at rest the last solution is taken without a comparison.
    barrier: IPOPT's at the start of a warm solve, or "adaptive" (mu_strategy, of every solve).
    """

    def __init__(self, *arguments, policy=None, barrier=1e-4, max_iter=200, **options):
        self.policy, self.barrier = policy, barrier
        super().__init__(*arguments, max_iter=max_iter, **options)
        self.model = self._model()
        self.objective = ca.Function("objective", [self.nlp["x"], self.nlp["p"]], [self.nlp["f"]])

    def _build_solvers(self, compile, tol, max_iter):
        super()._build_solvers(compile, tol, max_iter)
        # IPOPT would widen every bound by 1e-8; times a slack price of 4,500 (100 per degC, scaled) and 20 stages that is 1 % of the cost
        cold = {"print_level": 0, "sb": "yes", "tol": tol, "max_iter": max_iter, "bound_relax_factor": 0.0}
        # variables are scaled already: MUMPS need not, nor refine every solution (a tenth of the time)
        cold |= {"mumps_permuting_scaling": 0, "mumps_scaling": 0, "min_refinement_steps": 0}
        cold |= {"mu_strategy": "adaptive"} if self.barrier == "adaptive" else {}
        warm = cold | {"warm_start_init_point": "yes"} | ({} if self.barrier == "adaptive" else {"mu_init": self.barrier})
        for name in ("bound_push", "mult_bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac"):
            warm[f"warm_start_{name}"] = 1e-6
        common, oracle = {"print_time": False, "show_eval_warnings": False}, self.solvers["cold"].oracle()
        self.options = {name: common | {"ipopt": ipopt} for name, ipopt in (("cold", cold), ("warm", warm))}
        self.solvers = {name: ca.nlpsol(name, "ipopt", oracle, options) for name, options in self.options.items()}

    def tree_guess(self, x0, action):
        """w of the plan whose actions are `action(t, x)`, (n_x, nodes) -> (n_u, nodes): predicted states, slack as needed."""
        w, x, S = self.hold_guess(np.asarray(x0)), np.asarray(x0, dtype=float)[:, None], len(self.scenarios)
        for t, (n, n_next) in enumerate(zip(self.nodes, self.nodes[1:])):
            u = np.clip(np.array(action(t, x)).reshape(self.n_u, -1), self.plant.U_LOW[:, None], self.plant.U_HIGH[:, None])
            parent = np.arange(n_next) // (n_next // n)
            x = np.array(self.model(x[:, parent], u[:, parent], self.scenarios[np.arange(n_next) % S].T))
            w[self.index["u"][t]] = (u - self.u_center[:, None]) / self.u_scale[:, None]
            w[self.index["x"][t + 1]] = (x - self.x_center[:, None]) / self.x_scale[:, None]
            violation = self.plant.X_LOW[:, None] - x, x - self.plant.X_HIGH[:, None]
            slack = [np.maximum(v / self.x_scale[:, None], 0)[rows] for v, rows in zip(violation, self.soft)]
            w[self.index["slack"][t + 1]] = np.concatenate(slack)
        return w

    def policy_guess(self, x0):
        return self.tree_guess(x0, lambda t, x: self.policy(x, self.goal[:, t]))

    def cold_guesses(self):
        return super().cold_guesses() if self.policy is None else (self.policy_guess, self.hold_guess)

    def cost(self, x0, w):
        """Objective of a plan that `tree_guess` gave."""
        return float(self.objective(w, np.concatenate([x0, self.u_before, self.goal.ravel("F")])))

    def reset(self):
        super().reset()
        self.solution = None  # of the last step, not shifted
        self.x_before = self.x_compared = None  # the last state, and that at which guesses were last compared

    def _solve(self, *arguments):
        self.solution = super()._solve(*arguments)
        return self.solution

    def choose_guess(self, x0):
        """Put the cheapest first guess in the place of the shifted plan."""
        if self.solution is not None and np.abs((x0 - self.x_compared) / self.x_scale).max() < AT_REST:
            self.plan = self.solution
            return
        self.x_compared, plans = x0, [self.plan]
        if self.policy is not None and self.solution is not None:
            # where things move, an action that is planned for later would be put off for ever
            if np.abs((x0 - self.x_before) / self.x_scale).max() < deploy.HARDLY_MOVED:
                plans.append(self.solution)
        plans = [(self.tree_guess(x0, lambda t, x, w=w: self.physical(w, "u", t)), *multipliers) for w, *multipliers in plans]
        costs = [self.cost(x0, w) for w, *_ in plans]
        self.plan = plans[np.argmin(costs)]
        if self.policy is not None and not min(costs) <= self.cost(x0, self.policy_guess(x0)):
            self.set_initial_guess(x0)

    def make_step(self, x0):
        tick = time.perf_counter()
        if self.plan is not None:
            self.choose_guess(x0)
        else:
            self.x_compared = x0
        super().make_step(x0)
        self.x_before, fell_back = x0, self.stats["rung"] in ("plan", "hold")
        if self.stats["rung"] == "hold" and self.policy is not None:
            self.stats["rung"] = "actor"
            self.u_before = np.clip(np.array(self.policy(x0, self.goal[:, 0])).ravel(), self.plant.U_LOW, self.plant.U_HIGH)
        self.stats |= {"fell_back": fell_back, "late": False, "wall_ms": 1e3 * (time.perf_counter() - tick)}
        return self.u_before.copy()


class RelaxedMPC(IpoptMPC):
    """The same, with a second problem for steps from which no plan keeps the hard bounds: there every bound is soft, at `RELAXED_PRICE`.

    It stays in charge until its plan violates no hard bound, which it tells far sooner than IPOPT finds the first problem infeasible.
    """

    def __init__(self, *arguments, slack_price, **options):
        hard = np.isinf(slack_price).any()
        self.relaxed = IpoptMPC(*arguments, slack_price=RELAXED_PRICE, **options) if hard else None
        super().__init__(*arguments, slack_price=slack_price, **options)

    def reset(self):
        super().reset()
        self.infeasible = False
        if self.relaxed is not None:
            self.relaxed.reset()

    def _solve(self, *arguments):
        relaxed = self.relaxed is not None and self.stats["rung"] == "retry"  # a second try is the other problem's
        return None if relaxed else super()._solve(*arguments)

    def make_step(self, x0):
        tick, u_before, other, spent = time.perf_counter(), self.u_before, self.relaxed, 0
        if not self.infeasible:
            u = super().make_step(x0)
            if other is None or self.stats["success"]:
                return u
            spent = self.stats["iterations"]
            other.set_initial_guess(x0)
        other.u_before = u_before
        other.set_goal(self.goal)
        self.u_before = other.make_step(x0)
        self.stats = other.stats | {"success": False, "iterations": spent + other.stats["iterations"]}
        self.infeasible, self.plan, self.plan_left = True, None, 0
        if not self.stats["fell_back"]:
            slack = other.last_w[other.positions("slack")].max(axis=1)
            hard = np.isinf(np.concatenate([price[rows] for price, rows in zip(self.slack_price, other.soft)]))
            self.infeasible = slack[hard].max() > FEASIBLE
            w = np.zeros(self.size["w"])
            for name in ("x", "u"):
                w[self.positions(name)] = other.plan[0][other.positions(name)]
            self.plan = w, np.zeros(self.size["w"]), np.zeros(self.size["g"])
        self.stats["wall_ms"] = 1e3 * (time.perf_counter() - tick)
        return self.u_before.copy()


class PrintedMPC(IpoptMPC):
    """eq:QMPC as printed: stage cost and soft constraints at x_0 ... x_{N-1}, so that nothing bounds the last state but its value."""

    def __init__(self, plant, horizon, scenarios, stage_cost, terminal_cost=None, **options):
        x, u, goal = (ca.MX.sym(name, n) for name, n in (("x", len(plant.X_LOW)), ("u", len(plant.U_LOW)), ("goal", len(plant.GOAL_INDEX))))
        stage = ca.Function("stage", [x, u, goal], [stage_cost(x, goal)], {"never_inline": True})  # of a state and its action: before x_N
        super().__init__(plant, horizon, scenarios, stage, terminal_cost, **options)

    def _build_problem(self):
        super()._build_problem()
        self.bounds["lbg"][self.index["box"][self.horizon]] = -np.inf


class LiteralMPC(PrintedMPC):
    """The same with slack and the price of changes summed over scenarios instead of averaged.

    With N = 1 every term of the terminal cost sees the state under the first scenario, as in do-mpc (read in its source, 4.6.5 to 5.1.2);
    since that state has no soft constraint the other scenarios are not there.
    """

    def __init__(self, plant, horizon, scenarios, *costs, robust_horizon=1, slack_price=1.0, change_weight=0.0, **options):
        S = len(scenarios) if robust_horizon else 1
        options |= dict(slack_price=S * np.array(slack_price), change_weight=S * np.broadcast_to(change_weight, len(plant.U_LOW)))
        super().__init__(plant, horizon, scenarios, *costs, robust_horizon=robust_horizon if horizon > 1 else 0, **options)


def squared_error(plant):
    """Stage cost of the published benchmark."""
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
    return ca.Function("stage", [x, g], [ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))])


def gaussian(plant, sigma2=None):
    """Stage cost of RL+MPC; sigma2: the plant's by default."""
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
    return ca.Function("stage", [x, g], [-ca.exp(-squared_error(plant)(x, g) / (2 * (sigma2 or plant.MPC_SIGMA2)))])


def negative(V):
    """Terminal cost of a learned value."""
    x, g = ca.MX.sym("x", V.size1_in(0)), ca.MX.sym("goal", V.size1_in(1))
    return ca.Function("terminal", [x, g], [-V(x, g)])


def build_controller(name, args, kind=IpoptMPC):
    """A planner of rl_mpc_deploy.py by IPOPT, from the same arguments; kind: the class of RL+MPC. Raises ValueError for another name.

    nominal_mpc, robust_mpc: the published benchmark, which sums slack and the price of changes over scenarios.
    """
    plant, goal, critic = deploy.check(args)
    scenarios, options = plant.SCENARIOS["mpc"], dict(goal=goal, compile=args.compile)
    if name in ("nominal_mpc", "robust_mpc"):
        S, benchmark = len(scenarios) if name == "robust_mpc" else 1, plant.BENCHMARK
        options |= dict(robust_horizon=int(S > 1), slack_price=S * benchmark["slack_price"], change_weight=S * benchmark["change_weight"])
        return RelaxedMPC(plant, benchmark["horizon"], scenarios, squared_error(plant), **options)
    if name != "rl_mpc":
        raise ValueError(f"{name!r} is not a controller by IPOPT; choose nominal_mpc, robust_mpc or rl_mpc")
    mu, _, V = deploy.export(critic)
    slack_weight = critic.slack_weight if args.slack_weight is None else args.slack_weight
    options |= dict(robust_horizon=args.robust_horizon, slack_price=slack_weight if args.constraints == "soft" else np.inf)
    # a shifted plan is often far from optimal under a learned value: the adaptive barrier takes fewer iterations there
    options |= dict(policy=mu, barrier="adaptive")
    return kind(plant, args.horizon, scenarios, gaussian(plant), negative(V), **options)
