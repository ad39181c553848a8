"""Steady-state offset on plants whose parameters are fixed but unknown: every controller with and without an estimate of its plant.

    python experiments/reactor/offset_free.py --study training --jobs 2   # half an hour: agents that observe the mismatch, and ablations
    python experiments/reactor/offset_free.py --jobs 2                    # half an hour: closed loops; both continue where they stopped
    python experiments/reactor/offset_free.py --plot-only                 # redraw from the committed CSV

loops: the paired draws of deploy.py on a fixed plant; plants at twice the training box; the catalyst's activity beta falling from 1.0
to 0.9 at half time, or drifting there; measurement noise, a share of each state's range, under three filter gains. Every measure is of the
true state. training: the evaluation of offline.py, whose robust agent is the plain one.

Writes results/cstr_offset_free.csv (a row per case, controller and draw), cstr_offset_free_profile.csv (c_B over the fall of beta) and
figures/cstr_offset_free.png, or results/cstr_offset_free_training.csv (a row per variant and seed) and the figure of that name.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
from envs import cstr
from experiments import common
from experiments.common import HERE, PRETRAINED, column, distinct, grouped, rounded, select, without
from experiments.palette import BLUE, GREEN, GREY, PINK, RED
from experiments.reactor import literal, loops, offline
from experiments.reactor.deploy import ACTOR, AWARE, PAPER, RL_MPC, ROBUST, TUNED

OBSERVING = dict(observe_mismatch=True, scenario_hold="episode")


def scaled(factor):
    """An agent that observes the mismatch on another scale, which envs.load takes in place of True."""
    return OBSERVING | dict(observe_mismatch=tuple((factor * cstr.MISMATCH_SCALE).tolist()))


VARIANTS = {  # of the training: (arguments of sac_her_branching.py, seeds)
    "offset-free": (OBSERVING, 10),
    "offset-free, discount 0.99": (OBSERVING | dict(gamma=0.99), 5),
    "plain, discount 0.95": (dict(gamma=0.95), 5),
    "scenario held, mismatch not observed": (dict(scenario_hold="episode", gamma=0.95), 5),
    "mismatch observed, scenario not held": (dict(observe_mismatch=True), 5),
    "mismatch scale x 10": (scaled(10.0), 5),
    "mismatch scale / 10": (scaled(0.1), 5),
}
OBSERVER = dict(critic=PRETRAINED / "cstr_offset_free.pt")
FREE, PARAMETERS = dict(offset_free=True), dict(offset_free=True, estimate="parameters")
LONG, BEST = ROBUST | dict(horizon=20), ROBUST | dict(benchmark=TUNED)
CONTROLLERS = {  # label: (colour, dashes, keywords of rl_mpc_deploy.Args and of loops.Loop)
    "robust MPC": (GREY, ":", LONG),
    "robust MPC, offset-free": (GREY, "-", LONG | FREE),
    "robust MPC, tuned": (BLUE, ":", BEST),
    "robust MPC, tuned, offset-free": (BLUE, "-", BEST | FREE),
    "RL, paper's": (RED, ":", ACTOR | PAPER),
    "RL, offset-free": (RED, "-", ACTOR | OBSERVER),
    "RL+MPC": (GREEN, ":", RL_MPC | AWARE),
    "RL+MPC, offset-free": (GREEN, "-", RL_MPC | AWARE | FREE),
    "RL+MPC, parameters": (PINK, "--", RL_MPC | AWARE | PARAMETERS),
}
# those whose answer to a change is drawn, with where their names stand
ADAPTING = {"RL+MPC": (12, -5.4), "RL+MPC, offset-free": (12, 0.3), "robust MPC, tuned": (12, -3.6)}
ADAPTING |= {"RL, offset-free": (12, 1.1)}
WHOLE, FIFTH, HALF = dict(spread=1.0), dict(spread=0.2), dict(spread=0.5)
SETTINGS = {  # of RL+MPC, on a fixed plant alone
    "disturbance, whole spread": RL_MPC | AWARE | FREE | WHOLE,
    "disturbance, a fifth of the spread": RL_MPC | AWARE | FREE | FIFTH,
    "parameters, whole spread": RL_MPC | AWARE | PARAMETERS | WHOLE,
    "parameters, a fifth of the spread": RL_MPC | AWARE | PARAMETERS | FIFTH,
    "half the spread, nothing estimated": RL_MPC | AWARE | HALF,
    "critic that observes the mismatch": RL_MPC | OBSERVER | FREE,
    "the same, whole spread": RL_MPC | OBSERVER | FREE | WHOLE,
}
CHANGING = [label for label in CONTROLLERS if not label.startswith("robust MPC") or "tuned" in label]
NOISY = ["RL, offset-free", "RL+MPC", "RL+MPC, offset-free", "RL+MPC, parameters"]
NOISES, GAINS = (0.0, 0.002, 0.01), (1.0, 0.3, 0.1)


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["loops", "training"] = "loops"
    """loops: controllers on fixed, changing, noisy and unusual plants; training: agents"""
    episodes: int = 50
    """paired draws of the robust MPCs on a fixed plant; four times as many of the others, 20 at most elsewhere"""


# Closed loops


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


def closed_loop(mpc, x0, path, noise):
    """States (steps + 1, n_x) and solve times, ms; path: the plant's parameters and noise: of the measurement, a row per step."""
    mpc.reset()
    x, times = [x0], []
    for psi, error in zip(path, noise):
        u = mpc.make_step(x[-1] + error)
        x.append(cstr.step(x[-1], u, psi))
        times.append(mpc.stats["wall_ms"])
    return np.array(x), times


