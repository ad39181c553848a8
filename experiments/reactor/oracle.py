"""How far each controller of the reactor is from the best possible: one optimal control problem over the whole episode for each draw.

    python experiments/reactor/deploy.py --jobs 2      # first: the controllers, whose trajectories are guesses
    python experiments/reactor/oracle.py --jobs 2      # ten minutes; continues where it stopped
    python experiments/reactor/oracle.py --plot-only   # print the tables from the committed CSV

The oracle knows the plant's parameters and the whole episode, and maximises the evaluation's own time near goal minus a slack penalty of 5
per mol/l or degC and step (on the first 25 draws of 0.3 to 100, for the frontier). The problem has local optima: it is solved from
the trajectory of every controller, from a held state, and from the solutions for the neighbouring weights, and the best of these solves is
kept.

Writes results/cstr_oracle.csv (a row per weight and draw) and cstr_oracle_gap.csv (a row per controller): the gap of a
controller is what it lacks to the oracle in time near goal, in time outside constraints and in the oracle's objective; the last can be
negative only where every solve ended in a worse local optimum, which `negative` counts. It also says whether RL+MPC at N = 5 reaches the
goal that the repository sets itself.
"""

import functools
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
from envs import cstr
from envs.script.comparison import draws
from experiments import common
from experiments.common import column, distinct, grouped, rounded, select
from experiments.reactor import literal, loops
from experiments.reactor.deploy import STUDIES, summary

WEIGHT, FRONTIER = 5.0, (0.3, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0)
FRONTIER_DRAWS = 25
UNSEEN = 50  # draws from here on took no part in the choice of the default's weights
N_X, N_PSI = len(cstr.X_LOW), len(cstr.PSI_NOMINAL)
DEFAULT = "RL+MPC, constraint-aware, N = 5"


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 100
    """paired draws, the first of deploy.py's"""


def known_plant():
    """The reactor with its uncertain parameters as two constant states, so that one compiled problem serves every plant; and with the
    simulated plant's integration."""

    def ode(x, u, psi, xp=np):
        slope = cstr.ode(x[:N_X], u, x[N_X:], xp)
        return envs.stack(xp, [*(slope[i] for i in range(N_X)), *(0 * x[0] for _ in range(N_PSI))])

    wide = {"X_LOW": -np.inf, "X_HIGH": np.inf, "INIT_LOW": 0.0, "INIT_HIGH": 2.0}
    bounds = {name: np.append(getattr(cstr, name), np.full(N_PSI, value)) for name, value in wide.items()}
    constants = {k: v for k, v in vars(cstr).items() if k.isupper()} | bounds
    constants["MODEL_SUBSTEPS"] = 8  # those of `cstr.step`
    return SimpleNamespace(**constants, ode=ode, goal_error=cstr.goal_error)


class Oracle(literal.IpoptMPC):
    """The problem over a whole episode; the plan is replayed on the plant, so that its figures are those of a controller's row."""

    def __init__(self, steps, compile):
        plant, price = known_plant(), np.repeat([1.0, 0.0], [N_X, N_PSI])  # times the weight
        stage = literal.gaussian(plant, cstr.METRIC_SIGMA2)
        options = dict(goal=cstr.EVAL_GOAL, slack_price=price, compile=compile)
        super().__init__(plant, steps, cstr.PSI_NOMINAL[None], stage, **options)

    def build_problem(self, *costs):
        """The price of slack is a parameter: a problem serves every weight."""
        problem, limits = super().build_problem(*costs)
        weight, at = ca.MX.sym("weight"), self.at["slack"]  # (bounds, steps)
        slack = ca.reshape(problem["x"][at.ravel("F").tolist()], *at.shape)
        cost = ca.sum2(ca.DM(self.x_scale[np.concatenate(self.priced)]).T @ slack)
        changed = {"f": problem["f"] + (weight - 1) * cost, "p": ca.vertcat(problem["p"], weight)}
        return problem | changed, limits

    def optimum(self, x0, psi, weight, guess):
        """Actions (steps, n_u) that one solve from the actions `guess`, or from the held state (None), ends with; None if it fails."""
        start, solver = np.append(x0, psi), self.solvers["cold"]
        w = self.held(start) if guess is None else self.tree_guess(start, lambda t, x: guess[t])
        parameters = np.concatenate([start, self.u_before, self.goals.ravel("F"), [weight]])
        result = solver(x0=w, p=parameters, **self.limits)
        self.objective = float(result["f"])
        if not solver.stats()["success"] or not np.isfinite(self.objective):
            return None
        return self.planned(np.array(result["x"]).ravel())[1]


