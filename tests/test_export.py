"""The controller in C: its actions against Python's, whatever is measured, its memory and what it refuses."""

import ctypes
import os
import re
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import untrained

import envs
import rl_mpc_deploy as deploy
from envs.control.compiled import WHEEL
from envs.control.export import COPIED, export_c
from envs.script.comparison import draws, run_episode
from experiments.speed import embedded
from experiments.speed.embedded import Exported, make

FIXTURES = Path(__file__).parent / "fixtures"
LIBRARIES = [f"-I{WHEEL}/include", "-I.", f"-L{WHEEL}", f"-Wl,-rpath,{WHEEL}", "-lhpipm", "-lblasfeo", "-lm"]
LATE = 2  # RL_MPC_LATE
C99 = (
    "memcpy",
    "memset",
    "memmove",
    "fmod",
    "rint",
    "sqrt",
    "exp",
    "tanh",
    "fmax",
    "fmin",
    "fabs",
    "pow",
    "sin",
    "cos",
)

pytestmark = pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("make")), reason="the controller is built by make and gcc"
)

CONFIGURED = {
    "the reactor": dict(horizon=2),
    "offset-free": dict(horizon=1, offset_free=True),
    "noise, c_A unmeasured": dict(horizon=1, estimator="ekf", measure=("sensors",), noise=0.005),
    "hard bounds, price of changes": dict(horizon=2, constraints="hard", change_weight=(1e-3, 0.0)),
    "branching twice": dict(horizon=2, robust_horizon=2),
    "double_pendulum": dict(horizon=2, robust_horizon=0),
    "linear": dict(horizon=2),
}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """{name: (folder, controller in Python, controller in C)}, each built when it is asked for."""
    found, folder = {}, tmp_path_factory.mktemp("export")

    def build(name):
        if name not in found:
            options = dict(CONFIGURED[name])
            if name in envs.names():
                critic = untrained(envs.load(name), folder / f"{name}.pt")
                options |= dict(env=name, critic=critic)
            found[name] = folder / name, *embedded.exported(folder / name, **options)
        return found[name]

    return build


@pytest.mark.parametrize("name", CONFIGURED)
def test_closed_loops_in_c_and_in_python_are_the_same(built, name):
    """Each on its own plant: what differs at one step would grow."""
    _, python, c = built(name)
    plant, noise = python.plant, CONFIGURED[name].get("noise", 0)
    for i, (x, psi) in enumerate(zip(*draws(plant, 5, 0))):
        rng = (np.random.default_rng(i) for _ in range(2))
        loops = [
            run_episode(each, plant, x, psi, each.goal, 40, noise, r) for each, r in zip((python, c), rng)
        ]
        difference = np.abs(loops[0][1] - loops[1][1]) / (plant.U_HIGH - plant.U_LOW)
        assert difference.max() <= 1e-12
        assert loops[0][2]["iterations"] == loops[1][2]["iterations"] > 0


def test_without_a_value_and_a_policy(tmp_path):
    """A planner of Python that no command line makes: the middle of the actions is a first guess."""
    plant = envs.load("cstr")
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    stage = ca.Function("stage", [x, g], [ca.sumsqr(x[1] - g)])
    mpc = deploy.ScenarioMPC(plant, 3, plant.SCENARIOS["mpc"][:2], stage, goal=0.6)
    export_c(mpc, tmp_path / "bounded", records=20)
    assert "20 of 20 actions" in make(tmp_path / "bounded")
    # nor bounds, nor uncertain parameters to speak of, with a goal per stage
    mpc = deploy.ScenarioMPC(plant, 3, plant.PSI_NOMINAL[None], stage, goal=0.6, slack_price=0.0)
    mpc.set_goal(np.full((1, 3), 0.6))
    export_c(mpc, tmp_path / "free", records=20)
    assert "20 of 20 actions" in make(tmp_path / "free", flags=f"{embedded.HERE} -Werror=int-conversion")
    assert mpc.goal.shape == (1, 3)


def test_a_deadline_of_the_command_line_does_not_reach_the_check(tmp_path):
    deploy.main(deploy.Args(horizon=1, deadline_ms=1e-3, export_c=tmp_path))
    assert "100 of 100 actions" in make(tmp_path)
    assert "RL_MPC_DEADLINE_MS 0.001" in (tmp_path / "rl_mpc.h").read_text()


