"""Where the training time of the CSTR agent goes, what its settings buy, and Stable-Baselines3's SAC + HER on the same environment.

    python experiments/speed/training_speed.py --study ablation    # ten minutes: one setting changed at a time, 3 seeds
    python experiments/speed/training_speed.py --study peer        # ten minutes: Stable-Baselines3 (requirements-dev.txt), 3 seeds
    python experiments/speed/training_speed.py --study profile     # a minute: the parts of one update; nothing else should run
    python experiments/speed/training_speed.py --study ablation --plot-only

Runs are told apart by variant and seed and kept, so that a second call continues. Times are of training alone, evaluations left out, one
thread per run, another run beside it. Writes results/training_speed_NAME.csv for NAME in ablation, peer, profile (ablation and peer: a row
per evaluation) and figures/training_speed.png, which needs both.
"""

import functools
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn as nn
from scipy.stats import trim_mean

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import sac_her_branching as sac
from envs import cstr
from envs.agents.evaluation import evaluation_row
from envs.agents.policy import Scaling
from experiments import common
from experiments.common import column, grouped, rounded, without
from experiments.palette import BLUE, GREY, ORANGE, RED

VARIANTS = {  # of the arguments of sac_her_branching.py
    "default": {},
    "update per 4 transitions": dict(steps_per_update=4),
    "update per 16 transitions": dict(steps_per_update=16),
    "batch 512": dict(batch_size=512),
    "8 plants": dict(num_envs=8),
    "128 plants": dict(num_envs=128),
    "learning rate held at 1e-3": dict(learning_rate=1e-3, learning_rate_end=1.0),
    "tau 0.005": dict(tau=0.005),
}
PEERS = {  # Stable-Baselines3: plants, updates per step of all plants, learning rate and its end, tau
    "SB3, its own settings": dict(num_envs=1, updates=1, learning_rate=3e-4, end=1.0, tau=0.005),
    "SB3, our settings": dict(num_envs=32, updates=4, learning_rate=3e-3, end=0.0, tau=0.02),
}
LINES = {"default": (BLUE, "-"), "SB3, its own settings": (RED, "--"), "SB3, our settings": (ORANGE, "-.")}
QUICK = dict(total_timesteps=2000, eval_every=1000, eval_episodes=20)
QUALITIES = (3.0, 2.5, 2.2)  # percent, robust median error


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["ablation", "peer", "profile"] = "ablation"
    """ablation: settings of sac_her_branching.py; peer: Stable-Baselines3; profile: one update, part by part"""
    seeds: int = 3
    """training seeds per variant"""


def in_order(rows):
    """By variant and seed; they are run seed by seed, so that what disturbs one variant disturbs all."""
    order = [*VARIANTS, *PEERS]
    return sorted(rows, key=lambda row: (order.index(row["variant"]), int(row["seed"])))


def ours(args):
    """Evaluations of every run of sac_her_branching.py."""
    seeds, few = (1, QUICK) if args.quick else (args.seeds, {})
    variants = list(VARIANTS)[: 2 if args.quick else None]
    runs = [(variant, args.seed + i) for i in range(seeds) for variant in variants]
    agents, rows = [VARIANTS[variant] | few | dict(seed=seed) for variant, seed in runs], []
    for (variant, seed), folder in zip(runs, common.train(agents, args.runs, args.jobs)):
        noted = without(common.record(folder), "wall_seconds")
        evaluations = common.read(folder / "evaluations.csv")
        rows += [{"variant": variant, "seed": seed} | row | noted for row in evaluations]
    return in_order(rows)


def peers(args):
    """Evaluations of every run of Stable-Baselines3."""
    seeds, variants = (1, list(PEERS)[-1:]) if args.quick else (args.seeds, PEERS)
    todo = [(variant, args.seed + i, args.quick) for i in range(seeds) for variant in variants]
    rows = common.collect(peer, todo, args.runs, args.jobs)
    return in_order([row | {"jobs": args.jobs, "machine": common.machine()} for row in rows])


