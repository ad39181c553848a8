"""A plant as a goal-conditioned gymnasium environment: one at a time, and many in a batch."""

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from envs.measures import goal_reward, sample_states
from envs.mismatch import Mismatch


class _PlantSpaces:
    """Spaces and observation layout that the single and the batched environment share."""

    def _set_plant(self, plant, options, scenarios, scenario_hold, max_episode_steps, reward_shape):
        from envs import load

        self.plant = load(plant, **options)
        if scenario_hold not in ("step", "episode"):
            raise ValueError(f"scenario_hold={scenario_hold!r} is neither 'step' nor 'episode'")
        self.hold = scenario_hold == "episode"
        if scenarios not in self.plant.SCENARIOS:
            raise ValueError(f"scenarios={scenarios!r} is not one of {', '.join(self.plant.SCENARIOS)}")
        self.scenarios = self.plant.SCENARIOS[scenarios]
        self.reward_shape = reward_shape  # smooth_reward, reward_sigma2, reward_tolerance
        self.max_episode_steps = self.plant.EPISODE_STEPS if max_episode_steps is None else max_episode_steps
        for name, value in (
            ("max_episode_steps", self.max_episode_steps),
            ("reward_sigma2", reward_shape[1]),
            ("reward_tolerance", reward_shape[2]),
        ):
            if value is not None and not value > 0:
                raise ValueError(f"{name} is {value}; it must be positive")

        def box(low, high):
            return gym.spaces.Box(np.float64(low), np.float64(high), dtype=np.float64)

        p = self.plant
        goal_box = box(p.OBS_LOW[p.GOAL_INDEX], p.OBS_HIGH[p.GOAL_INDEX])
        self._single_observation_space = gym.spaces.Dict(
            observation=box(p.OBS_LOW, p.OBS_HIGH),
            achieved_goal=goal_box,
            desired_goal=box(p.GOAL_LOW, p.GOAL_HIGH),
        )
        self._single_action_space = gym.spaces.Box(
            np.float32(p.U_LOW), np.float32(p.U_HIGH), dtype=np.float32
        )

    def compute_reward(self, achieved_goal, desired_goal, info=None):
        """Reward, vectorised over the leading axes; equal to what `step` returned."""
        return goal_reward(self.plant, achieved_goal, desired_goal, *self.reward_shape)

    def _obs(self, x, goal):
        return {
            "observation": x.copy(),
            "achieved_goal": x[..., self.plant.GOAL_INDEX],
            "desired_goal": goal.copy(),
        }

    def _clip(self, action, shape):
        action = np.asarray(action, dtype=np.float64)
        if action.shape != shape:
            raise ValueError(f"action has shape {action.shape}; it must be {shape}")
        if not np.isfinite(action).all():
            raise ValueError(
                f"{(~np.isfinite(action)).sum()} of {action.size} numbers of the action are not finite"
            )
        return np.clip(action, self.plant.U_LOW, self.plant.U_HIGH)

    def _options(self, options, shape, used=()):
        """Copies of the state, goal and parameters that `reset` is given, each (*shape, n) or (n,); what is not given is left out.

        used: which rows count.
        """
        n_x = len(self.plant.MISMATCH_SCALE) if isinstance(self.plant, Mismatch) else len(self.plant.X_LOW)
        sizes = {"state": n_x, "goal": len(self.plant.GOAL_INDEX), "psi": len(self.plant.PSI_NOMINAL)}
        found = {}
        for name, n in sizes.items():
            if (options or {}).get(name) is not None:
                value = np.array(options[name], dtype=np.float64)
                if name == "state" and isinstance(self.plant, Mismatch):
                    value = value[..., :n_x]
                if value.shape not in ((n,), (*shape, n)) or not np.isfinite(value).all():
                    raise ValueError(
                        f"reset: {name} is {value.tolist()}; it must be finite, of shape {(*shape, n)}"
                    )
                if name == "state" and isinstance(self.plant, Mismatch):  # none yet
                    value = np.concatenate([value, np.zeros_like(value)], axis=-1)
                found[name] = np.broadcast_to(value, (*shape, value.shape[-1])).copy()
        if "goal" in found:
            goal, low, high = found["goal"][used], self.plant.GOAL_LOW, self.plant.GOAL_HIGH
            if not ((low <= goal) & (goal <= high)).all():
                raise ValueError(
                    f"reset: goal is {goal.tolist()}; it must lie in {low.tolist()} to {high.tolist()}"
                )
        return found


def reached_states(next_obs, infos):
    """The states (num_envs, n_x) that a step of a vector environment reached; where an episode ended they are in final_obs.

    That is a batch of observations here, and an array of single ones in gymnasium's own vector environments.
    """
    final = infos.get("final_obs", next_obs)
    if isinstance(final, dict):
        return final["observation"]
    reached = np.array(next_obs["observation"])
    for i in np.flatnonzero(infos["_final_obs"]):
        reached[i] = final[i]["observation"]
    return reached


