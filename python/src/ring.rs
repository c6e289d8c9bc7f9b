//! A ring for Python.

use std::collections::BTreeMap;

use inference::with_priors;
use lattices::export::{Calibration, Format, Lattice, text};
use measured::Folder;
use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use results::factors;
use twin::{BUILT_IN, Effect, EffectText, Machine, Rf};

use crate::array::{matrices, matrix};
use crate::error::input;
use crate::response::{by_parameter, jacobian, response, table};
use crate::source::{Imported, Source};

/// What makes a ring again: text and name of its file, patterns of monitors and correctors of a lattice, vars, prior width and range.
type State = (String, String, Option<(Vec<String>, Vec<String>)>, Vec<f64>, Option<f64>, Option<[f64; 2]>);

/// A ring; see `orbitcal.Ring`.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
pub struct Ring {
    /// The ring of the twin.
    pub ring: twin::Ring,
    source: Source,
    /// Factor of each param on what the file says.
    vars: Vec<f64>,
    width: Option<f64>,
    range: Option<[f64; 2]>,
    /// The ring on its design momentum, without effects.
    plain: Machine,
}

impl Ring {
    fn of(source: Source, vars: Option<Vec<f64>>, width: Option<f64>, range: Option<[f64; 2]>) -> PyResult<Self> {
        let ring = with_priors(&source.ring()?, width, range);
        let vars = vars.unwrap_or_else(|| vec![1.0; ring.parameters.len()]);
        let ring = ring.with_vars(&vars);
        let plain = Machine::new(ring.clone(), Rf::FixedMomentum, &[]).map_err(input)?;
        Ok(Self { ring, source, vars, width, range, plain })
    }

    /// The lattice of another code that it was made of.
    pub fn imported(&self) -> Option<&Imported> {
        match &self.source {
            Source::Lattice(imported) => Some(imported),
            Source::Machine { .. } => None,
        }
    }

    /// The width of the prior of every var, if the ring was told one.
    pub fn width(&self) -> Option<f64> {
        self.width
    }

    /// The range of every var, if the ring was told one.
    pub fn range(&self) -> Option<[f64; 2]> {
        self.range
    }

    /// Give a measurement of the lattice that the ring was made of the ring's gradients.
    pub fn strengthen(&self, folder: &mut Folder) {
        let named: BTreeMap<String, f64> = self.quadrupoles().into_iter().zip(self.ring.gradients()).collect();
        let of_row: Vec<Option<f64>> =
            (0..folder.lattice.len()).map(|row| named.get(&folder.element(row)).copied()).collect();
        folder.lattice.iter_mut().zip(of_row).for_each(|(row, k1)| row.k1 = k1.unwrap_or(row.k1));
    }

    /// Effects by their words.
    pub fn effects(&self, words: &[String]) -> PyResult<Vec<Effect>> {
        let read = |word: &String| word.parse::<EffectText>().and_then(|effect| effect.resolve(&self.ring));
        words.iter().map(read).collect::<Result<_, _>>().map_err(input)
    }

    /// Let a machine of this ring do something; without effects and on its momentum one is at hand.
    fn with_machine<T>(
        &self,
        (words, rf): (&[String], &str),
        work: impl FnOnce(&Machine, &[Effect]) -> Result<T, twin::OrbitError>,
    ) -> PyResult<T> {
        let (effects, rf) = (self.effects(words)?, rf_of(rf)?);
        let unstable = |error: twin::OrbitError| input(format!("{}: {error}", self.ring.name));
        if effects.is_empty() && rf == Rf::FixedMomentum {
            return work(&self.plain, &effects).map_err(unstable);
        }
        let machine = Machine::new(self.ring.clone(), rf, &effects).map_err(input)?;
        work(&machine, &effects).map_err(unstable)
    }
}

/// What the RF system holds, in the words of `--rf`.
pub fn rf_of(word: &str) -> PyResult<Rf> {
    match word {
        "fixed-momentum" => Ok(Rf::FixedMomentum),
        "fixed-frequency" => Ok(Rf::FixedFrequency),
        _ => Err(input(format!("rf: expected fixed-momentum or fixed-frequency, found {word:?}"))),
    }
}

#[pymethods]
impl Ring {
    /// A built-in machine by the name of its file; the first without one, or with one that is not built in.
    #[staticmethod]
    #[pyo3(signature = (file=None))]
    fn built_in(file: Option<&str>) -> PyResult<Self> {
        let (name, text) = BUILT_IN.into_iter().find(|(name, _)| Some(*name) == file).unwrap_or(BUILT_IN[0]);
        Self::machine(text.into(), name.into())
    }

