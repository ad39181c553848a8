"""goal_mpc.py against Riccati, against what must hold of a scenario tree, against its twin, the failure ladder, and the command line."""

import csv
import shutil
import signal
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import tyro
from scipy.linalg import solve_discrete_are

import envs
import goal_mpc as gm
import rl_mpc_deploy as deploy
from envs import cstr
from envs.script.pendulum import kinetic_energy, potential_energy

dp = envs.load("double_pendulum")

ROOT = Path(__file__).parent.parent
CSTR_X0 = np.array([0.8, 0.5, 134.14, 130.0])
NEAR_UPRIGHT = np.array([0.1, 0.1, 0.05, 0.0, 0.0, 0.0])  # one basin: other local optima are far
CHAIN = np.array([[0.0, 1.0], [0.3, -0.2]])  # x' = CHAIN x + [0, psi] u


def linear_plant(u_max=100.0, x_max=np.inf):
    """A double integrator's cousin as a plant module, exactly discretised by enough Runge-Kutta steps."""
    plant = SimpleNamespace(
        ENV_ID="linear",
        STATE_NAMES=("a", "b"),
        DT=0.1,
        MODEL_SUBSTEPS=10,
        GOAL_INDEX=[0],
        X_LOW=np.full(2, -x_max),
        X_HIGH=np.full(2, x_max),
        INIT_LOW=-np.ones(2),
        INIT_HIGH=np.ones(2),
        U_LOW=np.array([-u_max]),
        ANGLES=[],
        U_HIGH=np.array([u_max]),
        PSI_NOMINAL=np.ones(1),
        GOAL_LOW=-np.ones(1),
        GOAL_HIGH=np.ones(1),
    )

    def ode(x, u, psi, xp):
        a, b = (
            CHAIN[0, 0] * x[0] + CHAIN[0, 1] * x[1],
            CHAIN[1, 0] * x[0] + CHAIN[1, 1] * x[1] + psi[0] * u[0],
        )
        return ca.vertcat(a, b) if xp is ca else np.array([a, b])

    plant.ode = ode
    plant.step = lambda x, u, psi: gm.envs.rk4(
        ode, np.asarray(x, float), np.atleast_1d(u), np.asarray(psi), 0.1, 10
    )
    return plant


def quadratic(plant, Q, P=None):
    x, g = ca.SX.sym("x", 2), ca.SX.sym("g", 1)
    cost = ca.Function("q", [x, g], [x.T @ Q @ x])
    return cost, None if P is None else ca.Function("p", [x, g], [x.T @ (P - Q) @ x])


class Radau(gm.ScenarioMPC):
    """Predicts by Radau collocation of degree 3 instead of Runge-Kutta steps."""

    def model(self):
        tau, plant = ca.collocation_points(3, "radau"), self.plant
        C, D, _ = ca.collocation_coeff(tau)
        n_x, n_u = len(self.x_scale), len(self.u_scale)
        x, u, psi = (
            ca.MX.sym(name, n) for name, n in (("x", n_x), ("u", n_u), ("psi", self.scenarios.shape[1]))
        )
        inside = ca.MX.sym("inside", n_x, 3)  # states at the collocation points
        points, action = ca.horzcat(x, inside), u * self.u_scale + self.u_center
        slopes = [
            plant.ode(inside[:, j] * self.x_scale + self.x_center, action, psi, ca) / self.x_scale
            for j in range(3)
        ]
        residual = ca.vec(points @ C - plant.DT * ca.horzcat(*slopes))
        root = ca.rootfinder(
            "root", "newton", {"x": ca.vec(inside), "p": ca.vertcat(x, u, psi), "g": residual}
        )
        found = ca.reshape(root(ca.repmat(x, 3, 1), ca.vertcat(x, u, psi)), n_x, 3)
        return ca.Function("step", [x, u, psi], [ca.horzcat(x, found) @ D])


