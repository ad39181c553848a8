"""Figure `dip_profile`: the goal-conditioned controller visits the double pendulum's three unstable equilibria (sigma^2 = 0.5, N = 35).

    python experiments/pendulum/equilibria.py               # a minute; the controller learns of each new goal when it is due
    python experiments/pendulum/equilibria.py --plot-only   # redraw the profile from the committed CSV (the animation needs the run)

Writes results/dip_equilibria.csv (a row per start and goal), results/dip_profile.csv (the trajectory from the first start),
figures/dip_profile.png and figures/dip_profile.gif.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
from envs.script.arguments import goal_schedule
from envs.script.figure import draw_episode
from experiments import common
from experiments.common import column, distinct
from experiments.palette import BLUE

plant = envs.load("double_pendulum")

PROFILE = [*plant.STATE_NAMES, *plant.ACTION_NAMES, "goal_1", "goal_2"]  # columns


@dataclass(frozen=True)
class Args(common.StudyArgs):
    goals: tuple[str, ...] = ("up-down", "down-up", "up-up")
    """the equilibria in the order of the visit"""
    hold: int = 120
    """steps for each"""
    episodes: int = 10
    """starts, of seeds in a row: both angles 0.9 pi plus up to 0.05 rad each; the figure shows the first"""


def episode_rows(args, hold, seed, x, u, goals, log):
    """A row per goal of one episode."""
    near = envs.goal_reward(plant, x[1:, plant.GOAL_INDEX], goals, sigma2=plant.METRIC_SIGMA2)
    rows = []
    for i, name in enumerate(args.goals):
        part = slice(i * hold, (i + 1) * hold)
        row = gm.summary(plant, x[i * hold : (i + 1) * hold + 1], u[part], goals[part], log[part])
        row.pop("action_total_variation")  # is that of a whole episode
        reached = int(np.argmax(near[part] > 0.9)) if near[part].max() > 0.9 else hold
        head = {"seed": seed, "equilibrium": name, "steps_to_reach": reached}
        rows.append(head | {"near_last_20": round(near[part][-20:].mean(), 6)} | row)
    return rows


def collect(args):
    hold, episodes, horizon = (4, 1, 3) if args.quick else (args.hold, args.episodes, 35)
    settings = gm.Args(objective="goal", sigma2=0.5, horizon=horizon, compile=not args.quick)
    due = [f"{name}@{i * hold}" for i, name in enumerate(args.goals)]
    goals = goal_schedule(plant, due, hold * len(args.goals))
    mpc, rows = gm.build_controller(settings), []
    for seed in range(args.seed, args.seed + episodes):
        x0, psi = gm.start_and_plant(plant, seed, random_plant=False)
        x, u, predicted, log = gm.simulate(mpc, x0, psi, goals)
        rows += episode_rows(args, hold, seed, x, u, goals, log)
        if seed == args.seed:
            values = np.hstack([x, np.vstack([u, u[-1:]]), np.vstack([goals[:1], goals])]).tolist()
            profile = [{"step": t} | dict(zip(PROFILE, row)) for t, row in enumerate(values)]
            common.write(profile, args.table("dip_profile"))
            film = args.figure("dip_profile").with_suffix(".gif")
            film.parent.mkdir(parents=True, exist_ok=True)
            plant.animate(x, u, predicted, goals, film)
    common.write(rows, args.table("dip_equilibria"))


def plot(rows, path):
    values = np.stack([column(rows, name) for name in PROFILE], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    closed_loop = {"closed loop": (values[:, :6], values[:-1, 6:7], {"color": BLUE})}
    draw_episode(plant, closed_loop, values[1:, 7:], path)


def print_table(rows):
    head = f"{'goal':10s}{'steps to reach it: median [max]':>34s}{'near over the last 20: median [min]':>38s}"
    print(f"{head}{'ms median':>11s}{'p95':>8s}{'worst':>8s}{'failed':>8s}")
    for goal in distinct(rows, "equilibrium"):
        found = {k: column(rows, k, equilibrium=goal) for k in rows[0] if k != "equilibrium"}
        reach, near = found["steps_to_reach"], found["near_last_20"]
        text = f"{goal:10s}{np.median(reach):26.0f} [{reach.max():5.0f}]{np.median(near):31.3f} [{near.min():.2f}]"
        text += f"{np.median(found['solve_ms_median']):11.1f}{np.median(found['solve_ms_p95']):8.1f}"
        print(f"{text}{found['solve_ms_max'].max():8.0f}{found['solver_failures'].sum():8.0f}")


def main(args):
    common.check(args, "dip_profile", episodes=(1, 1000), hold=(1, 10**5))
    for name in args.goals:
        if name not in plant.GOALS:
            common.fail(f"--goals {name} is not an equilibrium; choose from {', '.join(plant.GOALS)}")
    if not args.plot_only:
        collect(args)
    plot(common.read(args.table("dip_profile")), args.figure("dip_profile"))
    print_table(common.read(args.table("dip_equilibria")))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
