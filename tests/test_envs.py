"""The plant against a stiff integrator, the three array libraries, and real clients of gymnasium environments."""

import itertools
import warnings

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp

import envs
from envs import cstr
from envs.script.comparison import new_folder


def random_points(n, seed=0):
    rng = np.random.default_rng(seed)
    x = envs.sample_states(cstr, rng, n)
    u = rng.uniform(cstr.U_LOW, cstr.U_HIGH, size=(n, 2))
    psi = rng.uniform([0.95, 0.9], [1.05, 1.1], size=(n, 2))
    return x, u, psi


def corner_points():
    ends = [*zip(cstr.X_LOW, cstr.X_HIGH), *zip(cstr.U_LOW, cstr.U_HIGH), (0.95, 1.05), (0.9, 1.1)]
    points = np.array(list(itertools.product(*ends)))
    return points[:, :4], points[:, 4:6], points[:, 6:]


@pytest.mark.parametrize("points", [random_points(200), corner_points()], ids=["random", "corners"])
def test_step_agrees_with_a_stiff_integrator(points):
    x, u, psi = points
    exact = np.array(
        [
            solve_ivp(
                lambda _, y, i=i: cstr.ode(y, u[i], psi[i]),
                (0, cstr.DT),
                x[i],
                method="LSODA",
                rtol=1e-10,
                atol=1e-11,
            ).y[:, -1]
            for i in range(len(x))
        ]
    )
    for substeps, allowed in ((8, 5e-6), (4, 6e-5)):
        error = np.abs(cstr.step(x, u, psi, substeps) - exact) / (cstr.X_HIGH - cstr.X_LOW)
        assert error.max() < allowed, (substeps, error.max())


def test_the_same_lines_serve_numpy_torch_and_casadi():
    x, u, psi = random_points(7)
    expected = cstr.ode(x.T, u.T, psi.T)
    in_torch = cstr.ode(*(torch.tensor(a.T) for a in (x, u, psi)), xp=torch).numpy()
    symbols = [ca.SX.sym(name, n) for name, n in (("x", 4), ("u", 2), ("psi", 2))]
    in_casadi = np.array(ca.Function("f", symbols, [cstr.ode(*symbols, xp=ca)]).map(7)(x.T, u.T, psi.T))
    np.testing.assert_allclose(in_torch, expected, rtol=1e-12)
    np.testing.assert_allclose(in_casadi, expected, rtol=1e-12)


def test_known_steady_state():
    """Feeding at F = 10 1/h without cooling: where the derivative vanishes, step does not move."""
    u, psi = np.array([10.0, 0.0]), cstr.PSI_NOMINAL
    x = np.array([0.8, 0.6, 130.0, 130.0])
    for _ in range(4000):
        x = cstr.step(x, u, psi)
    assert np.abs(cstr.ode(x, u, psi)).max() < 1e-8
    assert x[2] == pytest.approx(x[3], abs=1e-9)  # no cooling: coolant and reactor in equilibrium
    assert 0 < x[0] + x[1] < cstr.C_A0


def test_reachable_states_stay_in_the_observation_box():
    rng = np.random.default_rng(0)
    x, _, _ = random_points(512)
    psi = cstr.EVAL_PSI[rng.integers(len(cstr.EVAL_PSI), size=512)]
    for t in range(300):
        if t % 30 == 0:
            u = np.where(rng.random((512, 2)) < 0.5, cstr.U_LOW, cstr.U_HIGH)
        x = cstr.step(x, u, psi)
        assert ((cstr.OBS_LOW < x) & (x < cstr.OBS_HIGH)).all()


def test_evaluation_plants():
    on_grid = np.isclose(cstr.EVAL_PSI[:, None], cstr.SCENARIOS["robust"]).all(-1).any(-1)
    assert (len(cstr.EVAL_PSI), on_grid.sum(), len(cstr.SCENARIOS["robust"])) == (56, 8, 100)
    assert not np.isclose(cstr.PSI_NOMINAL, cstr.SCENARIOS["robust"]).all(-1).any()
    np.testing.assert_array_equal(cstr.SCENARIOS["mpc"][0], cstr.PSI_NOMINAL)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized.*")
def test_checkers_of_gymnasium_and_stable_baselines3():
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*(deprecated|float32|not within|must be).*")
        check_env(gym.make("RLMPC/CSTR-v0").unwrapped)
        sb3_check_env(gym.make("RLMPC/CSTR-v0").unwrapped)


def test_stable_baselines3_her_runs():
    from stable_baselines3 import SAC, HerReplayBuffer

    env = gym.make("RLMPC/CSTR-v0")
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=100,
        train_freq=8,
        seed=0,
        device="cpu",
    )
    model.learn(500)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert env.action_space.contains(action)


def test_reward_is_that_of_the_next_achieved_goal():
    env = gym.make("RLMPC/CSTR-v0").unwrapped
    obs, _ = env.reset(seed=1, options={"state": [0.8, 0.5, 130, 130], "goal": [0.6], "psi": [1.0, 1.0]})
    new, reward, terminated, truncated, info = env.step(np.array([20.0, -1000.0], dtype=np.float32))
    np.testing.assert_allclose(new["observation"], cstr.step(obs["observation"], [20.0, -1000.0], [1.0, 1.0]))
    assert (
        reward
        == np.exp(-((new["observation"][1] - 0.6) ** 2) / (2 * 1e-4))
        == env.compute_reward(new["achieved_goal"], np.array([0.6]))
    )
    assert not terminated and not truncated


