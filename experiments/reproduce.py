"""Every CSV and figure of the repository, from nothing: trains the critics, then runs every experiment.

    python experiments/reproduce.py --list                         # what there is, and what is done
    python experiments/reproduce.py --quick                        # all of it on tiny budgets, in minutes, into runs/quick
    python experiments/reproduce.py                                # all of it, for hours (--list estimates); continues where it stopped
    python experiments/reproduce.py --only cstr_deploy             # one step, after what it needs
    python experiments/reproduce.py --backend dask --scheduler tcp://HOST:8786    # on a cluster whose workers share this folder

A step is one command. Steps that do not need each other run side by side, those that measure times one by one at the end. A finished
step leaves a note under --runs and is not repeated until a script changes; what an interrupted step had finished is kept as well, by the
experiment itself. A command that a lost worker leaves behind does no harm: results appear by an atomic rename.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from experiments import common
from experiments.common import ENVS, HERE, ROOT, SCRIPTS, fail


@dataclass(frozen=True)
class Step:
    name: str
    command: tuple
    """script, from the root of the repository, and its arguments"""
    minutes: float
    """about how long it takes with one process, for the time left"""
    needs: tuple = ()
    """names of steps whose results or agents it reads"""
    alone: bool = False
    """it measures times: nothing else may run"""
    takes: tuple = ("jobs", "runs")
    """which of these its script has arguments for"""


def study(name, script, part=None, minutes=1.0, needs=(), **options):
    """A script of experiments/, or one of its studies."""
    command = f"experiments/{script}.py", *(("--study", part) if part else ())
    return Step(f"{name}_{part}" if part else name, command, minutes, tuple(needs), **options)


def critic(name, minutes=1.0):
    return Step(f"critic_{name}", ("experiments/critics.py", "--critic", name), minutes, takes=("runs",))


EMBEDDED = ("experiments/speed/embedded.py", "--study")
CRITICS = ("critic_cstr_robust", "critic_cstr_nominal", "critic_cstr_constrained", "critic_cstr_offset_free")
STEPS = [  # what others wait for and what takes long first
    *(critic(name.removeprefix("critic_")) for name in CRITICS),
    critic("linear_robust", 6),
    critic("double_pendulum_planner", 11),
    study("linear_value_mpc", "linear/value_mpc", "train", 65, ["critic_linear_robust"]),
    study("linear_value_mpc", "linear/value_mpc", "distance", 6, ["linear_value_mpc_train"]),
    study("dip_value", "pendulum/learned_value", "train", 23, ["critic_double_pendulum_planner"]),
    study("dip_value", "pendulum/learned_value", "ablation", 28),
    study("dip_value", "pendulum/learned_value", "loops", 15, ["dip_value_train"]),
    study("dip_value", "pendulum/learned_value", "equilibria", 1, ["critic_double_pendulum_planner"]),
    Step("embedded", (*EMBEDDED, "equal", "elsewhere", "draws", "room", "fuzz"), 27, CRITICS, takes=()),
    study("cstr_deploy", "reactor/deploy", minutes=14, needs=CRITICS),
    study("cstr_deploy", "reactor/deploy", "critics", 4, CRITICS),
    study("cstr_oracle", "reactor/oracle", minutes=14, needs=["cstr_deploy"]),
    study("cstr_frontier", "reactor/frontier", minutes=1, needs=["cstr_oracle"]),
    study("cstr_planner", "reactor/planner_value", minutes=12, needs=["cstr_oracle"]),
    study("cstr_ablation", "reactor/ablation", minutes=13, needs=["cstr_deploy_critics"]),
    study("cstr_training", "reactor/training", minutes=7, needs=CRITICS),
    study("cstr_offline", "reactor/offline", minutes=1, needs=["cstr_training"]),
    study("cstr_offline", "reactor/offline", "ablation", 14, ["cstr_training"]),
    study("cstr_observers", "reactor/observers", minutes=11, needs=["cstr_offline"]),
    study("training_speed", "speed/training_speed", "ablation", 12, ["cstr_offline_ablation"]),
    study("training_speed", "speed/training_speed", "peer", 25, ["training_speed_ablation"]),
    study("cstr_tune", "reactor/tune", minutes=21, needs=CRITICS),
    study("cstr_deploy", "reactor/deploy", "ipopt", 7, CRITICS),
    study("cstr_deploy", "reactor/deploy", "literal", 4, CRITICS),
    study("cstr_deploy", "reactor/deploy", "branching", 1, CRITICS),
    study("cstr_stuck", "reactor/stuck", minutes=9, needs=CRITICS),
    study("cstr_estimation", "reactor/estimation", minutes=9, needs=CRITICS),
    study("cstr_shift", "reactor/shift", "plants", 7, CRITICS),
    study("cstr_shift", "reactor/shift", "critic", 1, CRITICS),
    study("cstr_profile", "reactor/trajectories", needs=CRITICS, takes=()),
    study("reliability", "trust/reliability", "controllers", 7, CRITICS),
    study("reliability", "trust/reliability", "training", 4),
    study("reliability", "trust/reliability", "checkpoints", 1),
    study("reliability", "trust/reliability", "deployments", 1, CRITICS),
    study("reliability", "trust/reliability", "determinism", 13, CRITICS),
    study("linear_scalability", "linear/scalability", "main", 14),
    study("linear_scalability", "linear/scalability", "sweep", 7, ["linear_scalability_main"]),
    study("dip_performance", "pendulum/performance", minutes=20),
    study("dip_equilibria", "pendulum/equilibria", minutes=1, takes=()),
    Step("embedded_time", (*EMBEDDED, "time", "beside"), 5, CRITICS, alone=True, takes=()),
    study("linear_value_mpc", "linear/value_mpc", "profile", 1, ["linear_value_mpc_train"], alone=True),
    study("linear_value_mpc", "linear/value_mpc", "scaling", 1, ["linear_value_mpc_train"], alone=True),
    study("solve_time", "speed/solve_time", minutes=1, needs=CRITICS, alone=True, takes=()),
    study("training_speed", "speed/training_speed", "profile", 1, alone=True),
    study("benchmark_peers", "speed/benchmark_peers", minutes=6, needs=CRITICS, alone=True, takes=("runs",)),
]


@dataclass
class Args:
    quick: bool = False
    """tiny budgets: a smoke test of everything"""
    only: tuple[str, ...] | None = None
    """steps to run, with what they need; default: all"""
    list: bool = False
    """print the steps, what they need and whether they are done"""
    jobs: int = 2
    """steps at a time"""
    step_jobs: int = 1
    """processes within each step; no result depends on it"""
    backend: Literal["processes", "dask"] = "processes"
    """where steps run: processes of this machine, or the workers of a dask cluster"""
    scheduler: str = ""
    """address of the dask scheduler"""
    runs: Path = ROOT / "runs/reproduce"
    """where finished parts are kept; on a cluster a folder that every worker sees"""
    out: Path | None = None
    """folder whose results/, figures/ and pretrained/ are written; default: experiments/, with --quick runs/quick. Experiments read the
    shipped critics, so that only experiments/ trains those that it then uses"""


def version(quick):
    """Of all code that a step may run, and of the budget."""
    return common.digest([*SCRIPTS, ENVS, HERE], quick)


def note(step, args):
    return args.runs / f"done/{step.name}_{version(args.quick)}.json"


def write(text, path):
    """A file that appears whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def run(step, args, done):
    """One step, in a process of its own, unless its note `done` is there. Returns what went wrong, or None."""
    if done.exists():
        return None
    tick, command = time.time(), [sys.executable, *step.command, "--out", str(args.out)]
    command += ["--quick"] * args.quick
    command += ["--jobs", str(args.step_jobs)] if "jobs" in step.takes else []
    command += ["--runs", str(args.runs / "experiments")] if "runs" in step.takes else []
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", env=one_thread)
    if result.returncode:
        return f"{' '.join(command)}\n{result.stderr.strip()[-2000:]}"
    write(result.stdout, args.runs / f"logs/{step.name}.txt")
    write(json.dumps({"seconds": time.time() - tick}), done)