def test_the_check_finds_what_differs(built, tmp_path):
    folder = shutil.copytree(built("the reactor")[0], tmp_path / "copy")
    assert re.search(r"100 of 100 .* difference 0.0e\+00", make(folder))
    data = (folder / "check_data.h").read_text()
    actions = re.findall(r"(\S+, \S+)(?:,\n|\};)", data)
    for action in actions[:2]:
        data = data.replace(action, "50.0, -4000.0", 1)
    (folder / "check_data.h").write_text(data)
    with pytest.raises(RuntimeError, match="98 of 100"):
        make(folder)


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_other_flags_round_otherwise_and_decide_alike(built, tmp_path, compiler):
    if not shutil.which(compiler):
        pytest.skip(f"no {compiler}")
    folder = shutil.copytree(built("the reactor")[0], tmp_path / "copy")
    make(folder, "clean")
    assert re.match(r"(99|100) of 100 actions", make(folder, compiler=compiler, flags="-O1", more=("FAST=",)))


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", ["the reactor", "noise, c_A unmeasured"])
def test_what_is_written_by_hand_is_plain_c99(built, name, compiler):
    if not shutil.which(compiler):
        pytest.skip(f"no {compiler}")
    flags = "-std=c99 -Wall -Wextra -pedantic -Werror -fsyntax-only".split()
    for source in COPIED:
        if source.endswith(".c"):
            command = [compiler, *flags, f"-I{WHEEL}/include", source]
            subprocess.run(command, cwd=built(name)[0], check=True)


@pytest.mark.parametrize("flag", ["-ffast-math", "-ffinite-math-only"])
@pytest.mark.parametrize("source", ["rl_mpc.c", "tree_qp.c"])
def test_fast_math_is_refused_where_it_would_do_harm(built, source, flag):
    command = ["gcc", flag, "-fsyntax-only", f"-I{WHEEL}/include", source]
    out = subprocess.run(command, cwd=built("the reactor")[0], capture_output=True, text=True)
    assert out.returncode and "without -ffast-math" in out.stderr


def test_flags_of_the_environment_do_not_reach_the_checks(built):
    run = dict(capture_output=True, text=True, check=True)
    for name in ("OWN", "FLAGS", "FAST"):
        command = ["make", "-nB", "-C", built("the reactor")[0], "tree_qp.o", "rl_mpc.o"]
        out = subprocess.run(command, env=os.environ | {name: "-ffast-math"}, **run).stdout
        assert "-c tree_qp.c" in out and "-ffast-math" not in out


def test_single_precision(built, tmp_path):
    """Plans cost the same, and files of both kinds do not link."""
    for name in ("the reactor", "noise, c_A unmeasured"):
        folder = shutil.copytree(built(name)[0], tmp_path / name)
        make(folder, "clean")
        costs = re.search(r"(\d+) costs within 1 %", make(folder, flags=f"{embedded.HERE} {embedded.SINGLE}"))
        assert int(costs[1]) >= 95
    for name in ("check", "check.o"):
        (folder / name).unlink()
    with pytest.raises(RuntimeError, match="undefined reference"):
        make(folder, "check")


@pytest.mark.parametrize("name", ["noise, c_A unmeasured", "double_pendulum"])
def test_impossible_measurements_under_sanitizers(built, name):
    """Two thousand of them: not-a-number, infinities, 1e300; the program checks actions and error codes itself."""
    folder, sources = built(name)[0], ["rl_mpc.c", "rl_mpc_functions.c", "tree_qp.c"]
    sanitizers = "-O1 -fsanitize=address,undefined -fno-sanitize-recover=all".split()
    command = ["gcc", *sanitizers, FIXTURES / "fuzz.c", *sources, *LIBRARIES, "-o", "fuzz"]
    subprocess.run(command, cwd=folder, check=True)
    out = subprocess.run([folder / "fuzz", "2000"], capture_output=True, text=True)
    assert out.returncode == 0, out.stdout + out.stderr
    steps, done, measurements, goals, planned, *others = map(int, re.findall(r"\d+", out.stdout))
    assert steps == done + measurements + goals and planned > 300 and sum(others) > 0 and goals > 0
    assert (measurements > 0) == (name == "double_pendulum")


def test_no_allocation_and_no_globals(built):
    run = dict(cwd=built("offset-free")[0], capture_output=True, text=True, check=True)
    for name in ("rl_mpc.o", "rl_mpc_functions.o", "tree_qp.o"):
        needs = subprocess.run(["nm", "-u", name], **run).stdout.split()
        assert not {"malloc", "calloc", "realloc", "free"} & set(needs)
        assert all(
            n.startswith(("d_tree_", "rl_mpc_", "tree_qp_", "_")) for n in needs if n not in ("U", *C99)
        )
        sections = subprocess.run(["size", "-A", name], **run).stdout
        assert re.findall(r"^\.(?:data|bss) +(\d+)", sections, re.MULTILINE) == ["0", "0"]


