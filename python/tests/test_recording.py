"""Recordings: read, written, from pandas, from a response matrix."""

import datetime
import pickle

import numpy as np
import pandas as pd
import pytest
from conftest import IMPORTS, RECORDINGS

import orbitcal


def test_frames_and_header_are_those_of_the_files(paper_vars):
    frames = paper_vars.frames
    known = pd.read_csv(RECORDINGS / "former/paper-vars/frames.csv")
    assert len(paper_vars) == len(frames) == len(known) == 346
    np.testing.assert_allclose(frames["x_E4_mm"], known["x_E4_mm"], rtol=0, atol=1e-12)  # mm to m and back
    assert paper_vars.header["believed_rf"] == "fixed_momentum" and paper_vars.header["format"] == 2


def test_what_is_written_is_read_again(paper_vars, booster, tmp_path):
    folder = paper_vars.write(tmp_path / "paper-vars")
    again = orbitcal.Recording.read(folder, booster)
    pd.testing.assert_frame_equal(again.frames, paper_vars.frames)
    assert again.header == paper_vars.header
    pickled = pickle.loads(pickle.dumps(paper_vars))
    pd.testing.assert_frame_equal(pickled.frames, paper_vars.frames)


def test_a_table_of_pandas_is_a_recording(paper_vars, booster, fitted):
    header = {key: value for key, value in paper_vars.header.items() if key not in ("machine", "lattice", "particle")}
    made = orbitcal.Recording.from_pandas(paper_vars.frames, booster, header, name="paper-vars")
    pd.testing.assert_frame_equal(made.frames, paper_vars.frames)
    assert orbitcal.fit(made).means.equals(fitted.means)


def test_what_is_wrong_with_a_table_is_said_as_of_a_file(paper_vars, booster):
    frames = paper_vars.frames
    frames.loc[3, "x_E4_mm"] = 123.0
    with pytest.raises(orbitcal.InputError) as said:
        orbitcal.Recording.from_pandas(frames, booster, paper_vars.header, name="shift")
    assert (
        str(said.value)
        == 'shift/frames.csv, line 5, column x_E4_mm: expected a position from -100 to 100 mm, found "123.0"'
    )
    with pytest.raises(orbitcal.InputError, match="missing field `believed_rf`"):
        header = {key: value for key, value in paper_vars.header.items() if key != "believed_rf"}
        orbitcal.Recording.from_pandas(paper_vars.frames, booster, header)
    with pytest.raises(orbitcal.InputError, match="nowhere/header.toml: file not found"):
        orbitcal.Recording.read("nowhere", booster)


def test_a_check_says_what_can_be_done(paper_vars):
    checked = paper_vars.check()
    assert checked["frames"] == 346 and checked["settings"]["correctors"] == [37, 48]
    assert {one["command"]: one["can"] for one in checked["commands"]}["diagnose"]


@pytest.fixture(scope="module")
def matrix(twelve_cells):
    """docs/your-own-ring.md, whose numbers these are."""
    table = pd.read_csv(IMPORTS / "response.csv", index_col=0)
    dispersion = pd.read_csv(IMPORTS / "dispersion.csv", index_col=0, header=None)[1]
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    return orbitcal.Recording.from_response(
        table, ring, orbit_unit="mm", kick=(0.2, 0.15), kick_is="full", kick_sign="x+y+", noise=0.002,
        dispersion=dispersion, rf_step=2000.0, name="my-ring",
    )  # fmt: skip


def test_a_response_matrix_is_a_recording(matrix):
    assert matrix.is_matrix and matrix.matrix.shape == (24, 24) and matrix.matrix.attrs["units"] == "mm"
    x, y = matrix.check()["agreement"]
    assert (round(x["factor"], 3), round(x["correlation"], 3)) == (0.626, 0.676)
    assert (round(y["factor"], 3), round(y["correlation"], 3)) == (0.934, 0.998)


