# /// script
# requires-python = ">=3.11"
# dependencies = ["torch==2.13.0", "gymnasium==1.4.0", "numpy", "tyro", "tensorboard", "tqdm"]
# ///
"""Soft actor-critic with hindsight experience replay over branched rollouts: a robust goal-conditioned critic.

The plant's uncertain parameters psi are drawn anew from a scenario set, by default at every step (eq:offlineMDP), so that the critic
learns the value averaged over scenarios (eq:robustQ). With `--branches K` every transition carries K next states under
independently drawn scenarios, and their *targets* are averaged:

    y = 1/K sum_i [ r(s'_i, g) + gamma ( min_j Qbar_j(s'_i, a'_i, g) - alpha log pi(a'_i | s'_i, g) ) ],   a'_i ~ pi(. | s'_i, g)

HER (eq:relabeled) replaces the goal of most samples by something that the same episode achieved, by default later.

    python sac_her_branching.py --env cstr                        # the robust agent of the paper's Example 3
    python sac_her_branching.py --env cstr --scenarios nominal    # the nominal agent it is compared with
    python sac_her_branching.py --observe-mismatch --scenario-hold episode    # an agent that tells its plant from the last transition
    python sac_her_branching.py --resume runs/NAME/resume.pt      # continue an interrupted run, to the same numbers

It writes `runs/{env}__sac_her_branching__{seed}__{time}/`: tensorboard events, evaluations.csv, checkpoint.pt (what
`load_policy` and rl_mpc_deploy.py read) and resume.pt. Only the folder `envs/` is needed beside this file.
"""

import csv
import os
import signal
import sys
import time
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import envs

# of the arguments that a plant's TRAINING may set
DEFAULTS = {"hidden": (64, 64), "total_timesteps": 100_000, "num_envs": 32, "gamma": 0.99, "steps_per_update": 8, "learning_starts": 1_000,
            "buffer_size": 200_000, "alpha_init": 1.0}  # fmt: skip


MAX_CHECKPOINT_BYTES = 10**9


@dataclass
class Args:
    env: str = "cstr"
    """the plant: NAME of a module envs/NAME.py"""
    dim: int | None = None
    """number of states, for a plant that comes in sizes (linear: 2)"""
    system: int | None = None
    """which one, for a plant that comes in several (linear: the seed of its matrix, 0)"""
    seed: int = 0
    """seed of networks, plants, exploration and replay; same seed, same machine, same numbers"""
    total_timesteps: int | None = None
    """transitions to collect, over all parallel plants; default: the plant's (cstr: 100000, linear: 500000)"""
    num_envs: int | None = None
    """plants simulated in parallel; default: the plant's (cstr: 32, linear: 64)"""
    scenarios: Literal["robust", "nominal", "mpc"] = "robust"
    """where psi is drawn from: the training grid, the nominal plant, or the MPC's scenario set"""
    scenario_hold: Literal["step", "episode"] = "step"
    """how long a scenario lasts: drawn anew at every step, as in the paper, or once per episode"""
    observe_mismatch: bool = False
    """let the agent see how the last transition differed from the nominal model, which tells what plant it is on; give --scenario-hold
    episode too. Lowers the default of --gamma to 0.95"""
    branches: int = 1
    """K, next states per transition whose targets are averaged; 1 is the paper's sampling: the one that the episode follows"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where the networks live; auto takes cuda where there is one"""
    torch_threads: int = 1
    """CPU threads of torch; networks this small run fastest on one"""

    her_strategy: Literal["future", "final", "episode"] = "future"
    """hindsight goal: what was achieved later in the episode, at its end, or anywhere in it"""
    her_ratio: float = 0.8
    """share of the samples whose goal is replaced in hindsight; 0 turns HER off"""
    smooth_reward: bool = True
    """Gaussian reward (eq:cstrreward); off: the 0/1 reward (eq:sparsereward)"""
    reward_sigma2: float | None = None
    """sigma^2 of the Gaussian reward, squared units of the goal error; default: the plant's (cstr: 1e-4)"""
    reward_tolerance: float | None = None
    """half-width of the 0/1 reward, units of the goal error; default: the plant's (cstr: 0.01)"""
    constraint_weight: float = 0.0
    """weight of the measure of time outside constraints, exp(-|x - clip(x)|^2 / 0.02) - 1, in the reward; 0: the paper's agent"""
    goal_input: Literal["error", "goal"] = "error"
    """what the networks see beside the state: goal minus achieved goal, or the goal itself"""

    hidden: tuple[int, ...] | None = None
    """widths of the hidden layers of actor and critics (SiLU); default: the plant's (cstr: 64 64, linear: 256 256)"""
    gamma: float | None = None
    """discount; default: the plant's (cstr: 0.99, linear: 0.9)"""
    tau: float = 0.02
    """step of the target networks towards the critics after each update"""
    batch_size: int = 256
    """transitions per update"""
    learning_rate: float = 3e-3
    """of actor, critics and entropy coefficient (Adam), at the start"""
    learning_rate_end: float = 0.0
    """learning rate at the end of the run, as a share of the initial one (it falls linearly)"""
    learning_starts: int | None = None
    """transitions with uniformly random actions before the first update; default: the plant's (cstr: 1000,
    linear: 10000)"""
    steps_per_update: int | None = None
    """transitions collected per update; default: the plant's (cstr: 8, linear: 16)"""
    entropy_in_target: bool = True
    """SAC's soft value; off: the critic counts reward alone, the actor still maximises Q plus entropy"""
    add_plant_data: Path | None = None
    """a trajectories.npz of rl_mpc_deploy.py: closed loops of plants that the simulation stands for, put into the replay buffer first"""
    buffer_size: int | None = None
    """transitions that the replay buffer holds; default: the plant's (cstr: 200000)"""
    target_entropy: float | None = None
    """entropy that the coefficient alpha is tuned to; default: minus the number of actions"""
    alpha_init: float | None = None
    """entropy coefficient at the start; default: the plant's (cstr: 1, linear: 0.005)"""

    eval_every: int = 10_000
    """transitions between evaluations; 0: only at the end"""
    eval_episodes: int = 200
    """start states of an evaluation (nominal and robust)"""
    save_every: int = 50_000
    """transitions between checkpoints; 0: only at the end"""
    resume: Path | None = None
    """a resume.pt: continue that run in its folder, with the arguments that it was started with"""
    out: Path = Path("runs")
    """folder that the run's own folder is made in"""

    def __post_init__(self):
        """Arguments left out take the plant's value."""
        if self.env in envs.names():
            defaults = DEFAULTS | envs.load(self.env).TRAINING
            if self.observe_mismatch:
                defaults["gamma"] = min(defaults["gamma"], 0.95)
            for name, value in defaults.items():
                if getattr(self, name) is None:
                    setattr(self, name, value)

    @property
    def plant_options(self):
        """What `envs.load` needs beside the plant's name."""
        options = {"dim": self.dim, "system": self.system, "observe_mismatch": self.observe_mismatch or None}
        return {name: value for name, value in options.items() if value is not None}


