"""Linear systems: the regulator against scipy and the Bellman equation, LQ-MPC against the regulator, eq:jensen, real clients."""

import csv
import gc
import subprocess
import sys
from pathlib import Path

import casadi as ca
import gymnasium as gym
import numpy as np
import pytest
import torch
import tyro
from gymnasium.utils.env_checker import check_env
from scipy.linalg import solve_discrete_are

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs import linear
from envs.control import linear_systems
from experiments.linear import scalability as study

ROOT = Path(__file__).parent.parent

GAMMAS = (0.3, 0.9, 0.99, 1.0)


# Systems


@pytest.mark.parametrize("n", [1, 2, 8, 32])
def test_random_systems_are_what_the_appendix_describes(n):
    for system in range(5):
        plant = linear.make(n, system)
        assert plant.A.shape == (n, n) and np.abs(np.linalg.eigvals(plant.A)).max() <= 1.1 + 1e-9
        assert (np.triu(plant.transform, 1) == 0).all() and (np.diag(plant.transform) > 0).all()
        assert np.linalg.cond(plant.transform) <= 10
        m = (
            plant.transform @ plant.A @ np.linalg.inv(plant.transform)
        )  # undo the similarity: singular values in [0.11, 1.1]
        values = np.linalg.svd(m, compute_uv=False)
        assert values.min() >= 0.11 - 1e-9 and values.max() <= 1.1 + 1e-9
    np.testing.assert_array_equal(
        plant.A, linear.Linear(*linear.random_matrix(n, np.random.default_rng([n, 4]))).A
    )  # seeded
    assert not np.array_equal(plant.A, linear.make(n, 0).A)
    assert linear.make(n, 4) is plant


def test_many_large_systems_are_slightly_unstable():
    radius = [np.abs(np.linalg.eigvals(linear.make(32, system).A)).max() for system in range(10)]
    assert 1.0 < np.median(radius) <= 1.1


def test_next_state_serves_numpy_torch_and_casadi_and_equals_step():
    plant, rng = linear.make(3, 0), np.random.default_rng(0)
    x, u = rng.normal(size=(2, 5, 3))
    expected = x @ plant.A.T + u
    np.testing.assert_allclose(plant.step(x, u), expected)
    np.testing.assert_allclose(plant.next_state(x.T, u.T).T, expected)
    np.testing.assert_allclose(
        plant.next_state(torch.tensor(x.T), torch.tensor(u.T), xp=torch).numpy().T, expected
    )
    xs, us = ca.MX.sym("x", 3), ca.MX.sym("u", 3)
    np.testing.assert_allclose(
        np.array(ca.Function("f", [xs, us], [plant.next_state(xs, us, xp=ca)]).map(5)(x.T, u.T)).T, expected
    )


# The discounted regulator


@pytest.mark.parametrize("gamma", GAMMAS)
def test_regulator_against_scipy_and_the_bellman_equation(gamma):
    """With M, R and B that are not the identity, so that no term can hide."""
    rng = np.random.default_rng(3)
    a, b = linear.make(5, 1).A, rng.normal(size=(5, 2))
    m, r = np.diag(rng.uniform(0.5, 2, 5)), np.diag(rng.uniform(0.5, 2, 2))
    p, k = linear_systems.discounted_lqr(a, b, m, r, gamma)
    np.testing.assert_allclose(p, solve_discrete_are(np.sqrt(gamma) * a, np.sqrt(gamma) * b, m, r), rtol=1e-8)
    dare = (
        m
        + gamma * a.T @ p @ a
        - gamma**2 * a.T @ p @ b @ np.linalg.inv(r + gamma * b.T @ p @ b) @ b.T @ p @ a
    )  # as printed
    np.testing.assert_allclose(p, dare, rtol=1e-8)
    np.testing.assert_allclose(k, gamma * np.linalg.inv(r + gamma * b.T @ p @ b) @ b.T @ p @ a, rtol=1e-8)
    iterate = np.zeros((5, 5))
    for _ in range(3000):
        iterate, gain = linear_systems.bellman_step(a, b, m, r, gamma, iterate)
    np.testing.assert_allclose(iterate, p, rtol=1e-6)
    np.testing.assert_allclose(gain, k, atol=1e-6)
    x, total = np.ones(5), 0.0  # and against the sum of costs along its own closed loop
    for t in range(3000):
        u = -k @ x
        total, x = total + gamma**t * (x @ m @ x + u @ r @ u), a @ x + b @ u
    assert total == pytest.approx(np.ones(5) @ p @ np.ones(5), rel=1e-6)


