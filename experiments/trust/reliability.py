"""What happens when things go wrong, counted: faults in closed loops, killed trainings, hostile checkpoints, many deployments, two runs.

    python experiments/trust/reliability.py --study controllers      # or training, checkpoints, deployments, determinism

controllers: closed loops over random starts, goals and plants, and the same with a fault at every fourth step: numbers that are not
finite in the measurement or in the previous plan, states far outside the box, a solver stopped after one iteration (goal_mpc.py: three) or
by a deadline, goals that cannot be held. An action must be finite and within its limits, a measurement that is none must be refused, or by
a filter left out, a plan must cost no more than its first guess, and the next step without a fault must be planned again.
training: SIGKILL at random moments, then --resume; the end must equal an uninterrupted run, bit for bit.
checkpoints: damaged and malicious files; each must be refused in one sentence or, where the damage is not to be seen, load as finite
numbers.
deployments: 1,000 in one process; memory must not grow.
determinism: the whole reproduction on tiny budgets, twice, with one and with two processes in every step; tables must be the same but for
times.

Writes results/reliability_STUDY.csv, a row per case.
"""

import collections
import io
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
import sac_her_branching as sac
from envs.agents.checkpoint import MAX_CHECKPOINT_BYTES
from envs.control.expansion import torch_value
from experiments import common, reproduce
from experiments.common import ROOT, without

EPISODE = 25  # steps
CONTROLLERS = {  # arguments of goal_mpc.py, or name and arguments of rl_mpc_deploy.py
    "RL+MPC, N = 5": ("rl_mpc", deploy.Args()),
    "RL+MPC, offset-free": ("rl_mpc", deploy.Args(offset_free=True)),
    "RL+MPC, N = 0": ("rl_mpc", deploy.Args(horizon=0)),
    "RL+MPC, linear, n = 32": ("rl_mpc", deploy.Args(env="linear", horizon=3)),
    "actor": ("actor", deploy.Args()),
    "nominal MPC": ("nominal_mpc", deploy.Args()),
    "robust MPC": ("robust_mpc", deploy.Args()),
    "goal_mpc.py, reactor": gm.Args(env="cstr", horizon=10, robust_horizon=1),
    "goal_mpc.py, pendulum": gm.Args(horizon=20),
}
PLANS = [name for name in CONTROLLERS if name not in ("actor", "RL+MPC, N = 0")]  # have a solver and a plan
ANYTIME = [name for name in PLANS if not name.startswith("goal_mpc.py")]
FAULTS = {  # case: controllers that it can befall
    "random": list(CONTROLLERS),
    "plan not finite": PLANS,
    "measurement not finite": list(CONTROLLERS),
    "state far outside": list(CONTROLLERS),
    "deadline": ANYTIME,
    "stopped early": PLANS,
    "stopped early, always": PLANS,
    "goal out of reach": list(CONTROLLERS),
}
LASTING = ("goal out of reach", "stopped early, always")  # not at single steps
ANSWERS = {
    "solved": "planned",
    "retry": "planned",
    "plan": "fell_back",
    "hold": "held",
}  # rungs of goal_mpc.py
STEPS = {("random", "RL+MPC, N = 5"): 10_000, ("random", "actor"): 10_000}  # of the others 500
CELL = 500  # steps
COUNTS = "faults refused wrong cost_rose chances recovered planned fell_back held qp_unsolved".split()
# columns that may differ from run to run
TIMES = re.compile(r"(^|_)(ms|seconds)(_|$)|^(jobs|machine|ratio_\w+|peer_versions)$")


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    study: Literal["controllers", "training", "checkpoints", "deployments", "determinism"] = "controllers"
    """what to break"""


# Closed loops


class Hasty(gm.ScenarioMPC):
    """goal_mpc.py's controller with a second pair of solvers, which stop after three iterations: they solve while `early` is set."""

    early = False

    def build_solvers(self, compile, options):
        usual = super().build_solvers(compile, options)
        early = super().build_solvers(compile, options | {"max_iter": 3})
        return usual | {f"early {name}": solver for name, solver in early.items()}

    def solve(self, which, *arguments):
        return super().solve(f"early {which}" if self.early else which, *arguments)


