"""Closed loops of the reactor study: what its scripts share.

A `Loop` names a controller and some of the paired draws; `run` gives a row for each of them. Rows hold the actions, too, so that the oracle
can start from them; `table` leaves them out.
"""

import functools
import hashlib
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import torch

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr
from envs.control.expansion import expansion
from experiments import common as cells
from experiments.common import HERE, ROOT
from experiments.reactor import literal

ROBUST, CONSTRAINED = (HERE / f"pretrained/cstr_{kind}.pt" for kind in ("robust", "constrained"))
# what rows depend on, read when it is imported: an edit while loops run does not file old results under new code
INPUTS = [
    Path(module.__file__).read_bytes() for module in (sys.modules[__name__], literal, deploy, gm, envs, cstr)
]
BLOCK = 25  # draws per cell


class OneStart(deploy.ScenarioMPC):
    """Improves the shifted last plan alone: the actor gives the first guess of an episode, and none after it."""

    def _guesses(self, x):
        found = super()._guesses(x)
        return {"shifted": found["shifted"]} if "shifted" in found else found


KINDS = {"ipopt": literal.IpoptMPC, "literal": literal.LiteralMPC, "printed": literal.PrintedMPC}


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


@functools.cache
def checksum(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]


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
            args = deploy.Args(**{k: v for k, v in options.items() if k not in own})
            key = f"{checksum(deploy.critic_path(args))} {replace(args, critic=None)}"
            stop = min(first + BLOCK, episodes)
            found.append(
                Loop(label, args, key, first, stop, **{k: v for k, v in options.items() if k in own})
            )
    return found


def one_start(settings):
    """RL+MPC whose planner is a `OneStart`."""
    plant, goal, critic = deploy.check(settings)
    mu, _, V = deploy.export(critic)
    options = dict(
        slack_price=settings.slack_weight, iterations=settings.iterations, compile=settings.compile
    )
    options |= dict(goal=goal, policy=mu, expansion=expansion(critic))
    return OneStart(plant, settings.horizon, plant.SCENARIOS["mpc"], literal.gaussian(plant), V, **options)


@functools.cache
def controller(settings, like, benchmark):
    torch.set_num_threads(1)
    name, replaced = (
        settings.controllers[0],
        {key: np.array(value) if isinstance(value, tuple) else value for key, value in benchmark},
    )
    with mock.patch.dict(cstr.BENCHMARK, replaced):
        if like in KINDS:
            return literal.build_controller(name, settings, KINDS[like])
        return one_start(settings) if like else deploy.build_controller(name, settings)


class Recorder:
    """A controller that keeps the statistics of its steps."""

    def __init__(self, controller):
        self.controller, self.log = controller, []

    def reset(self):
        self.controller.reset()

    def make_step(self, x0):
        u = self.controller.make_step(x0)
        self.stats = dict(self.controller.stats)
        self.log.append(self.stats | {"left": self.left()})
        return u

    def left(self):
        """Of every tenth plan of an SQP how much lower fifty more iterations bring its cost, as a share of it."""
        mpc, cost = self.controller, self.stats.get("cost")
        if not isinstance(mpc, deploy.ScenarioMPC) or cost is None or len(self.log) % 10:
            return np.nan
        iterations, mpc.iterations = mpc.iterations, 50
        lower = mpc.improve(mpc.plan, cost, None)[1]
        mpc.iterations, mpc.stats = iterations, self.stats
        return (cost - lower) / abs(cost)

    def counts(self):
        """Steps whose quadratic program was unsolved, or IPOPT's first solve; steps that ended at the limit of iterations; and the largest
        `left`, 0 where nothing is known of it."""
        return {
            "unsolved": sum(
                stats.get("stop") == "unsolved" or not stats.get("success", True) for stats in self.log
            ),
            "limit": sum(stats.get("stop") == "limit" for stats in self.log),
            "left": max((stats["left"] for stats in self.log if stats["left"] >= 0), default=0.0),
        }