def test_without_a_future_there_is_no_action():
    plant = linear.make(8, 0)
    gains = [np.abs(plant.lqr(gamma)[1]).max() for gamma in (0.5, 1e-1, 1e-2, 1e-4)]
    assert gains == sorted(gains, reverse=True) and gains[-1] < 1e-3


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_cost_with_a_linear_tail_falls_with_the_horizon(gamma):
    """eq:finitelqr: N free actions, then some stabilising linear controller that is not the best one."""
    plant = linear.make(4, 0)
    a, one = plant.A, np.eye(4)
    worse = 0.5 * a  # u = -0.5 A x halves the open loop
    p = np.zeros((4, 4))
    for _ in range(2000):
        closed = a - worse
        p = one + worse.T @ worse + gamma * closed.T @ p @ closed
    x, costs = np.array([1.0, -0.5, 0.3, 0.8]), []
    for _ in range(20):
        costs.append(x @ p @ x)
        p = linear_systems.bellman_step(a, one, one, one, gamma, p)[0]
    assert (np.diff(costs) <= 1e-12).all() and costs[0] > costs[1] + 1e-3
    assert costs[-1] == pytest.approx(x @ plant.lqr(gamma)[0] @ x, rel=1e-6)


# MPC


def lq_mpc(plant, **options):
    return study.LinearMPC(plant, options.pop("horizon", 6), **dict(ipopt={"tol": 1e-9}) | options)


@pytest.mark.parametrize("gamma", [0.9, 1.0])
@pytest.mark.parametrize("options", [{}, {"control_horizon": 2}, {"control_horizon": 0}])
def test_unconstrained_lq_mpc_is_the_regulator(gamma, options):
    """Near the origin no bound is active: action and cost are Riccati's, at every horizon and control horizon."""
    plant = linear.make(5, 2)
    mpc, x0 = lq_mpc(plant, gamma=gamma, **options), 0.02 * np.array([1, -1, 2, 0.5, -2])
    u = mpc.make_step(x0)
    p, k = plant.lqr(gamma)
    assert mpc.stats["rung"] == "solved"
    np.testing.assert_allclose(u, -k @ x0, atol=1e-7)
    assert mpc.objective == pytest.approx(x0 @ p @ x0, rel=1e-6)
    u = mpc.make_step(plant.step(x0, u))  # and from the shifted plan
    np.testing.assert_allclose(u, -k @ plant.step(x0, -k @ x0), atol=1e-6)


def test_beyond_the_control_horizon_the_plan_follows_the_regulator_and_before_it_does_not():
    plant = linear.make(8, 1)
    k = plant.lqr()[1]
    x0 = np.sign(k[np.abs(k).sum(axis=1).argmax()])
    mpc = lq_mpc(plant, control_horizon=3)
    mpc.make_step(x0)
    plan = mpc.prediction()
    x, u = [x0[:, None], *plan["x"]], plan["u"]
    for t in range(3, 6):
        np.testing.assert_allclose(u[t], -k @ x[t], atol=1e-6)
    assert np.abs(u[0] + k @ x0[:, None]).max() > 0.05  # the limits are active there
    assert np.abs(np.concatenate(u)).max() <= 1 + 1e-9