@functools.cache
def oracle(steps):
    return Oracle(steps, compile=steps > 3)


def measure(x0, psi, u):
    """Time near goal, time outside constraints and slack of the plant under the actions u."""
    x = [x0]
    for action in u:
        x.append(cstr.step(x[-1], np.clip(action, cstr.U_LOW, cstr.U_HIGH), psi))
    x = np.array(x)
    near = envs.time_near_goal(cstr, x[1:, cstr.GOAL_INDEX], cstr.EVAL_GOAL)
    return near, envs.outside_constraints(cstr, x[1:]).sum(), loops.slack(x)


def best(cell):
    """A row per weight: the best solution of one draw over all guesses."""
    episode, seed, steps, weights, guesses = cell
    x0, psi = (found[episode] for found in draws(cstr, episode + 1, seed))
    guesses = {label: np.array(u) for label, u in guesses} | {"held state": None}
    known = {}  # weight: its best solution
    solves = {weight: [] for weight in weights}  # objective of every solve, None if it failed

    def improve(weight, guesses):
        for label, guess in guesses.items():
            u = oracle(steps).optimum(x0, psi, weight, guess)
            solves[weight].append(None)
            if u is not None:
                near, outside, slack = measure(x0, psi, u)
                solves[weight][-1] = objective = near - weight * slack
                if weight not in known or objective > known[weight][0]:
                    known[weight] = objective, near, outside, slack, label, u

    for weight in weights:
        improve(weight, guesses)
    for order in (weights, weights[::-1]):  # what is good at one weight is a guess for the next
        for before, weight in zip(order, order[1:]):
            if before in known:
                improve(weight, {f"solution for weight {before:g}": known[before][-1]})
    rows = []
    for weight in weights:
        if weight not in known:  # no solve succeeded: the best guess
            candidates = {label: measure(x0, psi, u) for label, u in guesses.items() if u is not None}
            label = max(candidates, key=lambda name: candidates[name][0] - weight * candidates[name][2])
            near, outside, slack = candidates[label]
            known[weight] = near - weight * slack, near, outside, slack, f"{label}, not solved", None
        objective, near, outside, slack, label, _ = known[weight]
        found = [value for value in solves[weight] if value is not None]
        row = {"weight": weight, "seed": seed, "episode": episode, "time_near_goal": near}
        row |= {
            "time_outside_constraints": outside,
            "slack": slack,
            "objective": objective,
            "found_from": label,
        }
        row |= {"solves": len(solves[weight]), "failed": len(solves[weight]) - len(found)}
        rows.append(rounded(row | {"agree": sum(value > objective - 1e-2 for value in found)}, 6))
    return rows


def collect(args):
    """The oracle's rows and those of every controller."""
    episodes, steps = (2, 3) if args.quick else (args.episodes, 100)
    controllers = loops.collect(STUDIES["deploy"], args)  # found in args.runs if deploy.py has run
    oracle(steps)  # compiled before the processes fork
    jobs = []
    for episode in range(episodes):
        mine = select(controllers, episode=episode)
        guesses = tuple((row["variant"], json.loads(row["actions"])) for row in mine)
        jobs.append((episode, args.seed, steps, FRONTIER if episode < FRONTIER_DRAWS else (WEIGHT,), guesses))
    found = common.collect(best, jobs, args.runs, args.jobs, uses=[loops, literal])
    return found, loops.table(controllers)


def gaps(found, controllers):
    """A row per controller: medians and extremes of its gaps over the oracle's draws."""
    rows, at_best = [], {row["episode"]: row for row in select(found, weight=WEIGHT)}
    for label, mine in grouped(controllers, "variant").items():
        mine = [row for row in mine if row["episode"] in at_best]
        there = [at_best[row["episode"]] for row in mine]
        keys = ("time_near_goal", "time_outside_constraints", "slack")
        near, outside, slack = (column(there, key) - column(mine, key) for key in keys)
        objective = near - WEIGHT * slack
        row = {"variant": label, "draws": len(mine)}
        for name, gap in (("near", near), ("outside", outside), ("objective", objective)):
            row |= {f"{name}_median_gap": np.median(gap), f"{name}_p95_gap": np.quantile(gap, 0.95)}
        row |= {"objective_worst_gap": objective.max(), "objective_least_gap": objective.min()}
        rows.append(rounded(row | {"negative": int((objective < -1e-2).sum())}, 4))
    return rows


