"""Health and set points, which a daemon publishes beside its estimates; the layouts are in docs/daemon.md."""

import ctypes
import struct
import time

import iceoryx2 as iox2


class HealthHeader(ctypes.Structure):
    """The header of a health record."""

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


class SetpointHeader(ctypes.Structure):
    """The header of a record of set points."""

    _fields_ = [
        ("published_ns", ctypes.c_uint64),
        ("sequence", ctypes.c_uint32),
        ("frames", ctypes.c_uint32),
        ("hold", ctypes.c_uint32),
        ("left_out", ctypes.c_uint32),
        ("limited", ctypes.c_uint32),
        ("correctors", ctypes.c_uint32),
        ("text_bytes", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        return "orbitcal.Setpoints.v1"


assert ctypes.sizeof(HealthHeader) == 48 and ctypes.sizeof(SetpointHeader) == 40


class Health:
    """State of every monitor and corrector."""

    Header, SUFFIX = HealthHeader, "/health"

    def __init__(self, header, payload):
        count = header.monitors + header.correctors
        self.states = struct.unpack_from(f"<{count}I", payload)
        self.names = text(header, payload, 4 * count)[1:]
        expect_one_each(self.names, self.states)
        self.monitors = header.monitors
        self.mismatch = header.mismatch
        self.chi2_per_dof = header.chi_square / header.degrees_of_freedom if header.degrees_of_freedom > 0 else float("nan")
        self.published_s = header.published_ns / 1e9

    def by_name(self):
        return dict(zip(self.names, self.states))


class Setpoints:
    """Set points of the orbit feedback."""

    Header, SUFFIX = SetpointHeader, "/setpoints"

    def __init__(self, header, payload):
        count = header.correctors
        self.current = struct.unpack_from(f"<{count}f", payload)
        self.role = struct.unpack_from(f"<{count}I", payload, 4 * count)
        self.names = text(header, payload, 2 * count)[1:]
        expect_one_each(self.names, self.current)
        self.hold, self.left_out, self.limited = header.hold, header.left_out, header.limited
        self.sequence = header.sequence
        self.published_s = header.published_ns / 1e9


def text(header, payload, words):
    """Names after so many words."""
    return payload[4 * words : 4 * words + header.text_bytes].decode().splitlines()


def expect_one_each(names, values):
    if len(names) != len(values):
        raise ValueError(f"{len(names)} names for {len(values)} values")


class Reader:
    """The last record of one kind; a publisher that starts later is found."""

    def __init__(self, node, service, kind):
        self.kind = kind
        opened = (
            node.service_builder(iox2.ServiceName.new(service + kind.SUFFIX))
            .publish_subscribe(iox2.Slice[ctypes.c_uint32])
            .user_header(kind.Header)
            .history_size(1)
            .subscriber_max_buffer_size(16)
            .enable_safe_overflow(True)
            .max_subscribers(16)
            .max_publishers(4)
            .max_nodes(24)
            .open_or_create()
        )
        self.subscriber = opened.subscriber_builder().create()

    def newest(self):
        """The newest record since the last call; None without one."""
        newest = None
        while (sample := self.subscriber.receive()) is not None:
            payload = sample.payload()
            header = self.kind.Header.from_buffer_copy(sample.user_header().contents)
            newest = self.kind(header, ctypes.string_at(payload.as_ptr(), 4 * payload.len()))
            sample.delete()
        return newest

    def within(self, seconds):
        """The newest record that is there within some seconds; None without one."""
        until = time.monotonic() + seconds
        while (newest := self.newest()) is None and time.monotonic() < until:
            time.sleep(0.02)
        return newest
