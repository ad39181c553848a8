"""Plants as goal-conditioned gymnasium environments. Every module in this folder is one plant: `--env NAME` means `envs/NAME.py`.

A plant module holds plain constants and functions and no gymnasium code (`envs/cstr.py` is the pattern to copy):

    ENV_ID, EPISODE_STEPS, DT, TIME_UNIT          gymnasium id, steps before truncation, sampling time
    STATE_NAMES, STATE_UNITS, ACTION_NAMES, ...   for tables and figures
    X_LOW, X_HIGH                                 constraint box, (n_x,), infinite where there is no constraint
    INIT_LOW, INIT_HIGH                           box of initial states, finite: it also scales states for networks and solvers
    OBS_LOW, OBS_HIGH                             wider box that every reachable state stays in, (n_x,)
    ANGLES                                        indices of states that are angles (networks see their sine and cosine)
    START, START_NOISE                            one start state, and how far a seed moves it (goal_mpc.py)
    U_LOW, U_HIGH                                 actuator limits, (n_u,)
    PSI_NAMES, PSI_NOMINAL, EVAL_PSI              uncertain parameters, their nominal value, the plants of the evaluation
    SCENARIOS                                     sets to draw psi from: "nominal", "mpc" (its first is nominal), "robust" (training)
    BENCHMARK                                     of the MPC that rl_mpc_deploy.py compares with: "horizon", "slack_price" (2, n_x), below
                                                  and above (inf: a hard bound, 0: none), "change_weight" (n_u,)
    GOAL_INDEX                                    which states the goal is about, so `x[..., GOAL_INDEX]` is the achieved goal
    TRAIN_GOALS, EVAL_GOAL, GOAL_LOW, GOAL_HIGH, GOAL_REACHABLE (box of the goals that can be held at steady state)
    ERROR_SCALE                                   size of a large goal error, (n_goal,): normalises the networks' input
    REWARD_SIGMA2, MPC_SIGMA2                     sigma^2 of the Gaussian reward and of the planners' stage cost, squared units of the
                                                  goal error
    REWARD_TOLERANCE                              half-width of the sparse reward, units of the goal error
    ode(x, u, psi, xp), step(x, u, psi), goal_error(achieved, goal, xp), percentage_error(achieved, goal)
    MODEL_SUBSTEPS                                Runge-Kutta steps per sampling time in predictions
    TRAINING                                      arguments of sac_her_branching.py whose defaults it changes, {} for none
optional: held_action(goal), the action (n_u,) that holds a goal, infinite if none does, where a box cannot tell
optional, for observe_mismatch: MISMATCH_SCALE, size of a large difference between model and plant after one step, (n_x,)
optional, for goal_mpc.py: GOALS (by name), expert_cost(x, xp) and EXPERT_CHANGE_WEIGHT (another objective), animate(...)

A family of plants (`envs/linear.py`) defines `make(dim, system)` instead, which returns an object with these names. A plant in discrete
time has next_state(x, u, psi, xp) instead of ode; one with a linear-quadratic regulator lqr, lq_cost, lq_value, feedback and baseline.

The folder `tools` holds what the scripts share beside plants.

`GoalEnv` and `VectorGoalEnv` below turn such a module into environments; importing `envs` registers one id per module.
"""

import importlib
import inspect
import itertools
import pkgutil

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


def stack(xp, rows):
    """Join the components of a derivative into one array, for numpy, torch and casadi alike (components along the first axis)."""
    if xp is np:
        return np.array(rows)  # half the time of np.stack at a batch of 1,024
    return xp.vertcat(*rows) if hasattr(xp, "vertcat") else xp.stack(rows)


def rk4(ode, x, u, psi, dt, substeps, xp=np):
    """Classical Runge-Kutta steps of `ode(x, u, psi, xp)` over `dt` with the input held (components along the first axis)."""
    h = dt / substeps
    for _ in range(substeps):
        k1 = ode(x, u, psi, xp)
        k2 = ode(x + h / 2 * k1, u, psi, xp)
        k3 = ode(x + h / 2 * k2, u, psi, xp)
        k4 = ode(x + h * k3, u, psi, xp)
        k2 += k3  # in place: a fifth faster than x + h / 6 * (k1 + 2 * (k2 + k3) + k4), which it computes
        k2 *= 2
        k2 += k1
        k2 += k4
        k2 *= h / 6
        x = x + k2
    return x


