"""The page of the whole story: what was concealed, what was found, and what that is worth."""

import html
import io

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.ticker import LogLocator  # noqa: E402

USED = 1  # of a reading
MEAN = 20  # frames
BEFORE, AFTER, TRUE = "#b4531a", "#1a5fb4", "#222222"
STYLE = """body { font: 16px/1.5 system-ui, sans-serif; max-width: 980px; margin: 2em auto; padding: 0 1em; color: #222 }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em } table { border-collapse: collapse } td, th { padding: .25em .9em .25em 0; text-align: left }
td.number { text-align: right } svg { width: 100%; height: auto } p.small { color: #555; font-size: .9em }"""
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "none"})


def svg(figure):
    out = io.StringIO()
    figure.tight_layout()
    figure.savefig(out, format="svg")
    plt.close(figure)
    return out.getvalue()[out.getvalue().index("<svg") :]


def decades(axis):
    """A logarithmic axis with plain numbers."""
    for each in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
        each(lambda number, _: f"{number:g}")
    axis.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))


def legend(axis):
    """Above the axes, where it hides nothing."""
    axis.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, borderaxespad=0.2)


def live(show, recorder):
    """Innovations of the stream against time, with what was done."""
    start = show.marks[0][0]
    figure, axis = plt.subplots(figsize=(9, 3.2))
    used = [(when - start, one.nis / count) for when, one in recorder.estimates if (count := one.reading.count(USED)) > 0]
    times, each = np.array(used).T
    axis.semilogy(times[MEAN - 1 :], np.convolve(each, np.full(MEAN, 1 / MEAN), "valid"), color=TRUE, lw=1.0)
    axis.axhline(1.0, color="#999999", lw=0.8, ls=":")
    # marks that follow each other within a few seconds have one number below the other
    row, near = 0, 0.02 * (show.marks[-1][0] - start)
    for number, (when, _) in enumerate(show.marks, 1):
        row = row + 1 if number > 1 and when - show.marks[number - 2][0] < near else 0
        axis.axvline(when - start, color="#cccccc", lw=0.8, zorder=0)
        axis.annotate(str(number), (when - start, 1.0 + 0.07 * row), xycoords=("data", "axes fraction"), ha="center", va="bottom", color="#555555")
    axis.set(xlabel="time [s]", ylabel="NIS per reading")
    decades(axis)
    return svg(figure)


def orbit(runs, orbits):
    """Rms orbit against the cycle, both models."""
    figure, axis = plt.subplots(figsize=(9, 3.4))
    for run, colour in zip(runs, (BEFORE, AFTER)):
        cycles = np.arange(run["first"], run["last"])
        each = [np.sqrt(np.mean(orbits[cycle] ** 2)) for cycle in cycles]
        axis.semilogy(cycles - run["first"], each, color=colour, lw=1.2, label=run["name"])
    for move in runs[0]["moves"]:
        axis.axvline(move - runs[0]["first"], color="#dddddd", lw=0.8, zorder=0)
    axis.set(xlabel="cycle since the feedback was switched on", ylabel="orbit, rms over monitors [mm]")
    decades(axis)
    legend(axis)
    return svg(figure)


def monitors(names, runs, orbits):
    """Rms over cycles at each monitor."""
    figure, axis = plt.subplots(figsize=(9, 3.0))
    at = np.arange(len(names))
    for offset, run, colour in zip((-0.2, 0.2), runs, (BEFORE, AFTER)):
        each = np.array([orbits[cycle] for cycle in run["answered"]])
        axis.bar(at + offset, np.sqrt(np.mean(each**2, axis=0)), 0.38, color=colour, label=run["name"])
    axis.set(ylabel="orbit, rms over cycles [mm]", xlim=(-0.8, len(names) - 0.2))
    axis.set_xticks(at, names, rotation=90)
    legend(axis)
    return svg(figure)