def pendulum(horizon=12, objective="goal", kind=gm.ScenarioMPC, **options):
    """The controller with one of the paper's objectives, or with "steep": quadratic in the state, so that optima are sharp."""
    x, g = ca.SX.sym("x", 6), ca.SX.sym("g", 2)
    steep = ca.Function("steep", [x, g], [ca.sumsqr(x[1:3] - g) + 0.1 * ca.sumsqr(x)])
    stage = steep if objective == "steep" else gm.costs(dp, objective)[0]
    settings = dict(goal=dp.EVAL_GOAL, compile=False) | options
    return kind(dp, horizon, settings.pop("scenarios", dp.SCENARIOS["mpc"]), stage, **settings)


def first_solve(controller, x0):
    controller.reset()
    u = controller.make_step(x0)
    assert controller.stats["rung"] == "solved", controller.stats
    return controller.objective, u


# The optimal control problem


@pytest.mark.parametrize("kind", [gm.ScenarioMPC, Radau])
def test_linear_quadratic_problem_has_riccatis_solution(kind):
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
    mpc = kind(
        plant,
        80,
        np.ones((1, 1)),
        quadratic(plant, Q)[0],
        goal=[0.0],
        change_weight=[R],
        compile=False,
        ipopt={"tol": 1e-9},
    )
    x0 = np.array([0.7, -0.4])
    objective, u = first_solve(mpc, x0)
    start = np.append(x0, 0.0)
    assert objective == pytest.approx(start @ P @ start, rel=1e-6)
    np.testing.assert_allclose(u, -K @ start, rtol=1e-5)


def test_runge_kutta_steps_and_collocation_agree_on_the_pendulum():
    results = [first_solve(pendulum(20, "steep", kind), NEAR_UPRIGHT) for kind in (gm.ScenarioMPC, Radau)]
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-3)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=0.05)


def test_identical_scenarios_and_one_scenario_give_the_nominal_controller():
    x0 = NEAR_UPRIGHT
    nominal = first_solve(pendulum(objective="steep", ipopt={"tol": 1e-9}), x0)
    for scenarios in (np.ones((3, 3)), np.ones((1, 3))):
        objective, u = first_solve(
            pendulum(objective="steep", scenarios=scenarios, robust_horizon=1, ipopt={"tol": 1e-9}), x0
        )
        assert objective == pytest.approx(nominal[0], rel=1e-6)
        np.testing.assert_allclose(u, nominal[1], atol=1e-3)


def test_a_tree_that_branches_twice():
    """Nodes, parents and scenarios of every stage, by following the prediction with the plant's own equations."""
    controller, nodes = pendulum(3, scenarios=dp.SCENARIOS["mpc"][[0, 5]], robust_horizon=2), [1, 2, 4, 4]
    x0 = NEAR_UPRIGHT
    first_solve(controller, x0)
    predicted = controller.prediction()
    states = [x0[:, None], *predicted["x"]]
    for t in range(3):
        for j in range(nodes[t + 1]):
            parent = j // 2 if t < 2 else j
            expected = dp.step(
                states[t][:, parent],
                predicted["u"][t][:, parent],
                controller.scenarios[j % 2],
                dp.MODEL_SUBSTEPS,
            )
            np.testing.assert_allclose(states[t + 1][:, j], expected, atol=1e-6)


