"""goal_mpc.py against Riccati, against what must hold of a scenario tree, against its twin, the failure ladder, and the command line."""

import csv
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr
from envs import double_pendulum as dp

ROOT = Path(__file__).parent.parent
CSTR_X0 = np.array([0.8, 0.5, 134.14, 130.0])
NEAR_UPRIGHT = np.array([0.1, 0.1, 0.05, 0.0, 0.0, 0.0])  # one basin: other local optima are far
CHAIN = np.array([[0.0, 1.0], [0.3, -0.2]])  # x' = CHAIN x + [0, psi] u


def linear_plant(u_max=100.0, x_max=np.inf):
    """A double integrator's cousin as a plant module, exactly discretised by enough Runge-Kutta steps."""
    plant = SimpleNamespace(ENV_ID="linear", STATE_NAMES=("a", "b"), DT=0.1, MODEL_SUBSTEPS=10, GOAL_INDEX=[0], X_LOW=np.full(2, -x_max),
                            X_HIGH=np.full(2, x_max), INIT_LOW=-np.ones(2), INIT_HIGH=np.ones(2), U_LOW=np.array([-u_max]),
                            U_HIGH=np.array([u_max]))  # fmt: skip

    def ode(x, u, psi, xp):
        a, b = CHAIN[0, 0] * x[0] + CHAIN[0, 1] * x[1], CHAIN[1, 0] * x[0] + CHAIN[1, 1] * x[1] + psi[0] * u[0]
        return ca.vertcat(a, b) if xp is ca else np.array([a, b])

    plant.ode = ode
    plant.step = lambda x, u, psi: gm.envs.rk4(ode, np.asarray(x, float), np.atleast_1d(u), np.asarray(psi), 0.1, 10)
    return plant


def quadratic(plant, Q, P=None):
    x, g = ca.SX.sym("x", 2), ca.SX.sym("g", 1)
    cost = ca.Function("q", [x, g], [x.T @ Q @ x])
    return cost, None if P is None else ca.Function("p", [x, g], [x.T @ (P - Q) @ x])


def pendulum(horizon=12, objective="goal", **options):
    """The controller with one of the paper's objectives, or with "steep": quadratic in the state, so that optima are sharp."""
    x, g = ca.SX.sym("x", 6), ca.SX.sym("g", 2)
    steep = ca.Function("steep", [x, g], [ca.sumsqr(x[1:3] - g) + 0.1 * ca.sumsqr(x)])
    stage = steep if objective == "steep" else gm.costs(dp, objective)[0]
    settings = dict(goal=dp.EVAL_GOAL, compile=False) | options
    return gm.ScenarioMPC(dp, horizon, settings.pop("scenarios", dp.SCENARIOS["mpc"]), stage, **settings)


def first_solve(controller, x0):
    controller.reset()
    controller.set_initial_guess(x0)
    u = controller.make_step(x0)
    assert controller.stats["rung"] == "solved", controller.stats
    return controller.last_objective, u


# The optimal control problem


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
@pytest.mark.parametrize("discretization", ["rk4", "radau"])
def test_linear_quadratic_problem_has_riccatis_solution(solver, discretization):
    """Input price through the change penalty: with the previous input as a state, the problem is linear-quadratic in (x, u_before)."""
    plant, Q, R = linear_plant(), np.diag([1.0, 0.1]), 0.05
    columns = [plant.step(e[:2], e[2:], [1.0]) for e in np.eye(3)]
    A, B = np.column_stack(columns[:2]), columns[2][:, None]
    # state (x, v) with v the previous input: x' = A x + B u, v' = u, cost x'^T Q x' + R (u - v)^2 at every step
    AA, BB = np.block([[A, np.zeros((2, 1))], [np.zeros((1, 3))]]), np.vstack([B, [[1.0]]])
    QQ, RR = np.block([[A.T @ Q @ A, np.zeros((2, 1))], [np.zeros((1, 2)), R * np.eye(1)]]), B.T @ Q @ B + R
    S = np.vstack([A.T @ Q @ B, [[-R]]])
    P = solve_discrete_are(AA, BB, QQ, RR, s=S)
    K = np.linalg.solve(RR + BB.T @ P @ BB, BB.T @ P @ AA + S.T)
    mpc = gm.ScenarioMPC(plant, 80, np.ones((1, 1)), quadratic(plant, Q)[0], goal=[0.0], change_weight=[R], solver=solver,
                         discretization=discretization, compile=False, tol=1e-9)  # fmt: skip
    x0 = np.array([0.7, -0.4])
    objective, u = first_solve(mpc, x0)
    start = np.append(x0, 0.0)
    assert objective == pytest.approx(start @ P @ start, rel=1e-6)
    np.testing.assert_allclose(u, -K @ start, rtol=1e-5)