def factors(show, recorder, runs):
    """Strength factors less the truth, in error bars' sight."""
    first_with_model = next(when for when, what in show.marks if what == f"feedback on, {runs[1]['name']}")
    before = next((one for when, one in reversed(recorder.estimates) if when < marked(show, runs[0])), recorder.estimates[0][1])
    after = next((one for when, one in reversed(recorder.estimates) if when < first_with_model), recorder.estimates[-1][1])
    figure, axis = plt.subplots(figsize=(9, 3.0))
    at = np.arange(len(before.vars))
    for offset, one, colour, name in ((-0.15, before, BEFORE, runs[0]["name"]), (0.15, after, AFTER, runs[1]["name"])):
        error = [100 * (mean - show.story.truth[var]) for var, mean in zip(one.vars, one.mean)]
        axis.errorbar(at + offset, error, [100 * sigma for sigma in one.sigma], fmt="o", ms=3, lw=0.9, color=colour, label=name)
    axis.axhline(0.0, color="#999999", lw=0.8)
    axis.set(ylabel="strength factor, estimate − truth [%]", xlim=(-0.8, len(at) - 0.2))
    axis.set_xticks(at, before.vars, rotation=90)
    legend(axis)
    return svg(figure)


def marked(show, run):
    return next(when for when, what in show.marks if what == f"feedback on, {run['name']}")


def table(rows):
    cells = "".join(f"<tr><th>{html.escape(name)}</th>" + "".join(f"<td class=number>{html.escape(one)}</td>" for one in row) + "</tr>" for name, *row in rows)
    return f"<table>{cells}</table>"


def shown(one):
    """An effect in words; error bar where there is one."""
    if one["amplitude"] is None or one["kind"].endswith("polarity"):
        return f"{one['kind']} at {one['at']}"
    sigma = f" ± {100 * one['sigma']:.1f}" if "sigma" in one else ""
    return f"{one['kind']} at {one['at']}, {100 * one['amplitude']:+.1f}{sigma} %"


def page(path, show, recorder, runs, exact, result):
    """Write it."""
    (names, orbits), found = exact, result["findings"]
    start = show.marks[0][0]
    steps = "".join(f"<li>{html.escape(what)} ({when - start:.0f} s)</li>" for when, what in show.marks)
    numbers = table(
        [
            ("", "design's model", "model that was found"),
            ("chi²/dof of the live stream under feedback", f"{result['chi2_per_dof_before']:.3f}", f"{result['chi2_per_dof_after']:.3f}"),
            ("orbit with feedback, rms [mm]", f"{result['feedback_rms_mm_before']:.3f}", f"{result['feedback_rms_mm_after']:.3f}"),
        ]
    )
    text = f"""<!doctype html><html lang=en><meta charset=utf-8><title>The Booster, a concealed effect, and the feedback</title><style>{STYLE}</style>
<h1>A concealed effect found, and what that is worth to the orbit feedback</h1>
{table([("concealed", shown(show.truth)), ("found", shown(found[0]) if found else "nothing")])}
<p>{html.escape(result["verdict"])} after {result["campaigns"]} measured {"campaign" if result["campaigns"] == 1 else "campaigns"}, {result["seconds"]:.0f} s in all. The machine is simulated by exact closed orbits behind an
EPICS IOC; the daemon, the measurement and the feedback see its channels and nothing else.</p>
{numbers}
<h2>The live stream</h2>
{live(show, recorder)}
<ol>{steps}</ol>
<p class=small>Normalised innovations squared of the readings that the daemon used, each predicted before it was learnt; mean of {MEAN} frames. A right model has 1.</p>
<h2>The orbit under feedback</h2>
{orbit(runs, orbits)}
<p class=small>At each grey line operators move {", ".join(show.operators)} by up to {show.disturbed_A:g} A; the feedback brings the orbit back with the other correctors.
Both runs begin with the same machine and have the same moves. The orbit is what the monitors would read without noise, less the orbit that was there at the
beginning, and less the shape of the dispersion: that is momentum, which the feedback leaves alone. Numbers and bars are of the frames from the eighth after each move on.</p>
{monitors(names, runs, orbits)}
<h2>Strength factors of the quadrupoles</h2>
{factors(show, recorder, runs)}
<p class=small>Estimates of the daemon before the feedback was switched on, with error bars of one standard deviation.</p>
<p class=small>Seed {result["seed"]}. The diagnosis in full: <a href="booster/diagnosis.html">booster/diagnosis.html</a>.</p>
</html>"""
    path.write_text(text)
