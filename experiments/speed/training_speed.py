"""Where the training time of the CSTR agent goes, what its settings buy, and Stable-Baselines3's SAC + HER on the same environment.

    python experiments/speed/training_speed.py --study ablation --jobs 2    # half an hour: one setting changed at a time, 5 seeds
    python experiments/speed/training_speed.py --study peer --jobs 2        # an hour: Stable-Baselines3 (requirements-dev.txt), 3 seeds
    python experiments/speed/training_speed.py --study profile              # a minute: the parts of one update; nothing else should run
    python experiments/speed/training_speed.py --study ablation --plot-only

Runs are told apart by variant and seed and kept, so that a second call continues. Times are of training alone, evaluations left out, one
thread per run. Writes results/training_speed_NAME.csv for NAME in ablation, peer, profile (ablation and peer: a row per evaluation) and
figures/training_speed.png, which needs both.
"""

import functools
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn as nn
import tyro
from scipy.stats import trim_mean

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import sac_her_branching as sac
from envs import cstr
from envs.agents.evaluation import evaluation_row
from envs.agents.policy import Scaling
from experiments import common as cells
from experiments.common import HERE, ROOT

VARIANTS = {  # of the arguments of sac_her_branching.py
    "default": [],
    "update per 4 transitions": ["--steps-per-update", "4"],
    "update per 16 transitions": ["--steps-per-update", "16"],
    "batch 128": ["--batch-size", "128"],
    "batch 512": ["--batch-size", "512"],
    "batch 512, update per 16": ["--batch-size", "512", "--steps-per-update", "16"],
    "batch 1024, update per 32": ["--batch-size", "1024", "--steps-per-update", "32"],
    "8 plants": ["--num-envs", "8"],
    "128 plants": ["--num-envs", "128"],
    "learning rate held at 1e-3": ["--learning-rate", "1e-3", "--learning-rate-end", "1"],
    "tau 0.005": ["--tau", "0.005"],
    "4 branches in the targets": ["--branches", "4"],
    "half the transitions, update per 4": ["--total-timesteps", "50000", "--steps-per-update", "4"],
}
PEERS = {  # Stable-Baselines3: plants, updates per step of all plants, learning rate and its end, tau
    "SB3, its own settings": dict(num_envs=1, updates=1, learning_rate=3e-4, end=1.0, tau=0.005),
    "SB3, our settings": dict(num_envs=32, updates=4, learning_rate=3e-3, end=0.0, tau=0.02),
}
QUALITIES = (3.0, 2.5, 2.2)  # percent, robust median error


