"""Figure `cstr_rlmpc`: actor, nominal MPC, robust MPC and RL+MPC on paired draws of start state and plant.

    python experiments/cstr_deploy.py --jobs 2     # 50 draws; continues, controller by controller, where it stopped
    python experiments/cstr_deploy.py --plot-only  # redraw from the committed CSV

Writes results/cstr_deploy.csv (a row per controller and draw, columns of rl_mpc_deploy.py) and figures/cstr_deploy.png.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import rl_mpc_deploy as deploy

CONTROLLERS = ("nominal_mpc", "robust_mpc", "actor", "rl_mpc")


@dataclass
class Args:
    episodes: int = 50
    """paired draws"""
    horizon: int = 5
    """prediction steps of RL+MPC"""
    slack_weight: float = deploy.Args.slack_weight
    """price of a constraint violation in RL+MPC"""
    critic: Path = deploy.Args.critic
    """checkpoint of the actor and of RL+MPC's terminal value"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 10 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_deploy")
    """where finished controllers are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write(rows, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def collect(args):
    episodes, steps = (2, 10) if args.quick else (args.episodes, 100)
    rows = []
    for name in CONTROLLERS:
        variant = (
            f"_{args.critic.stem}_N{args.horizon}_{args.slack_weight:g}" if name == "rl_mpc" else f"_{args.critic.stem}" * (name == "actor")
        )
        path = args.runs / f"{name}{variant}_{args.seed}_{episodes}x{steps}.csv"
        if not path.exists():
            settings = deploy.Args(horizon=args.horizon, critic=args.critic, slack_weight=args.slack_weight, episodes=episodes,
                                   steps=steps, seed=args.seed, jobs=args.jobs, controllers=(name,))  # fmt: skip
            write(deploy.compare(settings)[0], path)
        rows += read(path)
    write(rows, args.out / "results/cstr_deploy.csv")


def plot(args):
    rows = read(args.out / "results/cstr_deploy.csv")
    columns = {"time_near_goal": "time near goal [steps]", "time_outside_constraints": "time outside constraints [steps]"}
    fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), sharey=True, layout="constrained")
    print(f"{'controller':22s} {'time near goal':>28s} {'time outside constraints':>32s}")
    print(f"{'':22s} {'median   5 %-ile     worst':>28s} {'median   5 %-ile     worst     mean':>40s}")
    for position, name in enumerate(reversed(CONTROLLERS)):
        mine = [row for row in rows if row["controller"] == name]
        texts = []
        for ax, (key, title) in zip(axes, columns.items()):
            values = np.array([float(row[key]) for row in mine])
            ax.boxplot(values, positions=[position], orientation="horizontal", widths=0.6, whis=(5, 95), showfliers=False,
                       medianprops=dict(color=deploy.COLOURS[name], lw=2.5))  # fmt: skip
            jitter = np.random.default_rng(0).uniform(-0.2, 0.2, len(values))
            ax.plot(values, position + jitter, "o", color=deploy.COLOURS[name], ms=3, alpha=0.5)
            ax.set_xlabel(title)
            texts.append(f"{np.median(values):9.1f} {np.quantile(values, 0.05):9.1f} {values.min():9.1f}")
            if key == "time_outside_constraints":
                texts[-1] += f" {values.mean():9.1f}"
        print(f"{deploy.label(mine[0]):22s} {texts[0]} {texts[1]}")
    labels = [deploy.label(next(row for row in rows if row["controller"] == name)) for name in reversed(CONTROLLERS)]
    axes[0].set_yticks(range(len(labels)), labels)
    for ax in axes:
        ax.grid(axis="x", alpha=0.3)
    fig.suptitle(f"{len(rows) // len(CONTROLLERS)} paired draws of start state and plant; box 25-75 %, whiskers 5-95 %", fontsize=10)
    path = args.out / "figures/cstr_deploy.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)


def main(args):
    if not args.plot_only:
        collect(args)
    plot(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
