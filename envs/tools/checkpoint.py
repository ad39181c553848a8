"""Reading a checkpoint.pt of sac_her_branching.py: data, never code, and refused in one sentence if it is anything else."""

import zipfile
from pathlib import Path

import torch

FORMAT = "rlmpc-sac-her-branching-1"
MAX_CHECKPOINT_BYTES = 10**9


def read_checkpoint(path, env, build):
    """`build(data)` of the file's data, for the plant `env`; what `build` raises is a reason to refuse. Raises ValueError."""
    path, found, agent = Path(path), None, None
    try:
        if path.stat().st_size > MAX_CHECKPOINT_BYTES:
            raise ValueError(f"larger than {MAX_CHECKPOINT_BYTES / 1e9:g} gigabytes")
        if zipfile.ZipFile(path).testzip():
            raise ValueError("damaged")
        data = torch.load(path, map_location="cpu", weights_only=True)
        if data["format"] != FORMAT:
            raise ValueError("of another format")
        found = data["env"]
        if not (isinstance(found, str) and found.isidentifier()):
            raise ValueError("of no plant")
        if found == env:
            agent = build(data)
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; it must be a checkpoint.pt written by sac_her_branching.py") from None
    except Exception as error:  # text, a folder, a pickle of code, weights that do not fit: torch raises many types
        reason = str(error) if type(error) is ValueError and "\n" not in str(error) else type(error).__name__
        raise ValueError(f"{path} is not a checkpoint.pt of sac_her_branching.py ({reason})") from None
    if found != env:
        raise ValueError(f"{path} was trained on {found!r}, not on {env!r}; --env and --critic must match")
    return agent
