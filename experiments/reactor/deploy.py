"""Figures `cstr_rlmpc` and `full_cstr_rlmpc`: every controller of the reactor on paired draws of start state and plant.

    python experiments/reactor/deploy.py --jobs 2                   # 200 draws, a quarter of an hour; continues where it stopped
    python experiments/reactor/deploy.py --study critics --jobs 2   # the same claim with critics of other training seeds, which it trains
    python experiments/reactor/deploy.py --study ipopt --jobs 2     # the same problems solved by IPOPT
    python experiments/reactor/deploy.py --study literal --jobs 2   # the authors' conventions and eq:QMPC's sum beside ours, all by IPOPT
    python experiments/reactor/deploy.py --study branching --jobs 2 # trees that branch at none, one and two stages
    python experiments/reactor/deploy.py --plot-only                # redraw from the committed CSV

Writes results/cstr_deploy.csv (a row per controller and draw), figures/cstr_deploy.png and cstr_deploy_full.png; the other studies write
cstr_STUDY. How far each controller is from the best possible is said by oracle.py.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from experiments import common
from experiments.common import column, distinct, select
from experiments.reactor import loops
from experiments.reactor.loops import ACTOR, AWARE, PAPER, RL_MPC
from experiments.reactor.tune import TUNED, TUNED_IPOPT

NOMINAL, ROBUST = dict(controllers=("nominal_mpc",)), dict(controllers=("robust_mpc",))
IPOPT, ONE, HARD = dict(like="ipopt"), dict(iterations=1), dict(constraints="hard")
HORIZONS = (0, 1, 2, 5, 10)
DRAWS = {"deploy": 200, "critics": 50, "ipopt": 12}  # else 20
CONVENTIONS = {
    "this repository's problem": IPOPT,
    "slack summed over scenarios": IPOPT | dict(slack_weight=9.0),
    "sum as printed": dict(like="printed"),
    "as in the authors' stack": dict(like="literal"),
}
STUDIES = {  # label: keywords of rl_mpc_deploy.Args and of loops.Loop
    "deploy": {
        "nominal MPC, N = 20": NOMINAL,
        "robust MPC, N = 20": ROBUST,
        "robust MPC, tuned": ROBUST | dict(benchmark=TUNED),
        "goal-conditioned MPC, N = 5": dict(controllers=("goal_mpc",), slack_weight=2.0),
        "RL, paper's": ACTOR | PAPER,
        **{f"RL+MPC, paper's, N = {n}": RL_MPC | PAPER | dict(horizon=n) for n in HORIZONS},
        "RL+MPC, paper's, N = 5, one iteration": RL_MPC | PAPER | ONE,
        "RL, constraint-aware": ACTOR | AWARE,
        **{f"RL+MPC, constraint-aware, N = {n}": RL_MPC | AWARE | dict(horizon=n) for n in HORIZONS},
        "RL+MPC, constraint-aware, N = 5, one iteration": RL_MPC | AWARE | ONE,
        "RL+MPC, constraint-aware, N = 5, hard": RL_MPC | AWARE | HARD,
    },
    "ipopt": {
        "nominal MPC, N = 20, IPOPT": NOMINAL | IPOPT,
        "robust MPC, N = 20, IPOPT": ROBUST | IPOPT,
        f"robust MPC, tuned, N = {dict(TUNED_IPOPT)['horizon']}, IPOPT": ROBUST
        | IPOPT
        | dict(benchmark=TUNED_IPOPT),
        "RL+MPC, constraint-aware, N = 5, IPOPT": RL_MPC | AWARE | IPOPT,
        "RL+MPC, constraint-aware, N = 5, hard, IPOPT": RL_MPC | AWARE | IPOPT | HARD,
    },
    "literal": {
        f"{title}, N = {n}": RL_MPC | PAPER | dict(horizon=n) | options
        for n in (1, 2, 5)
        for title, options in CONVENTIONS.items()
    },
    "branching": {
        f"RL+MPC, constraint-aware, N = 5, robust horizon {n}": RL_MPC | AWARE | dict(robust_horizon=n)
        for n in range(3)
    },
}
MAIN = [
    "robust MPC, N = 20",
    "robust MPC, tuned",
    "RL, paper's",
    "RL+MPC, paper's, N = 5",
    "RL, constraint-aware",
    "RL+MPC, constraint-aware, N = 5",
]
KINDS = {"paper's": {}, "constraint-aware": dict(constraint_weight=3.0)}  # of agents, how they are trained
MEASURES = {
    "time_near_goal": "time near goal [steps]",
    "time_outside_constraints": "time outside constraints [steps]",
}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["deploy", "critics", "ipopt", "literal", "branching"] = "deploy"
    """deploy: the controllers against each other; critics: of other training seeds; ipopt: by another solver; literal: conventions of the
    authors' code; branching: trees that branch at more stages"""
    episodes: int | None = None
    """paired draws; default: 200, of critics 50, of ipopt 12, of the others 20"""


