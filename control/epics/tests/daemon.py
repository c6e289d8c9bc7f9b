"""The daemon on the live channels of a simulated machine, its gateway, and what carries set points, as processes of a test."""

import os
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

from measure import BIN

DAEMON = """[machine]
recording = "{header}"
[source]
address = "epics:{plan}"
program = "{source}"
timeout_ms = 60000
late_ms = 1000
backoff_first_ms = 100
backoff_most_ms = 500
[publish]
service = "{service}"
name = "live"
[checkpoint]
file = "checkpoint"
checkpoint_every_frames = 200
"""


# two servers on one machine need ports of their own
GATEWAY = {"EPICS_CA_SERVER_PORT": "35264", "EPICS_PVAS_SERVER_PORT": "35275", "EPICS_PVAS_BROADCAST_PORT": "35276"}


class Site:
    """A folder, a plan, and a service in shared memory."""

    def __init__(self, story, folder, name):
        self.story, self.folder = story, Path(folder)
        self.service = f"orbitcal/{name}/{os.getpid()}"

    def configure(self, more=""):
        values = {
            "header": Path("config/booster-header.toml").resolve(),
            "plan": self.story.plan.resolve(),
            "source": BIN / "orbitcal-epics-source",
            "service": self.service,
        }
        (self.folder / "daemon.toml").write_text(DAEMON.format(**values) + more)
        return self

    def daemon(self):
        return self.process("daemon", self.story.orbitcal, "serve", self.folder / "daemon.toml")

    def gateway(self, more=""):
        (self.folder / "gateway.toml").write_text(f'service = "{self.service}"\n{more}')
        return self.process("gateway", BIN / "orbitcal-gateway", self.folder / "gateway.toml", **GATEWAY)

    def feedback(self, correctors, step=3.0, limit=24.0):
        """What carries the set points of these correctors to the machine."""
        channels = "\n".join(f'{name} = "BOOSTER:{name[2:]}:SET"' for name in correctors)
        text = f"limits_A = [{-limit}, {limit}]\nstep_A = {step}\n[channels]\n{channels}\n"
        (self.folder / "feedback.toml").write_text(text)
        return self.process("feedback", BIN / "orbitcal-feedback", self.folder / "feedback.toml")

    @contextmanager
    def process(self, name, *command, **environment):
        with (self.folder / f"{name}.log").open("a") as said:
            process = subprocess.Popen([str(one) for one in command], stdout=said, stderr=said, env=os.environ | environment)
        try:
            yield process
        finally:
            process.terminate()
            process.wait(20)

    def said(self, name):
        return (self.folder / f"{name}.log").read_text()

    def request(self, *what):
        """`orbitcal request`, which has to be done."""
        command = [self.story.orbitcal, "request", *what, "--service", self.service]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def until(holds, seconds, what):
    """Wait until something holds; returns how long that took."""
    start = time.monotonic()
    while not holds():
        assert time.monotonic() - start < seconds, f"{what} in {seconds} s"
        time.sleep(0.02)
    return time.monotonic() - start
