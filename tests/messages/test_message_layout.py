"""Plans against rosbags' serialiser where alignment decides: behind texts and arrays of any length."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from fusion.messages.definitions import parse
from fusion.messages.layout import Want, plan_of
from fusion.messages.make import point_fields
from tests.messages.samples import WIRES, made, ros_of, sent, store

TEXT = (
    "string text\nfloat64[] numbers\nuint8 small\nint64[] passed\nint16 middle\nuint8[] data\nfloat64 last\n"
)
NAME = "layout_msgs/msg/Mixed"


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize(
    "wanted", [("numbers", "middle", "data", "last"), ("last",), ("text", "small", "last")]
)
def test_values_behind_texts_and_arrays_of_any_length(wire: str, wanted: tuple[str, ...]) -> None:
    ros = ros_of(wire)
    if NAME not in store(ros).types:
        store(ros).register(get_types_from_msg(TEXT, NAME))
    kinds = {"numbers": "numbers", "middle": "integer", "data": "bytes", "last": "number", "text": "text"}
    wants = {name: Want(kinds.get(name, "integer")) for name in wanted}
    definitions = parse(f"ros{ros}msg", NAME, TEXT.encode())
    order = ">" if wire == "cdr big" else "<"
    plan = plan_of(definitions, "layout_msgs/Mixed", wants, order=order, cdr=ros == 2)
    for letters, n, passed, size in itertools.product(range(9), (0, 1, 3), (0, 2), (0, 3)):
        values: dict[str, Any] = {
            "text": "x" * letters,
            "numbers": np.arange(n) + 0.5,
            "small": 7,
            "middle": -3,
            "last": 2.5,
            "passed": np.arange(passed),
            "data": np.arange(size, dtype=np.uint8),
        }
        data = sent(wire, made(wire, NAME, **values))
        found: list[Any] = []
        end = plan.walk(memoryview(data)[0 if ros == 1 else 4 :], 0, found)
        expected = {**values, "numbers": tuple(values["numbers"]), "data": values["data"].tobytes()}
        assert found == [expected[name] for name in plan.paths]
        assert end == len(data) - (0 if ros == 1 else 4)


def test_a_field_of_a_point_has_at_least_one_number() -> None:
    assert [field.count for field in point_fields((("x", 0, 7, 0), ("y", 4, 7, 3)), "ros")] == [1, 3]
