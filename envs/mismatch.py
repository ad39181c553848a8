"""A plant for agents that observe how the last transition differed from the nominal model."""

import numpy as np

from envs.measures import sample_states


def checked_scale(plant, scale):
    """A new array (n_x,). Raises ValueError for another shape, or what is not positive."""
    scale = np.array(scale, dtype=float)
    if scale.shape != plant.X_LOW.shape or not ((scale > 0) & (scale < np.inf)).all():
        raise ValueError(
            f"scale of the mismatch is {scale.tolist()}; it must be {len(plant.X_LOW)} positive numbers"
        )
    return scale


class Mismatch:
    """A plant whose observation (2 n_x,) is its state and how the last transition differed from the nominal model, zero at the first step:

        m_t = tanh((x_t - f(x_{t-1}, u_{t-1}, psi nominal)) / MISMATCH_SCALE)

    One state does not tell which plant it comes from; one transition does. Everything but the state is the plant's. scale: in place of the
    plant's MISMATCH_SCALE, (n_x,).
    """

    def __init__(self, plant, scale=None):
        if scale is None and not hasattr(plant, "MISMATCH_SCALE"):
            raise ValueError(f"--observe-mismatch: {plant.ENV_ID} has no MISMATCH_SCALE")
        self.plant, n = plant, len(plant.X_LOW)
        self.MISMATCH_SCALE = checked_scale(plant, plant.MISMATCH_SCALE if scale is None else scale)
        extra = {
            "X_LOW": -np.inf,
            "X_HIGH": np.inf,
            "INIT_LOW": 0.0,
            "INIT_HIGH": 0.0,
            "OBS_LOW": -1.0,
            "OBS_HIGH": 1.0,
        }
        for name, value in extra.items():
            setattr(self, name, np.append(getattr(plant, name), np.full(n, value)))

    def __getattr__(self, name):
        if name == "plant" or name.startswith("__"):  # not yet there, while it is copied
            raise AttributeError(name)
        return getattr(self.plant, name)

    def sample_states(self, rng, n):
        """Initial states, (n, 2 n_x): no mismatch at first."""
        x = sample_states(self.plant, rng, n)
        return np.hstack([x, np.zeros_like(x)])

    def step(self, x, u, psi=None):
        psi = self.plant.PSI_NOMINAL if psi is None else psi
        x = np.asarray(x)[..., : len(self.plant.X_LOW)]
        x_next = self.plant.step(x, u, psi)
        nominal = self.plant.step(x, u, np.broadcast_to(self.plant.PSI_NOMINAL, np.shape(psi)))
        return np.concatenate([x_next, np.tanh((x_next - nominal) / self.MISMATCH_SCALE)], axis=-1)
