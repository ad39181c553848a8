"""Figure `cstr_offlineagent`: offset of the robust and of the nominal agent on the nominal plant and on uncertain plants; and
what the number of scenarios, branches per transition and a critic per scenario do to it.

    python experiments/reactor/offline.py --jobs 2                    # six minutes: 10 training seeds per agent; continues where it stopped
    python experiments/reactor/offline.py --study ablation --jobs 2   # a quarter of an hour more: 5 seeds per variant
    python experiments/reactor/offline.py --plot-only                 # redraw from the committed CSV

The evaluation is the paper's (`sac_her_branching.evaluate`): 200 start states, the same for every agent, 50 steps, goal 0.65 mol/l, mean
absolute percentage error of c_B over the last 25. Writes results/cstr_offline.csv (a row per agent, seed, evaluation and start) or
cstr_offline_ablation.csv (a row per variant and seed), and the figure of the same name.
"""

import contextlib
import io
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import sac_her_branching as sac
from envs import cstr
from envs.agents.evaluation import evaluate
from envs.agents.policy import Scaling
from experiments import common as cells
from experiments.common import HERE, ROOT

STUDIES = {  # label: arguments of sac_her_branching.py
    "agents": {"robust": {}, "nominal": {"scenarios": "nominal"}},
    "ablation": {
        "1 scenario (nominal)": {"scenarios": "nominal"},
        "9 scenarios": {"scenarios": "mpc"},
        "100 scenarios (default)": {},
        "100 scenarios, K = 4": {"branches": 4},
        "100 scenarios, K = 16": {"branches": 16},
        "9 scenarios, a critic for each": {"scenarios": "mpc"},  # trained by `ScenarioCritics`
    },
}
SEPARATE = "9 scenarios, a critic for each"
COLOURS = {"robust": "#0072B2", "nominal": "#E69F00"}  # Okabe and Ito
PAPER = {
    "robust": {"robust": "about 2", "nominal": ""},
    "nominal": {"robust": "about 5", "nominal": "about 5"},
}


@dataclass
class Args:
    study: Literal["agents", "ablation"] = "agents"
    """agents: the paper's figure; ablation: scenarios, branches, a critic per scenario"""
    seeds: int | None = None
    """training seeds per agent; default: 10, ablation 5"""
    seed: int = 0
    """the first of them"""
    jobs: int = 2
    """runs at a time, each on one thread"""
    quick: bool = False
    """3,000 transitions, two seeds, 20 starts: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_offline")
    """where finished runs are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


class ManyCritics(sac.TwinCritic):
    """A pair of Q networks for each scenario, all evaluated as one batched product."""

    def __init__(self, pairs, **network):
        super().__init__(**network)
        twins = [sac.TwinCritic(**network) for _ in range(pairs)]
        self.weight = torch.nn.ParameterList(
            torch.cat(w).detach() for w in zip(*(twin.weight for twin in twins))
        )
        self.bias = torch.nn.ParameterList(torch.cat(b).detach() for b in zip(*(twin.bias for twin in twins)))
        self.pairs = pairs

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
        self.optimisers["critic"] = torch.optim.Adam(
            self.critic.parameters(), lr=args.learning_rate, fused=True
        )

    def update_critic(self, x, u, goal, x_next):
        pairs, batch = len(self.scenarios), len(x)
        with torch.no_grad():
            g = goal.repeat(pairs, 1)  # (pairs * B, n_goal), scenario after scenario, as everything below
            x_next = self.plant.step(
                *(v.repeat(pairs, 1).numpy() for v in (x, u)), self.scenarios.repeat(batch, axis=0)
            )
            x_next = torch.as_tensor(x_next, dtype=torch.float32)
            z = self.features(x_next, g)
            action, log_prob = self.actor.sample(z, self.generator)
            reward = envs.goal_reward(self.plant, x_next[:, self.scaling.goal_index], g, xp=torch).view(
                pairs, batch
            )
            z, action = (v.view(pairs, batch, -1) for v in (z, action))
            value = self.target.each(z, action).amin(1) - self.log_alpha.exp() * log_prob.view(pairs, batch)
            y = reward + self.args.gamma * value
        q = self.critic.each(self.features(x, goal), (u - self.scaling.u_center) / self.scaling.u_scale)
        loss = 2 * pairs * F.mse_loss(q, y[:, None].expand(-1, 2, -1))  # the sum over all critics
        self.optimisers["critic"].zero_grad()
        loss.backward()
        self.optimisers["critic"].step()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.target.parameters()), list(self.critic.parameters()), self.args.tau
            )
        return {
            "losses/qf_loss": loss.detach(),
            "losses/qf_values": q.detach().mean(),
            "losses/targets": y.mean(),
        }


def errors(cell):
    """Trains one agent; a row per evaluation and start state."""
    label, settings, seed, quick = cell
    agent, starts = (ScenarioCritics if label == SEPARATE else sac.SAC), 20 if quick else 200
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        args = sac.Args(
            seed=seed,
            out=Path(folder),
            eval_every=0,
            save_every=0,
            **settings,
            **({"total_timesteps": 3000} if quick else {}),
        )
        tick = time.perf_counter()
        data = torch.load(sac.main(args, agent) / "checkpoint.pt", weights_only=True)
        seconds = time.perf_counter() - tick
    actor = sac.Actor(**data["network"])
    actor.load_state_dict(data["actor"])
    plant = envs.load("cstr", **data["plant_options"])
    policy, rows = sac.Policy(plant, actor, None, Scaling(**data["scaling"]), data["goal_input"]), []
    for evaluation in ("nominal", "robust"):
        ape, _, held_out = evaluate(policy, cstr.EVAL_GOAL, starts, evaluation == "robust")
        for start, (error, out) in enumerate(zip(ape, held_out)):
            rows.append(
                {
                    "agent": label,
                    "seed": seed,
                    "evaluation": evaluation,
                    "start": start,
                    "held_out": int(out),
                    "ape": round(float(error), 4),
                    "train_seconds": round(seconds, 1),
                }
            )
    return rows


