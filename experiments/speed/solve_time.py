"""Where the time of a step of the planners goes, and how it grows with the horizon and the number of scenarios.

    python experiments/speed/solve_time.py                    # two minutes in one process, and compilation: nothing else should run
    python experiments/speed/solve_time.py --plot-only        # redraw from the committed CSV

`where`: closed loops over the paired draws of rl_mpc_deploy.py, with a clock around every call of a compiled function and of the solver of
quadratic programs; what remains of make_step is Python. `scaling`: cold solves of RL+MPC from the same start states, in turn, by horizon (9
scenarios) and by the number of scenarios (N = 5), from square grids over the box of parameters; the time per iteration is that of
linearisation, quadratic program and line search.

Writes results/solve_time_where.csv, results/solve_time_scaling.csv and figures/solve_time.png.
"""

import collections
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
from envs import cstr, double_pendulum
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import literal

CONTROLLERS = {  # label: (name, keywords of rl_mpc_deploy.Args)
    "RL+MPC, N = 1": ("rl_mpc", dict(horizon=1)),
    "RL+MPC, N = 5": ("rl_mpc", dict(horizon=5)),
    "RL+MPC, N = 5, one iteration": ("rl_mpc", dict(horizon=5, iterations=1)),
    "RL+MPC, N = 5, robust horizon 2": ("rl_mpc", dict(horizon=5, robust_horizon=2)),
    "RL+MPC, N = 10": ("rl_mpc", dict(horizon=10)),
    "robust MPC, N = 20": ("robust_mpc", {}),
    "robust MPC, N = 20, one iteration": ("robust_mpc", dict(iterations=1)),
    "pendulum, no value, N = 20": ("pendulum", dict(horizon=20, robust_horizon=0)),
    "pendulum, no value, N = 20, 27 scenarios": ("pendulum", dict(horizon=20)),
}
HORIZONS, GRIDS = (1, 2, 5, 10, 20), (1, 2, 3, 5, 7)  # grids of k x k parameters
PARTS = {  # column: (label, colour)
    "guesses_ms": ("first guesses", "#56B4E9"),
    "linearise_ms": ("linearisation", "#0072B2"),
    "qp_ms": ("quadratic programs (HPIPM)", "#E69F00"),
    "search_ms": ("line search", "#009E73"),
    "python_ms": ("Python", "#999999"),
}


