"""Learning curves and final evaluations of the reactor's agents over seeds (the paper's figure `cstr_offlineagent`, in numbers).

Runs sac_her_branching.py, with its default arguments, once per seed and scenario set.

    python experiments/reactor/training.py --seeds 10 --jobs 2     # about 15 minutes on two cores; continues where it stopped
    python experiments/reactor/training.py --plot-only             # redraw from the committed CSV

Writes results/cstr_training.csv (an evaluation per row), results/cstr_training_seeds.csv (a run per row, with wall time and
machine) and figures/cstr_training.png.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import trim_mean

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common
from experiments.common import column, grouped, select
from experiments.palette import BLUE, ORANGE

AGENTS = {"robust": (BLUE, "-"), "nominal": (ORANGE, "--")}  # scenarios: colour, dashes
QUICK = dict(total_timesteps=3000, eval_every=1000)


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    seeds: int = 10
    """training seeds per agent"""


def collect(args):
    """An evaluation per row, and the last one of each run with what `common.train` noted."""
    seeds = range(args.seed, args.seed + (min(args.seeds, 2) if args.quick else args.seeds))
    agents = [{"scenarios": scenarios, "seed": seed} for seed in seeds for scenarios in AGENTS]
    settings = [agent | (QUICK if args.quick else {}) for agent in agents]
    curves, finals = [], []
    for agent, folder in zip(agents, common.train(settings, args.runs, args.jobs)):
        rows = common.read(folder / "evaluations.csv")
        curves += [{"env": "cstr"} | agent | row for row in rows]
        finals.append(curves[-1] | common.record(folder))
    return curves, finals


def plot(curves, finals, path):
    fig, axes = common.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for ax, evaluation in zip(axes, ("robust", "nominal")):
        for scenarios, (colour, dashes) in AGENTS.items():
            by_step = grouped(select(curves, scenarios=scenarios), "step")
            values = np.array([column(rows, f"{evaluation}_median_ape") for rows in by_step.values()])
            steps = np.array(list(map(int, by_step))) / 1000
            middle, label = trim_mean(values, 0.25, axis=1), f"{scenarios} agent"
            ax.plot(steps, middle, color=colour, lw=2, ls=dashes, label=label)
            ax.fill_between(steps, values.min(1), values.max(1), color=colour, alpha=0.2, lw=0)
        ax.set(yscale="log", xlabel="transitions [thousands]", title=f"{evaluation} evaluation")
        ax.yaxis.set_major_formatter("{x:g}")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("median absolute percentage error of $c_B$")
    axes[0].legend(frameon=False, title=f"interquartile mean and range, {len(finals) // 2} seeds")
    common.save(fig, path)


def print_table(finals):
    print("interquartile mean over seeds [95 % bootstrap interval] (range)")
    for scenarios in AGENTS:
        for key in ("robust_median_ape", "robust_held_out_median_ape", "nominal_median_ape", "wall_seconds"):
            print(f"{scenarios:8s} {key:28s} {common.iqm_text(column(finals, key, scenarios=scenarios))}")


def main(args):
    common.check(args, "cstr_training", seeds=(1, 1000))
    tables = args.table("cstr_training"), args.table("cstr_training_seeds")
    if not args.plot_only:
        for rows, table in zip(collect(args), tables):
            common.write(rows, table)
    curves, finals = map(common.read, tables)
    plot(curves, finals, args.figure("cstr_training"))
    print_table(finals)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
