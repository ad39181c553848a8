"""The quadratic programs of a scenario tree: HPIPM's answers against PIQP's, HiGHS's and qpOASES's, costs against numpy."""

import gc
import os
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rl_mpc_deploy as deploy
from envs import cstr
from envs.control.tree_qp import ConicQP, ScenarioTree, TreeQP, pointer
from envs.script.comparison import draws, run_episode

pytestmark = pytest.mark.skipif(
    not any(map(shutil.which, ("gcc", "clang", "cc"))), reason="HPIPM's solver is compiled"
)
TIGHT = {"piqp": {"eps_abs": 1e-10, "eps_rel": 1e-12}}
TOLERANCE = 1e-6  # of a cost, relative to 1 + |cost|
LOOSE = {
    "violated": 1e-5
}  # bounds that are a hundred out of reach: HPIPM's mode SPEED_ABS does not look at stationarity
UNSOLVED = 4  # of about a hundred
EACH = 14  # random problems per shape and kind

# scenarios, horizon, robust horizon, states, actions, whether changes have a price, share of the bounds that there are
SHAPES = {
    "branching once": (3, 3, 1, 4, 2, False, 1.0),
    "branching once, changes": (3, 3, 1, 4, 2, True, 1.0),
    "branching twice": (2, 3, 2, 3, 2, False, 1.0),
    "branching twice, changes": (2, 3, 2, 3, 1, True, 0.6),
    "nominal, six states": (1, 4, 0, 6, 1, False, 1.0),
    "nominal, changes": (3, 4, 0, 4, 2, True, 1.0),
    "one stage": (4, 1, 1, 4, 2, True, 1.0),
    "some bounds": (3, 2, 1, 4, 2, True, 0.4),
    "no bounds": (3, 2, 1, 4, 2, False, 0.0),
    "no bounds, changes": (2, 2, 2, 3, 1, True, 0.0),
}
KINDS = (
    "plain",
    "flat",
    "singular",
    "indefinite",
    "inactive",
    "violated",
    "crossing",
    "tiny boxes",
    "at a limit",
    "dear",
    "cheap",
)


def random_problem(rng, kind, tree, active, n_x, n_u):
    """What `solve` takes."""
    there = active[:, active.any(axis=0)]
    edges, inner, rows = len(tree.parent) - 1, tree.inner, there.shape[1]
    A, B = rng.normal(size=(edges, n_x, n_x)) / 2, rng.normal(size=(edges, n_u, n_x))
    slope, root = rng.normal(size=(edges, n_x)), rng.normal(size=(edges, n_x, n_x))
    hessian = root @ root.swapaxes(1, 2)
    u_low, u_high = -rng.uniform(size=(inner, n_u)), rng.uniform(size=(inner, n_u))
    x_low = rng.normal(size=(edges, rows)) - 1
    x_high = x_low + rng.exponential(3, size=x_low.shape)
    price = 10 ** rng.uniform(-1, 1.5, size=(edges, 2, rows))
    change, moved = rng.exponential(size=(inner, n_u)), rng.normal(size=(inner, n_u))
    if kind == "flat":
        hessian = 0 * hessian
    elif kind == "singular":
        hessian = root[:, :1].swapaxes(1, 2) @ root[:, :1]
    elif kind == "indefinite":
        hessian = root + root.swapaxes(1, 2)
    elif kind == "inactive":
        x_low, x_high = x_low - 1e3, x_high + 1e3
    elif kind == "violated":  # by every plan
        x_low, x_high = x_low + 1e2, x_high + 1e2
    elif kind == "crossing":  # the present plan violates one of them or both
        x_low, x_high = x_high, x_low
    elif kind == "tiny boxes":
        width = 10 ** rng.uniform(-6, -2)
        u_low, u_high = width * u_low, width * u_high
    elif kind == "at a limit":
        at_low = rng.uniform(size=u_low.shape) < 0.5
        u_low, u_high = np.where(at_low, 0.0, -2.0), np.where(at_low, 2.0, 0.0)
    elif kind == "dear":
        price = np.full_like(price, 4.5e4)
    elif kind == "cheap":
        price = np.full_like(price, 1e-3)
    x_low, x_high = (
        np.where(there[0], x_low, -1e9),
        np.where(there[1], x_high, 1e9),
    )  # as the controller writes what is not there
    return (
        A,
        B,
        slope,
        hessian,
        u_low,
        u_high,
        x_low,
        x_high,
        price,
        change,
        moved,
        max(price.max(initial=0), 1.0),
    )