def test_both_solvers_and_both_discretizations_agree_on_the_pendulum():
    x0 = NEAR_UPRIGHT
    reference = first_solve(pendulum(20, "steep", robust_horizon=0), x0)
    for options in (dict(solver="fatrop"), dict(discretization="radau"), dict(solver="fatrop", discretization="radau")):
        objective, u = first_solve(pendulum(20, "steep", robust_horizon=0, **options), x0)
        assert objective == pytest.approx(reference[0], rel=1e-3), options
        np.testing.assert_allclose(u, reference[1], atol=0.05)


def test_identical_scenarios_and_one_scenario_give_the_nominal_controller():
    x0 = NEAR_UPRIGHT
    nominal = first_solve(pendulum(objective="steep", robust_horizon=0, tol=1e-9), x0)
    for scenarios in (np.ones((3, 3)), np.ones((1, 3))):
        objective, u = first_solve(pendulum(objective="steep", scenarios=scenarios, robust_horizon=1, tol=1e-9), x0)
        assert objective == pytest.approx(nominal[0], rel=1e-6)
        np.testing.assert_allclose(u, nominal[1], atol=1e-3)


def test_a_tree_that_branches_twice():
    """Nodes, parents and scenarios of every stage, by following the prediction with the plant's own equations."""
    controller = pendulum(3, scenarios=dp.SCENARIOS["mpc"][[0, 5]], robust_horizon=2)
    assert controller.nodes == [1, 2, 4, 4]
    x0 = NEAR_UPRIGHT
    first_solve(controller, x0)
    predicted = controller.prediction()
    states = [x0[:, None], *predicted["x"]]
    for t in range(3):
        for j in range(controller.nodes[t + 1]):
            parent = j // 2 if t < 2 else j
            expected = dp.step(states[t][:, parent], predicted["u"][t][:, parent], controller.scenarios[j % 2], dp.MODEL_SUBSTEPS)
            np.testing.assert_allclose(states[t + 1][:, j], expected, atol=1e-6)


