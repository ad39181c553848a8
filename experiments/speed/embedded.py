"""The controller in C beside the one in Python: the same actions, the same closed loops, how long a step takes, how much room it needs.

    python experiments/speed/embedded.py --study equal elsewhere draws room fuzz    # a quarter of an hour
    python experiments/speed/embedded.py --study time beside                        # nothing else should run

`equal`: both in closed loop, each on its own plant, ten draws of 100 steps; the largest difference of an action, in its range. `elsewhere`:
check.c with 1,000 recorded steps, and the closed loop of example.c, with other flags, by other compilers and for other processors, where
they are installed; for aarch64 with the libraries of CasADi's wheel for it, in the folder --aarch64. `draws`: the paired draws of
reactor/deploy.py, in C. `time`: steps in C on one core; `beside`: in turn with Python. `room`: memory and stack here, flash and memory
on an ARM Cortex-M7. `fuzz`: random and impossible measurements and goals under AddressSanitizer and UndefinedBehaviorSanitizer.

Writes results/embedded_STUDY.csv.
"""

import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import rl_mpc_deploy as deploy
from envs.control.compiled import WHEEL
from envs.control.export import export_c
from envs.script.comparison import draws, run_episode
from experiments import common
from experiments.common import column, rounded

FIXTURES = common.ROOT / "tests/fixtures"
CONFIGURED = {  # label: keywords of rl_mpc_deploy.Args
    "N = 5": {},
    "N = 1": dict(horizon=1),
    "offset-free": dict(offset_free=True),
    "c_A unmeasured, noise 0.5 %": dict(estimator="ekf", measure=("sensors",), noise=0.005),
    "hard bounds, price of changes": dict(constraints="hard", change_weight=(1e-3, 0.0)),
}
SINGLE = "-DRL_MPC_SINGLE"
HERE = "-O3 -march=native -fPIC"  # the flags of the Makefile
BUILDS = {  # label: (compiler, flags, arguments of make)
    "gcc, the flags of Python": ("gcc", HERE, ()),
    "gcc, not -fPIC": ("gcc", "-O3 -march=native", ()),
    "gcc -O2, any x86-64": ("gcc", "-O2", ()),
    "gcc -O2, without fast-math": ("gcc", "-O2", ("FAST=",)),
    "clang": ("clang", "-O3 -march=native", ()),
    "aarch64, gcc": ("aarch64-linux-gnu-gcc", "-O3", ()),
}
OFTEN = "N = 5", "offset-free", "c_A unmeasured, noise 0.5 %"
DRAWS = [(label, flags) for flags in (HERE, f"{HERE} {SINGLE}") for label in OFTEN] + [("N = 5", "-O2")]
TIMED = ("N = 5", 5, HERE), ("N = 5", 3, HERE), ("N = 1", 3, HERE), ("N = 5", 3, f"{HERE} {SINGLE}")
M7 = "-O2 -mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard -mthumb"


@dataclass(frozen=True)
class Args(common.StudyArgs):
    study: tuple[str, ...] = ("equal", "elsewhere", "draws", "time", "beside", "room", "fuzz")
    """which studies"""
    episodes: int = 200
    """draws of `draws`"""
    steps: int = 100_000
    """of `time` and of `fuzz`"""
    aarch64: Path | None = None
    """folder casadi/ of CasADi's wheel for aarch64, unpacked"""


def make(folder, *targets, compiler="gcc", flags=HERE, more=()):
    command = ["make", "-s", "-C", folder, f"CC={compiler}", f"CFLAGS={flags}", *more, *targets]
    found = subprocess.run(command, capture_output=True, text=True)
    if found.returncode:
        raise RuntimeError(found.stdout + found.stderr)
    return found.stdout


def structures(folder, real):
    """rl_mpc_state and rl_mpc_info as ctypes structures, by the sizes in rl_mpc.h."""
    size = {k: int(v) for k, v in re.findall(r"RL_MPC_(\w+) (\d+)\b", (folder / "rl_mpc.h").read_text())}
    n_x, n_u, n_y, n_z = (size[name] for name in ("NX", "NU", "NY", "NZ"))
    state = [("begun", ctypes.c_int), ("planned", ctypes.c_int), ("x", real * n_x)]
    state += [("u", real * n_u), ("plan", real * (size["INNER"] * n_u))]
    if n_z:
        state += [("known", ctypes.c_int), ("z", real * n_z), ("P", real * n_z**2)]
        state += [("last", real * n_y), ("wrong_for", ctypes.c_int * n_y)]
    state += [("iterations", ctypes.c_int), ("deadline_ms", ctypes.c_double)]
    state += [("now_ms", ctypes.c_void_p), ("work", ctypes.c_void_p)]
    info = [(name, ctypes.c_int) for name in ("rung", "guess", "stop", "iterations")]
    info += [(name, real) for name in ("guess_cost", "cost", "predicted")]
    info += [("rejected", ctypes.c_uint), ("restarted", ctypes.c_int)]
    return [type("Structure", (ctypes.Structure,), {"_fields_": fields})() for fields in (state, info)]


