# /// script
# requires-python = ">=3.11"
# dependencies = ["torch==2.13.0", "gymnasium==1.4.0", "numpy", "tyro", "tensorboard", "tqdm"]
# ///
"""Soft actor-critic with hindsight experience replay over branched rollouts: a robust goal-conditioned critic.

The plant's uncertain parameters psi are drawn anew from a scenario set, by default at every step (eq:offlineMDP),
so that the critic learns the value averaged over scenarios (eq:robustQ). With `--branches K` every transition
carries K next states under independently drawn scenarios, and their *targets* are averaged:

    y = 1/K sum_i [ r(s'_i, g) + gamma ( min_j Qbar_j(s'_i, a'_i, g) - alpha log pi(a'_i | s'_i, g) ) ],
    a'_i ~ pi(. | s'_i, g)

HER (eq:relabeled) replaces the goal of most samples by something that the same episode achieved later.

    python sac_her_branching.py --env cstr                        # the robust agent of the paper's Example 3
    python sac_her_branching.py --env cstr --scenarios nominal    # the nominal agent it is compared with
    python sac_her_branching.py --constraint-weight 3             # an agent that knows the price of constraints
    python sac_her_branching.py --resume runs/NAME/resume.pt      # continue an interrupted run, to the same numbers

It writes `runs/{env}__sac_her_branching__{seed}__{time}/`: tensorboard events, evaluations.csv, checkpoint.pt
(what `load_policy` and rl_mpc_deploy.py read) and resume.pt. Only the folder `envs/` is needed beside this file.
"""

import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import envs
from envs.agents.checkpoint import FORMAT, RESUME, plain, read_file, save
from envs.agents.evaluation import evaluation_row, evaluation_table
from envs.agents.policy import Policy, Scaling, read_policy
from envs.script.arguments import as_annotated, check_effects, check_ranges
from envs.script.comparison import output_folder, read_trajectories, write_csv
from envs.script.interrupt import until_interrupted

# of the arguments that a plant's TRAINING may set
DEFAULTS = dict(hidden=(64, 64), total_timesteps=100_000, num_envs=32, gamma=0.99, steps_per_update=8)
DEFAULTS |= dict(learning_starts=1_000, buffer_size=200_000, alpha_init=1.0)


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
    observe_mismatch: Annotated[bool, tuple[float, ...]] = False
    """let the agent see how the last transition differed from the nominal model, which tells what plant it is on;
    give --scenario-hold episode too. Lowers the default of --gamma to 0.95. From Python also its scale, (n_x,)"""
    branches: int = 1
    """K, next states per transition whose targets are averaged; 1: the one that the episode follows, as in the paper"""

    her_strategy: Literal["future", "final"] = "future"
    """hindsight goal: what was achieved later in the episode, or at its end"""
    her_ratio: float = 0.8
    """share of the samples whose goal is replaced in hindsight; 0 turns HER off"""
    smooth_reward: bool = True
    """Gaussian reward (eq:cstrreward); off: the 0/1 reward (eq:sparsereward)"""
    reward_sigma2: float | None = None
    """sigma^2 of the Gaussian reward, squared units of the goal error; default: the plant's (cstr: 1e-4)"""
    reward_tolerance: float | None = None
    """half-width of the 0/1 reward, units of the goal error; default: the plant's (cstr: 0.01)"""
    constraint_weight: float = 0.0
    """weight in the reward of time outside constraints, exp(-|x - clip(x)|^2 / (2 METRIC_SIGMA2)) - 1; 0: the paper"""
    goal_input: Literal["error", "goal"] = "error"
    """what the networks see beside the state: goal minus achieved goal, or the goal itself"""
    add_plant_data: Path | None = None
    """a trajectories.npz of rl_mpc_deploy.py: closed loops of a plant, put into the replay buffer first"""

    hidden: tuple[int, ...] | None = None
    """widths of the hidden layers (SiLU); default: the plant's (cstr: 64 64, linear: 256 256)"""
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
    """transitions with random actions before the first update; default: the plant's (cstr: 1000, linear: 10000)"""
    steps_per_update: int | None = None
    """transitions collected per update; default: the plant's (cstr: 8, linear: 16)"""
    entropy_in_target: bool = True
    """SAC's soft value; off: the critic counts reward alone, the actor still maximises Q plus entropy"""
    buffer_size: int | None = None
    """transitions that the replay buffer holds; default: the plant's (cstr: 200000)"""
    alpha_init: float | None = None
    """entropy coefficient at the start; default: the plant's (cstr: 1, linear: 0.005)"""

    eval_every: int = 10_000
    """transitions between evaluations; 0: only at the end"""
    eval_episodes: int = 200
    """start states of an evaluation, the same for every seed"""
    save_every: int = 50_000
    """transitions between checkpoints; 0: only at the end"""
    resume: Path | None = None
    """a resume.pt: continue that run in its folder, with the arguments that it was started with"""
    out: Path = Path("runs")
    """folder that the run's own folder is made in"""

    def __post_init__(self):
        """Arguments left out take the plant's value, all of them plain types."""
        as_annotated(self)
        defaults = DEFAULTS | envs.load(self.env).TRAINING if self.env in envs.names() else {}
        if self.observe_mismatch and defaults:
            defaults["gamma"] = min(defaults["gamma"], 0.95)
        for name, value in vars(self).items():
            setattr(self, name, defaults.get(name) if value is None else value)
        as_annotated(self)

    @property
    def plant_options(self):
        """What `envs.load` needs beside the plant's name."""
        options = {"dim": self.dim, "system": self.system, "observe_mismatch": self.observe_mismatch or None}
        return {name: value for name, value in options.items() if value is not None}


