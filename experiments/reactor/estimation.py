"""From measurements, not states: filters for noise, offset and a state that nobody measures, and plans over what they do not know.

    python experiments/reactor/estimation.py --jobs 2      # ten minutes; continues where it stopped
    python experiments/reactor/estimation.py --plot-only   # redraw from the committed CSV

Closed loops of rl_mpc_deploy.py on the paired draws of deploy.py: start states and plants whose parameters are fixed but unknown. Cases:

noise: every state is measured, with noise of 0 to 1 % of its range. hidden: c_A is not measured, noise 0.5 %; "mean" plans from the
filter's mean alone. faults: the same with sensors that are stuck (steps 20 to 60), drift from step 20, or give 1.5 times the value at every
fifth step; with three times or a third of the noise that the filter was told; and with starts whose c_A lies at an end of its box, far from
where the filter begins. change: the catalyst's activity beta falls from 1.0 to 0.9 at half time, or drifts there. twice: plants on the edge
of twice the training box; "known plant" is told the parameters, and `held` is the smallest offset at which any constant action holds the
plant inside its bounds. Every measure is of the true state.

Writes results/cstr_estimation.csv (a row per case, controller and draw), cstr_estimation_profile.csv (c_B over the fall of beta) and
figures/cstr_estimation.png.
"""

import functools
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs
from envs import cstr
from envs.control.estimation import Measured
from experiments import common
from experiments.common import PRETRAINED, column, distinct, grouped, rounded, select, without
from experiments.palette import BLUE, GREEN, GREY, ORANGE, PINK, RED
from experiments.reactor import literal, loops
from experiments.reactor.deploy import ACTOR, AWARE, RL_MPC, ROBUST, TUNED

OURS, OFFSET_FREE = RL_MPC | AWARE, dict(offset_free=True)
EKF, PARTICLES, SENSORS = dict(estimator="ekf"), dict(estimator="particles"), dict(measure=("sensors",))
FILTERS = {"RL+MPC, Kalman filter": OURS | EKF, "RL+MPC, particles": OURS | PARTICLES}
WHOLE = {"RL+MPC": OURS, "RL+MPC, offset-free": OURS | OFFSET_FREE} | FILTERS
OBSERVER = ACTOR | dict(critic=PRETRAINED / "cstr_offset_free.pt")
OBSERVERS = {"RL, offset-free": OBSERVER, "RL, offset-free, Kalman filter": OBSERVER | EKF}
BENCHMARKS = {"robust MPC, tuned": ROBUST | dict(benchmark=TUNED)}
BENCHMARKS |= {"robust MPC, tuned, offset-free": ROBUST | OFFSET_FREE | dict(benchmark=TUNED)}
HIDDEN = {
    "Kalman filter, mean, half the spread": OURS | EKF | dict(spread=0.5),
    "Kalman filter, mean, no spread": OURS | EKF | dict(spread=0.0),
    "Kalman filter, sigma points": OURS | EKF,
    "particles, mean, half the spread": OURS | PARTICLES | dict(spread=0.5),
    "particles in nine groups": OURS | PARTICLES,
}
KNOWN = "RL+MPC, known plant"
NOISES, HALF_PERCENT = (0.0, 0.002, 0.005, 0.01), 0.005
FAULTS = (
    "none",
    "c_B stuck",
    "T_R stuck",
    "c_B drifts",
    "T_R drifts",
    "glitches",
    "c_A far off",
    "noise x 3",
    "noise / 3",
)
STYLES = {  # of what is drawn: colour, dashes, where its name stands in the panel of changes
    "RL+MPC": (GREY, "-", (12, -5.4)),
    "RL+MPC, offset-free": (GREEN, "-", (15, 1.4)),
    "RL+MPC, Kalman filter": (BLUE, "--", None),
    "RL+MPC, particles": (ORANGE, ":", (14, -1.6)),
    "RL, offset-free": (PINK, ":", None),
    "RL, offset-free, Kalman filter": (RED, "-.", None),
}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 80
    """paired draws; a quarter of them for faults, changes and benchmarks"""


