"""Random linear systems (section app:LQ-GC) and the discounted linear-quadratic regulator (section app:lqr)."""

import numpy as np

SPECTRAL_RADIUS = 1.1  # at most
SINGULAR_VALUE_MIN = 0.1  # of tanh(D), so that A has an inverse that is not huge
CONDITION_MAX = 10.0  # of L at off_diagonal = 1; another is drawn where it is larger


def random_matrix(n, rng, off_diagonal=1.0, entries="symmetric"):
    """A random (n, n) matrix with spectral radius at most 1.1 and the L that made it (section app:LQ-GC).

    M = U tanh(D) V' from the singular value decomposition of a matrix with entries uniform in [-1, 1] ("symmetric") or in [0, 1]
    ("positive"), its singular values clipped and scaled to [0.11, 1.1]; then A = L^-1 M L. What the paper leaves open: the triangular L
    has entries uniform in [-off_diagonal, off_diagonal] / sqrt(n) below a diagonal uniform in [0.5, 1.5], and a condition number of at
    most 10. With entries that do not shrink with n, L and with it the norm of A grow without bound (a median norm of 4e6 at n = 32).
    """
    u, d, vt = np.linalg.svd(rng.uniform(-1 if entries == "symmetric" else 0, 1, size=(n, n)))
    m = u @ np.diag(SPECTRAL_RADIUS * np.clip(np.tanh(d), SINGULAR_VALUE_MIN, 1)) @ vt
    while True:
        below = np.tril(rng.uniform(-off_diagonal, off_diagonal, size=(n, n)) / np.sqrt(n), -1)
        transform = below + np.diag(rng.uniform(0.5, 1.5, size=n))
        if np.linalg.cond(transform) <= CONDITION_MAX * max(1, off_diagonal) ** 2:
            return np.linalg.solve(transform, m @ transform), transform


def bellman_step(a, b, m, r, gamma, p):
    """One value iteration: (P, K) that minimise x'Mx + u'Ru + gamma (Ax + Bu)' p (Ax + Bu) over u = -K x (eq:bellmanLQR)."""
    k = gamma * np.linalg.solve(r + gamma * b.T @ p @ b, b.T @ p @ a)
    closed = a - b @ k
    return m + k.T @ r @ k + gamma * closed.T @ p @ closed, k


def discounted_lqr(a, b, m, r, gamma=1.0):
    """P and K of min sum gamma^t (x'Mx + u'Ru), u = -K x: the solution of the discounted Riccati equation of section app:lqr.

    It is the undiscounted one of sqrt(gamma) A, sqrt(gamma) B. The closed loop A - B K need only be stable when multiplied by
    sqrt(gamma): as gamma goes to 0, so does K.
    """
    from scipy.linalg import solve_discrete_are

    p = solve_discrete_are(np.sqrt(gamma) * a, np.sqrt(gamma) * b, m, r)
    return p, bellman_step(a, b, m, r, gamma, p)[1]