def variants(args):
    if args.study != "critics":
        return STUDIES[args.study]
    seeds = (1,) if args.quick else (1, 2, 3)
    agents = [(kind, seed) for kind in KINDS for seed in seeds]
    paths = loops.train([KINDS[kind] | dict(seed=seed) for kind, seed in agents], args)
    found = {}
    for (kind, seed), path in zip(agents, paths):
        found[f"RL, {kind}, seed {seed}"] = ACTOR | dict(critic=path)
        found[f"RL+MPC, {kind}, seed {seed}"] = RL_MPC | dict(critic=path)
    return found


def summary(rows):
    """[(median, 5th percentile)] of time near goal and of time outside constraints."""
    found = [column(rows, key) for key in MEASURES]
    return [(float(np.median(v)), float(np.quantile(v, 0.05))) for v in found]


def print_table(rows):
    measures = f"{'time near goal':>25s}{'time outside constraints':>37s}{'offset':>9s}"
    print(f"{'':48s}{measures}{'solve ms':>16s}{'iterations':>12s}{'steps':>10s}")
    titles = f"{'median':>9s}{'5 %-ile':>8s}{'worst':>8s}"
    times = f"{'median     p95':>16s}{'per step':>12s}{'unsolved':>10s}"
    print(f"{'':48s}{titles}   {titles}{'mean':>9s}{'%':>9s}{times}")
    for label in distinct(rows, "variant"):
        mine, text = select(rows, variant=label), f"{label:48s}"
        for key in MEASURES:
            found = column(mine, key)
            text += f"{np.median(found):9.1f}{np.quantile(found, 0.05):8.1f}{found.min():8.1f}   "
        columns = ("ape_tail", "solve_ms_median", "solve_ms_p95", "iterations", "unsolved")
        offset, median, p95, iterations, unsolved = (column(mine, key) for key in columns)
        text = f"{text[:-3]}{found.mean():9.1f}{np.median(offset):9.2f}{np.median(median):8.1f}{np.median(p95):8.1f}"
        print(f"{text}{iterations.mean():12.1f}{unsolved.sum():10.0f}")


def draw(rows, labels, path):
    """The paper's boxen plot of both measures."""
    import seaborn as sns  # takes seconds

    fig, axes = common.subplots(1, 2, figsize=(10, 0.9 + 0.4 * len(labels)), sharey=True)
    rows = [row for label in labels for row in select(rows, variant=label)]
    colours = {row["variant"]: deploy.STYLES[row["controller"]]["color"] for row in rows}
    style = dict(y="variant", hue="variant", palette=colours, legend=False, flier_kws={"s": 4})
    for ax, (key, title) in zip(axes, MEASURES.items()):
        data = {"variant": [row["variant"] for row in rows], title: column(rows, key).tolist()}
        sns.boxenplot(data, x=title, ax=ax, **style)
        ax.grid(axis="x", alpha=0.3)
        ax.set_ylabel("")
    draws = len(distinct(rows, "episode"))
    text = f"{draws} paired draws of start state and plant; boxes hold 50, 75, 87.5 ... % of them"
    fig.suptitle(text, fontsize=10)
    common.save(fig, path)


def main(args):
    name = f"cstr_{args.study}"
    common.check(args, name, episodes=(1, 10**6))
    if not args.plot_only:
        rows = loops.collect(variants(args), args, args.episodes or DRAWS.get(args.study, 20))
        common.write(loops.table(rows), args.table(name))
    rows = common.read(args.table(name))
    print_table(rows)
    labels = distinct(rows, "variant")
    if args.study == "deploy":
        draw(rows, labels, args.figure("cstr_deploy_full"))
    draw(rows, MAIN if args.study == "deploy" else labels, args.figure(name))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
