"""What an agent and a controller learn about their plant from the last transitions."""

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
    free = deploy.build_controller(
        "rl_mpc", deploy.Args(horizon=1, compile=False, offset_free=True, spread=1.0, filter_gain=0.3)
    )
    assert plain.estimator.kind is None and free.estimator.kind == "disturbance"
    assert (plain.scenarios == cstr.SCENARIOS["mpc"]).all() and (
        free.scenarios == cstr.SCENARIOS["mpc"]
    ).all()
    # with nothing estimated yet the first step is the same, and the second one is not
    np.testing.assert_array_equal(plain.make_step(NEAR), free.make_step(NEAR))
    assert plain.stats["cost"] == free.stats["cost"]
    for controller in (plain, free):
        controller.make_step(cstr.step(NEAR, [20.0, -1000.0], np.array([1.05, 0.9])))
    assert abs(plain.stats["cost"] - free.stats["cost"]) > 1e-3


def test_the_arguments_reach_the_controllers(observing):
    for name in ("nominal_mpc", "robust_mpc", "goal_mpc", "rl_mpc"):
        controller = deploy.build_controller(
            name, deploy.Args(horizon=1, compile=False, offset_free=True, filter_gain=0.3)
        )
        assert (controller.estimator.kind, controller.estimator.gain) == ("disturbance", 0.3)
        if name != "nominal_mpc":
            half = cstr.PSI_NOMINAL + 0.5 * (cstr.SCENARIOS["mpc"] - cstr.PSI_NOMINAL)
            np.testing.assert_array_equal(controller.scenarios, half)
    for name, horizon in (("actor", 1), ("rl_mpc", 0), ("rl_mpc", 1)):
        controller = deploy.build_controller(
            name, deploy.Args(horizon=horizon, compile=False, critic=observing, filter_gain=0.3)
        )
        assert (controller.estimator.kind, controller.estimator.gain) == ("mismatch", 0.3)


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
    for difference in (0 * cstr.MISMATCH_SCALE, cstr.MISMATCH_SCALE):
        controller.estimator.difference = difference
        controller.estimator.before = None
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
    for difference in (0 * cstr.MISMATCH_SCALE, cstr.MISMATCH_SCALE):
        mpc.reset()
        mpc.policy, mpc.follow = None, None
        mpc.estimator.difference, mpc.plan, mpc.x_before = difference, plan, cstr.START
        mpc.make_step(NEAR)
        costs.append(mpc.stats["cost"])
    m, leaves = np.full(4, np.tanh(1.0)), mpc.prediction()["x"][-1].T
    expected = np.mean([float(V(x, mpc.goal, 0 * m) - V(x, mpc.goal, m)) for x in leaves])
    assert (
        len(leaves) == 9 and costs[1] - costs[0] == pytest.approx(expected, abs=1e-9) and abs(expected) > 1e-3
    )


def test_a_disturbance_moves_the_first_prediction_by_itself_and_shifted_parameters_are_predicted_with():
    for estimate in ("disturbance", "parameters"):
        args = deploy.Args(horizon=2, compile=False, offset_free=True, estimate=estimate, iterations=0)
        mpc, psi, x = deploy.build_controller("rl_mpc", args), np.array([1.04, 0.93]), NEAR
        for _ in range(3):
            x = cstr.step(x, mpc.make_step(x), psi)
        mpc.make_step(x)
        u, known = mpc.prediction()["u"][0][:, 0], mpc.estimator
        for predicted, scenario in zip(mpc.prediction()["x"][0].T, mpc.scenarios):
            expected = cstr.step(x, u, scenario + known.shift, substeps=4) + known.disturbance
            np.testing.assert_allclose(predicted, expected, rtol=1e-9)
        assert known.disturbance.any() == (estimate == "disturbance") and known.shift.any() == (
            estimate == "parameters"
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
    np.testing.assert_allclose(
        cstr.step(x, u, cstr.PSI_NOMINAL) + estimators[0].disturbance, x_next, rtol=1e-12
    )
    np.testing.assert_allclose(estimators[1].disturbance, estimators[0].disturbance / 4)
    np.testing.assert_allclose(estimators[1].mismatch, estimators[0].mismatch / 4)


@pytest.mark.parametrize("kind", ["disturbance", "parameters"])
def test_a_wrong_measurement_teaches_nothing(kind):
    """Neither on its arrival nor as the state that the next transition starts from."""
    psi, u, x, estimator = np.array([1.05, 0.9]), np.array([20.0, -2000.0]), NEAR, envs.Estimator(cstr, kind)
    known = []
    for wrong in (None, None, [1e6, 0.5, -1e9, 130.0], None):
        seen = x if wrong is None else np.array(wrong)
        estimator.update(seen)
        known.append([*estimator.difference, *estimator.shift])
        estimator.before, x = (seen, u), cstr.step(x, u, psi)
    assert not np.any(known[0]) and np.any(known[1])
    np.testing.assert_array_equal(known[1:], [known[1]] * 3)


@pytest.mark.parametrize(
    "name, estimate",
    [("nominal_mpc", "parameters"), ("nominal_mpc", "disturbance"), ("rl_mpc", "disturbance")],
)
def test_no_offset_remains(name, estimate):
    """Near the goal, on a plant that the nominal model misses."""
    offsets = []
    for offset_free in (False, True):
        args = deploy.Args(
            horizon=5,
            compile=False,
            offset_free=offset_free,
            estimate=estimate if offset_free else "disturbance",
        )
        x, _, _ = closed_loop(deploy.build_controller(name, args), (1.04, 0.93), 40)
        offsets.append(abs(x[-5:, 1] / cstr.EVAL_GOAL[0] - 1).mean())
    assert offsets[1] < (0.001 if name == "nominal_mpc" else 0.004) < 0.005 < offsets[0]


# Command line


def test_command_lines(observing, tmp_path):
    keep = dict(critic=observing, episodes=1, steps=3, jobs=1, compile=False, out=tmp_path)
    for controllers, given in (
        (("actor", "goal_mpc", "rl_mpc"), dict(horizon=1, offset_free=True)),
        (("rl_mpc",), dict(horizon=0)),
    ):
        deploy.main(deploy.Args(controllers=controllers, **given, **keep))
        rows = list(csv.DictReader(open(tmp_path / "results.csv")))
        assert tuple(row["controller"] for row in rows) == controllers and rows[0]["fell_back"] == "0"
        assert json.loads(rows[0]["arguments"]) == {"steps": 3} | (
            {"offset_free": True} if "offset_free" in given else {}
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
        ("rl_mpc_deploy.py", ["--offset-free", "--filter-gain", "0"], ["--filter-gain", "0.0"]),
        ("rl_mpc_deploy.py", ["--estimate", "parameters"], ["--estimate", "no effect", "--offset-free"]),
        ("rl_mpc_deploy.py", ["--filter-gain", "0.5"], ["--filter-gain", "no effect", "--offset-free"]),
        (
            "rl_mpc_deploy.py",
            ["--constraints", "hard", "--slack-weight", "3"],
            ["--slack-weight", "no effect", "hard"],
        ),
        (
            "rl_mpc_deploy.py",
            ["--env", "linear", "--offset-free", "--estimate", "parameters"],
            ["--estimate", "uncertain"],
        ),
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
