"""What experiments with many independent parts share: every finished cell is kept as a CSV of its own, so that a second call continues."""

import csv
import hashlib
import os
import platform
import re
import signal
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.stats import bootstrap, trim_mean
from tqdm import tqdm

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
SHARED = ROOT / "envs"


def fail(message):
    """A user's mistake: one sentence, exit code 2, no traceback."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def check(args, table, **ranges):
    """Refuse arguments outside their (least, most), a folder that cannot be written, and redrawing `table` where there is none."""
    for name, (least, most) in ranges.items():
        if not (getattr(args, name) is None or least <= getattr(args, name) <= most):
            fail(f"--{name.replace('_', '-')} is {getattr(args, name)}; it must lie in {least} to {most}")
    for name in ("out",) if args.plot_only or not hasattr(args, "runs") else ("runs", "out"):
        try:
            getattr(args, name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            fail(f"--{name} {getattr(args, name)}: cannot write there ({error.strerror})")
    if args.plot_only and not (args.out / "results" / table).exists():
        fail(f"--plot-only: {args.out / 'results' / table} does not exist; run without it first")


def run(main, args):
    """`main(args)`; a --quick run without --out leaves the committed results alone, and Ctrl-C ends a run without a traceback."""
    if args.quick and args.out is not None and args.out.resolve() == Path(__file__).resolve().parent:
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
    return f"{models[0] if models else platform.processor()} ({os.cpu_count()} cores), Python {platform.python_version()}, {versions}"


def iqm(values):
    """Interquartile mean, computed as rliable does (without the lowest and the highest quarter, rounded down to whole seeds), and the ends
    of its 95 % bootstrap interval, not a number for fewer than three."""
    low = high = float("nan")
    if len(values) > 2:
        low, high = bootstrap(
            (values,),
            lambda v, axis: trim_mean(v, 0.25, axis=axis),
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
    return float(trim_mean(values, 0.25)), float(low), float(high)


def read(path):
    """The rows of a table, as dictionaries of strings."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def write(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    with open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    temporary.replace(path)


def _fill(function, cell, path):
    write(function(cell), path)


def collect(function, cells, jobs, folder, inputs):
    """The rows `function(cell)` of all cells, in order, over `jobs` processes.

    Cells are told apart by their repr; `inputs` are the files that results depend on, or their contents, beside envs/
    (a change makes every cell new).
    """
    inputs = [*inputs, *sorted([*SHARED.rglob("*.py"), *SHARED.rglob("*.c")])]
    version = hashlib.sha256(
        b"".join(file if isinstance(file, bytes) else Path(file).read_bytes() for file in inputs)
    ).digest()
    paths = [
        folder / f"{hashlib.sha256(version + repr(cell).encode()).hexdigest()[:12]}.csv" for cell in cells
    ]
    quit_at_once = dict(
        initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_DFL)
    )  # CasADi would take Ctrl-C for a failed solve
    with ProcessPoolExecutor(jobs, **quit_at_once) as pool:
        futures = [
            pool.submit(_fill, function, cell, path) for cell, path in zip(cells, paths) if not path.exists()
        ]
        try:
            for future in tqdm(
                as_completed(futures),
                initial=len(cells) - len(futures),
                total=len(cells),
                unit="cell",
                disable=None,
            ):
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [row for path in paths for row in read(path)]
