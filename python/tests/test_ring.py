"""The ring: response, Jacobian and optics against other codes and against differences; the way to and from other codes."""

import json
import pickle

import at
import numpy as np
import pytest
import xarray as xr
import xtrack
from conftest import IMPORTS, ROOT

import orbitcal

KICK = 2e-6  # rad
# tolerances of docs/export.md: tracking steps of the codes and rounding of orbits
TUNE, RESPONSE = 1e-6, 1e-4  # 1, m/rad


def response_of_pyat(lattice):
    """x and y at all monitors to kicks in x and y [2][monitors][2][correctors] [m/rad], momentum held."""
    lattice = lattice.deepcopy()
    lattice.disable_6d()
    monitors, correctors = at.get_uint32_index(lattice, at.Monitor), at.get_uint32_index(lattice, at.Corrector)
    made = np.empty((2, len(monitors), 2, len(correctors)))
    for column, corrector in enumerate(correctors):
        for plane in (0, 1):
            orbits = []
            for sign in (1, -1):
                lattice[corrector].KickAngle = [sign * KICK * (plane == 0), sign * KICK * (plane == 1)]
                orbits.append(at.find_orbit4(lattice, 0.0, monitors, convergence=1e-12, max_iterations=50)[1])
            lattice[corrector].KickAngle = [0.0, 0.0]
            made[:, :, plane, column] = ((orbits[0] - orbits[1]) / (2 * KICK)).T[[0, 2]]
    return made


def both_planes(ring):
    """The same of a ring whose monitors and correctors are of both planes."""
    response = ring.response()
    monitors, correctors = len(ring.monitors) // 2, len(ring.correctors) // 2
    return response.values.reshape(2, monitors, 2, correctors)


def test_the_response_with_every_effect_is_that_of_pyat(booster):
    golden = json.loads((ROOT / "tests/golden/reference-effects.json").read_text())
    for name, case in golden["cases"].items():
        known = np.array([case["response_x_m_per_rad"], case["response_y_m_per_rad"]])
        response = booster.response(effects=case.get("effects", []), all_places=True)
        assert response.shape == (2, 48, 48)
        # the bars of tests/tests: kicks of 0.2 mrad and pyAT's integrator, on a displaced orbit its sextupoles too
        assert abs(response.values - known).max() < 2e-3, name


def test_a_response_is_what_xarray_s_constructor_makes(booster):
    """The labels are put together by private names of xarray."""
    made = booster.response()
    by_hand = xr.DataArray(made.values, booster._coords(), made.dims, made.name, made.attrs)
    xr.testing.assert_identical(made, by_hand)
    assert made.xindexes.keys() == by_hand.xindexes.keys()
    for array in (made.copy(), pickle.loads(pickle.dumps(made)), made.isel(monitor=slice(None, None, -1)) * 1.0):
        xr.testing.assert_equal(array.sel(monitor="x_E4"), by_hand.sel(monitor="x_E4"))
    xr.testing.assert_identical((made - by_hand.isel(monitor=slice(5, 9))).monitor, by_hand.isel(monitor=slice(5, 9)).monitor)
    assert made.rename(monitor="bpm").sel(bpm="x_E4").sizes == {"corrector": 48}


def test_a_response_may_be_written_to(booster):
    """What is changed in one is not changed in the next."""
    made, known = booster.response(), booster.response().copy(deep=True)
    made[0, 0] = 1.0
    made.s_monitor[0] = 3.0
    assert made.s_monitor[0] == 3.0
    made.monitor.attrs["axis"] = "BPM"
    made.s_corrector.attrs["units"] = "mm"
    made.attrs["units"] = "mm/rad"
    xr.testing.assert_identical(booster.response(), known)


def test_one_effect_need_not_be_a_list(booster):
    rolled = booster.response(effects=["quad_roll@D8=0.01"])
    for one in ("quad_roll@D8=0.01", {"kind": "quad_roll", "at": "D8", "amplitude": 0.01}):
        np.testing.assert_array_equal(booster.response(effects=one), rolled)


def test_own_planes_are_rows_of_all_places(booster):
    for effects in ([], ["bpm_gain@x_E4=0.1"], ["quad_roll@D8=0.01"]):
        own, places = booster.response(effects=effects), booster.response(effects=effects, all_places=True)
        for monitor in own.monitor.values:
            row = places.sel(plane=monitor[0], monitor=monitor)
            np.testing.assert_allclose(own.sel(monitor=monitor), row, rtol=0, atol=1e-12)  # rounding


def test_arrays_have_names_places_and_units(booster):
    response = booster.response()
    assert response.dims == ("monitor", "corrector") and response.shape == (33, 48)
    assert response.attrs["units"] == "m/rad" and response.s_monitor.attrs["units"] == "m"
    assert list(response.monitor.values) == booster.monitors and "H_A4" in response.corrector
    second = booster.response(effects=["bpm_gain@x_E4=0.1"])
    np.testing.assert_allclose(second.sel(monitor="x_E4"), 1.1 * response.sel(monitor="x_E4"), rtol=1e-12)


