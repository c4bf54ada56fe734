"""Which topics of a recording are the camera: found by type, encoding and frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from active6d_bringup.bags.source import BagError, BagSource
from active6d_bringup.camera.rectification import RECTIFIED
from active6d_core.calibration import Calibration
from active6d_core.ros.conversions import MessageError
from active6d_core.ros.topics import CAMERA_COLOR, CAMERA_DEPTH, CAMERA_INFO, CAMERA_POSE
from active6d_core.ros.transform_tree import TransformTree

IMAGES = {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}
INFO = "sensor_msgs/msg/CameraInfo"
POSES = {"geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"}
TRANSFORMS = "tf2_msgs/msg/TFMessage"
#: What a user may name with ``--topics``; world is a frame.
KEYS = ("color", "depth", "info", "depth_info", "pose", "world")
_DEPTH_ENCODINGS = {"16UC1", "mono16", "32FC1", "64FC1"}
_COPIES = ("/compressed", "/compressedDepth", "/theora", "/ffmpeg", "/zstd")
_PNG, _PNG_DEPTH = b"\x89PNG", bytes([16, 0])  # 16 bits of grey
_NAMES = {"color": CAMERA_COLOR.name, "depth": CAMERA_DEPTH.name, "info": CAMERA_INFO.name, "pose": CAMERA_POSE.name}


_WITHOUT_POSES = (
    "record the camera's poses, too, as PoseStamped or /tf; without poses, save images and K of single views, "
    "and run active6d estimate --rgb FILE --depth FILE --intrinsics FILE (docs/bags.md)"
)

#: Settings of ``camera_adapter``, which texts for both name, and the options that do the same for a recording.
_OPTIONS = {
    "set depth_info_topic and depth_to_color": "name --topics depth_info=NAME, with /tf_static in the recording",
    "set info_topic to": "name --topics info=NAME,",
    "(rectified)": "(--rectified)",
    "depth_scale": "--depth-scale",
}


def with_options(text: str) -> str:
    """A text that names settings of ``camera_adapter``, naming the command's options instead."""
    for setting, option in _OPTIONS.items():
        text = text.replace(setting, option)
    return text


@dataclass(frozen=True)
class CameraOptions:
    """What a user says of a recorded camera.

    Attributes:
        topics: names that replace what would be found, by the keys of ``KEYS``.
        depth_scale: metres per unit of depth, 0 for what REP-118 says.
        rectified: whether images are rectified already, None for what the name of the colour topic says.
    """

    topics: dict[str, str] = field(default_factory=dict)
    depth_scale: float = 0.0
    rectified: bool | None = None

    @classmethod
    def parse(cls, topics: str, depth_scale: float = 0.0, rectified: bool | None = None) -> "CameraOptions":
        """From a text such as ``color=/left/image,depth=/left/depth``.

        Raises:
            ValueError: a part is not KEY=NAME, or the key is unknown.
        """
        named = {}
        for part in filter(None, (part.strip() for part in topics.split(","))):
            key, _, name = part.partition("=")
            if key not in KEYS or not name:
                raise ValueError(f"--topics: '{part}' is not KEY=NAME with a key of {', '.join(KEYS)}")
            named[key] = name
        return cls(named, depth_scale, rectified)

    @property
    def parameters(self) -> dict[str, Any]:
        """The same as parameters of the node ``bag_player``."""
        topics = ",".join(f"{key}={name}" for key, name in self.topics.items())
        rectified = next(text for text, value in RECTIFIED.items() if value is self.rectified)
        return {"topics": topics, "depth_scale": self.depth_scale, "rectified": rectified}

    @property
    def given(self) -> bool:
        """Whether the user says anything."""
        return self != CameraOptions()


