"""Checks of a script's arguments: ValueError, one sentence that names the argument, its value and what is allowed."""

from pathlib import Path
from typing import Literal, get_args, get_origin

import numpy as np

import envs


def as_annotated(args):
    """Put what Python gave into the types of the command line: lists, arrays and single numbers as tuples, text as paths, plain numbers."""
    for name, kind in type(args).__annotations__.items():
        value, kinds = getattr(args, name), get_args(kind) or (kind,)
        if isinstance(value, np.generic):
            value = value.item()
        listed = any(get_origin(each) is tuple for each in (kind, *kinds))
        if listed and value is not None and not isinstance(value, tuple):
            value = (value,) if isinstance(value, str) else tuple(np.atleast_1d(value).tolist())
        if Path in kinds and isinstance(value, str):
            value = Path(value)
        object.__setattr__(args, name, value)


def flag(name):
    """The argument of the command line that sets the field `name`."""
    return f"--{name.replace('_', '-')}"


def check_ranges(args, **ranges):
    """Numbers of a dataclass of arguments must lie in their (least, most), and what is a choice must be one; None is neither."""
    for name, (least, most) in ranges.items():
        value = getattr(args, name)
        if value is not None and not least <= value <= most:  # nor is nan
            raise ValueError(f"{flag(name)} is {value}; it must lie in [{least:g}, {most:g}]")
    for name, kind in type(args).__annotations__.items():
        optional, value = type(None) in get_args(kind), getattr(args, name)
        literal = get_args(kind)[0] if optional else kind
        if get_origin(literal) is Literal and value not in (*get_args(literal), *[None] * optional):
            raise ValueError(f"{flag(name)} is {value!r}; choose one of {', '.join(get_args(literal))}")


def check_effects(args, without_effect):
    """Arguments that would do nothing must have their defaults; without_effect: {name: why, or "" if it has an effect}."""
    for name, why in without_effect.items():
        if why and getattr(args, name) != getattr(type(args), name):
            raise ValueError(f"{flag(name)} {getattr(args, name)} has no effect {why}")


def check_weights(name, weights, n):
    """Prices must be n numbers of at least 0, or None."""
    if weights is not None and not (len(weights) == n and all(0 <= weight < np.inf for weight in weights)):
        raise ValueError(f"{flag(name)} is {weights}; it needs {n} number(s), each at least 0")


def goal_schedule(plant, texts, steps):
    """The goal at each of x_1 ... x_steps, (steps, n_goal), from texts such as ("up-up", "0,3.14@100").

    Raises ValueError for one that is no goal of the plant, out of its range, or not in order.
    """
    named, first, goals = getattr(plant, "GOALS", {}), -1, np.empty((steps, len(plant.GOAL_INDEX)))
    for text in texts or [",".join(map(str, plant.EVAL_GOAL))]:
        value, _, when = text.partition("@")
        try:
            goal = np.array(named[value] if value in named else [float(part) for part in value.split(",")])
            start = int(when) if when else max(first, 0)
        except ValueError:
            goal = np.empty(0)
        if goal.shape != plant.EVAL_GOAL.shape:
            allowed = " or ".join([*named, f"{len(plant.EVAL_GOAL)} number(s) joined by commas"])
            raise ValueError(f"--goal {text} is not a goal of {plant.ENV_ID}; it must be {allowed}")
        try:
            goal = envs.checked_goal(plant, goal)
        except ValueError as error:
            raise ValueError(f"--goal {text} is out of range: {error}") from None
        if not (first < start < steps and (first >= 0 or start == 0)):
            order = f"increasing from goal to goal and below {steps}; the first goal starts at 0"
            raise ValueError(f"--goal {text} needs @STEP, {order}")
        goals[start:], first = goal, start
    return goals
