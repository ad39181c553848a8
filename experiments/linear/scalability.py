"""Figure `scalability`: linear-quadratic against goal-conditioned MPC on random linear systems, and eq:jensen that explains the gap.

    python experiments/linear/scalability.py --jobs 2                  # 50 systems, 10 starts each; continues where it stopped
    python experiments/linear/scalability.py --study sweep --jobs 2    # what the paper leaves open, one choice at a time
    python experiments/linear/scalability.py --plot-only               # redraw from the committed CSV

Both controllers are goal_mpc.py's, with stage cost l = |x|^2 + |u|^2, terminal cost V = x'Px and the same price on violations of the state
bounds: one minimises sum l + V, the other sum -exp(-l) - exp(-V). Choices that the paper leaves open: horizon 10, no discount, free
actions at all stages, 50 steps, state bounds 1.5 at a price of 1 per unit and step, matrices as in envs/linear.py.

Writes results/linear_scalability.csv (a row per controller and start), figures/linear_scalability.png and linear_scalability_jensen.png;
the sweep writes linear_scalability_sweep.csv and .png.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
from scipy.special import logsumexp

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
from envs import linear
from experiments import common
from experiments.common import column, distinct, rounded, select
from experiments.palette import BLUE, RED

DIMENSIONS = (2, 4, 8, 16, 32)
CONTROLLERS = {"quadratic": ("LQ-MPC", RED, "s"), "goal": ("goal-conditioned MPC", BLUE, "o")}
MEASURES = {
    "steps_not_near": "steps not near\nthe origin",
    "l2_error": "$\\ell^2$ error",
    "constraint_violation": "constraint\nviolation",
}
BASE = dict(horizon=10, control_horizon=None, gamma=1.0, steps=50, bound=linear.STATE_BOUND, price=1.0)
BASE |= dict(off_diagonal=1.0, entries="symmetric")
SWEEP = {  # one choice at a time
    "base": {},
    "horizon 5": dict(horizon=5),
    "horizon 20": dict(horizon=20),
    "control horizon 5": dict(control_horizon=5),
    "discount 0.99": dict(gamma=0.99),
    "discount 0.9": dict(gamma=0.9),
    "100 steps": dict(steps=100),
    "state bounds 3": dict(bound=3.0),
    "state bounds 0.5": dict(bound=0.5),  # most starts are outside
    "state bounds 0.5, slack price 10": dict(bound=0.5, price=10.0),
    "slack price 10": dict(price=10.0),
    "L diagonal": dict(off_diagonal=0.0),
    "L off-diagonals doubled": dict(off_diagonal=2.0),
    "entries of M in [0, 1]": dict(entries="positive"),
}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["main", "sweep"] = "main"
    """main: the figure of the paper; sweep: n = 2, 8, 32 with one open choice changed at a time"""
    systems: int | None = None
    """random systems per dimension, of seeds in a row; default: 10, in the sweep 3"""
    starts: int | None = None
    """initial states per system; default: 10, in the sweep 2"""


def jensen(costs, gamma=1.0):
    """Logarithms of both sides of eq:jensen for costs l(x_0, u_0), ..., l(x_{N-1}, u_{N-1}), V(x_N): (..., N + 1) -> two of (...).

    The weights gamma^t (1 - gamma) / (1 - gamma^{N+1}), t = 0 ... N, sum to one; without a discount they are 1 / (N + 1).
    """
    weights = gamma ** np.arange(costs.shape[-1])
    weights = weights / weights.sum()
    return -(costs * weights).sum(-1), logsumexp(-costs, b=weights, axis=-1)


def trajectory_costs(plant, x, u, gamma=1.0):
    """l(x_t, u_t) for every action and V of the last state, goal at the origin: x (N + 1, n), u (N, n) -> (N + 1,)."""
    return np.append((x[:-1] ** 2).sum(1) + (u**2).sum(1), x[-1] @ plant.lqr(gamma)[0] @ x[-1])


def make_plant(n, system, settings):
    """The system of envs/linear.py with this seed, or its sibling under other choices."""
    rng = np.random.default_rng([n, system])
    plant = linear.Linear(*linear.random_matrix(n, rng, settings["off_diagonal"], settings["entries"]))
    plant.X_LOW, plant.X_HIGH = (side * np.full(n, settings["bound"]) for side in (-1, 1))
    return plant


class LinearMPC(gm.ScenarioMPC):
    """goal_mpc.py's controller whose stage t, slack included, counts gamma^t, with the discounted regulator's value at its end.

    control_horizon: N_c of eq:nominalMPCobj, from which stage on the actions follow that regulator; None: never.
    """

    def __init__(self, plant, horizon, objective="quadratic", *, gamma=1.0, control_horizon=None, **options):
        self.gamma, self.control_horizon = gamma, control_horizon
        x, goal = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("goal", len(plant.GOAL_INDEX))
        value = plant.lq_value(x, goal, gamma)
        value = -ca.exp(-value) if objective == "goal" else value
        stage, _ = gm.costs(plant, objective)
        terminal = ca.Function("terminal", [x, goal], [value], {"never_inline": True})
        options = dict(goal=plant.EVAL_GOAL, compile=False) | options
        super().__init__(plant, horizon, plant.SCENARIOS["nominal"], stage, terminal, **options)

    def weights(self):
        return super().weights() * self.gamma**self.tree.stage

    def build_problem(self, *costs):
        problem, limits = super().build_problem(*costs)
        if self.control_horizon is not None:
            n, N = self.plant.A.shape[0], self.horizon
            x, u = (ca.reshape(problem["x"][self.at[k].ravel("F").tolist()], n, N) for k in "xu")
            x = ca.horzcat(problem["p"][:n], x * self.x_scale + self.x_center)
            goal = ca.reshape(problem["p"][2 * n :], n, N)
            follows = []
            for t in range(self.control_horizon, N):
                action = self.plant.feedback(x[:, t], goal[:, t], self.gamma)
                follows.append(u[:, t] - (action - self.u_center) / self.u_scale)
            follows = ca.veccat(*follows)
            problem["g"] = ca.vertcat(problem["g"], follows)
            limits |= {name: np.append(limits[name], np.zeros(follows.numel())) for name in ("lbg", "ubg")}
        return problem, limits

    def build_shift(self):
        w, known = super().build_shift()[0], self.at["x"].size + self.at["slack"].size
        law = np.arange(known, len(self.limits["lbg"]))  # whose multipliers stay where they are
        return w, w, np.append(w[:known], law)


def controller(plant, objective, settings):
    """One of the two controllers for this plant."""
    named = {name: settings[name] for name in ("gamma", "control_horizon")}
    return LinearMPC(plant, settings["horizon"], objective, slack_price=settings["price"], **named)


def plan_sides(mpc, x0):
    """Both sides of eq:jensen for the last plan of a controller."""
    plan = mpc.prediction()
    x, u = (np.array([stage[:, 0] for stage in plan[key]]) for key in "xu")
    return jensen(trajectory_costs(mpc.plant, np.vstack([x0, x]), u, mpc.gamma), mpc.gamma)


def judged_plan(mpc, x0, price):
    """Of the last plan of a controller: the logarithm of eq:jensen's right side, and the goal-conditioned objective, slack included."""
    right, x = plan_sides(mpc, x0)[1], np.array([stage[:, 0] for stage in mpc.prediction()["x"]])
    weights = mpc.gamma ** np.arange(mpc.horizon + 1)
    outside = np.abs(x - np.clip(x, mpc.plant.X_LOW, mpc.plant.X_HIGH)).sum(1)
    return right, -weights.sum() * np.exp(right) + price * (weights[1:] * outside).sum()


