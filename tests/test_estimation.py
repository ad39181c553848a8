"""Filters: against the Kalman filter and true parameters, through faults, and in controllers that plan over what they tell."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import envs
import rl_mpc_deploy as deploy
from envs import cstr
from envs.control.estimation import (
    DISTURBANCE,
    FURTHEST,
    STATE_NOISE,
    WALK,
    KalmanFilter,
    Measured,
    ParticleFilter,
)
from envs.script.comparison import draws, run_episode

RANGE, SENSORS = envs.state_range(cstr), ("c_B", "T_R", "T_K")
BOTH = {"ekf": KalmanFilter, "particles": ParticleFilter}


@pytest.fixture(scope="module")
def linear():
    return envs.load("linear", dim=3, system=1)


def kalman(**options):
    return KalmanFilter(cstr, compile=False, **options)


def simulated(estimator, psi, steps, noise=0.0, seed=0, x0=cstr.START):
    """Random actions on a plant: yields the state, the action before it and what is measured, from the first state on."""
    rng, x, u = np.random.default_rng(seed), np.array(x0), np.zeros(2)
    for _ in range(steps):
        yield x, u, (x + noise * RANGE * rng.normal(size=4))[estimator.measured]
        u = rng.uniform([10.0, -3000.0], [40.0, 0.0])
        x = cstr.step(x, u, np.array(psi))


# Oracles


def test_on_a_linear_plant_it_is_the_kalman_filter(linear):
    """Covariance in the steady state: that of the Riccati equation for the plant with its disturbances."""
    estimator = KalmanFilter(linear, ["x_1", "x_3"], 0.01)
    n, m, rng = 3, 2, np.random.default_rng(0)
    x = np.array([0.5, -0.3, 0.2])
    for _ in range(10_000):
        estimator.update(
            x[[0, 2]] + 0.01 * envs.state_range(linear)[[0, 2]] * rng.normal(size=2),
            np.zeros(linear.B.shape[1]),
        )
        x = linear.A @ x
    pick = np.eye(n)[:, [0, 2]]
    scale = estimator.x_scale
    F = np.block([[linear.A * scale / scale[:, None], pick], [np.zeros((m, n)), np.eye(m)]])
    H = np.hstack([pick.T, np.zeros((m, m))])
    walk = np.diag(np.append(np.full(n, STATE_NOISE**2), np.full(m, (WALK * DISTURBANCE) ** 2)))
    predicted = solve_discrete_are(F.T, H.T, walk, np.diag(estimator.variance))
    gain = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + np.diag(estimator.variance))
    np.testing.assert_allclose(estimator.P, predicted - gain @ H @ predicted, rtol=1e-3, atol=2e-9)


def test_particles_converge_to_the_kalman_filter(linear):
    """Without disturbances, which particles do not estimate: the mean, in standard deviations, the more particles the nearer."""
    noise, rng, A = 0.05, np.random.default_rng(1), linear.A
    scale, x = envs.half_width(linear), np.array([0.5, -0.3, 0.2])
    r = (noise * envs.state_range(linear)[:2] / scale[:2]) ** 2
    filters = [
        ParticleFilter(linear, ["x_1", "x_2"], noise, particles=n, seed=seed)
        for n in (100, 10_000)
        for seed in range(4)
    ]
    z, P, H, apart = np.zeros(3), np.diag([*r, 1 / 3]), np.eye(3)[:2], []
    for t in range(15):
        y = x[:2] + noise * envs.state_range(linear)[:2] * rng.normal(size=2)
        if t:
            z, P = A @ z, A @ P @ A.T + STATE_NOISE**2 * np.eye(3)
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(r))
            z, P = z + gain @ (y / scale[:2] - z[:2]), P - gain @ H @ P
        else:
            z[:2] = y / scale[:2]
        found = [
            (each.update(y, np.zeros(linear.B.shape[1])) / scale - z) / np.sqrt(np.diag(P))
            for each in filters
        ]
        apart.append(np.abs(found).mean(axis=1))
        x = A @ x
    few, many = np.mean(apart, axis=0).reshape(2, 4).mean(axis=1)
    assert many < 0.15 and many < few / 2


def test_the_covariance_is_consistent():
    """Squared innovations, in standard deviations, of readings with noise: one on average."""
    estimator, found = kalman(measured=SENSORS, noise=0.005), []
    for seed in range(6):
        estimator.reset()
        psi = np.random.default_rng([seed, 1]).uniform([0.95, 0.9], [1.05, 1.1])
        for t, (_, u, y) in enumerate(simulated(estimator, psi, 60, 0.005, seed)):
            estimator.update(y, u)
            if t >= 10:
                found.append(estimator.far)
    assert np.mean(found) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("psi", [(1.0, 1.0), (1.05, 0.9), (0.96, 1.07), (1.08, 0.85)])
@pytest.mark.parametrize("kind, close", [(KalmanFilter, 0.1), (ParticleFilter, 0.15)])
def test_parameters_are_recovered(kind, close, psi):
    """In half-widths of their range, without noise; what the Kalman filter's disturbance explains is small."""
    estimator = kind(cstr)
    for x, u, y in simulated(estimator, psi, 40):  # noqa: B007
        found = estimator.update(y, u)
    np.testing.assert_allclose(found, x, atol=2e-3 * RANGE.max(), rtol=2e-2)
    np.testing.assert_allclose(estimator.shift, np.array(psi) - 1, atol=close * 0.1)
    assert not estimator.report["rejected"] and not estimator.report["restarted"]


