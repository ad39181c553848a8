"""Solve times beside the authors' stack, do-mpc with L4CasADi: the same optimal control problems, one core, step by step in turn.

    python experiments/benchmark_peers.py                  # eight minutes, in one process: nothing else should run
    python experiments/benchmark_peers.py --plot-only      # redraw from the committed CSV

The peers live in environments of their own (see requirements-peers.txt and requirements-peers-new.txt for how they are made); where one
is not there, its rows say so and this repository's side is measured alone. Each row is a closed loop of both controllers from the same
starts on the same plant, every one on its own states; peer_do_mpc.py is the other side. On the reactor both solve the literal problem
(literal.py), everywhere to a tolerance of 1e-6 and with exact bounds. `same_optimum` is the relative difference of the objectives at
the first start, solved by both to 1e-9 from the start state held at every node. On the same model, this repository's Runge-Kutta steps,
it must be small, unless there are several optima; the collocation rows are another model.

Writes results/benchmark_peers.csv and figures/benchmark_peers.png.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch
import tyro

matplotlib.use("Agg")
import casadi as ca
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import cells
from literal import LiteralMPC

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr

LABELS = {
    "l4casadi": "do-mpc 4.6.5 + L4CasADi, same model",
    "l4casadi, collocation": "do-mpc 4.6.5 + L4CasADi, as published",
    "casadi": "do-mpc 5.1.2, critic in CasADi, same model",
    "MX": "do-mpc 5.1.2, same model",
    "SX": "do-mpc 5.1.2, same model, scalar expressions",
    "MX, collocation": "do-mpc 5.1.2, collocation, as published",
    "SX, collocation": "do-mpc 5.1.2, collocation, scalar expressions",
}
WITH_CRITIC, WITHOUT = ("l4casadi", "l4casadi, collocation", "casadi"), ("MX", "SX", "MX, collocation", "SX, collocation")
CELLS = [("cstr", n, "random", peer) for n in (1, 2, 5) for peer in WITH_CRITIC]
CELLS += [("cstr", 20, kind, peer) for kind in ("none", "small barrier") for peer in WITHOUT]
CELLS += [("double_pendulum", n, "none", peer) for n in (25, 75) for peer in WITHOUT]
CELLS += [("cstr", n, "trained", peer) for n in (1, 2, 5) for peer in ("l4casadi", "casadi")]
CSTR_START = np.array([0.8, 0.4, 134.14, 130.0])  # of the authors' scripts


@dataclass(frozen=True)
class Args:
    peers: Path = HERE.parent / ".venv-peers"
    """virtual environment of requirements-peers.txt"""
    peers_new: Path = HERE.parent / ".venv-peers-new"
    """virtual environment of requirements-peers-new.txt"""
    starts: int = 3
    """start states (with a trained critic: 2 at most; the pendulum: 2 at most)"""
    steps: int = 25
    """sampling times per start (with a trained critic: 5 at most)"""
    seed: int = 0
    """seed of starts, plants and random critics"""
    core: int = 0
    """the core that everything runs on"""
    quick: bool = False
    """2 steps from 1 start, the reactor at N = 1 alone: a smoke test"""
    plot_only: bool = False
    """redraw from the CSV"""
    runs: Path = Path("runs/benchmark_peers")
    """where finished rows are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def load_critic(kind, seed):
    """The shipped robust critic, or its architecture with random weights: (critic, its weights for the peer)."""
    critic = deploy.load_critic(HERE / "pretrained/cstr_robust.pt", "cstr")
    if kind == "random":
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for p in [*critic.actor.parameters(), *critic.critic.parameters()]:
                bound = p.shape[-2] ** -0.5 if p.dim() > 1 else 0.1
                p.copy_(bound * (2 * torch.rand(p.shape, generator=generator, dtype=p.dtype) - 1))
    actor, twins = critic.layers()
    weights = {name: critic.scaling[name] for name in ("x_center", "x_scale", "error_scale", "goal_index")}
    for name, layers in (("actor", actor), ("critic", twins[0])):
        for i, (w, b) in enumerate(layers):
            weights |= {f"{name}_w{i}": w, f"{name}_b{i}": b.ravel()}
    return critic, {name: value.tolist() for name, value in weights.items()}


