"""How far each controller of the reactor is from the best possible: one optimal control problem over the whole episode for each draw.

    python experiments/reactor/deploy.py --jobs 2      # first: the controllers, whose trajectories are guesses
    python experiments/reactor/oracle.py --jobs 2      # twenty minutes; continues where it stopped
    python experiments/reactor/oracle.py --plot-only   # print the tables from the committed CSV

The oracle knows the plant's parameters and the whole episode, and maximises the evaluation's own time near goal minus a slack penalty of 1
or 5 per mol/l or degC and step (on the first 50 draws 0.3 to 100, for the frontier). The problem has local optima: it is solved from
the trajectory of every controller, from a held state, and from the solutions for the neighbouring weights, and the best of these solves is
kept.

Writes results/cstr_oracle.csv (a row per weight and draw) and cstr_oracle_gap.csv (a row per weight and controller): the gap of a
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
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import rl_mpc_deploy as deploy
from envs import cstr
from experiments import common as cells
from experiments.common import HERE
from experiments.reactor import literal, loops
from experiments.reactor.deploy import STUDIES, summary

WEIGHTS, FRONTIER = (1.0, 5.0), (0.3, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0)
FRONTIER_DRAWS = 50
UNSEEN = 50  # draws from here on took no part in the choice of the default's weights
N_X, N_PSI = len(cstr.X_LOW), len(cstr.PSI_NOMINAL)


@dataclass
class Args:
    episodes: int = 200
    """paired draws, as many as cstr_deploy.py had"""
    seed: int = 0
    """seed of the draws"""
    jobs: int = 2
    """processes"""
    quick: bool = False
    """2 draws of 3 steps: a smoke test"""
    plot_only: bool = False
    """print the tables of the CSV"""
    runs: Path = Path("runs/cstr_loops")
    """where finished parts of this script and of cstr_deploy.py are kept"""
    out: Path = HERE
    """folder whose results/ is written"""


def known_plant():
    """The reactor with its uncertain parameters as two constant states, so that one compiled problem serves every plant; and with the
    simulated plant's integration."""

    def ode(x, u, psi, xp=np):
        slope = cstr.ode(x[:N_X], u, x[N_X:], xp)
        return envs.stack(xp, [*(slope[i] for i in range(N_X)), *(0 * x[0] for _ in range(N_PSI))])

    wide = {"X_LOW": -np.inf, "X_HIGH": np.inf, "INIT_LOW": 0.0, "INIT_HIGH": 2.0}
    bounds = {name: np.append(getattr(cstr, name), np.full(N_PSI, value)) for name, value in wide.items()}
    bounds["MODEL_SUBSTEPS"] = 8  # those of `cstr.step`
    return SimpleNamespace(
        **{k: v for k, v in vars(cstr).items() if k.isupper()} | bounds, ode=ode, goal_error=cstr.goal_error
    )


