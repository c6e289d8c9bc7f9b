"""The gateway, seen by three clients that nobody here wrote: pyepics, caproto and p4p.

Usage: clients.py ORBITCAL, in the repository, with the Python that has orbitcal-gateway[test]. A recording is replayed, its estimates
published, and every var, its units, limits, alarms and the table are read back by each client. Exit status 0 if all are right.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from orbitcal_gateway import severity

BASE = 20000 + 8 * (os.getpid() % 4000)
# the processes of one test share them
os.environ.update({} if "ORBITCAL_GATEWAY_TEST" in os.environ else
    {
        "ORBITCAL_GATEWAY_TEST": "1",
        "EPICS_CA_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CAS_INTF_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_SERVER_PORT": str(BASE),
        "EPICS_CA_REPEATER_PORT": str(BASE + 1),
        "EPICS_PVA_ADDR_LIST": "127.0.0.1",
        "EPICS_PVA_AUTO_ADDR_LIST": "NO",
        "EPICS_PVAS_INTF_ADDR_LIST": "127.0.0.1",
        "EPICS_PVA_SERVER_PORT": str(BASE + 2),
        "EPICS_PVA_BROADCAST_PORT": str(BASE + 3),
    }
)
BIN = Path(sys.executable).parent
SERVICE = f"orbitcal.GatewayTest.{os.getpid()}"
CORRECTORS = [f"{plane}_{cell}{n}" for plane, n0 in (("H", 2), ("V", 1)) for cell in "ABCDEF" for n in range(n0, 9, 2)]
SCREEN = Path(__file__).parents[1] / "vars.bob"
HOLDS, STATES = [[word for word, _ in words] for words in (severity.HOLDS, severity.STATES)]
VARS = [f"{cell}{n}" for n0 in (2, 1) for cell in "ABCDEF" for n in range(n0, 9, 2)]
NO_ALARM, MINOR, MAJOR, INVALID = range(4)
CONFIG = f'service = "{SERVICE}"\nsetpoints = ["H_A4"]\nstale_s = 3.0\nsigma_minor = 0.004\n'


@contextmanager
def gateway(folder, config):
    file = Path(folder) / "gateway.toml"
    file.write_text(config)
    process = subprocess.Popen([BIN / "orbitcal-gateway", file], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert "listening" in process.stdout.readline()
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(3)
        except subprocess.TimeoutExpired:
            process.kill()
            raise


@contextmanager
def daemon(orbitcal, folder, feedback):
    """The daemon on a recording as if it were live."""
    recording = Path("recordings/paper-vars").resolve()
    text = f'[machine]\nrecording = "{recording}"\n[source]\naddress = "replay:{recording}"\nrate_hz = 12\n'
    (folder / "daemon.toml").write_text(f'{text}[publish]\nservice = "{SERVICE}"\n[feedback]\n{feedback}\npatience_ms = 60000\n')
    process = subprocess.Popen([orbitcal, "serve", folder / "daemon.toml"], stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


@contextmanager
def replay(orbitcal, *more):
    command = [orbitcal, "replay", "recordings/paper-vars", "--service", SERVICE, "--quiet", *more]
    process = subprocess.Popen(command)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def by_pyepics():
    import epics

    pvs = {name: [epics.PV(f"ORBITCAL:{name}:{what}", form="ctrl") for what in ("MEAN", "SIGMA")] for name in VARS}
    seen = {}
    for name, (mean, sigma) in pvs.items():
        assert mean.wait_for_connection(10) and sigma.wait_for_connection(10), name
        value, spread = mean.get(), sigma.get()
        assert 0.9 < value < 1.1 and 0 < spread < 0.05, (name, value, spread)
        assert mean.units == sigma.units == "1"
        assert (mean.lower_disp_limit, mean.upper_disp_limit) == (0.8, 1.2)
        assert (mean.lower_alarm_limit, mean.upper_alarm_limit) == (0.94, 1.06), mean.upper_alarm_limit
        assert not mean.write_access and not sigma.write_access
        seen[name] = (spread, sigma.severity)
    for name, (spread, alarm) in seen.items():
        # one value may be of another cycle than its alarm: only where it is far from a limit
        if not 0.0039 < spread < 0.0041 and not 0.0299 < spread < 0.0301:
            assert alarm == (MINOR if 0.004 < spread <= 0.03 else MAJOR if spread > 0.03 else NO_ALARM), (name, spread, alarm)
    assert list(epics.caget("ORBITCAL:NAMES")) == VARS
    means, sigmas = epics.caget("ORBITCAL:MEANS"), epics.caget("ORBITCAL:SIGMAS")
    assert len(means) == len(sigmas) == 48
    assert epics.caget("ORBITCAL:MISMATCH", as_string=True) in ("fits", "does not fit", "not checked")
    assert "Booster" in epics.caget("ORBITCAL:MACHINE", as_string=True)
    counts = []
    watched = epics.PV("ORBITCAL:SEQUENCE", callback=lambda value, **_: counts.append(value))
    assert watched.wait_for_connection(10)
    beat = epics.caget("ORBITCAL:HEARTBEAT")
    time.sleep(3.5)
    watched.clear_callbacks()
    assert epics.caget("ORBITCAL:HEARTBEAT") - beat in (3, 4)
    steps = [b - a for a, b in zip(counts[1:], counts[2:])]
    assert len(steps) > 20 and all(step >= 1 for step in steps), steps
    # a cycle may be passed over where the gateway is late, never repeated
    assert sum(step == 1 for step in steps) >= 0.9 * len(steps), steps
    assert epics.PV("ORBITCAL:H_A4:SETPOINT").wait_for_connection(5)
    assert not epics.PV("ORBITCAL:H_A4:SETPOINT").write_access
    print(f"pyepics: 48 vars, limits, units, severities; {len(steps)} updates in 3.5 s")


def by_caproto():
    from caproto import ChannelType
    from caproto.threading.client import Context

    context = Context()
    pvs = context.get_pvs(*[f"ORBITCAL:{name}:{what}" for name in VARS for what in ("MEAN", "SIGMA")], timeout=10)
    for pv in pvs:
        pv.wait_for_connection(timeout=10)
        reply = pv.read(data_type=ChannelType.CTRL_DOUBLE, timeout=10)
        assert reply.metadata.units == b"1" and reply.data[0] == reply.data[0], pv.name
    [names] = context.get_pvs("ORBITCAL:NAMES")
    names.wait_for_connection(timeout=10)
    assert [name.decode() for name in names.read().data] == VARS
    print(f"caproto: {len(pvs)} records with units, names")


def by_p4p():
    from p4p.client.thread import Context

    context = Context("pva", nt=False)  # one type a context is unwrapped rightly; nothing is unwrapped here
    for name in VARS:
        value = context.get(f"ORBITCAL:{name}:MEAN", timeout=10)
        assert 0.9 < value.value < 1.1 and value.display.units == "1", name
    table = context.get("ORBITCAL:TABLE", timeout=10)
    assert table.getID() == "epics:nt/NTTable:1.0" and list(table.value.name) == VARS
    assert all(0.9 < mean < 1.1 for mean in table.value.mean) and all(sigma > 0 for sigma in table.value.sigma)
    expected = [MINOR if sigma > 0.004 else NO_ALARM for sigma in table.value.sigma]
    assert list(table.value.severity) == expected or context.get("ORBITCAL:MISMATCH").value.index == 1
    updates = []
    with context.monitor("ORBITCAL:TABLE", updates.append):
        time.sleep(3.0)
    assert len(updates) > 20, len(updates)
    context.close()
    print(f"p4p: 48 records, the table with {len(updates)} updates in 3 s")


def screen():
    """Every channel that the operators' screen shows is there."""
    import xml.etree.ElementTree as xml

    import epics

    shown = [node.text.replace("$(P)", "ORBITCAL") for node in xml.parse(SCREEN).iter("pv_name")]
    pvs = [epics.PV(name) for name in shown]
    missing = [pv.pvname for pv in pvs if not pv.wait_for_connection(10)]
    assert len(shown) > 100 and not missing, missing
    print(f"screen: all {len(shown)} channels of {SCREEN.name} are there")


