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


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory, plant):
    """An untrained but not trivial checkpoint.pt, written by the training script's own functions."""
    args = training.Args(seed=3)
    agent = training.SAC(args, plant, torch.device("cpu"))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in [*agent.actor.parameters(), *agent.critic.parameters()]:
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator) / np.sqrt(parameter.shape[-1])
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.pt"
    training.save(training.checkpoint(agent, training.plain(args), step=0), path)
    return path


@pytest.fixture(scope="session")
def quick(tmp_path_factory):
    """The whole reproduction on tiny budgets: a folder with results/, figures/, pretrained/ and runs/."""
    folder = tmp_path_factory.mktemp("quick")
    command = [sys.executable, "experiments/reproduce.py", "--quick", "--out", folder, "--runs", folder / "runs"]
    out = subprocess.run(command, cwd=Path(__file__).parent.parent, capture_output=True, text=True, timeout=1200)
    assert out.returncode == 0, out.stderr
    return folder