def compared_plans(lq, mpc, states, price):
    """At every state of a closed loop: is the goal-conditioned plan as good as LQ-MPC's, by the right side and by its objective?"""
    lq.reset()
    mpc.reset()
    compared, worse, costlier = 0, 0, 0
    for x in states:
        for rival in (lq, mpc):
            rival.make_step(x)
        if all(rival.stats["rung"] in ("solved", "retry") for rival in (lq, mpc)):
            (lq_side, lq_cost), (side, cost) = (judged_plan(rival, x, price) for rival in (lq, mpc))
            compared += 1
            worse += side < lq_side - 1e-6
            costlier += cost > lq_cost + 1e-6
    return {"plans_compared": compared, "plans_worse": worse, "plans_costlier": costlier}


def run_system(cell):
    """Both controllers from every start of one system: rows of the table."""
    variant, settings, n, system, starts = cell
    settings = dict(settings)
    plant, steps, gamma = make_plant(n, system, settings), settings["steps"], settings["gamma"]
    both = {objective: controller(plant, objective, settings) for objective in CONTROLLERS}
    weights, rows = gamma ** np.arange(steps + 1), []
    for start in range(starts):
        x0 = envs.sample_states(plant, np.random.default_rng([n, system, start + 1]), 1)[0]
        for objective, mpc in both.items():
            x, u, _, log = gm.simulate(mpc, x0, plant.PSI_NOMINAL, np.zeros((steps, n)))
            plans = dict.fromkeys(("plans_compared", "plans_worse", "plans_costlier"), 0)
            if objective == "goal":
                plans = compared_plans(both["quadratic"], mpc, x[:-1], settings["price"])
            left, right = jensen(trajectory_costs(plant, x, u, gamma), gamma)
            near = (weights * (np.linalg.norm(x, axis=1) <= 0.1)).sum() / weights.sum()
            row = {"variant": variant, "controller": objective, "n": n, "system": system, "start": start}
            row |= {
                "steps_not_near": steps - envs.time_near_goal(plant, x[1:], plant.EVAL_GOAL),
                "l2_error": np.sqrt((x[1:] ** 2).sum()),
                "constraint_violation": np.abs(x[1:] - np.clip(x[1:], plant.X_LOW, plant.X_HIGH)).sum(),
                "jensen_log_left": left,
                "jensen_log_right": right,
                "log_indicator": np.log(near + 1e-300),
            }
            row |= plans | {
                "solver_failures": sum(not s["success"] for s in log),
                "solve_ms_median": np.median([s["wall_ms"] for s in log]),
                "condition_L": np.linalg.cond(plant.transform),
                "norm_A": np.linalg.norm(plant.A, 2),
                "spectral_radius": np.abs(np.linalg.eigvals(plant.A)).max(),
            }
            rows.append(rounded(row, 6))
    return rows