class GoalEnv(_PlantSpaces, gym.Env):
    """One plant as a goal environment (`Dict` observation), in physical units, truncated after the plant's EPISODE_STEPS.

    At every step, or with scenario_hold="episode" once per episode, the parameters psi are drawn anew from the scenario set
    (eq:offlineMDP). `reset(options=...)` takes `state` (n_x,), `goal` (n_goal,) and `psi` (n_psi,): a given psi is held for the episode.
    Nothing is rendered; render_mode is there for those who pass it always.
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        plant,
        scenarios="robust",
        smooth_reward=True,
        reward_sigma2=None,
        reward_tolerance=None,
        scenario_hold="step",
        max_episode_steps=None,
        render_mode=None,
        **options,
    ):
        reward_shape = smooth_reward, reward_sigma2, reward_tolerance
        self._set_plant(plant, options, scenarios, scenario_hold, max_episode_steps, reward_shape)
        self.observation_space, self.action_space = self._single_observation_space, self._single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        given, self.t = self._options(options, ()), 0
        self.x = given["state"] if "state" in given else sample_states(self.plant, self.np_random, 1)[0]
        self.goal = given.get("goal")
        if self.goal is None:
            self.goal = np.array(self.np_random.choice(self.plant.TRAIN_GOALS), dtype=np.float64)
        self.psi = given.get("psi")
        if self.psi is None and self.hold:
            self.psi = self.np_random.choice(self.scenarios)
        return self._obs(self.x, self.goal), {}

    def step(self, action):
        psi = self.np_random.choice(self.scenarios) if self.psi is None else self.psi.copy()
        self.x = self.plant.step(self.x, self._clip(action, self.plant.U_LOW.shape), psi)
        self.t += 1
        obs = self._obs(self.x, self.goal)
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"]))
        return obs, reward, False, self.t >= self.max_episode_steps, {"psi": psi}


class VectorGoalEnv(_PlantSpaces, gym.vector.VectorEnv):
    """`num_envs` copies of a plant stepped in one batch, same-step autoreset: the state before a reset is `infos["final_obs"]`.

    With `branches` > 0, `infos["branch_states"]` (num_envs, branches, n_x) holds the next states under that many scenarios
    drawn independently of the one that the episode follows. With scenario_hold="episode" the scenario is drawn once per episode.
    `reset(options=...)` takes `state`, `goal` and `psi` as `GoalEnv` does, (num_envs, n) or (n,) for all.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        plant,
        num_envs=1,
        scenarios="robust",
        smooth_reward=True,
        reward_sigma2=None,
        reward_tolerance=None,
        branches=0,
        scenario_hold="step",
        max_episode_steps=None,
        render_mode=None,
        **options,
    ):
        reward_shape = smooth_reward, reward_sigma2, reward_tolerance
        self._set_plant(plant, options, scenarios, scenario_hold, max_episode_steps, reward_shape)
        if num_envs < 1 or branches < 0:
            raise ValueError(f"num_envs is {num_envs}, branches {branches}; they must be at least 1 and 0")
        self.num_envs, self.branches = num_envs, branches
        self.single_observation_space = self._single_observation_space
        self.single_action_space = self._single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        mask = None if mask is None else np.asarray(mask)
        if mask is not None and (mask.shape != (self.num_envs,) or mask.dtype != bool):
            text = f"it must be True or False for each of {self.num_envs}"
            raise ValueError(f"reset: reset_mask is {mask}; {text}")
        if mask is None:
            self.x = np.empty((self.num_envs, len(self.plant.X_LOW)))
            self.goal = np.empty((self.num_envs, len(self.plant.GOAL_INDEX)))
            self.t = np.zeros(self.num_envs, dtype=np.int64)
            self.psi = np.zeros((self.num_envs, self.scenarios.shape[1]))
            self.held = np.zeros(self.num_envs, dtype=bool)  # whose psi lasts for the episode
            mask = np.ones(self.num_envs, dtype=bool)
        self._reset_rows(mask)
        for name, value in self._options(options, (self.num_envs,), mask).items():
            kept = {"state": self.x, "goal": self.goal, "psi": self.psi}[name]
            kept[mask] = value[mask]
            self.held |= mask & (name == "psi")
        return self._obs(self.x, self.goal), {}

    def _reset_rows(self, mask):
        n = int(mask.sum())
        self.x[mask] = sample_states(self.plant, self.np_random, n)
        self.goal[mask] = self.np_random.choice(self.plant.TRAIN_GOALS, size=n)
        self.t[mask], self.held[mask] = 0, self.hold
        if self.hold:
            self.psi[mask] = self._draw_scenarios(n)

    def _draw_scenarios(self, *shape):
        return self.scenarios[self.np_random.integers(len(self.scenarios), size=shape)]

    def step(self, actions):
        u, infos = self._clip(actions, (self.num_envs, len(self.plant.U_LOW))), {}
        if self.branches:
            shape = (self.num_envs, self.branches)
            x, v = (np.broadcast_to(a[:, None], (*shape, a.shape[-1])) for a in (self.x, u))
            infos["branch_states"] = self.plant.step(x, v, self._draw_scenarios(*shape))
        infos["psi"] = self.psi.copy()
        if not self.held.all():
            infos["psi"] = np.where(self.held[:, None], self.psi, self._draw_scenarios(self.num_envs))
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
        state = {name: getattr(self, name).tolist() for name in ("x", "goal", "t", "psi", "held")}
        return state | {"rng": self.np_random.bit_generator.state}

    def set_state(self, state):
        """Continue from what `get_state` returned; returns the observation."""
        for name in ("x", "goal", "t", "psi", "held"):
            setattr(self, name, np.array(state[name]).reshape(getattr(self, name).shape))
        self.np_random.bit_generator.state = state["rng"]
        return self._obs(self.x, self.goal)
