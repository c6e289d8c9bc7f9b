"""Forty blind orbit-response campaigns on five rings, simulated with pyAT.

The rings (``lattices.py``) are of invented design and unlike each other.  Each has eight campaigns, the first one to
three of them of ordinary machines with nothing to be found.  Every campaign is a folder with ``header.toml``,
``frames.csv`` and ``truth.json``; the machine file ``ring.json`` lies above it.  The programs share no code with the
one that reads the recordings.

    python tests/peers/rings/campaigns.py --out DIR [--only ring3-02 ring4 ...]

All of it takes ten minutes on one core.  Seeds are fixed: with the same pyAT and NumPy the recordings are the same to
the byte.

``truth.json`` holds ``effects`` and ``vars`` under the names of the recording, ``drawn`` gains and rolls, and gains
in ln posterior [nat], see ``visibility.py``:

    oracle_gain                  of all effects together, over the best factors without them
    own_gain                     of each effect, with the others present
    ..._with_gains_free          the same if monitors' and correctors' gains may follow too (only where they scatter)
    own_gain_before_projection   of each effect, nothing following
    feed_down_gain               of the displaced quadrupoles, without effects: what a model misses that does not know
                                 the orbit in the sextupoles

Units and signs are those of ``machine.py``.
"""
import argparse
import json
import os
import time
from dataclasses import asdict, replace

os.environ.setdefault("OMP_NUM_THREADS", "1")                # must be set before NumPy is imported

import numpy as np

from lattices import make_ring
from machine import SEED, Campaign, Equipment, Imperfections, Machine, Measurement, at, effect
from visibility import LinearModel

EQUIPMENT = {
    1: Equipment(sigma=0.03, kick_per_ampere=0.015, current=10.0, displacement=1.2e-4, rf_step=5e-6,
                 dipole_current=4000.0, dipole_ripple=2e-5, ripple=4e-5,
                 nominal={"QF": 900.0, "QD": 880.0}, transfer=[0.0, 1.03, -0.03]),
    2: Equipment(sigma=0.005, kick_per_ampere=0.05, current=3.0, displacement=2.0e-5, rf_step=3e-6, ripple=2e-5,
                 nominal={"Q1": 120.0, "Q2": 210.0, "Q3": 180.0},
                 transfer={"Q1": [0.0, 1.0], "Q2": [0.0, 1.05, -0.05], "Q3": [0.001, 0.999]},
                 believed_rf="fixed_frequency"),
    3: Equipment(sigma=0.08, kick_per_ampere=0.1, current=6.0, displacement=2.5e-4, rf_step=1e-4,
                 dipole_current=1800.0, dipole_ripple=4e-5, ripple=1e-4,
                 nominal={"focus": 400.0, "defocus": 350.0}, transfer=[0.0, 1.0]),
    4: Equipment(sigma=0.006, kick_per_ampere=0.03, current=5.0, displacement=4.0e-5, rf_step=3e-5, ripple=3e-5,
                 nominal={"QF": 250.0, "QD": 250.0, "QT": 80.0}, transfer=[0.0, 1.02, -0.02],
                 vertical_sigma=0.8, other_sigma={"x_M.03.a": 0.015, "y_M.03.a": 0.015, "x_M.19.b": 0.015},
                 planes_roll_together=False),
    5: Equipment(sigma=0.02, kick_per_ampere=0.008, current=15.0, displacement=1.0e-4, rf_step=2e-5,
                 dipole_current=3000.0, dipole_ripple=3e-5, ripple=3e-5,
                 nominal={"main": 1200.0}, transfer=[0.0, 1.0, 0.02, -0.02]),
}


# -------------------------------------------------------------------------------------------------- the forty campaigns

# Kinds that the diagnosis has no word for:
#   reading_lag       all readings hold this share of the reading before [1]
#   local_feedback    a vertical corrector takes this share of the orbit at a monitor away [1]
#   intensity_offset  offsets of the twelve monitors of one crate, named by the first, move with the recorded intensity
#                     [mm per relative intensity]
#   solenoid          a field along the beam, with its focusing: rotation [rad], positive from x to -y

