"""Why robust MPC stays where it is: one problem under two solvers, each given the other's plan, and IPOPT with other Hessians and barriers.

    python experiments/reactor/stuck.py --jobs 2        # half an hour; continues where it stopped
    python experiments/reactor/stuck.py --plot-only     # print the table of the committed CSV

The problem is that of rl_mpc_deploy.py's robust MPC, N = 20 with quadratic cost, hard bounds as exact penalties; objectives are the same
number for the same plan. Closed loops on paired draws:

- anytime: the planner of rl_mpc_deploy.py. IPOPT: goal_mpc.py's solver, each step from its own shifted plan.
- Gauss-Newton: IPOPT with the Hessian of the objective alone, without the curvature of the dynamics. Initial barrier: 1e-4 otherwise.
- IPOPT from the anytime plan, anytime from IPOPT's plan: the other one solves at every state first. `gain` is by how much the second then
  lowers the cost (anytime alone: from its own first guess; IPOPT alone: 0), median over steps. Where it is 0 plans are local optima.

Writes results/cstr_stuck.csv, a row per experiment and draw.
"""

import functools
import sys
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from envs import cstr
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import literal, loops

PRICE = np.minimum(len(cstr.SCENARIOS["mpc"]) * cstr.BENCHMARK["slack_price"], deploy.HARD_PRICE)
PROBLEM = dict(
    goal=cstr.EVAL_GOAL, robust_horizon=1, slack_price=PRICE, change_weight=cstr.BENCHMARK["change_weight"]
)
NEAR = 50.0  # below it IPOPT counts as stuck


@dataclass
class Args:
    episodes: int = 20
    """paired draws"""
    seed: int = 0
    """seed of the draws, that of cstr_deploy.py"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps: a smoke test"""
    plot_only: bool = False
    """print the table of the CSV"""
    runs: Path = Path("runs/cstr_loops")
    """where finished draws are kept, so that a second call continues"""
    out: Path = HERE
    """folder whose results/ is written"""


class GaussNewton(literal.IpoptMPC):
    def build_solvers(self, compile, options):
        oracle = super().build_solvers(compile, options)["cold"].oracle()
        w, p, f, g = (self.problem[name] for name in "xpfg")
        factor, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
        hessian = ca.Function(
            "nlp_hess_l", [w, p, factor, multipliers], [ca.triu(ca.hessian(factor * f, w)[0])]
        )
        common = {"print_time": False, "show_eval_warnings": False, "hess_lag": hessian}
        ipopt = {"cold": self.cold | options, "warm": self.cold | options | self.warm}
        return {
            name: ca.nlpsol(name, "ipopt", oracle, common | {"ipopt": given}) for name, given in ipopt.items()
        }


class Second:
    """A controller that starts each step from the plan of another one at the same state."""

    def __init__(self, *arguments, other, **options):
        self.other = other
        super().__init__(*arguments, **options)

    def reset(self, u=None):
        super().reset(u)
        self.other.reset(u)

    def actions(self, x):
        """The other's plan, a list over stages (n_u, nodes)."""
        self.other.u_before = self.u_before
        self.other.make_step(x)
        return self.other.prediction()["u"]


class IpoptSecond(Second, literal.IpoptMPC):
    def make_step(self, x0):
        actions = self.actions(x0)
        w = self.tree_guess(x0, lambda t, x: actions[t])
        guess_cost, self.found, self.plan = (
            self.cost(x0, w),
            None,
            (w, np.zeros(len(w)), np.zeros(len(self.limits["lbg"]))),
        )
        u = super().make_step(x0)
        self.stats |= {
            "guess_cost": guess_cost,
            "cost": guess_cost if self.stats["fell_back"] else self.objective,
        }
        return u


class AnytimeSecond(Second, deploy.ScenarioMPC):
    def _guesses(self, x):
        return {"IPOPT": (np.hstack(self.actions(x)).T - self.u_center) / self.u_scale}


EXPERIMENTS = {
    "anytime": (deploy.ScenarioMPC, {}),
    "IPOPT": (literal.IpoptMPC, {}),
    "IPOPT, Gauss-Newton": (GaussNewton, {}),
    "IPOPT, initial barrier 1": (literal.IpoptMPC, {"barrier": 1.0}),
    "IPOPT, initial barrier 1e-7": (literal.IpoptMPC, {"barrier": 1e-7}),
    "IPOPT from the anytime plan": (IpoptSecond, {"other": "anytime"}),
    "anytime from IPOPT's plan": (AnytimeSecond, {"other": "IPOPT"}),
}


@functools.cache
def controller(experiment, horizon, compile):
    kind, options = EXPERIMENTS[experiment]
    if "other" in options:
        options = {"other": controller(options["other"], horizon, compile)}
    return kind(
        cstr,
        horizon,
        cstr.SCENARIOS["mpc"],
        literal.squared_error(cstr),
        compile=compile,
        **PROBLEM,
        **options,
    )


def run(cell):
    """A row: one experiment on one draw."""
    experiment, seed, episode, steps, *problem = cell
    recorder, (starts, psi) = (
        loops.Recorder(controller(experiment, *problem)),
        deploy.draws(cstr, episode + 1, seed),
    )
    _, _, row = deploy.run_episode(recorder, cstr, starts[episode], psi[episode], cstr.EVAL_GOAL, steps)
    gain = [stats["guess_cost"] - stats["cost"] for stats in recorder.log if "guess_cost" in stats]
    row |= {"gain": np.median(gain or [0.0]), "unsolved": recorder.counts()["unsolved"]}
    row = {key: round(float(value), 6) if isinstance(value, float) else value for key, value in row.items()}
    return [{"variant": experiment, "seed": seed, "episode": episode} | row]


def print_table(rows):
    stuck = {
        row["episode"] for row in rows if row["variant"] == "IPOPT" and float(row["time_near_goal"]) < NEAR
    }
    draws = len({row["episode"] for row in rows})
    print(
        f"medians over the {len(stuck)} of {draws} draws in which IPOPT is near the goal for less than {NEAR:g} steps"
    )
    columns = (
        "time_near_goal",
        "time_outside_constraints",
        "gain",
        "iterations",
        "solve_ms_median",
        "unsolved",
    )
    print(f"{'':32s}" + "".join(f"{name.replace('_', ' '):>26s}" for name in columns))
    for label in EXPERIMENTS:
        mine = [row for row in rows if row["variant"] == label and row["episode"] in stuck]
        print(
            f"{label:32s}"
            + "".join(f"{np.median([float(row[name]) for row in mine]):26.4g}" for name in columns)
        )


def main(args):
    cells.check(args, "cstr_stuck.csv", episodes=(1, 10**6), seed=(0, 10**9), jobs=(1, 1024))
    table = args.out / "results/cstr_stuck.csv"
    if not args.plot_only:
        episodes, steps = (2, 3) if args.quick else (args.episodes, 100)
        problem = (3, False) if args.quick else (cstr.BENCHMARK["horizon"], True)
        todo = [
            (label, args.seed, episode, steps, *problem)
            for label in EXPERIMENTS
            for episode in range(episodes)
        ]
        cells.write(cells.collect(run, todo, args.jobs, args.runs, [Path(__file__), *loops.INPUTS]), table)
    print_table(cells.read(table))


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