def test_robust_problem_equals_its_twin_in_the_deployed_controller():
    """The same tree, model, Gaussian cost, L1 slack: rl_mpc_deploy.py without a critic."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    stage = ca.Function("stage", [x, g], [-ca.exp(-((x[1] - g) ** 2) / 0.02)])
    same = 0
    for x0 in (CSTR_X0, np.array([0.8, 0.6, 145.0, 141.0])):  # the second outside the bounds
        twin = deploy.ScenarioMPC(cstr, 5, cstr.SCENARIOS["mpc"], stage, goal=[0.65], iterations=50, compile=False)
        mine = gm.ScenarioMPC(cstr, 5, cstr.SCENARIOS["mpc"], stage, goal=[0.65], robust_horizon=1, compile=False)
        objective, u = first_solve(mine, x0)
        v = twin.make_step(x0)
        gap = (objective - twin.stats["cost"]) / (1 + abs(objective))
        assert -1e-4 < gap < 0.01  # from outside the bounds the twin finds the better of two optima
        if abs(gap) < 1e-5:
            same += 1
            assert (np.abs(u - v) <= 0.01 * (cstr.U_HIGH - cstr.U_LOW)).all()
    assert same


@pytest.mark.parametrize("robust_horizon, solver", [(0, "ipopt"), (1, "ipopt"), (2, "ipopt"), (0, "fatrop")])
def test_objective_is_that_of_a_naive_loop(robust_horizon, solver):
    """At a random point: weights, both slack prices, change penalty through the tree, terminal cost at every leaf, a goal per stage."""
    rng, N, S = np.random.default_rng(1), 3, 2 if robust_horizon else 1
    x, g, span = ca.SX.sym("x", 4), ca.SX.sym("g", 1), cstr.INIT_HIGH - cstr.INIT_LOW
    stage = ca.Function("s", [x, g], [ca.sumsqr(x / span) + ca.sin(g) * x[1]])
    terminal = ca.Function("t", [x, g], [ca.sum1((x / span) ** 3) + g**2 * x[0]])
    price, price_l2, change = rng.uniform(1, 2, (2, 4)), rng.uniform(1, 2, (2, 4)), rng.uniform(0, 1e-3, 2)
    price[0, 2] = price_l2[0, 2] = 0.0  # no lower bound for T_R
    mpc = gm.ScenarioMPC(cstr, N, cstr.SCENARIOS["mpc"][[0, 5]], stage, terminal, goal=[0.65], robust_horizon=robust_horizon, solver=solver,
                         slack_price=price, slack_price_l2=price_l2, change_weight=change, compile=False)  # fmt: skip
    w, goal, before = rng.uniform(-0.5, 0.5, mpc.size["w"]), rng.uniform(-1, 1, (1, N)), rng.uniform(cstr.U_LOW, cstr.U_HIGH)
    u = [mpc.physical(w, "u", t) for t in range(N)]
    if solver == "fatrop":  # the carried action is another variable: set it to what it must equal
        for t in range(N + 1):
            w[mpc.index["u_before"][t]] = (((u[t - 1] if t else before[:, None]).T - mpc.u_center) / mpc.u_scale).T
    function = ca.Function("f", [mpc.nlp["x"], mpc.nlp["p"]], [mpc.nlp["f"]])
    objective = float(function(w, np.concatenate([envs.sample_states(cstr, rng, 1)[0], before, goal.ravel()])))
    expected = 0.0
    for t in range(1, N + 1):
        states, slack, nodes = mpc.physical(w, "x", t), w[mpc.index["slack"][t]], S ** min(t, robust_horizon)
        for j in range(nodes):
            expected += float(stage(states[:, j], goal[0, t - 1])) / nodes + (float(terminal(states[:, j], goal[0, -1])) / nodes) * (t == N)
            for value, (side, i) in zip(slack[:, j], [(0, 0), (0, 1), (0, 3), (1, 0), (1, 1), (1, 2), (1, 3)], strict=True):
                e = value * span[i] / 2
                expected += (price[side, i] * e + price_l2[side, i] * e**2) / nodes
    for t in range(N):
        nodes = S ** min(t, robust_horizon)
        for j in range(nodes):
            last = u[t - 1][:, j // S if t <= robust_horizon else j] if t else before
            expected += (change * (u[t][:, j] - last) ** 2).sum() / nodes
    assert objective == pytest.approx(expected, rel=1e-12)


def test_hard_bounds_hold_in_a_tree_from_the_first_prediction_on():
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    heat = ca.Function("heat", [x, g], [-x[2] / 10])
    mpc = gm.ScenarioMPC(cstr, 3, cstr.SCENARIOS["mpc"], heat, goal=[0.65], robust_horizon=1, slack_price=np.inf, compile=False)
    first_solve(mpc, np.array([1.2, 0.6, 137.0, 137.0]))
    states = np.hstack(mpc.prediction()["x"])
    assert states.shape == (4, 27) and 139.9 < states[2].max() < 140 + 1e-4
    mpc.make_step(np.array([1.2, 0.6, 140.5, 120.0]))  # a measured state outside is no contradiction
    assert mpc.stats["rung"] in ("solved", "retry")


def test_guide_and_preview():
    """The guide's closed loop is the first guess; with preview the controller prepares for a goal that it otherwise learns of later."""
    guide = pendulum(4, robust_horizon=0)
    mpc = pendulum(8, robust_horizon=0, guide=guide)
    guess = mpc.guided_guess(dp.START)
    x = dp.START
    guide.reset()
    for t in range(8):
        np.testing.assert_allclose(mpc.physical(guess, "x", t)[:, 0], x, atol=1e-9)
        u = guide.make_step(x)
        np.testing.assert_allclose(mpc.physical(guess, "u", t)[:, 0], u, atol=1e-9)
        x = dp.step(x, u, dp.PSI_NOMINAL)
    plant, (x, g) = linear_plant(), (ca.SX.sym("x", 2), ca.SX.sym("g", 1))
    cost = ca.Function("c", [x, g], [(x[0] - g) ** 2])
    mpc = gm.ScenarioMPC(plant, 5, np.ones((1, 1)), cost, goal=[0.0], change_weight=[1e-4], compile=False)
    goals = np.repeat([[0.0], [1.0]], [6, 6], axis=0)
    early, late = (gm.simulate(mpc, np.zeros(2), np.ones(1), goals, preview)[0][:, 0] for preview in (True, False))
    assert np.abs(late[:7]).max() < 1e-3 < np.abs(early[:7]).max() and late[-1] == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_soft_equals_hard_where_hard_is_feasible(solver):
    plant = linear_plant(u_max=3.0, x_max=0.5)
    cost, _ = quadratic(plant, np.diag([1.0, 0.0]))
    x0, results = np.array([0.45, 0.4]), {}
    for price in (np.inf, 100.0, 0.0):
        mpc = gm.ScenarioMPC(plant, 15, np.ones((1, 1)), cost, goal=[0.0], slack_price=price, solver=solver, compile=False)
        objective, u = first_solve(mpc, x0)
        results[price] = objective, np.abs(np.hstack(mpc.prediction()["x"])).max()
    assert results[np.inf][0] == pytest.approx(results[100.0][0], rel=1e-4) and results[100.0][1] < 0.5 + 1e-4
    assert results[0.0][1] > 0.51 and results[0.0][0] < results[np.inf][0]  # the bound was in the way