def test_a_state_that_nobody_measures_is_found():
    for kind in BOTH.values():
        estimator, far = kind(cstr, SENSORS, 0.005), []
        for x, u, y in simulated(estimator, (1.03, 0.94), 60, 0.005):
            far.append(abs(estimator.update(y, u)[0] - x[0]))
        assert np.mean(far[-20:]) < 0.06 < 0.1 < far[0]


# Faults


@pytest.mark.parametrize("kind", BOTH.values())
def test_a_wrong_reading_is_left_out_and_reported(kind):
    estimator = kind(cstr, noise=0.002)
    for t, (x, u, y) in enumerate(simulated(estimator, (1.05, 0.9), 30, 0.002)):
        wrong = {10: (1, 1.9), 15: (2, np.nan), 20: (3, 1e12), 25: (0, -np.inf)}.get(t)
        if wrong:
            y[wrong[0]] = wrong[1]
        found = estimator.update(y, u)
        assert estimator.report["rejected"] == ((cstr.STATE_NAMES[wrong[0]],) if wrong else ())
        assert t < 5 or (np.abs(found - x) < 0.02 * RANGE).all()


@pytest.mark.parametrize("kind", BOTH.values())
def test_a_sensor_that_repeats_itself_is_left_out(kind):
    estimator = kind(cstr, SENSORS, 0.005)
    stuck = np.nan
    for t, (x, u, y) in enumerate(simulated(estimator, (1.0, 1.0), 60, 0.005)):  # noqa: B007
        y[1] = stuck = stuck if 20 <= t < 50 else y[1]
        found = estimator.update(y, u)
        assert ("T_R" in estimator.report["rejected"]) == (20 <= t < 50)
    assert abs(found[2] - x[2]) < 0.02 * 90


@pytest.mark.parametrize("kind", BOTH.values())
@pytest.mark.parametrize("seed", range(3))
def test_after_any_faults_it_is_right_within_ten_sound_steps_or_says_that_it_started_again(kind, seed):
    rng, estimator = np.random.default_rng(seed), kind(cstr, noise=0.002)
    sound, restarted = 0, True
    for x, u, y in simulated(estimator, (1.03, 1.05), 300, 0.002, seed):
        if rng.uniform() < 0.02 or 0 < -sound < 8:  # some bursts of faults
            bad = rng.uniform(size=4) < 0.7
            y[bad] = rng.choice([np.nan, np.inf, 1e300, -3.0, 0.0, 77.7], size=4)[bad]
            sound = min(sound, 0) - 1 if rng.uniform() < 0.9 else 0
        else:
            sound = max(sound, 0) + 1
        found = estimator.update(y, u)
        assert np.isfinite(found).all() and np.isfinite(estimator.shift).all()
        restarted = estimator.report["restarted"] or (restarted and sound < 15)
        if sound >= 10:
            assert (np.abs(found - x) < 0.03 * RANGE).all() or restarted


