"""Figure `cstr_offlineagent`: offset of the robust and of the nominal agent on the nominal plant and on uncertain plants; and
what the number of scenarios, branches per transition and a critic per scenario do to it.

    python experiments/reactor/offline.py --jobs 2                    # six minutes: 10 training seeds per agent; continues where it stopped
    python experiments/reactor/offline.py --study ablation --jobs 2   # ten minutes more: 3 seeds per variant
    python experiments/reactor/offline.py --plot-only                 # redraw from the committed CSV

The evaluation is the paper's (envs/agents/evaluation.py): 200 start states, the same for every agent, 50 steps, goal 0.65 mol/l, mean
absolute percentage error of c_B over the last 25. Writes results/cstr_offline.csv (a row per agent, seed, evaluation and start) or
cstr_offline_ablation.csv (a row per variant and seed), and the figure of the same name.
"""

import functools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import sac_her_branching as sac
from envs import cstr
from envs.agents.evaluation import evaluate
from envs.agents.policy import read_policy
from experiments import common
from experiments.common import column, distinct, grouped, iqm_text, select
from experiments.palette import BLUE, GREY
from experiments.reactor.training import AGENTS, QUICK

SEPARATE = "9 scenarios, a critic for each"  # trained by `ScenarioCritics`
VARIANTS = {  # of the ablation: arguments of sac_her_branching.py
    "1 scenario (nominal)": {"scenarios": "nominal"},
    "9 scenarios": {"scenarios": "mpc"},
    "100 scenarios (default)": {},
    "100 scenarios, K = 4": {"branches": 4},
    "100 scenarios, K = 16": {"branches": 16},
    SEPARATE: {"scenarios": "mpc"},
}
PAPER = {
    "robust": {"robust": "about 2", "nominal": ""},
    "nominal": {"robust": "about 5", "nominal": "about 5"},
}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["agents", "ablation"] = "agents"
    """agents: the paper's figure; ablation: scenarios, branches, a critic per scenario"""
    seeds: int | None = None
    """training seeds per agent; default: 10, ablation 3"""


# The paper's option 2


class ManyCritics(sac.TwinCritic):
    """A pair of Q networks for each scenario, all evaluated as one batched product."""

    def __init__(self, pairs, **network):
        super().__init__(**network)
        twins, self.pairs = [sac.TwinCritic(**network) for _ in range(pairs)], pairs
        weights, biases = zip(*((twin.weight, twin.bias) for twin in twins))
        self.weight = torch.nn.ParameterList(torch.cat(w).detach() for w in zip(*weights))
        self.bias = torch.nn.ParameterList(torch.cat(b).detach() for b in zip(*biases))

    def each(self, z, a):
        """Every scenario's pair: features (B, n_in) or (pairs, B, n_in), action likewise -> (pairs, 2, B)."""
        h = torch.cat([z, a], dim=-1)
        h = h.expand(2 * self.pairs, -1, -1) if h.dim() == 2 else h.repeat_interleave(2, dim=0)
        *hidden, (w_out, b_out) = zip(self.weight, self.bias)
        for w, b in hidden:
            h = F.silu(torch.baddbmm(b, h, w))
        return torch.baddbmm(b_out, h, w_out).view(self.pairs, 2, -1)

    def forward(self, z, a):
        """The average over scenarios, (2, B)."""
        return self.each(z, a).mean(0)


class ScenarioCritics(sac.SAC):
    """The paper's option 2: scenarios side by side under one policy, critics for each, averaged where the policy is improved.

    The target of scenario i takes its next state, which the plant computes from the stored state and action, and its critics.
    """

    def __init__(self, args, plant):
        super().__init__(args, plant)
        self.scenarios = plant.SCENARIOS["mpc"]  # (pairs, n_psi)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(args.seed)
            self.critic, self.target = (ManyCritics(len(self.scenarios), **self.network) for _ in range(2))
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)
        optimiser = torch.optim.Adam(self.critic.parameters(), lr=args.learning_rate, fused=True)
        self.optimisers["critic"] = optimiser
        self.saved |= {"critic": self.critic, "target": self.target, "critic optimiser": optimiser}

    def update_critic(self, x, u, goal, x_next):
        pairs, batch = len(self.scenarios), len(x)
        with torch.no_grad():
            g = goal.repeat(pairs, 1)  # (pairs * B, n_goal), scenario after scenario, as everything below
            x_all, u_all = (v.repeat(pairs, 1).numpy() for v in (x, u))
            x_next = self.plant.step(x_all, u_all, self.scenarios.repeat(batch, axis=0))
            x_next = torch.as_tensor(x_next, dtype=torch.float32)
            z = self.features(x_next, g)
            action, log_prob = self.actor.sample(z, self.generator)
            z, action = (v.view(pairs, batch, -1) for v in (z, action))
            value = self.target.each(z, action).amin(1) - self.log_alpha.exp() * log_prob.view(pairs, batch)
            y = self.reward(x_next, g, torch).view(pairs, batch) + self.args.gamma * value
        q = self.critic.each(self.features(x, goal), (u - self.scaling.u_center) / self.scaling.u_scale)
        loss = 2 * pairs * F.mse_loss(q, y[:, None].expand(-1, 2, -1))  # the sum over all critics
        self.optimisers["critic"].zero_grad()
        loss.backward()
        self.optimisers["critic"].step()
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters()):
                slow.lerp_(fast, self.args.tau)
        return {"losses/qf_loss": loss.detach(), "losses/qf_values": q.detach().mean()}


# Errors


def train(agents, args, kind=None):
    """Folders of agents {(label, seed): arguments of sac_her_branching.py}, by the same keys."""
    few = QUICK if args.quick else {}
    settings = [arguments | few | {"seed": seed} for (_, seed), arguments in agents.items()]
    return dict(zip(agents, common.train(settings, args.runs, args.jobs, kind)))


