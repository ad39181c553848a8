"""experiments/planner_value_iteration.py: what plans teach, what networks make of it, and what the deployed controller does with that."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import envs
import rl_mpc_deploy as rl
import sac_her_branching as sac
from envs.script.comparison import draws, run_episode
from experiments import planner_value_iteration as pvi

SHIPPED = Path(__file__).parent.parent / "experiments/pretrained/double_pendulum_planner.pt"
FEW = dict(
    sweeps=2, states=60, length=10, updates=40, lookahead=6, horizon=4, loops=2, steps=51, hidden=(16, 16)
)


@pytest.fixture(scope="module")
def pendulum():
    return envs.load("double_pendulum")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return pvi.main(pvi.Args(**FEW, out=tmp_path_factory.mktemp("planner")))


def value_by_hand(plant, args, x, goal, u, psi, learned):
    """Discounted reward of actions (T, n_u) and the learned value behind them, from its definition, in numpy."""
    value = 0.0
    for t, action in enumerate(u):
        x = plant.step(x, action, psi, plant.MODEL_SUBSTEPS)
        error = plant.goal_error(x[plant.GOAL_INDEX], goal)
        violation = np.maximum(plant.X_LOW - x, 0) + np.maximum(x - plant.X_HIGH, 0)
        reward = np.exp(-(error**2).sum() / (2 * args.sigma**2)) - args.slack_weight * violation.sum()
        value += args.gamma**t * reward
    return value + args.gamma ** len(u) * float(learned(x, goal)) if learned else value


CASES = [("double_pendulum", 0, 0.5), ("cstr", 1, 0.1)]


def teacher_of(env, robust_horizon, sigma, trained):
    """A teacher, states to plan from, the arguments, and the learned value behind its plans, which the pendulum alone has."""
    plant, rng = envs.load(env), np.random.default_rng(0)
    args = replace(pvi.Args(**FEW), env=env, robust_horizon=robust_horizon, sigma=sigma, states=120)
    learned = torch.load(trained / "checkpoint.pt") if env == "double_pendulum" else None
    teacher = pvi.build_teacher(args, plant, learned)
    return teacher, pvi.sample(args, plant, None, rng)[0], args, learned and rl.export(rl.Critic(learned))[2]


@pytest.mark.parametrize("env, robust_horizon, sigma", CASES)
def test_a_plan_teaches_what_it_is_worth(env, robust_horizon, sigma, trained):
    """By simulation, the mean over scenarios."""
    teacher, states, args, V = teacher_of(env, robust_horizon, sigma, trained)
    plant, psi = teacher.plant, teacher.scenarios
    for x in states[:8]:
        teacher.reset()
        action, u = teacher.make_step(x), teacher.prediction()["u"]
        u = np.stack([np.repeat(stage, len(psi) // stage.shape[1], axis=1) for stage in u])
        by_hand = [
            value_by_hand(plant, args, x, plant.EVAL_GOAL, u[:, :, i], psi[i], V) for i in range(len(psi))
        ]
        assert teacher.value() == pytest.approx(np.mean(by_hand), abs=1e-7)
        assert action == pytest.approx(u[0, :, 0])


@pytest.mark.parametrize("env, robust_horizon, sigma", CASES)
def test_a_plan_teaches_how_its_value_changes_when_it_is_adapted(env, robust_horizon, sigma, trained):
    """By planning anew from states beside it, from the same plan on; where that has converged."""
    teacher, states, *_ = teacher_of(env, robust_horizon, sigma, trained)
    teacher.STATIONARY, teacher.iterations, checked = 1e-12, 100, 0

    def planned_anew(x, plan):
        teacher.problem = teacher.parameters(teacher.estimator.update(x, np.zeros(len(plan[0]))))
        return -teacher.improve(plan, teacher.cost(plan), 0.0)[1]

    for x in states:
        teacher.reset()
        teacher.make_step(x)
        value, slope, plan, found = teacher.value(), teacher.slope(), teacher.plan, []
        if abs(planned_anew(x, plan) - value) > 1e-9:
            continue
        for step in 1e-4 * np.diag(teacher.x_scale):
            sides = [(planned_anew(x + s * step, plan) - value) * s / 1e-4 for s in (1, -1)]
            smooth = abs(np.diff(sides)[0]) < 0.02 * (1 + abs(slope).max())
            found.append(np.mean(sides) if smooth else np.nan)
        if np.isfinite(found).all():
            assert slope == pytest.approx(found, abs=0.02 * (1 + abs(slope).max())), x
            checked += 1
    assert checked >= 4


def test_a_closed_loop_teaches_the_best_of_what_was_promised_and_what_it_got(pendulum, trained):
    """Of every state the best over k of k rewards and what the plan promised then; where plants are drawn the plan alone."""
    teacher, states, args, _ = teacher_of(*CASES[0], trained)
    goal, more = pendulum.EVAL_GOAL, 0
    for x in states:
        rows = pvi.teach(args, teacher, x, goal, np.ones(3))
        plans = pvi.teach(replace(args, robust_horizon=1), teacher, x, goal, np.ones(3))
        promised = [row[2] for row in plans]
        rewards = [pvi.reward(args, pendulum, row[0], goal) for row in rows]
        for t in range(len(rows)):
            best = max(
                sum(args.gamma**i * rewards[t + 1 + i] for i in range(k)) + args.gamma**k * promised[t + k]
                for k in range(len(rows) - t)
            )
            assert rows[t][2] == pytest.approx(best, abs=1e-9)
        assert np.array_equal(rows[-1][0], plans[-1][0]) and np.array_equal(rows[-1][3], plans[-1][3])
        more += sum(row[2] > each + 1e-6 for row, each in zip(rows, promised))
    assert more


def test_two_sweeps_of_short_plans_learn_what_a_long_one_is_worth(tmp_path):
    """The oracle: plans of forty steps, beyond which the discount leaves little. Two states, linear."""
    plant = envs.load("linear")
    args = pvi.Args(
        env="linear", sigma=0.5, gamma=0.9, lookahead=4, horizon=4, sweeps=2, states=2000, updates=600
    )
    args = replace(args, loops=2, steps=51, hidden=(32, 32), out=tmp_path)
    V = rl.export(rl.Critic(torch.load(pvi.main(args) / "checkpoint.pt")))[2]
    none, long = (pvi.build_teacher(replace(args, lookahead=T), plant, None) for T in (4, 40))
    found = []
    for x in pvi.sample(args, plant, None, np.random.default_rng(1))[0]:
        values = [float(V(x, plant.EVAL_GOAL))]
        for teacher in (none, long):
            teacher.reset()
            teacher.make_step(x)
            values.append(teacher.value())
        found.append(values)
    learned, before, wanted = np.transpose(found)
    assert np.abs(learned - wanted).mean() < 0.1 * np.abs(before - wanted).mean()


def test_a_mirrored_plant_teaches_twice(pendulum):
    assert pvi.mirrors(pendulum) and not pvi.mirrors(envs.load("cstr"))
    teacher, rng = pvi.build_teacher(pvi.Args(**FEW), pendulum, None), np.random.default_rng(0)
    u = rng.uniform(-1, 1, (6, 1))
    for x in envs.sample_states(pendulum, rng, 4):
        found = []
        for sign in (1, -1):
            teacher.reset()
            teacher.problem = teacher.parameters(teacher.estimator.update(sign * x, np.zeros(1)))
            found.append(teacher.cost(sign * u))
        assert found[0] == pytest.approx(found[1], rel=1e-12)


def test_states_lie_in_the_box_or_where_the_closed_loops_went(pendulum):
    args = pvi.Args(states=400, length=2)
    x, goal = pvi.sample(args, pendulum, None, np.random.default_rng(0))
    high = np.array([5.5, 1.5 * np.pi, 1.5 * np.pi, 1.5, 7.5, 7.5])  # beyond the track, or half again the box
    assert (np.abs(x) <= high).all() and (np.abs(x).max(axis=0) > 0.95 * high).all()
    assert {tuple(g) for g in goal} == {tuple(g) for g in pendulum.TRAIN_GOALS}
    visited = np.full((3, 6), 0.5), np.tile(pendulum.TRAIN_GOALS[1], (3, 1))
    x, goal = pvi.sample(args, pendulum, visited, np.random.default_rng(0))
    near = (np.abs(x - 0.5) < 0.3 * envs.half_width(pendulum)).all(axis=1)
    assert near.sum() == 50 and (goal[near] == pendulum.TRAIN_GOALS[1]).all()


def test_the_checkpoint_is_one_of_the_deployed_controller_and_of_the_training_script(trained, pendulum):
    path = trained / "checkpoint.pt"
    args = rl.Args(env="double_pendulum", critic=path, horizon=4)
    planner, policy = rl.build_controller("rl_mpc", args), sac.load_policy(path)
    assert planner.discount == 0.97 and planner.tree.nodes[-1] == 1
    assert planner.slack_price[0, 0] == 0.5  # the track's bound is one half-width of the box from zero
    critic = rl.load_critic(path, "double_pendulum")
    mu, Q, V = rl.export(critic)
    x = envs.sample_states(pendulum, np.random.default_rng(0), 5)
    for state, u in zip(x, policy.act(x, pendulum.EVAL_GOAL)):
        assert np.array(mu(state, pendulum.EVAL_GOAL)).ravel() == pytest.approx(u, abs=1e-4)
        values = [float(Q(state, force, pendulum.EVAL_GOAL)) for force in (-5, 5)]
        assert values == pytest.approx([float(V(state, pendulum.EVAL_GOAL))] * 2, abs=1e-12)


def test_the_latest_critic_may_be_one_of_this_script(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    args = rl.Args(env="double_pendulum", critic="latest")
    with pytest.raises(ValueError, match="there is no runs/double_pendulum__"):
        rl.critic_path(args)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / trained.name).symlink_to(trained)
    assert rl.critic_path(args).samefile(trained / "checkpoint.pt")


def test_an_interrupted_run_continues_to_the_same_numbers(trained, tmp_path):
    run = pvi.main(pvi.Args(**FEW | dict(sweeps=1), out=tmp_path))
    data = torch.load(run / "resume.pt")
    torch.save(data | {"args": data["args"] | {"sweeps": 2}}, run / "resume.pt")
    assert pvi.main(pvi.Args(resume=run / "resume.pt")) == run
    ends = [torch.load(folder / "resume.pt")["learner"] for folder in (trained, run)]
    for network in ("actor", "critic"):
        for name, weights in ends[0][network].items():
            assert torch.equal(weights, ends[1][network][name]), name
    assert len((run / "sweeps.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    "wrong, text",
    [
        (dict(sweeps=0), "--sweeps is 0"),
        (dict(env="none"), "none"),
        (dict(gamma=1.0), "--gamma is 1.0"),
        (dict(hidden=()), "--hidden"),
        (dict(steps=50), "--steps is 50"),
        (dict(robust_horizon=4), "robust horizon"),
        (dict(resume=Path("none.pt")), "none.pt does not exist"),
        (dict(resume=SHIPPED), "not a resume.pt"),
        (dict(resume=Path("none.pt"), sweeps=3), "give no others"),
    ],
)
def test_what_cannot_work_is_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        pvi.main(pvi.Args(**wrong))


def test_the_training_script_says_what_to_expect_of_the_pendulum(tmp_path, capsys):
    few = dict(
        total_timesteps=128, learning_starts=64, eval_episodes=2, buffer_size=640, hidden=(8,), out=tmp_path
    )
    sac.main(sac.Args(env="double_pendulum", **few))
    assert "experiments/planner_value_iteration.py learns both" in capsys.readouterr().err


def test_the_shipped_value_swings_up_with_a_short_plan_that_cannot_without_it(pendulum):
    near = {}
    for name in ("rl_mpc", "goal_mpc"):
        planner = rl.build_controller(name, rl.Args(env="double_pendulum", horizon=15))
        x, _ = draws(pendulum, 4, 5, "start")
        loops = [run_episode(planner, pendulum, start, np.ones(3), pendulum.EVAL_GOAL, 100) for start in x]
        near[name] = np.median([row["time_near_goal"] for _, _, row in loops])
    assert near["rl_mpc"] > 28 and near["goal_mpc"] < 5