def names():
    """Names of the plants in this folder, the values that `--env` takes."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__) if not module.ispkg)


class Mismatch:
    """A plant whose observation (2 n_x,) is its state and how the last transition differed from the nominal model, zero at the first step:

        m_t = tanh((x_t - f(x_{t-1}, u_{t-1}, psi nominal)) / MISMATCH_SCALE)

    One state does not tell which plant it comes from; one transition does. Everything but the state is the plant's. scale: in place of the
    plant's MISMATCH_SCALE, (n_x,).
    """

    def __init__(self, plant, scale=None):
        if not hasattr(plant, "MISMATCH_SCALE"):
            raise ValueError(f"--observe-mismatch: {plant.ENV_ID} has no MISMATCH_SCALE")
        self.plant, n = plant, len(plant.X_LOW)
        self.MISMATCH_SCALE = plant.MISMATCH_SCALE if scale is None else np.array(scale)
        extra = {"X_LOW": -np.inf, "X_HIGH": np.inf, "INIT_LOW": 0.0, "INIT_HIGH": 0.0, "OBS_LOW": -1.0, "OBS_HIGH": 1.0}
        for name, value in extra.items():
            setattr(self, name, np.append(getattr(plant, name), np.full(n, value)))

    def __getattr__(self, name):
        return getattr(self.plant, name)

    def step(self, x, u, psi):
        x = np.asarray(x)[..., : len(self.plant.X_LOW)]
        x_next, nominal = self.plant.step(x, u, psi), self.plant.step(x, u, np.broadcast_to(self.plant.PSI_NOMINAL, np.shape(psi)))
        return np.concatenate([x_next, np.tanh((x_next - nominal) / self.MISMATCH_SCALE)], axis=-1)


class Estimator:
    """What the last transitions tell about a plant, for predictions without steady-state offset. Of the kinds

    "disturbance": what one transition adds to the nominal model, x_t - f(x_{t-1}, u_{t-1}, nominal), which every prediction then adds: the
        classic construction (Pannocchia and Rawlings, AIChE Journal 49(2), 2003), here with the whole state measured.
    "parameters": psi by least squares over the last `window` transitions, within twice the box of the MPC's scenarios.
    "mismatch": neither, only what an agent that observes the `Mismatch` sees (which the others tell too).
    None: nothing.

    A transition further from the model than half the box of initial states is taken for a wrong measurement and left out.

    Attributes: disturbance (n_x,) and shift (n_psi,) = psi - nominal, physical units; mismatch (n_x,). Each follows what the last
    transitions say by `gain`. scale: of the mismatch, (n_x,), the agent's; without it the mismatch is zero.
    """

    def __init__(self, plant, kind=None, gain=1.0, scale=None, window=5):
        self.plant, self.kind, self.gain, self.scale, self.window = plant, kind, gain, np.inf if scale is None else np.array(scale), window
        self.reset()

    def reset(self):
        """Forget everything, as at the start of an episode."""
        self.before, self.transitions = None, []  # before: the last state and action, to be set by whoever acts
        self.difference = np.zeros(len(self.plant.X_LOW))
        self.shift = np.zeros(len(self.plant.PSI_NOMINAL))

    @property
    def disturbance(self):
        return self.difference * (self.kind == "disturbance")

    @property
    def mismatch(self):
        return np.tanh(self.difference / self.scale)

    def memory(self):
        """What a prediction takes, by name."""
        return {} if self.kind is None else {"disturbance": self.disturbance, "shift": self.shift, "mismatch": self.mismatch}

    def update(self, x):
        """Take the state (n_x,) that the last action led to."""
        if self.kind is None or self.before is None:
            return
        with np.errstate(over="ignore", invalid="ignore"):
            found = x - self.plant.step(*self.before, self.plant.PSI_NOMINAL)
        if not (np.abs(found) < (self.plant.INIT_HIGH - self.plant.INIT_LOW) / 2).all():  # a glitch of the measurement, not the plant
            return
        self.difference = self.difference + self.gain * (found - self.difference)
        if self.kind == "parameters":
            self.transitions = [*self.transitions, (*self.before, x)][-self.window :]
            self.shift = self.shift + self.gain * (self._least_squares() - self.shift)

    def _least_squares(self, prior=1e-5):
        """Shift of the parameters that fits the transitions; `prior` keeps what they do not show where it was."""
        from scipy.optimize import least_squares

        x, u, x_next = (np.array(v) for v in zip(*self.transitions))  # (window, n)
        nominal, scale = self.plant.PSI_NOMINAL, (self.plant.INIT_HIGH - self.plant.INIT_LOW) / 2
        half = np.ptp(self.plant.SCENARIOS["mpc"], axis=0) / 2
        known = np.where(half > 0, half, 1.0)  # what no scenario varies stays nominal

        def residuals(v):  # v: shift in half-widths of the scenario set
            predicted = self.plant.step(x, u, np.tile(nominal + half * v, (len(x), 1)))
            return np.append((predicted - x_next) / scale, prior * (v - self.shift / known))

        return half * least_squares(residuals, np.clip(self.shift / known, -1.99, 1.99), bounds=(-2, 2), xtol=1e-6).x


def load(name, observe_mismatch=False, **options):
    """The plant module `envs/NAME.py`, or what its `make(**options)` returns if it has one; options that are None are left out.

    With observe_mismatch, True or its scale (n_x,), it is wrapped as a `Mismatch`. Raises ValueError, one sentence, for a plant that is not
    there (with the list of what is) or an option that it does not take.
    """
    if name not in names():
        raise ValueError(f"--env {name!r} is not a plant of this folder; choose one of {', '.join(names())}")
    module, options = importlib.import_module(f"{__name__}.{name}"), {k: v for k, v in options.items() if v is not None}
    known = inspect.signature(module.make).parameters if hasattr(module, "make") else ()
    for option in options:
        if option not in known:
            raise ValueError(f"--{option} is not an option of --env {name}")
    plant = module.make(**options) if hasattr(module, "make") else module
    return Mismatch(plant, None if observe_mismatch is True else observe_mismatch) if observe_mismatch else plant


def scenario_set(plant, name):
    """Parameters (S, n_psi) of the plant's scenario set, the nominal ones first, whether the set has them or not.

    Raises ValueError for a set that the plant does not have.
    """
    if name not in plant.SCENARIOS:
        raise ValueError(f"--scenarios {name} is not a scenario set of {plant.ENV_ID}; choose one of {', '.join(plant.SCENARIOS)}")
    scenarios = np.asarray(plant.SCENARIOS[name])
    return np.concatenate([plant.PSI_NOMINAL[None], scenarios[(scenarios != plant.PSI_NOMINAL).any(axis=1)]])


def sample_states(plant, rng, n):
    """Initial states uniform in their box, (n, n_x)."""
    if isinstance(plant, Mismatch):  # zero at first, and no random numbers of its own
        x = sample_states(plant.plant, rng, n)
        return np.hstack([x, np.zeros_like(x)])
    return rng.uniform(plant.INIT_LOW, plant.INIT_HIGH, size=(n, len(plant.INIT_LOW)))


def goal_reward(plant, achieved, goal, smooth=True, sigma2=None, tolerance=None, xp=np):
    """Reward of reaching `achieved` under `goal`, both (..., n_goal): Gaussian (eq:goalreward), or 0/1 (eq:sparsereward)."""
    error = plant.goal_error(achieved, goal, xp)
    if smooth:
        return xp.exp(-(error**2).sum(-1) / (2 * (plant.REWARD_SIGMA2 if sigma2 is None else sigma2)))
    return 1.0 * (abs(error) <= (plant.REWARD_TOLERANCE if tolerance is None else tolerance)).all(-1)


def outside_constraints(plant, x, sigma2=0.01, xp=np):
    """The paper's measure of constraint violation, exp(-|x - clip(x)|^2 / (2 sigma2)) - 1, x (..., n_x) -> (...): 0 inside the box."""
    low, high = (xp.asarray(bound, dtype=x.dtype, device=x.device) for bound in (plant.X_LOW, plant.X_HIGH))
    return xp.exp(-((x - xp.clip(x, low, high)) ** 2).sum(-1) / (2 * sigma2)) - 1