@pytest.mark.parametrize("objective", ["quadratic", "goal"])
def test_objective_and_constraints_are_those_of_the_paper(objective):
    """At a random point: discounted costs at (x_0, u_0) ... (x_{N-1}, u_{N-1}), terminal cost, slack outside the exponential."""
    plant, rng, gamma, N = linear.make(3, 0), np.random.default_rng(0), 0.9, 4
    goal = np.array([0.1, -0.2, 0.05])
    mpc = lq_mpc(plant, horizon=N, gamma=gamma, objective=objective, slack_price=0.7, goal=goal)
    x_now = rng.uniform(-1, 1, 3)
    x, u = np.vstack([x_now, rng.uniform(-2, 2, (N, 3))]), rng.uniform(-1, 1, (N, 3))
    w, outside = mpc.vector(x[1:], u), np.abs(x - np.clip(x, plant.X_LOW, plant.X_HIGH)).sum(axis=1)
    held = goal - plant.A @ goal
    costs = [(x[t] - goal) @ (x[t] - goal) + (u[t] - held) @ (u[t] - held) for t in range(N)]
    costs.append((x[N] - goal) @ plant.lqr(gamma)[0] @ (x[N] - goal))
    if objective == "goal":
        costs = [-np.exp(-cost) for cost in costs]
    slack = sum(gamma**t * 0.7 * outside[t] for t in range(1, N + 1))
    parameters = np.concatenate([x_now, np.zeros(3), np.repeat(goal[:, None], N, axis=1).ravel("F")])
    value = ca.Function("f", [mpc.problem["x"], mpc.problem["p"]], [mpc.problem["f"]])(w, parameters)
    assert float(value) == pytest.approx(
        sum(gamma**t * cost for t, cost in enumerate(costs)) + slack, rel=1e-12
    )


def test_a_goal_off_the_origin_is_held():
    plant = linear.make(2, 0)
    goal = 0.5 * plant.GOAL_REACHABLE[1]
    for objective in ("quadratic", "goal"):
        mpc = lq_mpc(plant, objective=objective, goal=goal)
        x, u, _, _ = gm.simulate(mpc, np.array([0.9, -0.9]), plant.PSI_NOMINAL, np.tile(goal, (30, 1)))
        np.testing.assert_allclose(x[-1], goal, atol=1e-5)
        np.testing.assert_allclose(u[-1], goal - plant.A @ goal, atol=1e-5)


# eq:jensen


def some_costs(seed=0, n=200, length=11):
    rng = np.random.default_rng(seed)
    return rng.exponential(rng.uniform(0.01, 30, size=(n, 1)), size=(n, length))


@pytest.mark.parametrize("gamma", GAMMAS)
def test_jensen_holds_strictly_and_is_an_equality_for_equal_costs(gamma):
    left, right = study.jensen(some_costs(), gamma)
    assert (left < right).all()
    left, right = study.jensen(np.full((3, 11), [[0.0], [0.5], [50.0]]), gamma)
    np.testing.assert_allclose(left, right, atol=1e-12)
    np.testing.assert_allclose(left, [0, -0.5, -50])


@pytest.mark.parametrize("gamma", [0.9, 0.99])
def test_jensen_sides_are_the_printed_formula_and_a_wrong_rho_is_caught(gamma):
    def printed(costs, rho_inverse):
        N = costs.shape[-1] - 1
        powers = gamma ** np.arange(N + 1)
        return -rho_inverse * (powers * costs).sum(-1), np.log(
            rho_inverse * (powers * np.exp(-costs)).sum(-1)
        )

    costs, N = some_costs(1), 10
    right_rho = (1 - gamma) / (1 - gamma ** (N + 1))
    np.testing.assert_allclose(study.jensen(costs, gamma), printed(costs, right_rho), rtol=1e-9)
    equal = np.full((1, N + 1), 0.01)
    for wrong in (1 - gamma, (1 - gamma) / (1 - gamma**N), 1 / (N + 1)):
        left, right = printed(equal, wrong)
        assert np.abs(left - right).max() > 1e-4  # equality of equal costs is lost
    left, right = printed(equal, 1 - gamma)  # weights that sum to less than one break the inequality itself
    assert left > right


