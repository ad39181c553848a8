"""What the networks see: the plant's states and goals in units of their boxes, angles as sine and cosine."""

import numpy as np
import torch


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
            half = np.where(high > low, (high - low) / 2, 1.0)  # a mismatch starts at zero and has unit scale already
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
