"""The reactor's problems by IPOPT, on goal_mpc.py's class: the published benchmark, eq:QMPC as it is printed, and the authors' conventions.

rl_mpc_deploy.py's controllers solve the same problems by an iteration of their own; experiments set these beside them.
"""

import casadi as ca
import numpy as np

import goal_mpc as gm
import rl_mpc_deploy as deploy

RELAXED_PRICE = 1e3  # per physical unit, of bounds that cannot be kept
FEASIBLE = 1e-6  # slack of a hard bound, half-widths of the box
AT_REST = 1e-3  # movement of a state, half-widths of the box


class IpoptMPC(gm.ScenarioMPC):
    """goal_mpc.py's controller in the closed loops of rl_mpc_deploy.py: the first guesses are those of its controllers.

    policy: CasADi function (x, goal) -> u (n_u,), or None. Its rollout through the tree is a first guess, and it acts where no solve
    succeeds. Guesses are chosen as by rl_mpc_deploy.py's planner, but that at rest the last solution is taken without a comparison.
    barrier: IPOPT's at the start of a warm solve, or "adaptive" (mu_strategy, of every solve).
    """

    # IPOPT would widen every bound by 1e-8; times a slack price of 4,500 (100 per degC, scaled) and 20 stages that is 1 % of the cost.
    # Variables are scaled already: MUMPS need not, nor refine every solution (a tenth of the time)
    cold = gm.ScenarioMPC.cold | {
        "max_iter": 200,
        "mumps_permuting_scaling": 0,
        "mumps_scaling": 0,
        "min_refinement_steps": 0,
    }

    def __init__(self, *arguments, policy=None, barrier=1e-4, **options):
        self.policy = policy
        if barrier == "adaptive":
            self.cold = self.cold | {"mu_strategy": "adaptive"}
            self.warm = {name: value for name, value in self.warm.items() if name != "mu_init"}
        else:
            self.warm = self.warm | {"mu_init": barrier}
        super().__init__(*arguments, **options)
        self.predict = self.model()
        self.cost_of = ca.Function("cost", [self.problem["x"], self.problem["p"]], [self.problem["f"]])

    def tree_guess(self, x0, action):
        """w of the plan whose actions are `action(t, x)`, (n_x, nodes) -> (n_u, nodes): predicted states, slack as needed."""
        tree, states, actions = self.tree, [], []
        center, scale = self.x_center[:, None], self.x_scale[:, None]
        x = (x0[:, None] - center) / scale
        for t in range(self.horizon):
            u = np.array(action(t, x * scale + center)).reshape(len(self.u_scale), -1)
            actions.append(np.clip(u, self.plant.U_LOW[:, None], self.plant.U_HIGH[:, None]))
            here = slice(tree.first[t + 1], tree.first[t + 2])
            parent, psi = tree.parent[here] - tree.first[t], self.scenarios[tree.scenario[here]].T
            scaled = (actions[-1] - self.u_center[:, None]) / self.u_scale[:, None]
            x = np.array(self.predict(x[:, parent], scaled[:, parent], psi))
            states.append(x)
        return self.vector(np.hstack(states).T * self.x_scale + self.x_center, np.hstack(actions).T)

    def policy_guess(self, x0):
        return self.tree_guess(x0, lambda t, x: self.policy(x, self.goals[:, t]))

    def first_guesses(self, x0):
        if self.policy is None:
            yield from super().first_guesses(x0)
        else:
            yield self.policy_guess(x0)
            yield self.held(x0)

    def cost(self, x0, w):
        """Objective of a plan that `tree_guess` gave."""
        return float(self.cost_of(w, np.concatenate([x0, self.u_before, self.goals.ravel("F")])))

    def reset(self, u=None):
        super().reset(u)
        self.found = None  # what the last solve gave, not shifted
        self.x_compared = None  # the state at which guesses were last compared

    def solve(self, *arguments):
        self.found = super().solve(*arguments)
        return self.found

    def choose_guess(self, x0):
        """Put the cheapest first guess in the place of the shifted plan."""
        if self.found is not None and np.abs((x0 - self.x_compared) / self.x_scale).max() < AT_REST:
            self.plan = self.found
            return
        self.x_compared = x0
        plans = [self.plan]
        if self.policy is not None and self.found is not None:
            # where things move, an action that is planned for later would be put off for ever
            if np.abs((x0 - self.x_before) / self.x_scale).max() < deploy.ScenarioMPC.HARDLY_MOVED:
                plans.append(self.found)
        rolled_out = []
        for w, *multipliers in plans:
            actions = np.split(self.planned(w)[1], self.tree.first[1:-2])
            rolled_out.append((self.tree_guess(x0, lambda t, x, actions=actions: actions[t].T), *multipliers))
        costs = [self.cost(x0, w) for w, *_ in rolled_out]
        self.plan = rolled_out[np.argmin(costs)]
        if self.policy is not None and not min(costs) <= self.cost(x0, self.policy_guess(x0)):
            self.plan = None

    def action(self, x, tick):
        if self.plan is not None:
            self.choose_guess(x)
        else:
            self.x_compared = x
        u = super().action(x, tick)
        if self.policy is not None and not np.isfinite(u).all():
            self.stats |= {"rung": "actor", "fell_back": True}
            u = np.array(self.policy(x, self.goals[:, 0])).ravel()
        return u


