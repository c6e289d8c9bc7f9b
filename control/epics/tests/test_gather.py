"""The gathering of cycles by time stamps, without EPICS; and the bytes of a frame against docs/frame.md.

    python -m unittest discover -s control/epics/tests
"""

import math
import re
import unittest
from pathlib import Path

from orbitcal_epics.gather import Gatherer, Sample
from orbitcal_epics.wire import cobs, encode

REQUEST = {
    "cycle": "CYCLE",
    "monitors": [{"channel": "X", "slots": [0, 1]}, {"channel": "Y", "slots": [2]}],
    "count": 3,
    "corrector": ["C1", "C2"],
    "supply": ["Q"],
    "dipole": "B",
    "rf": {"channel": "RF", "nominal_Hz": 1e6},
    "tune": ["TX", "TY"],
    "cycle_time_us": 92_000,
    "match_window_s": 0.01,
    "late_s": 0.2,
}
VALUES = {"X": [1.0, 2.0], "Y": [3.0], "TX": [0.8], "TY": [0.6], "C1": [5.0], "C2": [-5.0], "Q": [1800.0], "B": [2400.0], "RF": [1e6]}
EPOCH_S = 1_700_000_000.0
DOCS = Path(__file__).parents[3] / "docs" / "frame.md"


class Machine:
    """Cycles of a machine, a second apart, as updates of a gatherer; times [s] from 0 on."""

    def __init__(self, **request):
        self.gatherer = Gatherer({**REQUEST, **request}, EPOCH_S)
        self.frames = []

    def update(self, channel, value, at, heard=None, invalid=False):
        heard = at if heard is None else heard
        self.gatherer.hear(channel, Sample(value, EPOCH_S + at, heard, invalid))
        self.frames += self.gatherer.frames(heard)

    def cycle(self, number, at, heard=None, without=(), **values):
        for channel, value in {**VALUES, **values}.items():
            if channel not in without:
                self.update(channel, value, at, heard)
        self.update("CYCLE", [float(number)], at, heard)

    def wait(self, now):
        self.frames += self.gatherer.frames(now)

    def numbers(self):
        return [frame["sequence"] for frame in self.frames]


