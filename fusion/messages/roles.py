"""Which topic could be which camera or LiDAR, judged by its name, type, pixels and size, with the reason in
words.

Evidence is counted in points. Names say what people meant, pixels what was recorded: where they disagree (a
coloured picture on a topic called thermal) pixels win, for a coloured picture is no measurement of heat.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from fusion.messages.base import CameraInfo, CompressedImage, Message, Points, RawImage, Role, Transforms
from fusion.messages.peek import peek
from fusion.recordings.base import Topic

CAMERA_ROLES: tuple[Role, ...] = ("rgb", "fir", "depth")
# Words of a topic's name.
WORDS: Mapping[Role, str] = {
    "fir": "thermal thermo therm lwir ir fir tir infrared boson lepton tau tau2 flir seek optris hadron heat"
    " temperature thr uncooled xtr vue",
    "rgb": "rgb color colour visible vis vi visual eo bgr left right cam camera usb webcam basler gopro zed",
    "depth": "depth disparity groundtruth",
    "lidar": "lidar velodyne ouster os os0 os1 os2 livox avia mid360 hesai pandar rslidar robosense scan"
    " points laser vlp16",
}
_WEAK = "left right cam camera usb visual points scan os"  # said of other things as well
# what is made from pictures, or from clouds
_MADE: Mapping[str, str] = {
    "image": "fused mask support label labels segmentation debug annotated overlay detections preview"
    " thumbnail",
    "cloud": "map registered filtered ground obstacles colored",
}
# near infrared: "infra1" and "ir2" are stereo cameras with a projector
_NEAR_INFRARED = re.compile(r"(?i)(?<![a-z])(infra[12]?|nir|ir_?[12])(?![a-z0-9])")
_CORES_WH = frozenset(
    {(640, 512), (320, 256), (336, 256), (160, 120), (80, 60), (384, 288), (382, 288), (1280, 1024)}
)
_COLOUR = re.compile(r"(?i)(bgr|rgb|bayer|yuv|uyvy|yuyv|nv12|nv21|nv24)|^8UC[34]|^16UC[34]")
_BYTES16 = ("mono16", "16uc1", "16sc1")
_GENERIC = re.compile(
    r"(?i)(image|img)(_(raw|rect|colou?r|mono|rect_raw|rect_colou?r|8bit|16bit))?|raw|data|camera_info|info|points(_raw)?"
)
_EMPTY = 0.3  # a share of zeros that depth maps have and counts have not
_TRANSPORTS = ("compressed", "compresseddepth", "theora", "ffmpeg", "zstd", "draco")


@dataclass(frozen=True, slots=True)
class Seen:
    """What is known of a topic: `kind` of its messages, and of one of them, as far as one was looked at.

    `encoding` is ROS's word for the pixels (a JPEG's or PNG's content in the same words), `fields` those of
    points.
    """

    topic: Topic
    kind: type[Message] | None
    encoding: str = ""
    size_wh: tuple[int, int] | None = None
    fields: tuple[str, ...] = ()
    camera: str = ""  # what is one device; by default told from the topic's name
    zeros: float | None = None  # share of the pixels that are 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "camera", self.camera or camera_of(self.topic.name))

    @classmethod
    def of(
        cls,
        topic: Topic,
        kind: type[Message] | None,
        message: Message | None = None,
        zeros: float | None = None,
    ) -> Seen:
        """From a topic and, if there is one, any of its messages. Compressed pictures: only their head is
        read.
        """
        if isinstance(message, RawImage):
            return cls(topic, kind, message.encoding, (message.width, message.height), zeros=zeros)
        if isinstance(message, CompressedImage):
            if "compresseddepth" in message.format.lower():
                return cls(topic, kind, message.format)
            head = peek(message.data)
            known = (head.encoding, head.size_wh) if head else (message.format, None)
            return cls(topic, kind, *known, zeros=zeros)
        if isinstance(message, Points):
            return cls(topic, kind, fields=tuple(part.name for part in message.fields))
        return cls(topic, kind)


class Guess(NamedTuple):
    """A role that a topic could play, how much speaks for it, and what."""

    role: Role
    topic: Topic
    points: int
    reason: str
    camera: str


@dataclass(frozen=True, slots=True)
class Roles:
    """`chosen`: the best topic of each role (rgb, fir, lidar, depth), and why. `ambiguous`: for a role, all
    topics between which nothing decides (the chosen one among them). `infos`: the CameraInfo topic of each
    camera role. `transforms`: all of them. `guesses`: everything that could be, the best first.
    """

    chosen: Mapping[Role, tuple[Topic, str]] = field(default_factory=dict)
    ambiguous: Mapping[Role, tuple[Guess, ...]] = field(default_factory=dict)
    infos: Mapping[Role, tuple[Topic, str]] = field(default_factory=dict)
    transforms: tuple[Topic, ...] = ()
    guesses: tuple[Guess, ...] = ()


def is_colour(encoding: str) -> bool:
    """Whether ROS's word for an image's pixels says that they have colour (a Bayer mosaic has)."""
    return _COLOUR.search(encoding) is not None


def guess_roles(topics: Sequence[Seen]) -> tuple[Guess, ...]:
    """Every role that every topic could play, the best first; a topic without messages plays none."""
    found = [guess for seen in topics if seen.topic.count != 0 for guess in _guesses(seen)]
    return tuple(sorted(found, key=lambda guess: (-guess.points, guess.topic.name, guess.role)))


def roles_of(topics: Sequence[Seen]) -> Roles:
    """One topic a role, one role a topic, the best evidence first; where two cameras tie, it says so."""
    guesses = guess_roles(topics)
    chosen: dict[Role, Guess] = {}
    used: set[str] = set()
    for guess in guesses:
        if guess.role in chosen or guess.role in ("info", "transforms") or guess.camera in used:
            continue
        chosen[guess.role] = guess
        used.add(guess.camera)
    infos = _infos(guesses, chosen)
    return Roles(
        {role: (guess.topic, guess.reason) for role, guess in chosen.items()},
        {role: tied for role, guess in chosen.items() if len(tied := _tied(guess, guesses, chosen)) > 1},
        infos,
        tuple(guess.topic for guess in guesses if guess.role == "transforms"),
        guesses,
    )


def camera_of(name: str) -> str:
    """What topics of one device have in common: the name without its transport and a last part that says
    nothing.

    ``/thermal/image_raw/compressed`` and ``/thermal/camera_info`` give ``/thermal``.
    """
    parts = name.rstrip("/").split("/")
    while len(parts) > 1 and parts[-1].lower() in _TRANSPORTS:
        parts.pop()
    said_before = len([part for part in parts[:-1] if part]) > 0
    return "/".join(parts[:-1] if said_before and _GENERIC.fullmatch(parts[-1]) else parts)


def words_of(name: str) -> set[str]:
    """The words of a name, in small letters: ``/flirBoson/image_raw`` has flir, boson, image, raw."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+[0-9]*|[A-Z]+(?![a-z])[0-9]*", name)}


