import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
import torch

import envs
import sac_her_branching as training


@pytest.fixture(scope="session")
def plant():
    return envs.load("cstr")


def untrained(plant, path, **options):
    """An untrained but not trivial checkpoint.pt, written by the training script's own functions."""
    args = training.Args(seed=3, env=plant.name, **options)
    agent = training.SAC(args, plant)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in [*agent.actor.parameters(), *agent.critic.parameters()]:
            parameter += (
                0.3 * torch.randn(parameter.shape, generator=generator) / np.sqrt(parameter.shape[-1])
            )
    training.save(training.checkpoint(agent, training.plain(args), step=0), path)
    return path


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory, plant):
    return untrained(plant, tmp_path_factory.mktemp("checkpoint") / "checkpoint.pt")


def pytest_collection_modifyitems(items):
    """What looks at the whole reproduction comes last: it runs beside the other tests from the start."""
    items.sort(key=lambda item: "quick" in getattr(item, "fixturenames", ()))


@pytest.fixture(scope="session", autouse=True)
def reproduction(request, tmp_path_factory):
    """The process of the whole reproduction on tiny budgets, and its folder, if any test looks at it."""
    if not any("quick" in getattr(item, "fixturenames", ()) for item in request.session.items):
        yield None
        return
    folder = tmp_path_factory.mktemp("quick")
    command = [
        sys.executable,
        "experiments/reproduce.py",
        "--quick",
        "--out",
        folder,
        "--runs",
        folder / "runs",
    ]
    with open(folder / "log.txt", "w") as log:
        process = subprocess.Popen(
            command, cwd=Path(__file__).parent.parent, stdout=log, stderr=subprocess.STDOUT
        )
    yield process, folder
    process.terminate()


@pytest.fixture(scope="session")
def quick(reproduction):
    """What the whole reproduction on tiny budgets wrote: a folder with results/, figures/, pretrained/ and runs/."""
    process, folder = reproduction
    assert process.wait(timeout=1200) == 0, (folder / "log.txt").read_text()
    return folder
