"""Live fleets, recordings and data sets of v2vloc as NumPy arrays.

Frames are right-handed: x forward, y left, z up; metres, radians, nanoseconds. A transform is named target-from-source:
``world_from_cav`` moves points of a vehicle's LiDAR frame to the world. A box is ``x, y, z, dx, dy, dz, heading``:
centre, full length, width and height, rotation from x towards y. A CAV (connected automated vehicle) is named by its
id, a text; the frame of a CAV is that of its LiDAR.
"""

from collections.abc import Iterator, Sequence
from os import PathLike
from types import TracebackType
from typing import Any, Literal, Optional, Union, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

class Error(ValueError):
    """Bad input: the message names the file, key or argument, and both values where two do not agree."""

class PoseEstimate:
    """Pose that an agent has estimated, or the reason why it has none."""

    @property
    def world_from_cav(self) -> Optional[NDArray[np.float64]]:
        """``[4, 4]``; ``None`` without a pose."""
    @property
    def confidence(self) -> Optional[float]:
        """Confidence of the pose, 0 to 1."""
    @property
    def covariance(self) -> Optional[NDArray[np.float64]]:
        """``[3, 3]`` of x, y (square metres) and yaw (square radians) in the world, where the source has one."""
    @property
    def no_pose_reason(self) -> Optional[str]:
        """``too_few_points``, ``too_few_inliers``, ``no_source``, ``low_confidence``, ``failed`` or
        ``low_coverage``."""
    @property
    def inlier_count(self) -> Optional[int]:
        """Inliers of the failed estimate."""

class Bev:
    """BEV feature map of an agent, decompressed, in the frame of its LiDAR."""

    @property
    def features(self) -> NDArray[np.float32]:
        """``[C, H, W]``: the row grows with y, the column with x; zero where no cell was sent."""
    @property
    def mask(self) -> Optional[NDArray[np.bool_]]:
        """``[H, W]``, true for cells that were sent; ``None``: all were."""
    @property
    def x_min_m(self) -> float:
        """Lower edge of column 0, metres."""
    @property
    def y_min_m(self) -> float:
        """Lower edge of row 0, metres."""
    @property
    def cell_m(self) -> float:
        """Edge of a cell, metres."""
    @property
    def code_of(self) -> Optional[int]:
        """Channels before the sender's learnt compressor; ``None``: not used."""
    @property
    def dtype(self) -> str:
        """Number format on the wire: ``f32``, ``f16`` or ``i8``."""
    @property
    def payload_bytes(self) -> int:
        """Bytes of the map on the wire."""
    @property
    def pose(self) -> PoseEstimate:
        """Pose of the sender."""

class Detections:
    """Detections of an ego, or of one agent from its own sensors, in the frame of its LiDAR."""

    @property
    def cav(self) -> str:
        """The vehicle."""
    @property
    def boxes(self) -> NDArray[np.float64]:
        """``[N, 7]``: x, y, z, dx, dy, dz (metres), heading (radians)."""
    @property
    def scores(self) -> NDArray[np.float32]:
        """``[N]``, 0 to 1, falling."""
    @property
    def sources(self) -> list[Optional[str]]:
        """The CAV of each box, if a single one has detected it (late fusion)."""
    @property
    def tracks(self) -> list[Optional[dict[str, Any]]]:
        """Of one agent: the track of each object that it detected before: ``id``, ``velocity_mps``, ``position_covariance``,
        ``velocity_covariance`` (xx, xy, yy) along x, y of its LiDAR frame; empty of an ego."""
    @property
    def pose(self) -> PoseEstimate:
        """Pose of the vehicle."""
    @property
    def method(self) -> Optional[str]:
        """Fusion method of an ego; ``None``: the boxes are those of one agent, and what follows is empty."""
    @property
    def agent_frame(self) -> Optional[int]:
        """Frame of the ego's own agent, from 0."""
    @property
    def fused(self) -> list[dict[str, Any]]:
        """Neighbours that were fused: ``cav``, ``age_nanos``, ``confidence``, ``payload_bytes``, ``wire_bytes``."""
    @property
    def skipped(self) -> list[dict[str, Any]]:
        """Neighbours that were not: ``cav``, ``reason``."""
    @property
    def neighbours(self) -> list[dict[str, Any]]:
        """State of neighbours: ``cav``, ``trust``, ``misbehaviour``, ``clock_offset_s``, ``capture_offset_s``."""
    @property
    def stages_ms(self) -> dict[str, float]:
        """Durations of the ego's stages, milliseconds."""
    def __len__(self) -> int: ...