# Networks. They see normalised inputs; `Scaling` is the only place where physical units are left and entered.


class Scaling:
    """Affine maps between physical and network units, kept in the checkpoint as plain lists."""

    def __init__(self, device="cpu", **values):
        self.values = values
        for name, value in values.items():
            setattr(self, name, torch.tensor(value, device=device, dtype=torch.long if name.endswith("index") else torch.float32))

    @classmethod
    def of(cls, plant, device="cpu"):
        def affine(name, low, high):
            half = np.where(high > low, (high - low) / 2, 1.0)  # a mismatch starts at zero and has unit scale already
            return {f"{name}_center": ((low + high) / 2).tolist(), f"{name}_scale": half.tolist()}

        i, n_x = plant.GOAL_INDEX, len(plant.INIT_LOW)
        goals = affine("goal", plant.INIT_LOW[i], plant.INIT_HIGH[i])
        columns = list(range(n_x)) + i  # of [x, goal]: the state that each is about
        angles = [j for j, state in enumerate(columns) if state in plant.ANGLES]
        others = [j for j in range(len(columns)) if j not in angles]
        return cls(device, **affine("x", plant.INIT_LOW, plant.INIT_HIGH), **affine("u", plant.U_LOW, plant.U_HIGH), **goals,
                   error_scale=plant.ERROR_SCALE.tolist(), goal_index=i, angle_index=angles, other_index=others)  # fmt: skip

    def features(self, x, goal, goal_input):
        """Physical state (B, n_x) and goal (B, n_goal) -> network input (B, n_in), angles as sine and cosine."""
        if goal_input == "error":
            g = goal = goal - x[:, self.goal_index]
            g = g / self.error_scale
        else:
            g = (goal - self.goal_center) / self.goal_scale
        z = torch.cat([(x - self.x_center) / self.x_scale, g], dim=-1)
        if not len(self.angle_index):
            return z
        angles = torch.cat([x, goal], dim=-1)[:, self.angle_index]
        return torch.cat([z[:, self.other_index], torch.sin(angles), torch.cos(angles)], dim=-1)


class Actor(nn.Module):
    """Tanh-Gaussian policy, features (B, n_in) -> action in [-1, 1]^n_u."""

    LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0  # CleanRL's sac_continuous_action.py, after spinning-up

    def __init__(self, n_in, n_u, hidden):
        super().__init__()
        widths = [n_in, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:]))
        self.head = nn.Linear(widths[-1], 2 * n_u)  # mean and log standard deviation before tanh

    def forward(self, z):
        for layer in self.layers:
            z = F.silu(layer(z))
        return self.head(z).chunk(2, dim=-1)

    def act(self, z):
        """The deterministic action mu(s, g) = tanh(mean)."""
        return torch.tanh(self(z)[0])

    def sample(self, z, generator):
        """A sampled action (B, n_u) and its log probability (B,)."""
        mean, log_std = self(z)
        log_std = self.LOG_STD_MIN + 0.5 * (self.LOG_STD_MAX - self.LOG_STD_MIN) * (torch.tanh(log_std) + 1)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        pre_tanh = mean + log_std.exp() * noise
        # log(1 - tanh(v)^2) = 2 (log 2 - v - softplus(-2v)) does not cancel where tanh saturates
        log_prob = -0.5 * noise**2 - log_std - 0.9189385332 - 2 * (0.6931471806 - pre_tanh - F.softplus(-2 * pre_tanh))
        return torch.tanh(pre_tanh), log_prob.sum(-1)


