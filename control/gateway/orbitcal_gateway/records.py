"""The records of one machine, and an estimate shown on them."""

import math

from softioc import alarm, builder

from . import severity


class Records:
    """Records by the names of docs/control-system.md; made once, for the vars of the first estimate."""

    def __init__(self, config, estimate):
        self.config, self.vars = config, list(estimate.vars)
        builder.SetDeviceName(config.prefix)
        low, high = config.mean_limits
        alarm_low, alarm_high = config.mean_alarm
        shown = {"PREC": 4, "EGU": "1", "LOPR": low, "HOPR": high, "LOLO": alarm_low, "HIHI": alarm_high}
        shown.update(LLSV="MAJOR", HHSV="MAJOR")
        spread = {"PREC": 5, "EGU": "1", "LOPR": 0, "HOPR": config.sigma_major}
        spread.update(HIGH=config.sigma_minor, HIHI=config.sigma_major, HSV="MINOR", HHSV="MAJOR")
        self.mean = [builder.aIn(f"{name}:MEAN", DESC=f"strength factor of {name}", **shown) for name in self.vars]
        self.sigma = [builder.aIn(f"{name}:SIGMA", DESC=f"standard deviation of {name}", **spread) for name in self.vars]
        count = len(self.vars)
        self.means = builder.WaveformIn("MEANS", length=count, datatype=float, EGU="1", PREC=4)
        self.sigmas = builder.WaveformIn("SIGMAS", length=count, datatype=float, EGU="1", PREC=5)
        self.names = builder.WaveformIn("NAMES", initial_value=self.vars)
        self.sequence = builder.longIn("SEQUENCE", DESC="counter of the machine cycle")
        self.heartbeat = builder.longIn("HEARTBEAT", DESC="counts up once a second")
        self.nis = builder.aIn("NIS", DESC="normalised innovation squared", PREC=2, EGU="1")
        self.mismatch = builder.mbbIn("MISMATCH", *severity.MISMATCH, DESC="do the readings fit the model")
        self.faulty = builder.longIn("FAULTY_MONITORS", DESC="monitors that are not ok")
        self.machine = builder.longStringIn("MACHINE", initial_value=estimate.machine, length=128)
        self.setpoints = [self._setpoint(corrector) for corrector in config.setpoints]
        self.beats = 0

    def _setpoint(self, corrector):
        """A feedback set point; whoever steers may write it where that is configured, and somebody else carries it to the machine."""
        low, high = self.config.setpoint_limits_A
        limits = {"EGU": "A", "PREC": 3, "LOPR": low, "HOPR": high}
        name = f"{corrector}:SETPOINT"
        if not self.config.writable:
            return builder.aOut(name, initial_value=0.0, **limits)
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
        faulty = sum(state != 0 for state in estimate.monitor_state)
        put(self.faulty, faulty, (severity.MINOR, severity.SOFT) if faulty else (severity.NO_ALARM, severity.NONE), stamp)
        put(self.sequence, signed(estimate.sequence), (severity.NO_ALARM, severity.NONE), stamp)

    def stale(self):
        """Nothing new for too long: values stay, and are invalid."""
        everything = [*self.mean, *self.sigma, self.means, self.sigmas, self.mismatch, self.nis, self.faulty, self.sequence]
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
