"""Agents that observe how the last transition differed from the nominal model, and so tell their plant: what each ingredient contributes.

    python experiments/reactor/observers.py --jobs 2      # ten minutes; continues where it stopped
    python experiments/reactor/observers.py --plot-only   # redraw from the committed CSV

The evaluation is that of offline.py, whose robust agent is the plain one. Writes results/cstr_offset_free_training.csv (a row per variant
and seed) and the figure of that name.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from envs import cstr
from experiments import common
from experiments.common import HERE, column, distinct, grouped, rounded, select
from experiments.palette import BLUE, RED
from experiments.reactor import offline

Args = common.ParallelArgs
SEEDS = 3  # agents per variant
OBSERVING = dict(observe_mismatch=True, scenario_hold="episode")


def scaled(factor):
    """An agent that observes the mismatch on another scale, which envs.load takes in place of True."""
    return OBSERVING | dict(observe_mismatch=tuple((factor * cstr.MISMATCH_SCALE).tolist()))


VARIANTS = {  # arguments of sac_her_branching.py
    "offset-free": OBSERVING,
    "offset-free, discount 0.99": OBSERVING | dict(gamma=0.99),
    "plain, discount 0.95": dict(gamma=0.95),
    "scenario held, mismatch not observed": dict(scenario_hold="episode", gamma=0.95),
    "mismatch observed, scenario not held": dict(observe_mismatch=True),
    "mismatch scale x 10": scaled(10.0),
    "mismatch scale / 10": scaled(0.1),
}


def training_row(label, seed, rows):
    """The evaluation of offline.py, in medians and 75th percentiles over starts."""
    row = {"variant": label, "seed": seed}
    for evaluation in ("robust", "nominal"):
        ape = column(rows, "ape", evaluation=evaluation)
        row |= {f"{evaluation}_median_ape": np.median(ape), f"{evaluation}_p75_ape": np.quantile(ape, 0.75)}
    return rounded(row, 4)


def train(args):
    """A row per agent; those of the plain ones are of offline.py's committed table."""
    agents = {
        (label, seed): arguments
        for label, arguments in VARIANTS.items()
        for seed in range(args.seed, args.seed + (1 if args.quick else SEEDS))
    }
    plain = grouped(select(common.read(HERE / "results/cstr_offline.csv"), agent="robust"), "seed")
    found = [training_row("plain", seed, rows) for seed, rows in plain.items()]
    rows = grouped(offline.errors(offline.train(agents, args), args), "agent", "seed")
    return found + [training_row(label, seed, mine) for (label, seed), mine in rows.items()]


def plot_training(rows, path):
    fig, ax = common.subplots(figsize=(8, 3.6))
    labels = distinct(rows, "variant")
    shown = {
        "robust_median_ape": ("median over starts", BLUE, "o"),
        "robust_p75_ape": ("75th percentile", RED, "d"),
    }
    titles = ("robust: median over starts", "75th percentile", "nominal")
    print(f"{'':40s}" + "".join(f"{title:42s}" for title in titles))
    for position, label in enumerate(labels):
        mine = select(rows, variant=label)
        texts = [common.iqm_text(column(mine, key)) for key in (*shown, "nominal_median_ape")]
        print(f"{label:40s}" + "".join(f"{text:42s}" for text in texts))
        for key, (_, colour, marker) in shown.items():
            found = column(mine, key)
            ax.plot(found, np.full(len(found), -position), marker, color=colour, ms=4, alpha=0.5)
            middle = common.iqm(found)[0]
            ax.plot([middle] * 2, [-position - 0.3, -position + 0.3], color=colour, lw=2.5)
    ax.set_yticks(-np.arange(len(labels)), labels)
    ax.set(xscale="log", xlabel="absolute percentage error of $c_B$ on uncertain plants, 200 starts")
    ax.set_xticks([0.2, 0.3, 0.5, 1, 2, 3, 5], ["0.2", "0.3", "0.5", "1", "2", "3", "5"])
    ax.minorticks_off()
    for text, colour, marker in shown.values():
        ax.plot([], [], color=colour, marker=marker, label=text)
    title = "points: training seeds; bars: interquartile means"
    common.legend(fig, ax, ncols=2, title=title, title_fontsize=9)
    ax.grid(axis="x", alpha=0.3)
    common.save(fig, path)


def main(args):
    name = "cstr_offset_free_training"
    common.check(args, name)
    if not args.plot_only:
        common.write(train(args), args.table(name))
    plot_training(common.read(args.table(name)), args.figure(name))


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
