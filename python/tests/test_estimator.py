"""The core on frames as they come, its feedback, and the shared memory of another process."""

import os
import subprocess
import uuid

import numpy as np
import pandas as pd
import pytest
from conftest import RECORDINGS

import orbitcal
from orbitcal.estimator import frames_as_bytes


@pytest.fixture(scope="module")
def last(booster, paper_vars):
    """The estimate after all frames of a recording."""
    estimates = list(orbitcal.Estimator(booster, paper_vars).stream(paper_vars))
    assert [one.frames for one in estimates] == list(range(1, 347))
    return estimates[-1]


def test_the_stream_ends_where_the_fit_does(last, fitted, booster):
    assert last.vars == list(fitted.means.index) and last.monitors == booster.monitors
    away = abs(last.mean - fitted.means.values) / fitted.table["sigma"].values
    assert away.max() < 0.1  # README: 0.07 of an error bar
    np.testing.assert_allclose(np.sqrt(np.diag(last.covariance)), last.sigma, rtol=0.05)  # before truncation
    assert last.usable and last.mismatch is False and last.publisher is None
    assert dict(zip(last.monitors, last.monitor_state))["x_C6"] == "noisy"
    assert "48 vars" in repr(last)


def test_bytes_rows_and_recordings_are_the_same_frames(booster, paper_vars, last):
    by_bytes = orbitcal.Estimator(booster, paper_vars)
    *_, of_bytes = by_bytes.stream(frames_as_bytes(paper_vars))
    # a header alone is enough where frames have names
    by_rows = orbitcal.Estimator(booster, paper_vars.header)
    *_, of_rows = by_rows.stream(paper_vars.frames)
    for other in (of_bytes, of_rows):
        np.testing.assert_array_equal(other.mean, last.mean)
        np.testing.assert_array_equal(other.covariance, last.covariance)
    assert 0.9 < by_rows.chi2_per_dof < 1.1 and by_rows.fitted.shape == (33,)


def test_a_frame_that_cannot_be_is_refused(booster, paper_vars):
    estimator = orbitcal.Estimator(booster, paper_vars.header)
    with pytest.raises(orbitcal.InputError, match="expected a first frame with the names of its columns"):
        estimator.update(b"\0")
    row = paper_vars.frames.iloc[0].drop("x_E4_mm")
    with pytest.raises(orbitcal.InputError, match="x_E4_mm"):
        estimator.update(row)
    estimator.update(paper_vars.frames.iloc[0])
    with pytest.raises(orbitcal.InputError):
        estimator.update(b"\1\2\3\0")


def test_an_empty_cell_is_a_missing_reading(booster, paper_vars):
    """As NaN, as None and as pandas' NA."""
    means = []
    for empty in (np.nan, None, pd.NA):
        row = paper_vars.frames.iloc[0].astype(object)
        row["x_E4_mm"] = empty
        estimate = orbitcal.Estimator(booster, paper_vars.header).update(row)
        assert estimate.reading[booster.monitors.index("x_E4")] == 0
        means.append(estimate.mean)
    np.testing.assert_array_equal(means[1:], [means[0], means[0]])


def test_a_feedback_says_its_set_points(booster, paper_vars):
    """Two correctors whose currents follow bring an orbit back that one of them has moved by 2 A."""
    estimator = orbitcal.Estimator(booster, paper_vars)
    assert estimator.correction is None
    for _ in estimator.stream(paper_vars):
        pass
    frames, columns = paper_vars.frames, [f"{name}_mm" for name in booster.monitors]
    row = frames[frames["setting_A"] == 0].iloc[-1].copy()
    row["seq"], row["time_s"] = frames[["seq", "time_s"]].iloc[-1]
    before = row[columns].to_numpy(dtype=float)
    wanted = dict(zip(booster.monitors, 1e-3 * before, strict=True))
    estimator.steer(wanted, correctors=["H_A4", "H_C4"], patience=10.0)  # frames are 4 s apart
    response = booster.response().to_pandas()[["H_A4", "H_C4"]] * paper_vars.header["kick_mrad_per_A"]  # mm/A
    currents, random, followed = pd.Series(0.0, response.columns), np.random.default_rng(1), []
    for _ in range(40):
        row["seq"], row["time_s"] = row["seq"] + 1, row["time_s"] + 4.0
        row["ic_A4_A"], row["ic_C4_A"] = currents
        row[columns] = random.normal(before + response @ currents + 2.0 * response["H_A4"], 0.15)
        estimator.update(row)
        currents = estimator.correction.setpoint[currents.index]
        if estimator.correction.hold is None:
            followed.append(estimator.correction)
    assert len(followed) > 10  # others are frames that surprise: the vars are not those of the design
    made = followed[-1]
    assert list(made.setpoint.index) == booster.correctors
    assert dict(made.role[made.role != "unused"]) == {"H_A4": "used", "H_C4": "used"}
    assert made.limited == made.left_out == 0
    assert abs(made.setpoint["H_A4"] + 2.0) < 1.0 and abs(made.setpoint["H_C4"]) < 1.0
    with pytest.raises(orbitcal.InputError, match="has no monitor 'x_Z9'"):
        estimator.steer({"x_Z9": 0.0})


@pytest.mark.skipif("ORBITCAL" not in os.environ, reason="ORBITCAL names the program, as make python does")
def test_another_process_is_read_from_shared_memory(last):
    service = f"orbitcal/test-{uuid.uuid4()}"
    subscriber = orbitcal.Subscriber(service)
    command = [
        os.environ["ORBITCAL"],
        "replay",
        RECORDINGS / "former/paper-vars",
        "--service",
        service,
        "--name",
        "night shift",
        "--quiet",
    ]
    with subprocess.Popen([*command, "--rate", "200"]) as publisher:
        read = []
        for estimate in subscriber.stream(timeout=20):
            read.append(estimate)
            if estimate.frames == 346:
                break
        assert publisher.wait(20) == 0
    assert type(read[-1]) is orbitcal.Estimate is type(last)
    assert read[-1].publisher == "night shift" and read[-1].machine == last.machine
    assert [one.frames for one in read] == list(range(1, 347))
    np.testing.assert_array_equal(read[-1].mean, last.mean)
    np.testing.assert_array_equal(read[-1].covariance, last.covariance)
    assert read[-1].monitor_state == last.monitor_state


def test_nothing_published_is_nothing_read():
    subscriber = orbitcal.Subscriber(f"orbitcal/test-{uuid.uuid4()}")
    assert subscriber.wait(0.05) == []
    assert list(subscriber.stream(timeout=0.05)) == []


def test_an_estimate_is_a_table_in_one_line(last):
    table = pd.DataFrame({"mean": last.mean, "sigma": last.sigma}, index=last.vars)
    assert table.shape == (48, 2) and (table["sigma"] > 0).all()
