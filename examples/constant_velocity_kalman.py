"""The constant-velocity Kalman filter that filterpy's documentation starts with: positions in, belief out."""

import numpy as np

from flowgraph import Scalar, Stream, block, delay, graph, simulate


@block
def kalman(belief, z: Scalar):
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q, R = 0.1 * np.outer([0.005, 0.1], [0.005, 0.1]), 5.0
    x, P = F @ belief[0], F @ belief[1] @ F.T + Q
    K = P @ H.T / (H @ P @ H.T + R)
    return x + K @ (z - H @ x), (np.eye(2) - K @ H) @ P


@graph
def constant_velocity(z: Stream[Scalar]):
    belief = delay((np.array([2.0, 0.0]), 1000.0 * np.eye(2)), name="belief")
    posterior = kalman(belief, z)
    belief.feed(posterior)
    return posterior


print(simulate(constant_velocity.build(), {"z": (np.arange(50) * 10**9, np.arange(50.0))}).output["0"][-1])
