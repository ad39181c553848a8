"""Time near goal against time outside constraints: what every controller of the reactor trades, and what is possible.

    python experiments/reactor/deploy.py --jobs 2 && python experiments/reactor/oracle.py --jobs 2   # first: points, and the oracle's curve
    python experiments/reactor/frontier.py --jobs 2      # a quarter of an hour; continues where it stopped
    python experiments/reactor/frontier.py --plot-only   # redraw from the committed CSVs

RL+MPC's slack weight is swept, which is its weight between value and constraints, at N = 1, 5 and 10 with the constraint-aware critic and
at N = 5 with the paper's, on the draws of deploy.py. Writes results/cstr_frontier.csv (a row per setting and draw) and
figures/cstr_frontier.png; every point there is of the same draws.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common
from experiments.common import grouped, select
from experiments.palette import BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY
from experiments.reactor import loops
from experiments.reactor.deploy import AWARE, PAPER, RL_MPC, summary

WEIGHTS = (0.3, 1.0, 2.0, 3.0, 5.0, 10.0, 30.0)
CURVES = {  # label: (colour, marker, keywords of rl_mpc_deploy.Args)
    "RL+MPC, N = 1": (SKY, "s", RL_MPC | AWARE | dict(horizon=1)),
    "RL+MPC, N = 5": (GREEN, "o", RL_MPC | AWARE | dict(horizon=5)),
    "RL+MPC, N = 10": (BLUE, "D", RL_MPC | AWARE | dict(horizon=10)),
    "RL+MPC, N = 5, paper's critic": (PINK, "v", RL_MPC | PAPER | dict(horizon=5)),
}
POINTS = {  # of cstr_deploy.csv: (colour, marker, name)
    "nominal MPC, N = 20": (GREY, "P", "nominal MPC"),
    "robust MPC, N = 20": (BLUE, "X", "robust MPC, N = 20"),
    "robust MPC, tuned": (BLUE, "*", "robust MPC, tuned, N = 40"),
    "goal-conditioned MPC, N = 5": (ORANGE, "P", "goal-conditioned MPC, N = 5"),
    "RL, constraint-aware": (RED, "^", "RL, constraint-aware"),
    "RL+MPC, constraint-aware, N = 0": (GREEN, "P", "RL+MPC, N = 0"),
    "RL+MPC, constraint-aware, N = 5, hard": (GREEN, "*", "RL+MPC, N = 5, hard"),
    "RL, paper's": (RED, "v", "RL, paper's"),
    "RL+MPC, paper's, N = 0": (PINK, "P", "RL+MPC, N = 0, paper's critic"),
}
# what the figure shows, with where its name stands in the panel of medians and of 5th percentiles
DRAWN = {
    "oracle": ((-5, 92.6), (-7.2, 86)),
    "RL+MPC, N = 5": ((0.3, 83.2), (-6, 74)),
    "RL+MPC, N = 5, paper's critic": ((-70, 79), (-100, 60)),
    "robust MPC, N = 20": ((0.25, 74.8), (-9, 11)),
    "robust MPC, tuned, N = 40": ((0.25, 77.5), (-9, 48)),
    "RL, constraint-aware": ((0.25, 79.5), (-7.2, 62)),
    "RL, paper's": ((-110, 90.2), (-100, 71)),
}


# where slack weights stand beside their marks: right of them or not, and how far, points
LABELS_AT = {"RL+MPC, N = 5": (True, 6, 3), "RL+MPC, N = 5, paper's critic": (False, -7, -3)}
BLIND = "RL+MPC, N = 5, paper's critic"
CROWDED = {(BLIND, 0, "2"), (BLIND, 1, "2"), (BLIND, 1, "0.3")}  # curve, panel and weight


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 25
    """paired draws, at most as many as deploy.py had"""


def plot(args):
    rows = common.read(args.table("cstr_frontier"))
    draws = {(row["seed"], row["episode"]) for row in rows}
    fig, axes = common.subplots(1, 2, figsize=(10, 5.2))
    for ax, title in zip(axes, ("medians", "5th percentiles")):
        ax.set(
            title=title, xlabel="time outside constraints [steps], 0 is best", ylabel="time near goal [steps]"
        )
        ax.set_xscale("symlog", linthresh=1)
        ax.set_xlim(-120, 30 if title == "medians" else -2.5)
        ax.set_ylim((65, 95) if title == "medians" else (-3, 90))
        ticks = [-100, -30, -10, -3, -1, 0]
        ax.set_xticks(ticks, ticks)
        ax.grid(alpha=0.3)
    print(f"{len(draws)} draws{'':36s}near goal: median  5 %-ile   outside: median  5 %-ile")

    def draw(groups, label, colour, marker, weights=("",), ls="-"):
        """Draw a curve, a group of rows per slack weight, or a single point without one."""
        points = [summary(group) for group in groups]
        size = 9 if len(points) == 1 else 6
        for k, ax in enumerate(axes) if label in DRAWN else ():
            x, y = [p[1][k] for p in points], [p[0][k] for p in points]
            ax.plot(x, y, marker=marker, color=colour, ls=ls, ms=size, lw=1.5)
            name = label.replace(", paper's", ",\npaper's")
            ax.text(*DRAWN[label][k], name, color=colour, fontsize=9, va="center")
            right, dx, dy = LABELS_AT.get(label, (False, -5, 3))
            for weight, *at in zip(weights, x, y):
                if weight in (weights[0], "2", weights[-1]) and (label, k, weight) not in CROWDED:
                    style = dict(fontsize=7, color=colour, ha="left" if right else "right", va="center")
                    ax.annotate(weight, at, xytext=(dx, dy), textcoords="offset points", **style)
        for weight, ((near, near_low), (outside, outside_low)) in zip(weights, points):
            text = f"{label}, slack weight {weight}" if weight else label
            print(f"{text:46s}{near:14.1f}{near_low:9.1f}{outside:18.1f}{outside_low:9.1f}")

    def of_these_draws(name):
        return [row for row in common.read(args.table(name)) if (row["seed"], row["episode"]) in draws]

    def curve(rows, by, *style):
        groups = {weight: group for weight, group in grouped(rows, by).items() if len(group) == len(draws)}
        draw(groups.values(), *style, [f"{float(weight):g}" for weight in groups])

    curve(of_these_draws("cstr_oracle"), "weight", "oracle", "black", "h")
    for label, (colour, marker, _) in CURVES.items():
        mine = [row for row in rows if row["variant"].rpartition(", slack weight ")[0] == label]
        curve(mine, "slack_weight", label, colour, marker)
    controllers = of_these_draws("cstr_deploy")
    for variant, (colour, marker, label) in POINTS.items():
        draw([select(controllers, variant=variant)], label, colour, marker, ls="none")
    common.save(fig, args.figure("cstr_frontier"))


def main(args):
    common.check(args, "cstr_frontier", episodes=(1, 10**6))
    for name in ("deploy", "oracle"):
        table = args.table(f"cstr_{name}")
        if not table.exists():
            common.fail(f"{table} does not exist; run python experiments/reactor/{name}.py first")
    if not args.plot_only:
        variants = {
            f"{label}, slack weight {weight:g}": options | dict(slack_weight=weight)
            for label, (_, _, options) in CURVES.items()
            for weight in (WEIGHTS[:2] if args.quick else WEIGHTS)
        }
        common.write(loops.table(loops.collect(variants, args)), args.table("cstr_frontier"))
    plot(args)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