def _guesses(seen: Seen) -> Iterator[Guess]:
    topic = seen.topic
    if seen.kind is CameraInfo:
        yield Guess("info", topic, 1, "a camera's calibration", seen.camera)
    elif seen.kind is Transforms:
        static = "static" in topic.name.lower()
        words = "how frames stand to each other" + (", fixed" if static else "")
        yield Guess("transforms", topic, 1, words, seen.camera)
    elif seen.kind is Points:
        yield from _weighed("lidar", seen, _of_points(seen))
    elif seen.kind in (RawImage, CompressedImage):
        for role in CAMERA_ROLES:
            yield from _weighed(role, seen, _of_image(role, seen))


def _weighed(role: Role, seen: Seen, evidence: list[tuple[int, str]]) -> Iterator[Guess]:
    total = sum(points for points, _ in evidence)
    if total > 0:
        words = ", ".join(reason for points, reason in evidence if points > 0)
        yield Guess(role, seen.topic, total, words, seen.camera)


def _of_points(seen: Seen) -> list[tuple[int, str]]:
    evidence = [(3, "a point cloud"), *_by_name("lidar", seen.topic.name)]
    names = {name.lower() for name in seen.fields}
    told = sorted(names & {"ring", "line", "channel", "time", "t", "timestamp", "offset_time"})
    if told:
        evidence.append((2, f"with {' and '.join(told)}"))
    if names & {"rgb", "rgba"}:
        evidence.append((-2, "coloured by a camera"))
    if words_of(seen.topic.name) & _words("depth"):
        evidence.append((-1, "made of depth pictures"))
    return evidence


