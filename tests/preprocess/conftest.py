"""An object store on this machine, and the environment that leads to it."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

KEYS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """The URL of a store that speaks S3, with the buckets ``input`` and ``output``; this process is led
    there.
    """
    server = pytest.importorskip("moto.server").ThreadedMotoServer(
        ip_address="127.0.0.1", port=0, verbose=False
    )
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    before = dict(os.environ)
    os.environ.update(KEYS, AWS_ENDPOINT_URL=endpoint)
    try:
        import s3fs

        store = s3fs.S3FileSystem()
        store.mkdir("input")
        store.mkdir("output")
        yield endpoint
    finally:
        os.environ.clear()
        os.environ.update(before)
        server.stop()
