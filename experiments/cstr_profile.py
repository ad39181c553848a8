"""Figure `cstr_rlmpc_profile`: every controller from the paper's start state, where the benchmark MPC gets stuck.

    python experiments/cstr_profile.py              # about a minute
    python experiments/cstr_profile.py --plot-only  # redraw from the committed CSV

Writes results/cstr_profile.csv (a row per controller and sampling time) and figures/cstr_profile.png.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import envs
import rl_mpc_deploy as deploy

X0 = np.array([0.8, 0.3, 100.14, 100.0])  # mol/l, mol/l, degC, degC
CONTROLLERS = ("actor", "robust_mpc", "rl_mpc")


@dataclass
class Args:
    goal: float = 0.6
    """c_B, mol/l"""
    alpha: float = 1.0
    """the plant's activation-energy factor"""
    beta: float = 1.0
    """the plant's rate factor"""
    steps: int = 100
    """sampling times"""
    quick: bool = False
    """5 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def main(args):
    plant = envs.load("cstr")
    settings = deploy.Args(goal=(args.goal,), steps=5 if args.quick else args.steps)
    table, names = args.out / "results/cstr_profile.csv", [*plant.STATE_NAMES, *plant.ACTION_NAMES]
    if not args.plot_only:
        table.parent.mkdir(parents=True, exist_ok=True)
        with open(table, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["controller", "horizon", "goal", "alpha", "beta", "step", *names])
            for name in CONTROLLERS:
                controller = deploy.build_controller(name, settings)
                x, u, row = deploy.run_episode(controller, plant, X0, np.array([args.alpha, args.beta]), controller.goal, settings.steps)
                print(name, {key: round(float(value), 2) for key, value in row.items()})
                for t in range(settings.steps + 1):  # the last action is held for the last row
                    writer.writerow(
                        [
                            name,
                            getattr(controller, "horizon", 0),
                            args.goal,
                            args.alpha,
                            args.beta,
                            t,
                            *x[t],
                            *u[min(t, settings.steps - 1)],
                        ]
                    )
    with open(table, newline="") as file:
        rows = list(csv.DictReader(file))
    paths = {}
    for name in CONTROLLERS:
        values = np.array([[float(row[column]) for column in names] for row in rows if row["controller"] == name])
        paths[name] = values[None, :, :4], values[None, :-1, 4:]
    (args.out / "figures").mkdir(exist_ok=True)
    deploy.figure(plant, deploy.Args(steps=len(values) - 1), rows, paths, [float(rows[0]["goal"])], args.out / "figures/cstr_profile.png")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