def test_numbers_alone_need_an_order(matrix, twelve_cells):
    words = dict(orbit_unit="mm", kick=(0.2, 0.15), kick_is="full", kick_sign="x+y+", noise=0.002)
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    numbers = np.loadtxt(IMPORTS / "response.txt")
    made = orbitcal.Recording.from_response(numbers, ring, order="planes", **words)
    np.testing.assert_allclose(made.matrix.values, matrix.matrix.values, rtol=0, atol=1e-6)  # decimals of the two files
    by_name = dict(
        words, kick={f"{plane}:COR[{n}]": 0.2 if plane == "x" else 0.15 for plane in "xy" for n in range(1, 13)}
    )
    assert orbitcal.Recording.from_response(numbers, ring, order="planes", **by_name).matrix.equals(made.matrix)
    with pytest.raises(orbitcal.InputError, match="order"):
        orbitcal.Recording.from_response(numbers, ring, **words)
    with pytest.raises(orbitcal.InputError, match='kick_sign: expected x\\+y\\+, .* found "up"'):
        orbitcal.Recording.from_response(numbers, ring, order="planes", **dict(words, kick_sign="up"))


WORDS = dict(orbit_unit="mm", kick=(0.2, 0.15), kick_is="full", kick_sign="x+y+", noise=0.002)


def test_names_of_the_ring_are_those_of_findings_and_tables(twelve_cells):
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    assert ring.monitors[0].startswith("x_BPM.") and ring.correctors[-1].startswith("V_COR.")
    response = ring.response().to_pandas()
    made = orbitcal.Recording.from_response(0.2 * response, ring, **dict(WORDS, kick=0.2))
    assert list(made.matrix.monitor.values) == ring.monitors
    x, y = made.check()["agreement"]
    assert abs(x["factor"] - 1) < 0.1 and abs(y["factor"] - 1) < 1e-6  # in x the path length is held, by default
    ring.response(effects=[{"kind": "bpm_gain", "at": ring.monitors[3], "amplitude": 0.1}])


def test_a_matrix_is_modelled_by_the_ring_with_its_factors(twelve_cells):
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    stronger = ring.with_vars({name: 1.003 for name in ring.vars.index[:4]})
    made = orbitcal.Recording.from_response(0.2 * stronger.response().to_pandas(), stronger, **dict(WORDS, kick=0.2))
    of_file = orbitcal.Recording.from_response(0.2 * stronger.response().to_pandas(), ring, **dict(WORDS, kick=0.2))
    of = lambda one: one.check()["agreement"][1]["largest_difference_mm"]
    assert of(made) < 1e-9 < 1e-3 < of(of_file)


def test_what_a_matrix_cannot_use_is_refused(matrix, twelve_cells, booster):
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    numbers = np.loadtxt(IMPORTS / "response.txt")
    with pytest.raises(orbitcal.InputError, match="expected dispersion and rf_step together"):
        orbitcal.Recording.from_response(numbers, ring, order="planes", dispersion=np.zeros(24), **WORDS)
    with pytest.raises(orbitcal.InputError, match="a matrix is fitted without a range"):
        orbitcal.fit(matrix, ring.with_priors(range=(0.9, 1.1)))
    with pytest.raises(orbitcal.InputError, match="expected its ring, .* found AGS Booster"):
        orbitcal.fit(matrix, booster)


def test_a_recording_of_another_ring_is_refused(paper_vars):
    ten_cells = orbitcal.Ring(RECORDINGS / "ten-cells/ring.json")
    for work in (orbitcal.fit, orbitcal.sample, lambda one, ring: orbitcal.diagnose(one, ring=ring)):
        with pytest.raises(orbitcal.InputError, match="paper-vars: expected its ring, AGS Booster .* found"):
            work(paper_vars, ten_cells)
    with pytest.raises(orbitcal.InputError, match="expected its ring"):
        orbitcal.Estimator(ten_cells, paper_vars)


