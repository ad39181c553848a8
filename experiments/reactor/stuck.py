"""Why robust MPC stays where it is: one problem under two solvers, each given the other's plan, and IPOPT with other Hessians and barriers.

    python experiments/reactor/stuck.py --jobs 2        # eight minutes; continues where it stopped
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

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from envs import cstr
from envs.script.comparison import draws, run_episode
from experiments import common
from experiments.common import column, distinct, rounded
from experiments.reactor import literal, loops

SCENARIOS, BENCHMARK = cstr.SCENARIOS["mpc"], cstr.BENCHMARK
OPTIONS = dict(goal=cstr.EVAL_GOAL, robust_horizon=1, change_weight=BENCHMARK["change_weight"])
OPTIONS |= dict(slack_price=np.minimum(len(SCENARIOS) * BENCHMARK["slack_price"], deploy.HARD_PRICE))
NEAR = 50.0  # below it IPOPT counts as stuck


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 10
    """paired draws"""


class GaussNewton(literal.IpoptMPC):
    def build_solvers(self, compile, options):
        oracle = super().build_solvers(compile, options)["cold"].oracle()
        w, p, f, g = (self.problem[name] for name in "xpfg")
        factor, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
        hessian = ca.triu(ca.hessian(factor * f, w)[0])
        hessian = ca.Function("nlp_hess_l", [w, p, factor, multipliers], [hessian])
        shared = {"print_time": False, "show_eval_warnings": False, "hess_lag": hessian}
        ipopt = {"cold": self.cold | options, "warm": self.cold | options | self.warm}
        return {name: ca.nlpsol(name, "ipopt", oracle, shared | {"ipopt": ipopt[name]}) for name in ipopt}


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
        self.found, self.plan = None, (w, np.zeros(len(w)), np.zeros(len(self.limits["lbg"])))
        guess_cost = self.cost(x0, w)
        u = super().make_step(x0)
        cost = guess_cost if self.stats["fell_back"] else self.objective
        self.stats |= {"guess_cost": guess_cost, "cost": cost}
        return u


class AnytimeSecond(Second, deploy.ScenarioMPC):
    def first_guesses(self, x):
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
    options = OPTIONS | options | dict(compile=compile)
    return kind(cstr, horizon, SCENARIOS, literal.squared_error(cstr), **options)


def run(cell):
    """A row: one experiment on one draw."""
    experiment, seed, episode, steps, *problem = cell
    recorder = loops.Recorder(controller(experiment, *problem))
    starts, psi = draws(cstr, episode + 1, seed)
    _, _, row = run_episode(recorder, cstr, starts[episode], psi[episode], cstr.EVAL_GOAL, steps)
    gain = [stats["guess_cost"] - stats["cost"] for stats in recorder.log if "guess_cost" in stats]
    row |= {"gain": np.median(gain or [0.0]), "unsolved": recorder.counts()["unsolved"]}
    return [{"variant": experiment, "seed": seed, "episode": episode} | rounded(row, 6)]


def print_table(rows):
    near = {row["episode"]: float(row["time_near_goal"]) for row in rows if row["variant"] == "IPOPT"}
    stuck, draws = [row for row in rows if near[row["episode"]] < NEAR], len(near)
    which = f"{len(distinct(stuck, 'episode'))} of {draws} draws"
    print(f"medians over the {which} in which IPOPT is near the goal for less than {NEAR:g} steps")
    columns = ["time_near_goal", "time_outside_constraints", "gain", "iterations"]
    columns += ["solve_ms_median", "unsolved"]
    print(f"{'':32s}" + "".join(f"{name.replace('_', ' '):>26s}" for name in columns))
    for label in EXPERIMENTS:
        medians = (np.median(column(stuck, name, variant=label)) for name in columns)
        print(f"{label:32s}" + "".join(f"{median:26.4g}" for median in medians))


def main(args):
    common.check(args, "cstr_stuck", episodes=(1, 10**6))
    if not args.plot_only:
        usual = args.episodes, 100, BENCHMARK["horizon"], True
        episodes, steps, *problem = (2, 3, 3, False) if args.quick else usual
        todo = [(label, args.seed, i, steps, *problem) for label in EXPERIMENTS for i in range(episodes)]
        rows = common.collect(run, todo, args.runs, args.jobs, uses=[loops, literal])
        common.write(rows, args.table("cstr_stuck"))
    print_table(common.read(args.table("cstr_stuck")))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