class Tracks:
    """Tracks of an ego after a frame, in the frame of its LiDAR."""

    @property
    def cav(self) -> str:
        """The ego."""
    @property
    def agent_frame(self) -> int:
        """Frame of the ego's own agent, from 0."""
    @property
    def ids(self) -> NDArray[np.uint64]:
        """``[N]``: identities, rising, from 1; never used again by the same ego."""
    @property
    def boxes(self) -> NDArray[np.float64]:
        """``[N, 7]``: x, y, z, dx, dy, dz (metres), heading (radians)."""
    @property
    def velocities_mps(self) -> NDArray[np.float64]:
        """``[N, 2]``: velocity over ground along x, y of the ego's LiDAR frame."""
    @property
    def covariances(self) -> NDArray[np.float32]:
        """``[N, 4, 4]``: of x, y, velocity x, velocity y; metres and metres per second."""
    @property
    def scores(self) -> NDArray[np.float64]:
        """``[N]``, 0 to 1: mean score of the detections times the probability that the object exists."""
    @property
    def hits(self) -> NDArray[np.uint32]:
        """``[N]``: number of detections."""
    @property
    def ages_s(self) -> NDArray[np.float64]:
        """``[N]``: time since the first detection."""
    @property
    def unseen_s(self) -> NDArray[np.float64]:
        """``[N]``: time since the last detection; 0: detected in this frame, else the place is predicted."""
    @property
    def pose(self) -> PoseEstimate:
        """Pose of the ego; without one there are no tracks."""
    @property
    def left_out(self) -> int:
        """Detections that were left out: too many, or with a number that is none."""
    def __len__(self) -> int: ...

class Objects:
    """Annotated objects."""

    @property
    def ids(self) -> NDArray[np.int64]:
        """``[N]``: the same for one object in the annotations of all agents."""
    @property
    def classes(self) -> list[str]:
        """``car``, ``van``, ``truck``, ``bus``, ``two_wheeler``, ``pedestrian`` or ``other``."""
    @property
    def boxes(self) -> Optional[NDArray[np.float64]]:
        """``[N, 7]``, upright, in the LiDAR frame of the agent or ego; ``None`` if its true pose is unknown."""
    @property
    def world_from_object(self) -> NDArray[np.float64]:
        """``[N, 4, 4]``: the centre, and x along the length."""
    @property
    def sizes_m(self) -> NDArray[np.float64]:
        """``[N, 3]``: full length, width and height, metres."""
    @property
    def speeds_mps(self) -> NDArray[np.float64]:
        """``[N]``, metres per second; NaN where there is none."""
    def __len__(self) -> int: ...

class Camera:
    """Image of a camera, encoded, with its calibration."""

    @property
    def image(self) -> bytes:
        """The encoded image."""
    @property
    def format(self) -> str:
        """``png`` or ``jpeg``."""
    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    @property
    def intrinsics(self) -> Optional[NDArray[np.float64]]:
        """``[3, 3]``, pixels."""
    @property
    def lidar_from_camera(self) -> Optional[NDArray[np.float64]]:
        """``[4, 4]``; the camera's frame: z ahead, x right, y down."""

class Agent:
    """One agent at one capture time. What was not recorded, sent or asked for is ``None``."""

    @property
    def cav(self) -> str: ...
    @property
    def points(self) -> Optional[NDArray[np.float32]]:
        """LiDAR sweep ``[N, 4]``: x, y, z (metres), intensity (0 to 1), in the LiDAR frame."""
    @property
    def radar(self) -> Optional[NDArray[np.float32]]:
        """Radar sweep ``[N, 4]``: x, y, z (metres), radial velocity (metres per second) or as stored."""
    @property
    def cameras(self) -> dict[int, Camera]:
        """Images by camera number."""
    @property
    def world_from_lidar(self) -> Optional[NDArray[np.float64]]:
        """True pose ``[4, 4]``, as recorded."""
    @property
    def gnss_world_from_lidar(self) -> Optional[NDArray[np.float64]]:
        """Pose ``[4, 4]`` by GNSS, or the recorded one that a replay publishes as such."""
    @property
    def speed_mps(self) -> Optional[float]: ...
    @property
    def yaw_rate_rad_s(self) -> Optional[float]: ...
    @property
    def objects(self) -> Objects:
        """What this agent's annotation lists."""
    @property
    def pose(self) -> Optional[PoseEstimate]:
        """Pose estimate that the agent has published."""
    @property
    def bev(self) -> Optional[Bev]:
        """Feature map that it has published."""
    @property
    def boxes(self) -> Optional[Detections]:
        """Detections from its own sensors that it has published (late fusion)."""