def test_robust_problem_equals_its_twin_in_the_deployed_controller():
    """The same tree, model, Gaussian cost, L1 slack: rl_mpc_deploy.py without a critic."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    stage = ca.Function("stage", [x, g], [-ca.exp(-((x[1] - g) ** 2) / 0.02)])
    same = 0
    for x0 in (CSTR_X0, np.array([0.8, 0.6, 145.0, 141.0])):  # the second outside the bounds
        twin = deploy.ScenarioMPC(
            cstr, 5, cstr.SCENARIOS["mpc"], stage, goal=[0.65], iterations=50, compile=False
        )
        mine = gm.ScenarioMPC(
            cstr, 5, cstr.SCENARIOS["mpc"], stage, goal=[0.65], robust_horizon=1, compile=False
        )
        objective, u = first_solve(mine, x0)
        v = twin.make_step(x0)
        gap = (objective - twin.stats["cost"]) / (1 + abs(objective))
        assert -1e-4 < gap < 0.01  # from outside the bounds the twin finds the better of two optima
        if abs(gap) < 1e-5:
            same += 1
            assert (np.abs(u - v) <= 0.01 * (cstr.U_HIGH - cstr.U_LOW)).all()
    assert same


@pytest.mark.parametrize("robust_horizon", [0, 1, 2])
def test_objective_is_that_of_a_naive_loop(robust_horizon):
    """At a random plan: weights, slack prices, change penalty through the tree, terminal cost at every leaf, a goal per stage."""
    rng, N, S = np.random.default_rng(1), 3, 2 if robust_horizon else 1
    x, g, span = ca.SX.sym("x", 4), ca.SX.sym("g", 1), cstr.INIT_HIGH - cstr.INIT_LOW
    stage = ca.Function("s", [x, g], [ca.sumsqr(x / span) + ca.sin(g) * x[1]])
    terminal = ca.Function("t", [x, g], [ca.sum1((x / span) ** 3) + g**2 * x[0]])
    price, change = rng.uniform(1, 2, (2, 4)), rng.uniform(0, 1e-3, 2)
    price[0, 2] = 0.0  # no lower bound for T_R
    mpc = gm.ScenarioMPC(
        cstr,
        N,
        cstr.SCENARIOS["mpc"][[0, 5]],
        stage,
        terminal,
        goal=[0.65],
        robust_horizon=robust_horizon,
        slack_price=price,
        change_weight=change,
        compile=False,
    )
    nodes = [S ** min(t, robust_horizon) for t in range(N + 1)]
    goal, before = rng.uniform(-1, 1, (1, N)), rng.uniform(cstr.U_LOW, cstr.U_HIGH)
    states = [rng.uniform(cstr.X_LOW - span, cstr.X_HIGH + span, (n, 4)) for n in nodes[1:]]
    u = [rng.uniform(cstr.U_LOW, cstr.U_HIGH, (n, 2)) for n in nodes[:-1]]
    function = ca.Function("f", [mpc.problem["x"], mpc.problem["p"]], [mpc.problem["f"]])
    plan = mpc.vector(np.concatenate(states), np.concatenate(u))
    objective = float(
        function(plan, np.concatenate([envs.sample_states(cstr, rng, 1)[0], before, goal.ravel()]))
    )
    expected = 0.0
    for t in range(1, N + 1):
        for x in states[t - 1]:
            expected += float(stage(x, goal[0, t - 1])) / nodes[t] + (
                float(terminal(x, goal[0, -1])) / nodes[t]
            ) * (t == N)
            outside = np.maximum(cstr.X_LOW - x, 0), np.maximum(x - cstr.X_HIGH, 0)
            expected += sum((price[side] * outside[side]).sum() for side in (0, 1)) / nodes[t]
    for t in range(N):
        for j in range(nodes[t]):
            last = u[t - 1][j // S if t <= robust_horizon else j] if t else before
            expected += (change * (u[t][j] - last) ** 2).sum() / nodes[t]
    assert objective == pytest.approx(expected, rel=1e-12)


def test_hard_bounds_hold_in_a_tree_from_the_first_prediction_on():
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    heat = ca.Function("heat", [x, g], [-x[2] / 10])
    mpc = gm.ScenarioMPC(
        cstr, 3, cstr.SCENARIOS["mpc"], heat, goal=[0.65], robust_horizon=1, slack_price=np.inf, compile=False
    )
    first_solve(mpc, np.array([1.2, 0.6, 137.0, 137.0]))
    states = np.hstack(mpc.prediction()["x"])
    assert states.shape == (4, 27) and 139.9 < states[2].max() < 140 + 1e-4
    mpc.make_step(np.array([1.2, 0.6, 140.5, 120.0]))  # a measured state outside is no contradiction
    assert mpc.stats["rung"] in ("solved", "retry")


def test_an_objective_that_is_none_is_refused():
    """Once a capital letter gave the quadratic one."""
    for wrong in (("Goal",), ("goal", 0.0), ("goal", -1.0), ("goal", np.nan)):
        with pytest.raises(ValueError, match="is not defined for RLMPC/CSTR-v0; choose quadratic, goal"):
            gm.costs(envs.load("cstr"), *wrong)


def test_the_guides_closed_loop_is_the_first_guess():
    from experiments.pendulum.performance import Guided

    guide, mpc = pendulum(4), pendulum(8, kind=Guided)
    mpc.guide = guide
    states, actions = mpc.planned(next(mpc.first_guesses(dp.START)))
    guide.reset()
    x = dp.START
    for t in range(8):
        u = guide.make_step(x)
        x = dp.step(x, u, dp.PSI_NOMINAL)
        np.testing.assert_allclose(actions[t], u, atol=1e-9)
        np.testing.assert_allclose(states[t], x, atol=1e-9)


def test_with_preview_the_controller_prepares_for_a_goal_that_it_otherwise_learns_of_later():
    plant, (x, g) = linear_plant(), (ca.SX.sym("x", 2), ca.SX.sym("g", 1))
    cost = ca.Function("c", [x, g], [(x[0] - g) ** 2])
    mpc = gm.ScenarioMPC(plant, 5, np.ones((1, 1)), cost, goal=[0.0], change_weight=[1e-4], compile=False)
    goals = np.repeat([[0.0], [1.0]], [6, 6], axis=0)
    early, late = (
        gm.simulate(mpc, np.zeros(2), np.ones(1), goals, preview)[0][:, 0] for preview in (True, False)
    )
    assert np.abs(late[:7]).max() < 1e-3 < np.abs(early[:7]).max() and late[-1] == pytest.approx(1, abs=0.05)


def test_soft_equals_hard_where_hard_is_feasible():
    plant = linear_plant(u_max=3.0, x_max=0.5)
    cost, _ = quadratic(plant, np.diag([1.0, 0.0]))
    x0, results = np.array([0.45, 0.4]), {}
    for price in (np.inf, 100.0, 0.0):
        mpc = gm.ScenarioMPC(plant, 15, np.ones((1, 1)), cost, goal=[0.0], slack_price=price, compile=False)
        objective, u = first_solve(mpc, x0)
        results[price] = objective, np.abs(np.hstack(mpc.prediction()["x"])).max()
    assert results[np.inf][0] == pytest.approx(results[100.0][0], rel=1e-4) and results[100.0][1] < 0.5 + 1e-4
    assert results[0.0][1] > 0.51 and results[0.0][0] < results[np.inf][0]  # the bound was in the way


def test_no_price_ignores_the_bound():
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    heat = ca.Function("heat", [x, g], [-x[2]])
    mpc = gm.ScenarioMPC(cstr, 3, cstr.SCENARIOS["mpc"], heat, goal=[0.65], slack_price=0.0, compile=False)
    first_solve(mpc, np.array([0.8, 0.6, 139.0, 139.0]))
    assert max(states[2].max() for states in mpc.prediction()["x"]) > 140.1


def test_the_pendulum_holds_still_where_its_rods_stand_or_hang():
    assert (
        gm.envs.can_hold(
            dp, np.array([[0.0, 0.0], [np.pi, 0.0], [0.0, -np.pi], [0.3, 0.0], [np.pi, 1.0]])
        ).tolist()
        == [True] * 3 + [False] * 2
    )


def test_slack_is_priced_per_physical_unit():
    x, g = ca.SX.sym("x", 4), ca.SX.sym("g", 1)
    nothing = ca.Function("nothing", [x, g], [0])
    options = dict(goal=[0.65], robust_horizon=1, slack_price=3.0, compile=False)
    mpc = gm.ScenarioMPC(cstr, 1, cstr.SCENARIOS["mpc"], nothing, **options)
    objective, _ = first_solve(mpc, np.array([0.8, 0.6, 160.0, 155.0]))
    states = mpc.prediction()["x"][0]
    violation = np.maximum(states - cstr.X_HIGH[:, None], 0) + np.maximum(cstr.X_LOW[:, None] - states, 0)
    assert objective == pytest.approx(3 * violation.sum(0).mean(), rel=1e-3) and violation.sum() > 10


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
    for bad in ([0.0, 1.0], np.zeros((1, 7)), [np.nan], 5.0):
        with pytest.raises(ValueError, match="goal"):
            mpc.set_goal(bad)


@pytest.mark.skipif(not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="no C compiler")
def test_compiled_equals_interpreted(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiled = pendulum(8, compile=True)
    assert len(list((tmp_path / "rlmpc").iterdir())) == 1 and not capsys.readouterr().err
    a, b = first_solve(compiled, dp.START), first_solve(pendulum(8), dp.START)
    assert a[0] == pytest.approx(b[0], rel=1e-8)
    np.testing.assert_allclose(a[1], b[1], atol=1e-4)
    pendulum(8, compile=True)
    assert len(list((tmp_path / "rlmpc").iterdir())) == 1  # from the cache
    monkeypatch.setattr(shutil, "which", lambda name: None)
    first_solve(pendulum(8, compile=True), dp.START)
    assert "interpreted" in capsys.readouterr().err


def test_a_plan_is_shifted_in_time_and_not_across_channels():
    """After a solve that succeeded two fail: the action is the plan's next one, under the first scenario where the tree branches."""
    controller = pendulum(4, scenarios=dp.SCENARIOS["mpc"][:2], robust_horizon=2)
    first_solve(controller, dp.START)
    planned = controller.prediction()
    states, actions = controller.planned(controller.plan[0])
    later = controller.tree.by_stage(states, actions)
    for key in "xu":
        stages = planned[key]
        for t, now in enumerate(later[key]):
            following = stages[min(t + 1, 3)]
            np.testing.assert_allclose(now, following[:, :: following.shape[1] // now.shape[1]])


# Failures


class Scripted(gm.ScenarioMPC):
    """Solves fail on command."""

    outcomes, guesses = (), ()

    def solve(self, which, x0, guess, *multipliers):
        self.guesses.append(guess)
        return super().solve(which, x0, guess, *multipliers) if self.outcomes.pop(0) else None


def test_failure_ladder():
    """Each rung in turn; a failed iterate is neither applied nor a later start."""
    controller = pendulum(3, kind=Scripted)
    controller.guesses = []

    def step(*given):
        controller.outcomes = list(given)
        u = controller.make_step(dp.START)
        assert not controller.outcomes and ((dp.U_LOW <= u) & (u <= dp.U_HIGH)).all()
        return u, controller.stats["rung"], controller.stats["success"], controller.stats["fell_back"]

    controller.reset(u=[2.0])
    u, *rest = step(False, False)  # nothing planned yet: the last action
    assert rest == ["hold", False, True] and u == 2.0
    assert not np.array_equal(*controller.guesses[-2:])  # the retry starts elsewhere
    assert step(False, True)[1:] == ("retry", False, False)
    assert step(True)[1:] == ("solved", True, False)
    planned = controller.prediction()["u"]
    for t in (1, 2, 2, 2):  # the last one stays
        u, *rest = step(False, False)
        assert rest == ["plan", False, True]
        np.testing.assert_allclose(u, planned[t][:, 0], atol=1e-12)
    assert step(True)[1:] == ("solved", True, False)  # and it recovers


def test_every_status_is_read():
    """A solver stopped after two iterations is a failure, whatever it returned."""
    controller = pendulum(10, ipopt={"max_iter": 2})
    u = controller.make_step(dp.START)
    assert not controller.stats["success"] and controller.stats["rung"] == "hold" and u == 0
    with pytest.raises(ValueError, match="no prediction"):
        controller.prediction()


@pytest.mark.parametrize(
    "state", [[0, 3, np.nan, 0, 0, 0], [0, 3, 3, 0, 0], [[0, 3, 3, 0, 0, 0]], [np.inf, 3, 3, 0, 0, 0]]
)
def test_a_state_that_is_none_is_refused(state):
    with pytest.raises(ValueError, match="state"):
        pendulum(2).make_step(state)


def test_problems_that_cannot_be_built_are_refused():
    with pytest.raises(ValueError, match="horizon is 0"):
        pendulum(0)
    for options in (
        dict(scenarios=np.ones((1, 2))),
        dict(slack_price=-1.0),
        dict(slack_price=np.ones(3)),
        dict(change_weight=np.nan),
    ):
        with pytest.raises(ValueError, match=next(iter(options))):
            pendulum(3, **options)


def test_angles_measured_within_one_turn():
    """Wrapped to [-pi, pi], as sensors give them, they are taken to the turn nearest to the last one."""
    controller, loops = pendulum(20), []
    for wrap in (lambda angle: angle, lambda angle: (angle + np.pi) % (2 * np.pi) - np.pi):
        controller.reset()
        x, loop = dp.START + [0, 0, 0, 0, 2.0, 2.0], []
        for _ in range(12):
            measured = x.copy()
            measured[dp.ANGLES] = wrap(x[dp.ANGLES])
            loop.append(controller.make_step(measured))
            x = dp.step(x, loop[-1], dp.PSI_NOMINAL)
        loops.append(loop)
        assert x[dp.ANGLES].max() > np.pi
    np.testing.assert_allclose(*loops, atol=1e-3)


# Goals, measures, command line


def test_goal_schedules():
    goals = gm.goal_schedule(dp, ("up-down", "1.5,-0.5@3", "up-up@5"), 6)
    np.testing.assert_allclose(goals, [[0, np.pi]] * 3 + [[1.5, -0.5]] * 2 + [[0, 0]])
    np.testing.assert_allclose(gm.goal_schedule(cstr, ("0.7",), 2), [[0.7], [0.7]])
    np.testing.assert_allclose(gm.goal_schedule(cstr, (), 1), [cstr.EVAL_GOAL])
    bad_schedules = (
        ["sideways"],
        ["1"],
        ["1,2,3"],
        ["up-up", "up-down"],
        ["up-up", "0,0@4", "up-up@4"],
        ["9,0"],
        ["up-up", "0,0@x"],
    )
    for bad in (*bad_schedules, ["up-up@2"], ["up-up", "up-down@6"]):
        with pytest.raises(ValueError, match="--goal"):
            gm.goal_schedule(dp, bad, 6)


def test_objectives_are_those_of_the_paper():
    x, goal = np.array([0.2, 0.4, 2.0, 0.3, -1.0, 2.0]), np.array([0.0, np.pi])
    squared = (1 - np.cos(0.4)) ** 2 + (1 - np.cos(2.0 - np.pi)) ** 2
    assert float(gm.costs(dp, "quadratic")[0](x, goal)) == pytest.approx(squared / 2)
    assert float(gm.costs(dp, "goal")[0](x, goal)) == pytest.approx(-np.exp(-squared / 2))
    assert float(gm.costs(dp, "goal", 0.5)[0](x, goal)) == pytest.approx(-np.exp(-squared))
    assert float(gm.costs(dp, "expert")[0](x, goal)) == pytest.approx(
        float(kinetic_energy(x) - potential_energy(x))
    )


def test_the_nominal_plant_leads_every_tree():
    for scenarios, size in {"nominal": 1, "mpc": 9, "robust": 101}.items():
        mpc = gm.build_controller(
            gm.Args(env="cstr", horizon=1, scenarios=scenarios, compile=False, robust_horizon=1)
        )
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
    assert row["time_near_goal"] == pytest.approx(near, abs=1e-5) and row[
        "action_total_variation"
    ] == pytest.approx(variation, abs=1e-5)
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
    "env objective horizon arguments seed psi time_near_goal action_total_variation solve_ms_median solve_ms_p95 solve_ms_max "
    "solver_failures".split()
)


def run_script(*arguments):
    return subprocess.run(
        [sys.executable, "goal_mpc.py", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize(
    "extra, files",
    [
        (
            ["--env", "double_pendulum", "--episodes", "2", "--animate"],
            {"results.csv", "trajectories.npz", "episode.png", "episode.gif"},
        ),
        (
            ["--env", "cstr", "--robust-horizon", "1", "--constraints", "hard", "--objective", "quadratic"],
            {"results.csv", "trajectories.npz", "episode.png"},
        ),
    ],
)
def test_command_line_end_to_end(extra, files, tmp_path):
    out = run_script("--horizon", 6, "--steps", 4, "--no-compile", "--out", tmp_path / "o", *extra)
    assert out.returncode == 0, out.stderr
    assert {path.name for path in (tmp_path / "o").iterdir()} == files
    rows = list(csv.DictReader(open(tmp_path / "o" / "results.csv")))
    assert list(rows[0]) == COLUMNS and [row["seed"] for row in rows] == ["0", "1"][: len(rows)]
    assert all(np.isfinite(float(row[column])) for row in rows for column in COLUMNS[6:])
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
        (["--horizon", "0"], ["--horizon", "0", "[1, "]),
        (["--objective", "expert", "--env", "cstr"], ["--objective", "expert", "CSTR"]),
        (["--steps", "0"], ["--steps", "0"]),
        (["--sigma2", "-1"], ["--sigma2", "-1"]),
        (["--scenarios", "all"], ["--scenarios", "all", "extremes"]),
        (["--change-weight", "1", "2"], ["--change-weight", "1 number(s)"]),
        (["--animate", "--env", "cstr"], ["--animate", "cstr"]),
        (["--out", "LICENSE/folder"], ["--out", "cannot write"]),
        (["--robust-horizon", "5"], ["robust horizon of 5", "leaves"]),
        (["--objective", "quadratic", "--sigma2", "2"], ["--sigma2", "no effect", "quadratic"]),
        (["--constraints", "hard", "--slack-weight", "3"], ["--slack-weight", "no effect", "hard"]),
        (["--scenarios", "extremes"], ["--scenarios", "no effect", "--robust-horizon 0"]),
    ],
)
def test_bad_arguments_get_one_sentence(arguments, words, tmp_path):
    args = tyro.cli(gm.Args, args=arguments)
    with pytest.raises(ValueError) as refusal:
        gm.main(replace(args, out=args.out or tmp_path))
    sentence = str(refusal.value)
    assert "\n" not in sentence and all(word in sentence for word in words), sentence


@pytest.mark.parametrize(
    "arguments, word", [(["--horizon", "0"], "error: --horizon is 0"), (["--objective", "best"], "best")]
)
def test_bad_arguments_end_with_exit_code_2(arguments, word):
    out = run_script(*arguments)
    assert out.returncode == 2 and "Traceback" not in out.stderr and word in out.stderr


def test_help_documents_every_argument():
    out = run_script("--help")
    assert out.returncode == 0
    assert all("--" + field.name.replace("_", "-") in out.stdout for field in fields(gm.Args))


def test_default_arguments_are_accepted():
    plant, goals = gm.check(replace(gm.Args(), steps=5))
    assert plant.name == "double_pendulum" and goals.shape == (5, 2)


def test_an_interrupt_ends_the_program_at_once(tmp_path):
    script = [sys.executable, "-u", "goal_mpc.py"]
    command = [*script, "--no-compile", "--steps", "100000", "--out", str(tmp_path)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert "variables" in process.stdout.readline()  # built; the next thing is a solve
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=10) == -signal.SIGINT


def test_what_the_caller_hands_over_is_not_kept():
    """Buffers that are used again change nothing."""
    x, goal, scenarios = CSTR_X0.copy(), np.array([0.65]), cstr.SCENARIOS["mpc"].copy()
    price, change = np.full((2, 4), 2.0), np.array([1e-4, 1e-8])
    stage = gm.costs(cstr, "goal")[0]
    options = dict(goal=goal, robust_horizon=1, slack_price=price, change_weight=change, compile=False)
    careless = gm.ScenarioMPC(cstr, 2, scenarios, stage, **options)
    options = {
        name: np.copy(value) if isinstance(value, np.ndarray) else value for name, value in options.items()
    }
    careful = gm.ScenarioMPC(cstr, 2, scenarios.copy(), stage, **options)
    for buffer in (goal, scenarios, price, change):
        buffer[:] = 0.1
    for _ in range(3):
        expected = careful.make_step(x.copy())
        u = careless.make_step(x)
        np.testing.assert_array_equal(u, expected)
        u[:] = 0
        x[:] = cstr.step(x, expected, cstr.PSI_NOMINAL)
