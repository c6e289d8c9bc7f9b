"""The gateway's configuration: one TOML file, every key with a default."""

import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path


@dataclass
class Config:
    """What an operator may change; docs/control-system.md explains each key."""

    prefix: str = "ORBITCAL"
    service: str = "orbitcal/estimate"
    mean_limits: list = field(default_factory=lambda: [0.8, 1.2])  # display limits of a var
    mean_alarm: list = field(default_factory=lambda: [0.94, 1.06])  # MAJOR beyond
    sigma_minor: float = 0.01
    sigma_major: float = 0.03
    stale_s: float = 20.0
    setpoints: list = field(default_factory=list)  # correctors with a set point; none: those of the daemon's feedback
    setpoint_limits_A: list = field(default_factory=lambda: [-25.0, 25.0])
    writable: bool = False


def read(path):
    """The configuration of a file; all that is wrong with it at once."""
    text = tomllib.loads(Path(path).read_text())
    known = {one.name: one for one in fields(Config)}
    default = Config()
    wrong = []
    for key, value in text.items():
        if key not in known:
            wrong.append(f"{key}: unknown, expected one of {', '.join(known)}")
            continue
        wanted = getattr(default, key)
        number = isinstance(wanted, float) and isinstance(value, int | float) and not isinstance(value, bool)
        if not number and type(value) is not type(wanted):
            wrong.append(f"{key}: expected {type(wanted).__name__}, found {value!r}")
        elif isinstance(wanted, float) and value <= 0:
            wrong.append(f"{key}: expected a positive number, found {value}")
        elif key.startswith("mean_") or key == "setpoint_limits_A":
            numbers = all(isinstance(one, int | float) for one in value)
            if len(value) != 2 or not numbers or value[0] >= value[1]:
                wrong.append(f"{key}: expected two rising numbers, found {value}")
        elif key == "setpoints" and not all(isinstance(one, str) for one in value):
            wrong.append(f"{key}: expected names of correctors, found {value}")
    config = Config(**{key: value for key, value in text.items() if key in known})
    if not wrong and config.sigma_minor >= config.sigma_major:
        wrong.append(f"sigma_minor: expected less than sigma_major = {config.sigma_major}, found {config.sigma_minor}")
    if wrong:
        raise ValueError(f"{path}: " + "; ".join(wrong))
    return config
