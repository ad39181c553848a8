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

import numpy as np
from matplotlib.ticker import LogLocator
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
from envs import cstr
from envs.script.comparison import draws
from experiments import common
from experiments.common import column, rounded, select
from experiments.palette import BLUE, GREEN, GREY, ORANGE, SKY
from experiments.reactor import literal, loops

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
    "guesses_ms": ("first guesses", SKY),
    "linearise_ms": ("linearisation", BLUE),
    "qp_ms": ("quadratic programs (HPIPM)", ORANGE),
    "search_ms": ("line search", GREEN),
    "python_ms": ("Python", GREY),
}
CLOCKED = list(PARTS)[:-1]  # Python is what remains


@dataclass(frozen=True)
class Args(common.StudyArgs):
    episodes: int = 10
    """draws of start and plant (scaling: start states)"""
    steps: int = 100
    """sampling times per draw"""


class Clock:
    """A function that adds the milliseconds of its calls to `spent[part()]`."""

    def __init__(self, function, spent, part):
        self.function, self.spent, self.part = function, spent, part

    def __call__(self, *arguments):
        tick = time.perf_counter()
        result = self.function(*arguments)
        self.spent[self.part()] += 1e3 * (time.perf_counter() - tick)
        return result


class ClockedProgram(Clock):
    """A planner's solver of quadratic programs, with a clock around `solve` and its iterations counted."""

    def __init__(self, program, spent):
        super().__init__(program.solve, spent, lambda: "qp_ms")
        self.program = program

    def solve(self, *arguments):
        found = self(*arguments)
        self.spent.update(programs=1, qp_iterations=self.program.iterations)
        return found


def clocked(mpc):
    """Put clocks around what a planner calls. Returns a counter of the milliseconds of PARTS, of programs and of their iterations."""
    spent = collections.Counter()

    def rolling_out():  # before the first iteration of a step: a guess
        return "search_ms" if mpc.stats["iterations"] else "guesses_ms"

    mpc.rollout = Clock(mpc.rollout, spent, rolling_out)
    mpc.follow = mpc.follow and Clock(mpc.follow, spent, lambda: "guesses_ms")
    mpc.linearise = Clock(mpc.linearise, spent, lambda: "linearise_ms")
    mpc.qp = ClockedProgram(mpc.qp, spent)
    return spent


def pendulum(horizon, robust_horizon=1, compile=True):
    """Goal-conditioned MPC of the double pendulum."""
    plant = envs.load("double_pendulum")
    options = dict(goal=plant.EVAL_GOAL, robust_horizon=robust_horizon, slack_price=10.0, compile=compile)
    return deploy.ScenarioMPC(plant, horizon, plant.SCENARIOS["mpc"], literal.gaussian(plant), **options)


def build(name, options, compile):
    if name == "pendulum":
        return pendulum(compile=compile, **options)
    return deploy.build_controller(name, deploy.Args(compile=compile, **options))


def where(args):
    """Rows: averages per step, over all steps, of every controller, and quantiles of a whole step."""
    rows = []
    for label, (name, options) in CONTROLLERS.items():
        mpc = build(name, options, compile=not args.quick)
        spent, log = clocked(mpc), []
        starts, psi = draws(mpc.plant, args.episodes, args.seed)
        for i in tqdm(range(args.episodes), desc=label, disable=None):
            mpc.reset()
            x = starts[i]
            for _ in range(args.steps):
                x = mpc.plant.step(x, mpc.make_step(x), psi[i])
                log.append(mpc.stats)
        milliseconds, n = np.array([stats["wall_ms"] for stats in log]), len(log)
        row = {"controller": label, "nodes": len(mpc.tree.stage), "steps": n}
        row |= {"step_ms_mean": milliseconds.mean()}
        for key, q in (("median", 0.5), ("p95", 0.95), ("p999", 0.999), ("max", 1)):
            row[f"step_ms_{key}"] = np.quantile(milliseconds, q)
        # of the quadratic programs: in a step, and interior-point iterations of each
        row["iterations_mean"] = spent["programs"] / n
        row["qp_iterations_mean"] = spent["qp_iterations"] / spent["programs"]
        row |= {key: spent[key] / n for key in CLOCKED}
        row["python_ms"] = row["step_ms_mean"] - sum(row[key] for key in CLOCKED)
        rows.append(rounded(row, 4) | {"machine": common.machine()})
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
    planners = []
    for _, n, k in todo:
        settings = deploy.Args(horizon=n, compile=not args.quick)
        mpc = loops.value_mpc(settings, scenarios=grid(k))
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
        row = {"axis": axis, "horizon": n, "scenarios": k * k, "nodes": len(mpc.tree.stage) - 1}
        row |= {"ms_median": round(np.median(ms), 3), "iterations_median": np.median(iterations)}
        row["ms_per_iteration"] = round(np.median(iterating / iterations), 4)
        rows.append(row | {"machine": common.machine()})
    return rows


