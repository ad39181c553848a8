"""What experiments share: arguments, parts that are kept, trained agents, tables and figures.

Whatever takes long is kept under --runs, in a file or folder named by a hash of the code and the settings that it depends on: a second
call of the same command continues, and a change of the code makes everything new that it may change.
"""

import contextlib
import csv
import functools
import hashlib
import importlib
import inspect
import io
import json
import os
import platform
import re
import signal
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import tyro
from scipy.stats import bootstrap, trim_mean
from tqdm import tqdm

from envs.script.arguments import as_annotated, check_ranges

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PRETRAINED = HERE / "pretrained"
ENVS = ROOT / "envs"
TRAINING, PLANNER = ROOT / "sac_her_branching.py", HERE / "planner_value_iteration.py"  # which learn a value
QUICK_PLANNER = dict(
    sweeps=1, states=40, length=4, updates=5, lookahead=3, horizon=2, loops=2, steps=51, hidden=(8, 8)
)
SCRIPTS = TRAINING, ROOT / "goal_mpc.py", ROOT / "rl_mpc_deploy.py"
# all code as it was when this process began: an edit while it runs does not file old results under new code
FILES = sorted(
    path for place in (ENVS, HERE) for path in place.rglob("*") if path.suffix in (".py", ".c", ".h")
)
CODE = {path: path.read_bytes() for path in (*SCRIPTS, *FILES)}


# Command line


@dataclass(frozen=True)
class StudyArgs:
    seed: int = 0
    """of the draws of start states and plants; where agents are trained, the first agent's"""
    quick: bool = False
    """a smoke test on tiny budgets; without --out it writes to runs/quick"""
    plot_only: bool = False
    """compute nothing: print the tables and draw the figures from the CSV files"""
    out: Path = HERE
    """folder whose results/ and figures/ are written"""

    def table(self, name):
        return self.out / f"results/{name}.csv"

    def figure(self, name):
        return self.out / f"figures/{name}.png"


@dataclass(frozen=True)
class ParallelArgs(StudyArgs):
    jobs: int = 2
    """processes; results do not depend on it, but times do"""
    runs: Path = Path("runs/experiments")
    """where finished parts and trained agents are kept, so that a second call continues"""


def fail(message):
    """A user's mistake: one sentence, exit code 2, no traceback."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check(args, table, **ranges):
    """Refuse arguments outside their (least, most), folders that cannot be written, and --plot-only where `table` is not there."""
    ranges |= {"seed": (0, 10**9)} | ({"jobs": (1, 1024)} if hasattr(args, "jobs") else {})
    try:
        as_annotated(args)
        check_ranges(args, **ranges)
    except ValueError as error:
        fail(error)
    for name in ("out", "runs") if hasattr(args, "runs") and not args.plot_only else ("out",):
        try:
            getattr(args, name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"--{name} {getattr(args, name)}: cannot write there ({error.strerror})")
    if args.plot_only and not args.table(table).exists():
        fail(f"--plot-only: {args.table(table)} does not exist; run without it first")


def command_line(main, kind, description):
    """`main` of the arguments of the command line. A --quick run without --out leaves the committed results alone."""
    args = tyro.cli(kind, description=description)
    if args.quick and args.out is not None and args.out.resolve() == HERE:
        args = replace(args, out=Path("runs/quick"))
        print(f"--quick: results go to {args.out}; --out names another folder", file=sys.stderr)
    try:
        main(args)
    except KeyboardInterrupt:
        print("interrupted; what is finished is kept, so that the same command continues", file=sys.stderr)
        raise SystemExit(130) from None


def machine():
    """Processor and versions, for a table."""
    info = Path("/proc/cpuinfo")
    models = re.findall(r"^model name\s*: (.*)", info.read_text(), re.MULTILINE) if info.exists() else []
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "casadi"))
    processor = f"{models[0] if models else platform.processor()} ({os.cpu_count()} cores)"
    return f"{processor}, Python {platform.python_version()}, {versions}"


# Parts that are kept


def digest(places, *words):
    """Short hash of code and words; places: files, folders, and functions, classes or modules, whose files are meant."""
    places = [part if isinstance(part, Path) else Path(inspect.getfile(part)).resolve() for part in places]
    code = [text for path, text in CODE.items() if any(path.is_relative_to(place) for place in places)]
    return hashlib.sha256(b"".join([*code, repr(words).encode()])).hexdigest()[:12]


@functools.cache
def checksum(path):
    """Short hash of a file's contents, for cells that read it."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]


def each(function, cells, jobs, unit, finished=0):
    """Call `function(*cell)` for all cells, over processes."""
    # CasADi would take Ctrl-C for a failed solve
    quit_at_once = dict(initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_DFL))
    with ProcessPoolExecutor(jobs, **quit_at_once) as pool:
        futures = [pool.submit(function, *cell) for cell in cells]
        progress = dict(initial=finished, total=finished + len(cells), unit=unit, disable=None)
        try:
            for future in tqdm(as_completed(futures), **progress):
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _fill(function, cell, path):
    write(function(cell), path)