class Oracle(literal.IpoptMPC):
    """The problem over a whole episode; the plan is replayed on the plant, so that its figures are those of a controller's row."""

    def __init__(self, steps, compile):
        price = np.repeat([1.0, 0.0], [N_X, N_PSI])  # times the weight
        stage = literal.gaussian(known_plant(), cstr.METRIC_SIGMA2)
        super().__init__(
            known_plant(),
            steps,
            cstr.PSI_NOMINAL[None],
            stage,
            goal=cstr.EVAL_GOAL,
            slack_price=price,
            compile=compile,
        )

    def build_problem(self, *costs):
        """The price of slack is a parameter: a problem serves every weight."""
        problem, limits = super().build_problem(*costs)
        weight, at = ca.MX.sym("weight"), self.at["slack"]  # (bounds, steps)
        slack = ca.reshape(problem["x"][at.ravel("F").tolist()], *at.shape)
        cost = ca.sum2(ca.DM(self.x_scale[np.concatenate(self.priced)]).T @ slack)
        return problem | {
            "f": problem["f"] + (weight - 1) * cost,
            "p": ca.vertcat(problem["p"], weight),
        }, limits

    def optimum(self, x0, psi, weight, guess):
        """Actions (steps, n_u) that one solve from the actions `guess`, or from the held state (None), ends with; None if it fails."""
        start, solver = np.append(x0, psi), self.solvers["cold"]
        w = self.held(start) if guess is None else self.tree_guess(start, lambda t, x: guess[t])
        result = solver(
            x0=w, p=np.concatenate([start, self.u_before, self.goals.ravel("F"), [weight]]), **self.limits
        )
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
    x0, psi = (found[episode] for found in deploy.draws(cstr, episode + 1, seed))
    guesses, known = {label: np.array(u) for label, u in guesses} | {"held state": None}, {}

    def improve(weight, guesses):
        for label, guess in guesses.items():
            u = oracle(steps).optimum(x0, psi, weight, guess)
            rows.setdefault(weight, []).append(None)
            if u is not None:
                near, outside, slack = measure(x0, psi, u)
                rows[weight][-1] = objective = near - weight * slack
                if weight not in known or objective > known[weight][0]:
                    known[weight] = objective, near, outside, slack, label, u

    rows = {}
    for weight in weights:
        improve(weight, guesses)
    for order in (weights, weights[::-1]):  # what is good at one weight is a guess for the next
        for before, weight in zip(order, order[1:]):
            if before in known:
                improve(weight, {f"solution for weight {before:g}": known[before][-1]})
    result = []
    for weight in weights:
        if weight not in known:  # no solve succeeded: the best guess
            candidates = {label: measure(x0, psi, u) for label, u in guesses.items() if u is not None}
            label = max(candidates, key=lambda name: candidates[name][0] - weight * candidates[name][2])
            near, outside, slack = candidates[label]
            known[weight] = near - weight * slack, near, outside, slack, f"{label}, not solved", None
        objective, near, outside, slack, label, _ = known[weight]
        found = [value for value in rows[weight] if value is not None]
        figures = {
            "time_near_goal": near,
            "time_outside_constraints": outside,
            "slack": slack,
            "objective": objective,
        }
        result.append(
            {"weight": weight, "seed": seed, "episode": episode}
            | {key: round(float(value), 6) for key, value in figures.items()}
            | {
                "found_from": label,
                "solves": len(rows[weight]),
                "failed": len(rows[weight]) - len(found),
                "agree": sum(value > objective - 1e-2 for value in found),
            }
        )
    return result


def collect(args):
    """The oracle's rows and those of every controller."""
    episodes, steps = (2, 3) if args.quick else (args.episodes, 100)
    variants = STUDIES["deploy"]
    controllers = loops.collect(variants, args)  # found in args.runs if cstr_deploy.py has run
    oracle(steps)  # compiled before the processes fork
    jobs = []
    for episode in range(episodes):
        guesses = tuple(
            (row["variant"], json.loads(row["actions"]))
            for row in controllers
            if int(row["episode"]) == episode
        )
        jobs.append((episode, args.seed, steps, FRONTIER if episode < FRONTIER_DRAWS else WEIGHTS, guesses))
    return cells.collect(best, jobs, args.jobs, args.runs, [Path(__file__), *loops.INPUTS]), loops.table(
        controllers
    )


