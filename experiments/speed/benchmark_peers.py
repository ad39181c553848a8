"""Solve times beside the authors' stack, do-mpc with L4CasADi: the same optimal control problems, one core, step by step in turn.

    python experiments/speed/benchmark_peers.py                  # eight minutes, in one process: nothing else should run
    python experiments/speed/benchmark_peers.py --plot-only      # redraw from the committed CSV

The peers live in environments of their own (see requirements-peers.txt and requirements-peers-new.txt for how they are made); where one
is not there, its rows say so and this repository's side is measured alone. Each row is a closed loop of every controller from the same
starts on the same plant, every one on its own states; peer_do_mpc.py is the other side, IPOPT to a tolerance of 1e-6 with exact bounds.

On the reactor this side is the planner of rl_mpc_deploy.py, three times: converged (at most 50 iterations a step), with its default of 5,
and with one. The peers solve the literal problem (literal.py). Ours differs from it by convention only: stage cost and soft constraints at
x_1 ... x_N instead of x_0 ... x_{N-1}, and means over the nine scenarios where the peers sum slack and changes, so that prices are nine
times theirs. On the pendulum this side is goal_mpc.py's IPOPT.

`same_optimum` says that the peers' problem is the one in words: the relative difference of their objective and that of literal.py, both
by IPOPT at the first start, to 1e-9 from the start state held at every node. On the same model, this repository's Runge-Kutta steps,
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

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr
from envs.control.expansion import expansion
from experiments import common
from experiments.common import PRETRAINED, ROOT, grouped
from experiments.palette import BLUE, RED
from experiments.reactor import literal

PEER = Path(__file__).resolve().parent / "peer_do_mpc.py"
LABELS = {
    "l4casadi": "do-mpc 4.6.5 + L4CasADi, same model",
    "l4casadi, collocation": "do-mpc 4.6.5 + L4CasADi, as published",
    "casadi": "do-mpc 5.1.2, critic in CasADi, same model",
    "MX": "do-mpc 5.1.2, same model",
    "SX": "do-mpc 5.1.2, same model, scalar expressions",
    "MX, collocation": "do-mpc 5.1.2, collocation, as published",
    "SX, collocation": "do-mpc 5.1.2, collocation, scalar expressions",
}
WITH_CRITIC = ("l4casadi", "l4casadi, collocation", "casadi")
WITHOUT = ("MX", "SX", "MX, collocation", "SX, collocation")
CELLS = [("cstr", n, "random", peer) for n in (1, 2, 5) for peer in WITH_CRITIC]
CELLS += [("cstr", 20, "none", peer) for peer in WITHOUT]
CELLS += [("double_pendulum", n, "none", peer) for n in (25, 75) for peer in WITHOUT]
CELLS += [("cstr", n, "trained", peer) for n in (1, 2, 5) for peer in ("l4casadi", "casadi")]
DEFAULT = deploy.Args.iterations
OURS = {  # columns of this repository's planner: (label, iterations)
    "ours": ("this repository", 50),
    "ours_default": (f"the same, {DEFAULT} iterations", DEFAULT),
    "ours_one": ("the same, one iteration", 1),
}
SCENARIOS, BENCHMARK = cstr.SCENARIOS["mpc"], cstr.BENCHMARK
S = len(SCENARIOS)
BLIND = np.repeat(
    [[0.0], [1.0]], 4, axis=1
)  # price of slack beside a critic: above the upper bounds, as published
CSTR_START = np.array([0.8, 0.4, 134.14, 130.0])  # of the authors' scripts


@dataclass(frozen=True)
class Args(common.StudyArgs):
    peers: Path = ROOT / ".venv-peers"
    """virtual environment of requirements-peers.txt"""
    peers_new: Path = ROOT / ".venv-peers-new"
    """virtual environment of requirements-peers-new.txt"""
    starts: int = 3
    """start states (with a trained critic: 2 at most; the pendulum: 2 at most)"""
    steps: int = 25
    """sampling times per start (with a trained critic: 5 at most)"""
    core: int = 0
    """the core that everything runs on"""
    runs: Path = Path("runs/experiments")
    """where finished rows are kept, so that a second call continues"""


def load_critic(kind, seed):
    """The shipped robust critic, or its architecture with random weights: (critic, its weights for the peer)."""
    critic, rng = deploy.load_critic(PRETRAINED / "cstr_robust.pt", "cstr"), np.random.default_rng([seed, 6])

    def drawn(layers):
        found = []
        for w, b in layers:
            found.append((rng.uniform(-1, 1, w.shape) / np.sqrt(w.shape[1]), rng.uniform(-0.1, 0.1, b.shape)))
        return found

    if kind == "random":
        critic.actor, critic.twins = drawn(critic.actor), [drawn(twin) for twin in critic.twins]
    weights = {name: critic.scaling[name] for name in ("x_center", "x_scale", "error_scale", "goal_index")}
    for name, layers in (("actor", critic.actor), ("critic", critic.twins[0])):
        for i, (w, b) in enumerate(layers):
            weights |= {f"{name}_w{i}": w, f"{name}_b{i}": b.ravel()}
    return critic, {name: value.tolist() for name, value in weights.items()}


def in_words(env, horizon, kind, peer, seed, tol=1e-6):
    """The literal problem for the peer."""
    plant = envs.load(env)
    words = {
        "env": env,
        "horizon": horizon,
        "goal": plant.EVAL_GOAL.tolist(),
        "model": "collocation" if "collocation" in peer else "rk4",
        "tol": tol,
        "symbols": "SX" if "SX" in peer else "MX",
        "degree": 2 if env == "cstr" else 3,
    }
    if env == "double_pendulum":
        return words | {
            "robust_horizon": 0,
            "sigma2": plant.MPC_SIGMA2,
            "change_weight": {"force": 0.0},
            "u_scale": [5.0],
            "soft": {},
            "hard": {"position": (-5.0, 5.0)},
            "uncertainty": dict.fromkeys(plant.PSI_NAMES, [1.0]),
        }
    words |= {"robust_horizon": 1, "u_scale": [100.0, 2000.0]}
    words |= {"uncertainty": {"alpha": [1.0, 0.95, 1.05], "beta": [1.0, 0.9, 1.1]}}
    if kind == "none":
        # the newest do-mpc averages the penalty of changes over the scenarios, 4.6.5 sums it as literal.py does
        return words | {
            "sigma2": None,
            "change_weight": {"F": S * 0.1, "Q_dot": S * 1e-3},
            "soft": {"T_R": (140.0, 100.0)},
            "hard": {"c_A": (0.1, 2.0), "c_B": (0.1, 2.0), "T_R": (50.0, None), "T_K": (50.0, 140.0)},
        }
    return words | {
        "sigma2": plant.MPC_SIGMA2,
        "change_weight": {"F": 0.0, "Q_dot": 0.0},
        "hard": {},
        "soft": {name: (high, 1.0) for name, high in zip(plant.STATE_NAMES, plant.X_HIGH)},
        "critic": load_critic(kind, seed)[1],
        "network": "casadi" if peer == "casadi" else "l4casadi",
    }


def pendulum(horizon, **options):
    plant = envs.load("double_pendulum")
    options |= dict(goal=plant.EVAL_GOAL, slack_price=np.inf)
    return gm.ScenarioMPC(plant, horizon, plant.SCENARIOS["mpc"], *gm.costs(plant, "goal"), **options)


def ours(env, horizon, kind, seed):
    """This repository's controllers, by the columns of their times."""
    if env == "double_pendulum":
        return {"ours": pendulum(horizon)}
    if kind == "none":
        stage = literal.squared_error(cstr)
        options = {key: S * BENCHMARK[key] for key in ("slack_price", "change_weight")}
    else:
        critic, _ = load_critic(kind, seed)
        (mu, _, V), stage = deploy.export(critic), literal.gaussian(cstr)
        options = dict(slack_price=S * BLIND, value=V, policy=mu, expansion=expansion(critic))
    options |= dict(goal=cstr.EVAL_GOAL)
    return {
        name: deploy.ScenarioMPC(cstr, horizon, SCENARIOS, stage, iterations=iterations, **options)
        for name, (_, iterations) in OURS.items()
    }