SCATTERED = Imperfections(noise=(1.2, 1.1), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.006,
                          corrector_roll=0.006, missing=0.004, lost=3)
ALL_H_B = tuple(f"H_K.{cell:02d}.b" for cell in range(1, 23))
ALL_V_A = tuple(f"V_K.{cell:02d}.a" for cell in range(1, 23))

CAMPAIGNS = {
    "ring1-01": Campaign(0.5, Measurement(zero_every=2, format=1), displaced=0.7),
    "ring1-02": Campaign(
        1.5, Measurement(repeats=3, both_signs=False, rf_steps=6, tunes=False),
        replace(SCATTERED, noise=(1.28, 0.85), monitor_roll=0.005),
        displaced=1.6,
    ),
    "ring1-03": Campaign(1.0, Measurement(repeats=3), effects=[effect("bpm_gain", "x_F09", -0.06)]),
    "ring1-04": Campaign(
        0.8, Measurement(repeats=4, zero_every=3, format=1),
        Imperfections(noise=(0.9, 1.2), monitor_gain=0.02, corrector_gain=0.02, missing=0.006, momentum_jitter=2e-5),
        [effect("quad_roll", "D13", 0.003)],
    ),
    "ring1-05": Campaign(
        1.0, Measurement(repeats=3, tunes=False),
        Imperfections(noise=(1.1, 1.0)),
        [effect("radial_loop", None, 1.0)],
        loop_monitors=("x_F03", "x_F15"),
    ),
    "ring1-06": Campaign(
        1.2, Measurement(left_out=("H_F08", "V_D16"), tunes=False),
        replace(SCATTERED, monitor_roll=0.007),
        [effect("stray_skew_gradient", "SLOT_F11", 0.0004)],
    ),
    "ring1-07": Campaign(
        0.7, Measurement(repeats=3, rf_steps=8),
        Imperfections(noise=(0.8, 0.8), slow=0.6),
        [effect("corrector_gain", "H_F05", 0.03), effect("sextupole_error", "SD_D20", 0.7)],
    ),
    "ring1-08": Campaign(
        1.0, Measurement(zero_every=1),
        Imperfections(noise=(1.0, 1.15)),
        [effect("reading_lag", None, 0.006)],
    ),

    "ring2-01": Campaign(1.0, Measurement(repeats=1, both_signs=False, zero_every=3), displaced=0.25),
    "ring2-02": Campaign(
        1.4, Measurement(rf_steps=6),
        Imperfections(noise=(1.15, 1.25), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.008,
                      corrector_roll=0.008, missing=0.003, faulty=(("x_BPM04-2", "noisy", 7.0),), lost=2),
        displaced=0.6,
    ),
    "ring2-03": Campaign(
        0.6, Measurement(left_out=("H_COR03-1", "H_COR07-2", "V_COR11-3"), tunes=False),
        Imperfections(noise=(0.75, 0.9), slow=0.7, slow_frames=20, wander=2e-4, missing=0.01),
        displaced=0.5,
    ),
    "ring2-04": Campaign(
        1.0, Measurement(repeats=3),
        Imperfections(noise=(1.1, 1.1)),
        [effect("sextupole_error", "SDA06", 6.0)],
        displaced=0.6,
    ),
    "ring2-05": Campaign(
        0.9, Measurement(both_signs=False),
        Imperfections(monitor_gain=0.01),
        [effect("bpm_polarity", "y_BPM08-5")],
        displaced=0.25,
    ),
    "ring2-06": Campaign(
        1.2, Measurement(repeats=1),
        replace(SCATTERED, monitor_roll=0.005),
        [effect("corrector_dead", "V_COR09-2")],
        displaced=0.3,
    ),
    "ring2-07": Campaign(
        1.0, Measurement(rf_steps=4, tunes=False),
        Imperfections(noise=(1.2, 1.0)),
        [effect("bpm_roll", "x_BPM02-4", 0.035), effect("stray_gradient", "ID05", 0.008)],
        displaced=0.25,
    ),
    "ring2-08": Campaign(
        0.8, Measurement(),
        Imperfections(noise=(1.0, 1.0), missing=0.002),
        [effect("local_feedback", "V_COR10-1,y_BPM10-3", 0.01)],
        displaced=0.4,
    ),

    "ring3-01": Campaign(0.5, Measurement(repeats=5, zero_every=1)),
    "ring3-02": Campaign(
        1.3, Measurement(repeats=4, zero_every=2, rf_steps=10),
        Imperfections(noise=(0.8, 1.3), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.01,
                      corrector_roll=0.01, quad_roll=5e-4, slow=0.5, missing=0.01, lost=4),
    ),
    "ring3-03": Campaign(
        1.0, Measurement(repeats=4, zero_every=2, rf_steps=6),
        Imperfections(noise=(1.1, 1.1)),
        [effect("dipole_gradient", "B_4", 0.03)],
    ),
    "ring3-04": Campaign(
        1.1, Measurement(repeats=5, zero_every=2),
        effects=[effect("corrector_even", "V_6", 0.07)],
    ),
    "ring3-05": Campaign(
        1.0, Measurement(repeats=4, zero_every=2, left_out=("H_3",), tunes=False),
        Imperfections(noise=(1.2, 0.9), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.005),
        [effect("dipole_edge", "B_7", 0.06)],
    ),
    "ring3-06": Campaign(
        0.8, Measurement(repeats=3, both_signs=False, zero_every=2),
        Imperfections(noise=(0.9, 0.9), missing=0.01),
        [effect("fixed_rf_frequency", None, 1.0)],
    ),
    "ring3-07": Campaign(
        1.0, Measurement(repeats=5, zero_every=2),
        replace(SCATTERED, monitor_gain=0.015),
        [effect("bpm_swap", "y_1,y_3"), effect("quad_roll", "F5", 0.01)],
    ),
    "ring3-08": Campaign(
        1.0, Measurement(repeats=4, zero_every=2),
        Imperfections(noise=(1.0, 1.1)),
        [effect("corrector_crosstalk", "H_2", 0.06)],                       # to H_3
    ),

    "ring4-01": Campaign(0.8, Measurement(repeats=1, both_signs=False, zero_every=6)),
    "ring4-02": Campaign(
        1.5, Measurement(repeats=1, zero_every=8, rf_steps=4, tunes=False),
        Imperfections(noise=(1.1, 0.9), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.01,
                      corrector_roll=0.008, missing=0.003, faulty=(("y_M.12.b", "jumps", 12.0),), lost=2),
        displaced=1.5,
    ),
    "ring4-03": Campaign(
        1.0, Measurement(repeats=1, zero_every=6),
        Imperfections(noise=(1.2, 1.2), slow=0.5),
        [effect("bpm_swap", "x_M.05.a,x_M.05.b")],
    ),
    "ring4-04": Campaign(
        0.9, Measurement(and_back=True, left_out=ALL_H_B, tunes=False),
        effects=[effect("corrector_hysteresis", None, 0.003)],            # of all correctors
    ),
    "ring4-05": Campaign(
        1.0, Measurement(repeats=1, zero_every=6),
        replace(SCATTERED, monitor_roll=0.008),
        [effect("corrector_roll", "V_K.17.a", 0.06)],
    ),
    "ring4-06": Campaign(
        1.1, Measurement(zero_every=6, left_out=ALL_V_A, tunes=False),
        Imperfections(noise=(1.1, 1.1), monitor_gain=0.02, corrector_gain=0.02),
        [effect("bpm_cubic", "x_M.20.a", 0.03)],
    ),
    "ring4-07": Campaign(
        1.0, Measurement(repeats=1),
        Imperfections(noise=(0.9, 1.0)),
        [effect("quad_drift", None, 6e-4), effect("bpm_gain", "y_M.09.b", 0.04)],
    ),
    "ring4-08": Campaign(
        0.7, Measurement(repeats=1, intensity=True),
        Imperfections(noise=(1.0, 1.0), missing=0.002),
        [effect("intensity_offset", "x_M.14.a", 0.03)],
        displaced=0.5,
    ),

    "ring5-01": Campaign(0.6, Measurement(zero_every=3)),
    "ring5-02": Campaign(
        1.2, Measurement(repeats=3, zero_every=3, rf_steps=6),
        Imperfections(noise=(1.25, 0.8), monitor_gain=0.02, corrector_gain=0.02, monitor_roll=0.006,
                      corrector_roll=0.006, slow=0.4, missing=0.005, lost=2),
        displaced=1.5,
    ),
    "ring5-03": Campaign(
        1.0, Measurement(repeats=3, both_signs=False, zero_every=3, tunes=False),
        Imperfections(noise=(1.0, 1.1), quad_roll=8e-4, momentum_jitter=3e-5, faulty=(("x_F08", "noisy", 5.0),)),
        displaced=0.6,
    ),
    "ring5-04": Campaign(
        1.0, Measurement(repeats=3, zero_every=3, tunes=False),
        Imperfections(noise=(1.1, 1.0)),
        [effect("stray_gradient", "SLOT_D05", 0.0045)],
    ),
    "ring5-05": Campaign(
        1.3, Measurement(zero_every=3, left_out=("H_F12", "V_D06")),
        replace(SCATTERED, monitor_roll=0.008, quad_roll=3e-4),
        [effect("corrector_polarity", "H_F06")],
    ),
    "ring5-06": Campaign(
        0.8, Measurement(repeats=4, zero_every=2, rf_steps=4),
        effects=[effect("momentum_offset", None, 2.5e-3)],
    ),
    "ring5-07": Campaign(
        1.0, Measurement(repeats=3, zero_every=3),
        Imperfections(noise=(0.85, 0.9), monitor_gain=0.01, corrector_gain=0.01),
        [effect("sextupole_error", "SX_F03", 1.1), effect("corrector_gain", "V_D10", -0.06)],
    ),
    "ring5-08": Campaign(
        0.9, Measurement(repeats=3, zero_every=3),
        Imperfections(noise=(1.0, 1.1)),
        [effect("solenoid", "SLOT_F11", 0.004)],
    ),
}


