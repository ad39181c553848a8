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
import matplotlib.pyplot as plt
import numpy as np
import tyro
from scipy.special import logsumexp

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
from envs import linear
from experiments import common as cells
from experiments.common import HERE

DIMENSIONS = (2, 4, 8, 16, 32)
CONTROLLERS = {"quadratic": "LQ-MPC", "goal": "goal-conditioned MPC"}
COLOURS = {"quadratic": "#D55E00", "goal": "#0072B2"}  # Okabe and Ito
MARKERS = {"quadratic": "s", "goal": "o"}
MEASURES = {
    "steps_not_near": "steps not near\nthe origin",
    "l2_error": "$\\ell^2$ error",
    "constraint_violation": "constraint\nviolation",
}
BASE = dict(
    horizon=10,
    control_horizon=None,
    gamma=1.0,
    steps=50,
    bound=linear.STATE_BOUND,
    price=1.0,
    off_diagonal=1.0,
    entries="symmetric",
)
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
class Args:
    study: Literal["main", "sweep"] = "main"
    """main: the figure of the paper; sweep: n = 2, 8, 32 with one open choice changed at a time"""
    systems: int | None = None
    """random systems per dimension; default: 10, in the sweep 5"""
    starts: int | None = None
    """initial states per system; default: 10, in the sweep 4"""
    seed: int = 0
    """seed of the first system"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 small systems, 2 starts of 10 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/linear_scalability")
    """where finished systems are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


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
        terminal = ca.Function(
            "terminal", [x, goal], [-ca.exp(-value) if objective == "goal" else value], {"never_inline": True}
        )
        options = dict(goal=plant.EVAL_GOAL, compile=False) | options
        super().__init__(
            plant, horizon, plant.SCENARIOS["nominal"], gm.costs(plant, objective)[0], terminal, **options
        )

    def weights(self):
        return super().weights() * self.gamma**self.tree.stage

    def build_problem(self, *costs):
        problem, limits = super().build_problem(*costs)
        if self.control_horizon is not None:
            n, N = self.plant.A.shape[0], self.horizon
            x, u = (
                ca.reshape(problem["x"][at.ravel("F").tolist()], n, N) for at in (self.at["x"], self.at["u"])
            )
            x = ca.horzcat(problem["p"][:n], x * self.x_scale + self.x_center)
            goal = ca.reshape(problem["p"][2 * n :], n, N)
            law = [
                self.plant.feedback(x[:, t], goal[:, t], self.gamma) for t in range(self.control_horizon, N)
            ]
            follows = ca.veccat(
                *(
                    u[:, N - len(law) + i] - (action - self.u_center) / self.u_scale
                    for i, action in enumerate(law)
                )
            )
            problem["g"] = ca.vertcat(problem["g"], follows)
            limits |= {name: np.append(limits[name], np.zeros(follows.numel())) for name in ("lbg", "ubg")}
        return problem, limits

    def build_shift(self):
        w, known = super().build_shift()[0], self.at["x"].size + self.at["slack"].size
        return (
            w,
            w,
            np.append(w[:known], np.arange(known, len(self.limits["lbg"]))),
        )  # the law's multipliers stay where they are


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


def run_system(cell):
    """Both controllers from every start of one system: rows of the table."""
    variant, settings, n, system, starts = cell
    settings = dict(settings)
    plant, steps, gamma = make_plant(n, system, settings), settings["steps"], settings["gamma"]
    both = {objective: controller(plant, objective, settings) for objective in CONTROLLERS}
    rows = []
    for start in range(starts):
        x0 = envs.sample_states(plant, np.random.default_rng([n, system, start + 1]), 1)[0]
        for objective, mpc in both.items():
            x, u, _, log = gm.simulate(mpc, x0, plant.PSI_NOMINAL, np.zeros((steps, n)))
            compared, worse, costlier = 0, 0, 0
            if (
                objective == "goal"
            ):  # at every state of its closed loop: is its plan at least as good, by the right side, as LQ-MPC's?
                both["quadratic"].reset()
                mpc.reset()
                for state in x[:-1]:
                    rivals = both["quadratic"], mpc
                    for rival in rivals:
                        rival.make_step(state)
                    if all(rival.stats["rung"] in ("solved", "retry") for rival in rivals):
                        (lq_side, lq_cost), (side, cost) = (
                            judged_plan(rival, state, settings["price"]) for rival in rivals
                        )
                        compared, worse, costlier = (
                            compared + 1,
                            worse + (side < lq_side - 1e-6),
                            costlier + (cost > lq_cost + 1e-6),
                        )
            left, right = jensen(trajectory_costs(plant, x, u, gamma), gamma)
            weights = gamma ** np.arange(steps + 1)
            distance = np.linalg.norm(x, axis=1)
            rows.append(
                {
                    "variant": variant,
                    "controller": objective,
                    "n": n,
                    "system": system,
                    "start": start,
                    "steps_not_near": steps - envs.time_near_goal(plant, x[1:], plant.EVAL_GOAL),
                    "l2_error": np.sqrt((x[1:] ** 2).sum()),
                    "constraint_violation": np.abs(x[1:] - np.clip(x[1:], plant.X_LOW, plant.X_HIGH)).sum(),
                    "jensen_log_left": left,
                    "jensen_log_right": right,
                    "log_indicator": np.log((weights * (distance <= 0.1)).sum() / weights.sum() + 1e-300),
                    "plans_compared": compared,
                    "plans_worse": worse,
                    "plans_costlier": costlier,
                    "solver_failures": sum(not s["success"] for s in log),
                    "solve_ms_median": np.median([s["wall_ms"] for s in log]),
                    "condition_L": np.linalg.cond(plant.transform),
                    "norm_A": np.linalg.norm(plant.A, 2),
                    "spectral_radius": np.abs(np.linalg.eigvals(plant.A)).max(),
                }
            )
    return [{k: round(float(v), 6) if isinstance(v, float) else v for k, v in row.items()} for row in rows]