def collect(args):
    seeds = args.seeds or (10 if args.study == "agents" else 5)
    jobs = [
        (label, settings, seed, args.quick)
        for label, settings in STUDIES[args.study].items()
        for seed in range(args.seed, args.seed + (2 if args.quick else seeds))
    ]
    root = ROOT
    inputs = [Path(__file__), root / "sac_her_branching.py", root / "envs/__init__.py", root / "envs/cstr.py"]
    return cells.collect(errors, jobs, args.jobs, args.runs, inputs)


def by_seed(rows, **wanted):
    """Median error of each training seed over the rows that match."""
    found = {}
    for row in rows:
        if all(row[key] == value for key, value in wanted.items()):
            found.setdefault(row["seed"], []).append(float(row["ape"]))
    return np.array([np.median(values) for values in found.values()])


def line(values):
    middle, low, high = cells.iqm(values)
    return f"{middle:6.2f} [{low:.2f}, {high:.2f}] ({values.min():.2f} to {values.max():.2f})"


def plot_agents(rows, path):
    """The paper's boxen plot over all seeds and starts, and what it says in numbers."""
    import seaborn as sns

    seeds = len({row["seed"] for row in rows})
    print(f"median error % per seed: interquartile mean over {seeds} seeds [95 % bootstrap interval] (range)")
    for agent in COLOURS:
        for evaluation in ("nominal", "robust"):
            measured = line(by_seed(rows, agent=agent, evaluation=evaluation))
            print(f"{agent:8s} agent, {evaluation:8s}{measured:42s} paper: {PAPER[agent][evaluation]}")
        print(f"{'':16s}held out{line(by_seed(rows, agent=agent, evaluation='robust', held_out='1'))}")
    fig, ax = plt.subplots(figsize=(6.5, 3.8), layout="constrained")
    titles = {"nominal": "nominal plant", "robust": "uncertain plants"}
    data = {
        "plant": [titles[row["evaluation"]] for row in rows],
        "agent": [f"{row['agent']} agent" for row in rows],
        "error": [max(float(row["ape"]), 1e-3) for row in rows],
    }
    palette = {f"{agent} agent": colour for agent, colour in COLOURS.items()}
    sns.boxenplot(
        data, x="plant", y="error", hue="agent", palette=palette, log_scale=True, flier_kws={"s": 4}, ax=ax
    )
    ax.set(xlabel="", ylabel="absolute percentage error of $c_B$", ylim=(0.01, 200))
    ax.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    ax.grid(axis="y", alpha=0.3)
    starts = len({row["start"] for row in rows})
    ax.legend(frameon=False, title=f"{seeds} training seeds x {starts} starts", loc="upper left")
    fig.savefig(path, dpi=150)


def plot_ablation(rows, path):
    labels = list(dict.fromkeys(row["agent"] for row in rows))
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    print(f"{'':32s}{'robust evaluation':42s}{'nominal evaluation':42s}seconds")
    for position, label in enumerate(labels):
        texts = f"{label:32s}"
        for ax, evaluation in zip(axes, ("robust", "nominal")):
            values = np.array(
                [float(row[f"{evaluation}_median_ape"]) for row in rows if row["agent"] == label]
            )
            middle, low, high = cells.iqm(values)
            ax.plot([low, high], [-position, -position], color="#0072B2", lw=2)
            ax.plot(values, np.full(len(values), -position), "o", color="#999999", ms=4)
            ax.plot(middle, -position, "D", color="#0072B2", ms=6)
            ax.set(xlabel="median absolute percentage error of $c_B$", title=f"{evaluation} evaluation")
            ax.grid(axis="x", alpha=0.3)
            texts += f"{line(values):42s}"
        print(
            f"{texts}{np.median([float(row['train_seconds']) for row in rows if row['agent'] == label]):7.0f}"
        )
    for ax in axes:
        ax.set_xlim(0, None)
    axes[0].set_yticks(-np.arange(len(labels)), labels)
    fig.suptitle("interquartile mean, its 95 % bootstrap interval, every training seed", fontsize=10)
    fig.savefig(path, dpi=150)


def main(args):
    name = "cstr_offline" if args.study == "agents" else "cstr_offline_ablation"
    cells.check(args, f"{name}.csv", seeds=(1, 1000), seed=(0, 10**6), jobs=(1, 1024))
    table = args.out / f"results/{name}.csv"
    if not args.plot_only:
        rows = collect(args)
        if args.study == "ablation":
            rows = [
                {
                    "agent": label,
                    "seed": seed,
                    "train_seconds": next(
                        r["train_seconds"] for r in rows if (r["agent"], r["seed"]) == (label, seed)
                    ),
                }
                | {
                    f"{e}_median_ape": round(by_seed(rows, agent=label, seed=seed, evaluation=e)[0], 4)
                    for e in ("nominal", "robust")
                }
                for label, seed in dict.fromkeys((row["agent"], row["seed"]) for row in rows)
            ]
        else:
            rows = [{key: value for key, value in row.items() if key != "train_seconds"} for row in rows]
        cells.write(rows, table)
    figure = args.out / f"figures/{name}.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    (plot_agents if args.study == "agents" else plot_ablation)(cells.read(table), figure)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