class Frame:
    """Everything of one capture time."""

    @property
    def source(self) -> str:
        """Name of the run or scenario."""
    @property
    def tick(self) -> Optional[int]:
        """Tick of the scene, from 0, if known."""
    @property
    def capture_time_ns(self) -> int:
        """Capture time on the clock of the scene."""
    @property
    def agents(self) -> dict[str, Agent]:
        """Agents by id, in the order of the scene."""
    @property
    def detections(self) -> dict[str, Detections]:
        """Results by the id of the ego."""
    @property
    def tracks(self) -> dict[str, Tracks]:
        """Tracks by the id of the ego, if it tracks."""
    @property
    def ego(self) -> Optional[str]:
        """The ego, the same in all frames, also where it is absent: of a data set the first agent that takes part by the
        protocol of the layout, of a recorded run the scored one, of a recording alone the first by name. Of a frame of a live
        run the vehicle of its first result. Without results the first agent."""
    @property
    def problems(self) -> list[str]:
        """Parts that were left out, each with its reason."""
    def ground_truth(
        self,
        ego: Optional[str] = None,
        *,
        protocol: Optional[str] = None,
        area_m: Optional[Sequence[float]] = None,
    ) -> Objects:
        """Objects that an ego is expected to find: the annotations of all agents in range that take part by the protocol,
        merged by id, in the frame of the ego's LiDAR. The boxes are read-only.

        :param ego: takes part in any case; default: :attr:`ego`, and that of ``protocol`` in a data set.
        :param protocol: evaluation protocol, for example ``opv2v``; default: the one of :func:`read`, of the data set's layout, or
            that by which a recorded run was scored. Of live runs, and of recordings outside of a run folder, ``opv2v``.
        :param area_m: x, y, z low, then x, y, z high of the detector in the LiDAR frame: the range of the protocol ends
            there.
        :raises Error: without a true pose of the ego, if ``area_m`` is no range, or if the ego of ``protocol`` has other frames
            than the data set was read with.
        """

Payload = Union[NDArray[np.float32], PoseEstimate, Bev, Detections, Camera, Agent, dict[str, Any], str]

class Message:
    """One message of the wire format."""

    @property
    def key(self) -> Optional[str]: ...
    @property
    def kind(self) -> str:
        """``lidar``, ``pose``, ``bev``, ... as in the reference of the wire format."""
    @property
    def cav(self) -> str:
        """Sender."""
    @property
    def epoch(self) -> int:
        """Random number of the sender's process instance."""
    @property
    def sequence(self) -> int: ...
    @property
    def capture_time_ns(self) -> int:
        """On the clock of the scene."""
    @property
    def publish_time_ns(self) -> int:
        """On the Unix clock; in simulation time on that of the scene."""
    @property
    def wire_bytes(self) -> int: ...
    @property
    def payload(self) -> Payload:
        """By kind: ``lidar``, ``radar``: points ``[N, 4]``; ``pose``: :class:`PoseEstimate`; ``bev``: :class:`Bev`;
        ``boxes``, ``detections``: :class:`Detections`; ``camera``: :class:`Camera`; ``points``: :class:`Agent`;
        ``truth``: a dictionary with ``tick`` and ``agents``; others: their fields as a dictionary."""

class DataSet:
    """Frames of a data set or recording: iterable and indexable by numbers. It can be pickled, for worker processes of a loader."""

    @property
    def path(self) -> PathLike[str]: ...
    @property
    def layout(self) -> str: ...
    @property
    def scenarios(self) -> list[str]:
        """Names of the scenarios, whose frames follow each other."""
    @property
    def agents(self) -> dict[str, list[str]]:
        """Agents of each scenario that take part by the protocol of :func:`read`, the ego first; empty for a recording."""
    @property
    def problems(self) -> list[str]:
        """Files that cannot be read, each with its reason, and scenarios without an ego of the protocol of :func:`read`.
        Those of a frame are in :attr:`Frame.problems`."""
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> Frame: ...
    def __iter__(self) -> Iterator[Frame]: ...