def settings_of(args):
    """Variants, dimensions, systems and starts of a study."""
    if args.quick:
        variants = (
            {"base": {}}
            if args.study == "main"
            else {"base": {}, "control horizon 5": SWEEP["control horizon 5"]}
        )
        return variants, (2, 4), 2, 2
    variants, dimensions, systems, starts = (
        ({"base": {}}, DIMENSIONS, 10, 10) if args.study == "main" else (SWEEP, (2, 8, 32), 5, 4)
    )
    return (
        variants,
        dimensions,
        systems if args.systems is None else args.systems,
        starts if args.starts is None else args.starts,
    )


def collect(args):
    variants, dimensions, systems, starts = settings_of(args)
    work = [
        (variant, tuple((BASE | change | ({"steps": 10} if args.quick else {})).items()), n, system, starts)
        for n in reversed(dimensions)  # the long ones first
        for variant, change in variants.items()
        for system in range(args.seed, args.seed + systems)
    ]
    rows = cells.collect(
        run_system, work, args.jobs, args.runs, [__file__, gm.__file__, envs.__file__, linear.__file__]
    )
    order = {variant: i for i, variant in enumerate(variants)}
    rows.sort(key=lambda row: (order[row["variant"]], int(row["n"]), int(row["system"]), int(row["start"])))
    cells.write(rows, args.out / f"results/linear_scalability{'' if args.study == 'main' else '_sweep'}.csv")


def column(rows, key, **where):
    return np.array([float(row[key]) for row in rows if all(row[k] == str(v) for k, v in where.items())])