def settings_of(args):
    """Variants, dimensions, systems and starts of a study."""
    swept = args.study == "sweep"
    if args.quick:
        return {name: SWEEP[name] for name in ("base", "control horizon 5")[: 1 + swept]}, (2, 4), 2, 2
    systems, starts = args.systems or (3 if swept else 10), args.starts or (2 if swept else 10)
    return SWEEP if swept else {"base": {}}, (2, 8, 32) if swept else DIMENSIONS, systems, starts


def collect(args):
    variants, dimensions, systems, starts = settings_of(args)
    few = {"steps": 10} if args.quick else {}
    work = [
        (variant, tuple((BASE | change | few).items()), n, system, starts)
        for n in reversed(dimensions)  # the long ones first
        for variant, change in variants.items()
        for system in range(args.seed, args.seed + systems)
    ]
    rows, order = common.collect(run_system, work, args.runs, args.jobs), list(variants)
    keys = ("n", "system", "start")
    return sorted(rows, key=lambda row: (order.index(row["variant"]), *(int(row[key]) for key in keys)))


def draw_bands(ax, dimensions, values, colour, style, label):
    """Median and bar of 2.5 to 95 percentile, the controllers' beside each other; values: an array for each dimension."""
    low, median, high = np.transpose([np.quantile(v, [0.025, 0.5, 0.95]) for v in values])
    at = np.array(dimensions) * 1.04 ** (1 if colour == CONTROLLERS["goal"][1] else -1)
    ax.errorbar(
        at, median, (median - low, high - median), fmt=style, color=colour, lw=1.5, capsize=4, label=label
    )


def by_dimension(ax, dimensions):
    ax.set_xscale("log", base=2)
    ax.set_xticks(dimensions, dimensions)


def plot_main(rows, path):
    dimensions = sorted({int(row["n"]) for row in rows})
    fig, axes = common.subplots(3, 1, figsize=(7, 6.4), sharex=True)
    for objective, (name, colour, marker) in CONTROLLERS.items():
        for ax, key in zip(axes, MEASURES):
            values = [column(rows, key, controller=objective, n=n) for n in dimensions]
            draw_bands(ax, dimensions, values, colour, "-" + marker, name)
    for ax, label in zip(axes, MEASURES.values()):
        ax.set_ylabel(label)
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
    by_dimension(axes[-1], dimensions)
    axes[-1].set_xlabel("number of states n")
    axes[0].legend(frameon=False)
    systems, starts = (len(distinct(rows, key)) for key in ("system", "start"))
    title = f"{systems} systems per point, {starts} starts each: median, 2.5 to 95 percentile"
    axes[0].set_title(title, fontsize=10)
    common.save(fig, path)


def print_main(rows):
    titles = "".join(f"{title:>24s}" for title in ("steps not near", "l2 error", "violation"))
    print(f"{'n':>3s}  {'':22s}{titles}{'failed':>8s}   median [2.5 %, 95 %]")
    for n in sorted({int(row["n"]) for row in rows}):
        for objective, (name, _, _) in CONTROLLERS.items():
            text = f"{n:3d}  {name:22s}"
            for key in MEASURES:
                found = column(rows, key, controller=objective, n=n)
                text += "{1:9.2f} [{0:5.2f}, {2:5.2f}]".format(*np.quantile(found, [0.025, 0.5, 0.95]))
            print(f"{text}{column(rows, 'solver_failures', controller=objective, n=n).sum():8.0f}")
        # paired by system and start
        lq, goal = (column(rows, "steps_not_near", controller=objective, n=n) for objective in CONTROLLERS)
        fewer = f"{np.median(lq - goal):.2f} fewer steps (median), fewer in {(goal < lq).mean():.0%}"
        print(f"     the same start: {fewer}")