@dataclass(frozen=True)
class CameraTopics:
    """The camera's topics in a recording; None for what it does not have.

    Attributes:
        pose: None where poses come from /tf.
        depth_info: None where depth is registered to colour.
        world: frame that counts as the world with /tf, None for "world" or the root of the tree.
        passed_over: topics of poses that /tf is preferred to.
    """

    color: str
    depth: str
    info: str
    pose: str | None
    depth_info: str | None
    world: str | None
    passed_over: tuple[str, ...] = ()

    def __str__(self) -> str:
        parts = [f"color={self.color}", f"depth={self.depth}", f"info={self.info}"]
        parts += [f"depth_info={self.depth_info}"] if self.depth_info else []
        if self.pose:
            return ",".join([*parts, f"pose={self.pose}"])
        tf = "from /tf"
        if self.passed_over:
            tf += f" rather than {', '.join(self.passed_over)}; --topics pose=NAME if that is the camera's pose"
        return ",".join([*parts, f"world={self.world or 'world'} ({tf})"])


@dataclass(frozen=True)
class _Candidate:
    """A topic, with the frame and size of its first message."""

    topic: str
    frame: str
    size: tuple[int, int] | None
    encoding: str = ""


def find_camera(source: BagSource, options: CameraOptions) -> CameraTopics:
    """The camera's topics.

    Raises:
        BagError: a kind of topic is missing, or there are several that could be meant.
    """
    first = _first_messages(source)
    images = [
        _image(topic, message) for topic, (kind, message) in first.items() if kind in IMAGES and message is not None
    ]
    named = options.topics
    images = _without_copies(images, set(named.values()))
    depths = [image for image in images if _is_depth(image)]
    # Of cameras, 16-bit grey is depth only where nothing else is.
    depths = [image for image in depths if image.encoding != "mono16"] or depths
    depths = [image for image in images if image.topic == named.get("depth")] or depths
    colors = [image for image in images if image not in depths]
    colors = [image for image in images if image.topic == named.get("color")] or colors
    depth = _choose(source, "depth", depths, named, lambda image: "align" in image.topic or "regist" in image.topic)
    color = _choose(source, "color", colors, named, lambda image: image.frame == depth.frame)
    infos = [_info(topic, message) for topic, (kind, message) in first.items() if kind == INFO and message is not None]
    depth_info = named.get("depth_info")
    same_size = None in (depth.size, color.size) or depth.size == color.size
    registered = depth_info is None and depth.frame == color.frame and same_size
    fits = [info for info in infos if info.frame == color.frame] or infos
    fits = [info for info in fits if info.size == color.size] or fits
    info = _choose(source, "info", fits, named, lambda each: _folder(each.topic) == _folder(color.topic))
    if not registered and depth_info is None:
        own = [each for each in infos if each.frame == depth.frame and each.topic != info.topic]
        depth_info = own[0].topic if len(own) == 1 else None
    pose, passed_over = _pose(source, named, color.frame)
    return CameraTopics(color.topic, depth.topic, info.topic, pose, depth_info, named.get("world"), passed_over)


def _pose(source: BagSource, named: dict[str, str], color_frame: str) -> tuple[str | None, tuple[str, ...]]:
    """The topic of camera poses, None for /tf; and the topics that /tf is preferred to."""
    poses = sorted({each.topic for each in source.connections if each.msgtype in POSES and "goal" not in each.topic})
    transforms = any(each.msgtype == TRANSFORMS for each in source.connections)
    if "world" in named and "pose" not in named and transforms:
        return None, ()
    if not poses and transforms and "pose" not in named:
        return None, ()
    if "pose" not in named and transforms and _tf_carries(source, color_frame):
        # Drivers of arms publish the tool's pose, too, and nothing in the message tells it from the camera's.
        of_camera = [topic for topic in poses if "camera" in topic.lower()]
        if not of_camera:
            return None, tuple(poses)
        poses = of_camera
    candidates = [_Candidate(topic, "", None) for topic in poses]
    return _choose(source, "pose", candidates, named, lambda each: each.topic.endswith(_NAMES["pose"])).topic, ()


