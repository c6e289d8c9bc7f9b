"""`orbitcal-epics-source`: monitors of EPICS channels, gathered into machine cycles, as wire frames on stdout.

The daemon starts it and writes on its stdin, in one line of JSON, which channels there are. It ends with its input. Channels that are not
there, or go away, are waited for: channel access connects again by itself. A zero byte a second says that it lives.
"""

import asyncio
import json
import math
import os
import sys
import threading
import time

import aioca

from .gather import Gatherer, Sample
from .wire import encode

INVALID = 3  # alarm severity
TICK_S = 0.02  # between two looks at what has waited long enough
BEAT_S = 1.0
SAY_S = 10.0


class Source:
    """From monitors to stdout."""

    def __init__(self, request):
        self.gatherer = Gatherer(request, time.time())
        self.out = os.fdopen(sys.stdout.fileno(), "wb", buffering=0)
        self.said = ("", -math.inf)
        self.beaten = -math.inf

    async def run(self):
        names = self.gatherer.channels()
        aioca.camonitor(
            names, self.update, format=aioca.FORMAT_TIME, all_updates=True, notify_disconnect=True, connect_timeout=math.inf
        )
        while True:
            await asyncio.sleep(TICK_S)
            self.give()
            now = time.monotonic()
            if now - self.beaten >= BEAT_S:
                self.beaten = now
                self.out.write(b"\x00")
            self.say(now)

    def update(self, value, index):
        channel = self.gatherer.channels()[index]
        if not value.ok:
            self.gatherer.lose(channel)
            return
        several = [float(one) for one in value] if hasattr(value, "__len__") else [float(value)]
        sample = Sample(several, value.timestamp, time.monotonic(), value.severity >= INVALID)
        self.gatherer.hear(channel, sample)
        if channel == self.gatherer.request["cycle"]:
            self.give()

    def give(self):
        for frame in self.gatherer.frames(time.monotonic()):
            self.out.write(encode(frame))

    def say(self, now):
        text, when = self.said
        new = self.gatherer.said()
        if new != text and now - when >= SAY_S:
            self.said = (new, now)
            print(f"orbitcal-epics-source: {new}", file=sys.stderr, flush=True)


def end_with_input():
    """The daemon is gone, or wants no more."""
    while sys.stdin.buffer.read(1024):
        pass
    os._exit(0)


def main():
    request = json.loads(sys.stdin.buffer.readline() or b"null")
    if request is None:
        sys.exit("orbitcal-epics-source: expected the channels as a line of JSON on stdin, see docs/control-system.md")
    threading.Thread(target=end_with_input, daemon=True).start()
    try:
        asyncio.run(Source(request).run())
    except BrokenPipeError:
        pass  # the daemon is gone
