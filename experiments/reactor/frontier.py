"""Time near goal against time outside constraints: what every controller of the reactor trades, and what is possible.

    python experiments/reactor/deploy.py --jobs 2 && python experiments/reactor/oracle.py --jobs 2   # first: points, and the oracle's curve
    python experiments/reactor/frontier.py --jobs 2      # a quarter of an hour; continues where it stopped
    python experiments/reactor/frontier.py --plot-only   # redraw from the committed CSVs

RL+MPC's slack weight is swept, which is its weight between value and constraints, at N = 1, 5 and 10 with the constraint-aware critic and
at N = 5 with the paper's, on the draws of cstr_deploy.py. Writes results/cstr_frontier.csv (a row per setting and draw) and
figures/cstr_frontier.png; every point there is of the same draws.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import loops
from experiments.reactor.deploy import AWARE, PAPER, RL_MPC, summary

WEIGHTS = (0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0)
CURVES = {  # label: (colour, marker, keywords of cstr_loops)
    "RL+MPC, N = 1": ("#56B4E9", "s", RL_MPC | AWARE | dict(horizon=1)),
    "RL+MPC, N = 5": ("#009E73", "o", RL_MPC | AWARE | dict(horizon=5)),
    "RL+MPC, N = 10": ("#0072B2", "D", RL_MPC | AWARE | dict(horizon=10)),
    "RL+MPC, N = 5, paper's critic": ("#CC79A7", "v", RL_MPC | PAPER | dict(horizon=5)),
}
POINTS = {  # of cstr_deploy.csv: (colour, marker, name)
    "nominal MPC, N = 20": ("#999999", "P", "nominal MPC"),
    "robust MPC, N = 20": ("#999999", "X", "robust MPC"),
    "robust MPC, tuned": ("#999999", "*", "robust MPC, tuned"),
    "goal-conditioned MPC, N = 5": ("#E69F00", "P", "goal-conditioned MPC, N = 5"),
    "RL, constraint-aware": ("#D55E00", "^", "RL, constraint-aware"),
    "RL+MPC, constraint-aware, N = 0": ("#009E73", "P", "RL+MPC, N = 0"),
    "RL+MPC, constraint-aware, N = 5, hard": ("#009E73", "*", "RL+MPC, N = 5, hard"),
    "RL, paper's": ("#D55E00", "v", "RL, paper's"),
    "RL+MPC, paper's, N = 0": ("#CC79A7", "P", "RL+MPC, N = 0, paper's critic"),
}


@dataclass
class Args:
    episodes: int = 50
    """paired draws, at most as many as cstr_deploy.py had"""
    seed: int = 0
    """seed of the draws, that of cstr_deploy.py and cstr_oracle.py"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps, two weights: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSVs"""
    runs: Path = Path("runs/cstr_loops")
    """where finished blocks are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def plot(args):
    rows = cells.read(args.out / "results/cstr_frontier.csv")
    draws = {(row["seed"], row["episode"]) for row in rows}
    fig, axes = plt.subplots(1, 2, figsize=(10, 5.2), layout="constrained")
    for ax, title in zip(axes, ("medians", "5th percentiles")):
        ax.set(
            xlabel="time outside constraints [steps], 0 is best", ylabel="time near goal [steps]", title=title
        )
        ax.set_xscale("symlog", linthresh=1)
        ax.set_xlim(-120, 0.3 if title == "medians" else -5)
        ax.set_xticks([-100, -30, -10, -3, -1, 0], ["-100", "-30", "-10", "-3", "-1", "0"])
        ax.grid(alpha=0.3)
    print(f"{len(draws)} draws{'':36s}near goal: median  5 %-ile   outside: median  5 %-ile")

    def draw(groups, label, colour, marker, names=None, ls="-"):
        points = [summary(group) for group in groups]
        for ax, k in zip(axes, (0, 1)):
            size = 9 if len(points) == 1 else 6
            ax.plot(
                [p[1][k] for p in points],
                [p[0][k] for p in points],
                marker=marker,
                color=colour,
                ls=ls,
                ms=size,
                lw=1.5,
                label=label,
            )
            for name, p in zip(names or [], points):
                if name not in (names[0], "2", names[-1]):
                    continue
                ax.annotate(
                    name,
                    (p[1][k], p[0][k]),
                    xytext=(4, 4),
                    textcoords="offset points",
                    fontsize=7,
                    color=colour,
                )
        for name, ((near, near_low), (outside, outside_low)) in zip(names or [""], points):
            text = f"{label}{', slack weight ' if name else ''}{name}"
            print(f"{text:46s}{near:14.1f}{near_low:9.1f}{outside:18.1f}{outside_low:9.1f}")

    oracle = [
        row
        for row in cells.read(args.out / "results/cstr_oracle.csv")
        if (row["seed"], row["episode"]) in draws
    ]
    by_weight = {}
    for row in oracle:
        by_weight.setdefault(row["weight"], []).append(row)
    by_weight = {weight: group for weight, group in by_weight.items() if len(group) == len(draws)}
    draw(by_weight.values(), "oracle", "black", "h", [f"{float(weight):g}" for weight in by_weight])
    for label, (colour, marker, _) in CURVES.items():
        groups = {}
        for row in rows:
            if row["variant"].rpartition(", slack weight ")[0] == label:
                groups.setdefault(row["slack_weight"], []).append(row)
        draw(groups.values(), label, colour, marker, [f"{float(weight):g}" for weight in groups])
    controllers = [
        row
        for row in cells.read(args.out / "results/cstr_deploy.csv")
        if (row["seed"], row["episode"]) in draws
    ]
    for variant, (colour, marker, label) in POINTS.items():
        draw([[row for row in controllers if row["variant"] == variant]], label, colour, marker, ls="none")
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    (args.out / "figures").mkdir(parents=True, exist_ok=True)
    fig.savefig(args.out / "figures/cstr_frontier.png", dpi=150)


def main(args):
    cells.check(args, "cstr_frontier.csv", episodes=(1, 10**6), seed=(0, 10**9), jobs=(1, 1024))
    for needed in ("cstr_deploy", "cstr_oracle"):
        if not (args.out / f"results/{needed}.csv").exists():
            cells.fail(
                f"{args.out / 'results' / needed}.csv does not exist; run python experiments/{needed}.py first"
            )
    if not args.plot_only:
        variants = {
            f"{label}, slack weight {weight:g}": options | dict(slack_weight=weight)
            for label, (_, _, options) in CURVES.items()
            for weight in (WEIGHTS[:2] if args.quick else WEIGHTS)
        }
        cells.write(loops.table(loops.collect(variants, args)), args.out / "results/cstr_frontier.csv")
    plot(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