class Exported:
    """An exported folder as a controller of Python: `u = make_step(y)`, `set_goal(goal)`, `reset()`, `stats`."""

    def __init__(self, folder, controller, flags=HERE):
        make(folder, "librl_mpc.so", flags=flags)
        self.library = ctypes.CDLL(f"{folder}/librl_mpc.so")
        self.real, real = (np.float32, ctypes.c_float) if SINGLE in flags else (np.float64, ctypes.c_double)
        self.state, self.info = structures(folder, real)
        names = (
            f"rl_mpc_{name}" + "_single" * (SINGLE in flags) for name in ("size", "init", "reset", "step")
        )
        size, init, self.c_reset, self.c_step = (getattr(self.library, name) for name in names)
        size.restype = ctypes.c_size_t
        self.memory = ctypes.create_string_buffer(size())
        assert init(ctypes.byref(self.state), self.memory, ctypes.c_size_t(len(self.memory))) == 0
        self.plant, self.estimator = controller.plant, SimpleNamespace(measured=controller.estimator.measured)
        self.u = np.zeros(len(self.plant.U_LOW), dtype=self.real)
        self.set_goal(controller.goal)

    def reset(self):
        self.c_reset(ctypes.byref(self.state), None)

    def set_goal(self, goal):
        self.goal = np.array(goal, dtype=self.real).reshape(-1)

    def make_step(self, y):
        y = np.array(y, dtype=self.real)
        arrays = [ctypes.c_void_p(a.ctypes.data) for a in (y, self.goal, self.u)]
        pointers = ctypes.byref(self.state), *arrays, ctypes.byref(self.info)
        tick = time.perf_counter()
        code = self.c_step(*pointers)
        took = 1e3 * (time.perf_counter() - tick)
        if code:
            raise ValueError(f"rl_mpc_step returned {code}")
        self.stats = {"iterations": self.info.iterations, "wall_ms": took, "rung": self.info.rung}
        self.stats |= {"late": self.info.stop == 2, "fell_back": self.info.rung > 0}
        return self.u.astype(float)


def exported(folder, records=100, flags=HERE, **options):
    """Controllers in Python and in C, by keywords of rl_mpc_deploy.Args."""
    args = deploy.Args(**options)
    controller = deploy.build_controller("rl_mpc", args)
    export_c(controller, folder, records, args.noise)
    return controller, Exported(folder, controller, flags)


def equal(args, folder):
    rows = []
    for label, options in CONFIGURED.items():
        pair, noise = exported(folder / label, 2, **options), options.get("noise", 0)
        plant, episodes = pair[0].plant, 2 if args.quick else 10
        steps, largest, same = (5 if args.quick else 100), 0.0, 0
        for i, (x, psi) in enumerate(zip(*draws(plant, episodes, args.seed))):
            rng = (np.random.default_rng([args.seed, i]) for _ in pair)
            loops = [run_episode(c, plant, x, psi, c.goal, steps, noise, r) for c, r in zip(pair, rng)]
            difference = np.abs(loops[0][1] - loops[1][1]) / (plant.U_HIGH - plant.U_LOW)
            largest, same = max(largest, difference.max()), same + (difference == 0).all(axis=1).sum()
        rows.append({"controller": label, "steps": episodes * steps, "same": same, "largest": float(largest)})
    return rows


def foreign_loop(folder, emulator):
    """States, goal and actions of example.c, (steps, numbers)."""
    found = subprocess.run([*emulator, folder / "example"], check=True, capture_output=True, text=True).stdout
    # without the time, what chose the action, iterations and milliseconds
    return np.array([line.split(",")[1:-3] for line in found.split()[1:]], dtype=float)