def reference(env, horizon, kind, seed):
    """The peer's problem by IPOPT, and a function of the start state that gives what its objective has beside the peer's."""
    options = dict(ipopt={"tol": 1e-9}, compile=False)
    if env == "double_pendulum":
        return pendulum(horizon, **options), lambda x0: 0.0
    if kind == "none":
        stage, terminal = literal.squared_error(cstr), literal.squared_error(cstr)
        options |= {key: BENCHMARK[key] for key in ("slack_price", "change_weight")}
    else:
        stage, V = literal.gaussian(cstr), deploy.export(load_critic(kind, seed)[0])[2]
        terminal = literal.negative(V)
        options |= dict(slack_price=BLIND, change_weight=0.0)
    options |= dict(goal=cstr.EVAL_GOAL)
    mpc = literal.LiteralMPC(cstr, horizon, SCENARIOS, stage, terminal, **options)
    return mpc, lambda x0: float(stage(x0, cstr.EVAL_GOAL))


class Peer:
    """The other process, which answers one state at a time."""

    def __init__(self, python, problem):
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        command = [str(python), "-W", "ignore", str(PEER)]
        self.process = subprocess.Popen(command, text=True, encoding="utf-8", **pipes)
        self.versions = self.ask(problem)

    def ask(self, message):
        try:
            self.process.stdin.write(json.dumps(message) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())
        except (BrokenPipeError, json.JSONDecodeError):
            said = self.process.communicate()[1][-3000:]
            raise RuntimeError(f"the peer's process stopped: {said}") from None

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def same_optimum(cell, x0):
    """Relative difference of the first solves' objectives, both from the start state held; empty if one failed."""
    env, horizon, kind, peer, python, *_, seed, _ = cell
    mpc, beside = reference(env, horizon, kind, seed)
    other = Peer(python, in_words(env, horizon, kind, peer, seed, tol=1e-9))
    theirs = other.ask({"x": x0.tolist(), "new": True})
    other.close()
    mpc.make_step(x0)
    if mpc.stats["rung"] != "solved" or not theirs["success"]:
        return ""
    return f"{abs((mpc.objective - beside(x0)) / theirs['objective'] - 1):.1e}"


