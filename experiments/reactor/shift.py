"""How each controller of the reactor degrades outside of the training box, and how far the critic can be believed where the planner goes.

    python experiments/reactor/shift.py --jobs 2                    # plants beyond the box; a quarter of an hour
    python experiments/reactor/shift.py --study critic --jobs 2     # calibration of the critics; both continue where they stopped
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

import numpy as np
import torch
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
import sac_her_branching as sac
from envs import cstr
from envs.agents.policy import Policy, Scaling
from experiments import common
from experiments.common import column, rounded, select
from experiments.palette import BLUE, GREEN, GREY, ORANGE, PINK, RED, SKY
from experiments.reactor import loops
from experiments.reactor.deploy import ACTOR, AWARE, MEASURES, NOMINAL, PAPER, RL_MPC, ROBUST, TUNED

FACTORS = (0.0, 0.5, 1.0, 1.5, 2.0)
GOAL_MPC = dict(controllers=("goal_mpc",), slack_weight=2.0)
CONTROLLERS = {  # label: (colour, dashes, keywords of rl_mpc_deploy.Args and of loops.Loop)
    "nominal MPC, N = 20": (GREY, ":", NOMINAL),
    "robust MPC, N = 20": (BLUE, "-.", ROBUST),
    "robust MPC, tuned": (SKY, (0, (5, 1)), ROBUST | dict(benchmark=TUNED)),
    "goal-conditioned MPC, N = 5": (ORANGE, (0, (3, 1, 1, 1)), GOAL_MPC),
    "RL, paper's": (PINK, "--", ACTOR | PAPER),
    "RL, constraint-aware": (RED, "--", ACTOR | AWARE),
    "RL+MPC, paper's, N = 5": (PINK, "-", RL_MPC | PAPER),
    "RL+MPC, constraint-aware, N = 5": (GREEN, "-", RL_MPC | AWARE),
}
CRITICS = {"paper's": loops.ROBUST, "constraint-aware": loops.CONSTRAINED}
VISITED_BY = {"actor": (RED, "o", ACTOR), "RL+MPC, N = 5": (GREEN, "^", RL_MPC)}  # colour, marker, keywords


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["plants", "critic"] = "plants"
    """plants: beyond the training box; critic: learned value against simulated return"""
    episodes: int = 25
    """paired draws"""
    rollouts: int = 32
    """simulations per state (critic)"""


# Plants beyond the training box


def plants(args):
    variants = {
        f"{label} | {factor:g}": options | dict(shift=factor)
        for label, (_, _, options) in CONTROLLERS.items()
        for factor in (FACTORS[::4] if args.quick else FACTORS)
    }
    rows = []
    for row in loops.table(loops.collect(variants, args)):
        label, factor = row["variant"].split(" | ")
        rows.append({"factor": factor} | row | {"variant": label})
    return rows


def plot_plants(rows, path):
    fig, axes = common.subplots(1, 3, figsize=(11, 3.8))
    columns = MEASURES | {"ape_tail": "offset [%]"}
    titles = "".join(f"{title:>36s}" for title in columns.values())
    print(f"{'':36s}factor  {titles}   median, 5th percentile (offset: 95th)")
    for label, (colour, dashes, _) in CONTROLLERS.items():
        mine = select(rows, variant=label)
        factors = sorted({float(row["factor"]) for row in mine})
        texts = [f"{label:36s}{factor:6g}  " for factor in factors]
        for ax, key in zip(axes, columns):
            found = [column([r for r in mine if float(r["factor"]) == factor], key) for factor in factors]
            medians = [np.median(v) for v in found]
            tails = [np.quantile(v, 0.95 if key == "ape_tail" else 0.05) for v in found]
            ax.plot(factors, medians, color=colour, ls=dashes, lw=2.2, marker="o", ms=4, label=label)
            ax.plot(factors, tails, color=colour, ls=dashes, lw=1, alpha=0.7)
            texts = [f"{text}{m:26.1f}{tail:10.1f}" for text, m, tail in zip(texts, medians, tails)]
        for text in texts:
            print(text)
    for ax, title in zip(axes, columns.values()):
        ax.axvline(1, color="black", lw=1, alpha=0.5)
        ax.set(title=title, xlabel="distance from the centre / training box")
        ax.grid(alpha=0.3)
    axes[2].set_yscale("log")
    axes[2].yaxis.set_major_formatter("{x:g}")
    common.legend(fig, axes[0], ncols=4, title="thick: median; thin: 5th percentile (offset: 95th)")
    common.save(fig, path)


# The critic where the planner goes


def simulated_value(critic_path, x, rollouts, steps, rng):
    """What V(x) = Q(x, mu(x)) estimates, by simulation from x (B, n_x): the mean first action, then SAC's soft return of its policy; and
    that policy's time outside constraints over the first 100 steps. Both (B,).

    Parameters are redrawn at every step, as in training.
    """
    data = torch.load(critic_path, weights_only=True)
    actor, settings = sac.Actor(**data["network"]), data["args"]
    actor.load_state_dict(data["actor"])
    policy = Policy(cstr, actor, None, Scaling(**data["scaling"]), data["goal_input"])
    generator = torch.Generator().manual_seed(0)
    x = np.repeat(x, rollouts, axis=0)
    total, outside, weight = np.zeros(len(x)), np.zeros(len(x)), 1.0
    for t in range(steps):
        with torch.no_grad():
            z = policy.features(x, cstr.EVAL_GOAL)
            if t == 0:
                action, log_prob = actor.act(z), torch.zeros(len(x))
            else:
                action, log_prob = actor.sample(z, generator)
        entropy = -data["alpha"] * log_prob.numpy() if settings["entropy_in_target"] else 0.0
        psi = rng.choice(cstr.SCENARIOS["robust"], size=len(x))
        x = cstr.step(x, policy.physical(action), psi, substeps=4)
        reward = envs.goal_reward(cstr, x[:, cstr.GOAL_INDEX], cstr.EVAL_GOAL)
        violation = envs.outside_constraints(cstr, x)
        total += weight * (entropy + reward + settings["constraint_weight"] * violation)
        outside += violation if t < 100 else 0.0
        weight *= data["gamma"]
    return total.reshape(-1, rollouts).mean(1), outside.reshape(-1, rollouts).mean(1)


def critic(args):
    """A row per state visited in the closed loops of the actor and of RL+MPC at N = 5: learned and simulated value."""
    rollouts, steps = (2, 20) if args.quick else (args.rollouts, 1000)
    visited = {}  # before torch computes: no fork after it
    for name, path in CRITICS.items():
        variants = {label: options | dict(critic=path) for label, (_, _, options) in VISITED_BY.items()}
        visited[name] = loops.collect(variants, args)
    rows = []
    for name, path in CRITICS.items():
        V = deploy.export(deploy.load_critic(path, "cstr"))[2]
        for label in VISITED_BY:
            rng, found = np.random.default_rng(args.seed), []
            for row in select(visited[name], variant=label):
                states = loops.replay(row)[:-1]
                times = rng.choice(len(states), size=min(20, len(states)), replace=False)
                found += [(int(row["episode"]), int(t), *states[t]) for t in sorted(times)]
            x = np.array(found)[:, 2:]
            learned = np.array(V(x.T, cstr.EVAL_GOAL)).ravel()
            simulated, outside = simulated_value(path, x, rollouts, steps, rng)
            for (episode, t, *state), *values in zip(found, learned, simulated, outside):
                row = {"critic": name, "visited_by": label, "episode": episode, "step": t}
                row |= dict(zip(cstr.STATE_NAMES, state))
                rows.append(rounded(row | dict(zip(("learned", "simulated", "outside"), values)), 4))
    return rows


def plot_critic(rows, path):
    fig, axes = common.subplots(2, 2, figsize=(9, 7))
    titles = f"{'error of the value':>26s}   its rank correlation with return and time outside"
    print(f"{'':42s}{titles}")
    for panels, name in zip(axes.T, CRITICS):
        for label, (colour, marker, _) in VISITED_BY.items():
            mine = select(rows, critic=name, visited_by=label)
            learned, *others = (column(mine, key) for key in ("learned", "simulated", "outside"))
            error, correlations = learned - others[0], [spearmanr(learned, v).statistic for v in others]
            for ax, v, correlation in zip(panels, others, correlations):
                text = f"{label}: rank correlation {correlation:.2f}"
                ax.plot(v, learned, marker, color=colour, ms=3, alpha=0.5, label=text)
            head = f"{name}, visited by {label}, {len(mine)} states"
            errors = f"{error.mean():.1f}, absolute {np.abs(error).mean():.1f}"
            print(f"{head:46s}{errors:>22s}{correlations[0]:31.2f}{correlations[1]:18.2f}")
        upper, lower = panels
        ends = [min(upper.get_xlim()[0], upper.get_ylim()[0]), max(upper.get_xlim()[1], upper.get_ylim()[1])]
        upper.plot(ends, ends, color="black", lw=1)
        upper.set(xlabel="simulated return", ylabel="learned value", title=f"{name} critic")
        lower.set(xlabel="the policy's time outside constraints from here [steps]", ylabel="learned value")
        for ax in panels:
            ax.grid(alpha=0.3)
            ax.legend(frameon=False, fontsize=8, title="visited by", title_fontsize=8)
    common.save(fig, path)


def main(args):
    name = "cstr_shift" if args.study == "plants" else "cstr_shift_critic"
    common.check(args, name, episodes=(1, 10**6), rollouts=(1, 10**4))
    if not args.plot_only:
        common.write(plants(args) if args.study == "plants" else critic(args), args.table(name))
    plot = plot_plants if args.study == "plants" else plot_critic
    plot(common.read(args.table(name)), args.figure(name))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