def problems(env, horizon, kind, peer, seed, tol=1e-6, compile=True):
    """This repository's controller and the same problem in words for the peer."""
    plant, options = envs.load(env), dict(tol=tol, compile=compile)
    shared = {"env": env, "horizon": horizon, "goal": plant.EVAL_GOAL.tolist(), "model": "collocation" if "collocation" in peer else "rk4",
              "tol": tol, "symbols": "SX" if "SX" in peer else "MX", "degree": 2 if env == "cstr" else 3}  # fmt: skip
    if env == "double_pendulum":
        costs = gm.costs(plant, "goal")
        mpc = gm.ScenarioMPC(plant, horizon, plant.SCENARIOS["mpc"], *costs, goal=plant.EVAL_GOAL, slack_price=np.inf, **options)
        words = {"robust_horizon": 0, "sigma2": plant.MPC_SIGMA2, "change_weight": {"force": 0.0}, "u_scale": [5.0], "soft": {},
                 "hard": {"position": (-5.0, 5.0)}, "uncertainty": dict.fromkeys(plant.PSI_NAMES, [1.0])}  # fmt: skip
        return mpc, shared | words
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    squared_error = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], g, ca))
    scenarios, sigma2 = plant.SCENARIOS["mpc"], plant.MPC_SIGMA2 if kind in ("random", "trained") else None
    words = {"robust_horizon": 1, "sigma2": sigma2, "u_scale": [100.0, 2000.0],
             "uncertainty": {"alpha": [1.0, 0.95, 1.05], "beta": [1.0, 0.9, 1.1]}}  # fmt: skip
    if kind not in ("random", "trained"):  # the robust benchmark; a small barrier is faster, but leaves fewer local optima
        stage = ca.Function("stage", [x, g], [squared_error])
        mpc = LiteralMPC(plant, horizon, scenarios, stage, stage, goal=plant.EVAL_GOAL, relaxed_price=1e3,
                         slack_price=plant.BENCHMARK["slack_price"], change_weight=plant.BENCHMARK["change_weight"],
                         barrier=1e-4 if kind == "none" else 1e-7, **options)  # fmt: skip
        # the newest do-mpc averages the penalty of changes over the scenarios, 4.6.5 and this repository sum it
        words |= {"change_weight": {"F": 9 * 0.1, "Q_dot": 9 * 1e-3}, "soft": {"T_R": (140.0, 100.0)},
                  "hard": {"c_A": (0.1, 2.0), "c_B": (0.1, 2.0), "T_R": (50.0, None), "T_K": (50.0, 140.0)}}  # fmt: skip
        return mpc, shared | words
    critic, weights = load_critic(kind, seed)
    mu, _, V = deploy.export(critic)
    stage = ca.Function("stage", [x, g], [-ca.exp(-squared_error / (2 * sigma2))])
    mpc = LiteralMPC(plant, horizon, scenarios, stage, ca.Function("terminal", [x, g], [-V(x, g)]), goal=plant.EVAL_GOAL, actor=mu,
                     slack_price=[[0, 0, 0, 0], [1, 1, 1, 1]], barrier="adaptive", **options)  # fmt: skip
    soft = {name: (high, 1.0) for name, high in zip(plant.STATE_NAMES, plant.X_HIGH)}
    words |= {"change_weight": {"F": 0.0, "Q_dot": 0.0}, "hard": {}, "soft": soft, "critic": weights,
              "network": "casadi" if peer == "casadi" else "l4casadi"}  # fmt: skip
    return mpc, shared | words


