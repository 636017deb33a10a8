"""The camera driver against the emulated network camera, and the emulator's image sources."""

import itertools
import os
import socket
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.drivers import collect, opening, running
from support.jpegs import stripped, without_stamp

from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.samples import WORLD_STATE
from rig.devices.camera.camera import MjpegDriver, V4l2Driver
from rig.devices.camera.jpeg import frame_stamp, jpeg_size
from rig.devices.camera.mjpeg_emulator import (
    FrameSource,
    MjpegEmulator,
    MjpegEmulatorConfig,
    looped,
    rendered,
)
from rig.devices.camera.settings import MjpegConfig, V4l2Config

CLOCK = SystemClock()
RNG = np.random.default_rng(0)


def encoded(value: int, width: int = 640, height: int = 480) -> bytes:
    return cv2.imencode(".jpg", np.full((height, width, 3), value, np.uint8))[1].tobytes()


def one_image(jpeg: bytes) -> FrameSource:
    """Return an endless source of the same file."""
    return lambda state: jpeg


class CountingWorld:
    """A world in which each state is 1 ms after the previous one."""

    def __init__(self) -> None:
        self.record: Any = np.zeros(1, WORLD_STATE)[0]

    def state(self) -> tuple[int, np.void]:
        self.record["t_ns"] += 1_000_000
        return int(self.record["t_ns"]) // 1_000_000, self.record


def emulated(
    host: str, source: FrameSource, world: Any = None
) -> AbstractContextManager[MjpegEmulator]:
    device = MjpegConfig("http://loopback:8090/", rate_hz=100.0)
    return running(MjpegEmulator(MjpegEmulatorConfig(device, host=host), source, world, CLOCK))


def opened(host: str, **options: Any) -> AbstractContextManager[MjpegDriver]:
    config = MjpegConfig(f"http://{host}:8090/", **({"silence": 20.0} | options))
    return opening(MjpegDriver(config, CLOCK))


def test_the_cameras_own_bytes_arrive_unchanged(host: str) -> None:
    jpeg = encoded(77)
    with emulated(host, one_image(jpeg)), opened(host) as driver:
        samples = collect(driver, 5)
        assert {without_stamp(sample["value"]) for sample in samples} == {jpeg}
        assert all(np.isnan(sample["device_t"]) for sample in samples)
        assert driver.describe() | {"address": ""} == {
            "device": "camera",
            "address": "",
            "backend": "FFMPEG",
            "fourcc": "MJPG",
            "rate_hz": None,
            "width": 640,
            "height": 480,
            "jpeg_bytes_kept": True,
            "device_clock": "none",
            "numbering": "none",
        }


def test_frames_come_in_order_and_are_not_held_back(host: str) -> None:
    with emulated(host, one_image(encoded(5))) as emulator, opened(host) as driver:
        for _ in range(20):
            newest = emulator.frames.count
            stamps = [frame_stamp(sample["value"]) for sample in collect(driver, 1)]
            numbers = [stamp[0] for stamp in stamps if stamp is not None]
            assert numbers == sorted(set(numbers))
            # Frames queued anywhere on the way would show as numbers far behind.
            assert numbers[-1] >= newest - 5