class RelaxedMPC(IpoptMPC):
    """The same, with a second problem for steps from which no plan keeps the hard bounds: there every bound is soft, at `RELAXED_PRICE`.

    It stays in charge until its plan violates no hard bound, which it tells far sooner than IPOPT finds the first problem infeasible.
    """

    def __init__(self, *arguments, slack_price, **options):
        hard = np.isinf(slack_price).any()
        self.relaxed = IpoptMPC(*arguments, slack_price=RELAXED_PRICE, **options) if hard else None
        super().__init__(*arguments, slack_price=slack_price, **options)

    def reset(self, u=None):
        super().reset(u)
        self.infeasible = False
        if self.relaxed is not None:
            self.relaxed.reset(u)

    def solve(self, *arguments):
        if self.relaxed is not None and self.stats["rung"] == "retry":
            return None  # a second try is the other problem's
        return super().solve(*arguments)

    def action(self, x, tick):
        other, spent = self.relaxed, 0
        if not self.infeasible:
            u = super().action(x, tick)
            if other is None or self.stats["success"]:
                return u
            spent, other.plan = self.stats["iterations"], None
        other.u_before = self.u_before
        other.set_goal(self.goal)
        u = other.make_step(x)
        self.stats |= other.stats | {"success": False, "iterations": spent + other.stats["iterations"]}
        self.infeasible, self.plan = True, None
        if not self.stats["fell_back"]:
            hard = np.isinf(
                np.concatenate([price[rows] for price, rows in zip(self.slack_price, other.priced)])
            )
            self.infeasible = other.solution[other.at["slack"]].max(axis=1)[hard].max() > FEASIBLE
            w = self.vector(*other.planned(other.plan[0]))
            self.plan = w, np.zeros(len(w)), np.zeros(len(self.limits["lbg"]))
        return u


class PrintedMPC(IpoptMPC):
    """eq:QMPC as printed: stage cost and soft constraints at x_0 ... x_{N-1}, so that nothing bounds the last state but its value."""

    def __init__(self, plant, horizon, scenarios, stage_cost, terminal_cost=None, **options):
        sizes = ("x", len(plant.X_LOW)), ("u", len(plant.U_LOW)), ("goal", len(plant.GOAL_INDEX))
        x, u, goal = (ca.MX.sym(*size) for size in sizes)
        # of a state and its action: before x_N
        stage = ca.Function("stage", [x, u, goal], [stage_cost(x, goal)], {"never_inline": True})
        super().__init__(plant, horizon, scenarios, stage, terminal_cost, **options)

    def build_problem(self, *costs):
        problem, limits = super().build_problem(*costs)
        limits["lbg"][self.at["slack"][:, self.tree.first[self.horizon] - 1 :]] = -np.inf
        return problem, limits


class LiteralMPC(PrintedMPC):
    """The same with slack and the price of changes summed over scenarios instead of averaged.

    With N = 1 every term of the terminal cost sees the state under the first scenario, as in do-mpc (read in its source, 4.6.5 to 5.1.2);
    since that state has no soft constraint the other scenarios are not there.
    """

    def __init__(self, plant, horizon, scenarios, *costs, robust_horizon=1, slack_price=1.0, **options):
        S = len(scenarios) if robust_horizon else 1
        changes = np.broadcast_to(options.pop("change_weight", 0.0), len(plant.U_LOW))
        options |= dict(slack_price=S * np.array(slack_price), change_weight=S * changes)
        options |= dict(robust_horizon=robust_horizon if horizon > 1 else 0)
        super().__init__(plant, horizon, scenarios, *costs, **options)


def squared_error(plant):
    """Stage cost of the published benchmark."""
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
    return ca.Function("stage", [x, g], [ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))])


def gaussian(plant, sigma2=None):
    """Stage cost of RL+MPC; sigma2: the plant's by default."""
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
    shaped = -ca.exp(-squared_error(plant)(x, g) / (2 * (sigma2 or plant.MPC_SIGMA2)))
    return ca.Function("stage", [x, g], [shaped])


def negative(V):
    """Terminal cost of a learned value."""
    x, g = ca.MX.sym("x", V.size1_in(0)), ca.MX.sym("goal", V.size1_in(1))
    return ca.Function("terminal", [x, g], [-V(x, g)])


def benchmark(plant, name, scenarios, replaced=()):
    """Horizon, and keywords of a planner, of nominal_mpc or robust_mpc; replaced: items in place of those of the plant's BENCHMARK.

    The published benchmark sums slack and the price of changes over scenarios, where the planners take means.
    """
    found, robust = plant.BENCHMARK | dict(replaced), name == "robust_mpc"
    counted = len(scenarios) if robust else 1
    prices = {key: counted * np.array(found[key]) for key in ("slack_price", "change_weight")}
    return found["horizon"], prices | dict(robust_horizon=int(robust))


def build_controller(name, args, kind=IpoptMPC, replaced=()):
    """A planner of rl_mpc_deploy.py by IPOPT, from the same arguments. Raises ValueError for another name.

    kind: the class of RL+MPC; replaced: see `benchmark`.
    """
    plant, goal, critic, _ = deploy.check(args)
    scenarios, options = plant.SCENARIOS["mpc"], dict(goal=goal, compile=args.compile)
    if name in ("nominal_mpc", "robust_mpc"):
        horizon, problem = benchmark(plant, name, scenarios, replaced)
        return RelaxedMPC(plant, horizon, scenarios, squared_error(plant), **problem, **options)
    if name != "rl_mpc":
        raise ValueError(f"{name!r} is not a controller by IPOPT; choose nominal_mpc, robust_mpc or rl_mpc")
    mu, _, V = deploy.export(critic)
    price = critic.plan["slack_weight"] if args.slack_weight is None else args.slack_weight
    price = price if args.constraints == "soft" else np.inf
    options |= dict(
        robust_horizon=1 if args.robust_horizon is None else args.robust_horizon, slack_price=price
    )
    # a shifted plan is often far from optimal under a learned value: the adaptive barrier takes fewer iterations there
    options |= dict(policy=mu, barrier="adaptive")
    return kind(plant, args.horizon, scenarios, gaussian(plant), negative(V), **options)