class GatherTest(unittest.TestCase):
    def test_a_cycle_is_a_frame_at_once(self):
        machine = Machine()
        machine.cycle(7, 0.0)
        [frame] = machine.frames
        self.assertEqual(frame["reading_mm"], [1.0, 2.0, 3.0])
        self.assertEqual((frame["sequence"], frame["epoch"], frame["time_us"]), (7, 1_700_000_000, 1_700_000_000_000_000))
        self.assertEqual((frame["corrector"], frame["supply"], frame["dipole"]), ([5.0, -5.0], [1800.0], 2400.0))
        self.assertEqual((frame["tune"], frame["rf_offset"]), ([0.8, 0.6], 0.0))

    def test_a_missing_value_or_waveform_is_an_empty_reading(self):
        machine = Machine()
        machine.cycle(1, 0.0, X=[math.nan, 250.0])
        self.assertEqual(machine.frames[0]["reading_mm"], [None, None, 3.0])
        machine.cycle(2, 1.0, without=["Y"])
        self.assertEqual(len(machine.frames), 1, "it is waited for")
        machine.wait(1.21)
        self.assertEqual(machine.frames[1]["reading_mm"], [1.0, 2.0, None])
        # once missing, it is not waited for
        machine.cycle(3, 2.0, without=["Y"])
        self.assertEqual(machine.numbers(), [1, 2, 3])
        # an INVALID waveform is none
        machine.update("X", [1.0, 2.0], 3.0, invalid=True)
        machine.cycle(4, 3.0, without=["X"])
        self.assertEqual(machine.frames[3]["reading_mm"], [None, None, 3.0])

    def test_a_waveform_of_another_cycle_is_none(self):
        machine = Machine()
        machine.cycle(1, 0.0)
        machine.update("Y", [9.0], 0.98)  # beyond the window
        machine.cycle(2, 1.0, without=["Y"])
        machine.wait(1.3)
        self.assertEqual(machine.frames[1]["reading_mm"], [1.0, 2.0, None])

    def test_a_cycle_with_nothing_is_no_frame(self):
        machine = Machine()
        machine.cycle(1, 0.0, X=[math.nan] * 2, Y=[math.nan])
        machine.cycle(2, 1.0)
        self.assertEqual(machine.numbers(), [2])
        self.assertIn("1 cycles gave no frame; the last: cycle 1: no monitor reports", machine.gatherer.said())

    def test_late_values_are_waited_for_and_the_order_is_kept(self):
        machine = Machine(late_s=1.5)
        machine.cycle(1, 0.0)
        machine.cycle(2, 1.0, without=["X"])
        machine.cycle(3, 2.0)
        self.assertEqual(machine.numbers(), [1], "the third waits for the second")
        machine.update("X", [8.0, 9.0], 1.0, heard=2.2)
        self.assertEqual(machine.numbers(), [1, 2, 3])
        self.assertEqual(machine.frames[1]["reading_mm"], [8.0, 9.0, 3.0])
        # too late, said; the next time it is waited for again
        machine.cycle(4, 3.0, without=["X"])
        machine.wait(4.6)
        machine.update("X", [8.0, 9.0], 3.0, heard=4.7)
        machine.cycle(5, 5.0, without=["X"])
        self.assertEqual(machine.numbers(), [1, 2, 3, 4])
        self.assertIn("1 updates came late", machine.gatherer.said())

    def test_read_backs_count_as_they_last_were(self):
        machine = Machine()
        machine.cycle(1, 0.0)
        machine.cycle(2, 1.0, without=["C1", "C2", "Q", "B", "RF"])
        machine.wait(1.21)
        machine.cycle(3, 2.0, without=["C1", "C2", "Q", "B", "RF"], C2=[-6.0])
        self.assertEqual(machine.numbers(), [1, 2, 3], "the third is not waited for")
        self.assertEqual(machine.frames[2]["corrector"], [5.0, -5.0])
        # one of the next cycle that has come already is not of this one
        machine.update("C1", [7.0], 3.5)
        machine.cycle(4, 3.0, heard=3.6, without=["C1"])
        self.assertEqual(machine.frames[3]["corrector"][0], 5.0)

    def test_without_a_read_back_there_is_no_frame(self):
        machine = Machine()
        machine.cycle(1, 0.0)
        machine.gatherer.lose("C2")
        machine.cycle(2, 1.0, without=["C2"])
        machine.wait(1.3)
        machine.update("C2", [0.0], 2.0, invalid=True)
        machine.cycle(3, 2.0, without=["C2"])
        machine.cycle(4, 3.0, Q=[0.0])
        machine.cycle(5, 4.0)
        self.assertEqual(machine.numbers(), [1, 5])
        self.assertIn("3 cycles gave no frame; the last: cycle 4: the main supply Q is at 0.0 A", machine.gatherer.said())

    def test_a_cycle_that_is_told_twice_is_one(self):
        machine = Machine()
        machine.cycle(1, 0.0)
        machine.update("CYCLE", [1.0], 0.0, heard=5.0)  # a connection that came back
        machine.cycle(2, 6.0)
        self.assertEqual(machine.numbers(), [1, 2])

    def test_a_counter_that_begins_anew_is_another_epoch(self):
        machine = Machine()
        machine.cycle(900, 0.0)
        machine.cycle(1, 10.0)
        machine.cycle(2, 11.0)
        epochs = [frame["epoch"] for frame in machine.frames]
        self.assertEqual((machine.numbers(), epochs), ([900, 1, 2], [1_700_000_000] + 2 * [1_700_000_001]))

    def test_a_clock_that_is_set_changes_no_time(self):
        for step in (-3600.0, 3600.0):
            machine = Machine()
            machine.cycle(1, 0.0)
            machine.cycle(2, 1.0)
            machine.cycle(3, 2.0 + step, heard=2.0)
            machine.cycle(4, 3.0 + step, heard=3.0, without=["C1"])  # it has not changed since the clock was set
            machine.wait(3.3)
            times = [frame["time_us"] - machine.frames[0]["time_us"] for frame in machine.frames]
            self.assertEqual(times, [0, 1_000_000, 2_000_000, 3_000_000])
            self.assertEqual(machine.frames[3]["reading_mm"], [1.0, 2.0, 3.0])
            self.assertIn("1 clocks were set", machine.gatherer.said())

    def test_a_clock_that_is_set_back_keeps_read_backs_that_do_not_change(self):
        machine = Machine()
        machine.cycle(1, 0.0)
        machine.cycle(2, 1.0 - 3600.0, heard=1.0, without=["C1"])
        machine.wait(1.3)
        machine.cycle(3, 2.0 - 3600.0, heard=2.0, without=["C1"])
        self.assertEqual(machine.frames[-1]["corrector"], [5.0, -5.0])
        self.assertEqual(machine.numbers()[-1], 3)

    def test_the_radio_frequency_counts_relative_to_its_nominal_value(self):
        machine = Machine()
        machine.cycle(1, 0.0, RF=[1.0002e6])
        machine.cycle(2, 1.0, RF=[1.2e6])
        self.assertEqual(machine.numbers(), [1])
        self.assertAlmostEqual(machine.frames[0]["rf_offset"], 2e-4, places=12)
        self.assertEqual(Machine(rf=None).gatherer.channels().count("RF"), 0)


class WireTest(unittest.TestCase):
    def test_the_worked_example_has_these_bytes(self):
        text = re.search(r"On the wire:\n\n```text\n(.*?)```", DOCS.read_text(), re.S)[1]
        frame = {
            "epoch": 1,
            "sequence": 7,
            "time_us": 28_000_000,
            "cycle_time_us": 92_000,
            "corrector": [22.0, -1.3e-3, 0.5e-3],
            "dipole": 2399.785,
            "supply": [1800.013, 1790.202],
            "rf_offset": 2e-4,
            "reading_mm": [2.89, -1.8666],
            "tune": [0.80562, None],
            "intensity": 4.5e9,
        }
        self.assertEqual(encode(frame), bytes.fromhex(text))

    def test_long_runs_without_a_zero_are_cut(self):
        for length in (0, 1, 253, 254, 255, 600):
            data = bytes(1 + i % 255 for i in range(length)) + b"\x00\x07"
            self.assertEqual(decode(cobs(data)), data, length)


def decode(coded):
    """The other way, byte by byte."""
    out, at = bytearray(), 0
    while at < len(coded):
        code = coded[at]
        out += coded[at + 1 : at + code]
        at += code
        if code < 255 and at < len(coded):
            out.append(0)
    return bytes(out)


if __name__ == "__main__":
    unittest.main()
