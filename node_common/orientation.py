"""Rotation matrices and unit quaternions; importing scipy would add 0.4 s to each node's start."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def from_rpy(degrees: ArrayLike) -> Floats:
    """Return the rotation matrix of roll, pitch, yaw [deg] about the fixed axes x, y, z, shape (3,
    3).
    """
    half = np.radians(degrees) / 2
    x, y, z = (
        np.array([*(np.sin(angle) * axis), np.cos(angle)])
        for angle, axis in zip(half, np.eye(3), strict=True)
    )
    return from_quaternion(z) @ from_quaternion(y) @ from_quaternion(x)


def from_quaternion(quaternion: ArrayLike) -> Floats:
    """Return the rotation matrix of a quaternion x y z w of any norm, shape (3, 3)."""
    q = np.asarray(quaternion, float)
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(rotation: Floats) -> Floats:
    """Return the quaternion x y z w of a rotation matrix, shape (4,), from its largest component.

    Source: S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1 (1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    products = np.array(  # of each two components, times 4
        [
            [1 + xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, 1 - xx + yy - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, 1 - xx - yy + zz, yx - xy],
            [zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz],
        ]
    )
    row = products[np.argmax(np.diag(products))]
    return np.asarray(row / np.linalg.norm(row))
