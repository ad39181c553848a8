"""How each controller of the reactor degrades outside of the training box, and how far the critic can be believed where the planner goes.

    python experiments/reactor/shift.py --jobs 2                    # plants beyond the box; a quarter of an hour, kept
    python experiments/reactor/shift.py --study critic --jobs 2     # calibration of the critics; two minutes
    python experiments/reactor/shift.py --plot-only                 # redraw from the committed CSV

plants: (alpha, beta) lie on the edge of the training box [0.95, 1.05] x [0.9, 1.1] blown up by a factor of 0 to 2 about its centre; start
and direction of a draw are the same at every factor. critic: the learned value at states which RL+MPC and which the actor visit, against
the mean discounted return of the policy from there, by simulation, with what the value counts: rewards, the price of constraints, entropy.

Writes results/cstr_shift.csv (a row per controller, factor and draw) or cstr_shift_critic.csv (a row per state), and the figure of the same
name.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
import sac_her_branching as sac
from envs import cstr
from envs.agents.policy import Scaling
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import loops
from experiments.reactor.deploy import ACTOR, AWARE, MEASURES, PAPER, RL_MPC, TUNED

FACTORS = (0.0, 0.5, 1.0, 1.5, 2.0)
CONTROLLERS = {  # label: (colour, dashes, keywords of cstr_loops)
    "nominal MPC, N = 20": ("#999999", ":", dict(controllers=("nominal_mpc",))),
    "robust MPC, N = 20": ("#0072B2", "-.", dict(controllers=("robust_mpc",))),
    "robust MPC, tuned": ("#56B4E9", (0, (5, 1)), dict(controllers=("robust_mpc",), benchmark=TUNED)),
    "goal-conditioned MPC, N = 5": (
        "#E69F00",
        (0, (3, 1, 1, 1)),
        dict(controllers=("goal_mpc",), slack_weight=2.0),
    ),
    "RL, paper's": ("#CC79A7", "--", ACTOR | PAPER),
    "RL, constraint-aware": ("#D55E00", "--", ACTOR | AWARE),
    "RL+MPC, paper's, N = 5": ("#CC79A7", "-", RL_MPC | PAPER),
    "RL+MPC, constraint-aware, N = 5": ("#009E73", "-", RL_MPC | AWARE),
}
CRITICS = {"paper's": loops.ROBUST, "constraint-aware": loops.CONSTRAINED}


@dataclass
class Args:
    study: Literal["plants", "critic"] = "plants"
    """plants: beyond the training box; critic: learned value against simulated return"""
    episodes: int = 25
    """paired draws"""
    rollouts: int = 32
    """simulations per state (critic)"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_loops")
    """where finished blocks are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


# Plants beyond the training box


def plants(args):
    factors = FACTORS[::4] if args.quick else FACTORS
    variants = {
        f"{label} | {factor:g}": options | dict(shift=factor)
        for label, (_, _, options) in CONTROLLERS.items()
        for factor in factors
    }
    rows = loops.collect(variants, args)
    return [
        {"factor": row["variant"].split(" | ")[1]} | row | {"variant": row["variant"].split(" | ")[0]}
        for row in loops.table(rows)
    ]


def plot_plants(rows, path):
    fig, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    columns = MEASURES | {"ape_tail": "offset [%]"}
    print(
        f"{'':36s}factor  "
        + "".join(f"{title:>36s}" for title in columns.values())
        + "   median, 5th percentile (offset: 95th)"
    )
    for label, (colour, dashes, _) in CONTROLLERS.items():
        mine = [row for row in rows if row["variant"] == label]
        factors = sorted({float(row["factor"]) for row in mine})
        found = {
            key: [np.array([float(r[key]) for r in mine if float(r["factor"]) == f]) for f in factors]
            for key in columns
        }
        for ax, key in zip(axes, columns):
            ax.plot(
                factors,
                [np.median(v) for v in found[key]],
                color=colour,
                ls=dashes,
                lw=2.2,
                marker="o",
                ms=4,
                label=label,
            )
            tail = [np.quantile(v, 0.95 if key == "ape_tail" else 0.05) for v in found[key]]
            ax.plot(factors, tail, color=colour, ls=dashes, lw=1, alpha=0.7)
        for i, factor in enumerate(factors):
            numbers = "".join(
                f"{np.median(found[k][i]):26.1f}{np.quantile(found[k][i], 0.95 if k == 'ape_tail' else 0.05):10.1f}"
                for k in columns
            )
            print(f"{label:36s}{factor:6g}  {numbers}")
    for ax, title in zip(axes, columns.values()):
        ax.axvline(1, color="black", lw=1, alpha=0.5)
        ax.set(title=title, xlabel="distance from the centre / training box")
        ax.grid(alpha=0.3)
    axes[2].set_yscale("log")
    axes[2].yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    title = "thick: median; thin: 5th percentile (offset: 95th)"
    fig.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=4,
        frameon=False,
        fontsize=9,
        title=title,
    )
    fig.savefig(path, dpi=150)


# The critic where the planner goes


def simulated_value(critic_path, x, rollouts, steps, rng):
    """What V(x) = Q(x, mu(x)) estimates, by simulation from x (B, n_x): the mean first action, then SAC's soft return of its policy; and
    that policy's time outside constraints over the first 100 steps. Both (B,).

    Parameters are redrawn at every step, as in training.
    """
    data = torch.load(critic_path, weights_only=True)
    actor, scaling, a = sac.Actor(**data["network"]), Scaling(**data["scaling"]), data["args"]
    actor.load_state_dict(data["actor"])
    generator = torch.Generator().manual_seed(0)
    x = np.repeat(x, rollouts, axis=0)
    goal = torch.tensor(cstr.EVAL_GOAL, dtype=torch.float32).expand(len(x), -1)
    total, outside, weight = np.zeros(len(x)), np.zeros(len(x)), 1.0
    for t in range(steps):
        with torch.no_grad():
            z = scaling.features(torch.tensor(x, dtype=torch.float32), goal, data["goal_input"])
            action, log_prob = (actor.act(z), torch.zeros(len(x))) if t == 0 else actor.sample(z, generator)
            u = (action * scaling.u_scale + scaling.u_center).numpy()
        entropy = -data["alpha"] * log_prob.numpy() if a["entropy_in_target"] else 0.0
        x = cstr.step(x, u, rng.choice(cstr.SCENARIOS["robust"], size=len(x)), substeps=4)
        reward = envs.goal_reward(cstr, x[:, cstr.GOAL_INDEX], cstr.EVAL_GOAL)
        violation = envs.outside_constraints(cstr, x)
        total += weight * (entropy + reward + a["constraint_weight"] * violation)
        outside += violation if t < 100 else 0.0
        weight *= data["gamma"]
    return total.reshape(-1, rollouts).mean(1), outside.reshape(-1, rollouts).mean(1)


def critic(args):
    """A row per state visited in the closed loops of the actor and of RL+MPC at N = 5: learned and simulated value."""
    kinds = {"actor": ACTOR, "RL+MPC, N = 5": RL_MPC}
    variants = {
        name: {label: kind | dict(critic=path) for label, kind in kinds.items()}
        for name, path in CRITICS.items()
    }
    visited, rows = (
        {name: loops.collect(own, args) for name, own in variants.items()},
        [],
    )  # before torch computes: no fork after it
    for name, path in CRITICS.items():
        V = deploy.export(deploy.load_critic(path, "cstr"))[2]
        for label in kinds:
            rng, found = np.random.default_rng(args.seed), []
            for row in visited[name]:
                if row["variant"] == label:
                    states = loops.replay(row)[:-1]
                    times = rng.choice(len(states), size=min(20, len(states)), replace=False)
                    found += [(int(row["episode"]), int(t), *states[t]) for t in sorted(times)]
            found = np.array(found)
            learned = np.array(V(found[:, 2:].T, cstr.EVAL_GOAL)).ravel()
            simulated, outside = simulated_value(
                path, found[:, 2:], 2 if args.quick else args.rollouts, 20 if args.quick else 1000, rng
            )
            for (episode, t, *state), v, mc, out in zip(found, learned, simulated, outside):
                rows.append(
                    {"critic": name, "visited_by": label, "episode": int(episode), "step": int(t)}
                    | {column: round(s, 4) for column, s in zip(cstr.STATE_NAMES, state)}
                    | {
                        "learned": round(float(v), 4),
                        "simulated": round(float(mc), 4),
                        "outside": round(float(out), 4),
                    }
                )
    return rows


def plot_critic(rows, path):
    fig, axes = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
    print(f"{'':42s}{'error of the value':>26s}   its rank correlation with return and time outside")
    for (ax, lower), name in zip(axes.T, CRITICS):
        for label, colour, marker in (("actor", "#D55E00", "o"), ("RL+MPC, N = 5", "#009E73", "^")):
            mine = [row for row in rows if (row["critic"], row["visited_by"]) == (name, label)]
            learned, simulated, outside = (
                np.array([float(row[key]) for row in mine]) for key in ("learned", "simulated", "outside")
            )
            error, found = (
                learned - simulated,
                [spearmanr(learned, v).statistic for v in (simulated, outside)],
            )
            for axis, v, correlation in zip((ax, lower), (simulated, outside), found):
                text = f"{label}: rank correlation {correlation:.2f}"
                axis.plot(v, learned, marker, color=colour, ms=3, alpha=0.5, label=text)
            errors = f"{error.mean():.1f}, absolute {np.abs(error).mean():.1f}"
            print(
                f"{f'{name}, visited by {label}, {len(mine)} states':46s}{errors:>22s}{found[0]:31.2f}{found[1]:18.2f}"
            )
        ends = [min(ax.get_xlim()[0], ax.get_ylim()[0]), max(ax.get_xlim()[1], ax.get_ylim()[1])]
        ax.plot(ends, ends, color="black", lw=1)
        ax.set(xlabel="simulated return", ylabel="learned value", title=f"{name} critic")
        lower.set(xlabel="the policy's time outside constraints from here [steps]", ylabel="learned value")
        for axis in (ax, lower):
            axis.grid(alpha=0.3)
            axis.legend(frameon=False, fontsize=8, title="visited by", title_fontsize=8)
    fig.savefig(path, dpi=150)


def main(args):
    name = "cstr_shift" if args.study == "plants" else "cstr_shift_critic"
    cells.check(
        args, f"{name}.csv", episodes=(1, 10**6), rollouts=(1, 10**4), seed=(0, 10**9), jobs=(1, 1024)
    )
    table, figure = args.out / f"results/{name}.csv", args.out / f"figures/{name}.png"
    if not args.plot_only:
        cells.write((plants if args.study == "plants" else critic)(args), table)
    figure.parent.mkdir(parents=True, exist_ok=True)
    (plot_plants if args.study == "plants" else plot_critic)(cells.read(table), figure)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
