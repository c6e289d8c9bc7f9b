"""`orbitcal-feedback CONFIG.toml`: carries the gateway's set points to the machine, within limits.

Nothing else in orbitcal writes to correctors while the beam is steered, and this writes nothing else:

- a set point that is INVALID, or that has not come for `stale_s`, is not written; the corrector stays where it is;
- no corrector is written that the table does not name, nor beyond `limits_A`;
- a set point that is further than `step_A` from what was written last is approached by so much each time it comes. The first time, what was
  written last is what the machine is at.
"""

import asyncio
import math
import signal
import sys
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import aioca

INVALID = 3  # alarm severity
TIMEOUT_S = 5.0


@dataclass
class Config:
    """The file, key by key."""

    channels: dict  # set point of the machine, by corrector
    limits_A: list
    step_A: float
    prefix: str = "ORBITCAL"
    stale_s: float = 2.0

    def __post_init__(self):
        low, high = self.limits_A
        if not (low < high and self.step_A > 0 and self.stale_s > 0 and self.channels):
            raise ValueError("expected rising limits_A, positive step_A and stale_s, and channels")


@dataclass
class Carrier:
    """What is written where."""

    config: Config
    written: dict = field(default_factory=dict)
    refused: dict = field(default_factory=dict)

    def next(self, corrector, wanted):
        """What is written next; None for nothing."""
        low, high = self.config.limits_A
        if not math.isfinite(wanted) or not low <= wanted <= high:
            return None
        at, step = self.written[corrector], self.config.step_A
        to = min(max(wanted, at - step), at + step)
        return None if to == at else to


class Feedback:
    """From the gateway to the machine."""

    def __init__(self, config):
        self.carrier = Carrier(config)
        self.names = list(config.channels)
        self.news = {}
        self.wake = asyncio.Event()

    async def run(self, stopped):
        config = self.carrier.config
        machine = [config.channels[name] for name in self.names]
        for name, now in zip(self.names, await aioca.caget(machine, timeout=TIMEOUT_S)):
            self.carrier.written[name] = float(now)
        set_points = [f"{config.prefix}:{name}:SETPOINT" for name in self.names]
        aioca.camonitor(set_points, self.hear, format=aioca.FORMAT_TIME, notify_disconnect=True, connect_timeout=math.inf)
        print(f"orbitcal-feedback: {len(self.names)} correctors, within {config.limits_A} A", flush=True)
        while not stopped.is_set():
            try:
                await asyncio.wait_for(self.wake.wait(), 0.2)
            except TimeoutError:
                continue
            self.wake.clear()
            await self.write()

    def hear(self, value, index):
        name = self.names[index]
        is_fresh = value.ok and value.severity < INVALID and time.time() - value.timestamp < self.carrier.config.stale_s
        if is_fresh:
            self.news[name] = float(value)
            self.wake.set()
        else:
            self.news.pop(name, None)

    async def write(self):
        """All that has come, at once."""
        news, self.news = self.news, {}
        due = {name: self.carrier.next(name, wanted) for name, wanted in news.items()}
        due = {name: to for name, to in due.items() if to is not None}
        if not due:
            return
        channels = [self.carrier.config.channels[name] for name in due]
        done = await aioca.caput(channels, list(due.values()), timeout=TIMEOUT_S, throw=False)
        for (name, to), one in zip(due.items(), done):
            if one.ok:
                self.carrier.written[name] = to
            elif self.carrier.refused.get(name) != str(one):
                self.carrier.refused[name] = str(one)
                print(f"orbitcal-feedback: {one}", file=sys.stderr, flush=True)


async def serve(config):
    stopped, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    await Feedback(config).run(stopped)


def main():
    try:
        config = Config(**tomllib.loads(Path(sys.argv[1]).read_text()))
    except (IndexError, OSError, TypeError, ValueError) as error:
        print(f"orbitcal-feedback: {sys.argv[1:] or 'expected a CONFIG.toml'}: {error}", file=sys.stderr)
        sys.exit(2)
    asyncio.run(serve(config))