def collect(function, cells, runs, jobs=1, uses=()):
    """The rows `function(cell)` of all cells, in order, over processes; those of a finished cell are kept in the folder `runs`.

    Results depend on the cell, which its repr tells from others, on the three scripts and envs/, on the function's file, and on modules
    and files that it `uses`.
    """
    code = digest([*SCRIPTS, ENVS, function, *uses], function.__qualname__)
    paths = [runs / f"parts/{digest([], code, repr(cell))}.csv" for cell in cells]
    missing = [(function, cell, path) for cell, path in zip(cells, paths) if not path.exists()]
    each(_fill, missing, jobs, "cell", len(cells) - len(missing))
    return [row for path in paths for row in read(path)]


# Trained agents


def agent_folder(settings, runs, kind=None, script=TRAINING):
    """Where `train` keeps the agent with these arguments, which all of them and the code tell from others."""
    module = _module(script)
    values = vars(module.Args(**settings)) | {"out": None, "save_every": None}
    values = {name: value.name if isinstance(value, Path) else value for name, value in values.items()}
    places = [script, ENVS, *([kind] if kind else []), *(SCRIPTS if script != TRAINING else [])]
    code = digest(places, kind and kind.__qualname__, values)
    return runs / f"agents/{values['env']}_{values['seed']}_{code}"


def _module(script):
    return importlib.import_module(".".join(script.relative_to(ROOT).with_suffix("").parts))


def _train(settings, folder, jobs, kind, script):
    module, own = _module(script), dict(save_every=0) if script == TRAINING else {}
    folder.parent.mkdir(parents=True, exist_ok=True)
    quiet = contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO())
    with tempfile.TemporaryDirectory(dir=folder.parent) as place, quiet[0], quiet[1]:
        tick = time.perf_counter()
        run = module.main(module.Args(out=Path(place), **own, **settings), *([kind] if kind else []))
        seconds = round(time.perf_counter() - tick, 1)
        (run / "resume.pt").unlink()  # as large as the replay buffer
        record = {"wall_seconds": seconds, "jobs": jobs, "machine": machine()}
        (run / "run.json").write_text(json.dumps(record), encoding="utf-8")
        try:
            run.rename(folder)
        except OSError:
            if not folder.exists():  # else another process was faster, with the same agent
                raise


def train(agents, runs, jobs, kind=None, script=TRAINING):
    """Folders of agents, dictionaries of arguments of a script that trains; only those are trained that `runs` lacks.

    Each holds checkpoint.pt, evaluations.csv (planner_value_iteration.py: sweeps.csv) and run.json: wall_seconds, jobs beside each other,
    machine. kind: a subclass of the SAC of sac_her_branching.py.
    """
    folders = [agent_folder(settings, runs, kind, script) for settings in agents]
    missing = {folder: settings for folder, settings in zip(folders, agents) if not folder.exists()}
    todo = [(settings, folder, jobs, kind, script) for folder, settings in missing.items()]
    each(_train, todo, jobs, "agent", len(folders) - len(todo))
    return folders


def record(folder):
    """What `train` noted of an agent: wall_seconds, jobs, machine."""
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


# Tables


def read(path):
    """The rows of a table, as dictionaries of strings."""
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    with open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    temporary.replace(path)


def rounded(row, digits):
    """A row whose floats are rounded, numpy's too."""
    return {k: round(float(v), digits) if isinstance(v, float) else v for k, v in row.items()}


def without(row, *keys):
    return {k: v for k, v in row.items() if k not in keys}


def select(rows, **where):
    """The rows that have these values, which are compared as text."""
    return [row for row in rows if all(str(row[key]) == str(value) for key, value in where.items())]


def column(rows, key, **where):
    """Numbers of one column, of the rows that `select` finds."""
    return np.array([float(row[key]) for row in select(rows, **where)])


def distinct(rows, key):
    """The values of a column, each once, in order."""
    return list(dict.fromkeys(row[key] for row in rows))


def grouped(rows, *keys):
    """{value, or tuple of values: rows}, in order."""
    found = {}
    for row in rows:
        found.setdefault(row[keys[0]] if len(keys) == 1 else tuple(row[k] for k in keys), []).append(row)
    return found


def iqm(values):
    """Interquartile mean, computed as rliable does (without the lowest and the highest quarter, rounded down to whole seeds), and the ends
    of its 95 % bootstrap interval, not a number for fewer than three."""
    low = high = float("nan")
    if len(values) > 2:
        options = dict(method="percentile", rng=np.random.default_rng(0))
        found = bootstrap((values,), lambda v, axis: trim_mean(v, 0.25, axis=axis), **options)
        low, high = found.confidence_interval
    return float(trim_mean(values, 0.25)), float(low), float(high)


def iqm_text(values):
    """`iqm [its interval] (range)`."""
    middle, low, high = iqm(values)
    return f"{middle:6.2f} [{low:.2f}, {high:.2f}] ({values.min():.2f} to {values.max():.2f})"


# Figures


def subplots(*shape, figsize, **options):
    """A figure and its axes, without pyplot: whoever imports an experiment keeps the backend that they have."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=figsize, layout="constrained")
    return fig, fig.subplots(*shape, **options)


def legend(fig, ax, where="upper", **options):
    """The legend of one panel, outside of all of them."""
    options = dict(loc=f"outside {where} center", frameon=False, fontsize=9) | options
    fig.legend(*ax.get_legend_handles_labels(), **options)


def save(fig, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=150)
