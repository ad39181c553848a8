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
actor's actions, that without one the regulator's. Beside them the goal-conditioned MPC of linear_scalability.py, whose costs contain the
input and whose terminal cost is the regulator's.

Writes results/linear_value_mpc_NAME.csv for NAME in training, profile, distance, times, linear_value_mpc.csv (a row per closed loop of the
profile study), and the figures linear_value_mpc.png, linear_value_mpc_distance.png and linear_value_mpc_times.png.
"""

import csv
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import casadi as ca
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import torch

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import linear
from envs.control.expansion import expansion
from envs.control.tree_qp import positive_part
from experiments import common as cells
from experiments.common import HERE, ROOT

CONTROLLERS = {  # label: (colour, dashes, settings of rl_mpc_deploy.py, or None for goal_mpc.py)
    "RL (actor alone)": ("#D55E00", "--", dict(controllers=("actor",))),
    "goal-conditioned MPC, regulator's value": ("#999999", ":", None),
    "goal-conditioned MPC, no value": ("#E69F00", "-.", dict(controllers=("goal_mpc",))),
    "RL+MPC": ("#009E73", "-", dict(controllers=("rl_mpc",))),
    "RL+MPC, one iteration": ("#CC79A7", (0, (3, 1, 1, 1)), dict(controllers=("rl_mpc",), iterations=1)),
    "RL+MPC, taylor": ("#0072B2", (0, (5, 1)), dict(controllers=("rl_mpc",))),
}
SCALING_DIMENSIONS, SCALING_HORIZONS = (2, 4, 8, 16), (2, 5, 10, 20, 40)  # beside --dim
DISTANCE_HORIZONS, DISTANCES = (1, 2, 5, 10), (0.1, 0.3, 1.0, 2.0, 3.0)
MEASURES = ("steps_not_near", "l2_error", "constraint_violation")


@dataclass(frozen=True)
class Args:
    study: Literal["train", "profile", "distance", "scaling"] = "profile"
    """train the agents; profile: the paper's figure; distance: starts near and far; scaling: solve times"""
    dim: int = 32
    """number of states"""
    systems: int = 10
    """random systems, one agent each"""
    starts: int = 10
    """initial states per system (distance: 2 at most, scaling: 5)"""
    steps: int = 50
    """sampling times per episode (distance and scaling: 20 at most)"""
    horizon: int = 5
    """N of every controller that plans"""
    seed: int = 0
    """seed of the first system and its agent"""
    jobs: int = 1
    """processes; more than one per core disturbs the solve times"""
    quick: bool = False
    """2 systems with 3 states, hardly trained, 2 starts of 5 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/linear_value_mpc")
    """where agents and finished systems are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


# Agents


def agent_folder(args, dim, system):
    """Agents of the scaling study have a smaller budget and a folder of their own."""
    return (
        args.runs
        / f"agents/{dim}_{system}{'' if dim == args.dim else '_scaling'}{'_quick' if args.quick else ''}"
    )


def checkpoint(args, dim, system):
    """The trained agent of a system; a missing one is a user's mistake."""
    found = list(agent_folder(args, dim, system).glob("*/wall_seconds.txt"))
    if not found:
        command = f"python experiments/linear/value_mpc.py --study train --dim {args.dim} --systems {args.systems} --runs {args.runs}"
        cells.fail(
            f"no trained agent in {agent_folder(args, dim, system)}; first run {command}{' --quick' if args.quick else ''}"
        )
    return found[0].parent / "checkpoint.pt"


