"""Fit, sample, diagnose, compare: results, reports, Ctrl-C, threads, progress."""

import signal
import threading
import time
from pathlib import Path

import arviz
import numpy as np
import pytest
from conftest import RECORDINGS

import orbitcal


def test_a_fit_is_that_of_the_program(fitted):
    assert (fitted.method, fitted.model, fitted.frames) == ("map", "twin", 346)
    assert abs(fitted.means["D8"] - 0.9572) < 4e-4 and abs(fitted.means["A4"] - 0.9926) < 4e-4
    assert abs(fitted.chi2_per_dof - 0.987) < 2e-3 and fitted.tunes == pytest.approx((4.8061, 4.6534), abs=1e-4)
    assert {one.name: one.state for one in fitted.monitors}["x_C6"] == "noisy"
    covariance = fitted.covariance
    assert covariance.shape == (48, 48)
    # sigma is that of the truncated posterior
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), fitted.table["sigma"], rtol=0.05)


def test_a_recording_is_read_with_the_built_in_ring_that_it_names():
    recording = orbitcal.Recording.read(RECORDINGS / "paper-vars")
    assert recording.ring.optics().attrs["tune_x"] == orbitcal.Ring.booster().optics().attrs["tune_x"]
    fitted = orbitcal.fit(recording)
    # the README's table is the stream's, which is within 0.1 of an error bar (0.3 to 0.5 %) of this
    assert fitted.tunes == pytest.approx((4.8076, 4.6553), abs=1e-4) and abs(fitted.means["D8"] - 0.9582) < 4e-4