@dataclass(frozen=True)
class Args:
    episodes: int = 10
    """draws of start and plant (scaling: start states)"""
    steps: int = 100
    """sampling times per draw"""
    seed: int = 0
    """of the draws"""
    quick: bool = False
    """2 draws of 3 steps, interpreted, two horizons and grids: a smoke test"""
    plot_only: bool = False
    """redraw from the CSV"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def clocked(mpc):
    """Put a clock around what a planner calls. Returns a counter of the milliseconds of PARTS, of programs and of their iterations."""
    spent = collections.Counter()

    def clock(function, part):
        def call(*arguments):
            tick = time.perf_counter()
            result = function(*arguments)
            spent[part()] += 1e3 * (time.perf_counter() - tick)
            return result

        return call

    def solve(*arguments):
        result = program(*arguments)
        spent.update(programs=1, qp_iterations=mpc.qp.iterations)
        return result

    # a rollout before the first iteration of a step is that of a guess
    mpc.rollout = clock(mpc.rollout, lambda: "search_ms" if mpc.stats["iterations"] else "guesses_ms")
    mpc.follow = [clock(follow, lambda: "guesses_ms") for follow in mpc.follow]
    mpc.linearise = clock(mpc.linearise, lambda: "linearise_ms")
    program = clock(mpc.qp.solve, lambda: "qp_ms")
    mpc.qp.solve = solve
    return spent


def pendulum(horizon, robust_horizon=1, compile=True):
    """Goal-conditioned MPC of the double pendulum."""
    plant = double_pendulum
    options = dict(goal=plant.EVAL_GOAL, robust_horizon=robust_horizon, slack_price=10.0, compile=compile)
    return deploy.ScenarioMPC(plant, horizon, plant.SCENARIOS["mpc"], literal.gaussian(plant), **options)


def where(args):
    """Rows: averages per step, over all steps, of every controller, and quantiles of a whole step."""
    rows = []
    for label, (name, options) in CONTROLLERS.items():
        options |= {"compile": not args.quick}
        mpc = (
            pendulum(**options)
            if name == "pendulum"
            else deploy.build_controller(name, deploy.Args(**options))
        )
        spent, plant = clocked(mpc), mpc.plant
        starts, psi = deploy.draws(plant, args.episodes, args.seed)
        log = []
        for i in tqdm(range(args.episodes), desc=label, disable=None):
            mpc.reset()
            x = starts[i]
            for _ in range(args.steps):
                x = plant.step(x, mpc.make_step(x), psi[i])
                log.append(mpc.stats)
        milliseconds = np.array([stats["wall_ms"] for stats in log])
        n = len(log)
        row = {
            "controller": label,
            "nodes": len(mpc.tree.stage),
            "steps": n,
            "step_ms_mean": milliseconds.mean(),
        }
        row |= {
            f"step_ms_{key}": np.quantile(milliseconds, q)
            for key, q in (("median", 0.5), ("p95", 0.95), ("p999", 0.999), ("max", 1))
        }
        # of the quadratic programs: in a step, and interior-point iterations of each
        row |= {
            "iterations_mean": spent["programs"] / n,
            "qp_iterations_mean": spent["qp_iterations"] / spent["programs"],
        }
        row |= {key: spent[key] / n for key in list(PARTS)[:-1]}
        row["python_ms"] = row["step_ms_mean"] - sum(row[key] for key in list(PARTS)[:-1])
        rows.append(
            {k: round(float(v), 4) if isinstance(v, float) else v for k, v in row.items()}
            | {"machine": cells.machine()}
        )
    return rows


def grid(k):
    """k x k parameters over the MPC's box, the nominal ones first."""
    alpha, beta = (np.linspace(1 - width, 1 + width, k) if k > 1 else np.ones(1) for width in (0.05, 0.1))
    psi = np.stack(np.meshgrid(alpha, beta, indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.argsort(np.abs(psi - cstr.PSI_NOMINAL).sum(1), kind="stable")
    return psi[order]


def scaling(args):
    """Rows: cold solves of RL+MPC by horizon and by the number of scenarios."""
    todo = [("horizon", n, 3) for n in HORIZONS] + [("scenarios", 5, k) for k in GRIDS]
    if args.quick:
        todo = [("horizon", 1, 3), ("horizon", 2, 3), ("scenarios", 1, 1), ("scenarios", 1, 2)]
    shipped, planners = cstr.SCENARIOS["mpc"], []
    for _, n, k in todo:
        cstr.SCENARIOS["mpc"] = grid(k)
        try:
            mpc = deploy.build_controller("rl_mpc", deploy.Args(horizon=n, compile=not args.quick))
        finally:
            cstr.SCENARIOS["mpc"] = shipped
        planners.append((mpc, clocked(mpc), []))
    starts = envs.sample_states(cstr, np.random.default_rng([args.seed, 6]), args.episodes)
    for x in tqdm([x for _ in range(3) for x in starts], desc="scaling", disable=None):
        for mpc, spent, log in planners:  # in turn, so that what disturbs one disturbs all
            mpc.reset()
            spent.clear()
            mpc.make_step(x)
            iterating = sum(spent[key] for key in ("linearise_ms", "qp_ms", "search_ms"))
            log.append((mpc.stats["wall_ms"], iterating, mpc.stats["iterations"]))
    rows = []
    for (axis, n, k), (mpc, _, log) in zip(todo, planners):
        ms, iterating, iterations = np.transpose(log)
        rows.append(
            {
                "axis": axis,
                "horizon": n,
                "scenarios": k * k,
                "nodes": len(mpc.tree.stage) - 1,
                "ms_median": round(np.median(ms), 3),
                "iterations_median": np.median(iterations),
                "ms_per_iteration": round(np.median(iterating / iterations), 4),
                "machine": cells.machine(),
            }
        )
    return rows


def exponent(rows, size):
    """Slope of log time per iteration over log size, least squares, beyond the smallest problem."""
    x, y = (np.log([float(row[key]) for row in rows]) for key in (size, "ms_per_iteration"))
    return np.polyfit(x[1:], y[1:], 1)[0] if len(x) > 2 else np.nan


def plot(where_rows, scaling_rows, path):
    fig, axes = plt.subplots(1, 3, figsize=(12, 3.9), layout="constrained", width_ratios=(1.7, 1, 1))
    for y, row in enumerate(where_rows):
        left = 0.0
        for key, (label, colour) in PARTS.items():
            axes[0].barh(y, float(row[key]), left=left, color=colour, label=label if y == 0 else None)
            left += float(row[key])
        axes[0].annotate(
            f"{left:.1f}", (left, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize=9
        )
    axes[0].set_yticks(range(len(where_rows)), [row["controller"] for row in where_rows], fontsize=9)
    axes[0].invert_yaxis()
    axes[0].set(
        xlabel="mean time of a step [ms]",
        xlim=(0, 1.16 * max(float(row["step_ms_mean"]) for row in where_rows)),
    )
    fig.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False, fontsize=9
    )
    for ax, axis in zip(axes[1:], ("horizon", "scenarios")):
        mine = [row for row in scaling_rows if row["axis"] == axis]
        x, y = (np.array([float(row[key]) for row in mine]) for key in (axis, "ms_per_iteration"))
        ax.plot(x, y, "o-", color="#0072B2", label="measured")
        ax.plot(x, y[-1] * x / x[-1], ls=":", color="black", label="proportional")
        ax.set(xscale="log", yscale="log", ylabel="time per iteration [ms]")
        ax.set_xlabel({"horizon": "horizon N (9 scenarios)", "scenarios": "scenarios (N = 5)"}[axis])
        ax.set_xticks(x, [f"{v:.0f}" for v in x])
        ax.set_xticks([], minor=True)
        ax.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        ax.yaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(args):
    cells.check(args, "solve_time_where.csv", episodes=(1, 1000), steps=(1, 10_000), seed=(0, 10**9))
    if not args.plot_only:
        if args.quick:
            args = replace(args, episodes=2, steps=3)
        cells.write(where(args), args.out / "results/solve_time_where.csv")
        cells.write(scaling(args), args.out / "results/solve_time_scaling.csv")
    where_rows, scaling_rows = (
        cells.read(args.out / f"results/solve_time_{name}.csv") for name in ("where", "scaling")
    )
    print(
        f"{'':44s}{'step, ms: mean  median     p95   99.9 %     max':48s}  SQP, QP iterations  "
        + "  ".join(label for label, _ in PARTS.values())
    )
    for row in where_rows:
        step = "".join(
            f"{float(row[f'step_ms_{key}']):9.2f}" for key in ("mean", "median", "p95", "p999", "max")
        )
        parts = "".join(f"{float(row[key]):9.2f}" for key in PARTS)
        print(
            f"{row['controller']:44s}{step}{float(row['iterations_mean']):9.1f}{float(row['qp_iterations_mean']):6.1f}   {parts}"
        )
    for axis in ("horizon", "scenarios"):
        mine = [row for row in scaling_rows if row["axis"] == axis]
        print(
            f"{axis}: "
            + ", ".join(f"{row[axis]}: {float(row['ms_per_iteration']):.2f}" for row in mine)
            + f" ms per iteration; exponent {exponent(mine, axis):.2f}"
        )
    plot(where_rows, scaling_rows, args.out / "figures/solve_time.png")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
