"""What a plant module may look like, and what becomes of one that is wrong; copies, real clients, shapes."""

import copy
import importlib
import pickle
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import envs
import goal_mpc
from envs import cstr
from envs.plant import KEYS

ROOT = Path(__file__).parent.parent
SMALLEST = """
import numpy as np
from envs.plant import stack
ENV_ID, DT = "Test/{name}-v0", 0.1
STATE_NAMES, STATE_UNITS = ("p", "v"), ("m", "m/s")
X_LOW, X_HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])
ACTION_NAMES, ACTION_UNITS, U_LOW, U_HIGH = ("a",), ("m/s^2",), np.array([-1.0]), np.array([1.0])
GOAL_INDEX, TRAIN_GOALS, EVAL_GOAL = [0], np.array([[0.5], [1.0]]), np.array([0.7])
def ode(x, u, psi, xp=np):
    return stack(xp, [x[1], u[0] - x[1] - x[0]])
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A second folder of plants: `folder(name, text, old, new)` writes one."""
    monkeypatch.setattr(envs, "__path__", [*envs.__path__, str(tmp_path)])
    envs._load.cache_clear()

    def write(name, old="", new="", text=SMALLEST):
        assert old in text
        text = text.replace(old, new) if old else text
        (tmp_path / f"{name}.py").write_text(text.replace("{name}", name))
        sys.modules.pop(f"envs.{name}", None)
        importlib.invalidate_caches()
        return name

    yield write
    envs._load.cache_clear()


def test_the_fewest_names_make_a_plant(folder):
    """15 names, nothing uncertain: it simulates, trains, plans."""
    plant = envs.load(folder("smallest"))
    x = plant.step(np.array([0.0, 0.5]), np.array([0.2]), plant.PSI_NOMINAL)
    assert x.shape == (2,) and plant.SCENARIOS["robust"].shape == plant.EVAL_PSI.shape == (1, 0)
    env, vec = envs.GoalEnv("smallest"), envs.VectorGoalEnv("smallest", 3)
    assert env.reset(seed=0)[0]["desired_goal"][0] in (0.5, 1.0) and vec.reset(seed=0)[0][
        "observation"
    ].shape == (3, 2)
    for robust_horizon in (0, 1):  # psi has no entries
        mpc = goal_mpc.build_controller(
            goal_mpc.Args(env="smallest", horizon=15, robust_horizon=robust_horizon, compile=False)
        )
        for _ in range(80):
            x = plant.step(x, mpc.make_step(x), plant.PSI_NOMINAL)
        assert x[0] == pytest.approx(0.7, abs=0.02)


def test_uncertain_parameters_make_the_scenario_sets(folder):
    text = (
        SMALLEST
        + "PSI_NOMINAL, PSI_LOW, PSI_HIGH = np.ones(2), np.array([0.95, 0.9]), np.array([1.05, 1.1])\n"
    )
    plant = envs.load(folder("uncertain", text=text))
    np.testing.assert_array_equal(plant.SCENARIOS["mpc"], cstr.SCENARIOS["mpc"])
    np.testing.assert_allclose(plant.SCENARIOS["robust"], cstr.SCENARIOS["robust"])
    assert plant.EVAL_PSI.shape == (49, 2) and plant.PSI_NAMES == ("psi_1", "psi_2")


def test_a_state_that_always_starts_at_one_value(folder):
    text = SMALLEST + "INIT_LOW, INIT_HIGH = np.array([-1.0, 0.0]), np.array([1.0, 0.0])\n"
    plant = envs.load(folder("at_rest", text=text))
    mpc = goal_mpc.build_controller(goal_mpc.Args(env="at_rest", horizon=10, compile=False))
    mpc.make_step(plant.START)
    assert mpc.stats["rung"] == "solved"


