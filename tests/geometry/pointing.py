"""By how many degrees cameras see an object in the wrong place."""

import numpy as np

from visdom_plugin.geometry.cameras import Cameras


def pointing_error(cameras: Cameras, true: Cameras, points: np.ndarray) -> np.ndarray:
    """(N,) mean degrees between where each camera sees the object's points and where the true one does.

    The points may first be turned, moved and scaled together as fits best: what is left blurs a reconstruction.
    """

    def directions(seen: Cameras, where: np.ndarray) -> np.ndarray:
        motion = seen.world_from_camera.double().numpy()
        local = np.einsum("npc,ncd->npd", where[None] - motion[:, None, :3, 3], motion[:, :3, :3])
        return local / np.linalg.norm(local, axis=-1, keepdims=True)

    reference, middle = directions(true, points), points.mean(0)
    size = np.linalg.norm(points - middle, axis=1).mean()

    def difference(change: np.ndarray) -> np.ndarray:
        w = change[:3]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        turn = np.linalg.solve(np.eye(3) - cross / 2, np.eye(3) + cross / 2)  # Cayley
        return (
            directions(cameras, middle + change[3:6] * size + (1 + change[6]) * (points - middle) @ turn.T)
            - reference
        )

    change = np.zeros(7)
    for _ in range(4):
        now = difference(change).ravel()
        slope = np.stack([(difference(change + 1e-6 * e).ravel() - now) / 1e-6 for e in np.eye(7)], -1)
        change = change - np.linalg.lstsq(slope, now, rcond=None)[0]
    return np.degrees(np.linalg.norm(difference(change), axis=-1)).mean(1)
