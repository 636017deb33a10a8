"""The camera driver on a V4L2 node that a preloaded library provides for one process only."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support import hidraw_nodes

SHIM = r"""
// A V4L2 capture node for one process, by LD_PRELOAD: 640x480 YUYV or MJPG, four-buffer queue,
// CLOCK_MONOTONIC stamps. FAKE_JPEG: file sent as MJPG (none: the camera has YUYV only).
// FAKE_UNPLUG_AFTER, FAKE_FREEZE_AFTER: number of frames. FAKE_SKIP_EVERY: frames lost.
// FAKE_GAIN_STUCK: gain cannot be set. FAKE_STAMP_AT_START: times are of the start of exposure.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>
#define NODE "/dev/video77"
#define WIDTH 640
#define HEIGHT 480
#define SIZE (WIDTH * HEIGHT * 2)
#define BUFFERS 8
#define FPS 100
#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static struct { unsigned char *bytes; int queued; unsigned used; long seq; double t; } buf[BUFFERS];
static int node = -1, count, waiting[BUFFERS], n_waiting, done[BUFFERS], n_done, streaming;
static unsigned format = V4L2_PIX_FMT_YUYV;
static long tick, taken;
static double t0;
static int exposure_auto = 3, exposure = 166, gain = 64, white_auto = 1;
static unsigned char jpeg[SIZE];
static long jpeg_bytes;

static long number(const char *name) { char *s = getenv(name); return s ? atol(s) : -1; }
static double now(void) {
    struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec + t.tv_nsec * 1e-9;
}
static int unplugged(void) {
    long after = number("FAKE_UNPLUG_AFTER"); return after >= 0 && taken >= after;
}
static void fill(int i) {
    if (format == V4L2_PIX_FMT_YUYV) {
        for (int k = 0; k < SIZE; k += 4) memcpy(buf[i].bytes + k, "\x51\x5a\x51\xf0", 4);
        buf[i].used = SIZE;
    } else {
        char text[80];
        int n = sprintf(text, "tactile-rig emulator seq=%ld state_t_ns=%lld", buf[i].seq,
                        (long long)(buf[i].t * 1e9));
        unsigned char head[6] = {0xff, 0xd8, 0xff, 0xfe, 0, n + 2};
        memcpy(buf[i].bytes, head, 6);
        memcpy(buf[i].bytes + 6, text, n);
        memcpy(buf[i].bytes + 6 + n, jpeg + 2, jpeg_bytes - 2);
        buf[i].used = 4 + n + jpeg_bytes;
    }
}
static void advance(void) {
    long freeze = number("FAKE_FREEZE_AFTER"), skip = number("FAKE_SKIP_EVERY");
    while (streaming && t0 + (tick + 1.0) / FPS <= now()) {
        tick++;
        if (skip > 0 && tick % skip == 0) continue;
        if (!n_waiting || (freeze >= 0 && taken >= freeze)) continue;
        int i = waiting[0];
        memmove(waiting, waiting + 1, --n_waiting * sizeof(int));
        buf[i].queued = 0; buf[i].seq = tick; buf[i].t = t0 + (double)tick / FPS;
        fill(i);
        done[n_done++] = i;
    }
}
static int wait_frame(double seconds) {
    for (double end = now() + seconds; now() < end; usleep(500)) {
        advance();
        if (n_done || unplugged()) return 1;
    }
    return 0;
}
static int open_node(void) {
    FILE *f = getenv("FAKE_JPEG") ? fopen(getenv("FAKE_JPEG"), "rb") : 0;
    if (f) { jpeg_bytes = fread(jpeg, 1, SIZE, f); fclose(f); }
    return node = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
}
#define OPEN(open) int open(const char *path, int flags, ...) { \
    va_list a; va_start(a, flags); mode_t mode = va_arg(a, int); va_end(a); \
    return strcmp(path, NODE) ? REAL(open)(path, flags, mode) : open_node(); }