WRONG = {
    '"Test/{name}-v0", 0.1': ('"Test/{name}-v0", -0.1', "DT is -0.1"),
    'ENV_ID, DT = "Test/{name}-v0", 0.1': ('ENV_ID = "Test/{name}-v0"', "lacks DT"),
    "def ode": ("def equations", "lacks ode"),
    "np.array([2.0, 1.0])": ("np.array([2.0, 1.0, 3.0])", "X_HIGH has shape"),
    "X_HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])": (
        "X_HIGH = np.array([-2.0, -np.inf]), np.array([2.0, np.inf])",
        "INIT_LOW.*finite.*give INIT_LOW",
    ),
    '("m", "m/s")': ('("m",)', "STATE_UNITS are 1"),
    "np.array([-1.0]), np.array([1.0])\nGOAL": (
        "np.array([1.0]), np.array([1.0])\nGOAL",
        "U_LOW is .* not in order",
    ),
    "GOAL_INDEX, TRAIN_GOALS, EVAL_GOAL = [0]": ("GOAL_INDEX, TRAIN_GOALS, EVAL_GOAL = [2]", "GOAL_INDEX"),
    "np.array([0.7])": ("np.array([np.nan])", "EVAL_GOAL"),
    "np.array([[0.5], [1.0]])": ("np.array([0.5, 1.0])", "TRAIN_GOALS has shape"),
    "u[0] - x[1] - x[0]": ("u[1] - x[1]", "a step from START fails .IndexError"),
    "[x[1], u[0] - x[1] - x[0]]": ("[x[1]]", "ode at START gives"),
    "import numpy as np": ("import numpy as np, no_such_module", "cannot be imported .ModuleNotFoundError"),
    "def ode(x, u, psi, xp=np):": ("def ode(x, u, psi, xp=np)", "cannot be imported .SyntaxError"),
}


@pytest.mark.parametrize("number", range(len(WRONG)))
def test_a_plant_that_is_wrong_is_refused_by_name_and_harms_no_other(folder, number):
    old, (new, words) = list(WRONG.items())[number]
    name = folder(f"wrong_{number}", old, new, text=SMALLEST)
    with pytest.raises(ValueError, match=words) as error:
        envs.load(name)
    assert f"envs/{name}.py" in str(error.value)
    assert envs.load("cstr").name == "cstr" and name in envs.names()


ADDED = {
    "INIT_LOW, INIT_HIGH, GOAL_LOW, GOAL_HIGH = [0.5, -1], [0.5, 1], [0.5], [0.5]; TRAIN_GOALS, EVAL_GOAL = [[0.5]], [0.5]": (
        "ERROR_SCALE is .0.0.; it must be positive"
    ),
    "ERROR_SCALE = [-1.0]": "ERROR_SCALE is .-1.0.; it must be positive",
    "MISMATCH_SCALE = [0.1]": "MISMATCH_SCALE has shape",
    "METRIC_SIGMA2 = 0": "METRIC_SIGMA2 is 0; it must be positive",
    "MPC_SIGMA2 = 'wide'": "MPC_SIGMA2 is 'wide'; it must be a positive number",
    "EPISODE_STEPS = 0": "EPISODE_STEPS is 0; it must be a whole number",
    "MODEL_SUBSTEPS = 1.5": "MODEL_SUBSTEPS is 1.5; it must be a whole number",
    "GOAL_INDEX = [0.0]": "GOAL_INDEX is .0.0.; it must be different indices",
    "MEASURED = 'x'": "MEASURED is",
    "STATE_NAMES = 'p', 'p'": "STATE_NAMES is .*each may be there once",
    "GOALS = {'far': [0.1, 0.2]}": "GOALS.'far'. has shape",
    "GOAL_LOW, GOAL_HIGH = [0.0], [0.6]": "EVAL_GOAL .0.7. is not within GOAL_LOW",
    "GOAL_LOW = [0.0]": "GOAL_LOW and GOAL_HIGH belong together",
    "OBS_LOW, OBS_HIGH = [-1, -1], [1, 1]": "INIT_LOW .* is not within OBS_LOW",
    "PSI_NOMINAL, PSI_LOW, PSI_HIGH = [2.0], [0.0], [1.0]": "PSI_NOMINAL .* is not within PSI_LOW",
    "X_LOW = 'low'": "X_LOW is 'low'",
    "SCENARIOS = [1.0]": "SCENARIOS is",
    "def step(x, u, psi):\n    return x[:1]": "step at START gives",
    "TRAINING = dict(gama=0.9)": "TRAINING has gama; it takes hidden, .*gamma",
    "raise SystemExit": "cannot be imported .SystemExit",
    "ENV_ID = 'A plant'": "ENV_ID is 'A plant', which gymnasium refuses; it must be one text such as 'Word/Word-v0'",
    "ENV_ID = 'RLMPC/' + 'Tank-v0'": "ENV_ID is 'RLMPC/', which gymnasium refuses",
    "ENV_ID = 'CartPole-v1'": "ENV_ID is 'CartPole-v1', which is already that of another environment",
    "DT = [0.1, 0.2]": "DT is .0.1, 0.2.; it must be a positive number",
    "REWARD_SIGMA2 = [1.0, 2.0]": "REWARD_SIGMA2 is .* it must be a positive number",
    "METRIC_SIGMA2 = np.inf": "METRIC_SIGMA2 is inf; it must be positive and finite",
    "GOAL_REACHABLE = [[0.1]]": "GOAL_REACHABLE is ..0.1..; it must be 1 lowest",
    "GOAL_REACHABLE = [0.9], [0.1]": "GOAL_REACHABLE is ..0.9., .0.1..; it must be",
    "BENCHMARK = None": "BENCHMARK is None; it must be a dict",
}


