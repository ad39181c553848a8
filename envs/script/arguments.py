"""Checks of a script's arguments: ValueError, one sentence that names the argument, its value and what is allowed."""

from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, Union, get_args, get_origin

import numpy as np

import envs

WORDS = {bool: "True or False", int: "a whole number", float: "a number", str: "text", Path: "a path"}


def _converted(value, kind):
    """A value as the command line gives `kind`. Raises TypeError with what it must be."""
    if isinstance(value, np.generic) or isinstance(value, np.ndarray) and not value.ndim:
        value = value.item()
    if get_origin(kind) is Annotated:  # what the command line takes, and what Python may give instead
        kind = get_args(kind)[isinstance(value, (tuple, list, np.ndarray))]
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    if value is None and type(None) in kinds:
        return None
    kind, number = kinds[0], type(value) in (int, float)
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise TypeError(f"choose one of {', '.join(get_args(kind))}")
        return value
    if get_origin(kind) is tuple:
        parts = value.tolist() if hasattr(value, "tolist") else value  # of numpy or torch
        parts = parts if isinstance(parts, (list, tuple, range)) else [parts]
        return tuple(_converted(part, get_args(kind)[0]) for part in parts)
    if kind is int and type(value) is float and value.is_integer() or kind is float and number:
        return kind(value)
    if kind is str and number:
        return repr(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if not isinstance(value, kind) or kind is int and isinstance(value, bool):
        raise TypeError(f"it must be {WORDS[kind]}")
    return value


def as_annotated(args):
    """Put what Python gave into the types of the command line: numbers of numpy, lists and arrays, text as paths.

    Raises ValueError for what does not fit.
    """
    for field in fields(args):
        value = getattr(args, field.name)
        try:
            object.__setattr__(args, field.name, _converted(value, field.type))
        except TypeError as error:
            raise ValueError(f"{flag(field.name)} is {value!r}; {error}") from None


def flag(name):
    """The argument of the command line that sets the field `name`."""
    return f"--{name.replace('_', '-')}"


def check_ranges(args, **ranges):
    """Numbers of a dataclass of arguments must lie in their (least, most); None need not."""
    for name, (least, most) in ranges.items():
        value = getattr(args, name)
        if value is not None and not least <= value <= most:  # nor is nan
            raise ValueError(f"{flag(name)} is {value}; it must lie in [{least:g}, {most:g}]")


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