def _of_image(role: Role, seen: Seen) -> list[tuple[int, str]]:
    evidence = _by_name(role, seen.topic.name) + _by_pixels(role, seen.encoding)
    said = words_of(seen.topic.name)
    if role == "fir" and seen.size_wh in _CORES_WH:
        evidence.append((1, "{}x{} as thermal cores have".format(*seen.size_wh)))
    if role == "rgb" and said & (_words("fir") | _words("depth")):
        evidence.append((-3, "named otherwise"))
    if role == "fir" and said & _words("depth"):
        evidence.append((-3, "named otherwise"))
    if role == "depth" and said & _words("fir"):
        evidence.append((-3, "named otherwise"))
    if seen.encoding.lower() in _BYTES16 and (seen.zeros or 0.0) > _EMPTY:
        evidence.append({"depth": (4, "mostly 0: no value"), "fir": (-4, "")}.get(role, (0, "")))
    if role == "fir" and _NEAR_INFRARED.search(seen.topic.name):
        evidence.append((-5, "near infrared"))
    return evidence


def _words(role: Role) -> set[str]:
    return set(WORDS[role].split())


def _by_name(role: Role, name: str) -> list[tuple[int, str]]:
    said = sorted(words_of(name) & _words(role))
    strong = [word for word in said if word not in _WEAK.split()]
    evidence = []
    if strong:
        evidence.append((4, f"named {strong[0]}"))
    elif said:
        evidence.append((1, f"named {said[0]}"))
    made = _MADE["cloud" if role == "lidar" else "image"]
    if words_of(name) & set(made.split()):
        evidence.append((-2 if role == "lidar" else -6, "made from another one"))
    return evidence


def _by_pixels(role: Role, encoding: str) -> list[tuple[int, str]]:
    """What pixels say for or against a role; unknown ones say nothing but that it is a picture."""
    word = encoding.lower()
    if "compresseddepth" in word:
        return [(8, "compressedDepth") if role == "depth" else (-9, "depth")]
    if is_colour(encoding):
        return [(3, f"colour ({encoding})") if role == "rgb" else (-9, "colour")]
    if word in _BYTES16:
        table = {"fir": 3 if word == "mono16" else 2, "depth": 1 if word != "mono16" else -1, "rgb": -2}
        return [(table[role], f"16 bit ({encoding})")]
    if word.startswith(("32f", "64f")):
        return [({"depth": 3, "fir": 0, "rgb": -9}[role], f"floating point ({encoding})")]
    if word in ("mono8", "8uc1"):
        return [({"rgb": 1, "fir": 1, "depth": -2}[role], f"grey ({encoding})")]
    return [({"rgb": 1, "fir": 0, "depth": -1}[role], "a picture")]


def _tied(best: Guess, guesses: Sequence[Guess], chosen: Mapping[Role, Guess]) -> tuple[Guess, ...]:
    """`best` and what has as much evidence for its role, is another device, and is not wanted more
    elsewhere.
    """
    wanted = {guess.camera: guess.points for role, guess in chosen.items() if role != best.role}
    tied = {best.camera: best}
    for guess in guesses:
        rival = guess.role == best.role and guess.points >= best.points
        if rival and wanted.get(guess.camera, 0) <= guess.points:
            tied.setdefault(guess.camera, guess)
    return tuple(tied.values())


def _infos(guesses: Sequence[Guess], chosen: Mapping[Role, Guess]) -> dict[Role, tuple[Topic, str]]:
    """The CameraInfo of the same device; else one in the same namespace, where no other chosen camera is."""
    infos = [guess for guess in guesses if guess.role == "info"]
    cameras: dict[Role, Guess] = {role: chosen[role] for role in CAMERA_ROLES if role in chosen}
    spaces: dict[Role, str] = {role: _namespace(guess.topic.name) for role, guess in cameras.items()}
    found: dict[Role, tuple[Topic, str]] = {}
    for role, camera in cameras.items():
        same = [info for info in infos if info.camera == camera.camera]
        alone = list(spaces.values()).count(spaces[role]) == 1
        near = [info for info in infos if alone and _namespace(info.topic.name) == spaces[role]]
        if same or near:
            found[role] = ((same or near)[0].topic, f"beside the pictures of {role}")
    return found


def _namespace(name: str) -> str:
    parts = name.rstrip("/").split("/")
    while len(parts) > 1 and parts[-1].lower() in _TRANSPORTS:
        parts.pop()
    return "/".join(parts[:-1])
