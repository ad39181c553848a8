"""Figure `norm_profile`: the learned value in goal-conditioned MPC on ten random linear systems with 32 states, and its fast variant.

    python experiments/linear/value_mpc.py --study train --jobs 2    # forty minutes: an agent per system; continues where it stopped
    python experiments/linear/value_mpc.py                           # the closed loops; one process, so that solve times mean something
    python experiments/linear/value_mpc.py --study distance          # how far from the goal the fast variant stays valid
    python experiments/linear/value_mpc.py --study scaling           # solve time against n and against the horizon
    python experiments/linear/value_mpc.py --study profile --plot-only

The agents are those of `python sac_her_branching.py --env linear --dim 32 --system 0 --seed 0`, and of 1 to 9; the scaling study has one
more for each smaller n, of 100,000 transitions. Every controller has the stage cost -exp(-|x|^2) at x_1 ... x_N and state bounds 1.5 at a
price of 1 (rl_mpc_deploy.py); they differ in what stands at x_N: nothing, -V, with as many iterations as needed or with one, or the
paper's fast variant, -V expanded about the goal to second order (`taylor_value`). Those with a value first guess the
actor's actions, that without one the regulator's. Beside them the goal-conditioned MPC of scalability.py, whose costs contain the
input and whose terminal cost is the regulator's.

Writes results/linear_value_mpc_NAME.csv for NAME in training, profile, distance, times, linear_value_mpc.csv (a row per closed loop of the
profile study), and the figures linear_value_mpc.png, linear_value_mpc_distance.png and linear_value_mpc_times.png.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs.control.expansion import expansion
from envs.control.tree_qp import positive_part
from experiments import common
from experiments.common import column, distinct, rounded, select, without
from experiments.palette import BLUE, GREEN, GREY, ORANGE, PINK, RED

ACTOR, REGULATOR = "RL (actor alone)", "goal-conditioned MPC, regulator's value"
NO_VALUE, TAYLOR = "goal-conditioned MPC, no value", "RL+MPC, V expanded about the goal"
RL_MPC, ONE = dict(controllers=("rl_mpc",)), dict(controllers=("rl_mpc",), iterations=1)
CONTROLLERS = {  # label: (colour, dashes, settings of rl_mpc_deploy.py, or None for goal_mpc.py)
    ACTOR: (RED, "--", dict(controllers=("actor",))),
    REGULATOR: (GREY, ":", None),
    NO_VALUE: (ORANGE, "-.", dict(controllers=("goal_mpc",))),
    "RL+MPC": (GREEN, "-", RL_MPC),
    "RL+MPC, one iteration": (PINK, (0, (3, 1, 1, 1)), ONE),
    TAYLOR: (BLUE, (0, (5, 1)), RL_MPC),
}
PLANNERS = list(CONTROLLERS)[1:]
SCALING_DIMENSIONS, SCALING_HORIZONS = (2, 4, 8, 16), (2, 5, 10, 20, 40)  # beside --dim
DISTANCE_HORIZONS, DISTANCES = (1, 2, 5, 10), (0.1, 0.3, 1.0, 2.0, 3.0)
QUICK = dict(total_timesteps=2000, learning_starts=500, eval_every=1000, hidden=(16, 16))


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["train", "profile", "distance", "scaling"] = "profile"
    """train the agents; profile: the paper's figure; distance: starts near and far; scaling: solve times"""
    dim: int = 32
    """number of states"""
    systems: int = 10
    """random systems, of seeds in a row, one agent each"""
    starts: int = 10
    """initial states per system (distance: 2 at most, scaling: 5)"""
    steps: int = 50
    """sampling times per episode (distance and scaling: 20 at most)"""
    horizon: int = 5
    """N of every controller that plans"""
    jobs: int = 1
    """processes; more than one per core disturbs the solve times"""


# Agents


def agent(args, dim, system):
    """Arguments of sac_her_branching.py; agents of the scaling study have a smaller budget."""
    settings = dict(env="linear", dim=dim, system=system, seed=system)
    settings |= {} if dim == args.dim else dict(total_timesteps=100_000)
    return settings | (QUICK if args.quick else {})


def scaling_dimensions(args):
    return [n for n in SCALING_DIMENSIONS[: 1 if args.quick else None] if n < args.dim] + [args.dim]


