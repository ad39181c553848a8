"""The exported critic against torch, plans against the problem written out in numpy, what holds of every plan, and the command line."""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import fields
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch
import tyro

import envs
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs import cstr
from envs.agents.checkpoint import read_checkpoint
from envs.control import compiled
from envs.control.controllers import ActorController, GreedyController
from envs.control.estimation import KalmanFilter, Measured, ParticleFilter
from envs.control.expansion import check_export, expansion, torch_value
from envs.script.comparison import draws, run_episode

double_pendulum = envs.load("double_pendulum")

ROOT = Path(__file__).parent.parent
SHIPPED = ROOT / "experiments/pretrained"
X0 = np.array([0.8, 0.5, 134.14, 130.0])
GOAL = cstr.EVAL_GOAL
COMPILER = any(map(shutil.which, ("gcc", "clang", "cc")))


def run_script(*arguments):
    return subprocess.run(
        [sys.executable, "rl_mpc_deploy.py", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def casadi_stage(plant):
    """The Gaussian stage cost of the plant's planners."""
    x, g = ca.MX.sym("x", len(plant.X_LOW)), ca.MX.sym("g", len(plant.GOAL_INDEX))
    error = plant.goal_error(x[plant.GOAL_INDEX], g, ca)
    return ca.Function("stage", [x, g], [-ca.exp(-ca.sumsqr(error) / (2 * plant.MPC_SIGMA2))])


def numpy_stage(plant):
    return lambda x, g: (
        -np.exp(-np.sum(plant.goal_error(x[plant.GOAL_INDEX], g) ** 2) / (2 * plant.MPC_SIGMA2))
    )


def of_state(formula):
    """A stage cost of the cstr in CasADi that does not look at the goal."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    return ca.Function("stage", [x, g], [formula(x)])


def mpc(
    horizon=3,
    scenarios=cstr.SCENARIOS["mpc"],
    stage=None,
    value=None,
    goal=GOAL,
    kind=deploy.ScenarioMPC,
    **options,
):
    return kind(
        cstr,
        horizon,
        scenarios,
        stage or casadi_stage(cstr),
        value,
        **dict(goal=goal, compile=False) | options,
    )


class Shifted(deploy.ScenarioMPC):
    """Guesses the shifted plan alone where there is one."""

    def first_guesses(self, x):
        found = super().first_guesses(x)
        return {"shifted": found["shifted"]} if "shifted" in found else found


def solve(controller, x0=X0, iterations=100):
    controller.iterations = iterations
    u = controller.make_step(x0)
    assert controller.stats["rung"] == "plan" and controller.stats["stop"] in ("stationary", "stalled"), (
        controller.stats
    )
    return controller.stats["cost"], u


def close(u, v, share):
    """Actions that differ by at most this share of their range."""
    return (np.abs(u - v) <= share * (cstr.U_HIGH - cstr.U_LOW)).all()


def written_out(
    plant,
    actions,
    starts,
    psi,
    goal,
    stage,
    value=None,
    *,
    robust_horizon=1,
    weight=None,
    price=0.0,
    change=0.0,
    u_before=0.0,
    disturbance=0.0,
    discount=1.0,
):
    """States and cost of a plan by the definition of the problem, node by node.

    actions: per stage (n_u, nodes); starts, psi, weight: per scenario; goal (n_goal, N). Returns the states x_1 ... x_N, (n_x, nodes) each,
    and the cost.
    """
    S = len(psi) if robust_horizon else 1
    weight, price = (
        np.full(S, 1 / S) if weight is None else weight,
        np.broadcast_to(price, (2, len(plant.X_LOW))),
    )
    states, cost = [], 0.0
    level = [
        (None, 1.0, 0, u_before)
    ]  # state, weight, scenario and the action before, of each node of a stage
    for t, u in enumerate(actions):
        assert u.shape[1] == len(level)
        following = []
        for j, (x, w, last, before) in enumerate(level):
            cost += discount ** max(t - 1, 0) * w * np.sum(change * (u[:, j] - before) ** 2)
            for i in range(S) if t < robust_horizon else [last]:
                share = w * (weight[i] if t < robust_horizon else 1.0)
                after = (
                    plant.step(x if t else starts[i], u[:, j], psi[i], substeps=plant.MODEL_SUBSTEPS)
                    + disturbance
                )
                below, above = np.maximum(plant.X_LOW - after, 0), np.maximum(after - plant.X_HIGH, 0)
                now = discount**t * share
                cost += now * (stage(after, goal[:, t]) + price[0] @ below + price[1] @ above)
                if value is not None and t == len(actions) - 1:
                    cost -= discount * now * value(after, goal[:, t])
                following.append((after, share, i, u[:, j]))
        level = following
        states.append(np.stack([node[0] for node in level], axis=1))
    return states, cost


def torch_critic(critic):
    """V(x, goal) by torch."""
    return lambda x, g: torch_value(critic, torch.tensor(x)[None], torch.tensor(g)[None]).item()


# Checkpoint and export


@pytest.fixture(scope="module")
def pendulum_checkpoint(tmp_path_factory):
    args = training.Args(env="double_pendulum", seed=1, hidden=(32, 32))
    agent, generator = training.SAC(args, double_pendulum), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in [*agent.actor.parameters(), *agent.critic.parameters()]:
            parameter += (
                0.3 * torch.randn(parameter.shape, generator=generator) / np.sqrt(parameter.shape[-1])
            )
    path = tmp_path_factory.mktemp("pendulum") / "checkpoint.pt"
    training.save(training.checkpoint(agent, training.plain(args), step=0), path)
    return path


def assert_equals_torch(critic, states, goal):
    """Value, gradient and Hessian of V by CasADi's own derivatives and of `expansion`, both against torch's."""
    V, n_x = deploy.export(critic)[2], len(critic.plant.X_LOW)
    assert check_export(critic, V) < 1e-12
    x = ca.MX.sym("x", n_x)
    derivatives = ca.Function(
        "derivatives", [x], [V(x, goal), ca.gradient(V(x, goal), x), ca.hessian(V(x, goal), x)[0]]
    )

    def value(v):
        return torch_value(critic, v[None], torch.tensor(goal)[None])[0]

    expanded = expansion(critic)
    for point in states:
        there = torch.tensor(point)
        expected = (
            value(there),
            torch.autograd.functional.jacobian(value, there),
            torch.autograd.functional.hessian(value, there),
        )
        for mine in (derivatives(point), expanded(point, goal, np.zeros(n_x))):
            for a, b in zip(mine, expected):
                b = b.detach().numpy()
                np.testing.assert_allclose(np.array(a).squeeze(), b, rtol=1e-8, atol=1e-9 * np.abs(b).max())


@pytest.mark.parametrize("goal_input", ["error", "goal"])
@pytest.mark.parametrize("combine", ["min", "first", "mean"])
def test_export_and_expansion_equal_torch_in_value_gradient_and_hessian(
    checkpoint, tmp_path, goal_input, combine
):
    data = torch.load(checkpoint, weights_only=True)
    torch.save(data | {"goal_input": goal_input}, tmp_path / "c.pt")
    critic = deploy.load_critic(tmp_path / "c.pt", "cstr", combine)
    assert critic.goal_input == goal_input and critic.combine == combine
    assert_equals_torch(critic, envs.sample_states(cstr, np.random.default_rng(1), 5), np.array([0.65]))


@pytest.mark.parametrize("combine", ["min", "first", "mean"])
def test_the_hessian_sees_the_curvature_of_sines_and_cosines(pendulum_checkpoint, combine):
    critic = deploy.load_critic(pendulum_checkpoint, "double_pendulum", combine)
    assert_equals_torch(
        critic, envs.sample_states(double_pendulum, np.random.default_rng(1), 5), np.array([0.0, 3.0])
    )


@pytest.mark.parametrize("part", ["actor", "twins", "scaling"])
def test_a_wrong_export_stops_the_program(checkpoint, part):
    critic = deploy.load_critic(checkpoint, "cstr", "min")
    V = deploy.export(critic)[2]
    if part == "scaling":
        critic.scaling["x_scale"] = critic.scaling["x_scale"] * 1.001
    else:
        layers = critic.actor if part == "actor" else critic.twins[0]
        layers[0] = (layers[0][0], layers[0][1] + 1e-3)
    with pytest.raises(RuntimeError, match="differs from torch"):
        check_export(critic, V)


def test_both_scripts_read_a_checkpoint_alike(checkpoint):
    policy = training.load_policy(checkpoint)
    mu, Q, V = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    x = envs.sample_states(cstr, np.random.default_rng(2), 20)
    actions = np.array([np.array(mu(s, 0.7)).ravel() for s in x])
    np.testing.assert_allclose(actions, policy.act(x, [0.7]), rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose([float(V(s, 0.7)) for s in x], policy.value(x, [0.7]), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        [float(Q(s, u, 0.7)) for s, u in zip(x, actions)], [float(V(s, 0.7)) for s in x], rtol=1e-12
    )


# The optimal control problem


def test_identical_scenarios_give_the_nominal_controller():
    nominal = solve(mpc(robust_horizon=0))
    for controller in (
        mpc(scenarios=np.tile(cstr.PSI_NOMINAL, (3, 1))),
        mpc(scenarios=cstr.PSI_NOMINAL[None]),
    ):
        cost, u = solve(controller)
        assert cost == pytest.approx(nominal[0], rel=1e-4)
        assert close(u, nominal[1], 0.02)


@pytest.mark.parametrize("robust_horizon", [1, 2])
def test_every_leaf_counts(robust_horizon, checkpoint):
    """The terminal cost alone: the parameters of any one scenario change a plan's cost, and a plan costs what the definition says."""
    critic = deploy.load_critic(checkpoint, "cstr")
    V, psi = deploy.export(critic)[2], cstr.SCENARIOS["mpc"][[0, 4, 8]]
    options = dict(kind=Shifted, robust_horizon=robust_horizon, slack_price=0.0, iterations=0)
    controller = mpc(2, psi, of_state(lambda x: 0 * x[0]), V, **options)
    assert controller.tree.nodes == ([1, 3, 3] if robust_horizon == 1 else [1, 3, 9])
    plan = np.random.default_rng(0).uniform(-1, 1, size=(controller.tree.inner, 2))

    def cost(scenarios):
        planner = mpc(2, scenarios, of_state(lambda x: 0 * x[0]), V, **options)
        planner.plan, planner.x_before = plan.copy(), cstr.START  # far away: the guess is the shifted plan
        planner.make_step(X0)
        assert planner.stats["guess"] == "shifted"
        return planner.stats["cost"], planner.prediction()

    reference, prediction = cost(psi)
    states, expected = written_out(
        cstr,
        prediction["u"],
        [X0] * 3,
        psi,
        np.full((1, 2), GOAL),
        lambda x, g: 0.0,
        torch_critic(critic),
        robust_horizon=robust_horizon,
    )
    assert reference == pytest.approx(expected, rel=1e-9)
    for scenario in range(3):
        other = psi.copy()
        other[scenario] += [0.01, -0.02]
        assert abs(cost(other)[0] - reference) > 1e-5


def test_constraints_hold_at_every_predicted_state_the_last_included():
    """Without a reward, only the slack price of the last state can stop a controller that is paid to heat the reactor."""
    heat, hot = of_state(lambda x: -x[2] / 10), np.array([1.2, 0.6, 137.0, 137.0])
    free = mpc(3, stage=heat, slack_price=0.0)
    solve(free, hot)
    assert max(states[2].max() for states in free.prediction()["x"]) > 145
    assert free.prediction()["x"][-1][2].max() > 145
    for price in (10.0, np.inf):
        controller = mpc(3, stage=heat, slack_price=price)
        solve(controller, hot)
        for states in controller.prediction()["x"]:
            assert states[2].max() < 140.01 and states[3].max() < 140.01
        assert max(states[2].max() for states in controller.prediction()["x"]) > 139  # paid to come near


def test_soft_equals_hard_where_hard_is_feasible():
    cost_soft, u_soft = solve(mpc(slack_price=10.0))
    cost_hard, u_hard = solve(mpc(slack_price=np.inf))
    assert cost_soft == pytest.approx(cost_hard, rel=1e-4)
    assert close(u_soft, u_hard, 0.02)


def test_slack_is_priced_per_physical_unit():
    """From 20 degC above the bound, one step: the cost is the price times the mean violation over the scenarios."""
    price = np.array([[3.0, 5.0, 0.0, 2.0], [1.0, 0.0, 3.0, 0.5]])
    for x0 in ([0.8, 0.6, 160.0, 155.0], [2.3, 0.05, 45.0, 40.0]):
        controller = mpc(1, stage=of_state(lambda x: 0 * x[0]), slack_price=price)
        controller.make_step(x0)
        states = controller.prediction()["x"][0]
        above, below = (
            np.maximum(states - cstr.X_HIGH[:, None], 0),
            np.maximum(cstr.X_LOW[:, None] - states, 0),
        )
        expected = (price[0] @ below + price[1] @ above).mean()
        assert controller.stats["cost"] == pytest.approx(expected, rel=1e-9) and expected > 1


def test_the_first_action_is_shared_and_later_ones_are_not():
    controller = mpc(3)
    first = controller.make_step(X0)
    u = controller.prediction()["u"]
    assert [a.shape for a in u] == [(2, 1), (2, 9), (2, 9)] and [
        a.shape for a in controller.prediction()["x"]
    ] == [(4, 9)] * 3
    np.testing.assert_array_equal(u[0][:, 0], first)
    assert np.ptp(u[1], axis=1).max() > 0


def test_hard_bounds_that_no_plan_keeps_are_broken_as_little_as_possible():
    """Above the bound of c_A, which F >= 5 1/h only raises while it is cold."""
    controller = mpc(5, robust_horizon=0, slack_price=np.inf)
    _, u = solve(controller, np.array([2.5, 0.3, 55.0, 55.0]))
    states = controller.prediction()["x"]
    assert all(x[0].max() > cstr.X_HIGH[0] for x in states)
    least = np.array([2.5, 0.3, 55.0, 55.0])
    for x in states:
        least = cstr.step(least, [5.0, 0.0], cstr.PSI_NOMINAL)
        assert x[0, 0] <= least[0] + 1e-3


@pytest.mark.skipif(not COMPILER, reason="no C compiler")
def test_compiled_equals_interpreted(monkeypatch, tmp_path, checkpoint, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    critic = deploy.load_critic(checkpoint, "cstr")
    mu, _, V = deploy.export(critic)
    options = dict(value=V, policy=mu, expansion=expansion(critic))
    fast, slow = mpc(2, compile=True, **options), mpc(2, **options)
    assert (
        len(list((tmp_path / "rlmpc").iterdir())) == 2
    )  # the functions and the solver of quadratic programs
    assert "notice" not in capsys.readouterr().err
    for x0 in (X0, X0 + [0.05, 0.02, -2, -2]):
        u, expected = fast.make_step(x0), slow.make_step(x0)
        assert fast.stats["guess"] == slow.stats["guess"] and fast.stats["guess_cost"] == pytest.approx(
            slow.stats["guess_cost"], rel=1e-9
        )
        assert fast.stats["cost"] == pytest.approx(slow.stats["cost"], rel=1e-4)
        assert close(u, expected, 0.01)
    mpc(2, compile=True, **options)  # from the cache
    assert len(list((tmp_path / "rlmpc").iterdir())) == 2


def test_without_a_compiler_it_works_with_a_notice(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(shutil, "which", lambda name: None)
    bare = mpc(2, compile=True)
    err = capsys.readouterr().err
    assert "notice: running interpreted" in err and "PIQP" in err
    np.testing.assert_array_equal(bare.make_step(X0), mpc(2).make_step(X0))


def test_loops_of_the_generated_code_are_reordered(checkpoint, tmp_path, monkeypatch):
    """The text that `vectorised` looks for is in this CasADi's code, and nothing else of it changes."""
    monkeypatch.chdir(tmp_path)
    V = deploy.export(deploy.load_critic(checkpoint, "cstr", "first"))[2]
    V.generate("V.c")
    before = Path("V.c").read_text()
    after = compiled.vectorised(before)
    changed = [
        (a.split(), b.split()) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b
    ]
    assert (
        len(changed) == 4 and changed[2][0] == changed[3][1] and changed[3][0] == changed[2][1]
    )  # two lines change places
    assert all(
        b.count("restrict") > 0 and [word for word in b if word != "restrict"] == a for a, b in changed[:2]
    )
    assert compiled.vectorised("int nothing;") == "int nothing;"


# What holds of every plan


def random_goal(plant, rng, horizon=None):
    size = (len(plant.GOAL_INDEX),) if horizon is None else (horizon, len(plant.GOAL_INDEX))
    return rng.uniform(plant.GOAL_LOW, plant.GOAL_HIGH, size=size).T


@cache
def planner(case, pendulum_checkpoint=None):
    """A compiled controller, the arguments of `written_out`, and its critic."""
    name = {"pendulum": "double_pendulum"}.get(case.split()[0], case.split()[0])
    paths = {
        "cstr": SHIPPED / "cstr_constrained.pt",
        "linear": SHIPPED / "linear_robust.pt",
        "double_pendulum": pendulum_checkpoint,
    }
    critic = deploy.load_critic(paths[name], name)
    mu, _, V = deploy.export(critic)
    psi = critic.plant.SCENARIOS["mpc"]
    horizon, psi, robust_horizon, price, change, learned = {
        "cstr N=5": (5, psi, 1, 2.0, np.array([1e-4, 1e-8]), True),
        "cstr branches twice": (3, psi[:9:4], 2, np.inf, 0.0, False),
        "cstr no bounds": (2, psi, 1, 0.0, 0.0, True),
        "cstr one scenario N=1": (1, psi[:1], 1, 2.0, 0.0, True),
        "cstr one scenario N=10": (10, psi[:1], 1, np.array([[1.0, 0, 0, 0.5], [0, 2.0, 0.1, 0]]), 0.0, True),
        "cstr nominal N=20": (20, psi[:1], 0, np.inf, np.array([1e-4, 1e-8]), False),
        "pendulum N=2": (2, psi, 1, 1.0, np.array([0.1]), True),
        "linear N=2": (2, psi, 1, 1.0, 0.0, True),
    }[case]
    stage, options = (
        casadi_stage(critic.plant),
        dict(robust_horizon=robust_horizon, slack_price=price, change_weight=change),
    )
    if learned:
        options |= dict(value=V, policy=mu, expansion=expansion(critic))
    controller = deploy.ScenarioMPC(critic.plant, horizon, psi, stage, goal=critic.plant.EVAL_GOAL, **options)
    written = dict(
        plant=critic.plant,
        psi=psi,
        stage=numpy_stage(critic.plant),
        value=torch_critic(critic) if learned else None,
        robust_horizon=robust_horizon,
        price=np.minimum(price, deploy.HARD_PRICE),
        change=change,
    )
    return controller, written, mu if learned else None


CASES = [
    "cstr N=5",
    "cstr branches twice",
    "cstr no bounds",
    "cstr one scenario N=1",
    "cstr one scenario N=10",
    "cstr nominal N=20",
    "pendulum N=2",
    "linear N=2",
]


def judged(controller, written, x, goal, u_before):
    """The plan of the last step by the definition of the problem."""
    goals = np.broadcast_to(goal.reshape(len(goal), -1), (len(goal), controller.horizon))
    starts = [x] * len(written["psi"])
    return written_out(
        actions=controller.prediction()["u"], starts=starts, goal=goals, u_before=u_before, **written
    )


@pytest.mark.parametrize("case", CASES)
def test_a_plan_is_a_rollout_within_the_limits_and_never_dearer_than_its_guess(case, pendulum_checkpoint):
    """From random states, goals and stored plans, stopped after 0, 1, 2, 5 iterations and by a deadline that is over at once."""
    controller, written, mu = planner(case, pendulum_checkpoint)
    plant, rng, improved, guesses = controller.plant, np.random.default_rng(0), 0, set()
    u_scale, u_center = (plant.U_HIGH - plant.U_LOW) / 2, (plant.U_HIGH + plant.U_LOW) / 2
    for trial in range(8):
        x = envs.sample_states(plant, rng, 1)[0]
        goal = random_goal(plant, rng, controller.horizon if trial % 2 else None)
        u_before = rng.uniform(plant.U_LOW, plant.U_HIGH)
        x_before = None if not trial else x if trial % 3 == 0 else envs.sample_states(plant, rng, 1)[0]
        if trial:  # the measurement is taken to the turn nearest to the last
            x = x + np.isin(np.arange(len(x)), plant.ANGLES) * 2 * np.pi * np.round(
                (x_before - x) / (2 * np.pi)
            )
        controller.set_goal(goal)
        stored = rng.uniform(-1, 1, size=(controller.tree.inner, len(u_scale))) if trial else None
        if trial > 4:  # a good one, which beats the policy's rollout
            controller.reset()
            controller.iterations, controller.deadline_ms = 30, None
            controller.make_step(x)
            stored = np.clip(controller.plan + 1e-3 * stored, -1, 1)
        found = {}
        for stop in (0, 1, 2, 5, "late"):
            controller.reset()
            controller.plan, controller.x_before = None if stored is None else stored.copy(), x_before
            controller.u_before = u_before.copy()
            controller.iterations, controller.deadline_ms = (5, 1e-6) if stop == "late" else (stop, None)
            u = controller.make_step(x)
            stats = controller.stats
            assert stats["rung"] == "plan" and not stats["fell_back"] and stats["wall_ms"] > 0
            assert ((plant.U_LOW <= u) & (u <= plant.U_HIGH)).all()
            states, cost = judged(controller, written, x, goal, u_before)
            for mine, theirs in zip(controller.prediction()["x"], states, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
            for actions in controller.prediction()["u"]:
                assert (np.abs(actions - u_center[:, None]) <= u_scale[:, None] * (1 + 1e-12)).all()
            np.testing.assert_allclose(controller.prediction()["u"][0][:, 0], u, rtol=1e-12, atol=1e-12)
            assert stats["cost"] == pytest.approx(cost, rel=1e-8, abs=1e-8)
            assert stats["cost"] <= stats["guess_cost"]
            assert stats["late"] == (stop == "late") and (stats["stop"] == "late") == (stop == "late")
            assert stats["iterations"] == 0 if stop in (0, "late") else stats["iterations"] <= stop
            found[stop] = stats
            if stop == 0:  # the plan is the guess itself: the cheapest of those there are
                guess, guess_cost, name = controller.prediction()["u"], cost, stats["guess"]
                assert stats["cost"] == stats["guess_cost"] and stats["stop"] == "limit"
                if stored is not None:
                    physical = np.split(stored * u_scale + u_center, controller.tree.first[1:-2])
                    later = [part.T for part in physical[1:] + physical[-1:]]
                    later[0] = later[0][:, :1]  # under the first scenario
                    if written["robust_horizon"] < 2:
                        assert (
                            guess_cost <= shifted_cost(controller, written, x, goal, u_before, later) + 1e-9
                        )
        assert len({(s["guess"], s["guess_cost"]) for s in found.values()}) == 1
        controller.reset()
        controller.u_before, controller.iterations, controller.deadline_ms = u_before.copy(), 0, None
        controller.make_step(
            x
        )  # what it starts from without a stored plan: the policy's rollout or the middle
        assert controller.stats["guess"] == ("middle" if mu is None else "policy")
        assert mu is None or guess_cost <= controller.stats["cost"] + 1e-9
        assert name != "policy" or guess_cost == pytest.approx(controller.stats["cost"], rel=1e-12)
        assert found[0]["cost"] >= found[1]["cost"] >= found[2]["cost"] >= found[5]["cost"]
        guesses.add(found[0]["guess"])
        if found[0]["guess"] == "last":
            np.testing.assert_allclose(np.hstack(guess).T, stored * u_scale + u_center)
        improved += found[5]["cost"] < guess_cost - 1e-6
    assert improved >= 3 and len(guesses) >= 2
    assert mu is None or "policy" in guesses


def shifted_cost(controller, written, x, goal, u_before, actions):
    goals = np.broadcast_to(goal.reshape(len(goal), -1), (len(goal), controller.horizon))
    return written_out(
        actions=actions, starts=[x] * len(written["psi"]), goal=goals, u_before=u_before, **written
    )[1]


def test_a_planner_with_a_policy_costs_no_more_than_the_policys_rollout():
    """The rollout of the clipped policy under every scenario, by hand: a guess, and what a first step starts from."""
    controller, written, mu = planner("cstr N=5")
    controller.reset()
    controller.set_goal(0.7)
    controller.iterations, controller.deadline_ms = 0, None
    controller.make_step(X0)
    assert controller.stats["guess"] == "policy"

    def act(x):
        return np.clip(np.array(mu(x, 0.7)).ravel(), cstr.U_LOW, cstr.U_HIGH)

    x, actions = [X0] * 9, []
    for t in range(5):
        u = [act(X0)] if t == 0 else [act(state) for state in x]
        actions.append(np.stack(u, axis=1))
        x = [
            cstr.step(state, u[i if t else 0], psi, substeps=4)
            for i, (state, psi) in enumerate(zip(x, written["psi"]))
        ]
    for mine, theirs in zip(controller.prediction()["u"], actions, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_every_finite_measurement_gives_an_action(case, pendulum_checkpoint):
    controller, _, _ = planner(case, pendulum_checkpoint)
    plant = controller.plant
    controller.set_goal(plant.EVAL_GOAL)
    controller.iterations, controller.deadline_ms = 5, None
    rng = np.random.default_rng(1)
    for kept in (False, True):
        controller.reset()
        if kept:
            controller.make_step(plant.START)
        for size in (1e3, 1e12, 1e300, -1e12, -1e300, 1.7e308):
            for x in (
                np.full(len(plant.X_LOW), size),
                np.where(rng.random(len(plant.X_LOW)) < 0.3, size, plant.START),
            ):
                u = controller.make_step(x)
                assert np.isfinite(u).all() and ((plant.U_LOW <= u) & (u <= plant.U_HIGH)).all()
                assert controller.stats["rung"] in ("plan", "actor", "hold")
                assert controller.stats["fell_back"] == (controller.stats["rung"] != "plan")
        controller.make_step(plant.START)  # and it recovers
        assert controller.stats["rung"] == "plan" and np.isfinite(controller.stats["cost"])


@pytest.mark.parametrize("case", ["cstr N=5", "cstr nominal N=20", "pendulum N=2", "linear N=2"])
def test_a_plan_that_is_no_number_never_wins(case, pendulum_checkpoint):
    controller, _, mu = planner(case, pendulum_checkpoint)
    plant = controller.plant
    controller.set_goal(plant.EVAL_GOAL)
    controller.iterations, controller.deadline_ms = 5, None
    for wrong in (np.nan, np.inf, -np.inf):
        for everywhere in (True, False):
            controller.reset()
            controller.make_step(plant.START)
            spoiled = controller.plan.copy()
            if everywhere:
                spoiled[:] = wrong
            else:
                spoiled[-1, -1] = wrong
            controller.plan = spoiled
            u = controller.make_step(plant.START)
            assert np.isfinite(u).all() and ((plant.U_LOW <= u) & (u <= plant.U_HIGH)).all()
            if mu is not None:
                assert controller.stats["guess"] == "policy" and np.isfinite(controller.plan).all()
            elif controller.plan is not None:
                assert np.isfinite(controller.plan).all()
            controller.make_step(plant.START)
            assert controller.stats["rung"] == "plan"


@pytest.mark.parametrize("kind", [Measured, KalmanFilter, ParticleFilter])
def test_what_the_caller_does_with_his_buffers_afterwards_changes_nothing(kind):
    psi, spoil = np.array([1.05, 0.9]), []
    mu = ca.Function("mu", [ca.MX.sym("x", 4), ca.MX.sym("g", 1)], [ca.DM([20.0, -2000.0])])
    buffers = dict(
        scenarios=cstr.SCENARIOS["mpc"].copy(), goal=np.array([0.65]), slack_price=np.full((2, 4), 2.0)
    )
    buffers |= dict(change_weight=np.zeros(2))
    careless = mpc(2, **buffers, policy=mu, estimator=kind(cstr))
    careful = mpc(2, goal=np.array([0.65]), slack_price=2.0, policy=mu, estimator=kind(cstr))
    for buffer in buffers.values():
        buffer[:] = 0.3
    x = X0.copy()
    for t in range(5):
        if t == 2:
            goal = np.array([0.7])
            careless.set_goal(goal)
            careful.set_goal(0.7)
            goal[:] = 0.1
        given = x.copy()
        u, expected = careless.make_step(given), careful.make_step(x)
        np.testing.assert_array_equal(u, expected)
        np.testing.assert_array_equal(given, x)
        x = cstr.step(x, expected, psi)
        spoil = [given, u, *careless.prediction()["x"], *careless.prediction()["u"]]
        for array in spoil:
            array[...] = 50.0
        assert kind is Measured or t == 0 or np.abs(careful.estimator.shift).max() > 0


def test_full_turns_of_an_angle_change_no_action(pendulum_checkpoint):
    controller, _, _ = planner("pendulum N=2", pendulum_checkpoint)
    controller.set_goal([0.3, -0.2])
    controller.iterations, controller.deadline_ms = 3, None
    rng = np.random.default_rng(0)
    states, actions, guesses = [double_pendulum.START], [], []
    for turns in (np.zeros((6, 2)), rng.integers(-3, 4, size=(6, 2)), np.full((6, 2), 2)):
        controller.reset()
        actions.append([])
        for t in range(6):
            x = states[t].copy()
            x[double_pendulum.ANGLES] += 2 * np.pi * turns[t]
            actions[-1].append(controller.make_step(x))
            guesses.append(controller.stats["guess"])
            if len(states) == t + 1:
                states.append(double_pendulum.step(states[t], actions[0][t], np.array([1.05, 0.95, 1.0])))
    np.testing.assert_allclose(actions[1], actions[0], atol=1e-5)
    np.testing.assert_allclose(actions[2], actions[0], atol=1e-5)
    assert np.ptp(actions[0]) > 0.1 and guesses[:6] == guesses[6:12] == guesses[12:]


@pytest.mark.parametrize("glitches", [[3e100], [1.7e308, -1.7e308]])
def test_a_wrong_angle_is_forgotten(glitches):
    """The next sound measurements are acted on as if it had not been there."""
    x, g = ca.MX.sym("x", 6), ca.MX.sym("g", 2)
    controller = ActorController(
        double_pendulum, ca.Function("mu", [x, g], [5 * ca.sin(x[1])]), double_pendulum.EVAL_GOAL
    )
    state = double_pendulum.START.copy()
    for angle in (0.1, *glitches, 0.1, 0.5, -0.5):
        state[1] = angle
        u = controller.make_step(state)
        assert np.isfinite(u).all() and abs(u[0]) <= 5
        if abs(angle) < 1:
            assert u[0] == pytest.approx(5 * np.sin(angle), abs=1e-6)


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(horizon=2.5), "horizon is 2.5"),
        (dict(robust_horizon=1.0), "robust_horizon 1.0"),
        (dict(iterations=1.5), "iterations is 1.5"),
        (dict(deadline_ms="1"), "deadline_ms is '1'"),
        (dict(scenarios=np.ones((9, 3))), r"scenarios have shape \(9, 3\)"),
        (dict(scenarios=np.ones(2)), "scenarios have shape"),
        (dict(scenarios=np.full((1, 2), np.nan)), "finite"),
        (dict(change_weight=np.inf), "change_weight is inf"),
        (dict(slack_price=np.nan), "slack_price is nan"),
        (dict(discount=np.nan), "discount is nan"),
        (dict(discount=-1.0), "discount is -1.0"),
    ],
)
def test_the_planner_refuses_what_is_no_setting(wrong, words):
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    given = dict(
        horizon=2,
        scenarios=cstr.SCENARIOS["mpc"],
        stage_cost=ca.Function("stage", [x, g], [x[1]]),
        goal=cstr.EVAL_GOAL,
    )
    with pytest.raises(ValueError, match=words) as error:
        deploy.ScenarioMPC(cstr, compile=False, **given | wrong)
    assert "\n" not in str(error.value)


def test_a_goal_per_stage():
    """A constant one equals a single goal; a change that lies ahead is planned for."""
    actions = {}
    step = np.append(np.full((1, 4), 0.65), np.full((1, 4), 0.8), axis=1)
    for name, goal in (
        ("number", 0.65),
        ("vector", [0.65]),
        ("constant", np.full((1, 8), 0.65)),
        ("ahead", step),
    ):
        controller = mpc(8, robust_horizon=0, goal=goal)
        controller.stats, actions[name] = {}, solve(controller)[1]
        later = mpc(8, robust_horizon=0, goal=0.5)
        later.set_goal(goal)
        np.testing.assert_array_equal(solve(later)[1], actions[name])
    np.testing.assert_array_equal(actions["vector"], actions["number"])
    np.testing.assert_array_equal(actions["constant"], actions["number"])
    assert not close(actions["ahead"], actions["number"], 0.005)


@pytest.mark.parametrize(
    "goal",
    [
        [0.65, 0.65],
        np.full((1, 3), 0.65),
        np.full((2, 1), 0.65),
        np.nan,
        0.05,
        2.5,
        [[0.6, 0.6, 0.6, 9.0]],
        [],
        "goal",
        None,
    ],
)
def test_a_goal_that_is_none_is_refused_and_leaves_the_last_one(goal):
    controller = mpc(4, scenarios=cstr.PSI_NOMINAL[None])
    with pytest.raises((ValueError, TypeError)):
        controller.set_goal(goal)
    np.testing.assert_array_equal(
        controller.make_step(X0), mpc(4, scenarios=cstr.PSI_NOMINAL[None]).make_step(X0)
    )


class Believing(Measured):
    """Weights, and states to start from, that a test chooses."""

    given = starts = None

    def belief(self, scenarios):
        starts, psi, weight = super().belief(scenarios)
        return (
            starts if self.starts is None else self.starts,
            psi,
            weight if self.given is None else self.given,
        )


def test_weight_one_on_a_scenario_gives_that_scenarios_controller():
    controller = mpc(2, cstr.SCENARIOS["mpc"][:4], kind=Shifted, estimator=Believing(cstr))
    for i in range(4):
        controller.estimator.given = np.eye(4)[i]
        nominal = mpc(2, cstr.SCENARIOS["mpc"][[i]], robust_horizon=0)
        controller.reset()
        for each in (controller, nominal):
            each.iterations = 0
            each.make_step(X0)
        assert controller.stats["cost"] == pytest.approx(
            nominal.stats["cost"], rel=1e-10
        )  # of the same guess, the middle
        controller.reset()
        nominal.reset()
        cost, u = solve(controller)
        expected_cost, expected = solve(nominal)
        assert cost == pytest.approx(expected_cost, rel=1e-4)
        assert close(u, expected, 0.02)


@pytest.mark.parametrize("robust_horizon", [1, 2])
def test_weighted_costs_add_up_and_scenarios_start_from_their_own_states(robust_horizon):
    rng, psi = np.random.default_rng(2), cstr.SCENARIOS["mpc"][[0, 4, 8]]
    controller = mpc(
        3,
        psi,
        kind=Shifted,
        estimator=Believing(cstr),
        robust_horizon=robust_horizon,
        change_weight=[1e-4, 1e-8],
        iterations=0,
    )
    controller.estimator.starts = X0 + rng.uniform(-1, 1, size=(3, 4)) * [0.1, 0.1, 5, 5]
    plan, u_before = rng.uniform(-1, 1, size=(controller.tree.inner, 2)), np.array([30.0, -4000.0])

    def cost(weight):
        controller.reset()
        controller.estimator.given, controller.plan, controller.x_before, controller.u_before = (
            weight,
            plan.copy(),
            cstr.START,
            u_before,
        )
        controller.make_step(X0)
        return controller.stats["cost"]

    weight = np.array([0.5, 0.2, 0.3])
    mixed = cost(weight)
    states, expected = written_out(
        cstr,
        controller.prediction()["u"],
        controller.estimator.starts,
        psi,
        np.full((1, 3), GOAL),
        numpy_stage(cstr),
        robust_horizon=robust_horizon,
        weight=weight,
        price=1.0,
        change=np.array([1e-4, 1e-8]),
        u_before=u_before,
    )
    assert mixed == pytest.approx(expected, rel=1e-9)
    for mine, theirs in zip(controller.prediction()["x"], states):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9)
    if robust_horizon == 1:
        assert mixed == pytest.approx(sum(w * cost(one) for w, one in zip(weight, np.eye(3))), rel=1e-9)


@pytest.mark.parametrize("robust_horizon", [0, 1, 2])
def test_a_discount_counts_later_stages_and_the_value_less(robust_horizon):
    """x_t by discount^(t - 1), the value by discount^N, as V(x_N) counts from x_{N+1} on; the optimum's slopes with them."""
    psi, x = cstr.SCENARIOS["mpc"][[0, 4, 8]], ca.MX.sym("x", 4)
    value = ca.Function("value", [x, ca.MX.sym("g")], [-((x[1] - 0.7) ** 2)])
    options = dict(discount=0.8, value=value, robust_horizon=robust_horizon, change_weight=[1e-4, 1e-8])
    controller = mpc(3, psi, iterations=1, **options)
    controller.make_step(X0)
    states, expected = written_out(
        cstr,
        controller.prediction()["u"],
        np.tile(X0, (3, 1)),
        psi,
        np.full((1, 3), GOAL),
        numpy_stage(cstr),
        lambda x, g: -((x[1] - 0.7) ** 2),
        robust_horizon=robust_horizon,
        price=1.0,
        change=np.array([1e-4, 1e-8]),
        discount=0.8,
    )
    assert controller.stats["cost"] == pytest.approx(expected, rel=1e-9)
    # a program with wrong slopes would not foresee what its step does
    fine = mpc(3, psi, iterations=50, **options)
    fine.make_step(X0)
    assert fine.stats["stop"] == "stationary" and fine.stats["cost"] <= controller.stats["cost"]


def test_a_disturbance_shifts_the_prediction_by_itself_at_the_first_stage():
    plain, shifted = (mpc(3, iterations=0, estimator=Measured(cstr)) for _ in range(2))
    d = np.array([0.03, -0.02, 1.5, -0.7])
    shifted.estimator.disturbance = d
    for controller in (plain, shifted):
        controller.make_step(X0)
    np.testing.assert_allclose(
        shifted.prediction()["x"][0] - plain.prediction()["x"][0], np.tile(d[:, None], 9), atol=1e-10
    )
    states, cost = written_out(
        cstr,
        shifted.prediction()["u"],
        [X0] * 9,
        cstr.SCENARIOS["mpc"],
        np.full((1, 3), GOAL),
        numpy_stage(cstr),
        price=1.0,
        disturbance=d,
    )
    for mine, theirs in zip(shifted.prediction()["x"], states):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9)
    assert shifted.stats["cost"] == pytest.approx(cost, rel=1e-9)


def test_what_one_turn_adds_is_no_disturbance():
    psi, found = np.array([1.05, 0.95, 1.0]), []
    for turns in (0, 1):
        estimator = KalmanFilter(double_pendulum, compile=False)
        controller = deploy.ScenarioMPC(
            double_pendulum,
            1,
            double_pendulum.SCENARIOS["nominal"],
            casadi_stage(double_pendulum),
            goal=double_pendulum.EVAL_GOAL,
            estimator=estimator,
            compile=False,
        )
        after = double_pendulum.step(double_pendulum.START, controller.make_step(double_pendulum.START), psi)
        after[double_pendulum.ANGLES] += 2 * np.pi * turns
        controller.make_step(after)
        found.append(estimator.disturbance)
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)
    assert np.abs(found[0]).max() > 1e-6


