"""Alarm severities of EPICS, from what orbitcal says of itself."""

NO_ALARM, MINOR, MAJOR, INVALID = range(4)
# alarm status of EPICS
NONE, HIHI, HIGH, SOFT, UDF = 0, 3, 4, 15, 17

# states of an instrument: docs/daemon.md
STATES = [("ok", NO_ALARM), ("noisy", MINOR), ("jumps", MINOR), ("dead", MAJOR), ("back", MINOR)]
FAULTY = (1, 2, 3)
# why the feedback holds: docs/feedback.md
HOLDS = [
    ("follows", NO_ALARM),
    ("first after a silence", MINOR),
    ("no beam it knows", MINOR),
    ("estimate failed", MAJOR),
    ("surprising frame", MINOR),
    ("model disagrees", MAJOR),
    ("too few monitors", MAJOR),
    ("gains not made yet", MINOR),
]

MISMATCH = ["fits", "does not fit", "not checked"]


def of_sigma(config, sigma):
    """How uncertain a var may be."""
    if sigma > config.sigma_major:
        return MAJOR, HIHI
    if sigma > config.sigma_minor:
        return MINOR, HIGH
    return NO_ALARM, NONE


def of_mean(config, estimate, i):
    """A var is worth what its sigma and the model are worth: the worse of the two. The record itself compares it with its limits."""
    return max(of_sigma(config, estimate.sigma[i]), of_mismatch(estimate), key=lambda one: one[0])


def of_row(config, estimate, i):
    """What the record of the mean shows, its limits included."""
    if not estimate.usable(i):
        return INVALID
    low, high = config.mean_alarm
    beyond = estimate.mean[i] <= low or estimate.mean[i] >= high
    return MAJOR if beyond else of_mean(config, estimate, i)[0]


def of_count(faulty):
    """Some instruments are not as they should be."""
    return (MINOR, SOFT) if faulty else (NO_ALARM, NONE)


def of_code(words, code):
    """A state, or a reason to hold; a word that this gateway does not know is INVALID."""
    worst = words[code][1] if code < len(words) else INVALID
    return worst, SOFT if worst else NONE


def of_mismatch(estimate):
    """The readings do not fit the model: nothing that follows from it can be relied on."""
    return (MAJOR, SOFT) if estimate.mismatch == 1 else (NO_ALARM, NONE)