def run(case):
    """A row per draw; the path of c_B, as text, goes into a table of its own."""
    loop, args, rows = case.loop, case.loop.settings, []
    mpc = loops.controller(args, loop.like, loop.benchmark)
    starts, psi = loops.paired_draws(loop)
    for episode in range(loop.first, loop.stop):
        path = plant_path(case.kind, psi[episode], args.steps)
        rng, scale = np.random.default_rng([args.seed, 7, episode]), case.noise * (cstr.X_HIGH - cstr.X_LOW)
        noise = scale * rng.normal(size=(args.steps, len(scale)))
        x, times = closed_loop(mpc, starts[episode], path, noise)
        achieved = x[1:, cstr.GOAL_INDEX]
        error = cstr.percentage_error(achieved, mpc.goal)
        late = error[args.steps // 2 :] if case.kind in ("step", "drift") else error
        row = {"case": case.kind, "controller": loop.variant, "noise": case.noise, "gain": args.filter_gain}
        row |= {"seed": args.seed, "episode": episode, "alpha": path[-1, 0], "beta": path[-1, 1]}
        row |= {
            "time_near_goal": envs.time_near_goal(cstr, achieved, mpc.goal),
            "time_outside_constraints": envs.outside_constraints(cstr, x[1:]).sum(),
            "offset": error[-25:].mean(),
            "steps_over_2_percent": int((late > 2).sum()),
            "solve_ms_median": np.median(times),
            "solve_ms_p95": np.quantile(times, 0.95),
        }
        rows.append(rounded(row, 5) | {"c_B": " ".join(f"{v:.4f}" for v in x[:, 1])})
    return rows


def cases(args):
    found, few = [], min(args.episodes, 20)

    def add(kind, labels, episodes, noise=0.0, gain=1.0, **options):
        options |= dict(filter_gain=gain)
        known = SETTINGS | {label: keywords for label, (_, _, keywords) in CONTROLLERS.items()}
        variants = {label: known[label] | options for label in labels}
        cells = loops.loops(variants, episodes, args.seed, args.quick)
        found.extend(Case(kind, noise, loop) for loop in cells)

    for label in CONTROLLERS:
        add("fixed", [label], args.episodes if label.startswith("robust") else 4 * args.episodes)
    add("fixed", SETTINGS, args.episodes)
    for kind, options in (("outside", dict(shift=2.0)), ("step", {}), ("drift", {})):
        add(kind, CHANGING, few, **options)
    for noise in NOISES:
        for gain in GAINS:
            add("noise", [label for label in NOISY if gain == 1 or label != "RL+MPC"], few, noise, gain)
    return found[:: 9 if args.quick else 1]


def print_loops(rows):
    head = f"{'case':9s}{'noise':>6s}{'gain':>5s} {'controller':36s}{'draws':>6s}"
    head += f"{'offset %: median  95 %':>24s}{'near goal: median  5 %':>24s}{'outside: median  5 %':>22s}"
    print(f"{head}{'steps over 2 %':>16s}{'ms':>7s}")
    keys = ("offset", "time_near_goal", "time_outside_constraints", "steps_over_2_percent", "solve_ms_median")
    for (case, noise, gain, controller), mine in grouped(rows, "case", "noise", "gain", "controller").items():
        offset, near, outside, over, ms = (column(mine, key) for key in keys)
        text = f"{case:9s}{100 * float(noise):5.1f}%{gain:>5s} {controller:36s}{len(mine):6d}"
        text += f"{np.median(offset):17.2f}{np.quantile(offset, 0.95):7.2f}"
        text += f"{np.median(near):17.1f}{np.quantile(near, 0.05):7.1f}"
        text += f"{np.median(outside):15.2f}{np.quantile(outside, 0.05):7.1f}"
        print(f"{text}{np.median(over):16.0f}{np.median(ms):7.1f}")


def plot_loops(rows, paths, path):
    fig, axes = common.subplots(1, 3, figsize=(13, 4.4), width_ratios=(1.1, 1, 1))
    for position, (label, (colour, _, _)) in enumerate(CONTROLLERS.items()):
        found = np.maximum(column(rows, "offset", case="fixed", controller=label), 1e-3)
        style = dict(
            boxprops=dict(facecolor=colour), medianprops=dict(color="black", lw=2), patch_artist=True
        )
        style |= dict(orientation="horizontal", widths=0.6, whis=(5, 95), showfliers=False)
        axes[0].boxplot(found, positions=[-position], **style)
    axes[0].set_yticks(-np.arange(len(CONTROLLERS)), CONTROLLERS)
    axes[0].set(
        xscale="log", xlabel="offset of $c_B$ over the last 25 steps [%]", title="a fixed, unknown plant"
    )
    for label, mine in grouped(paths, "controller").items():
        if label not in ADAPTING:
            continue
        colour, dashes, _ = CONTROLLERS[label]
        c_b = np.array([[float(v) for v in row["c_B"].split()] for row in mine])
        error, steps = 100 * (c_b / cstr.EVAL_GOAL[0] - 1), np.arange(c_b.shape[1]) - c_b.shape[1] // 2
        shown = steps >= -10
        axes[1].plot(steps[shown], np.median(error, 0)[shown], color=colour, ls=dashes, lw=2)
        axes[1].text(*ADAPTING[label], label, color=colour, fontsize=9)
    axes[1].axhline(0, color="black", lw=1, alpha=0.5)
    axes[1].set(xlabel=r"steps after $\beta$ falls from 1.0 to 0.9", title="the catalyst loses activity")
    axes[1].set(ylabel="$c_B$ above the goal [%], median of 20 draws", ylim=(-6, 2))
    for label in ("RL+MPC", "RL+MPC, offset-free"):
        colour = "black" if label == "RL+MPC" else CONTROLLERS[label][0]
        for gain, dashes, marker in zip(GAINS, ("-", "--", ":"), "osd"):
            by_noise = grouped(select(rows, case="noise", controller=label, gain=gain), "noise").items()
            levels = [(100 * float(noise), np.median(column(mine, "offset"))) for noise, mine in by_noise]
            if levels:
                text = "" if label == "RL+MPC" else f"filter gain {gain:g}"
                axes[2].plot(*zip(*levels), color=colour, ls=dashes, marker=marker, ms=4)
                last, end = levels[-1]
                axes[2].text(
                    last + 0.04,
                    end * (1.1 if gain == 0.3 else 1),
                    text,
                    color=colour,
                    fontsize=9,
                    va="center",
                )
                if not text:
                    axes[2].text(0, levels[0][1] * 1.15, "RL+MPC without an estimate", fontsize=9)
    axes[2].set(xlabel="measurement noise [% of range]", ylabel="offset of the true $c_B$ [%], median")
    axes[2].set(yscale="log", title="RL+MPC, offset-free: noise", xlim=(-0.05, 1.5), xticks=(0, 0.2, 1))
    for ax in axes:
        ax.grid(alpha=0.3)
    common.save(fig, path)


# Agents


def training_row(label, seed, rows):
    """The evaluation of offline.py, in medians and 75th percentiles over starts."""
    row = {"variant": label, "seed": seed}
    for evaluation in ("robust", "nominal"):
        ape = column(rows, "ape", evaluation=evaluation)
        row |= {f"{evaluation}_median_ape": np.median(ape), f"{evaluation}_p75_ape": np.quantile(ape, 0.75)}
    return rounded(row, 4)


def train(args):
    """A row per agent; those of the plain ones are of offline.py's committed table."""
    agents = {
        (label, seed): arguments
        for label, (arguments, seeds) in VARIANTS.items()
        for seed in range(args.seed, args.seed + (1 if args.quick else seeds))
    }
    plain = grouped(select(common.read(HERE / "results/cstr_offline.csv"), agent="robust"), "seed")
    found = [training_row("plain", seed, rows) for seed, rows in plain.items()]
    rows = grouped(offline.errors(offline.train(agents, args), args), "agent", "seed")
    return found + [training_row(label, seed, mine) for (label, seed), mine in rows.items()]


def plot_training(rows, path):
    fig, ax = common.subplots(figsize=(8, 3.6))
    labels = distinct(rows, "variant")
    shown = {
        "robust_median_ape": ("median over starts", BLUE, "o"),
        "robust_p75_ape": ("75th percentile", RED, "d"),
    }
    titles = ("robust: median over starts", "75th percentile", "nominal")
    print(f"{'':40s}" + "".join(f"{title:42s}" for title in titles))
    for position, label in enumerate(labels):
        mine = select(rows, variant=label)
        texts = [common.iqm_text(column(mine, key)) for key in (*shown, "nominal_median_ape")]
        print(f"{label:40s}" + "".join(f"{text:42s}" for text in texts))
        for key, (_, colour, marker) in shown.items():
            found = column(mine, key)
            ax.plot(found, np.full(len(found), -position), marker, color=colour, ms=4, alpha=0.5)
            middle = common.iqm(found)[0]
            ax.plot([middle] * 2, [-position - 0.3, -position + 0.3], color=colour, lw=2.5)
    ax.set_yticks(-np.arange(len(labels)), labels)
    ax.set(xscale="log", xlabel="absolute percentage error of $c_B$ on uncertain plants, 200 starts")
    ax.set_xticks([0.2, 0.3, 0.5, 1, 2, 3, 5], ["0.2", "0.3", "0.5", "1", "2", "3", "5"])
    ax.minorticks_off()
    for text, colour, marker in shown.values():
        ax.plot([], [], color=colour, marker=marker, label=text)
    title = "points: training seeds; bars: interquartile means"
    common.legend(fig, ax, ncols=2, title=title, title_fontsize=9)
    ax.grid(axis="x", alpha=0.3)
    common.save(fig, path)


def main(args):
    name = "cstr_offset_free" if args.study == "loops" else "cstr_offset_free_training"
    common.check(args, name, episodes=(1, 10**6))
    table, profile = args.table(name), args.table("cstr_offset_free_profile")
    if args.study == "training":
        if not args.plot_only:
            common.write(train(args), table)
        return plot_training(common.read(table), args.figure(name))
    if not args.plot_only:
        rows = common.collect(run, cases(args), args.runs, args.jobs, uses=[loops, literal])
        steps = select(rows, case="step")
        common.write([{k: row[k] for k in ("controller", "episode", "c_B")} for row in steps], profile)
        common.write([without(row, "c_B") for row in rows], table)
    rows = common.read(table)
    print_loops(rows)
    plot_loops(rows, common.read(profile), args.figure(name))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