# ----------------------------------------------------------------------------------------------------------- recordings

def toml(value):
    """A value in TOML."""
    if isinstance(value, dict):
        quoted = {key if key.isidentifier() else f'"{key}"': toml(v) for key, v in value.items()}
        return "{ " + ", ".join(f"{key} = {v}" for key, v in quoted.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def write_header(path, machine):
    """``header.toml``."""
    ring, equipment, measurement = machine.ring, machine.equipment, machine.campaign.measurement
    convention = "+I of one corrector after the other; 0 A frames in between"
    if measurement.and_back:
        convention = "+I, 0, -I, 0 of one corrector after the other"
    elif measurement.both_signs:
        convention = "+I, then -I, of one corrector after the other; 0 A frames in between"
    sigma = equipment.sigma
    other = {name: round(float(s), 6) for name, s in zip(machine.monitor_names, machine.believed_sigma) if s != sigma}
    dipole = {"dipole": equipment.dipole_current} if equipment.dipole_current else {}
    nominal = equipment.nominal
    if measurement.format == 1:
        nominal = {"qh": nominal["QF"], "qv": nominal["QD"]}
    header = {"format": 2} if measurement.format == 2 else {}
    header |= {
        "machine": ring.name,
        "lattice": "ring.json",
        "recorded_with": f"pyAT {at.__version__}",
        "particle": ring.particle,
        "kinetic_energy_GeV": ring.kinetic_energy,
        "bpm_sigma_mm": {"default": sigma, **other} if other else sigma,
        "kick_mrad_per_A": equipment.kick_per_ampere,
        "kick_convention": convention,
        "believed_rf": equipment.believed_rf,
        "nominal_A": dipole | nominal,
        "quad_transfer": equipment.transfer,
    }
    if machine.campaign.loop_monitors:
        header["radial_loop_monitors"] = machine.campaign.loop_monitors
    with open(path, "w") as f:
        f.writelines(f"{key} = {toml(value)}\n" for key, value in header.items())


def write_frames(path, machine, run):
    """``frames.csv``, in the two formats that a recording can have."""
    readings = run.readings + machine.noise + machine.jumps + machine.slow * machine.sigma
    rows = []
    for t in range(len(machine.frames)):
        if t not in machine.lost:
            rows.append(settings(machine, t) | currents(machine, t) | measured(machine, t, readings[t], run.tunes[t]))
    with open(path, "w") as f:
        f.write(",".join(rows[0]) + "\n")
        f.writelines(",".join(row.values()) + "\n" for row in rows)


def recorded_correctors(machine):
    """Names of the correctors in the recording; format 1 does not tell their plane."""
    names = machine.corrector_names
    return [name[2:] for name in names] if machine.campaign.measurement.format == 1 else names


def settings(machine, t):
    """Columns of frame ``t``: what was set, and when."""
    measurement, frame = machine.campaign.measurement, machine.frames[t]
    first_format = measurement.format == 1
    row = {"seq": str(t + 1), "time_s": f"{4.0 * (t + 1):.3f}"}
    if first_format:
        row["t_cycle_ms"] = "0.0"
    if frame.corrector is not None:
        row |= {"corrector": recorded_correctors(machine)[frame.corrector], "setting_A": f"{frame.current:g}"}
    else:
        row |= {"corrector": "", "setting_A": "0" if first_format else ""}
    if measurement.rf_steps or first_format:
        row["drf_rel"] = f"{frame.rf_step:g}"
    return row


def currents(machine, t):
    """Columns of frame ``t``: currents of supplies and correctors."""
    equipment, first_format = machine.equipment, machine.campaign.measurement.format == 1
    row = {}
    if equipment.dipole_current:
        row["i_dipole_A"] = f"{equipment.dipole_current * machine.dipole[t]:.4f}"
    for supply, current in machine.supply.items():
        name = {"QF": "qh", "QD": "qv"}[supply] if first_format else supply
        row[f"i_{name}_A"] = f"{equipment.nominal[supply] * current[t]:.5f}"
    if first_format:
        row |= {"i_sh_A": "0", "i_sv_A": "0"}
    for name, current in zip(recorded_correctors(machine), machine.current[t]):
        row[f"ic_{name}_A"] = f"{current:.5f}"
    return row


def measured(machine, t, readings, tunes):
    """Columns of frame ``t``: readings, intensity and tunes."""
    measurement = machine.campaign.measurement
    row = {}
    for name, reading, missing in zip(machine.monitor_names, readings, machine.missing[t]):
        row[f"{name}_mm"] = "" if missing or abs(reading) > 99 else f"{reading:.5f}"
    if measurement.intensity:
        row["intensity"] = f"{machine.intensity[t]:.4e}"
    if measurement.tunes or measurement.format == 1:
        missing = machine.tune_missing[t] or not measurement.tunes
        for name, tune in zip(("qx_frac", "qy_frac"), (tunes + machine.tune_noise[t]) % 1):
            row[name] = "" if missing else f"{tune:.5f}"
    return row


# ---------------------------------------------------------------------------------------------------------------- truth

def gains(machine, run):
    """How visible the effects and the feed-down are, in the words of ``truth.json``."""
    effects, imperfections = machine.campaign.effects, machine.campaign.imperfections
    model = LinearModel(machine)
    without = machine.track([]) if effects else run
    centred = machine.track([], displaced=False)
    out = {}
    if effects:
        together = run.readings - without.readings
        single = [together]
        if len(effects) > 1:
            others = [machine.track([other for other in effects if other is not e]) for e in effects]
            single = [run.readings - other.readings for other in others]
        own, before = zip(*(model.gain(change) for change in single))
        out = {"own_gain": own, "oracle_gain": model.gain(together)[0], "own_gain_before_projection": before}
        if imperfections.monitor_gain or imperfections.corrector_gain:
            out["own_gain_with_gains_free"] = [model.gain(change, with_gains=True)[0] for change in single]
            out["oracle_gain_with_gains_free"] = model.gain(together, with_gains=True)[0]
    if centred is not None:
        out["feed_down_gain"] = model.gain(without.readings - centred.readings)[0]
    return out


def truth_of(machine, run):
    """What was put in, and how visible it is."""
    campaign, ring = machine.campaign, machine.ring
    perfect = Imperfections()
    ordinary = {key: v for key, v in asdict(campaign.imperfections).items() if v != getattr(perfect, key)}
    orbit = run.readings[0] - machine.offset
    horizontal = np.array([m.plane == "H" for m in ring.monitors])
    deviation = run.readings - run.readings[0]
    drawn = {
        "monitor_gain": dict(zip(machine.monitor_names, machine.monitor_gain.tolist())),
        "corrector_gain": dict(zip(machine.corrector_names, machine.corrector_gain.tolist())),
        "monitor_roll": dict(zip(machine.monitor_names, machine.monitor_roll.tolist())),
        "corrector_roll": dict(zip(machine.corrector_names, machine.corrector_roll.tolist())),
        "quad_roll": machine.quad_roll,
    }
    return {
        "seed": machine.seed,
        "ordinary": {"var_scatter": campaign.scatter, "quad_displacement_m": machine.displacement, **ordinary},
        "effects": list(campaign.effects),
        "vars": machine.vars,
        "condition": ", ".join(ordinary).replace("_", " ") or "nothing imperfect",
        **gains(machine, run),
        "orbit_rms_mm": [round(float(orbit[plane].std()), 4) for plane in (horizontal, ~horizontal)],
        "response_rms_mm": round(float(np.sqrt(np.mean(deviation ** 2))), 4),
        "response_max_mm": round(float(np.max(np.abs(deviation))), 3),
        "tunes": [round(float(q), 4) for q in run.tunes[0]],
        "drawn": drawn,
    }


# --------------------------------------------------------------------------------------------------------- command line

def stable_machine(ring, name):
    """The first machine that keeps its beam with the effects, within 60 mm at all monitors; and its run."""
    campaign = CAMPAIGNS[name]
    number, campaign_number = place_of(name)
    for attempt in range(20):
        machine = Machine(ring, EQUIPMENT[number], campaign, [SEED, number, campaign_number, attempt])
        run = machine.track(campaign.effects, with_tunes=campaign.measurement.tunes)
        if run is not None and np.max(np.abs(run.readings)) < 60:
            return machine, run
    raise RuntimeError(f"{name}: no stable machine")


def place_of(name):
    """Numbers of the ring and of its campaign: 3 and 2 of "ring3-02"."""
    ring, campaign = name.removeprefix("ring").split("-")
    return int(ring), int(campaign)


def make_campaign(ring, name, folder):
    """Simulate one campaign and write it; returns the truth."""
    machine, run = stable_machine(ring, name)
    truth = truth_of(machine, run)
    write_header(os.path.join(folder, "header.toml"), machine)
    write_frames(os.path.join(folder, "frames.csv"), machine, run)
    with open(os.path.join(folder, "truth.json"), "w") as f:
        json.dump(truth, f, indent=1)
    return truth


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for the rings and their campaigns")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="rings or campaigns: ring4, ring3-02")
    options = parser.parse_args()
    wanted = [name for name in CAMPAIGNS if not options.only or {name, name.split("-")[0]} & set(options.only)]
    known = set(CAMPAIGNS) | {name.split("-")[0] for name in CAMPAIGNS}
    unknown = sorted(set(options.only or []) - known)
    if unknown:
        parser.error(f"no such campaign: {', '.join(unknown)}")
    rings = {}
    for name in wanted:
        start = time.time()
        ring_name, number = name.split("-")
        folder = os.path.join(options.out, ring_name, number)
        os.makedirs(folder, exist_ok=True)
        if ring_name not in rings:
            rings[ring_name] = make_ring(place_of(name)[0])
            rings[ring_name].write(os.path.join(options.out, ring_name, "ring.json"))
        truth = make_campaign(rings[ring_name], name, folder)
        effects = [f"{e['kind']}@{e.get('at', '-')}={e.get('amplitude', '-')}" for e in truth["effects"]]
        print(f"{name} {', '.join(effects) or 'no effect'} gain {truth.get('oracle_gain', '-')} "
              f"orbit {truth['orbit_rms_mm']} mm tunes {truth['tunes']} {time.time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