def steered():
    """Set points and health of a daemon, by all three clients: values, limits, units, alarms, and what may be written."""
    import epics
    from caproto import ChannelType
    from caproto.threading.client import Context as Caproto
    from p4p.client.thread import Context as P4p

    names = [f"ORBITCAL:{corrector}:SETPOINT" for corrector in CORRECTORS]
    pvs = [epics.PV(name, form="ctrl") for name in names]
    hold = epics.PV("ORBITCAL:FEEDBACK:HOLD")
    assert hold.wait_for_connection(10)
    for pv in pvs:
        assert pv.wait_for_connection(10) and pv.units == "A" and not pv.write_access, pv.pvname
        assert (pv.lower_disp_limit, pv.upper_disp_limit) == (-25.0, 25.0)
        assert abs(pv.get()) <= 25.0 and pv.severity in (NO_ALARM, MINOR), (pv.pvname, pv.get(), pv.severity)
    # of a campaign, whose correctors others move: those of the feedback do not follow, and are said
    assert hold.get(as_string=True) in HOLDS and hold.severity in (NO_ALARM, MINOR, MAJOR)
    left_out = epics.PV("ORBITCAL:FEEDBACK:LEFT_OUT")
    assert left_out.wait_for_connection(10)
    assert left_out.get() == 0 or left_out.severity == MINOR
    values = {name: pv.get() for name, pv in zip(names, pvs)}
    context = Caproto()
    for pv in context.get_pvs(*names, timeout=10):
        pv.wait_for_connection(timeout=10)
        reply = pv.read(data_type=ChannelType.CTRL_DOUBLE, timeout=10)
        assert reply.metadata.units == b"A" and abs(reply.data[0]) <= 25.0, pv.name
    pva = P4p("pva", nt=False)
    for name in names:
        value = pva.get(name, timeout=10)
        assert abs(value.value) <= 25.0 and value.display.units == "A" and value.alarm.severity < INVALID, name
    states = [epics.PV(f"ORBITCAL:{name}:STATE") for name in ("x_C6", "y_B5", "H_A4", "V_F7")]
    for pv in states:
        assert pv.wait_for_connection(10) and pv.get(as_string=True) in STATES, pv.pvname
    chi2 = epics.PV("ORBITCAL:CHI2_PER_DOF")
    assert chi2.wait_for_connection(10) and 0.5 < chi2.get() < 2.0, chi2.get()
    moved = sum(abs(value) > 0.05 for value in values.values())
    print(f"set points: {len(names)} by pyepics, caproto and p4p, {moved} of them moved; health of instruments; chi2/dof {chi2.get():.2f}")