def train(args, dim, system):
    """One run of the training script, continued where it was interrupted; returns its row."""
    parent = agent_folder(args, dim, system)
    if not list(parent.glob("*/wall_seconds.txt")):
        command = [sys.executable, str(ROOT / "sac_her_branching.py")]
        interrupted = list(parent.glob("*/resume.pt"))
        if interrupted:
            command += ["--resume", str(interrupted[0])]
        else:
            command += [
                "--env",
                "linear",
                "--dim",
                str(dim),
                "--system",
                str(system),
                "--seed",
                str(system),
                "--out",
                str(parent),
            ]
            command += ["--save-every", "100000"]
            if dim != args.dim:
                command += ["--total-timesteps", "100000"]
            if args.quick:
                command += [
                    "--total-timesteps",
                    "2000",
                    "--learning-starts",
                    "500",
                    "--eval-every",
                    "1000",
                    "--hidden",
                    "16",
                    "16",
                ]
        tick = time.perf_counter()
        result = subprocess.run(
            command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        if result.returncode:
            raise RuntimeError(f"training of system {system} stopped: {result.stderr[-2000:]}")
        run = max(parent.iterdir(), key=lambda path: path.stat().st_mtime)
        (run / "resume.pt").unlink()  # as large as the replay buffer
        (run / "wall_seconds.txt").write_text(f"{time.perf_counter() - tick:.1f}")
    run = checkpoint(args, dim, system).parent
    data = torch.load(run / "checkpoint.pt", weights_only=True)
    last = list(csv.DictReader(open(run / "evaluations.csv")))[-1]
    sizes = {name: sum(v.numel() for v in data[name].values()) for name in ("actor", "critic")}
    return {
        "n": dim,
        "system": system,
        "seed": data["args"]["seed"],
        "transitions": last["step"],
        "updates": last["updates"],
        "train_seconds": last["train_seconds"],
        "wall_seconds": (run / "wall_seconds.txt").read_text(),
        "jobs": args.jobs,
        "error_median": last["nominal_median_ape"],
        "error_p75": last["nominal_p75_ape"],
        "alpha": data["alpha"],
        "parameters_actor": sizes["actor"],
        "parameters_one_critic": sizes["critic"] // 2,
    }


def train_all(args):
    agents = [(args.dim, system) for system in range(args.seed, args.seed + args.systems)] + [
        (n, args.seed) for n in scaling_dimensions(args)[:-1]
    ]
    with ThreadPoolExecutor(args.jobs) as pool:
        rows = list(
            tqdm(
                pool.map(lambda agent: train(args, *agent), agents),
                total=len(agents),
                unit="agent",
                disable=None,
            )
        )
    cells.write(rows, args.out / "results/linear_value_mpc_training.csv")
    rows = rows[: args.systems]
    print(
        "system  updates  seconds  error %, median  75th percentile  (root mean square of the state over steps 26 to 50)"
    )
    for row in rows:
        print(
            f"{row['system']:6d}{row['updates']:>9s}{float(row['train_seconds']):9.0f}{float(row['error_median']):17.2f}{float(row['error_p75']):17.2f}"
        )
    print(
        f"median over systems {np.median([float(row['error_median']) for row in rows]):.2f} %, "
        f"at most {max(float(row['train_seconds']) for row in rows):.0f} s per agent"
    )


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
        return gm.build_controller(
            gm.Args(env="linear", dim=dim, system=system, horizon=horizon, slack_weight=1.0, compile=False)
        )
    settings = deploy.Args(env="linear", critic=critic, horizon=horizon, compile=compile, **settings)
    if label not in ("goal-conditioned MPC, no value", "RL+MPC, taylor"):
        return deploy.build_controller(settings.controllers[0], settings)
    critic = deploy.load_critic(critic, "linear")
    plant = critic.plant
    x, goal = ca.MX.sym("x", dim), ca.MX.sym("goal", dim)
    stage = ca.Function("stage", [x, goal], [-ca.exp(-ca.sumsqr(x - goal) / (2 * plant.MPC_SIGMA2))])
    if label == "RL+MPC, taylor":
        value, policy = taylor_value(critic), deploy.export(critic)[0]
    else:  # far from the goal the stage cost is flat: from middle actions no solver would find the way
        value, policy = None, ca.Function("regulator", [x, goal], [plant.feedback(x, goal)])
    return deploy.ScenarioMPC(
        plant,
        horizon,
        plant.SCENARIOS["mpc"],
        stage,
        value,
        goal=plant.EVAL_GOAL,
        policy=policy,
        compile=compile,
    )


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
    return (
        not stats["success"] if "success" in stats else stats["fell_back"] or stats.get("stop") == "unsolved"
    )


def measures(plant, x, log):
    """The measures of linear_scalability.py, and solve times."""
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


def start_states(dim, system, starts):
    plant = envs.load("linear", dim=dim, system=system)
    return plant, np.stack(
        [envs.sample_states(plant, np.random.default_rng([dim, system, i + 1]), 1)[0] for i in range(starts)]
    )


def run_cell(cell):
    """One controller on one system from every start, at one horizon and at some distances: rows, each with its profile as text."""
    label, dim, system, horizon, scales, starts, steps, critic, jobs, compile = cell
    torch.set_num_threads(1)
    controller, (plant, x0s) = (
        build(label, dim, system, horizon, Path(critic), compile),
        start_states(dim, system, starts),
    )
    rows = []
    for scale in scales:
        for i, x0 in enumerate(x0s):
            x, log = run_loop(controller, plant, scale * x0, steps)
            head = {
                "controller": label,
                "n": dim,
                "horizon": horizon,
                "system": system,
                "start": i,
                "scale": scale,
                "jobs": jobs,
            }
            rows.append(
                head
                | {k: round(float(v), 5) for k, v in measures(plant, x, log).items()}
                | {
                    "norms": " ".join(f"{v:.4g}" for v in np.linalg.norm(x, axis=1)),
                    "times": " ".join(f"{s['wall_ms']:.4g}" for s in log),
                }
            )
    return rows


def inputs():
    return [__file__, deploy.__file__, gm.__file__, envs.__file__, linear.__file__]


def without(row, *keys):
    return {k: v for k, v in row.items() if k not in keys}


def collect(args, labels, horizons, scales):
    work = [
        (
            label,
            args.dim,
            system,
            horizon,
            scales,
            args.starts,
            args.steps,
            str(checkpoint(args, args.dim, system)),
            args.jobs,
            not args.quick,
        )
        for horizon in horizons
        for label in labels
        if not (label == "RL (actor alone)" and horizon != horizons[0])
        for system in range(args.seed, args.seed + args.systems)
    ]
    return cells.collect(run_cell, work, args.jobs, args.runs / args.study, inputs())


def profile(args):
    rows = collect(args, CONTROLLERS, (args.horizon,), (1.0,))
    cells.write([without(row, "norms", "times") for row in rows], args.out / "results/linear_value_mpc.csv")
    curves = []
    for label in CONTROLLERS:
        mine = [row for row in rows if row["controller"] == label]
        norms, times = (
            np.array([np.fromstring(row[key], sep=" ") for row in mine]) for key in ("norms", "times")
        )
        for t in range(norms.shape[1]):
            curve = dict(
                zip(("norm_low", "norm_median", "norm_high"), np.quantile(norms[:, t], [0.025, 0.5, 0.95]))
            )
            late = np.minimum(
                t, times.shape[1] - 1
            )  # no action is computed at the last state: its time is repeated
            curve |= dict(
                zip(("ms_low", "ms_median", "ms_high"), np.quantile(times[:, late], [0.025, 0.5, 0.95]))
            )
            curves.append({"controller": label, "step": t} | {k: float(f"{v:.5g}") for k, v in curve.items()})
    cells.write(curves, args.out / "results/linear_value_mpc_profile.csv")


def paired(rows, label):
    """Steps not near the origin of a controller, in the order of systems and starts."""
    return np.array([float(row["steps_not_near"]) for row in rows if row["controller"] == label])


def plot_profile(args):
    rows, curves = (
        cells.read(args.out / f"results/{name}.csv")
        for name in ("linear_value_mpc", "linear_value_mpc_profile")
    )
    fig, axes = plt.subplots(2, 1, figsize=(8, 6.4), sharex=True, layout="constrained")
    baseline = {}
    print(
        f"{'':42s}{'steps not near':>22s}{'l2 error':>22s}{'violation':>10s}{'|x_50|':>9s}{'ms median':>11s}"
        f"{'first 5':>9s}{'worst':>8s}{'failed':>8s}"
    )
    labels = [label for label in CONTROLLERS if any(row["controller"] == label for row in curves)]
    for label in labels:
        colour, dashes, _ = CONTROLLERS[label]
        mine = {
            key: np.array([row[key] for row in curves if row["controller"] == label]).astype(float)
            for key in list(curves[0])[1:]
        }
        for ax, key, floor in zip(axes, ("norm", "ms"), (1e-3, 0)):
            if key == "norm" or "actor" not in label:
                low, median, high = (
                    np.maximum(mine[f"{key}_{name}"], floor) for name in ("low", "median", "high")
                )
                width = (
                    4.5 if label == "goal-conditioned MPC, no value" and key == "norm" else 2
                )  # on which the others lie
                ax.plot(mine["step"], median, color=colour, ls=dashes, lw=width, label=label)
                ax.fill_between(mine["step"], low, high, color=colour, alpha=0.12, lw=0)
        mine = {
            key: np.array([float(row[key]) for row in rows if row["controller"] == label])
            for key in list(rows[0])[7:]
        }
        baseline[label] = {key: np.median(values) for key, values in mine.items()}
        spread = "".join(
            f"{np.median(mine[k]):8.2f} [{np.quantile(mine[k], 0.025):5.2f},{np.quantile(mine[k], 0.95):6.2f}]"
            for k in MEASURES[:2]
        )
        violation, end, milliseconds, early = (
            baseline[label][key]
            for key in ("constraint_violation", "final_norm", "solve_ms_median", "solve_ms_transient")
        )
        worst, failed = mine["solve_ms_max"].max(), mine["solver_failures"].sum()
        print(
            f"{label:42s}{spread}{violation:10.2f}{end:9.4f}{milliseconds:11.1f}{early:9.1f}{worst:8.0f}{failed:8.0f}"
        )
    plain = baseline["goal-conditioned MPC, no value"]
    for label in labels[3:]:
        print(
            f"{label}: solve time over that without a value, median {baseline[label]['solve_ms_median'] / plain['solve_ms_median']:.2f}, "
            f"first five steps {baseline[label]['solve_ms_transient'] / plain['solve_ms_transient']:.2f}"
        )
    actor = paired(rows, "RL (actor alone)")
    for label in labels[1:]:
        gain = actor - paired(rows, label)
        print(
            f"{label}: {np.median(gain):.2f} fewer steps not near the origin than the actor (median), fewer in {(gain > 0).mean():.0%}"
        )
    axes[0].set(ylabel="|x|, below 0.001 drawn there", yscale="log", xlim=(0, 12))
    axes[1].set(ylabel="solve time [ms]", yscale="log", xlabel="step")
    systems, starts = (len({row[key] for row in rows}) for key in ("system", "start"))
    axes[0].set_title(
        f"{systems} systems, {starts} starts each; lines: medians, bands: 2.5 to 95 percentile", fontsize=10
    )
    for ax in axes:
        ax.grid(alpha=0.3)
    fig.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9
    )
    save(fig, args.out / "figures/linear_value_mpc.png")


