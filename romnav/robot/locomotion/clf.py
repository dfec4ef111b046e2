"""Control-Lyapunov function of the tracking error: V = eta' P eta, P from the Riccati equation.

Every output is a double integrator, eta = (error, error rate); with Q and R one 2 x 2 solution serves all
outputs, each scaled by its tolerance. Along the closed loop u = -R^-1 B' P eta, dV/dt = -eta' (Q + P B R^-1 B' P) eta,
so V falls at least at the rate lambda = min eig(Q) / max eig(P) (Ames et al. 2014; CLF-RL).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_continuous_are
from torch import Tensor

A = np.array([[0.0, 1.0], [0.0, 0.0]])
B = np.array([[0.0], [1.0]])


def riccati(rate_time: float, effort: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """P of the double integrator, its feedback gain and the decay rate of V, 1/s.

    Args:
        rate_time: s; Q = diag(1, rate_time^2).
        effort: R, s^4.

    Returns:
        P (2, 2), normalised to P[0, 0] = 1; the gain K (1, 2) of u = -K eta; lambda.
    """
    q = np.diag([1.0, rate_time**2])
    p = solve_continuous_are(A, B, q, np.array([[effort]]))
    gain = B.T @ p / effort
    decay = float(eigh(q, p, eigvals_only=True)[0])
    return p / p[0, 0], gain, decay


class Clf:
    """V of batches of outputs.

    Attributes:
        p: (2, 2).
        decay: lambda, 1/s.
    """

    def __init__(self, rate_time: float, effort: float) -> None:
        p, self.gain, self.decay = riccati(rate_time, effort)
        self.p = torch.tensor(p, dtype=torch.float32)

    def __call__(self, error: Tensor, rate: Tensor, tolerance: Tensor) -> Tensor:
        """Mean over outputs of eta' P eta, (n,), from errors and rates (n, k) in units of tolerances (k,)."""
        e, r = error / tolerance, rate / tolerance
        return (self.p[0, 0] * e**2 + 2 * self.p[0, 1] * e * r + self.p[1, 1] * r**2).mean(-1)
