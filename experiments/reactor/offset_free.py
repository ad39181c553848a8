"""Steady-state offset on plants whose parameters are fixed but unknown: every controller with and without an estimate of its plant.

    python experiments/reactor/offset_free.py --study training --jobs 2   # half an hour: agents that observe the mismatch, and ablations
    python experiments/reactor/offset_free.py --jobs 2                    # half an hour: closed loops; both continue where they stopped
    python experiments/reactor/offset_free.py --plot-only                 # redraw from the committed CSV

loops: the paired draws of cstr_deploy.py on a fixed plant; plants at twice the training box; the catalyst's activity beta falling from 1.0
to 0.9 at half time, or drifting there; measurement noise, a share of each state's range, under three filter gains. Every measure is of the
true state. training: the evaluation of cstr_offline.py, whose robust agent is the plain one.

Writes results/cstr_offset_free.csv (a row per case, controller and draw), cstr_offset_free_profile.csv (c_B over the fall of beta) and
figures/cstr_offset_free.png, or results/cstr_offset_free_training.csv (a row per variant and seed) and the figure of that name.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
from envs import cstr
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import loops, offline
from experiments.reactor.deploy import ACTOR, AWARE, PAPER, RL_MPC, TUNED

OBSERVING = dict(observe_mismatch=True, scenario_hold="episode")
VARIANTS = {  # of the training: (arguments of sac_her_branching.py, mismatch scale times the default, seeds)
    "offset-free": (OBSERVING, 1.0, 10),
    "offset-free, discount 0.99": (OBSERVING | dict(gamma=0.99), 1.0, 5),
    "plain, discount 0.95": (dict(gamma=0.95), 1.0, 5),
    "scenario held, mismatch not observed": (dict(scenario_hold="episode", gamma=0.95), 1.0, 5),
    "mismatch observed, scenario not held": (dict(observe_mismatch=True), 1.0, 5),
    "mismatch scale x 10": (OBSERVING, 10.0, 5),
    "mismatch scale / 10": (OBSERVING, 0.1, 5),
}
OBSERVER = HERE / "pretrained/cstr_offset_free.pt"
ROBUST, FREE = dict(controllers=("robust_mpc",)), dict(offset_free=True)
CONTROLLERS = {  # label: (colour, dashes, keywords of cstr_loops)
    "robust MPC": ("#999999", ":", ROBUST | dict(horizon=20)),
    "robust MPC, offset-free": ("#999999", "-", ROBUST | dict(horizon=20) | FREE),
    "robust MPC, tuned": ("#0072B2", ":", ROBUST | dict(benchmark=TUNED)),
    "robust MPC, tuned, offset-free": ("#0072B2", "-", ROBUST | dict(benchmark=TUNED) | FREE),
    "RL, paper's": ("#D55E00", ":", ACTOR | PAPER),
    "RL, offset-free": ("#D55E00", "-", ACTOR | dict(critic=OBSERVER)),
    "RL+MPC": ("#009E73", ":", RL_MPC | AWARE),
    "RL+MPC, offset-free": ("#009E73", "-", RL_MPC | AWARE | FREE),
    "RL+MPC, parameters": ("#CC79A7", "--", RL_MPC | AWARE | FREE | dict(estimate="parameters")),
}
SETTINGS = {  # of RL+MPC, on a fixed plant alone
    "disturbance, whole spread": RL_MPC | AWARE | FREE | dict(spread=1.0),
    "disturbance, a fifth of the spread": RL_MPC | AWARE | FREE | dict(spread=0.2),
    "parameters, whole spread": RL_MPC | AWARE | FREE | dict(estimate="parameters", spread=1.0),
    "parameters, a fifth of the spread": RL_MPC | AWARE | FREE | dict(estimate="parameters", spread=0.2),
    "half the spread, nothing estimated": RL_MPC | AWARE | dict(spread=0.5),
    "critic that observes the mismatch": RL_MPC | dict(critic=OBSERVER) | FREE,
    "the same, whole spread": RL_MPC | dict(critic=OBSERVER, spread=1.0) | FREE,
}
CHANGING = [label for label in CONTROLLERS if not label.startswith("robust MPC") or "tuned" in label]
NOISY = ["RL, offset-free", "RL+MPC", "RL+MPC, offset-free", "RL+MPC, parameters"]
NOISES, GAINS = (0.0, 0.002, 0.01), (1.0, 0.3, 0.1)


@dataclass
class Args:
    study: Literal["loops", "training"] = "loops"
    """loops: controllers on fixed, changing, noisy and unusual plants; training: agents"""
    episodes: int = 50
    """paired draws of the robust MPCs on a fixed plant; four times as many of the others, 20 at most elsewhere"""
    seed: int = 0
    """seed of the draws, or of the first agent"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 4 steps, hardly trained agents: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    runs: Path = Path("runs/cstr_offset_free")
    """where finished parts are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


@dataclass(frozen=True)
class Case:
    """One controller on one kind of plant; `loop` names controller and draws."""

    kind: str
    """fixed, step, drift, noise or outside"""
    noise: float
    loop: loops.Loop


def plant_path(kind, psi, steps):
    """Parameters at every step, (steps, n_psi)."""
    path, half = np.tile(psi, (steps, 1)), steps // 2
    if kind == "step":
        path[:half], path[half:] = (1.0, 1.0), (1.0, 0.9)
    elif kind == "drift":
        path[:] = cstr.PSI_NOMINAL
        path[:, 1] -= 0.1 * np.clip((np.arange(steps) - steps // 4) / (steps // 2), 0, 1)
    return path


def run(case):
    """A row per draw; the path of c_B, as text, goes into a table of its own."""
    loop, args, rows = case.loop, case.loop.settings, []
    mpc = loops.controller(args, loop.like, loop.benchmark)
    starts, psi = deploy.draws(cstr, loop.stop, args.seed)
    if loop.shift is not None:
        psi = loops.shifted_plants(loop.stop, args.seed, loop.shift)
    for episode in range(loop.first, loop.stop):
        path = plant_path(case.kind, psi[episode], args.steps)
        rng, scale = np.random.default_rng([args.seed, 7, episode]), case.noise * (cstr.X_HIGH - cstr.X_LOW)
        mpc.reset()
        x, times = [starts[episode]], []
        for t in range(args.steps):
            u = mpc.make_step(x[-1] + scale * rng.normal(size=len(scale)))
            x.append(cstr.step(x[-1], u, path[t]))
            times.append(mpc.stats["wall_ms"])
        x = np.array(x)
        achieved = x[1:, cstr.GOAL_INDEX]
        error = cstr.percentage_error(achieved, mpc.goal)
        late = error[args.steps // 2 :] if case.kind in ("step", "drift") else error
        row = {
            "case": case.kind,
            "controller": loop.variant,
            "noise": case.noise,
            "gain": args.filter_gain,
            "seed": args.seed,
            "episode": episode,
            "alpha": path[-1, 0],
            "beta": path[-1, 1],
            "time_near_goal": envs.time_near_goal(cstr, achieved, mpc.goal),
            "time_outside_constraints": envs.outside_constraints(cstr, x[1:]).sum(),
            "offset": error[-25:].mean(),
            "steps_over_2_percent": int((late > 2).sum()),
            "solve_ms_median": np.median(times),
            "solve_ms_p95": np.quantile(times, 0.95),
        }
        row = {k: round(float(v), 5) if isinstance(v, float) else v for k, v in row.items()}
        rows.append(row | {"c_B": " ".join(f"{v:.4f}" for v in x[:, 1])})
    return rows


def cases(args):
    found, few = [], min(args.episodes, 20)

    def add(kind, variants, episodes, noise=0.0, gain=1.0, **options):
        variants = {
            label: CONTROLLERS[label][2] if label in CONTROLLERS else SETTINGS[label] for label in variants
        }
        variants = {
            label: keywords | options | dict(filter_gain=gain) for label, keywords in variants.items()
        }
        found.extend(
            Case(kind, noise, loop) for loop in loops.loops(variants, episodes, args.seed, args.quick)
        )

    for label in CONTROLLERS:
        add("fixed", [label], args.episodes if label.startswith("robust") else 4 * args.episodes)
    add("fixed", SETTINGS, args.episodes)
    for kind, options in (("outside", dict(shift=2.0)), ("step", {}), ("drift", {})):
        add(kind, CHANGING, few, **options)
    for noise in NOISES:
        for gain in GAINS:
            add("noise", [label for label in NOISY if gain == 1 or label != "RL+MPC"], few, noise, gain)
    return found[:: 9 if args.quick else 1]


def train(cell):
    """The row of one agent: the evaluation of cstr_offline.py, in medians over starts."""
    label, (settings, factor, _), seed, quick = cell
    scale = cstr.MISMATCH_SCALE
    cstr.MISMATCH_SCALE = factor * scale
    try:
        return [training_row(label, seed, offline.errors((label, settings, seed, quick)))]
    finally:
        cstr.MISMATCH_SCALE = scale


def training_row(label, seed, rows):
    row = {"variant": label, "seed": seed}
    for evaluation in ("robust", "nominal"):
        ape = number([r for r in rows if r["evaluation"] == evaluation], "ape")
        for name, value in (("median", np.median(ape)), ("p75", np.quantile(ape, 0.75))):
            row[f"{evaluation}_{name}_ape"] = round(float(value), 4)
    return row


def plain():
    """Rows of the plain agents, which cstr_offline.py trained."""
    seeds = {}
    for row in cells.read(HERE / "results/cstr_offline.csv"):
        if row["agent"] == "robust":
            seeds.setdefault(int(row["seed"]), []).append(row)
    return [training_row("plain", seed, rows) for seed, rows in seeds.items()]


def number(rows, key):
    return np.array([float(row[key]) for row in rows])


def print_loops(rows):
    print(
        f"{'case':9s}{'noise':>6s}{'gain':>5s} {'controller':36s}{'draws':>6s}{'offset %: median  95 %':>24s}"
        f"{'near goal: median  5 %':>24s}"
        f"{'outside: median  5 %':>22s}{'steps over 2 %':>16s}{'ms':>7s}"
    )
    groups = {}
    for row in rows:
        groups.setdefault((row["case"], row["noise"], row["gain"], row["controller"]), []).append(row)
    for (case, noise, gain, controller), mine in groups.items():
        keys = (
            "offset",
            "time_near_goal",
            "time_outside_constraints",
            "steps_over_2_percent",
            "solve_ms_median",
        )
        offset, near, outside, over, ms = (number(mine, key) for key in keys)
        print(
            f"{case:9s}{100 * float(noise):5.1f}%{gain:>5s} {controller:36s}{len(mine):6d}"
            f"{np.median(offset):17.2f}{np.quantile(offset, 0.95):7.2f}"
            f"{np.median(near):17.1f}{np.quantile(near, 0.05):7.1f}{np.median(outside):15.2f}{np.quantile(outside, 0.05):7.1f}"
            f"{np.median(over):16.0f}{np.median(ms):7.1f}"
        )


def plot_loops(rows, paths, path):
    fig, axes = plt.subplots(1, 3, figsize=(13, 4.4), layout="constrained", width_ratios=(1.1, 1, 1))

    def offsets(case, label, noise="0.0", gain="1.0"):
        return number(
            [
                r
                for r in rows
                if (r["case"], r["controller"], r["noise"], r["gain"]) == (case, label, noise, gain)
            ],
            "offset",
        )

    for position, (label, (colour, _, _)) in enumerate(CONTROLLERS.items()):
        style = dict(
            medianprops=dict(color="black", lw=2), boxprops=dict(facecolor=colour), patch_artist=True
        )
        found = np.maximum(offsets("fixed", label), 1e-3)
        axes[0].boxplot(
            found,
            positions=[-position],
            orientation="horizontal",
            widths=0.6,
            whis=(5, 95),
            showfliers=False,
            **style,
        )
    axes[0].set_yticks(-np.arange(len(CONTROLLERS)), CONTROLLERS)
    axes[0].set(
        xscale="log", xlabel="offset of $c_B$ over the last 25 steps [%]", title="a fixed, unknown plant"
    )
    for label in CHANGING:
        colour, dashes, _ = CONTROLLERS[label]
        c_b = np.array(
            [[float(v) for v in row["c_B"].split()] for row in paths if row["controller"] == label]
        )
        if len(c_b):
            error, steps = 100 * (c_b / cstr.EVAL_GOAL[0] - 1), np.arange(c_b.shape[1]) - c_b.shape[1] // 2
            shown = steps >= -10
            axes[1].plot(steps[shown], np.median(error, 0)[shown], color=colour, ls=dashes, lw=2, label=label)
    axes[1].axhline(0, color="black", lw=1, alpha=0.5)
    axes[1].set(
        xlabel=r"steps after $\beta$ falls from 1.0 to 0.9",
        ylabel="$c_B$ above the goal [%], median of 20 draws",
        ylim=(-12, 6),
        title="the catalyst loses activity",
    )
    axes[1].legend(frameon=False, fontsize=7, loc="lower right")
    for label in NOISY:
        for gain, dashes, marker in zip(GAINS, ("-", "--", ":"), "osd"):
            levels = [(noise, offsets("noise", label, str(noise), str(gain))) for noise in NOISES]
            levels = [(100 * noise, np.median(found)) for noise, found in levels if len(found)]
            if levels:
                text = label if label == "RL+MPC" else f"{label}, gain {gain:g}"
                axes[2].plot(
                    *zip(*levels),
                    color="black" if label == "RL+MPC" else CONTROLLERS[label][0],
                    ls=dashes,
                    marker=marker,
                    ms=4,
                    label=text,
                )
    axes[2].set(
        xlabel="measurement noise [% of range]",
        ylabel="offset of the true $c_B$ [%], median",
        yscale="log",
        title="noise and the filter gain",
    )
    if axes[2].lines:
        axes[2].legend(frameon=False, fontsize=7)
    for ax in axes:
        ax.grid(alpha=0.3)
    fig.savefig(path, dpi=150)


def plot_training(rows, path):
    fig, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
    labels = list(dict.fromkeys(row["variant"] for row in rows))
    print(
        f"{'':40s}robust: median over starts                 75th percentile                           nominal"
    )
    for position, label in enumerate(labels):
        mine = [row for row in rows if row["variant"] == label]
        text = "".join(
            f"{offline.line(number(mine, key)):42s}"
            for key in ("robust_median_ape", "robust_p75_ape", "nominal_median_ape")
        )
        print(f"{label:40s}{text}")
        for key, colour, marker in (
            ("robust_median_ape", "#0072B2", "o"),
            ("robust_p75_ape", "#D55E00", "d"),
        ):
            found = number(mine, key)
            ax.plot(found, np.full(len(found), -position), marker, color=colour, ms=4, alpha=0.5)
            ax.plot([cells.iqm(found)[0]] * 2, [-position - 0.3, -position + 0.3], color=colour, lw=2.5)
    ax.set_yticks(-np.arange(len(labels)), labels)
    ax.set(xscale="log", xlabel="absolute percentage error of $c_B$ on uncertain plants, 200 starts")
    ax.set_xticks([0.2, 0.3, 0.5, 1, 2, 3, 5], ["0.2", "0.3", "0.5", "1", "2", "3", "5"])
    ax.minorticks_off()
    styles = {"median over starts": ("#0072B2", "o"), "75th percentile": ("#D55E00", "d")}
    handles = [
        plt.Line2D([], [], color=colour, marker=marker, label=label)
        for label, (colour, marker) in styles.items()
    ]
    title = "points: training seeds; bars: interquartile means"
    fig.legend(
        handles=handles,
        loc="outside upper center",
        ncols=2,
        frameon=False,
        fontsize=9,
        title=title,
        title_fontsize=9,
    )
    ax.grid(axis="x", alpha=0.3)
    fig.savefig(path, dpi=150)


def main(args):
    name = "cstr_offset_free" if args.study == "loops" else "cstr_offset_free_training"
    cells.check(args, f"{name}.csv", episodes=(1, 10**6), seed=(0, 10**6), jobs=(1, 1024))
    table, profile = (args.out / f"results/{part}.csv" for part in (name, "cstr_offset_free_profile"))
    figure = args.out / f"figures/{name}.png"
    figure.parent.mkdir(parents=True, exist_ok=True)
    if args.study == "training":
        if not args.plot_only:
            todo = [
                (label, variant, seed, args.quick)
                for label, variant in VARIANTS.items()
                for seed in range(args.seed, args.seed + (1 if args.quick else variant[2]))
            ]
            code = [
                Path(__file__),
                offline.__file__,
                offline.sac.__file__,
                envs.__file__,
                cstr.__file__,
            ]
            cells.write(plain() + cells.collect(train, todo, args.jobs, args.runs, code), table)
        return plot_training(cells.read(table), figure)
    if not args.plot_only:
        rows = cells.collect(run, cases(args), args.jobs, args.runs, [Path(__file__), *loops.INPUTS])
        cells.write(
            [{k: row[k] for k in ("controller", "episode", "c_B")} for row in rows if row["case"] == "step"],
            profile,
        )
        cells.write([{k: v for k, v in row.items() if k != "c_B"} for row in rows], table)
    rows = cells.read(table)
    print_loops(rows)
    plot_loops(rows, cells.read(profile), figure)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
