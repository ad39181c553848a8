"""The double pendulum's energies, for the paper's expert, and its film."""

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from envs import double_pendulum as plant
from envs.script.figure import new_figure


def kinetic_energy(x, psi=plant.PSI_NOMINAL, xp=np):
    """Kinetic energy in J, x (6, ...) -> (...)."""
    cart, rod_1, rod_2 = plant.masses(psi)
    velocity, omega_1, omega_2 = x[3], x[4], x[5]
    sin_1, cos_1, sin_2, cos_2 = xp.sin(x[1]), xp.cos(x[1]), xp.sin(x[2]), xp.cos(x[2])
    across_1, along_1 = velocity + plant.CENTRE_1 * omega_1 * cos_1, plant.CENTRE_1 * omega_1 * sin_1
    across_2 = velocity + plant.LENGTH_1 * omega_1 * cos_1 + plant.CENTRE_2 * omega_2 * cos_2
    along_2 = plant.LENGTH_1 * omega_1 * sin_1 + plant.CENTRE_2 * omega_2 * sin_2
    translation = cart * velocity**2 + rod_1 * (across_1**2 + along_1**2) + rod_2 * (across_2**2 + along_2**2)
    return 0.5 * (
        translation
        + rod_1 * plant.LENGTH_1**2 / 12 * omega_1**2
        + rod_2 * plant.LENGTH_2**2 / 12 * omega_2**2
    )


def potential_energy(x, psi=plant.PSI_NOMINAL, xp=np):
    """Potential energy in J, zero with both rods level, x (6, ...) -> (...)."""
    _, rod_1, rod_2 = plant.masses(psi)
    height_1, height_2 = (
        plant.CENTRE_1 * xp.cos(x[1]),
        plant.LENGTH_1 * xp.cos(x[1]) + plant.CENTRE_2 * xp.cos(x[2]),
    )
    return plant.GRAVITY * (rod_1 * height_1 + rod_2 * height_2)


def skeleton(x):
    """Cart, joint and tip in the plane, m, for drawing: x (..., 6) -> (..., 3, 2)."""
    x = np.asarray(x)
    cart = np.stack([x[..., 0], 0 * x[..., 0]], axis=-1)
    joint = cart + plant.LENGTH_1 * np.stack([np.sin(x[..., 1]), np.cos(x[..., 1])], axis=-1)
    tip = joint + plant.LENGTH_2 * np.stack([np.sin(x[..., 2]), np.cos(x[..., 2])], axis=-1)
    return np.stack([cart, joint, tip], axis=-2)


def animate(x, u, predicted, goals, path, every=2):
    """GIF of the motion in real time, a frame per `every` steps; the predicted motion is drawn faintly, the goal dotted.

    x (steps + 1, 6), u (steps, 1), predicted (steps, N + 1, 6), goals (steps, 2).
    """
    figure = new_figure(figsize=(6, 3.9), layout="constrained")
    ax = figure.subplots()
    (ghosts,) = ax.plot([], [], color="#56B4E9", lw=1, alpha=0.6)
    (target,) = ax.plot([], [], ":", color="#CC79A7", lw=3)
    (rods,) = ax.plot([], [], "-o", color="#0072B2", lw=4, ms=6)
    (cart,) = ax.plot([], [], "s", color="black", ms=16)
    (force,) = ax.plot([], [], color="#D55E00", lw=5)
    clock = ax.text(0.02, 0.93, "", transform=ax.transAxes)
    names = {"rods": rods, "prediction": ghosts, "goal": target, "force": force}
    ax.legend(names.values(), names.keys(), loc="upper right", ncols=4, fontsize=8, frameon=False)
    ax.set(ylim=(-1.2, 1.5), aspect="equal", xlabel="position [m]", yticks=[])
    ax.axhline(0, color="grey", lw=1, zorder=0)
    for end in (plant.X_LOW[0], plant.X_HIGH[0]):
        ax.plot([end, end], [-0.35, 0.35], color="black", lw=4)  # the track's ends
    # the camera follows the cart
    view = np.convolve(np.pad(skeleton(x)[:, 0, 0], 12, mode="edge"), np.ones(25) / 25, mode="valid")

    def draw(t):
        points = skeleton(x[t])
        step = max(predicted.shape[1] // 12, 1)
        faint = skeleton(predicted[t, ::step])
        ghosts.set_data(*np.concatenate([np.vstack([p, [[np.nan, np.nan]]]) for p in faint]).T)
        aim = x[t].copy()
        aim[plant.GOAL_INDEX] = goals[t]
        target.set_data(*skeleton(aim).T)
        rods.set_data(*points.T)
        cart.set_data(points[:1, 0], points[:1, 1])
        force.set_data([points[0, 0], points[0, 0] + 0.15 * u[t, 0]], [-0.2, -0.2])
        ax.set_xlim(view[t] - 2.2, view[t] + 2.2)
        clock.set_text(f"t = {t * plant.DT:4.1f} s")

    writer = PillowWriter(fps=round(1 / (every * plant.DT), 2))
    FuncAnimation(figure, draw, frames=range(0, len(u), every)).save(path, writer=writer, dpi=80)
