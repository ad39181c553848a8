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

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from envs import cstr
from envs.script.comparison import run_episode
from envs.script.figure import draw_episode
from experiments import common
from experiments.common import PRETRAINED, column, select
from experiments.palette import BLUE, GREEN, RED, SKY

PAPER, DOTS = dict(critic=PRETRAINED / "cstr_robust.pt"), (0, (1, 1.5))
CONTROLLERS = {  # name in the table: (what is built, keywords of rl_mpc_deploy.Args, label, lines)
    "actor": ("actor", PAPER, "RL, paper's", {"color": RED, "ls": "--"}),
    "robust_mpc": ("robust_mpc", {}, "robust MPC", {"color": BLUE, "ls": "-."}),
    "rl_mpc_paper": ("rl_mpc", PAPER, "RL+MPC, paper's", {"color": SKY}),
    "rl_mpc": ("rl_mpc", {}, "RL+MPC, constraint-aware", {"color": GREEN}),
    "rl_mpc_hard": (
        "rl_mpc",
        dict(constraints="hard"),
        "the same, hard constraints",
        {"color": "black", "ls": DOTS},
    ),
}
COLUMNS = cstr.STATE_NAMES + cstr.ACTION_NAMES


@dataclass(frozen=True)
class Args(common.StudyArgs):
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


def trajectory(name, args):
    """Rows of one controller's closed loop; the last action is held for the last row."""
    kind, options, *_ = CONTROLLERS[name]
    controller = deploy.build_controller(kind, deploy.Args(goal=(args.goal,), **options))
    psi, steps = np.array([args.alpha, args.beta]), 5 if args.quick else args.steps
    x, u, row = run_episode(controller, cstr, np.array(args.start), psi, controller.goal, steps)
    print(name, {key: round(float(value), 2) for key, value in row.items()})
    head = {"controller": name, "horizon": controller.horizon or 0, "goal": args.goal}
    head |= {"alpha": args.alpha, "beta": args.beta}
    values = np.hstack([x, np.vstack([u, u[-1:]])])
    return [head | {"step": t} | dict(zip(COLUMNS, values[t])) for t in range(steps + 1)]


def plot(rows, path):
    paths = {}
    for name, (_, _, label, style) in CONTROLLERS.items():
        mine = select(rows, controller=name)
        label += "" if name == "actor" else f", N = {mine[0]['horizon']}"
        values = np.stack([column(mine, key) for key in COLUMNS], axis=1)
        paths[label] = values[:, :4], values[:-1, 4:], style
    goals = np.full((len(values) - 1, 1), float(rows[0]["goal"]))
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_episode(cstr, paths, goals, path)


def main(args):
    common.check(args, "cstr_profile", goal=(0.1, 2), alpha=(0.5, 1.5), beta=(0.1, 10), steps=(1, 10**5))
    if not args.plot_only:
        rows = [row for name in CONTROLLERS for row in trajectory(name, args)]
        common.write(rows, args.table("cstr_profile"))
    plot(common.read(args.table("cstr_profile")), args.figure("cstr_profile"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
