"""What scripts ask of a plant: goals that it can hold, scales, draws, rewards and the paper's measures, and checks of states and goals."""

import numpy as np

from envs.plant import grid


def reachable_goals(plant, actions=1600, steps=2000):
    """Lowest and highest goal that every scenario of the set "mpc" holds at steady state within the constraints, (1,) each.

    To be written down as GOAL_REACHABLE of a plant with one goal, no angle, that comes to rest by itself: about so many constant actions, a
    grid or random ones, are held from START until nothing moves, or for so many steps: a slow plant may need more. Raises ValueError for
    another plant, or where nothing is held.
    """
    if len(plant.GOAL_INDEX) != 1 or plant.GOAL_INDEX[0] in plant.ANGLES:
        raise ValueError("reachable_goals needs a plant with one goal, which is no angle")
    n_u = len(plant.U_LOW)
    u = grid(*np.linspace(plant.U_LOW, plant.U_HIGH, round(actions ** (1 / n_u))).T) if n_u <= 3 else None
    u = np.random.default_rng(0).uniform(plant.U_LOW, plant.U_HIGH, size=(actions, n_u)) if u is None else u
    ends = []
    for psi in plant.SCENARIOS["mpc"]:
        x, psi = np.tile(np.asarray(plant.START, dtype=float), (len(u), 1)), np.tile(psi, (len(u), 1))
        for _ in range(steps):
            x, before = plant.step(x, u, psi), x
            rests = (np.abs(x - before) < 1e-6 * half_width(plant)).all(axis=1)
            if rests.all():
                break
        goals = x[rests & ((plant.X_LOW <= x) & (x <= plant.X_HIGH)).all(axis=1), plant.GOAL_INDEX[0]]
        ends.append((goals.min(initial=np.inf), goals.max(initial=-np.inf)))
    low, high = np.max(ends, axis=0)[:1], np.min(ends, axis=0)[1:]
    if not low <= high:
        raise ValueError(f"no goal of {plant.ENV_ID} is held by every scenario")
    return low, high


# Measures


def half_width(plant):
    """Half the width of the box of initial states, (n_x,), by which states are scaled; 1 where it has none."""
    half = (np.asarray(plant.INIT_HIGH) - plant.INIT_LOW) / 2
    return np.where(half > 0, half, 1.0)


def state_range(plant):
    """Width of the constraint box, (n_x,), of which sensor noise is a share; where it is infinite that of the box of initial states."""
    width = np.asarray(plant.X_HIGH) - plant.X_LOW
    return np.where(np.isfinite(width), width, 2 * half_width(plant))


def sample_states(plant, rng, n):
    """Initial states uniform in their box, (n, n_x)."""
    if hasattr(plant, "sample_states"):
        return plant.sample_states(rng, n)
    return rng.uniform(plant.INIT_LOW, plant.INIT_HIGH, size=(n, len(plant.INIT_LOW)))


def scenario_set(plant, name):
    """Parameters (S, n_psi) of the plant's scenario set, the nominal ones first, whether the set has them or not.

    Raises ValueError for a set that the plant does not have.
    """
    if name not in plant.SCENARIOS:
        raise ValueError(
            f"--scenarios {name} is not a scenario set of {plant.ENV_ID}; choose one of {', '.join(plant.SCENARIOS)}"
        )
    scenarios = np.asarray(plant.SCENARIOS[name])
    return np.concatenate([plant.PSI_NOMINAL[None], scenarios[(scenarios != plant.PSI_NOMINAL).any(axis=1)]])


def goal_reward(plant, achieved, goal, smooth=True, sigma2=None, tolerance=None, xp=np):
    """Reward of reaching `achieved` under `goal`, both (..., n_goal): Gaussian (eq:goalreward), or 0/1 (eq:sparsereward)."""
    n = (len(plant.GOAL_INDEX),)
    if np.shape(achieved)[-1:] != n or np.shape(goal)[-1:] != n:
        shapes = f"{tuple(np.shape(achieved))} and {tuple(np.shape(goal))}"
        raise ValueError(
            f"achieved and desired goal have shapes {shapes}; {plant.ENV_ID} has {n[0]} per goal"
        )
    error = plant.goal_error(achieved, goal, xp)
    if smooth:
        return xp.exp(-(error**2).sum(-1) / (2 * (plant.REWARD_SIGMA2 if sigma2 is None else sigma2)))
    return 1.0 * (abs(error) <= (plant.REWARD_TOLERANCE if tolerance is None else tolerance)).all(-1)


def time_near_goal(plant, achieved, goal):
    """The paper's measure of a trajectory (..., T, n_goal): sum over T of exp(-|error|^2 / (2 METRIC_SIGMA2)), (...)."""
    return goal_reward(plant, achieved, np.asarray(goal), sigma2=plant.METRIC_SIGMA2).sum(-1)


def outside_constraints(plant, x, xp=np):
    """The paper's measure of constraint violation, exp(-|x - clip(x)|^2 / (2 METRIC_SIGMA2)) - 1, x (..., n_x) -> (...): 0 inside."""
    low, high = (xp.asarray(bound, dtype=x.dtype, device=x.device) for bound in (plant.X_LOW, plant.X_HIGH))
    return xp.exp(-((x - xp.clip(x, low, high)) ** 2).sum(-1) / (2 * plant.METRIC_SIGMA2)) - 1


def can_hold(plant, goals):
    """Whether every scenario can hold each goal at steady state, (..., n_goal) -> (...)."""
    if hasattr(plant, "held_action"):
        action = np.apply_along_axis(plant.held_action, -1, np.asarray(goals))
        return ((plant.U_LOW <= action) & (action <= plant.U_HIGH)).all(-1)
    low, high = plant.GOAL_REACHABLE
    return ((low <= goals) & (goals <= high)).all(-1)


# Checks


def checked_state(plant, x0):
    """The measured state as a new float array (n_x,). Raises ValueError if it has another shape or an entry that is not finite."""
    x0 = np.array(x0, dtype=float)
    if x0.shape != plant.X_LOW.shape:
        raise ValueError(
            f"state has shape {x0.shape}; {plant.ENV_ID} needs {plant.X_LOW.shape}: {', '.join(plant.STATE_NAMES)}"
        )
    if not np.isfinite(x0).all():
        raise ValueError(f"state is {np.array2string(x0, threshold=8)}; every entry must be finite")
    return x0


def checked_goal(plant, goal, horizon=None):
    """The goal as a new float array: (n_goal,) from that many numbers, or from one if there is one; with a horizon also (n_goal, horizon).

    Raises ValueError for another shape, or an entry outside the plant's range or not finite.
    """
    n, goal = len(plant.GOAL_INDEX), np.array(goal, dtype=float)
    goal = goal.reshape(1) if goal.ndim == 0 and n == 1 else goal
    low, high = plant.GOAL_LOW, plant.GOAL_HIGH
    texts = [np.array2string(v.ravel(), threshold=4, edgeitems=1) for v in (goal, low, high)]
    shown, low_shown, high_shown = texts
    if goal.shape not in ((n,), (n, horizon)):
        stages = f", or {n} for each of {horizon} stages" if horizon else ""
        raise ValueError(f"goal is {shown}; {plant.ENV_ID} needs {n} number(s){stages}")
    if not ((low <= goal.T) & (goal.T <= high)).all():  # nor is nan
        raise ValueError(f"goal is {shown}; {plant.ENV_ID} takes {low_shown} to {high_shown}")
    return goal
