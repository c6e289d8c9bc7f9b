"""The daemon on the channels of the simulated Booster behind its soft IOC, over channel access on loopback.

Usage: live.py ORBITCAL, in the repository, with the Python that has orbitcal-epics and orbitcal-gateway. Exit status 0 if all of it holds:

- every cycle is a frame, a monitor that drops out has empty readings, and one plane that is not updated has none;
- an IOC, and the process that watches the channels, killed and started again: frames go on by themselves, the daemon lives;
- nothing is left when the daemon is killed.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measure import Story

from daemon import Site, until

from orbitcal_gateway.estimates import Subscriber  # noqa: E402

NOT_REPORTED = 0
PERIOD_S = 0.1


class Listener:
    """Every estimate of the daemon."""

    def __init__(self, service):
        self.subscriber, self.heard = Subscriber(service), []

    def listen(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.heard += self.subscriber.all(left)
        return self.heard

    def until_more(self, seconds, what):
        """How long it takes until there is another estimate."""
        have = len(self.heard)

        def more():
            self.heard += self.subscriber.all(0.05)
            return len(self.heard) > have

        return until(more, seconds, what)


def sources(daemon):
    """The processes that a daemon has started."""
    listed = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(daemon.pid)], capture_output=True, text=True).stdout
    return [int(line.split()[0]) for line in listed.splitlines() if "orbitcal-epics-source" in line]


def every_cycle(site):
    with site.story.booster("--fault", "drop_out@x_E4=0.1"), site.daemon():
        listener = Listener(site.service)
        listener.until_more(40, "no estimate")
        listener.heard.clear()
        heard = listener.listen(20)
    steps = [after.sequence - before.sequence for before, after in zip(heard, heard[1:])]
    missed = sum(step - 1 for step in steps)
    monitor = heard[0].monitors.index("x_E4")
    silent = sum(one.reading[monitor] == NOT_REPORTED for one in heard) / len(heard)
    others = sum(one.reading[b] == NOT_REPORTED for one in heard for b in range(len(one.monitors)) if b != monitor)
    print(f"every cycle: {len(heard)} estimates in 20 s, {missed} cycles without one; x_E4 silent in {silent:.3f} of them", flush=True)
    # a client that a busy machine does not let run for some cycles is told the last of them
    assert len(heard) > 0.6 * 20 / PERIOD_S and missed <= 0.1 * len(heard)
    # a share of 0.1 of some 200 readings, four standard deviations
    assert abs(silent - 0.1) < 4 * (0.09 / len(heard)) ** 0.5
    assert others == 0, f"{others} readings of other monitors are missing"


def a_plane_freezes(site):
    with site.story.booster("--fault", "freeze@y=80"), site.daemon():
        listener = Listener(site.service)
        until(lambda: listener.listen(0.2) and listener.heard[-1].sequence > 110, 60, "no cycle 110")
        heard = listener.listen(3)
    late = [one for one in heard if one.sequence > 85]
    planes = [{one.reading[b] != NOT_REPORTED for one in late for b, name in enumerate(one.monitors) if name[0] == plane} for plane in "xy"]
    steps = {after.sequence - before.sequence for before, after in zip(late, late[1:])}
    assert planes == [{True}, {False}] and max(steps) <= 5, (planes, steps)
    print(f"freezes: {len(late)} estimates with the horizontal monitors alone", flush=True)


def killed(site):
    """The IOC, then the source, then the daemon."""
    resumed = []
    with site.daemon() as daemon:
        listener = Listener(site.service)
        for _ in range(3):
            with site.story.booster() as ioc:
                listener.until_more(30, "no estimate of a new IOC")
                listener.listen(1.0)
                ioc.kill()
                ioc.wait()
            listener.listen(2.0)
            last, have = listener.heard[-1], len(listener.heard)
            began = time.monotonic()
            with site.story.booster():
                listener.until_more(60, "no estimate after the IOC was started again")
                resumed.append(time.monotonic() - began)
                assert listener.heard[have].frames == last.frames + 1, "the core goes on"
                listener.listen(0.5)
        with site.story.booster():
            listener.until_more(30, "no estimate")
            before = listener.heard[-1]
            [source] = sources(daemon)
            subprocess.run(["kill", "-9", str(source)], check=True)
            listener.listen(0.3)
            took = listener.until_more(20, "no estimate after the source was killed")
            listener.listen(2.0)
            assert listener.heard[-1].frames > before.frames + 10 and daemon.poll() is None
            assert "connection lost: closed by the other end" in site.said("daemon")
            [source] = sources(daemon)
            daemon.kill()
            daemon.wait()
            until(lambda: not Path(f"/proc/{source}").exists(), 10, "the source outlives the daemon")
    text = ", ".join(f"{seconds:.1f}" for seconds in resumed)
    print(f"killed: IOC three times, frames again {text} s after its start; source once, {took:.1f} s; nothing left of the daemon", flush=True)


def main(orbitcal):
    with tempfile.TemporaryDirectory() as folder:
        story = Story(Path(orbitcal).resolve(), 17, Path(folder))
        story.period = PERIOD_S
        for number, test in enumerate((every_cycle, a_plane_freezes, killed)):
            place = Path(folder) / str(number)
            place.mkdir()
            site = Site(story, place, f"live-{number}").configure()
            try:
                test(site)
            except BaseException:
                print(site.said("daemon"), flush=True)
                raise


if __name__ == "__main__":
    main(*sys.argv[1:])