# Networks


class Actor(nn.Module):
    """Tanh-Gaussian policy, features (B, n_in) -> action in [-1, 1]^n_u."""

    LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0  # CleanRL's sac_continuous_action.py, after spinning-up

    def __init__(self, n_in, n_u, hidden):
        super().__init__()
        widths = [n_in, *hidden]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:]))
        self.head = nn.Linear(widths[-1], 2 * n_u)  # mean and log standard deviation before tanh

    def forward(self, z):
        """Mean and log standard deviation before they are squashed, (B, n_u) each."""
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
        noise = torch.randn(mean.shape, generator=generator)
        v = mean + log_std.exp() * noise
        # log(1 - tanh(v)^2) = 2 (log 2 - v - softplus(-2v)) does not cancel where tanh saturates
        log_prob = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - v - F.softplus(-2 * v))
        return torch.tanh(v), log_prob.sum(-1)


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
        *hidden, (w_out, b_out) = zip(self.weight, self.bias)
        for w, b in hidden:
            h = F.silu(torch.baddbmm(b, h, w))
        return torch.baddbmm(b_out, h, w_out).squeeze(-1)


def load_policy(path):
    """The agent stored in a checkpoint.pt, which is data, never code. Raises ValueError for anything else."""
    return read_policy(path, Actor, TwinCritic)


# Replay with hindsight