    /// The ring of a machine file's text; `file` appears in errors.
    #[staticmethod]
    pub fn machine(text: String, file: String) -> PyResult<Self> {
        Self::of(Source::Machine { text, file }, None, None, None)
    }

    /// The ring of a lattice by another code.
    #[staticmethod]
    fn lattice(text: String, file: String, monitors: Vec<String>, correctors: Vec<String>) -> PyResult<Self> {
        Self::of(Source::Lattice(Imported::parse(text, file, monitors, correctors)?), None, None, None)
    }

    /// A ring from what `state` said of it.
    #[staticmethod]
    fn again(state: State) -> PyResult<Self> {
        let (text, file, patterns, vars, width, range) = state;
        let source = match patterns {
            None => Source::Machine { text, file },
            Some((monitors, correctors)) => Source::Lattice(Imported::parse(text, file, monitors, correctors)?),
        };
        Self::of(source, Some(vars), width, range)
    }

    /// All that the ring is made of.
    fn state(&self) -> State {
        let (text, file, patterns) = match &self.source {
            Source::Machine { text, file } => (text, file, None),
            Source::Lattice(of) => (&of.text, &of.file, Some((of.monitors.clone(), of.correctors.clone()))),
        };
        (text.clone(), file.clone(), patterns, self.vars.clone(), self.width, self.range)
    }

    /// The same ring with factors on the gradients of its params, by name; 1 for the others.
    fn with_vars(&self, vars: BTreeMap<String, f64>) -> PyResult<Self> {
        let factors = factors(&vars, &self.ring).map_err(input)?;
        let vars = self.vars.iter().zip(factors).map(|(own, factor)| own * factor).collect();
        Self::of(self.source.clone(), Some(vars), self.width, self.range)
    }

    /// The same ring with other priors of its vars.
    fn with_priors(&self, width: Option<f64>, range: Option<[f64; 2]>) -> PyResult<Self> {
        if width.is_some_and(|width| !(width > 0.0 && width.is_finite())) {
            return Err(input(format!("prior_width: expected above 0, found {}", width.unwrap_or(f64::NAN))));
        }
        if let Some([low, high]) =
            range.filter(|[low, high]| !(0.0 < *low && *low < 1.0 && 1.0 < *high && high.is_finite()))
        {
            return Err(input(format!("range: expected one between 0 and 1 and one above 1, found {low}, {high}")));
        }
        Self::of(self.source.clone(), Some(self.vars.clone()), width.or(self.width), range.or(self.range))
    }

    #[getter]
    fn name(&self) -> &str {
        &self.ring.name
    }

    #[getter]
    fn file(&self) -> &str {
        &self.ring.file
    }

    #[getter]
    fn circumference(&self) -> f64 {
        self.ring.circumference
    }

    #[getter]
    fn particle(&self) -> &str {
        self.ring.particle.name()
    }

    #[getter]
    fn kinetic_energy(&self) -> f64 {
        self.ring.particle.kinetic_energy
    }

    /// Names of the strength factors [N].
    #[getter]
    fn vars(&self) -> Vec<String> {
        self.ring.var_names()
    }

    /// Factor of each [N].
    #[getter]
    fn factors(&self) -> Vec<f64> {
        self.vars.clone()
    }

    /// Names of the monitors that are read [B].
    #[getter]
    fn monitors(&self) -> Vec<String> {
        self.ring.monitor_names()
    }

    /// Names of all monitors, those that are not read too [P].
    #[getter]
    fn places(&self) -> Vec<String> {
        (0..self.ring.monitors.len()).map(|monitor| self.ring.monitor_name(monitor)).collect()
    }

    /// Names of the correctors [C].
    #[getter]
    fn correctors(&self) -> Vec<String> {
        self.ring.corrector_names()
    }

    /// Names of the quadrupoles [M].
    #[getter]
    fn quadrupoles(&self) -> Vec<String> {
        self.ring.labels(self.ring.quadrupoles.iter().map(|q| q.element))
    }

    /// Gradients of the quadrupoles [M] [1/m^2].
    #[getter]
    fn gradients(&self) -> Vec<f64> {
        self.ring.gradients()
    }

    /// Prior of each var: width, smallest and largest value [N].
    #[getter]
    fn priors(&self) -> Vec<[f64; 3]> {
        let of = |one: &twin::Parameter| [one.prior.width, one.prior.range[0], one.prior.range[1]];
        self.ring.parameters.iter().map(of).collect()
    }