def summary(name, steps):
    """Columns of one side: times in ms, iterations, statuses of all steps as JSON."""
    times, iterations = (np.array([step[key] for step in steps]) for key in ("ms", "iterations"))
    return {
        f"{name}_ms_median": round(np.median(times), 3),
        f"{name}_ms_p95": round(np.quantile(times, 0.95), 3),
        f"{name}_ms_max": round(times.max(), 3),
        f"{name}_iterations": np.median(iterations),
        f"{name}_failed": sum(not step["success"] for step in steps),
        f"{name}_status": json.dumps(Counter(step["status"] for step in steps)),
    }


def outcome(stats):
    """A step of this repository in the peer's words."""
    found = {"ms": stats["wall_ms"], "iterations": stats["iterations"]}
    if "status" in stats:  # IPOPT
        return found | {"success": stats["success"], "status": stats["status"]}
    solved = not stats["fell_back"] and stats["stop"] != "unsolved"
    return found | {"success": solved, "status": stats.get("stop", stats["rung"])}


def starts_and_plants(plant, starts, seed):
    """Start states (starts, n_x) and plants (starts, n_psi): the first ones the authors' and the nominal one."""
    rng = np.random.default_rng([seed, 5])
    base = CSTR_START if plant is cstr else plant.START
    noise = rng.uniform(-1, 1, size=(starts, len(base))) * plant.START_NOISE
    psi = plant.EVAL_PSI[rng.integers(len(plant.EVAL_PSI), size=starts)]
    psi[0] = plant.PSI_NOMINAL
    return base + noise * (np.arange(starts) > 0)[:, None], psi