class HERBuffer:
    """Ring buffer of the parallel plants' transitions, episode after episode; a batch is drawn with replaced goals.

    Row t % rows holds time t of every plant. Example with `future`: an episode covers t = 100 ... 149, the sample is
    t = 120; its hindsight goal is what x_{t'+1} achieved, t' uniform in 120 ... 149 (with t' = 120 reward is full).
    """

    OPEN = 2**62  # end of an episode that is still running

    def __init__(self, args, plant):
        self.rows, self.num_envs = args.buffer_size // args.num_envs, args.num_envs
        self.branches = args.branches if args.branches > 1 else 0  # one is the transition's own next state
        self.strategy, self.ratio, self.goal_index = args.her_strategy, args.her_ratio, plant.GOAL_INDEX
        n_x, n_u, shape = len(plant.X_LOW), len(plant.U_LOW), (self.rows, self.num_envs)
        self.x, self.x_next = torch.zeros(2, *shape, n_x)
        self.u = torch.zeros(*shape, n_u)
        self.goal = torch.zeros(*shape, len(plant.GOAL_INDEX))
        self.branch_next = torch.zeros(*shape, self.branches, n_x)
        self.end = torch.zeros(*shape, dtype=torch.long)  # of the transition's episode
        self.now = 0  # time steps written so far

    def add(self, x, u, goal, x_next, branch_next, done):
        """One transition of each plant, (num_envs, ...); branch_next (num_envs, K, n_x) or None; done (num_envs,)."""
        row = self.now % self.rows
        branches = {"branch_next": branch_next} if self.branches else {}
        for name, value in dict(x=x, u=u, goal=goal, x_next=x_next, **branches).items():
            store = getattr(self, name)
            if np.shape(value) != store.shape[1:]:
                raise ValueError(f"{name} has shape {np.shape(value)}, not {tuple(store.shape[1:])}")
            store[row] = torch.as_tensor(value, dtype=torch.float32)
        self.end[row] = self.OPEN
        if done.any():
            self.end[(self.end == self.OPEN) & torch.as_tensor(done)] = self.now
        self.now += 1

    def add_episodes(self, x, u, goal):
        """Whole episodes x (E, T + 1, n_x), u (E, T, n_u) with goals (E, n_goal), repeated to fill a row of plants."""
        for first in range(0, len(x), self.num_envs):
            group, steps = np.arange(first, first + self.num_envs) % len(x), u.shape[1]
            for t in range(steps):
                done = np.full(self.num_envs, t == steps - 1)
                self.add(x[group, t], u[group, t], goal[group], x[group, t + 1], None, done)

    def sample(self, batch_size, generator):
        """x (B, n_x), u (B, n_u), goal (B, n_goal), next states (B, K, n_x): one goal for all branches."""
        oldest = max(0, self.now - self.rows)
        t = torch.randint(oldest, self.now, (batch_size,), generator=generator)
        env = torch.randint(self.num_envs, (batch_size,), generator=generator)
        draw, relabel = torch.rand(2, batch_size, generator=generator)
        row = t % self.rows
        end = self.end[row, env].clamp(max=self.now - 1)
        later = (t + (draw * (end - t + 1)).long()).clamp(max=end) if self.strategy == "future" else end
        achieved = self.x_next[later % self.rows, env][:, self.goal_index]
        goal = torch.where((relabel < self.ratio)[:, None], achieved, self.goal[row, env])
        x_next = self.branch_next[row, env] if self.branches else self.x_next[row, env][:, None]
        return self.x[row, env], self.u[row, env], goal, x_next


# Soft actor-critic