def test_sparse_reward():
    env = gym.make("RLMPC/CSTR-v0", smooth_reward=False, reward_tolerance=0.05).unwrapped
    achieved = np.array([[0.60], [0.649], [0.651]])
    np.testing.assert_array_equal(env.compute_reward(achieved, np.array([[0.6]] * 3)), [1.0, 1.0, 0.0])


def test_vector_env_resets_in_the_same_step_and_branches():
    vec = gym.make_vec(
        "RLMPC/CSTR-v0", num_envs=5, scenarios="mpc", branches=16, max_episode_steps=3
    ).unwrapped
    assert vec.metadata["autoreset_mode"] == gym.vector.AutoresetMode.SAME_STEP
    obs, _ = vec.reset(seed=0)
    for t in range(7):
        action = vec.action_space.sample()
        new, reward, terminated, truncated, infos = vec.step(action)
        assert vec.observation_space.contains(new)
        assert (truncated.all() if t % 3 == 2 else not truncated.any()) and not terminated.any()
        reached = infos["final_obs"]["observation"] if truncated.any() else new["observation"]
        u = np.clip(action.astype(float), cstr.U_LOW, cstr.U_HIGH)
        np.testing.assert_allclose(reached, cstr.step(obs["observation"], u, infos["psi"]))
        np.testing.assert_array_equal(reward, vec.compute_reward(reached[:, [1]], obs["desired_goal"]))
        # every branch is the step under one of the nine scenarios, and they are not all the same one
        candidates = np.stack(
            [cstr.step(obs["observation"], u, np.broadcast_to(psi, (5, 2))) for psi in cstr.SCENARIOS["mpc"]],
            axis=1,
        )
        distance = np.abs(infos["branch_states"][:, :, None] - candidates[:, None]).max(-1)
        assert distance.min(-1).max() < 1e-12
        assert len(np.unique(distance.argmin(-1))) > 1
        obs = new


def test_vector_env_state_continues_exactly():
    vec = gym.make_vec("RLMPC/CSTR-v0", num_envs=3).unwrapped
    vec.reset(seed=4)
    action = np.tile([20.0, -2000.0], (3, 1))
    vec.step(action)
    state = vec.get_state()
    expected = [vec.step(action)[0]["observation"] for _ in range(60)]
    vec.set_state(state)
    np.testing.assert_array_equal([vec.step(action)[0]["observation"] for _ in range(60)], expected)


def test_a_goal_is_checked_and_copied():
    linear, pendulum = envs.load("linear", dim=3), envs.load("double_pendulum")
    for goal in (0.65, [0.65], np.float32(0.65), np.array(0.65)):
        assert envs.checked_goal(cstr, goal).shape == (1,)
    given = np.array([[0.5, 0.6, 0.7, 2.0]])
    goal = envs.checked_goal(cstr, given, 4)
    given[:] = 0
    np.testing.assert_array_equal(goal, [[0.5, 0.6, 0.7, 2.0]])
    np.testing.assert_array_equal(envs.checked_goal(pendulum, [np.pi, -np.pi]), [np.pi, -np.pi])
    assert envs.checked_goal(linear, np.zeros((3, 5)), 5).shape == (3, 5)
    assert envs.checked_goal(linear, np.zeros((3, 3)), 3).shape == (3, 3)
    step = np.array([[-1.0, 1.0, 0.5]] * 5).T  # a row per component, each within its own limits
    np.testing.assert_array_equal(envs.checked_goal(linear, step, 5), step)


@pytest.mark.parametrize(
    "plant, goal, horizon",
    [
        ("cstr", [0.6, 0.6], None),
        ("cstr", [[0.6, 0.6]], None),
        ("cstr", [[0.6, 0.6]], 3),
        ("cstr", [[0.6], [0.6]], 2),
        ("cstr", [], None),
        ("cstr", 0.0999, None),
        ("cstr", 2.0001, None),
        ("cstr", np.nan, None),
        ("cstr", np.inf, 4),
        ("cstr", [[0.6, 0.6, -np.inf]], 3),
        ("cstr", [[0.6, 2.1, 0.6]], 3),
        ("double_pendulum", 0.0, None),
        ("double_pendulum", [0.0, 3.2], None),
        ("double_pendulum", [[0.0, 0.0], [0.0, 3.2]], 2),
        ("linear", [0.0, 1.1], None),
    ],
)
def test_a_goal_of_another_shape_or_outside_the_range_is_refused(plant, goal, horizon):
    with pytest.raises(ValueError, match="goal is") as error:
        envs.checked_goal(envs.load(plant), goal, horizon)
    assert "\n" not in str(error.value)


def test_runs_of_the_same_second_get_folders_of_their_own(tmp_path):
    made = [new_folder(tmp_path / "runs/cstr__0__1") for _ in range(3)]
    assert [path.name for path in made] == ["cstr__0__1", "cstr__0__1-2", "cstr__0__1-3"] and all(
        path.is_dir() for path in made
    )


def test_unknown_names_are_refused_with_the_list():
    with pytest.raises(ValueError, match="cstr"):
        envs.load("no_such_plant")
    with pytest.raises(ValueError, match="robust"):
        gym.make("RLMPC/CSTR-v0", scenarios="all")
