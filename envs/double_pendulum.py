"""Double inverted pendulum on a cart, the paper's Example 1: the benchmark of Fiedler et al. (2023), do-mpc's `DIP`.

A horizontal force moves a cart that carries two uniform rods in series. Angles are measured from the upright position,
both against the vertical. The three masses are uncertain. Departures from the benchmark: the rods' accelerations are
solved for (a symmetric 3 x 3 mass matrix) where it hands an implicit system to a DAE solver, and its kinetic energy
takes the first rod's angular rate in the second rod's rotational term, here corrected.
"""

import numpy as np

from envs.plant import grid, stack, stepper

ENV_ID = "RLMPC/DoublePendulum-v0"
EPISODE_STEPS = 100
DT = 0.04  # s, sampling time
TIME_UNIT = "s"

STATE_NAMES = ("position", "theta_1", "theta_2", "velocity", "omega_1", "omega_2")
MEASURED = ("position", "theta_1", "theta_2")
STATE_UNITS = ("m", "rad", "rad", "m/s", "rad/s", "rad/s")
X_LOW = np.array([-5.0, -np.inf, -np.inf, -np.inf, -np.inf, -np.inf])  # the track is what limits the motion
X_HIGH = -X_LOW
INIT_LOW = np.array([-1.0, -np.pi, -np.pi, -1.0, -5.0, -5.0])
INIT_HIGH = -INIT_LOW
# far beyond what 5 N and the initial energy reach in an episode
OBS_LOW = np.array([-200.0, -1000.0, -1000.0, -100.0, -200.0, -200.0])
OBS_HIGH = -OBS_LOW
ANGLES = [1, 2]  # the networks see them as sine and cosine
START = np.array([0.0, 0.9 * np.pi, 0.9 * np.pi, 0.0, 0.0, 0.0])  # the paper's: at rest, nearly hanging
START_NOISE = np.array([0.0, 0.05, 0.05, 0.0, 0.0, 0.0])  # half-width of what the seed of goal_mpc.py adds

ACTION_NAMES = ("force",)
ACTION_UNITS = ("N",)
U_LOW, U_HIGH = np.array([-5.0]), np.array([5.0])

PSI_NAMES = ("cart_mass", "rod_1_mass", "rod_2_mass")  # factors of the nominal masses
PSI_NOMINAL = np.ones(3)
SCENARIOS = {
    "nominal": PSI_NOMINAL[None],
    "mpc": grid(*[[1.0, 0.95, 1.05]] * 3),  # nominal first
    "extremes": np.concatenate([PSI_NOMINAL[None], grid(*[[0.95, 1.05]] * 3)]),
    "robust": grid(*[np.linspace(0.95, 1.05, 10)] * 3),
}
EVAL_PSI = grid(*[np.linspace(0.95, 1.05, 7)] * 3)

# the quadratic agent
BENCHMARK = {"horizon": 25, "slack_price": 1e3 * np.ones((2, 6)), "change_weight": np.zeros(1)}
EXPERT_CHANGE_WEIGHT = np.array([0.1])  # 1/N^2, of the expert agent's penalty on changes of the force

GOAL_INDEX = [1, 2]  # the goal is a pair of angles, rad
# the unstable equilibria, inner rod first
GOALS = {"up-up": (0.0, 0.0), "up-down": (0.0, np.pi), "down-up": (np.pi, 0.0)}
TRAIN_GOALS = np.array(list(GOALS.values()))
EVAL_GOAL = np.array(GOALS["up-up"])
GOAL_LOW, GOAL_HIGH = -np.pi * np.ones(2), np.pi * np.ones(2)
ERROR_SCALE = np.ones(2)  # not used: both goals are angles
REWARD_SIGMA2 = 0.25  # of 1 - cos(error); with 0.01 SAC finds nothing to learn from
REWARD_TOLERANCE = 0.02  # 1 - cos of 0.2 rad
MPC_SIGMA2 = 1.0  # eq:smoothreward as the stage cost of goal_mpc.py
METRIC_SIGMA2 = 0.01  # of time near goal and time outside constraints, as in the paper
MODEL_SUBSTEPS = 2  # Runge-Kutta steps per sampling time in predictions; the simulated plant takes 8

