"""The double pendulum against a stiff integrator, conservation of energy, the literature's implicit equations, and real clients."""

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp

import envs
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs.script.figure import angles_on_one_scale
from envs.script.pendulum import kinetic_energy, potential_energy, skeleton

dp = envs.load("double_pendulum")


def random_points(n, seed=0):
    rng = np.random.default_rng(seed)
    x = envs.sample_states(dp, rng, n)
    return x, rng.uniform(dp.U_LOW, dp.U_HIGH, size=(n, 1)), rng.uniform(0.95, 1.05, size=(n, 3))


def test_energy_is_conserved_without_force():
    """Ten seconds from the paper's start and from fast ones, fine integrator: 1e-8 relative to the energy between hanging and upright."""
    x = np.vstack([dp.START, envs.sample_states(dp, np.random.default_rng(1), 5)])
    psi, force = np.tile([1.0, 0.97, 1.04], (6, 1)), np.zeros((6, 1))

    def energy(x):
        return kinetic_energy(x.T, psi.T) + potential_energy(x.T, psi.T)

    start, scale = (
        energy(x),
        np.ptp(
            potential_energy(np.array([[0, 0], [0, np.pi], [0, np.pi], [0, 0], [0, 0], [0, 0]]), psi[:2].T)
        ),
    )
    for _ in range(250):
        x = dp.step(x, force, psi, substeps=100)
    assert np.abs(energy(x) - start).max() / scale < 1e-8
    assert np.abs(x[:, 1:3] - dp.START[1:3]).max() > 1  # it moved


def test_step_agrees_with_a_stiff_integrator():
    x, u, psi = random_points(200)
    exact = np.array(
        [
            solve_ivp(
                lambda _, y, i=i: dp.ode(y, u[i], psi[i]),
                (0, dp.DT),
                x[i],
                method="Radau",
                rtol=1e-10,
                atol=1e-12,
            ).y[:, -1]
            for i in range(len(x))
        ]
    )
    for substeps, allowed in ((8, 1e-6), (dp.MODEL_SUBSTEPS, 1e-4)):
        error = np.abs(dp.step(x, u, psi, substeps) - exact) / (dp.INIT_HIGH - dp.INIT_LOW)
        assert error.max() < allowed and np.median(error.max(axis=1)) < allowed / 100, (substeps, error.max())


def test_accelerations_satisfy_the_implicit_euler_lagrange_equations():
    """With the constants h_1 ... h_8 of the benchmark (Fiedler et al. 2023): residuals of its three equations."""
    x, u, _ = random_points(100, seed=1)
    m0, m1, m2, length_1, length_2, g = 0.6, 0.2, 0.2, 0.5, 0.5, 9.80665
    l1, l2 = length_1 / 2, length_2 / 2
    j1, j2 = m1 * l1**2 / 3, m2 * l2**2 / 3
    h1, h2, h3 = m0 + m1 + m2, m1 * l1 + m2 * length_1, m2 * l2
    h4, h5, h6 = m1 * l1**2 + m2 * length_1**2 + j1, m2 * l2 * length_1, m2 * l2**2 + j2
    h7, h8 = (m1 * l1 + m2 * length_1) * g, m2 * l2 * g
    for (_, a, b, _, da, db), (force,) in zip(x, u):
        ddp, dda, ddb = dp.ode(np.array([0, a, b, 0, da, db]), np.array([force]), np.ones(3))[3:]
        residual = [
            h1 * ddp
            + h2 * dda * np.cos(a)
            + h3 * ddb * np.cos(b)
            - (h2 * da**2 * np.sin(a) + h3 * db**2 * np.sin(b) + force),
            h2 * np.cos(a) * ddp
            + h4 * dda
            + h5 * np.cos(a - b) * ddb
            - (h7 * np.sin(a) - h5 * db**2 * np.sin(a - b)),
            h3 * np.cos(b) * ddp
            + h5 * np.cos(a - b) * dda
            + h6 * ddb
            - (h5 * da**2 * np.sin(a - b) + h8 * np.sin(b)),
        ]
        np.testing.assert_allclose(residual, 0, atol=1e-12)


