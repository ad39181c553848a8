"""Figure `dip_performance`: expert, quadratic and goal-conditioned MPC on the double pendulum's swing-up, from ten starts near 0.9 pi.

    python experiments/pendulum/performance.py               # a quarter of an hour on one core; continues, cell by cell, where it stopped
    python experiments/pendulum/performance.py --plot-only   # redraw from the committed CSV

The first guess is the start state held, as in the authors' scripts, or (guide 75) the simulated closed loop of the same controller with
N = 75. Writes results/dip_performance.csv (a row per controller and start, columns of goal_mpc.py) and figures/dip_performance.png.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
from experiments import common
from experiments.common import column, grouped, select
from experiments.palette import BLUE, GREEN, ORANGE

double_pendulum = envs.load("double_pendulum")
OBJECTIVES = {"expert": (GREEN, "s"), "quadratic": (ORANGE, "^"), "goal": (BLUE, "o")}
GUIDED = (25, 0), (75, 0), (300, 75), (300, 0)  # horizon of the controller and of its guide
PANELS = {"time_near_goal": "time near goal [steps]", "action_total_variation": "action total variation [N]"}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 10
    """starts, of seeds in a row: both angles 0.9 pi plus up to 0.05 rad each"""
    jobs: int = 1
    """processes; more than one per core disturbs the solve times"""


class Guided(gm.ScenarioMPC):
    """An episode starts from the simulated closed loop of another controller, of a shorter horizon."""

    guide = None

    def first_guesses(self, x0):
        if self.guide is not None and self.plan is None:
            self.guide.reset(self.u_before)
            yield self.rolled_out(x0, lambda t, x: self.guide.make_step(x))
        yield from super().first_guesses(x0)


def run(cell):
    """One controller from every start; rows of results.csv with the guide's horizon."""
    settings, guide_horizon = cell
    mpc, goals, rows = gm.build_controller(settings, Guided), np.zeros((settings.steps, 2)), []
    mpc.guide = gm.build_controller(replace(settings, horizon=guide_horizon)) if guide_horizon else None
    for seed in range(settings.seed, settings.seed + settings.episodes):
        x0, psi = gm.start_and_plant(double_pendulum, seed, random_plant=False)
        x, u, _, log = gm.simulate(mpc, x0, psi, goals)
        head = {key: getattr(settings, key) for key in ("env", "objective", "horizon")}
        head |= {"guide_horizon": guide_horizon, "seed": seed, "first_solve_ms": round(log[0]["wall_ms"], 6)}
        rows.append(head | gm.summary(double_pendulum, x, u, goals, log))
    return rows


def collect(args):
    few = dict(episodes=2, steps=5, compile=False) if args.quick else dict(episodes=args.episodes)
    work = []
    for horizon, guide in GUIDED:
        if args.quick:
            horizon, guide = horizon // 25, guide // 25
        for objective in OBJECTIVES:
            work.append((gm.Args(objective=objective, horizon=horizon, seed=args.seed, **few), guide))
    return common.collect(run, work, args.runs, args.jobs)


def plot(rows, path):
    columns = list(grouped(rows, "horizon", "guide_horizon"))
    variation = {}  # (objective, column): median
    fig, axes = common.subplots(2, 1, figsize=(8, 5.6), sharex=True)
    head = f"{'objective':10s}{'N':>5s}{'guide':>6s}{'near goal: median [min, max]':>32s}"
    head += f"{'action TV: median [min, max]':>32s}{'ms median':>11s}{'p95':>8s}{'worst':>9s}{'failed':>8s}"
    print(head)
    for order, (objective, (colour, marker)) in enumerate(OBJECTIVES.items()):
        for position, (horizon, guide) in enumerate(columns):
            mine = select(rows, objective=objective, horizon=horizon, guide_horizon=guide)
            at = position + 0.25 * (order - 1)
            text = f"{objective:10s}{horizon:>5s}{guide:>6s}"
            for ax, key in zip(axes, PANELS):
                values, label = column(mine, key), objective if not position else None
                jitter = np.random.default_rng(0).uniform(-0.06, 0.06, len(values))
                ax.plot(at + jitter, values, marker, color=colour, ms=4, alpha=0.5)
                ax.plot([at - 0.1, at + 0.1], [np.median(values)] * 2, color=colour, lw=3, label=label)
                text += f"{np.median(values):16.1f} [{values.min():5.1f}, {values.max():5.1f}]"
            variation[objective, position] = np.median(column(mine, "action_total_variation"))
            median, p95, worst = (column(mine, f"solve_ms_{key}") for key in ("median", "p95", "max"))
            failed = column(mine, "solver_failures").sum()
            print(f"{text}{np.median(median):11.1f}{np.median(p95):8.1f}{worst.max():9.0f}{failed:8.0f}")
    print_variation(variation)
    guesses = {guide: f"closed loop, N = {guide}" for _, guide in columns} | {"0": "start held"}
    labels = [f"N = {horizon}\nfirst guess:\n{guesses[guide]}" for horizon, guide in columns]
    axes[1].set_xticks(range(len(columns)), labels)
    for ax, title in zip(axes, PANELS.values()):
        ax.set_ylabel(title)
        ax.set_ylim(bottom=0)
        ax.grid(axis="y", alpha=0.3)
    axes[0].set_title(f"{len(mine)} starts per controller; bars: medians", fontsize=10)
    common.legend(fig, axes[0], ncols=3, fontsize=10)
    common.save(fig, path)


def print_variation(variation):
    """What the paper says of the medians of action variation, {(objective, column): median}."""
    share = {name: variation["expert", 1] / variation[name, 1] for name in ("quadratic", "goal")}
    fall = {name: 1 - variation[name, 2] / variation[name, 0] for name in ("quadratic", "goal")}
    print(
        f"expert's variation in the second column: {share['quadratic']:.2f} of the quadratic agent's, "
        f"{share['goal']:.2f} of the goal-conditioned agent's; "
        f"fall from the first column to the third: quadratic {fall['quadratic']:.0%}, goal {fall['goal']:.0%}"
    )


def main(args):
    common.check(args, "dip_performance", episodes=(1, 1000))
    if not args.plot_only:
        common.write(collect(args), args.table("dip_performance"))
    plot(common.read(args.table("dip_performance")), args.figure("dip_performance"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
