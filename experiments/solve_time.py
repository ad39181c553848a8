"""Where the time of a step of the controllers goes, and how it grows with the horizon and the number of scenarios.

    python experiments/solve_time.py                    # two minutes in one process, and compilation: nothing else should run
    python experiments/solve_time.py --plot-only        # redraw from the committed CSV

`where`: closed loops over the paired draws of rl_mpc_deploy.py; CasADi's clocks give the function evaluations, IPOPT's own the linear
algebra (in whole milliseconds per solve, too coarse for N = 1), the rest of the solver call and of make_step is what remains. The floor
is the bare evaluation of objective, constraints and derivatives, once per iteration. `scaling`: cold solves of RL+MPC from the same start
states, by horizon (9 scenarios) and by the number of scenarios (N = 5), from square grids over the box of parameters.

Writes results/solve_time_where.csv, results/solve_time_scaling.csv and figures/solve_time.png.
"""

import re
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import casadi as ca
import matplotlib
import numpy as np
import tyro
from tqdm import tqdm

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import cells

import envs
import rl_mpc_deploy as deploy
from envs import cstr

CRITIC = HERE / "pretrained/cstr_robust.pt"
CONTROLLERS = {"RL+MPC, N = 1": ("rl_mpc", 1), "RL+MPC, N = 5": ("rl_mpc", 5), "robust MPC, N = 20": ("robust_mpc", 20)}
HORIZONS, GRIDS = (1, 2, 5, 10, 20), (1, 2, 3, 5, 7)  # grids of k x k parameters
FUNCTIONS = {"f": "objective", "g": "constraints", "grad_f": "gradient", "jac_g": "Jacobian", "hess_l": "Hessian"}
PARTS = {  # column: (label, colour)
    "functions_ms": ("function evaluations", "#0072B2"),
    "linear_ms": ("linear algebra (MUMPS)", "#E69F00"),
    "solver_ms": ("rest of IPOPT and CasADi", "#999999"),
    "python_ms": ("Python: guesses, bounds", "#D55E00"),
}


@dataclass(frozen=True)
class Args:
    episodes: int = 6
    """draws of start and plant (scaling: start states)"""
    steps: int = 60
    """sampling times per draw"""
    seed: int = 0
    """of the draws"""
    quick: bool = False
    """2 draws of 3 steps, interpreted, two horizons and grids: a smoke test"""
    plot_only: bool = False
    """redraw from the CSV"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


class Clocked:
    """A solver of ScenarioMPC with IPOPT's timing statistics: calls go through, and what its clocks say is kept."""

    def __init__(self, solver, report):
        self.solver, self.report, self.log, self.reading_ms = solver, report, [], 0.0

    def __call__(self, **arguments):
        tick = time.perf_counter()
        result = self.solver(**arguments)
        total, stats = 1e3 * (time.perf_counter() - tick), self.solver.stats()
        linear = 1e3 * float(re.findall(r"StdAugSystemSolverMultiSolve.*wall: +([\d.]+)", self.report.read_text())[-1])  # of this call
        each = {name: 1e3 * stats[f"t_wall_nlp_{name}"] for name in FUNCTIONS}
        self.log.append(
            each | {"call_ms": total, "functions_ms": sum(each.values()), "linear_ms": linear, "iterations": stats["iter_count"]}
        )
        return result

    def stats(self):
        return self.solver.stats()


def clocked(build, folder):
    """`build()` with both of its solvers clocked: IPOPT writes its timing statistics into a file per solver."""
    plain = ca.nlpsol

    def nlpsol(name, plugin, nlp, *options):
        if options:  # the solver itself; the first call, without options, only generates code
            more = {"output_file": str(folder / f"{name}.txt"), "file_print_level": 3, "print_timing_statistics": "yes"}
            options = ({**options[0], "ipopt": {**options[0]["ipopt"], **more}},)
        return plain(name, plugin, nlp, *options)

    ca.nlpsol = nlpsol
    try:
        controller = build()
    finally:
        ca.nlpsol = plain
    controller.solvers = {name: Clocked(solver, folder / f"{name}.txt") for name, solver in controller.solvers.items()}
    return controller


def floor(controller, repeats):
    """Milliseconds of one bare evaluation of every function that an iteration needs, at the last plan."""
    solver, w = controller.solvers["warm"].solver, controller.last_w
    p = controller._parameters(cstr.START, np.minimum(controller.slack_price, 1e3))
    lam, total = np.zeros(controller.nlp["g"].numel()), 0.0
    for name in FUNCTIONS:
        function = solver.get_function(f"nlp_{name}")
        buffer, evaluate = function.buffer()  # calls without a copy of arguments and results
        arguments = [np.array(a, dtype=float) for a in (w, p, 1.0, lam)[: function.n_in()]]
        results = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, value in enumerate(arguments):
            buffer.set_arg(i, memoryview(value.reshape(-1)))
        for i, value in enumerate(results):
            buffer.set_res(i, memoryview(value))
        times = []
        for _ in range(repeats):
            tick = time.perf_counter()
            evaluate()
            times.append(time.perf_counter() - tick)
        total += 1e3 * np.median(times)
    return total