def peer(cell):
    """Evaluations of one run of Stable-Baselines3 on the goal environment, with the networks' inputs of sac_her_branching.py."""
    import gymnasium as gym
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Features(BaseFeaturesExtractor):
        def __init__(self, observation_space):
            super().__init__(observation_space, features_dim=len(cstr.X_LOW) + len(cstr.GOAL_INDEX))
            self.scaling = Scaling.of(cstr)

        def forward(self, obs):
            return self.scaling.features(obs["observation"], obs["desired_goal"], "error")

    class Evaluate(BaseCallback):
        """Rows of evaluations.csv, and a clock that stops for them."""

        def _on_training_start(self):
            self.rows, self.tick, self.due = [], time.perf_counter(), every

        def _on_step(self):
            if self.num_timesteps >= self.due:
                seconds = time.perf_counter() - self.tick
                row = {"variant": variant, "seed": seed, "step": self.num_timesteps}
                row |= {"updates": self.model._n_updates, "train_seconds": round(seconds, 2)}
                self.rows.append(row | evaluation_row(self, 20 if quick else 200))
                self.due += every
                self.tick = time.perf_counter() - seconds
            return True

        plant = cstr

        def act(self, x, goal):
            goals = np.broadcast_to(goal, (len(x), len(goal)))
            obs = {"observation": x, "achieved_goal": x[:, cstr.GOAL_INDEX], "desired_goal": goals}
            return self.model.predict(obs, deterministic=True)[0]

    variant, seed, quick = cell
    torch.set_num_threads(1)
    settings, every, total = PEERS[variant], 1_000 if quick else 10_000, 2_000 if quick else 100_000
    start, end = settings["learning_rate"], settings["end"]
    num_envs = settings["num_envs"]
    first = max(1_000, num_envs * (cstr.EPISODE_STEPS + 1))  # its replay needs a whole episode of each plant
    vec = make_vec_env(functools.partial(gym.make, cstr.ENV_ID), num_envs, seed=seed)
    # the same networks, discount, batch, share of hindsight goals and buffer as sac_her_branching.py
    model = SAC(
        "MultiInputPolicy",
        vec,
        learning_rate=lambda left: start * (end + (1 - end) * left),
        buffer_size=200_000,
        learning_starts=first,
        batch_size=256,
        tau=settings["tau"],
        gamma=0.99,
        gradient_steps=settings["updates"],
        seed=seed,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=dict(n_sampled_goal=4, goal_selection_strategy="future"),
        policy_kwargs=dict(net_arch=[64, 64], activation_fn=nn.SiLU, features_extractor_class=Features),
        device="cpu",
    )
    callback = Evaluate()
    model.learn(total, callback=callback)
    return callback.rows


def profile(args):
    """Median times of the parts of an update and of a step of the plants, ms."""
    torch.set_num_threads(1)
    settings = sac.Args()
    agent, rng = sac.SAC(settings, cstr), np.random.default_rng(0)
    vec = envs.VectorGoalEnv("cstr", num_envs=settings.num_envs)
    obs, _ = vec.reset(seed=0)
    buffer = sac.HERBuffer(settings, cstr)
    repeats = 20 if args.quick else 400

    def add():
        nonlocal obs
        action = rng.uniform(cstr.U_LOW, cstr.U_HIGH, size=(settings.num_envs, 2))
        next_obs, _, _, truncated, infos = vec.step(action)
        reached = infos["final_obs"]["observation"] if "final_obs" in infos else next_obs["observation"]
        buffer.add(obs["observation"], action, obs["desired_goal"], reached, None, truncated)
        obs = next_obs

    for _ in range(200):
        add()
    x, u, goal, x_next = buffer.sample(settings.batch_size, agent.generator)
    features, scaled = agent.features(x, goal), (u - agent.scaling.u_center) / agent.scaling.u_scale

    def critics():
        agent.optimisers["critic"].zero_grad()
        agent.critic(features, scaled).square().mean().backward()

    def actor():
        agent.optimisers["actor"].zero_grad()
        action, log_prob = agent.actor.sample(features, agent.generator)
        loss = (log_prob - agent.critic(features, action).amin(0)).mean()
        loss.backward(inputs=list(agent.actor.parameters()))

    def targets():
        with torch.no_grad():
            agent.targets(goal, x_next)

    def averages():
        with torch.no_grad():
            for slow, fast in zip(agent.target.parameters(), agent.critic.parameters()):
                slow.lerp_(fast, settings.tau)

    def update():
        x, u, goal, x_next = buffer.sample(settings.batch_size, agent.generator)
        agent.update_critic(x, u, goal, x_next)
        agent.update_actor(x, goal)

    parts = {
        "replay with hindsight": lambda: buffer.sample(settings.batch_size, agent.generator),
        "targets": targets,
        "critics, forward and backward": critics,
        "critics, Adam": agent.optimisers["critic"].step,
        "target networks": averages,
        "actor, forward and backward": actor,
        "actor, Adam": agent.optimisers["actor"].step,
        "whole update": update,
        "exploring actions": lambda: agent.explore(obs["observation"], obs["desired_goal"]),
        "step of all plants and storing": add,
    }
    rows, steps = [], settings.total_timesteps / settings.num_envs
    for name, part in parts.items():
        times = []
        for _ in range(repeats):
            tick = time.perf_counter()
            part()
            times.append(1e3 * (time.perf_counter() - tick))
        per_step = name in ("exploring actions", "step of all plants and storing")
        calls = steps if per_step else steps * settings.num_envs / settings.steps_per_update
        row = {"part": name, "ms_median": np.median(times), "ms_p95": np.quantile(times, 0.95)}
        row = rounded(row, 4) | {"seconds_in_a_run": round(np.median(times) * calls / 1e3, 2)}
        rows.append(row | {"machine": common.machine()})
    return rows