class TwinCritic(nn.Module):
    """Two Q networks evaluated as one batched product: features (B, n_in) and action (B, n_u) -> (2, B)."""

    def __init__(self, n_in, n_u, hidden):
        super().__init__()
        widths = [n_in + n_u, *hidden, 1]
        self.weight = nn.ParameterList(torch.empty(2, a, b) for a, b in zip(widths, widths[1:]))
        self.bias = nn.ParameterList(torch.empty(2, 1, b) for b in widths[1:])
        for w, b in zip(self.weight, self.bias):  # as nn.Linear starts
            bound = w.shape[1] ** -0.5
            nn.init.uniform_(w, -bound, bound)
            nn.init.uniform_(b, -bound, bound)

    def forward(self, z, a):
        h = torch.cat([z, a], dim=-1).expand(2, -1, -1)
        *hidden, (w_out, b_out) = zip(self.weight, self.bias)  # a slice of a ParameterList would make a new module each time
        for w, b in hidden:
            h = F.silu(torch.baddbmm(b, h, w))
        return torch.baddbmm(b_out, h, w_out).squeeze(-1)


class Policy:
    """A trained agent for people: batched numpy arrays in physical units."""

    def __init__(self, plant, actor, critic, scaling, goal_input):
        self.plant, self.actor, self.critic, self.scaling, self.goal_input = plant, actor, critic, scaling, goal_input

    def _features(self, x, goal, mismatch=None):
        x = np.atleast_2d(x)
        if isinstance(self.plant, envs.Mismatch) and x.shape[1] == len(self.plant.MISMATCH_SCALE):
            x = np.hstack([x, np.zeros_like(x) if mismatch is None else np.broadcast_to(mismatch, x.shape)])
        x = torch.as_tensor(x, dtype=torch.float32, device=self.scaling.x_center.device)
        goal = torch.as_tensor(np.atleast_2d(goal), dtype=torch.float32, device=x.device).expand(len(x), -1)
        return self.scaling.features(x, goal, self.goal_input)

    @torch.no_grad()
    def act(self, x, goal, mismatch=None):
        """Deterministic action u = mu(x, goal), (B, n_x) and (n_goal,) or (B, n_goal) -> (B, n_u), physical units.

        An agent that observes the mismatch takes it, (n_x,) or (B, n_x), default zero, or as further columns of x.
        """
        return (self.actor.act(self._features(x, goal, mismatch)) * self.scaling.u_scale + self.scaling.u_center).cpu().numpy()

    @torch.no_grad()
    def value(self, x, goal, mismatch=None):
        """V(x, goal) = min_j Q_j(x, mu(x, goal), goal), (B,). It contains SAC's entropy bonus unless trained without."""
        z = self._features(x, goal, mismatch)
        return self.critic(z, self.actor.act(z)).amin(0).cpu().numpy()