class Peer:
    """The other process, which answers one state at a time."""

    def __init__(self, python, problem):
        self.process = subprocess.Popen([str(python), "-W", "ignore", str(HERE / "peer_do_mpc.py")], text=True, stdin=subprocess.PIPE,
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
        self.versions = self.ask(problem)

    def ask(self, message):
        try:
            self.process.stdin.write(json.dumps(message) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())
        except (BrokenPipeError, json.JSONDecodeError):
            raise RuntimeError(f"the peer's process stopped: {self.process.communicate()[1][-3000:]}") from None

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def same_optimum(cell, x0):
    """Relative difference of the first solves' objectives, both from the start state held; empty if one failed."""
    env, horizon, kind, peer, python, *_, seed, _ = cell
    mpc, words = problems(env, horizon, kind, peer, seed, tol=1e-9, compile=False)
    other = Peer(python, words)
    theirs = other.ask({"x": x0.tolist(), "new": True})
    other.close()
    mpc.stats = {"iterations": 0}
    price = () if isinstance(mpc, gm.ScenarioMPC) else (mpc.slack_price,)
    if mpc._solve("cold", x0, *price, mpc.hold_guess(x0)) is None or not theirs["success"]:
        return ""
    return f"{abs(mpc.last_objective / theirs['objective'] - 1):.1e}"


def summary(name, steps):
    """Columns of one side: times in ms, iterations, statuses of all steps as JSON."""
    times, iterations = (np.array([step[key] for step in steps]) for key in ("ms", "iterations"))
    return {f"{name}_ms_median": round(np.median(times), 3), f"{name}_ms_p95": round(np.quantile(times, 0.95), 3),
            f"{name}_ms_max": round(times.max(), 3), f"{name}_iterations": np.median(iterations),
            f"{name}_failed": sum(not step["success"] for step in steps),
            f"{name}_status": json.dumps(Counter(step["status"] for step in steps))}  # fmt: skip


def measure(cell):
    """One row: both controllers in closed loop from every start, in turn; where there is no peer, this repository's alone."""
    env, horizon, kind, peer, python, starts, steps, seed, core = cell
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    mpc, words = problems(env, horizon, kind, peer, seed)
    plant, other, same = mpc.plant, None, ""
    rng = np.random.default_rng([seed, 5])
    base = CSTR_START if plant is cstr else plant.START
    x_starts = (
        base + rng.uniform(-1, 1, size=(starts, len(base))) * plant.START_NOISE * (np.arange(starts) > 0)[:, None]
    )  # the first as it is
    psi = plant.EVAL_PSI[rng.integers(len(plant.EVAL_PSI), size=starts)]
    psi[0] = plant.PSI_NOMINAL
    if Path(python).exists():
        same = same_optimum(cell, x_starts[0]) if words["model"] == "rk4" else ""
        other = Peer(python, words)
    mine, theirs = [], []
    for i in range(starts):
        mpc.reset()
        mpc.set_initial_guess(x_starts[i])
        x, y = x_starts[i], x_starts[i]
        for t in range(steps):
            u = mpc.make_step(x)
            x = plant.step(x, u, psi[i])
            mine.append({"ms": mpc.stats["wall_ms"]} | {key: mpc.stats[key] for key in ("success", "status", "iterations")})
            if other is None or not np.isfinite(y).all():
                continue
            theirs.append(other.ask({"x": y.tolist(), "new": t == 0}))
            y = plant.step(y, np.clip(theirs[-1]["u"], plant.U_LOW, plant.U_HIGH), psi[i])
    if other is not None:
        other.close()
    critic = kind if kind in ("random", "trained") else "none"
    row = {
        "env": env,
        "horizon": horizon,
        "critic": critic,
        "barrier": getattr(mpc, "barrier", 1e-7),
        "peer": LABELS[peer],
        "starts": starts,
        "steps": steps,
        "same_optimum": same,
    }
    row |= summary("ours", mine)
    if theirs:
        row |= summary("peer", theirs) | {"ratio_of_medians": "", "peer_versions": json.dumps(other.versions)}
        if row["peer_failed"] == 0:
            row["ratio_of_medians"] = round(row["peer_ms_median"] / row["ours_ms_median"], 2)
    else:
        row |= dict.fromkeys([f"peer_{key[5:]}" for key in row if key.startswith("ours_")], "")
        row |= {"peer_status": "not installed", "ratio_of_medians": "", "peer_versions": ""}
    return [row | {"machine": cells.machine()}]


def table(rows):
    print(f"{'':51s}{'this repository, ms':>24s}{'peer, ms':>27s}")
    print(f"{'problem and peer':51s}  median    p95  failed    median      p95  failed   ratio  same optimum")
    for row in rows:
        head = (
            f"{row['env']} N = {row['horizon']}, {row['critic']} critic"
            if row["critic"] != "none"
            else f"{row['env']} N = {row['horizon']}"
        )
        peer = "  not installed"
        if row["peer_ms_median"]:
            peer = f"{float(row['peer_ms_median']):10.1f}{float(row['peer_ms_p95']):9.1f}{row['peer_failed']:>8s}"
        mine = f"{float(row['ours_ms_median']):8.1f}{float(row['ours_ms_p95']):7.1f}{row['ours_failed']:>8s}"
        print(f"{head}\n    {row['peer']:47s}{mine}{peer}{row['ratio_of_medians']:>8s}  {row['same_optimum']}")


def plot(rows, path):
    """Median (dot) and 95th percentile (line) of every side, by problem, on a logarithmic axis."""
    critics = {"random": ", random critic", "trained": ", trained critic", "none": ""}
    groups = {}
    for row in rows:
        name = "reactor, RL+MPC" if row["critic"] != "none" else "reactor, robust MPC" if row["env"] == "cstr" else "pendulum"
        small = ", barrier 1e-7" if row["env"] == "cstr" and row["barrier"] == "1e-07" else ""
        groups.setdefault(f"{name}, N = {row['horizon']}{critics[row['critic']]}{small}", []).append(row)
    fig, ax = plt.subplots(figsize=(9, 0.21 * (len(rows) + 2 * len(groups)) + 1), layout="constrained")
    y, ticks = 0, []

    def bar(row, side, colour, text):
        nonlocal y
        ticks.append((y, text))
        if row[f"{side}_ms_median"]:
            median, p95, failed = (float(row[f"{side}_{key}"]) for key in ("ms_median", "ms_p95", "failed"))
            ax.plot([median, p95], [y, y], color=colour, lw=2.5)
            ax.plot(median, y, "o", color=colour, mec="black", mew=0.5, ms=6)
            words = f"{median:.3g} ms" + (f", {failed:.0f} of {int(row['starts']) * int(row['steps'])} failed" if failed else "")
            ax.annotate(words, (p95, y), xytext=(6, 0), textcoords="offset points", va="center", fontsize=8)
        else:
            ax.annotate("not installed", (1, y), va="center", fontsize=8)
        y += 1

    for name, mine in groups.items():
        ax.annotate(name, (0.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=9, weight="bold")
        y += 1
        # this repository was timed once beside each peer: the middle one
        bar(sorted(mine, key=lambda row: float(row["ours_ms_median"]))[len(mine) // 2], "ours", "#0072B2", "this repository")
        for row in mine:
            bar(row, "peer", "#D55E00", row["peer"])
        y += 0.4
    ax.set_yticks(*zip(*ticks), fontsize=8)
    ax.set_ylim(y - 0.4, -0.8)
    ax.set(xscale="log", xlabel="time of a closed-loop step, one core [ms]: median (dot) to 95th percentile")
    ax.set_xlim(right=ax.get_xlim()[1] * 10)
    ax.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    ax.grid(axis="x", alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main(args):
    cells.check(args, "benchmark_peers.csv", starts=(1, 1000), steps=(1, 1000), seed=(0, 10**9), core=(0, (os.cpu_count() or 1) - 1))
    path = args.out / "results/benchmark_peers.csv"
    if not args.plot_only:
        todo = []
        for env, horizon, kind, peer in [cell for cell in CELLS if not args.quick or cell[:3] == ("cstr", 1, "random")]:
            python = (args.peers if "l4casadi" in peer else args.peers_new).absolute() / "bin/python"
            starts = 1 if args.quick else min(args.starts, 3 if env == "cstr" and kind != "trained" else 2)
            steps = 2 if args.quick else min(args.steps, 5) if kind == "trained" else args.steps
            todo.append((env, horizon, kind, peer, str(python), starts, steps, args.seed, args.core))
        inputs = [HERE / name for name in ("benchmark_peers.py", "peer_do_mpc.py", "literal.py")]
        inputs += [
            HERE.parent / name
            for name in ("rl_mpc_deploy.py", "goal_mpc.py", "envs/__init__.py", "envs/cstr.py", "envs/double_pendulum.py")
        ]
        cells.write(cells.collect(measure, todo, 1, args.runs, inputs), path)
    rows = cells.read(path)
    table(rows)
    plot(rows, args.out / "figures/benchmark_peers.png")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