    /// Names of the main supplies [F].
    #[getter]
    fn supplies(&self) -> Vec<String> {
        self.ring.supplies.iter().map(|supply| supply.name.clone()).collect()
    }

    /// Name, type and entrance [m] of every element.
    #[getter]
    fn elements(&self) -> (Vec<String>, Vec<f64>) {
        let all = &self.ring.elements;
        (all.iter().map(|one| one.name.clone()).collect(), all.iter().map(|one| one.s).collect())
    }

    /// Entrances of the monitors that are read and of the correctors [m].
    #[getter]
    fn positions(&self) -> (Vec<f64>, Vec<f64>) {
        let s = |element: usize| self.ring.elements[element].s;
        let monitors = self.ring.monitors_read().map(|monitor| s(monitor.element)).collect();
        (monitors, self.ring.correctors.iter().map(|corrector| s(corrector.element)).collect())
    }

    /// Of a lattice of another code: what was left out, with the number of elements.
    #[getter]
    fn left_out(&self) -> Vec<(String, usize)> {
        let left_out = self.imported().map(|imported| imported.of.0.left_out.clone()).unwrap_or_default();
        left_out.into_iter().map(|(what, count)| (what.to_owned(), count)).collect()
    }

    /// Response of the monitors that are read [B][C] [m/rad].
    fn response<'py>(&self, py: Python<'py>, effects: Vec<String>, rf: &str) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let made = py.detach(|| self.with_machine((&effects, rf), response))?;
        matrix(py, &made)
    }

    /// Response of x and of y at all monitors [2][P][C] [m/rad].
    fn full_response<'py>(
        &self,
        py: Python<'py>,
        effects: Vec<String>,
        rf: &str,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let made = py.detach(|| self.with_machine((&effects, rf), |machine, _| machine.response()))?;
        matrices(py, &[made.x, made.y], [self.ring.monitors.len(), self.ring.correctors.len()])
    }

    /// Derivative of the response with respect to the vars [N][B][C] [m/rad], or to the gradients [M][B][C] [m/rad per 1/m^2].
    fn jacobian<'py>(
        &self,
        py: Python<'py>,
        by_gradient: bool,
        effects: Vec<String>,
        rf: &str,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let made = py.detach(|| {
            let of_gradients = self.with_machine((&effects, rf), jacobian)?;
            PyResult::Ok(if by_gradient { of_gradients } else { by_parameter(&self.ring, of_gradients) })
        })?;
        matrices(py, &made, [self.ring.read_monitors.len(), self.ring.correctors.len()])
    }

    /// Optics at the entrance of every element and at the end, as arrays by name.
    fn optics<'py>(&self, py: Python<'py>, effects: Vec<String>, rf: &str) -> PyResult<Bound<'py, PyDict>> {
        let made = py.detach(|| self.with_machine((&effects, rf), |machine, _| table(machine)))?;
        let result = PyDict::new(py);
        let planes = |of: &dyn Fn(usize, usize) -> f64| {
            let values = (0..2).flat_map(|plane| (0..made.twiss.len()).map(move |at| (plane, at)));
            let values: Vec<f64> = values.map(|(plane, at)| of(plane, at)).collect();
            PyArray1::from_vec(py, values)
        };
        result.set_item("beta", planes(&|plane, at| made.twiss[at].beta[plane]))?;
        result.set_item("phase_advance", planes(&|plane, at| made.twiss[at].phase_advance[plane]))?;
        result.set_item("dispersion", planes(&|plane, at| made.twiss[at].dispersion[plane]))?;
        result.set_item("orbit", planes(&|plane, at| made.orbit[at][plane]))?;
        result.set_item("tunes", made.tunes)?;
        result.set_item("momentum_compaction", made.compaction[0])?;
        result.set_item("gamma_transition", made.compaction[1])?;
        Ok(result)
    }

    /// The ring as a lattice file of another code, with the strengths and findings of a result's JSON if there is one.
    fn export(&self, format: &str, result: Option<&str>) -> PyResult<String> {
        let Some(format) = Format::ALL.into_iter().find(|one| one.word() == format) else {
            return Err(input(format!("format: expected madx, bmad, at, xsuite or pals, found {format:?}")));
        };
        let lattice = match result {
            None => Lattice::plain(&self.ring),
            Some(result) => {
                let path = std::path::Path::new("result");
                let calibration = Calibration::parse(result, "result").map_err(input)?;
                Lattice::of(&self.ring, &calibration, path).map_err(input)?
            }
        };
        Ok(text(&lattice, format))
    }
}