def elsewhere(args, folder):
    rows = []
    for label, options in list(CONFIGURED.items())[: 1 if args.quick else None]:
        exported(place := folder / label, 50 if args.quick else 1000, **options)
        loops = []
        for build, (compiler, flags, more) in BUILDS.items():
            emulator, foreign = [], compiler.startswith("aarch64")
            if not shutil.which(compiler) or foreign and not (args.aarch64 and shutil.which("qemu-aarch64")):
                continue
            if foreign:
                more, emulator = (f"HPIPM={args.aarch64}",), ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"]
            make(place, "clean")
            make(place, "check", "example", compiler=compiler, flags=flags, more=more)
            text = subprocess.run([*emulator, place / "check"], capture_output=True, text=True).stdout
            close, steps, largest = re.match(r"(\d+) of (\d+) .* difference ([\d.e+-]+);", text).groups()
            loop = foreign_loop(place, emulator)
            loops.append(loop)
            apart = (np.abs(loop - loops[0]) / np.ptp(loops[0], axis=0).clip(1e-9)).max()
            row = {"controller": label, "build": build, "steps": steps, "close": close, "largest": largest}
            rows.append(row | {"example_apart": f"{apart:.1e}"})
    return rows


def in_draws(args, folder):
    rows = []
    for label, flags in DRAWS[: 1 if args.quick else None]:
        options = CONFIGURED[label]
        python, c = exported(folder / f"{len(rows)}", 2, flags, **options)
        label += ", single" * (SINGLE in flags) + ", gcc -O2" * ("-O2" in flags)
        for i, (x, psi) in enumerate(
            tqdm(list(zip(*draws(c.plant, args.episodes, args.seed))), disable=None)
        ):
            rng, steps = np.random.default_rng([args.seed, 7, i + 1]), 3 if args.quick else 100
            row = run_episode(c, c.plant, x, psi, python.goal, steps, options.get("noise", 0), rng)[2]
            rows.append({"controller": label, "episode": i} | rounded(row, 6))
    return rows


