"""What a controller knows of its plant: the measurement itself, an extended Kalman filter, or particles."""

import itertools

import casadi as ca
import numpy as np

import envs
from envs.control.compiled import OnArrays, compiled_functions
from envs.control.model import prediction_model, scaling
from envs.mismatch import checked_scale

# in half-widths of the box of initial states and of the parameters' range, that of the planners' scenarios
STATE_NOISE = 1e-3  # what the model gets wrong in a step
DISTURBANCE = 5e-3  # what else a step may add to the nominal model, beside what parameters explain
WALK = 1e-2  # of how far parameters and disturbance may be off, how far they may move in a step
RETURN = 5e-4  # share of what parameters differ from their nominal values by which they return in a step
FURTHEST = 2.0  # parameters are looked for within twice their range
DOUBT = 0.25  # deviation of the parameters that planners allow for, however sure the filter is

SENSOR = 1e-3  # the least noise of a sensor that a filter assumes, share of the range of its state
GATE = 25.0  # squared: a measurement five standard deviations from its prediction is wrong
PATIENCE = 3  # steps in a row at which measurements are wrong before the filter doubts itself


class Measured:
    """The whole state is measured without noise, and nothing else is known: the plant is taken for the nominal one.

    `update(y, u)` takes the measurement y (n_y,) of the states `measured` after the action u (n_u,), physical units, and returns the
    estimate x (n_x,). Of the rest: shift (n_psi,) is what to add to nominal parameters, disturbance (n_x,) to every prediction, mismatch
    (n_x,) what agents observe (`Mismatch`, on the scale mismatch_scale; without one zero). report goes into the controller's stats.
    """

    def __init__(self, plant, mismatch_scale=None):
        self.plant, self.measured = plant, np.arange(len(plant.X_LOW))
        self.mismatch_scale = None if mismatch_scale is None else checked_scale(plant, mismatch_scale)
        self.reset()

    def reset(self):
        """Forget everything, as at the start of an episode."""
        n_x, n_psi = len(self.plant.X_LOW), len(self.plant.PSI_NOMINAL)
        self.x, self.report = None, {}
        self.shift, self.disturbance, self.mismatch = np.zeros(n_psi), np.zeros(n_x), np.zeros(n_x)

    def checked(self, y):
        """The measurement as a new array. Raises ValueError for another shape, or an entry that is not finite."""
        return envs.checked_state(self.plant, y)

    def update(self, y, u):
        y, u = self.checked(y), np.array(u, dtype=float)
        if u.shape != self.plant.U_LOW.shape:
            raise ValueError(
                f"u has shape {u.shape}; {self.plant.ENV_ID} has {len(self.plant.U_LOW)} actions"
            )
        before, self.x = self.x, self.estimate(y, u)
        if self.mismatch_scale is not None and before is not None and not self.report.get("restarted"):
            with np.errstate(over="ignore", invalid="ignore"):
                difference = self.x - self.plant.step(before, u, self.plant.PSI_NOMINAL)
            if (np.abs(difference) < envs.half_width(self.plant)).all():  # else a glitch, not the plant
                self.mismatch = np.tanh(difference / self.mismatch_scale)
        return self.x.copy()

    def estimate(self, y, u):
        return y

    def belief(self, scenarios):
        """Of every scenario (S, n_psi) the state that it starts from (S, n_x), its parameters (S, n_psi), its weight (S,)."""
        S = len(scenarios)
        return np.repeat([self.x], S, axis=0), scenarios + self.shift, np.full(S, 1 / S)