@cache
def built(name):
    torch.set_num_threads(1)
    settings = CONTROLLERS[name]
    if isinstance(settings, gm.Args):
        return gm.build_controller(settings, Hasty)
    return deploy.build_controller(*settings)


def draw(plant, rng):
    """Start state, goal and plant parameters."""
    psi = rng.uniform(plant.EVAL_PSI.min(axis=0), plant.EVAL_PSI.max(axis=0))
    goal = rng.uniform(plant.GOAL_LOW, plant.GOAL_HIGH)
    return rng.uniform(plant.INIT_LOW, plant.INIT_HIGH), goal, psi


def out_of_reach(controller, goal, rng):
    """A goal that not every scenario can hold."""
    low, high = controller.plant.GOAL_LOW, controller.plant.GOAL_HIGH
    while envs.can_hold(controller.plant, goal):
        goal = rng.uniform(low, high)
    return goal


def spoil(controller, case, x, rng):
    """Bring the fault about; returns what is measured."""
    if case == "measurement not finite":
        bad = rng.uniform(size=x.shape) < 0.5
        bad[rng.integers(len(x))] = True
        return np.where(bad, rng.choice([np.nan, np.inf, -np.inf]), x)
    if case == "state far outside":
        reach, width = 10.0 ** rng.uniform(1, 12), controller.plant.INIT_HIGH - controller.plant.INIT_LOW
        return x + reach * rng.uniform(-1, 1, size=x.shape) * width
    if case == "plan not finite" and controller.plan is not None:
        if isinstance(controller.plan, tuple):  # goal_mpc.py: with multipliers of bounds and of constraints
            plan = controller.plan[0].copy()
            controller.plan = plan, *controller.plan[1:]
        else:
            plan = controller.plan = controller.plan.copy()
        plan[rng.uniform(size=plan.shape) < 0.1] = np.nan
        plan.flat[0] = np.nan
    return x


def stop(controller, case):
    """Bring a fault of the solver about, or with case None take it back."""
    early = case is not None and case.startswith("stopped early")
    if isinstance(controller, Hasty):
        controller.early = early
    elif isinstance(controller, deploy.ScenarioMPC):
        controller.iterations = 1 if early else deploy.Args.iterations
        controller.deadline_ms = 1e-3 if case == "deadline" else None


def answered(controller):
    """What the last action came from: planned, fell_back or held. Of a controller that does not plan its usual action counts as planned."""
    stats = controller.stats
    if isinstance(controller, gm.ScenarioMPC):
        return ANSWERS[stats["rung"]]
    return "held" if stats["rung"] == "hold" else "fell_back" if stats["fell_back"] else "planned"


