"""Value iteration whose maximisation is the planner: its own closed loops teach the value that stands behind a short plan.

    P(x, g)    =   max over u of mean_i { sum_{t=1}^N gamma^{t-1} r(x_t^i, g) + gamma^N V(x_N^i, g) },   x_0^i = x
    V(x_t, g)  <-  max { P(x_t, g),  r(x_{t+1}, g) + gamma V(x_{t+1}, g) }   along closed loops of P
    r(x, g)    =   exp(-|error|^2 / (2 sigma^2)) - p'|violation of the constraints|

P is what the planner of rl_mpc_deploy.py computes: eq:bellmanQ over N steps, the mean over scenarios inside as in
eq:robustQ. The second candidate is what the loop then got, counted from its end; it is left out where plants are
drawn. A sweep

1. samples states and goals to start from: half anywhere in a box, half near what the last evaluation visited,
2. runs a closed loop from each, with the last sweep's V behind the plan. The first sweep plans longer, without V,
3. fits networks to the values, to how each changes with the state (the multipliers of the plan's quadratic program:
   as many numbers as there are states from one plan), and to the actions, from which later plans start,
4. evaluates the controller with the new V in closed loops of its own.

    python experiments/planner_value_iteration.py               # the double pendulum: half an hour on one core
    python experiments/planner_value_iteration.py --resume runs/NAME/resume.pt
    python experiments/planner_value_iteration.py --env cstr --robust-horizon 1 --sigma 0.1 --slack-weight 2
    python rl_mpc_deploy.py --env double_pendulum --horizon 15 --starts start       # with the value that is shipped

It writes `runs/{env}__planner_value_iteration__{seed}__{time}/`: tensorboard events, sweeps.csv, checkpoint.pt (the
best sweep by its closed loops; rl_mpc_deploy.py reads it) and resume.pt. It needs the scripts rl_mpc_deploy.py and
sac_her_branching.py and the folder envs/.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import torch
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs
import rl_mpc_deploy as rl
from envs.agents.checkpoint import FORMAT, plain, read_file, save
from envs.agents.policy import Scaling
from envs.control.expansion import expansion
from envs.control.tree_qp import ScenarioTree
from envs.script.arguments import as_annotated, check_ranges
from envs.script.comparison import draws, output_folder, run_episode, write_csv
from envs.script.interrupt import until_interrupted
from sac_her_branching import Actor, TwinCritic

RESUME = "rlmpc-planner-value-1"
STEEP = (
    3.0  # largest values per half-width of the box: a slope beyond that is of a plan that falls, chaotically
)


@dataclass
class Args:
    env: str = "double_pendulum"
    """the plant: NAME of a module envs/NAME.py"""
    seed: int = 0
    """of states, networks and the evaluation's starts; same seed, same machine, same numbers"""
    sweeps: int = 8
    """rounds of planning and fitting"""
    states: int = 24_000
    """plans per sweep"""
    length: int = 20
    """steps of the closed loops that teach"""

    lookahead: int = 30
    """T, steps of the plans of the first sweep, which end in no value"""
    horizon: int = 15
    """N, steps of all later plans"""
    robust_horizon: int = 0
    """stages at which the plans branch over the plant's scenarios; 0: the nominal plant"""
    sigma: float = 0.35
    """width of the Gaussian reward, units of the goal error (pendulum: 1 - cos of the angles)"""
    slack_weight: float = 0.5
    """p, price of a constraint violation per physical unit and step"""
    gamma: float = 0.97
    """discount, in the plan as in the value"""

    box: float = 1.5
    """how far the sampled states go where nothing bounds them, in half-widths of the box of initial states"""
    visited: float = 0.25
    """share of the states that lie near those of the last closed loops; the others lie anywhere in the box"""
    returns: bool = True
    """count what closed loops got; off: only what their plans promised, as always where plants are drawn"""
    slopes: float = 0.1
    """weight of the slopes in the fit"""
    combine: Literal["mean", "first", "min"] = "mean"
    """which of the two fitted networks V takes, as in rl_mpc_deploy.py"""
    hidden: tuple[int, ...] = (128, 128)
    """widths of the hidden layers (SiLU)"""
    updates: int = 12_000
    """steps of Adam per sweep, of which the learning rate falls linearly"""
    batch_size: int = 256
    """states per update"""
    learning_rate: float = 1e-3
    """of Adam, at the start of a sweep"""

    loops: int = 24
    """closed loops after a sweep: half of them near the plant's start state, half from anywhere in its box"""
    steps: int = 150
    """sampling times per closed loop"""
    resume: Path | None = None
    """a resume.pt: continue that run in its folder, with the arguments that it was started with"""
    out: Path = Path("runs")
    """folder that the run's own folder is made in"""

    __post_init__ = as_annotated