class Listener(Iterator[Frame]):
    """Frames of a live run as they arrive. Ends with the run, by :meth:`close`, or at the end of ``with``."""

    @property
    def run(self) -> str: ...
    @property
    def counts(self) -> dict[str, int]:
        """``messages`` received; ``undecodable``; ``late``: after their frame was handed over; ``overwritten`` and
        ``undelivered``: lost because this program took earlier ones too slowly."""
    @property
    def problems(self) -> list[str]:
        """Keys and reasons of messages that cannot be decoded, at most 100; ``counts`` has all."""
    def messages(self) -> Iterator[Message]:
        """Single messages at once, instead of frames."""
    def close(self) -> None: ...
    def __next__(self) -> Frame: ...
    def __enter__(self) -> Listener: ...
    def __exit__(
        self,
        kind: Optional[type[BaseException]],
        error: Optional[BaseException],
        traceback: Optional[TracebackType],
    ) -> None: ...

def read(
    path: Union[str, PathLike[str]],
    points: bool = True,
    radar: bool = False,
    cameras: bool = False,
    protocol: Optional[str] = None,
) -> DataSet:
    """Opens a data set, split or scenario in any layout that v2vloc reads, a recording (``.mcap``), or the folder of a
    recorded run.

    :param points: read LiDAR sweeps.
    :param radar: read radar sweeps.
    :param cameras: read images.
    :param protocol: evaluation protocol: the agents of a data set that take part by it, at the frames of its ego. Default:
        all agents, and the protocol of the layout or of the recorded run.
    :raises Error: if it cannot be opened. A frame that cannot be read in part has the rest.
    """

def listen(
    endpoint: str = "tcp/127.0.0.1:7447",
    run: Optional[str] = None,
    *,
    timeout_s: Optional[float] = 10.0,
    credentials: Union[None, str, PathLike[str]] = None,
    streams: Optional[Sequence[str]] = None,
    settle_s: float = 1.0,
) -> Listener:
    """Follows a live run as a passive subscriber; nobody waits for it.

    :param endpoint: the router of the run, as ``v2vloc up`` prints it.
    :param run: name of the run.
    :param timeout_s: iteration ends when no message has arrived for so long; ``None``: it waits.
    :param credentials: folder with keys of a viewer or recorder (``v2vloc keys``), for runs with access control. Feature
        maps need those of a recorder.
    :param streams: default: gnss, imu, pose, bev, boxes, points, detections, tracks and truth. Also lidar, radar, camera,
        descriptor, pace, stats.
    :param settle_s: a frame is handed over when its last message is so old. Later ones are counted.
    :raises Error: if there is no such router, or no message of the run.
    """

def decode(kind_or_key: str, data: bytes) -> Message:
    """Decodes one message, for example of another zenoh client.

    :param kind_or_key: ``bev``, or the key on which it was published, ``v2v/RUN/1000/bev``: then the sender is checked.
    :raises Error: with the reason, for anything but a valid message of that kind.
    """

@overload
def average_precision(
    detections: Sequence[Union[Detections, tuple[ArrayLike, ArrayLike]]],
    truth: Sequence[Union[Objects, ArrayLike]],
    iou: float = 0.5,
    *,
    ordering: Literal["global", "frame"] = "global",
) -> Optional[float]:
    """Average precision (area under the interpolated curve, VOC 2010), as ``v2vloc eval`` computes it.

    Footprints are matched as in OpenCOOD: detections of a frame by falling score, each takes the remaining object with
    the highest overlap. With :meth:`Frame.ground_truth` detections with a corner beyond its range do not count, and
    detections on objects of other classes count neither way.

    :param detections: of each frame: :class:`Detections`, or boxes ``[N, 7]`` and scores ``[N]``.
        No size is negative.
    :param truth: of each frame: :class:`Objects`, or boxes ``[M, 7]`` in the same frame of reference, which all count.
    :param iou: overlap from which a detection counts; a list or array, also of one, gives a dictionary.
    :param ordering: ``global``: by score over all frames; ``frame``: frame after frame (the default of OpenCOOD).
    :return: 0 to 1; ``None`` where no object counts, also without frames.
    :raises Error: with the frame whose shape or value is wrong.
    """

@overload
def average_precision(
    detections: Sequence[Union[Detections, tuple[ArrayLike, ArrayLike]]],
    truth: Sequence[Union[Objects, ArrayLike]],
    iou: Sequence[float],
    *,
    ordering: Literal["global", "frame"] = "global",
) -> dict[float, Optional[float]]: ...