def closed_loops(mine, other, plant, x_starts, psi, steps):
    """Steps of every controller of this repository, {name: outcomes}, and of the peer; each is on its own states, in turn."""
    log, theirs = {name: [] for name in mine}, []
    for x0, parameters in zip(x_starts, psi):
        states, y = dict.fromkeys(mine, x0), x0
        for mpc in mine.values():
            mpc.reset()
        for t in range(steps):
            for name, mpc in mine.items():
                states[name] = plant.step(states[name], mpc.make_step(states[name]), parameters)
                log[name].append(outcome(mpc.stats))
            if other is not None and np.isfinite(y).all():
                theirs.append(other.ask({"x": y.tolist(), "new": t == 0}))
                y = plant.step(y, np.clip(theirs[-1]["u"], plant.U_LOW, plant.U_HIGH), parameters)
    return log, theirs


def measure(cell):
    """One row: all controllers in closed loop from every start, in turn; where there is no peer, this repository's alone."""
    env, horizon, kind, peer, python, starts, steps, seed, core = cell
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    mine, words = ours(env, horizon, kind, seed), in_words(env, horizon, kind, peer, seed)
    plant, other, same = mine["ours"].plant, None, ""
    x_starts, psi = starts_and_plants(plant, starts, seed)
    if Path(python).exists():
        same = same_optimum(cell, x_starts[0]) if words["model"] == "rk4" else ""
        other = Peer(python, words)
    log, theirs = closed_loops(mine, other, plant, x_starts, psi, steps)
    if other is not None:
        other.close()
    row = {
        "env": env,
        "horizon": horizon,
        "critic": kind,
        "peer": LABELS[peer],
        "starts": starts,
        "steps": steps,
    }
    row |= {"same_optimum": same} | summary("ours", log["ours"])
    for name in ("ours_default", "ours_one"):
        columns = summary(name, log[name]) if name in log else {}
        row |= {f"{name}_ms_{part}": columns.get(f"{name}_ms_{part}", "") for part in ("median", "p95")}
    if theirs:
        row |= summary("peer", theirs)
    else:
        row |= dict.fromkeys(summary("peer", log["ours"]), "") | {"peer_status": "not installed"}
    for ratio, name in zip(("ratio_of_medians", "ratio_default", "ratio_one"), OURS):
        known = row["peer_failed"] == 0 and row[f"{name}_ms_median"] != ""
        row[ratio] = round(row["peer_ms_median"] / row[f"{name}_ms_median"], 2) if known else ""
    versions = json.dumps(other.versions) if theirs else ""
    return [row | {"peer_versions": versions, "machine": common.machine()}]


def print_table(rows):
    titles = f"{'median':>11s}{'p95':>8s}{'failed':>8s}"
    sides = f"{'this repository, ms':>27s}{'default':>9s}{'one':>9s}{'peer, ms':>27s}"
    print(f"{'':51s}{sides}{'ratios of medians':>24s}")
    ratios = f"{'':>8s}{'default':>8s}{'one':>8s}  same optimum"
    print(f"{'problem and peer':51s}{titles}{'median':>9s}{'median':>9s}{titles}{ratios}")

    def number(value, width):
        return f"{float(value):{width}.1f}" if value else f"{'':{width}s}"

    def side(row, name):
        times = number(row[f"{name}_ms_median"], 11) + number(row[f"{name}_ms_p95"], 8)
        return f"{times}{row[f'{name}_failed']:>8s}"

    for row in rows:
        critic = f", {row['critic']} critic" if row["critic"] != "none" else ""
        print(f"{row['env']} N = {row['horizon']}{critic}")
        text = side(row, "ours")
        text += number(row["ours_default_ms_median"], 9) + number(row["ours_one_ms_median"], 9)
        text += side(row, "peer") if row["peer_ms_median"] else f"{'not installed':>27s}"
        text += "".join(number(row[key], 8) for key in ("ratio_of_medians", "ratio_default", "ratio_one"))
        print(f"    {row['peer']:47s}{text}  {row['same_optimum']}")