# Planning


class Teacher(rl.ScenarioMPC):
    """The deployed controller, which also says what its last plan is worth, and how that changes with the state."""

    def value(self):
        return -self.stats["cost"]

    def slope(self):
        """How the value changes with the state if the plan is adapted, scaled, (n_x,): the multipliers of its quadratic program.

        The derivative with all actions fixed is the same where the plan is optimal to the last digit, and else, on an unstable plant, grows
        with the horizon without bound.
        """
        program = self.program(self.plan)
        if self.qp.solve(*program)[0] is None:
            return np.full(len(self.x_scale), np.nan)
        later = self.qp.multipliers()
        transposed = program[0].reshape(-1, *2 * later.shape[1:])
        return -sum(A @ each for A, each in zip(transposed, later))


def build_teacher(args, plant, learned):
    """The controller of a sweep; learned: a checkpoint's data whose value stands behind the plan, None: a longer plan without one."""
    n_x, n_goal = len(plant.X_LOW), len(plant.GOAL_INDEX)
    x, g = ca.MX.sym("x", n_x), ca.MX.sym("goal", n_goal)
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))
    reward = ca.exp(-squared_error / (2 * args.sigma**2)) - plant.economic_cost(x, ca)
    options = dict(goal=plant.EVAL_GOAL, robust_horizon=args.robust_horizon, slack_price=args.slack_weight)
    options |= dict(discount=args.gamma)
    if learned:
        critic = rl.Critic(learned)
        mu, _, V = rl.export(critic)
        options |= dict(value=V, policy=mu, expansion=expansion(critic))
    scenarios = envs.scenario_set(plant, "mpc")
    horizon = args.horizon if learned else args.lookahead
    return Teacher(plant, horizon, scenarios, ca.Function("cost", [x, g], [-reward]), **options)