def save(fig, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
    plt.close(fig)


# How far from the goal


def distance(args):
    """The learned value and its expansions from starts that are scaled towards or away from the goal, at several horizons."""
    args = replace(args, starts=min(args.starts, 2), steps=min(args.steps, 20))
    horizons, scales = ((1, 2), (0.1, 1.0)) if args.quick else (DISTANCE_HORIZONS, DISTANCES)
    labels = [label for label in CONTROLLERS if "regulator" not in label]
    rows = collect(args, labels, horizons, scales)
    cells.write(
        [without(row, "norms", "times") for row in rows], args.out / "results/linear_value_mpc_distance.csv"
    )


def plot_distance(args):
    rows = cells.read(args.out / "results/linear_value_mpc_distance.csv")
    horizons, scales = (list(dict.fromkeys(row[key] for row in rows)) for key in ("horizon", "scale"))
    labels = [label for label in CONTROLLERS if any(row["controller"] == label for row in rows)]
    fig, axes = plt.subplots(
        1, len(horizons), figsize=(10, 3.6), sharey=True, layout="constrained", squeeze=False
    )
    print(
        f"median steps not near the origin, failed solves of all; starts in a box of half-width {', '.join(scales)}"
    )
    for ax, horizon in zip(axes[0], horizons):
        for offset, label in zip(np.linspace(-0.2, 0.2, len(labels)), labels):
            colour, dashes, _ = CONTROLLERS[label]
            mine = [
                row
                for row in rows
                if row["controller"] == label and (row["horizon"] == horizon or "actor" in label)
            ]
            steps = [
                np.median([float(row["steps_not_near"]) for row in mine if row["scale"] == scale])
                for scale in scales
            ]
            ax.plot(
                np.arange(len(scales)) + offset,
                steps,
                marker="o",
                color=colour,
                ls=dashes,
                lw=1.5,
                label=label,
            )
            failed = [
                sum(int(float(row["solver_failures"])) for row in mine if row["scale"] == scale)
                for scale in scales
            ]
            print(
                f"N = {horizon:3s} {label:42s}" + "".join(f"{s:9.2f} ({f:4d})" for s, f in zip(steps, failed))
            )
        ax.set_xticks(range(len(scales)), scales)
        ax.set(title=f"N = {horizon}", ylim=(-0.3, None), xlabel="half-width of the start box")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("steps not near the origin")
    fig.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=3,
        frameon=False,
        fontsize=9,
    )
    save(fig, args.out / "figures/linear_value_mpc_distance.png")