def check_goal(found, controllers):
    """The goal that the repository sets itself, line by line, for RL+MPC at N = 5."""
    (near, near_low), (outside, outside_low) = summary(select(controllers, variant=DEFAULT))
    (best, best_low), (kept, kept_low) = summary(select(found, weight=WEIGHT))
    lines = [
        ("near goal, median, of the oracle's: 97 % wanted", 100 * near / best, 97.0),
        ("near goal, 5th percentile, of the oracle's: 90 % wanted", 100 * near_low / best_low, 90.0),
        ("outside, median, less the oracle's: -0.5 at least", outside - kept, -0.5),
        ("outside, 5th percentile, less the oracle's: -5 at least", outside_low - kept_low, -5.0),
    ]
    for benchmark in ("robust MPC, N = 20", "robust MPC, tuned"):
        (other, other_low), (bounds, bounds_low) = summary(select(controllers, variant=benchmark))
        lines += [
            (f"near goal, median, less that of {benchmark}", near - other, 0.0),
            ("the same, 5th percentile", near_low - other_low, 0.0),
            (f"outside, median, less that of {benchmark}", outside - bounds, -0.05),
            ("the same, 5th percentile", outside_low - bounds_low, 0.0),
        ]
    print(f"\n{DEFAULT}, {len(distinct(controllers, 'episode'))} draws")
    for text, value, wanted in lines:
        print(f"  {text:68s}{value:9.2f}  {'reached' if value >= wanted else 'not reached'}")


def print_oracle(rows):
    print("the oracle          time near goal                  time outside constraints        solves")
    print("slack weight  draws   median 5 %-ile   worst   median 5 %-ile   worst    mean   failed, of")
    for weight, mine in grouped(rows, "weight").items():
        columns = ("time_near_goal", "time_outside_constraints", "failed", "solves")
        near, outside, failed, solves = (column(mine, key) for key in columns)
        found = ((np.median(v), np.quantile(v, 0.05), v.min()) for v in (near, outside))
        text = "".join("{:9.1f}{:8.1f}{:8.1f}".format(*numbers) for numbers in found)
        text += f"{outside.mean():8.1f}{failed.sum():8.0f}, {solves.sum():.0f}"
        print(f"{float(weight):12g}{len(mine):7d}{text}")


def print_gaps(rows):
    print(
        f"\ngap to the oracle of slack weight {WEIGHT:g}: medians over draws, of the objective also 95th percentile and worst;"
    )
    print("negative: the controller was better")
    keys = ("near_median", "outside_median", "objective_median", "objective_p95", "objective_worst")
    for row in rows:
        gap = [float(row[f"{key}_gap"]) for key in keys]
        numbers = "near {:7.2f}  outside {:7.2f}  objective {:8.2f}{:10.1f}{:10.1f}".format(*gap)
        print(f"{row['variant']:48s}{numbers}  negative {row['negative']} of {row['draws']}")


def main(args):
    common.check(args, "cstr_oracle", episodes=(1, 10**6))
    if not args.table("cstr_deploy").exists():
        table = args.table("cstr_deploy")
        common.fail(f"{table} does not exist; run python experiments/reactor/deploy.py first")
    if not args.plot_only:
        found, controllers = collect(args)
        common.write(found, args.table("cstr_oracle"))
        common.write(gaps(found, controllers), args.table("cstr_oracle_gap"))
    rows, controllers = common.read(args.table("cstr_oracle")), common.read(args.table("cstr_deploy"))
    solved = set(distinct(rows, "episode"))
    controllers = [row for row in controllers if row["episode"] in solved]
    print_oracle(rows)
    print_gaps(common.read(args.table("cstr_oracle_gap")))
    check_goal(rows, controllers)
    later = [[row for row in part if int(row["episode"]) >= UNSEEN] for part in (rows, controllers)]
    if later[0]:  # without the draws on which the setting was found
        check_goal(*later)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
