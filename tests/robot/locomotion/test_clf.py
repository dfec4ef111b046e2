"""The control-Lyapunov function: Riccati equation and decrease along the closed loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from romnav.robot.locomotion.clf import A, B, Clf, riccati
from romnav.robot.spec import ClfSpec

SPEC = ClfSpec()


def test_solves_the_riccati_equation() -> None:
    p, gain, _ = riccati(SPEC.rate_time, SPEC.effort)
    scale = (gain * SPEC.effort)[0, 1] / p[1, 1]
    p = p * scale
    q = np.diag([1.0, SPEC.rate_time**2])
    residual = A.T @ p + p @ A - p @ B @ B.T @ p / SPEC.effort + q
    assert residual == pytest.approx(np.zeros((2, 2)), abs=1e-9)


@given(st.floats(-1, 1), st.floats(-10, 10), st.floats(0.001, 1.0))
def test_falls_at_least_at_rate_lambda_along_the_closed_loop(error: float, rate: float, time: float) -> None:
    clf = Clf(SPEC.rate_time, SPEC.effort)
    eta = np.array([error, rate])
    later = expm((A - B @ clf.gain) * time) @ eta

    def value(e: np.ndarray) -> float:
        one = torch.tensor([[1.0]], dtype=torch.float64)
        return float(clf(one * e[0], one * e[1], torch.ones(1)))

    assert value(later) <= value(eta) * np.exp(-clf.decay * time) + 1e-6
    assert clf.decay > 1.0


def test_is_the_mean_over_outputs_in_units_of_their_tolerances() -> None:
    clf = Clf(SPEC.rate_time, SPEC.effort)
    value = clf(torch.tensor([[0.1, 0.0]]), torch.zeros(1, 2), torch.tensor([0.05, 1.0]))
    assert value.item() == pytest.approx((0.1 / 0.05) ** 2 / 2)
