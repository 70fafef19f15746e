"""Rows of a picture shared out among threads, for compiled loops that release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def in_bands(work: Callable[[int, int], Any], rows: int, threads: int) -> None:
    """`work(first, last)` for bands of rows, one a thread."""
    bands = max(1, min(threads, rows))
    edges = [rows * i // bands for i in range(bands + 1)]
    in_threads([lambda i=i: work(edges[i], edges[i + 1]) for i in range(bands)])


def in_threads(jobs: list[Callable[[], Any]]) -> None:
    """Run the jobs, the first in this thread; no pool outlives the call."""
    with ThreadPoolExecutor(max(1, len(jobs) - 1)) as pool:
        others = [pool.submit(job) for job in jobs[1:]]
        jobs[0]()
        for other in others:
            other.result()