def closed_loop(cell):
    """One case of one controller: the counts that are a row of the table."""
    case, name, steps, seed, _ = cell  # and its critic's checksum: a new critic is a new cell
    controller, lasting = built(name), case in LASTING
    plant, rng = controller.plant, np.random.default_rng([seed, *case.encode(), *name.encode()])
    counts = collections.Counter({key: 0 for key in COUNTS})

    def chance():
        counts.update(chances=1, recovered=int(answered(controller) == "planned"))

    for _ in range(max(steps // EPISODE, 1)):
        x, goal, psi = draw(plant, rng)
        goal = out_of_reach(controller, goal, rng) if case == "goal out of reach" else goal
        stop(controller, case if lasting else None)
        controller.reset()
        controller.set_goal(goal)
        faulty_before = False
        for t in range(min(EPISODE, steps)):
            faulty = case != "random" and t % 4 == 2 and not lasting
            measured = spoil(controller, case, x, rng) if faulty else x
            if not lasting:
                stop(controller, case if faulty else None)
            counts["faults"] += faulty or lasting
            try:
                u = controller.make_step(measured)
            except ValueError as error:
                if np.isfinite(measured).all() or "finite" not in str(error):
                    raise
                counts["refused"] += 1
                u = controller.make_step(x)  # the true state, as the next message may bring it
                chance()
            else:
                missing, left_out = not np.isfinite(measured).all(), bool(controller.stats.get("rejected"))
                counts.update(refused=missing and left_out, wrong=missing and not left_out)
                if faulty_before:
                    chance()
                faulty_before = faulty
            stats = controller.stats
            counts[answered(controller)] += 1
            counts["cost_rose"] += not stats.get("cost", 0.0) <= stats.get("guess_cost", np.inf)  # nor is nan
            counts["qp_unsolved"] += stats.get("stop") == "unsolved"
            allowed = np.isfinite(u).all() and (plant.U_LOW <= u).all() and (u <= plant.U_HIGH).all()
            counts["wrong"] += not allowed
            x = plant.step(x, u, psi)
        if lasting:  # a last step without it
            stop(controller, None)
            controller.set_goal(plant.EVAL_GOAL)
            controller.make_step(x)
            chance()
    stop(controller, None)
    total = sum(counts[key] for key in ("planned", "fell_back", "held"))
    return [{"case": case, "controller": name, "steps": total} | dict(counts)]


def controllers(args):
    rounds = []
    for name, settings in CONTROLLERS.items():  # in order, so that few processes build and compile the same
        critic = "" if isinstance(settings, gm.Args) else common.checksum(deploy.critic_path(settings[1]))
        for case in (case for case in FAULTS if name in FAULTS[case]):
            steps = 10 if args.quick else STEPS.get((case, name), CELL)
            parts = range(max(steps // CELL, 1))
            rounds += [(case, name, min(steps, CELL), seed, critic) for seed in parts]
    total = {}
    for row in common.collect(closed_loop, rounds, args.runs, args.jobs):
        counts = total.setdefault((row["case"], row["controller"]), collections.Counter())
        counts.update({key: int(value) for key, value in without(row, "case", "controller").items()})
    rows = [(case, name) for case in FAULTS for name in FAULTS[case]]
    return [{"case": case, "controller": name} | dict(total[case, name]) for case, name in rows]


# Training


TRAINING = "--env cstr --hidden 16 16 --total-timesteps 19200 --learning-starts 320 --eval-every 1600".split()
TRAINING += "--eval-episodes 20 --save-every 160 --buffer-size 3200".split()


def train(*arguments, kill_after=None):
    """The training script in a process of its own, killed after some seconds unless it has finished. Returns whether it finished."""
    command = [sys.executable, "sac_her_branching.py", *map(str, arguments)]
    options = dict(cwd=ROOT, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    process = subprocess.Popen(command, **options)
    try:
        _, error = process.communicate(timeout=kill_after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return False
    if process.returncode:
        raise RuntimeError(error)
    return True


def equal(a, b):
    """Whether nested plain data and tensors are the same, bit for bit, but for times and folders."""
    if isinstance(a, dict):
        kept = [key for key in a if key not in ("seconds", "train_seconds", "out")]
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in kept)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return torch.equal(a, b) if torch.is_tensor(a) else a == b or (a != a and b != b)


def killed(cell):
    """Trainings killed at random moments, until so many kills have come about; each end is compared with that of one that was not."""
    branches, kills, seed = cell
    rng = np.random.default_rng(seed)
    counts = collections.Counter(kills=0, half=0, mid_write=0, ends=0, same=0)
    with tempfile.TemporaryDirectory() as folder:
        untouched, runs = Path(folder) / "whole", Path(folder) / "killed"
        start = [*TRAINING, "--branches", branches, "--seed", seed, "--out"]
        tick = time.perf_counter()
        train(*start, untouched)
        seconds = time.perf_counter() - tick
        while counts["kills"] < kills:
            shutil.rmtree(runs, ignore_errors=True)
            finished = False
            while not finished:
                saved = list(runs.glob("*/resume.pt"))
                arguments = ["--resume", saved[0]] if saved else [*start, runs]
                moment = rng.uniform(0.3, 0.9) * seconds if counts["kills"] < kills else None
                finished = train(*arguments, kill_after=moment)
                if not finished:
                    broken = not all(map(whole, runs.glob("*/*.pt")))
                    counts.update(kills=1, mid_write=int(any(runs.glob("*/*.tmp"))), half=int(broken))
            ends = [next(place.glob("*/resume.pt")).parent for place in (untouched, runs)]
            same = equal(*(without_times(end / "evaluations.csv") for end in ends))
            for name in ("resume.pt", "checkpoint.pt"):
                same = same and equal(*(torch.load(end / name, weights_only=True) for end in ends))
            counts.update(ends=1, same=int(same))
    return [{"branches": branches} | dict(counts)]


def whole(path):
    """Whether a file can be read."""
    try:
        torch.load(path, weights_only=True)
    except Exception:
        return False
    return True


def training(args):
    parts = [(branches, 1 if args.quick else 15, seed) for seed, branches in enumerate((1, 4))]
    found = common.collect(killed, parts, args.runs, args.jobs)
    keys = ("kills", "half", "mid_write", "ends", "same")
    kills, half, mid_write, ends, same = (sum(int(row[key]) for row in found) for key in keys)
    detail = f"{mid_write} of them while a file was written"
    return [
        result("training", "SIGKILL: what was saved is whole", kills, kills - half, detail),
        result("training", "killed and resumed: equal to an uninterrupted run", ends, same),
    ]


def result(study, case, trials, held, detail=""):
    return {"study": study, "case": case, "trials": trials, "held": held, "detail": detail}


def without_times(path):
    """A table without the columns that may differ from run to run."""
    return [{key: value for key, value in row.items() if not TIMES.search(key)} for row in common.read(path)]


# Checkpoints


class Code:
    def __reduce__(self):
        return print, ("code from a checkpoint was run",)


def hostile(data, rng, tries):
    """Pairs of a name and the bytes of a file, made from a good checkpoint."""

    def stored(data):
        file = io.BytesIO()
        torch.save(data, file)
        return file.getvalue()

    good = stored(data)
    yield "a pickle that runs code", stored(data | {"actor": Code()})
    yield "a pickle that runs code", stored(Code())
    for _ in range(tries):
        yield "truncated", good[: rng.integers(len(good))]
    for _ in range(tries):
        flipped = bytearray(good)
        for at in rng.integers(len(good), size=rng.integers(1, 9)):
            flipped[at] ^= 1 << rng.integers(8)
        yield "bits flipped", bytes(flipped)
    for name in data["actor"] | data["critic"]:
        net = "actor" if name in data["actor"] else "critic"
        weights = data[net][name]
        yield "wrong shapes", stored(data | {net: data[net] | {name: weights[..., :-1]}})
        yield "wrong shapes", stored(data | {net: {k: v for k, v in data[net].items() if k != name}})
        bad = weights.clone()
        bad.view(-1)[rng.integers(bad.numel())] = rng.choice([np.nan, np.inf])
        yield "weights that are not finite", stored(data | {net: data[net] | {name: bad}})
    for hidden in ([10**9, 10**9], [64] * 10**4, [-1], ["64"], [], None, 64, [1.5]):
        yield "networks of other sizes", stored(data | {"network": data["network"] | {"hidden": hidden}})
    for key in data:
        yield "entries missing or of another type", stored({k: v for k, v in data.items() if k != key})
        for value in (None, "x", -1, [], {}, [np.nan], torch.zeros(3)):
            value = value if not isinstance(value, list) else [float(v) for v in value]
            yield "entries missing or of another type", stored(data | {key: value})
    for key, value in data["scaling"].items():
        n = len(value)
        for changed in (value[:-1], [float("nan")] * n, [0.0] * n, None, [10**6] * n):
            yield "scaling damaged", stored(data | {"scaling": data["scaling"] | {key: changed}})


LOADERS = (sac.load_policy, lambda path: deploy.load_critic(path, "cstr"))


def verdict(load, path):
    """What a loader makes of a file, counted: refused in one sentence, loaded to finite values, or neither ("wrong")."""
    try:
        agent = load(path)
    except ValueError as error:
        return collections.Counter(["refused" if "\n" not in str(error) else "wrong"])
    except Exception as error:
        print(f"{path}: {type(error).__name__} {error}", file=sys.stderr)
        return collections.Counter(["wrong"])
    start, goal = agent.plant.START, agent.plant.EVAL_GOAL
    if isinstance(agent, sac.Policy):
        value = agent.value(start, goal)
    else:
        value = torch_value(agent, torch.from_numpy(start)[None], torch.from_numpy(goal)[None]).numpy()
    return collections.Counter(["loaded" if np.isfinite(value).all() else "wrong"])


def checkpoints(args):
    """Both loaders on every hostile file."""
    data = torch.load(deploy.critic_path(deploy.Args()), weights_only=True)
    counts, rng = collections.defaultdict(collections.Counter), np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.pt"
        for case, content in hostile(data, rng, 10 if args.quick else 300):
            path.write_bytes(content)
            for load in LOADERS:
                counts[case] += verdict(load, path)
        with open(path, "wb") as file:  # takes no space on the disk
            file.truncate(2 * MAX_CHECKPOINT_BYTES)
        for load in LOADERS:
            counts["larger than a gigabyte"] += verdict(load, path)
    rows = []
    for case, found in counts.items():
        held, detail = found["refused"] + found["loaded"], f"{found['loaded']} of them loaded"
        rows.append(result("checkpoints", case, sum(found.values()), held, detail))
    return rows


# Many deployments


def deployments(args):
    """Controllers built anew from their checkpoint, each for a few steps from a start, to a goal and on a plant of its own."""
    most, steps, rng, sizes = 20 if args.quick else 1_000, 5, np.random.default_rng(0), []
    for i in range(most):
        controller = deploy.build_controller("rl_mpc", deploy.Args())
        x, goal, psi = draw(controller.plant, rng)
        controller.set_goal(goal)
        for _ in range(steps):
            x = controller.plant.step(x, controller.make_step(x), psi)
        if i + 1 in (most // 10, most):
            largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kilobytes; of macOS bytes
            sizes.append(largest / (1e3 if sys.platform == "linux" else 1e6))
    grown = sizes[1] - sizes[0]
    detail = f"{sizes[0]:.0f} MB at the most up to {most // 10}, {sizes[1]:.0f} MB up to {most}"
    return [result("deployments", "memory grows by less than 10 MB", most, most * (grown < 10), detail)]


# Twice the same


def determinism(args):
    """The whole reproduction twice: every table, and the weights of every critic."""
    steps = [step.name for step in reproduce.STEPS if not step.name.startswith("reliability")]
    steps = ["critic_cstr_robust", "cstr_profile", "linear_scalability_main"] if args.quick else steps
    found = {}
    for processes in (1, 2):
        folder = args.runs / f"determinism_{processes}"
        shutil.rmtree(folder, ignore_errors=True)
        command = ["experiments/reproduce.py", "--quick", "--jobs", 3 - processes, "--step-jobs", processes]
        command += ["--out", folder, "--runs", folder / "runs", "--only", *steps]
        command = [sys.executable, *map(str, command)]
        out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if out.returncode:
            raise RuntimeError(out.stderr)
        tables, critics = (folder / "results").glob("*.csv"), (folder / "pretrained").glob("*.pt")
        found[processes] = {path.name: without_times(path) for path in tables}
        found[processes] |= {path.name: torch.load(path, weights_only=True) for path in critics}
    rows = []
    for kind, case in ((".csv", "tables: the same but for times"), (".pt", "critics: the same weights")):
        names = sorted(name for name in found[1] | found[2] if name.endswith(kind))
        different = [name for name in names if not equal(found[1].get(name), found[2].get(name))]
        held, detail = len(names) - len(different), ", ".join(different)
        rows.append(result("determinism", case, len(names), held, detail))
    return rows


STUDIES = {"controllers": controllers, "training": training, "checkpoints": checkpoints}
STUDIES |= {"deployments": deployments, "determinism": determinism}


def main(args):
    table = f"reliability_{args.study}"
    common.check(args, table)
    if not args.plot_only:
        common.write(STUDIES[args.study](args), args.table(table))
    for row in common.read(args.table(table)):
        print("  ".join(f"{key} {value}" for key, value in row.items()))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
