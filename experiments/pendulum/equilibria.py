"""Figure `dip_profile`: the goal-conditioned controller visits the double pendulum's three unstable equilibria (sigma^2 = 0.5, N = 35).

    python experiments/pendulum/equilibria.py               # a minute; the controller learns of each new goal when it is due
    python experiments/pendulum/equilibria.py --plot-only   # redraw the profile from the committed CSV (the animation needs the run)

Writes results/dip_equilibria.csv (a row per start and goal), results/dip_profile.csv (the trajectory from the first start),
figures/dip_profile.png and figures/dip_profile.gif.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import goal_mpc as gm
from envs import double_pendulum as plant
from envs.runs.figure import draw_episode
from experiments import common as cells
from experiments.common import HERE


@dataclass
class Args:
    goals: tuple[str, ...] = ("up-down", "down-up", "up-up")
    """the equilibria in the order of the visit"""
    hold: int = 120
    """steps for each"""
    episodes: int = 10
    """starts: both angles 0.9 pi plus up to 0.05 rad each; the figure shows the first"""
    seed: int = 0
    """seed of the first start"""
    quick: bool = False
    """1 start, 4 steps for each goal, a short horizon: a smoke test"""
    plot_only: bool = False
    """redraw the profile from the CSV"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def collect(args):
    hold, episodes = (4, 1) if args.quick else (args.hold, args.episodes)
    settings = gm.Args(objective="goal", sigma2=0.5, horizon=3 if args.quick else 35, compile=not args.quick)
    goals = gm.goal_schedule(
        plant, [f"{name}@{i * hold}" for i, name in enumerate(args.goals)], hold * len(args.goals)
    )
    mpc, rows = gm.build_controller(settings), []
    for seed in range(args.seed, args.seed + episodes):
        x0, psi = gm.start_and_plant(plant, seed, random_plant=False)
        x, u, predicted, log = gm.simulate(mpc, x0, psi, goals)
        for i, name in enumerate(args.goals):
            part = slice(i * hold, (i + 1) * hold)
            row = gm.summary(plant, x[i * hold : (i + 1) * hold + 1], u[part], goals[part], log[part])
            near = gm.envs.goal_reward(plant, x[1:, plant.GOAL_INDEX], goals, sigma2=plant.METRIC_SIGMA2)[
                part
            ]
            row.pop("action_total_variation")  # is that of a whole episode
            reached = int(np.argmax(near > 0.9)) if near.max() > 0.9 else hold
            rows.append(
                {
                    "seed": seed,
                    "equilibrium": name,
                    "steps_to_reach": reached,
                    "near_last_20": round(near[-20:].mean(), 6),
                }
                | row
            )
        if seed == args.seed:
            names = [*plant.STATE_NAMES, *plant.ACTION_NAMES, "goal_1", "goal_2"]
            values = np.hstack([x, np.vstack([u, u[-1:]]), np.vstack([goals[:1], goals])])
            gm.write_csv(
                [{"step": t} | dict(zip(names, row)) for t, row in enumerate(values.tolist())],
                args.out / "results/dip_profile.csv",
            )
            (args.out / "figures").mkdir(exist_ok=True)
            plant.animate(x, u, predicted, goals, args.out / "figures/dip_profile.gif")
    gm.write_csv(rows, args.out / "results/dip_equilibria.csv")


def plot(args):
    with open(args.out / "results/dip_profile.csv", newline="") as file:
        values = np.array([[float(v) for v in row.values()] for row in csv.DictReader(file)])[:, 1:]
    (args.out / "figures").mkdir(exist_ok=True)
    closed_loop = {"closed loop": (values[:, :6], values[:-1, 6:7], {"color": "#0072B2"})}
    draw_episode(plant, closed_loop, values[1:, 7:], args.out / "figures/dip_profile.png")
    with open(args.out / "results/dip_equilibria.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    print(
        f"{'goal':10s}{'steps to reach it: median [max]':>34s}{'near over the last 20: median [min]':>38s}"
        f"{'ms median':>11s}{'p95':>8s}{'worst':>8s}{'failed':>8s}"
    )
    for goal in dict.fromkeys(row["equilibrium"] for row in rows):
        column = {
            key: np.array([float(row[key]) for row in rows if row["equilibrium"] == goal])
            for key in rows[0]
            if key != "equilibrium"
        }
        reach, near = column["steps_to_reach"], column["near_last_20"]
        print(
            f"{goal:10s}{np.median(reach):26.0f} [{reach.max():5.0f}]{np.median(near):31.3f} [{near.min():.2f}]"
            f"{np.median(column['solve_ms_median']):11.1f}{np.median(column['solve_ms_p95']):8.1f}{column['solve_ms_max'].max():8.0f}"
            f"{column['solver_failures'].sum():8.0f}"
        )


def main(args):
    cells.check(args, "dip_profile.csv", episodes=(1, 1000), seed=(0, 10**9), hold=(1, 10**5))
    for name in args.goals:
        if name not in plant.GOALS:
            cells.fail(f"--goals {name} is not an equilibrium; choose from {', '.join(plant.GOALS)}")
    if not args.plot_only:
        collect(args)
    plot(args)


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
