"""Emulated network camera: MJPEG over HTTP, of the World, images, a video, or a recording.

    python -m rig.mock.emulate camera '{"world": "run/world.state", "view": "run/world.json"}'
    python -m rig.mock.emulate camera '{"source": "images/", "device": {"rate_hz": 60}}'

Each JPEG has a comment after SOI, `tactile-rig emulator seq=<n> state_t_ns=<t>`: its number, and
the time of the World's state it shows (of the tick, if it shows no World). A slow client gets the
last four frames when it is ready for one, as from a driver's buffers; those before are skipped,
never queued. Faults are injected through rig.core.fault_injection; `wrong_units` halves the frame
size. `lens` sets `gain`, the brightness by the exposure, and `blur` of a lens out of focus [px]; by
default 1 and 0.

OpenCV reads one frame to open the stream and drops it, and the driver checks a second one before
it records. Of a recorded session both get the first picture; then the recorded files are sent
unchanged, none of them skipped.
"""

import contextlib
import functools
import itertools
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import SplitResult, urlsplit

import cv2
import numpy as np
import numpy.typing as npt

from recorder.natural_order import natural_key
from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.emulation import DeviceHandler, DeviceServer, Emulator, Newest, Served, SharedWorld
from rig.core.errors import ConfigError
from rig.core.fault_injection import FaultInjector
from rig.core.playback import PlayableConfig, Playback
from rig.core.realtime import CAMERA_PRIORITY
from rig.devices.camera.jpeg import (
    BOUNDARY,
    frame_stamp,
    is_whole,
    jpeg_size,
    multipart,
    stamped,
    torn,
)
from rig.devices.camera.settings import MjpegConfig

# Sources of the emulated camera's pictures: the World, a folder of images, a video.

Image = npt.NDArray[np.uint8]
# Width and height of every picture [px].
SIZE = (640, 480)
# JPEG quality, about that of a webcam.
QUALITY_RENDERED = 92
QUALITY_CONVERTED = 95
_SUFFIXES_IMAGE = (".png", ".jpg", ".jpeg")
_MJPG = cv2.VideoWriter.fourcc(*"MJPG")


# Returns one JPEG file of size `SIZE` per tick of the camera, given the WORLD_STATE record.
FrameSource = Callable[[np.void], bytes]


def rendered(view: Callable[[np.void], Image]) -> FrameSource:
    """Return the source of pictures of the World, whose RGB picture (480, 640, 3) is a `view`."""
    return lambda state: _encoded(cv2.cvtColor(view(state), cv2.COLOR_RGB2BGR), QUALITY_RENDERED)


def looped(path: Path, *, hold: int = 1) -> FrameSource:
    """Return the source that loops over a folder of images or a video, each for `hold` ticks."""
    frames = (jpeg for jpeg in _looped(path) for _ in range(max(hold, 1)))
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: no images and no video")
    pictures = itertools.chain([first], frames)
    return lambda state: next(pictures)