def gaps(found, controllers):
    """A row per weight and controller: medians and extremes of its gaps over the draws."""
    rows = []
    for weight in WEIGHTS:
        at_best = {int(row["episode"]): row for row in found if float(row["weight"]) == weight}
        for label in dict.fromkeys(row["variant"] for row in controllers):
            mine = [row for row in controllers if row["variant"] == label]
            gap = {}
            for key in ("time_near_goal", "time_outside_constraints", "slack"):
                gap[key] = np.array(
                    [float(at_best[int(row["episode"])][key]) - float(row[key]) for row in mine]
                )
            objective = gap["time_near_goal"] - weight * gap["slack"]
            near, outside = gap["time_near_goal"], gap["time_outside_constraints"]
            rows.append(
                {
                    "weight": weight,
                    "variant": label,
                    "draws": len(mine),
                    "near_median_gap": np.median(near),
                    "near_p95_gap": np.quantile(near, 0.95),
                    "outside_median_gap": np.median(outside),
                    "outside_p95_gap": np.quantile(outside, 0.95),
                    "objective_median_gap": np.median(objective),
                    "objective_p95_gap": np.quantile(objective, 0.95),
                    "objective_worst_gap": objective.max(),
                    "objective_least_gap": objective.min(),
                    "negative": int((objective < -1e-2).sum()),
                }
            )
    return [{k: round(float(v), 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows]


def check_goal(found, controllers, variant):
    """The goal that the repository sets itself, line by line, for one controller."""
    (near, near_low), (outside, outside_low) = summary(
        [row for row in controllers if row["variant"] == variant]
    )
    (best, best_low), (kept, kept_low) = summary([row for row in found if row["weight"] == "5.0"])
    lines = [
        ("near goal, median, of the oracle's (slack weight 5): 97 % wanted", 100 * near / best, 97.0),
        ("near goal, 5th percentile, of the oracle's: 90 % wanted", 100 * near_low / best_low, 90.0),
        ("outside, median, less the oracle's: -0.5 at least", outside - kept, -0.5),
        ("outside, 5th percentile, less the oracle's: -5 at least", outside_low - kept_low, -5.0),
    ]
    for benchmark in ("robust MPC, N = 20", "robust MPC, tuned"):
        (other, other_low), (bounds, bounds_low) = summary(
            [row for row in controllers if row["variant"] == benchmark]
        )
        lines += [
            (f"near goal, median, less that of {benchmark}", near - other, 0.0),
            ("the same, 5th percentile", near_low - other_low, 0.0),
        ]
        lines += [
            (f"outside, median, less that of {benchmark}", outside - bounds, -0.05),
            ("the same, 5th percentile", outside_low - bounds_low, 0.0),
        ]
    print(f"\n{variant}, {len({row['episode'] for row in controllers})} draws")
    for text, value, wanted in lines:
        print(f"  {text:68s}{value:9.2f}  {'reached' if value >= wanted else 'not reached'}")


def main(args):
    cells.check(args, "cstr_oracle.csv", episodes=(1, 10**6), seed=(0, 10**9), jobs=(1, 1024))
    if not (args.out / "results/cstr_deploy.csv").exists():
        cells.fail(
            f"{args.out / 'results/cstr_deploy.csv'} does not exist; run python experiments/reactor/deploy.py first"
        )
    table, gap_table = (args.out / f"results/{name}.csv" for name in ("cstr_oracle", "cstr_oracle_gap"))
    if not args.plot_only:
        found, controllers = collect(args)
        cells.write(found, table)
        cells.write(gaps(found, controllers), gap_table)
    rows = cells.read(table)
    print("the oracle          time near goal                  time outside constraints        solves")
    print("slack weight  draws   median 5 %-ile   worst   median 5 %-ile   worst    mean   failed, of")
    for weight in dict.fromkeys(row["weight"] for row in rows):
        mine = [row for row in rows if row["weight"] == weight]
        columns = ("time_near_goal", "time_outside_constraints", "failed", "solves")
        near, outside, failed, solves = (np.array([float(row[key]) for row in mine]) for key in columns)
        text = "".join(
            f"{np.median(v):9.1f}{np.quantile(v, 0.05):8.1f}{v.min():8.1f}" for v in (near, outside)
        )
        print(
            f"{float(weight):12g}{len(mine):7d}{text}{outside.mean():8.1f}{failed.sum():8.0f}, {solves.sum():.0f}"
        )
    print(
        "\ngap to the oracle: medians over draws, of the objective also 95th percentile and worst; negative: the controller was better"
    )
    for row in cells.read(gap_table):
        gap = [
            float(row[f"{key}_gap"])
            for key in (
                "near_median",
                "outside_median",
                "objective_median",
                "objective_p95",
                "objective_worst",
            )
        ]
        numbers = "near {:7.2f}  outside {:7.2f}  objective {:8.2f}{:10.1f}{:10.1f}".format(*gap)
        print(
            f"weight {row['weight']:4s} {row['variant']:42s} {numbers}  negative {row['negative']} of {row['draws']}"
        )
    controllers = cells.read(args.out / "results/cstr_deploy.csv")
    check_goal(rows, controllers, "RL+MPC, constraint-aware, N = 5")
    later = [[row for row in part if int(row["episode"]) >= UNSEEN] for part in (rows, controllers)]
    if later[0]:  # without the draws on which the setting was found
        check_goal(*later, "RL+MPC, constraint-aware, N = 5")


if __name__ == "__main__":
    cells.run(main, tyro.cli(Args, description=__doc__))
