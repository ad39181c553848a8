"""What makes RL+MPC good on the reactor: one setting changed at a time, over three critics.

    python experiments/reactor/ablation.py --jobs 2       # fifteen minutes, training included; continues where it stopped
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

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common
from experiments.common import column, distinct, select
from experiments.palette import BLUE, RED
from experiments.reactor import loops
from experiments.reactor.deploy import KINDS, MEASURES, RL_MPC

AWARE = KINDS["constraint-aware"]
PLANT_DATA = "plant data"
TRAINING = {  # setting: arguments of sac_her_branching.py
    "blind to constraints": {},
    "constraint weight 2": dict(constraint_weight=2.0),
    "constraint weight 5": dict(constraint_weight=5.0),
    "discount 0.98": AWARE | dict(gamma=0.98),
    "discount 0.95": AWARE | dict(gamma=0.95),
    "no entropy in the target": AWARE | dict(entropy_in_target=False),
    "reward sigma^2 = 1e-3": AWARE | dict(reward_sigma2=1e-3),
    PLANT_DATA: AWARE,
}
DEPLOYMENT = {  # setting: keywords of rl_mpc_deploy.Args and of loops.Loop
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
SHOWN = {"median": (0.5, BLUE, "o"), "5th percentile": (0.05, RED, "d")}  # quantile, colour, marker


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    seed: int = 2
    """of the draws; the comparison of deploy.py has seed 0"""
    episodes: int = 25
    """paired draws"""
    agents: tuple[int, ...] = (1, 2, 3)
    """training seeds"""


def plant_data(critic, args):
    """A trajectories.npz of RL+MPC with this critic in its loops on draws of another seed; returns its path."""
    rows = loops.collect({"data": RL_MPC | dict(critic=critic)}, args, episodes=64, seed=args.seed + 1000)
    x = np.stack([loops.replay(row) for row in rows])
    u = np.stack([json.loads(row["actions"]) for row in rows])
    path = args.runs / f"plant_data_{hashlib.sha256(x.tobytes() + u.tobytes()).hexdigest()[:12]}.npz"
    if not path.exists():
        np.savez_compressed(args.runs / "unfinished.npz", rl_mpc_x=x, rl_mpc_u=u)
        (args.runs / "unfinished.npz").replace(path)
    return path


def collect(args):
    seeds = args.agents[:1] if args.quick else args.agents
    training = {"default": AWARE} | dict(list(TRAINING.items())[-2:] if args.quick else TRAINING)
    deployment = dict(list(DEPLOYMENT.items())[: 2 if args.quick else None])

    agents = {(label, seed): training[label] | dict(seed=seed) for label in training for seed in seeds}
    plain = {agent: settings for agent, settings in agents.items() if agent[0] != PLANT_DATA}
    critics = dict(zip(plain, loops.train(list(plain.values()), args)))
    data = {seed: plant_data(critics["default", seed], args) for seed in seeds}
    with_data = [agents[PLANT_DATA, seed] | dict(add_plant_data=data[seed]) for seed in seeds]
    critics |= {(PLANT_DATA, seed): path for seed, path in zip(seeds, loops.train(with_data, args))}

    # a critic blind to constraints is planned with at the default's slack weight, too
    usual = RL_MPC | dict(slack_weight=2.0)
    variants = {f"{label} | {seed}": usual | dict(critic=critics[label, seed]) for label, seed in agents}
    for label, options in deployment.items():
        for seed in seeds:
            variants[f"{label} | {seed}"] = usual | dict(critic=critics["default", seed]) | options
    rows = []
    for row in loops.table(loops.collect(variants, args)):
        label, seed = row["variant"].split(" | ")
        rows.append({"agent": seed} | row | {"variant": label})
    return rows


def plot(rows, path):
    labels = distinct(rows, "variant")
    fig, axes = common.subplots(1, 2, figsize=(10, 0.9 + 0.28 * len(labels)), sharey=True)
    titles = "time near goal: median  5 %-ile   outside: median  5 %-ile     mean   offset"
    print(f"{'':28s}{titles}   in brackets: range over critics")
    for position, label in enumerate(labels):
        mine, text = select(rows, variant=label), f"{label:28s}"
        for ax, key in zip(axes, MEASURES):
            by_agent = [column(mine, key, agent=agent) for agent in sorted(distinct(mine, "agent"))]
            together = np.concatenate(by_agent)
            for q, colour, marker in SHOWN.values():
                found, pooled = [np.quantile(v, q) for v in by_agent], np.quantile(together, q)
                ax.plot(found, [-position] * len(found), marker, color=colour, ms=4, alpha=0.6)
                ax.plot([pooled] * 2, [-position - 0.35, -position + 0.35], color=colour, lw=2)
                text += f"{pooled:8.1f} [{min(found):.1f}, {max(found):.1f}]"
        print(f"{text}{together.mean():8.1f}{np.median(column(mine, 'ape_tail')):8.1f}")
    for ax, title in zip(axes, MEASURES.values()):
        ax.set_xlabel(title)
        ax.grid(alpha=0.3)
    axes[0].set_yticks(-np.arange(len(labels)), labels)
    for name, (_, colour, marker) in SHOWN.items():
        axes[0].plot([], [], marker=marker, color=colour, label=name)
    common.legend(fig, axes[0], ncols=2, fontsize=10, title="bar: all draws; points: each of the critics")
    common.save(fig, path)


def main(args):
    common.check(args, "cstr_ablation", episodes=(1, 10**6))
    if not args.plot_only:
        common.write(collect(args), args.table("cstr_ablation"))
    plot(common.read(args.table("cstr_ablation")), args.figure("cstr_ablation"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