def letterboxed(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the image scaled to fit `SIZE`, proportions kept, with black borders."""
    height, width = image.shape[:2]
    if (width, height) == SIZE:
        return image
    factor = min(SIZE[0] / width, SIZE[1] / height)
    scaled = cv2.resize(
        image,
        (round(width * factor), round(height * factor)),
        interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR,
    )
    canvas = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    top, left = (SIZE[1] - scaled.shape[0]) // 2, (SIZE[0] - scaled.shape[1]) // 2
    canvas[top : top + scaled.shape[0], left : left + scaled.shape[1]] = scaled
    return canvas


def through_lens(jpeg: bytes, gain: float, blur: float) -> bytes:
    """Return the picture at another exposure and focus: brightness, and blur [px]."""
    image = _decoded(jpeg)
    if blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    return _encoded(cv2.convertScaleAbs(image, alpha=gain), QUALITY_RENDERED)


def _decoded(jpeg: bytes) -> npt.NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("no picture")
    return image


def _encoded(image: npt.NDArray[Any], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"image of shape {image.shape} cannot be encoded")
    return data.tobytes()


def _looped(path: Path) -> Iterator[bytes]:
    once = _folder if path.is_dir() else _video
    for _ in itertools.count():
        empty = True
        for jpeg in once(path):
            empty = False
            yield jpeg
        if empty:
            return


def _folder(path: Path) -> Iterator[bytes]:
    names = (p.name for p in path.iterdir() if p.suffix.lower() in _SUFFIXES_IMAGE)
    for name in sorted(names, key=natural_key):
        yield _image(path / name)


@functools.lru_cache(maxsize=256)
def _image(path: Path) -> bytes:
    # Cached: a conversion takes 10 ms, too long for every tick of a fast camera.
    content = path.read_bytes()
    if _serves_as_it_is(content):
        return content
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: cannot be decoded")
    return _encoded(letterboxed(image), QUALITY_CONVERTED)


def _video(path: Path) -> Iterator[bytes]:
    if not path.is_file():
        return
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        # Motion JPEG is a sequence of JPEG files; other formats must be decoded.
        size = (capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        raw = int(capture.get(cv2.CAP_PROP_FOURCC)) == _MJPG and size == SIZE
        if raw:
            capture.set(cv2.CAP_PROP_FORMAT, -1)
        while True:
            arrived, frame = capture.read()
            if not arrived:
                return
            if not raw:
                yield _encoded(letterboxed(frame), QUALITY_CONVERTED)
            elif _serves_as_it_is(jpeg := frame.tobytes()):
                yield jpeg
    finally:
        capture.release()


def _serves_as_it_is(content: bytes) -> bool:
    return is_whole(content) and jpeg_size(content) == SIZE


# How long each image of a still source is shown [s].
_STILL = 2.0
# About two frames, so that a slow client does not find old ones waiting.
_SEND_BUFFER = 1 << 17
# Frames that a camera's driver keeps for a computer that is late: they come later, but all do.
_BUFFERS = 4
# Rows of a recording under way; the driver keeps 120 frames for a late recorder.
_WINDOW = 32
# Frames that a driver needs to open.
_LEAD_IN = 2
_TORN = b"\xff\xd8"


@dataclass(frozen=True, slots=True)
class MjpegEmulatorConfig(PlayableConfig):
    """Port, pictures and timing of the emulated camera."""

    device: MjpegConfig = field(default=MjpegConfig(address="http://127.0.0.1:8090/"))
    view: Path | None = None
    """JSON file of the World, to show a view of it."""
    source: Path | None = None
    """Folder of images, or video, to show in place of a view."""
    motion: Literal["moving", "still"] = "moving"
    """One picture of the source per frame, or each for 2 s."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """Time between exposure of a frame and its delivery [s]; 0: as soon as it is rendered."""


class MjpegEmulator(Emulator):
    """Emulated camera: one thread produces frames, one per client sends the newest frame.

    The source shows the state of a world; without one, frames have the time of their tick.
    """

    def __init__(
        self,
        config: MjpegEmulatorConfig,
        source: FrameSource | Playback,
        world: SharedWorld | None,
        clock: Clock,
    ) -> None:
        super().__init__()
        self._config = config
        self._port = urlsplit(config.device.address).port or 80
        self._source = source
        self._world = world
        self._no_contact = SharedWorld(None).state()[1]
        self._clock = clock
        self.frames = Newest[bytes](
            2 * _WINDOW if isinstance(source, Playback) else _BUFFERS, self._ending
        )
        """Frames for the clients."""
        self.lead_in = b""
        """Sent to a new client before those."""
        if isinstance(source, Playback):
            rows = source.recorded.rows
            first = min(rows.start, len(source.recorded.stream) - 1)
            self.lead_in = _LEAD_IN * _recorded_part(source, first)
        self.faults = FaultInjector[bytes](
            clock, spoil=torn, mistake=_halved, on_change=self._on_plug
        )
        self._lens = (1.0, 0.0)
        self._late: queue.SimpleQueue[tuple[int, tuple[bytes, ...]] | None] = queue.SimpleQueue()
        self._server: _Server | None = None

    @property
    def address(self) -> str:
        """URL of the stream."""
        return f"http://{self._config.host}:{self._port}/"

    def start(self) -> None:
        """Start serving."""
        self._server = _Server((self._config.host, self._port), self)
        accept = functools.partial(self._server.serve_forever, 0.05)
        source = self._source
        if isinstance(source, Playback):
            self._run_threads(functools.partial(self._play, source), accept)
        else:
            self._run_threads(functools.partial(self._film, source), self._deliver, accept)

    def _disconnect(self) -> None:
        self.frames.wake()
        if self._server is not None:
            self._server.shutdown()
            self._server.disconnect_all()
            self._server.server_close()
            self._server = None

    def apply(self, fault: str, **values: Any) -> dict[str, Any]:
        """Change the lens, or inject a fault; see the module and `FaultInjector.inject`."""
        if fault == "lens":
            self._lens = (float(values.get("gain", 1.0)), float(values.get("blur", 0.0)))
            return {}
        return self.faults.inject(fault, **values)

    def _on_plug(self) -> None:
        if self.faults.unplugged and self._server is not None:
            self._server.disconnect_all()

    def _film(self, source: FrameSource) -> None:
        pacer = Pacer(self._clock, self._config.device.rate_hz, behind=_BUFFERS)
        delay_ns = round(self._config.delay * SECOND_NS)
        filmed = 0
        while not self._ending.is_set():
            t_ns = pacer.wait()
            self.missed = pacer.missed
            state = self._no_contact
            if self._world is not None:
                _, state = self._world.state()
                t_ns = int(state["t_ns"])
            filmed += 1
            jpeg = source(state)
            if self._lens != (1.0, 0.0):
                jpeg = through_lens(jpeg, *self._lens)
            passed = self.faults.passed(stamped(jpeg, filmed, t_ns))
            parts = tuple(multipart(frame) for frame in passed)
            if delay_ns:
                self._late.put((t_ns + delay_ns, parts))
            else:
                self.frames.publish(parts)
        self._late.put(None)

    def _deliver(self) -> None:
        while (late := self._late.get()) is not None:
            self._clock.sleep_until(late[0])
            self.frames.publish(late[1])

    def _play(self, playback: Playback) -> None:
        rows = playback.recorded.rows
        playback.run(
            lambda place: self.frames.publish([_recorded_part(playback, rows[place])]),
            window=_WINDOW,
            ending=self._ending,
            # OpenCV returns from its wait, and the driver drops the torn frame.
            wake=lambda: self.frames.publish([multipart(_TORN)]),
        )


def _recorded_part(playback: Playback, row: int) -> bytes:
    """Return a recorded picture as the part of a stream, its bytes as recorded."""
    stream = playback.recorded.stream
    jpeg = stream.jpeg(row)
    if jpeg is None:
        raise ValueError(f"streams/{stream.name}: stored as pixels, not as JPEG")
    return multipart(jpeg)


def _halved(jpeg: bytes) -> bytes:
    """Return the frame at half the size, with its stamp."""
    stamp = frame_stamp(jpeg)
    small = _encoded(cv2.resize(_decoded(jpeg), None, fx=0.5, fy=0.5), QUALITY_RENDERED)
    return small if stamp is None else stamped(small, *stamp)


class _Server(DeviceServer):
    daemon_threads = False

    def __init__(self, address: tuple[str, int], emulator: MjpegEmulator) -> None:
        self._clients: set[socket.socket] = set()
        self._lock = threading.Lock()
        super().__init__(address, _StreamHandler, emulator)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a client, with a send buffer that holds few frames."""
        client, address = super().get_request()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._clients.add(client)
        return client, address

    def shutdown_request(self, request: Any) -> None:
        """Forget a client that has finished."""
        with self._lock:
            self._clients.discard(request)
        super().shutdown_request(request)

    def disconnect_all(self) -> None:
        """Wake every thread that is sending."""
        with self._lock:
            for client in self._clients:
                # It may be gone already.
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)


class _StreamHandler(DeviceHandler):
    def get(self, url: SplitResult) -> None:
        emulator = self.server.emulator
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        sent = emulator.frames.count
        self.wfile.write(emulator.lead_in)
        while not emulator.closing:
            sent, parts = emulator.frames.newer_than(sent)
            for part in parts:
                self.wfile.write(part)


def emulate(settings: MjpegEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated camera."""
    source: FrameSource | Playback
    world = None
    if (playback := settings.playback(clock)) is not None:
        source = playback
    elif settings.view is not None and settings.source is None:
        from rig.mock.world import load_view

        source, world = rendered(load_view(settings.view)), SharedWorld(settings.world)
    elif settings.source is not None and settings.view is None:
        hold = round(_STILL * settings.device.rate_hz) if settings.motion == "still" else 1
        source = looped(settings.source, hold=hold)
    else:
        named = "both" if settings.view else "neither"
        raise ConfigError(f"view, source: found {named}; allowed: one of them")
    emulator = MjpegEmulator(settings, source, world, clock)
    return Served("camera", emulator, emulator.apply, CAMERA_PRIORITY)