@pytest.mark.parametrize("number", range(len(ADDED)))
def test_a_name_that_is_wrong_is_refused_by_name(folder, number):
    line, words = list(ADDED.items())[number]
    text = (
        SMALLEST.replace('ENV_ID, DT = "Test/{name}-v0", 0.1', "DT = 0.1") if "ENV_ID" in line else SMALLEST
    )
    with pytest.raises(ValueError, match=words) as error:
        envs.load(folder(f"added_{number}", text=f"{text}\n{line}\n"))
    assert "\n" not in str(error.value) and f"envs/added_{number}.py" in str(error.value)
    assert envs.load("cstr").name == "cstr"


def test_a_plant_may_set_what_training_takes_from_it(folder):
    import sac_her_branching as training

    assert set(KEYS["TRAINING"]) == set(training.DEFAULTS)
    for name, value in training.DEFAULTS.items():
        plant = folder(f"sets_{name}", text=f"{SMALLEST}\nTRAINING = dict({name}={value})\n")
        assert getattr(training.Args(env=plant), name) == value


def test_lists_and_numpys_numbers_make_the_same_plant(folder, tmp_path):
    """Whatever a plant names its constants with, they are copies, and what is trained on it is plain data."""
    import sac_her_branching as training

    text = SMALLEST.replace(
        "GOAL_INDEX, TRAIN_GOALS, EVAL_GOAL = [0]", "GOAL_INDEX, TRAIN_GOALS, EVAL_GOAL = np.array([0])"
    )
    text = text.replace("np.array([-2.0, -1.0]), np.array([2.0, 1.0])", "[-2, -1], (2, 1)").replace(
        "np.array([0.7])", "[0.7]"
    )
    plant = envs.load(folder("lists", text=text))
    twin = envs.load(folder("arrays"))
    for name in ("X_LOW", "INIT_HIGH", "EVAL_GOAL", "GOAL_INDEX", "ERROR_SCALE", "START"):
        np.testing.assert_array_equal(getattr(plant, name), getattr(twin, name))
    arrays = [id(value) for value in vars(twin).values() if isinstance(value, np.ndarray)]
    assert len(set(arrays)) == len(arrays) >= 15
    sys.modules["envs.arrays"].X_HIGH[:] = 9
    assert twin.X_HIGH[0] == twin.INIT_HIGH[0] == 2
    hidden, rate = (np.int64(8), np.int64(8)), np.array(1e-3)
    args = training.Args(
        env="lists", hidden=hidden, learning_rate=rate, total_timesteps=64, out=str(tmp_path)
    )
    assert training.load_policy(training.main(args) / "checkpoint.pt").plant is plant
    mpc = goal_mpc.build_controller(goal_mpc.Args(env="lists", horizon=5, goal=0.6, compile=False))
    assert np.isfinite(mpc.make_step(plant.START)).all()


def test_a_goal_whose_state_always_starts_at_one_value(folder):
    """A tank that starts empty: the range of goals says what is a large error."""
    text = SMALLEST + "INIT_LOW, INIT_HIGH, GOAL_LOW, GOAL_HIGH = [0.0, -1.0], [0.0, 1.0], [0.0], [1.0]\n"
    plant = envs.load(folder("empty", text=text))
    assert plant.percentage_error(np.array([0.5]), np.array([1.0])) == 100
    args = goal_mpc.Args(env="empty", objective="quadratic", horizon=15, compile=False)
    mpc, x = goal_mpc.build_controller(args), plant.START
    for _ in range(80):
        x = plant.step(x, mpc.make_step(x))
    assert mpc.stats["rung"] == "solved" and x[0] == pytest.approx(0.7, abs=0.02)


