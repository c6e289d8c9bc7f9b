"""The simulated machine of a plan behind a soft IOC: `orbitcal-soft-ioc [--period-s S] orbitcal simulate PLAN.toml ...`.

The program behind it (`orbitcal simulate`) holds the physics and says what its channels are; here they become records, on CA and PVA. Every
period it is told the set points and gives the values of the next cycle, which all get the time stamp of that cycle, the counter last.
"""

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time

from softioc import builder, softioc
from softioc.asyncio_dispatcher import AsyncioDispatcher


STAMPED = -2  # the record keeps the time stamp that it is given


class Machine:
    """The simulation, one cycle a line."""

    def __init__(self, command):
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.records = self._line()["records"]

    def cycle(self, set_points, seconds):
        print(json.dumps({"set": set_points, "seconds": seconds}), file=self.process.stdin, flush=True)
        return self._line()["values"]

    def _line(self):
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f"the simulation has ended with status {self.process.wait()}")
        return json.loads(line)


def record(described):
    """The EPICS record of a channel."""
    name, kind, unit = described["name"], described["kind"], described["unit"]
    if kind == "waveform":
        return builder.WaveformIn(name, length=described["length"], datatype=float, EGU=unit, TSE=STAMPED)
    if kind == "counter":
        return builder.longIn(name, TSE=STAMPED)
    if kind == "value":
        return builder.aIn(name, EGU=unit, PREC=6, TSE=STAMPED)
    low, high = described["limits"]
    limits = {"DRVL": low, "DRVH": high, "LOPR": low, "HOPR": high}
    return builder.aOut(name, initial_value=described["value"], always_update=True, EGU=unit, PREC=6, **limits)


def show(record, kind, values, stamp):
    """A value of this cycle; what has none is invalid."""
    if kind == "waveform":
        record.set([math.nan if value is None else value for value in values], timestamp=stamp)
    elif values[0] is None:
        record.set(0, severity=3, alarm=17, timestamp=stamp)  # INVALID, UDF
    else:
        record.set(int(values[0]) if kind == "counter" else values[0], timestamp=stamp)


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--period-s", type=float, default=4.0, help="time between two cycles")
    arguments.add_argument("command", nargs=argparse.REMAINDER, help="orbitcal simulate PLAN.toml ...")
    options = arguments.parse_args()
    machine = Machine(options.command)
    kinds = {one["name"]: one["kind"] for one in machine.records}
    records = {one["name"]: record(one) for one in machine.records}
    counter = next(name for name, kind in kinds.items() if kind == "counter")
    builder.LoadDatabase()
    dispatcher = AsyncioDispatcher()
    softioc.iocInit(dispatcher)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    print(f"{len(records)} records, a cycle every {options.period_s} s", flush=True)
    due = time.monotonic()
    while not stop.wait(max(0.0, due - time.monotonic())):
        set_points = {name: records[name].get() for name, kind in kinds.items() if kind == "set"}
        values, stamp = machine.cycle(set_points, options.period_s), time.time()
        for name in sorted(values, key=lambda name: name == counter):
            show(records[name], kinds[name], values[name], stamp)
        due = max(due + options.period_s, time.monotonic())
    os._exit(0)  # the IOC's threads do not end by themselves