def cost_by_numpy(tree, active, problem, du):
    """The problem of tree_qp.c at du, word by word."""
    A, B, slope, hessian, _, _, x_low, x_high, price, change, moved, _ = problem
    n_x, n_u, rows, cost = slope.shape[1], du.shape[1], np.flatnonzero(active.any(axis=0)), 0.0
    A, hessian, B = A.reshape(-1, n_x, n_x), hessian.reshape(-1, n_x, n_x), B.reshape(-1, n_u, n_x)
    for i in range(tree.inner):
        step = du[i] - (du[tree.parent[i]] if i else 0)
        cost += change[i] @ ((moved[i] + step) ** 2 - moved[i] ** 2)
    dx = np.zeros((len(tree.parent), n_x))
    for i in range(1, len(tree.parent)):
        e, before = i - 1, tree.parent[i]
        dx[i] = A[e].T @ dx[before] + B[e].T @ du[before]
        values, vectors = np.linalg.eigh((hessian[e] + hessian[e].T) / 2)
        cost += slope[e] @ dx[i] + np.maximum(values, 0) @ (vectors.T @ dx[i]) ** 2 / 2
        for j, row in enumerate(rows):
            cost += active[0, row] * price[e, 0, j] * max(x_low[e, j] - dx[i, row], 0)
            cost += active[1, row] * price[e, 1, j] * max(dx[i, row] - x_high[e, j], 0)
    return cost


def compared(tree, active, solver, oracles, problems):
    """Of every problem (cost less the best oracle's, error of the cost itself), relative to 1 + |cost|; nan if it is not solved."""
    found = []
    for problem in problems:
        du, cost = solver.solve(*problem)
        if du is None:
            assert np.isnan(cost)
            found.append((np.nan, np.nan))
            continue
        u_low, u_high = problem[4], problem[5]
        assert du.shape == u_low.shape and (u_low <= du).all() and (du <= u_high).all()
        exact, best = cost_by_numpy(tree, active, problem, du), np.inf
        for oracle in oracles:
            other, _ = oracle.solve(*problem)
            if other is not None:
                best = min(best, cost_by_numpy(tree, active, problem, np.clip(other, u_low, u_high)))
        assert np.isfinite(best)
        found.append(((exact - best) / (1 + abs(best)), (cost - exact) / (1 + abs(exact))))
    return np.array(found)


def check(found, unsolved=UNSOLVED, tolerance=TOLERANCE):
    """Costs are what they are said to be, none is above the oracle's, and as few as that are not solved."""
    above, error = found[~np.isnan(found[:, 0])].T
    assert np.isnan(found[:, 0]).sum() <= unsolved
    assert above.max() <= tolerance
    assert np.abs(error).max() <= TOLERANCE


@cache
def shaped(shape):
    """Tree, bounds, the solver, and a function that makes the oracle of a plugin, of a key of SHAPES."""
    scenarios, horizon, robust_horizon, n_x, n_u, changes, share = SHAPES[shape]
    tree = ScenarioTree(scenarios if robust_horizon else 1, horizon, robust_horizon)
    active = np.random.default_rng([len(shape), 7]).uniform(size=(2, n_x)) < share
    sizes = tree, n_x, n_u, active, changes
    oracle = cache(lambda plugin: ConicQP(*sizes, plugin, TIGHT if plugin == "piqp" else None))
    return tree, active, TreeQP(*sizes), oracle