def not_steered():
    """Without a feedback a set point is there, and INVALID: nobody is to write it."""
    import epics

    for record in ("H_A4:SETPOINT", "V_F7:SETPOINT", "FEEDBACK:HOLD"):
        pv = epics.PV(f"ORBITCAL:{record}")
        assert pv.wait_for_connection(10) and pv.get_timevars()["severity"] == INVALID, record
    print("without a feedback: set points are INVALID")


def gone_stale():
    """What was published stays to be read, and is invalid."""
    import epics

    for record in ("D8:MEAN", "D8:SIGMA", "MEANS", "SEQUENCE"):
        pv = epics.PV(f"ORBITCAL:{record}")
        assert pv.wait_for_connection(10) and pv.get() is not None
        assert pv.get_timevars()["severity"] == INVALID, record
    print("silence: records are INVALID, and keep their values")


def written():
    """A set point that may be written is, within its limits; nothing else is."""
    import epics

    setpoint, mean = epics.PV("ORBITCAL:H_A4:SETPOINT"), epics.PV("ORBITCAL:D8:MEAN")
    assert setpoint.wait_for_connection(15) and setpoint.write_access
    for wanted, kept in ((3.5, 3.5), (40.0, 25.0)):
        setpoint.put(wanted, wait=True)
        assert setpoint.get(use_monitor=False) == kept
    assert mean.wait_for_connection(10) and not mean.write_access
    print("set points: written where configured, held within their limits; nothing else may be written")


def alive():
    import epics

    pv = epics.PV("ORBITCAL:D8:MEAN")
    assert pv.wait_for_connection(15) and 0.9 < pv.get() < 1.1


CLIENTS = {one.__name__: one for one in (by_pyepics, by_caproto, by_p4p, screen, steered, not_steered, gone_stale, written, alive)}


def see(*clients):
    """Each in a process of its own: their C libraries do not all survive a server that goes away."""
    for client in clients:
        # not piped: caproto's repeater would keep the pipe open
        subprocess.run([sys.executable, __file__, "--see", client.__name__], check=True, env=os.environ)


def misconfigured(folder):
    """All that is wrong is told at once."""
    file = folder / "wrong.toml"
    file.write_text('prefix = 3\nsigma_minor = -1\nmean_alarm = [2, 1]\nsetpoint = []\n')
    run = subprocess.run([BIN / "orbitcal-gateway", file], capture_output=True, text=True)
    assert run.returncode == 2, run
    for part in (
        "prefix: expected str, found 3",
        "sigma_minor: expected a positive number, found -1",
        "mean_alarm: expected two rising numbers, found [2, 1]",
        "setpoint: unknown, expected one of prefix, service",
    ):
        assert part in run.stderr, run.stderr
    print("configuration: four wrong values told at once", flush=True)


def main(orbitcal):
    with tempfile.TemporaryDirectory() as folder:
        misconfigured(Path(folder))
        with gateway(folder, CONFIG):
            with replay(orbitcal, "--rate", "10"):
                see(by_pyepics, by_caproto, by_p4p)
            time.sleep(5.0)
            see(gone_stale)
        with daemon(orbitcal, Path(folder), "on = true"), gateway(folder, CONFIG.replace('setpoints = ["H_A4"]\n', "")):
            see(screen, steered)
        with daemon(orbitcal, Path(folder), ""), gateway(folder, CONFIG.replace('setpoints = ["H_A4"]\n', "")):
            see(alive, not_steered)
        with gateway(folder, CONFIG + "writable = true\n"), replay(orbitcal, "--rate", "15"):
            see(written)
        pick = random.Random(3)
        for _ in range(5):
            with replay(orbitcal, "--rate", "15"), gateway(folder, CONFIG) as process:
                see(alive)
                time.sleep(pick.uniform(0.0, 1.0))
                process.kill()
                process.wait()
        print("killed 5 times, back each time")


if __name__ == "__main__":
    if sys.argv[1] == "--see":
        CLIENTS[sys.argv[2]]()
        sys.stdout.flush()
        os._exit(0)  # threads of the clients do not all end by themselves
    main(Path(sys.argv[1]).resolve())
