"""Two ways to learn the value on the reactor, side by side: soft actor-critic, and value iteration whose maximisation is the planner.

    python experiments/reactor/planner_value.py --jobs 2       # training included; continues where it stopped
    python experiments/reactor/planner_value.py --plot-only    # print the table and redraw from the committed CSV

SAC is `sac_her_branching.py --constraint-weight 3`, deployed with its defaults; the planner is `planner_value_iteration.py` with `PLANNER`,
deployed with what its checkpoint says. Both are deployed by rl_mpc_deploy.py with N = 5 and N = 1 on the draws of deploy.py. What a
controller lacks to the best possible is measured by the objective of oracle.py, with its optima of the same draws. Writes
results/cstr_planner.csv (a row per value, horizon and draw) and figures/cstr_planner.png.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from experiments import common
from experiments.common import column, grouped
from experiments.palette import BLUE, GREEN
from experiments.reactor import loops
from experiments.reactor.deploy import KINDS, MEASURES, RL_MPC
from experiments.reactor.oracle import gaps

HORIZONS = (1, 5)  # of the deployed plans
PLANNER = dict(env="cstr", robust_horizon=1, sigma=0.1, slack_weight=2.0, lookahead=15, horizon=10)
PLANNER |= dict(gamma=0.98, box=1.0, states=4_000, sweeps=8, steps=60, updates=4_000)
METHODS = {  # script, its arguments, and those of --quick
    "SAC": (common.TRAINING, KINDS["constraint-aware"], dict(total_timesteps=2000)),
    "planner": (common.PLANNER, PLANNER, common.QUICK_PLANNER),
}
STYLES = {"SAC": (BLUE, "o"), "planner": (GREEN, "s")}


@dataclass(frozen=True)
class Args(common.ParallelArgs):
    episodes: int = 100
    """paired draws, at most as many as oracle.py had"""
    agents: tuple[int, ...] = (1, 2)
    """training seeds"""


def collect(args):
    """A row per value, horizon and draw."""
    rows = []
    for method, (script, settings, few) in METHODS.items():
        settings = settings | (few if args.quick else {})
        agents = {seed: settings | dict(seed=seed) for seed in args.agents[: 1 if args.quick else None]}
        folders = dict(zip(agents, common.train(agents.values(), args.runs, args.jobs, script=script)))
        seconds = {seed: common.record(folder)["wall_seconds"] for seed, folder in folders.items()}
        variants = {
            f"{seed} {horizon}": RL_MPC | dict(critic=folder / "checkpoint.pt", horizon=horizon)
            for horizon in HORIZONS
            for seed, folder in folders.items()
        }
        for row in loops.table(loops.collect(variants, args)):
            seed = int(row["variant"].split()[0])
            head = {"method": method, "agent": seed, "train_seconds": seconds[seed]}
            rows.append(head | row | {"variant": f"{method}, N = {row['horizon']}"})
    return rows


def plot(rows, oracle, path):
    """Quantiles of both measures over draws, and of the gap to the oracle; a point per training seed."""
    fig, axes = common.subplots(1, 3, figsize=(11, 2.6), sharey=True)
    gap = "gap to the oracle: median, 95th percentile"
    print(f"{'':22s}seconds   near: median   5th   outside: median   5th   {gap}   [range over seeds]")
    for position, (label, mine) in enumerate(grouped(rows, "variant").items()):
        per_agent = grouped(mine, "agent").values()
        found = np.array(
            [
                [np.quantile(column(each, key), q) for key in MEASURES for q in (0.5, 0.05)]
                for each in per_agent
            ]
        )
        lack = [gaps(oracle, each)[0] for each in per_agent]
        found = np.hstack([found, [[row["objective_median_gap"], row["objective_p95_gap"]] for row in lack]])
        shown = "".join(f"{v.mean():8.1f} [{v.min():.1f}, {v.max():.1f}]" for v in found.T)
        print(f"{label:22s}{column(mine, 'train_seconds').mean():8.0f}{shown}")
        colour, marker = STYLES[mine[0]["method"]]
        for k, ax in enumerate(axes):
            ax.plot(found[:, 2 * k], [-position] * len(found), marker, color=colour, ms=5)
            ax.plot(found[:, 2 * k + 1], [-position] * len(found), marker, color=colour, ms=5, mfc="none")
    labels = common.distinct(rows, "variant")
    axes[0].set_yticks(-np.arange(len(labels)), labels)
    for ax, title in zip(axes, (*MEASURES.values(), "gap to the best possible")):
        ax.set_xlabel(title)
        ax.grid(alpha=0.3)
    axes[0].plot([], [], "ko", label="median over draws")
    axes[0].plot([], [], "ko", mfc="none", label="5th percentile (gap: 95th)")
    common.legend(fig, axes[0], ncols=2, title="a point per training seed")
    common.save(fig, path)


def main(args):
    common.check(args, "cstr_planner", episodes=(1, 10**6))
    if not args.plot_only:
        common.write(collect(args), args.table("cstr_planner"))
    plot(
        *(common.read(args.table(name)) for name in ("cstr_planner", "cstr_oracle")),
        args.figure("cstr_planner"),
    )


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