def test_a_recording_of_another_energy_is_pickled(paper_vars, booster, tmp_path):
    folder = paper_vars.write(tmp_path / "earlier")
    header = (folder / "header.toml").read_text().replace("kinetic_energy_GeV = 1.5", "kinetic_energy_GeV = 1.0")
    (folder / "header.toml").write_text(header)
    earlier = orbitcal.Recording.read(folder, booster, any_energy=True)
    again = pickle.loads(pickle.dumps(earlier))
    assert again.header["kinetic_energy_GeV"] == 1.0
    pd.testing.assert_frame_equal(again.frames, earlier.frames)


def test_a_matrix_is_diagnosed_fitted_and_written(matrix, tmp_path):
    diagnosis = orbitcal.diagnose(matrix, progress=False)
    assert diagnosis.verdict == "identified" and diagnosis.findings[0].kind == "bpm_swap"
    assert diagnosis.findings[0].at == "x_BPM.22,x_BPM.52"
    result = orbitcal.fit(matrix)
    assert round(result.means["QF.2"], 4) == 1.0010 and round(result.table.loc["QF.2", "sigma"], 4) == 0.0006
    assert result.wiring == [{"kind": "bpm_swap", "at": "x_BPM.22,x_BPM.52"}]
    again = orbitcal.Recording.read(matrix.write(tmp_path / "my-ring"))
    assert again.matrix.equals(matrix.matrix)
    # its ring is that of its lattice, and takes the fit
    assert again.ring.monitors == matrix.ring.monitors
    calibrated = again.ring.with_vars(orbitcal.fit(again))
    assert calibrated.vars["QF.2"] == result.means["QF.2"]
    again.ring.to_pyat(orbitcal.fit(again))


def test_settings_are_numbers_where_they_can_be(paper_vars, booster):
    assert paper_vars.frames["setting_A"].dtype == float and set(paper_vars.frames["setting_A"].dropna()) == {-22, 0, 22}
    frames = paper_vars.frames.astype({"setting_A": object})
    row = frames.index[frames["setting_A"] == 22][0]
    frames.loc[row, ["corrector", "setting_A"]] = ["H_A4;H_C4", "22;-22"]
    several = orbitcal.Recording.from_pandas(frames, booster, paper_vars.header)
    assert several.frames.loc[row, "setting_A"] == "22;-22"


def test_a_recording_is_true(paper_vars, matrix):
    assert matrix and paper_vars and len(matrix) == 0


def test_numbers_of_numpy_and_pandas_are_numbers(paper_vars, booster, matrix, twelve_cells):
    header = paper_vars.header
    own = header | {
        "format": np.int64(2),
        "bpm_sigma_mm": np.float64(header["bpm_sigma_mm"]),
        "quad_transfer": np.array(header["quad_transfer"]),
    }
    assert orbitcal.Recording.from_pandas(paper_vars.frames, booster, own).header == header
    with pytest.raises(orbitcal.InputError, match="header: expected texts, numbers, .* found datetime"):
        orbitcal.Recording.from_pandas(paper_vars.frames, booster, header | {"note": datetime.date(2026, 1, 1)})
    ring, numbers = orbitcal.Ring.from_pyat(twelve_cells), np.loadtxt(IMPORTS / "response.txt")
    words = dict(orbit_unit="mm", kick=(0.2, 0.15), kick_is="full", kick_sign="x+y+", order="planes")
    by_name = pd.Series({f"{plane}:BPM[{n}]": 0.002 for plane in "xy" for n in range(1, 13)})
    made = orbitcal.Recording.from_response(numbers, ring, noise=by_name, **words)
    assert made.matrix.equals(orbitcal.Recording.from_response(numbers, ring, noise=0.002, **words).matrix)
    for noise in (np.zeros(3), (0.1, 0.2, 0.3), "loud", None):
        with pytest.raises(orbitcal.InputError, match="noise: expected a number, two"):
            orbitcal.Recording.from_response(numbers, ring, noise=noise, **words)
