"""Figure `cstr_rlmpc_profile`: every controller from the paper's start state, where the benchmark MPC gets stuck.

    python experiments/reactor/trajectories.py              # about a minute
    python experiments/reactor/trajectories.py --goal 0.65 --start 0.8 0.3 60 60 --out runs/cold
    python experiments/reactor/trajectories.py --plot-only  # redraw from the committed CSV

The paper's agent is blind to constraints; the constraint-aware one is the default of rl_mpc_deploy.py, with soft and with hard constraints.
Writes results/cstr_profile.csv (a row per controller and sampling time) and figures/cstr_profile.png.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from envs import cstr
from envs.runs.figure import draw_episode
from experiments import common as cells
from experiments.common import HERE

PAPER = dict(critic=HERE / "pretrained/cstr_robust.pt")
CONTROLLERS = {  # name in the table: (what is built, keywords of rl_mpc_deploy.Args, label, lines)
    "actor": ("actor", PAPER, "RL, paper's", {"color": "#D55E00", "ls": "--"}),
    "robust_mpc": ("robust_mpc", {}, "robust MPC", {"color": "#0072B2", "ls": "-."}),
    "rl_mpc_paper": ("rl_mpc", PAPER, "RL+MPC, paper's", {"color": "#56B4E9"}),
    "rl_mpc": ("rl_mpc", {}, "RL+MPC, constraint-aware", {"color": "#009E73"}),
    "rl_mpc_hard": (
        "rl_mpc",
        dict(constraints="hard"),
        "the same, hard constraints",
        {"color": "black", "ls": (0, (1, 1.5))},
    ),
}


@dataclass
class Args:
    goal: float = 0.6
    """c_B, mol/l"""
    alpha: float = 1.0
    """the plant's activation-energy factor"""
    beta: float = 1.0
    """the plant's rate factor"""
    start: tuple[float, float, float, float] = (0.8, 0.3, 100.14, 100.0)
    """c_A, c_B [mol/l], T_R, T_K [degC]"""
    steps: int = 100
    """sampling times"""
    quick: bool = False
    """5 steps: a smoke test"""
    plot_only: bool = False
    """redraw the figure from the CSV"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""


def profile(name, args):
    """Rows of one controller's closed loop; the last action is held for the last row."""
    kind, options, *_ = CONTROLLERS[name]
    settings = deploy.Args(goal=(args.goal,), **options)
    controller = deploy.build_controller(kind, settings)
    psi, steps = np.array([args.alpha, args.beta]), 5 if args.quick else args.steps
    x, u, row = deploy.run_episode(controller, cstr, np.array(args.start), psi, controller.goal, steps)
    print(name, {key: round(float(value), 2) for key, value in row.items()})
    head = {
        "controller": name,
        "horizon": controller.horizon or 0,
        "goal": args.goal,
        "alpha": args.alpha,
        "beta": args.beta,
    }
    return [
        head | {"step": t} | dict(zip(cstr.STATE_NAMES + cstr.ACTION_NAMES, [*x[t], *u[min(t, steps - 1)]]))
        for t in range(steps + 1)
    ]


def main(args):
    cells.check(args, "cstr_profile.csv", goal=(0.1, 2), alpha=(0.5, 1.5), beta=(0.1, 10), steps=(1, 10**5))
    table, columns = args.out / "results/cstr_profile.csv", cstr.STATE_NAMES + cstr.ACTION_NAMES
    if not args.plot_only:
        cells.write([row for name in CONTROLLERS for row in profile(name, args)], table)
    rows, paths = cells.read(table), {}
    for name in CONTROLLERS:
        mine = [row for row in rows if row["controller"] == name]
        values = np.array([[float(row[column]) for column in columns] for row in mine])
        label, style = CONTROLLERS[name][2:]
        label += "" if name == "actor" else f", N = {mine[0]['horizon']}"
        paths[label] = values[:, :4], values[:-1, 4:], style
    (args.out / "figures").mkdir(parents=True, exist_ok=True)
    draw_episode(
        cstr,
        paths,
        np.full((len(values) - 1, 1), float(rows[0]["goal"])),
        args.out / "figures/cstr_profile.png",
    )


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