def where(args):
    """Rows: averages per step, over all steps, of every controller."""
    rows = []
    for label, (name, horizon) in CONTROLLERS.items():
        with tempfile.TemporaryDirectory() as folder:
            settings = deploy.Args(horizon=horizon, critic=CRITIC, compile=not args.quick)
            mpc, steps = clocked(partial(deploy.build_controller, name, settings), Path(folder)), []
            starts, psi = deploy.draws(cstr, args.episodes, args.seed)
            for i in tqdm(range(args.episodes), desc=label, disable=None):
                mpc.reset()
                mpc.set_initial_guess(starts[i])
                x = starts[i]
                for _ in range(args.steps):
                    reading = sum(solver.reading_ms for solver in mpc.solvers.values())
                    u = mpc.make_step(x)
                    steps.append(mpc.stats["wall_ms"] - sum(solver.reading_ms for solver in mpc.solvers.values()) + reading)
                    x = cstr.step(x, u, psi[i])
            log = [entry for solver in mpc.solvers.values() for entry in solver.log]
            sums = {key: sum(entry[key] for entry in log) for key in log[0]}
            iterations, n = sums["iterations"], len(steps)
            row = {"controller": label, "steps": n, "step_ms_mean": np.mean(steps), "step_ms_median": np.median(steps),
                   "step_ms_p95": np.quantile(steps, 0.95), "iterations_mean": iterations / n}  # fmt: skip
            row |= {key: sums[key] / n for key in ("functions_ms", "linear_ms")}
            row["solver_ms"] = (sums["call_ms"] - sums["functions_ms"] - sums["linear_ms"]) / n
            row["python_ms"] = np.mean(steps) - sums["call_ms"] / n
            row |= {f"{name}_ms_per_iteration": sums[name] / iterations for name in FUNCTIONS}
            row["floor_ms"] = floor(mpc, 5 if args.quick else 200) * iterations / n
        rows.append({k: round(float(v), 4) if isinstance(v, float) else v for k, v in row.items()} | {"machine": cells.machine()})
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
    shipped, rows = cstr.SCENARIOS["mpc"], []
    starts = envs.sample_states(cstr, np.random.default_rng([args.seed, 6]), args.episodes)
    for axis, n, k in tqdm(todo, desc="scaling", disable=None):
        cstr.SCENARIOS["mpc"] = grid(k)
        try:
            mpc = deploy.build_controller("rl_mpc", deploy.Args(horizon=n, critic=CRITIC, compile=not args.quick))
        finally:
            cstr.SCENARIOS["mpc"] = shipped
        log = []
        for x in starts:
            mpc.reset()
            mpc.make_step(x)
            log.append((mpc.stats["wall_ms"], mpc.stats["iterations"]))
        ms, iterations = np.transpose(log)
        rows.append({"axis": axis, "horizon": n, "scenarios": k * k, "nodes": sum(mpc.nodes[1:]), "variables": mpc.nlp["x"].numel(),
                     "ms_median": round(np.median(ms), 3), "iterations_median": np.median(iterations),
                     "ms_per_iteration": round(np.median(ms / iterations), 4), "machine": cells.machine()})  # fmt: skip
    return rows


def exponent(rows, size):
    """Slope of log time per iteration over log size, least squares, beyond the smallest problem."""
    x, y = (np.log([float(row[key]) for row in rows]) for key in (size, "ms_per_iteration"))
    return np.polyfit(x[1:], y[1:], 1)[0] if len(x) > 2 else np.nan


def plot(where_rows, scaling_rows, path):
    fig, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained", width_ratios=(1.5, 1, 1))
    for y, row in enumerate(where_rows):
        left = 0.0
        for key, (label, colour) in PARTS.items():
            share = 100 * float(row[key]) / float(row["step_ms_mean"])
            axes[0].barh(y, share, left=left, color=colour, label=label if y == 0 else None)
            left += share
        axes[0].plot(2 * [100 * float(row["floor_ms"]) / float(row["step_ms_mean"])], [y - 0.4, y + 0.4], color="black", lw=2,
                     label="floor: bare evaluations" if y == 0 else None)  # fmt: skip
    axes[0].set_yticks(range(len(where_rows)), [f"{row['controller']}\nmean {float(row['step_ms_mean']):.1f} ms" for row in where_rows])
    axes[0].invert_yaxis()
    axes[0].set(xlabel="share of a step [%]", xlim=(0, 100))
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    for ax, axis, size in ((axes[1], "horizon", "horizon"), (axes[2], "scenarios", "scenarios")):
        mine = [row for row in scaling_rows if row["axis"] == axis]
        x, y = (np.array([float(row[key]) for row in mine]) for key in (size, "ms_per_iteration"))
        ax.plot(x, y, "o-", color="#0072B2", label="measured")
        ax.plot(x, y[-1] * x / x[-1], ls=":", color="black", label="proportional")
        ax.set(xscale="log", yscale="log", xlabel={"horizon": "horizon N (9 scenarios)", "scenarios": "scenarios (N = 5)"}[axis],
               ylabel="time per iteration [ms]")  # fmt: skip
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
    where_rows, scaling_rows = (cells.read(args.out / f"results/solve_time_{name}.csv") for name in ("where", "scaling"))
    for row in where_rows:
        print(
            f"{row['controller']}: {float(row['step_ms_mean']):.2f} ms per step in the mean, {float(row['iterations_mean']):.1f} iterations"
        )
        for key, (label, _) in PARTS.items():
            print(f"    {label:28s}{float(row[key]):8.2f} ms{100 * float(row[key]) / float(row['step_ms_mean']):6.0f} %")
        print(f"    {'floor: bare evaluations':28s}{float(row['floor_ms']):8.2f} ms")
    for axis, size in (("horizon", "horizon"), ("scenarios", "scenarios")):
        mine = [row for row in scaling_rows if row["axis"] == axis]
        print(f"{axis}: " + ", ".join(f"{row[size]}: {float(row['ms_per_iteration']):.2f}" for row in mine)
              + f" ms per iteration; exponent {exponent(mine, size):.2f}")  # fmt: skip
    plot(where_rows, scaling_rows, args.out / "figures/solve_time.png")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
