"""What a second of a calibration is: of work, whatever else the machine does, unless it gives next to nothing."""

import time

import pytest
import torch

from ttscompile.calibration.clock import Clock


class Machine:
    """A wall clock and the processor time that this process was given, set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
        self.wall = self.work = 100.0
        monkeypatch.setattr(time, "monotonic", lambda: self.wall)
        monkeypatch.setattr(time, "process_time", lambda: self.work)
        monkeypatch.setattr(torch, "get_num_threads", lambda: threads)

    def go_on(self, wall: float, work: float) -> None:
        self.wall, self.work = self.wall + wall, self.work + work


@pytest.mark.parametrize(
    ("wall", "work", "seconds"),
    [
        (60.0, 240.0, 60.0),  # four threads compute all the time
        (90.0, 240.0, 60.0),  # and the same on a machine that does something else for a third of the time
        (60.0, 60.0, 30.0),  # work for one thread: no slower than half of the wall clock
        (600.0, 0.0, 300.0),
        (60.0, 300.0, 60.0),  # threads that are not torch's
    ],
)
def test_work_counts_and_waiting_does_not(
    monkeypatch: pytest.MonkeyPatch, wall: float, work: float, seconds: float
) -> None:
    machine = Machine(monkeypatch, threads=4)
    clock, other = Clock(100.0, before=7.0), Clock(100.0, wall=True)
    machine.go_on(wall, work)
    assert clock.elapsed() == pytest.approx(7 + seconds)
    assert clock.until(0.5).left() == pytest.approx(50 - 7 - seconds)
    assert other.elapsed() == pytest.approx(wall)


def test_what_takes_too_long_is_cut_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    machine, done = Machine(monkeypatch, threads=1), list[int]()
    clock = Clock(10.0)
    for part in clock.in_time(range(5)):
        done.append(part)
        machine.go_on(6.0, 3.0)
    assert done == [0, 1, 2] and clock.left_out
    roomy = Clock(16.0)
    for _ in roomy.in_time(range(5)):
        machine.go_on(6.0, 3.0)
    assert not roomy.left_out


def test_a_search_ends_early_enough_for_what_has_to_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever share of the time it has; and says what it left out."""
    machine = Machine(monkeypatch, threads=1)
    clock = Clock(100.0)
    share = clock.until(0.9)
    clock.ahead += [lambda: 25.0, lambda: 5.0]
    assert (clock.left(), share.left(), share.until(0.5).left()) == (70, 70, 45)
    machine.go_on(60.0, 60.0)
    assert share.has(10.0) and not clock.left_out
    assert not share.has(11.0, "three steps") and not clock.has(12.0, "three steps") and not share.has(13.0)
    assert clock.left_out == ["three steps", "a longer search"]
