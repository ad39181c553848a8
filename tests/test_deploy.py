"""The exported critic against torch, the scenario tree against what must hold of one, the failure ladder, and the command line."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch

import envs
import rl_mpc_deploy as deploy
import sac_her_branching as training
from envs import cstr
from envs.tools import compiled

ROOT = Path(__file__).parent.parent
X0 = np.array([0.8, 0.5, 134.14, 130.0])
GOAL = cstr.EVAL_GOAL


def run_script(*arguments):
    return subprocess.run([sys.executable, "rl_mpc_deploy.py", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300)


def gaussian():
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    return ca.Function("stage", [x, g], [-ca.exp(-((x[1] - g) ** 2) / (2 * 0.1**2))])


def mpc(horizon=3, scenarios=cstr.SCENARIOS["mpc"], stage=None, terminal=None, goal=GOAL, **options):
    return deploy.ScenarioMPC(cstr, horizon, scenarios, stage or gaussian(), terminal, goal=goal, compile=False, **options)


def first_solve(controller, x0=X0):
    controller.reset()
    controller.set_initial_guess(x0)
    u = controller.make_step(x0)
    assert controller.stats["rung"] == "solved", controller.stats
    return controller.last_objective, u


def close(u, v, share):
    """Actions that differ by at most this share of their range."""
    return (np.abs(u - v) <= share * (cstr.U_HIGH - cstr.U_LOW)).all()


# Checkpoint and export


@pytest.mark.parametrize("goal_input", ["error", "goal"])
@pytest.mark.parametrize("value", ["min", "first", "mean"])
def test_export_equals_torch_in_value_gradient_and_hessian(checkpoint, tmp_path, goal_input, value):
    data = torch.load(checkpoint, weights_only=True)
    data["goal_input"] = goal_input
    torch.save(data, tmp_path / "c.pt")
    critic = deploy.load_critic(tmp_path / "c.pt", "cstr", value)
    _, _, V = deploy.export(critic)
    assert deploy.check_export(critic, V) < 1e-12
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    hessian = ca.Function("h", [x, g], [ca.hessian(V(x, g), x)[0]])
    rng = np.random.default_rng(1)
    for point in envs.sample_states(cstr, rng, 5):
        expected = torch.autograd.functional.hessian(
            lambda v: critic.value(v[None], torch.tensor([[0.65]], dtype=torch.float64))[0], torch.tensor(point)
        ).numpy()
        np.testing.assert_allclose(np.array(hessian(point, 0.65)), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_a_wrong_export_stops_the_program(checkpoint):
    critic = deploy.load_critic(checkpoint, "cstr", "min")
    _, _, V = deploy.export(critic)
    with torch.no_grad():
        critic.critic.bias[0] += 1e-3
    with pytest.raises(RuntimeError, match="differs from torch"):
        deploy.check_export(critic, V)


def test_both_scripts_read_a_checkpoint_alike(checkpoint):
    policy = training.load_policy(checkpoint)
    mu, _, V = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    x = envs.sample_states(cstr, np.random.default_rng(2), 20)
    actions = np.array([np.array(mu(s, 0.7)).ravel() for s in x])
    np.testing.assert_allclose(actions, policy.act(x, [0.7]), rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose([float(V(s, 0.7)) for s in x], policy.value(x, [0.7]), rtol=1e-4, atol=1e-4)


# The optimal control problem


def test_identical_scenarios_give_the_nominal_controller():
    nominal = first_solve(mpc(robust_horizon=0))
    same = first_solve(mpc(scenarios=np.tile(cstr.PSI_NOMINAL, (3, 1))))
    one = first_solve(mpc(scenarios=cstr.PSI_NOMINAL[None]))
    for objective, u in (same, one):
        assert objective == pytest.approx(nominal[0], rel=1e-5)
        assert close(u, nominal[1], 1e-3)


@pytest.mark.parametrize("robust_horizon", [1, 2])
def test_every_leaf_counts(robust_horizon, checkpoint):
    """The optimum changes when the scenario of any one leaf changes, through the terminal cost alone."""
    _, _, V = deploy.export(deploy.load_critic(checkpoint, "cstr", "first"))
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    nothing, terminal = ca.Function("n", [x, g], [0 * x[0]]), ca.Function("t", [x, g], [-V(x, g)])
    scenarios = cstr.SCENARIOS["mpc"][[0, 4]]
    controller = mpc(2, scenarios, nothing, terminal, robust_horizon=robust_horizon, slack_price=0.0)
    assert controller.nodes == [1, 2, 2] if robust_horizon == 1 else [1, 2, 4]
    w = controller._rollout(X0, lambda t, x: np.tile([[20.0], [-1000.0]], x.shape[1]))
    p = controller._parameters(X0, controller.slack_price)
    reference = float(controller.objective(w, p))
    for leaf in range(controller.nodes[-1]):
        moved = w.copy()
        controller.block(moved, "x", 2)[3, leaf] += 0.1
        gradient = ca.Function("d", [controller.nlp["x"], controller.nlp["p"]], [ca.gradient(controller.nlp["f"], controller.nlp["x"])])
        assert abs(float(controller.objective(moved, p)) - reference) > 1e-6
        assert np.abs(controller.block(np.array(gradient(w, p)).ravel(), "x", 2)[:, leaf]).max() > 1e-6
    parents = [X0]
    for t in (1, 2):  # the state of each node is the plant's step under the scenario on its branch
        states = controller.block(w, "x", t) * controller.x_scale[:, None] + controller.x_center[:, None]
        for j in range(states.shape[1]):
            parent = parents[j // 2] if t <= robust_horizon else parents[j]
            expected = cstr.step(parent, [20.0, -1000.0], scenarios[j % 2], substeps=4)
            np.testing.assert_allclose(states[:, j], expected, rtol=1e-9)
        parents = list(states.T)


def test_constraints_hold_at_every_predicted_state_the_last_included():
    """Without a reward, only the slack price of the last state can stop a controller that is paid to heat the reactor."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    heat = ca.Function("heat", [x, g], [-x[2] / 10])
    hot = np.array([1.2, 0.6, 137.0, 137.0])
    free = mpc(3, stage=heat, slack_price=0.0)
    first_solve(free, hot)
    assert max(states[2].max() for states in free.prediction()["x"]) > 145
    for options in (dict(slack_price=10.0), dict(slack_price=np.inf)):
        controller = mpc(3, stage=heat, **options)
        first_solve(controller, hot)
        for states in controller.prediction()["x"]:
            assert states[2].max() < 140 + 1e-3 and states[3].max() < 140 + 1e-3