# Failures


def made(kind, checkpoint):
    mu, Q, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    if kind == "mpc":
        return mpc(2, policy=mu)
    return ActorController(cstr, mu, GOAL) if kind == "actor" else GreedyController(cstr, mu, Q, GOAL)


@pytest.mark.parametrize(
    "state",
    [[0.8, 0.5, np.nan, 130], [0.8, 0.5, 134], [[0.8, 0.5, 134, 130]], [0.8, np.inf, 134, 130], [], 1.0],
)
@pytest.mark.parametrize("kind", ["mpc", "actor", "greedy"])
def test_a_state_that_is_none_is_refused_and_leaves_the_controller_as_it_was(state, kind, checkpoint):
    asked, control = (made(kind, checkpoint) for _ in range(2))
    x = X0
    for _ in range(2):
        with pytest.raises(ValueError, match="state"):
            asked.make_step(state)
        u, expected = asked.make_step(x), control.make_step(x)
        np.testing.assert_array_equal(u, expected)
        stats = asked.stats
        with pytest.raises(ValueError, match="state"):
            asked.make_step(state)
        assert asked.stats == stats
        x = cstr.step(x, u, np.array([1.05, 0.9]))


@pytest.mark.parametrize("kind", ["actor", "greedy"])
def test_every_finite_measurement_gives_an_action_without_a_plan(kind, checkpoint):
    controller = made(kind, checkpoint)
    for size in (1e12, 1e300, -1e300):
        for x in (np.full(4, size), [0.8, 0.5, size, 130]):
            u = controller.make_step(x)
            assert np.isfinite(u).all() and ((cstr.U_LOW <= u) & (u <= cstr.U_HIGH)).all()


