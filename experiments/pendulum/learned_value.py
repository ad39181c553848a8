"""A learned value behind a short plan, on the double pendulum: how it is learnt, what it is worth, what matters in learning it.

    python experiments/pendulum/learned_value.py --study train      # learning curves of three seeds
    python experiments/pendulum/learned_value.py --study loops      # time near the goal and solve times against the horizon
    python experiments/pendulum/learned_value.py --study ablation   # one setting at a time, a tenth of the budget, three seeds each
    python experiments/pendulum/learned_value.py --study equilibria # the paper's sequence of goals with the learned controller

The values are those of `python experiments/planner_value_iteration.py --seed 0`, and of 1 and 2. Plants are nominal. A controller is near
its goal for some of 100 steps, and holds it if the mean nearness of steps 101 to 150 is above 0.9. Starts: "start", both angles 0.9 pi plus
up to 0.05 rad, or "anywhere", angles uniform, rates up to 2 rad/s, the cart within 1 m at up to 1 m/s.

Writes results/dip_value_NAME.csv for NAME in train, loops, ablation, equilibria and profile, and the figures dip_value_NAME.png and
dip_value_equilibria.gif.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs.script.arguments import goal_schedule
from envs.script.comparison import draws, run_episode
from envs.script.figure import draw_episode
from experiments import common
from experiments.common import column, distinct, grouped, rounded, select
from experiments.palette import BLUE, GREEN, GREY, ORANGE, PINK, RED
from experiments.pendulum.equilibria import PROFILE

plant = envs.load("double_pendulum")
GOALS = {name: np.array(goal) for name, goal in plant.GOALS.items()}
ANYWHERE = np.array([1.0, np.pi, np.pi, 1.0, 2.0, 2.0])  # half-widths
HORIZONS = (5, 8, 10, 12, 15, 20)
TENTH = dict(states=6_000, sweeps=3, updates=3_000)  # of all plans and updates
SEQUENCE = "up-down", "down-up", "up-up"
SHOWN = {  # controller: label, colour, marker
    "rl_mpc": ("short plan with the learned value", GREEN, "o"),
    "goal_mpc": ("the same without it", ORANGE, "s"),
    "goal_mpc.py": ("goal_mpc.py, sigma^2 = 1", BLUE, "^"),
}
VARIANTS = {  # of the ablation
    "as it is": {},
    "no slopes": dict(slopes=0.0),
    "plans' promises alone": dict(returns=False),
    "twice the states": dict(states=12_000),
    "no visited states": dict(visited=0.0),
    "twice the box": dict(box=3.0),
    "one sweep": dict(sweeps=1),
    "the lower of two": dict(combine="min"),
}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["train", "loops", "ablation", "equilibria"] = "train"
    """see above"""
    seeds: int = 3
    """values per setting"""
    episodes: int = 100
    """starts of either kind"""
    jobs: int = 1
    """processes; more than one per core disturbs the solve times"""


# Training


def agents(args, changed, budget=None):
    """Arguments of planner_value_iteration.py, of every seed."""
    settings = (common.QUICK_PLANNER if args.quick else budget or {}) | changed
    return [settings | dict(seed=args.seed + i) for i in range(1 if args.quick else args.seeds)]


def learn(args, variants, budget=None):
    """The rows of sweeps.csv of every variant and seed."""
    every = {
        (name, i): each for name in variants for i, each in enumerate(agents(args, variants[name], budget))
    }
    folders = common.train(every.values(), args.runs, args.jobs, script=common.PLANNER)
    rows = []
    for (name, _), settings, folder in zip(every, every.values(), folders):
        head = {"variant": name, "seed": settings["seed"]}
        rows += [head | row for row in common.read(folder / "sweeps.csv")]
    return rows


def checkpoints(args):
    """Of the values that --study train has learnt, one per seed."""
    folders = [common.agent_folder(each, args.runs, script=common.PLANNER) for each in agents(args, {})]
    if not all(folder.exists() for folder in folders):
        common.fail(f"no values are learnt in {args.runs}; first run this with --study train")
    return [folder / "checkpoint.pt" for folder in folders]


def study_train(args):
    common.write(learn(args, {"as it is": {}}), args.table("dip_value_train"))


def study_ablation(args):
    variants = dict(list(VARIANTS.items())[: 2 if args.quick else None])
    common.write(learn(args, variants, TENTH), args.table("dip_value_ablation"))


# Closed loops


@dataclass(frozen=True)
class Loops:
    """Closed loops of one controller: with the value of a checkpoint, that problem without it, or goal_mpc.py."""

    controller: str
    horizon: int
    starts: str
    equilibrium: str
    seed: int
    """of the value"""
    episodes: int
    checkpoint: Path

    def build(self):
        if self.controller == "goal_mpc.py":
            return gm.build_controller(gm.Args(objective="goal", horizon=self.horizon))
        settings = deploy.Args(env="double_pendulum", critic=self.checkpoint, horizon=self.horizon)
        return deploy.build_controller(self.controller, settings)


def loops(cell):
    """A row per start."""
    controller, goal, rows = cell.build(), GOALS[cell.equilibrium], []
    controller.set_goal(goal)
    starts, _ = draws(plant, cell.episodes, 0, "start")
    if cell.starts == "anywhere":
        starts = np.random.default_rng([0, 5]).uniform(-ANYWHERE, ANYWHERE, (cell.episodes, 6))
    for i, start in enumerate(starts):
        x, _, row = run_episode(controller, plant, start, plant.PSI_NOMINAL, goal, 150)
        near = envs.goal_reward(plant, x[1:, plant.GOAL_INDEX], goal, sigma2=plant.METRIC_SIGMA2)
        head = {key: getattr(cell, key) for key in ("controller", "horizon", "starts", "equilibrium", "seed")}
        row = {key: row[key] for key in ("solve_ms_median", "solve_ms_p95")}
        row = {"near": near[:100].sum(), "held": near[100:].mean(), "furthest": np.abs(x[:, 0]).max()} | row
        rows.append(head | rounded({"episode": i} | row, 4))
    return rows


def study_loops(args):
    values, kinds = dict(enumerate(checkpoints(args), args.seed)), ("start", "anywhere")
    horizons, long = ((3,), (3,)) if args.quick else (HORIZONS, (20, 75))
    cells = []
    for starts in kinds:
        for horizon in horizons:
            cells += [("rl_mpc", horizon, starts, "up-up", seed) for seed in values]
            cells += [("goal_mpc", horizon, starts, "up-up", args.seed)]
        cells += [("goal_mpc.py", long[0], starts, "up-up", args.seed)]
    # not from anywhere: plans that do not succeed take seconds each
    cells += [("goal_mpc.py", long[-1], "start", "up-up", args.seed)]
    usual, others = 3 if args.quick else 15, ("up-down", "down-up")
    cells += [("rl_mpc", usual, "start", goal, seed) for seed in values for goal in others]
    episodes = 2 if args.quick else args.episodes
    cells = [Loops(*cell, episodes, values[cell[-1]]) for cell in cells]
    common.write(common.collect(loops, cells, args.runs, args.jobs), args.table("dip_value_loops"))


# The paper's sequence of goals


def study_equilibria(args):
    """The controller that is shipped visits them one after the other, from starts of seeds in a row; the profile is of the first."""
    horizon, hold, episodes = (3, 4, 1) if args.quick else (15, 120, 10)
    due = [f"{name}@{i * hold}" for i, name in enumerate(SEQUENCE)]
    goals = goal_schedule(plant, due, hold * len(SEQUENCE))
    controller, rows = (
        deploy.build_controller("rl_mpc", deploy.Args(env="double_pendulum", horizon=horizon)),
        [],
    )
    starts, _ = draws(plant, episodes, args.seed, "start")
    for episode, start in enumerate(starts):
        controller.reset()
        x, u, predicted, log = [start], [], [], []
        for goal in goals:
            controller.set_goal(goal)
            u.append(controller.make_step(x[-1]))
            predicted.append([x[-1], *(stage[:, 0] for stage in controller.prediction()["x"])])
            log.append(controller.stats["wall_ms"])
            x.append(plant.step(x[-1], u[-1], plant.PSI_NOMINAL))
        x, u = np.array(x), np.array(u)
        near = envs.goal_reward(plant, x[1:, plant.GOAL_INDEX], goals, sigma2=plant.METRIC_SIGMA2)
        for i, name in enumerate(SEQUENCE):
            part = near[i * hold : (i + 1) * hold]
            row = {"episode": episode, "equilibrium": name, "near": part.sum()}
            row |= {"steps_to_reach": int(np.argmax(part > 0.9)) if part.max() > 0.9 else hold}
            row |= {"near_last_20": part[-20:].mean(), "solve_ms_median": np.median(log)}
            rows.append(rounded(row | {"solve_ms_p95": np.quantile(log, 0.95)}, 4))
        if episode == 0:
            shown = np.hstack([x, np.vstack([u, u[-1:]]), np.vstack([goals[:1], goals])])
            profile = [{"step": t} | dict(zip(PROFILE, row)) for t, row in enumerate(shown.tolist())]
            common.write(profile, args.table("dip_value_profile"))
            film = args.figure("dip_value_equilibria").with_suffix(".gif")
            film.parent.mkdir(parents=True, exist_ok=True)
            plant.animate(x, u, np.array(predicted), goals, film)
    common.write(rows, args.table("dip_value_equilibria"))


# Tables and figures


def plot_train(args):
    """Learning curves: a line per seed."""
    rows = common.read(args.table("dip_value_train"))
    fig, axes = common.subplots(1, 2, figsize=(9, 3.2))
    print("seed  sweep  minutes  near the goal, share of steps  held near the start / anywhere  fit error")
    for colour, (seed, mine) in zip((BLUE, RED, GREEN, ORANGE, PINK, GREY), grouped(rows, "seed").items()):
        minutes, best = column(mine, "seconds") / 60, max(mine, key=lambda row: float(row["score"]))
        held = (column(mine, "held") + column(mine, "held_anywhere")) / 2
        for ax, values in zip(axes, (column(mine, "score"), held)):
            ax.plot(minutes, values, "-o", color=colour, ms=4, label=f"seed {seed}")
            at = mine.index(best)
            ax.plot(minutes[at], values[at], "o", color=colour, ms=10, mfc="none")
        text = f"{seed:>4s}{best['sweep']:>7s}{minutes[mine.index(best)]:9.1f}{float(best['score']):30.2f}"
        print(
            f"{text}{float(best['held']):22.2f} / {float(best['held_anywhere']):.2f}{float(best['fit_error']):18.1f}"
        )
    for ax, title in zip(axes, ("near the goal, share of steps", "held at the end, share of loops")):
        ax.set(xlabel="minutes on one core", ylabel=title, ylim=(0, 1.03))
        ax.grid(alpha=0.3)
    common.legend(fig, axes[0], ncols=6, title="rings: the sweep that is kept")
    common.save(fig, args.figure("dip_value_train"))


def measures(rows):
    """Median and 5th percentile of the time near goal, share held, medians of both times of a step."""
    near, held = column(rows, "near"), column(rows, "held") > 0.9
    times = [np.median(column(rows, key)) for key in ("solve_ms_median", "solve_ms_p95")]
    return [np.median(near), np.quantile(near, 0.05), held.mean(), *times]


def plot_loops(args):
    rows = common.read(args.table("dip_value_loops"))
    print("controller      N  goal     starts    seed   near: median  5th    held   step, ms: median   p95")
    for keys, mine in grouped(rows, "controller", "horizon", "equilibrium", "starts", "seed").items():
        median, low, held, ms, p95 = measures(mine)
        text = "{:12s}{:>5s}  {:9s}{:9s}{:>5s}".format(*keys)
        print(f"{text}{median:13.1f}{low:7.1f}{held:7.2f}{ms:14.2f}{p95:11.2f}")
    fig, axes = common.subplots(1, 3, figsize=(11, 3.6))
    titles = "near the goal in 100 steps", "held at the end, share of starts", "time of a step [ms]"
    for name, (label, colour, marker) in SHOWN.items():
        mine = select(rows, controller=name, equilibrium="up-up", starts="start")
        found = {int(n): each for n, each in grouped(mine, "horizon").items()}
        for ax, key in zip(axes, (0, 2, 3)):
            line = [measures(each)[key] for each in found.values()]
            ax.plot(list(found), line, "-" + marker, color=colour, ms=5, label=label)
            if key == 0:
                ends = [np.quantile(column(each, "near"), (0.05, 0.95)) for each in found.values()]
                ax.vlines(list(found), *np.transpose(ends), color=colour, lw=1, alpha=0.6)
            if key == 3:
                ends = [(measures(each)[3], measures(each)[4]) for each in found.values()]
                ax.vlines(list(found), *np.transpose(ends), color=colour, lw=1, alpha=0.6)
    for ax, title in zip(axes, titles):
        ax.set(xlabel="horizon N", ylabel=title, xscale="log")
        ticks = sorted({int(n) for n in column(rows, "horizon")})
        ax.set_xticks(ticks, ticks, fontsize=8)
        ax.minorticks_off()
        ax.grid(alpha=0.3)
    axes[2].set_yscale("log")
    lines = "points: medians; lines: 5th to 95th percentile of starts, of a step's time up to its 95th"
    common.legend(fig, axes[0], ncols=3, title=lines)
    common.save(fig, args.figure("dip_value_loops"))


def plot_ablation(args):
    rows = common.read(args.table("dip_value_ablation"))
    names = distinct(rows, "variant")
    fig, axes = common.subplots(1, 2, figsize=(9, 0.9 + 0.3 * len(names)), sharey=True)
    print(f"{'':22s}near the goal, share of steps: mean [range]    held: mean [range]    minutes")
    for position, name in enumerate(names):
        agents = grouped(select(rows, variant=name), "seed").values()
        best = [max(mine, key=lambda row: float(row["score"])) for mine in agents]
        score, held = column(best, "score"), (column(best, "held") + column(best, "held_anywhere")) / 2
        for ax, values in zip(axes, (score, held)):
            ax.plot(values, [-position] * len(values), "o", color=BLUE, ms=4, alpha=0.6)
            ax.plot([values.mean()] * 2, [-position - 0.35, -position + 0.35], color=BLUE, lw=2)
        minutes = column(
            [mine[-1] for mine in grouped(select(rows, variant=name), "seed").values()], "seconds"
        )
        shown = "".join(f"{v.mean():20.2f} [{v.min():.2f}, {v.max():.2f}]" for v in (score, held))
        print(f"{name:22s}{shown}{minutes.mean() / 60:11.1f}")
    axes[0].set_yticks(-np.arange(len(names)), names)
    for ax, title in zip(axes, ("near the goal, share of steps", "held at the end, share of loops")):
        ax.set_xlabel(title)
        ax.grid(alpha=0.3)
    common.save(fig, args.figure("dip_value_ablation"))


def plot_equilibria(args):
    profile, rows = (
        common.read(args.table("dip_value_profile")),
        common.read(args.table("dip_value_equilibria")),
    )
    shown = np.stack([column(profile, name) for name in PROFILE], axis=1)
    args.figure("dip_value_equilibria").parent.mkdir(parents=True, exist_ok=True)
    path = {"closed loop": (shown[:, :6], shown[:-1, 6:7], {"color": BLUE})}
    draw_episode(plant, path, shown[1:, 7:], args.figure("dip_value_equilibria"))
    print(
        "goal      steps to reach it: median [most]   near over the last 20: median [least]   ms: median   p95"
    )
    for name in distinct(rows, "equilibrium"):
        mine = select(rows, equilibrium=name)
        reach, near, ms, p95 = (column(mine, key) for key in list(rows[0])[3:])
        text = f"{name:10s}{np.median(reach):26.0f} [{reach.max():.0f}]{np.median(near):32.3f} [{near.min():.2f}]"
        print(f"{text}{np.median(ms):16.2f}{np.median(p95):7.2f}")


def main(args):
    common.check(args, f"dip_value_{args.study}", episodes=(1, 10**6), seeds=(1, 1000))
    studies = dict(train=study_train, loops=study_loops, ablation=study_ablation, equilibria=study_equilibria)
    plots = dict(train=plot_train, loops=plot_loops, ablation=plot_ablation, equilibria=plot_equilibria)
    if not args.plot_only:
        studies[args.study](args)
    plots[args.study](args)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
