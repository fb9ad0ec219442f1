"""Poses of cameras: evenly spread directions, look-at matrices and rotations about an axis."""

import math

import numpy as np

#: Angle between neighbours on a Fibonacci lattice: the golden angle.
GOLDEN = math.pi * (3 - math.sqrt(5))


def sphere_directions(views: int, test: int, low: float, high: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors ``(views, 3)`` and ``(test, 3)``, spread evenly between two elevations (radians); z is up.

    Both are Fibonacci lattices. The seed gives the angle by which the first is turned about the axis; the second is
    turned so that its smallest distance to the first is as large as possible.
    """
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    train = _lattice(views, low, high, turn)
    turned = [_lattice(test, low, high, turn + t) for t in np.linspace(0, 2 * np.pi, 90, endpoint=False)]
    if not test:
        return train, turned[0]
    return train, max(turned, key=lambda candidate: np.arccos(np.clip(candidate @ train.T, -1, 1)).min())


def orbit_directions(views: int, test: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors ``(views, 3)`` and ``(test, 3)`` of a closed orbit around z between two elevations.

    Elevations are radians. Test directions lie between the others, as evenly as their numbers allow.
    """
    between = (np.floor((np.arange(test) + 0.5) * views / max(test, 1)) + 0.5) / views
    azimuths = (2 * np.pi * turns for turns in (np.arange(views) / views, between))
    train, tests = (_unit(a, (low + high) / 2 - (high - low) / 2 * np.cos(a)) for a in azimuths)
    return train, tests


def _lattice(count: int, low: float, high: float, turn: float) -> np.ndarray:
    i = np.arange(count)
    z = math.sin(low) + (math.sin(high) - math.sin(low)) * (i + 0.5) / max(count, 1)
    return _unit(GOLDEN * i + turn, np.arcsin(z))


def _unit(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def upright_frame(up) -> np.ndarray:
    """Return a rotation ``(3, 3)`` that takes z to ``up``; with y up, azimuth 0 is z and grows towards x."""
    z = np.array(up, np.float64) / np.linalg.norm(up)
    y = np.eye(3)[(int(np.argmax(np.abs(z))) + 2) % 3]
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def pose(origin: np.ndarray, target: np.ndarray, up) -> np.ndarray:
    """Return camera to world, ``(4, 4)``, of a camera at ``origin`` that looks at ``target`` along its −z; y is up."""
    z = (origin - target) / np.linalg.norm(origin - target)
    x = np.cross(np.array(up, np.float64) / np.linalg.norm(up), z)
    if np.linalg.norm(x) < 1e-6:  # straight from above or below
        x = upright_frame(up)[:, 0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3] = np.stack([x, np.cross(z, x), z, origin], axis=1)
    return matrix


def rotation(axis, degrees: float, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the rotation about ``axis`` through the point ``centre``, ``(4, 4)`` (Rodrigues)."""
    unit = np.array(axis, np.float64) / np.linalg.norm(axis)
    k, angle = np.cross(np.eye(3), unit), np.radians(degrees)
    matrix, centre = np.eye(4), np.array(centre, np.float64)
    matrix[:3, :3] += np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    matrix[:3, 3] = centre - matrix[:3, :3] @ centre
    return matrix