def new_folder(path):
    """Make the folder, or if another run has it already one with -2, -3, ... behind its name; returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            pass


def can_hold(plant, goals):
    """Whether every scenario can hold each goal at steady state, (..., n_goal) -> (...)."""
    if hasattr(plant, "held_action"):
        action = np.apply_along_axis(plant.held_action, -1, np.asarray(goals))
        return ((plant.U_LOW <= action) & (action <= plant.U_HIGH)).all(-1)
    low, high = plant.GOAL_REACHABLE
    return ((low <= goals) & (goals <= high)).all(-1)


def checked_state(plant, x0):
    """The measured state as a new float array (n_x,). Raises ValueError if it has another shape or an entry that is not finite."""
    x0 = np.array(x0, dtype=float)
    if x0.shape != plant.X_LOW.shape:
        raise ValueError(f"state has shape {x0.shape}; {plant.ENV_ID} needs {plant.X_LOW.shape}: {', '.join(plant.STATE_NAMES)}")
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
    shown, low_shown, high_shown = (np.array2string(v.ravel(), threshold=4, edgeitems=1) for v in (goal, low, high))
    if goal.shape not in ((n,), (n, horizon)):
        stages = f", or {n} for each of {horizon} stages" if horizon else ""
        raise ValueError(f"goal is {shown}; {plant.ENV_ID} needs {n} number(s){stages}")
    if not ((low <= goal.T) & (goal.T <= high)).all():  # nor is nan
        raise ValueError(f"goal is {shown}; {plant.ENV_ID} takes {low_shown} to {high_shown}")
    return goal


class _PlantSpaces:
    """Spaces and observation layout that the single and the batched environment share."""

    def _set_plant(self, plant, options, scenarios, smooth_reward, reward_sigma2, reward_tolerance, scenario_hold):
        self.plant = load(plant, **options)
        if scenario_hold not in ("step", "episode"):
            raise ValueError(f"scenario_hold={scenario_hold!r} is neither 'step' nor 'episode'")
        self.hold = scenario_hold == "episode"
        if scenarios not in self.plant.SCENARIOS:
            raise ValueError(f"scenarios={scenarios!r} is not one of {', '.join(self.plant.SCENARIOS)}")
        self.scenarios = self.plant.SCENARIOS[scenarios]
        self.reward_shape = (smooth_reward, reward_sigma2, reward_tolerance)

        def box(low, high):
            return gym.spaces.Box(np.float64(low), np.float64(high), dtype=np.float64)

        p = self.plant
        goal_box = box(p.OBS_LOW[p.GOAL_INDEX], p.OBS_HIGH[p.GOAL_INDEX])
        self._single_observation_space = gym.spaces.Dict(
            observation=box(p.OBS_LOW, p.OBS_HIGH), achieved_goal=goal_box, desired_goal=box(p.GOAL_LOW, p.GOAL_HIGH)
        )
        self._single_action_space = gym.spaces.Box(np.float32(p.U_LOW), np.float32(p.U_HIGH), dtype=np.float32)

    def compute_reward(self, achieved_goal, desired_goal, info=None):
        """Reward, vectorised over the leading axes; equal to what `step` returned."""
        return goal_reward(self.plant, achieved_goal, desired_goal, *self.reward_shape)

    def _obs(self, x, goal):
        return {"observation": x.copy(), "achieved_goal": x[..., self.plant.GOAL_INDEX], "desired_goal": goal.copy()}

    def _clip(self, action):
        return np.clip(np.asarray(action, dtype=np.float64), self.plant.U_LOW, self.plant.U_HIGH)


class GoalEnv(_PlantSpaces, gym.Env):
    """One plant as a goal environment (`Dict` observation), in physical units.

    At every step, or with scenario_hold="episode" once per episode, the parameters psi are drawn anew from the scenario set
    (eq:offlineMDP). `reset(options=...)` takes `state` (n_x,), `goal` (n_goal,) and `psi` (n_psi,): a given psi is held for the episode.
    """

    metadata = {"render_modes": []}

    def __init__(self, plant, scenarios="robust", smooth_reward=True, reward_sigma2=None, reward_tolerance=None, scenario_hold="step",
                 **options):  # fmt: skip
        self._set_plant(plant, options, scenarios, smooth_reward, reward_sigma2, reward_tolerance, scenario_hold)
        self.observation_space, self.action_space = self._single_observation_space, self._single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        options = options or {}
        state = options.get("state", sample_states(self.plant, self.np_random, 1)[0])
        goal = options.get("goal", self.np_random.choice(self.plant.TRAIN_GOALS))
        if isinstance(self.plant, Mismatch):  # none yet
            state = np.append(state[: len(self.plant.MISMATCH_SCALE)], 0 * self.plant.MISMATCH_SCALE)
        self.x, self.goal = np.array(state, dtype=np.float64), np.array(goal, dtype=np.float64)
        self.psi = options.get("psi", self.np_random.choice(self.scenarios) if self.hold else None)
        return self._obs(self.x, self.goal), {}

    def step(self, action):
        psi = self.np_random.choice(self.scenarios) if self.psi is None else np.asarray(self.psi)
        self.x = self.plant.step(self.x, self._clip(action), psi)
        obs = self._obs(self.x, self.goal)
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"]))
        return obs, reward, False, False, {"psi": psi}


class VectorGoalEnv(_PlantSpaces, gym.vector.VectorEnv):
    """`num_envs` copies of a plant stepped in one batch, same-step autoreset: the state before a reset is `infos["final_obs"]`.

    With `branches` > 0, `infos["branch_states"]` (num_envs, branches, n_x) holds the next states under that many scenarios
    drawn independently of the one that the episode follows. With scenario_hold="episode" the scenario is drawn once per episode.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, plant, num_envs=1, scenarios="robust", smooth_reward=True, reward_sigma2=None, reward_tolerance=None,
                 branches=0, scenario_hold="step", max_episode_steps=None, **options):  # fmt: skip
        self._set_plant(plant, options, scenarios, smooth_reward, reward_sigma2, reward_tolerance, scenario_hold)
        self.num_envs, self.branches = num_envs, branches
        self.max_episode_steps = max_episode_steps or self.plant.EPISODE_STEPS
        self.single_observation_space, self.single_action_space = self._single_observation_space, self._single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            self.x = np.empty((self.num_envs, len(self.plant.X_LOW)))
            self.goal = np.empty((self.num_envs, len(self.plant.GOAL_INDEX)))
            self.t = np.zeros(self.num_envs, dtype=np.int64)
            self.psi = np.zeros((self.num_envs, self.scenarios.shape[1]))
            mask = np.ones(self.num_envs, dtype=bool)
        self._reset_rows(mask)
        return self._obs(self.x, self.goal), {}

    def _reset_rows(self, mask):
        n = int(mask.sum())
        self.x[mask] = sample_states(self.plant, self.np_random, n)
        self.goal[mask] = self.np_random.choice(self.plant.TRAIN_GOALS, size=n)
        self.t[mask] = 0
        if self.hold:
            self.psi[mask] = self._draw_scenarios(n)

    def _draw_scenarios(self, *shape):
        return self.scenarios[self.np_random.integers(len(self.scenarios), size=shape)]

    def step(self, actions):
        u, infos = self._clip(actions), {}
        if self.branches:
            shape = (self.num_envs, self.branches)
            x, v = (np.broadcast_to(a[:, None], (*shape, a.shape[-1])) for a in (self.x, u))
            infos["branch_states"] = self.plant.step(x, v, self._draw_scenarios(*shape))
        infos["psi"] = self.psi.copy() if self.hold else self._draw_scenarios(self.num_envs)
        self.x = self.plant.step(self.x, u, infos["psi"])
        self.t += 1
        obs = self._obs(self.x, self.goal)
        rewards = self.compute_reward(obs["achieved_goal"], obs["desired_goal"])
        truncations = self.t >= self.max_episode_steps
        if truncations.any():
            infos["final_obs"], infos["_final_obs"] = obs, truncations.copy()
            self._reset_rows(truncations)
            obs = self._obs(self.x, self.goal)
        return obs, rewards, np.zeros(self.num_envs, dtype=bool), truncations, infos

    def get_state(self):
        """Everything that the next `step` depends on, as plain data (for checkpoints)."""
        state = {name: getattr(self, name).tolist() for name in ("x", "goal", "t", "psi")}
        return state | {"rng": self.np_random.bit_generator.state}

    def set_state(self, state):
        """Continue from what `get_state` returned; returns the observation."""
        for name in ("x", "goal", "t", "psi"):
            setattr(self, name, np.array(state.get(name, getattr(self, name))))
        self.np_random.bit_generator.state = state["rng"]
        return self._obs(self.x, self.goal)


for _name in names():
    gym.register(
        id=load(_name).ENV_ID,
        entry_point="envs:GoalEnv",
        vector_entry_point="envs:VectorGoalEnv",
        max_episode_steps=load(_name).EPISODE_STEPS,
        kwargs={"plant": _name},
    )