def test_huffman_tables_are_put_into_frames_that_lack_them(host: str) -> None:
    with emulated(host, one_image(stripped(encoded(90)))), opened(host) as driver:
        value = collect(driver, 1)[0]["value"]
        image = cv2.imdecode(np.frombuffer(value, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (480, 640, 3)
        assert abs(int(image.mean()) - 90) <= 1


def test_torn_frames_are_counted_and_left_out(host: str) -> None:
    def tear(jpeg: bytes) -> Iterable[bytes]:
        return (jpeg,) if frame_stamp(jpeg)[0] % 3 else (jpeg[: len(jpeg) // 2], jpeg[2:])

    with emulated(host, one_image(encoded(5))) as emulator:
        emulator.faults.passed = tear
        with opened(host) as driver:
            stamps = [frame_stamp(sample["value"]) for sample in collect(driver, 20)]
            assert all(stamp is not None and stamp[0] % 3 for stamp in stamps)
            assert driver.rejected["corrupt"] >= 9


def test_another_size_than_the_bench_says_is_a_config_error(host: str) -> None:
    with (
        emulated(host, one_image(encoded(5, 320, 240))),
        pytest.raises(ConfigError, match="asked 640x480, got 320x240"),
        opened(host),
    ):
        pass


def test_each_kind_of_camera_refuses_the_addresses_of_the_other() -> None:
    for address in ("/dev/video0", "ftp://h/"):
        with pytest.raises(ValueError, match="kind v4l2"):
            MjpegConfig(address)
    with pytest.raises(ValueError, match="kind mjpeg"):
        V4l2Config("http://h/")
    with pytest.raises(ValueError, match="allowed on a mock bench: mjpeg"):
        V4l2Config().check_mock()


def test_a_missing_v4l2_node_is_device_lost() -> None:
    with pytest.raises(DeviceLost, match="/dev/video99"):
        V4l2Driver(V4l2Config("/dev/video99"), CLOCK).open(0.5)


def test_the_environment_is_as_it_was_after_opening(host: str) -> None:
    before = dict(os.environ)
    with emulated(host, one_image(encoded(5))), opened(host):
        assert dict(os.environ) == before


def test_a_client_that_does_not_read_gets_few_old_frames(host: str) -> None:
    noisy = cv2.imencode(".jpg", RNG.integers(0, 255, (480, 640, 3), np.uint8))[1].tobytes()
    with emulated(host, one_image(noisy)) as emulator:
        with socket.create_connection((host, 8090), 5.0) as slow:
            slow.sendall(b"GET / HTTP/1.0\r\n\r\n")
            while emulator.frames.count < 100:
                emulator.frames.newer_than(emulator.frames.count)
            # The contents of the sockets' buffers, then the newest: not a hundred frames.
            received = b""
            while received.count(b"seq=") < 60 and max(_stamps(received), default=0) < 100:
                received += slow.recv(1 << 20)
        numbers = _stamps(received)
        assert numbers == sorted(numbers)
        assert max(b - a for a, b in itertools.pairwise(numbers)) > 10


def _stamps(received: bytes) -> list[int]:
    return [int(part.split(b" ", 1)[0]) for part in received.split(b"seq=")[1:] if b" " in part]


def test_frames_of_the_world_carry_the_time_of_its_state(host: str) -> None:
    def view(state: np.void) -> np.ndarray:
        return np.full((480, 640, 3), (200, 40, int(state["t_ns"] // 1_000_000) % 100), np.uint8)

    with emulated(host, rendered(view), world=CountingWorld()), opened(host) as driver:
        for sample in collect(driver, 5):
            stamp = frame_stamp(sample["value"])
            assert stamp is not None
            image = cv2.imdecode(np.frombuffer(sample["value"], np.uint8), cv2.IMREAD_COLOR)
            blue, green, red = image[240, 320].astype(int)
            assert (abs(red - 200) < 4, abs(green - 40) < 4) == (True, True)
            assert abs(blue - stamp[1] // 1_000_000 % 100) < 6


def played(source: FrameSource, count: int) -> list[bytes]:
    return [source(np.zeros(1, WORLD_STATE)[0]) for _ in range(count)]


def test_a_folder_is_played_in_natural_order_and_jpeg_of_the_right_size_as_it_is(
    tmp_path: Path,
) -> None:
    images = [encoded(20), encoded(40), encoded(200)]
    for number, image in zip((1, 2, 10), images, strict=True):
        (tmp_path / f"image_{number}.jpg").write_bytes(image)
    assert played(looped(tmp_path), 6) == images * 2
    held = [image for image in images for _ in range(3)]
    assert played(looped(tmp_path, hold=3), 9) == held


def test_images_of_another_size_are_letterboxed(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "wide.png"), np.full((100, 400, 3), 255, np.uint8))
    (jpeg,) = played(looped(tmp_path), 1)
    assert jpeg_size(jpeg) == (640, 480)
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image[240, 320] > 250
    assert image[20, 320] < 5


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no images"):
        looped(tmp_path)


@pytest.mark.parametrize(("size", "kept"), [((640, 480), True), ((320, 240), False)])
def test_a_motion_jpeg_video_of_the_right_size_is_played_byte_for_byte(
    tmp_path: Path, size: tuple[int, int], kept: bool
) -> None:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30, size
    )
    for k in range(3):
        writer.write(np.full((size[1], size[0], 3), 80 * k, np.uint8))
    writer.release()
    frames = played(looped(path), 6)
    assert [jpeg_size(jpeg) for jpeg in frames] == [(640, 480)] * 6
    assert all((jpeg in path.read_bytes()) == kept for jpeg in frames)
    assert frames[:3] == frames[3:]
    assert len(set(frames)) == 3