class Filter(Measured):
    """What filters share: noisy measurements of some of the states, of which those that are wrong are left out.

    measured: names of states; default: all. noise: standard deviation of the sensors, a share of each state's range, a number or (n_y,).
    certain: planners take the estimate for certain, with their own scenarios about it (certainty equivalence); default: their scenarios
    are what the filter does not know, its `points` with weights. What is not finite in a measurement, or outside of the plant's OBS_LOW to
    OBS_HIGH, is missing, and a sensor that repeats itself to the last digit is stuck.

    z begins with state and uncertain parameters, scaled. report: rejected, names of the states whose measurement was missing or wrong;
    restarted, whether the filter started again: when all have been wrong for PATIENCE steps, or one for `longest`.
    """

    longest = PATIENCE

    def __init__(self, plant, measured=None, noise=0.0, *, certain=False, mismatch_scale=None):
        names, noise = list(plant.STATE_NAMES), np.array(noise, dtype=float)
        chosen = [measured] if isinstance(measured, str) else list(names if measured is None else measured)
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(names):
            text = f"measured is {', '.join(chosen) or 'nothing'}; it must be different ones of {', '.join(names)}"
            raise ValueError(text)
        if noise.shape not in ((), (len(chosen),)) or not ((noise >= 0) & (noise < np.inf)).all():
            raise ValueError(f"noise is {noise}; it must be a number or {len(chosen)}, finite, not negative")
        self.x_center, self.x_scale, self.u_center, self.u_scale = scaling(plant)
        half, self.n = np.ptp(plant.SCENARIOS["mpc"], axis=0) / 2, len(self.x_scale)
        self.uncertain, self.certain = np.flatnonzero(half > 0), certain  # parameters
        self.half, self.known = half[self.uncertain], self.n + len(self.uncertain)
        super().__init__(plant, mismatch_scale)
        self.measured = i = np.array([names.index(name) for name in chosen])
        self.variance = (np.maximum(noise, SENSOR) * envs.state_range(plant)[i] / self.x_scale[i]) ** 2

    def reset(self):
        super().reset()
        self.z, self.last, self.wrong_for = None, np.nan, 0

    def checked(self, y):
        y, names = np.array(y, dtype=float), [self.plant.STATE_NAMES[i] for i in self.measured]
        if y.shape != (len(names),):
            raise ValueError(
                f"measurement has shape {y.shape}; it must be ({len(names)},): {', '.join(names)}"
            )
        return np.where(np.isfinite(y), y, np.nan)

    def estimate(self, y, u):
        low, high = (np.asarray(bound)[self.measured] for bound in (self.plant.OBS_LOW, self.plant.OBS_HIGH))
        present, self.last = np.isfinite(y) & (low <= y) & (y <= high) & (y != self.last), y
        y = (np.where(present, y, 0.0) - self.x_center[self.measured]) / self.x_scale[self.measured]
        y = np.clip(y, -1e12, 1e12)  # its square is finite
        wrong, restarted, first = ~present, False, self.z is None
        if not first:
            wrong = wrong | self.step((u - self.u_center) / self.u_scale, y, present)
            self.wrong_for = np.where(present, (self.wrong_for + 1) * wrong, self.wrong_for)
            late = self.wrong_for[present]
            lost = late.min(initial=self.longest) >= PATIENCE or late.max(initial=0) >= self.longest
            restarted = bool(present.any() and lost or not np.isfinite(self.z).all())
        if first or restarted:
            self.begin(y, present)
            wrong, self.wrong_for = ~present, 0 * present
        rejected = tuple(self.plant.STATE_NAMES[i] for i in self.measured[wrong])
        self.report = {"rejected": rejected, "restarted": restarted}
        self.shift[self.uncertain] = self.z[self.n : self.known] * self.half
        return self.z[: self.n] * self.x_scale + self.x_center

    def belief(self, scenarios):
        if self.certain:
            return super().belief(scenarios)
        points, weight = self.points(len(scenarios))
        starts = points[:, : self.n] * self.x_scale + self.x_center
        return np.clip(starts, self.plant.OBS_LOW, self.plant.OBS_HIGH), self.psi(points), weight

    def psi(self, z):
        """Parameters (..., n_psi) of vectors z."""
        psi = np.tile(self.plant.PSI_NOMINAL, (len(z), 1))
        psi[:, self.uncertain] += np.clip(z[:, self.n : self.known], -FURTHEST, FURTHEST) * self.half
        return psi


