"""Closed loops of the reactor study: what its scripts share.

A `Loop` names a controller and some of the paired draws; `run` gives a row for each of them. Rows hold the actions, too, so that the oracle
can start from them; `table` leaves them out.
"""

import copy
import functools
import json
from dataclasses import dataclass, field, replace

import numpy as np
import torch

import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr
from envs.control.expansion import expansion
from envs.script.comparison import draws, run_episode
from experiments import common
from experiments.common import PRETRAINED, rounded, without
from experiments.reactor import literal

ROBUST, CONSTRAINED = PRETRAINED / "cstr_robust.pt", PRETRAINED / "cstr_constrained.pt"
PAPER, AWARE = dict(critic=ROBUST), dict(critic=CONSTRAINED)
ACTOR, RL_MPC = dict(controllers=("actor",)), dict(controllers=("rl_mpc",))
BLOCK = 25  # draws per cell


@dataclass(frozen=True)
class Loop:
    """A controller (`settings.controllers[0]`) on the draws first ... stop - 1 of `settings.seed`."""

    variant: str
    """its name in tables"""
    settings: deploy.Args = field(repr=False)
    key: str
    """the settings, with the checkpoint's hash in place of its path: cells are told apart by their repr"""
    first: int
    stop: int
    like: str = ""
    """a key of KINDS, by IPOPT; literal: the authors' conventions, printed: eq:QMPC's sum; or "one start" """
    benchmark: tuple = ()
    """items that replace those of the plant's BENCHMARK"""
    shift: float | None = None
    """plants at the edge of the training box times this factor, in place of the evaluation's"""


def loops(variants, episodes, seed, quick=False):
    """Cells, block by block: `variants` are {label: keywords of deploy.Args and of Loop}. Quick: 2 draws of 3 steps, benchmarks of N = 3,
    not compiled."""
    own, found = ("like", "benchmark", "shift"), []
    episodes, steps = (2, 3) if quick else (episodes, 100)
    for first in range(0, episodes, BLOCK):
        for label, options in variants.items():
            options = {"horizon": 5, "seed": seed, "steps": steps, "jobs": 1, "compile": not quick} | options
            if quick:
                options["benchmark"] = (*options.get("benchmark", ()), ("horizon", 3))
            args = deploy.Args(**without(options, *own))
            key = f"{common.checksum(deploy.critic_path(args))} {replace(args, critic=None)}"
            kind = {name: options[name] for name in own if name in options}
            found.append(Loop(label, args, key, first, min(first + BLOCK, episodes), **kind))
    return found


# Controllers that the command line of rl_mpc_deploy.py does not make


class OneStart(deploy.ScenarioMPC):
    """Improves the shifted last plan alone: the actor gives the first guess of an episode, and none after it."""

    def first_guesses(self, x):
        found = super().first_guesses(x)
        return {"shifted": found["shifted"]} if "shifted" in found else found


KINDS = {"ipopt": literal.IpoptMPC, "literal": literal.LiteralMPC, "printed": literal.PrintedMPC}


def value_mpc(settings, kind=deploy.ScenarioMPC, scenarios=None):
    """RL+MPC as by deploy.build_controller, of another class or with another scenario set (S, n_psi)."""
    plant, goal, critic, _ = deploy.check(settings)
    mu, _, V = deploy.export(critic)
    price = critic.plan["slack_weight"] if settings.slack_weight is None else settings.slack_weight
    options = dict(slack_price=price, iterations=settings.iterations, compile=settings.compile)
    options |= dict(goal=goal, policy=mu, expansion=expansion(critic))
    scenarios = plant.SCENARIOS["mpc"] if scenarios is None else scenarios
    return kind(plant, settings.horizon, scenarios, literal.gaussian(plant), V, **options)


def benchmark_mpc(name, settings, replaced):
    """nominal_mpc or robust_mpc as by deploy.build_controller, with items in place of those of the plant's BENCHMARK."""
    plant, goal, _, estimator = deploy.check(settings)
    horizon, options = literal.benchmark(plant, name, deploy.scenario_set(plant, settings), replaced)
    options |= dict(goal=goal, estimator=estimator, iterations=settings.iterations, compile=settings.compile)
    scenarios, cost = deploy.scenario_set(plant, settings), literal.squared_error(plant)
    return deploy.ScenarioMPC(plant, horizon, scenarios, cost, **options)


@functools.cache
def controller(settings, like, benchmark):
    torch.set_num_threads(1)
    name = settings.controllers[0]
    if like in KINDS:
        return literal.build_controller(name, settings, KINDS[like], benchmark)
    if like:
        return value_mpc(settings, OneStart)
    if benchmark and name in ("nominal_mpc", "robust_mpc"):
        return benchmark_mpc(name, settings, benchmark)
    return deploy.build_controller(name, settings)


# Closed loops


