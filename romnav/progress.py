"""Progress of a long stage: a bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Column

Progress = Callable[[int, int, str], None]
"""What a long computation is given to report on itself: (units done, units in all, text of its metric)."""

PLAIN_INTERVAL = 10.0
"""Time between two lines where there is no terminal, s."""


class Meter:
    """Rate and time left, measured from the first report, so that a resumed run counts its own work only."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._started = clock()
        self._first: tuple[float, int, int] | None = None

    def describe(self, done: int, total: int, metric: str) -> str:
        """One line: share, units, rate, time elapsed, time left and the metric."""
        now = self._clock()
        if self._first is None or self._first[2] != total:  # another total is another task
            self._first = (now, done, total)
        start, before, _ = self._first
        rate = (done - before) / (now - start) if now > start else 0.0
        left = duration((total - done) / rate) if rate > 0 else "?"
        share = f"{done / total:4.0%}" if total else "   ?"
        parts = [
            f"{share} {done:,}/{total:,}",
            f"{rate:,.0f}/s" if rate >= 10 else f"{rate:.2g}/s",
            f"{duration(now - self._started)} elapsed",
            f"{left} left",
            metric,
        ]
        return "  ".join(part for part in parts if part)


def duration(seconds: float) -> str:
    """Seconds as m:ss or h:mm:ss."""
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


@contextmanager
def bar(title: str) -> Iterator[Progress]:
    """Shows the progress of one stage on standard error."""
    meter = Meter()
    if not sys.stderr.isatty():
        yield _plain(title, meter)
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bars
    from rich.table import Column

    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, min_width=len(title))),
        BarColumn(12),
        TextColumn("{task.fields[text]}", markup=False, table_column=_rest()),
    )
    with Bars(*columns, console=Console(stderr=True), expand=True) as bars:
        task = bars.add_task(title, total=None, text="")
        yield lambda done, total, metric: bars.update(
            task, completed=done, total=total, text=meter.describe(done, total, metric)
        )


def _plain(title: str, meter: Meter) -> Progress:
    last = -PLAIN_INTERVAL

    def report(done: int, total: int, metric: str) -> None:
        nonlocal last
        line = meter.describe(done, total, metric)
        if done >= total or time.monotonic() - last >= PLAIN_INTERVAL:
            last = time.monotonic()
            _tell(f"{title}  {line}")

    return report


def _tell(line: str) -> None:
    """Prints to standard error; that nobody reads there any more stops no run."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


def _rest() -> Column:
    """A column of the terminal's remaining width, its text cut at the end rather than wrapped."""
    from rich.table import Column

    return Column(ratio=1, no_wrap=True, overflow="ellipsis")


@contextmanager
def lines(names: Sequence[str]) -> Iterator[Callable[[str, str], None]]:
    """Shows the latest line of each of several concurrent stages on standard error: (name, line)."""
    if not sys.stderr.isatty():
        yield lambda name, line: _tell(line)
        return
    from rich.console import Console
    from rich.progress import Progress as Bars
    from rich.progress import SpinnerColumn, TextColumn

    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False, table_column=_rest())
    with Bars(*columns, console=Console(stderr=True), expand=True) as bars:
        tasks = {name: bars.add_task(name, total=None) for name in names}
        yield lambda name, line: bars.update(tasks[name], description=line)
