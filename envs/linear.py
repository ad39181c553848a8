"""Random linear systems x' = A x + u, the paper's Example 2 (its sections app:lqr and app:LQ-GC): `--env linear --dim N --system SEED`.

Unlike the other modules, this one is a family of plants: `make(dim, system)` returns one of them, an object with the names that a plant
module has. There is nothing uncertain about it: psi has no entries.
"""

from functools import cache

import numpy as np

from envs.control.linear_systems import discounted_lqr, random_matrix

STEPS = 50
STATE_BOUND = 1.5  # soft, of every state; initial states lie in [-1, 1]


class Linear:
    """The plant with matrix A (n, n), B = I, and the names of a plant module (see envs/__init__.py)."""

    ENV_ID, EPISODE_STEPS, DT, TIME_UNIT = "RLMPC/Linear-v0", STEPS, 1.0, "steps"
    ANGLES, PSI_NAMES, PSI_NOMINAL, MODEL_SUBSTEPS = [], (), np.zeros(0), 1
    SCENARIOS = {name: np.zeros((1, 0)) for name in ("nominal", "mpc", "robust")}
    EVAL_PSI = np.zeros((1, 0))
    REWARD_SIGMA2 = 0.25  # squared norm of the state
    REWARD_TOLERANCE = 0.1  # half-width of the 0/1 reward in every state
    MPC_SIGMA2 = 0.5  # exp(-l) of eq:jensen
    METRIC_SIGMA2 = 0.01  # of time near goal and time outside constraints
    # what sac_her_branching.py trains with: over 90,000 parameters per network at n = 32
    TRAINING = dict(hidden=(256, 256), total_timesteps=500_000, num_envs=64, gamma=0.9)
    TRAINING |= dict(learning_starts=10_000, steps_per_update=16, alpha_init=0.005)

    def __init__(self, a, transform=None):
        n = len(a)
        one = np.ones(n)
        self.A, self.B = np.array(a, dtype=float), np.eye(n)
        self.transform = np.eye(n) if transform is None else np.array(transform, dtype=float)
        self.STATE_NAMES, self.STATE_UNITS = tuple(f"x_{i + 1}" for i in range(n)), ("-",) * n
        self.ACTION_NAMES, self.ACTION_UNITS = tuple(f"u_{i + 1}" for i in range(n)), ("-",) * n
        self.X_LOW, self.X_HIGH = -STATE_BOUND * one, STATE_BOUND * one
        self.INIT_LOW, self.INIT_HIGH = self.U_LOW, self.U_HIGH = -one, one
        self.START, self.START_NOISE = 0 * one, one
        powers, free, forced = np.eye(n), [], np.zeros(n)
        for _ in range(STEPS + 1):  # |A^t x_0| + sum_k |A^k u|
            free.append(np.abs(powers).sum(axis=1) + forced)
            forced, powers = forced + np.abs(powers).sum(axis=1), self.A @ powers
        self.OBS_HIGH = 1.01 * np.max(free, axis=0)
        self.OBS_LOW = -self.OBS_HIGH
        self.BENCHMARK = {"horizon": 10, "slack_price": np.ones((2, n)), "change_weight": np.zeros(n)}
        self.GOAL_INDEX, self.EVAL_GOAL = list(range(n)), np.zeros(n)
        # each uniform in a box whose half-width is uniform in [0, 1]. The origin alone would be a goal that the
        # critic recognises and, since it is missed at first, learns to be worth nothing
        rng = np.random.default_rng(0)
        self.TRAIN_GOALS = rng.uniform(0, 1, size=(1000, 1)) * rng.uniform(-1, 1, size=(1000, n))
        self.GOAL_LOW, self.GOAL_HIGH = -one, one
        held = 1 / np.abs(np.eye(n) - a).sum(axis=1)  # a goal is held by u = (I - A) g
        # a cube within the goals that envs.can_hold tells exactly
        self.GOAL_REACHABLE = -held.min() * one, held.min() * one
        self.ERROR_SCALE = one
        self.solved = {}  # discount: P and K

    def next_state(self, x, u, psi=None, xp=np):
        """A x + B u, components along the first axis: x (n, ...), u (n, ...); xp is numpy, torch or casadi."""
        a = xp.as_tensor(self.A, dtype=x.dtype, device=x.device) if hasattr(xp, "as_tensor") else self.A
        return a @ x + u

    def step(self, x, u, psi=None, substeps=1):
        """State one sampling time later. Batched over the leading axes: x (..., n), u (..., n) -> (..., n)."""
        return np.asarray(x, dtype=np.float64) @ self.A.T + np.asarray(u, dtype=np.float64)

    def lqr(self, gamma=1.0):
        """P and K, (n, n) each, of the discounted regulator with M = R = I."""
        if gamma not in self.solved:
            self.solved[gamma] = discounted_lqr(
                self.A, self.B, np.eye(len(self.A)), np.eye(len(self.A)), gamma
            )
        return tuple(part.copy() for part in self.solved[gamma])

    def held_action(self, goal):
        """The action that holds a goal, (I - A) g: the linear-quadratic costs count deviations from it."""
        return goal - self.A @ goal

    def lq_cost(self, x, u, goal):
        """Stage cost l = |x - g|^2 + |u - (I - A) g|^2 of eq:nominalMPCobj, CasADi."""
        dx, du = x - goal, u - self.held_action(goal)
        return dx.T @ dx + du.T @ du

    def lq_value(self, x, goal, gamma=1.0):
        """Its value V = (x - g)' P (x - g), CasADi."""
        dx = x - goal
        return dx.T @ self.lqr(gamma)[0] @ dx

    def feedback(self, x, goal, gamma=1.0):
        """The regulator's action without limits, u = -K (x - g) + (I - A) g, numpy or CasADi, (n,) or (n, 1)."""
        return self.held_action(goal) - self.lqr(gamma)[1] @ (x - goal)

    def baseline(self, x, goal):
        """The regulator's action within the limits, for the controllers' first guesses, components along the first axis."""
        return np.clip(self.feedback(x, goal).T, self.U_LOW, self.U_HIGH).T

    def goal_error(self, achieved, goal, xp=np):
        """Elementwise error whose squared norm enters the Gaussian reward."""
        return achieved - goal

    def percentage_error(self, achieved, goal):
        """Root mean square over the states, in percent of the half-width of the initial box, (..., n) -> (...)."""
        return 100 * np.sqrt(np.mean((achieved - goal) ** 2, axis=-1))


@cache
def make(dim=2, system=0):
    """The plant of dimension `dim` whose matrix is drawn from the seed `system`. Raises ValueError for a size that is not one."""
    for name, value, least, most in (("dim", dim, 1, 512), ("system", system, 0, 10**9)):
        if not (isinstance(value, (int, np.integer)) and least <= value <= most):
            raise ValueError(f"--{name} is {value}; it must be a whole number from {least} to {most}")
    return Linear(*random_matrix(dim, np.random.default_rng([dim, system])))
