"""`orbitcal-gateway [CONFIG.toml]`: shared memory in, EPICS out."""

import os
import signal
import sys
import time
from pathlib import Path

import iceoryx2 as iox2
from softioc import builder, imports, softioc
from softioc.asyncio_dispatcher import AsyncioDispatcher

from .beside import Health, Reader, Setpoints
from .config import Config, read
from .estimates import Subscriber
from .records import Records
from .table import Table

BEAT_S = 1.0
GLANCE_S = 0.2  # between two looks at whether to stop
BESIDE_S = 1.5  # for health, which a daemon publishes every second
ACCESS = Path(__file__).with_name("access.acf")


class Gateway:
    """From the first estimate on records exist; until then, and after a silence, nothing pretends to be valid."""

    def __init__(self, config):
        self.config, self.subscriber = config, Subscriber(config.service)
        node = self.subscriber.node
        self.health, self.setpoints = Reader(node, config.service, Health), Reader(node, config.service, Setpoints)
        self.records = self.table = None
        self.steered = None  # when set points came last

    def begin(self, estimate):
        health = self.health.within(BESIDE_S)
        self.records = Records(self.config, estimate, health)
        builder.LoadDatabase()
        imports.dbCore.asSetFilename(str(ACCESS).encode())
        softioc.iocInit(AsyncioDispatcher())
        self.table = Table(f"{self.config.prefix}:TABLE")
        print(f"{self.config.prefix}: {len(estimate.vars)} vars of {estimate.machine}, from {estimate.publisher}", flush=True)

    def run(self, stopped):
        heard = due = time.monotonic()
        stale = False
        while not stopped():
            estimate = self.subscriber.newest(min(GLANCE_S, max(0.01, due - time.monotonic())))
            now = time.monotonic()
            if estimate is not None and self.records is None:
                self.begin(estimate)
            if self.records is not None:
                self.show_beside(now)
            if estimate is not None and self.fits(estimate):
                heard, stale = now, False
                self.records.show(estimate)
                self.table.show(self.config, estimate)
            if self.records is not None and not stale and now - heard > self.config.stale_s:
                stale = True
                self.records.stale()
            if now >= due:
                due = now + BEAT_S
                if self.records is not None:
                    self.records.beat()

    def show_beside(self, now):
        """Set points and health, as they come; set points first, somebody waits for them. A feedback that is off publishes none."""
        if (setpoints := self.setpoints.newest()) is not None:
            self.steered = now
            self.records.show_setpoints(setpoints)
        elif self.steered is not None and now - self.steered > self.config.stale_s:
            self.steered = None
            self.records.setpoints_stale()
        if (health := self.health.newest()) is not None:
            self.records.show_health(health)

    def fits(self, estimate):
        """Records are those of one machine."""
        if estimate.vars == self.records.vars:
            return True
        print(f"passed over: an estimate of {estimate.machine}, whose vars are others", file=sys.stderr, flush=True)
        return False


def main():
    try:
        config = read(sys.argv[1]) if len(sys.argv) > 1 else Config()
    except (OSError, ValueError) as error:
        print(f"orbitcal-gateway: {error}", file=sys.stderr)
        sys.exit(2)
    stop = []
    gateway = Gateway(config)
    for number in (signal.SIGINT, signal.SIGTERM):  # iceoryx2 takes them when its node is made
        signal.signal(number, lambda *_: stop.append(True))
    print(f"listening on {config.service}", flush=True)
    try:
        gateway.run(lambda: bool(stop))
    except (iox2.NodeWaitFailure, iox2.ListenerWaitError):
        pass  # a signal
    del gateway.subscriber
    os._exit(0)  # the IOC's threads do not end by themselves
