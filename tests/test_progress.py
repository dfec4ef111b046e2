from __future__ import annotations

import pytest

from romnav import progress
from romnav.progress import Meter, bar, duration


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_resumed_run_is_timed_by_its_own_work() -> None:
    clock = Clock()
    meter = Meter(clock)
    meter.describe(500, 1000, "")  # what an earlier session did
    clock.now += 10.0
    assert meter.describe(600, 1000, "success 12 %") == (" 60% 600/1,000  10/s  0:10 elapsed  0:40 left  success 12 %")


def test_another_total_is_another_task() -> None:
    clock = Clock()
    meter = Meter(clock)
    meter.describe(0, 10, "")
    clock.now += 100.0
    meter.describe(0, 5000, "")
    clock.now += 1.0
    assert "100/s" in meter.describe(100, 5000, "")


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (3725, "1:02:05")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_without_a_terminal_lines_are_few_and_the_last_is_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(progress.time, "monotonic", clock)
    with bar("policy") as report:
        for done in range(1, 1001):
            clock.now += 0.1
            report(done, 1000, f"m{done}")
    lines = capsys.readouterr().err.splitlines()
    assert 10 <= len(lines) <= 12
    assert lines[-1].startswith("policy  100% 1,000/1,000")
    assert lines[-1].endswith("m1000")


def test_on_a_terminal_a_bar_shows_the_metric(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with bar("policy [rom]") as report:
        report(3, 10, "success 5 %")
    shown = capsys.readouterr().err
    assert "policy [rom]" in shown
    assert "3/10" in shown
    assert "success 5 %" in shown


@pytest.mark.parametrize("width", [80, 60])
def test_a_narrow_terminal_shows_which_arm_runs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", str(width))
    metric = "success 51% (same 62%, cross 40%), a long tale of many more numbers"
    with bar("policy uniform-nocap, seed 0") as report:
        report(1_572_864, 50_331_648, metric)
    assert "policy uniform-nocap, seed 0" in capsys.readouterr().err
    with progress.lines(["a"]) as show:
        show("a", f"policy uniform-nocap, seed 0  {metric}  {metric}")
    shown = capsys.readouterr().err
    assert "policy uniform-nocap, seed 0" in shown
    assert all(len(line) <= 3 * width for line in shown.splitlines())