def wanted(steps, only):
    """The steps named and what they need, in order. Raises ValueError for a name that is none."""
    by_name, chosen = {step.name: step for step in steps}, set()
    names = list(by_name if only is None else only)
    if not names:
        raise ValueError(f"--only is empty; choose from {', '.join(by_name)}")
    while names:
        name = names.pop()
        if name not in by_name:
            raise ValueError(f"--only {name} is not a step; choose from {', '.join(by_name)}")
        if name not in chosen:
            chosen.add(name)
            names += by_name[name].needs
    return [step for step in steps if step.name in chosen]


def startable(left, done, running):
    """Those of the steps left that may start now, in order: what measures times waits for all others and runs by itself."""
    if any(step.alone for step in running):
        return []
    ready = [step for step in left if done.issuperset(step.needs)]
    beside = [step for step in ready if not step.alone]
    if not beside and not running and all(step.alone for step in left):
        return ready[:1]
    return beside


def checked(args):
    """The arguments with their folders, which are made. Refuses what cannot work."""
    for name in ("jobs", "step_jobs"):
        if not 1 <= getattr(args, name) <= 1024:
            fail(f"--{name.replace('_', '-')} is {getattr(args, name)}; it must lie in 1 to 1024")
    if (args.backend == "dask") != bool(args.scheduler):
        fail("--backend dask and --scheduler ADDRESS belong together")
    out = args.out or (ROOT / "runs/quick" if args.quick else HERE)
    if args.quick and out.resolve() == HERE:
        fail(
            "--quick would replace the committed results by those of tiny budgets; name another folder with --out"
        )
    args = replace(args, runs=args.runs.absolute(), out=out.absolute())
    try:
        for folder in (args.runs, args.out):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        fail(f"--runs {args.runs} or --out {args.out}: cannot write there ({error.strerror})")
    return args