class KalmanFilter(Filter):
    """Extended Kalman filter; z: state, uncertain parameters, and of each measured state what a step adds to the model; P: its covariance;
    far: squared distance of each measurement from its prediction, in standard deviations.

    With a disturbance per measurement there is no steady-state offset (Pannocchia and Rawlings, AIChE Journal 49(2), 2003). Parameters and
    disturbances walk at random; at rest both explain the same, so that parameters slowly return to their nominal values (RETURN). If a
    measurement is wrong for PATIENCE steps they are taken to have changed: what may be off at the start is added to their covariance.
    `points`: the mean and, on both sides along the axes in which state and parameters are most uncertain, sigma points of equal weight.
    """

    longest = 8

    def __init__(self, plant, measured=None, noise=0.0, *, compile=True, **options):
        super().__init__(plant, measured, noise, **options)
        off = np.repeat([3**-0.5, DISTURBANCE], [self.known, len(self.measured)])  # uniform in its box
        self.prior, later = off**2, off**2 * (np.arange(len(off)) >= self.n)
        walk = np.append(np.full(self.n, STATE_NOISE), WALK * off[self.n :]) ** 2
        self.functions = [*self._functions(np.diag(walk), np.diag(later)), self._axes()]
        compiled = compiled_functions(self.functions) if compile else self.functions
        self.predict, self.correct, self.axes = map(OnArrays, compiled)

    def _functions(self, walk, later):
        """CasADi functions: predict (z, P, u) -> z, P, and P if things have changed, one sampling time later; correct (these, y, present,
        whether it has been wrong before) -> z, P and the squared distance of each measurement in standard deviations."""
        n, known, m, size = self.n, self.known, len(self.measured), len(walk)
        z, P, u = ca.MX.sym("z", size), ca.MX.sym("P", size, size), ca.MX.sym("u", len(self.u_scale))
        pick, rows = np.eye(size)[:, self.measured], self.uncertain.tolist()
        psi = ca.MX(self.plant.PSI_NOMINAL)
        psi[rows] += z[n:known] * self.half
        x, A, E = prediction_model(self.plant, "psi")[1](z[:n], u, psi)
        stay, given, P = np.eye(size)[n:], P, (P + P.T) / 2  # else rounding errors grow
        stay[: known - n] *= 1 - RETURN
        F = ca.vertcat(ca.horzcat(A, E[:, rows] @ np.diag(self.half), pick[:n]), stay)
        z_after, P_after = ca.vertcat(x + pick[:n] @ z[known:], stay @ z), F @ P @ F.T + walk
        after = [z_after, P_after, P_after + F @ later @ F.T]
        predict = ca.Function("predict", [z, given, u], [*map(ca.densify, after)])

        P, e, y, r, present = given, ca.MX.sym("e", size), *map(ca.MX.sym, ("y", "r", "present"))
        column, innovation = P @ e, y - ca.dot(e, z)
        far = present * innovation**2 / (ca.dot(e, column) + r)
        gain = present * (far < GATE) / (ca.dot(e, column) + r)
        after = [z + gain * innovation * column, P - gain * column @ column.T, far]
        one = ca.Function("one", [z, P, e, y, r, present], after, {"never_inline": True})
        y, present, before, changed = *(ca.MX.sym(v, m) for v in "ypb"), ca.MX.sym("changed", size, size)
        given = [(pick[:, i], y[i], r, present[i]) for i, r in enumerate(self.variance)]
        furthest = ca.mmax(before * ca.vertcat(*(one(z, P, *each)[2] for each in given)))
        state, covariance, far = z, ca.if_else(furthest > GATE, changed, P), []
        for each in given:
            state, covariance, found = one(state, covariance, *each)
            far.append(found)
        given = [z, P, changed, y, present, before]
        return predict, ca.Function("correct", given, [state, covariance, ca.vertcat(*far)])

    def _axes(self, sweeps=8):
        """CasADi function P -> the axes along which state and parameters are uncertain, a column each as long as a standard deviation,
        the longest first; by cyclic Jacobi rotations (Golub and Van Loan, section 8.5), so that they move little when P does."""
        n, size = self.known, len(self.prior)
        M, V, p, q = ca.SX.sym("M", n, n), ca.SX.sym("V", n, n), ca.SX.sym("p", n), ca.SX.sym("q", n)
        a, d = 2 * ca.bilin(M, p, q), ca.bilin(M, q, q) - ca.bilin(M, p, p)
        t = a / (d + ca.if_else(d < 0, -1, 1) * ca.sqrt(d**2 + a**2) + 1e-30)
        c = 1 / ca.sqrt(t**2 + 1)

        def rotated(m):
            return m + (((c - 1) * m @ p - t * c * m @ q) @ p.T + (t * c * m @ p + (c - 1) * m @ q) @ q.T)

        after = [rotated(rotated(M).T), rotated(V)]
        rotate, unit = ca.Function("rotate", [M, V, p, q], after, {"never_inline": True}), np.eye(n)
        P = ca.MX.sym("P", size, size)
        M = (P + P.T)[:n, :n] / 2 + np.diag(DOUBT**2 * (np.arange(n) >= self.n))
        V = ca.MX(unit)
        for first, second in list(itertools.combinations(unit, 2)) * sweeps:
            M, V = rotate(M, V, first, second)
        variance = ca.fmax(ca.diag(M), 0)
        longer = ca.repmat(variance, 1, n) > ca.repmat(variance.T, n, 1)
        longer += (ca.repmat(variance, 1, n) == ca.repmat(variance.T, n, 1)) * np.triu(np.ones((n, n)), 1)
        rank = ca.sum1(longer)  # how many are longer
        place = ca.repmat(rank.T, 1, n) == ca.repmat(ca.DM(range(n)).T, n, 1)
        return ca.Function("axes", [P], [ca.densify((V * ca.repmat(ca.sqrt(variance).T, n, 1)) @ place)])

    def begin(self, y, present):
        """The middle of the boxes, and what is measured as it is."""
        self.z, variance, i = np.zeros(len(self.prior)), self.prior.copy(), self.measured[present]
        self.z[i], variance[i] = y[present], self.variance[present]
        self.P, self.disturbance = np.diag(variance), np.zeros(self.n)

    def step(self, u, y, present):
        """Take an action and the measurement after it; returns which entries of that are wrong."""
        before = self.wrong_for + np.zeros(len(y)) >= PATIENCE - 1
        z, P, far = self.correct(*self.predict(self.z, self.P, u), y, present, before)
        self.z, self.P, self.far = z.ravel().copy(), P.copy(), far.ravel().copy()
        self.z[self.n : self.known] = np.clip(self.z[self.n : self.known], -FURTHEST, FURTHEST)
        self.disturbance[self.measured] = self.z[self.known :] * self.x_scale[self.measured]
        return ~(self.far < GATE)

    def points(self, S):
        moves = self.axes(self.P)[0][: (S - 1) // 2] * np.sqrt(S / 2)  # fewer if z is short
        moves = np.concatenate([np.zeros((S - 2 * len(moves), self.known)), moves, -moves])
        return self.z[: self.known] + moves, np.full(S, 1 / S)


class ParticleFilter(Filter):
    """Particles (x, psi) on the batched simulator, drawn towards the measurement (the optimal proposal for Gaussian noise), and resampled
    when they count for less than half of their number; z is their mean.

    `points`: the particles in as many groups, each its mean and its weight: first in order along the axis in which they spread most, then
    each particle with the nearest mean (Lloyd's algorithm).
    """

    def __init__(self, plant, measured=None, noise=0.0, *, particles=500, seed=0, **options):
        if particles < 1:
            raise ValueError(f"particles is {particles}; it must be at least 1")
        self.count, self.seed = particles, seed
        super().__init__(plant, measured, noise, **options)

    def reset(self):
        super().reset()
        self.rng = np.random.default_rng(self.seed)
        self.doubt = (
            DOUBT * self.rng.normal(size=(self.count, self.known)) * (np.arange(self.known) >= self.n)
        )

    def begin(self, y, present):
        z, i = self.rng.uniform(-1, 1, size=(self.count, self.known)), self.measured[present]
        z[:, self.n :] *= FURTHEST
        z[:, i] = self.rng.normal(y[present], np.sqrt(self.variance[present]), size=(self.count, len(i)))
        self.particles, self.weight = z, np.full(self.count, 1 / self.count)
        self.z = z.mean(axis=0)

    @np.errstate(over="ignore", invalid="ignore")  # of particles that have gone astray
    def step(self, u, y, present):
        n, x, u = (
            self.n,
            self.particles[:, : self.n],
            np.tile(u * self.u_scale + self.u_center, (self.count, 1)),
        )
        x = self.plant.step(x * self.x_scale + self.x_center, u, self.psi(self.particles))
        x = (x - self.x_center) / self.x_scale
        astray = ~np.isfinite(x).all(axis=1)
        x[astray], self.weight[astray] = self.z[:n], 0.0
        innovation, variance = np.zeros((self.count, n)), np.ones(n)  # where nothing is measured
        innovation[:, self.measured] = (y - x[:, self.measured]) * present
        variance[self.measured] = STATE_NOISE**2 + self.variance
        far = innovation**2 / variance
        use = far.min(axis=0) < GATE
        share = np.isin(np.arange(n), self.measured[present]) * use * STATE_NOISE**2 / variance
        self.particles[:, :n] = x + share * innovation
        self.particles[:, :n] += STATE_NOISE * np.sqrt(1 - share) * self.rng.normal(size=x.shape)
        p = self.particles[:, n:] + WALK * self.rng.normal(size=(self.count, self.known - n))
        self.particles[:, n:] = np.clip(p, -FURTHEST, FURTHEST)
        likelihood = -np.where(use, far, 0).sum(axis=1) / 2
        self.weight = self.weight * np.exp(likelihood - likelihood.max())
        self.weight /= self.weight.sum()
        self.z = self.weight @ self.particles
        if 1 / (self.weight**2).sum() < self.count / 2:
            self.resample()
        return ~use[self.measured]

    def resample(self, kernel=0.1):
        """Systematic; then each particle moves by a share of their spread, so that mean and covariance stay (Liu and West, 2001)."""
        at = (self.rng.uniform() + np.arange(self.count)) / self.count
        chosen = self.particles[np.searchsorted(np.cumsum(self.weight), at).clip(max=self.count - 1)]
        away = (self.particles - self.z) * np.sqrt(self.weight)[:, None]
        variance, axes = np.linalg.eigh(away.T @ away)
        spread = axes * np.sqrt(np.maximum(variance, 0))
        self.particles = self.z + np.sqrt(1 - kernel**2) * (chosen - self.z)
        self.particles += kernel * self.rng.normal(size=chosen.shape) @ spread.T
        self.weight = np.full(self.count, 1 / self.count)

    def points(self, S):
        z = self.particles + self.doubt
        axis = np.linalg.svd((z - self.z) * np.sqrt(self.weight)[:, None], full_matrices=False)[2][0]
        order = np.argsort(z @ axis)
        group = np.empty(self.count, dtype=int)
        group[order] = np.minimum(np.cumsum(self.weight[order]) * S, S - 1)
        for _ in range(5):
            member = np.eye(S)[group].T * self.weight  # (S, particles)
            weight = member.sum(axis=1)
            means = np.where(weight[:, None] > 0, member @ z / np.maximum(weight, 1e-300)[:, None], self.z)
            group = ((means**2).sum(axis=1) - 2 * z @ means.T).argmin(axis=1)
        return means, weight


def build_estimator(plant, kind, measured=None, noise=0.0, **options):
    """An estimator by its name on the command line; measured: names of states, or ("sensors",), the plant's MEASURED; options of filters.

    Raises ValueError for what no sensor or no estimator can tell.
    """
    names = tuple(plant.STATE_NAMES)
    measured = plant.MEASURED if measured == ("sensors",) else measured
    filters = {"ekf": KalmanFilter, "particles": ParticleFilter}
    if kind in filters:
        own = {name: value for name, value in options.items() if name != "compile" or kind == "ekf"}
        return filters[kind](plant, measured, noise, **own)
    if kind != "none":
        raise ValueError(f"--estimator is {kind!r}; choose one of none, {', '.join(filters)}")
    if measured is not None and tuple(measured) != names:
        text = (
            f"--measure is {', '.join(measured)}; without --estimator ekf or particles it must be every state"
        )
        raise ValueError(f"{text}: {', '.join(names)}")
    return Measured(plant, options.get("mismatch_scale"))