def shifted_plants(episodes, seed, factor):
    """Plants whose (alpha, beta) lie on the edge of the training box blown up by `factor` about its centre, (episodes, 2); a draw keeps its
    direction whatever the factor."""
    found = []
    for episode in range(episodes):
        direction = np.random.default_rng([seed, 4, episode]).uniform(-1, 1, size=2)
        found.append(
            cstr.PSI_NOMINAL
            + factor
            * direction
            / np.abs(direction).max()
            * (cstr.SCENARIOS["robust"].max(0) - cstr.PSI_NOMINAL)
        )
    return np.array(found)


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
    starts, psi = deploy.draws(cstr, loop.stop, args.seed)
    if loop.shift is not None:
        psi = shifted_plants(loop.stop, args.seed, loop.shift)
    critic = deploy.critic_path(args)
    head = {
        "variant": loop.variant,
        "controller": args.controllers[0],
        "horizon": mpc.horizon or 0,
        "slack_weight": slack_weight(mpc),
        "critic": critic.stem if critic.parent == ROBUST.parent else critic.parent.name,
        "seed": args.seed,
    }
    rows = []
    for episode in range(loop.first, loop.stop):
        recorder = Recorder(mpc)
        x, u, row = deploy.run_episode(
            recorder, cstr, starts[episode], psi[episode], np.array(args.goal or cstr.EVAL_GOAL), args.steps
        )
        row |= recorder.counts() | {"slack": slack(x)}
        row = {k: round(float(v), 6) if isinstance(v, float) else v for k, v in row.items()}
        rows.append(
            head
            | {"episode": episode, "psi": json.dumps(psi[episode].tolist())}
            | row
            | {"actions": json.dumps(u.tolist())}
        )
    return rows


def collect(variants, args, episodes=None, seed=None):
    """Rows of every variant, variant by variant, each finished block kept under `args.runs`."""
    episodes, seed = episodes or args.episodes, args.seed if seed is None else seed
    rows = cells.collect(run, loops(variants, episodes, seed, args.quick), args.jobs, args.runs, INPUTS)
    return [row for label in variants for row in rows if row["variant"] == label]


def table(rows):
    """Rows for a committed table."""
    return [{k: v for k, v in row.items() if k != "actions"} for row in rows]


def train(agents, args):
    """Checkpoints of agents (seed, argument, argument, ...) of sac_her_branching.py on the reactor; only missing ones are trained."""
    code = [ROOT / name for name in ("sac_her_branching.py", "envs/__init__.py", "envs/cstr.py")]

    def one(agent):
        seed, *flags = map(str, agent)
        named = [
            flag.name if isinstance(flag, Path) else str(flag) for flag in agent[1:]
        ]  # the same wherever the files lie
        version = hashlib.sha256(
            b"".join(path.read_bytes() for path in code) + repr((named, args.quick)).encode()
        ).hexdigest()[:8]
        final = args.runs / f"agents/{version}_{seed}"
        if not (final / "checkpoint.pt").exists():
            command = [
                sys.executable,
                str(ROOT / "sac_her_branching.py"),
                "--seed",
                seed,
                "--eval-every",
                "0",
                "--save-every",
                "0",
            ]
            command += [
                "--out",
                str(final / "run"),
                *(["--total-timesteps", "2000"] if args.quick else []),
                *flags,
            ]
            subprocess.run(
                command, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
            )
            max(final.glob("run/*/checkpoint.pt"), key=lambda path: path.stat().st_mtime).replace(
                final / "checkpoint.pt"
            )
        return final / "checkpoint.pt"

    with ThreadPoolExecutor(args.jobs) as pool:
        return list(tqdm(pool.map(one, agents), total=len(agents), unit="agent", disable=None))


def replay(row):
    """States (T + 1, n_x) of a closed loop, from its actions."""
    x, psi = (
        [deploy.draws(cstr, int(row["episode"]) + 1, int(row["seed"]))[0][int(row["episode"])]],
        np.array(json.loads(row["psi"])),
    )
    for u in json.loads(row["actions"]):
        x.append(cstr.step(x[-1], np.array(u), psi))
    return np.array(x)


def values(rows, variant, key):
    return np.array([float(row[key]) for row in rows if row["variant"] == variant])