@pytest.mark.parametrize("rf", ["fixed-momentum", "fixed-frequency"])
@pytest.mark.parametrize("effects", [[], ["bpm_roll@y_C5=0.05", "corrector_gain@H_A2=0.1"]])
def test_the_jacobian_is_the_derivative_of_the_response(booster, rf, effects):
    jacobian = booster.jacobian(effects=effects, rf=rf)
    assert jacobian.dims == ("var", "monitor", "corrector") and jacobian.shape == (48, 33, 48)
    step = 1e-4
    for name in ("A2", "D8", "F7"):
        more, less = (
            booster.with_vars({name: np.exp(sign * step)}).response(effects=effects, rf=rf) for sign in (1, -1)
        )
        numeric = (more - less) / (2 * step)
        # truncation: step^2 times the square of the resonance denominators
        assert abs(jacobian.sel(var=name) - numeric).max() < 1e-5 * abs(jacobian).max()


def test_the_jacobian_by_quadrupole_adds_up_to_that_by_var(booster):
    by_var, by_quadrupole = booster.jacobian(), booster.jacobian(by="quadrupole")
    sums = by_quadrupole.sel(quadrupole="D8") * booster.quadrupoles["D8"]
    np.testing.assert_allclose(by_var.sel(var="D8"), sums, rtol=1e-12)


def test_the_rf_condition_matters_in_x_alone(booster):
    momentum, frequency = booster.response(), booster.response(rf="fixed-frequency")
    change = abs(frequency - momentum)
    assert change.sel(monitor="x_E4").max() > 1e-2 and change.sel(monitor="y_C5").max() < 1e-9


def test_optics_are_those_of_pyat(booster):
    optics, lattice = booster.optics(), booster.to_pyat()
    assert optics.beta.dims == ("plane", "element") and optics.beta.attrs["units"] == "m"
    assert abs(optics.attrs["tune_x"] - 4.83) < 1e-6  # the design
    tunes = at.get_tune(lattice, get_integer=True)[:2]
    assert abs(tunes - np.array([optics.attrs["tune_x"], optics.attrs["tune_y"]])).max() < TUNE
    refpts = [i for i, one in enumerate(lattice) if one.FamName.startswith("PUH_")]
    _, _, of_pyat = at.get_optics(lattice, refpts)
    own = optics.sel(element=[lattice[i].FamName for i in refpts])
    np.testing.assert_allclose(own.beta.values.T, of_pyat.beta, rtol=1e-5)  # pyAT's steps in quadrupoles
    np.testing.assert_allclose(own.dispersion.values[0], of_pyat.dispersion[:, 0], rtol=1e-4)


def test_optics_are_those_at_the_momentum_that_the_rf_leaves(booster):
    effect = ["momentum_offset=0.002"]
    moved, plain = booster.optics(effects=effect), booster.optics(rf="fixed-frequency")
    assert abs(moved.attrs["tune_x"] - plain.attrs["tune_x"]) > 1e-4
    assert booster.optics().attrs["tune_x"] == plain.attrs["tune_x"], "without an effect the frequency is the design's"


def test_a_pyat_lattice_comes_in_and_goes_out(twelve_cells):
    ring = orbitcal.Ring.from_pyat(twelve_cells)
    assert (len(ring.monitors), len(ring.correctors), len(ring.quadrupoles)) == (24, 24, 24)
    assert abs(both_planes(ring) - response_of_pyat(twelve_cells)).max() < RESPONSE
    back = ring.to_pyat()
    flat = twelve_cells.deepcopy()
    flat.disable_6d()  # its cavity moves the orbit
    assert abs(at.get_tune(back)[:2] - at.get_tune(flat)[:2]).max() < TUNE
    assert abs(response_of_pyat(back) - response_of_pyat(twelve_cells)).max() < RESPONSE
    again = orbitcal.Ring.from_pyat(back)
    assert abs(again.response().values - ring.response().values).max() < 1e-9  # decimals of the file


def test_an_xsuite_line_comes_in_and_goes_out():
    line = xtrack.Line.from_json(str(IMPORTS / "twelve-cells.xsuite.json"))
    ring = orbitcal.Ring.from_xsuite(line, monitors=["bpm*"], correctors=["cor*"])
    optics, back = ring.optics(), ring.to_xsuite()
    for own in (line, back):
        own.build_tracker()
        twiss = own.twiss4d(co_search_settings={"xtol": 1e-14})
        assert abs(twiss.qx - optics.attrs["tune_x"]) < TUNE and abs(twiss.qy - optics.attrs["tune_y"]) < TUNE
    again = orbitcal.Ring.from_xsuite(back, monitors=["bpm*"], correctors=["corrector*"])
    assert abs(again.response().values - ring.response().values).max() < 1e-9  # decimals of the file