def plot_jensen(rows, path):
    """The margin of eq:jensen and its right side, and the same as a table."""
    dimensions = sorted({int(row["n"]) for row in rows})
    fig, axes = common.subplots(1, 2, figsize=(9, 3.6))
    print("\neq:jensen on the closed loops, logarithms, medians: left side, right side, smallest margin,")
    print("indicator sum (|x| <= 0.1)")
    for objective, (name, colour, marker) in CONTROLLERS.items():
        mine = [select(rows, controller=objective, n=n) for n in dimensions]
        keys = ("jensen_log_left", "jensen_log_right", "log_indicator")
        left, right, near = ([column(part, key) for part in mine] for key in keys)
        margins = [r - v for v, r in zip(left, right)]
        draw_bands(axes[0], dimensions, margins, colour, "-" + marker, name)
        style = dict(color=colour, marker=marker, lw=2)
        axes[1].plot(dimensions, [np.median(np.exp(v)) for v in right], label=f"right side, {name}", **style)
        style |= dict(ls=":", mfc="white", label=f"share of steps with |x| ≤ 0.1, {name}")
        axes[1].plot(dimensions, [np.median(np.exp(v)) for v in near], **style)
        for i, n in enumerate(dimensions):
            medians = [np.median(values[i]) for values in (left, right, near)]
            text = f"{medians[0]:9.3f}{medians[1]:9.3f}{margins[i].min():11.2e}{medians[2]:9.3f}"
            print(f"{n:3d}  {name:22s}{text}")
    keys = ("plans_compared", "plans_worse", "plans_costlier")
    compared, worse, costlier = (column(rows, key, controller="goal").sum() for key in keys)
    print(f"of {compared:.0f} goal-conditioned plans, right side below that of LQ-MPC's plan: {worse:.0f};")
    print(f"objective with slack worse than of LQ-MPC's plan (local optima): {costlier:.0f}")
    axes[0].set(ylabel="log right side − log left side", yscale="log")
    axes[1].set(ylabel="weighted mean over the episode", ylim=(0.885, 1))  # room for the legend
    for ax in axes:
        by_dimension(ax, dimensions)
        ax.set_xlabel("number of states n")
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    common.save(fig, path)


def plot_sweep(rows, path):
    variants, dimensions = distinct(rows, "variant"), sorted({int(row["n"]) for row in rows})
    size = (2 + 2.7 * len(dimensions), 1.4 + 0.32 * len(variants))
    fig, axes = common.subplots(1, len(dimensions), figsize=size, sharey=True)
    titles = "".join(f"{'n = ' + str(n):>30s}" for n in dimensions)
    print(f"{'':26s}{titles}   median steps not near the origin: LQ, goal, gap; failed solves")
    for position, variant in enumerate(variants):
        text = f"{variant:26s}"
        for ax, n in zip(axes, dimensions):
            medians = []
            for objective, (name, colour, marker) in CONTROLLERS.items():
                values = column(rows, "steps_not_near", variant=variant, controller=objective, n=n)
                medians.append(np.median(values))
                at = -position + (0.15 if objective == "goal" else -0.15)
                ax.plot(np.quantile(values, [0.025, 0.95]), [at, at], color=colour, alpha=0.4, lw=3)
                ax.plot(medians[-1], at, marker, color=colour, label=None if position else name)
            failed = column(rows, "solver_failures", variant=variant, n=n).sum()
            text += f"{medians[0]:10.2f}{medians[1]:7.2f}{medians[0] - medians[1]:7.2f}{failed:6.0f}"
        print(text)
    for ax, n in zip(axes, dimensions):
        ax.set(title=f"n = {n}", xlabel="steps not near the origin")
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(-np.arange(len(variants)), variants)
    axes[0].set_ylim(0.5 - len(variants), 0.5)
    common.legend(fig, axes[0], ncols=2, fontsize=10)
    common.save(fig, path)


def main(args):
    name = "linear_scalability" if args.study == "main" else "linear_scalability_sweep"
    common.check(args, name, systems=(1, 1000), starts=(1, 1000))
    if not args.plot_only:
        common.write(collect(args), args.table(name))
    rows = common.read(args.table(name))
    if args.study == "sweep":
        return plot_sweep(rows, args.figure(name))
    plot_main(rows, args.figure(name))
    print_main(rows)
    plot_jensen(rows, args.figure("linear_scalability_jensen"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