@dataclass(frozen=True)
class Case:
    """One controller in one case; `loop` names controller and draws."""

    case: str
    noise: float
    """of the sensors, share of each state's range"""
    kind: str
    """a fault, or a change of the plant"""
    loop: loops.Loop


# Closed loops


def start_and_path(case, x0, psi):
    """The start, and the plant's parameters at every step."""
    steps = case.loop.settings.steps
    path, half = np.tile(psi, (steps, 1)), steps // 2
    if case.kind == "fall":
        path[:half], path[half:] = (1.0, 1.0), (1.0, 0.9)
    if case.kind == "drift":
        path[:] = cstr.PSI_NOMINAL
        path[:, 1] -= 0.1 * np.clip((np.arange(steps) - steps // 4) / half, 0, 1)
    if case.kind == "c_A far off":
        x0 = np.append(cstr.X_LOW[0] if x0[0] < 1.05 else cstr.X_HIGH[0], x0[1:])
    return x0, path


def spoiled(kind, t, y, stuck):
    """The readings y of (c_B, T_R, T_K) at step t as a fault makes them; stuck: those of step 20."""
    name, _, what = kind.partition(" ")
    i = {"c_B": 0, "T_R": 1}.get(name)
    if what == "stuck" and 20 <= t < 60:
        y[i] = stuck[i]
    if what == "drifts":
        y[i] += 5e-4 * (t - 20) * (t > 20) * (1.8, 90.0)[i]  # a twentieth of a percent of the range a step
    if kind == "glitches" and t % 5 == 4:
        y[t % len(y)] *= 1.5
    return y


class Known(Measured):
    """The whole state is measured, and the parameters are known: `actual` (n_psi,), to be set."""

    def belief(self, scenarios):
        self.shift = self.actual - self.plant.PSI_NOMINAL
        return super().belief(self.plant.PSI_NOMINAL + 0.5 * (scenarios - self.plant.PSI_NOMINAL))


@functools.cache
def controller(loop):
    mpc = loops.controller(loop.settings, loop.like, loop.benchmark)
    if loop.variant == KNOWN:
        mpc.estimator = Known(mpc.plant)
    return mpc


def closed_loop(case, mpc, x0, path, rng):
    """States (steps + 1, n_x), actions, and the controller's stats of every step."""
    mpc.reset()
    x, u, log, stuck = [x0], [], [], None
    deviation = case.noise * envs.state_range(cstr)
    for t, psi in enumerate(path):
        y = (x[-1] + deviation * rng.normal(size=len(x0)))[mpc.estimator.measured]
        stuck = y.copy() if t <= 20 else stuck
        u.append(mpc.make_step(spoiled(case.kind, t, y, stuck)))
        x.append(cstr.step(x[-1], u[-1], psi))
        log.append(mpc.stats)
    return np.array(x), np.array(u), log


def held(psi):
    """The smallest offset, %, at which some constant action holds the plant inside its bounds."""
    names = "GOAL_INDEX ANGLES U_LOW U_HIGH START X_LOW X_HIGH INIT_LOW INIT_HIGH ENV_ID step".split()
    plant = SimpleNamespace(**{name: getattr(cstr, name) for name in names}, SCENARIOS={"mpc": psi[None]})
    low, high = envs.reachable_goals(plant, actions=400, steps=1000)
    return cstr.percentage_error(np.clip(cstr.EVAL_GOAL, low, high), cstr.EVAL_GOAL)


def run(case):
    """A row per draw; the path of c_B, as text, goes into a table of its own."""
    loop, args, rows = case.loop, case.loop.settings, []
    mpc, (starts, psis) = controller(loop), loops.paired_draws(loop)
    for episode in range(loop.first, loop.stop):
        x0, path = start_and_path(case, starts[episode], psis[episode])
        if loop.variant == KNOWN:
            mpc.estimator.actual = psis[episode]
        rng = np.random.default_rng([args.seed, 7, episode])
        x, u, log = closed_loop(case, mpc, x0, path, rng)
        achieved = x[1:, cstr.GOAL_INDEX]
        error = cstr.percentage_error(achieved, mpc.goal)
        late = error[args.steps // 2 :]
        row = {"case": case.case, "kind": case.kind, "noise": case.noise, "controller": loop.variant}
        row |= {"seed": args.seed, "episode": episode, "alpha": path[-1, 0], "beta": path[-1, 1]}
        row |= {
            "offset": error[-25:].mean(),
            "time_near_goal": envs.time_near_goal(cstr, achieved, mpc.goal),
            "time_outside_constraints": envs.outside_constraints(cstr, x[1:]).sum(),
            "action_variation": (np.abs(np.diff(u, axis=0)) / (cstr.U_HIGH - cstr.U_LOW)).sum(),
            "steps_over_2_percent": int((late > 2).sum()),
            "rejected": sum(len(stats.get("rejected", ())) for stats in log),
            "restarted": sum(stats.get("restarted", False) for stats in log),
            "solve_ms_median": np.median([stats["wall_ms"] for stats in log]),
            "held": held(psis[episode]) if case.case == "twice" and loop.variant == KNOWN else 0.0,
        }
        rows.append(rounded(row, 5) | {"c_B": " ".join(f"{v:.4f}" for v in x[:, 1])})
    return rows


def cases(args):
    found, few = [], max(args.episodes // 4, 1)

    def add(case, variants, episodes, noise=0.0, kind="fixed", told=None, **options):
        options |= dict(noise=noise if told is None else told)
        variants = {label: settings | options for label, settings in variants.items()}
        found.extend(
            Case(case, noise, kind, loop) for loop in loops.loops(variants, episodes, args.seed, args.quick)
        )

    for noise in NOISES:
        add("noise", WHOLE | OBSERVERS, args.episodes, noise)
    add("noise", BENCHMARKS, few)
    add("hidden", HIDDEN, args.episodes, HALF_PERCENT, **SENSORS)
    for kind in FAULTS:
        factor = {"noise x 3": 3.0, "noise / 3": 1 / 3}.get(kind, 1.0)
        add("faults", FILTERS, few, factor * HALF_PERCENT, kind, HALF_PERCENT, **SENSORS)
    for kind in ("fall", "drift"):
        add("change", WHOLE, few, kind=kind)
        add("change", FILTERS, few, HALF_PERCENT, kind, **SENSORS)
    add("twice", WHOLE | {KNOWN: OURS}, args.episodes, shift=2.0)
    some = "RL+MPC", "RL+MPC, Kalman filter", "Kalman filter, sigma points", KNOWN
    return (
        [case for case in found if case.loop.variant in some and case.noise < 0.002] if args.quick else found
    )


# Tables and figure


def print_table(rows):
    head = (
        f"{'case':8s}{'kind':13s}{'noise':>6s} {'controller':42s}{'draws':>6s}{'offset %: median  95 %':>24s}"
    )
    head += f"{'near goal: median  5 %':>24s}{'outside: median  5 %   mean':>30s}{'variation':>10s}{'over 2 %':>9s}"
    print(f"{head}{'rejected':>9s}{'restarts':>9s}{'ms':>6s}")
    keys = "offset time_near_goal time_outside_constraints action_variation steps_over_2_percent rejected restarted"
    for (case, kind, noise, label), mine in grouped(rows, "case", "kind", "noise", "controller").items():
        offset, near, outside, *others = (column(mine, key) for key in keys.split())
        variation, over, rejected, restarted = others
        text = f"{case:8s}{kind:13s}{100 * float(noise):5.2g}% {label:42s}{len(mine):6d}"
        text += f"{np.median(offset):17.2f}{np.quantile(offset, 0.95):7.2f}"
        text += f"{np.median(near):17.1f}{np.quantile(near, 0.05):7.1f}"
        text += f"{np.median(outside):15.2f}{np.quantile(outside, 0.05):7.1f}{outside.mean():8.2f}"
        text += (
            f"{np.median(variation):10.1f}{np.median(over):9.0f}{rejected.mean():9.1f}{restarted.mean():9.2f}"
        )
        print(f"{text}{np.median(column(mine, 'solve_ms_median')):6.1f}")
    best = column(rows, "held", case="twice", controller=KNOWN)
    print(
        f"twice: held inside the bounds with an offset of {np.median(best):.1f} % (median), {np.quantile(best, 0.95):.1f} (95 %)"
    )


def plot(rows, paths, path):
    fig, axes = common.subplots(1, 3, figsize=(13, 4.2))
    for label, (colour, dashes, _) in STYLES.items():
        by_noise = grouped(select(rows, case="noise", controller=label), "noise").items()
        if not by_noise:
            continue
        noise, offset = np.transpose(
            [(100 * float(n), np.median(column(mine, "offset"))) for n, mine in by_noise]
        )
        axes[0].plot(noise, offset, color=colour, ls=dashes, marker="o", ms=4, lw=2, label=label)
    axes[0].set(
        xlabel="noise of the sensors [% of range]",
        ylabel="offset of the true $c_B$ [%], median",
        yscale="log",
    )
    axes[0].set_title("every state measured", fontsize=11)
    axes[0].set_yticks([0.05, 0.1, 0.3, 1, 3], ["0.05", "0.1", "0.3", "1", "3"])

    hidden = select(rows, case="hidden")
    whole = select(rows, case="noise", noise=0.0, controller="RL+MPC, Kalman filter")
    groups = {"whole state, no noise": whole} | {
        label: select(hidden, controller=label) for label in distinct(hidden, "controller")
    }
    for y, mine in enumerate(groups.values()):
        outside = column(mine, "time_outside_constraints")
        axes[1].plot(np.quantile(outside, [0.05, 0.5]), [-y, -y], color=GREY, lw=2)
        axes[1].plot(np.median(outside), -y, "o", color=GREEN if y else "black", ms=7)
        axes[1].plot(outside.mean(), -y, "d", color=ORANGE, ms=7)
    axes[1].set_yticks(-np.arange(len(groups)), groups, fontsize=8)
    axes[1].set(xlabel="time outside [steps]\ndot: median, diamond: mean, line: to the 5th percentile")
    axes[1].set_title("$c_A$ not measured, noise 0.5 %", fontsize=11)

    for label, mine in grouped(paths, "controller").items():
        colour, dashes, where = STYLES[label]
        if where is None:
            continue
        c_b = np.array([[float(v) for v in row["c_B"].split()] for row in mine])
        error, steps = 100 * (c_b / cstr.EVAL_GOAL[0] - 1), np.arange(c_b.shape[1]) - c_b.shape[1] // 2
        shown = steps >= -10
        axes[2].plot(steps[shown], np.median(error, 0)[shown], color=colour, ls=dashes, lw=2)
        axes[2].text(*where, label, color=colour, fontsize=9)
    axes[2].set(
        xlabel=r"steps after $\beta$ falls from 1.0 to 0.9", ylabel="$c_B$ above the goal [%], median"
    )
    axes[2].set_title("the catalyst loses activity", fontsize=11)
    for ax in axes:
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8, frameon=False)
    common.save(fig, path)


def main(args):
    common.check(args, "cstr_estimation", episodes=(1, 10**6))
    table, profile = args.table("cstr_estimation"), args.table("cstr_estimation_profile")
    if not args.plot_only:
        rows = common.collect(run, cases(args), args.runs, args.jobs, uses=[loops, literal])
        fall = [row for row in rows if row["kind"] == "fall" and float(row["noise"]) == 0]
        common.write([{k: row[k] for k in ("controller", "episode", "c_B")} for row in fall], profile)
        common.write([without(row, "c_B") for row in rows], table)
    rows = common.read(table)
    print_table(rows)
    plot(rows, common.read(profile), args.figure("cstr_estimation"))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