class SAC(Policy):
    """A policy with what trains it: target critics, optimisers and the two update steps."""

    def __init__(self, args, plant):
        scaling, n_u = Scaling.of(plant), len(plant.U_LOW)
        n_in = len(scaling.other_index) + 2 * len(scaling.angle_index)
        self.network = dict(n_in=n_in, n_u=n_u, hidden=list(args.hidden))
        with torch.random.fork_rng(devices=[]):  # torch.nn draws from the global generator
            torch.manual_seed(args.seed)
            actor = Actor(**self.network)
            critic = TwinCritic(**self.network)
            self.target = TwinCritic(**self.network).requires_grad_(False)
        super().__init__(plant, actor, critic, scaling, args.goal_input)
        self.args = args
        self.target.load_state_dict(self.critic.state_dict())
        self.log_alpha = torch.tensor([args.alpha_init]).log().requires_grad_()
        self.generator = torch.Generator().manual_seed(args.seed)

        trained = {"actor": actor.parameters(), "critic": critic.parameters(), "alpha": [self.log_alpha]}
        adam = dict(lr=args.learning_rate, fused=True)
        self.optimisers = {name: torch.optim.Adam(parts, **adam) for name, parts in trained.items()}
        self.saved = {f"{name} optimiser": optimiser for name, optimiser in self.optimisers.items()}
        self.saved |= {"actor": actor, "critic": critic, "target": self.target}

    @torch.no_grad()
    def explore(self, x, goal):
        """Sampled actions in physical units, (num_envs, n_u)."""
        return self.physical(self.actor.sample(self.features(x, goal), self.generator)[0])

    def reward(self, x, goal, xp):
        """Of states reached (B, n_x) under goals (B, n_goal), (B,), in numpy or torch: eq:goalreward."""
        a, achieved = self.args, x[:, self.plant.GOAL_INDEX]
        how = a.smooth_reward, a.reward_sigma2, a.reward_tolerance
        reward = envs.goal_reward(self.plant, achieved, goal, *how, xp=xp)
        if a.constraint_weight:  # else a planner puts a violation off to after its horizon, where it is free
            reward = reward + a.constraint_weight * envs.outside_constraints(self.plant, x, xp=xp)
        return reward

    def targets(self, goal, x_next):
        """Mean over branches of reward + discounted soft value of the next state, (B,): eq:robustQ with entropy."""
        batch, k = x_next.shape[:2]
        x, g = x_next.flatten(0, 1), goal.repeat_interleave(k, dim=0)  # (B*K, n_x), (B*K, n_goal)
        z = self.features(x, g)
        action, log_prob = self.actor.sample(z, self.generator)
        value = self.target(z, action).amin(0)
        if self.args.entropy_in_target:
            value -= self.log_alpha.exp() * log_prob
        # the plants do not terminate, and the time limit is bootstrapped through
        y = self.reward(x, g, torch) + self.args.gamma * value
        return y.view(batch, k).mean(1)

    def update_critic(self, x, u, goal, x_next):
        """One step of both critics (eq:updateQ), on what `HERBuffer.sample` returns; returns what to log."""
        with torch.no_grad():
            y = self.targets(goal, x_next)
        q = self.critic(self.features(x, goal), (u - self.scaling.u_center) / self.scaling.u_scale)
        loss = 2 * F.mse_loss(q, y.expand(2, -1))  # the sum of both critics' losses
        self.optimisers["critic"].zero_grad()
        loss.backward()
        self.optimisers["critic"].step()
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters()):
                slow.lerp_(fast, self.args.tau)
        return {"losses/qf_loss": loss.detach(), "losses/qf_values": q.detach().mean()}

    def update_actor(self, x, goal):
        """One step of the actor (eq:dpgalg) and the entropy coefficient; returns what to log."""
        z = self.features(x, goal)
        action, log_prob = self.actor.sample(z, self.generator)
        alpha = self.log_alpha.detach().exp()
        loss = (alpha * log_prob - self.critic(z, action).amin(0)).mean()
        self.optimisers["actor"].zero_grad()
        loss.backward(inputs=list(self.actor.parameters()))  # not the critics'
        self.optimisers["actor"].step()
        entropy = -log_prob.detach().mean()
        # the gradient of exp(log_alpha) (entropy - target entropy)
        self.log_alpha.grad = alpha * (entropy + len(self.plant.U_LOW))
        self.optimisers["alpha"].step()
        return {"losses/actor_loss": loss.detach(), "losses/alpha": alpha, "losses/entropy": entropy}

    def state_dict(self):
        parts = {name: part.state_dict() for name, part in self.saved.items()}
        return parts | {"log_alpha": self.log_alpha.detach(), "generator": self.generator.get_state()}

    def load_state_dict(self, state):
        for name, part in self.saved.items():
            part.load_state_dict(state[name])
        self.log_alpha.data.copy_(state["log_alpha"])
        self.generator.set_state(state["generator"])


# Training


@dataclass
class Progress:
    """What the loop counts."""

    step: int = 0
    updates: int = 0
    seconds: float = 0.0
    returns: list = field(default_factory=list)  # of the running episodes
    rows: list = field(default_factory=list)  # evaluations


def checkpoint(agent, args, step):
    """What deployment needs, as plain data."""
    args = {name: value for name, value in plain(args).items() if name not in ("out", "resume")}
    options = {name: args[name] for name in ("dim", "system") if args[name] is not None}
    if args["observe_mismatch"]:
        options["observe_mismatch"] = agent.plant.MISMATCH_SCALE.tolist()
    head = {"format": FORMAT, "env": args["env"], "plant_options": options, "env_id": agent.plant.ENV_ID}
    head |= {"network": agent.network, "goal_input": args["goal_input"], "scaling": agent.scaling.values}
    networks = {"actor": agent.actor, "critic": agent.critic}
    head |= {k: {name: p for name, p in net.state_dict().items()} for k, net in networks.items()}
    return head | {"gamma": args["gamma"], "alpha": agent.log_alpha.exp().item(), "step": step, "args": args}


