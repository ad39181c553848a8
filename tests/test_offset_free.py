"""What an agent and a controller learn about their plant from the last transitions."""

import csv
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import envs
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs import cstr

ROOT = Path(__file__).parent.parent
NEAR = np.array([0.8, 0.6, 125.0, 122.0])


def run_script(script, *arguments):
    return subprocess.run([sys.executable, script, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def observing(tmp_path_factory):
    """A checkpoint of a hardly trained agent that observes the mismatch."""
    args = training.Args(total_timesteps=1_600, learning_starts=500, eval_every=0, eval_episodes=5, hidden=(16, 16), observe_mismatch=True,
                         scenario_hold="episode", out=tmp_path_factory.mktemp("observing"))  # fmt: skip
    return training.main(args) / "checkpoint.pt"


def closed_loop(controller, psi, steps, x0=NEAR):
    return deploy.run_episode(controller, cstr, x0, np.array(psi), controller.goal, steps)


# The observation


def test_the_mismatch_is_exactly_zero_on_the_nominal_plant():
    vec = gym.make_vec(cstr.ENV_ID, num_envs=5, scenarios="nominal", observe_mismatch=True)
    obs, _ = vec.reset(seed=0)
    for _ in range(60):  # over the end of an episode
        assert obs["observation"].shape == (5, 8) and (obs["observation"][:, 4:] == 0).all()
        obs, *_ = vec.step(vec.action_space.sample())


def test_the_mismatch_is_that_of_a_naive_loop_and_zero_after_a_reset():
    vec = gym.make_vec(cstr.ENV_ID, num_envs=3, observe_mismatch=True, scenario_hold="episode", max_episode_steps=4).unwrapped
    obs, _ = vec.reset(seed=1)
    psi = None
    for t in range(12):
        x, u = obs["observation"], np.random.default_rng(t).uniform(cstr.U_LOW, cstr.U_HIGH, size=(3, 2))
        obs, _, _, ended, infos = vec.step(u)
        reached = infos["final_obs"]["observation"] if ended.any() else obs["observation"]
        assert psi is None or t % 4 == 0 or (infos["psi"] == psi).all()  # held
        psi = infos["psi"]
        for i in range(3):
            x_next = cstr.step(x[i, :4], u[i], psi[i])
            m = np.tanh((x_next - cstr.step(x[i, :4], u[i], cstr.PSI_NOMINAL)) / cstr.MISMATCH_SCALE)
            np.testing.assert_allclose(reached[i], np.append(x_next, m), rtol=1e-12)
        if ended.any():
            assert (obs["observation"][:, 4:] == 0).all()
    assert len(np.unique(vec.psi, axis=0)) > 1


def test_without_the_flags_nothing_changes():
    """The same random numbers drawn in the same order, and the optimal control problem has no more parameters."""
    runs = []
    for options in ({}, {"scenario_hold": "step", "observe_mismatch": False}):
        vec = gym.make_vec(cstr.ENV_ID, num_envs=3, **options)
        vec.reset(seed=3)
        runs.append([vec.step(np.full((3, 2), [20.0, -1000.0]))[0]["observation"] for _ in range(55)])
    assert np.array_equal(*runs)
    plain = deploy.build_controller("rl_mpc", deploy.Args(horizon=1, compile=False))
    free = deploy.build_controller("rl_mpc", deploy.Args(horizon=1, compile=False, offset_free=True, spread=1.0))
    assert plain.estimator.kind is None and plain.nlp["p"].numel() == 4 + 1 + 2 + 8
    assert free.nlp["p"].numel() == plain.nlp["p"].numel() + 4 + 2 + 4
    # with nothing estimated yet the first step is the same
    for controller in (plain, free):
        controller.set_initial_guess(NEAR)
    np.testing.assert_allclose(plain.make_step(NEAR), free.make_step(NEAR), rtol=1e-6)


def test_resuming_a_run_with_held_scenarios_keeps_them(tmp_path):
    vec = gym.make_vec(cstr.ENV_ID, num_envs=4, scenario_hold="episode").unwrapped
    vec.reset(seed=0)
    vec.step(np.full((4, 2), [20.0, -1000.0]))
    other = gym.make_vec(cstr.ENV_ID, num_envs=4, scenario_hold="episode").unwrapped
    other.reset(seed=9)
    other.set_state(vec.get_state())
    for _ in range(60):
        a, b = (v.step(np.full((4, 2), [20.0, -1000.0]))[0]["observation"] for v in (vec, other))
        assert np.array_equal(a, b)


# Networks that see it


def test_both_scripts_read_an_observing_checkpoint_alike(observing):
    policy, critic = training.load_policy(observing), deploy.load_critic(observing, "cstr", "min")
    mu, Q, V = deploy.export(critic)
    assert deploy.check_export(critic, V) < 1e-12 and critic.observes_mismatch and len(critic.plant.X_LOW) == 4
    x, rng = envs.sample_states(cstr, np.random.default_rng(0), 20), np.random.default_rng(1)
    m = rng.uniform(-1, 1, size=x.shape)
    np.testing.assert_allclose(np.array(mu(x.T, [0.65], m.T)).T, policy.act(x, [0.65], m), rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(np.array(V(x.T, [0.65], m.T))[0], policy.value(x, [0.65], m), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(policy.act(np.hstack([x, m]), [0.65]), policy.act(x, [0.65], m))
    np.testing.assert_array_equal(policy.act(x, [0.65]), policy.act(x, [0.65], 0 * m))
    assert not np.allclose(policy.act(x, [0.65]), policy.act(x, [0.65], m))


def test_the_deployed_actor_sees_what_the_trained_one_saw(observing):
    policy = training.load_policy(observing)
    actor = deploy.build_controller("actor", deploy.Args(critic=observing))
    psi = np.array([1.03, 0.92])
    _, u, _ = closed_loop(actor, psi, 6)
    x = np.append(NEAR, np.zeros(4))[None]
    for t in range(6):
        action = policy.act(x, cstr.EVAL_GOAL)
        np.testing.assert_allclose(u[t], action[0], rtol=1e-4, atol=1e-2)
        x = policy.plant.step(x, np.clip(action, cstr.U_LOW, cstr.U_HIGH), psi[None])


# Estimates


@pytest.mark.parametrize("psi", [(1.0, 1.0), (1.05, 0.9), (0.96, 1.07), (1.08, 0.85)])
def test_estimated_parameters_are_the_true_ones_without_noise(psi):
    estimator, x, rng = envs.Estimator(cstr, "parameters"), NEAR, np.random.default_rng(0)
    for _ in range(4):
        u = rng.uniform(cstr.U_LOW, cstr.U_HIGH)
        estimator.before, x = (x, u), cstr.step(x, u, np.array(psi))
        estimator.update(x)
    np.testing.assert_allclose(cstr.PSI_NOMINAL + estimator.shift, psi, atol=1e-4)
    estimator.reset()
    assert (estimator.shift == 0).all() and (estimator.mismatch == 0).all()


def test_the_disturbance_makes_the_nominal_model_right_and_the_gain_filters_it():
    psi, u, x = np.array([1.05, 0.9]), np.array([20.0, -2000.0]), NEAR
    estimators = [envs.Estimator(cstr, "disturbance", gain) for gain in (1.0, 0.25)]
    x_next = cstr.step(x, u, psi)
    for estimator in estimators:
        estimator.before = x, u
        estimator.update(x_next)
    np.testing.assert_allclose(cstr.step(x, u, cstr.PSI_NOMINAL) + estimators[0].disturbance, x_next, rtol=1e-12)
    np.testing.assert_allclose(estimators[1].disturbance, estimators[0].disturbance / 4)
    np.testing.assert_allclose(estimators[1].mismatch, estimators[0].mismatch / 4)


@pytest.mark.parametrize("estimate", ["parameters", "disturbance"])
def test_no_offset_remains(estimate):
    """Nominal MPC, near its goal, on a plant that the nominal model misses."""
    offsets = []
    for offset_free in (False, True):
        args = deploy.Args(compile=False, offset_free=offset_free, estimate=estimate)
        x, _, _ = closed_loop(deploy.build_controller("nominal_mpc", args), (1.04, 0.93), 40)
        offsets.append(abs(x[-5:, 1] / cstr.EVAL_GOAL[0] - 1).mean())
    assert offsets[1] < 0.001 < 0.005 < offsets[0]


# Command line


def test_command_lines(observing, tmp_path):
    keep = ["--critic", observing, "--episodes", 1, "--steps", 3, "--jobs", 1, "--no-compile", "--out", tmp_path]
    out = run_script("rl_mpc_deploy.py", *keep, "--horizon", 1, "--offset-free", "--controllers", "actor", "nominal_mpc", "rl_mpc")
    assert out.returncode == 0, out.stderr
    assert [row["controller"] for row in csv.DictReader(open(tmp_path / "results.csv"))] == ["actor", "nominal_mpc", "rl_mpc"]
    out = run_script("rl_mpc_deploy.py", *keep, "--horizon", 0, "--controllers", "rl_mpc")
    assert out.returncode == 0, out.stderr


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        ("sac_her_branching.py", ["--observe-mismatch", "--branches", "2"], ["--branches", "--observe-mismatch"]),
        ("sac_her_branching.py", ["--observe-mismatch", "--env", "linear"], ["--observe-mismatch", "Linear"]),
        ("rl_mpc_deploy.py", ["--offset-free", "--filter-gain", "0"], ["--filter-gain", "0.0"]),
        ("rl_mpc_deploy.py", ["--value", "taylor", "--critic", "{}"], ["--value", "mismatch"]),
    ],
)
def test_bad_arguments_get_one_sentence_and_exit_code_2(script, arguments, words, observing):
    out = run_script(script, *(a.format(observing) for a in arguments))
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr


def test_the_checkpoint_says_what_it_observes(observing):
    data = torch.load(observing, weights_only=True)
    assert data["plant_options"] == {"observe_mismatch": True} and data["gamma"] == 0.95 and data["network"]["n_in"] == 9