def test_whatever_else_lies_in_the_folder_does_no_harm(folder, tmp_path):
    (tmp_path / ".#cstr.py").symlink_to("nobody@nowhere:1")
    (tmp_path / "gone.py").symlink_to("nowhere")
    (tmp_path / "a_folder.py").mkdir()
    folder("notes", text='"""How ENV_ID works:\nENV_ID = "RLMPC/CSTR-v0"\n"""\n')
    assert envs.names() == ["cstr", "double_pendulum", "linear"] and envs.load("cstr").name == "cstr"
    shutil.copytree(ROOT / "envs", tmp_path / "here/envs")  # and while envs is imported
    for path in (tmp_path / ".#cstr.py", tmp_path / "gone.py"):
        (tmp_path / "here/envs" / path.name).symlink_to("nowhere")
    for number, env_id in enumerate(("My plant", "Tank-v0/", "RLMPC/CSTR", "Tank", "CartPole-v1")):
        (tmp_path / f"here/envs/odd_{number}.py").write_text(f"ENV_ID = {env_id!r}\nraise SystemExit\n")
    code = "import envs; print(envs.__path__, envs.load('cstr'), len(envs.names()))"
    out = subprocess.run([sys.executable, "-c", code], cwd=tmp_path / "here", capture_output=True, text=True)
    assert str(tmp_path) in out.stdout and "<plant cstr> 8" in out.stdout, out.stderr


def test_other_files_are_no_plants_and_two_of_one_id_are_refused(folder):
    folder("helper", text="VALUE = 1\n")
    assert "helper" not in envs.names() and "plant" not in envs.names()
    folder("cstr_old", text=Path(cstr.__file__).read_text())
    for name in ("cstr", "cstr_old"):
        with pytest.raises(ValueError, match="envs/cstr.py and envs/cstr_old.py have the same ENV_ID"):
            envs.load(name)
    assert envs.load("linear").name == "linear"


