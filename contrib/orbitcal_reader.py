"""Read a daemon's estimates and its health from shared memory: an example to build on, in one file.

It needs nothing but the package iceoryx2==0.10.0 from PyPI, the version that orbitcal is built with, and the daemon's user.

Usage: orbitcal_reader.py [SERVICE [COUNT [SECONDS]]]; the defaults are orbitcal/estimate, no end, and 20 s without news.
Prints the publisher, each estimate's sequence number and the strength factor (var) farthest from 1, monitors and correctors
that are not ok, then how many estimates came and how many are missing between them. Exit status 0 if COUNT came and none is missing.
"""

import ctypes
import struct
import sys
import time

import iceoryx2 as iox2


class Header(ctypes.Structure):
    """The header of docs/shared-memory.md, which says what each field means."""

    _fields_ = [
        ("time_us", ctypes.c_uint64),
        ("started_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("sequence", ctypes.c_uint32),
        ("frames", ctypes.c_uint32),
        ("rejected_frames", ctypes.c_uint32),
        ("linearised", ctypes.c_uint32),
        ("mismatch", ctypes.c_uint32),
        ("nis", ctypes.c_float),
        ("log_evidence", ctypes.c_float),
        ("tune_innovation", ctypes.c_float * 2),
        ("vars", ctypes.c_uint32),
        ("monitors", ctypes.c_uint32),
        ("text_bytes", ctypes.c_uint32),
        ("remarks", ctypes.c_uint32),
        ("put_aside_frames", ctypes.c_uint32),
        ("baselines_moved", ctypes.c_uint32),
        ("unsolved_frames", ctypes.c_uint32),
        ("tables", ctypes.c_uint32),
        ("usable", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        return "orbitcal.Estimate.v4"


assert ctypes.sizeof(Header) == 96


class Estimate:
    """One estimate, of a ring of any size."""

    def __init__(self, header, payload):
        self.header, self._rest = header, payload
        n, b = header.vars, header.monitors
        self.mean, self.sigma = self._take("f", n), self._take("f", n)
        self.map_params, self.centre, self.params_sigma = (self._take("f", n) for _ in range(3))
        self.clipped = self._take("I", n)
        self.covariance = self._take("f", n * (n + 1) // 2)
        self.reading, self.monitor_state = self._take("I", b), self._take("I", b)
        self.monitor_sigma, self.monitor_rejected = self._take("f", b), self._take("I", b)
        names = self._rest[: header.text_bytes].decode().splitlines()
        self.publisher, self.machine = names[:2]
        self.vars, self.monitors = names[2 : 2 + n], names[2 + n :]
        assert len(self.monitors) == b, f"{len(self.monitors)} names of {b} monitors"

    def _take(self, kind, count):
        taken, self._rest = self._rest[: 4 * count], self._rest[4 * count :]
        return struct.unpack(f"<{count}{kind}", taken)

    def farthest(self):
        """The var that is farthest from 1 in error bars."""
        away = [abs(mean - 1) / sigma if sigma > 0 else 0 for mean, sigma in zip(self.mean, self.sigma)]
        i = away.index(max(away))
        return f"{self.vars[i]} {self.mean[i]:.4f} ± {self.sigma[i]:.4f}"


class HealthHeader(ctypes.Structure):
    """The header of the health in docs/daemon.md, which says what each field means."""

    _fields_ = [
        ("published_ns", ctypes.c_uint64),
        ("sequence", ctypes.c_uint32),
        ("frames", ctypes.c_uint32),
        ("mismatch", ctypes.c_uint32),
        ("chi_square", ctypes.c_float),
        ("degrees_of_freedom", ctypes.c_float),
        ("excess", ctypes.c_float),
        ("monitors", ctypes.c_uint32),
        ("correctors", ctypes.c_uint32),
        ("text_bytes", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        return "orbitcal.Health.v1"


assert ctypes.sizeof(HealthHeader) == 48
STATES = ["ok", "noisy", "jumps", "dead", "back"]


class Health:
    """State and filtered ratios of every monitor, then of every corrector."""

    def __init__(self, header, payload):
        count = header.monitors + header.correctors
        codes = struct.unpack(f"<{count}I", payload[: 4 * count])
        ratios = struct.unpack(f"<{3 * count}f", payload[4 * count : 16 * count])
        names = payload[16 * count :][: header.text_bytes].decode().splitlines()
        self.header, self.machine = header, names[0]
        self.state = dict(zip(names[1:], (STATES[code] for code in codes)))
        self.scatter, self.jumps, self.missing = (ratios[i * count : (i + 1) * count] for i in range(3))
        assert len(self.state) == count, f"{len(self.state)} names of {count} instruments"

    def unwell(self):
        """Those that are not ok, with their states."""
        return [f"{name} {state}" for name, state in self.state.items() if state != "ok"]


def bytes_of(sample):
    """The payload of a sample, copied: the sample goes back to its writer."""
    payload = sample.payload()
    return ctypes.string_at(payload.as_ptr(), 4 * payload.len())


class HealthReader:
    """The last health of a daemon: it is there for whoever joins, and comes anew every second."""

    def __init__(self, node, name):
        service = node.service_builder(iox2.ServiceName.new(name + "/health"))
        service = service.publish_subscribe(iox2.Slice[ctypes.c_uint32]).user_header(HealthHeader)
        service = service.history_size(1).subscriber_max_buffer_size(16).enable_safe_overflow(True)
        service = service.max_subscribers(16).max_publishers(4).max_nodes(24).open_or_create()
        self._subscriber = service.subscriber_builder().create()

    def newest(self):
        """What has come since the last call; None if nothing has."""
        newest = None
        while (sample := self._subscriber.receive()) is not None:
            newest = Health(HealthHeader.from_buffer_copy(sample.user_header().contents), bytes_of(sample))
            sample.delete()
        return newest


def join(name):
    """Both ends of the service; with the publisher's settings, so that either side may start first."""
    iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
    service = iox2.ServiceName.new(name)
    estimates = (
        node.service_builder(service)
        .publish_subscribe(iox2.Slice[ctypes.c_uint32])
        .user_header(Header)
        .history_size(16)
        .subscriber_max_buffer_size(256)
        .enable_safe_overflow(True)
        .max_subscribers(16)
        .max_publishers(4)
        .max_nodes(24)
        .open_or_create()
    )
    news = node.service_builder(service).event().max_listeners(16).max_notifiers(4).max_nodes(24).open_or_create()
    return node, news.listener_builder().create(), estimates.subscriber_builder().create()


def news(name, seconds):
    """Every estimate, and health, as they come, until there is no estimate for some seconds."""
    node, listener, subscriber = join(name)
    health = HealthReader(node, name)
    print(f"listening on {name}", flush=True)
    heard = time.monotonic()
    while time.monotonic() - heard < seconds:
        try:
            node.wait(iox2.Duration.from_millis(0))
            listener.timed_wait(iox2.Duration.from_millis(100))
        except (iox2.NodeWaitFailure, iox2.ListenerWaitError):  # SIGINT or SIGTERM
            return
        while (sample := subscriber.receive()) is not None:  # one wake-up may stand for many
            estimate = Estimate(Header.from_buffer_copy(sample.user_header().contents), bytes_of(sample))
            sample.delete()
            heard = time.monotonic()
            yield estimate
        if (newest := health.newest()) is not None:
            yield newest


def main(name="orbitcal/estimate", count="0", seconds="20"):
    seen, lost, last = 0, 0, {}  # last frame count of each publisher, by its start
    for estimate in news(name, float(seconds)):
        header = estimate.header
        if isinstance(estimate, Health):
            fit = header.chi_square / header.degrees_of_freedom if header.degrees_of_freedom > 0 else 0
            unwell = ", ".join(estimate.unwell()) or "all ok"
            print(f"health after {header.frames} frames: chi2/dof {fit:.3f}, {len(estimate.state)} instruments, {unwell}", flush=True)
            continue
        seen += 1
        lost += header.frames - last.get(header.started_ns, header.frames - 1) - 1
        if header.started_ns not in last:
            print(f"from {estimate.publisher}: {estimate.machine}, {header.vars} vars, {header.monitors} monitors")
        last[header.started_ns] = header.frames
        print(f"seq {header.sequence} {estimate.farthest()}", flush=True)
        if seen == int(count):
            break
    print(f"{seen} estimates seen, {lost} lost")
    return 0 if lost == 0 and seen >= int(count) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
