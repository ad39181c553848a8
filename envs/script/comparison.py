"""Closed loops on paired draws of start state and plant, over several processes."""

import csv
import itertools
import multiprocessing
import signal
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed

import numpy as np
from tqdm import tqdm

import envs


def draws(plant, episodes, seed, starts="box"):
    """Start states (episodes, n_x) uniform in their box or near the plant's START, and plants (episodes, n_psi) from the evaluation set."""
    # of any number, the first are the same
    rngs = [np.random.default_rng([seed, 3, i + 1]) for i in range(episodes)]
    x = np.concatenate([envs.sample_states(plant, rng, 1) for rng in rngs])
    psi = np.stack([rng.choice(plant.EVAL_PSI) for rng in rngs])
    if starts == "start":
        x = np.stack([plant.START + plant.START_NOISE * rng.uniform(-1, 1, len(plant.START)) for rng in rngs])
    return x, psi


def run_episode(controller, plant, x0, psi, goal, steps, noise=0.0, rng=None):
    """Closed loop on a plant with fixed parameters: x (steps + 1, n_x), u (steps, n_u) and the row of results.csv.

    What the controller's estimator measures is disturbed by `noise`, a standard deviation, share of each state's range, drawn from rng.
    """
    controller.reset()
    x, u, log, deviation = [np.array(x0, dtype=float)], [], [], noise * envs.state_range(plant)
    for _ in range(steps):
        y = x[-1] + deviation * rng.normal(size=len(deviation)) if noise else x[-1]
        u.append(controller.make_step(y[controller.estimator.measured]))
        x.append(plant.step(x[-1], u[-1], psi))
        log.append(controller.stats)
    x, u = np.array(x), np.array(u)
    milliseconds = [stats["wall_ms"] for stats in log]
    achieved = x[1:, plant.GOAL_INDEX]
    row = {
        "time_near_goal": envs.time_near_goal(plant, achieved, goal),
        "time_outside_constraints": envs.outside_constraints(plant, x[1:]).sum(),
        "ape_tail": plant.percentage_error(achieved, np.asarray(goal))[-25:].mean(),
        "solve_ms_median": np.median(milliseconds),
        "solve_ms_p95": np.quantile(milliseconds, 0.95),
        "iterations": np.mean([stats["iterations"] for stats in log]),
        "late": sum(stats["late"] for stats in log),
        "fell_back": sum(stats["fell_back"] for stats in log),
    }
    return x, u, row


def read_trajectories(path, plant):
    """States (E, T + 1, n_x) and actions (E, T, n_u) of every controller in a trajectories.npz. Raises ValueError."""
    try:
        with np.load(path, allow_pickle=False) as data:
            x, u = (
                np.concatenate([data[name] for name in sorted(data.files) if name.endswith(end)])
                for end in ("_x", "_u")
            )
        if not (x.shape[0], x.shape[1] - 1, *x.shape[2:], u.shape[2]) == (
            *u.shape[:2],
            len(plant.X_LOW),
            len(plant.U_LOW),
        ):
            raise ValueError
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            raise ValueError
    except (
        Exception
    ) as error:  # missing, truncated, not an archive, of another plant: one sentence for all of them
        reason = (
            f"not a trajectories.npz of {plant.ENV_ID} ({type(error).__name__})"
            if path.exists()
            else "does not exist"
        )
        raise ValueError(f"{path}: {reason}") from None
    return x, u


def parallel(function, jobs, processes, first=0):
    """[function(*job) for job in jobs] over processes; the `first` ones are done before the others begin."""
    # else CasADi would take Ctrl-C for a failed evaluation, and torch does not survive a fork
    quit_at_once = dict(initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_DFL))
    pool = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"), **quit_at_once)
    futures = []
    try:
        with tqdm(total=len(jobs), unit="episode", disable=None) as bar:
            for part in (jobs[:first], jobs[first:]):
                started = [pool.submit(function, *job) for job in part]
                for future in as_completed(started):
                    future.result()
                    bar.update()
                futures += started
    finally:
        pool.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


def new_folder(path):
    """Make the folder, or if another run has it already one with -2, -3, ... behind its name; returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            pass


def output_folder(out, otherwise):
    """The folder `out`, or a new one at the path `otherwise`, made and tried. Raises ValueError where it cannot be written."""
    try:
        folder = out or new_folder(otherwise)
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ValueError(f"--out {out or otherwise.parent}: cannot write there ({error.strerror})") from None
    return folder


def write_csv(rows, path):
    """Rows of equal keys as a table; a killed process leaves no half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_suffix(".tmp"), "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    path.with_suffix(".tmp").replace(path)


TABLE = """\
                        time near goal    time outside    offset     step, ms   iterations   late  steps that
controller              median [worst]  median [worst]       %  median    p95     per step  steps   fell back
{}
Near the goal more is better; outside the constraints 0 is best, and from many a start out of reach for all.
Offset: mean error of the last 25 steps. Late: stopped by --deadline-ms. Fell back: found no plan."""


def table(rows, label):
    """Rows of results.csv as text: median [worst] over episodes; label: the name of a row."""
    lines = []
    for name in dict.fromkeys(row["controller"] for row in rows):
        mine = [row for row in rows if row["controller"] == name]
        columns = (np.array([row[key] for row in mine]) for key in list(rows[0])[9:])
        near, outside, offset, median, p95, iterations, late, fell_back = columns
        lines.append(
            f"{label(mine[0]):22s}  {np.median(near):6.1f} [{near.min():5.1f}]  {np.median(outside):6.1f}"
            f" [{outside.min():5.1f}]  {np.median(offset):6.2f}  {np.median(median):6.1f} {np.median(p95):6.1f}"
            f"  {iterations.mean():11.1f}  {late.sum():5d}  {fell_back.sum():10d}"
        )
    return TABLE.format("\n".join(lines))