def problem(row):
    name = "pendulum" if row["env"] != "cstr" else "reactor, robust MPC"
    name = name if row["critic"] == "none" else "reactor, RL+MPC"
    return f"{name}, N = {row['horizon']}" + (f", {row['critic']} critic" if row["critic"] != "none" else "")


def plot(rows, path):
    """Median (dot) and 95th percentile (line) of every side, by problem, on a logarithmic axis."""
    groups = grouped([row | {"problem": problem(row)} for row in rows], "problem")
    fig, ax = common.subplots(figsize=(9, 0.21 * (len(rows) + 4 * len(groups)) + 1))
    y, ticks = 0, []

    def bar(row, side, colour, text):
        nonlocal y
        ticks.append((y, text))
        if row[f"{side}_ms_median"]:
            median, p95 = (float(row[f"{side}_ms_{key}"]) for key in ("median", "p95"))
            failed = float(row.get(f"{side}_failed", 0))
            ax.plot([median, p95], [y, y], color=colour, lw=2.5)
            ax.plot(median, y, "o", color=colour, mec="black", mew=0.5, ms=6)
            words = f"{median:.0f} ms" if median >= 100 else f"{median:.3g} ms"
            words += f", {failed:.0f} of {int(row['starts']) * int(row['steps'])} failed" if failed else ""
            ax.annotate(words, (p95, y), xytext=(6, 0), textcoords="offset points", va="center", fontsize=8)
        else:
            ax.annotate("not installed", (1, y), va="center", fontsize=8)
        y += 1

    for name, mine in groups.items():
        style = dict(xycoords=("axes fraction", "data"), va="center", fontsize=9, weight="bold")
        ax.annotate(name, (0.01, y), **style)
        y += 1
        # this repository was timed once beside each peer: the middle one
        middle = sorted(mine, key=lambda row: float(row["ours_ms_median"]))[len(mine) // 2]
        for side, (text, _) in OURS.items():
            if middle[f"{side}_ms_median"]:
                bar(middle, side, BLUE, text)
        for row in mine:
            bar(row, "peer", RED, row["peer"])
        y += 0.4
    ax.set_yticks(*zip(*ticks), fontsize=8)
    ax.set_ylim(y - 0.4, -0.8)
    ax.set(xscale="log", xlabel="time of a closed-loop step, one core [ms]: median (dot) to 95th percentile")
    ax.set_xlim(right=ax.get_xlim()[1] * 10)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.grid(axis="x", alpha=0.3)
    common.save(fig, path)


def cells(args):
    found = []
    for env, horizon, kind, peer in CELLS:
        python = (args.peers if "l4casadi" in peer else args.peers_new).absolute() / "bin/python"
        starts, steps = args.starts, args.steps
        if env == "double_pendulum" or kind == "trained":
            starts = min(starts, 2)
        if kind == "trained":
            steps = min(steps, 5)
        if args.quick:
            starts, steps = 1, 2
        if not args.quick or (env, horizon, kind) == ("cstr", 1, "random"):
            found.append((env, horizon, kind, peer, str(python), starts, steps, args.seed, args.core))
    return found


def main(args):
    cores = os.cpu_count() or 1
    common.check(args, "benchmark_peers", starts=(1, 1000), steps=(1, 1000), core=(0, cores - 1))
    table = args.table("benchmark_peers")
    if not args.plot_only:
        common.write(common.collect(measure, cells(args), args.runs, uses=[literal, PEER]), table)
    print_table(common.read(table))
    plot(common.read(table), args.figure("benchmark_peers"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
