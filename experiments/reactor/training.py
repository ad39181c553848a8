"""Learning curves and final evaluations of the CSTR agents over seeds (the paper's figure `cstr_offlineagent`, in numbers).

Runs sac_her_branching.py, with its default arguments, once per seed and scenario set, each in a process of its own.

    python experiments/reactor/training.py --seeds 10 --jobs 2     # about 15 minutes on two cores; continues where it stopped
    python experiments/reactor/training.py --plot-only             # redraw from the committed CSV

Writes results/cstr_training.csv (an evaluation per row), results/cstr_training_seeds.csv (a run per row, with wall time and
machine) and figures/cstr_training.png.
"""

import csv
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from scipy.stats import trim_mean
from tqdm import tqdm

from experiments import common as cells
from experiments.common import HERE, ROOT

COLOURS = {"robust": "#0072B2", "nominal": "#E69F00"}  # Okabe and Ito


@dataclass
class Args:
    seeds: int = 10
    """training seeds per agent"""
    seed: int = 0
    """the first of them"""
    jobs: int = 2
    """runs at a time, each on one thread"""
    quick: bool = False
    """3,000 transitions and two seeds: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_training")
    """where the runs are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def train(scenarios, seed, args):
    """One run of the training script; returns its folder."""
    parent = args.runs / f"{scenarios}_{seed}{'_quick' if args.quick else ''}"
    done = list(parent.glob("*/wall_seconds.txt"))
    if done:
        return done[0].parent
    command = [
        sys.executable,
        str(ROOT / "sac_her_branching.py"),
        "--scenarios",
        scenarios,
        "--seed",
        str(seed),
    ]
    command += ["--out", str(parent)]
    if args.quick:
        command += ["--total-timesteps", "3000", "--eval-every", "1000"]
    tick = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    run = max(parent.iterdir(), key=lambda p: p.stat().st_mtime)
    (run / "wall_seconds.txt").write_text(f"{time.perf_counter() - tick:.1f}")
    return run


def collect(args):
    jobs = [
        (scenarios, seed)
        for seed in range(args.seed, args.seed + args.seeds)
        for scenarios in ("robust", "nominal")
    ]
    with ThreadPoolExecutor(args.jobs) as pool:
        runs = list(
            tqdm(pool.map(lambda job: train(*job, args), jobs), total=len(jobs), unit="run", disable=None)
        )
    curves, finals = [], []
    for (scenarios, seed), run in zip(jobs, runs):
        with open(run / "evaluations.csv") as file:
            rows = [
                {"env": "cstr", "scenarios": scenarios, "seed": seed} | row for row in csv.DictReader(file)
            ]
        curves += rows
        finals.append(
            rows[-1]
            | {
                "wall_seconds": (run / "wall_seconds.txt").read_text(),
                "jobs": args.jobs,
                "machine": cells.machine(),
            }
        )
    for name, table in (("cstr_training", curves), ("cstr_training_seeds", finals)):
        path = args.out / "results" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, table[0])
            writer.writeheader()
            writer.writerows(table)


def plot(args):
    with open(args.out / "results/cstr_training.csv") as file:
        curves = list(csv.DictReader(file))
    with open(args.out / "results/cstr_training_seeds.csv") as file:
        finals = list(csv.DictReader(file))
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for ax, evaluation in zip(axes, ("robust", "nominal")):
        for scenarios, colour in COLOURS.items():
            mine = [row for row in curves if row["scenarios"] == scenarios]
            steps = sorted({int(row["step"]) for row in mine})
            values = np.array(
                [
                    [float(row[f"{evaluation}_median_ape"]) for row in mine if int(row["step"]) == step]
                    for step in steps
                ]
            )
            steps = np.array(steps) / 1000
            ax.plot(
                steps,
                trim_mean(values, 0.25, axis=1),
                color=colour,
                lw=2,
                ls="-" if scenarios == "robust" else "--",
                label=f"{scenarios} agent",
            )
            ax.fill_between(steps, values.min(1), values.max(1), color=colour, alpha=0.2, lw=0)
        ax.set(yscale="log", xlabel="transitions [thousands]", title=f"{evaluation} evaluation")
        ax.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("median absolute percentage error of $c_B$")
    axes[0].legend(frameon=False, title=f"interquartile mean and range, {len(finals) // 2} seeds")
    path = args.out / "figures/cstr_training.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)

    print("interquartile mean over seeds [95 % bootstrap interval] (min ... max)")
    for scenarios in COLOURS:
        mine = [row for row in finals if row["scenarios"] == scenarios]
        for key in ("robust_median_ape", "robust_held_out_median_ape", "nominal_median_ape", "wall_seconds"):
            values = np.array([float(row[key]) for row in mine])
            middle, low, high = cells.iqm(values)
            print(
                f"{scenarios:8s} {key:28s} {middle:7.2f} [{low:.2f}, {high:.2f}] ({values.min():.2f} ... {values.max():.2f})"
            )


def main(args):
    cells.check(args, "cstr_training.csv", seeds=(1, 1000), jobs=(1, 1024))
    if args.quick:
        args.seeds = min(args.seeds, 2)
    if not args.plot_only:
        collect(args)
    plot(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