# Scaling


def scaling_dimensions(args):
    return [n for n in SCALING_DIMENSIONS[: 1 if args.quick else None] if n < args.dim] + [args.dim]


def scaling(args):
    """Solve times of one system: against n at the horizon, against the horizon at n = dim."""
    dimensions, horizons = scaling_dimensions(args), SCALING_HORIZONS[: 2 if args.quick else None]
    starts, steps, rows = min(args.starts, 5), min(args.steps, 20), []
    for axis, pairs in (
        ("n", [(n, args.horizon) for n in dimensions]),
        ("horizon", [(dimensions[-1], N) for N in horizons]),
    ):
        work = [
            (
                label,
                n,
                args.seed,
                N,
                (1.0,),
                starts,
                steps,
                str(checkpoint(args, n, args.seed)),
                args.jobs,
                not args.quick,
            )
            for n, N in pairs
            for label in CONTROLLERS
            if "actor" not in label
        ]
        found = cells.collect(run_cell, work, args.jobs, args.runs / "scaling", inputs())
        rows += [{"axis": axis} | without(row, "norms", "times") for row in found]
    cells.write(rows, args.out / "results/linear_value_mpc_times.csv")


def plot_scaling(args):
    rows = cells.read(args.out / "results/linear_value_mpc_times.csv")
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout="constrained")
    labels = [
        label
        for label in CONTROLLERS
        if "actor" not in label and any(row["controller"] == label for row in rows)
    ]
    for ax, axis in zip(axes, ("n", "horizon")):
        values = sorted({int(row[axis]) for row in rows if row["axis"] == axis})
        print(f"{axis}: median ms per step and (mean ms of the first five steps) at {values}")
        for label in labels:
            mine = [
                [row for row in rows if (row["axis"], row["controller"], row[axis]) == (axis, label, str(v))]
                for v in values
            ]
            early = [np.median([float(row["solve_ms_transient"]) for row in group]) for group in mine]
            late = [np.median([float(row["solve_ms_median"]) for row in group]) for group in mine]
            colour, dashes, _ = CONTROLLERS[label]
            ax.plot(values, early, marker="o", color=colour, ls=dashes, lw=2, label=label)
            print(f"  {label:42s}" + "".join(f"{b:8.1f} ({a:7.1f})" for a, b in zip(early, late)))
        ax.set(xscale="log", yscale="log", xlabel={"n": "number of states n", "horizon": "horizon N"}[axis])
        ax.set_xticks(values, values)
        ax.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("solve time, mean of steps 1 to 5 [ms]")
    fig.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=9
    )
    save(fig, args.out / "figures/linear_value_mpc_times.png")


def main(args):
    table = {"train": "training", "profile": "profile", "distance": "distance", "scaling": "times"}[
        args.study
    ]
    cells.check(
        args,
        f"linear_value_mpc_{table}.csv",
        dim=(1, 512),
        systems=(1, 1000),
        starts=(1, 1000),
        steps=(5, 10**6),
        horizon=(1, 1000),
        jobs=(1, 1024),
        seed=(0, 10**9),
    )
    if args.quick:
        args = replace(args, dim=3, systems=2, starts=2, steps=5)
    if args.study == "train":
        return train_all(args)
    if not args.plot_only:
        {"profile": profile, "distance": distance, "scaling": scaling}[args.study](args)
    {"profile": plot_profile, "distance": plot_distance, "scaling": plot_scaling}[args.study](args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