def test_soft_equals_hard_where_hard_is_feasible():
    objective_soft, u_soft = first_solve(mpc(slack_price=10.0))
    objective_hard, u_hard = first_solve(mpc(slack_price=np.inf))
    assert objective_soft == pytest.approx(objective_hard, rel=1e-4)
    assert close(u_soft, u_hard, 0.01)


def test_slack_is_priced_per_physical_unit():
    """From 20 degC above the bound, one step: the cost of the slack is the price times the mean violation over the scenarios."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    nothing = ca.Function("nothing", [x, g], [0 * x[0]])
    controller = mpc(1, stage=nothing, slack_price=3.0)
    objective, _ = first_solve(controller, np.array([0.8, 0.6, 160.0, 155.0]))
    states = controller.prediction()["x"][0]
    violation = np.maximum(states - cstr.X_HIGH[:, None], 0) + np.maximum(cstr.X_LOW[:, None] - states, 0)
    assert objective == pytest.approx(3 * violation.sum(0).mean(), rel=1e-3) and violation.sum() > 10


def test_the_first_action_is_shared_and_later_ones_are_not():
    controller = mpc(3)
    first_solve(controller)
    u = controller.prediction()["u"]
    assert [a.shape for a in u] == [(2, 1), (2, 9), (2, 9)]
    assert np.ptp(u[1], axis=1).max() > 0


@pytest.mark.skipif(not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="no C compiler")
def test_compiled_equals_interpreted(monkeypatch, tmp_path, checkpoint):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _, _, V = deploy.export(deploy.load_critic(checkpoint, "cstr", "first"))
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    terminal = ca.Function("terminal", [x, g], [-V(x, g)])
    compiled = deploy.ScenarioMPC(cstr, 2, cstr.SCENARIOS["mpc"], gaussian(), terminal, goal=GOAL)
    assert compiled.compiled and len(list((tmp_path / "rlmpc").iterdir())) == 1
    a, b = first_solve(compiled), first_solve(mpc(2, terminal=terminal))
    assert a[0] == pytest.approx(b[0], rel=1e-8)
    np.testing.assert_allclose(a[1], b[1], rtol=1e-5, atol=1e-3)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert not deploy.ScenarioMPC(cstr, 2, cstr.SCENARIOS["mpc"], gaussian(), goal=GOAL).compiled


def test_loops_of_the_generated_code_are_reordered(checkpoint, tmp_path, monkeypatch):
    """The text that `vectorised` looks for is in this CasADi's code, and nothing else of it changes."""
    monkeypatch.chdir(tmp_path)
    _, _, V = deploy.export(deploy.load_critic(checkpoint, "cstr", "first"))
    V.generate("V.c")
    before = Path("V.c").read_text()
    after = compiled.vectorised(before)
    changed = [(a.split(), b.split()) for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    assert len(changed) == 4 and changed[2][0] == changed[3][1] and changed[3][0] == changed[2][1]  # two lines change places
    assert all(b.count("restrict") > 0 and [word for word in b if word != "restrict"] == a for a, b in changed[:2])
    assert compiled.vectorised("int nothing;") == "int nothing;"


def test_shifting_moves_time_and_not_channels():
    controller = mpc(4, cstr.SCENARIOS["mpc"][:2])
    w, g = np.zeros(controller.nlp["x"].numel()), np.zeros(controller.nlp["g"].numel())
    for vector, shift, names in ((w, controller.shift_w, ("u", "x", "below", "above")), (g, controller.shift_g, ("dynamics", "box"))):
        layout = {key: block for key, block in controller.layout.items() if key[0] in names}
        for (name, t), (_, rows, nodes) in layout.items():
            controller.block(vector, name, t)[:] = 1000 * t + 10 * np.arange(rows)[:, None] + np.arange(nodes)
        shifted = vector[shift]
        for (name, t), (_, rows, nodes) in layout.items():
            later = t + 1 if (name, t + 1) in layout else t
            expected = 1000 * later + 10 * np.arange(rows)[:, None] + np.arange(nodes)
            np.testing.assert_array_equal(controller.block(shifted, name, t), expected)


# Failures


@pytest.mark.parametrize("state", [[0.8, 0.5, np.nan, 130], [0.8, 0.5, 134], [[0.8, 0.5, 134, 130]], [0.8, np.inf, 134, 130]])
@pytest.mark.parametrize("kind", ["mpc", "actor", "greedy"])
def test_a_state_that_is_none_is_refused(state, kind, checkpoint):
    mu, Q, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    make = {"mpc": lambda: mpc(1), "actor": lambda: deploy.ActorController(cstr, mu, GOAL),
            "greedy": lambda: deploy.GreedyController(cstr, mu, Q, GOAL)}  # fmt: skip
    with pytest.raises(ValueError, match="state"):
        make[kind]().make_step(state)


def test_failure_ladder(checkpoint):
    """Each rung in turn, by solves that fail on command; a failed iterate is neither applied nor a later start."""
    mu, _, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    controller = mpc(3, cstr.SCENARIOS["mpc"][:2], actor=mu)
    solve, outcomes, calls = controller._solve, [], []

    def scripted(which, x0, price, guess, *multipliers):
        calls.append(guess)
        return solve(which, x0, price, guess, *multipliers) if outcomes.pop(0) else None

    controller._solve = scripted

    def step(x0, *given):
        outcomes[:] = given
        u = controller.make_step(x0)
        assert not outcomes  # as many solves as expected
        assert ((cstr.U_LOW <= u) & (u <= cstr.U_HIGH)).all()
        return u, controller.stats["rung"], controller.stats["success"]

    u, rung, success = step(X0, False, False)  # nothing planned yet: the actor
    assert (rung, success) == ("actor", False)
    np.testing.assert_allclose(u, np.array(mu(X0, GOAL)).ravel())
    u, rung, success = step(X0, False, True)
    assert (rung, success) == ("retry", False)
    assert not np.array_equal(calls[-1], calls[-2])  # the retry starts elsewhere
    assert step(X0, True)[1:] == ("solved", True)
    planned = controller.prediction()["u"]
    for t in (1, 2):  # the rest of that plan, under the first scenario
        u, rung, success = step(X0, False, False)
        assert (rung, success) == ("plan", False)
        np.testing.assert_allclose(u, planned[t][:, 0], rtol=1e-9, atol=1e-9)
    u, rung, success = step(X0, False, False)  # the plan is used up
    assert (rung, success) == ("actor", False)
    np.testing.assert_allclose(u, np.array(mu(X0, GOAL)).ravel())
    assert step(X0, True)[1:] == ("solved", True)  # and it recovers


def test_every_status_is_read(checkpoint):
    """A solver stopped after two iterations is a failure, whatever it returned."""
    controller = mpc(3, cstr.SCENARIOS["mpc"][:2])
    problem, options = controller.nlp, {"ipopt": {"print_level": 0, "sb": "yes", "max_iter": 2}, "print_time": False}
    controller.solvers = {name: ca.nlpsol(name, "ipopt", problem, options) for name in ("cold", "warm")}
    u = controller.make_step(X0)
    assert controller.stats["status"] == "Maximum_Iterations_Exceeded" and not controller.stats["success"]
    with pytest.raises(ValueError, match="no prediction"):
        controller.prediction()
    assert controller.stats["rung"] == "hold" and ((cstr.U_LOW <= u) & (u <= cstr.U_HIGH)).all()


def test_infeasible_benchmark_is_solved_with_relaxed_bounds_and_counted():
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    stage = ca.Function("stage", [x, g], [(x[1] - g) ** 2])
    controller = mpc(5, stage=stage, robust_horizon=0, slack_price=np.inf, relaxed_price=1e3)
    x = np.array([2.5, 0.3, 55.0, 55.0])
    controller.make_step(x)  # above the bound of c_A, which F >= 5 1/h only raises while it is cold
    assert controller.stats["rung"] == "retry" and not controller.stats["success"]


def test_relaxed_bounds_first_finds_what_hard_bounds_first_finds():
    """Two controllers in closed loop from an infeasible start; one forgets at every step that the last one was infeasible."""
    x, g = ca.MX.sym("x", 4), ca.MX.sym("g", 1)
    stage = ca.Function("stage", [x, g], [(x[1] - g) ** 2])
    first, second = (mpc(5, stage=stage, robust_horizon=0, slack_price=np.inf, relaxed_price=1e3) for _ in range(2))
    state, feasible, saved = np.array([2.6, 0.8, 105.0, 105.0]), [], 0
    for _ in range(12):
        second.infeasible = False
        u, expected = first.make_step(state), second.make_step(state)
        assert first.stats["success"] == second.stats["success"] and first.stats["rung"] == second.stats["rung"]
        assert close(u, expected, 1e-3)
        feasible.append(first.stats["success"])
        saved += second.stats["iterations"] - first.stats["iterations"]
        state = cstr.step(state, u, cstr.PSI_NOMINAL)
    assert feasible[1] is False and feasible[-1] is True  # both kinds of step were met
    assert saved > 0


# Closed loop


def test_metrics_are_those_of_a_naive_loop(checkpoint):
    mu, _, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    x0, psi = (a[0] for a in deploy.draws(cstr, 1, seed=0))
    x, u, row = deploy.run_episode(deploy.ActorController(cstr, mu, GOAL), cstr, x0, psi, GOAL, steps=30)
    near = outside = 0.0
    for t in range(30):
        np.testing.assert_allclose(x[t + 1], cstr.step(x[t], u[t], psi))
        near += np.exp(-((0.65 - x[t + 1][1]) ** 2) / 0.02)
        outside += np.exp(-sum(max(v - h, low - v, 0) ** 2 for v, low, h in zip(x[t + 1], cstr.X_LOW, cstr.X_HIGH)) / 0.02) - 1
    assert row["time_near_goal"] == pytest.approx(near) and row["time_outside_constraints"] == pytest.approx(outside)
    assert row["ape_tail"] == pytest.approx(np.mean(100 * np.abs(x[-25:, 1] - 0.65) / 0.65))


def test_draws_are_paired_and_do_not_depend_on_their_number():
    few, many = deploy.draws(cstr, 3, seed=1), deploy.draws(cstr, 10, seed=1)
    np.testing.assert_array_equal(few[0], many[0][:3])
    np.testing.assert_array_equal(few[1], many[1][:3])
    assert (few[0] != deploy.draws(cstr, 3, seed=2)[0]).all()


@pytest.mark.parametrize("name, options", [("actor", {}), ("rl_mpc", dict(horizon=0)), ("rl_mpc", dict(horizon=2)), ("nominal_mpc", {}),
                                           ("rl_mpc", dict(horizon=1, value="taylor")),
                                           ("rl_mpc", dict(horizon=1, value="taylor-local"))])  # fmt: skip
def test_a_new_goal_gives_what_a_new_controller_gives(name, options, checkpoint):
    both = [deploy.build_controller(name, deploy.Args(critic=checkpoint, compile=False, goal=goal, **options)) for goal in ((0.5,), (0.8,))]
    both[0].make_step(X0)
    before = both[0].make_step(X0)
    both[0].set_goal((0.8,))
    both[0].reset()
    np.testing.assert_allclose(both[0].make_step(X0), both[1].make_step(X0), rtol=1e-6)
    assert name == "nominal_mpc" or np.abs(before - both[1].make_step(X0)).max() > 1e-3
    for wrong in ((0.5, 0.5), (np.nan,)):
        with pytest.raises(ValueError, match="goal"):
            both[0].set_goal(wrong)


def test_a_network_that_overflows_holds_the_last_action():
    x, goal = ca.MX.sym("x", 4), ca.MX.sym("goal", 1)
    actor = deploy.ActorController(cstr, ca.Function("mu", [x, goal], [ca.vertcat(20.0, -2000.0) * ca.sqrt(1e3 - x[0])]), GOAL)
    first = actor.make_step(X0)
    np.testing.assert_array_equal(actor.make_step([1e6, 0.5, 134.0, 130.0]), first)
    assert actor.stats["rung"] == "hold" and not actor.stats["success"]
    actor.make_step(X0)
    assert actor.stats["rung"] == "solved"


def test_horizon_zero_maximises_the_critic(checkpoint):
    mu, Q, _ = deploy.export(deploy.load_critic(checkpoint, "cstr", "min"))
    controller = deploy.GreedyController(cstr, mu, Q, GOAL)
    rng = np.random.default_rng(0)
    for x0 in envs.sample_states(cstr, rng, 3):
        best = float(Q(x0, controller.make_step(x0), GOAL))
        others = rng.uniform(cstr.U_LOW, cstr.U_HIGH, size=(500, 2))
        assert best >= max(float(Q(x0, u, GOAL)) for u in others) - 1e-6
        assert best >= float(Q(x0, mu(x0, GOAL), GOAL)) - 1e-9


COLUMNS = ("env controller horizon critic goal episode seed psi arguments time_near_goal time_outside_constraints ape_tail solve_ms_median "
           "solve_ms_p95 solver_failures retries fallback_plan fallback_actor").split()  # fmt: skip


def test_command_line_end_to_end_and_any_number_of_jobs(checkpoint, tmp_path):
    tables = []
    for jobs in (1, 2):
        out = run_script("--critic", checkpoint, "--episodes", 3, "--steps", 3, "--horizon", 1, "--no-compile", "--jobs", jobs,
                         "--controllers", "actor", "nominal_mpc", "rl_mpc", "--out", tmp_path / str(jobs))  # fmt: skip
        assert out.returncode == 0, out.stderr
        assert "RL+MPC, N = 1" in out.stdout and "nominal MPC, N = 20" in out.stdout
        assert {p.name for p in (tmp_path / str(jobs)).iterdir()} == {"results.csv", "trajectories.npz", "episode.png"}
        rows = list(csv.DictReader(open(tmp_path / str(jobs) / "results.csv")))
        assert list(rows[0]) == COLUMNS and len(rows) == 9
        assert len(json.loads(rows[0]["psi"])) == 2 and json.loads(rows[0]["arguments"]) == {"steps": 3}
        assert all(np.isfinite(float(row[column])) for row in rows for column in COLUMNS[9:])
        tables.append([{k: v for k, v in row.items() if not k.startswith("solve_ms")} for row in rows])
    assert tables[0] == tables[1]
    trajectories = np.load(tmp_path / "1" / "trajectories.npz")
    assert trajectories["rl_mpc_x"].shape == (3, 4, 4) and trajectories["rl_mpc_u"].shape == (3, 3, 2)


def test_horizon_zero_and_hard_constraints_from_the_command_line(checkpoint, tmp_path):
    for extra in (["--horizon", 0], ["--horizon", 2, "--constraints", "hard", "--robust-horizon", 0, "--no-compile"]):
        out = run_script(
            "--critic", checkpoint, "--episodes", 1, "--steps", 2, "--jobs", 1, "--controllers", "rl_mpc", *extra, "--out", tmp_path
        )
        assert out.returncode == 0, out.stderr
        (row,) = csv.DictReader(open(tmp_path / "results.csv"))
        assert row["horizon"] == str(extra[1])


def test_the_slack_weight_follows_the_critic(checkpoint, tmp_path):
    """1, as in the paper, with a critic that is blind to constraints, 2 with one that is not; what the command line says goes first."""
    data = torch.load(checkpoint, weights_only=True)
    torch.save(data | {"args": data["args"] | {"constraint_weight": 3.0}}, tmp_path / "aware.pt")
    for path, given, wanted in ((checkpoint, None, 1.0), (tmp_path / "aware.pt", None, 2.0), (tmp_path / "aware.pt", 5.0, 5.0)):
        controller = deploy.build_controller("rl_mpc", deploy.Args(critic=path, horizon=1, slack_weight=given, compile=False))
        assert (controller.slack_price == wanted).all()
    assert deploy.critic_path(deploy.Args()).name == "cstr_constrained.pt"
    assert deploy.critic_path(deploy.Args(env="linear")).name == "linear_robust.pt"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--env", "reactor"], ["--env", "reactor", "cstr"]),
        (["--horizon", "-1"], ["--horizon", "-1", "[0, "]),
        (["--episodes", "0"], ["--episodes", "0", "[1, "]),
        (["--steps", "-5"], ["--steps", "-5"]),
        (["--goal", "3"], ["--goal", "3", "[0.1] to [2.]"]),
        (["--goal", "nan"], ["--goal", "nan"]),
        (["--critic", "no/such.pt"], ["--critic", "no/such.pt", "does not exist"]),
        (["--critic", "LICENSE"], ["--critic", "LICENSE", "not a checkpoint"]),
        (["--out", "LICENSE/folder"], ["--out", "cannot write"]),
        (["--controllers", "pid"], ["controllers", "pid", "rl_mpc"]),
        (["--slack-weight", "inf"], ["--slack-weight", "inf"]),
        (["--sigma", "0"], ["--sigma", "0.0"]),
        (["--combine", "max"], ["combine", "min"]),
        (["--value", "linear"], ["value", "taylor"]),
        (["--robust-horizon", "5"], ["--robust-horizon", "5", "leaves"]),
        (["--horizon", "0", "--slack-weight", "3"], ["--slack-weight", "3", "no effect", "--horizon 0"]),
        (["--horizon", "0", "--combine", "mean"], ["--combine", "mean", "no effect"]),
    ],
)
def test_bad_arguments_get_one_sentence_and_exit_code_2(arguments, words, checkpoint):
    critic = [] if "--critic" in arguments else ["--critic", checkpoint]
    out = run_script(*critic, *arguments)
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr


