"""The robust benchmark MPC with its weights tuned, under both solvers, so that RL+MPC is not compared with a straw man.

    python experiments/reactor/tune.py --jobs 2        # a quarter of an hour; continues where it stopped

A grid over the prices of soft constraints (every bound soft, where the published benchmark has hard ones) and the horizon, input changes a
tenth as dear as published, on draws of their own, by the planner of rl_mpc_deploy.py and, on the first half of the draws, by IPOPT. The
best of each, by the sum of the paper's two measures, is `TUNED` or `TUNED_IPOPT`. Writes results/cstr_tune.csv, a row per setting, and
prints it in order.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from envs import cstr
from experiments import common
from experiments.common import column, rounded
from experiments.reactor import loops

# per mol/l and per degC, summed over scenarios as the published ones
PRICES = ((0.03, 1.0), (0.1, 1.0), (1.0, 1.0), (10.0, 10.0))


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    seed: int = 1
    """of the draws; the comparison has seed 0"""
    episodes: int = 16
    """paired draws; IPOPT, thirty times as slow, has the first half of them"""


def settings(prices, horizon):
    """Items that replace those of the plant's BENCHMARK."""
    slack_price = ((prices[0], prices[0], prices[1], prices[1]),) * 2  # below and above
    change_weight = tuple((0.1 * cstr.BENCHMARK["change_weight"]).tolist())
    return ("slack_price", slack_price), ("change_weight", change_weight), ("horizon", horizon)


LABEL = "{:g} per mol/l, {:g} per degC, N = {}"
GRID = {"published": ()} | {LABEL.format(*p, N): settings(p, N) for N in (20, 40) for p in PRICES}
SOLVERS = {"anytime": "", "IPOPT": "ipopt"}  # name in the table: `like` of loops.py
TUNED = settings(prices=(1.0, 1.0), horizon=40)
TUNED_IPOPT = settings(prices=(0.1, 1.0), horizon=40)


def summary(rows, label):
    """The row of one setting under one solver."""
    columns = ("time_near_goal", "time_outside_constraints", "solve_ms_median")
    near, outside, ms = (column(rows, key, variant=label) for key in columns)
    variant, solver = label.split(" | ")
    row = {"solver": solver, "variant": variant, "draws": len(near)}
    for name, values in (("near", near), ("outside", outside)):
        row |= {f"{name}_median": np.median(values), f"{name}_mean": values.mean()}
        row |= {f"{name}_p5": np.quantile(values, 0.05)}
    return rounded(row | {"score": (near + outside).mean(), "ms": np.median(ms)}, 4)


def main(args):
    common.check(args, "cstr_tune", episodes=(1, 10**6))
    if not args.plot_only:
        grid = dict(list(GRID.items())[:2]) if args.quick else GRID
        found = []
        for (solver, like), episodes in zip(SOLVERS.items(), (args.episodes, (args.episodes + 1) // 2)):
            variants = {
                f"{label} | {solver}": dict(controllers=("robust_mpc",), benchmark=benchmark, like=like)
                for label, benchmark in grid.items()
            }
            rows = loops.collect(variants, args, episodes)
            found += [summary(rows, label) for label in variants]
        common.write(found, args.table("cstr_tune"))
    for row in sorted(common.read(args.table("cstr_tune")), key=lambda row: -float(row["score"])):
        head = f"{row.pop('solver'):8s}{row.pop('variant'):52s}"
        print(head, *(f"{key} {float(value):.1f}" for key, value in row.items()), sep="  ")


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
