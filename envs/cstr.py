"""Continuous stirred tank reactor of Klatt and Engell (1998), the paper's Example 3 (equations in its section app:cstr).

A -> B -> C and 2A -> D. The feed rate F and the cooling power Q_dot steer the product concentration c_B; the activation energy
of A -> D (factor alpha) and the rate of A -> B (factor beta) are uncertain. Corrections to the printed equations: the T_R
equation lacks a `+` before the heat-transfer term, and Table 1 lists activation energies times R, where the exponents need kelvin.
"""

import numpy as np

from envs.plant import grid, stack, stepper

ENV_ID = "RLMPC/CSTR-v0"
EPISODE_STEPS = 50
DT = 0.005  # h, sampling time
TIME_UNIT = "h"

STATE_NAMES = ("c_A", "c_B", "T_R", "T_K")
STATE_UNITS = ("mol/l", "mol/l", "°C", "°C")
MEASURED = ("c_B", "T_R", "T_K")
X_LOW = np.array([0.1, 0.1, 50.0, 50.0])
X_HIGH = np.array([2.0, 2.0, 140.0, 140.0])
INIT_LOW, INIT_HIGH = X_LOW, X_HIGH
OBS_LOW = np.array([0.0, 0.0, -50.0, -50.0])  # never left: the feed holds 5.1 mol/l of A
OBS_HIGH = np.array([6.0, 6.0, 400.0, 400.0])
ANGLES = []
START = np.array([0.8, 0.3, 100.14, 100.0])  # of the paper's trajectories
START_NOISE = np.array([0.05, 0.05, 5.0, 5.0])  # half-width of what the seed of goal_mpc.py adds to it

ACTION_NAMES = ("F", "Q_dot")
ACTION_UNITS = ("1/h", "kJ/h")
U_LOW = np.array([5.0, -8500.0])
U_HIGH = np.array([100.0, 0.0])


PSI_NAMES = ("alpha", "beta")
PSI_NOMINAL = np.array([1.0, 1.0])
SCENARIOS = {
    "nominal": PSI_NOMINAL[None],
    "mpc": grid([1.0, 0.95, 1.05], [1.0, 0.9, 1.1]),  # nominal first
    "robust": grid(np.linspace(0.95, 1.05, 10), np.linspace(0.9, 1.1, 10)),
}
EVAL_PSI = grid(np.linspace(1.05, 0.95, 7), np.linspace(1.1, 0.9, 8))  # 8 of the 56 lie on the training grid

BENCHMARK = {  # the MPC that the paper compares with: hard bounds but for the upper one of T_R, quadratic cost
    "horizon": 20,
    # below, above
    "slack_price": np.array([[np.inf, np.inf, np.inf, np.inf], [np.inf, np.inf, 100.0, np.inf]]),
    "change_weight": np.array([0.1 / 100**2, 1e-3 / 2000**2]),
}

GOAL_INDEX = [1]  # the goal is a concentration c_B, mol/l
TRAIN_GOALS = np.array([[0.6], [0.7], [0.8]])
EVAL_GOAL = np.array([0.65])
GOAL_LOW, GOAL_HIGH = np.array([0.1]), np.array([2.0])
# at steady state, inside the box, by every scenario of the set "mpc"
GOAL_REACHABLE = np.array([0.31]), np.array([0.80])
ERROR_SCALE = np.array([0.05])  # mol/l; five standard deviations of the training reward
# mol/l, mol/l, degC, degC: what the corners of the training box do in one step
MISMATCH_SCALE = np.array([0.02, 0.02, 0.5, 0.5])
REWARD_SIGMA2 = 1e-4  # (mol/l)^2, eq:cstrreward
REWARD_TOLERANCE = 0.01  # mol/l
MODEL_SUBSTEPS = 4  # Runge-Kutta steps per sampling time in predictions; the simulated plant takes 8
MPC_SIGMA2 = 0.01  # (mol/l)^2, of the stage cost in the authors' script; the paper's text says 0.0625
METRIC_SIGMA2 = 0.01  # of time near goal and time outside constraints, as in the paper

K0_AB = 1.287e12  # 1/h, rate constants (Table 1)
K0_AD = 9.043e9  # l/(mol h)
E_AB, E_AD = 9758.3, 8560.0  # K, activation energies over the gas constant; that of B -> C equals E_AB
H_AB, H_BC, H_AD = 4.2, -11.0, -41.85  # kJ/mol, reaction enthalpies
RHO, C_P, C_PK = 0.9342, 3.01, 2.0  # kg/l, kJ/(kg K), kJ/(kg K)
A_R, V_R, M_K = 0.215, 10.01, 5.0  # m^2, l, kg
T_IN, K_W, C_A0 = 130.0, 4032.0, 5.1  # degC, kJ/(h m^2 K), mol/l
REACTOR_HEAT = 1 / (RHO * C_P)  # K l/kJ


def ode(x, u, psi, xp=np):
    """Time derivative, per hour. Components along the first axis: x (4, ...), u (2, ...), psi (2, ...); xp is numpy, torch or casadi."""
    c_a, c_b, t_r, t_k = x[0], x[1], x[2], x[3]
    feed, q_dot, alpha, beta = u[0], u[1], psi[0], psi[1]
    minus_1_over_t = -1.0 / (t_r + 273.15)  # 1/K
    k2 = K0_AB * xp.exp(E_AB * minus_1_over_t)  # 1/h
    r_ab = beta * k2 * c_a  # reaction rates, mol/(l h)
    r_bc = k2 * c_b
    r_ad = K0_AD * xp.exp(E_AD * alpha * minus_1_over_t) * c_a * c_a
    t_dif = t_k - t_r  # K
    return stack(
        xp,
        [
            feed * (C_A0 - c_a) - r_ab - r_ad,
            r_ab - feed * c_b - r_bc,
            (-H_AB * REACTOR_HEAT) * r_ab
            + (-H_BC * REACTOR_HEAT) * r_bc
            + (-H_AD * REACTOR_HEAT) * r_ad
            + feed * (T_IN - t_r)
            + (K_W * A_R * REACTOR_HEAT / V_R) * t_dif,
            1 / (M_K * C_PK) * q_dot - K_W * A_R / (M_K * C_PK) * t_dif,
        ],
    )


step = stepper(ode, DT)  # x (..., 4), u (..., 2), psi (..., 2) -> (..., 4)


def goal_error(achieved, goal, xp=np):
    """Elementwise error whose squared norm enters the Gaussian reward, mol/l."""
    return achieved - goal


def percentage_error(achieved, goal):
    """Absolute percentage error of c_B, (..., 1) -> (...)."""
    return 100 * np.abs(achieved - goal)[..., 0] / goal[..., 0]