@pytest.mark.parametrize("compile", [False, True])
def test_failure_ladder(compile):
    """The plan; the policy where no guess has a finite cost; the last action where that is not finite either."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    policy = ca.Function("mu", [x, g], [ca.vertcat(20.0 + 0 * x[0], -2000.0 * ca.sqrt(1e200 - x[3]) / 1e100)])
    controller = mpc(2, policy=policy, compile=compile)
    with pytest.raises(ValueError, match="prediction"):
        controller.prediction()
    planned = controller.make_step(X0)
    assert (controller.stats["rung"], controller.stats["fell_back"]) == ("plan", False)
    np.testing.assert_allclose(controller.make_step([1e200, 0.5, 134.0, 130.0]), [20.0, -2000.0])
    assert (controller.stats["rung"], controller.stats["fell_back"]) == ("actor", True)
    with pytest.raises(ValueError, match="prediction"):
        controller.prediction()
    np.testing.assert_allclose(controller.make_step([0.8, 0.5, 134.0, 1e300]), [20.0, -2000.0])
    assert (controller.stats["rung"], controller.stats["fell_back"]) == ("hold", True)
    np.testing.assert_allclose(controller.make_step(X0), planned, rtol=1e-6)  # as a first step does
    assert (controller.stats["rung"], controller.stats["fell_back"]) == ("plan", False)
    # without a policy, and even where the cost, here none at all, is finite and the states are not
    for options in ({}, dict(stage=of_state(lambda x: 0 * x[0]), slack_price=0.0)):
        bare = mpc(2, compile=compile, **options)
        first = bare.make_step(X0)
        np.testing.assert_array_equal(bare.make_step([1e200, 0.5, 134.0, 130.0]), first)
        assert bare.stats["rung"] == "hold"


def test_a_network_that_overflows_holds_the_last_action():
    x, goal = ca.MX.sym("x", 4), ca.MX.sym("goal", 1)
    actor = ActorController(
        cstr, ca.Function("mu", [x, goal], [ca.vertcat(20.0, -2000.0) * ca.sqrt(1e3 - x[0])]), GOAL
    )
    first = actor.make_step(X0)
    np.testing.assert_array_equal(actor.make_step([1e6, 0.5, 134.0, 130.0]), first)
    assert actor.stats["rung"] == "hold" and actor.stats["fell_back"]
    actor.make_step(X0)
    assert actor.stats["rung"] == "actor" and not actor.stats["fell_back"]


def test_a_late_controller_goes_on_where_it_stopped():
    """Stopped at once in every step, on a state that does not move, it keeps its plan; given time it improves it."""
    controller = mpc(3, deadline_ms=1e-6)
    controller.make_step(X0)
    assert (
        controller.stats["late"]
        and controller.stats["stop"] == "late"
        and controller.stats["guess"] == "middle"
    )
    late = controller.stats["cost"]
    controller.deadline_ms = 1e6
    controller.make_step(X0)
    assert not controller.stats["late"] and controller.stats["iterations"] > 0
    assert controller.stats["cost"] < late and controller.stats["guess_cost"] <= late


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(iterations=-1), "iterations"),
        (dict(iterations=float("nan")), "iterations"),
        (dict(deadline_ms=0), "deadline_ms"),
        (dict(deadline_ms=-5.0), "deadline_ms"),
        (dict(deadline_ms=float("nan")), "deadline_ms"),
        (dict(slack_price=-1.0), "slack_price"),
        (dict(slack_price=np.full((2, 4), np.nan)), "slack_price"),
        (dict(change_weight=[-1.0, 0.0]), "change_weight"),
        (dict(horizon=0), "horizon"),
        (dict(robust_horizon=-1), "robust_horizon"),
        (dict(robust_horizon=5, horizon=5), "20000"),
        (dict(horizon=20_001, robust_horizon=0), "20000"),
        (dict(goal=5.0), "goal"),
        (dict(goal=[0.6, 0.6]), "goal"),
    ],
)
def test_the_constructor_refuses_what_cannot_work(wrong, words):
    with pytest.raises(ValueError, match=words) as error:
        mpc(**wrong)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name, wrong, words",
    [
        ("pid", {}, "pid.*rl_mpc"),
        ("rl_mpc", dict(constraints="Soft"), "--constraints.*Soft"),
        ("rl_mpc", dict(estimator="x"), "--estimator.*'x'"),
        ("rl_mpc", dict(combine="max"), "--combine.*max"),
        ("rl_mpc", dict(iterations=-1), "--iterations.*-1"),
        ("nominal_mpc", dict(deadline_ms=0.0), "--deadline-ms"),
        ("rl_mpc", dict(slack_weight=-2.0), "--slack-weight.*-2"),
        ("rl_mpc", dict(change_weight=(1.0,)), "--change-weight.*2 number"),
        ("rl_mpc", dict(change_weight=(-1.0, 0.0)), "--change-weight.*at least 0"),
        ("rl_mpc", dict(change_weight=(np.inf, 0.0)), "--change-weight.*inf"),
        ("rl_mpc", dict(robust_horizon=5), "robust horizon of 5.*20000"),
        ("rl_mpc", dict(horizon=-1), "--horizon.*-1"),
        ("actor", dict(goal=(3.0,)), "goal"),
        ("actor", dict(goal=(0.5, 0.5)), "goal"),
        ("goal_mpc", dict(horizon=0, controllers=("goal_mpc",)), "--horizon"),
        ("rl_mpc", dict(controllers=()), "--controllers"),
        ("rl_mpc", dict(controllers=("rl-mpc",)), "--controllers.*choose one of actor.*rl_mpc"),
        ("rl_mpc", dict(horizon="2"), "--horizon is '2'; it must be a whole number"),
        ("rl_mpc", dict(seed=1.5), "--seed is 1.5; it must be a whole number"),
        ("rl_mpc", dict(offset_free="yes"), "--offset-free is 'yes'; it must be True or False"),
        ("rl_mpc", dict(critic=3), "--critic is 3; it must be a path"),
        ("rl_mpc", dict(goal=("a",)), "--goal is .'a',.; it must be a number"),
        ("rl_mpc", dict(env="reactor"), "reactor.*cstr"),
    ],
)
def test_build_controller_refuses_what_cannot_work(name, wrong, words, checkpoint):
    with pytest.raises(ValueError, match=words) as error:
        deploy.build_controller(name, deploy.Args(**dict(critic=checkpoint, compile=False) | wrong))
    assert "\n" not in str(error.value)


# Closed loop


def test_metrics_are_those_of_a_naive_loop(checkpoint):
    mu = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))[0]
    x0, psi = (a[0] for a in draws(cstr, 1, seed=0))
    x, u, row = run_episode(ActorController(cstr, mu, GOAL), cstr, x0, psi, GOAL, steps=30)
    near = outside = 0.0
    for t in range(30):
        np.testing.assert_allclose(x[t + 1], cstr.step(x[t], u[t], psi))
        np.testing.assert_allclose(u[t], np.clip(np.array(mu(x[t], GOAL)).ravel(), cstr.U_LOW, cstr.U_HIGH))
        near += np.exp(-((0.65 - x[t + 1][1]) ** 2) / 0.02)
        outside += (
            np.exp(
                -sum(max(v - h, low - v, 0) ** 2 for v, low, h in zip(x[t + 1], cstr.X_LOW, cstr.X_HIGH))
                / 0.02
            )
            - 1
        )
    assert cstr.METRIC_SIGMA2 == 0.01
    assert row["time_near_goal"] == pytest.approx(near) and row["time_outside_constraints"] == pytest.approx(
        outside
    )
    assert row["ape_tail"] == pytest.approx(np.mean(100 * np.abs(x[-25:, 1] - 0.65) / 0.65))
    assert row["iterations"] == row["late"] == row["fell_back"] == 0
    assert 0 < row["solve_ms_median"] <= row["solve_ms_p95"]


def test_counts_are_those_of_the_steps(checkpoint):
    """Iterations per step, late steps, and steps without a plan, which a state that no plan can start from makes."""
    controller, found = mpc(2, scenarios=cstr.PSI_NOMINAL[None]), []

    class Recording:
        reset, estimator = controller.reset, controller.estimator

        def make_step(self, x):
            controller.deadline_ms = 1e-6 if len(found) == 1 else None
            u = controller.make_step([1e200, 0.5, 134.0, 130.0] if len(found) == 3 else x)
            self.stats = controller.stats
            found.append(
                (self.stats["iterations"], self.stats["late"], self.stats["fell_back"], self.stats["wall_ms"])
            )
            return u

    row = run_episode(Recording(), cstr, X0, cstr.PSI_NOMINAL, GOAL, 6)[2]
    iterations, late, fell_back, wall = np.array(found, dtype=float).T
    assert row["iterations"] == pytest.approx(iterations.mean()) and iterations.mean() > 0
    assert (row["late"], row["fell_back"]) == (late.sum(), fell_back.sum()) == (1, 1)
    assert row["solve_ms_median"] == pytest.approx(np.median(wall)) and row["solve_ms_p95"] == pytest.approx(
        np.quantile(wall, 0.95)
    )


def test_draws_are_paired_and_do_not_depend_on_their_number():
    few, many = draws(cstr, 3, seed=1), draws(cstr, 10, seed=1)
    np.testing.assert_array_equal(few[0], many[0][:3])
    np.testing.assert_array_equal(few[1], many[1][:3])
    assert (few[0] != draws(cstr, 3, seed=2)[0]).all()
    assert ((cstr.INIT_LOW <= many[0]) & (many[0] <= cstr.INIT_HIGH)).all()
    assert (
        all((psi == cstr.EVAL_PSI).all(axis=1).any() for psi in many[1])
        and len(np.unique(many[1], axis=0)) > 5
    )


@pytest.mark.parametrize(
    "name, options",
    [
        ("actor", {}),
        ("rl_mpc", dict(horizon=0)),
        ("rl_mpc", dict(horizon=2)),
        ("nominal_mpc", {}),
        ("goal_mpc", dict(horizon=2, constraints="hard")),
    ],
)
def test_a_new_goal_gives_what_a_new_controller_gives(name, options, checkpoint):
    both = [
        deploy.build_controller(name, deploy.Args(critic=checkpoint, compile=False, goal=goal, **options))
        for goal in ((0.5,), (0.8,))
    ]
    both[0].make_step(X0)
    before = both[0].make_step(X0)
    both[0].set_goal((0.8,))
    both[0].reset()
    expected = both[1].make_step(X0)
    np.testing.assert_array_equal(both[0].make_step(X0), expected)
    assert name == "nominal_mpc" or np.abs(before - expected).max() > 1e-3
    for wrong in ((0.5, 0.5), (np.nan,), 3.0):
        with pytest.raises(ValueError, match="goal"):
            both[0].set_goal(wrong)


def test_horizon_zero_maximises_the_critic(checkpoint):
    mu, Q, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    built = deploy.build_controller("rl_mpc", deploy.Args(critic=checkpoint, horizon=0))
    controller = GreedyController(cstr, mu, Q, GOAL)
    rng = np.random.default_rng(0)
    for x0 in envs.sample_states(cstr, rng, 3):
        u = controller.make_step(x0)
        best = float(Q(x0, u, GOAL))
        others = rng.uniform(cstr.U_LOW, cstr.U_HIGH, size=(500, 2))
        assert best >= max(float(Q(x0, u, GOAL)) for u in others) - 1e-6
        assert best >= float(Q(x0, mu(x0, GOAL), GOAL)) - 1e-9
        np.testing.assert_array_equal(built.make_step(x0), u)


@pytest.mark.parametrize("name", ["nominal_mpc", "robust_mpc", "goal_mpc", "rl_mpc"])
def test_the_compared_planners_solve_what_the_documentation_says(name):
    """Costs of their plans by the definition, with prices, weights and scenarios from the plant and the arguments."""
    given = dict(sigma=0.2, slack_weight=3.0, spread=0.7, change_weight=(1e-4, 1e-8))
    args = deploy.Args(horizon=3, goal=(0.7,), iterations=0, compile=False, **given)
    controller = deploy.build_controller(name, args)
    controller.make_step(np.array([0.8, 0.5, 143.0, 130.0]))
    psi = cstr.PSI_NOMINAL + 0.7 * (cstr.SCENARIOS["mpc"] - cstr.PSI_NOMINAL)
    if name in ("nominal_mpc", "robust_mpc"):
        robust = name == "robust_mpc"
        price = np.minimum(cstr.BENCHMARK["slack_price"] * (9 if robust else 1), deploy.HARD_PRICE)
        change = cstr.BENCHMARK["change_weight"] * (9 if robust else 1)  # prices count once per scenario
        written = dict(stage=lambda x, g: (x[1] - g[0]) ** 2, change=change, robust_horizon=int(robust))
        horizon = 20
    else:
        written = dict(
            stage=lambda x, g: -np.exp(-((x[1] - g[0]) ** 2) / (2 * 0.2**2)), change=np.array([1e-4, 1e-8])
        )
        horizon, price = 3, 3.0
        if name == "rl_mpc":
            written["value"] = torch_critic(deploy.load_critic(deploy.critic_path(args), "cstr"))
    _, cost = written_out(
        cstr,
        controller.prediction()["u"],
        [[0.8, 0.5, 143.0, 130.0]] * 9,
        psi,
        np.full((1, horizon), 0.7),
        price=price,
        u_before=np.zeros(2),
        **written,
    )
    assert controller.horizon == horizon and controller.stats["cost"] == pytest.approx(cost, rel=1e-9)


def test_the_slack_weight_follows_the_critic(checkpoint, tmp_path):
    """1, as in the paper, with a critic that is blind to constraints, 2 with one that is not; what the command line says goes first."""
    data = torch.load(checkpoint, weights_only=True)
    torch.save(data | {"args": data["args"] | {"constraint_weight": 3.0}}, tmp_path / "aware.pt")
    hot = np.array([0.8, 0.6, 160.0, 155.0])
    for path, given, wanted in (
        (checkpoint, None, 1.0),
        (tmp_path / "aware.pt", None, 2.0),
        (tmp_path / "aware.pt", 5.0, 5.0),
    ):
        args = deploy.Args(critic=path, horizon=1, slack_weight=given, compile=False, iterations=0)
        controller = deploy.build_controller("goal_mpc", args)
        controller.make_step(hot)
        cost = written_out(
            cstr,
            controller.prediction()["u"],
            [hot] * 9,
            cstr.SCENARIOS["mpc"],
            np.full((1, 1), GOAL),
            numpy_stage(cstr),
            price=wanted,
        )[1]
        assert controller.stats["cost"] == pytest.approx(cost, rel=1e-9) and cost > 10 * wanted
    assert deploy.critic_path(deploy.Args()).name == "cstr_constrained.pt"
    assert deploy.critic_path(deploy.Args(env="linear")).name == "linear_robust.pt"


# Command line


COLUMNS = (
    "env controller horizon critic goal episode seed psi arguments time_near_goal time_outside_constraints ape_tail solve_ms_median "
    "solve_ms_p95 iterations late fell_back"
).split()


def test_command_line_end_to_end_and_any_number_of_jobs(checkpoint, tmp_path):
    tables = []
    for jobs in (1, 2):
        out = run_script(
            "--critic",
            checkpoint,
            "--episodes",
            3,
            "--steps",
            3,
            "--horizon",
            1,
            "--jobs",
            jobs,
            "--controllers",
            "actor",
            "nominal_mpc",
            "rl_mpc",
            "--out",
            tmp_path / str(jobs),
        )
        assert out.returncode == 0, out.stderr
        assert "RL+MPC, N = 1" in out.stdout and "nominal MPC, N = 20" in out.stdout
        assert {p.name for p in (tmp_path / str(jobs)).iterdir()} == {
            "results.csv",
            "trajectories.npz",
            "episode.png",
        }
        rows = list(csv.DictReader(open(tmp_path / str(jobs) / "results.csv")))
        assert list(rows[0]) == COLUMNS and len(rows) == 9
        assert len(json.loads(rows[0]["psi"])) == 2 and json.loads(rows[0]["arguments"]) == {"steps": 3}
        assert all(np.isfinite(float(row[column])) for row in rows for column in COLUMNS[9:])
        assert all((float(row["iterations"]) > 0) == (row["controller"] != "actor") for row in rows)
        tables.append([{k: v for k, v in row.items() if not k.startswith("solve_ms")} for row in rows])
    assert tables[0] == tables[1]
    trajectories = np.load(tmp_path / "1" / "trajectories.npz")
    assert trajectories["rl_mpc_x"].shape == (3, 4, 4) and trajectories["rl_mpc_u"].shape == (3, 3, 2)
    starts, psis = draws(cstr, 3, seed=0)
    for name in ("actor", "nominal_mpc", "rl_mpc"):
        x, u = trajectories[f"{name}_x"], trajectories[f"{name}_u"]
        np.testing.assert_array_equal(x[:, 0], starts)
        np.testing.assert_allclose(cstr.step(x[:, 0], u[:, 0], psis), x[:, 1])


def test_horizon_zero_and_other_arguments_reach_the_table(checkpoint, tmp_path):
    for given in (
        dict(horizon=0),
        dict(horizon=1, deadline_ms=0.001, change_weight=(1e-4, 1e-8), constraints="hard"),
    ):
        args = deploy.Args(
            critic=checkpoint,
            episodes=1,
            steps=2,
            jobs=1,
            controllers=("rl_mpc",),
            compile=False,
            out=tmp_path,
            **given,
        )
        (returned,) = deploy.main(args)
        (row,) = csv.DictReader(open(tmp_path / "results.csv"))
        assert row == {k: str(v) for k, v in returned.items()}
        assert row["horizon"] == str(given["horizon"]) and row["late"] == str(2 * given["horizon"])
        expected = {k: list(v) if isinstance(v, tuple) else v for k, v in given.items() if k != "horizon"}
        assert json.loads(row["arguments"]) == {"steps": 2} | expected


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--env", "reactor"], ["--env", "reactor", "cstr"]),
        (["--horizon", "-1"], ["--horizon", "-1", "[0, "]),
        (["--episodes", "0"], ["--episodes", "0", "[1, "]),
        (["--steps", "-5"], ["--steps", "-5"]),
        (["--goal", "3"], ["goal", "3", "[0.1] to [2.]"]),
        (["--goal", "nan"], ["goal", "nan"]),
        (["--critic", "no/such.pt"], ["no/such.pt", "does not exist"]),
        (["--critic", "LICENSE"], ["LICENSE", "not a checkpoint"]),
        (["--out", "LICENSE/folder"], ["--out", "cannot write"]),
        (["--slack-weight", "inf"], ["--slack-weight", "inf"]),
        (["--sigma", "0"], ["--sigma", "0.0"]),
        (["--iterations", "-1"], ["--iterations", "-1"]),
        (["--deadline-ms", "0"], ["--deadline-ms", "0.0"]),
        (["--change-weight", "1"], ["--change-weight", "2 number(s)"]),
        (["--robust-horizon", "5"], ["robust horizon of 5", "leaves"]),
        (["--horizon", "0", "--slack-weight", "3"], ["--slack-weight", "3", "no effect", "--horizon 0"]),
        (["--horizon", "0", "--combine", "mean"], ["--combine", "mean", "no effect"]),
        (["--horizon", "0", "--change-weight", "1", "1"], ["--change-weight", "no effect"]),
    ],
)
def test_bad_arguments_are_refused_in_one_sentence(arguments, words, checkpoint, tmp_path):
    """Before anything is written or computed; through main, as the command line goes."""
    line = [
        *([] if "--critic" in arguments else ["--critic", str(checkpoint)]),
        "--controllers",
        "rl_mpc",
        *arguments,
    ]
    line += [] if "--out" in arguments else ["--out", str(tmp_path / "out")]
    with pytest.raises(ValueError) as error:
        deploy.main(tyro.cli(deploy.Args, args=line))
    assert all(word in str(error.value) for word in words), error.value
    assert "\n" not in str(error.value) and not list(tmp_path.glob("out/*.csv"))


@pytest.mark.parametrize(
    "arguments, words",
    [(["--horizon", "-1"], ["error: --horizon is -1"]), (["--controllers", "pid"], ["pid", "rl_mpc"])],
)
def test_bad_arguments_exit_with_code_2(arguments, words, checkpoint):
    out = run_script("--critic", checkpoint, *arguments)
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr
    assert not words[0].startswith("error:") or len(out.stderr.strip().splitlines()) == 1


def test_foreign_and_damaged_checkpoints_are_refused(checkpoint, tmp_path):
    def refused(words, data=None, path=tmp_path / "bad.pt"):
        if data is not None:
            torch.save(data, path)
        with pytest.raises(ValueError, match=words) as error:
            deploy.load_critic(path, "cstr")
        assert "\n" not in str(error.value)

    data = torch.load(checkpoint, weights_only=True)
    refused("is not a checkpoint.pt", {"weights": torch.zeros(3)})
    refused("of another format", data | {"format": "other"})
    refused("trained on 'pendulum'", data | {"env": "pendulum"})
    refused("is not a checkpoint.pt", data | {"network": data["network"] | {"hidden": [32, 32]}})
    refused("unknown goal_input", data | {"goal_input": "both"})
    refused("not finite", data | {"actor": data["actor"] | {"head.bias": torch.full((4,), torch.nan)}})
    refused("not finite", data | {"critic": {k: v * 1e200 for k, v in data["critic"].items()}})
    refused("not positive", data | {"scaling": data["scaling"] | {"x_scale": [0.0] * 4}})
    refused("is not a checkpoint.pt", path=tmp_path)
    refused("does not exist", path=tmp_path / "none.pt")
    (tmp_path / "cut.pt").write_bytes(checkpoint.read_bytes()[:5000])
    refused("is not a checkpoint.pt", path=tmp_path / "cut.pt")
    (tmp_path / "empty.pt").write_bytes(b"")
    refused("is not a checkpoint.pt", path=tmp_path / "empty.pt")

    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "pwned"), "w"))

    refused("is not a checkpoint.pt", {"x": Evil()})
    assert not (tmp_path / "pwned").exists()


def test_read_checkpoint_hands_the_data_over_and_refuses_what_the_reader_refuses(checkpoint):
    assert read_checkpoint(checkpoint, "cstr", lambda data: data["env"]) == "cstr"

    def no(data):
        raise ValueError("no use")

    with pytest.raises(ValueError, match=r"not a checkpoint.pt .*\(no use\)"):
        read_checkpoint(checkpoint, "cstr", no)
    with pytest.raises(ValueError, match="trained on 'cstr', not on 'linear'"):
        read_checkpoint(checkpoint, "linear", no)


def test_help_documents_every_argument():
    out = run_script("--help")
    assert out.returncode == 0
    assert all("--" + field.name.replace("_", "-") in out.stdout for field in fields(deploy.Args))
    documented = Path(deploy.__file__).read_text().split("class Args:")[1].split("# The learned value")[0]
    for field in fields(deploy.Args):  # a sentence below each
        assert documented.split(f"\n    {field.name}: ")[1].splitlines()[1].startswith('    """'), field.name


def test_a_finite_price_is_the_price():
    """Above that of hard bounds, too."""
    dear = mpc(2, slack_price=5000.0, goal=np.array([0.65]))
    np.testing.assert_allclose(dear.slack_price, 5000.0 * np.tile(dear.x_scale, (2, 1)))