def errors(folders, args, critic=sac.TwinCritic):
    """A row per agent {(label, seed): folder}, evaluation and start state; critic: its class."""
    torch.set_num_threads(1)  # as in training: the same numbers on every number of cores
    rows, starts = [], 20 if args.quick else 200
    for (label, seed), folder in folders.items():
        policy = read_policy(folder / "checkpoint.pt", sac.Actor, critic)
        for evaluation in ("nominal", "robust"):
            head = {"agent": label, "seed": seed, "evaluation": evaluation}
            found, _, held_out = evaluate(policy, cstr.EVAL_GOAL, starts, evaluation == "robust")
            for start, (error, out) in enumerate(zip(found, held_out)):
                rows.append(head | {"start": start, "held_out": int(out), "ape": round(float(error), 4)})
    return rows


def collect(args):
    seeds = args.seeds or (10 if args.study == "agents" else 3)
    seeds = range(args.seed, args.seed + (2 if args.quick else seeds))
    if args.study == "agents":
        agents = {(label, seed): {"scenarios": label} for label in AGENTS for seed in seeds}
        return errors(train(agents, args), args)
    agents = {(label, seed): arguments for label, arguments in VARIANTS.items() for seed in seeds}
    separate = {agent: agents.pop(agent) for agent in list(agents) if agent[0] == SEPARATE}
    folders, separate = train(agents, args), train(separate, args, ScenarioCritics)
    critics = functools.partial(ManyCritics, len(cstr.SCENARIOS["mpc"]))
    found = errors(folders, args) + errors(separate, args, critics)
    rows = []
    for (label, seed), folder in (folders | separate).items():
        seconds = common.read(folder / "evaluations.csv")[-1]["train_seconds"]
        mine = select(found, agent=label, seed=seed)
        row = {"agent": label, "seed": seed, "train_seconds": seconds}
        for evaluation in ("nominal", "robust"):
            row[f"{evaluation}_median_ape"] = round(np.median(column(mine, "ape", evaluation=evaluation)), 4)
        rows.append(row)
    return rows


def by_seed(rows, **where):
    """Median error of each training seed over the rows that match."""
    seeds = grouped(select(rows, **where), "seed").values()
    return np.array([np.median(column(mine, "ape")) for mine in seeds])


def plot_agents(rows, path):
    """The paper's boxen plot over all seeds and starts, and what it says in numbers."""
    import seaborn as sns  # takes seconds

    seeds, starts = len(distinct(rows, "seed")), len(distinct(rows, "start"))
    print(f"median error % per seed: interquartile mean over {seeds} seeds [95 % bootstrap interval] (range)")
    for agent in AGENTS:
        for evaluation in ("nominal", "robust"):
            measured = iqm_text(by_seed(rows, agent=agent, evaluation=evaluation))
            print(f"{agent:8s} agent, {evaluation:8s}{measured:42s} paper: {PAPER[agent][evaluation]}")
        held_out = by_seed(rows, agent=agent, evaluation="robust", held_out=1)
        print(f"{'':16s}held out{iqm_text(held_out)}")
    fig, ax = common.subplots(figsize=(6.5, 3.8))
    titles = {"nominal": "nominal plant", "robust": "uncertain plants"}
    data = {
        "plant": [titles[row["evaluation"]] for row in rows],
        "agent": [f"{row['agent']} agent" for row in rows],
        "error": np.maximum(column(rows, "ape"), 1e-3).tolist(),
    }
    palette = {f"{agent} agent": colour for agent, (colour, _) in AGENTS.items()}
    style = dict(palette=palette, log_scale=True, flier_kws={"s": 4}, ax=ax)
    sns.boxenplot(data, x="plant", y="error", hue="agent", **style)
    ax.set(xlabel="", ylabel="absolute percentage error of $c_B$", ylim=(0.01, 200))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.grid(axis="y", alpha=0.3)
    ax.legend(frameon=False, title=f"{seeds} training seeds x {starts} starts", loc="upper left")
    common.save(fig, path)


def plot_ablation(rows, path):
    labels = distinct(rows, "agent")
    fig, axes = common.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    print(f"{'':32s}{'robust evaluation':42s}{'nominal evaluation':42s}seconds")
    for position, label in enumerate(labels):
        text = f"{label:32s}"
        for ax, evaluation in zip(axes, ("robust", "nominal")):
            values = column(rows, f"{evaluation}_median_ape", agent=label)
            middle, low, high = common.iqm(values)
            ax.plot([low, high], [-position, -position], color=BLUE, lw=2)
            ax.plot(values, np.full(len(values), -position), "o", color=GREY, ms=4)
            ax.plot(middle, -position, "D", color=BLUE, ms=6)
            ax.set(xlabel="median absolute percentage error of $c_B$", title=f"{evaluation} evaluation")
            ax.grid(axis="x", alpha=0.3)
            text += f"{iqm_text(values):42s}"
        print(f"{text}{np.median(column(rows, 'train_seconds', agent=label)):7.0f}")
    for ax in axes:
        ax.set_xlim(0, None)
    axes[0].set_yticks(-np.arange(len(labels)), labels)
    fig.suptitle("interquartile mean, its 95 % bootstrap interval, every training seed", fontsize=10)
    common.save(fig, path)


def main(args):
    name = "cstr_offline" if args.study == "agents" else "cstr_offline_ablation"
    common.check(args, name, seeds=(1, 1000))
    if not args.plot_only:
        common.write(collect(args), args.table(name))
    plot = plot_agents if args.study == "agents" else plot_ablation
    plot(common.read(args.table(name)), args.figure(name))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
