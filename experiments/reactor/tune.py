"""The robust benchmark MPC with its weights tuned, under both solvers, so that RL+MPC is not compared with a straw man.

    python experiments/reactor/tune.py --jobs 2        # three quarters of an hour; continues where it stopped

A grid over the prices of soft constraints (every bound soft, where the published benchmark has hard ones), the penalty of input changes and
the horizon, on draws of their own, by the planner of rl_mpc_deploy.py and by IPOPT. The best of each, by the sum of the paper's two
measures, is `TUNED` or `TUNED_IPOPT`. Writes results/cstr_tune.csv, a row per setting, and prints it in order.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from envs import cstr
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import loops

# per mol/l and per degC, summed over scenarios as the published ones
PRICES = ((0.01, 1.0), (0.03, 1.0), (0.1, 1.0), (1.0, 1.0), (10.0, 10.0))
CHANGES = (1.0, 0.1)  # times the published weights


@dataclass
class Args:
    episodes: int = 16
    """paired draws"""
    seed: int = 1
    """seed of the draws; the comparison has seed 0"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps for two settings: a smoke test"""
    plot_only: bool = False
    """print the table of the CSV"""
    runs: Path = Path("runs/cstr_loops")
    """where finished blocks are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ is written"""


def settings(prices, change, horizon):
    """Items that replace those of the plant's BENCHMARK."""
    slack_price = ((prices[0], prices[0], prices[1], prices[1]),) * 2  # below and above
    return (
        ("slack_price", slack_price),
        ("change_weight", tuple((change * cstr.BENCHMARK["change_weight"]).tolist())),
        ("horizon", horizon),
    )


GRID = {"published": ()} | {
    f"{prices[0]:g} per mol/l, {prices[1]:g} per degC, changes x {change:g}, N = {horizon}": settings(
        prices, change, horizon
    )
    for prices, change, horizon in [(p, change, 20) for p in PRICES for change in CHANGES]
    + [(p, 0.1, 40) for p in PRICES]
}
SOLVERS = {"anytime": "", "IPOPT": "ipopt"}  # name in the table: `like` of cstr_loops.py
TUNED = settings(prices=(1.0, 1.0), change=0.1, horizon=40)
TUNED_IPOPT = settings(prices=(0.1, 1.0), change=0.1, horizon=40)


def main(args):
    cells.check(args, "cstr_tune.csv", episodes=(1, 10**6), seed=(0, 10**9), jobs=(1, 1024))
    table = args.out / "results/cstr_tune.csv"
    if not args.plot_only:
        grid = dict(list(GRID.items())[:2]) if args.quick else GRID
        variants = {
            f"{label} | {solver}": dict(controllers=("robust_mpc",), benchmark=benchmark, like=like)
            for solver, like in SOLVERS.items()
            for label, benchmark in grid.items()
        }
        rows, found = loops.collect(variants, args), []
        for label in variants:
            columns = ("time_near_goal", "time_outside_constraints", "solve_ms_median")
            near, outside, ms = (loops.values(rows, label, column) for column in columns)
            variant, solver = label.split(" | ")
            found.append(
                {
                    "solver": solver,
                    "variant": variant,
                    "draws": len(near),
                    "near_median": np.median(near),
                    "near_mean": near.mean(),
                    "near_p5": np.quantile(near, 0.05),
                    "outside_median": np.median(outside),
                    "outside_mean": outside.mean(),
                    "outside_p5": np.quantile(outside, 0.05),
                    "score": (near + outside).mean(),
                    "ms": np.median(ms),
                }
            )
        cells.write(
            [{k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in found], table
        )
    for row in sorted(cells.read(table), key=lambda row: -float(row["score"])):
        head = f"{row.pop('solver'):8s}{row.pop('variant'):52s}"
        print(head, *(f"{key} {float(value):.1f}" for key, value in row.items()), sep="  ")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
