"""What an agent that observes the mismatch learns about its plant, and the command lines of estimators."""

import csv
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import tyro

import envs
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs import cstr
from envs.control.estimation import KalmanFilter, Measured, ParticleFilter
from envs.control.expansion import check_export
from envs.script.comparison import run_episode

ROOT = Path(__file__).parent.parent
NEAR = np.array([0.8, 0.6, 125.0, 122.0])
PINNED = [6.503921523392776, 2.535779312510386, 303.249091002583, 285.56583929590454]


@pytest.fixture(scope="module")
def observing(tmp_path_factory):
    """A checkpoint of a hardly trained agent that observes the mismatch."""
    args = training.Args(
        total_timesteps=1_600,
        learning_starts=500,
        eval_every=0,
        eval_episodes=5,
        hidden=(16, 16),
        observe_mismatch=True,
        scenario_hold="episode",
        out=tmp_path_factory.mktemp("observing"),
    )
    return training.main(args) / "checkpoint.pt"


def closed_loop(controller, psi, steps, x0=NEAR):
    return run_episode(controller, cstr, x0, np.array(psi), controller.goal, steps)


# The observation


def test_the_mismatch_is_exactly_zero_on_the_nominal_plant():
    vec = gym.make_vec(cstr.ENV_ID, num_envs=5, scenarios="nominal", observe_mismatch=True)
    obs, _ = vec.reset(seed=0)
    for _ in range(60):  # over the end of an episode
        assert obs["observation"].shape == (5, 8) and (obs["observation"][:, 4:] == 0).all()
        obs, *_ = vec.step(vec.action_space.sample())


def test_the_mismatch_is_that_of_a_naive_loop_and_zero_after_a_reset():
    vec = gym.make_vec(
        cstr.ENV_ID, num_envs=3, observe_mismatch=True, scenario_hold="episode", max_episode_steps=4
    ).unwrapped
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
    """Figures of the code before there were flags: random stream of the environment, size of the problem, scenarios."""
    vec = gym.make_vec(cstr.ENV_ID, num_envs=3)
    vec.reset(seed=3)
    last = [vec.step(np.full((3, 2), [20.0, -1000.0]))[0]["observation"] for _ in range(55)][-1]
    np.testing.assert_allclose(last.sum(axis=0), PINNED, rtol=1e-10)
    plain = deploy.build_controller("rl_mpc", deploy.Args(horizon=1, compile=False))
    assert type(plain.estimator) is Measured and (plain.scenarios == cstr.SCENARIOS["mpc"]).all()


def test_the_arguments_reach_the_controllers(observing):
    given = dict(horizon=1, compile=False, measure=("c_B", "T_K"), noise=0.02)
    for kind, options in (
        (KalmanFilter, dict(estimator="ekf")),
        (ParticleFilter, dict(estimator="particles")),
    ):
        for name in ("actor", "nominal_mpc", "goal_mpc", "rl_mpc"):
            estimator = deploy.build_controller(name, deploy.Args(**given, **options)).estimator
            assert type(estimator) is kind and estimator.measured.tolist() == [1, 3] and not estimator.certain
            np.testing.assert_allclose(np.sqrt(estimator.variance) * estimator.x_scale[[1, 3]], [0.038, 1.8])
    mpc = deploy.build_controller("rl_mpc", deploy.Args(horizon=1, compile=False, offset_free=True))
    half = cstr.PSI_NOMINAL + 0.5 * (cstr.SCENARIOS["mpc"] - cstr.PSI_NOMINAL)
    np.testing.assert_array_equal(mpc.scenarios, half)
    assert mpc.estimator.certain
    for name, horizon in (("actor", 1), ("rl_mpc", 0), ("rl_mpc", 1)):
        args = deploy.Args(horizon=horizon, compile=False, critic=observing)
        assert deploy.build_controller(name, args).estimator.mismatch_scale is not None
    sensors = deploy.Args(measure=("sensors",), offset_free=True, compile=False)
    assert deploy.check(sensors)[3].measured.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    "name, horizon, offset_free",
    [("rl_mpc", 1, True), ("rl_mpc", 1, False), ("rl_mpc", 0, False), ("actor", 1, False)],
)
def test_an_episode_starts_with_nothing_estimated(name, horizon, offset_free, observing):
    args = deploy.Args(horizon=horizon, compile=False, offset_free=offset_free, critic=observing)
    controller = deploy.build_controller(name, args)
    first, again = (closed_loop(controller, (1.05, 0.9), 3)[1] for _ in range(2))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("name, horizon", [("rl_mpc", 0), ("actor", 1)])
def test_actions_depend_on_the_mismatch_that_the_critic_observes(name, horizon):
    critic = ROOT / "experiments/pretrained/cstr_offset_free.pt"
    controller, actions = (
        deploy.build_controller(name, deploy.Args(horizon=horizon, compile=False, critic=critic)),
        [],
    )
    for mismatch in (np.zeros(4), np.full(4, np.tanh(1.0))):
        controller.reset()
        controller.estimator.mismatch = mismatch
        actions.append(controller.make_step(NEAR))
    assert np.abs(actions[1] - actions[0]).max() > 1e-3