def exponent(rows, size):
    """Slope of log time per iteration over log size, least squares, beyond the smallest problem."""
    x, y = np.log(column(rows, size)), np.log(column(rows, "ms_per_iteration"))
    return np.polyfit(x[1:], y[1:], 1)[0] if len(x) > 2 else np.nan


def plot(where_rows, scaling_rows, path):
    fig, axes = common.subplots(1, 3, figsize=(12, 3.9), width_ratios=(1.7, 1, 1))
    for y, row in enumerate(where_rows):
        left = 0.0
        for key, (label, colour) in PARTS.items():
            axes[0].barh(y, float(row[key]), left=left, color=colour, label=None if y else label)
            left += float(row[key])
        style = dict(xytext=(4, 0), textcoords="offset points", va="center", fontsize=9)
        axes[0].annotate(f"{left:.1f}", (left, y), **style)
    axes[0].set_yticks(range(len(where_rows)), [row["controller"] for row in where_rows], fontsize=9)
    axes[0].invert_yaxis()
    axes[0].set(xlabel="mean time of a step [ms]", xlim=(0, 1.16 * column(where_rows, "step_ms_mean").max()))
    common.legend(fig, axes[0], ncols=5)
    titles = "horizon N (9 scenarios)", "scenarios (N = 5)"
    for ax, axis, title in zip(axes[1:], ("horizon", "scenarios"), titles):
        mine = select(scaling_rows, axis=axis)
        x, y = column(mine, axis), column(mine, "ms_per_iteration")
        ax.plot(x, y, "o-", color=BLUE, label="measured")
        ax.plot(x, y[-1] * x / x[-1], ls=":", color="black", label="proportional")
        ax.set(xscale="log", yscale="log", xlabel=title, ylabel="time per iteration [ms]")
        ax.set_xticks(x, [f"{v:.0f}" for v in x])
        ax.set_xticks([], minor=True)
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    common.save(fig, path)


def print_tables(where_rows, scaling_rows):
    head = f"{'':44s}{'step, ms: mean  median     p95   99.9 %     max':48s}  SQP, QP iterations  "
    print(head + "  ".join(label for label, _ in PARTS.values()))
    for row in where_rows:
        keys = [f"step_ms_{key}" for key in ("mean", "median", "p95", "p999", "max")]
        step, parts = ("".join(f"{float(row[key]):9.2f}" for key in names) for names in (keys, PARTS))
        iterations = f"{float(row['iterations_mean']):9.1f}{float(row['qp_iterations_mean']):6.1f}"
        print(f"{row['controller']:44s}{step}{iterations}   {parts}")
    for axis in ("horizon", "scenarios"):
        mine = select(scaling_rows, axis=axis)
        times = ", ".join(f"{row[axis]}: {float(row['ms_per_iteration']):.2f}" for row in mine)
        print(f"{axis}: {times} ms per iteration; exponent {exponent(mine, axis):.2f}")


def main(args):
    common.check(args, "solve_time_where", episodes=(1, 1000), steps=(1, 10_000))
    tables = args.table("solve_time_where"), args.table("solve_time_scaling")
    if not args.plot_only:
        if args.quick:
            args = replace(args, episodes=2, steps=3)
        for study, table in zip((where, scaling), tables):
            common.write(study(args), table)
    rows = [common.read(table) for table in tables]
    print_tables(*rows)
    plot(*rows, args.figure("solve_time"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