def time_to(rows, quality):
    """Training seconds at the first evaluation of a run with at most this robust median error, infinite if there is none."""
    return min(
        (float(row["train_seconds"]) for row in rows if float(row["robust_median_ape"]) <= quality),
        default=np.inf,
    )


def runs_of(rows):
    """{variant: list over seeds of the rows of a run}"""
    return {name: list(grouped(mine, "seed").values()) for name, mine in grouped(rows, "variant").items()}


def last(runs, key):
    """A column at the ends of runs."""
    return np.array([float(run[-1][key]) for run in runs])


def print_profile(rows):
    for row in rows:
        print(
            f"{row['part']:32s} {float(row['ms_median']):8.3f} ms   {row['seconds_in_a_run']:>6s} s of a run"
        )


def print_runs(rows):
    qualities = ", ".join(map(str, QUALITIES))
    head = "robust error %     nominal  seconds  transitions  runs that reach"
    print(f"{'':36s}  {head} {qualities} %")
    print(f"{'':36s}  IQM [min, max]         IQM   median  per second   (median seconds of those)")
    for variant, runs in runs_of(rows).items():
        keys = ("robust_median_ape", "nominal_median_ape", "train_seconds", "step")
        robust, nominal, seconds, steps = (last(runs, key) for key in keys)
        reached = []
        for quality in QUALITIES:
            times = np.array([time_to(run, quality) for run in runs])
            done = np.isfinite(times)
            median = f" ({np.median(times[done]):.0f})" if done.any() else ""
            reached.append(f"{done.sum()} of {len(runs)}{median}")
        text = f"{trim_mean(robust, 0.25):.2f} [{robust.min():.2f}, {robust.max():.2f}]"
        text += f"  {trim_mean(nominal, 0.25):6.2f}  {np.median(seconds):7.1f}  {np.median(steps / seconds):11.0f}"
        print(f"{variant:36s}  {text}  {', '.join(reached)}")


def plot(ablation, peers, path):
    """Robust error against training time: every variant's end on the left, the curves of ours and of Stable-Baselines3 on the right."""
    fig, axes = common.subplots(1, 2, figsize=(10, 4.4))
    runs, names = runs_of(ablation), []
    for y, (variant, mine) in enumerate(runs.items()):
        robust = last(mine, "robust_median_ape")
        axes[0].plot(robust, [y] * len(robust), "o", color=BLUE if y == 0 else GREY, ms=4, alpha=0.7)
        axes[0].plot(trim_mean(robust, 0.25), y, "|", color="black", ms=14, mew=2)
        names.append(f"{variant}  ({np.median(last(mine, 'train_seconds')):.0f} s)")
    axes[0].set_yticks(range(len(runs)), names, fontsize=8)
    axes[0].invert_yaxis()
    axes[0].set_xlabel("robust error at the end of a run [%]")
    axes[0].set_title("dots: seeds, bar: interquartile mean; median time", fontsize=9)
    runs |= runs_of(peers)
    for variant, (colour, dashes) in LINES.items():
        for i, run in enumerate(runs.get(variant, [])):
            x, y = column(run, "train_seconds"), column(run, "robust_median_ape")
            label = None if i else {"default": "this repository"}.get(variant, variant)
            axes[1].plot(x, y, color=colour, ls=dashes, lw=1.3, alpha=0.8, label=label)
    axes[1].axhline(2.2, color="black", lw=1, ls=":", label="2.2 %")
    axes[1].set(xscale="log", xlabel="training time on one core [s]", yscale="log", ylabel="robust error [%]")
    axes[1].set_title("a line per seed", fontsize=9)
    for axis, ticks in ((axes[1].xaxis, (3, 10, 30, 100, 300)), (axes[1].yaxis, (2, 3, 5, 10, 20, 50))):
        axis.set_ticks(ticks, [str(tick) for tick in ticks])
        axis.set_ticks([], minor=True)
    axes[1].legend(fontsize=8, loc="upper right")
    for ax in axes:
        ax.grid(alpha=0.3)
    common.save(fig, path)


def main(args):
    name = f"training_speed_{args.study}"
    common.check(args, name, seeds=(1, 1000))
    if not args.plot_only:
        study = {"ablation": ours, "peer": peers, "profile": profile}[args.study]
        common.write(study(args), args.table(name))
    rows = common.read(args.table(name))
    if args.study == "profile":
        return print_profile(rows)
    print_runs(rows)
    tables = [args.table(f"training_speed_{study}") for study in ("ablation", "peer")]
    if all(table.exists() for table in tables):
        plot(*map(common.read, tables), args.figure("training_speed"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
