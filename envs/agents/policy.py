"""A trained agent: what its networks see, and its actions and values in physical units."""

import numpy as np
import torch

import envs
from envs.agents.checkpoint import read_checkpoint


class Scaling:
    """Affine maps between physical and network units, in which alone the networks compute; plain lists in files."""

    def __init__(self, **values):
        self.values = values
        for name, value in values.items():
            kind = torch.long if name.endswith("index") else torch.float32
            setattr(self, name, torch.tensor(value, dtype=kind))

    @classmethod
    def of(cls, plant):
        def affine(name, low, high):
            # a mismatch starts at zero and has unit scale already
            half = np.where(high > low, (high - low) / 2, 1.0)
            return {f"{name}_center": ((low + high) / 2).tolist(), f"{name}_scale": half.tolist()}

        index, n_x = plant.GOAL_INDEX, len(plant.INIT_LOW)
        columns = [*range(n_x), *index]  # of [x, goal]: the state that each is about
        angles = [j for j, state in enumerate(columns) if state in plant.ANGLES]
        others = [j for j in range(len(columns)) if j not in angles]
        values = affine("x", plant.INIT_LOW, plant.INIT_HIGH) | affine("u", plant.U_LOW, plant.U_HIGH)
        values |= affine("goal", plant.INIT_LOW[index], plant.INIT_HIGH[index])
        values |= {"error_scale": plant.ERROR_SCALE.tolist(), "goal_index": index}
        return cls(**values, angle_index=angles, other_index=others)

    def features(self, x, goal, goal_input):
        """Physical state (B, n_x) and goal (B, n_goal) -> network input (B, n_in), angles as sine and cosine."""
        if goal_input == "error":
            goal = goal - x[:, self.goal_index]
            g = goal / self.error_scale
        else:
            g = (goal - self.goal_center) / self.goal_scale
        z = torch.cat([(x - self.x_center) / self.x_scale, g], dim=-1)
        if not len(self.angle_index):
            return z
        angles = torch.cat([x, goal], dim=-1)[:, self.angle_index]
        return torch.cat([z[:, self.other_index], torch.sin(angles), torch.cos(angles)], dim=-1)


class Policy:
    """A trained agent for people: batched numpy arrays in physical units. x: (n_x,) or (B, n_x), what the agent observes."""

    def __init__(self, plant, actor, critic, scaling, goal_input):
        self.plant, self.actor, self.critic = plant, actor, critic
        self.scaling, self.goal_input = scaling, goal_input

    def features(self, x, goal):
        x, goal = (torch.atleast_2d(torch.as_tensor(v, dtype=torch.float32)) for v in (x, goal))
        sizes = len(self.scaling.x_center), len(self.scaling.goal_center)
        if (x.shape[-1], goal.shape[-1]) != sizes:
            raise ValueError(
                f"state and goal are {x.shape[-1]} and {goal.shape[-1]} numbers; the agent has {sizes}"
            )
        return self.scaling.features(x, goal.expand(len(x), -1), self.goal_input)

    def physical(self, action):
        """Actions in [-1, 1] in physical units, numpy."""
        return (action * self.scaling.u_scale + self.scaling.u_center).numpy()

    @torch.no_grad()
    def act(self, x, goal):
        """Deterministic action mu(x, goal), (B, n_u); goal (n_goal,) or (B, n_goal)."""
        return self.physical(self.actor.act(self.features(x, goal)))

    @torch.no_grad()
    def value(self, x, goal):
        """V(x, goal) = min_j Q_j(x, mu(x, goal), goal), (B,), with SAC's entropy bonus unless trained without."""
        z = self.features(x, goal)
        return self.critic(z, self.actor.act(z)).amin(0).numpy()


def read_policy(path, actor_class, critic_class):
    """The agent stored in a checkpoint.pt, which is data, never code. Raises ValueError for anything else."""

    def build(data):
        plant = envs.load(data["env"], **data["plant_options"])
        with torch.device("meta"):  # no memory until the file's own weights are put in, if they fit
            actor, critic = actor_class(**data["network"]), critic_class(**data["network"])
        actor.load_state_dict(data["actor"], assign=True)
        critic.load_state_dict(data["critic"], assign=True)
        networks = actor.float(), critic.float()
        policy = Policy(plant, *networks, Scaling(**data["scaling"]), data["goal_input"])
        if not np.isfinite(
            policy.value(envs.sample_states(plant, np.random.default_rng(0), 1), plant.EVAL_GOAL)
        ).all():
            raise ValueError("values that are not finite")
        return policy

    return read_checkpoint(path, None, build)