def random_problems(shape, kind, number, seed=0):
    _, _, _, n_x, n_u, changes, _ = SHAPES[shape]
    tree, active, _, _ = shaped(shape)
    rng = np.random.default_rng([seed, list(SHAPES).index(shape), KINDS.index(kind)])
    problems = [random_problem(rng, kind, tree, active, n_x, n_u) for _ in range(number)]
    return [(*p[:9], changes * p[9], *p[10:]) for p in problems]


def measured(shape, kind, number=EACH, plugins=("piqp",), seed=0):
    tree, active, solver, oracle = shaped(shape)
    return compared(
        tree,
        active,
        solver,
        [oracle(plugin) for plugin in plugins],
        random_problems(shape, kind, number, seed),
    )


ONE_SIDED = ("branching twice, changes", "some bounds")
BOTH_SIDED = [shape for shape in SHAPES if shape not in ONE_SIDED]


@pytest.mark.parametrize("shape", SHAPES)
def test_multipliers_are_those_of_another_solver(shape):
    """Of what has one solution, and with one stage the slopes of the cost themselves."""
    tree, _, solver, oracle = shaped(shape)
    for problem in random_problems(shape, "plain", 6):
        solved = [each.solve(*problem)[0] for each in (solver, oracle("piqp"))]
        assert solved[0] == pytest.approx(solved[1], abs=1e-4)
        found = solver.multipliers()
        assert found.shape == (tree.nodes[1], SHAPES[shape][3])
        assert found == pytest.approx(oracle("piqp").multipliers(), abs=2e-3, rel=2e-3)
        again = solver.solve(*problem)[0]  # which the multipliers leave as it is
        assert np.array_equal(solved[0], again)


def test_the_shapes_have_the_bounds_that_they_are_for():
    for shape in SHAPES:
        _, active, _, _ = shaped(shape)
        assert (active[0] != active[1]).any() == (shape in ONE_SIDED)
        assert active.any() == ("no bounds" not in shape)


