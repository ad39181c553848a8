"""Figure `cstr_rlmpc`: actor, nominal MPC, robust MPC and RL+MPC on paired draws of start state and plant; and which learned value
serves RL+MPC best.

    python experiments/cstr_deploy.py --jobs 2      # 50 draws, four minutes; continues, variant by variant, where it stopped
    python experiments/cstr_deploy.py --study value --episodes 10
    python experiments/cstr_deploy.py --study expansion
    python experiments/cstr_deploy.py --plot-only   # redraw from the committed CSV

Writes results/cstr_deploy.csv (a row per controller and draw, columns of rl_mpc_deploy.py) and figures/cstr_deploy.png; the other
studies write cstr_value and cstr_expansion.
"""

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import cells

import rl_mpc_deploy as deploy

PRETRAINED = HERE / "pretrained"
STUDIES = {  # name: {label: settings of rl_mpc_deploy.py}
    "deploy": {
        "nominal MPC, N = 20": dict(controllers=("nominal_mpc",)),
        "robust MPC, N = 20": dict(controllers=("robust_mpc",)),
        "RL (actor alone)": dict(controllers=("actor",)),
        "RL+MPC, N = 5": dict(controllers=("rl_mpc",)),
        "RL, constraint-aware": dict(controllers=("actor",), critic=PRETRAINED / "cstr_constrained.pt"),
        "RL+MPC, N = 5, constraint-aware": dict(controllers=("rl_mpc",), critic=PRETRAINED / "cstr_constrained.pt"),
        "RL+MPC, N = 5, slack weight 3": dict(controllers=("rl_mpc",), slack_weight=3.0),
    },
    "value": {
        "first critic": dict(controllers=("rl_mpc",)),
        "minimum of both critics": dict(controllers=("rl_mpc",), combine="min"),
        "mean of both critics": dict(controllers=("rl_mpc",), combine="mean"),
        "no entropy in the target": dict(controllers=("rl_mpc",), critic=PRETRAINED / "cstr_no_entropy.pt"),
    },
    "expansion": {
        "exact value": dict(controllers=("rl_mpc",)),
        "taylor": dict(controllers=("rl_mpc",), value="taylor"),
        "taylor-local": dict(controllers=("rl_mpc",), value="taylor-local"),
    },
}


@dataclass
class Args:
    study: Literal["deploy", "value", "expansion"] = "deploy"
    """deploy: the controllers against each other; value: RL+MPC with each way to read a value out of a checkpoint; expansion: with that
    value and its second-order expansions"""
    episodes: int = 50
    """paired draws"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 10 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_deploy")
    """where finished variants are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def collect(args):
    episodes, steps = (2, 10) if args.quick else (args.episodes, 100)
    rows = []
    for variant, settings in STUDIES[args.study].items():
        settings = deploy.Args(horizon=5, episodes=episodes, steps=steps, seed=args.seed, jobs=args.jobs, **settings)
        inputs = [Path(deploy.__file__), Path(deploy.__file__).parent / "envs/cstr.py", deploy.critic_path(settings)]
        version = hashlib.sha256(repr(settings).encode() + b"".join(p.read_bytes() for p in inputs)).hexdigest()[:12]
        path = args.runs / f"{version}.csv"  # another script, plant, critic or setting is another file
        if not path.exists():
            print(variant)
            cells.write([{"variant": variant, "slack_weight": settings.slack_weight} | row for row in deploy.compare(settings)[0]], path)
        rows += [row | {"variant": variant} for row in cells.read(path)]  # studies that share a variant name it differently
    cells.write(rows, args.out / f"results/cstr_{args.study}.csv")


def plot(args):
    variants, rows = STUDIES[args.study], cells.read(args.out / f"results/cstr_{args.study}.csv")
    columns = {"time_near_goal": "time near goal [steps]", "time_outside_constraints": "time outside constraints [steps]"}
    fig, axes = plt.subplots(1, 2, figsize=(10, 0.9 + 0.45 * len(variants)), sharey=True, layout="constrained")
    print(f"{'':33s}{'time near goal':>27s}{'time outside constraints':>39s}{'offset':>9s}{'solve ms':>16s}{'failed':>9s}")
    print(
        f"{'':33s}{'median  5 %-ile    worst':>27s}{'median  5 %-ile    worst     mean':>39s}{'%':>9s}{'median     p95':>16s}{'solves':>9s}"
    )
    for position, variant in enumerate(variants):
        mine = {key: np.array([row[key] for row in rows if row["variant"] == variant]) for key in rows[0]}
        line = f"{variant:33s}"
        for ax, (key, title) in zip(axes, columns.items()):
            values = mine[key].astype(float)
            colour = deploy.STYLES[mine["controller"][0]][0]
            ax.boxplot(values, positions=[-position], orientation="horizontal", widths=0.6, whis=(5, 95), showfliers=False,
                       medianprops=dict(color=colour, lw=2.5))  # fmt: skip
            jitter = np.random.default_rng(0).uniform(-0.2, 0.2, len(values))
            ax.plot(values, jitter - position, "o", color=colour, ms=3, alpha=0.5)
            ax.set_xlabel(title)
            line += f"{np.median(values):9.1f}{np.quantile(values, 0.05):9.1f}{values.min():9.1f}   "
        times, failed = (mine[key].astype(float) for key in ("solve_ms_median", "solver_failures"))
        print(f"{line[:-3]}{values.mean():9.1f}{np.median(mine['ape_tail'].astype(float)):9.2f}{np.median(times):8.1f}"
              f"{np.quantile(mine['solve_ms_p95'].astype(float), 0.5):8.1f}{failed.sum():9.0f}")  # fmt: skip
    axes[0].set_yticks(-np.arange(len(variants)), list(variants))
    for ax in axes:
        ax.grid(axis="x", alpha=0.3)
    fig.suptitle(f"{len(rows) // len(variants)} paired draws of start state and plant; box 25-75 %, whiskers 5-95 %", fontsize=10)
    path = args.out / f"figures/cstr_{args.study}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)


def main(args):
    if not args.plot_only:
        collect(args)
    plot(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