def test_trajectory_costs_are_the_controllers_own():
    plant, x0 = linear.make(4, 0), np.array([0.5, -0.5, 0.9, -0.2])
    for objective, side in (("quadratic", 0), ("goal", 1)):
        mpc = lq_mpc(plant, objective=objective)
        mpc.make_step(x0)
        sides = study.plan_sides(mpc, x0)
        expected = (
            -mpc.objective / 7 if objective == "quadratic" else np.log(-mpc.objective / 7)
        )  # no bound is violated here
        assert sides[side] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("n", [2, 8])
def test_closed_loops_satisfy_jensen_and_goal_conditioned_plans_have_the_larger_right_side(n):
    """The second half is no theorem: a local optimum or a saved violation may break it. On these systems nothing does."""
    settings = study.BASE | {"steps": 12}
    rows = [
        row
        for system in range(2)
        for row in study.run_system(("base", tuple(settings.items()), n, system, 2))
    ]
    assert all(row["jensen_log_left"] < row["jensen_log_right"] <= 0 for row in rows)
    goal = [row for row in rows if row["controller"] == "goal"]
    assert [row["plans_compared"] for row in goal] == [12] * 4
    assert sum(row["plans_worse"] + row["plans_costlier"] for row in goal) == 0
    plant = study.make_plant(
        n, 0, settings
    )  # and that count is not vacuous: the roles exchanged, LQ-MPC's plans are worse
    lq, mpc = (study.controller(plant, objective, settings) for objective in study.CONTROLLERS)
    x0 = envs.sample_states(plant, np.random.default_rng([n, 0, 1]), 1)[0]
    for controller in (lq, mpc):
        controller.make_step(x0)
    (side, cost), (best_side, best_cost) = (
        study.judged_plan(controller, x0, settings["price"]) for controller in (lq, mpc)
    )
    assert side < best_side - 1e-4 and cost > best_cost + 1e-4
    assert best_cost == pytest.approx(mpc.objective, abs=1e-4)  # slack ends near, not at, zero


# Clients


def test_checkers_of_gymnasium_and_stable_baselines3():
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    check_env(gym.make("RLMPC/Linear-v0", dim=3, system=1).unwrapped)
    sb3_check_env(gym.make("RLMPC/Linear-v0", dim=3, system=1).unwrapped)
    assert gym.make("RLMPC/Linear-v0").observation_space["observation"].shape == (2,)


def test_reachable_states_stay_in_the_observation_box():
    vec = gym.make_vec("RLMPC/Linear-v0", num_envs=64, dim=32, system=0).unwrapped
    obs, _ = vec.reset(seed=0)
    plant = vec.plant
    values, vectors = np.linalg.eig(plant.A.T)
    push = np.real(vectors[:, np.abs(values).argmax()])
    for _ in range(plant.EPISODE_STEPS - 1):
        action = np.sign(obs["observation"] @ push)[:, None] * np.sign(push)  # the fastest way out
        obs = vec.step(action)[0]
        assert vec.observation_space["observation"].contains(obs["observation"])
    assert np.abs(obs["observation"]).max() > 10


def test_a_plant_that_is_not_there_is_one_sentence():
    for options in ({"dim": 0}, {"dim": 3, "system": -1}, {"dim": 10**6}):
        with pytest.raises(ValueError, match="--dim|--system"):
            envs.load("linear", **options)
    with pytest.raises(ValueError, match="--color is not an option of --env linear"):
        envs.load("linear", color=1)
    with pytest.raises(ValueError, match="--dim is not an option of --env cstr"):
        envs.load("cstr", dim=3)