def timed(args, folder):
    rows = []
    for label, iterations, flags in TIMED:
        options = dict(iterations=iterations) | CONFIGURED[label]
        c = exported(folder / f"{len(rows)}", 2, flags, **options)[1]
        milliseconds, plant, label = [], c.plant, label + ", single" * (SINGLE in flags)
        for x, psi in tqdm(list(zip(*draws(plant, -(-args.steps // 100), args.seed))), disable=None):
            c.reset()
            for _ in range(100):
                x = plant.step(x, c.make_step(x), psi)
                milliseconds.append(c.stats["wall_ms"])
        row = {"controller": label, "iterations": iterations, "steps": len(milliseconds)}
        for name, q in (("median", 0.5), ("p95", 0.95), ("p999", 0.999), ("p9999", 0.9999), ("max", 1)):
            row[f"ms_{name}"] = np.quantile(milliseconds, q)
        rows.append(rounded(row, 4) | {"machine": common.machine()})
    return rows


def beside(args, folder):
    """Rows: steps in Python and in C, in turn on the same draws."""
    rows = []
    for label in ("N = 5", "N = 1"):
        pair = exported(folder / label, 2, **CONFIGURED[label])
        milliseconds = [[], []]
        for start, psi in zip(*draws(pair[0].plant, 2 if args.quick else 60, args.seed)):
            for controller, log in zip(pair, milliseconds):
                controller.reset()
                x = start
                for _ in range(3 if args.quick else 100):
                    tick = time.perf_counter()
                    u = controller.make_step(x)
                    log.append(1e3 * (time.perf_counter() - tick))
                    x = controller.plant.step(x, u, psi)
        for language, log in zip(("Python", "C"), milliseconds):
            row = {"controller": label, "language": language, "steps": len(log)}
            row |= dict(zip(("ms_median", "ms_p95"), np.quantile(log, [0.5, 0.95])))
            rows.append(rounded(row, 4) | {"machine": common.machine()})
    return rows


def sections(folder, *sources, compiler="arm-none-eabi-gcc", flags=M7):
    """Bytes of code and constants, and of variables, of sources compiled there."""
    command = [
        compiler,
        *flags.split(),
        "-std=c99",
        f"-I{WHEEL}/include",
        "-ffunction-sections",
        "-c",
        *sources,
    ]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    objects = [f"{Path(source).stem}.o" for source in sources]
    size = [compiler.replace("gcc", "size"), *objects]
    lines = subprocess.run(size, cwd=folder, check=True, capture_output=True, text=True).stdout.splitlines()
    text, data, bss = np.sum([[int(n) for n in line.split()[:3]] for line in lines[1:]], axis=0)
    return int(text), int(data + bss)


def room(args, folder):
    rows = []
    for label, options in list(CONFIGURED.items())[:-1]:
        python, c = exported(folder / label, 2, **options)
        place, libraries = (
            folder / label,
            [f"-L{WHEEL}", f"-Wl,-rpath,{WHEEL}", "-lhpipm", "-lblasfeo", "-lm"],
        )
        objects = ["rl_mpc.o", "rl_mpc_functions.o", "tree_qp.o"]
        stack = ["gcc", "-O2", "-I.", "-pthread", FIXTURES / "stack.c", *objects, *libraries, "-o", "stack"]
        subprocess.run(stack, cwd=place, check=True)
        found = subprocess.run([place / "stack"], capture_output=True, text=True, check=True).stdout.split()
        row = {"controller": label, "memory": len(c.memory), "state": ctypes.sizeof(c.state)}
        row |= {"stack_init": int(found[0]), "stack_step": int(found[1])}
        row |= dict.fromkeys(
            ("m7_functions", "m7_loop", "m7_work", "m7_single_functions", "m7_single_work"), ""
        )
        if shutil.which("arm-none-eabi-gcc"):
            (place / "work.c").write_text('#include "rl_mpc.c"\nwork_memory only_its_size;\n')
            row["m7_loop"] = sections(place, "rl_mpc.c", "tree_qp.c")[0]
            for kind, flags in (("m7", M7), ("m7_single", f"{M7} {SINGLE}")):
                row[f"{kind}_functions"] = sections(
                    place, "rl_mpc_functions.c", flags=f"{flags} -ffast-math"
                )[0]
                row[f"{kind}_work"] = sections(place, "work.c", flags=flags)[1]
        rows.append(row)
    return rows


def fuzz(args, folder):
    rows = []
    for label in ("N = 1", "c_A unmeasured, noise 0.5 %")[: 1 if args.quick else 2]:
        exported(place := folder / label, 2, **CONFIGURED[label])
        sources = [FIXTURES / "fuzz.c", "rl_mpc.c", "rl_mpc_functions.c", "tree_qp.c"]
        search = [
            f"-I{WHEEL}/include",
            "-I.",
            f"-L{WHEEL}",
            f"-Wl,-rpath,{WHEEL}",
            "-lhpipm",
            "-lblasfeo",
            "-lm",
        ]
        sanitizers = "-g -O1 -fsanitize=address,undefined -fno-sanitize-recover=all".split()
        subprocess.run(["gcc", *sanitizers, *sources, *search, "-o", "fuzz"], cwd=place, check=True)
        command = [place / "fuzz", str(200 if args.quick else args.steps)]
        found = subprocess.run(command, capture_output=True, text=True)
        if found.returncode:
            raise RuntimeError(found.stdout + found.stderr)
        counts = re.findall(r"\d+", found.stdout)
        names = ("steps", "done", "measurements_refused", "goals_refused", "planned", "by_policy", "held")
        rows.append({"controller": label} | dict(zip(names, counts)))
    return rows


STUDIES = {
    "equal": equal,
    "elsewhere": elsewhere,
    "draws": in_draws,
    "time": timed,
    "beside": beside,
    "room": room,
    "fuzz": fuzz,
}


def print_table(study, rows):
    print(f"\n{study}")
    if study == "draws":
        for label, mine in common.grouped(rows, "controller").items():
            near, outside = (column(mine, key) for key in ("time_near_goal", "time_outside_constraints"))
            near, outside = (
                " ".join(f"{np.quantile(v, q):.1f}" for q in (0.5, 0.05, 0)) for v in (near, outside)
            )
            offset = np.quantile(column(mine, "ape_tail"), [0.5, 0.95]).round(2)
            print(
                f"{label}: near goal, median, 5th percentile, worst: {near}; outside {outside}; offset {offset} %"
            )
        return
    for row in rows:
        print("  ".join(f"{key} {value}" for key, value in row.items() if key != "machine"))


def main(args):
    common.check(args, "embedded_equal", episodes=(1, 10**4), steps=(100, 10**7))
    unknown = set(args.study) - set(STUDIES)
    if unknown:
        common.fail(f"--study {' '.join(unknown)}: choose from {', '.join(STUDIES)}")
    if args.quick:
        args = replace(args, episodes=2, steps=100)
    for study in args.study:
        table = args.table(f"embedded_{study}")
        if not args.plot_only:
            with tempfile.TemporaryDirectory() as folder:
                common.write(STUDIES[study](args, Path(folder)), table)
        print_table(study, common.read(table))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