def test_a_result_prints_shows_and_reports(fitted, tmp_path):
    assert "chi2/dof" in str(fitted) and "paper-vars: 346 frames" in repr(fitted)
    shown = fitted._repr_html_()
    assert shown.startswith("<pre") and "data:image/png;base64," in shown
    page = fitted.report(tmp_path / "fit.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and "paper-vars" in page
    assert fitted.json["vars"][0]["name"] == "A2"
    with pytest.raises(orbitcal.OrbitcalError, match="folder not found"):
        fitted.report(tmp_path / "nowhere/fit.html")


def test_other_priors_pull_other_ways(paper_vars, booster, fitted):
    tight = orbitcal.fit(paper_vars, booster.with_priors(width=0.005))
    assert (tight.table["sigma"] < fitted.table["sigma"]).all()
    with pytest.raises(orbitcal.InputError, match="rf is for a measured matrix"):
        orbitcal.fit(paper_vars, rf="fixed-momentum")


def test_a_posterior_is_for_arviz(paper_vars, fitted):
    data = orbitcal.sample(paper_vars, model="green", chains=2, warm_up=300, draws=500, seed=3, progress=False)
    assert isinstance(data, arviz.InferenceData)
    assert dict(data.posterior["vars"].sizes) == {"chain": 2, "draw": 500, "var": 48}
    assert list(data.posterior["var"].values) == list(fitted.means.index)
    summary = arviz.summary(data, kind="diagnostics")
    assert summary["r_hat"].max() < 1.05 and summary["ess_bulk"].min() > 200  # of 1000 draws
    assert {"lp", "diverging", "energy", "tree_depth", "n_steps"} <= set(data.sample_stats)
    mean = data.posterior["vars"].mean(("chain", "draw"))
    # 200 effective draws: 0.07 of an error bar, four of them for the largest of 48, and 0.03 between sampler and fit
    assert (abs(mean.values - fitted.means) / fitted.table["sigma"]).max() < 0.3
    again = orbitcal.sample(paper_vars, model="green", chains=2, warm_up=300, draws=500, seed=3, progress=False)
    np.testing.assert_array_equal(again.posterior["vars"], data.posterior["vars"])
    with pytest.raises(orbitcal.InputError, match="draws: expected 4 or more, found 1"):
        orbitcal.sample(paper_vars, draws=1)


@pytest.fixture(scope="module")
def open_10(booster):
    return orbitcal.Recording.read(RECORDINGS / "concealed/open-10", booster)


@pytest.fixture(scope="module")
def diagnosed(open_10):
    return orbitcal.diagnose(open_10, progress=False)


def test_missing_physics_is_found(diagnosed, tmp_path):
    finding = diagnosed.findings[0]
    assert (diagnosed.verdict, finding.kind, finding.at) == ("identified", "stray_skew_gradient", "SLOT_B6")
    assert finding.probability > 0.95 and abs(finding.amplitude + 0.0089) < 3 * finding.sigma
    assert len(diagnosed.vars_after) == 48 and diagnosed.fit["elpd_gain"] > 2 * diagnosed.fit["elpd_gain_se"]
    assert list(diagnosed.table["kind"]) == ["stray_skew_gradient"]
    assert "data:image/png" in diagnosed._repr_html_() and "SLOT_B6" in str(diagnosed)
    assert "SLOT_B6" in diagnosed.report(tmp_path / "open-10.html").read_text()


def test_what_changed_between_two_recordings(paper_vars, booster):
    other = orbitcal.Recording.read(RECORDINGS / "former/random-vars", booster)
    compared = orbitcal.compare(paper_vars, other)
    assert len(compared.changes) == 48 and compared.sentence
    assert compared.table["changed"].any() and "data:image/png" in compared._repr_html_()
    same = orbitcal.compare(paper_vars, paper_vars)
    assert not same.table["changed"].any() and abs(same.table["relative"]).max() == 0


def test_recordings_of_both_sorts_do_not_compare(paper_vars):
    matrix = orbitcal.Recording.read(RECORDINGS / "measured/twelve-cells/before")
    with pytest.raises(orbitcal.InputError, match="one is a measured matrix, one a recording of frames"):
        orbitcal.compare(paper_vars, matrix)
    compared = orbitcal.compare(matrix, orbitcal.Recording.read(RECORDINGS / "measured/twelve-cells/after"))
    assert compared.changes[0].index is not None


def system_threads():
    """Threads of this process that compute: those of Python and of Rust."""
    return len(list(Path("/proc/self/task").iterdir()))


@pytest.mark.parametrize("work", ["sample", "diagnose"])
def test_ctrl_c_stops_it(paper_vars, open_10, work):
    """The signal comes while the work is under way, and is heard long before its end."""
    long = {
        # long, and yet it ends where the signal is not heard
        "sample": lambda: orbitcal.sample(paper_vars, draws=20_000, progress=False),
        "diagnose": lambda: [orbitcal.diagnose(open_10, progress=False) for _ in range(5)],
    }[work]
    before = system_threads()
    timer = threading.Timer(0.5, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        long()
    timer.join()
    # the worker ends at its next step; a step of the diagnosis takes seconds
    end = time.monotonic() + 60
    while system_threads() > before and time.monotonic() < end:
        time.sleep(0.1)
    assert system_threads() <= before


def test_other_threads_run_beside_it(open_10):
    """A thread of Python counts while a diagnosis runs."""
    counted, over = [0], threading.Event()

    def count():
        while not over.is_set():
            counted[0] += 1
            time.sleep(0.01)

    thread = threading.Thread(target=count)
    thread.start()
    orbitcal.diagnose(open_10, progress=False)
    over.set()
    thread.join()
    assert counted[0] > 20


def test_progress_is_heard_to_the_end(paper_vars, monkeypatch):
    import tqdm.auto

    drawn, closed = [], []

    class Bar(tqdm.auto.tqdm):
        def refresh(self, *arguments, **named):
            drawn.append((self.n, self.total))
            return super().refresh(*arguments, **named)

        def close(self):
            closed.append(self.n)
            super().close()

    monkeypatch.setattr(tqdm.auto, "tqdm", Bar)
    orbitcal.sample(paper_vars, model="green", chains=1, warm_up=50, draws=200, progress=True)
    assert all(total == 250 for _, total in drawn) and drawn == sorted(drawn)
    assert drawn[-1] == (250, 250) and closed[0] == 250


def test_an_error_in_a_bar_ends_the_work(paper_vars):
    """What a bar raises comes out as it is."""
    from orbitcal import _orbitcal

    def hear(step, done):
        raise ZeroDivisionError(step)

    with pytest.raises(ZeroDivisionError, match="Gauss-Newton"):
        _orbitcal.fit(paper_vars.ring._ring, paper_vars._recording, None, False, hear)