def checkpoint(args, dim, system):
    """The trained agent of a system; a missing one is a user's mistake."""
    path = common.agent_folder(agent(args, dim, system), args.runs) / "checkpoint.pt"
    if not path.exists():
        command = "python experiments/linear/value_mpc.py --study train"
        command += f" --dim {args.dim} --systems {args.systems} --runs {args.runs}{' --quick' * args.quick}"
        common.fail(f"no agent is trained for n = {dim}, system {system}; first run {command}")
    return path


def train(args):
    """A row per agent: of every system, then of the scaling study."""
    agents = [(args.dim, system) for system in range(args.seed, args.seed + args.systems)]
    agents += [(n, args.seed) for n in scaling_dimensions(args)[:-1]]
    rows, settings = [], [agent(args, *each) for each in agents]
    for (dim, system), folder in zip(agents, common.train(settings, args.runs, args.jobs)):
        data = torch.load(folder / "checkpoint.pt", weights_only=True)
        last, record = common.read(folder / "evaluations.csv")[-1], common.record(folder)
        sizes = {name: sum(v.numel() for v in data[name].values()) for name in ("actor", "critic")}
        row = {"n": dim, "system": system, "seed": data["args"]["seed"], "transitions": last["step"]}
        row |= {"updates": last["updates"], "train_seconds": last["train_seconds"]}
        row |= {name: record[name] for name in ("wall_seconds", "jobs")}
        row |= {"error_median": last["nominal_median_ape"], "error_p75": last["nominal_p75_ape"]}
        row |= {"alpha": data["alpha"], "parameters_actor": sizes["actor"]}
        rows.append(row | {"parameters_one_critic": sizes["critic"] // 2})
    return rows


def print_agents(rows):
    print("system  updates  seconds  error %, median  75th percentile")
    print("        (root mean square of the state over steps 26 to 50)")
    for row in rows:
        errors = f"{float(row['error_median']):17.2f}{float(row['error_p75']):17.2f}"
        print(f"{row['system']:>6s}{row['updates']:>9s}{float(row['train_seconds']):9.0f}{errors}")
    error, seconds = np.median(column(rows, "error_median")), column(rows, "train_seconds").max()
    print(f"median over systems {error:.2f} %, at most {seconds:.0f} s per agent")


# Closed loops


def taylor_value(critic):
    """CasADi function (x, goal) -> V expanded to second order about the goal, which names every state.

    -V need not be convex, and a quadratic that is not has its minimum at the end of the world: negative eigenvalues of its Hessian, in
    units of the box of initial states, become zero.
    """
    center, scale = critic.plant.EVAL_GOAL, critic.scaling["x_scale"]
    x, goal = ca.MX.sym("x", len(center)), ca.MX.sym("goal", len(center))
    value, gradient, hessian = (np.array(part) for part in expansion(critic)(center, center, 0 * center))
    curvature = positive_part(-hessian * np.outer(scale, scale))
    away = (x - goal) / scale
    expanded = value + ca.dot(gradient.ravel() * scale, away) - ca.bilin(curvature, away, away) / 2
    return ca.Function("taylor", [x, goal], [expanded])


def build(label, dim, system, horizon, critic, compile=True):
    """A controller of the figure for one system."""
    settings = CONTROLLERS[label][2]
    if settings is None:
        given = dict(env="linear", dim=dim, system=system, horizon=horizon)
        return gm.build_controller(gm.Args(**given, slack_weight=1.0, compile=False))
    settings = deploy.Args(env="linear", critic=critic, horizon=horizon, compile=compile, **settings)
    if label not in (NO_VALUE, TAYLOR):
        return deploy.build_controller(settings.controllers[0], settings)
    critic = deploy.load_critic(critic, "linear")
    plant = critic.plant
    x, goal = ca.MX.sym("x", dim), ca.MX.sym("goal", dim)
    stage = ca.Function("stage", [x, goal], [-ca.exp(-ca.sumsqr(x - goal) / (2 * plant.MPC_SIGMA2))])
    if label == TAYLOR:
        value, policy = taylor_value(critic), deploy.export(critic)[0]
    else:  # far from the goal the stage cost is flat: from middle actions no solver would find the way
        value, policy = None, ca.Function("regulator", [x, goal], [plant.feedback(x, goal)])
    options = dict(goal=plant.EVAL_GOAL, policy=policy, compile=compile)
    return deploy.ScenarioMPC(plant, horizon, plant.SCENARIOS["mpc"], stage, value, **options)


def run_loop(controller, plant, x0, steps):
    """Closed loop from x0: states (steps + 1, n) and the controller's stats of every step."""
    controller.reset()
    x, log = [x0], []
    for _ in range(steps):
        x.append(plant.step(x[-1], controller.make_step(x[-1])))
        log.append(controller.stats)
    return np.array(x), log


def failed(stats):
    """Whether a step had no plan or left a problem unsolved."""
    if "success" in stats:  # IPOPT's
        return not stats["success"]
    return stats["fell_back"] or stats.get("stop") == "unsolved"


def measures(plant, x, log):
    """The measures of scalability.py, and solve times."""
    milliseconds = [s["wall_ms"] for s in log]
    return {
        "steps_not_near": len(log) - envs.time_near_goal(plant, x[1:], plant.EVAL_GOAL),
        "l2_error": np.sqrt((x[1:] ** 2).sum()),
        "constraint_violation": np.abs(x[1:] - np.clip(x[1:], plant.X_LOW, plant.X_HIGH)).sum(),
        "final_norm": np.linalg.norm(x[-1]),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "solve_ms_max": max(milliseconds),
        "solve_ms_transient": np.mean(milliseconds[:5]),
        "iterations": sum(s.get("iterations", 0) for s in log),
        "solver_failures": sum(map(failed, log)),
    }


def run_cell(cell):
    """One controller on one system from every start, at one horizon and at some distances: rows, each with its profile as text."""
    label, dim, system, horizon, scales, starts, steps, critic, jobs, compile = cell
    torch.set_num_threads(1)
    controller = build(label, dim, system, horizon, Path(critic), compile)
    plant, rows = envs.load("linear", dim=dim, system=system), []
    rngs = [np.random.default_rng([dim, system, i + 1]) for i in range(starts)]
    x0s = [envs.sample_states(plant, rng, 1)[0] for rng in rngs]
    for scale in scales:
        for i, x0 in enumerate(x0s):
            x, log = run_loop(controller, plant, scale * x0, steps)
            head = {"controller": label, "n": dim, "horizon": horizon, "system": system, "start": i}
            row = {k: float(v) for k, v in measures(plant, x, log).items()}
            paths = {"norms": np.linalg.norm(x, axis=1), "times": [s["wall_ms"] for s in log]}
            texts = {name: " ".join(f"{v:.4g}" for v in path) for name, path in paths.items()}
            rows.append(head | {"scale": scale, "jobs": jobs} | rounded(row, 5) | texts)
    return rows


def cell(args, label, dim, system, horizon, scales=(1.0,)):
    critic = str(checkpoint(args, dim, system))
    return label, dim, system, horizon, scales, args.starts, args.steps, critic, args.jobs, not args.quick


def collect(args, labels, horizons, scales=(1.0,)):
    """Rows of controllers on every system; the actor has no horizon and runs once."""
    systems = range(args.seed, args.seed + args.systems)
    kinds = [(label, N) for N in horizons for label in labels if label != ACTOR or N == horizons[0]]
    work = [cell(args, label, args.dim, system, N, scales) for label, N in kinds for system in systems]
    return common.collect(run_cell, work, args.runs, args.jobs)


def table(rows):
    """Rows for a committed table."""
    return [without(row, "norms", "times") for row in rows]


# The paper's figure


def quantiles(name, values):
    """2.5 and 95 percentile and median, five digits."""
    found = np.quantile(values, [0.025, 0.5, 0.95])
    return {f"{name}_{k}": float(f"{v:.5g}") for k, v in zip(("low", "median", "high"), found)}


def profile(args):
    rows, curves = collect(args, CONTROLLERS, (args.horizon,)), []
    for label in CONTROLLERS:
        mine = select(rows, controller=label)
        norms, times = (np.array([row[key].split() for row in mine], float) for key in ("norms", "times"))
        for t in range(norms.shape[1]):
            late = min(t, times.shape[1] - 1)  # no action is computed at the last state: its time is repeated
            curve = quantiles("norm", norms[:, t]) | quantiles("ms", times[:, late])
            curves.append({"controller": label, "step": t} | curve)
    common.write(table(rows), args.table("linear_value_mpc"))
    common.write(curves, args.table("linear_value_mpc_profile"))


def print_profile(rows, labels):
    head = f"{'':42s}{'steps not near':>22s}{'l2 error':>22s}{'violation':>10s}{'|x_50|':>9s}"
    print(f"{head}{'ms median':>11s}{'first 5':>9s}{'worst':>8s}{'failed':>8s}")
    for label in labels:
        mine, text = select(rows, controller=label), f"{label:42s}"
        for key in ("steps_not_near", "l2_error"):
            low, median, high = np.quantile(column(mine, key), [0.025, 0.5, 0.95])
            text += f"{median:8.2f} [{low:5.2f},{high:6.2f}]"
        keys = ("constraint_violation", "final_norm", "solve_ms_median", "solve_ms_transient")
        violation, end, ms, early = (np.median(column(mine, key)) for key in keys)
        worst, failed = column(mine, "solve_ms_max").max(), column(mine, "solver_failures").sum()
        print(f"{text}{violation:10.2f}{end:9.4f}{ms:11.1f}{early:9.1f}{worst:8.0f}{failed:8.0f}")
    for label in labels[3:]:
        text = f"{label}: solve time over that without a value"
        for key, name in (("solve_ms_median", "median"), ("solve_ms_transient", "first five steps")):
            mine, plain = (np.median(column(rows, key, controller=each)) for each in (label, NO_VALUE))
            text += f", {name} {mine / plain:.2f}"
        print(text)
    actor, *others = (column(rows, "steps_not_near", controller=label) for label in labels)
    for label, steps in zip(labels[1:], others):
        gain = actor - steps  # paired by system and start
        fewer = f"{np.median(gain):.2f} fewer steps not near the origin than the actor (median)"
        print(f"{label}: {fewer}, fewer in {(gain > 0).mean():.0%}")


def plot_profile(args):
    rows, curves = (common.read(args.table(f"linear_value_mpc{part}")) for part in ("", "_profile"))
    labels = distinct(curves, "controller")
    print_profile(rows, labels)
    fig, axes = common.subplots(2, 1, figsize=(8, 6.4), sharex=True)
    for label in labels:
        colour, dashes, _ = CONTROLLERS[label]
        for ax, key, floor in zip(axes, ("norm", "ms"), (1e-3, 0)):
            if key == "ms" and label == ACTOR:
                continue
            names = (f"{key}_low", f"{key}_median", f"{key}_high")
            low, median, high = (np.maximum(column(curves, name, controller=label), floor) for name in names)
            wide = label == NO_VALUE and key == "norm"  # on which the others lie
            ax.plot(median, color=colour, ls=dashes, lw=4.5 if wide else 2, label=label)
            ax.fill_between(range(len(median)), low, high, color=colour, alpha=0.12, lw=0)
    axes[0].set(ylabel="|x|, below 0.001 drawn there", yscale="log", xlim=(0, 12))
    axes[1].set(ylabel="solve time [ms]", yscale="log", xlabel="step")
    systems, starts = (len(distinct(rows, key)) for key in ("system", "start"))
    title = f"{systems} systems, {starts} starts each; lines: medians, bands: 2.5 to 95 percentile"
    axes[0].set_title(title, fontsize=10)
    for ax in axes:
        ax.grid(alpha=0.3)
    common.legend(fig, axes[0], "lower", ncols=2)
    common.save(fig, args.figure("linear_value_mpc"))


# How far from the goal


def distance(args):
    """The learned value and its expansions from starts that are scaled towards or away from the goal, at several horizons."""
    args = replace(args, starts=min(args.starts, 2), steps=min(args.steps, 20))
    horizons, scales = ((1, 2), (0.1, 1.0)) if args.quick else (DISTANCE_HORIZONS, DISTANCES)
    rows = collect(args, [label for label in CONTROLLERS if label != REGULATOR], horizons, scales)
    common.write(table(rows), args.table("linear_value_mpc_distance"))


def plot_distance(args):
    rows = common.read(args.table("linear_value_mpc_distance"))
    horizons, scales, labels = (distinct(rows, key) for key in ("horizon", "scale", "controller"))
    fig, axes = common.subplots(1, len(horizons), figsize=(10, 3.6), sharey=True, squeeze=False)
    print(
        "median steps not near the origin, failed solves of all; starts in a box of half-width",
        ", ".join(scales),
    )
    for ax, horizon in zip(axes[0], horizons):
        for offset, label in zip(np.linspace(-0.2, 0.2, len(labels)), labels):
            colour, dashes, _ = CONTROLLERS[label]
            mine = select(rows, controller=label, **{} if label == ACTOR else {"horizon": horizon})
            steps = [np.median(column(mine, "steps_not_near", scale=scale)) for scale in scales]
            failed = [column(mine, "solver_failures", scale=scale).sum() for scale in scales]
            at, style = np.arange(len(scales)) + offset, dict(color=colour, ls=dashes, lw=1.5)
            ax.plot(at, steps, marker="o", label=label, **style)
            texts = [f"{s:9.2f} ({f:4.0f})" for s, f in zip(steps, failed)]
            print(f"N = {horizon:3s} {label:42s}" + "".join(texts))
        ax.set_xticks(range(len(scales)), scales)
        ax.set(title=f"N = {horizon}", ylim=(-0.3, None), xlabel="half-width of the start box")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("steps not near the origin")
    common.legend(fig, axes[0, 0], "lower", ncols=3)
    common.save(fig, args.figure("linear_value_mpc_distance"))


# Scaling


def scaling(args):
    """Solve times of one system: against n at the horizon, against the horizon at n = dim."""
    args = replace(args, starts=min(args.starts, 5), steps=min(args.steps, 20))
    problems = {
        "n": [(n, args.horizon) for n in scaling_dimensions(args)],
        "horizon": [(args.dim, N) for N in SCALING_HORIZONS[: 2 if args.quick else None]],
    }
    rows = []
    for axis, pairs in problems.items():
        work = [cell(args, label, n, args.seed, N) for n, N in pairs for label in PLANNERS]
        found = common.collect(run_cell, work, args.runs, args.jobs)
        rows += [{"axis": axis} | row for row in table(found)]
    common.write(rows, args.table("linear_value_mpc_times"))


def plot_scaling(args):
    rows = common.read(args.table("linear_value_mpc_times"))
    fig, axes = common.subplots(1, 2, figsize=(9, 3.8), sharey=True)
    for ax, axis, title in zip(axes, ("n", "horizon"), ("number of states n", "horizon N")):
        values = sorted({int(row[axis]) for row in select(rows, axis=axis)})
        print(f"{axis}: median ms per step and (mean ms of the first five steps) at {values}")
        for label in distinct(rows, "controller"):
            groups = [select(rows, axis=axis, controller=label, **{axis: value}) for value in values]
            early = [np.median(column(group, "solve_ms_transient")) for group in groups]
            late = [np.median(column(group, "solve_ms_median")) for group in groups]
            colour, dashes, _ = CONTROLLERS[label]
            ax.plot(values, early, marker="o", color=colour, ls=dashes, lw=2, label=label)
            print(f"  {label:42s}" + "".join(f"{b:8.1f} ({a:7.1f})" for a, b in zip(early, late)))
        ax.set(xscale="log", yscale="log", xlabel=title)
        ax.set_xticks(values, values)
        ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("solve time, mean of steps 1 to 5 [ms]")
    common.legend(fig, axes[0], "lower", ncols=2)
    common.save(fig, args.figure("linear_value_mpc_times"))


def main(args):
    name = {"train": "training", "scaling": "times"}.get(args.study, args.study)
    ranges = dict(dim=(1, 512), systems=(1, 1000), starts=(1, 1000), steps=(5, 10**6), horizon=(1, 1000))
    common.check(args, f"linear_value_mpc_{name}", **ranges)
    if args.quick:
        args = replace(args, dim=3, systems=2, starts=2, steps=5)
    if args.study == "train":
        if not args.plot_only:
            common.write(train(args), args.table("linear_value_mpc_training"))
        return print_agents(common.read(args.table("linear_value_mpc_training"))[: args.systems])
    if not args.plot_only:
        {"profile": profile, "distance": distance, "scaling": scaling}[args.study](args)
    {"profile": plot_profile, "distance": plot_distance, "scaling": plot_scaling}[args.study](args)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