@pytest.mark.parametrize("active", [True, False])
@pytest.mark.parametrize("bend", ["sector", "straight"])
def test_edges_that_xsuite_has_switched_off_are_none(bend, active):
    """Eight cells with sixteen bends, whose edges change a tune by 0.7; markers are monitors, one pattern may be a text."""
    angle = 2 * np.pi / 16
    made = {
        "sector": lambda: xtrack.Bend(
            length=1.5, angle=angle, k0_from_h=True, edge_entry_angle=angle / 2, edge_exit_angle=angle / 2
        ),
        "straight": lambda: xtrack.RBend(length_straight=1.5, angle=angle, k0_from_h=True),
    }[bend]

    def dipole():
        one = made()
        one.edge_entry_active = one.edge_exit_active = active
        return one

    elements, names = [], []
    for cell in range(8):
        of_cell = {
            "qf": xtrack.Quadrupole(length=0.3, k1=0.9),
            "da": xtrack.Drift(length=0.4),
            "ba": dipole(),
            "monitor": xtrack.Marker(),
            "corrector": xtrack.Multipole(knl=[0.0], ksl=[0.0]),
            "db": xtrack.Drift(length=0.4),
            "qd": xtrack.Quadrupole(length=0.3, k1=-0.8),
            "dc": xtrack.Drift(length=0.4),
            "bb": dipole(),
            "dd": xtrack.Drift(length=0.4),
        }
        elements += of_cell.values()
        names += [f"{name}{cell}" for name in of_cell]
    line = xtrack.Line(elements=elements, element_names=names)
    line.particle_ref = xtrack.Particles(p0c=2e9, mass0=xtrack.PROTON_MASS_EV)
    twiss = line.twiss4d()
    optics = orbitcal.Ring.from_xsuite(line, monitors="monitor*", correctors="corrector*").optics().attrs
    assert abs(twiss.qx - optics["tune_x"]) < TUNE and abs(twiss.qy - optics["tune_y"]) < TUNE


def test_what_the_twin_leaves_out_is_said(twelve_cells):
    lattice = twelve_cells.deepcopy()
    for one in lattice[at.Quadrupole][:3]:
        one.PolynomA = np.array([0.0, 0.01])
    with pytest.warns(UserWarning, match="left out of 3 elements: .*skew"):
        orbitcal.Ring.from_pyat(lattice)


def test_a_fit_goes_into_a_lattice(booster, fitted):
    calibrated = booster.with_vars(fitted)
    assert abs(calibrated.vars["D8"] - fitted.means["D8"]) < 1e-15
    tunes = at.get_tune(booster.to_pyat(fitted), get_integer=True)[:2]
    of_twin = calibrated.optics().attrs
    assert abs(tunes - np.array([of_twin["tune_x"], of_twin["tune_y"]])).max() < TUNE


def test_a_ring_survives_pickling(booster, twelve_cells):
    for ring in (booster.with_vars({"D8": 0.96}).with_priors(width=0.02), orbitcal.Ring.from_pyat(twelve_cells)):
        again = pickle.loads(pickle.dumps(ring))
        np.testing.assert_array_equal(again.response(), ring.response())
        assert again.vars.equals(ring.vars) and again.name == ring.name


def test_errors_are_those_of_the_program(booster, tmp_path):
    said = lambda call: str(pytest.raises(orbitcal.InputError, call).value)
    assert said(lambda: orbitcal.Ring("nowhere.json")) == "nowhere.json: file not found"
    toy = {
        "name": "toy",
        "circumference_m": 3.0,
        "k1": {},
        "reference": {"particle": "muon", "kinetic_energy_GeV": 1.0},
        "elements": [],
    }
    (tmp_path / "toy.json").write_text(json.dumps(toy))
    # docs/machine.md, "What is refused"
    assert (
        said(lambda: orbitcal.Ring(tmp_path / "toy.json"))
        == "toy: expected reference.particle proton or electron, found muon"
    )
    assert said(lambda: booster.with_vars({"Z9": 1.0})) == f'expected a quadrupole of {booster.name}, found "Z9"'
    assert said(lambda: booster.with_vars({"D8": 9.0})) == "var D8: expected 0.5 to 1.5, found 9"
    assert "bpm_gane" in said(lambda: booster.response(effects=["bpm_gane@x_E4"]))
    assert said(booster.with_vars({name: 0.5 for name in booster.vars.index[:24]}).response).startswith(
        f"{booster.name}: unstable motion: half trace"
    )
    assert isinstance(orbitcal.InputError(), ValueError)
    with pytest.raises(orbitcal.InputError, match="no monitors by the types of the elements"):
        orbitcal.Ring.from_lattice(IMPORTS / "twelve-cells.xsuite.json")
