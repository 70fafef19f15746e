"""Names below a root: the same promises by a folder, by memory and by an object store."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import FusionError, InputError, OutputError, UsageError
from fusion.storage import FsspecStorage, LocalFolder, RunStorage, checked_name, open_storage

OUTSIDE = ["../x", "a/../../x", "/etc/x", "a/..", "..", "c:/x", "C:x"]
NO_NAMES = ["", "a//b", "a/", "./a", "a/.", "a\nb", "a\x00b", "a\x85b", "a\\b", "\ud800", f".{'0a' * 16}.tmp"]
LEFTOVER = f".{'0f' * 16}.tmp"


@pytest.fixture(params=["folder", "memory", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> RunStorage:
    if request.param == "s3":
        request.getfixturevalue("s3_endpoint")
    memory = f"memory://{uuid.uuid4().hex}"
    place = {"folder": str(tmp_path / "out"), "memory": memory, "s3": "s3://output/storage"}
    store = open_storage(place[request.param])
    for name in store.names(""):
        store.remove(name)
    return store


def test_what_is_written_is_there_by_its_name(store: RunStorage) -> None:
    files = {"a.txt": b"", "b/c.bin": bytes(range(256)), "b/d/e é &?#%20+.png": b"x" * 70_000, "b.txt": b"1"}
    assert store.names("") == []
    for name, data in files.items():
        store.write(name, data)
    assert {name: store.read(name) for name in files} == files
    assert {name: store.size(name) for name in files} == {name: len(data) for name, data in files.items()}
    assert store.names("") == sorted(files)
    assert store.sizes("") == {name: len(files[name]) for name in sorted(files)}
    assert store.names("b") == ["b/c.bin", "b/d/e é &?#%20+.png"]  # and not b.txt
    assert store.names("nowhere") == store.names("a.txt") == []


def test_a_file_is_replaced_and_removed(store: RunStorage) -> None:
    store.write("a/b", b"before")
    store.write("a/b", b"now")
    assert (store.read("a/b"), store.size("a/b")) == (b"now", 3)
    store.remove("a/b")
    store.remove("a/b")
    assert (store.size("a/b"), store.size("a"), store.names("")) == (None, None, [])
    with pytest.raises(InputError, match=r"a/b.*cannot be read"):
        store.read("a/b")


def test_it_travels_as_its_url(store: RunStorage) -> None:
    store.write("a", b"1")
    there = pickle.loads(pickle.dumps(store))
    assert there.url == store.url
    assert there.read("a") == b"1"


def test_another_process_or_thread_is_seen_at_once(store: RunStorage) -> None:
    """Listings are not remembered: what somebody else wrote after the first one is in the second."""
    other = open_storage(store.url)
    for count in range(3):
        other.write(f"f/{count}", b"1")
        assert len(list(store.names("f"))) == count + 1
        assert store.size(f"f/{count}") == 1
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda count: store.write(f"g/{count:02d}/x", b"%d" % count), range(40)))
    assert [store.read(name) for name in store.names("g")] == [b"%d" % count for count in range(40)]


@pytest.mark.parametrize("name", [*OUTSIDE, *NO_NAMES])
def test_no_name_leads_out(store: RunStorage, name: str) -> None:
    calls: list[Callable[[], object]] = [lambda: store.write(name, b""), lambda: store.read(name)]
    calls += [lambda: store.size(name), lambda: store.remove(name)]
    for call in calls:
        with pytest.raises(OutputError, match="the name"):
            call()


@given(st.text(max_size=12) | st.lists(st.sampled_from([".", "..", "", "a", "c:", "~"])).map("/".join))
def test_a_name_that_passes_stays_inside(name: str) -> None:
    try:
        checked_name(name)
    except OutputError:
        return
    root = Path("/root/of/run")
    path = Path(os.path.normpath(root / name))
    assert root in path.parents
    assert path.relative_to(root).as_posix() == name


def test_urls_that_cannot_be(tmp_path: Path) -> None:
    for url in ("nosuch://x", "s3://", "memory://", "simplecache::s3://b/x", "", "a\x00b"):
        with pytest.raises(UsageError):
            open_storage(url)
    assert isinstance(open_storage(f"file://{tmp_path}/a"), LocalFolder)
    assert open_storage(f"file://{tmp_path}/a").url == open_storage(tmp_path / "a").url == f"{tmp_path}/a"
    assert isinstance(open_storage("memory://a/"), FsspecStorage)
    assert (open_storage("memory://a/").shared, open_storage(tmp_path).shared) == (False, True)


def test_a_store_that_does_not_answer_is_one_line(s3_endpoint: str) -> None:
    store = open_storage("s3://nobucket/run")
    calls: list[Callable[[], object]] = [lambda: store.write("a", b""), lambda: store.read("a")]
    for call in calls:
        with pytest.raises(FusionError) as caught:
            call()
        assert "s3://nobucket/run/a" in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1
    assert store.size("a") is None


def test_what_another_machine_put_is_seen(s3_endpoint: str) -> None:
    import s3fs

    store, other = open_storage("s3://output/two"), s3fs.S3FileSystem(skip_instance_cache=True)
    for count in range(2):
        assert len(list(store.names(""))) == len(store.sizes("f")) == count
        assert store.size(f"f/{count}") is None
        other.pipe_file(f"output/two/f/{count}", b"1")
        assert store.size(f"f/{count}") == 1


def test_the_endpoint_is_fsspecs_own_configuration(s3_endpoint: str) -> None:
    code = "from fusion.storage import open_storage; open_storage('s3://output/by-env').write('a', b'1')"
    environment = {name: value for name, value in os.environ.items() if name != "AWS_ENDPOINT_URL"}
    environment |= {"FSSPEC_S3_ENDPOINT_URL": s3_endpoint}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, capture_output=True)
    assert open_storage("s3://output/by-env").read("a") == b"1"


# --- folders


def test_a_folder_takes_other_files_for_none_of_its_own(tmp_path: Path) -> None:
    store = open_storage(tmp_path)
    store.write("a/b", b"1")
    (tmp_path / "a" / LEFTOVER).write_bytes(b"half")
    (tmp_path / "notes.tmp").write_bytes(b"the user's own")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    assert store.names("") == ["a/b", "notes.tmp"]
    assert store.size("pipe") is None
    assert store.clean() == 1
    assert store.clean() == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "dangling", "notes.tmp", "pipe"]
    assert not (tmp_path / "a" / LEFTOVER).exists()


def test_a_part_of_the_folder_may_lie_on_another_disk(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out/fused").symlink_to(tmp_path / "disk")
    store = open_storage(tmp_path / "out")
    store.write("fused/a", b"1")
    assert store.sizes("") == {"fused/a": 1}
    assert (tmp_path / "disk/a").read_bytes() == b"1"


def test_nothing_but_the_file_is_left(tmp_path: Path) -> None:
    store = open_storage(tmp_path)
    store.write("a", b"1")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="folder"):
        store.write("folder", b"1")
    with pytest.raises(OutputError):
        store.write("n" * 300, b"1")
    with pytest.raises(OutputError):
        store.write("a/b", b"1")  # a is a file
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "folder"]
    assert (store.size("a/b"), store.size("folder")) == (None, None)
    store.remove("a/b")
    with pytest.raises(OutputError):
        store.remove("folder")


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    """Even when two write it: a chunk may be done a second time while its first worker is only slow."""
    store = open_storage(tmp_path)
    sides = [b"a" * 3_000_000, b"b" * 2_000_000]
    store.write("f", sides[0])
    with ThreadPoolExecutor(2) as pool:
        writing = [
            pool.submit(lambda data=data: [store.write("f", data) for _ in range(40)]) for data in sides
        ]
        while not all(each.done() for each in writing):
            assert store.read("f") in sides
        assert [each.exception() for each in writing] == [None, None]
    assert store.names("") == ["f"]


def test_one_run_at_a_time(tmp_path: Path) -> None:
    store = open_storage(tmp_path / "new")
    with store.lock():
        with pytest.raises(OutputError, match="another run is writing here"), open_storage(store.url).lock():
            pass
        code = f"from fusion.storage import open_storage\nwith open_storage({store.url!r}).lock(): pass"
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert "another run is writing here" in other.stderr
    with store.lock():
        pass
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="is a file"), open_storage(tmp_path / "file").lock():
        pass
