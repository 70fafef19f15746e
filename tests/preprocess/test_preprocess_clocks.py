"""A recording whose thermal clock is off: found from its pictures, and used."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fusion.errors import UsageError
from fusion.messages.base import Header, RawImage
from fusion.preprocess.clocks import clock_of
from fusion.preprocess.config import PreprocessConfig, StreamsConfig
from fusion.preprocess.recorded import RecordedFootage
from fusion.preprocess.streams import resolve_streams
from fusion.recordings import open_recording
from fusion.simulate.container_writers import open_writer
from tests.cli.conftest import Answer
from tests.cli.conftest import fusion as fusion
from tests.timing.drawn import Clock, pictures, times, wobble

OFF = Clock(offset_s=0.412)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """14 s of a wall before two cameras that turn together; the thermal clock is 412 ms ahead."""
    out, turning, messages = tmp_path_factory.mktemp("clocks") / "wall.mcap", wobble(3), []
    for topic, encoding, rate_hz, clock in (
        ("/rgb", "bgr8", 20.0, Clock()),
        ("/thermal", "mono16", 25.0, OFF),
    ):
        seconds = times(rate_hz, 14.0)
        drawn = pictures(turning, seconds, seed=len(topic), thermal=encoding == "mono16")
        logs = Clock().stamps(seconds) + 10_000_000
        for stamp, log, pixels in zip(clock.stamps(seconds), logs, drawn, strict=True):
            h, w = pixels.shape[:2]
            header = Header(int(stamp), topic[1:])
            data = np.ascontiguousarray(pixels).tobytes()
            messages.append((int(log), topic, RawImage(header, w, h, encoding, False, len(data) // h, data)))
    with open_writer(out, "mcap-ros2", "none") as writer:
        for sequence, (log, topic, message) in enumerate(sorted(messages, key=lambda each: each[:2])):
            writer.write(topic, message, log, sequence)
    return out


def test_the_offset_is_found_as_a_rig_would_say_it(recording: Path) -> None:
    with closing(open_recording(recording)) as opened:
        streams, _ = resolve_streams(opened, StreamsConfig())
    with closing(RecordedFootage(str(recording), streams)) as footage:
        found = clock_of(footage)
    # The drawn thermal camera has no lag, and 10 ms of time constant are taken off: 7 ms.
    assert abs(found.offset_ns - found.lag_ns + 412_000_000) < 5_000_000


def test_the_command_says_and_uses_it(fusion: Callable[..., Answer], recording: Path, tmp_path: Path) -> None:
    done = fusion("preprocess", recording, "-o", tmp_path / "out", "--estimate-clock", "--tolerance-ms", 25)
    assert done.code == 0, done.err
    assert "note: clock: thermal -40" in done.out
    lines = (tmp_path / "out" / "frames.csv").read_text().splitlines()
    names = lines[0].split(",")
    apart = [abs(int(line.split(",")[names.index("fir_dt_ns")])) for line in lines[1:]]
    assert len(apart) > 250
    assert max(apart) <= 25_000_000


def test_a_clock_is_given_or_estimated() -> None:
    with pytest.raises(UsageError, match="given and to be estimated"):
        PreprocessConfig.of(streams={"estimate_clock": True, "fir_offset_ms": 3.0})