def test_the_terminal_value_takes_the_mismatch_at_every_leaf(observing):
    mpc, costs = (
        deploy.build_controller(
            "rl_mpc", deploy.Args(horizon=2, compile=False, critic=observing, iterations=0)
        ),
        [],
    )
    V = deploy.export(deploy.load_critic(observing, "cstr"))[2]
    plan = np.random.default_rng(0).uniform(-0.5, 0.5, size=(mpc.tree.inner, 2))
    for mismatch in (np.zeros(4), np.full(4, np.tanh(1.0))):
        mpc.reset()
        mpc.policy, mpc.follow = None, None
        mpc.estimator.mismatch, mpc.plan, mpc.x_before = mismatch, plan, cstr.START
        mpc.make_step(NEAR)
        costs.append(mpc.stats["cost"])
    m, leaves = np.full(4, np.tanh(1.0)), mpc.prediction()["x"][-1].T
    expected = np.mean([float(V(x, mpc.goal, 0 * m) - V(x, mpc.goal, m)) for x in leaves])
    assert (
        len(leaves) == 9 and costs[1] - costs[0] == pytest.approx(expected, abs=1e-9) and abs(expected) > 1e-3
    )


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
    assert check_export(critic, V) < 1e-12 and critic.mismatch_scale and len(critic.plant.X_LOW) == 4
    x, rng = envs.sample_states(cstr, np.random.default_rng(0), 20), np.random.default_rng(1)
    m = rng.uniform(-1, 1, size=x.shape)
    np.testing.assert_allclose(
        np.array(mu(x.T, [0.65], m.T)).T, policy.act(np.hstack([x, m]), [0.65]), rtol=1e-4, atol=1e-2
    )
    np.testing.assert_allclose(
        np.array(V(x.T, [0.65], m.T))[0], policy.value(np.hstack([x, m]), [0.65]), rtol=1e-4, atol=1e-4
    )
    assert not np.allclose(policy.act(np.hstack([x, 0 * m]), [0.65]), policy.act(np.hstack([x, m]), [0.65]))


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


# Command line


def test_command_lines(observing, tmp_path):
    keep = dict(critic=observing, episodes=1, steps=3, jobs=1, compile=False, out=tmp_path)
    for controllers, given in (
        (("actor", "goal_mpc", "rl_mpc"), dict(horizon=1, offset_free=True, noise=0.01)),
        (("rl_mpc",), dict(horizon=0)),
    ):
        deploy.main(deploy.Args(controllers=controllers, **given, **keep))
        rows = list(csv.DictReader(open(tmp_path / "results.csv")))
        assert tuple(row["controller"] for row in rows) == controllers and rows[0]["fell_back"] == "0"
        assert json.loads(rows[0]["arguments"]) == {"steps": 3} | (
            {"offset_free": True, "noise": 0.01} if "offset_free" in given else {}
        )


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        (
            "sac_her_branching.py",
            ["--observe-mismatch", "--branches", "2"],
            ["--branches", "--observe-mismatch"],
        ),
        ("sac_her_branching.py", ["--observe-mismatch", "--env", "linear"], ["--observe-mismatch", "Linear"]),
        (
            "sac_her_branching.py",
            ["--scenario-hold", "episode", "--branches", "2"],
            ["--branches", "--scenario-hold"],
        ),
        (
            "sac_her_branching.py",
            ["--observe-mismatch", "--add-plant-data", "x.npz"],
            ["--add-plant-data", "--observe-mismatch"],
        ),
        (
            "rl_mpc_deploy.py",
            ["--constraints", "hard", "--slack-weight", "3"],
            ["--slack-weight", "no effect", "hard"],
        ),
        (
            "rl_mpc_deploy.py",
            ["--measure", "c_B", "T_R"],
            ["--measure is c_B, T_R", "--estimator", "c_A, c_B, T_R, T_K"],
        ),
        (
            "rl_mpc_deploy.py",
            ["--offset-free", "--measure", "c_X"],
            ["measured is c_X", "c_A, c_B, T_R, T_K"],
        ),
        ("rl_mpc_deploy.py", ["--offset-free", "--measure"], ["measured is"]),
        ("rl_mpc_deploy.py", ["--offset-free", "--measure", "c_B", "c_B"], ["measured is c_B, c_B"]),
        ("rl_mpc_deploy.py", ["--noise", "-0.1"], ["--noise", "-0.1"]),
        ("rl_mpc_deploy.py", ["--noise", "nan"], ["--noise", "nan"]),
        ("rl_mpc_deploy.py", ["--offset-free", "--estimator", "particles"], ["--estimator", "--offset-free"]),
        ("rl_mpc_deploy.py", ["--estimator", "magic"], ["magic", "particles"]),
    ],
)
def test_bad_arguments_get_one_sentence(script, arguments, words, capsys):
    module = {"sac_her_branching.py": training, "rl_mpc_deploy.py": deploy}[script]
    with pytest.raises((SystemExit, ValueError)) as refusal:
        module.check(tyro.cli(module.Args, args=arguments))
    sentence = capsys.readouterr().err + str(refusal.value)
    assert all(word in sentence for word in words), sentence


def test_the_checkpoint_says_what_it_observes(observing):
    data = torch.load(observing, weights_only=True)
    assert (
        data["plant_options"] == {"observe_mismatch": cstr.MISMATCH_SCALE.tolist()}
        and data["gamma"] == 0.95
        and data["network"]["n_in"] == 9
    )
