"""Files of sac_her_branching.py: data, never code, and refused in one sentence if they are anything else."""

import os
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

FORMAT, RESUME = "rlmpc-sac-her-branching-1", "rlmpc-resume-2"
MAX_CHECKPOINT_BYTES = 10**9


def plain(value):
    """A dataclass, or what it may hold, as plain data: numbers of numpy as Python's, paths as text, tuples as lists."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(part) for name, part in asdict(value).items()}
    if isinstance(value, (tuple, list)):
        return [plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value.item() if isinstance(value, np.generic) else value


def save(data, path):
    """Write a file so that a killed process never leaves half of it: temporary name, flush, rename."""
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        torch.save(data, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def read_file(path, wanted, what, most=None, build=lambda data: data):
    """`build` of the data of a file of the format `wanted`. Raises ValueError for anything else, and for what `build` raises."""
    path = Path(path)
    try:
        if most and path.stat().st_size > most:
            raise ValueError(f"larger than {most / 1e9:g} gigabytes")
        if zipfile.ZipFile(path).testzip():
            raise ValueError("damaged")
        data = torch.load(path, map_location="cpu", weights_only=True)
        if data["format"] != wanted:
            raise ValueError("of another format")
        return build(data)
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; it must be {what}") from None
    except (
        Exception
    ) as error:  # text, a folder, a pickle of code, weights that do not fit: torch raises many types
        reason = str(error) if type(error) is ValueError and "\n" not in str(error) else type(error).__name__
        raise ValueError(f"{path} is not {what} ({reason})") from None


def read_checkpoint(path, env, build):
    """`build(data)` of a checkpoint.pt for the plant `env`, None: any; what `build` raises is a reason to refuse. Raises ValueError."""

    def checked(data):
        found = data["env"]
        if not (isinstance(found, str) and found.isidentifier()):
            raise ValueError("of no plant")
        if data["goal_input"] not in ("error", "goal"):
            raise ValueError(f"unknown goal_input {data['goal_input']!r}")
        if not all(
            (np.asarray(v, dtype=float) > 0).all()
            for name, v in data["scaling"].items()
            if name.endswith("scale")
        ):
            raise ValueError("scales that are not positive")
        if not all(v.isfinite().all() for network in ("actor", "critic") for v in data[network].values()):
            raise ValueError("weights that are not finite")
        return found, build(data) if env in (None, found) else None

    found, agent = read_file(
        path, FORMAT, "a checkpoint.pt of sac_her_branching.py", most=MAX_CHECKPOINT_BYTES, build=checked
    )
    if env not in (None, found):
        raise ValueError(f"{path} was trained on {found!r}, not on {env!r}; --env and --critic must match")
    return agent