class Recorder:
    """A controller that keeps the statistics of its steps."""

    def __init__(self, controller):
        self.controller, self.estimator, self.log = controller, controller.estimator, []

    def reset(self):
        self.controller.reset()

    def make_step(self, x0):
        u = self.controller.make_step(x0)
        self.stats = dict(self.controller.stats)
        self.log.append(self.stats | {"left": self.left()})
        return u

    def left(self):
        """Of every tenth plan of an SQP how much lower fifty more iterations bring its cost, as a share of it."""
        mpc, cost = copy.copy(self.controller), self.stats.get("cost")
        if not isinstance(mpc, deploy.ScenarioMPC) or cost is None or len(self.log) % 10:
            return np.nan
        mpc.iterations, mpc.stats = 50, dict(self.stats)
        return (cost - mpc.improve(mpc.plan, cost, None)[1]) / abs(cost)

    def counts(self):
        """Steps whose quadratic program was unsolved, or IPOPT's first solve; steps that ended at the limit of iterations; and the largest
        `left`, 0 where nothing is known of it."""
        unsolved = (s.get("stop") == "unsolved" or not s.get("success", True) for s in self.log)
        limit = (s.get("stop") == "limit" for s in self.log)
        left = (s["left"] for s in self.log if s["left"] >= 0)
        return {"unsolved": sum(unsolved), "limit": sum(limit), "left": max(left, default=0.0)}


def shifted_plants(episodes, seed, factor):
    """Plants whose (alpha, beta) lie on the edge of the training box blown up by `factor` about its centre, (episodes, 2); a draw keeps its
    direction whatever the factor."""
    half, found = cstr.SCENARIOS["robust"].max(0) - cstr.PSI_NOMINAL, []
    for episode in range(episodes):
        direction = np.random.default_rng([seed, 4, episode]).uniform(-1, 1, size=2)
        found.append(cstr.PSI_NOMINAL + factor * direction / np.abs(direction).max() * half)
    return np.array(found)


def paired_draws(loop):
    """Start states and plants of a loop and of all draws before it."""
    starts, psi = draws(cstr, loop.stop, loop.settings.seed)
    if loop.shift is not None:
        psi = shifted_plants(loop.stop, loop.settings.seed, loop.shift)
    return starts, psi


def slack(x):
    """Sum of violations over x_1 ... x_T, physical units (mol/l and degC added up), of a trajectory (T + 1, n_x)."""
    return np.abs(x - np.clip(x, cstr.X_LOW, cstr.X_HIGH))[1:].sum()


def slack_weight(mpc):
    """Price of a concentration below its bound, mol/l; infinite: a hard bound."""
    if isinstance(mpc, gm.ScenarioMPC):
        return float(mpc.slack_price[0, 0])
    price = mpc.slack_price[0, 0] / mpc.x_scale[0] if isinstance(mpc, deploy.ScenarioMPC) else 0.0
    return round(float(price), 6)


def run(loop):
    """A row per draw: labels, the metrics of rl_mpc_deploy.py, `Recorder.counts`, `slack`, and the actions as JSON."""
    args, mpc = loop.settings, controller(loop.settings, loop.like, loop.benchmark)
    critic, (starts, psi) = deploy.critic_path(args), paired_draws(loop)
    head = {
        "variant": loop.variant,
        "controller": args.controllers[0],
        "horizon": mpc.horizon or 0,
        "slack_weight": slack_weight(mpc),
        "critic": critic.stem if critic.parent == PRETRAINED else critic.parent.name,
        "seed": args.seed,
    }
    rows, goal = [], np.array(args.goal or cstr.EVAL_GOAL)
    for episode in range(loop.first, loop.stop):
        recorder = Recorder(mpc)
        x, u, row = run_episode(recorder, cstr, starts[episode], psi[episode], goal, args.steps)
        drawn = {"episode": episode, "psi": json.dumps(psi[episode].tolist())}
        row = rounded(row | recorder.counts() | {"slack": slack(x)}, 6)
        rows.append(head | drawn | row | {"actions": json.dumps(u.tolist())})
    return rows


def collect(variants, args, episodes=None, seed=None):
    """Rows of every variant, variant by variant, each finished block kept under `args.runs`."""
    episodes, seed = episodes or args.episodes, args.seed if seed is None else seed
    cells = loops(variants, episodes, seed, args.quick)
    rows = common.collect(run, cells, args.runs, args.jobs, uses=[literal])
    return [row for label in variants for row in rows if row["variant"] == label]


def table(rows):
    """Rows for a committed table."""
    return [without(row, "actions") for row in rows]


def train(agents, args):
    """Checkpoints of agents of sac_her_branching.py, dictionaries of its arguments."""
    few = dict(total_timesteps=2000) if args.quick else {}
    folders = common.train([few | agent for agent in agents], args.runs, args.jobs)
    return [folder / "checkpoint.pt" for folder in folders]


def replay(row):
    """States (T + 1, n_x) of a closed loop, from its actions."""
    episode, psi = int(row["episode"]), np.array(json.loads(row["psi"]))
    x = [draws(cstr, episode + 1, int(row["seed"]))[0][episode]]
    for u in json.loads(row["actions"]):
        x.append(cstr.step(x[-1], np.array(u), psi))
    return np.array(x)
