"""`orbitcal measure` against the simulated Booster behind its soft IOC, over channel access on loopback.

Usage: measure.py ORBITCAL [SEED], in the repository, with the Python that has orbitcal-epics. Exit status 0 if all of it holds:

- a corrector that sticks and an IOC that goes away are said, and the machine is (or, with --restore, comes) back at its settings;
- killed 20 times by SIGKILL at random moments, the machine is back at its settings after every --restore;
- the measurement that went on after each of them, monitors dropping out, has all frames and is fitted within its error bars.
"""

import asyncio
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

LOOPBACK = {
    "EPICS_CA_ADDR_LIST": "127.0.0.1:35164 127.0.0.1:35264",  # the machine's IOC, and a gateway
    "EPICS_CA_AUTO_ADDR_LIST": "NO",
    "EPICS_CAS_INTF_ADDR_LIST": "127.0.0.1",
    "EPICS_CA_SERVER_PORT": "35164",
    "EPICS_CA_REPEATER_PORT": "35165",
    "EPICS_PVAS_INTF_ADDR_LIST": "127.0.0.1",
    "EPICS_PVAS_SERVER_PORT": "35175",
    "EPICS_PVAS_BROADCAST_PORT": "35176",
}
os.environ.update(LOOPBACK)

import aioca  # noqa: E402, reads the environment when it is loaded
import numpy as np  # noqa: E402

PERIOD_S = 0.04
KILLS = 20
# fast supplies and cycles; all else as it is committed
FAST = {
    'header = "': f'header = "{Path("config").resolve()}/',
    "settle_s = 4.0": "settle_s = 0.1",
    "timeout_s = 60.0": "timeout_s = 4.0",
    "match_window_s = 0.5": "match_window_s = 0.01",
}
# what operators have set, so that "as it was" is not 0
STEERED = {f"BOOSTER:{cell}{n}:SET": 0.25 * n * (-1) ** n for cell in "ABCDEF" for n in range(1, 9)}
BIN = Path(sys.executable).parent
LOOP = asyncio.new_event_loop()  # channels live in one


