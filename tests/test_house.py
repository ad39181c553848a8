"""What keeps the repository easy to read and to use: lengths of files, and what scripts do to those who import them."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch

import envs
import goal_mpc
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs.agents.evaluation import evaluation_row
from envs.control.compiled import compiled
from envs.script.comparison import write_csv
from envs.script.figure import draw_episode
from experiments import common
from experiments.reactor import tune

ROOT = Path(__file__).parent.parent
LINES = {"sac_her_branching.py": 520, "goal_mpc.py": 480, "rl_mpc_deploy.py": 640}
LINES |= {f"envs/{name}.py": 120 for name in ("cstr", "double_pendulum", "linear")}


@pytest.mark.parametrize("name, most", LINES.items())
def test_a_script_can_be_read_in_a_sitting(name, most):
    """As formatted at 110 columns, without exceptions from formatting."""
    text = (ROOT / name).read_text()
    assert len(text.splitlines()) <= most and "fmt: skip" not in text and "fmt: off" not in text


def test_the_readme_can_be_read_in_minutes():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 180 and len(text.split()) <= 1_800


def test_everything_is_formatted():
    ruff = [sys.executable, "-m", "ruff"]
    for command in (["format", "--check"], ["check"]):
        out = subprocess.run([*ruff, *command, "."], cwd=ROOT, capture_output=True, text=True)
        assert out.returncode == 0, out.stdout


def test_importing_scripts_and_drawing_leave_matplotlibs_backend_alone(tmp_path):
    code = "import matplotlib; matplotlib.use('svg'); import sac_her_branching, goal_mpc, rl_mpc_deploy; "
    code += f"goal_mpc.main(goal_mpc.Args(horizon=3, steps=3, compile=False, animate=True, out={str(tmp_path)!r})); "
    code += "print('backend', matplotlib.get_backend())"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert out.stdout.strip().splitlines()[-1] == "backend svg", out.stderr
    assert {"episode.png", "episode.gif"} <= {path.name for path in tmp_path.iterdir()}


def test_a_state_with_one_bound_is_drawn(tmp_path, monkeypatch):
    """Whichever side has it, and the bound is in the legend."""
    drawn = []
    monkeypatch.setattr(
        matplotlib.figure.Figure, "savefig", lambda figure, *args, **options: drawn.append(figure)
    )
    plant = envs.load("cstr")
    for low, high in ((np.full(4, -np.inf), plant.X_HIGH), (plant.X_LOW, np.full(4, np.inf))):
        bounded = type(
            "Bounded", (), {"__getattr__": lambda _, name: getattr(plant, name), "X_LOW": low, "X_HIGH": high}
        )()
        x, u = np.tile(plant.START, (4, 1)), np.tile(plant.U_LOW, (3, 1))
        draw_episode(bounded, {"closed loop": (x, u, {})}, np.full((3, 1), 0.65), tmp_path / "x.png")
        titles = [ax.get_title(loc="left") for ax in drawn[-1].axes if ax.get_visible()]
        assert len(titles) == 6 and "bound" in [text.get_text() for text in drawn[-1].legends[0].get_texts()]


def test_arguments_from_python_are_those_of_the_command_line():
    """Lists, arrays, text and single numbers where the command line has tuples and paths."""
    args = deploy.Args(
        out="x", critic="x.pt", goal=[0.6], change_weight=np.array([1.0, 2.0]), seed=np.int64(3)
    )
    assert args == deploy.Args(
        out=Path("x"), critic=Path("x.pt"), goal=(0.6,), change_weight=(1.0, 2.0), seed=3
    )
    given = training.Args(num_envs=16.0, hidden=(np.int64(8), 8.0), learning_rate=np.array(1e-3), out="x")
    assert given == training.Args(num_envs=16, hidden=(8, 8), learning_rate=1e-3, out=Path("x"))
    for goal in (0.7, [0.7], np.array([0.7]), np.float64(0.7), "0.7"):
        assert goal_mpc.Args(env="cstr", goal=goal) == goal_mpc.Args(env="cstr", goal=("0.7",))
    for wrong in (
        dict(num_envs=16.5),
        dict(seed=True),
        dict(hidden=("8",)),
        dict(smooth_reward="no"),
        dict(out=3),
    ):
        with pytest.raises(ValueError, match="it must be"):
            training.Args(**wrong)
    assert deploy.Args(goal=torch.tensor([0.5])).goal == (0.5,)
    study = tune.Args(out="x", runs="y", jobs=2.0)  # inherited fields, too
    common.as_annotated(study)
    assert (study.out, study.runs, study.jobs) == (Path("x"), Path("y"), 2)
    assert hash(args) and deploy.Args(goal=0.6).goal == (0.6,)
    assert goal_mpc.Args(goal="0.7", out="x") == goal_mpc.Args(goal=("0.7",), out=Path("x"))
    assert training.Args(hidden=[32, 16], out="x").hidden == (32, 16)


def test_the_latest_critic(tmp_path, monkeypatch, checkpoint):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="--critic latest"):
        deploy.check(deploy.Args(critic="latest"))
    for i, name in enumerate(
        ("cstr__sac_her_branching__0__1", "cstr__sac_her_branching__1__0", "linear__sac_her_branching__0__9")
    ):
        path = tmp_path / "runs" / name / "checkpoint.pt"
        path.parent.mkdir(parents=True)
        path.write_bytes(checkpoint.read_bytes())
        os.utime(path, (i, i))
    assert deploy.critic_path(deploy.Args(critic="latest")).parent.name == "cstr__sac_her_branching__1__0"
    assert deploy.check(deploy.Args(critic="latest"))[0].name == "cstr"


def test_a_training_that_diverged_says_so(checkpoint):
    policy = training.load_policy(checkpoint)
    with torch.no_grad():
        policy.actor.head.bias += np.nan
    with pytest.raises(ValueError, match="diverged"):
        evaluation_row(policy, 3)


@pytest.mark.skipif(not any(map(__import__("shutil").which, ("gcc", "clang", "cc"))), reason="no C compiler")
@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[:-1] + b"x"]
)
def test_a_damaged_library_in_the_cache_is_built_again(damage, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library = compiled("double twice(double x) { return 2 * x; }")
    whole = library.read_bytes()
    library.write_bytes(damage(whole))
    code = f"import ctypes; f = ctypes.CDLL({str(library)!r}).twice; f.restype = ctypes.c_double; print(f(ctypes.c_double(3)))"
    assert compiled("double twice(double x) { return 2 * x; }") == library
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "6.0"
    )
    assert library.stat().st_size == len(whole)


def test_tables_are_utf8_whatever_the_locale(tmp_path):
    code = "from envs.script.comparison import write_csv; from pathlib import Path; write_csv([{'unit': chr(176) + 'C'}], Path('t.csv'))"
    environment = os.environ | {
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONPATH": str(ROOT),
    }
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert out.returncode == 0, out.stderr
    assert next(csv.DictReader(open(tmp_path / "t.csv", encoding="utf-8")))["unit"] == "°C"
    write_csv([{"unit": "°C"}], tmp_path / "t.csv")


def test_the_action_that_a_plant_gets_now_can_be_told():
    """The price of changes counts from it."""
    loops = []
    for u in (None, [80.0, -1000.0]):
        mpc = deploy.build_controller("nominal_mpc", deploy.Args(compile=False))
        mpc.reset(u=u)
        loops.append(mpc.make_step(envs.load("cstr").START))
        np.testing.assert_array_equal(mpc.reset(u=u) or mpc.u_before, np.zeros(2) if u is None else u)
    assert np.abs(loops[0] - loops[1]).max() > 0
    for bad in ([1.0], [np.nan, 0.0], [[80.0], [-1000.0]]):
        with pytest.raises(ValueError, match="u is"):
            mpc.reset(u=bad)
