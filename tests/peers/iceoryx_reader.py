"""Read published estimates from shared memory (PyPI: iceoryx2==0.10.0, the version that orbitcal is built with).

Usage: iceoryx_reader.py [SERVICE [COUNT [SECONDS]]]; the defaults are orbitcal/estimate, no end, and 20 s without news.
Prints the sequence number and D8 of every estimate, then how many came and how many are missing between them.
Exit status 0 if COUNT came and none is missing.
"""

import ctypes
import sys
import time

import iceoryx2 as iox2

VARS, MONITORS = 48, 33
D8 = 15  # of A2 A4 A6 A8 B2 .. F8, then A1 A3 A5 A7 B1 .. F7


class Estimate(ctypes.Structure):
    """The layout of EstimateRecord in host-bridge/src/record.rs, which says what each field means."""

    _fields_ = [
        ("time_us", ctypes.c_uint64),
        ("clipped", ctypes.c_uint64),
        ("accepted", ctypes.c_uint64),
        ("rejected", ctypes.c_uint64),
        ("started_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("sequence", ctypes.c_uint32),
        ("frames", ctypes.c_uint32),
        ("rejected_frames", ctypes.c_uint32),
        ("linearised", ctypes.c_uint32),
        ("nis", ctypes.c_float),
        ("log_evidence", ctypes.c_float),
        ("mean", ctypes.c_float * VARS),
        ("sigma", ctypes.c_float * VARS),
        ("map_params", ctypes.c_float * VARS),
        ("params_sigma", ctypes.c_float * VARS),
        ("covariance", ctypes.c_float * (VARS * (VARS + 1) // 2)),
        ("monitor_sigma", ctypes.c_float * MONITORS),
        ("monitor_rejected", ctypes.c_uint32 * MONITORS),
        ("monitor_state", ctypes.c_uint8 * MONITORS),
        ("padding", ctypes.c_uint8 * 7),
    ]

    @staticmethod
    def type_name():
        return "orbitcal.Estimate.v1"


assert ctypes.sizeof(Estimate) == 5848


def join(name):
    """Both ends of the service; with the publisher's settings, so that either side may start first."""
    iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
    service = iox2.ServiceName.new(name)
    estimates = (
        node.service_builder(service)
        .publish_subscribe(Estimate)
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
            estimate = Estimate.from_buffer_copy(sample.payload().contents)
            sample.delete()
            heard = time.monotonic()
            yield estimate


def main(name="orbitcal/estimate", count="0", seconds="20"):
    seen, lost, last = 0, 0, {}  # last frame count of each publisher, by its start
    for estimate in estimates(name, float(seconds)):
        seen += 1
        lost += estimate.frames - last.get(estimate.started_ns, estimate.frames - 1) - 1
        last[estimate.started_ns] = estimate.frames
        print(f"seq {estimate.sequence} D8 {estimate.mean[D8]:.4f} +- {estimate.sigma[D8]:.4f}", flush=True)
        if seen == int(count):
            break
    print(f"{seen} estimates seen, {lost} lost")
    return 0 if lost == 0 and seen >= int(count) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
