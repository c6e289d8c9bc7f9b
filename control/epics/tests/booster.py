"""The whole story: the simulated Booster with a concealed effect, measured through EPICS, diagnosed, and the model that was found judged on one
more measurement.

Usage: booster.py ORBITCAL [SEED], in the repository, with the Python that has orbitcal-epics. Writes target/booster.json. The effect is drawn here;
orbitcal is told nothing of it. Exit status 0 if kind and place are found.
"""

import json
import random
import shutil
import sys
import time
from pathlib import Path

from measure import Story

# Kind, places, amplitudes: about twice what `diagnose` states as the median detection limit of one such campaign
# (8.6 % of a monitor's gain, 7.4 % of a corrector's, 4.4 mrad of a quadrupole's roll)
CONCEALED = [
    ("quad_roll", ["B4", "D8", "F2", "C3"], [0.009, -0.009]),
    ("bpm_gain", ["x_E4", "x_B6", "y_D3"], [0.17, -0.17]),
    ("corrector_gain", ["H_C4", "H_E6", "V_F1"], [0.15, -0.15]),
]

MOST = 3  # campaigns that are taken to tell what is missing


def effect(seed):
    pick = random.Random(seed)
    kind, places, amplitudes = pick.choice(CONCEALED)
    return {"kind": kind, "at": pick.choice(places), "amplitude": pick.choice(amplitudes)}


def run(story, *command):
    out = story.folder / "result.json"
    story.run(*command, "--quiet", "--json", out)
    return json.loads(out.read_text())


def main(orbitcal, seed="1"):
    began = time.monotonic()
    folder = Path("target/booster")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    story, truth = Story(Path(orbitcal).resolve(), int(seed), folder.resolve()), effect(int(seed))
    model, page = folder / "model.bin", folder / "diagnosis.html"
    with story.booster("--effect", "{kind}@{at}={amplitude}".format(**truth)):
        for campaigns in range(1, MOST + 1):
            story.run("measure", story.plan, "--out", folder / f"campaign-{campaigns}", *story.epics)
            measured = [folder / f"campaign-{number}" for number in range(1, campaigns + 1)]
            found = run(story, "diagnose", *measured, "--model-out", model, "--report", page)
            print(found["sentence"], flush=True)
            if found["verdict"] != "ambiguous":
                break
            print(f"the data cannot tell yet: {found['next_measurement']}; measured once more, with the same settings", flush=True)
        story.run("measure", story.plan, "--out", folder / "judge", *story.epics)
    streamed = ["replay", folder / "judge", "--no-publish"]
    before = run(story, *streamed)["chi2_per_dof"]
    after = run(story, *streamed, "--model-file", model)["chi2_per_dof"] if model.exists() else before
    result = {
        "truth": [truth],
        "findings": found["findings"],
        "verdict": found["verdict"],
        "campaigns": campaigns,
        "chi2_per_dof_before": before,
        "chi2_per_dof_after": after,
        "seconds": time.monotonic() - began,
    }
    Path("target/booster.json").write_text(json.dumps(result, indent=2) + "\n")
    print(f"concealed: {truth['kind']} at {truth['at']}, {truth['amplitude']}")
    print(f"one more measurement, in the core: chi2/dof {before:.3f} with the design's model, {after:.3f} with what was found")
    print(f"{result['seconds']:.0f} s; target/booster.json, {page}")
    first = (found["findings"] or [{}])[0]
    return 0 if (first.get("kind"), first.get("at")) == (truth["kind"], truth["at"]) else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
