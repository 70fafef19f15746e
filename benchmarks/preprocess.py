"""`fusion preprocess` on a recording: against its parts, its start, its first frame, and on Dask workers."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recordings import flight
from table import Row, Section, at_least, at_most, per_second, spread
from timing import Sample, clocked, interleaved
from workspace import FUSION, Workspace

from fusion.batch import opencv_on_one_thread
from fusion.frames import FrameSet
from fusion.lidar.lane import DepthLane
from fusion.preprocess.campaign import Route
from fusion.preprocess.config import PreprocessConfig
from fusion.preprocess.footage import Moment
from fusion.preprocess.made import Made
from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.run import preprocess
from fusion.preprocess.streams import resolve_streams
from fusion.preprocess.work import PreprocessWork, make_plan
from fusion.recordings import open_recording
from fusion.rig import load_rig
from fusion.simulate.containers import write_recording
from fusion.sinks.depth import sparse_npz
from fusion.storage import MemoryStorage

LEAST_SHARE, FIRST_FRAME_S, START_S, DASK_GAIN = 0.9, 2.0, 1.0, 1.6
POLL_S, WAIT_S = 0.005, 120.0
