"""What `orbitcal-feedback` writes, without EPICS."""

import math
import unittest

from orbitcal_epics.feedback import Carrier, Config, Feedback

CONFIG = Config(channels={"H_A2": "M:A2:SET"}, limits_A=[-20.0, 20.0], step_A=3.0)


class Value(float):
    """A set point as channel access gives it."""

    def __new__(cls, number, severity=0, timestamp=math.inf, ok=True):
        value = super().__new__(cls, number)
        value.severity, value.timestamp, value.ok = severity, timestamp, ok
        return value


class FeedbackTest(unittest.TestCase):
    def test_set_points_are_approached_in_steps_within_the_limits(self):
        carrier = Carrier(CONFIG, written={"H_A2": 1.0})
        self.assertEqual(carrier.next("H_A2", 2.5), 2.5)
        self.assertEqual(carrier.next("H_A2", 9.0), 4.0)
        self.assertEqual(carrier.next("H_A2", -9.0), -2.0)
        self.assertIsNone(carrier.next("H_A2", 1.0), "it is there")
        for beyond in (20.001, -1e9, math.nan, math.inf):
            self.assertIsNone(carrier.next("H_A2", beyond))

    def test_nothing_is_carried_that_is_invalid_or_old_or_not_connected(self):
        feedback = Feedback(CONFIG)
        feedback.hear(Value(5.0), 0)
        self.assertEqual(feedback.news, {"H_A2": 5.0})
        for value in (Value(6.0, severity=3), Value(6.0, timestamp=0.0), Value(6.0, ok=False)):
            feedback.hear(Value(5.0), 0)
            feedback.hear(value, 0)
            self.assertEqual(feedback.news, {}, "what came before does not count either")

    def test_a_configuration_without_sense_is_refused(self):
        for wrong in ({"limits_A": [1.0, -1.0]}, {"step_A": 0.0}, {"channels": {}}):
            with self.assertRaises(ValueError):
                Config(**{"channels": {"H_A2": "M"}, "limits_A": [-1.0, 1.0], "step_A": 1.0, **wrong})


if __name__ == "__main__":
    unittest.main()