def sample(args, plant, visited, rng):
    """States (n, n_x) and goals (n, n_goal) to start from; visited: both of earlier closed loops, or None."""
    half, middle = args.box * envs.half_width(plant), (plant.INIT_LOW + plant.INIT_HIGH) / 2
    over = 0.1 * (plant.X_HIGH - plant.X_LOW) / 2  # what lies outside of the constraints teaches, too
    low = np.where(np.isfinite(over), np.maximum(plant.X_LOW - over, plant.OBS_LOW), middle - half)
    high = np.where(np.isfinite(over), np.minimum(plant.X_HIGH + over, plant.OBS_HIGH), middle + half)
    starts = -(-args.states // args.length)
    x, g = rng.uniform(low, high, size=(starts, len(low))), rng.choice(plant.TRAIN_GOALS, starts)
    if visited:
        chosen = rng.permutation(starts)[: round(args.visited * starts)]
        some = rng.integers(len(visited[0]), size=len(chosen))
        noise = 0.05 * rng.uniform(size=(len(chosen), 1)) * rng.normal(size=(len(chosen), len(low)))
        x[chosen] = visited[0][some] + noise * envs.half_width(plant)
        g[chosen] = visited[1][some]
    return x, g


def reward(args, plant, x, goal):
    """Of a state (n_x,) that was reached."""
    error = plant.goal_error(x[plant.GOAL_INDEX], goal)
    violation = np.abs(x - np.clip(x, plant.X_LOW, plant.X_HIGH)).sum()
    gaussian = np.exp(-(error**2).sum() / (2 * args.sigma**2))
    return gaussian - args.slack_weight * violation - plant.economic_cost(x)


def teach(args, teacher, x, goal, psi):
    """A closed loop from x on a plant with the parameters psi: a row (x, goal, value, slope, action) per step.

    What a state is worth is what its plan promised, or what the loop then got if that is more: both can be done, and a plan, whose actions
    are fixed, cannot hold for long what is unstable. Not where plants are drawn: what one of them got is not the mean over all.
    """
    plant, rows, rewards = teacher.plant, [], []
    teacher.reset()
    teacher.set_goal(goal)
    for _ in range(args.length):
        u = teacher.make_step(x)
        if teacher.stats["rung"] != "plan":
            break
        slope = teacher.slope() if args.slopes else np.zeros(len(x))  # a third of the time
        rows.append([x, goal, teacher.value(), slope, teacher.plan[0].copy()])
        x = plant.step(x, u, psi)
        rewards.append(reward(args, plant, x, goal))
    for now, later, got in zip(rows[-2::-1], rows[:0:-1], rewards[-2::-1]):
        if args.returns and not args.robust_horizon:
            now[2] = max(now[2], got + args.gamma * later[2])
    return rows


def mirrors(plant):
    """Whether the mirror image (-x, -u, -goal) of every motion is one, and worth the same: each plan then teaches twice."""
    rng = np.random.default_rng(0)
    x, psi = envs.sample_states(plant, rng, 16), rng.choice(plant.EVAL_PSI, 16)
    u, goal = (
        rng.uniform(plant.U_LOW, plant.U_HIGH, (16, len(plant.U_LOW))),
        rng.choice(plant.TRAIN_GOALS, 16),
    )
    error = [(plant.goal_error(s * x[:, plant.GOAL_INDEX], s * goal) ** 2).sum(axis=1) for s in (1, -1)]
    pairs = [error, (plant.step(x, u, psi), -plant.step(-x, -u, psi))]
    pairs += [(plant.X_LOW, -plant.X_HIGH), (plant.U_LOW, -plant.U_HIGH)]
    return all(np.allclose(a, b, rtol=1e-9, atol=1e-9) for a, b in pairs)


# Fitting


class Learner:
    """Actor and two critics in the form that deployment reads; the critics' inputs from the action stay zero."""

    def __init__(self, args, plant):
        self.args, self.plant, self.scaling = args, plant, Scaling.of(plant)
        n_in = len(self.scaling.other_index) + 2 * len(self.scaling.angle_index)
        self.network = dict(n_in=n_in, n_u=len(plant.U_LOW), hidden=list(args.hidden))
        self.most = 1 / (1 - args.gamma)  # value of a reward of one for ever, the networks' unit
        with torch.random.fork_rng(devices=[]):  # torch.nn draws from the global generator
            torch.manual_seed(args.seed)
            self.actor, self.critic = Actor(**self.network), TwinCritic(**self.network)
        self.generator = torch.Generator().manual_seed(args.seed)

    def values(self, x, goal):
        """Both critics' values, unit `most`, (2, B), of states (2, B, n_x), and the input of each, (2, B, n_in)."""
        z = self.scaling.features(x.flatten(0, 1), goal.flatten(0, 1), "error").view(*x.shape[:2], -1)
        return self.critic(z, torch.zeros(*z.shape[:2], self.network["n_u"])), z

    def fit(self, x, goal, value, slope, action):
        """Tensors of what the plans taught, a row per state. Returns the mean error of the value on a twentieth, held out."""
        held, parameters = len(x) // 20, [*self.actor.parameters(), *self.critic.parameters()]
        value, slope = value / self.most, slope / self.most
        sane = (slope.abs() < STEEP).all(dim=1, keepdim=True)  # nor is nan
        slope = torch.where(sane, slope, 0)
        optimiser = torch.optim.Adam(parameters, fused=True)
        for k in tqdm(range(self.args.updates), "fit", leave=False, mininterval=0.5, disable=None):
            batch = torch.randint(held, len(x), (self.args.batch_size,), generator=self.generator)
            at = x[batch].repeat(2, 1, 1).requires_grad_()
            found, z = self.values(at, goal[batch].repeat(2, 1, 1))
            loss = 2 * F.mse_loss(found, value[batch].expand(2, -1))
            loss += F.mse_loss(self.actor.act(z[0].detach()), action[batch])
            if self.args.slopes:
                (slopes,) = torch.autograd.grad(found.sum(), at, create_graph=True)
                difference = (slopes * self.scaling.x_scale - slope[batch]) * sane[batch]
                loss += 2 * self.args.slopes * F.smooth_l1_loss(difference, torch.zeros_like(difference))
            optimiser.param_groups[0]["lr"] = self.args.learning_rate * (1 - k / self.args.updates)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            found, _ = self.values(x[:held].repeat(2, 1, 1), goal[:held].repeat(2, 1, 1))
            return self.most * (found.mean(0) - value[:held]).abs().mean().item()

    def checkpoint(self, sweep):
        """What deployment needs, as plain data."""
        a, critic = self.args, {name: part.clone() for name, part in self.critic.state_dict().items()}
        critic["weight.0"][:, self.network["n_in"] :] = 0  # V has no action
        for name in (f"{kind}.{len(a.hidden)}" for kind in ("weight", "bias")):
            critic[name] *= self.most
        head = {"format": FORMAT, "env": a.env, "plant_options": {}, "env_id": self.plant.ENV_ID}
        head |= {"network": self.network, "goal_input": "error", "scaling": self.scaling.values}
        head |= {"actor": dict(self.actor.state_dict()), "critic": critic, "combine": a.combine}
        plan = dict(discount=a.gamma, sigma2=a.sigma**2)
        plan |= dict(slack_weight=a.slack_weight, robust_horizon=a.robust_horizon)
        args = {name: value for name, value in plain(a).items() if name not in ("out", "resume")}
        return head | {"plan": plan, "gamma": a.gamma, "step": sweep, "args": args}

    def state_dict(self):
        networks = {"actor": self.actor.state_dict(), "critic": self.critic.state_dict()}
        return networks | {"generator": self.generator.get_state()}

    def load_state_dict(self, state):
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.generator.set_state(state["generator"])


# Closed loops


def closed_loops(args, plant, path):
    """The deployed controller with the value at `path`: what it visited (states, goals), and a row of how it did."""
    n = args.loops // 2
    starts = [draws(plant, n, args.seed + 1000, kind) for kind in ("start", "box")]
    x, psi = (np.concatenate(parts) for parts in zip(*starts))
    psi = psi if args.robust_horizon else np.broadcast_to(plant.PSI_NOMINAL, psi.shape)
    controller = rl.build_controller("rl_mpc", rl.Args(env=args.env, critic=path, horizon=args.horizon))
    states, aims, rows = [], [], []
    for i in range(2 * n):
        goal = plant.TRAIN_GOALS[i % len(plant.TRAIN_GOALS)]
        controller.set_goal(goal)
        reached, _, row = run_episode(controller, plant, x[i], psi[i], goal, args.steps)
        states.append(reached[:-1])
        aims.append(np.broadcast_to(goal, (args.steps, len(goal))))
        near = envs.goal_reward(plant, reached[-51:, plant.GOAL_INDEX], goal, sigma2=plant.METRIC_SIGMA2)
        rows.append(row | {"held": near.mean() > 0.9})
    near, outside, held, ms = (
        np.array([row[key] for row in rows])
        for key in ("time_near_goal", "time_outside_constraints", "held", "solve_ms_median")
    )
    row = {
        "score": (near + outside).mean() / args.steps,
        "near_goal": np.median(near),
        "held": held[:n].mean(),
    }
    row |= {"held_anywhere": held[n:].mean(), "outside": outside.mean(), "solve_ms": np.median(ms)}
    return (np.concatenate(states), np.concatenate(aims)), row


# Training


def check(args):
    """Refuse, by ValueError, what cannot work before anything long starts; returns the plant."""
    plant = envs.load(args.env)
    check_ranges(args, seed=(0, 10**9), sweeps=(1, 1000), states=(40, 10**7), length=(2, 10**5))
    check_ranges(args, **dict.fromkeys(["lookahead", "horizon"], (1, 1000)), robust_horizon=(0, 10))
    check_ranges(args, sigma=(1e-6, 1e6), slack_weight=(0, 1e6), gamma=(0, 0.9999), box=(0.1, 100))
    check_ranges(args, visited=(0, 1), slopes=(0, 1e3), updates=(1, 10**7), batch_size=(1, 10**6))
    check_ranges(args, learning_rate=(1e-9, 1e3), loops=(2, 10**4), steps=(51, 10**5))
    if not args.hidden or not all(1 <= width <= 10_000 for width in args.hidden):
        raise ValueError(f"--hidden is {args.hidden}; it needs at least one width, each from 1 to 10000")
    ScenarioTree(len(envs.scenario_set(plant, "mpc")), args.lookahead, args.robust_horizon)
    return plant


def main(args):
    source, state = args.resume, None
    if source:
        if args != Args(resume=source):
            raise ValueError(f"--resume {source} continues with the run's own arguments; give no others")
        state = read_file(source, RESUME, "a resume.pt of this script")
        args = Args(**state["args"])
    plant = check(args)
    name = f"{args.env}__planner_value_iteration__{args.seed}__{int(time.time())}"
    run_dir = output_folder(source and source.parent, args.out / name)
    torch.set_num_threads(1)  # networks this small run fastest on one
    learner, rng = Learner(args, plant), np.random.default_rng(args.seed)
    rows, visited, twice = [], None, mirrors(plant)
    if source:
        learner.load_state_dict(state["learner"])
        rng.bit_generator.state = state["rng"]
        rows, visited = state["rows"], [part.numpy() for part in state["visited"]]
    writer = SummaryWriter(run_dir, purge_step=len(rows))
    with until_interrupted() as interrupted:
        for sweep in range(len(rows), args.sweeps):
            tick = time.perf_counter()
            teacher = build_teacher(args, plant, learner.checkpoint(sweep) if sweep else None)
            taught, starts = [], list(zip(*sample(args, plant, visited, rng)))
            for x, goal in tqdm(starts, f"sweep {sweep}: plan", leave=False, disable=None):
                psi = rng.choice(plant.SCENARIOS["robust"]) if args.robust_horizon else plant.PSI_NOMINAL
                taught += [] if interrupted else teach(args, teacher, x, goal, psi)
            if interrupted:
                break
            planned = time.perf_counter() - tick
            x, goal, value, slope, action = (
                torch.tensor(np.array(part), dtype=torch.float32) for part in zip(*taught)
            )
            if twice:
                pairs = (torch.stack([part, -part], 1).flatten(0, 1) for part in (x, goal, slope, action))
                (x, goal, slope, action), value = pairs, value.repeat_interleave(2)
            error = learner.fit(x, goal, value, slope, action)
            fitted = time.perf_counter() - tick - planned
            save(learner.checkpoint(sweep), run_dir / "latest.pt")
            visited, row = closed_loops(args, plant, run_dir / "latest.pt")
            seconds = time.perf_counter() - tick + (rows[-1]["seconds"] if rows else 0)
            head = {"sweep": sweep, "seconds": seconds, "plan_seconds": planned, "fit_seconds": fitted}
            row = head | {"value": value.mean().item(), "fit_error": error} | row
            rows.append({k: v if isinstance(v, int) else round(float(v), 4) for k, v in row.items()})
            write_csv(rows, run_dir / "sweeps.csv")
            for name, number in rows[-1].items():
                writer.add_scalar(f"charts/{name}", number, sweep)
            if rows[-1]["score"] >= max(each["score"] for each in rows):
                (run_dir / "latest.pt").replace(run_dir / "checkpoint.pt")
            print("  ".join(f"{name} {number:.4g}" for name, number in rows[-1].items()), flush=True)
            resume = {"format": RESUME, "args": plain(args), "rows": rows, "learner": learner.state_dict()}
            resume |= {
                "rng": rng.bit_generator.state,
                "visited": [torch.from_numpy(part) for part in visited],
            }
            save(resume, run_dir / "resume.pt")
    writer.close()
    if interrupted:
        print(f"interrupted; continue with --resume {run_dir / 'resume.pt'}", file=sys.stderr)
        raise SystemExit(130)
    print(run_dir / "checkpoint.pt")
    return run_dir


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