class Story:
    def __init__(self, orbitcal, seed, folder):
        self.orbitcal, self.random, self.folder = orbitcal, random.Random(seed), folder
        self.epics = ["--epics", BIN / "orbitcal-epics"]
        text = Path("config/measure-booster.toml").read_text()
        for old, new in FAST.items():
            assert old in text, old
            text = text.replace(old, new)
        self.plan, self.period = folder / "plan.toml", PERIOD_S
        self.plan.write_text(text)
        self.truth = json.loads(Path("recordings/random-vars/truth.json").read_text())["vars"]
        (folder / "vars.json").write_text(json.dumps(self.truth))

    @contextmanager
    def booster(self, *more):
        """The simulated Booster behind its IOC, steered."""
        command = [self.orbitcal, "simulate", self.plan, "--vars", self.folder / "vars.json", "--settling-s", "0.02", "--seed", "5", *more]
        ioc = [BIN / "orbitcal-soft-ioc", "--period-s", str(self.period), *command]
        process = subprocess.Popen(ioc, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            LOOP.run_until_complete(steer())
            yield process
        finally:
            process.terminate()
            process.wait()

    def run(self, *command):
        """A command to its good end."""
        subprocess.run([self.orbitcal, *command], check=True)

    def measure(self, *more):
        command = [self.orbitcal, "measure", *more, *self.epics]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def take(self, out):
        return self.measure(self.plan, "--out", self.folder / out, "--json", self.folder / f"{out}.json")

    def restored(self, out):
        """Restore, and see that the machine is and stays as it was."""
        process = self.measure("--restore", self.folder / f"{out}.journal")
        _, said = process.communicate(timeout=90)
        assert process.returncode == 0, said
        for _ in range(2):
            assert_as_it_was()
            time.sleep(0.2)

    def sticks(self):
        with self.booster("--fault", "stick@C2=200"):
            process = self.take("stuck")
            _, said = process.communicate(timeout=120)
            assert process.returncode == 1, said
            assert "read-back BOOSTER:" in said and "the machine is back at its settings" in said, said
            assert_as_it_was()
        print(f"sticks: {said.strip()}", flush=True)

    def goes_away(self):
        with self.booster() as ioc:
            process = self.take("away")
            time.sleep(4.0)
            ioc.kill()
            _, said = process.communicate(timeout=120)
        assert process.returncode == 1 and "not put back: BOOSTER:" in said and "--restore" in said, said
        with self.booster():  # a restarted IOC, at what its own start sets; then as the journal says
            LOOP.run_until_complete(aioca_put({f"BOOSTER:{name}:SET": 0.0 for name in ("A2", "A4", "F7")}))
            self.restored("away")
        print(f"goes away: {said.strip()}", flush=True)

    def terminated(self):
        with self.booster():
            process = self.take("terminated")
            time.sleep(4.0)
            process.send_signal(signal.SIGTERM)
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=60)
            assert process.returncode == 1 and "interrupted; the machine is back at its settings" in said, said
            assert_as_it_was()
        print(f"terminated: {said.strip()}", flush=True)

    def killed(self):
        moved = 0
        with self.booster("--fault", "drop_out@x_E4=0.1"):
            for _ in range(KILLS):
                process = self.take("killed")
                time.sleep(self.random.uniform(0.3, 3.5))
                assert process.poll() is None, process.communicate()
                process.kill()
                process.communicate()
                time.sleep(0.1)
                moved += not as_it_was()
                self.restored("killed")
            process = self.take("killed")
            _, said = process.communicate(timeout=300)
            assert process.returncode == 0, said
            assert_as_it_was()
        result = json.loads((self.folder / "killed.json").read_text())
        print(f"killed {KILLS} times, {moved} of them with a set point moved; {result['frames']} frames", flush=True)
        assert moved >= KILLS / 2
        assert result["frames"] == 342 and not (self.folder / "killed.journal").exists()

    def fitted(self):
        for command in ("check", "fit"):
            json_file = self.folder / f"{command}.json"
            self.run(command, self.folder / "killed", "--quiet", "--json", json_file)
        fit = json.loads((self.folder / "fit.json").read_text())
        error = np.array([var["mean"] - self.truth[var["name"]] for var in fit["vars"]])
        nees = error @ np.linalg.solve(np.array(fit["covariance"]), error) / len(error)
        missing = json.loads((self.folder / "check.json").read_text())["missing"]
        print(f"fitted: NEES/48 {nees:.2f}, chi2/dof {fit['chi2_per_dof']:.3f}, {missing:.4f} of the readings missing")
        assert 0.5 < nees < 1.6 and 0.9 < fit["chi2_per_dof"] < 1.1, "three standard deviations of chi-square"


async def steer():
    await aioca.connect(list(STEERED), timeout=20)
    await aioca_put(STEERED)


async def aioca_put(values):
    for channel, value in values.items():
        await aioca.caput(channel, value, wait=True, timeout=10)


async def found():
    values = await aioca.caget(list(STEERED), timeout=10)
    return dict(zip(STEERED, map(float, values)))


def as_it_was():
    return LOOP.run_until_complete(found()) == STEERED


def assert_as_it_was():
    values = LOOP.run_until_complete(found())
    wrong = {name: value for name, value in values.items() if value != STEERED[name]}
    assert not wrong, f"not as it was: {wrong}"


def main(orbitcal, seed="17"):
    with tempfile.TemporaryDirectory() as folder:
        story = Story(Path(orbitcal).resolve(), int(seed), Path(folder))
        story.sticks()
        story.goes_away()
        story.terminated()
        story.killed()
        story.fitted()


if __name__ == "__main__":
    main(*sys.argv[1:])
