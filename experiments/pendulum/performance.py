"""Figure `dip_performance`: expert, quadratic and goal-conditioned MPC on the double pendulum's swing-up, from ten starts near 0.9 pi.

    python experiments/pendulum/performance.py               # a quarter of an hour on one core; continues, cell by cell, where it stopped
    python experiments/pendulum/performance.py --plot-only   # redraw from the committed CSV

The first guess is the start state held, as in the authors' scripts, or (guide 75) the simulated closed loop of the same controller with
N = 75. Writes results/dip_performance.csv (a row per controller and start, columns of goal_mpc.py) and figures/dip_performance.png.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import goal_mpc as gm
from envs import double_pendulum
from experiments import common as cells
from experiments.common import HERE

CELLS = [
    (objective, horizon, guide)
    for horizon, guide in ((25, 0), (75, 0), (300, 75), (300, 0))
    for objective in ("expert", "quadratic", "goal")
]
COLOURS = {"expert": "#009E73", "quadratic": "#E69F00", "goal": "#0072B2"}  # Okabe and Ito
MARKERS = {"expert": "s", "quadratic": "^", "goal": "o"}


@dataclass
class Args:
    episodes: int = 10
    """starts: both angles 0.9 pi plus up to 0.05 rad each"""
    seed: int = 0
    """seed of the first start"""
    jobs: int = 1
    """processes; more than one per core disturbs the solve times"""
    quick: bool = False
    """2 starts of 5 steps with short horizons: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/dip_performance")
    """where finished cells are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


class Guided(gm.ScenarioMPC):
    """An episode starts from the simulated closed loop of another controller, of a shorter horizon."""

    guide = None

    def first_guesses(self, x0):
        if self.guide is not None and self.plan is None:
            self.guide.reset(self.u_before)
            yield self.rolled_out(x0, lambda t, x: self.guide.make_step(x))
        yield from super().first_guesses(x0)


def run_cell(cell):
    """One controller from every start; rows of results.csv with the guide's horizon."""
    settings, guide_horizon = cell
    mpc, goals, rows = gm.build_controller(settings, Guided), np.zeros((settings.steps, 2)), []
    mpc.guide = gm.build_controller(replace(settings, horizon=guide_horizon)) if guide_horizon else None
    for seed in range(settings.seed, settings.seed + settings.episodes):
        x0, psi = gm.start_and_plant(double_pendulum, seed, random_plant=False)
        x, u, _, log = gm.simulate(mpc, x0, psi, goals)
        head = {
            "env": settings.env,
            "objective": settings.objective,
            "horizon": settings.horizon,
            "guide_horizon": guide_horizon,
        }
        rows.append(
            head
            | {"seed": seed, "first_solve_ms": round(log[0]["wall_ms"], 6)}
            | gm.summary(double_pendulum, x, u, goals, log)
        )
    return rows


def collect(args):
    work = []
    for objective, horizon, guide in CELLS:
        settings = gm.Args(objective=objective, horizon=horizon, episodes=args.episodes, seed=args.seed)
        if args.quick:
            settings, guide = (
                replace(settings, horizon=horizon // 25, episodes=2, steps=5, compile=False),
                guide // 25,
            )
        work.append((settings, guide))
    inputs = [__file__, gm.__file__, gm.envs.__file__, double_pendulum.__file__]
    cells.write(
        cells.collect(run_cell, work, args.jobs, args.runs, inputs), args.out / "results/dip_performance.csv"
    )


def plot(args):
    rows = cells.read(args.out / "results/dip_performance.csv")
    panels = {
        "time_near_goal": "time near goal [steps]",
        "action_total_variation": "action total variation [N]",
    }
    columns = list(dict.fromkeys((row["horizon"], row["guide_horizon"]) for row in rows))
    variation = {}  # (objective, column): median
    fig, axes = plt.subplots(2, 1, figsize=(8, 5.6), sharex=True, layout="constrained")
    print(
        f"{'objective':10s}{'N':>5s}{'guide':>6s}{'near goal: median [min, max]':>32s}{'action TV: median [min, max]':>32s}"
        f"{'ms median':>11s}{'p95':>8s}{'worst':>9s}{'failed':>8s}"
    )
    for objective, colour in COLOURS.items():
        for position, (horizon, guide) in enumerate(columns):
            mine = [
                row
                for row in rows
                if (row["objective"], row["horizon"], row["guide_horizon"]) == (objective, horizon, guide)
            ]
            column = {
                key: np.array([float(row[key]) for row in mine])
                for key in mine[0]
                if key not in ("env", "objective")
            }
            at = position + 0.25 * (list(COLOURS).index(objective) - 1)
            line = f"{objective:10s}{horizon:>5s}{guide:>6s}"
            for ax, key in zip(axes, panels):
                values = column[key]
                jitter = np.random.default_rng(0).uniform(-0.06, 0.06, len(values))
                ax.plot(at + jitter, values, MARKERS[objective], color=colour, ms=4, alpha=0.5)
                ax.plot(
                    [at - 0.1, at + 0.1],
                    [np.median(values)] * 2,
                    color=colour,
                    lw=3,
                    label=objective if not position else None,
                )
                line += f"{np.median(values):16.1f} [{values.min():5.1f}, {values.max():5.1f}]"
            variation[objective, position] = np.median(column["action_total_variation"])
            times = (
                np.median(column["solve_ms_median"]),
                np.median(column["solve_ms_p95"]),
                column["solve_ms_max"].max(),
            )
            print(
                f"{line}{times[0]:11.1f}{times[1]:8.1f}{times[2]:9.0f}{column['solver_failures'].sum():8.0f}"
            )
    fall = {
        objective: 1 - variation[objective, 2] / variation[objective, 0]
        for objective in ("quadratic", "goal")
    }
    print(
        f"expert's variation in the second column: {variation['expert', 1] / variation['quadratic', 1]:.2f} of the quadratic agent's, "
        f"{variation['expert', 1] / variation['goal', 1]:.2f} of the goal-conditioned agent's; "
        f"fall from the first column to the third: quadratic {fall['quadratic']:.0%}, goal {fall['goal']:.0%}"
    )
    guesses = {"0": "start held"} | {
        guide: f"closed loop, N = {guide}" for _, guide in columns if guide != "0"
    }
    axes[1].set_xticks(
        range(len(columns)), [f"N = {horizon}\nfirst guess:\n{guesses[guide]}" for horizon, guide in columns]
    )
    for ax, title in zip(axes, panels.values()):
        ax.set_ylabel(title)
        ax.set_ylim(bottom=0)
        ax.grid(axis="y", alpha=0.3)
    axes[0].set_title(f"{len(mine)} starts per controller; bars: medians", fontsize=10)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    path = args.out / "figures/dip_performance.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)


def main(args):
    cells.check(args, "dip_performance.csv", episodes=(1, 1000), seed=(0, 10**9), jobs=(1, 1024))
    if not args.plot_only:
        collect(args)
    plot(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
