"""Estimates as they come from shared memory; the layout is docs/shared-memory.md."""

import ctypes
import math
import struct
import time

import iceoryx2 as iox2


class Header(ctypes.Structure):
    """The header of an estimate."""

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
        n, b = header.vars, header.monitors
        words = len(payload) // 4
        need = 5 * n + n + n * (n + 1) // 2 + 4 * b
        if words < need:
            raise ValueError(f"a record of {words} words, {need} are needed for {n} vars and {b} monitors")
        numbers = struct.unpack_from(f"<{2 * n}f", payload)
        self.mean, self.sigma = numbers[:n], numbers[n:]
        readings = 4 * (6 * n + n * (n + 1) // 2)
        self.reading = struct.unpack_from(f"<{b}I", payload, readings)
        self.monitor_state = struct.unpack_from(f"<{b}I", payload, readings + 4 * b)
        text = payload[4 * need : 4 * need + header.text_bytes].decode()
        names = text.splitlines()
        self.publisher, self.machine = names[:2]
        self.vars, self.monitors = names[2 : 2 + n], names[2 + n :]
        if len(self.vars) != n or len(self.monitors) != b:
            raise ValueError(f"{len(names)} names in a record of {n} vars and {b} monitors")
        self.sequence, self.frames = header.sequence, header.frames
        self.mismatch, self.nis = header.mismatch, header.nis
        self.published_s = header.published_ns / 1e9
        self.started_ns = header.started_ns

    def usable(self, i):
        """Whether mean and sigma of a var are numbers."""
        return math.isfinite(self.mean[i]) and math.isfinite(self.sigma[i]) and self.sigma[i] > 0


class Subscriber:
    """Both ends of the service, opened with the publisher's settings, so that either side may start first."""

    def __init__(self, name):
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        self.node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
        service = iox2.ServiceName.new(name)
        estimates = (
            self.node.service_builder(service)
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
        news = self.node.service_builder(service).event().max_listeners(16).max_notifiers(4).max_nodes(24)
        self.listener = news.open_or_create().listener_builder().create()
        self.subscriber = estimates.subscriber_builder().create()

    def newest(self, seconds):
        """The newest estimate that comes within some seconds; None without one. Those before it are passed over."""
        come = self._wait(seconds, lambda records: records[-1:])
        return come[0] if come else None

    def all(self, seconds):
        """All estimates that have come, once there is one; none if none comes within some seconds."""
        return self._wait(seconds, lambda records: records)

    def _wait(self, seconds, wanted):
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.listener.timed_wait(iox2.Duration.from_millis(max(1, min(100, int(1000 * left)))))
            records = []
            while (sample := self.subscriber.receive()) is not None:  # one wake-up may stand for many
                payload = sample.payload()
                header = Header.from_buffer_copy(sample.user_header().contents)
                records.append((header, ctypes.string_at(payload.as_ptr(), 4 * payload.len())))
                sample.delete()
            if records:
                return [Estimate(*record) for record in wanted(records)]
        return []
