"""kill -9 of the gateway at random moments, while another subscriber listens.

Usage: kills.py ORBITCAL [KILLS], in the repository, with the Python that has orbitcal-gateway[test]. Exit status 0 if after each kill a new gateway serves
estimates that are new, the other subscriber has heard every estimate, and nothing is left in shared memory.
"""

import os
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

from clients import CONFIG, SERVICE, gateway, replay

from orbitcal_gateway.estimates import Subscriber  # noqa: E402

FRAMES = 346  # of the recording that is replayed, slowly enough for all of the test
LONGEST_S = 3.0  # of a life, which includes the start of Python


class Other(threading.Thread):
    """A subscriber that nobody kills."""

    def __init__(self):
        super().__init__(daemon=True)
        self.frames, self.ended = [], threading.Event()

    def run(self):
        subscriber = Subscriber(SERVICE)
        while not self.ended.is_set():
            self.frames += [one.frames for one in subscriber.all(0.2)]


class Client:
    """A PVA client that lives through all restarts of the server."""

    def __init__(self):
        from p4p.client.thread import Context

        self.context = Context("pva", nt=False)
        self.sequence, self.news = None, threading.Condition()
        self.monitor = self.context.monitor("ORBITCAL:SEQUENCE", self.hear, notify_disconnect=True)

    def hear(self, value):
        with self.news:
            self.sequence = None if isinstance(value, Exception) else value.value
            self.news.notify_all()

    def wait_for_news(self, seconds):
        """Until a server that is connected has a later estimate than at first."""
        with self.news:
            assert self.news.wait_for(lambda: self.sequence is not None, seconds), "no gateway"
            first = self.sequence
            assert self.news.wait_for(lambda: self.sequence not in (None, first), seconds), f"no estimate after {first}"


def left_by(processes):
    """What processes have left in shared memory and of its bookkeeping: the upper half of an id holds the process."""
    folders = [folder for folder in ("/dev/shm", "/tmp/iceoryx2/nodes") if os.path.isdir(folder)]
    names = [name for folder in folders for name in os.listdir(folder)]
    parts = {name: [int(part) for part in name.replace(".", "_").split("_") if part.isdigit()] for name in names}
    return [name for name in names if any((part >> 64) & 0xFFFF_FFFF in processes for part in parts[name])]


def main(orbitcal, kills):
    pick, processes, starts = random.Random(11), set(), []
    rate = FRAMES / (6.0 * kills + 60.0)
    with tempfile.TemporaryDirectory() as folder, replay(orbitcal, "--rate", str(rate)):
        other = Other()
        other.start()
        client = Client()
        for _ in range(kills):
            with gateway(folder, CONFIG) as process:
                processes.add(process.pid)
                time.sleep(pick.uniform(0.0, LONGEST_S))
                process.kill()
                process.wait()
        # a random moment may be before anything is served: the last ones are all seen
        for _ in range(max(1, kills // 5)):
            began = time.monotonic()
            with gateway(folder, CONFIG) as process:
                processes.add(process.pid)
                client.wait_for_news(30)
                starts.append(time.monotonic() - began)
                seen = left_by({process.pid})
                process.kill()
                process.wait()
            assert seen, "a gateway that lives has shared memory"
        other.ended.set()
        other.join()
        Subscriber(SERVICE)  # whoever joins clears away what the last one has left
        # the publisher lets go of its end with its next estimate
        deadline = time.monotonic() + 3.0 / rate
        while (left := left_by(processes)) and time.monotonic() < deadline:
            time.sleep(0.1)
    frames = other.frames
    assert not left, f"left behind: {left[:5]}"
    assert frames == list(range(frames[0], frames[0] + len(frames))), "the other subscriber lost estimates"
    print(f"gateway killed {len(processes)} times: new records {max(starts):.1f} s after a start at most, nothing left, {len(frames)} estimates heard beside it")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), int(sys.argv[2]) if len(sys.argv) > 2 else 20)
    sys.stdout.flush()
    os._exit(0)  # threads of the client do not all end by themselves
