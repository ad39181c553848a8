"""The robust benchmark MPC with its weights tuned, so that RL+MPC is not compared with a straw man.

    python experiments/cstr_tune.py --jobs 2        # a quarter of an hour; continues where it stopped

A grid over the prices of soft constraints (every bound soft, where the published benchmark has hard ones), the penalty of input changes and
the horizon, on draws of their own. The best, by the sum of the paper's two measures, is `TUNED` in cstr_deploy.py. Writes
results/cstr_tune.csv, a row per setting, and prints it in order.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import cells
import cstr_loops as loops

from envs import cstr

PRICES = (
    (0.01, 1.0),
    (0.03, 1.0),
    (0.1, 1.0),
    (1.0, 1.0),
    (10.0, 10.0),
)  # per mol/l and per degC, summed over scenarios as the published ones
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
    f"{prices[0]:g} per mol/l, {prices[1]:g} per degC, changes x {change:g}, N = {horizon}": settings(prices, change, horizon)
    for prices, change, horizon in [(p, change, 20) for p in PRICES for change in CHANGES] + [(p, 0.1, 40) for p in PRICES[1:4]]
}


def main(args):
    cells.check(args, "cstr_tune.csv", episodes=(1, 10**6), seed=(0, 10**9), jobs=(1, 1024))
    table = args.out / "results/cstr_tune.csv"
    if not args.plot_only:
        variants = {label: dict(controllers=("robust_mpc",), benchmark=benchmark) for label, benchmark in GRID.items()}
        variants = dict(list(variants.items())[:2]) if args.quick else variants
        rows, found = loops.collect(variants, args), []
        for label in variants:
            near, outside = (loops.values(rows, label, k) for k in ("time_near_goal", "time_outside_constraints"))
            found.append({"variant": label, "draws": len(near), "near_median": np.median(near), "near_mean": near.mean(),
                          "near_p5": np.quantile(near, 0.05), "outside_median": np.median(outside), "outside_mean": outside.mean(),
                          "outside_p5": np.quantile(outside, 0.05), "score": (near + outside).mean()})  # fmt: skip
        cells.write([{k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in found], table)
    for row in sorted(cells.read(table), key=lambda row: -float(row["score"])):
        print(row.pop("variant").ljust(52), *(f"{key} {float(value):.1f}" for key, value in row.items()), sep="  ")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
