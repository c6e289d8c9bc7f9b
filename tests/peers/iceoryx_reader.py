"""Read published estimates from shared memory (PyPI: iceoryx2==0.10.0, the version that orbitcal is built with).

Usage: iceoryx_reader.py [SERVICE [COUNT [SECONDS]]]; the defaults are orbitcal/estimate, no end, and 20 s without news.
Prints the publisher, the sequence number and the strength factor (var) farthest from 1 of every estimate, then how many
came and how many are missing between them. Exit status 0 if COUNT came and none is missing.
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


def estimates(name, seconds):
    """Every estimate as it comes, until there is none for some seconds."""
    node, listener, subscriber = join(name)
    print(f"listening on {name}", flush=True)
    heard = time.monotonic()
    while time.monotonic() - heard < seconds:
        try:
            node.wait(iox2.Duration.from_millis(0))
            listener.timed_wait(iox2.Duration.from_millis(100))
        except (iox2.NodeWaitFailure, iox2.ListenerWaitError):  # SIGINT or SIGTERM
            return
        while (sample := subscriber.receive()) is not None:  # one wake-up may stand for many
            header = Header.from_buffer_copy(sample.user_header().contents)
            payload = sample.payload()
            estimate = Estimate(header, ctypes.string_at(payload.as_ptr(), 4 * payload.len()))
            sample.delete()
            heard = time.monotonic()
            yield estimate


def main(name="orbitcal/estimate", count="0", seconds="20"):
    seen, lost, last = 0, 0, {}  # last frame count of each publisher, by its start
    for estimate in estimates(name, float(seconds)):
        header = estimate.header
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
