"""The records of one machine, and an estimate shown on them."""

import math

from softioc import alarm, builder

from . import severity

STAMPED = -2  # a record keeps the time stamp that it is given
LEFT_OUT = 2  # role of a corrector in a record of set points


class Records:
    """Records by the names of docs/control-system.md; made once, for the vars of the first estimate."""

    def __init__(self, config, estimate, health=None):
        self.config, self.vars = config, list(estimate.vars)
        builder.SetDeviceName(config.prefix)
        low, high = config.mean_limits
        alarm_low, alarm_high = config.mean_alarm
        shown = {"TSE": STAMPED, "PREC": 4, "EGU": "1", "LOPR": low, "HOPR": high, "LOLO": alarm_low, "HIHI": alarm_high}
        shown.update(LLSV="MAJOR", HHSV="MAJOR")
        spread = {"TSE": STAMPED, "PREC": 5, "EGU": "1", "LOPR": 0, "HOPR": config.sigma_major}
        spread.update(HIGH=config.sigma_minor, HIHI=config.sigma_major, HSV="MINOR", HHSV="MAJOR")
        self.mean = [builder.aIn(f"{name}:MEAN", DESC=f"strength factor of {name}", **shown) for name in self.vars]
        self.sigma = [builder.aIn(f"{name}:SIGMA", DESC=f"standard deviation of {name}", **spread) for name in self.vars]
        count = len(self.vars)
        self.means = builder.WaveformIn("MEANS", length=count, datatype=float, EGU="1", PREC=4, TSE=STAMPED)
        self.sigmas = builder.WaveformIn("SIGMAS", length=count, datatype=float, EGU="1", PREC=5, TSE=STAMPED)
        self.names = builder.WaveformIn("NAMES", initial_value=self.vars)
        self.sequence = builder.longIn("SEQUENCE", DESC="counter of the machine cycle", TSE=STAMPED)
        self.heartbeat = builder.longIn("HEARTBEAT", DESC="counts up once a second")
        self.nis = builder.aIn("NIS", DESC="normalised innovation squared", PREC=2, EGU="1", TSE=STAMPED)
        self.mismatch = builder.mbbIn("MISMATCH", *severity.MISMATCH, TSE=STAMPED, DESC="do the readings fit the model")
        self.faulty = builder.longIn("FAULTY_MONITORS", DESC="monitors that are not ok", TSE=STAMPED)
        self.machine = builder.longStringIn("MACHINE", initial_value=estimate.machine, length=128)
        self._make_health(health)
        self._make_setpoints(health)
        self.beats = 0

    def _make_health(self, health):
        """A state for every monitor and corrector, where a daemon publishes its health."""
        words, names = [word for word, _ in severity.STATES], health.names if health else []
        self.states = {name: builder.mbbIn(f"{name}:STATE", *words, TSE=STAMPED, DESC=f"health of {name}") for name in names}
        self.faulty_correctors = builder.longIn("FAULTY_CORRECTORS", DESC="correctors that are not ok", TSE=STAMPED)
        self.chi2 = builder.aIn("CHI2_PER_DOF", DESC="chi-square of the readings over dof", PREC=3, EGU="1", TSE=STAMPED)
        for record in (self.faulty_correctors, self.chi2):
            put(record, 0, (severity.INVALID, severity.UDF), None)

    def _make_setpoints(self, health):
        """A set point for every corrector, and whether the feedback holds; INVALID until a feedback is on."""
        correctors = self.config.setpoints or (health.names[health.monitors :] if health else [])
        self.setpoints = {corrector: self._setpoint(corrector) for corrector in correctors}
        self.hold = builder.mbbIn("FEEDBACK:HOLD", *[word for word, _ in severity.HOLDS], TSE=STAMPED, DESC="why set points stay as they are")
        self.left_out = builder.longIn("FEEDBACK:LEFT_OUT", DESC="correctors that do not follow", TSE=STAMPED)
        self.limited = builder.longIn("FEEDBACK:LIMITED", DESC="correctors at their limit", TSE=STAMPED)
        for record in (self.hold, self.left_out, self.limited):
            put(record, 0, (severity.INVALID, severity.UDF), None)

    def _setpoint(self, corrector):
        """A feedback set point; somebody else carries it to the machine. Whoever steers instead may write it where that is configured."""
        low, high = self.config.setpoint_limits_A
        limits = {"EGU": "A", "PREC": 3, "LOPR": low, "HOPR": high}
        name = f"{corrector}:SETPOINT"
        if not self.config.writable:
            record = builder.aIn(name, TSE=STAMPED, **limits)
            put(record, 0.0, (severity.INVALID, severity.UDF), None)  # nobody is to write this 0 to the machine
            return record
        return builder.aOut(name, initial_value=0.0, DRVL=low, DRVH=high, always_update=True, ASG="SETPOINT", **limits)

    def show(self, estimate):
        """All values of an estimate, with the time at which it was published; the sequence number last."""
        stamp = estimate.published_s
        for i in range(len(self.vars)):
            if estimate.usable(i):
                put(self.mean[i], estimate.mean[i], severity.of_mean(self.config, estimate, i), stamp)
                put(self.sigma[i], estimate.sigma[i], severity.of_sigma(self.config, estimate.sigma[i]), stamp)
            else:
                put(self.mean[i], math.nan, (severity.INVALID, severity.UDF), stamp)
                put(self.sigma[i], math.nan, (severity.INVALID, severity.UDF), stamp)
        mismatch = severity.of_mismatch(estimate)
        put(self.means, list(estimate.mean), mismatch, stamp)
        put(self.sigmas, list(estimate.sigma), (severity.NO_ALARM, severity.NONE), stamp)
        put(self.mismatch, min(estimate.mismatch, 2), mismatch, stamp)
        put(self.nis, estimate.nis, mismatch, stamp)
        if not self.states:
            self._count(self.faulty, [state != 0 for state in estimate.monitor_state], stamp)
        put(self.sequence, signed(estimate.sequence), (severity.NO_ALARM, severity.NONE), stamp)

    def show_health(self, health):
        """State of every instrument; those that appear later have no record."""
        stamp = health.published_s
        for name, code in health.by_name().items():
            if record := self.states.get(name):
                put(record, code, severity.of_code(severity.STATES, code), stamp)
        if self.states:
            faulty = [code in severity.FAULTY for code in health.states]
            self._count(self.faulty, faulty[: health.monitors], stamp)
            self._count(self.faulty_correctors, faulty[health.monitors :], stamp)
            put(self.chi2, health.chi2_per_dof, severity.of_mismatch(health), stamp)

    def show_setpoints(self, setpoints):
        """Set points as the feedback has them: INVALID beyond the configured limits, MINOR of one that does not follow."""
        stamp, (low, high) = setpoints.published_s, self.config.setpoint_limits_A
        for name, current, role in zip(setpoints.names, setpoints.current, setpoints.role):
            if record := self.setpoints.get(name):
                if not low <= current <= high:
                    self._put_setpoint(record, min(max(current, low), high), (severity.INVALID, severity.SOFT), stamp)
                else:
                    self._put_setpoint(record, current, severity.of_count(role == LEFT_OUT), stamp)
        put(self.hold, setpoints.hold, severity.of_code(severity.HOLDS, setpoints.hold), stamp)
        put(self.left_out, setpoints.left_out, severity.of_count(setpoints.left_out), stamp)
        put(self.limited, setpoints.limited, severity.of_count(setpoints.limited), stamp)

    def _put_setpoint(self, record, value, how, stamp):
        """One that may be written is an output record, which takes the time of now."""
        if self.config.writable:
            worst, status = how
            record.set(value, severity=worst, alarm=status)
        else:
            put(record, value, how, stamp)

    def _count(self, record, faulty, stamp):
        put(record, sum(faulty), severity.of_count(any(faulty)), stamp)

    def stale(self):
        """Nothing new for too long: values stay, and are invalid."""
        everything = [*self.mean, *self.sigma, self.means, self.sigmas, self.mismatch, self.nis, self.faulty, self.sequence]
        everything += [*self.states.values(), self.faulty_correctors, self.chi2]
        for record in everything:
            record.set_alarm(severity.INVALID, alarm.TIMEOUT_ALARM)
        self.setpoints_stale()

    def setpoints_stale(self):
        """No feedback is on: nobody is to follow what it said last. One that may be written is another's."""
        everything = [self.hold, self.left_out, self.limited]
        everything += [] if self.config.writable else self.setpoints.values()
        for record in everything:
            record.set_alarm(severity.INVALID, alarm.TIMEOUT_ALARM)

    def beat(self):
        """The gateway lives, whether or not anything is published."""
        self.beats += 1
        self.heartbeat.set(signed(self.beats))


def put(record, value, how, stamp):
    worst, status = how
    record.set(value, severity=worst, alarm=status, timestamp=stamp)


def signed(counter):
    """A counter of 32 bits in a record of 31."""
    return counter & 0x7FFF_FFFF
