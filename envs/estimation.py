"""What transitions tell about a plant: to an agent that observes it, and to planners without steady-state offset."""

import numpy as np

from envs.plant import half_width, sample_states


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

    def step(self, x, u, psi):
        x = np.asarray(x)[..., : len(self.plant.X_LOW)]
        x_next = self.plant.step(x, u, psi)
        nominal = self.plant.step(x, u, np.broadcast_to(self.plant.PSI_NOMINAL, np.shape(psi)))
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
        self.plant, self.kind, self.gain, self.window = plant, kind, gain, window
        self.scale = np.inf if scale is None else np.array(scale)
        if kind not in (None, "disturbance", "parameters", "mismatch"):
            raise ValueError(f"kind is {kind!r}; it must be None, 'disturbance', 'parameters' or 'mismatch'")
        if not 0 < gain <= 1:
            raise ValueError(f"gain is {gain}; it must lie in (0, 1]")
        self.reset()

    def reset(self):
        """Forget everything, as at the start of an episode."""
        self.last, self.transitions = None, []
        self.difference = np.zeros(len(self.plant.X_LOW))
        self.shift = np.zeros(len(self.plant.PSI_NOMINAL))

    @property
    def before(self):
        """The last state and action, to be set by whoever acts."""
        return self.last

    @before.setter
    def before(self, pair):
        self.last = pair and tuple(np.array(part, dtype=float) for part in pair)

    @property
    def disturbance(self):
        return self.difference * (self.kind == "disturbance")

    @property
    def mismatch(self):
        return np.tanh(self.difference / self.scale)

    def memory(self):
        """What a prediction takes, by name."""
        return (
            {}
            if self.kind is None
            else {"disturbance": self.disturbance, "shift": self.shift, "mismatch": self.mismatch}
        )

    def update(self, x):
        """Take the state (n_x,) that the last action led to."""
        if self.kind is None or self.before is None:
            return
        x = np.array(x, dtype=float)
        with np.errstate(over="ignore", invalid="ignore"):
            found = x - self.plant.step(*self.before, self.plant.PSI_NOMINAL)
        if not (np.abs(found) < half_width(self.plant)).all():  # a glitch of the measurement, not the plant
            return
        self.difference = self.difference + self.gain * (found - self.difference)
        if self.kind == "parameters":
            self.transitions = [*self.transitions, (*self.before, x)][-self.window :]
            self.shift = self.shift + self.gain * (self._least_squares() - self.shift)

    def _least_squares(self, prior=1e-5):
        """Shift of the parameters that fits the transitions; `prior` keeps what they do not show where it was."""
        from scipy.optimize import least_squares

        x, u, x_next = (np.array(v) for v in zip(*self.transitions))  # (window, n)
        nominal, scale = self.plant.PSI_NOMINAL, half_width(self.plant)
        half = np.ptp(self.plant.SCENARIOS["mpc"], axis=0) / 2
        known = np.where(half > 0, half, 1.0)  # what no scenario varies stays nominal

        def residuals(v):  # v: shift in half-widths of the scenario set
            predicted = self.plant.step(x, u, np.tile(nominal + half * v, (len(x), 1)))
            return np.append((predicted - x_next) / scale, prior * (v - self.shift / known))

        start = np.clip(self.shift / known, -1.99, 1.99)
        return half * least_squares(residuals, start, bounds=(-2, 2), xtol=1e-6).x