def check(args):
    """Refuse, by ValueError, what cannot work before anything long starts; returns the plant."""
    plant = envs.load(args.env, **args.plant_options)
    check_ranges(args, total_timesteps=(1, 10**9), steps_per_update=(1, 10**9), branches=(1, 1024))
    check_ranges(args, num_envs=(1, 10**6), batch_size=(1, 10**6), eval_episodes=(1, 10**6))
    check_ranges(args, **dict.fromkeys(["seed", "learning_starts", "eval_every", "save_every"], (0, 10**9)))
    check_ranges(args, **dict.fromkeys(["her_ratio", "gamma", "tau", "learning_rate_end"], (0, 1)))
    check_ranges(args, **dict.fromkeys(["learning_rate", "reward_sigma2", "reward_tolerance"], (1e-9, 1e3)))
    check_ranges(args, alpha_init=(1e-9, 1e3), constraint_weight=(0, 1e9))
    if not args.hidden or not all(1 <= width <= 10_000 for width in args.hidden):
        raise ValueError(f"--hidden is {args.hidden}; it needs at least one width, each from 1 to 10000")
    kept = 1 + (args.branches if args.branches > 1 else 0)
    numbers = len(plant.X_LOW) * (1 + kept) + len(plant.U_LOW) + len(plant.GOAL_INDEX) + 2
    check_ranges(args, buffer_size=(args.num_envs, 10**10 // (4 * numbers)))  # a row of plants, ten gigabytes
    single = {"scenario_hold": "step", "observe_mismatch": False, "add_plant_data": None}
    if args.branches > 1 and any(getattr(args, name) != value for name, value in single.items()):
        names = "--scenario-hold episode, --observe-mismatch and --add-plant-data"
        raise ValueError(f"--branches is {args.branches}; it must be 1 with {names}")
    if args.observe_mismatch and args.add_plant_data:
        raise ValueError("--add-plant-data does not go with --observe-mismatch, which its states lack")
    if args.learning_starts >= args.total_timesteps:
        print("warning: nothing is learnt, --learning-starts is not below --total-timesteps", file=sys.stderr)
    unused = {"reward_tolerance": "with --smooth-reward" if args.smooth_reward else ""}
    unused |= {"reward_sigma2": "" if args.smooth_reward else "with --no-smooth-reward"}
    check_effects(args, unused | {"her_strategy": "" if args.her_ratio else "with --her-ratio 0"})
    return plant


def main(args, kind=SAC):
    source, state = args.resume, None
    if source:
        if args != Args(resume=source):
            raise ValueError(f"--resume {source} continues with the run's own arguments; give no others")
        state = read_file(source, RESUME, "a resume.pt of this script")
        args = Args(**state["args"])
    plant = check(args)
    plant_data = read_trajectories(args.add_plant_data, plant) if args.add_plant_data and not source else None
    name = f"{args.env}__sac_her_branching__{args.seed}__{int(time.time())}"
    run_dir = output_folder(source and source.parent, args.out / name)
    run = Progress(**state["progress"]) if source else Progress(returns=[0.0] * args.num_envs)
    writer = SummaryWriter(run_dir, purge_step=run.step + 1 if source else None)
    lines = [f"|{name}|{value}|" for name, value in plain(args).items()]
    writer.add_text("hyperparameters", "\n".join(["|argument|value|", "|-|-|", *lines]))

    torch.set_num_threads(1)  # networks this small run fastest on one
    agent, buffer = kind(args, plant), HERBuffer(args, plant)
    options = dict(scenarios=args.scenarios, branches=buffer.branches, scenario_hold=args.scenario_hold)
    vec = envs.VectorGoalEnv(args.env, args.num_envs, **options, **args.plant_options)
    rng = np.random.default_rng([args.seed, 2])  # random actions before learning starts
    obs, _ = vec.reset(seed=args.seed)
    if plant_data:
        buffer.add_episodes(*plant_data, rng.choice(plant.TRAIN_GOALS, size=len(plant_data[0])))
    if source:
        agent.load_state_dict(state["agent"])
        vars(buffer).update(state["buffer"])
        obs = vec.set_state(state["vec"])
        rng.bit_generator.state = state["rng"]

    def save_all():
        save(checkpoint(agent, args, run.step), run_dir / "checkpoint.pt")
        resume = {"format": RESUME, "args": plain(args), "progress": asdict(run), "agent": agent.state_dict()}
        resume |= {"buffer": vars(buffer), "vec": vec.get_state(), "rng": rng.bit_generator.state}
        save(resume, run_dir / "resume.pt")

    def due(every):
        return every > 0 and run.step // every > (run.step - args.num_envs) // every

    def log(scalars):
        for name, value in scalars.items():
            writer.add_scalar(name, value, run.step)

    if plant.EXPECT:
        print(f"notice: {plant.EXPECT}", file=sys.stderr)
    losses = {}
    bar = tqdm(total=args.total_timesteps, initial=run.step, unit="step", mininterval=0.5, disable=None)
    with until_interrupted() as interrupted, bar:
        while run.step < args.total_timesteps and not interrupted:
            tick = time.perf_counter()
            if run.step < args.learning_starts:
                action = rng.uniform(plant.U_LOW, plant.U_HIGH, size=(args.num_envs, len(plant.U_LOW)))
            else:
                action = agent.explore(obs["observation"], obs["desired_goal"])
            next_obs, _, _, done, infos = vec.step(action)  # `SAC.reward` counts constraints, too
            reached = envs.reached_states(next_obs, infos)
            goal = obs["desired_goal"]
            buffer.add(obs["observation"], action, goal, reached, infos.get("branch_states"), done)
            obs = next_obs
            run.step += args.num_envs
            returns = np.add(run.returns, agent.reward(reached, goal, np))
            if done.any():
                log({"charts/episodic_return": returns[done].mean()})
            run.returns = np.where(done, 0.0, returns).tolist()
            if run.step >= args.learning_starts:
                share = min(run.step / args.total_timesteps, 1.0)
                rate = args.learning_rate * (1 + (args.learning_rate_end - 1) * share)
                for optimiser in agent.optimisers.values():
                    optimiser.param_groups[0]["lr"] = rate
                while run.updates * args.steps_per_update < run.step - args.learning_starts:
                    x, u, goal, x_next = buffer.sample(args.batch_size, agent.generator)
                    losses = agent.update_critic(x, u, goal, x_next) | agent.update_actor(x, goal)
                    run.updates += 1
            run.seconds += time.perf_counter() - tick
            bar.update(args.num_envs)
            if due(1_000):
                log(losses | {"charts/SPS": run.step / run.seconds})
            if due(args.eval_every) or run.step >= args.total_timesteps:
                row = evaluation_row(agent, args.eval_episodes)
                log({f"eval/{name}": value for name, value in row.items()})
                counted = {"step": run.step, "updates": run.updates, "train_seconds": round(run.seconds, 2)}
                run.rows.append(counted | row)
                write_csv(run.rows, run_dir / "evaluations.csv")
                error, outside = row["robust_median_ape"], row["robust_median_outside"]
                bar.set_postfix_str(f"robust evaluation: error {error:.2f} %, outside {outside:.1f} %")
            if due(args.save_every):
                save_all()
    writer.close()
    save_all()
    if interrupted:
        print(f"interrupted; continue with --resume {run_dir / 'resume.pt'}", file=sys.stderr)
        raise SystemExit(130)
    print(f"{plant.ENV_ID}, seed {args.seed}: {run.step} transitions in {run.seconds:.0f} s")
    print(evaluation_table(run.rows[-1]))
    print(run_dir / "checkpoint.pt")
    return run_dir


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