def print_list(steps, args):
    for step in steps:
        state = "done" if note(step, args).exists() else f"{step.minutes:g} min"
        needs = "the reactor's critics" if step.needs == CRITICS else ", ".join(step.needs)
        needs = f"needs {needs}" if needs else ""
        print(f"{step.name:28s}{state:>8s}  {'alone' if step.alone else '':7s}{needs}")
    left = [step for step in steps if not note(step, args).exists()]
    hours = sum(step.minutes / (1 if step.alone else args.jobs) for step in left) / 60
    print(f"minutes of one process; about {hours:.1f} hours are left with --jobs {args.jobs}")


def run_all(steps, args, pool):
    """Every step, each as soon as it may start, until one fails; returns what went wrong."""
    left, running, done, failed = list(steps), {}, set(), []
    layout = "{l_bar}{bar}| {remaining} left{postfix}"
    with tqdm(total=sum(step.minutes for step in steps), disable=None, bar_format=layout) as bar:
        while running or (left and not failed):
            ready = [] if failed else startable(left, done, running.values())
            # a cluster has a queue of its own
            for step in ready[: args.jobs - len(running) if args.backend == "processes" else None]:
                left.remove(step)
                running[pool.submit(run, step, args, note(step, args))] = step
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                step, error = running.pop(future), future.result()
                bar.set_postfix_str(f", {step.name} {'failed' if error else 'done'}")
                bar.update(step.minutes)
                done.add(step.name)
                failed += [f"{step.name}: {error}"] if error else []
    return failed


@contextlib.contextmanager
def executor(args):
    """Where `run` is called: threads, since a step is a process of its own, or the workers of the cluster."""
    if args.backend == "processes":
        with ThreadPoolExecutor(args.jobs) as pool:
            yield pool
        return
    try:
        from dask.distributed import Client
    except ImportError:
        fail("dask is missing; pip install -r requirements-experiments.txt")
    try:
        client = Client(args.scheduler, timeout=20)
    except (OSError, ValueError) as error:
        fail(f"--scheduler {args.scheduler} does not answer ({error})")
    with client:
        yield client.get_executor(pure=False)


def main(args, steps=STEPS):
    args = checked(args)
    try:
        steps = wanted(steps, args.only)
    except ValueError as error:
        fail(error)
    if args.quick:  # whose times mean nothing
        steps = [replace(step, alone=False) for step in steps]
    if args.list:
        return print_list(steps, args)
    with executor(args) as pool:
        failed = run_all(steps, args, pool)
    if failed:
        fail("\n\n".join(failed))
    print(f"{len(steps)} steps done; results in {args.out}")


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