@pytest.mark.parametrize("kind", BOTH.values())
def test_a_plant_that_jumps_elsewhere_is_followed(kind):
    estimator = kind(cstr, noise=0.002)
    for _, u, y in simulated(estimator, (1.0, 1.0), 20, 0.002):
        estimator.update(y, u)
    elsewhere, restarts = np.array([1.9, 0.2, 60.0, 120.0]), 0
    for x, u, y in simulated(estimator, (1.0, 1.0), 10, 0.002, seed=5, x0=elsewhere):  # noqa: B007
        found = estimator.update(y, u)
        restarts += estimator.report["restarted"]
    assert restarts >= 1 and (np.abs(found - x) < 0.02 * RANGE).all()


def test_a_catalyst_that_loses_activity_is_noticed():
    for kind in BOTH.values():
        estimator, x, u = kind(cstr), cstr.START, np.array([20.0, -1500.0])
        for t in range(60):
            estimator.update(x, u)
            x = cstr.step(x, u := u + [0.05, 1.0], np.array([1.0, 1.0 if t < 30 else 0.9]))
        np.testing.assert_allclose(estimator.shift[1], -0.1, atol=0.02)


@pytest.mark.parametrize("kind", [Measured, *BOTH.values()])
def test_what_it_is_given_is_copied_and_a_reset_forgets(kind):
    found = []
    for careless in (False, True, False):
        if careless or not found:
            estimator = kind(cstr, mismatch_scale=cstr.MISMATCH_SCALE)
        estimator.reset()
        for _, u, y in simulated(estimator, (1.05, 0.9), 6):
            answer = estimator.update(y, u)
            if careless:
                for buffer in (y, answer):
                    buffer[:] = 7.0
        found.append(
            np.concatenate([estimator.x, estimator.shift, estimator.disturbance, estimator.mismatch])
        )
    np.testing.assert_array_equal(found[1:], found[:-1])
    estimator.reset()
    assert not (estimator.shift.any() or estimator.disturbance.any() or estimator.mismatch.any())


# What planners get


def test_sigma_points_have_the_mean_and_covariance_of_what_is_most_uncertain(monkeypatch):
    monkeypatch.setattr("envs.control.estimation.DOUBT", 0.0)
    estimator = kalman(measured=SENSORS, noise=0.005)
    for _, u, y in simulated(estimator, (1.0, 1.0), 8, 0.005):
        estimator.update(y, u)
    points, weight = estimator.points(13)  # of six unknowns: all axes
    known = estimator.P[:6, :6]
    np.testing.assert_allclose(weight @ points, estimator.z[:6], atol=1e-12)
    np.testing.assert_allclose(
        (points - estimator.z[:6]).T @ np.diag(weight) @ (points - estimator.z[:6]), known, atol=1e-12
    )
    nine, one = estimator.points(9)[0], estimator.points(1)[0]
    left = known - np.cov(nine.T, bias=True)
    assert np.linalg.eigvalsh(left)[-1] < np.linalg.eigvalsh(known)[1] * (
        1 + 1e-9
    )  # the two smallest are left out
    np.testing.assert_array_equal(one, [estimator.z[:6]])
    starts, psi, weight = estimator.belief(cstr.SCENARIOS["mpc"])
    assert starts.shape == (9, 4) and psi.shape == (9, 2) and weight.sum() == pytest.approx(1)
    assert np.ptp(starts[:, 0]) > 0.05 and (starts[0] == estimator.x).all()