OPEN(open)
OPEN(open64)
int close(int fd) {
    if (fd >= 0 && fd == node) { node = -1; streaming = count = n_waiting = n_done = 0; }
    return REAL(close)(fd);
}
#define MMAP(mmap) void *mmap(void *at, size_t n, int prot, int flags, int fd, off_t offset) { \
    if (fd >= 0 && fd == node) return buf[offset / SIZE].bytes; \
    return REAL(mmap)(at, n, prot, flags, fd, offset); }
MMAP(mmap)
MMAP(mmap64)
int munmap(void *at, size_t size) {
    for (int i = 0; i < BUFFERS; i++) if (at && at == buf[i].bytes) return 0;
    return REAL(munmap)(at, size);
}
int select(int n, fd_set *r, fd_set *w, fd_set *x, struct timeval *t) {
    if (node < 0 || !r || n <= node || !FD_ISSET(node, r)) return REAL(select)(n, r, w, x, t);
    int ready = wait_frame(t->tv_sec + t->tv_usec * 1e-6);
    if (!ready) FD_ZERO(r);
    return ready;
}
int poll(struct pollfd *fds, nfds_t n, int ms) {
    if (n != 1 || node < 0 || fds[0].fd != node) return REAL(poll)(fds, n, ms);
    int ready = wait_frame(ms * 1e-3);
    fds[0].revents = ready ? POLLIN : 0;
    return ready;
}
static int refuse(int why) { errno = why; return -1; }
static int control(struct v4l2_control *c, int set) {
    int *value = c->id == V4L2_CID_EXPOSURE_AUTO ? &exposure_auto
               : c->id == V4L2_CID_EXPOSURE_ABSOLUTE ? &exposure
               : c->id == V4L2_CID_AUTO_WHITE_BALANCE ? &white_auto
               : c->id == V4L2_CID_GAIN ? &gain : 0;
    if (!value) return refuse(EINVAL);
    if (!set) c->value = *value;
    else if (value == &exposure && exposure_auto != 1) return refuse(EIO);
    else if (value != &gain || !getenv("FAKE_GAIN_STUCK")) *value = c->value;
    return 0;
}
static void describe(struct v4l2_buffer *b) {
    int i = b->index;
    b->memory = V4L2_MEMORY_MMAP; b->length = SIZE; b->m.offset = i * SIZE;
    b->bytesused = buf[i].used;
    b->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    if (getenv("FAKE_STAMP_AT_START")) b->flags |= V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
    b->sequence = buf[i].seq;
    b->timestamp.tv_sec = (long)buf[i].t;
    b->timestamp.tv_usec = (long)((buf[i].t - (long)buf[i].t) * 1e6);
}
static int request(unsigned long code, void *arg) {
    if (unplugged()) return refuse(ENODEV);
    switch (code) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *c = arg;
        memset(c, 0, sizeof *c);
        strcpy((char *)c->driver, "uvcvideo"); strcpy((char *)c->card, "Fake Camera");
        c->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        c->capabilities = c->device_caps | V4L2_CAP_DEVICE_CAPS;
        return 0; }
    case VIDIOC_G_FMT: case VIDIOC_S_FMT: case VIDIOC_TRY_FMT: {
        struct v4l2_pix_format *p = &((struct v4l2_format *)arg)->fmt.pix;
        if (code != VIDIOC_G_FMT && (p->pixelformat == V4L2_PIX_FMT_YUYV ||
            (p->pixelformat == V4L2_PIX_FMT_MJPEG && jpeg_bytes))) format = p->pixelformat;
        p->width = WIDTH; p->height = HEIGHT; p->pixelformat = format; p->sizeimage = SIZE;
        p->bytesperline = format == V4L2_PIX_FMT_YUYV ? WIDTH * 2 : 0;
        p->field = V4L2_FIELD_NONE;
        return 0; }
    case VIDIOC_G_PARM: case VIDIOC_S_PARM: {
        struct v4l2_captureparm *p = &((struct v4l2_streamparm *)arg)->parm.capture;
        p->capability = V4L2_CAP_TIMEPERFRAME;
        p->timeperframe.numerator = 1; p->timeperframe.denominator = FPS;
        return 0; }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *r = arg;
        count = r->count = r->count > BUFFERS ? BUFFERS : r->count;
        streaming = n_waiting = n_done = 0;
        for (int i = 0; i < count; i++) {
            if (!buf[i].bytes) buf[i].bytes = aligned_alloc(4096, SIZE + 4096);
            buf[i].queued = 0;
        }
        return 0; }
    case VIDIOC_QUERYBUF: describe(arg); return 0;
    case VIDIOC_QBUF: {
        int i = ((struct v4l2_buffer *)arg)->index;
        if (i >= count || buf[i].queued) return refuse(EINVAL);
        advance();
        buf[i].queued = 1; waiting[n_waiting++] = i;
        return 0; }
    case VIDIOC_DQBUF: {
        struct v4l2_buffer *b = arg;
        advance();
        if (!n_done) return refuse(EAGAIN);
        b->index = done[0];
        memmove(done, done + 1, --n_done * sizeof(int));
        describe(b);
        taken++;
        return 0; }
    case VIDIOC_STREAMON: streaming = 1; t0 = now(); tick = 0; return 0;
    case VIDIOC_STREAMOFF:
        streaming = n_waiting = n_done = 0;
        for (int i = 0; i < count; i++) buf[i].queued = 0;
        return 0;
    case VIDIOC_QUERYCTRL: {
        struct v4l2_queryctrl *q = arg;
        struct v4l2_control c = {q->id, 0};
        q->minimum = 0; q->maximum = 10000; q->step = 1; q->flags = 0;
        return control(&c, 0); }
    case VIDIOC_G_CTRL: return control(arg, 0);
    case VIDIOC_S_CTRL: return control(arg, 1);
    }
    return refuse(ENOTTY);
}
int ioctl(int fd, unsigned long code, ...) {
    va_list a; va_start(a, code); void *arg = va_arg(a, void *); va_end(a);
    if (fd >= 0 && fd == node) return request(code & 0xffffffff, arg);
    return ((int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl"))(fd, code, arg);
}
"""

CLIENT = """
import json, sys
import numpy as np
from rig.devices.camera.settings import V4l2Config
from rig.devices.camera.jpeg import frame_stamp
from rig.devices.camera.camera import V4l2Driver
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost

options = {"address": "/dev/video77", "rate_hz": 100.0} | json.loads(sys.argv[1])
driver = V4l2Driver(V4l2Config(**options), SystemClock())
found = {"samples": [], "error": None}
try:
    driver.open(1.0)
    found["properties"] = driver.describe()
    while len(found["samples"]) < 200:
        for sample in driver.read(1.0):
            value = sample["value"]
            found["samples"].append({
                "t_ns": sample["t_ns"],
                "device_t": sample["device_t"],
                "seq": sample["seq"],
                "stamp": frame_stamp(value) if isinstance(value, bytes) else None,
                "shape": None if isinstance(value, bytes) else value.shape,
                "pixel": None if isinstance(value, bytes) else value[240, 320].tolist(),
            })
except (ConfigError, DeviceLost) as error:
    found["error"] = [type(error).__name__, str(error)]
finally:
    found["dropped"] = driver.dropped
    driver.close()
    driver.close()
print(json.dumps(found))
"""


@pytest.fixture(name="shim", scope="module")
def compiled_shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler on Linux to fake a V4L2 node")
    folder = tmp_path_factory.mktemp("v4l2")
    (folder / "shim.c").write_text(SHIM)
    command = [compiler, "-O1", "-w", "-shared", "-fPIC", "-o", "shim.so", "shim.c", "-ldl"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if built.returncode != 0:
        pytest.skip(f"the fake V4L2 node does not compile here: {built.stderr[:200]}")
    cv2.imwrite(str(folder / "frame.jpg"), np.full((480, 640, 3), 90, np.uint8))
    return folder


def seen(shim: Path, options: dict[str, Any], *, mjpg: bool = True, **faults: int) -> Any:
    """Return the driver's results for a camera with `faults`, from a separate process."""
    variables = {f"FAKE_{name.upper()}": value for name, value in faults.items()}
    if mjpg:
        variables["FAKE_JPEG"] = shim / "frame.jpg"
    text = hidraw_nodes.run(shim / "shim.so", CLIENT, json.dumps(options), **variables)
    return json.loads(text)


def test_jpeg_frames_carry_the_buffers_own_monotonic_time_until_the_camera_is_unplugged(
    shim: Path,
) -> None:
    found = seen(shim, {"exposure": 0.008, "gain": 12}, unplug_after=40)
    assert found["properties"]["backend"] == "V4L2"
    assert found["properties"]["jpeg_bytes_kept"] is True
    assert found["properties"]["device_clock"] == "monotonic"
    assert found["properties"]["stamp"] == "end"
    assert found["properties"]["rate_hz"] == 100.0
    assert found["properties"]["automatic"] == ["white balance"]  # the exposure was set
    assert len(found["samples"]) >= 35
    for sample in found["samples"]:
        number, t_ns = sample["stamp"]
        assert number == sample["seq"] > 0
        assert sample["device_t"] == pytest.approx(t_ns / 1e9, abs=2e-6)
        assert sample["device_t"] * 1e9 < sample["t_ns"]
    assert found["error"][0] == "DeviceLost"
    assert "unplugged" in found["error"][1]


def test_frames_that_the_node_lost_are_gaps_and_times_may_be_of_the_start_of_exposure(
    shim: Path,
) -> None:
    found = seen(shim, {}, skip_every=7, unplug_after=60, stamp_at_start=1)
    assert found["properties"]["stamp"] == "start"
    assert found["properties"]["automatic"] == ["exposure", "white balance"]
    numbers = [sample["seq"] for sample in found["samples"]]
    assert all(number % 7 for number in numbers)
    lost = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert lost >= 8
    assert found["dropped"] == lost
    assert found["properties"]["numbering"] == "device"


@pytest.mark.parametrize(("after", "fewest", "most"), [(20, 11, 24), (0, 0, 0)])
def test_a_camera_that_falls_silent_or_never_sends_is_lost(
    shim: Path, after: int, fewest: int, most: int
) -> None:
    found = seen(shim, {"silence": 0.3}, freeze_after=after)
    assert fewest <= len(found["samples"]) <= most
    assert found["error"][0] == "DeviceLost"
    assert not after or "no frame for 0.3 s" in found["error"][1]


def test_yuyv_frames_come_as_rgb(shim: Path) -> None:
    found = seen(shim, {"fourcc": "YUYV"}, mjpg=False, unplug_after=20)
    assert found["properties"]["jpeg_bytes_kept"] is False
    sample = found["samples"][-1]
    assert sample["shape"] == [480, 640, 3]
    red, green, blue = sample["pixel"]
    assert red > 240 > 20 > green + blue  # Y, U, V = 81, 90, 240


@pytest.mark.parametrize(
    ("options", "mjpg", "complaint"),
    [
        ({}, False, "fourcc: asked MJPG, got YUYV"),
        ({"width": 800}, True, "width: asked 800, got 640"),
        ({"rate_hz": 30.0}, True, "rate_hz: asked 30, got 100"),
        ({"gain": 12}, True, "gain: asked 12, got 64"),
    ],
)
def test_a_setting_the_camera_did_not_take_is_a_config_error(
    shim: Path, options: dict[str, Any], mjpg: bool, complaint: str
) -> None:
    found = seen(shim, options, mjpg=mjpg, gain_stuck=1)
    assert found["error"][0] == "ConfigError"
    assert complaint in found["error"][1]