def test_foreign_and_damaged_checkpoints_are_refused(checkpoint, tmp_path):
    def refused(words, data=None, path=tmp_path / "bad.pt"):
        if data is not None:
            torch.save(data, path)
        with pytest.raises(ValueError, match=words):
            deploy.load_critic(path, "cstr")

    data = torch.load(checkpoint, weights_only=True)
    refused("is not a checkpoint.pt", {"weights": torch.zeros(3)})
    refused("trained on 'pendulum'", data | {"env": "pendulum"})
    refused("is not a checkpoint.pt", data | {"network": data["network"] | {"hidden": [32, 32]}})
    refused("not finite", data | {"actor": data["actor"] | {"head.bias": torch.full((4,), torch.nan)}})
    refused("is not a checkpoint.pt", path=tmp_path)
    (tmp_path / "cut.pt").write_bytes(checkpoint.read_bytes()[:5000])
    refused("is not a checkpoint.pt", path=tmp_path / "cut.pt")

    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "pwned"), "w"))

    refused("is not a checkpoint.pt", {"x": Evil()})
    assert not (tmp_path / "pwned").exists()


def test_help_documents_every_argument():
    from dataclasses import fields

    out = run_script("--help")
    assert out.returncode == 0
    assert all("--" + field.name.replace("_", "-") in out.stdout for field in fields(deploy.Args))