def test_particles_are_grouped_into_scenarios():
    estimator = ParticleFilter(cstr, SENSORS, 0.005)
    for _, u, y in simulated(estimator, (1.0, 1.0), 8, 0.005):
        estimator.update(y, u)
    means, weight = estimator.points(9)
    assert means.shape == (9, 6) and weight.min() >= 0 and weight.sum() == pytest.approx(1)
    np.testing.assert_allclose(
        weight @ means, estimator.weight @ (estimator.particles + estimator.doubt), atol=1e-9
    )
    starts, psi, _ = estimator.belief(cstr.SCENARIOS["mpc"])
    assert np.ptp(starts[:, 0]) > 0.05 and (np.abs(psi - 1) <= FURTHEST * np.array([0.05, 0.1]) + 1e-12).all()
    certain = ParticleFilter(cstr, SENSORS, 0.005, certain=True)
    certain.update(y, u)
    np.testing.assert_array_equal(np.ptp(certain.belief(cstr.SCENARIOS["mpc"])[0], axis=0), 0)


@pytest.mark.parametrize("name", ["nominal_mpc", "rl_mpc"])
def test_no_offset_remains(name):
    """Near the goal, on a plant that the nominal model misses."""
    offsets = []
    for offset_free in (False, True):
        mpc = deploy.build_controller(name, deploy.Args(compile=False, offset_free=offset_free))
        near, psi = np.array([0.8, 0.6, 125.0, 122.0]), np.array([1.04, 0.93])
        x, _, row = run_episode(mpc, cstr, near, psi, mpc.goal, 40)
        offsets.append(abs(x[-5:, 1] / cstr.EVAL_GOAL[0] - 1).mean())
    assert offsets[1] < (0.001 if name == "nominal_mpc" else 0.004) < 0.005 < offsets[0]


def test_a_difference_that_no_parameter_explains_leaves_no_offset():
    """A leak that takes 0.004 mol/l of B and half a degree in every step."""
    offsets = []
    for offset_free in (False, True):
        mpc = deploy.build_controller("rl_mpc", deploy.Args(offset_free=offset_free))
        x = np.array([0.8, 0.6, 125.0, 122.0])
        for _ in range(60):
            x = cstr.step(x, mpc.make_step(x), cstr.PSI_NOMINAL) - [0.0, 0.004, 0.5, 0.0]
        offsets.append(abs(x[1] / cstr.EVAL_GOAL[0] - 1))
    assert offsets[1] < 0.005 < 0.02 < offsets[0]


def test_the_plan_starts_from_each_scenarios_own_state():
    mpc = deploy.build_controller(
        "rl_mpc", deploy.Args(horizon=2, compile=False, estimator="ekf", measure=SENSORS)
    )
    u = mpc.make_step([0.5, 120.0, 118.0])
    starts, psi, _ = mpc.estimator.belief(mpc.scenarios)
    for predicted, start, parameters in zip(mpc.prediction()["x"][0].T, starts, psi):
        expected = cstr.step(start, u, parameters, substeps=4) + mpc.estimator.disturbance
        np.testing.assert_allclose(predicted, expected, rtol=1e-9)
    assert np.ptp(starts[:, 0]) > 0.5  # nobody knows c_A yet


@pytest.mark.parametrize("kind", BOTH)
def test_a_hidden_state_and_noise_cost_little(kind):
    """Time near the goal, and outside, against the whole state without noise, on three draws."""
    near, outside = [], []
    for options in ({}, dict(estimator=kind, measure=("sensors",), noise=0.005)):
        mpc, (starts, psis) = deploy.build_controller("rl_mpc", deploy.Args(**options)), draws(cstr, 3, 0)
        rows = []
        for x0, psi in zip(starts, psis):
            rng = np.random.default_rng(0)
            rows.append(run_episode(mpc, cstr, x0, psi, mpc.goal, 60, options.get("noise", 0.0), rng)[2])
        near.append(np.mean([row["time_near_goal"] for row in rows]))
        outside.append(np.mean([row["time_outside_constraints"] for row in rows]))
    assert near[1] > near[0] - 2 and outside[1] > outside[0] - 2