def test_training_and_deployment_run_on_it(tmp_path):
    """The checkpoint knows its system, and every controller runs on it."""
    run = training.main(
        training.Args(
            env="linear",
            dim=3,
            system=5,
            total_timesteps=2_000,
            learning_starts=500,
            num_envs=8,
            batch_size=32,
            eval_episodes=10,
            hidden=(16, 16),
            out=tmp_path,
        )
    )
    policy = training.load_policy(run / "checkpoint.pt")
    assert policy.plant is envs.load("linear", dim=3, system=5)
    controllers = ("actor", "nominal_mpc", "goal_mpc", "rl_mpc")
    args = deploy.Args(
        env="linear",
        critic=run / "checkpoint.pt",
        horizon=2,
        episodes=1,
        steps=4,
        jobs=1,
        compile=False,
        controllers=controllers,
        out=tmp_path / "deployed",
    )
    rows = deploy.main(args)
    assert [row["controller"] for row in rows] == list(controllers)
    assert all(np.isfinite(row["time_near_goal"]) and row["fell_back"] == 0 for row in rows)


# Learned values


@pytest.mark.parametrize("given", [False, True])
def test_with_a_quadratic_critic_one_iteration_finds_the_regulators_action(given):
    """The true value of the linear-quadratic problem as the learned one, its derivatives CasADi's own or given."""
    plant, goal = linear.make(5, 2), np.zeros(5)
    p, k = plant.lqr()
    x, g, m = (ca.MX.sym(name, 5) for name in ("x", "goal", "mismatch"))
    V = ca.Function("V", [x, g], [-ca.bilin(ca.DM(p), x - g, x - g) / 1000])
    stage = ca.Function("stage", [x, g], [0 * x[0]])
    derivatives = [V(x, g), ca.gradient(V(x, g), x), ca.hessian(V(x, g), x)[0]]
    mpc = deploy.ScenarioMPC(
        plant,
        1,
        plant.SCENARIOS["mpc"],
        stage,
        V,
        goal=goal,
        change_weight=1e-3,
        slack_price=0.0,
        compile=False,
        expansion=ca.Function("expansion", [x, g, m], derivatives) if given else None,
    )
    x0 = 0.02 * np.array(
        [1, -1, 2, 0.5, -2]
    )  # u before is zero: with N = 1 the change is |u|^2, so that the costs are the regulator's
    u = mpc.make_step(x0)
    expected = -np.linalg.solve(np.eye(5) + p, p @ plant.A @ x0)
    np.testing.assert_allclose(u, expected, atol=1e-6)
    np.testing.assert_allclose(expected, -k @ x0, atol=1e-9)
    assert mpc.stats["iterations"] <= 2 and mpc.stats["stop"] == "stationary"


def test_controllers_keep_what_casadi_calls_back(checkpoint):
    """Python's garbage collector must not take a function away that others are made of."""
    mpc = deploy.build_controller("rl_mpc", deploy.Args(critic=checkpoint, horizon=2, compile=False))
    gc.collect()
    mpc.make_step(np.array([0.8, 0.5, 134.14, 130.0]))
    assert mpc.stats["rung"] == "plan" and mpc.stats["cost"] < mpc.stats["guess_cost"]


def test_a_settled_plant_starts_from_the_last_plan(checkpoint):
    mpc = deploy.build_controller(
        "rl_mpc", deploy.Args(critic=checkpoint, horizon=3, compile=False, iterations=50)
    )
    x = np.array([0.8, 0.5, 110.0, 105.0])
    first = mpc.make_step(x)
    iterations, cost = mpc.stats["iterations"], mpc.stats["cost"]
    again = mpc.make_step(x)
    assert mpc.stats["guess"] == "last" and mpc.stats["guess_cost"] == cost
    np.testing.assert_allclose(again, first, atol=1e-3 * (mpc.plant.U_HIGH - mpc.plant.U_LOW).min())
    assert mpc.stats["iterations"] < iterations / 2
    mpc.make_step(x + 0.1 * (mpc.plant.INIT_HIGH - mpc.plant.INIT_LOW))  # moved: it would be put off for ever
    assert mpc.stats["guess"] in ("shifted", "policy")