def test_the_same_lines_serve_numpy_torch_and_casadi():
    x, u, psi = random_points(7)
    symbols = [ca.SX.sym(name, n) for name, n in (("x", 6), ("u", 1), ("psi", 3))]
    for function in (
        dp.ode,
        lambda x, u, psi, xp: kinetic_energy(x, psi, xp),
        lambda x, u, psi, xp: potential_energy(x, psi, xp),
    ):
        expected = np.atleast_2d(function(x.T, u.T, psi.T, np))
        in_torch = np.atleast_2d(function(*(torch.tensor(a.T) for a in (x, u, psi)), torch).numpy())
        in_casadi = np.array(ca.Function("f", symbols, [function(*symbols, ca)]).map(7)(x.T, u.T, psi.T))
        np.testing.assert_allclose(in_torch, expected, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(in_casadi, expected, rtol=1e-11, atol=1e-12)


def test_equilibria_and_their_names():
    for name, (a, b) in dp.GOALS.items():
        x = np.array([0.3, a, b, 0, 0, 0])
        np.testing.assert_allclose(dp.ode(x, np.zeros(1), dp.PSI_NOMINAL), 0, atol=1e-14)
        joint, tip = skeleton(x)[1:, 1]
        assert [name.split("-")[0], name.split("-")[1]] == [
            "up" if v > 0 else "down" for v in (joint, tip - joint)
        ]


def test_scenario_sets():
    assert [len(dp.SCENARIOS[name]) for name in ("nominal", "mpc", "extremes", "robust")] == [1, 27, 9, 1000]
    for name in ("mpc", "extremes"):
        np.testing.assert_array_equal(dp.SCENARIOS[name][0], dp.PSI_NOMINAL)
    assert all(0.95 <= dp.SCENARIOS[name].min() and dp.SCENARIOS[name].max() <= 1.05 for name in dp.SCENARIOS)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized.*", "ignore:.*bound.*")
def test_checkers_of_gymnasium_and_stable_baselines3():
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    check_env(gym.make("RLMPC/DoublePendulum-v0").unwrapped)
    sb3_check_env(gym.make("RLMPC/DoublePendulum-v0").unwrapped)


def test_vector_env_follows_the_physics_and_errors_go_the_short_way_round():
    vec = gym.make_vec("RLMPC/DoublePendulum-v0", num_envs=4, scenarios="mpc").unwrapped
    obs, _ = vec.reset(seed=0)
    action = vec.action_space.sample()
    new, reward, _, _, infos = vec.step(action)
    np.testing.assert_allclose(new["observation"], dp.step(obs["observation"], action, infos["psi"]))
    error = 1 - np.cos(new["achieved_goal"] - obs["desired_goal"])
    np.testing.assert_allclose(reward, np.exp(-(error**2).sum(1) / 0.5))
    assert dp.percentage_error(np.array([2 * np.pi, np.pi]), np.zeros(2)) == pytest.approx(50)
    for _ in range(150):
        new = vec.step(np.full((4, 1), 5.0))[0]
        assert vec.observation_space.contains(new)


def test_training_and_deployment_run_on_it(tmp_path):
    """A few hundred transitions; the checkpoint's networks see angles as sine and cosine, in torch and in CasADi alike."""
    run = training.main(
        training.Args(
            env="double_pendulum",
            total_timesteps=2_000,
            num_envs=8,
            batch_size=32,
            eval_episodes=10,
            out=tmp_path,
        )
    )
    policy = training.load_policy(run / "checkpoint.pt")
    x, turns = dp.START[None], np.array([[0, 2 * np.pi, -4 * np.pi, 0, 0, 0]])
    np.testing.assert_allclose(
        policy.act(x + turns, dp.EVAL_GOAL), policy.act(x, dp.EVAL_GOAL), atol=1e-4
    )  # a full turn is none
    for goal_input in ("error", "goal"):
        data = torch.load(run / "checkpoint.pt", weights_only=True) | {"goal_input": goal_input}
        torch.save(data, tmp_path / "c.pt")
        critic = deploy.load_critic(tmp_path / "c.pt", "double_pendulum")
        mu, _, V = deploy.export(critic)
        assert deploy.check_export(critic, V) < 1e-12
        policy = training.load_policy(tmp_path / "c.pt")
        np.testing.assert_allclose(
            np.array(mu(dp.START, [0.1, 3.0])).ravel(), policy.act(x, [0.1, 3.0])[0], atol=1e-3
        )
    args = deploy.Args(
        env="double_pendulum",
        critic=run / "checkpoint.pt",
        horizon=2,
        episodes=1,
        steps=3,
        jobs=1,
        compile=False,
        controllers=("actor", "nominal_mpc", "rl_mpc"),
        goal=(0.0, 3.0),
        out=tmp_path / "deploy",
    )
    rows = deploy.main(args)
    assert [row["controller"] for row in rows] == ["actor", "nominal_mpc", "rl_mpc"]
    assert all(np.isfinite(row["time_near_goal"]) and row["time_outside_constraints"] == 0 for row in rows)


def test_angles_are_drawn_without_jumps_and_goals_at_the_turn_that_is_taken():
    """Up the far side and back down: measured within one turn, drawn to 2 pi and pi; another path ends at the same turn."""
    up, down = np.linspace(0.9 * np.pi, 2 * np.pi, 30), np.linspace(2 * np.pi, np.pi, 30)
    path, other = np.concatenate([up, down]), np.linspace(0, -np.pi, 60)
    goal = np.repeat([0.0, -np.pi], 30)
    (drawn, second), goals = angles_on_one_scale([np.angle(np.exp(1j * path)), other], goal)
    np.testing.assert_allclose(drawn - drawn[0], path - path[0], atol=1e-12)
    np.testing.assert_allclose(goals, drawn[0] - path[0] + np.repeat([2 * np.pi, np.pi], 30))
    assert second[-1] == pytest.approx(drawn[-1])
    (drawn,), goals = angles_on_one_scale([np.array([0.0, 0.1, np.nan, 0.3])], np.zeros(4))
    np.testing.assert_array_equal(np.isnan(drawn), [False, False, True, False])
    assert not goals.any()
