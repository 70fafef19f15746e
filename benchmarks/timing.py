"""Interleaved timing: A B C A B C …, so that a machine that slows down slows all alike."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Job = Callable[[], float]  # does its work and returns the seconds that count


@dataclass(frozen=True, slots=True)
class Sample:
    """One value per round, in the order of the rounds."""

    values: tuple[float, ...]

    @property
    def median(self) -> float:
        return statistics.median(self.values)

    @property
    def quartiles(self) -> tuple[float, float]:
        if len(self.values) < 4:
            return min(self.values), max(self.values)
        first, _, third = statistics.quantiles(self.values, n=4, method="inclusive")
        return first, third

    def over(self, other: Sample) -> Sample:
        """The ratios round by round: what disturbed one round disturbed both sides of it."""
        return Sample(tuple(a / b for a, b in zip(self.values, other.values, strict=True)))

    def minus(self, other: Sample) -> Sample:
        return Sample(tuple(a - b for a, b in zip(self.values, other.values, strict=True)))

    def per(self, count: float) -> Sample:
        return Sample(tuple(value / count for value in self.values))

    def rate(self, count: float) -> Sample:
        return Sample(tuple(count / value for value in self.values))


def interleaved(jobs: Mapping[str, Job], rounds: int, warm: int = 1) -> dict[str, Sample]:
    """Run all `jobs` in turn, `rounds` times after `warm` rounds that do not count; seconds of each."""
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(warm + rounds):
        for name, job in jobs.items():
            seconds = job()
            if turn >= warm:
                taken[name].append(seconds)
    return {name: Sample(tuple(values)) for name, values in taken.items()}


def repeated(work: Callable[[], object], times: int) -> Job:
    """A job of `times` calls in a row that returns the seconds of one, without garbage collection."""

    def job() -> float:
        gc.collect()
        gc.disable()
        try:
            began = time.perf_counter()
            for _ in range(times):
                work()
            return (time.perf_counter() - began) / times
        finally:
            gc.enable()

    return job


def clocked(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