TRAINING = dict(hidden=(128, 128), gamma=0.97, num_envs=64, total_timesteps=300_000)
EXPECT = "SAC learns to swing, not to hold; experiments/planner_value_iteration.py learns both in minutes"

GRAVITY = 9.80665  # m/s^2
CART_MASS, ROD_1_MASS, ROD_2_MASS = 0.6, 0.2, 0.2  # kg
LENGTH_1, LENGTH_2 = 0.5, 0.5  # m, of the rods; their centres of mass are in the middle
CENTRE_1, CENTRE_2 = LENGTH_1 / 2, LENGTH_2 / 2  # m


def masses(psi):
    """Of cart and rods, kg."""
    return CART_MASS * psi[0], ROD_1_MASS * psi[1], ROD_2_MASS * psi[2]


def ode(x, u, psi, xp=np):
    """Time derivative, per second; components along the first axis; xp is numpy, torch or casadi."""
    theta_1, theta_2, omega_1, omega_2 = x[1], x[2], x[4], x[5]
    cart, rod_1, rod_2 = masses(psi)
    moment_1, moment_2 = rod_1 * CENTRE_1 + rod_2 * LENGTH_1, rod_2 * CENTRE_2  # kg m
    coupling = rod_2 * CENTRE_2 * LENGTH_1  # kg m^2
    sin_1, cos_1, sin_2, cos_2 = xp.sin(theta_1), xp.cos(theta_1), xp.sin(theta_2), xp.cos(theta_2)
    sin_12, cos_12 = sin_1 * cos_2 - cos_1 * sin_2, cos_1 * cos_2 + sin_1 * sin_2
    # symmetric mass matrix m and generalised forces b; a rod's inertia is m L^2 / 12
    m00, m01, m02 = cart + rod_1 + rod_2, moment_1 * cos_1, moment_2 * cos_2
    m11 = rod_1 * (CENTRE_1**2 + LENGTH_1**2 / 12) + rod_2 * LENGTH_1**2
    m12, m22 = coupling * cos_12, rod_2 * (CENTRE_2**2 + LENGTH_2**2 / 12)
    b0 = u[0] + moment_1 * omega_1 * omega_1 * sin_1 + moment_2 * omega_2 * omega_2 * sin_2
    b1 = moment_1 * GRAVITY * sin_1 - coupling * omega_2 * omega_2 * sin_12
    b2 = moment_2 * GRAVITY * sin_2 + coupling * omega_1 * omega_1 * sin_12
    # symmetric elimination, stable since the matrix is positive definite
    l1, l2 = m01 / m00, m02 / m00
    d11, d12, c1 = m11 - m01 * l1, m12 - m01 * l2, b1 - l1 * b0
    l12 = d12 / d11
    alpha_2 = (b2 - l2 * b0 - l12 * c1) / (m22 - m02 * l2 - d12 * l12)
    alpha_1 = (c1 - d12 * alpha_2) / d11
    return stack(xp, [x[3], omega_1, omega_2, (b0 - m01 * alpha_1 - m02 * alpha_2) / m00, alpha_1, alpha_2])


step = stepper(ode, DT)  # x (..., 6), u (..., 1), psi (..., 3) -> (..., 6)


def expert_cost(x, xp=np):
    """Stage and terminal cost of the paper's expert agent, J: kinetic minus potential energy, whatever the goal."""
    from envs.script.pendulum import kinetic_energy, potential_energy

    return kinetic_energy(x, xp=xp) - potential_energy(x, xp=xp)


def held_action(goal):
    """The force (1,) that holds both angles: none, if each rod stands or hangs; else infinite, there is none."""
    return np.zeros(1) if np.allclose(np.sin(goal), 0, atol=1e-6) else np.full(1, np.inf)


def animate(x, u, predicted, goals, path):
    """GIF of the motion in real time: x (steps + 1, 6), u (steps, 1), predicted (steps, N + 1, 6), goals (steps, 2)."""
    from envs.script.pendulum import animate

    animate(x, u, predicted, goals, path)