def load_policy(path, device="cpu"):
    """The agent stored in a checkpoint.pt, which is data, never code. Raises ValueError, one sentence, for anything else."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_CHECKPOINT_BYTES:
            raise ValueError(f"larger than {MAX_CHECKPOINT_BYTES / 1e9:g} gigabytes")
        if zipfile.ZipFile(path).testzip():
            raise ValueError("damaged")
        data = torch.load(path, map_location=device, weights_only=True)
        if data["format"] != "rlmpc-sac-her-branching-1":
            raise ValueError("of another format")
        if data["goal_input"] not in ("error", "goal"):
            raise ValueError(f"unknown goal_input {data['goal_input']!r}")
        plant = envs.load(data["env"], **data.get("plant_options", {}))
        with torch.device("meta"):  # sizes take no memory until the file's own weights are put in, if they fit
            actor, critic = Actor(**data["network"]), TwinCritic(**data["network"])
        actor.load_state_dict(data["actor"], assign=True)
        critic.load_state_dict(data["critic"], assign=True)
        if not all(p.isfinite().all() for p in [*actor.parameters(), *critic.parameters()]):
            raise ValueError("weights that are not finite")
        if not all((np.asarray(v, dtype=float) > 0).all() for name, v in data["scaling"].items() if name.endswith("scale")):
            raise ValueError("scales that are not positive")
        policy = Policy(plant, actor.float(), critic.float(), Scaling(device, **data["scaling"]), data["goal_input"])
        if not np.isfinite(policy.value(plant.START, plant.EVAL_GOAL)).all():
            raise ValueError("values that are not finite")
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; it must be a checkpoint.pt of this script") from None
    except Exception as error:  # text, a truncated file, a folder, a pickle of code, weights that do not fit: torch raises many types
        reason = str(error) if type(error) is ValueError and "\n" not in str(error) else type(error).__name__
        raise ValueError(f"{path} is not a checkpoint.pt of this script ({reason})") from None
    return policy


# Replay with hindsight


class HERBuffer:
    """Ring buffer of the parallel plants' transitions, episode after episode; goals are replaced when a batch is drawn.

    Row t % rows holds time t of every plant. Example with `future`: an episode covers t = 100 ... 149 and the sample is
    t = 120; the hindsight goal is what x_{t'+1} achieved for t' uniform in 120 ... 149, with t' = 120 among them, whose reward is full.
    """

    OPEN = 2**62  # end of an episode that is still running

    def __init__(self, capacity, num_envs, n_x, n_u, n_goal, goal_index, branches, strategy, ratio, device="cpu"):
        self.rows, self.num_envs, self.branches, self.strategy, self.ratio = capacity // num_envs, num_envs, branches, strategy, ratio
        self.goal_index, self.now = torch.tensor(goal_index, device=device), 0  # now: time steps written so far
        self.x, self.u, self.goal, self.x_next = (torch.zeros(self.rows, num_envs, n, device=device) for n in (n_x, n_u, n_goal, n_x))
        self.branch_next = torch.zeros(self.rows, num_envs, branches if branches > 1 else 0, n_x, device=device)
        # times at which the transition's episode began and ends
        self.start, self.end = torch.zeros(2, self.rows, num_envs, dtype=torch.long, device=device)
        self.episode_start = torch.zeros(num_envs, dtype=torch.long, device=device)

    def add(self, x, u, goal, x_next, branch_next, done):
        """One transition of each plant: (num_envs, ...) arrays; branch_next (num_envs, K, n_x) or None; done (num_envs,) bool."""
        row = self.now % self.rows
        stored = [(self.x, x), (self.u, u), (self.goal, goal), (self.x_next, x_next)]
        for store, value in stored + ([(self.branch_next, branch_next)] if self.branches > 1 else []):
            store[row] = torch.as_tensor(value, dtype=torch.float32)
        self.start[row] = self.episode_start
        self.end[row] = self.OPEN
        if done.any():
            done = torch.as_tensor(done, device=self.end.device)
            self.end[(self.end == self.OPEN) & done] = self.now
            self.episode_start[done] = self.now + 1
        self.now += 1

    def add_episodes(self, x, u, goal):
        """Whole episodes x (E, T + 1, n_x), u (E, T, n_u) with goals (E, n_goal); too few for a row of plants: filled up with others."""
        for first in range(0, len(x), self.num_envs):
            group, steps = np.arange(first, first + self.num_envs) % len(x), u.shape[1]
            for t in range(steps):
                self.add(x[group, t], u[group, t], goal[group], x[group, t + 1], None, np.full(self.num_envs, t == steps - 1))

    def sample(self, batch_size, generator):
        """x (B, n_x), u (B, n_u), goal (B, n_goal), next states (B, K, n_x): one goal for all branches of a transition."""
        device, oldest = self.x.device, max(0, self.now - self.rows)
        t = torch.randint(oldest, self.now, (batch_size,), generator=generator, device=device)
        env = torch.randint(self.num_envs, (batch_size,), generator=generator, device=device)
        index = t % self.rows * self.num_envs + env  # into the flattened (rows, num_envs)
        end = self.end.view(-1)[index].clamp(max=self.now - 1)
        first = {"future": t, "final": end, "episode": self.start.view(-1)[index].clamp(min=oldest)}[self.strategy]
        draw, relabel = torch.rand(2, batch_size, generator=generator, device=device)
        source = (first + (draw * (end - first + 1)).long()).clamp(max=end)
        achieved = self.x_next.view(-1, self.x_next.shape[-1])[source % self.rows * self.num_envs + env][:, self.goal_index]
        goal = torch.where((relabel < self.ratio)[:, None], achieved, self.goal.view(-1, self.goal.shape[-1])[index])
        x_next = self.branch_next.flatten(0, 1)[index] if self.branches > 1 else self.x_next.flatten(0, 1)[index][:, None]
        return self.x.flatten(0, 1)[index], self.u.flatten(0, 1)[index], goal, x_next

    def state_dict(self):
        return {k: v for k, v in vars(self).items() if torch.is_tensor(v)} | {"now": self.now}

    def load_state_dict(self, state):
        vars(self).update(state)


# Soft actor-critic


class SAC:
    """Networks, optimisers and the two update steps."""

    def __init__(self, args, plant, device):
        self.args, self.plant, self.device = args, plant, device
        self.scaling = Scaling.of(plant, device)
        n_u, n_in = len(plant.U_LOW), len(plant.INIT_LOW) + len(plant.GOAL_INDEX) + len(self.scaling.angle_index)
        self.network = dict(n_in=n_in, n_u=n_u, hidden=list(args.hidden))
        with torch.random.fork_rng(devices=[]):  # torch.nn initialises from the global generator; leave it as it was
            torch.manual_seed(args.seed)
            self.actor = Actor(**self.network).to(device)
            self.critic = TwinCritic(**self.network).to(device)
            self.target = TwinCritic(**self.network).to(device).requires_grad_(False)
        self.target.load_state_dict(self.critic.state_dict())
        self.log_alpha = torch.tensor([args.alpha_init], device=device).log().requires_grad_()
        self.target_entropy = -float(n_u) if args.target_entropy is None else args.target_entropy
        self.generator = torch.Generator(device=device).manual_seed(args.seed)

        trained = {"actor": self.actor.parameters(), "critic": self.critic.parameters(), "alpha": [self.log_alpha]}
        self.optimisers = {name: torch.optim.Adam(p, lr=args.learning_rate, fused=True) for name, p in trained.items()}
        self.policy = Policy(plant, self.actor, self.critic, self.scaling, args.goal_input)

    def features(self, x, goal):
        return self.scaling.features(x, goal, self.args.goal_input)

    @torch.no_grad()
    def explore(self, x, goal):
        """Sampled actions in physical units, (num_envs, n_u)."""
        x, goal = (torch.as_tensor(v, dtype=torch.float32, device=self.device) for v in (x, goal))
        a = self.actor.sample(self.features(x, goal), self.generator)[0]
        return (a * self.scaling.u_scale + self.scaling.u_center).cpu().numpy()

    def targets(self, goal, x_next):
        """Mean over branches of reward + discounted soft value of the next state, (B,): eq:robustQ with the entropy term."""
        a = self.args
        batch, k = x_next.shape[:2]
        x, g = x_next.flatten(0, 1), goal.repeat_interleave(k, dim=0)  # (B*K, n_x), (B*K, n_goal)
        z = self.features(x, g)
        action, log_prob = self.actor.sample(z, self.generator)
        achieved = x[:, self.scaling.goal_index]
        reward = envs.goal_reward(self.plant, achieved, g, a.smooth_reward, a.reward_sigma2, a.reward_tolerance, xp=torch)
        if a.constraint_weight:  # so that a planner cannot put a violation off to after its horizon, where it would be free
            reward = reward + a.constraint_weight * envs.outside_constraints(self.plant, x, xp=torch)
        # the plants do not terminate, and the time limit is bootstrapped through
        value = self.target(z, action).amin(0)
        if a.entropy_in_target:
            value -= self.log_alpha.exp() * log_prob
        y = reward + a.gamma * value
        return y.view(batch, k).mean(1)

    def update_critic(self, x, u, goal, x_next):
        """One step of both critics; returns what to log."""
        with torch.no_grad():
            y = self.targets(goal, x_next)
        q = self.critic(self.features(x, goal), (u - self.scaling.u_center) / self.scaling.u_scale)
        loss = 2 * F.mse_loss(q, y.expand(2, -1))  # the sum of both critics' losses
        self.optimisers["critic"].zero_grad()
        loss.backward()
        self.optimisers["critic"].step()
        with torch.no_grad():
            torch._foreach_lerp_(list(self.target.parameters()), list(self.critic.parameters()), self.args.tau)
        return {"losses/qf_loss": loss.detach(), "losses/qf_values": q.detach().mean(), "losses/targets": y.mean()}

    def update_actor(self, x, goal):
        """One step of the actor and the entropy coefficient; returns what to log."""
        z = self.features(x, goal)
        action, log_prob = self.actor.sample(z, self.generator)
        alpha = self.log_alpha.detach().exp()
        loss = (alpha * log_prob - self.critic(z, action).amin(0)).mean()
        self.optimisers["actor"].zero_grad()
        loss.backward(inputs=list(self.actor.parameters()))  # the critics' weight gradients are not wanted here
        self.optimisers["actor"].step()
        entropy = -log_prob.detach().mean()
        self.log_alpha.grad = alpha * (entropy - self.target_entropy)  # of exp(log_alpha) * (entropy - target_entropy)
        self.optimisers["alpha"].step()
        return {"losses/actor_loss": loss.detach(), "losses/alpha": alpha, "losses/entropy": entropy}

    def state_dict(self):
        modules = {name: getattr(self, name).state_dict() for name in ("actor", "critic", "target")}
        optimisers = {name: optimiser.state_dict() for name, optimiser in self.optimisers.items()}
        return modules | {"log_alpha": self.log_alpha.detach(), "optimisers": optimisers, "rng": self.generator.get_state()}

    def load_state_dict(self, state):
        for name in ("actor", "critic", "target"):
            getattr(self, name).load_state_dict(state[name])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.log_alpha.data.copy_(state["log_alpha"])
        self.generator.set_state(state["rng"].cpu())


# Evaluation and files


def evaluate(policy, goal, episodes, seed, robust):
    """The paper's protocol: start states uniform in the plant's box, one episode (cstr: 50 steps), error over its second half.

    Robust: psi drawn per episode from the plant's evaluation set and held; otherwise the nominal plant. Returns the mean
    absolute percentage error of each episode (episodes,) and whether its plant is held out from the training grid (episodes,).
    """
    plant, rng = policy.plant, np.random.default_rng([seed, 1])  # a stream of its own: training starts come from [seed]
    steps = plant.EPISODE_STEPS
    x = envs.sample_states(plant, rng, episodes)
    psi = rng.choice(plant.EVAL_PSI, size=episodes)
    if not robust:
        psi = np.broadcast_to(plant.PSI_NOMINAL, psi.shape)
    errors = []
    for t in range(steps):
        x = plant.step(x, policy.act(x, goal), psi)
        if t >= steps - steps // 2:
            errors.append(plant.percentage_error(x[:, plant.GOAL_INDEX], np.asarray(goal)))
    held_out = ~np.isclose(psi[:, None], plant.SCENARIOS["robust"]).all(-1).any(-1)
    return np.mean(errors, axis=0), held_out


def evaluation_row(policy, episodes, seed):
    """Medians and 75th percentiles that evaluations.csv and tensorboard report, in percent."""
    robust, held_out = evaluate(policy, policy.plant.EVAL_GOAL, episodes, seed, robust=True)
    nominal, _ = evaluate(policy, policy.plant.EVAL_GOAL, episodes, seed, robust=False)
    row = {"robust_median_ape": np.median(robust), "robust_p75_ape": np.quantile(robust, 0.75),
           "robust_held_out_median_ape": np.median(robust[held_out]) if held_out.any() else np.nan,
           "nominal_median_ape": np.median(nominal), "nominal_p75_ape": np.quantile(nominal, 0.75)}  # fmt: skip
    return {name: float(value) for name, value in row.items()}


def save(data, path):
    """Write a checkpoint so that a killed process never leaves half a file: temporary name, flush, rename."""
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        torch.save(data, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def plain(args):
    """The arguments as plain data, for files."""
    return {k: str(v) if isinstance(v, Path) else list(v) if isinstance(v, tuple) else v for k, v in asdict(args).items()}


def checkpoint(agent, args, step):
    """What deployment needs, as plain data (loads with weights_only=True)."""
    options = {name: args[name] for name in ("dim", "system") if args[name] is not None}
    if args["observe_mismatch"]:
        options["observe_mismatch"] = agent.plant.MISMATCH_SCALE.tolist()
    return {
        "format": "rlmpc-sac-her-branching-1",
        "env": args["env"],
        "plant_options": options,
        "env_id": agent.plant.ENV_ID,
        "network": agent.network,
        "goal_input": args["goal_input"],
        "scaling": agent.scaling.values,
        "actor": {k: v.cpu() for k, v in agent.actor.state_dict().items()},
        "critic": {k: v.cpu() for k, v in agent.critic.state_dict().items()},
        "gamma": args["gamma"],
        "alpha": agent.log_alpha.exp().item(),
        "step": step,
        "args": {name: value for name, value in args.items() if name not in ("out", "resume")},
    }


def write_csv(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    with open(path.with_suffix(".tmp"), "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    path.with_suffix(".tmp").replace(path)


def fail(message):
    """A user's mistake: one sentence, exit code 2, no traceback."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check(args):
    """Refuse arguments that cannot work, before anything long starts; returns the plant module."""
    try:
        plant = envs.load(args.env, **args.plant_options)
    except ValueError as error:
        fail(error)
    ranges = {
        (1, 10**9): ("total_timesteps", "steps_per_update"),
        (1, 10**6): ("num_envs", "batch_size", "eval_episodes"),  # what memory bears
        (1, 1024): ("branches", "torch_threads"),
        (0, 10**9): ("seed", "learning_starts", "eval_every", "save_every", "constraint_weight"),
        (0, 1): ("her_ratio", "gamma", "tau", "learning_rate_end"),
        (1e-9, 1e3): ("learning_rate", "reward_sigma2", "reward_tolerance", "alpha_init"),
        (-1e3, 1e3): ("target_entropy",),
    }
    for (low, high), names in ranges.items():
        for name in names:
            value = getattr(args, name)
            if value is not None and not low <= value <= high:  # catches nan too
                fail(f"--{name.replace('_', '-')} is {value}; it must lie in [{low:g}, {high:g}]")
    if not args.hidden or not all(1 <= width <= 10_000 for width in args.hidden):
        fail(f"--hidden is {args.hidden}; it needs at least one width, each from 1 to 10000")
    if args.buffer_size < args.num_envs:
        fail(f"--buffer-size is {args.buffer_size}; it must hold at least one transition of each of the {args.num_envs} plants")
    size = len(plant.X_LOW) * (2 + (args.branches if args.branches > 1 else 0)) + len(plant.U_LOW) + len(plant.GOAL_INDEX) + 4
    if args.buffer_size > 10**10 // (4 * size):
        fail(f"--buffer-size is {args.buffer_size}; at most {10**10 // (4 * size)} transitions are allowed, ten gigabytes")
    if args.scenario_hold == "episode" and args.branches > 1:
        fail(f"--branches is {args.branches}; --scenario-hold episode needs 1, since a branch is drawn anew at every step")
    if args.observe_mismatch and args.branches > 1:
        fail(f"--branches is {args.branches}; --observe-mismatch needs 1, since the average over plants is not that of the plant it sees")
    if args.observe_mismatch and args.add_plant_data:
        fail("--add-plant-data does not go with --observe-mismatch, which its states lack")
    if args.add_plant_data and args.branches > 1:
        fail(f"--branches is {args.branches}; --add-plant-data needs 1, since a plant gives one next state per action")
    without = [("reward_tolerance", args.smooth_reward, "--smooth-reward"), ("reward_sigma2", not args.smooth_reward, "--no-smooth-reward"),
               ("her_strategy", args.her_ratio == 0, "--her-ratio 0")]  # fmt: skip
    for name, unused, setting in without:
        if unused and getattr(args, name) != getattr(Args, name):
            fail(f"--{name.replace('_', '-')} {getattr(args, name)} has no effect with {setting}")
    if args.learning_starts >= args.total_timesteps:
        print(
            f"warning: nothing is learnt, since --learning-starts is {args.learning_starts}, not below --total-timesteps", file=sys.stderr
        )
    if args.device == "cuda" and not torch.cuda.is_available():
        fail("--device is cuda, but torch finds no CUDA device here; use auto or cpu")
    return plant


def load_plant_data(path, plant):
    """Trajectories x (E, T + 1, n_x), u (E, T, n_u) of every controller in a trajectories.npz."""
    try:
        with np.load(path, allow_pickle=False) as data:
            x, u = (np.concatenate([data[name] for name in sorted(data.files) if name.endswith(end)]) for end in ("_x", "_u"))
        if not (x.shape[0], x.shape[1] - 1, *x.shape[2:], u.shape[2]) == (*u.shape[:2], len(plant.X_LOW), len(plant.U_LOW)):
            raise ValueError
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            raise ValueError
    except Exception as error:  # missing, truncated, not an archive, of another plant: one sentence for all of them
        reason = f"not a trajectories.npz of {plant.ENV_ID} ({type(error).__name__})" if path.exists() else "does not exist"
        fail(f"--add-plant-data {path}: {reason}")
    return x, u


def load_resume(path):
    """Arguments and state of an interrupted run."""
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
        if state["format"] != "rlmpc-resume-1":
            raise ValueError
        stored = state["args"] | {"hidden": tuple(state["args"]["hidden"]), "out": Path(state["args"]["out"])}
        stored |= {"add_plant_data": Path(stored["add_plant_data"])} if stored.get("add_plant_data") else {}
        return Args(**stored), state
    except Exception as error:  # missing, truncated, a text file, a pickle of something else: one sentence for all of them
        reason = f"not a resume.pt of this script ({type(error).__name__})" if path.exists() else "does not exist"
        fail(f"--resume {path}: {reason}")


def main(args):
    state, run_dir = None, None
    if args.resume:
        run_dir = args.resume.parent
        if args != Args(resume=args.resume):
            fail(f"--resume {args.resume} continues with the arguments that the run was started with; give no others")
        args, state = load_resume(args.resume)
    plant = check(args)
    plant_data = load_plant_data(args.add_plant_data, plant) if args.add_plant_data and not state else None
    device = torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")
    if state and state["device"] != device.type:
        fail(f"--resume {run_dir / 'resume.pt'} was written on {state['device']}; its random state cannot continue on {device.type}")
    try:
        run_dir = run_dir or envs.new_folder(args.out / f"{args.env}__sac_her_branching__{args.seed}__{int(time.time())}")
        writer = SummaryWriter(run_dir, purge_step=state["step"] + 1 if state else None)
    except OSError as error:
        fail(f"{'--resume' if state else '--out'}: cannot write {run_dir or args.out} ({error.strerror})")
    torch.set_num_threads(args.torch_threads)
    plain_args = plain(args)
    writer.add_text("hyperparameters", "|argument|value|\n|-|-|\n" + "\n".join(f"|{k}|{v}|" for k, v in plain_args.items()))

    vec = gym.make_vec(plant.ENV_ID, num_envs=args.num_envs, scenarios=args.scenarios, smooth_reward=args.smooth_reward,
                       reward_sigma2=args.reward_sigma2, reward_tolerance=args.reward_tolerance,
                       branches=args.branches if args.branches > 1 else 0, scenario_hold=args.scenario_hold,
                       **args.plant_options).unwrapped  # fmt: skip
    agent = SAC(args, plant, device)
    buffer = HERBuffer(args.buffer_size, args.num_envs, len(plant.X_LOW), len(plant.U_LOW), len(plant.GOAL_INDEX),
                       plant.GOAL_INDEX, args.branches, args.her_strategy, args.her_ratio, device)  # fmt: skip
    rng = np.random.default_rng([args.seed, 2])  # random actions before learning starts
    obs, _ = vec.reset(seed=args.seed)
    if plant_data:
        buffer.add_episodes(*plant_data, rng.choice(plant.TRAIN_GOALS, size=len(plant_data[0])))
    returns, finished, step, updates, seconds, rows = np.zeros(args.num_envs), [], 0, 0, 0.0, []
    if state:
        try:
            agent.load_state_dict(state["agent"])
            buffer.load_state_dict({k: v.to(device) if torch.is_tensor(v) else v for k, v in state["buffer"].items()})
            obs = vec.set_state(state["vec"])
            rng.bit_generator.state = state["rng"]
            returns, finished, step, updates, seconds, rows = (
                state[k] for k in ("returns", "finished", "step", "updates", "seconds", "rows")
            )
            returns = np.array(returns)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            fail(f"--resume {run_dir / 'resume.pt'}: its state does not fit its arguments ({type(error).__name__})")
        if step >= args.total_timesteps:
            print(f"notice: {run_dir} had finished already", file=sys.stderr)

    def save_all():
        save(checkpoint(agent, plain_args, step), run_dir / "checkpoint.pt")
        resume = {"format": "rlmpc-resume-1", "device": device.type, "args": plain_args, "agent": agent.state_dict(),
                  "buffer": buffer.state_dict(), "vec": vec.get_state(), "rng": rng.bit_generator.state, "returns": returns.tolist(),
                  "finished": finished, "step": step, "updates": updates, "seconds": seconds, "rows": rows}  # fmt: skip
        save(resume, run_dir / "resume.pt")

    def due(every):
        return every > 0 and step // every > (step - args.num_envs) // every

    def log(scalars):
        for name, value in scalars.items():
            writer.add_scalar(name, value, step)

    losses, interrupted = {}, []  # Ctrl-C is acted on between steps, where the state is whole; a second one kills
    previous_handler = signal.signal(signal.SIGINT, lambda *_: (interrupted.append(True), signal.signal(signal.SIGINT, signal.SIG_DFL)))
    bar = tqdm(total=args.total_timesteps, initial=step, unit="step", mininterval=0.5, disable=None)
    try:
        while step < args.total_timesteps and not interrupted:
            tick = time.perf_counter()
            if step < args.learning_starts:
                action = rng.uniform(plant.U_LOW, plant.U_HIGH, size=(args.num_envs, len(plant.U_LOW)))
            else:
                action = agent.explore(obs["observation"], obs["desired_goal"])
            next_obs, reward, terminated, truncated, infos = vec.step(action)
            done = terminated | truncated
            # same-step autoreset: where an episode ended, the state that it reached is in final_obs
            reached = infos["final_obs"]["observation"] if "final_obs" in infos else next_obs["observation"]
            buffer.add(obs["observation"], action, obs["desired_goal"], reached, infos.get("branch_states"), done)
            obs = next_obs
            step += args.num_envs
            returns += reward
            if done.any():
                finished = returns[done].tolist()
                returns[done] = 0
            if step >= args.learning_starts:
                progress = min(step / args.total_timesteps, 1.0)
                for optimiser in agent.optimisers.values():
                    optimiser.param_groups[0]["lr"] = args.learning_rate * (1 + (args.learning_rate_end - 1) * progress)
                while updates * args.steps_per_update < step - args.learning_starts:
                    x, u, goal, x_next = buffer.sample(args.batch_size, agent.generator)
                    losses = agent.update_critic(x, u, goal, x_next) | agent.update_actor(x, goal)
                    updates += 1
            seconds += time.perf_counter() - tick
            bar.update(args.num_envs)
            if due(1_000):
                log(losses | {"charts/SPS": step / seconds} | ({"charts/episodic_return": np.mean(finished)} if finished else {}))
            if due(args.eval_every) or step >= args.total_timesteps:
                row = evaluation_row(agent.policy, args.eval_episodes, seed=args.seed)
                log({f"eval/{name}": value for name, value in row.items()})
                rows.append({"step": step, "updates": updates, "train_seconds": round(seconds, 2)} | row)
                write_csv(rows, run_dir / "evaluations.csv")
                bar.set_postfix_str(f"robust error {row['robust_median_ape']:.2f} %, nominal {row['nominal_median_ape']:.2f} %")
            if due(args.save_every):
                save_all()
    finally:
        bar.close()
        writer.close()
        signal.signal(signal.SIGINT, previous_handler)
    save_all()
    if interrupted:
        print(f"interrupted at step {step}; continue with: python sac_her_branching.py --resume {run_dir / 'resume.pt'}")
        raise SystemExit(130)
    last, goal = rows[-1], np.array2string(plant.EVAL_GOAL, threshold=4, edgeitems=1)
    print(f"""
{plant.ENV_ID}, {args.scenarios} scenarios, seed {args.seed}: {step} transitions, {updates} updates in {seconds:.0f} s
error in percent, goal {goal}        median   75th percentile
  robust evaluation, all plants      {last["robust_median_ape"]:10.2f} {last["robust_p75_ape"]:12.2f}
  robust evaluation, held-out plants {last["robust_held_out_median_ape"]:10.2f}
  nominal evaluation                 {last["nominal_median_ape"]:10.2f} {last["nominal_p75_ape"]:12.2f}
entropy coefficient {agent.log_alpha.exp().item():.2e}
{run_dir / "checkpoint.pt"}""")
    return run_dir


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
