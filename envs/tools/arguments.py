"""Checks of a script's arguments: ValueError, one sentence that names the argument, its value and what is allowed."""

from typing import Literal, get_args, get_origin


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
        if get_origin(kind) is Literal and getattr(args, name) not in get_args(kind):
            raise ValueError(f"{flag(name)} is {getattr(args, name)!r}; choose one of {', '.join(get_args(kind))}")


def check_effects(args, without_effect):
    """Arguments that would do nothing must have their defaults; without_effect: {name: why, or "" if it has an effect}."""
    for name, why in without_effect.items():
        if why and getattr(args, name) != getattr(type(args), name):
            raise ValueError(f"{flag(name)} {getattr(args, name)} has no effect {why}")