def test_default_networks_are_the_papers():
    args = training.Args(env="linear", dim=32)
    agent = training.SAC(args, envs.load("linear", **args.plant_options))
    sizes = [
        sum(p.numel() for p in agent.actor.parameters()),
        sum(p.numel() for p in agent.critic.parameters()) // 2,
    ]
    assert args.hidden == (256, 256) and args.total_timesteps == 500_000
    assert all(90_000 < size < 100_000 for size in sizes)
    assert training.Args().hidden == (64, 64) and training.Args(hidden=(8,), env="linear").hidden == (8,)


def test_the_shipped_critic_holds_the_origin_and_beats_its_actor():
    """32 states; the closed loops of the actor and of the planner with its value, from one start."""
    reached = {}
    for name in ("actor", "rl_mpc"):
        controller = deploy.build_controller(name, deploy.Args(env="linear", horizon=2))
        x = np.random.default_rng(0).uniform(-1, 1, size=32)
        for _ in range(6):
            x = controller.plant.step(x, controller.make_step(x))
            assert not controller.stats["fell_back"]
        reached[name] = np.linalg.norm(x)
    assert reached["rl_mpc"] < 0.01 < reached["actor"] < 0.05


# Command line


def run_script(name, *arguments):
    return subprocess.run(
        [sys.executable, name, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize("objective", ["quadratic", "goal"])
def test_goal_mpc_end_to_end(tmp_path, objective):
    out = run_script(
        "goal_mpc.py",
        "--env",
        "linear",
        "--dim",
        14,
        "--system",
        3,
        "--objective",
        objective,
        "--horizon",
        6,
        "--steps",
        8,
        "--episodes",
        2,
        "--out",
        tmp_path,
    )
    assert out.returncode == 0, out.stderr
    rows = list(csv.DictReader(open(tmp_path / "results.csv")))
    assert [row["env"] for row in rows] == ["linear"] * 2 and all(
        float(row["time_near_goal"]) > 2 for row in rows
    )
    assert (
        tmp_path / "episode.png"
    ).stat().st_size > 10_000  # 28 states and actions, of which some are drawn


@pytest.mark.parametrize(
    "script, arguments, words",
    [
        ("goal_mpc.py", ["--env", "linear", "--dim", "0"], ["--dim", "0"]),
        ("goal_mpc.py", ["--env", "cstr", "--dim", "3"], ["--dim", "cstr"]),
        ("goal_mpc.py", ["--env", "linear", "--objective", "expert"], ["--objective expert"]),
        ("goal_mpc.py", ["--env", "linear", "--goal", "5,5"], ["--goal", "5,5"]),
        ("sac_her_branching.py", ["--env", "linear", "--dim", "-1"], ["--dim", "-1"]),
        ("sac_her_branching.py", ["--env", "cstr", "--system", "1"], ["--system", "cstr"]),
        ("sac_her_branching.py", ["--env", "linear", "--alpha-init", "0"], ["--alpha-init"]),
    ],
)
def test_bad_arguments_get_one_sentence(script, arguments, words, capsys):
    module = {"goal_mpc.py": gm, "sac_her_branching.py": training}[script]
    with pytest.raises((SystemExit, ValueError)) as refusal:
        module.check(tyro.cli(module.Args, args=arguments))
    sentence = capsys.readouterr().err + str(refusal.value)
    assert all(word in sentence for word in words), sentence


def test_a_plants_matrices_are_its_own():
    a = 0.5 * np.eye(2)
    plant = linear.Linear(a, a)
    p = plant.lqr()[0]
    expected = p.copy()
    a[:] = p[:] = 9
    np.testing.assert_array_equal(plant.A, 0.5 * np.eye(2))
    np.testing.assert_array_equal(plant.transform, 0.5 * np.eye(2))
    np.testing.assert_array_equal(plant.lqr()[0], expected)
