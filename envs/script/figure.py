"""The figure of an episode."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def new_figure(**options):
    """A matplotlib figure that is drawn into files, whatever backend the caller's own figures have."""
    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


def nearest_turn(angle, to):
    """The angle plus as many whole turns as bring it nearest to another one."""
    return angle + 2 * np.pi * np.round((to - angle) / (2 * np.pi))


def angles_on_one_scale(paths, goal):
    """Angles of all paths (steps + 1,) each without jumps, and the goal (steps + 1,) at the turn that the first path takes to reach it.

    All paths end at the same turn.
    """
    paths = [np.array(path, dtype=float) for path in paths]
    for path in paths:
        known = np.isfinite(path)
        path[known] = np.unwrap(path[known])
    ends = [path[np.isfinite(path)][-1] for path in paths]
    paths = [
        path + nearest_turn(goal[-1], ends[0]) - nearest_turn(goal[-1], end) for path, end in zip(paths, ends)
    ]
    changes = np.append(np.flatnonzero(np.diff(goal)), len(goal) - 1)
    last = changes[np.searchsorted(changes, np.arange(len(goal)))]  # step until which each goal holds
    return paths, nearest_turn(goal, np.where(np.isfinite(paths[0]), paths[0], ends[0])[last])


def draw_episode(plant, paths, goals, path):
    """A panel per goal state, state with any bound, and action: up to four below each other, more in three columns.

    paths: {label: (x (steps + 1, n_x), u (steps, n_u), matplotlib options of its lines)}; goals: (steps, n_goal), those
    of x_1 ...
    """
    n_x = len(plant.X_LOW)
    low, high = np.append(plant.X_LOW, plant.U_LOW), np.append(plant.X_HIGH, plant.U_HIGH)
    names = [*zip(plant.STATE_NAMES, plant.STATE_UNITS), *zip(plant.ACTION_NAMES, plant.ACTION_UNITS)]
    titles = [f"{name} [{unit}]" for name, unit in names]
    bounded = np.isfinite(low) | np.isfinite(high)
    shown = [i for i in range(len(low)) if i in plant.GOAL_INDEX or bounded[i]]
    if len(shown) > 12:  # of a large plant, the first few
        shown = [i for i in shown if i < 4 or n_x <= i < n_x + 2]
        titles[0] += f" (4 of {n_x} states)"
    columns = 1 if len(shown) <= 4 else 3
    rows = -(-len(shown) // columns)
    size = (8, 0.7 + 1.5 * rows) if columns == 1 else (10, 0.8 + 2.2 * rows)
    figure = new_figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    times = np.arange(len(goals) + 1) * plant.DT
    for ax, i in zip(axes, shown):
        drawn = [np.hstack([x, np.vstack([u, u[-1:]])])[:, i] for x, u, _ in paths.values()]
        goal = goals[:, plant.GOAL_INDEX.index(i)] if i in plant.GOAL_INDEX else np.zeros(len(goals))
        goal = np.append(goal[:1], goal)
        if i in plant.ANGLES:
            drawn, goal = angles_on_one_scale(drawn, goal)
        if i in plant.GOAL_INDEX:
            ax.plot(times, goal, color="#CC79A7", lw=2, ls=(0, (1, 1)), drawstyle="steps-pre", label="goal")
        for values, (label, (_, _, style)) in zip(drawn, paths.items()):
            options = {"lw": 1.8, "drawstyle": "default" if i < n_x else "steps-post", "label": label} | style
            ax.plot(times, values, **options)
        for bound in filter(np.isfinite, (low[i], high[i])):
            ax.axhline(bound, color="black", lw=1, alpha=0.6, label="bound")
        if i in plant.ANGLES:
            low_turn, high_turn = np.round(np.array(ax.get_ylim()) / np.pi).astype(int)
            turns = np.arange(low_turn, high_turn + 1, max((high_turn - low_turn) // 4, 1))
            multiples = [{0: "0", 1: "π", -1: "-π"}.get(k, f"{k}π") for k in turns]
            ax.set_yticks(np.pi * turns, [f"{m} ({('up', 'down')[k % 2]})" for m, k in zip(multiples, turns)])
        ax.set_title(titles[i], fontsize=10, loc="left")
        ax.set_xlim(0, times[-1])
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    for ax in axes[max(len(shown) - columns, 0) : len(shown)]:
        ax.xaxis.set_tick_params(labelbottom=True)
        ax.set_xlabel(f"time [{plant.TIME_UNIT}]")
    handles = {text: h for ax in axes for h, text in zip(*ax.get_legend_handles_labels())}
    legend = dict(loc="outside upper center", ncols=min(len(handles), 4), frameon=False, fontsize=9)
    figure.legend(handles.values(), handles.keys(), **legend)
    figure.savefig(path, dpi=150)