@pytest.mark.parametrize("kind", KINDS)
def test_random_problems_against_piqp(kind):
    check(
        np.concatenate([measured(shape, kind) for shape in BOTH_SIDED]), tolerance=LOOSE.get(kind, TOLERANCE)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_random_problems_with_one_sided_bounds_against_piqp(kind):
    check(
        np.concatenate([measured(shape, kind) for shape in ONE_SIDED]), tolerance=LOOSE.get(kind, TOLERANCE)
    )


@pytest.mark.parametrize(
    "plugin, shapes", [("highs", BOTH_SIDED), ("qpoases", ["branching once, changes", "one stage"])]
)
def test_random_problems_against_other_solvers(plugin, shapes):
    """Where they find no solution PIQP's stands; what they return may not be lower."""
    found = [measured(shape, kind, 2, (plugin, "piqp"), seed=1) for shape in shapes for kind in KINDS]
    check(np.concatenate(found), tolerance=max(LOOSE.values()))


@cache
def recorded(name, horizon, wanted):
    """Problems of closed loops of the controller `name`, its sizes and its solver."""
    args = deploy.Args(horizon=horizon)
    controller = deploy.build_controller(name, args)
    solver, problems = controller.qp.solve, []

    def solve(*problem):
        problems.append([np.array(value) for value in problem])
        return solver(*problem)

    controller.qp.solve = solve
    steps = 12
    starts, psis = draws(cstr, 200, seed=5)
    for start, psi in zip(starts, psis):
        if len(problems) < wanted:
            run_episode(controller, cstr, start, psi, controller.goal, steps)
    del controller.qp.solve
    active = np.isfinite([cstr.X_LOW, cstr.X_HIGH])
    return problems[:wanted], (controller.tree, 4, 2, active, name == "robust_mpc"), controller.qp


RECORDED = {
    "rl_mpc, N = 1": ("rl_mpc", 1, 300),
    "rl_mpc, N = 5": ("rl_mpc", 5, 300),
    "robust_mpc": ("robust_mpc", 1, 200),
}


def measured_recorded(name, number=None, plugins=("piqp",)):
    problems, sizes, solver = recorded(*RECORDED[name])
    oracles = [ConicQP(*sizes, plugin, TIGHT if plugin == "piqp" else None) for plugin in plugins]
    problems = [
        (*(np.squeeze(p) if p.ndim == 0 else p for p in problem[:-1]), float(problem[-1]))
        for problem in problems
    ]
    return compared(sizes[0], sizes[3], solver, oracles, problems[:number])


@pytest.mark.parametrize("name", RECORDED)
def test_problems_of_closed_loops_against_piqp(name):
    found = measured_recorded(name)
    assert len(found) == RECORDED[name][-1]
    check(found, unsolved=0)


# The positive part


def positive_part(hessian):
    solver = shaped("no bounds")[2]
    h, result = np.ascontiguousarray(hessian, dtype=float), np.full(hessian.shape, np.nan)
    work = np.empty(2 * h.size)
    solver.library.tree_qp_positive_part(len(h), *map(pointer, (h, result, work)))
    return result


def symmetric(rng, n, kind):
    orthogonal, _ = np.linalg.qr(rng.normal(size=(n, n)))
    values = {
        "generic": rng.normal(size=n),
        "degenerate": rng.choice([-2.0, 0.0, 3.0], size=n),
        "positive": rng.exponential(size=n),
        "negative": -rng.exponential(size=n),
        "zero": np.zeros(n),
        "wide": rng.choice([-1, 1], size=n) * 10 ** rng.uniform(-9, 9, size=n),
    }[kind]
    return (orthogonal * values) @ orthogonal.T


@pytest.mark.parametrize("kind", ["generic", "degenerate", "positive", "negative", "zero", "wide"])
def test_the_positive_part_against_numpy(kind):
    rng = np.random.default_rng(1)
    for n in range(1, 33):
        for hessian in (symmetric(rng, n, kind), np.diag(np.diag(symmetric(rng, n, kind)))):
            values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
            expected = (vectors * np.maximum(values, 0)) @ vectors.T
            assert np.abs(positive_part(hessian) - expected).max() <= 1e-12 * max(
                np.abs(values).max(), 1e-300
            )


def test_the_positive_part_is_of_the_symmetric_part():
    rng = np.random.default_rng(2)
    hessian, skew = symmetric(rng, 5, "generic"), rng.normal(size=(5, 5))
    np.testing.assert_allclose(positive_part(hessian + skew - skew.T), positive_part(hessian), atol=1e-13)


# What goes wrong


@pytest.mark.parametrize("place", range(12))
def test_what_is_not_a_number_is_not_solved_and_leaves_nothing_behind(place):
    """place: which argument of `solve` has one not-a-number."""
    tree, active, solver, _ = shaped("branching once, changes")
    (problem,) = random_problems("branching once, changes", "plain", 1)
    expected = solver.solve(*problem)[0].copy()
    broken = [np.array(value, dtype=float) for value in problem]
    broken[place].ravel()[-1] = np.nan
    broken[-1] = float(broken[-1])
    if place == 11:
        broken[-1] = np.nan
    du, cost = solver.solve(*broken)
    assert du is None and np.isnan(cost)
    du, cost = solver.solve(*problem)
    np.testing.assert_array_equal(du, expected)
    assert cost == pytest.approx(cost_by_numpy(tree, active, problem, du), rel=1e-12)


def resident():
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux says how much memory a process has")
def test_dropped_instances_give_their_memory_back():
    tree, active = ScenarioTree(9, 20, 1), np.ones((2, 4), dtype=bool)

    def build(number):
        for _ in range(number):
            TreeQP(tree, 4, 2, active, True)
        gc.collect()

    build(20)
    before = resident()
    build(200)
    assert resident() - before < 3e7  # kept, they would take ten times as much, 1.75 MB each
