"""Updates of channels gathered into machine cycles by their time stamps. Nothing here knows of EPICS.

A cycle begins with an update of its counter. It waits for the channels that are updated every cycle, so long at most as is configured, and
becomes a frame in the order of the counter.

- A waveform counts if its time stamp is that of the cycle within the window, else its monitors have no reading.
- A read-back counts as it last was: control systems send what has changed. One that is not connected, or invalid, is not known,
  and there is no frame.
- A channel that did not come in time is not waited for, until it is updated with a cycle again.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass, field

from .wire import LARGEST_CURRENT_A, LARGEST_POSITION_MM, LARGEST_RF

KEPT = 64  # updates of a channel
STEP_S = 1.0  # a clock that is off the steady one by more from cycle to cycle was set


@dataclass
class Sample:
    """An update of a channel."""

    value: list
    stamp: float  # of the control system [s since 1970]
    heard: float  # of a steady clock here [s]
    invalid: bool = False

    def number(self):
        """The number of a channel that holds one."""
        value = self.value[0] if self.value else math.nan
        return value if math.isfinite(value) and not self.invalid else None


@dataclass
class Cycle:
    """A cycle that waits for its values."""

    number: int
    epoch: int
    stamp: float
    heard: float
    time_us: int
    before: float  # when the cycle before it was heard
    waits: set = field(default_factory=set)


class Gatherer:
    """Gathers the channels of a request, whose keys are those of `control::Gathering`."""

    def __init__(self, request, wall_s):
        self.request = request
        self.window, self.late_s = request["match_window_s"], request["late_s"]
        self.tunes = request["tune"] or []
        self.read_backs = [*request["corrector"], *request["supply"], *filter(None, [request["dipole"]])]
        self.rf = request["rf"]["channel"] if request["rf"] else None
        waveforms = [one["channel"] for one in request["monitors"]]
        each = dict.fromkeys([*waveforms, *self.tunes, *self.read_backs, *filter(None, [self.rf])])
        self.kept = {channel: deque(maxlen=KEPT) for channel in each}
        self.expected = set(each)
        self.pending = deque()
        self.last = self.done = None
        self.began_us = round(1e6 * wall_s)
        # larger in each life of this process, as long as clocks are right
        self.epoch = int(wall_s)
        self.faults, self.why = Counter(), ""

    def channels(self):
        """All channels, the counter last."""
        return [*self.kept, self.request["cycle"]]

    def hear(self, channel, sample):
        """Take an update."""
        if channel == self.request["cycle"]:
            return self._begin(sample)
        self.kept[channel].append(sample)
        matched = [cycle for cycle in self.pending if self._is_of(sample, cycle)]
        for cycle in matched:
            cycle.waits.discard(channel)
        late = not matched and self.done is not None and self._is_of(sample, self.done)
        self.faults["updates came late"] += late
        if matched or late:
            self.expected.add(channel)

    def lose(self, channel):
        """The connection is lost: what the channel last was is not known to be so any more."""
        self.faults["channels lost"] += 1
        if channel in self.kept:
            self.kept[channel].clear()

    def frames(self, now):
        """The frames of all cycles that are complete, or have waited long enough."""
        frames = []
        while self.pending and (not self.pending[0].waits or now - self.pending[0].heard >= self.late_s):
            self.done = self.pending.popleft()
            self.expected -= self.done.waits
            try:
                frames.append(self._frame(self.done))
            except ValueError as why:
                self.faults["cycles gave no frame"] += 1
                self.why = f"cycle {self.done.number}: {why}"
        return frames

    def said(self):
        """What went wrong so far; nothing if nothing did."""
        counted = ", ".join(f"{count} {what}" for what, count in self.faults.items() if count)
        return f"so far {counted}" + (f"; the last: {self.why}" if self.why else "") if counted else ""

    def _begin(self, sample):
        number, last = sample.number(), self.last
        if number is None or number < 0:
            return
        number = int(number)
        if last is not None and number == last.number:
            self.faults["cycles were told twice"] += 1
            return
        if last is not None and number < last.number:
            # the counter began anew: the machine's IOC was started again
            self.epoch = max(self.epoch + 1, self.began_us // 1_000_000)
            self.faults["counters began anew"] += 1
        time_us = self._time(sample)
        cycle = Cycle(number, self.epoch, sample.stamp, sample.heard, time_us, last.heard if last else -math.inf)
        cycle.waits = {channel for channel in self.expected if not self._near(channel, cycle)}
        self.pending.append(cycle)
        self.last = cycle

    def _time(self, sample):
        """Time of a cycle [us]: that of the control system, unless its clock was set."""
        if self.last is None:
            return self.began_us
        elapsed, steady = sample.stamp - self.last.stamp, sample.heard - self.last.heard
        if not 0 < elapsed < math.inf or abs(elapsed - steady) > STEP_S:
            self.faults["clocks were set"] += 1
            elapsed = max(steady, 1e-6)
        return self.last.time_us + round(1e6 * elapsed)

    def _is_of(self, sample, cycle):
        return abs(sample.stamp - cycle.stamp) <= self.window

    def _near(self, channel, cycle):
        """The update of a channel with this cycle."""
        near = [sample for sample in self.kept[channel] if self._is_of(sample, cycle)]
        return min(near, key=lambda sample: abs(sample.stamp - cycle.stamp), default=None)

    def _read_back(self, channel, cycle):
        """A number as it last was. An update from before the cycle before counts whatever its stamp says: the clock may have been set."""
        for sample in reversed(self.kept[channel]):
            if sample.stamp <= cycle.stamp + self.window or sample.heard <= cycle.before:
                if (number := sample.number()) is not None:
                    return number
                break
        raise ValueError(f"{channel} has no valid number")

    def _current(self, channel, cycle):
        current = self._read_back(channel, cycle)
        if abs(current) > LARGEST_CURRENT_A:
            raise ValueError(f"{channel} is at {current} A")
        return current

    def _main(self, channel, cycle):
        current = self._current(channel, cycle)
        if current <= 0.0:
            raise ValueError(f"the main supply {channel} is at {current} A")
        return current

    def _readings(self, cycle):
        readings = [None] * self.request["count"]
        for waveform in self.request["monitors"]:
            sample = self._near(waveform["channel"], cycle)
            if sample is None or sample.invalid:
                continue
            for slot, mm in zip(waveform["slots"], sample.value):
                readings[slot] = mm if math.isfinite(mm) and abs(mm) <= LARGEST_POSITION_MM else None
        if all(mm is None for mm in readings):
            raise ValueError("no monitor reports")
        return readings

    def _tune(self, channel, cycle):
        sample = self._near(channel, cycle)
        tune = sample.number() if sample else None
        return tune if tune is not None and 0.0 <= tune < 1.0 else None

    def _rf_offset(self, cycle):
        if self.rf is None:
            return 0.0
        offset = self._read_back(self.rf, cycle) / self.request["rf"]["nominal_Hz"] - 1.0
        if abs(offset) > LARGEST_RF:
            raise ValueError(f"{self.rf} is {offset:+.3%} off its nominal value")
        return offset

    def _frame(self, cycle):
        request = self.request
        return {
            "epoch": cycle.epoch,
            "sequence": cycle.number & 0xFFFF_FFFF,
            "time_us": cycle.time_us,
            "cycle_time_us": request["cycle_time_us"],
            "corrector": [self._current(channel, cycle) for channel in request["corrector"]],
            "dipole": self._main(request["dipole"], cycle) if request["dipole"] else None,
            "supply": [self._main(channel, cycle) for channel in request["supply"]],
            "rf_offset": self._rf_offset(cycle),
            "reading_mm": self._readings(cycle),
            "tune": [self._tune(channel, cycle) for channel in self.tunes] or [None, None],
        }