def test_a_quadratic_price_alone_bends_a_plan_and_no_price_ignores_the_bound():
    hot, deviations = np.array([0.8, 0.6, 139.0, 139.0]), []
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    heat = ca.Function("heat", [x, g], [-x[2]])
    for l2 in (0.0, 1e3):
        mpc = gm.ScenarioMPC(cstr, 3, cstr.SCENARIOS["mpc"], heat, goal=[0.65], slack_price=0.0, slack_price_l2=l2, compile=False)
        first_solve(mpc, hot)
        deviations.append(max(states[2].max() for states in mpc.prediction()["x"]) - 140)
    assert deviations[0] > 0.1 and deviations[1] < 0.5 * deviations[0]


def test_a_control_horizon_needs_a_law():
    with pytest.raises(ValueError, match="control_horizon is 2"):
        pendulum(control_horizon=2)


def test_the_pendulum_holds_still_where_its_rods_stand_or_hang():
    assert (
        gm.envs.can_hold(dp, np.array([[0.0, 0.0], [np.pi, 0.0], [0.0, -np.pi], [0.3, 0.0], [np.pi, 1.0]])).tolist()
        == [True] * 3 + [False] * 2
    )


def test_slack_is_priced_per_physical_unit_and_squared():
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    nothing = ca.Function("nothing", [x, g], [0])
    mpc = gm.ScenarioMPC(
        cstr, 1, cstr.SCENARIOS["mpc"], nothing, goal=[0.65], robust_horizon=1, slack_price=3.0, slack_price_l2=0.5, compile=False
    )
    objective, _ = first_solve(mpc, np.array([0.8, 0.6, 160.0, 155.0]))
    states = mpc.prediction()["x"][0]
    violation = np.maximum(states - cstr.X_HIGH[:, None], 0) + np.maximum(cstr.X_LOW[:, None] - states, 0)
    assert objective == pytest.approx((3 * violation + 0.5 * violation**2).sum(0).mean(), rel=1e-3) and violation.sum() > 10


def test_goal_may_change_over_the_horizon():
    """A plan that knows of the change equals, stage by stage, what the cost says; a wrong shape is refused."""
    plant, (cost, _) = linear_plant(), (None, None)
    x, g = ca.SX.sym("x", 2), ca.SX.sym("g", 1)
    cost = ca.Function("c", [x, g], [(x[0] - g) ** 2])
    mpc = gm.ScenarioMPC(plant, 20, np.ones((1, 1)), cost, goal=[0.0], change_weight=[1e-6], compile=False)
    mpc.set_goal(np.repeat([[0.2, -0.3]], [12, 8], axis=1))
    objective, _ = first_solve(mpc, np.array([0.2, 0.0]))
    x, u = mpc.prediction()["x"], np.hstack(mpc.prediction()["u"])[0]
    stages = sum((state[0, 0] - (0.2 if t < 12 else -0.3)) ** 2 for t, state in enumerate(x))
    assert objective == pytest.approx(stages + 1e-6 * (np.diff(u, prepend=0.0) ** 2).sum(), rel=1e-6)
    assert x[5][0, 0] == pytest.approx(0.2, abs=0.02) and x[-1][0, 0] == pytest.approx(-0.3, abs=0.02)
    for bad in ([0.0, 1.0], np.zeros((1, 7)), [np.nan]):
        with pytest.raises(ValueError, match="goal"):
            mpc.set_goal(bad)