@dataclass(frozen=True)
class Args:
    study: Literal["ablation", "peer", "profile"] = "ablation"
    """ablation: settings of sac_her_branching.py; peer: Stable-Baselines3; profile: one update, part by part"""
    seeds: int = 5
    """training seeds per variant (peer: 3 at most)"""
    seed: int = 0
    """the first of them"""
    jobs: int = 1
    """runs at a time, each on one thread"""
    quick: bool = False
    """2,000 transitions, two variants, one seed: a smoke test"""
    plot_only: bool = False
    """redraw from the CSV"""
    runs: Path = Path("runs/training_speed")
    """where finished runs are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def ours(cell):
    """Evaluations of one run of sac_her_branching.py, in a process of its own."""
    variant, seed, quick = cell
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            str(ROOT / "sac_her_branching.py"),
            "--seed",
            str(seed),
            "--save-every",
            "0",
            "--out",
            folder,
        ]
        command += VARIANTS[variant]
        if quick:
            command += ["--total-timesteps", "2000", "--eval-every", "1000", "--eval-episodes", "20"]
        subprocess.run(command, check=True, capture_output=True)
        return [
            {"variant": variant, "seed": seed} | row
            for row in cells.read(next(Path(folder).glob("*/evaluations.csv")))
        ]


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
                row = evaluation_row(self, 20 if quick else 200)
                updates = {
                    "step": self.num_timesteps,
                    "updates": self.model._n_updates,
                    "train_seconds": round(seconds, 2),
                }
                self.rows.append({"variant": variant, "seed": seed} | updates | row)
                self.due += every
                self.tick = time.perf_counter() - seconds
            return True

        plant = cstr

        def act(self, x, goal):
            obs = {
                "observation": x,
                "achieved_goal": x[:, cstr.GOAL_INDEX],
                "desired_goal": np.broadcast_to(goal, (len(x), len(goal))),
            }
            return self.model.predict(obs, deterministic=True)[0]

    variant, seed, quick = cell
    torch.set_num_threads(1)
    settings, every, total = PEERS[variant], 1_000 if quick else 10_000, 2_000 if quick else 100_000
    start, end = settings["learning_rate"], settings["end"]
    first = max(
        1_000, settings["num_envs"] * (cstr.EPISODE_STEPS + 1)
    )  # its replay needs a whole episode of each plant
    vec = make_vec_env(functools.partial(gym.make, cstr.ENV_ID), settings["num_envs"], seed=seed)
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
        (log_prob - agent.critic(features, action).amin(0)).mean().backward(
            inputs=list(agent.actor.parameters())
        )

    def targets():
        with torch.no_grad():
            agent.targets(goal, x_next)

    def averages():
        with torch.no_grad():
            torch._foreach_lerp_(
                list(agent.target.parameters()), list(agent.critic.parameters()), settings.tau
            )

    parts = {
        "replay with hindsight": lambda: buffer.sample(settings.batch_size, agent.generator),
        "targets": targets,
        "critics, forward and backward": critics,
        "critics, Adam": agent.optimisers["critic"].step,
        "target networks": averages,
        "actor, forward and backward": actor,
        "actor, Adam": agent.optimisers["actor"].step,
        "whole update": lambda: (
            buffer.sample(settings.batch_size, agent.generator),
            agent.update_critic(x, u, goal, x_next),
            agent.update_actor(x, goal),
        ),
        "exploring actions": lambda: agent.explore(obs["observation"], obs["desired_goal"]),
        "step of all plants and storing": add,
    }
    rows, updates = [], settings.num_envs / settings.steps_per_update
    for name, part in parts.items():
        times = []
        for _ in range(repeats):
            tick = time.perf_counter()
            part()
            times.append(1e3 * (time.perf_counter() - tick))
        per_step = name in ("exploring actions", "step of all plants and storing")
        share = (
            np.median(times)
            * (1 if per_step else updates)
            * settings.total_timesteps
            / settings.num_envs
            / 1e3
        )
        rows.append(
            {
                "part": name,
                "ms_median": round(np.median(times), 4),
                "ms_p95": round(np.quantile(times, 0.95), 4),
                "seconds_in_a_run": round(share, 2),
                "machine": cells.machine(),
            }
        )
        print(f"{name:32s} {rows[-1]['ms_median']:8.3f} ms   {share:6.2f} s of a run")
    cells.write(rows, args.out / "results/training_speed_profile.csv")


def time_to(rows, quality):
    """Training seconds at the first evaluation of a run with at most this robust median error, infinite if there is none."""
    return min(
        (float(row["train_seconds"]) for row in rows if float(row["robust_median_ape"]) <= quality),
        default=np.inf,
    )


def runs_of(rows):
    """{variant: list over seeds of the rows of a run}"""
    found = {}
    for row in rows:
        found.setdefault(row["variant"], {}).setdefault(row["seed"], []).append(row)
    return {variant: list(by_seed.values()) for variant, by_seed in found.items()}


def table(rows):
    print(
        f"{'':36s}  robust error %     nominal  seconds  transitions  runs that reach {', '.join(map(str, QUALITIES))} %"
    )
    print(f"{'':36s}  IQM [min, max]         IQM   median  per second   (median seconds of those)")
    for variant, runs in runs_of(rows).items():
        robust, nominal, seconds = (
            np.array([float(run[-1][key]) for run in runs])
            for key in ("robust_median_ape", "nominal_median_ape", "train_seconds")
        )
        reached = []
        for quality in QUALITIES:
            times = np.array([time_to(run, quality) for run in runs])
            done = np.isfinite(times)
            reached.append(
                f"{done.sum()} of {len(runs)}" + (f" ({np.median(times[done]):.0f})" if done.any() else "")
            )
        speed = np.median([float(run[-1]["step"]) / float(run[-1]["train_seconds"]) for run in runs])
        print(
            f"{variant:36s}  {trim_mean(robust, 0.25):.2f} [{robust.min():.2f}, {robust.max():.2f}]  {trim_mean(nominal, 0.25):6.2f}  "
            f"{np.median(seconds):7.1f}  {speed:11.0f}  {', '.join(reached)}"
        )


def plot(args):
    """Robust error against training time: every variant's end on the left, the curves of ours and of Stable-Baselines3 on the right."""
    ablation, peers = (
        cells.read(args.out / f"results/training_speed_{name}.csv") for name in ("ablation", "peer")
    )
    fig, axes = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    runs = runs_of(ablation)
    for y, (variant, mine) in enumerate(runs.items()):
        robust = [float(run[-1]["robust_median_ape"]) for run in mine]
        colour = "#0072B2" if variant == "default" else "#999999"
        axes[0].plot(robust, [y] * len(robust), "o", color=colour, ms=4, alpha=0.7)
        axes[0].plot(trim_mean(robust, 0.25), y, "|", color="black", ms=14, mew=2)
    seconds = {
        variant: np.median([float(run[-1]["train_seconds"]) for run in mine])
        for variant, mine in runs.items()
    }
    axes[0].set_yticks(
        range(len(runs)), [f"{variant}  ({seconds[variant]:.0f} s)" for variant in runs], fontsize=8
    )
    axes[0].invert_yaxis()
    axes[0].set(
        xlabel="robust error at the end of a run [%]",
        title="dots: seeds, bar: interquartile mean; median time",
    )
    curves = {"default": ("#0072B2", "-", "this repository")}
    curves |= {
        name: (colour, dashes, name)
        for name, colour, dashes in zip(PEERS, ("#D55E00", "#E69F00"), ("--", "-."))
    }
    for variant, (colour, dashes, name) in curves.items():
        mine = runs_of(ablation + peers).get(variant, [])
        for i, run in enumerate(mine):
            x, y = ([float(row[key]) for row in run] for key in ("train_seconds", "robust_median_ape"))
            axes[1].plot(x, y, color=colour, ls=dashes, lw=1.3, alpha=0.8, label=name if i == 0 else None)
    axes[1].axhline(2.2, color="black", lw=1, ls=":", label="2.2 %")
    axes[1].set(
        xscale="log",
        yscale="log",
        xlabel="training time on one core [s]",
        ylabel="robust error [%]",
        title="a line per seed",
    )
    for axis, ticks in ((axes[1].xaxis, (3, 10, 30, 100, 300)), (axes[1].yaxis, (2, 3, 5, 10, 20, 50))):
        axis.set_ticks(ticks, [str(tick) for tick in ticks])
        axis.set_ticks([], minor=True)
    axes[1].legend(fontsize=8, loc="upper right")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.title.set_fontsize(9)
    path = args.out / "figures/training_speed.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(args):
    cells.check(args, f"training_speed_{args.study}.csv", seeds=(1, 1000), seed=(0, 10**9), jobs=(1, 1024))
    result = args.out / f"results/training_speed_{args.study}.csv"
    if args.study == "profile":
        if not args.plot_only:
            profile(args)
        return
    if not args.plot_only:
        variants = list(VARIANTS if args.study == "ablation" else PEERS)
        if args.quick:
            variants = variants[-1:] if args.study == "peer" else variants[:2]
        seeds = 1 if args.quick else args.seeds if args.study == "ablation" else min(args.seeds, 3)
        todo = [(variant, args.seed + i, args.quick) for i in range(seeds) for variant in variants]
        inputs = [
            ROOT / "sac_her_branching.py",
            ROOT / "envs/__init__.py",
            ROOT / "envs/cstr.py",
        ]
        rows = cells.collect(ours if args.study == "ablation" else peer, todo, args.jobs, args.runs, inputs)
        rows.sort(key=lambda row: (variants.index(row["variant"]), int(row["seed"])))
        cells.write([row | {"jobs": args.jobs, "machine": cells.machine()} for row in rows], result)
    table(cells.read(result))
    if all((args.out / f"results/training_speed_{name}.csv").exists() for name in ("ablation", "peer")):
        plot(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