def test_importing_envs_imports_no_plant_and_registers_all():
    code = "import sys, envs, gymnasium as gym; assert not {'envs.cstr', 'envs.linear', 'casadi', 'torch'} & set(sys.modules); "
    code += (
        "print(gym.make('RLMPC/CSTR-v0').reset(seed=0)[0]['observation'].shape, 'envs.linear' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert out.stdout.split("\n")[0] == "(4,) False", out.stderr


@pytest.mark.parametrize("name", ["cstr", "double_pendulum", "linear"])
def test_plants_and_environments_can_be_copied_and_pickled(name):
    plant = envs.load(name)
    for twin in (copy.copy(plant), copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        np.testing.assert_array_equal(twin.X_LOW, plant.X_LOW)
        np.testing.assert_array_equal(
            twin.step(plant.START, plant.U_LOW, plant.PSI_NOMINAL),
            plant.step(plant.START, plant.U_LOW, plant.PSI_NOMINAL),
        )
    for env in (envs.GoalEnv(name), envs.VectorGoalEnv(name, 3)):
        env.reset(seed=3)
        action = np.broadcast_to(plant.U_LOW, env.action_space.shape)
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        expected = env.step(action)[0]["observation"]
        for twin in twins:
            np.testing.assert_array_equal(twin.step(action)[0]["observation"], expected)


def test_a_mismatch_can_be_copied_and_pickled():
    plant = envs.load("cstr", observe_mismatch=True)
    for twin in (copy.copy(plant), copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        np.testing.assert_array_equal(twin.OBS_HIGH, plant.OBS_HIGH)
        assert twin.EPISODE_STEPS == 50
    with pytest.raises(AttributeError):
        _ = plant.NO_SUCH_NAME


def test_stable_baselines3s_own_helper_works_and_render_mode_is_ignored():
    from stable_baselines3.common.env_util import make_vec_env

    vec = make_vec_env("RLMPC/CSTR-v0", n_envs=2)
    assert vec.reset()["observation"].shape == (2, 4)
    assert gym.make_vec("RLMPC/CSTR-v0", num_envs=2, vectorization_mode="sync").reset(seed=0)[0][
        "observation"
    ].shape == (2, 4)


def test_an_episode_is_truncated_after_its_steps():
    for env, steps in (
        (gym.make("RLMPC/CSTR-v0"), 50),
        (gym.make("RLMPC/CSTR-v0", max_episode_steps=7), 7),
        (envs.GoalEnv("cstr"), 50),
    ):
        env.reset(seed=0)
        ends = [env.step(np.array([20.0, -1000.0], dtype=np.float32))[3] for _ in range(steps)]
        assert ends == [False] * (steps - 1) + [True]


def test_actions_of_another_shape_are_refused():
    vec, env = envs.VectorGoalEnv("double_pendulum", 3), envs.GoalEnv("cstr")
    vec.reset(seed=0), env.reset(seed=0)
    for bad in (np.array([-5.0, 0.0, 5.0]), np.zeros((1, 1)), np.zeros((3, 2)), np.full((3, 1), np.nan)):
        with pytest.raises(ValueError, match="action"):
            vec.step(bad)
    for bad in (0.0, [1.0], np.zeros((1, 2)), [np.nan, 0.0]):
        with pytest.raises(ValueError, match="action"):
            env.step(bad)


def test_what_numpy_would_broadcast_is_refused():
    """Three forces for three pendulums of one force each, in a row."""
    pendulum, linear, cstr_plant = envs.load("double_pendulum"), envs.load("linear", dim=4), envs.load("cstr")
    three = np.tile(pendulum.START, (3, 1))
    assert pendulum.step(three, np.array([[-5.0], [0.0], [5.0]]), np.ones((3, 3))).shape == (3, 6)
    for plant, given in (
        (pendulum, (three, np.array([-5.0, 0.0, 5.0]), np.ones((3, 3)))),
        (pendulum, (three, np.zeros((3, 1)), np.ones((3, 1)))),
        (linear, (linear.START, [1.0])),
        (cstr_plant, (cstr_plant.START[:1], cstr_plant.U_LOW)),
    ):
        with pytest.raises(ValueError, match="has shape"):
            plant.step(*given)
    for plant, achieved, goal in ((pendulum, (3, 2), (1,)), (cstr_plant, (3, 1), (3,))):
        with pytest.raises(ValueError, match="shapes"):
            envs.GoalEnv(plant.name).compute_reward(np.zeros(achieved), np.zeros(goal))
        with pytest.raises(ValueError, match="shapes"):
            envs.time_near_goal(plant, np.zeros(achieved), np.zeros(goal))
    observed = envs.load("cstr", observe_mismatch=np.ones(4))
    assert observed.step(np.zeros(8) + observed.INIT_HIGH, cstr.U_LOW).shape == (8,)
    assert envs.load("cstr", observe_mismatch=np.bool_(True)).MISMATCH_SCALE[0] == 0.02
    for scale in ([1.0, 2.0], 0.5, [-1.0, 1.0, 1.0, 1.0]):
        with pytest.raises(ValueError, match="scale of the mismatch"):
            envs.load("cstr", observe_mismatch=scale)


def test_environments_refuse_what_cannot_be():
    vec, env = envs.VectorGoalEnv("cstr", 3), envs.GoalEnv("cstr")
    for made in (vec, env):
        with pytest.raises(ValueError, match="reset: goal is .* it must lie in"):
            made.reset(options={"goal": [50.0]})
    vec.reset(seed=0)
    some = {
        "reset_mask": [True, False, True],
        "goal": [[0.7], [0.0], [0.8]],
    }  # the one between stays as it is
    goals = vec.reset(options=some)[0]["desired_goal"].ravel()
    assert goals[0] == 0.7 and goals[2] == 0.8 and goals[1] in (0.6, 0.7, 0.8)
    with pytest.raises(ValueError, match="reset_mask"):
        vec.reset(options={"reset_mask": np.array([0, 1, 0])})
    for wrong in (
        dict(num_envs=0),
        dict(branches=-1),
        dict(max_episode_steps=-1),
        dict(reward_sigma2=-1.0),
        dict(reward_tolerance=0.0),
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            envs.VectorGoalEnv("cstr", **wrong)


def test_the_states_that_a_step_reached_are_told_from_those_of_the_next_episode():
    """By this repository's batch and by gymnasium's own, where plants end at different times."""
    mode = gym.vector.AutoresetMode.SAME_STEP
    makers = [partial(gym.make, "RLMPC/CSTR-v0", max_episode_steps=steps) for steps in (2, 3)]
    theirs = gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
    for vec in (theirs, envs.VectorGoalEnv("cstr", 2, max_episode_steps=2)):
        obs, _ = vec.reset(seed=0, options={"psi": cstr.PSI_NOMINAL})
        for _ in range(7):
            before = obs["observation"].copy()
            obs, _, _, _, infos = vec.step(np.tile([20.0, -1000.0], (2, 1)).astype(np.float32))
            nominal = cstr.step(before, np.tile([20.0, -1000.0], (2, 1)), np.ones((2, 2)))
            reached = envs.reached_states(obs, infos)
            assert (np.abs(reached - nominal) < [0.2, 0.2, 5, 5]).all()  # a new episode starts far away


def test_the_batch_starts_where_it_is_told_to_as_the_single_environment_does():
    state, goal, psi = np.array([0.8, 0.5, 130.0, 129.0]), np.array([0.7]), np.array([1.02, 0.95])
    options = {"state": state, "goal": goal, "psi": psi}
    env, vec = envs.GoalEnv("cstr"), envs.VectorGoalEnv("cstr", 2)
    for made in (env, vec):
        obs, _ = made.reset(seed=1, options=options)
        np.testing.assert_array_equal(np.atleast_2d(obs["observation"])[-1], state)
    action = np.array([20.0, -1000.0])
    single = [env.step(action)[0]["observation"] for _ in range(3)]
    batch = [vec.step(np.tile(action, (2, 1)))[0]["observation"][1] for _ in range(3)]
    np.testing.assert_allclose(batch, single, rtol=1e-12)
    state[:] = psi[:] = 0  # what was given was copied
    assert np.isfinite(env.step(action)[0]["observation"]).all()
    each = np.array([[0.8, 0.5, 130.0, 129.0], [0.9, 0.6, 120.0, 119.0]])
    np.testing.assert_array_equal(vec.reset(options={"state": each})[0]["observation"], each)
    for bad in (
        {"state": [1.0, 2.0]},
        {"goal": [0.6, 0.6]},
        {"psi": [np.nan, 1.0]},
        {"state": np.zeros((3, 4))},
    ):
        with pytest.raises(ValueError, match=f"reset: {next(iter(bad))}"):
            vec.reset(options=bad)


def test_a_benchmark_names_what_it_changes(folder):
    """The rest keeps its default, in training and in planners alike."""
    horizon = envs.load(folder("horizon", text=SMALLEST + 'BENCHMARK = {"horizon": 3}\n')).BENCHMARK
    assert horizon["horizon"] == 3 and np.isinf(horizon["slack_price"]).all()
    with pytest.raises(ValueError, match="BENCHMARK has prices"):
        envs.load(folder("price", text=SMALLEST + 'BENCHMARK = {"prices": 3}\n'))


def test_goals_of_a_slow_plant_are_found(folder):
    """A time constant of 300 steps: the levels that an action holds are reached late."""
    slow = "x[1], u[0] - x[1] - x[0]", "(u[0] - x[0]) / 30, x[0] - x[1]"
    low, high = envs.reachable_goals(envs.load(folder("slow", *slow)), actions=41, steps=6000)
    np.testing.assert_allclose([*low, *high], [-1, 1], atol=0.01)


def test_reachable_goals_are_held():
    plant = envs.load("cstr")
    (low,), (high,) = envs.reachable_goals(plant, actions=400, steps=300)
    assert 0.31 <= low < 0.65 < high <= 0.80 + 1e-3
    for name in ("double_pendulum", "linear"):
        with pytest.raises(ValueError, match="one goal"):
            envs.reachable_goals(envs.load(name))


def test_an_economic_cost_decides_where_a_goal_is_held(folder, tmp_path):
    """A double integrator with two inputs, whose goal says nothing about the second state."""
    import rl_mpc_deploy as deploy
    import sac_her_branching as training

    two = SMALLEST.replace(
        '("a",), ("m/s^2",), np.array([-1.0]), np.array([1.0])',
        '("a", "b"), ("-", "-"), -np.ones(2), np.ones(2)',
    )
    two = two.replace("[x[1], u[0] - x[1] - x[0]]", "[u[0] - x[0], u[1] - x[1]]")
    held = []
    for name, cost in (("plain", ""), ("economic", "def economic_cost(x, xp=np):\n    return -0.1 * x[1]\n")):
        args = training.Args(env=folder(name, text=two + cost), hidden=(8,))
        agent = training.SAC(args, envs.load(name))
        training.save(training.checkpoint(agent, args, 0), tmp_path / f"{name}.pt")
        settings = deploy.Args(
            env=name, critic=tmp_path / f"{name}.pt", horizon=5, compile=False, controllers=("goal_mpc",)
        )
        mpc, x = deploy.build_controller("goal_mpc", settings), np.array([0.6, 0.0])
        for _ in range(40):
            x = mpc.plant.step(x, mpc.make_step(x), mpc.plant.PSI_NOMINAL)
        held.append(x)
    assert np.abs(np.array(held)[:, 0] - 0.7).max() < 0.02
    assert held[0][1] < 0.5 < 0.9 < held[1][1]