@pytest.mark.skipif(not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="no C compiler")
@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_compiled_equals_interpreted(solver, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    options = dict(horizon=8, robust_horizon=0, solver=solver)
    compiled = pendulum(**options, compile=True)
    assert compiled.compiled and len(list((tmp_path / "rlmpc").iterdir())) == 1
    a, b = first_solve(compiled, dp.START), first_solve(pendulum(**options), dp.START)
    assert a[0] == pytest.approx(b[0], rel=1e-8)
    np.testing.assert_allclose(a[1], b[1], atol=1e-4)
    pendulum(**options, compile=True)
    assert len(list((tmp_path / "rlmpc").iterdir())) == 1  # from the cache
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert not pendulum(**options, compile=True).compiled


@pytest.mark.parametrize("options", [dict(robust_horizon=1), dict(solver="fatrop", change_weight=[0.1], discretization="radau")])
def test_shifting_moves_time_and_not_channels(options):
    controller = pendulum(4, scenarios=dp.SCENARIOS["mpc"][:2], **options)
    for vector, names in (("w", ("x", "u", "u_before", "inside", "slack")), ("g", ("dynamics", "carried", "collocation", "box"))):
        values = np.zeros(controller.size[vector])
        stages = {(name, t): at for name in names for t, at in controller.index.get(name, {}).items()}
        for (_, t), at in stages.items():
            values[at] = 1000 * t + 10 * np.arange(at.shape[0])[:, None] + np.arange(at.shape[1])
        shifted = values[controller.shift[vector]]
        for (name, t), at in stages.items():
            later = t + 1 if (name, t + 1) in stages else t
            np.testing.assert_array_equal(shifted[at], 1000 * later + 10 * np.arange(at.shape[0])[:, None] + np.arange(at.shape[1]))


# Failures


def test_failure_ladder():
    """Each rung in turn, by solves that fail on command; a failed iterate is neither applied nor a later start."""
    controller = pendulum(3, robust_horizon=0)
    solve, outcomes, guesses = controller._solve, [], []

    def scripted(which, x0, guess, *multipliers):
        guesses.append(guess)
        return solve(which, x0, guess, *multipliers) if outcomes.pop(0) else None

    controller._solve = scripted

    def step(*given):
        outcomes[:] = given
        u = controller.make_step(dp.START)
        assert not outcomes and ((dp.U_LOW <= u) & (u <= dp.U_HIGH)).all()
        return u, controller.stats["rung"], controller.stats["success"]

    u, *rest = step(False, False)  # nothing planned yet: the last action
    assert rest == ["hold", False] and u == 0
    assert not np.array_equal(*guesses[-2:])  # the retry starts elsewhere
    assert step(False, True)[1:] == ("retry", False)
    assert step(True)[1:] == ("solved", True)
    planned = controller.prediction()["u"]
    for t in (1, 2):
        u, *rest = step(False, False)
        assert rest == ["plan", False]
        np.testing.assert_allclose(u, planned[t][:, 0], atol=1e-12)
    last = u
    u, *rest = step(False, False)  # the plan is used up
    assert rest == ["hold", False]
    np.testing.assert_array_equal(u, last)
    assert step(True)[1:] == ("solved", True)  # and it recovers


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_every_status_is_read(solver):
    """A solver stopped after two iterations is a failure, whatever it returned."""
    controller = pendulum(10, robust_horizon=0, solver=solver)
    structure = {"structure_detection": "auto", "equality": (controller.bounds["ubg"] == 0).tolist()} if solver == "fatrop" else {}
    options = {solver: {"print_level": 0, "max_iter": 2}, "print_time": False} | structure
    controller.solvers = {name: ca.nlpsol(name, solver, controller.nlp, options) for name in ("cold", "warm")}
    u = controller.make_step(dp.START)
    assert not controller.stats["success"] and controller.stats["rung"] == "hold" and u == 0
    with pytest.raises(ValueError, match="no prediction"):
        controller.prediction()


@pytest.mark.parametrize("state", [[0, 3, np.nan, 0, 0, 0], [0, 3, 3, 0, 0], [[0, 3, 3, 0, 0, 0]], [np.inf, 3, 3, 0, 0, 0]])
def test_a_state_that_is_none_is_refused(state):
    with pytest.raises(ValueError, match="state"):
        pendulum(2).make_step(state)


def test_problems_that_cannot_be_built_are_refused():
    with pytest.raises(ValueError, match="horizon is 0"):
        pendulum(0)
    with pytest.raises(ValueError, match="fatrop"):
        pendulum(3, robust_horizon=1, solver="fatrop")


# Goals, measures, command line


def test_goal_schedules():
    goals = gm.goal_schedule(dp, ("up-down", "1.5,-0.5@3", "up-up@5"), 6)
    np.testing.assert_allclose(goals, [[0, np.pi]] * 3 + [[1.5, -0.5]] * 2 + [[0, 0]])
    np.testing.assert_allclose(gm.goal_schedule(cstr, ("0.7",), 2), [[0.7], [0.7]])
    np.testing.assert_allclose(gm.goal_schedule(cstr, (), 1), [cstr.EVAL_GOAL])
    bad_schedules = ["sideways"], ["1"], ["1,2,3"], ["up-up", "up-down"], ["up-up", "0,0@4", "up-up@4"], ["9,0"], ["up-up", "0,0@x"]
    for bad in (*bad_schedules, ["up-up@2"], ["up-up", "up-down@6"]):
        with pytest.raises(ValueError, match="--goal"):
            gm.goal_schedule(dp, bad, 6)


def test_objectives_are_those_of_the_paper():
    x, goal = np.array([0.2, 0.4, 2.0, 0.3, -1.0, 2.0]), np.array([0.0, np.pi])
    squared = (1 - np.cos(0.4)) ** 2 + (1 - np.cos(2.0 - np.pi)) ** 2
    assert float(gm.costs(dp, "quadratic")[0](x, goal)) == pytest.approx(squared / 2)
    assert float(gm.costs(dp, "goal")[0](x, goal)) == pytest.approx(-np.exp(-squared / 2))
    assert float(gm.costs(dp, "goal", 0.5)[0](x, goal)) == pytest.approx(-np.exp(-squared))
    assert float(gm.costs(dp, "expert")[0](x, goal)) == pytest.approx(float(dp.kinetic_energy(x) - dp.potential_energy(x)))


def test_the_nominal_plant_leads_every_tree():
    for scenarios, size in {"nominal": 1, "mpc": 9, "robust": 101}.items():
        mpc = gm.build_controller(gm.Args(env="cstr", horizon=1, scenarios=scenarios, compile=False, robust_horizon=1))
        np.testing.assert_array_equal(mpc.scenarios[0], cstr.PSI_NOMINAL)
        assert len(mpc.scenarios) == size


def test_closed_loop_measures_are_those_of_a_naive_loop():
    args = gm.Args(horizon=8, compile=False, steps=6)
    goals = gm.goal_schedule(dp, ("up-down", "up-up@3"), 6)
    x0, psi = gm.start_and_plant(dp, seed=3, random_plant=True)
    x, u, predicted, log = gm.simulate(gm.build_controller(args), x0, psi, goals)
    near, variation, before = 0.0, 0.0, 0.0
    for t in range(6):
        np.testing.assert_allclose(x[t + 1], dp.step(x[t], u[t], psi))
        near += np.exp(-sum((1 - np.cos(x[t + 1][1 + j] - goals[t][j])) ** 2 for j in range(2)) / 0.02)
        variation, before = variation + abs(u[t][0] - before), u[t][0]
    row = gm.summary(dp, x, u, goals, log)
    assert row["time_near_goal"] == pytest.approx(near, abs=1e-5) and row["action_total_variation"] == pytest.approx(variation, abs=1e-5)
    assert predicted.shape == (6, 9, 6)


@pytest.mark.skipif(not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="no C compiler")
def test_swing_up():
    """Expert and goal-conditioned agent bring both rods up and hold them; 40 of 100 steps is what a good swing-up gives."""
    for args in (gm.Args(objective="expert"), gm.Args(objective="goal")):
        mpc = gm.build_controller(args)
        x, u, _, log = gm.simulate(mpc, dp.START, dp.PSI_NOMINAL, gm.goal_schedule(dp, (), 100))
        row = gm.summary(dp, x, u, np.zeros((100, 2)), log)
        assert row["time_near_goal"] > 30 and np.abs(np.sin(x[-5:, 1:3] / 2)).max() < 0.1


COLUMNS = (
    "env objective horizon robust_horizon constraints solver gamma sigma2 goal seed time_near_goal action_total_variation solve_ms_median "
    "solve_ms_p95 solve_ms_max solver_failures".split()
)


def run_script(*arguments):
    return subprocess.run([sys.executable, "goal_mpc.py", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize(
    "extra, files",
    [
        (["--env", "double_pendulum", "--episodes", "2", "--animate"], {"results.csv", "trajectories.npz", "episode.png", "episode.gif"}),
        (["--env", "cstr", "--robust-horizon", "1", "--constraints", "hard", "--objective", "quadratic"],
         {"results.csv", "trajectories.npz", "episode.png"}),
    ],
)  # fmt: skip
def test_command_line_end_to_end(extra, files, tmp_path):
    out = run_script("--horizon", 6, "--steps", 4, "--no-compile", "--out", tmp_path / "o", *extra)
    assert out.returncode == 0, out.stderr
    assert {path.name for path in (tmp_path / "o").iterdir()} == files
    rows = list(csv.DictReader(open(tmp_path / "o" / "results.csv")))
    assert list(rows[0]) == COLUMNS and [row["seed"] for row in rows] == ["0", "1"][: len(rows)]
    assert all(np.isfinite(float(row[column])) for row in rows for column in COLUMNS[9:])
    assert all(word in out.stdout for word in ("near goal", "action TV", "ms median", "p95", "max", "failed"))
    again = run_script("--horizon", 6, "--steps", 4, "--no-compile", "--out", tmp_path / "p", *extra)
    assert again.returncode == 0
    for mine, other in zip(rows, csv.DictReader(open(tmp_path / "p" / "results.csv")), strict=True):
        assert all(mine[column] == other[column] for column in COLUMNS if "_ms_" not in column)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--env", "pendulum"], ["--env", "pendulum", "double_pendulum"]),
        (["--goal", "sideways"], ["--goal", "sideways", "up-down"]),
        (["--goal", "1,2,3"], ["--goal", "1,2,3", "2 number(s)"]),
        (["--goal", "up-up", "up-down"], ["--goal", "up-down", "@STEP"]),
        (["--goal", "nan,0"], ["--goal", "nan,0"]),
        (["--goal", "up-up@5"], ["--goal", "up-up@5", "starts at 0"]),
        (["--goal", "up-up", "up-down@100"], ["--goal", "up-down@100", "below 100"]),
        (["--goal", "up-down", "--objective", "expert"], ["--objective", "expert", "goal"]),
        (["--guide-horizon", "75"], ["--guide-horizon", "75", "below"]),
        (["--horizon", "0"], ["--horizon", "0", "[1, "]),
        (["--objective", "expert", "--env", "cstr"], ["--objective", "expert", "quadratic"]),
        (["--objective", "best"], ["objective", "best"]),
        (["--steps", "0"], ["--steps", "0"]),
        (["--sigma2", "-1"], ["--sigma2", "-1"]),
        (["--solver", "fatrop", "--robust-horizon", "1"], ["--solver", "fatrop", "robust-horizon"]),
        (["--scenarios", "all"], ["--scenarios", "all", "extremes"]),
        (["--change-weight", "1", "2"], ["--change-weight", "1 number(s)"]),
        (["--animate", "--env", "cstr"], ["--animate", "cstr"]),
        (["--out", "LICENSE/folder"], ["--out", "cannot write"]),
        (["--robust-horizon", "5"], ["--robust-horizon", "5", "leaves"]),
        (["--objective", "quadratic", "--sigma2", "2"], ["--sigma2", "no effect", "quadratic"]),
        (["--constraints", "hard", "--slack-weight", "3"], ["--slack-weight", "no effect", "hard"]),
        (["--scenarios", "extremes"], ["--scenarios", "no effect", "--robust-horizon 0"]),
    ],
)
def test_bad_arguments_get_one_sentence_and_exit_code_2(arguments, words):
    out = run_script(*arguments)
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr


def test_help_documents_every_argument():
    out = run_script("--help")
    assert out.returncode == 0
    assert all("--" + field.name.replace("_", "-") in out.stdout for field in fields(gm.Args))


def test_default_arguments_are_accepted():
    plant, goals = gm.check(replace(gm.Args(), steps=5))
    assert plant is dp and goals.shape == (5, 2)


def test_an_interrupt_ends_the_program_at_once():
    import signal
    import time

    process = subprocess.Popen([sys.executable, "goal_mpc.py", "--no-compile", "--steps", "100000"], cwd=ROOT, stderr=subprocess.DEVNULL)
    time.sleep(8)  # in a solve
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=10) == -signal.SIGINT