def test_memory_and_stack_are_what_the_header_says(built):
    folder, _, c = built("noise, c_A unmeasured")
    header = (folder / "rl_mpc.h").read_text()
    assert int(re.search(r"RL_MPC_MEMORY (\d+)", header)[1]) == len(c.memory)
    objects = ["rl_mpc.o", "rl_mpc_functions.o", "tree_qp.o"]
    command = ["gcc", "-pthread", FIXTURES / "stack.c", *objects, *LIBRARIES, "-o", "stack"]
    subprocess.run(command, cwd=folder, check=True)
    out = subprocess.run([folder / "stack"], capture_output=True, text=True, check=True).stdout
    nodes = int(re.search(r"RL_MPC_NODES (\d+)", header)[1])
    init, step = map(int, out.split())
    assert "The stack needs 8 kB, and in rl_mpc_init\n   another 150 bytes per node" in header
    assert 500 < step < 8192 and init < 8192 + 150 * nodes


def test_the_example_prints_the_closed_loop(built):
    folder = built("the reactor")[0]
    make(folder)
    lines = subprocess.run([folder / "example"], capture_output=True, text=True, check=True).stdout.split()
    assert lines[0] == "time,c_A,c_B,T_R,T_K,goal_c_B,F,Q_dot,rung,iterations,ms" and len(lines) == 101
    assert abs(float(lines[-1].split(",")[2]) - 0.65) < 0.05


def test_a_deadline_by_the_callers_clock(built):
    """A clock that goes a millisecond each time it is asked."""
    folder, python, _ = built("the reactor")
    c = Exported(folder, python)
    asked, x = iter(range(10**6)), python.plant.START
    clock = ctypes.CFUNCTYPE(ctypes.c_double)(lambda: next(asked))
    c.state.now_ms = ctypes.cast(clock, ctypes.c_void_p)
    for allowed in (0, 1, 2):
        c.reset()
        c.state.deadline_ms = allowed + 0.5
        c.make_step(x)
        assert c.info.stop == LATE and c.info.iterations == allowed
        assert (c.info.cost < c.info.guess_cost) == (allowed > 0)
    c.state.iterations, c.state.deadline_ms = 1, np.inf
    c.reset()
    c.make_step(x)
    assert c.info.iterations == 1


def test_two_controllers_do_not_meet_and_a_state_can_be_kept(built):
    folder, python, c = built("offset-free")
    other, plant = Exported(folder, python), python.plant
    (x, far), psi = draws(plant, 2, 3)[0], plant.PSI_NOMINAL
    other.set_goal(0.4)
    alone, together = [], []
    for actions, beside in ((alone, False), (together, True)):
        c.reset(), other.reset()
        now, there = x, far
        for _ in range(10):
            actions.append(c.make_step(now))
            if beside:
                there = plant.step(there, other.make_step(there), psi)
            now = plant.step(now, actions[-1], psi)
    np.testing.assert_array_equal(alone, together)
    kept = type(c.state).from_buffer_copy(c.state)
    expected = c.make_step(now)
    kept.work = other.state.work
    other.state = kept
    other.set_goal(c.goal)
    np.testing.assert_array_equal(other.make_step(now), expected)


@pytest.mark.parametrize(
    "options, said",
    [
        (dict(horizon=0), "--horizon 0"),
        (dict(estimator="particles"), "particles"),
        (dict(compile=False), "C compiler"),
        (dict(episodes=3), "--episodes 3 has no effect with --export-c"),
        (dict(horizon=1, export_c=Path("/proc/nowhere")), "cannot write there"),
    ],
)
def test_what_cannot_be_exported(tmp_path, options, said):
    with pytest.raises(ValueError, match=said):
        deploy.main(deploy.Args(**dict(export_c=tmp_path / "c") | options))
    assert not (tmp_path / "c").exists()


def test_a_folder_with_other_files_is_left_alone_and_an_export_replaced(built, tmp_path):
    (tmp_path / "README.md").write_text("precious")
    with pytest.raises(ValueError, match="holds other files"):
        deploy.main(deploy.Args(horizon=1, export_c=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    folder, python, _ = built("the reactor")
    export_c(python, folder, records=100)


def test_a_critic_that_observes_the_mismatch_is_not_exported(tmp_path):
    critic = Path(deploy.__file__).parent / "experiments/pretrained/cstr_offset_free.pt"
    with pytest.raises(ValueError, match="observes the mismatch"):
        deploy.main(deploy.Args(critic=critic, export_c=tmp_path / "c"))
