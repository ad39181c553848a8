"""What makes RL+MPC good on the reactor: one setting changed at a time, over three critics.

    python experiments/reactor/ablation.py --jobs 2       # forty minutes, training included; continues where it stopped
    python experiments/reactor/ablation.py --plot-only    # redraw from the committed CSV

The default is `sac_her_branching.py --constraint-weight 3` and `rl_mpc_deploy.py --horizon 5`, slack weight 2. Settings of the training
have agents of their own, of the same three seeds, none of which is the shipped critic's. "plant data" trains with the closed loops of the
default on 64 draws of yet another seed in the replay buffer (--add-plant-data). Writes results/cstr_ablation.csv (a row per setting,
training seed and draw) and figures/cstr_ablation.png.
"""

import hashlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import loops
from experiments.reactor.deploy import KINDS, MEASURES, RL_MPC

AWARE = KINDS["constraint-aware"]
PLANT_DATA = "plant data"
TRAINING = {  # setting: arguments of sac_her_branching.py
    "blind to constraints": (),
    "constraint weight 1": ("--constraint-weight", "1"),
    "constraint weight 2": ("--constraint-weight", "2"),
    "constraint weight 5": ("--constraint-weight", "5"),
    "discount 0.98": (*AWARE, "--gamma", "0.98"),
    "discount 0.95": (*AWARE, "--gamma", "0.95"),
    "no entropy in the target": (*AWARE, "--no-entropy-in-target"),
    "reward sigma^2 = 1e-3": (*AWARE, "--reward-sigma2", "1e-3"),
    "200,000 transitions": (*AWARE, "--total-timesteps", "200000"),
    "batch 512": (*AWARE, "--batch-size", "512"),
    PLANT_DATA: AWARE,
}
DEPLOYMENT = {  # setting: keywords of rl_mpc_deploy.Args
    "slack weight 1": dict(slack_weight=1.0),
    "slack weight 3": dict(slack_weight=3.0),
    "slack weight 5": dict(slack_weight=5.0),
    "N = 1": dict(horizon=1),
    "N = 10": dict(horizon=10),
    "sigma = 0.25": dict(sigma=0.25),
    "minimum of both critics": dict(combine="min"),
    "mean of both critics": dict(combine="mean"),
    "nominal model": dict(robust_horizon=0),
    "one start: the last plan": dict(like="one start"),
}


@dataclass
class Args:
    episodes: int = 25
    """paired draws"""
    seed: int = 2
    """seed of the draws; the comparison of cstr_deploy.py has seed 0"""
    agents: tuple[int, ...] = (1, 2, 3)
    """training seeds"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps, one critic, hardly trained: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_loops")
    """where agents and finished blocks are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def plant_data(critic, args):
    """A trajectories.npz of RL+MPC with this critic in its loops on draws of another seed; returns its path."""
    rows = loops.collect({"data": RL_MPC | dict(critic=critic)}, args, episodes=64, seed=args.seed + 1000)
    x, u = (
        np.stack([loops.replay(row) for row in rows]),
        np.stack([json.loads(row["actions"]) for row in rows]),
    )
    path = args.runs / f"plant_data_{hashlib.sha256(x.tobytes() + u.tobytes()).hexdigest()[:12]}.npz"
    if not path.exists():
        np.savez_compressed(args.runs / "unfinished.npz", rl_mpc_x=x, rl_mpc_u=u)
        (args.runs / "unfinished.npz").replace(path)
    return path


def collect(args):
    seeds = args.agents[:1] if args.quick else args.agents
    settings = {"default": AWARE} | dict(list(TRAINING.items())[-2:] if args.quick else TRAINING)
    plain = [(seed, *flags) for label, flags in settings.items() if label != PLANT_DATA for seed in seeds]
    critics = dict(zip(plain, loops.train(plain, args)))
    default = [critics[seed, *AWARE] for seed in seeds]
    with_data = loops.train(
        [(seed, *AWARE, "--add-plant-data", plant_data(c, args)) for seed, c in zip(seeds, default)], args
    )
    rows, variants = [], {}
    for label, flags in settings.items():
        paths = with_data if label == PLANT_DATA else [critics[seed, *flags] for seed in seeds]
        variants |= {(label, seed): dict(critic=path) for seed, path in zip(seeds, paths)}
    for label, options in list(DEPLOYMENT.items())[: 2 if args.quick else None]:
        variants |= {(label, seed): dict(critic=path) | options for seed, path in zip(seeds, default)}
    # a critic blind to constraints is planned with at the default's slack weight, too
    named = {
        f"{label} | {seed}": RL_MPC | dict(slack_weight=2.0) | options
        for (label, seed), options in variants.items()
    }
    for row in loops.table(loops.collect(named, args)):
        label, seed = row["variant"].split(" | ")
        rows.append({"agent": seed} | row | {"variant": label})
    return rows


def plot(rows, path):
    labels = list(dict.fromkeys(row["variant"] for row in rows))
    fig, axes = plt.subplots(1, 2, figsize=(10, 0.9 + 0.28 * len(labels)), sharey=True, layout="constrained")
    print(
        f"{'':28s}time near goal: median  5 %-ile   outside: median  5 %-ile     mean   offset   in brackets: range over critics"
    )
    for position, label in enumerate(labels):
        mine, text = [row for row in rows if row["variant"] == label], f"{label:28s}"
        agents = sorted({row["agent"] for row in mine})
        for ax, key in zip(axes, MEASURES):
            by_agent = [
                np.array([float(row[key]) for row in mine if row["agent"] == agent]) for agent in agents
            ]
            for measure, colour, marker in (
                (np.median, "#0072B2", "o"),
                (lambda v: np.quantile(v, 0.05), "#D55E00", "d"),
            ):
                found, pooled = [measure(v) for v in by_agent], measure(np.concatenate(by_agent))
                ax.plot(found, [-position] * len(found), marker, color=colour, ms=4, alpha=0.6)
                ax.plot([pooled] * 2, [-position - 0.35, -position + 0.35], color=colour, lw=2)
                text += f"{pooled:8.1f} [{min(found):.1f}, {max(found):.1f}]"
        offset = np.median([float(row["ape_tail"]) for row in mine])
        print(f"{text}{np.mean(np.concatenate(by_agent)):8.1f}{offset:8.1f}")
    for ax, title in zip(axes, MEASURES.values()):
        ax.set_xlabel(title)
        ax.grid(alpha=0.3)
    axes[0].set_yticks(-np.arange(len(labels)), labels)
    styles = {"median": ("#0072B2", "o"), "5th percentile": ("#D55E00", "d")}
    handles = [
        plt.Line2D([], [], color=colour, marker=marker, label=label)
        for label, (colour, marker) in styles.items()
    ]
    fig.legend(
        handles=handles,
        loc="outside upper center",
        ncols=2,
        frameon=False,
        title="bar: all draws; points: each of the critics",
    )
    fig.savefig(path, dpi=150)


def main(args):
    cells.check(args, "cstr_ablation.csv", episodes=(1, 10**6), seed=(0, 10**6), jobs=(1, 1024))
    table, figure = args.out / "results/cstr_ablation.csv", args.out / "figures/cstr_ablation.png"
    if not args.plot_only:
        cells.write(collect(args), table)
    figure.parent.mkdir(parents=True, exist_ok=True)
    plot(cells.read(table), figure)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