def _tf_carries(source: BagSource, frame: str) -> bool:
    """Whether /tf has the pose of a frame that moves. The driver's own static frames are not enough."""
    tree = TransformTree()
    for connection, _, payload in source.messages([each for each in source.connections if each.msgtype == TRANSFORMS]):
        try:
            tree.add(source.deserialize(payload, connection.msgtype), connection.topic.endswith("static"))
        except MessageError:  # a topic with poses can do without
            return False
        if tree.moves(frame):
            return True
    return False


def _choose(
    source: BagSource,
    key: str,
    candidates: list[_Candidate],
    named: dict[str, str],
    prefer: Callable[[_Candidate], bool],
) -> _Candidate:
    """The named candidate, the only one, or the only preferred one."""
    if key in named:
        found = [each for each in candidates if each.topic == named[key]]
        if not found:
            usable = ", ".join(sorted(each.topic for each in candidates)) or "none"
            raise BagError(
                f"{source.path}: --topics {key}={named[key]}: not a {key} topic of the bag; there are: {usable}"
            )
        return found[0]
    if not candidates:
        kinds = {
            "depth": f"depth images ({', '.join(sorted(_DEPTH_ENCODINGS))})",
            "color": "colour images",
            "info": "camera_info",
            "pose": "camera poses or /tf",
        }
        hint = f"; {_WITHOUT_POSES}" if key == "pose" else ""
        raise BagError(f"{source.path}: no {kinds[key]} in it; it holds {_contents(source)}{hint}")
    usual = [each for each in candidates if each.topic.lstrip("/") == _NAMES.get(key)]
    for group in (candidates, usual, [each for each in candidates if prefer(each)]):
        if len(group) == 1:
            return group[0]
    names = ", ".join(sorted(each.topic for each in candidates))
    raise BagError(f"{source.path}: several {key} topics ({names}); choose one with --topics {key}=NAME")


def _first_messages(source: BagSource) -> dict[str, tuple[str, Any]]:
    """Topic to its type and first message, for images and camera_info."""
    wanted = [each for each in source.connections if each.msgtype in IMAGES | {INFO}]
    missing = {each.topic for each in wanted}
    first: dict[str, tuple[str, Any]] = {}
    for connection, _, payload in source.messages(wanted):
        if connection.topic in missing:
            missing.discard(connection.topic)
            first[connection.topic] = connection.msgtype, source.deserialize(payload, connection.msgtype)
            if not missing:
                break
    return first


def _contents(source: BagSource) -> str:
    """The topics with messages; those of images with their encoding."""
    first = _first_messages(source)
    encodings = {topic: _image(topic, message).encoding for topic, (kind, message) in first.items() if kind in IMAGES}
    topics = sorted({each.topic for each in source.connections if each.msgcount})
    return ", ".join(f"{each} ({encodings[each]})" if each in encodings else each for each in topics) or "nothing"


def _without_copies(images: list[_Candidate], named: set[str]) -> list[_Candidate]:
    """Without the compressed copies of images that are there uncompressed, unless they are named."""
    raw = {image.topic for image in images}
    return [
        image
        for image in images
        if image.topic in named or not (image.topic.endswith(_COPIES) and _folder(image.topic) in raw - named)
    ]


def _image(topic: str, message: Any) -> _Candidate:
    if not hasattr(message, "format"):
        return _Candidate(topic, message.header.frame_id, (message.width, message.height), message.encoding)
    encoding, header = message.format, bytes(message.data[:26])
    # Some publishers only say "png"; the file itself says that it is 16-bit grey.
    if header.startswith(_PNG) and header[24:26] == _PNG_DEPTH and not encoding.startswith(("16UC1", "mono16")):
        encoding = f"16UC1; {encoding}"
    return _Candidate(topic, message.header.frame_id, None, encoding)


def _info(topic: str, message: Any) -> _Candidate:
    try:
        size = Calibration.from_info(message).image_size
    except ValueError:  # said with the first view
        size = None
    return _Candidate(topic, message.header.frame_id, size)


def _is_depth(image: _Candidate) -> bool:
    return image.encoding.split(";")[0].strip() in _DEPTH_ENCODINGS or "compressedDepth" in image.encoding


def _folder(topic: str) -> str:
    return topic.rpartition("/")[0]