@pytest.mark.parametrize("bad", [[0.5, 120.0], [0.5, 120.0, 118.0, 0.0], 0.5, []])
def test_measurements_of_the_wrong_length_are_refused_and_change_nothing(bad):
    args = deploy.Args(horizon=1, compile=False, offset_free=True, measure=SENSORS)
    asked, control = (deploy.build_controller("rl_mpc", args) for _ in range(2))
    for y in ([0.5, 120.0, 118.0], [0.51, 121.0, 118.5]):
        with pytest.raises(ValueError, match="c_B, T_R, T_K"):
            asked.make_step(bad)
        np.testing.assert_array_equal(asked.make_step(y), control.make_step(y))
    np.testing.assert_array_equal(asked.make_step([np.nan] * 3), control.make_step([np.inf, np.nan, -np.inf]))
    assert asked.stats["rejected"] == SENSORS


@pytest.mark.parametrize(
    "bad",
    [dict(measured=["c_X"]), dict(measured=[]), dict(noise=-1.0), dict(noise=[0.1, 0.1]), dict(noise=np.nan)],
)
@pytest.mark.parametrize("kind", BOTH.values())
def test_what_no_sensor_is_gets_a_sentence(kind, bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        kind(cstr, **bad)


def test_every_plant_has_filters():
    """The pendulum by position and angles, over a turn of them; a linear plant, of which nothing is uncertain."""
    pendulum = envs.load("double_pendulum")
    for kind in BOTH.values():
        estimator, x, psi = kind(pendulum, pendulum.MEASURED, 1e-3), pendulum.START, pendulum.PSI_NOMINAL
        mpc = deploy.ActorController(pendulum, lambda x, goal: np.zeros(1), pendulum.EVAL_GOAL, estimator)
        mpc.actor = type("Free", (), {"n_in": lambda self: 2, "__call__": lambda self, x, goal: 0.3})()
        for _ in range(40):
            y = x[estimator.measured]
            mpc.make_step((y + np.pi) % (2 * np.pi) - np.pi if _ % 2 else y)
            before, x = x, pendulum.step(x, mpc.u_before, psi)
        far = (mpc.x_before - before + np.pi * np.isin(range(6), pendulum.ANGLES)) % (2 * np.pi)
        far = far - np.pi * np.isin(range(6), pendulum.ANGLES)
        assert (np.abs(np.where(far > np.pi, far - 2 * np.pi, far)) < 0.3).all()
    plant = envs.load("linear", dim=2)
    for kind in BOTH.values():
        estimator, x = kind(plant), np.array([0.5, -0.5])
        for _ in range(5):
            found, x = estimator.update(x, np.zeros(2)), plant.A @ x
        assert estimator.belief(plant.SCENARIOS["mpc"])[1].shape == (1, 0) and np.isfinite(found).all()


def test_an_unstable_plant_is_followed_for_long():
    """The pendulum held upright by feedback of the true state: rounding errors of the covariance do not grow."""
    pendulum = envs.load("double_pendulum")
    estimator, psi, h = KalmanFilter(pendulum, pendulum.MEASURED), pendulum.PSI_NOMINAL, 1e-6
    rest, none = np.zeros(6), np.zeros(1)

    def slope(function, n):
        return np.stack([(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(n)], axis=-1)

    A, B = slope(lambda x: pendulum.step(x, none, psi), 6), slope(lambda u: pendulum.step(rest, u, psi), 1)
    P = solve_discrete_are(A, B, np.eye(6), np.eye(1))
    K = np.linalg.solve(np.eye(1) + B.T @ P @ B, B.T @ P @ A)
    x, u, rng = 0.01 * np.ones(6), none, np.random.default_rng(0)
    for _ in range(1000):
        found, before = estimator.update(x[estimator.measured] + 1e-6 * rng.normal(size=3), u), x
        u = np.clip(-K @ x, pendulum.U_LOW, pendulum.U_HIGH)
        x = pendulum.step(x, u, psi)
        assert not estimator.report["restarted"]
    np.testing.assert_allclose(found, before, atol=0.05)
    assert np.linalg.eigvalsh(estimator.P)[0] > 0


def test_parameters_stay_where_they_are_at_rest():
    """Parameters and disturbances explain a plant at rest alike: the split between them must not wander off."""
    estimator = KalmanFilter(cstr, noise=0.002)
    x, u, psi, rng = cstr.START, np.array([20.0, -1500.0]), np.array([1.03, 0.95]), np.random.default_rng(0)
    for _ in range(10_000):
        estimator.update(x + 0.002 * RANGE * rng.normal(size=4), u)
        x = cstr.step(x, u, psi)
    assert (np.abs(estimator.z[4:6]) < 1.5).all()


@pytest.mark.parametrize("kind", BOTH.values())
def test_a_sensor_that_shows_what_cannot_be_is_left_out_for_ever(kind):
    estimator = kind(cstr, noise=0.002)
    for t, (x, u, y) in enumerate(simulated(estimator, (1.02, 0.97), 60, 0.002)):
        y[1] = 1e12 + t if t >= 20 else y[1]
        found, true = estimator.update(y, u), x
        assert not estimator.report["restarted"]
    assert (np.abs(found - true) < 0.03 * RANGE).all() and estimator.report["rejected"] == ("c_B",)


@pytest.mark.parametrize("kind", BOTH.values())
def test_a_wrong_first_reading_is_forgotten_within_ten_steps(kind):
    estimator = kind(cstr, SENSORS, 0.005)
    for t, (x, u, y) in enumerate(simulated(estimator, (1.0, 1.0), 25, 0.005)):
        y[0] = 1.9 if t == 0 else y[0]
        found, true = estimator.update(y, u), x
        assert t < 11 or not estimator.report["rejected"]
    assert abs(found[1] - true[1]) < 0.03 * RANGE[1]


def test_particles_that_go_astray_are_dropped():
    """A rate with the root of a parameter: particles with a negative one are not finite."""

    class Root:
        STATE_NAMES, ANGLES, ENV_ID = ("x",), [], "Root"
        X_LOW = INIT_LOW = np.array([0.0])
        X_HIGH = INIT_HIGH = np.array([2.0])
        OBS_LOW, OBS_HIGH, U_LOW, U_HIGH = (np.array([v]) for v in (-9.0, 9.0, -1.0, 1.0))
        PSI_NOMINAL, SCENARIOS = np.array([1.0]), {"mpc": np.array([[1.0], [0.4], [1.6]])}

        def step(self, x, u, psi):
            return x + 0.1 * (u - np.sqrt(psi) * x)

    plant = Root()
    estimator, x, u = ParticleFilter(plant, noise=0.01), np.array([1.0]), np.array([0.8])
    rng, restarts = np.random.default_rng(0), 0
    for _ in range(60):
        found = estimator.update(x + 0.02 * rng.normal(size=1), u)
        restarts, before, x = restarts + estimator.report["restarted"], x, plant.step(x, u, np.array([1.3]))
    assert restarts == 0 and abs(found[0] - before[0]) < 0.05


@pytest.mark.parametrize("kind", [Measured, KalmanFilter, ParticleFilter])
def test_estimators_refuse_what_numpy_would_broadcast(kind):
    estimator = kind(cstr)
    for y, u in (
        ([1.0], cstr.U_LOW),
        (cstr.START, 5.0),
        (cstr.START, [5.0]),
        (np.tile(cstr.START, (2, 1)), cstr.U_LOW),
    ):
        with pytest.raises(ValueError, match="has shape"):
            estimator.update(np.array(y), u)
    for scale in ([1.0, 2.0], np.zeros(4)):
        with pytest.raises(ValueError, match="scale of the mismatch"):
            kind(cstr, mismatch_scale=scale)
    assert KalmanFilter(cstr, "c_B", compile=False).measured.tolist() == [1]
    with pytest.raises(ValueError, match="particles is 0"):
        ParticleFilter(cstr, particles=0)