def save(fig, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def plot_main(args):
    rows = cells.read(args.out / "results/linear_scalability.csv")
    dimensions = sorted({int(row["n"]) for row in rows})
    fig, axes = plt.subplots(3, 1, figsize=(7, 6.4), sharex=True, layout="constrained")
    print(
        f"{'n':>3s}  {'':22s}{'steps not near':>24s}{'l2 error':>24s}{'violation':>24s}{'failed':>8s}   median [2.5 %, 95 %]"
    )
    for objective, colour in COLOURS.items():
        for ax, key in zip(axes, MEASURES):
            bands = np.array(
                [
                    np.quantile(column(rows, key, controller=objective, n=n), [0.025, 0.5, 0.95])
                    for n in dimensions
                ]
            )
            ax.plot(
                dimensions,
                bands[:, 1],
                "-" + MARKERS[objective],
                color=colour,
                lw=2,
                label=CONTROLLERS[objective],
            )
            ax.fill_between(dimensions, bands[:, 0], bands[:, 2], color=colour, alpha=0.2, lw=0)
    for n in dimensions:
        for objective, name in CONTROLLERS.items():
            line = ""
            for key in MEASURES:
                low, median, high = np.quantile(
                    column(rows, key, controller=objective, n=n), [0.025, 0.5, 0.95]
                )
                line += f"{median:9.2f} [{low:5.2f}, {high:5.2f}]"
            print(
                f"{n:3d}  {name:22s}{line}{column(rows, 'solver_failures', controller=objective, n=n).sum():8.0f}"
            )
        lq, goal = (
            column(rows, "steps_not_near", controller=objective, n=n) for objective in CONTROLLERS
        )  # paired by system and start
        print(
            f"     the same start: {np.median(lq - goal):.2f} fewer steps (median), fewer in {(goal < lq).mean():.0%}"
        )
    for ax, label in zip(axes, MEASURES.values()):
        ax.set_ylabel(label)
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
    axes[-1].set_xscale("log", base=2)
    axes[-1].set_xticks(dimensions, dimensions)
    axes[-1].set_xlabel("number of states n")
    axes[0].legend(frameon=False)
    systems, starts = (len({row[key] for row in rows}) for key in ("system", "start"))
    axes[0].set_title(
        f"{systems} systems per point, {starts} starts each; band: 2.5 to 95 percentile", fontsize=10
    )
    save(fig, args.out / "figures/linear_scalability.png")

    fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    print(
        "\neq:jensen on the closed loops, logarithms, medians: left side, right side, smallest margin, indicator sum (|x| <= 0.1)"
    )
    for objective, colour in COLOURS.items():
        left, right, indicator = (
            [column(rows, key, controller=objective, n=n) for n in dimensions]
            for key in ("jensen_log_left", "jensen_log_right", "log_indicator")
        )
        margins = [r - v for v, r in zip(left, right)]
        name, marker = CONTROLLERS[objective], MARKERS[objective]
        axes[0].plot(
            dimensions, [np.median(m) for m in margins], "-" + marker, color=colour, lw=2, label=name
        )
        axes[0].fill_between(
            dimensions,
            *np.array([np.quantile(m, [0.025, 0.95]) for m in margins]).T,
            color=colour,
            alpha=0.2,
            lw=0,
        )
        axes[1].plot(
            dimensions,
            [np.median(np.exp(r)) for r in right],
            "-" + marker,
            color=colour,
            lw=2,
            label=f"right side, {name}",
        )
        axes[1].plot(
            dimensions,
            [np.median(np.exp(i)) for i in indicator],
            ":" + marker,
            color=colour,
            lw=2,
            mfc="white",
            label=f"share of steps with |x| ≤ 0.1, {name}",
        )
        for i, n in enumerate(dimensions):
            medians = [np.median(values[i]) for values in (left, right, indicator)]
            print(
                f"{n:3d}  {name:22s}{medians[0]:9.3f}{medians[1]:9.3f}{margins[i].min():11.2e}{medians[2]:9.3f}"
            )
    compared, worse, costlier = (
        column(rows, key, controller="goal").sum()
        for key in ("plans_compared", "plans_worse", "plans_costlier")
    )
    print(
        f"of {compared:.0f} goal-conditioned plans, right side below that of LQ-MPC's plan at the same state: {worse:.0f}; "
        f"objective with slack worse than of LQ-MPC's plan (local optima): {costlier:.0f}"
    )
    axes[0].set(xlabel="number of states n", ylabel="log right side − log left side", yscale="log")
    axes[1].set(
        xlabel="number of states n", ylabel="weighted mean over the episode", ylim=(0.885, 1)
    )  # room for the legend
    for ax in axes:
        ax.set_xscale("log", base=2)
        ax.set_xticks(dimensions, dimensions)
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    save(fig, args.out / "figures/linear_scalability_jensen.png")


def plot_sweep(args):
    rows = cells.read(args.out / "results/linear_scalability_sweep.csv")
    variants, dimensions = (
        list(dict.fromkeys(row["variant"] for row in rows)),
        sorted({int(row["n"]) for row in rows}),
    )
    size = (2 + 2.7 * len(dimensions), 1.4 + 0.32 * len(variants))
    fig, axes = plt.subplots(1, len(dimensions), figsize=size, sharey=True, layout="constrained")
    print(
        f"{'':26s}"
        + "".join(f"{'n = ' + str(n):>30s}" for n in dimensions)
        + "   median steps not near the origin: LQ, goal, gap; failed solves"
    )
    for position, variant in enumerate(variants):
        line = f"{variant:26s}"
        for ax, n in zip(axes, dimensions):
            medians = {}
            for objective, colour in COLOURS.items():
                values = column(rows, "steps_not_near", variant=variant, controller=objective, n=n)
                medians[objective] = np.median(values)
                at = -position + (0.15 if objective == "goal" else -0.15)
                ax.plot(np.quantile(values, [0.025, 0.95]), [at, at], color=colour, alpha=0.4, lw=3)
                ax.plot(
                    medians[objective],
                    at,
                    MARKERS[objective],
                    color=colour,
                    label=CONTROLLERS[objective] if not position else None,
                )
            failed = column(rows, "solver_failures", variant=variant, n=n).sum()
            line += f"{medians['quadratic']:10.2f}{medians['goal']:7.2f}{medians['quadratic'] - medians['goal']:7.2f}{failed:6.0f}"
        print(line)
    for ax, n in zip(axes, dimensions):
        ax.set(title=f"n = {n}", xlabel="steps not near the origin")
        ax.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(-np.arange(len(variants)), variants)
    axes[0].set_ylim(0.5 - len(variants), 0.5)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    save(fig, args.out / "figures/linear_scalability_sweep.png")


def main(args):
    table = f"linear_scalability{'' if args.study == 'main' else '_sweep'}.csv"
    cells.check(args, table, systems=(1, 1000), starts=(1, 1000), jobs=(1, 1024), seed=(0, 10**9))
    if not args.plot_only:
        collect(args)
    (plot_main if args.study == "main" else plot_sweep)(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
